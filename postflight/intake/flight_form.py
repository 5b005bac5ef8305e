"""Which keys may a file hold? JSON Schema for editors, from the very models that read the files.

What a key means is taken from the comments of the templates that ``postflight init`` writes. The schema says less than
the reader: it knows types, bounds and names, not what goes together.

Which values has an analyst still to write? Counted in the same way by ``import`` and by ``check``.

How a proposal stands in flight.toml: tables to correct, with why each column was taken for what, and questions.

What ``postflight init`` writes: a flight folder to fill in, with the schemas that editors check by.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from rich.console import Console
from rich.markup import escape

from flightmodel.aerodynamics import Sidecar
from flightmodel.checks import ConfigError
from flightmodel.config import FILL_IN, FILL_IN_VALUE, read_toml
from flightmodel.flightfile import FlightFile
from flightmodel.tables import UNITS
from flightmodel.vehicle import DATA, VehicleFile, vehicle_from_toml, vehicle_path
from postflight.intake.propose import ASKED, Mapped, SourceProposal, TimeMapped, quoted
from postflight.run_folder import write_file
from synthetic_flight.scenarios import ScenarioFile

MODELS: dict[str, type[BaseModel]] = {
    "flight": FlightFile,
    "vehicle": VehicleFile,
    "scenario": ScenarioFile,
    "coefficients": Sidecar,
}
HEADER = re.compile(r"^(?:# )?\[\[?([\w.]+)\]\]?")
KEY = re.compile(r"^(?:# )?(\w+) = (.*?)\s+# (.*)$")


def template(kind: str) -> str:
    """Text of the template of a ``flight`` or a ``vehicle``."""
    return (files("postflight.intake") / "templates" / f"{kind}.toml").read_text(encoding="utf-8")


def template_keys(kind: str) -> Iterator[tuple[str, str, str, str]]:
    """Table, key, value as written and comment of each line of a template that names a key."""
    table = ""
    for line in template(kind).splitlines():
        if header := HEADER.match(line):
            table = header[1]
        elif key := KEY.match(line):
            yield table, key[1], key[2], key[3]


def schema(kind: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a file of this kind."""
    made = MODELS[kind].model_json_schema()
    made = {"$schema": "https://json-schema.org/draft/2020-12/schema", **made}
    if kind in ("flight", "vehicle"):
        for table, key, _, comment in template_keys(kind):
            place = _properties(made, table)
            if key in place:
                place[key] = {**place[key], "description": comment.removesuffix(", e.g.").removesuffix("e.g.")}
    return made


def schema_text(kind: str) -> str:
    """Return the schema as it is written to a file."""
    return json.dumps(schema(kind), indent=2) + "\n"


def _properties(made: dict[str, Any], table: str) -> dict[str, Any]:
    """Return the properties of the table that a dotted name reaches, through references, options and lists."""
    at = made
    for part in filter(None, table.split(".")):
        inner = at.get("properties", {}).get(part)
        if inner is None:
            inner = at.get("additionalProperties") or next(iter(at.get("patternProperties", {}).values()))
        at = _resolved(made, inner)
    own: dict[str, Any] = at.get("properties", {})
    return own


