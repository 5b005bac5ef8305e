"""What ``postflight init`` writes: a flight folder to fill in, with the schemas that editors check by."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from flightmodel.checks import ConfigError
from flightmodel.config import FILL_IN_VALUE
from flightmodel.vehicle import DATA, vehicle_from_toml, vehicle_path
from postflight.intake.schema import schema_text, template
from postflight.whole_file import write_file

console = Console(soft_wrap=True)
VEHICLE_LINE = '# vehicle = "vehicle/vehicle.toml"    #'


def init(folder: Path, vehicle: str | None) -> None:
    """Write the files and say what comes next.

    Parameters
    ----------
    folder : Path
        Made where it does not exist.
    vehicle : str or None
        Name of a shipped vehicle, path of a vehicle file (copied with its coefficient table), or None for a form.

    Raises
    ------
    ConfigError
        Where a file that would be written exists, or no such vehicle is known.
    """
    texts, copies = _contents(folder, vehicle)
    there = [path for path in (*texts, *copies) if path.exists()]
    if there:
        raise ConfigError(
            [f"{path}: exists already, and nothing is overwritten; name another folder" for path in there]
        )
    (folder / "telemetry").mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        write_file(path, text)
    for path, source in copies.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, path)
    for path in (*texts, *copies):
        console.print(f"written {escape(str(path))}", highlight=False)
    left = sum(text.count(f'"{FILL_IN_VALUE}"') for text in texts.values())
    console.print(
        f"{left} values say FILL IN. Next: postflight import FILES... --into {escape(str(folder))}", highlight=False
    )


def _contents(folder: Path, vehicle: str | None) -> tuple[dict[Path, str], dict[Path, Path]]:
    """Texts to write and files to copy, by their paths."""
    flight = template("flight")
    texts = {folder / ".schema" / f"{kind}.json": schema_text(kind) for kind in ("flight", "vehicle")}
    copies: dict[Path, Path] = {}
    if vehicle is None:
        named = "vehicle/vehicle.toml"
        texts[folder / named] = template("vehicle")
    else:
        source = vehicle_path(vehicle)
        named = vehicle
        if source.parent != DATA / "vehicles":
            read = vehicle_from_toml(source)
            named = f"vehicle/{source.name}"
            copies = {folder / "vehicle" / name: source.parent / name for name in (source.name, *read.files)}
    assert VEHICLE_LINE in flight
    texts[folder / "flight.toml"] = flight.replace(VEHICLE_LINE, _line(named))
    return texts, copies


def _line(vehicle: str) -> str:
    return f"vehicle = {json.dumps(vehicle, ensure_ascii=False)}".ljust(VEHICLE_LINE.index("#", 1)) + "#"
