"""Spoilt deliveries: tables that a program stored, and trajectories of another team.

The cases of `tests.fuzzing` that `postflight import` and `postflight compare` meet. Where a format guards its content
(a spreadsheet is text in an archive, an OEM is text) a plain reader judges every number; where it has no check sums
(NetCDF, HDF5, Parquet, MATLAB) a flipped bit may be another number, and what is asked is a table or a refusal in words.
"""

from __future__ import annotations

import csv
import io
import math
import zipfile
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
from scipy.io import netcdf_file, savemat

from flightmodel import earth
from postflight.intake.freeform_tables import FreeFormTable
from postflight.intake.other_trajectory import OtherTrajectory, read_other
from postflight.intake.stored_tables import read_tables
from tests import fuzzing
from tests.fuzzing import CELLS, PLAIN, Case, Rows

EPOCH = "2009-08-17T12:52:00Z"
TIME_S = np.round(420.0 + 0.5 * np.arange(14), 6)
GEODETIC = np.column_stack([37.8 + 0.003 * TIME_S, -75.4 + 0.002 * TIME_S, 115e3 - 870.0 * (TIME_S - 420.0)])
SHEET = "xl/worksheets/sheet1.xml"
_SPREADSHEET = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"


# ---------------------------------------------------------------------------------------------- what programs store


def _channels() -> dict[str, np.ndarray]:
    w = np.sin(0.9 * TIME_S)
    return {"time": TIME_S, "range": 115e3 - 870.0 * (TIME_S - 420.0), "az": 130.0 + 0.03 * w, "el": 38.0 - 0.4 * w}


def _table_fault(tables: list[FreeFormTable]) -> str:
    """What keeps tables from being tables: lengths that differ, cells that are no text; empty for nothing."""
    for table in tables:
        if len(table.names) != len(table.units) or len(table.names) < 2:
            return f"{len(table.names)} names, {len(table.units)} units"
        cells = [*table.names, *table.units, *(cell for row in table.rows for cell in row)]
        if not all(isinstance(cell, str) for cell in cells):
            return "a cell that is no text"
        if any(math.isinf(v) for k in range(len(table.names)) for v in table.numbers(k)):
            return "an infinite number"
    return "" if tables else "accepted without a table"


def stored_case(root: Path) -> Case:
    """NetCDF 3 and 4, Parquet, MATLAB 5 and 7.3 with four channels."""
    import h5py
    import pyarrow as pa
    import pyarrow.parquet as pq

    root.mkdir(parents=True)
    channels = _channels()
    with netcdf_file(root / "track3.nc", "w") as file:
        file.createDimension("time", len(TIME_S))
        for name, values in channels.items():
            variable = file.createVariable(name, "f8", ("time",))
            variable[:] = values
            variable.units = "s" if name == "time" else "m"
    for name, title in (("track4.nc", b""), ("track73.mat", b"MATLAB 7.3 MAT-file")):
        with h5py.File(root / name, "w", userblock_size=512 if title else 0) as file:
            for channel, values in channels.items():
                file.create_dataset(channel, data=values[None] if title else values).attrs["units"] = "m"
        if title:
            with (root / name).open("r+b") as stored:
                stored.write(title)
    savemat(root / "track5.mat", channels)
    pq.write_table(pa.table(channels), root / "track.parquet")

    def judge(path: Path, data: bytes) -> str:
        return _table_fault(read_tables(path))

    files = tuple(sorted(path for path in root.iterdir()))
    return Case(root, files, fuzzing.spoil_bytes, judge)


