"""What do flight.toml and the vehicle file hold before the analyst's own values: forms, schema, placeholders,
proposals?

Forms are templates whose comments explain each key; a value ``"FILL IN"`` is a placeholder that no reader accepts.
The JSON Schema for editors is made from the very models that read the files, with the templates' comments as
descriptions; it states types, bounds and names, not what goes together. A proposal of ``postflight import`` becomes a
table of flight.toml with the reason for each column, and comments with ``QUESTION`` where more than one reading is
possible.
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
from rich.markup import escape

from flightmodel.aerodynamics import Sidecar
from flightmodel.checks import ConfigError
from flightmodel.config import FILL_IN_VALUE, read_toml
from flightmodel.files import write_file
from flightmodel.flightfolder import FlightFile
from flightmodel.tables import ACCELEROMETER, ATMOSPHERE, BAROMETER, GNSS, MAGNETOMETER, RADAR, RATES
from flightmodel.units import UNITS
from flightmodel.vehicle import DATA, VehicleFile, vehicle_from_toml, vehicle_path
from postflight.intake.column_recognition import (
    ASKED,
    FILL_IN_TOML,
    STATED,
    ColumnProposal,
    SourceProposal,
    TimeProposal,
    quoted,
)
from postflight.intake.loads_columns import kind_of
from postflight.terminal import terminal

_EVERY_QUANTITY = (*ACCELEROMETER, *RATES, *MAGNETOMETER, *RADAR, *GNSS, *BAROMETER, *ATMOSPHERE)
KINDS = ("flight", "vehicle", "scenario", "coefficients")
_HEADER = re.compile(r"^(?:# )?\[\[?([\w.]+)\]\]?")
_KEY = re.compile(r"^(?:# )?(\w+) = (.*?)\s+# (.*)$")
_INERTIAL = {"sensors.accelerometer": "the accelerometer is", "sensors.rates": "the gyros are"}
_WIDTH = 62  # of a line's value, before its comment
_VEHICLE_LINE = '# vehicle = "vehicle/vehicle.toml"    #'
console = terminal()


# forms and schema


def template(kind: str) -> str:
    """Return the text of a form: ``flight``, ``vehicle``, ``coefficients``, ``motion`` or ``attitude_prior``."""
    return (files("postflight.intake") / "templates" / f"{kind}.toml").read_text(encoding="utf-8")


def template_keys(kind: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield table, key, value as written and comment of each line of a template that names a key."""
    table = ""
    for line in template(kind).splitlines():
        if header := _HEADER.match(line):
            table = header[1]
        elif key := _KEY.match(line):
            yield table, key[1], key[2], key[3]


def model(kind: str) -> type[BaseModel]:
    """Return the model that reads files of this kind, one of `KINDS`."""
    if kind == "scenario":
        from synthetic_flight.scenarios import ScenarioFile  # init, import and check need no simulator

        return ScenarioFile
    models: dict[str, type[BaseModel]] = {"flight": FlightFile, "vehicle": VehicleFile, "coefficients": Sidecar}
    return models[kind]


def schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a file of this kind, one of `KINDS`."""
    made = model(kind).model_json_schema()
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


# placeholders


def placeholders(folder: Path) -> dict[Path, list[str]]:
    """Return the keys of the placeholders in flight.toml, its vehicle file and the coefficients' sidecar, by file.

    Files that cannot be read hold none: they are refused elsewhere.
    """
    path = folder / "flight.toml"
    found = {path: _tables(path)}
    named = found[path].get("vehicle")
    if isinstance(named, str) and named.endswith(".toml"):
        path = vehicle_path(named, folder)
        found[path] = _tables(path)
        aerodynamics = found[path].get("aerodynamics")
        table = aerodynamics.get("table") if isinstance(aerodynamics, dict) else None
        if isinstance(table, str):
            sidecar = (path.parent / table).with_suffix(".toml")
            found[sidecar] = _tables(sidecar)
    return {path: keys for path, tables in found.items() if (keys := list(_open_keys(tables, "")))}


def _tables(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except (ConfigError, OSError, ValueError):
        return {}


def _open_keys(value: Any, at: str) -> Iterator[str]:
    """Dotted names of placeholders; a list counts once."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _open_keys(inner, f"{at}.{key}" if at else key)
    elif isinstance(value, list) and any(isinstance(inner, (dict, list)) for inner in value):
        for k, inner in enumerate(value):
            yield from _open_keys(inner, f"{at}.{k}")
    else:
        leaves = value if isinstance(value, list) else [value]
        if any(isinstance(leaf, str) and leaf.startswith(FILL_IN_VALUE) for leaf in leaves):
            yield at


