"""How is each delivered file used: as telemetry table, radiosonde, coefficients, video, or not at all?

``postflight import`` reads all files, proposes what each column is, and only then writes: tables to ``telemetry/`` as
CSV, images and films there as they are, a vehicle file with its tables to ``vehicle/``, coefficient tables beside it
with a sidecar to fill in, and the proposals at the end of flight.toml. Nothing is overwritten, and nothing is written
where a file is refused.

A radiosonde's density follows from its pressure, temperature and humidity, ``rho = p / (R T_v)`` with the virtual
temperature ``T_v = T / (1 - 0.378 e / p)`` and the vapour pressure ``e`` of the dew point (Bolton, "The computation
of equivalent potential temperature", Monthly Weather Review 108, 1980, eq. 10). Geopotential heights ``h`` become
geometric, ``z = R h / (R - h)`` with R = 6356.766 km (US Standard Atmosphere 1976, eq. 19). Levels that hold only
wind or only temperature take the other from their neighbours: temperature along the logarithm of pressure, wind by
components along height; nothing is extrapolated. Wind directions stay where the wind comes from:
`flightmodel.sensor_tables` makes velocities of the air mass of them, with a finding.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from flightmodel.aerodynamics import COLUMNS, named_columns
from flightmodel.atmosphere import EARTH_RADIUS_US76_M, R_AIR_JPKGK
from flightmodel.checks import ConfigError, FloatArray, GateError, Issue
from flightmodel.config import read_toml
from flightmodel.files import file_bytes, write_file, writing
from flightmodel.film import FILM_SUFFIXES, start_fault
from flightmodel.instruments import TriadSpec
from flightmodel.tables import to_si
from flightmodel.telemetry import TriadRecord, find_rest, mean_readings
from flightmodel.vehicle import DATA, vehicle_path
from postflight.intake.column_recognition import (
    ASKED,
    FILL_IN_TOML,
    STATED,
    ColumnProposal,
    Recogniser,
    SourceProposal,
    TimeProposal,
    add_clock_columns,
    column_names,
    column_unit,
    find_time,
)
from postflight.intake.flight_form import (
    placeholders,
    section_text,
    start_text,
    template,
    vehicle_copies,
    with_vehicle,
)
from postflight.intake.freeform_tables import FreeFormTable
from postflight.intake.headers import MARKS, fold, parse_column_name
from postflight.intake.loads_columns import loads_proposal
from postflight.intake.stored_tables import read_tables
from postflight.terminal import terminal

_WIND_AXES = (*COLUMNS[:2], "cd", "cl", *COLUMNS[4:])
_TABLES = (  # what is named so and holds no table is refused
    ".csv", ".tsv", ".dat", ".asc", ".tab", ".mat", ".xlsx", ".xlsm", ".xls", ".parquet", ".nc", ".cdf", ".h5", ".hdf5",
)  # fmt: skip
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_RADIOSONDE = {"alt", "temperature", "pressure"}
_BY_DIRECTION, _BY_COMPONENTS = {"wind_speed", "wind_from"}, {"wind_north", "wind_east"}
EXIT_NOT_ALL_USED = 3
console = terminal()


# coefficients


def coefficient_columns(table: FreeFormTable) -> dict[str, str] | None:
    """Return which column is which coefficient; None where Mach, angle or a coefficient is missing (damping may be)."""
    for wanted in (COLUMNS, _WIND_AXES):
        found = named_columns(wanted, table.names)
        if not set(wanted[:5]) - set(found):
            return found
    return None


def as_coefficients(table: FreeFormTable, columns: dict[str, str]) -> bytes:
    """Return the CSV with the columns' names of the reader of coefficient tables; other columns stay."""
    back = {column: name for name, column in columns.items()}
    names = [back.get(name, name) for name in table.names]
    changed = [f"{old} as {new}" for old, new in zip(table.names, names, strict=True) if old != new]
    if changed:
        table.notes.append(f"columns renamed: {', '.join(changed)}")
    return replace(table, names=names, raw=None).as_csv()


