"""Spoilt input and what may become of it: refused in words, or read as exactly what the spoilt file says.

A `Case` is one small folder that reads without fault, and a judge that reads a spoilt copy through the user's gate.
The judge has a reader of its own, a few lines of plain Python: what the gate accepts must be what that reader finds.
``benchmarks/fuzz.py`` runs many thousands by hand, ``tests/test_fuzz.py`` a few seconds of them.
"""

from __future__ import annotations

import csv
import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from estimators.calibration import calibrate_lens, read_corners
from flightmodel import aerodynamics
from flightmodel.aerodynamics import read_with_sidecar
from flightmodel.camera_edits import EDITS_FILE, read_edits
from flightmodel.checks import GateError, Issue
from flightmodel.film import Frames
from flightmodel.flightfolder import read_flight, read_flight_file
from flightmodel.geometry import FEATURE_KINDS, torus_circles
from flightmodel.shell_features import read_features
from flightmodel.vehicle import DATA, vehicle_from_toml
from synthetic_flight.scenarios import read_scenario

PLAIN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
MISSING = ("", "nan", "na", "null", "-")
HALF_YEAR_S = 182.5 * 86400.0
T0 = datetime(2009, 8, 17, 12, 52, tzinfo=UTC)
CELLS = (
    "nan", "NaN", "inf", "-inf", "Infinity", "1e308", "-1e308", "1e309", "1e-320", "-0.0", "0", "-1", "9" * 400,
    "1_0", "0x1f", "１２", "٣", "1,5", "1 2", "12.5.1", "--3", "", "-", "NA", "null", "text", "é\u2028x", "\0",
    "\ufeff1", '"', '"1"', "'1'", "1e", "+1", "1.", ".5", "True", "2009-08-17T12:59:01Z", "229:12:59:01.5",
    "1e5 ", "\t3", "1;2", "=1+1", "#", "1f", "1d3", "0.1000000000000000055511151231257827", "4294967296",
    "123456789012345678901", "3.4028235e38", "1E+2",
)  # fmt: skip
VALUES = (
    "0", "-1", "1e308", "-0.0", "nan", "inf", "true", '"text"', '""', "[]", "[1]", "[1.0, 2.0, 3.0]", "{}",
    "{a = 1}", "1979-05-27", "1979-05-27T07:32:00Z", "9223372036854775808", "1" * 5000, "0.1", "-90.5", "360.1",
    '"../../x.toml"', '"/etc/passwd"', '"truth/truth.csv"', '"."', '"a\\u0000b"', '"telemetry"',
    "[[1, 2], [3]]", '["+x", "+y", "+z"]', "1e-320", "0x10", "1_000", '"0001-01-01T00:00:00+05:00"',
    '"9999-12-31T23:59:59-05:00"', '"é"', "[nan, nan, nan]", "{from_s = 1}", "'''", "5", "1.5",
)  # fmt: skip

FLIGHT = """\
name = "fuzzed"
t0_utc = "2009-08-17T12:52:00Z"
description = "a flight of three seconds"

[attitude_prior]
t_s = 420.0
azimuth_deg = 130.0
elevation_deg = -70.0
roll_deg = 10.0
sd_deg = 3.0

[motion]
model = "strapdown"
drag_sd = 1.0

[[events]]
name = "one"
t_s = 421.5

[sensors.accelerometer]
file = "telemetry/accelerometer.csv"
axes = ["+x", "+y", "+z"]
noise_sd_mps2 = 0.05
columns.ax = { column = "AX (g)", unit = "g" }

[sensors.rates]
file = "telemetry/rates.csv"
mount = "body"
time = { column = "irig", format = "irig_doy" }

[radars.north]
file = "telemetry/radar.csv"
latitude_deg = 37.841
longitude_deg = -75.485
height_m = 12.0
time = { column = "utc", format = "utc" }

[gnss.receiver]
file = "telemetry/gnss.csv"
horizontal_sd_m = 5.0
min_satellites = 4

[barometers.static]
file = "telemetry/barometer.csv"
height_is = "ellipsoid"
time = { unit = "ms" }

[atmosphere]
file = "telemetry/atmosphere.csv"
"""
TIMES = {
    "accelerometer": ("t_s", "seconds", 1.0), "rates": ("irig", "irig", 1.0), "radar": ("utc", "utc", 1.0),
    "gnss": ("t_s", "seconds", 1.0), "barometer": ("t_s", "seconds", 1e-3), "atmosphere": ("", "none", 1.0),
}  # fmt: skip
DEG, G = np.pi / 180.0, 9.80665
COLUMNS = {
    "accelerometer": (("AX (g)", G), ("ay_suba_mps2", 1.0), ("az_suba_mps2", 1.0)),
    "rates": (("p_body_degps", DEG), ("q_body_degps", DEG), ("r_body_degps", DEG)),
    "radar": (("range_m", 1.0), ("az_deg", DEG), ("el_deg", DEG)),
    "gnss": (("x_ecef_m", 1.0), ("y_ecef_m", 1.0), ("z_ecef_m", 1.0)),
    "barometer": (("height_m", 1.0),),
    "atmosphere": (
        ("alt_m", 1.0), ("rho_kgpm3", 1.0), ("t_k", 1.0), ("wind_n_mps", 1.0), ("wind_e_mps", 1.0),
    ),
}  # fmt: skip
SOURCES = {"radar": "north", "gnss": "receiver", "barometer": "static"}
Rows = list[tuple[float, ...]]


