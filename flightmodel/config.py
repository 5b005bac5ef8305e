"""How TOML files become checked values: every fault of a file at once, with the nearest known key."""

from __future__ import annotations

import os
import re
import tomllib
import unicodedata
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, Literal, Self, TypeVar, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from flightmodel.checks import ConfigError, Issue, nearest_name
from flightmodel.files import file_bytes, leads_outside, nothing_at
from flightmodel.units import UNITS, read_unit

# what a number may be: far wider than any flight, so that what lies outside is a slip of the pen
NonNegative = Annotated[float, Field(ge=0.0)]
Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
Elevation = Annotated[float, Field(ge=-90.0, le=90.0)]
Latitude = Elevation
Longitude = Angle
ErrorAngle = Annotated[float, Field(ge=0.0, le=45.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Time = Annotated[float, Field(ge=-1e6, le=1e6)]
Duration = Annotated[float, Field(ge=1e-9, le=1e6)]
SampleRate = Annotated[float, Field(ge=1e-3, le=20e3)]
Length = Annotated[float, Field(ge=1e-4, le=100.0)]
Place = Annotated[float, Field(ge=-100.0, le=100.0)]
YEARS = (1940, 2200)
LARGEST_TOML_BYTES = 10_000_000
# also the name of a table in TOML, of a file and of a column
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=64)]


def one_line(value: str) -> str:
    """Refuse a name that would move a cursor, turn a line round or begin another one where it is shown."""
    if any(unicodedata.category(sign) in ("Cc", "Cf", "Cs", "Zl", "Zp") for sign in value):
        raise ValueError("one line without control or bidirectional characters is wanted")
    return value


Label = Annotated[str, AfterValidator(one_line)]  # a name for people, who read it in tables and figures
FILL_IN_VALUE = "FILL IN"  # where a new file leaves a value to its user
FILL_IN = "still to fill in"  # and the message for it
NAME_RULE = "a name has 1 to 64 letters (a to z), digits, _ and -"


def beside(value: str) -> str:
    """Refuse a file name that leads out of the folder, so that a copy of the folder is whole."""
    paths = PurePosixPath(value), PureWindowsPath(value)
    if not paths[0].name or "\0" in value or any(path.anchor or ".." in path.parts for path in paths):
        raise ValueError("a file beside this one, or in a folder below it, is wanted; copy it there")
    return value


FileBeside = Annotated[str, AfterValidator(beside)]

# key below the table that is checked ("" for the table), its value, what is wrong; an `Issue` has its own code
KeyFault = tuple[str, object, str]


class KeyFaults(ValueError):
    """Inconsistencies between keys of a table; `parse_section` makes a message of each `KeyFault`."""

    def __init__(self, faults: list[KeyFault]) -> None:
        self.faults = tuple(faults)
        shown = (f"{key} = {_shown(value)}: {words}" if key else words for key, value, words in faults)
        super().__init__("; ".join(shown))


class Section(BaseModel):
    """Base of all configuration tables: immutable, unknown keys refused, numbers finite and nothing else than numbers.

    Whole numbers pass where a number is wanted, and so does text with a unit (``"4 mg"``) for a key whose name ends
    with a unit; true, false and other text do not.
    """

    # built at first use: a command reads few of the tables that it imports
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    @field_validator("*", mode="before")
    @classmethod
    def _no_coercion(cls, value: Any, info: ValidationInfo) -> Any:
        wanted = _wanted_types(cls, str(info.field_name))
        for leaf in _leaves(value):
            if isinstance(leaf, str) and leaf.startswith(FILL_IN_VALUE):
                raise ValueError(FILL_IN)
            if isinstance(leaf, bool) and bool not in wanted and wanted & {int, float}:
                raise ValueError("a number is wanted, not true or false")
            if isinstance(leaf, str) and str not in wanted and bool in wanted:
                raise ValueError("true or false is wanted")
            if isinstance(leaf, (int, float)) and wanted == {bool} and not isinstance(leaf, bool):
                raise ValueError("true or false is wanted")
        return _numbers_of(value, str(info.field_name)) if wanted & {int, float} and str not in wanted else value

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys, each of which is valid by itself."""
        return ()

    @model_validator(mode="after")
    def _keys_fit(self) -> Self:
        if faults := [*self.key_faults()]:
            raise KeyFaults(faults)
        return self


_WITH_UNIT = re.compile(r"\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*([^\s\d.].*?)\s*")


def _numbers_of(value: Any, key: str) -> Any:
    """Value in which texts with a unit, as data sheets have them, are numbers in the unit that ends the key's name."""
    if isinstance(value, (list, tuple)):
        return [_numbers_of(part, key) for part in value]
    if not isinstance(value, str):
        return value
    *name, last = key.split("_")
    own, text = UNITS.get(last), _WITH_UNIT.fullmatch(value)
    if own is None or text is None:
        raise ValueError("a number is wanted, not text")
    given = read_unit(text[2] if len(text[2]) > 1 else text[2].lower())  # K, T
    if given is None or given.kind != own.kind:
        raise ValueError(f"a number of {last} is wanted, or one with a unit of {own.kind}")
    apart = 0.0 if {"sd", "bias"} & set(name) else given.offset - own.offset  # a difference has no zero
    return (float(text[1]) * given.factor + apart) / own.factor


@cache  # a study checks the same few fields a hundred thousand times
def _wanted_types(model: type[BaseModel], field: str) -> frozenset[type]:
    return frozenset(_leaf_types(model.model_fields[field].annotation))