def spoil_workbook(data: bytes, rng: np.random.Generator) -> bytes:
    """Spoil a spreadsheet: bytes of the archive, or a value or tag of its sheet, packed again."""
    if rng.random() < 0.3:
        return fuzzing.spoil_bytes(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    text = parts[SHEET].decode()
    starts = [k for k in range(len(text)) if text.startswith("<v>", k)]
    at = starts[int(rng.integers(len(starts)))] + 3
    if rng.random() < 0.7:
        cell = CELLS[int(rng.integers(len(CELLS)))].replace("\0", "").replace("<", "")
        text = text[:at] + cell + text[text.index("</v>", at) :]
    else:
        text = fuzzing.spoil_bytes(text.encode(), rng).decode("utf-8", "replace")
    parts[SHEET] = text.encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return out.getvalue()


def workbook_case(root: Path) -> Case:
    """A spreadsheet with names, a row of units and fourteen rows."""
    import openpyxl

    root.mkdir(parents=True)
    path = root / "track.xlsx"
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(list(_channels()))
    sheet.append(["s", "m", "deg", "deg"])
    for row in zip(*_channels().values(), strict=True):
        sheet.append([float(value) for value in row])
    book.save(path)

    def judge(path: Path, data: bytes) -> str:
        tables = read_tables(path)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            tree = ElementTree.fromstring(archive.read(SHEET))
        written = {cell.text or "" for cell in tree.iter(f"{_SPREADSHEET}v")}
        numbers = {float(text) for text in written if _is_float(text)}
        for table in tables:
            for k in range(len(table.names)):
                strange = [v for v in table.numbers(k) if not math.isnan(v) and v not in numbers]
                if strange:
                    return f"read {strange[0]}, which the sheet does not hold"
        return _table_fault(tables)

    return Case(root, (path,), spoil_workbook, judge)


def _is_float(text: str) -> bool:
    try:
        return not math.isnan(float(text))
    except ValueError:
        return False


# ------------------------------------------------------------------------------------------ another team's trajectory


def _stamp(seconds: float) -> str:
    when = datetime(2009, 8, 17, 12, 52, tzinfo=UTC) + pd.Timedelta(seconds=seconds)
    return when.strftime("%Y-%m-%dT%H:%M:%S.%f")


def _seconds(stamp: str) -> float:
    """Time after t0 of an ISO stamp, or of one by the day of the year; ValueError where it is none."""
    text = stamp.strip().rstrip("Z")
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        when = datetime.strptime(text, "%Y-%jT%H:%M:%S.%f")
    return (when.replace(tzinfo=when.tzinfo or UTC) - datetime.fromisoformat(EPOCH)).total_seconds()


def _states(velocity_mps: tuple[float, float, float] = (-400.0, 310.0, -550.0)) -> np.ndarray:
    """Position in km and velocity in km/s (n, 6), Earth-fixed."""
    at = earth.ecef_from_geodetic(*np.deg2rad(GEODETIC[:, :2]).T, GEODETIC[:, 2])
    return 1e-3 * np.column_stack([at, np.broadcast_to(velocity_mps, at.shape)])


OEM_HEAD = """\
CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2009-09-01T00:00:00
ORIGINATOR = OTHER
META_START
OBJECT_NAME = ENTRY
OBJECT_ID = 2009-000A
CENTER_NAME = EARTH
REF_FRAME = ITRF2000
TIME_SYSTEM = UTC
META_STOP
"""


def spoil_oem(data: bytes, rng: np.random.Generator) -> bytes:
    """Spoil an OEM: a cell, a line, some bytes."""
    way = rng.random()
    if way < 0.25:
        return fuzzing.spoil_bytes(data, rng)
    lines = data.decode().split("\n")[:-1]
    k = int(rng.integers(len(lines)))
    if way < 0.45:
        other = int(rng.integers(len(lines)))
        lines[k], lines[other] = lines[other], lines[k]
    else:
        cells = lines[k].split(" ")
        cells[int(rng.integers(len(cells)))] = CELLS[int(rng.integers(len(CELLS)))]
        lines[k] = " ".join(cells)
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


def _plain_oem(data: bytes) -> Rows:
    """States of an OEM by a plain reader: seconds, m, m/s."""
    rows: Rows = []
    inside = False
    for raw in data.decode("utf-8", "replace").splitlines():
        line = raw.strip()
        if line.endswith(("_START", "_STOP")):
            inside = line.endswith("_START")
            continue
        cells = line.split()
        if inside or not cells or "=" in line or line.startswith("COMMENT"):
            continue
        if len(cells) < 7 or not all(PLAIN.fullmatch(cell) for cell in cells[1:7]):
            raise ValueError(line)
        rows.append((_seconds(cells[0]), *(1e3 * float(cell) for cell in cells[1:7])))
    return rows


def _judged_states(found: OtherTrajectory, wanted: Rows, whole: bool) -> str:
    """Nothing where each state read stands in the file, and what is left out is noted."""
    assert found.velocity_ecef_mps is not None or not whole
    columns = [found.time_s[:, None], found.position_ecef_m]
    columns += [] if found.velocity_ecef_mps is None else [found.velocity_ecef_mps]
    for row in np.column_stack(columns):
        near = [w for w in wanted if abs(w[0] - row[0]) < 1e-5]
        if not any(np.allclose(row, w[: len(row)], rtol=1e-9, atol=1e-6, equal_nan=True) for w in near):
            return f"read {row.tolist()}, which the file does not hold"
    if len(found.time_s) < len({w[0] for w in wanted}) and not any("left out" in note for note in found.notes):
        return f"{len(wanted)} rows became {len(found.time_s)} without a note"
    return ""


def oem_case(root: Path) -> Case:
    """A CCSDS OEM of fourteen states with one covariance."""
    root.mkdir(parents=True)
    path = root / "other.oem"
    rows = [f"{_stamp(t)} " + " ".join(f"{v:.9f}" for v in row) for t, row in zip(TIME_S, _states(), strict=True)]
    triangle = [" ".join("1.0e-6" if i == k else "0.0" for i in range(k + 1)) for k in range(6)]
    covariance = ["COVARIANCE_START", f"EPOCH = {_stamp(TIME_S[3])}", *triangle, "COVARIANCE_STOP"]
    path.write_text(OEM_HEAD + "\n".join([*rows, *covariance]) + "\n")

    def judge(path: Path, data: bytes) -> str:
        found = read_other(path, EPOCH)
        if b"CCSDS_OEM_VERS" not in data[:4096]:
            return ""
        try:
            wanted = _plain_oem(data)
        except ValueError as fault:
            return f"accepted, where a plain reader finds {fault}"
        return _judged_states(found, wanted, whole=True)

    return Case(root, (path,), spoil_oem, judge)


def trajectory_table_case(root: Path) -> Case:
    """A table of times, places and velocities."""
    root.mkdir(parents=True)
    path = root / "other.csv"
    table = pd.DataFrame({"t_s": TIME_S, "lat_deg": GEODETIC[:, 0], "lon_deg": GEODETIC[:, 1], "alt_m": GEODETIC[:, 2]})
    table.to_csv(path, index=False, float_format="%.12g", lineterminator="\n")

    def judge(path: Path, data: bytes) -> str:
        found = read_other(path, EPOCH)
        wanted: Rows = []
        for line in data.decode("utf-8", "replace").splitlines():
            cells = [cell.strip() for cell in next(csv.reader([line], skipinitialspace=True), [])]
            if len(cells) >= 4 and all(PLAIN.fullmatch(cell) for cell in cells[:4]):
                t, latitude, longitude, altitude = (float(cell) for cell in cells[:4])
                at = earth.ecef_from_geodetic(np.deg2rad(latitude), np.deg2rad(longitude), altitude)
                wanted.append((t, *at))
        return _judged_states(found, wanted, whole=False)

    return Case(root, (path,), fuzzing.spoil_table, judge)


def cases(root: Path) -> dict[str, Case]:
    """Every case, in folders of its own below ``root``."""
    return {
        "stored tables": stored_case(root / "stored"),
        "spreadsheet": workbook_case(root / "workbook"),
        "OEM": oem_case(root / "oem"),
        "trajectory table": trajectory_table_case(root / "trajectory"),
    }
