"""What does another team's file state about the flight? Positions, velocities, attitude and their covariance over time.

- CCSDS Orbit Ephemeris Message (KVN, versions 1 to 3): states and covariances, Earth-fixed, UTC.
- Tables as `postflight.intake.stored_tables` reads them (CSV, NetCDF, Parquet, MATLAB, spreadsheets). Columns of
  ``bet.csv`` and of its exports are known by name; those of others by their headers' vocabulary and stated units, as a
  receiver's. Nothing is guessed: a column whose unit is not stated is refused with what to write.

Seconds are taken after the run's time zero, UTC as it stands; heights that do not say above what, as ellipsoidal. Both
are noted, and where they are wrong the comparison shows a time offset or the geoid.

References
----------
CCSDS 502.0-B-2, Orbit Data Messages, 2009; 502.0-B-3, 2023.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flightmodel import earth, rotations, tables
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.config import parse_utc
from flightmodel.earth import undulation_m
from flightmodel.files import UnfitFile, file_bytes
from postflight.intake.column_recognition import Recogniser, SourceProposal
from postflight.intake.freeform_tables import LEAST_ROWS, FreeFormTable
from postflight.intake.stored_tables import read_tables

_OEM = b"CCSDS_OEM_VERS"
_FIXED_FRAMES = re.compile(r"(ITRF|WGS-?84|ECEF)")  # agree to centimetres
_LARGEST = 1e100  # what is beyond is a broken word
_NEAR_M = 6.2e6, 1e9  # from the Earth's centre: no flight is below, none that is compared beyond
_DAY_OF_YEAR = re.compile(r"(\d{4})-(\d{3})T(.*)")
_POSITIONS = (tuple(f"r{a}_ecef_m" for a in "xyz"), tuple(f"{a}_ecef_m" for a in "xyz"))
_ATTITUDES = (tuple(f"q{a}_ecef_body" for a in "wxyz"), tuple(f"q{a}" for a in "wxyz"))
_SD = (
    *(f"r{a}_ecef_sd_m" for a in "xyz"),
    *(f"v{a}_ecef_sd_mps" for a in "xyz"),
    *(f"rotation_{a}_body_sd_deg" for a in "xyz"),
)


@dataclass(frozen=True)
class OtherTrajectory:
    """Trajectory of another source, at its own times.

    Parameters
    ----------
    label : str
        The file's name.
    time_s : (n,) float
        After the run's time zero, increasing.
    position_ecef_m : (n, 3) float
    velocity_ecef_mps : (n, 3) float or None
        As stated; whether it is relative to the Earth is for the comparison to find.
    q_ecef_body : (n, 4) float or None
    covariance_time_s : (m,) float
        Empty where none is stated.
    covariance : (m, k, k) float
        ``k`` = 6: position ECEF m, velocity ECEF m/s; 9: rotation in body axes, rad, too.
    notes : tuple of str
        What was assumed in reading.
    """

    label: str
    time_s: FloatArray
    position_ecef_m: FloatArray
    velocity_ecef_mps: FloatArray | None
    q_ecef_body: FloatArray | None
    covariance_time_s: FloatArray
    covariance: FloatArray
    notes: tuple[str, ...]

    def part(self, keep: BoolArray, left_out: str) -> OtherTrajectory:
        """States of a mask (n,), with a note if any are left out; covariances stay."""
        if keep.all():
            return self
        columns = ("time_s", "position_ecef_m", "velocity_ecef_mps", "q_ecef_body")
        kept = {name: values[keep] for name in columns if (values := getattr(self, name)) is not None}
        return replace(self, **kept, notes=(*self.notes, left_out))


def read_other(path: Path, epoch_utc: str) -> OtherTrajectory:
    """Read another source's trajectory.

    Parameters
    ----------
    path : Path
    epoch_utc : str
        Time zero of the run that it is compared with.

    Raises
    ------
    GateError
        What `read_tables` refuses; ``oem-frame``; ``file-unreadable`` where no table
        holds times and positions, ``unit-unknown`` where a column's unit is not stated, ``value-range``,
        ``time-backwards``.
    """
    try:
        content = file_bytes(path)
    except (FileNotFoundError, UnfitFile):
        content = b""  # refused by the reader of tables, with its words
    if _OEM in content[:4096]:
        found = _read_oem(path, content.decode("utf-8", "replace"), parse_utc(epoch_utc))
    else:
        found = _read_table(path, parse_utc(epoch_utc))
    found = _near_earth(path, found)
    if len(found.time_s) < LEAST_ROWS or (np.diff(found.time_s) <= 0.0).any():
        words = f"{LEAST_ROWS} states in the order of their times are wanted, each time once"
        raise GateError(f"{path}: {words}", "time-backwards")
    return found


def _near_earth(path: Path, found: OtherTrajectory) -> OtherTrajectory:
    """Leave out states whose position is not plausible for a flight, and report them."""
    distance_m = np.linalg.norm(found.position_ecef_m, axis=1)
    keep = (distance_m > _NEAR_M[0]) & (distance_m < _NEAR_M[1])
    if len(keep) and not keep.any():
        words = f"positions are {np.median(distance_m):.4g} m from the Earth's centre: of another unit or frame"
        raise GateError(f"{path}: {words}", "value-range")
    return found.part(keep, f"{int((~keep).sum())} of {len(keep)} states in the Earth or far from it are left out")


# CCSDS OEM


class _Oem(NamedTuple):
    """Lines of a message: metadata as (line, key, value), states, and covariances (line of the epoch, its lines)."""

    metadata: list[tuple[int, str, str]]
    states: list[tuple[int, list[str]]]
    covariances: list[tuple[str, str, list[list[str]]]]  # epoch, frame, six rows


def _read_oem(path: Path, text: str, epoch: datetime) -> OtherTrajectory:
    message = _oem_lines(path, text)
    faults = []
    for line, key, value in message.metadata:
        if key == "REF_FRAME" and not _FIXED_FRAMES.match(value.upper()):
            words = f"REF_FRAME = {value}; an Earth-fixed frame (ITRF..., WGS84) is wanted: transform it before"
            faults.append(GateError(f"{path}: line {line}: {words}", "oem-frame").faults[0])
        if key == "TIME_SYSTEM" and value.upper() != "UTC":
            words = f"TIME_SYSTEM = {value}; UTC is wanted (GPS is 18 s ahead of it since 2017)"
            faults.append(GateError(f"{path}: line {line}: {words}", "oem-frame").faults[0])
    if faults:
        raise GateError(faults)
    rows = []
    for line, cells in message.states:
        try:
            row = [_seconds(cells[0], epoch), *map(tables.plain_number, cells[1:7])]
        except ValueError:
            row = []
        if len(row) != 7 or not (np.abs(row) < _LARGEST).all():
            raise _oem_syntax(path, line, "a time and six numbers are wanted")
        rows.append(row)
    table = np.array(rows, dtype=float).reshape(-1, 7)
    first = np.append(True, np.diff(table[:, 0]) != 0.0)[: len(table)]  # segments share their ends
    times, covariance, skipped = _oem_covariances(path, message, epoch)
    notes = (f"{skipped} covariances in another frame than the states' are left out",) if skipped else ()
    found = OtherTrajectory(
        path.name, table[:, 0], 1e3 * table[:, 1:4], 1e3 * table[:, 4:7], None, times, covariance, notes
    )
    return found.part(first, f"{int((~first).sum())} states at the time of the one before are left out")


def _oem_lines(path: Path, text: str) -> _Oem:
    found = _Oem([], [], [])
    inside, frame = "", ""
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith("COMMENT"):
            continue
        if line in ("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP"):
            inside = line.removesuffix("_START") if line.endswith("START") else ""
            frame = ""
            continue
        key, equals, value = (part.strip() for part in line.partition("="))
        if inside == "META" and equals:
            found.metadata.append((number, key, value))
        elif inside == "META":
            raise _oem_syntax(path, number, "within META_START and META_STOP KEY = value is wanted")
        elif inside == "COVARIANCE" and key == "EPOCH":
            found.covariances.append((value, frame, []))
        elif inside == "COVARIANCE" and key == "COV_REF_FRAME":
            frame = value
            if found.covariances and not found.covariances[-1][2]:
                found.covariances[-1] = (found.covariances[-1][0], value, [])
        elif inside == "COVARIANCE":
            if not found.covariances or len(found.covariances[-1][2]) == 6:
                raise _oem_syntax(path, number, "six rows below an EPOCH are wanted")
            found.covariances[-1][2].append(line.split())
        elif not equals:
            found.states.append((number, line.split()))
    return found


def _oem_covariances(path: Path, message: _Oem, epoch: datetime) -> tuple[FloatArray, FloatArray, int]:
    """Times, matrices (m, 6, 6) in m and m/s, and how many were left out."""
    times, matrices, skipped = [], [], 0
    for stamp, frame, rows in message.covariances:
        if frame and not _FIXED_FRAMES.match(frame.upper()):
            skipped += 1
            continue
        matrix = np.zeros((6, 6))
        try:
            for k, cells in enumerate(rows):
                matrix[k, : k + 1] = [tables.plain_number(cell) for cell in cells]
            if len(rows) != 6 or not (np.abs(matrix) < _LARGEST).all():
                raise ValueError
            times.append(_seconds(stamp, epoch))
        except ValueError:
            raise GateError(
                f"{path}: covariance at {stamp}: six rows of 1 to 6 numbers are wanted", "file-unreadable"
            ) from None
        matrices.append(1e6 * (matrix + np.tril(matrix, -1).T))
    return np.array(times), np.array(matrices).reshape(-1, 6, 6), skipped


def _oem_syntax(path: Path, line: int, words: str) -> GateError:
    return GateError(f"{path}: line {line}: {words}", "file-unreadable")


def _seconds(stamp: str, epoch: datetime) -> float:
    """Seconds after the epoch of an ISO time, or of one by the day of the year."""
    by_day = _DAY_OF_YEAR.fullmatch(stamp)
    if by_day:
        day = datetime.strptime(f"{by_day[1]} {by_day[2]}", "%Y %j")
        stamp = f"{day:%Y-%m-%d}T{by_day[3]}"
    head, _, fraction = stamp.rstrip("Z").partition(".")
    return (parse_utc(head) - epoch).total_seconds() + (float(f"0.{fraction}") if fraction else 0.0)


# tables


def _read_table(path: Path, epoch: datetime) -> OtherTrajectory:
    refused: list[str] = []
    for table in read_tables(path):
        found = _by_name(path, table, epoch) or _by_vocabulary(path, table, epoch, refused)
        if found is not None:
            return found
    if refused:
        raise GateError(f"{path}: {'; '.join(refused)}", "unit-unknown")
    words = (
        "no table with times and positions: t_s or utc; x_ecef_m, y_ecef_m, z_ecef_m or lat_deg, lon_deg, alt_m; "
        "and if known vx_ecef_mps ... or vn_mps, ve_mps, vd_mps, and qw_ecef_body ... (columns of bet.csv)"
    )
    raise GateError(f"{path}: {words}", "file-unreadable")


def _columns(table: FreeFormTable, names: tuple[str, ...]) -> FloatArray | None:
    """Columns (n, k) by name; None where one is missing."""
    if not set(names) <= set(table.names):
        return None
    return np.column_stack([table.numbers(table.names.index(name)) for name in names])


def _by_name(path: Path, table: FreeFormTable, epoch: datetime) -> OtherTrajectory | None:
    """Trajectory from a table with the columns of ``bet.csv``; None for any other table."""
    notes = list(table.notes)
    position = next((p for names in _POSITIONS if (p := _columns(table, names)) is not None), None)
    geodetic = _columns(table, ("lat_deg", "lon_deg", "alt_m"))
    if position is None and geodetic is not None:
        notes.append("alt_m is taken above the ellipsoid")
        latitude, longitude = np.deg2rad(geodetic[:, :2]).T
        position = earth.ecef_from_geodetic(latitude, longitude, geodetic[:, 2])
    time_s = _times(table, epoch, notes)
    if position is None or time_s is None:
        return None
    velocity = _columns(table, tuple(f"v{a}_ecef_mps" for a in "xyz"))
    ned = _columns(table, tuple(f"v{a}_mps" for a in "ned"))
    if velocity is None and ned is not None:
        velocity = earth.ecef_from_ned(ned, position)
    attitude = next((q for names in _ATTITUDES if (q := _columns(table, names)) is not None), None)
    return _assembled(path, time_s, position, velocity, attitude, _stated_sd(table), notes)


def _times(table: FreeFormTable, epoch: datetime, notes: list[str]) -> FloatArray | None:
    for name in ("utc", "time"):
        if name in table.names:
            cells = [row[table.names.index(name)] for row in table.rows]
            try:
                return np.array([_seconds(cell, epoch) for cell in cells])
            except ValueError:
                continue
    seconds = _columns(table, ("t_s",))
    if seconds is None:
        return None
    notes.append("t_s is taken after the run's time zero")
    return seconds[:, 0]


def _stated_sd(table: FreeFormTable) -> FloatArray | None:
    """Standard deviations (n, 3, 6 or 9) in SI of the columns that ``bet.csv`` has."""
    for count in (9, 6, 3):
        sd = _columns(table, _SD[:count])
        if sd is not None and np.isfinite(sd).all(axis=1).any():
            sd[:, 6:] = np.deg2rad(sd[:, 6:])
            return sd
    return None


def _assembled(
    path: Path,
    time_s: FloatArray,
    position: FloatArray,
    velocity: FloatArray | None,
    attitude: FloatArray | None,
    sd: FloatArray | None,
    notes: list[str],
) -> OtherTrajectory:
    """Complete rows; a quantity without any value is None."""
    velocity, attitude = (None if v is None or not np.isfinite(v).any() else v for v in (velocity, attitude))
    parts = [position, *(v for v in (velocity, attitude) if v is not None)]
    keep = np.isfinite(time_s) & np.isfinite(np.column_stack(parts)).all(axis=1)
    found = OtherTrajectory(
        path.name, time_s, position, velocity, attitude, np.empty(0), np.empty((0, 6, 6)), tuple(notes)
    ).part(keep, f"{int((~keep).sum())} of {len(keep)} rows are not whole and left out")
    if sd is not None and sd.shape[1] >= 6:
        known = keep & np.isfinite(sd).all(axis=1)
        covariance = np.einsum("ni,ij->nij", sd[known] ** 2, np.eye(sd.shape[1]))
        words = "standard deviations are stated, their correlations are not"
        found = replace(found, covariance_time_s=time_s[known], covariance=covariance, notes=(*found.notes, words))
    if found.q_ecef_body is not None:
        q = found.q_ecef_body
        found = replace(found, q_ecef_body=rotations.continuous(q / np.linalg.norm(q, axis=1, keepdims=True)))
    return found


def _by_vocabulary(path: Path, table: FreeFormTable, epoch: datetime, refused: list[str]) -> OtherTrajectory | None:
    """Trajectory from a table with a receiver's columns, else None; with the missing units."""
    found, _ = Recogniser(table).proposals()
    source = next((s for s in found if s.section.startswith("gnss.")), None)
    if source is None or source.time is None:
        return None
    unknown = [f"'{c.column}'" for c in source.columns if not c.unit and not c.canonical]
    if source.time.format not in ("seconds", "utc") or (source.time.format == "seconds" and not source.time.unit):
        unknown.append(f"'{source.time.columns[0]}' (seconds after t0 as t_s, or ISO UTC)")
    if unknown:
        refused.append(f"write the unit of {', '.join(unknown)} into its header, as in 'alt (km)'")
        return None
    notes = [*table.notes, f"read: {', '.join(c.column for c in source.columns)}"]
    values = {c.short: _in_si(table, c.column, c.unit or _canonical_unit(c.short)) for c in source.columns}
    if all(a in values for a in "xyz"):
        position = np.column_stack([values[a] for a in "xyz"])
    elif "alt" in values:
        height = values["alt"] + _above_ellipsoid(source, values, notes)
        position = earth.ecef_from_geodetic(values["lat"], values["lon"], height)
    else:
        return None
    velocity = None
    if all(f"v{a}" in values for a in "xyz"):
        velocity = np.column_stack([values[f"v{a}"] for a in "xyz"])
    elif all(f"v{a}" in values for a in "ned"):
        velocity = earth.ecef_from_ned(np.column_stack([values[f"v{a}"] for a in "ned"]), position)
    return _assembled(path, _recognised_times(table, source, epoch, notes), position, velocity, None, None, notes)


