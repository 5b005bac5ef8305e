"""How TOML files become checked values: every fault of a file at once, with the nearest known key."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from flightmodel.checks import ConfigError, nearest_name


class Section(BaseModel):
    """Base of all configuration tables: immutable, unknown keys refused, numbers finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


SectionT = TypeVar("SectionT", bound=Section)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file, or raise `ConfigError` with the file, line and column."""
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise ConfigError(f"{path}: not valid TOML: {fault}") from None
    except OSError as fault:
        raise ConfigError(f"{path}: cannot be read: {fault.strerror or fault}") from None


def parse_section(model: type[SectionT], tables: dict[str, Any], where: str) -> SectionT:
    """Validate ``tables`` as ``model``; raise `ConfigError` listing all faults of the file ``where``."""
    try:
        return model.model_validate(tables)
    except ValidationError as fault:
        raise ConfigError([_sentence(where, model, item) for item in fault.errors()]) from None


def _sentence(where: str, model: type[BaseModel], item: Any) -> str:
    path = [str(part) for part in item["loc"]]
    key = ".".join(path)
    if item["type"] == "extra_forbidden":
        known = _keys_beside(model, path[:-1])
        return f"{where}: unknown key '{key}'{nearest_name(path[-1], known)}; known here: {', '.join(sorted(known))}"
    if item["type"] == "missing":
        return f"{where}: key '{key}' is missing"
    return f"{where}: key '{key}' = {item['input']!r}: {item['msg'].removeprefix('Value error, ')}"


def _keys_beside(model: Any, path: list[str]) -> list[str]:
    """Return the fields of the table reached by ``path``, looking through dict, list and optional types."""
    for part in path:
        if isinstance(model, type) and issubclass(model, BaseModel) and part in model.model_fields:
            model = model.model_fields[part].annotation
        for _ in range(3):
            inner = [a for a in getattr(model, "__args__", ()) if hasattr(a, "model_fields") or hasattr(a, "__args__")]
            if (isinstance(model, type) and issubclass(model, BaseModel)) or not inner:
                break
            model = inner[-1]
    return list(model.model_fields) if hasattr(model, "model_fields") else []