def _resolved(made: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    while True:
        if "$ref" in node:
            node = made["$defs"][node["$ref"].rsplit("/", 1)[1]]
        elif "anyOf" in node:
            node = next(n for n in node["anyOf"] if n.get("type") != "null")
        elif node.get("type") == "array" and "$ref" in node.get("items", {}):
            node = node["items"]
        else:
            return node


def placeholders(folder: Path) -> list[str]:
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


WIDTH = 62  # of a line's value, before its comment


def section_text(source: SourceProposal, file: str, notes: list[str], taken: bool) -> str:
    """Return the TOML of one table; as comments below a question where flight.toml has that table already."""
    lines = [f"[{source.section}]"]
    lines += [f"# {note}" for note in notes]
    lines.append(f"file = {quoted(file)}")
    if source.time is not None:
        lines += _time_lines(source.time)
    lines += [_line(f"{key} = {value}", comment) for key, value, comment in source.keys]
    declared = [m for m in source.columns if not m.canonical]
    if declared:
        lines += ["", f"[{source.section}.columns]"]
        lines += [_column_line(m) for m in declared]
    if taken:
        first = f"# QUESTION: [{source.section}] is there already. Which is right? Take one out."
        lines = [first, *(f"# {line}".rstrip() for line in lines)]
    return "\n".join(lines) + "\n"


def start_text(sections: set[str], tables: dict[str, Any], doubtful: list[str]) -> str:
    """Return what the tables ask for besides: how the vehicle was turned, or how it moves without inertial sensors.

    ``doubtful`` names files with columns that were recognised as nothing and may be an accelerometer's or gyros'.
    """
    inertial = {"sensors.accelerometer", "sensors.rates"} <= sections
    if inertial:
        return _ballistic_doubt(tables) + _attitude_text(tables)
    tracked = any(s.startswith(("radars.", "gnss.")) for s in sections)
    if not tracked or "motion" in tables:
        return ""
    text = (
        "[motion]                          # no accelerometer with gyros yet: gravitation and drag carry the flight\n"
        'model = "ballistic"               # take [motion] out once both are there\n'
        'drag_area_per_mass_m2pkg = "FILL IN"  # m2/kg: C_D S / m, to a factor of 2.7\n'
    )
    if not doubtful:
        return text
    first = (
        f"# QUESTION: {one_line(', '.join(doubtful))} may hold an accelerometer or gyros: declare the columns above.\n"
        "# Only a flight without both moves like this:\n"
    )
    return first + "".join(f"# {line}\n" for line in text.replace("FILL IN", "...").splitlines())


def _ballistic_doubt(tables: dict[str, Any]) -> str:
    """Return the question that an earlier ``[motion]`` is, once inertial sensors are there."""
    motion = tables.get("motion")
    if not isinstance(motion, dict) or motion.get("model") != "ballistic":
        return ""
    return (
        '# QUESTION: [motion] above says model = "ballistic", so accelerometer and gyros would not carry the flight:\n'
        "# take [motion] out, unless that is meant.\n"
    )


def _attitude_text(tables: dict[str, Any]) -> str:
    if "attitude_prior" in tables:
        return ""
    return (
        "[attitude_prior]                  # how the vehicle was turned at one time; or q_ecef_body, scalar first\n"
        't_s = "FILL IN"                   # s after t0\n'
        'azimuth_deg = "FILL IN"           # deg from true north: where the nose points\n'
        'elevation_deg = "FILL IN"         # deg above the horizon\n'
        'roll_deg = "FILL IN"              # deg; at 0 body y is level and points right of one who looks along x\n'
        "# q_ecef_body = [1.0, 0.0, 0.0, 0.0]  # instead of these three: body to ECEF, scalar FIRST, e.g.\n"
        "sd_deg = 3.0                      # deg, one number or one for body x, y, z\n"
    )


def _line(text: str, comment: str) -> str:
    return f"{text:<{WIDTH}} # {comment}" if comment else text


def _time_lines(time: TimeMapped) -> list[str]:
    parts = []
    if time.format == "utc_hms":
        parts.append(f"columns = [{', '.join(quoted(c) for c in time.columns)}]")
    elif time.columns[0] != "t_s":
        parts.append(f"column = {quoted(time.columns[0])}")
    if time.format != "seconds":
        parts.append(f'format = "{time.format}"')
    elif time.unit != "s":
        parts.append(f'unit = "{time.unit or "FILL IN"}"')
    if time.offset_asked:
        parts.append('offset_s = "FILL IN"')
    why = time.why
    if time.format == "seconds" and not time.unit:
        why = f"which unit? s, ms, us, min; {why}"
    if time.offset_asked:
        why += "; these seconds do not start at t0: what is added to each (0 where they do)?"
    if time.others:
        why += f"; {', '.join(time.others)} would be another time"
    return [_line(f"time = {{ {', '.join(parts)} }}", why)] if parts else ([f"# time: {why}"] if time.others else [])


def _column_line(mapped: Mapped) -> str:
    text = f'{mapped.short} = {{ column = {quoted(mapped.column)}, unit = "{mapped.unit or "FILL IN"}" }}'
    if mapped.how == ASKED:
        return _line(text, f"which unit? {', '.join(units_of(mapped.short))}; {one_line(mapped.why)}")
    return _line(text, one_line(mapped.why) if mapped.how == "stated" else f"by its numbers: {one_line(mapped.why)}")


def units_of(short: str) -> list[str]:
    """Units that a quantity may have, the usual ones first."""
    from flightmodel.tables import ACCELEROMETER, ATMOSPHERE, BAROMETER, GNSS, MAGNETOMETER, RADAR, RATES

    every = (*ACCELEROMETER, *RATES, *MAGNETOMETER, *RADAR, *GNSS)
    known = next((q for q in (*every, *BAROMETER, *ATMOSPHERE) if q.short == short), None)
    return [u for u, (kind, _, _) in UNITS.items() if known is not None and kind == known.kind]


def one_line(text: str) -> str:
    """Text that is safe in a comment."""
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


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
    texts[folder / "flight.toml"] = flight.replace(VEHICLE_LINE, _vehicle_line(named))
    return texts, copies


def _vehicle_line(vehicle: str) -> str:
    return f"vehicle = {json.dumps(vehicle, ensure_ascii=False)}".ljust(VEHICLE_LINE.index("#", 1)) + "#"