# proposals


def section_text(source: SourceProposal, file: str, notes: list[str], question: str, timed_as: str = "") -> str:
    """Return the TOML of one proposal.

    Parameters
    ----------
    source : SourceProposal
    file : str
        Of its table, relative to flight.toml.
    notes : list of str
        What was changed in the file, as comments.
    question : str
        Why the table may not be wanted, such as that flight.toml has it already: all becomes comments below it.
    timed_as : str
        Earlier section of the same file where the time is asked for; empty for none.
    """
    lines = [f"[{source.section}]"]
    lines += [f"# {note}" for note in notes]
    lines.append(f"file = {quoted(file)}")
    if timed_as:
        lines.append(_line(f"time = {quoted(timed_as)}", "the same column, asked for there"))
    elif source.time is not None:
        lines += _time_lines(source.time)
    lines += [_line(f"{key} = {value}", comment) for key, value, comment in source.keys]
    declared = [m for m in source.columns if not m.canonical]
    if declared:
        lines += ["", f"[{source.section}.columns]"]
        lines += [_column_line(m) for m in declared]
    if question:
        lines = [f"# QUESTION: {question}", *(f"# {line}".rstrip() for line in lines)]
    return "\n".join(lines) + "\n"


def start_text(sections: set[str], tables: dict[str, Any], unrecognised: list[str]) -> str:
    """Return the text of what the tables still lack: an attitude, or a motion model without inertial sensors.

    Parameters
    ----------
    sections : set of str
        Tables of flight.toml, proposed ones among them, as ``sensors.rates``.
    tables : dict
        Of flight.toml as it is.
    unrecognised : list of str
        Names of files with columns that were recognised as nothing and may be an accelerometer's or gyros'.
    """
    if {"sensors.accelerometer", "sensors.rates"} <= sections:
        return _ballistic_question(tables) + ("" if "attitude_prior" in tables else template("attitude_prior"))
    tracked = any(s.startswith(("radars.", "gnss.")) for s in sections)
    if not tracked or "motion" in tables:
        return ""
    text = template("motion")
    missing = [words for s, words in _INERTIAL.items() if s not in sections]
    if not unrecognised and len(missing) == len(_INERTIAL):
        return text
    first = f"# QUESTION: {missing[0]} missing; import the table.\n" if len(missing) == 1 else ""
    if unrecognised:
        names = _one_line(", ".join(unrecognised))
        first += f"# QUESTION: {names} may hold an accelerometer or gyros: declare the columns.\n"
    first += "# Only a flight without both moves like this:\n"
    return first + "".join(f"# {line}\n" for line in text.replace(FILL_IN_VALUE, "...").splitlines())


def _ballistic_question(tables: dict[str, Any]) -> str:
    """Return a question about an existing ``[motion]`` once inertial sensors are imported."""
    motion = tables.get("motion")
    if not isinstance(motion, dict) or motion.get("model") != "ballistic":
        return ""
    return (
        '# QUESTION: [motion] above has model = "ballistic", so accelerometer and gyros would not carry the flight:\n'
        "# take [motion] out, unless that is meant.\n"
    )


def _line(text: str, comment: str) -> str:
    return f"{text:<{_WIDTH}} # {comment}" if comment else text