def sidecar_text(columns: dict[str, str]) -> str:
    """Return the sidecar to fill in; what the columns' names state is filled in."""
    moment = fold(columns.get("cm", ""))
    nose = re.search(r"nose|nase", moment)
    axes = "wind" if "cd" in columns else "body"
    value = "0.0".ljust(9) if nose else FILL_IN_TOML
    why = f"; by '{columns['cm']}'" if nose else ""
    return template("coefficients").format(moment_station=value, why=why, axes=axes)


def _named_in_form(text: str, beside: str) -> str | None:
    """Return a vehicle file's text with the table named; None where its coefficients are no longer the form's own.

    Parameters
    ----------
    text : str
        Of the vehicle file.
    beside : str
        The table, relative to it.
    """
    lines, form = text.splitlines(), template("vehicle").splitlines()
    asked = form[form.index("# [aerodynamics]") :]
    asked = asked[: next(k for k, line in enumerate(asked) if line.startswith("# mach = "))]
    at = next((k for k in range(len(lines)) if lines[k : k + len(asked)] == asked), None)
    if at is None:
        return None
    cone = [f"# {line}" for line in asked if line and not line.startswith("#")]
    made = ["[aerodynamics]", f"table = {json.dumps(beside)}", "", *cone]
    return "\n".join([*lines[:at], *made, *lines[at + len(asked) :]]) + "\n"


def _how_to_name(table: Path, vehicle: Path, named: bool) -> list[str]:
    """Sentences on how a vehicle file names a coefficient table."""
    beside = table.relative_to(vehicle.parent).as_posix()
    by_hand = f'in {vehicle} write  [aerodynamics]  table = "{beside}"  and take [aerodynamics.sphere_cone] out'
    return [
        f"a coefficient table: {f'{vehicle} names it now' if named else by_hand}",
        f"what its numbers refer to is to fill in in {table.with_suffix('.toml')}",
    ]


# radiosondes


def radiosonde_table(table: FreeFormTable) -> FreeFormTable | None:
    """Return the table of heights, density, temperature, pressure and wind; None where this is no radiosonde's.

    A table that has densities is none: its columns are declared as they are.
    """
    recogniser = Recogniser(table)
    if not recogniser.is_sounding():
        return None
    found = {q.short: m for q, m in recogniser.air_columns().items()}
    if "rho" in found or _missing_of_a_radiosonde(found):
        return None
    height_name = column_names(table)[table.names.index(found["alt"].column)]
    is_geometric = bool(MARKS["geometric"] & set(height_name.tokens))
    c = {short: to_si(table.numbers(table.names.index(m.column)), m.unit) for short, m in found.items()}
    dew = _dew_point(recogniser)
    height, p = c["alt"], c["pressure"]
    with np.errstate(invalid="ignore"):
        whole = (height > -1000.0) & (height < 2e5) & (p > 0.0)
    height = np.where(whole, height, np.nan)
    up = -np.log(np.where(whole, p, 1.0))
    temperature, filled_t = _between(up, c["temperature"], whole)
    dew_k = _between(up, dew, whole)[0] if dew is not None else np.full(len(p), np.nan)
    if set(c) >= _BY_DIRECTION:
        flow = c["wind_speed"][:, None] * np.column_stack([np.cos(c["wind_from"]), np.sin(c["wind_from"])])
    else:  # components are of where the air goes
        flow = -np.column_stack([c["wind_north"], c["wind_east"]])
    (north, filled_wind), (east, _) = (_between(height, component, whole) for component in flow.T)
    geometric = height if is_geometric else EARTH_RADIUS_US76_M * height / (EARTH_RADIUS_US76_M - height)
    from_deg = np.mod(np.rad2deg(np.arctan2(east, north)), 360.0)
    density = _moist_density(p, temperature, dew_k)
    columns = np.column_stack([geometric, density, temperature, p, np.hypot(north, east), from_deg])
    keep = whole & np.isfinite(columns).all(axis=1)
    rows = np.flatnonzero(keep)[np.argsort(geometric[keep], kind="stable")]
    rows = rows[np.diff(geometric[rows], prepend=-np.inf) > 0.0]
    if len(rows) < 3:
        return None
    notes = [
        *table.notes,
        f"radiosonde: {', '.join(f'{m.column} as {s} in {m.unit}' for s, m in found.items())}",
        f"temperature of {(filled_t & keep).sum()} levels and wind of {(filled_wind & keep).sum()} taken from their "
        "neighbours",
        f"{len(height) - len(rows)} levels left out: no height or pressure, or beyond the first or last that has both",
        "density by gas law" + (" with the dew point's vapour" if dew is not None else ", as of dry air"),
        f"heights '{height_name.name}' are geometric" if is_geometric else "geopotential heights became geometric ones",
    ]
    names = ["alt_m", "rho_kgpm3", "t_k", "p_pa", "wind_speed_mps", "wind_from_deg"]
    cells = [[f"{v:.8g}" for v in row] for row in columns[rows]]
    return FreeFormTable(table.label, names, [""] * len(names), cells, notes)