def _leaf_types(annotation: Any) -> Iterator[type]:
    if get_origin(annotation) is Literal:
        yield from {type(value) for value in get_args(annotation)}
    elif get_origin(annotation) is Annotated:
        yield from _leaf_types(get_args(annotation)[0])
    elif get_args(annotation):
        for part in get_args(annotation):
            yield from _leaf_types(part)
    elif annotation is not type(None) and isinstance(annotation, type):
        yield annotation


def _leaves(value: Any) -> Iterator[Any]:
    """Return the numbers and texts of a value; tables check themselves."""
    if isinstance(value, (list, tuple)):
        for part in value:
            yield from _leaves(part)
    elif not isinstance(value, (dict, BaseModel)):
        yield value


SectionT = TypeVar("SectionT", bound=Section)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file, or raise `ConfigError` with the file, line and column."""
    if "\0" in str(path):
        raise ConfigError(f"{str(path)!r}: a path holds no NUL character", code="path-refused")
    try:
        return tomllib.loads(file_bytes(path, LARGEST_TOML_BYTES).decode("utf-8-sig").replace("\r\n", "\n"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: {nothing_at(path)}", code="file-missing") from None
    except RecursionError:
        raise ConfigError(
            f"{path}: not valid TOML: arrays or tables lie too deep in each other", code="toml-syntax"
        ) from None
    except ValueError as fault:  # also integers of thousands of digits
        raise ConfigError(f"{path}: not valid TOML: {fault}", code="toml-syntax") from None
    except OSError as fault:
        raise ConfigError(
            f"{path}: cannot be read: {fault.strerror or fault}", getattr(fault, "code", "file-unreadable")
        ) from None


def read_section(model: type[SectionT], path: Path) -> SectionT:
    """Read a TOML file as ``model``; `ConfigError` with its faults, and the files below it that it names in vain."""
    tables = read_toml(path)
    try:
        return parse_section(model, tables, str(path))
    except ConfigError as fault:
        absent = [
            Issue(f"{path}: key '{key}': {path.parent / name}: {nothing_at(path.parent / name)}", "file-missing")
            for key, name in _named_files(tables)
            if not any(f"key '{key}'" in words for words in fault.faults) and not leads_outside(path.parent, name)
            if not os.path.exists(path.parent / name)  # False also for a name too long for a file
        ]
        raise ConfigError([*fault.faults, *absent]) from None


def _named_files(tables: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Key and value of each file that tables name, those inside them too."""
    for key, value in tables.items():
        if isinstance(value, dict):
            yield from _named_files(value, (*above, key))
        elif isinstance(value, str) and (key == "file" or value.endswith(".toml")) and "\0" not in value:
            yield ".".join((*above, key)), value


def parse_section(model: type[SectionT], tables: dict[str, Any], where: str) -> SectionT:
    """Validate ``tables`` as ``model``; raise `ConfigError` listing all faults of the file ``where``."""
    try:
        return model.model_validate(tables)
    except ValidationError as fault:
        raise ConfigError([text for item in fault.errors() for text in _sentences(where, model, item)]) from None
    except RecursionError:
        raise ConfigError(f"{where}: arrays or tables lie too deep in each other", code="toml-syntax") from None


def _shown(value: object) -> str:
    """Return a value as a message shows it: short."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "(too long to show)"
    return text if len(text) <= 60 else f"{text[:57]}..."


def _sentences(where: str, model: type[BaseModel], item: Any) -> list[Issue]:
    """Faults that one item of pydantic's list means."""
    path = [str(part) for part in item["loc"]]
    if path and path[-1] == "[key]":
        return [Issue(f"{where}: key '{'.'.join(path[:-1])}': {NAME_RULE}", "option-format")]
    key = ".".join(path)
    if item["type"] == "extra_forbidden":
        known = _keys_beside(model, path[:-1])
        hint = f"{nearest_name(path[-1], known)}; known here: {', '.join(sorted(known))}"
        return [Issue(f"{where}: unknown key '{key}'{hint}", "key-unknown")]
    if item["type"] == "missing":
        return [Issue(f"{where}: key '{key}' is missing", "key-missing")]
    words = item["msg"].removeprefix("Value error, ")
    if item["type"] == "model_type":
        words = f"a table is wanted here, with keys among {', '.join(_keys_beside(model, path))}"
    cause = item.get("ctx", {}).get("error")
    if isinstance(cause, KeyFaults):
        out = []
        for name, value, text in cause.faults:
            at = f"'{'.'.join([*path, name])}' = {_shown(value)}" if name else f"'{key}'"
            out.append(Issue(f"{where}: key {at}: {text}", getattr(text, "code", "keys-conflict")))
        return out
    if isinstance(item["input"], (dict, BaseModel)):
        return [Issue(f"{where}: key '{key}': {words}", "keys-conflict")]
    return [Issue(f"{where}: key '{key}' = {_shown(item['input'])}: {words}", "key-value")]


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
    fields = getattr(model, "model_fields", {})
    return [field.alias or name for name, field in fields.items()]


def parse_utc(text: str) -> datetime:
    """Return an aware UTC time from ISO text; ValueError where it is none, or in no year of spaceflight."""
    stamp = datetime.fromisoformat(text.replace("Z", "+00:00"))
    if not YEARS[0] <= stamp.year <= YEARS[1]:
        raise ValueError(f"a year from {YEARS[0]} to {YEARS[1]} is wanted")
    return stamp.astimezone(UTC) if stamp.tzinfo else stamp.replace(tzinfo=UTC)


def one_of(section: Section, first: str, second: str) -> Iterator[KeyFault]:
    """Yield that a section states neither of two keys, or both."""
    if (getattr(section, first) is None) == (getattr(section, second) is None):
        yield "", None, f"either {first} or {second} is wanted, and not both"