def _time_lines(time: TimeProposal) -> list[str]:
    parts = []
    if time.format == "utc_hms":
        parts.append(f"columns = [{', '.join(quoted(c) for c in time.columns)}]")
    elif time.columns[0] != "t_s":
        parts.append(f"column = {quoted(time.columns[0])}")
    if time.format != "seconds":
        parts.append(f'format = "{time.format}"')
    elif time.unit != "s":
        parts.append(f'unit = "{time.unit or FILL_IN_VALUE}"')
    if time.repeats:
        parts.append('repeats = "first"')
    if time.offset_asked:
        parts.append(f"offset_s = {FILL_IN_TOML}")
    why = time.why
    if time.format == "seconds" and not time.unit:
        why = f"which unit? s, ms, us, min; {why}"
    if time.offset_asked:
        why += "; these seconds do not start at t0: what is added to each (0 where they do)?"
    if time.others:
        why += f"; {', '.join(time.others)} would be another time"
    return [_line(f"time = {{ {', '.join(parts)} }}", why)] if parts else ([f"# time: {why}"] if time.others else [])


def _column_line(m: ColumnProposal) -> str:
    text = f"{m.short} = {{ column = {quoted(m.column)}, unit = {quoted(m.unit or FILL_IN_VALUE)} }}"
    if m.how == ASKED:
        return _line(text, f"which unit? {', '.join(_units_of(m.short))}; {_one_line(m.why)}")
    return _line(text, _one_line(m.why) if m.how == STATED else f"by its numbers: {_one_line(m.why)}")


def _units_of(short: str) -> list[str]:
    """Units that a quantity may have, the usual ones first."""
    wanted = next((q.kind for q in _EVERY_QUANTITY if q.short == short), kind_of(short))
    return [u for u, (kind, _, _) in UNITS.items() if kind == wanted]


def _one_line(text: str) -> str:
    """Text made safe for a comment: one line."""
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


# the command


def init(folder: Path, vehicle: str | None) -> None:
    """Write the forms of a new flight folder and print what comes next.

    Parameters
    ----------
    folder : Path
        Made where it does not exist.
    vehicle : str or None
        Name of a shipped vehicle, path of a vehicle file (copied with its coefficient table), ``"form"`` for a form, or
        None: a trajectory needs no vehicle.

    Raises
    ------
    ConfigError
        ``file-exists`` where a file would be overwritten, or what `flightmodel.vehicle` refuses.
    """
    texts, copies = _contents(folder, vehicle)
    there = [path for path in (*texts, *copies) if path.exists()]
    if there:
        words = "exists already, and nothing is overwritten; name another folder"
        raise ConfigError([f"{path}: {words}" for path in there], code="file-exists")
    (folder / "telemetry").mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        write_file(path, text)
    for path, source in copies.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, path)
    for path in (*texts, *copies):
        console.print(f"written {escape(str(path))}", highlight=False)
    still_open = sum(text.count(FILL_IN_TOML) for text in texts.values())
    following = f"{still_open} values to fill in. Next: postflight import FILES... --into {escape(str(folder))}"
    console.print(following, highlight=False)


def _contents(folder: Path, vehicle: str | None) -> tuple[dict[Path, str], dict[Path, Path]]:
    """Texts to write and files to copy, by their paths."""
    flight = template("flight")
    texts = {folder / ".schema" / f"{kind}.json": schema_text(kind) for kind in ("flight", "vehicle")}
    copies: dict[Path, Path] = {}
    if vehicle is None:
        del texts[folder / ".schema" / "vehicle.json"]
        return texts | {folder / "flight.toml": flight}, copies
    if vehicle == "form":
        named = "vehicle/vehicle.toml"
        texts[folder / named] = template("vehicle")
    else:
        source = vehicle_path(vehicle)
        named = vehicle
        if source.parent != DATA / "vehicles":
            copies = vehicle_copies(folder, source)
            named = f"vehicle/{source.name}"
    assert _VEHICLE_LINE in flight
    texts[folder / "flight.toml"] = with_vehicle(flight, named)
    return texts, copies


def vehicle_copies(folder: Path, source: Path) -> dict[Path, Path]:
    """Return where a vehicle file and its tables go in a flight folder, and where each comes from."""
    names = (source.name, *vehicle_from_toml(source).files)
    return {folder / "vehicle" / name: source.parent / name for name in names}


def with_vehicle(flight: str, named: str) -> str:
    """Return flight.toml with a vehicle in the line that the form has for it; as it is where that line is gone."""
    line = f"vehicle = {quoted(named)}".ljust(_VEHICLE_LINE.index("#", 1)) + "#"
    return flight.replace(_VEHICLE_LINE, line)