@dataclass
class Case:
    """A folder that reads without fault, the files to spoil, and the judge: empty words where nothing is wrong."""

    root: Path
    files: tuple[Path, ...]
    spoil: Callable[[bytes, np.random.Generator], bytes]
    judge: Callable[[Path, bytes], str]


def trial(case: Case, rng: np.random.Generator) -> tuple[str, str]:
    """Spoil one file, read, mend: ("refused" | "accepted" | "defect", words)."""
    path = case.files[int(rng.integers(len(case.files)))]
    clean = path.read_bytes()
    spoilt = case.spoil(clean, rng)
    path.write_bytes(spoilt)
    try:
        words = case.judge(path, spoilt)
        return ("defect", f"{path.name}: {words}") if words else ("accepted", "")
    except (GateError, OSError) as refusal:
        said = str(refusal).strip()
        return ("refused", said) if said else ("defect", f"{path.name}: a refusal without words")
    except Exception as fault:
        return "defect", f"{path.name}: {type(fault).__name__}: {fault}"
    finally:
        path.write_bytes(clean)


# ------------------------------------------------------------------------------------------------------ ways to spoil


def _pick(rng: np.random.Generator, values: tuple[str, ...]) -> str:
    return values[int(rng.integers(len(values)))]


def spoil_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip some bits, cut the end off, or put bytes in."""
    out = bytearray(data)
    way = int(rng.integers(6))
    if way == 0:
        return bytes(out[: int(rng.integers(len(out)))])
    if way == 1:
        at = int(rng.integers(len(out)))
        return bytes(out[:at] + rng.integers(0, 256, int(rng.integers(1, 9)), dtype=np.uint8).tobytes() + out[at:])
    if way == 2:
        at = int(rng.integers(len(out)))
        return bytes(out[:at] + out[at + int(rng.integers(1, 40)) :])
    for _ in range(int(rng.integers(1, 5))):
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _spoil_lines(lines: list[str], rng: np.random.Generator) -> list[str]:
    one, other = (int(k) for k in rng.integers(0, len(lines), 2))
    way = int(rng.integers(4))
    if way == 0:
        return lines[:one] + lines[one + 1 :]
    if way == 1:
        return [*lines[:one], lines[one], *lines[one:]]
    if way == 2:
        lines[one], lines[other] = lines[other], lines[one]
        return lines
    return [*lines[:one], lines[other], *lines[one:]]


Change = Callable[[list[str], float, np.random.Generator], None]


def _spoil_text(data: bytes, rng: np.random.Generator, shares: tuple[float, float], change: Change) -> bytes:
    """Spoil bytes or whole lines of a text, with these probabilities in sum, else a line as ``change`` does."""
    way = rng.random()
    if way < shares[0]:
        return spoil_bytes(data, rng)
    lines = data.decode().split("\n")[:-1]
    if way < shares[1]:
        lines = _spoil_lines(lines, rng)
    else:
        change(lines, way, rng)
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


def spoil_table(data: bytes, rng: np.random.Generator) -> bytes:
    """Spoil a CSV: a cell, a name, a line, some bytes."""
    return _spoil_text(data, rng, (0.25, 0.45), _spoil_cell)


def _spoil_cell(lines: list[str], way: float, rng: np.random.Generator) -> None:
    row = 0 if way > 0.92 else int(rng.integers(len(lines)))
    cells = lines[row].split(",")
    k = int(rng.integers(len(cells)))
    if row == 0:
        names = (*cells, "x", "", cells[k].upper(), cells[k] + " ", cells[k].rsplit("_", 1)[0])
        cells[k] = _pick(rng, tuple(names))
    elif way < 0.75:
        cells[k] = _pick(rng, CELLS)
    else:
        cells[k] = repr(float(rng.normal() * 10.0 ** rng.uniform(-12, 12)))
    lines[row] = ",".join(cells)


def spoil_toml(data: bytes, rng: np.random.Generator) -> bytes:
    """Spoil a TOML file: a value, a key, a line, some bytes."""
    return _spoil_text(data, rng, (0.15, 0.35), _spoil_entry)


def _spoil_entry(lines: list[str], way: float, rng: np.random.Generator) -> None:
    at = [k for k, line in enumerate(lines) if "=" in line and not line.startswith("#")]
    k = at[int(rng.integers(len(at)))]
    key, _, value = lines[k].partition("=")
    if way < 0.5:
        name = key.strip()
        other = lines[at[int(rng.integers(len(at)))]].partition("=")[0].strip()
        key = _pick(rng, (name[:-1] or "x", name + "x", name.upper(), "x", f"{name}.y", f'"{name} "', other, "é", '""'))
    elif way < 0.8:
        value = _pick(rng, VALUES)
    else:  # one number of the value
        numbers = list(re.finditer(r"-?\d+\.?\d*", value))
        if numbers:
            n = numbers[int(rng.integers(len(numbers)))]
            new = _pick(rng, ("nan", "-inf", "1e308", "0", "-0.0", '"1"', "true", repr(float(rng.normal(0.0, 50.0)))))
            value = value[: n.start()] + new + value[n.end() :]
    lines[k] = f"{key.strip()} = {value.strip()}"


# -------------------------------------------------------------------------------------- a plain reader, and the judges


def _number(cell: str) -> float:
    """Value of a cell; ValueError where it is none that a table may hold."""
    text = cell.strip()
    if text.lower() in MISSING:
        return math.nan
    if not PLAIN.fullmatch(text) or not math.isfinite(float(text)):
        raise ValueError(text)
    return float(text)


def _time(cell: str, kind: str, scale: float) -> float:
    if kind == "seconds":
        return _number(cell) * scale
    if kind == "irig":
        day, hour, minute, second = cell.strip().split(":")
        start = (datetime(T0.year, 1, 1, tzinfo=UTC) - T0).total_seconds()
        seconds = start + (int(day) - 1) * 86400.0 + int(hour) * 3600 + int(minute) * 60 + float(second)
        return seconds if seconds > -HALF_YEAR_S else seconds + 365 * 86400.0  # a flight across the turn of a year
    stamp = pd.Timestamp(cell.strip())
    stamp = stamp.tz_localize("UTC") if stamp.tzinfo is None else stamp
    return (stamp - pd.Timestamp(T0)).total_seconds()


def plain_rows(data: bytes, name: str) -> Rows:
    """What a table says, row by row: time (where it has any) and columns in SI, missing as NaN."""
    lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip()]
    table = [[cell.strip() for cell in row] for row in csv.reader(lines, skipinitialspace=True)]
    header, rows = table[0], []
    column, kind, scale = TIMES[name]
    for row in table[1:]:
        values = [_number(row[header.index(c)]) * factor for c, factor in COLUMNS[name]]
        for extra in ("nsat",) if name == "gnss" else ():
            _number(row[header.index(extra)])
        time = [] if kind == "none" else [_time(row[header.index(column)], kind, scale)]
        rows.append((*time, *values))
    return rows


def read_rows(telemetry: Any, name: str) -> Rows:
    """The same of what was read."""
    if name == "atmosphere":
        s = telemetry.sounding
        columns = [s.altitude_m, s.density_kgpm3, s.temperature_k, s.wind_north_mps, s.wind_east_mps]
        return [tuple(row) for row in np.column_stack(columns).tolist()]
    record, values = {
        "accelerometer": lambda t: (t.accelerometer, "measured_sensor"),
        "rates": lambda t: (t.rates, "measured_sensor"),
        "radar": lambda t: (t.radars["north"], "range_az_el"),
        "gnss": lambda t: (t.gnss["receiver"], "position_ecef_m"),
        "barometer": lambda t: (t.barometers["static"], "height_m"),
    }[name](telemetry)
    return [tuple(row) for row in np.column_stack([record.time_s, getattr(record, values)]).tolist()]


def _keys(rows: Rows, name: str) -> list[tuple[Any, ...]]:
    """Rows in a form to compare: NaN alike, clock times to their own 1e-7 s, azimuth within one turn."""
    out = []
    for row in rows:
        row = list(row)
        if TIMES[name][1] in ("utc", "irig"):
            row[0] = round(row[0], 6)
        if name == "radar":
            row[2] = float(np.mod(row[2], 2.0 * np.pi))
        if name == "gnss" and not all(math.isfinite(v) for v in row[1:]):
            row[1:] = [math.nan] * 3
        out.append(tuple("missing" if math.isnan(v) else v for v in row))
    return out


def _compare(telemetry: Any, name: str, data: bytes) -> str:
    try:
        wanted = _keys(plain_rows(data, name), name)
    except (ValueError, IndexError, UnicodeDecodeError) as fault:
        return f"accepted, where a plain reader finds {type(fault).__name__}: {fault}"
    got = _keys(read_rows(telemetry, name), name)
    strange = [row for row in got if row not in set(wanted)]
    if strange:
        return Issue(f"read {strange[0]}, which the file does not hold", "row-changed")
    source = SOURCES.get(name, name)
    lost = [row for row in wanted if row not in set(got)]
    if (lost or len(got) != len(wanted)) and not any(f.source == source for f in telemetry.findings):
        return Issue(f"{len(wanted)} rows became {len(got)} without a finding", "row-lost")
    return ""


def _same(one: Any, other: Any, names: set[str]) -> str:
    for name in sorted(names):
        if _keys(read_rows(one, name), name) != _keys(read_rows(other, name), name):
            return f"{name}.csv was not touched, yet reads otherwise"
    return ""


def flight_case(root: Path) -> tuple[Case, Case]:
    """A flight folder of six tables, and the same with flight.toml to be spoilt."""
    write_flight(root)
    clean = read_flight(root)
    assert not clean.findings, clean.findings

    def judge_table(path: Path, data: bytes) -> str:
        telemetry = read_flight(root)
        name = path.stem
        return _compare(telemetry, name, data) or _same(telemetry, clean, set(COLUMNS) - {name})

    def judge_toml(path: Path, data: bytes) -> str:
        spec = read_flight_file(root)
        words = not_in(tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n")), spec.model_dump())
        telemetry = read_flight(root)
        return words or _as_stated(telemetry, spec)

    tables = tuple(root / "telemetry" / f"{name}.csv" for name in COLUMNS)
    return Case(root, tables, spoil_table, judge_table), Case(root, (root / "flight.toml",), spoil_toml, judge_toml)


def _as_stated(telemetry: Any, spec: Any) -> str:
    """What the records say of themselves is what the file says."""
    for name, entry in spec.radars.items():
        site = telemetry.radars[name].spec
        if (site.latitude_rad, site.height_m) != (float(np.deg2rad(entry.latitude_deg)), entry.height_m):
            return f"radar {name} does not stand where flight.toml says"
    if telemetry.accelerometer is not None:
        got = telemetry.accelerometer.spec.noise_sd
        if got != spec.sensors.accelerometer.noise_sd_mps2:
            return f"accelerometer noise {got}"
    return ""


def not_in(written: Any, read: Any, where: str = "") -> str:
    """The first key or value of a TOML file that is not in what was read; empty for none."""
    if isinstance(written, dict):
        if not isinstance(read, dict):
            return f"{where}: a table became {read!r}"
        for key, value in written.items():
            if key not in read:
                return f"{where}.{key}: accepted and dropped"
            words = not_in(value, read[key], f"{where}.{key}")
            if words:
                return words
        return ""
    if isinstance(written, list):
        if not isinstance(read, list | tuple) or len(written) != len(read):
            return f"{where}: {written!r} became {read!r}"
        if where.endswith(".inertia_kgm2") and not any(isinstance(row, list) for row in written):
            read = tuple(read[k][k] for k in range(3)) if np.count_nonzero(read) == np.count_nonzero(written) else read
        return next(
            (w for k, (a, b) in enumerate(zip(written, read, strict=True)) if (w := not_in(a, b, f"{where}[{k}]"))), ""
        )
    if where == ".attitude_prior.sd_deg" and isinstance(read, tuple):
        read = read[0]
    return (
        ""
        if read == written and isinstance(read, bool) == isinstance(written, bool)
        else f"{where}: {written!r} became {read!r}"
    )


def write_flight(root: Path) -> None:
    """Three seconds of numbers of the right size; no physics is asked of them."""
    folder = root / "telemetry"
    folder.mkdir(parents=True)
    (root / "flight.toml").write_text(FLIGHT)
    t = np.round(420.0 + 0.1 * np.arange(31), 6)
    w = [np.sin(0.9 * t + k) + 0.011 * k * t for k in range(3)]
    stamp = [T0 + pd.Timedelta(seconds=float(s)) for s in t]
    tables = {
        "accelerometer": {"t_s": t, "AX (g)": w[0], "ay_suba_mps2": w[1], "az_suba_mps2": w[2] - 12.0},
        "rates": {
            "irig": [f"229:{s.hour:02d}:{s.minute:02d}:{s.second:02d}.{s.microsecond // 1000:03d}" for s in stamp],
            "p_body_degps": w[0] + 36.0, "q_body_degps": w[1], "r_body_degps": w[2],
        },
        "radar": {
            "utc": [s.strftime("%Y-%m-%dT%H:%M:%S.%f") + "Z" for s in stamp],
            "range_m": 115e3 - 870.0 * (t - 420.0), "az_deg": 130.0 + 0.03 * t, "el_deg": 38.0 - 0.4 * (t - 420.0),
        },
        "gnss": {
            "t_s": t, "x_ecef_m": 1.3e6 + 500.0 * t, "y_ecef_m": -4.9e6 - 300.0 * t, "z_ecef_m": 4.0e6 + 20.0 * t,
            "nsat": np.full(31, 8),
        },
        "barometer": {"t_s": 1e3 * t, "height_m": 60e3 - 300.0 * (t - 420.0) + w[0]},
        "atmosphere": {
            "alt_m": 3000.0 * np.arange(31), "rho_kgpm3": 1.2 * np.exp(-3.0 * np.arange(31) / 7.1),
            "t_k": 250.0 + 2.0 * np.sin(np.arange(31.0)), "wind_n_mps": w[0], "wind_e_mps": w[1],
        },
    }  # fmt: skip
    for name, columns in tables.items():
        pd.DataFrame(columns).to_csv(folder / f"{name}.csv", index=False, float_format="%.10g", lineterminator="\n")


AERO = """\
mach,alpha_deg,ca,cn,cm,cmq
0,0,0.9,0,0,0
0,90,0.5,0.6,-0.5,-0.1
0,180,-0.4,0.1,-0.1,-0.2
5,0,1.5,0,0,0.1
5,90,0.7,0.8,-0.4,-0.1
5,180,-0.1,0.2,-0.1,-0.3
"""
SIDECAR = """\
source = "made up"
licence = "MIT"
area_m2 = 7.0686
length_m = 3.0
moment_reference_station_m = 0.0
axes = "body"
uncertainty.ca = 0.03
"""


def vehicle_cases(root: Path) -> tuple[Case, Case, Case]:
    """A vehicle file, its coefficient table with sidecar, and a scenario."""
    root.mkdir(parents=True)
    text = (DATA / "vehicles/irve2_reference.toml").read_text()
    text = text.replace('table = "irve2_reference.csv"', 'table = "aero.csv"').replace(
        "[aerodynamics.free_molecular] ", "# none "
    )
    (root / "vehicle.toml").write_text(text)
    (root / "aero.csv").write_text(AERO)
    (root / "aero.toml").write_text(SIDECAR)
    scenario = (DATA / "scenarios/irve2_reference.toml").read_text()
    (root / "scenario.toml").write_text(scenario.replace('vehicle = "irve2_reference"', 'vehicle = "vehicle.toml"'))

    def judge_vehicle(path: Path, data: bytes) -> str:
        vehicle = vehicle_from_toml(path)
        got = {k: getattr(vehicle, k) for k in ("reference", "joint", "aeroshell", "centerbody", "geometry")}
        got = {k: v.model_dump() for k, v in got.items()}
        for part in ("sensors", "cameras"):
            got[part] = {k: v.model_dump() for k, v in getattr(vehicle, part).items()}
        written = tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n"))
        return not_in({k: written[k] for k in got if k in written}, got)

    def judge_table(path: Path, data: bytes) -> str:
        table, _ = read_with_sidecar(root / "aero.csv")
        if path.suffix == ".toml":
            return ""
        lines = [line.split("#")[0] for line in data.decode("utf-8-sig").splitlines() if line.split("#")[0].strip()]
        header = [cell.strip() for cell in lines[0].split(",")]
        header = [c.lower() if c.lower() in aerodynamics.COLUMNS else c for c in header]  # capitals are no other column
        if len(set(header)) < len(header):
            return "accepted with a column that stands twice"
        for line in lines[1:]:
            row = dict(zip(header, (_number(cell) for cell in line.split(",")), strict=True))
            at = table.coefficients[
                np.argmin(abs(table.mach - row["mach"])), np.argmin(abs(np.rad2deg(table.alpha_rad) - row["alpha_deg"]))
            ]
            if at.tolist() != [row[c] for c in ("ca", "cn", "cm", "cmq")]:
                return f"read {at.tolist()} where the file says {line}"
        return ""

    def judge_scenario(path: Path, data: bytes) -> str:
        spec = read_scenario(str(path)).spec
        return not_in(tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n")), spec.model_dump())

    aero = (root / "aero.csv", root / "aero.toml")
    return (
        Case(root, (root / "vehicle.toml",), spoil_toml, judge_vehicle),
        Case(root, aero, lambda d, r: spoil_toml(d, r) if b"licence" in d else spoil_table(d, r), judge_table),
        Case(root, (root / "scenario.toml",), spoil_toml, judge_scenario),
    )


# ------------------------------------------------------------------------------------------------------------- pictures

SIZE, BITS, FILM_FRAMES = (160, 120), 5, 24


def numbered(number: int) -> np.ndarray:
    """A picture that shows its number in bars, white or black above and the other way round below."""
    picture = np.full((SIZE[1], SIZE[0], 3), 20, dtype=np.uint8)
    for bit in range(BITS):
        half = np.s_[:60] if number >> bit & 1 else np.s_[60:]
        picture[half, 30 * bit + 5 : 30 * bit + 25] = 220
    return picture


def shown(picture: np.ndarray) -> int | None:
    """Number that a picture shows; None where its bars are not clear and complete."""
    bars = [[float(picture[half, 30 * bit + 10 : 30 * bit + 20].mean()) for bit in range(BITS)]
            for half in (np.s_[5:55], np.s_[65:115])]  # fmt: skip
    clear = all(min(pair) < 40 and max(pair) > 200 for pair in zip(*bars, strict=True))
    return sum(1 << bit for bit, mean in enumerate(bars[0]) if mean > 128) if clear else None


def picture_case(root: Path) -> Case:
    """Three PNG and three JPEG pictures: refused, empty, or (PNG, which carries check sums) as they were."""
    folder = _filmed_flight(root, 'folder = "telemetry/pictures"')
    pictures = folder / "pictures"
    pictures.mkdir()
    names = [f"p{k}.{'png' if k % 2 else 'jpg'}" for k in range(6)]
    for k, name in enumerate(names):
        cv2.imwrite(str(pictures / name), numbered(k))
    _frame_list(folder, names)
    clean = list(_frames(root).pictures())

    def judge(path: Path, data: bytes) -> str:
        for k, picture in enumerate(_frames(root).pictures()):
            if not picture.size:
                continue
            if picture.shape != clean[k].shape:
                return f"a picture of {picture.shape}"
            guarded = names[k] != path.name or path.suffix == ".png"  # a JPEG has no check sums
            if guarded and not np.array_equal(picture, clean[k]):
                return f"{names[k]} shows other pixels than before"
        return ""

    return Case(root, tuple(pictures / name for name in names), spoil_bytes, judge)


def film_case(root: Path, name: str, code: str) -> Case:
    """A flight with a film: a frame is refused, empty, spoilt itself, or the one that its number says."""
    folder = _filmed_flight(root, f'film = "telemetry/{name}"')
    writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*code), 10.0, SIZE)
    for k in range(FILM_FRAMES):
        writer.write(numbered(k))
    writer.release()
    _frame_list(folder, [str(k) for k in range(FILM_FRAMES)])
    assert [shown(p) for p in _frames(root).pictures()] == list(range(FILM_FRAMES))

    def judge(path: Path, data: bytes) -> str:
        telemetry = read_flight(root)
        pictures = list(telemetry.frames.pictures())
        if any(p.size and p.shape != (SIZE[1], SIZE[0]) for p in pictures):
            return "a picture of another size"
        found = [shown(p) if p.size else None for p in pictures]
        wrong = [k for k, number in enumerate(found) if number is not None and number != k]
        # what no check sum guards may show anything; later frames one after the other under wrong numbers may not be
        shifted = [
            k
            for k in wrong
            if k + 2 < FILM_FRAMES and all(found[k + j] is not None and found[k + j] == found[k] + j for j in range(3))
        ]
        said = any(f.source == "frames" for f in telemetry.findings)
        return f"frame {shifted[0]} is {found[shifted[0]]}, and no finding says so" if shifted and not said else ""

    return Case(root, (folder / name,), spoil_bytes, judge)


def _frames(root: Path) -> Frames:
    frames = read_flight(root).frames
    assert frames is not None
    return frames


def _filmed_flight(root: Path, where: str) -> Path:
    write_flight(root)
    text = (
        (DATA / "vehicles/irve2_reference.toml")
        .read_text()
        .replace('table = "irve2_reference.csv"', 'table = "aero.csv"')
        .replace("[aerodynamics.free_molecular] ", "# none ")
    )
    text = re.sub(r"width_px = \d+", f"width_px = {SIZE[0]}", text)
    (root / "vehicle.toml").write_text(re.sub(r"height_px = \d+", f"height_px = {SIZE[1]}", text))
    (root / "aero.csv").write_text(AERO)
    (root / "aero.toml").write_text(SIDECAR)
    frames = f'\n[frames]\nfile = "telemetry/frames.csv"\n{where}\ncamera = "camera5"\nbenchmark_s = 420.0\n'
    # the tables are the other case's
    head, radar = (
        FLIGHT.partition("[attitude_prior]")[0],
        FLIGHT[FLIGHT.index("[radars.north]") : FLIGHT.index("[gnss.")],
    )
    motion = '[motion]\nmodel = "ballistic"\ndrag_area_per_mass_m2pkg = 0.05\n\n'
    (root / "flight.toml").write_text(head + 'vehicle = "vehicle.toml"\n' + motion + radar + frames)
    return root / "telemetry"


def _frame_list(folder: Path, names: list[str]) -> None:
    rows = [f"{420.0 + 0.1 * k:.1f},{name}" for k, name in enumerate(names)]
    (folder / "frames.csv").write_text("t_s,frame\n" + "\n".join(rows) + "\n")


# -------------------------------------------------------------------------------------------------------------- corners


def corners_case(root: Path) -> Case:
    """Checkerboard corners of six pictures, calibrated."""
    root.mkdir(parents=True)
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(0.03 * np.arange(5), 0.03 * np.arange(4))
    board = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    matrix = np.array([[420.0, 0.0, 330.0], [0.0, 417.0, 236.0], [0.0, 0.0, 1.0]])
    rows = []
    for image in range(6):
        turn, shift = rng.uniform(-0.5, 0.5, 3), np.array([-0.06, -0.05, rng.uniform(0.25, 0.4)])
        pixels = cv2.projectPoints(board[:, None], turn, shift, matrix, np.zeros(4))[0].reshape(-1, 2)
        rows += [
            (image, *p[:2], *q) for p, q in zip(board, pixels + 0.1 * rng.standard_normal(pixels.shape), strict=True)
        ]
    table = pd.DataFrame(rows, columns=["image", "X_m", "Y_m", "u_px", "v_px"])
    path = root / "corners.csv"
    table.to_csv(path, index=False, float_format="%.10g", lineterminator="\n")

    def judge(path: Path, data: bytes) -> str:
        corners = read_corners(path)
        found = calibrate_lens(corners, (640, 480), "pinhole")
        numbers = np.concatenate([found.focal_px, found.centre_px, found.distortion, found.sd, [found.rms_px]])
        if not np.isfinite(numbers).all():
            return "a calibration that is not finite"
        lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip()]
        header, *body = [[cell.strip() for cell in row] for row in csv.reader(lines, skipinitialspace=True)]
        for column in ("X_m", "Y_m", "u_px", "v_px"):
            try:
                wanted = [_number(row[header.index(column)]) for row in body]
            except (ValueError, IndexError) as fault:
                return f"accepted, where a plain reader finds {fault}"
            if corners[column].tolist() != wanted:
                return f"column {column} is not read as the file says"
        return ""

    return Case(root, (path,), spoil_table, judge)


# ------------------------------------------------------------------------- an analyst's edits of a film, shell features

EDIT_TIMES, EDIT_SIZE = np.array([421.0, 421.04, 421.08, 440.0]), (720, 480)
EDITS = """\
camera,t_s,edit,name,u_px,v_px,value,note
camera5,421.04,benchmark,,,,,the first whole one
camera5,440,reject,,,,,"glare, worst"
camera5,421.08,accept,,,,,
camera5,,mask,sun,1,2,,
camera5,,mask,sun,100.5,2,,
camera5,,mask,sun,50,90.25,,
camera2,430,reject,,,,,of another camera
camera5,440,rim,,300.25,20.5,,
camera5,440,feature,dot 3,10,11,,
camera5,,pose,rotation_x_deg,,,0.25,
camera5,,pose,focal_factor,,,1.01,
"""
FEATURES = """\
station_m,radius_m,clock_lv_deg,kind,shade,width_m
"""


def _plain_table(data: bytes) -> list[dict[str, str]]:
    """Rows of a CSV by name, cells stripped; empty lines left out."""
    lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip()]
    header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines, skipinitialspace=True)]
    if any(header.count(name) > 1 for name in header if name):
        raise ValueError("a column stands twice")
    return [dict(zip(header, row, strict=True)) for row in rows]


def _judged_rows(data: bytes, rows: Callable[[list[dict[str, str]]], list[Any]], got: list[Any]) -> str:
    """Nothing where what was read is what a plain reader makes of the file."""
    try:
        wanted = rows(_plain_table(data))
    except (ValueError, KeyError, UnicodeDecodeError) as fault:
        return f"accepted, where a plain reader finds {type(fault).__name__}: {fault}"
    if wanted != got:
        return f"read {[g for g in got if g not in wanted][:1] or len(got)} where the file says otherwise"
    return ""


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def edits_case(root: Path) -> Case:
    """A table of an analyst's edits of one camera's film, with a row of another's."""
    root.mkdir(parents=True)
    path = root / EDITS_FILE
    path.write_text(EDITS)

    def plain(table: list[dict[str, str]]) -> list[Any]:
        rows = []
        for row in table:
            numbers = [_or_none(_number(row[c])) for c in ("t_s", "u_px", "v_px", "value")]
            words = tuple(row[c] for c in ("camera", "edit", "name", "note"))
            rows += [(words, numbers)] if row["camera"] == "camera5" else []
        return rows

    def judge(path: Path, data: bytes) -> str:
        found = read_edits(path, "camera5", EDIT_TIMES, EDIT_SIZE, ("camera2", "camera5")).rows
        got = [
            ((r.camera, r.edit, r.name, r.note), [_or_none(v) for v in (r.t_s, r.u_px, r.v_px, r.value)]) for r in found
        ]
        return _judged_rows(data, plain, got)

    return Case(root, (path,), spoil_table, judge)


