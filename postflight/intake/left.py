"""Which values has an analyst still to write? Counted in the same way by ``import`` and by ``check``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flightmodel.checks import ConfigError
from flightmodel.config import FILL_IN, FILL_IN_VALUE, read_toml
from flightmodel.vehicle import vehicle_path


def left_to_fill_in(folder: Path) -> list[str]:
    """Values that say FILL IN, each with file and key: of flight.toml, its vehicle file, and the table's sidecar.

    Files that cannot be read hold none: they are refused elsewhere.
    """
    flight = _tables(folder / "flight.toml")
    out = _said(folder / "flight.toml", flight)
    named = flight.get("vehicle")
    if not isinstance(named, str) or not named.endswith(".toml"):
        return out
    path = vehicle_path(named, folder)
    vehicle = _tables(path)
    out += _said(path, vehicle)
    aerodynamics = vehicle.get("aerodynamics")
    table = aerodynamics.get("table") if isinstance(aerodynamics, dict) else None
    if isinstance(table, str):
        sidecar = (path.parent / table).with_suffix(".toml")
        out += _said(sidecar, _tables(sidecar))
    return out


def _tables(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except (ConfigError, OSError, ValueError):
        return {}


def _said(path: Path, tables: dict[str, Any]) -> list[str]:
    return [f"{path}: key '{key}' {FILL_IN}" for key in _keys(tables, "")]


def _keys(value: Any, at: str) -> Iterator[str]:
    """Dotted names of what says FILL IN; a list counts once."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _keys(inner, f"{at}.{key}" if at else key)
    elif isinstance(value, list) and any(isinstance(inner, (dict, list)) for inner in value):
        for k, inner in enumerate(value):
            yield from _keys(inner, f"{at}.{k}")
    elif any(
        isinstance(v, str) and v.startswith(FILL_IN_VALUE) for v in (value if isinstance(value, list) else [value])
    ):
        yield at