def _recognised_times(table: FreeFormTable, source: SourceProposal, epoch: datetime, notes: list[str]) -> FloatArray:
    assert source.time is not None
    column = source.time.columns[0]
    if source.time.format == "utc":
        cells = [row[table.names.index(column)] for row in table.rows]
        return np.array([_seconds(cell, epoch) if cell else np.nan for cell in cells])
    notes.append(f"'{column}' is taken after the run's time zero")
    return _in_si(table, column, source.time.unit)


def _above_ellipsoid(source: SourceProposal, values: dict[str, FloatArray], notes: list[str]) -> FloatArray:
    stated = next((value for key, value, _ in source.keys if key == "height_is"), "")
    if stated == '"msl"':
        notes.append("heights above sea level became ellipsoidal with EGM96's undulation")
        return undulation_m(values["lat"], values["lon"])
    if stated != '"ellipsoid"':
        notes.append("heights are taken above the ellipsoid")
    return np.zeros(len(values["lat"]))


def _in_si(table: FreeFormTable, column: str, unit: str) -> FloatArray:
    return tables.to_si(table.numbers(table.names.index(column)).copy(), unit)


def _canonical_unit(short: str) -> str:
    """Unit in which a receiver's canonical column is written: the end of its name."""
    return next(q.canonical for q in tables.GNSS if q.short == short).rpartition("_")[2]