def features_case(root: Path) -> Case:
    """A list of marks on a shell."""
    root.mkdir(parents=True)
    geometry = vehicle_from_toml(DATA / "vehicles/irve2_reference.toml").geometry
    station, radius = (float(c[-1]) for c in torus_circles(geometry))
    marks = [
        f"{station + geometry.torus_minor_radius_m:.4f},{radius:.4f},{clock},{kind},{shade},0.03"
        for clock, kind, shade in ((0, "dot", "darker"), (72.5, "seam", "paler"), (-144, "hoop", "darker"),
                                   (216, "dot", "paler"), (288, "dot", "darker"))
    ]  # fmt: skip
    path = root / "features.csv"
    path.write_text(FEATURES + "\n".join(marks) + "\n")

    def plain(table: list[dict[str, str]]) -> list[Any]:
        rows = []
        for row in table:
            place = [_number(row[c]) for c in ("station_m", "radius_m", "clock_lv_deg")]
            at = np.deg2rad(place[2])
            x, y, z = -place[0], -place[1] * np.cos(at), place[1] * np.sin(at)
            point = tuple(np.round([x, y, z], 9).tolist())
            rows.append((point, FEATURE_KINDS.index(row["kind"]), row["shade"] == "paler", _number(row["width_m"])))
        return rows

    def judge(path: Path, data: bytes) -> str:
        f = read_features(path, geometry)
        points = [tuple((np.round(p, 9) + 0.0).tolist()) for p in f.points_shell_m]
        got = list(zip(points, f.kind.tolist(), f.is_paler.tolist(), f.width_m.tolist(), strict=True))
        return _judged_rows(data, plain, got)

    return Case(root, (path,), spoil_table, judge)


def cases(root: Path) -> dict[str, Case]:
    """Every case, in folders of its own below ``root``."""
    tables, flight = flight_case(root / "flight")
    vehicle, aero, scenario = vehicle_cases(root / "vehicle")
    return {
        "tables of a flight": tables,
        "flight.toml": flight,
        "vehicle.toml": vehicle,
        "coefficients": aero,
        "scenario.toml": scenario,
        "pictures": picture_case(root / "pictures"),
        "film, AVI": film_case(root / "avi", "film.avi", "MJPG"),
        "film, WebM": film_case(root / "webm", "film.webm", "VP90"),
        "corners": corners_case(root / "corners"),
        "camera edits": edits_case(root / "edits"),
        "shell features": features_case(root / "features"),
    }