def _missing_of_a_radiosonde(found: dict[str, ColumnProposal]) -> str:
    """Columns or known units missing for a radiosonde, in words; empty if there are none."""
    known = {short for short, column in found.items() if column.unit}
    without = [f"the unit of '{column.column}'" for column in found.values() if not column.unit]
    without += [f"a column of {short}" for short in sorted(_RADIOSONDE - set(found))]
    if not (known >= _BY_DIRECTION or known >= _BY_COMPONENTS) and not without:
        without.append("the wind's speed")
    return " and ".join(without)


def _moist_density(pressure_pa: FloatArray, temperature_k: FloatArray, dew_point_k: FloatArray) -> FloatArray:
    """Density (n,), kg/m^3, by the gas law with the virtual temperature; dry where the dew point is NaN."""
    celsius = np.nan_to_num(dew_point_k - 273.15, nan=-200.0)
    vapour = np.where(celsius > -150.0, 611.2 * np.exp(17.67 * celsius / np.maximum(celsius + 243.5, 1.0)), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        dry_part = 1.0 - 0.378 * vapour / pressure_pa
        return np.asarray(pressure_pa * dry_part / (R_AIR_JPKGK * temperature_k))


def _dew_point(recogniser: Recogniser) -> FloatArray | None:
    """Dew points (n,), K; None where no column in a known unit holds them."""
    for k in recogniser.columns_of("dewpoint"):
        values, named = recogniser.table.numbers(k), recogniser.named[k]
        unit = next(iter(named.units("temperature")), "")
        if not unit and not named.unknown_unit:
            unit, _ = column_unit("temperature", "temperature", values)
        if unit:
            return to_si(values, unit)
    return None


def _between(at: FloatArray, values: FloatArray, whole: np.ndarray) -> tuple[FloatArray, np.ndarray]:
    """Values with missing ones interpolated along ``at``, and the mask of these."""
    known = whole & np.isfinite(values)
    out = values.copy()
    if known.sum() < 2:
        return out, np.zeros(len(values), dtype=bool)
    order = np.flatnonzero(known)[np.argsort(at[known])]
    missing = whole & ~known
    out[missing] = np.interp(at[missing], at[order], values[order], left=np.nan, right=np.nan)
    return out, missing & np.isfinite(out)


# video


@dataclass(frozen=True)
class Video:
    """Folder of pictures or film, its source and destination; ``names`` are the pictures'."""

    source: Path
    place: Path
    names: tuple[str, ...] = ()

    @property
    def is_film(self) -> bool:
        """Whether it is one file with numbered frames."""
        return not self.names


def _video_of(path: Path, telemetry: Path) -> Video | None:
    """Return a folder that holds pictures, or a film; None for anything else."""
    place = telemetry / re.sub(r"[^A-Za-z0-9_.-]+", "_", path.resolve().name)
    if path.is_dir():
        names = sorted(p.name for p in path.iterdir() if p.suffix.lower() in _PICTURES and p.is_file())
        return Video(path, place, tuple(names)) if names else None
    return Video(path, place) if path.suffix.lower() in FILM_SUFFIXES and path.is_file() else None


def _copy(video: Video) -> None:
    """Copy pictures or film beside their destination and rename, so that they are complete or absent."""
    video.place.parent.mkdir(parents=True, exist_ok=True)
    with writing(video.place, "choose a folder that you may write to"):
        if video.is_film:
            write_file(video.place, lambda partial: shutil.copyfile(video.source, partial))
            return
        partial = video.place.with_name(f".partial-{video.place.name}")
        try:
            partial.mkdir()
            for name in video.names:
                shutil.copyfile(video.source / name, partial / name)
            partial.replace(video.place)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def frame_list(
    table: FreeFormTable, videos: Iterable[Video], cameras: Iterable[str], folder: Path
) -> SourceProposal | None:
    """Return the purpose of a list of frames, its column named ``frame``; None if the table is no such list.

    Parameters
    ----------
    table : FreeFormTable
        Its column of names or numbers is renamed, with a note; folders before a picture's name are taken away.
    videos : iterable of Video
        Folders of pictures and films that the list may be of.
    cameras : iterable of str
        Names of the vehicle's cameras.
    folder : Path
        The flight folder.
    """
    time = find_time(table, column_names(table))
    if time is None:
        return None
    used = set(time.columns)
    free = [k for k, name in enumerate(table.names) if name not in used]
    pictures = next((k for k in free if (some := table.cells(k)[:20]) and all(_is_picture(c) for c in some)), None)
    if pictures is None:
        numbers = [k for k in free if _is_frame_number(table, k)]
        if len(free) != 1 or not numbers:  # a counter beside other columns is a recorder's
            return None
    at = pictures if pictures is not None else numbers[0]
    _rename(table, at, bare=pictures is not None)
    names = set(table.cells(at))
    films = [v for v in videos if v.is_film]
    folders = [v for v in videos if not v.is_film and len(names & set(v.names)) >= 0.9 * len(names)]
    key, fitting = ("folder", folders) if pictures is not None else ("film", films)
    there = f'"{fitting[0].place.relative_to(folder).as_posix()}"' if len(fitting) == 1 else FILL_IN_TOML
    where = "where the pictures lie" if key == "folder" else "the first frame's number in it is 0"
    mounted = list(cameras)
    camera = f'"{mounted[0]}"' if len(mounted) == 1 else FILL_IN_TOML
    which = f"of the vehicle file: {', '.join(mounted)}" if mounted else "a [cameras.NAME] of the vehicle file"
    keys = [
        (key, there, where if len(fitting) == 1 else f"{where}; none, or several, would fit"),
        ("camera", camera, which),
        ("benchmark_s", FILL_IN_TOML, f"s: when the shell is taken as undeflected{_span(table, time)}"),
    ]
    why = "names of pictures" if pictures is not None else "numbers of frames"
    return SourceProposal("frames", [ColumnProposal("frame", "frame", "", STATED, why, canonical=True)], keys, time)


def _without_list(video: Video, folder: Path) -> str:
    """Return the comment for flight.toml where no list has the times of a video's frames."""
    place = video.place.relative_to(folder).as_posix()
    what, frame, key = f"holds {len(video.names)} pictures", "name", "folder"
    if video.is_film:
        what, frame, key = "is a film", "number", "film"
    return (
        f"# QUESTION: {place} {what}; when was each frame taken? A table t_s, frame (its {frame}) is wanted:\n"
        f'# [frames]\n# file = "telemetry/frames.csv"\n# {key} = "{place}"\n'
        f"# camera = {FILL_IN_TOML}\n# benchmark_s = {FILL_IN_TOML}\n"
    )


def _cameras_of(folder: Path, tables: dict[str, Any]) -> list[str]:
    """Names of the cameras in the vehicle file that flight.toml names; none where it cannot be read yet."""
    try:
        return list(read_toml(vehicle_path(str(tables.get("vehicle", "")), folder)).get("cameras", {}))
    except (OSError, ValueError):
        return []


def _is_picture(cell: str) -> bool:
    return Path(cell.replace("\\", "/")).suffix.lower() in _PICTURES


def _is_frame_number(table: FreeFormTable, k: int) -> bool:
    values = table.numbers(k)
    named = set(parse_column_name(table.names[k]).tokens) & MARKS["frame"]
    return bool(named) and bool((np.isfinite(values) & (values >= 0.0) & (values == np.round(values))).all())


def _rename(table: FreeFormTable, k: int, bare: bool) -> None:
    """Name a column ``frame``, and leave a picture's bare name, each with a note."""
    if bare:
        long = [row for row in table.rows if k < len(row) and re.search(r"[/\\]", row[k])]
        for row in long:
            row[k] = re.split(r"[/\\]", row[k])[-1]
        if long:
            table.notes.append(f"folders before {len(long)} pictures' names were taken away")
            table.raw = None
    if table.names[k] != "frame":
        table.notes.append(f"column '{table.names[k]}' was named frame")
        table.names[k] = "frame"
        table.raw = None


def _span(table: FreeFormTable, time: TimeProposal) -> str:
    if time.format != "seconds":
        return ""
    known = table.numbers(table.names.index(time.columns[0]))
    return f"; the list goes from {np.nanmin(known):g} to {np.nanmax(known):g}"


# the delivery


@dataclass
class _Delivery:
    """Delivered tables, videos, new files, the changed vehicle file, and what is left out, with the reason."""

    tables: list[FreeFormTable] = field(default_factory=list)
    videos: list[Video] = field(default_factory=list)
    daveml: dict[Path, bytes] = field(default_factory=dict)
    files: dict[Path, bytes | str] = field(default_factory=dict)
    vehicles: list[str] = field(default_factory=list)
    vehicle: dict[Path, str] = field(default_factory=dict)
    skipped: list[Issue] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def import_files(files: tuple[Path, ...], folder: Path) -> None:
    """Read, propose, write, print.

    Parameters
    ----------
    files : tuple of Path
        Tables, folders of images, films, coefficient tables.
    folder : Path
        A flight folder with a flight.toml.

    Raises
    ------
    ConfigError
        ``file-missing``, or ``file-exists`` where one would be overwritten.
    GateError
        Every table file in which no table is found, with the codes of `postflight.intake.stored_tables`.

    Leaves with `EXIT_NOT_ALL_USED` where something delivered is not used, which is named.
    """
    path = folder / "flight.toml"
    if not path.exists():
        words = f"no flight.toml; make one with `postflight init {folder}`"
        raise ConfigError(f"{folder}: {words}", code="file-missing")
    tables = read_toml(path)
    came = _delivered(files, folder)
    _coefficients(came, folder, tables)
    places = [_place(folder, table) for table in came.tables]
    every = [*places, *(v.place for v in came.videos), *came.files]
    there = [str(p) for k, p in enumerate(every) if p.exists() or p in every[:k]]
    if there:
        words = "exists already, and nothing is overwritten; rename the new one, or remove it there"
        raise ConfigError([f"{p}: {words}" for p in there], code="file-exists")
    added, shown, unused = _proposals(came, places, folder, tables)
    text = path.read_text(encoding="utf-8-sig").rstrip() + "\n" + added
    for named in came.vehicles if "vehicle" not in tables else ():
        text = with_vehicle(text, named)
    tomllib.loads(text)  # what is written can be read
    for video in came.videos:
        _copy(video)
    for table, place in zip(came.tables, places, strict=True):
        write_file(place, table.as_csv())
    for place, content in (*came.files.items(), *came.vehicle.items()):
        write_file(place, content)
    write_file(path, text)
    _print_proposals(shown)
    for video in came.videos:
        what = "film" if video.is_film else f"{len(video.names)} pictures"
        console.print(f"{escape(str(video.place))}: {what}", highlight=False)
    for words in came.notes:
        console.print(escape(words), highlight=False)
    for fault in (*came.skipped, *unused):
        console.print(f"[yellow]left out[/] {escape(f'{fault} [{fault.code}]')}", highlight=False)
    _print_placeholders(folder)
    if came.skipped or unused:
        sys.exit(EXIT_NOT_ALL_USED)


def _print_placeholders(folder: Path) -> None:
    """Print which values are still to fill in, file by file."""
    still_open = placeholders(folder)
    for file, keys in still_open.items():
        console.print(f"[cyan]to fill in[/] {escape(str(file))}: {escape(', '.join(keys))}", highlight=False)
    following = f"{sum(map(len, still_open.values()))} values to fill in. Next: postflight check {folder}"
    console.print(escape(following), highlight=False)


def _delivered(files: tuple[Path, ...], folder: Path) -> _Delivery:
    """Sort and read the delivered files; `GateError` with every table that cannot be read."""
    came = _Delivery()
    faults: list[str] = []
    lacking: list[str] = []  # libraries that are not installed
    _take_vehicles(came, [file for file in files if file.suffix.lower() == ".toml"], folder)
    of_vehicle = {place.name for place in came.files}  # its own tables, delivered beside it
    for file in (file for file in files if file.suffix.lower() != ".toml" and file.name not in of_vehicle):
        video = _video_of(file, folder / "telemetry")
        if video is not None:
            if video.is_film and (fault := start_fault(file)):
                faults.append(Issue(f"{file}: {fault}", fault.code))
            came.videos.append(video)
            came.skipped += _beside_pictures(file, video)
        elif file.is_dir():
            words = f"{file}: a folder without pictures; name the files in it: {file / '*'}"
            came.skipped.append(Issue(words, "nothing-to-import"))
        elif file.suffix.lower() == ".dml":
            came.daveml[file] = _bytes_of(file)
        elif file.suffix.lower() in _PICTURES:
            words = f"{file}: a picture alone; name the folder that holds a video's pictures"
            came.skipped.append(Issue(words, "nothing-to-import"))
        else:
            try:
                came.tables += read_tables(file)
            except ConfigError as fault:
                lacking += fault.faults
            except GateError as fault:
                if file.suffix.lower() in _TABLES or not file.is_file():
                    faults += fault.faults
                else:
                    came.skipped += fault.faults
    if faults:
        raise GateError([*faults, *lacking])
    if lacking:
        raise ConfigError(lacking)
    if not (came.tables or came.videos or came.daveml or came.vehicles):
        raise GateError(came.skipped, code="nothing-to-import")
    came.tables = [radiosonde_table(table) or table for table in came.tables]
    return came


def _take_vehicles(came: _Delivery, files: list[Path], folder: Path) -> None:
    """Add vehicle files with their tables; a TOML file that is neither is left out."""
    other: dict[str, Issue] = {}
    for file in files:
        try:
            came.files |= {place: _bytes_of(source) for place, source in vehicle_copies(folder, file).items()}
            came.vehicles.append(f"vehicle/{file.name}")
        except ConfigError as fault:
            other[file.name] = fault.faults[0]
    own = {place.name for place in came.files}
    came.skipped += [fault for name, fault in other.items() if name not in own]


def _beside_pictures(folder: Path, video: Video) -> list[Issue]:
    if video.is_film:
        return []
    others = sorted(p.name for p in folder.iterdir() if p.name not in video.names)
    words = f"{folder}: beside its pictures {', '.join(others[:5])}{' ...' if others[5:] else ''}"
    return [Issue(words, "nothing-to-import")] if others else []


def _bytes_of(file: Path) -> bytes:
    try:
        return file_bytes(file)
    except OSError as fault:
        words = f"cannot be read: {fault.strerror or fault}"
        raise GateError(f"{file}: {words}", getattr(fault, "code", "file-unreadable")) from None


def _coefficients(came: _Delivery, folder: Path, tables: dict[str, Any]) -> None:
    """Move coefficient tables to the files, beside the vehicle file, each with a form for its sidecar."""
    vehicle = _own_vehicle(folder, tables)
    found: list[tuple[Path, bytes, dict[str, str], list[str]]] = []
    for path, content in came.daveml.items():
        found.append((vehicle.parent / path.name, content, {}, []))
    for table in list(came.tables):
        columns = coefficient_columns(table)
        if columns is not None:
            came.tables.remove(table)
            content = as_coefficients(table, columns)
            found.append((vehicle.parent / f"{_plain(table.label)}.csv", content, columns, table.notes))
    for place, content, columns, notes in found:
        if place.with_suffix(".toml") == vehicle:  # the sidecar has the table's stem
            place = place.with_stem(f"{place.stem}_coefficients")
        if place in came.files:
            raise ConfigError(f"{place}: two delivered tables of this name; rename one", code="file-exists")
        came.files |= {place: content, place.with_suffix(".toml"): sidecar_text(columns)}
        text = came.vehicle.get(vehicle) or (file_bytes(vehicle).decode("utf-8-sig") if vehicle.is_file() else "")
        named = _named_in_form(text, place.name)
        if named is not None:
            came.vehicle[vehicle] = named
        came.notes += [f"{place}: {words}" for words in (*notes, *_how_to_name(place, vehicle, named is not None))]


def _own_vehicle(folder: Path, tables: dict[str, Any]) -> Path:
    """Vehicle file beside which a flight's coefficients belong: the one it names, unless that ships."""
    named = tables.get("vehicle")
    if isinstance(named, str) and named.endswith(".toml"):
        path = vehicle_path(named, folder)
        if path.parent != DATA / "vehicles":
            return path
    return folder / "vehicle" / "vehicle.toml"


def _plain(label: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", label).strip("_") or "table"


def _place(folder: Path, table: FreeFormTable) -> Path:
    return folder / "telemetry" / f"{_plain(table.label)}.csv"


def _proposals(
    came: _Delivery, places: list[Path], folder: Path, tables: dict[str, Any]
) -> tuple[str, list[tuple[FreeFormTable, list[SourceProposal], list[str]]], list[Issue]]:
    """Text to add to flight.toml, output to print, and unused parts of the tables, with the reason."""
    taken = _sections(tables)
    added, shown, unrecognised, unused_tables = [], [], [], []
    videos = [*came.videos, *_earlier_videos(folder)]
    cameras = _cameras_of(folder, tables)
    # another team's trajectory last: whether it is wanted depends on what is there to reconstruct one from
    read = [(table, place, loads_proposal(table)) for table, place in zip(came.tables, places, strict=True)]
    for table, place, loads in sorted(read, key=lambda each: each[2] is not None):
        add_clock_columns(table)
        frames = frame_list(table, videos, cameras, folder)
        recogniser = Recogniser(table)
        if loads is not None:
            found, unused = [loads[0]], loads[1]
        else:
            found, unused = recogniser.proposals() if frames is None else ([frames], [])
        if frames is None and loads is None and recogniser.may_be_inertial():
            unrecognised.append(table.label)
        shown.append((table, found, unused))
        file = place.relative_to(folder).as_posix()
        if not found:
            unused_tables.append(_not_recognised(table, file))
        asked = ""  # the section where this table's time is asked for
        for source in found:
            question = _question(source.section, taken)
            if question:
                words = f"{file}: [{source.section}] stands in flight.toml as a comment: {question}"
                unused_tables.append(Issue(words, "given-twice"))
            time = source.time
            is_open = time is not None and time is recogniser.time and time.is_open
            added.append(section_text(source, file, table.notes, question, asked if is_open else ""))
            if is_open and not question:
                asked = asked or source.section
            taken.add(source.section)
    listed = "".join(added)
    added += [_without_list(v, folder) for v in came.videos if v.place.relative_to(folder).as_posix() not in listed]
    start = start_text(taken, tables, unrecognised)
    rest = "" if "start" in tables else _rest_text(shown)
    return "".join(f"\n{text}" for text in (*added, start, rest) if text), shown, unused_tables


def _question(section: str, taken: set[str]) -> str:
    """Question why a proposed table may be unwanted beside those that are ``taken``; empty if there is none."""
    if section in taken:
        return f"[{section}] is there already. Which is right? Take one out."
    if section == "loads" and any(name.startswith(("radars.", "gnss.", "sensors.")) for name in taken):
        return "another team's trajectory. It is wanted where none is reconstructed from the sensors and trackers here."
    return ""


def _not_recognised(table: FreeFormTable, file: str) -> Issue:
    recogniser = Recogniser(table)
    if recogniser.is_sounding():
        without = _missing_of_a_radiosonde({q.short: m for q, m in recogniser.air_columns().items()}) or "three levels"
        words = f"{file}: a sounding, in which {without} is missing; write it into the names of the columns"
        return Issue(words, "column-missing")
    if recogniser.time is None:
        first = [f"'{name}' {cells[0]}" for k, name in enumerate(table.names[:3]) if (cells := table.cells(k, 1))]
        shown = ", ".join(first)
        words = (
            f"{file}: no column of times is recognised, and without one nothing else is (the first row has {shown}); "
            "docs/own-data.md lists the times that are read; or declare its columns in flight.toml"
        )
        return Issue(words, "column-missing")
    words = f"{file}: nothing recognised among {', '.join(table.names)}; declare its columns in flight.toml"
    return Issue(words, "column-missing")


def _rest_text(shown: list[tuple[FreeFormTable, list[SourceProposal], list[str]]]) -> str:
    """Text of ``[start]`` if accelerometer and gyros with known units and seconds begin at rest; else empty."""
    records = {
        source.section: record
        for table, found, _ in shown
        for source in found
        if (record := _triad_of(table, source)) is not None
    }
    if not {"sensors.accelerometer", "sensors.rates"} <= set(records):
        return ""
    both = records["sensors.accelerometer"], records["sensors.rates"]
    span = find_rest(*both)
    if span is None:
        return ""
    noise = [mean_readings(record, span).noise_sd for record in both]
    words = f"noise there, for the data sheets: {noise[0]:.2g} m/s2, {np.rad2deg(noise[1]):.2g} deg/s"
    return f"[start]  # the data begin with a rest\nat_rest = [{span[0]:.2f}, {span[1]:.2f}]  # s; {words}\n"


def _triad_of(table: FreeFormTable, source: SourceProposal) -> TriadRecord | None:
    """Samples of a proposed triad, SI, its own axes; None where times or units are still open."""
    time = source.time
    known = time is not None and time.format == "seconds" and time.unit and not time.offset_asked
    if not known or len(source.columns) != 3 or not all(m.unit for m in source.columns):
        return None
    assert time is not None
    t = to_si(table.numbers(table.names.index(time.columns[0])), time.unit)
    samples = np.column_stack([to_si(table.numbers(table.names.index(m.column)), m.unit) for m in source.columns])
    rows = np.isfinite(t) & np.isfinite(samples).all(axis=1)
    rows[rows] &= np.diff(np.maximum.accumulate(t[rows]), prepend=-np.inf) > 0.0
    if rows.sum() < 2:
        return None
    return TriadRecord(TriadSpec(source.section, np.zeros(3), np.eye(3), 0.0, 0.0, 0.0, 0.0), t[rows], samples[rows])


def _earlier_videos(folder: Path) -> list[Video]:
    """Pictures and films that an earlier import brought."""
    telemetry = folder / "telemetry"
    there = sorted(telemetry.iterdir()) if telemetry.is_dir() else []
    return [v for p in there if not p.name.startswith(".") and (v := _video_of(p, telemetry)) is not None]


def _sections(tables: dict[str, Any]) -> set[str]:
    groups = ("sensors", "radars", "gnss", "barometers")
    alone = {"atmosphere", "frames", "loads"} & set(tables)
    return alone | {f"{g}.{name}" for g in groups for name in tables.get(g, {})}


def _print_proposals(shown: list[tuple[FreeFormTable, list[SourceProposal], list[str]]]) -> None:
    """Print a table for each file: column, quantity, unit, and why; then the changes and the unused columns."""
    for table, found, unused in shown:
        screen = Table(title=escape(table.label), title_justify="left")
        for name in ("column", "as", "unit", "how", "why"):
            screen.add_column(name, overflow="fold")
        for source in found:
            t = source.time
            if t is not None and source is found[0]:
                unit = t.unit or ("" if t.format != "seconds" else "?")
                screen.add_row(*map(escape, (", ".join(t.columns), f"time, {t.format}", unit, t.how, t.why)))
            for m in source.columns:
                unit = m.unit or ("?" if m.how == ASKED else "")
                screen.add_row(*map(escape, (m.column, f"{source.section} {m.short}", unit, m.how, m.why)))
        if found:
            console.print(screen)
        for words in (*table.notes, *([f"not used: {', '.join(unused)}"] if unused and found else [])):
            console.print(f"  {escape(words)}", highlight=False)
