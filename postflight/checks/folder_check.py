"""What should an analyst know of a flight folder before running it? Facts, findings, oddities and what is refused.

Facts: rows, span, rate of every table. Findings: what the readers saw (gaps, frozen, saturated, told twice, out of
order). Oddities: what sensors say against each other and against physics, each only where it can be proved from the
data: units, axes, clocks. What cannot be told is not mentioned.

What ``postflight check`` prints, for a reader or as JSON, and the code it leaves with.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flightmodel import earth
from flightmodel.checks import FloatArray, GateError
from flightmodel.config import FILL_IN, read_toml
from flightmodel.flightfolder import Sources, read_sources
from flightmodel.telemetry import Finding
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.checks import inertial, pressure_and_field, tracks
from postflight.checks.track_force import best_comparison, track_force
from postflight.intake.flight_form import left_to_fill_in

CLOCK_SD, CLOCK_S = 5.0, 0.1  # a clock is doubted beyond so many standard deviations and seconds
TOLD_S = 0.5  # a clock is told to better than this, or not at all
FITS = 5.0  # reduced chi-square beyond which one lag and one scale do not describe it


@dataclass(frozen=True)
class Fact:
    """One table: rows, first and last time, samples a second (the usual one), rows with a missing value."""

    source: str
    file: str
    rows: int
    start_s: float
    end_s: float
    rate_hz: float
    missing: int


@dataclass(frozen=True)
class Clock:
    """How late ``source``'s times are against ``against``'s, with one standard deviation."""

    source: str
    against: str
    late_s: float
    sd_s: float


@dataclass
class Report:
    """Everything that a check found; ``exit_code`` as the command leaves with."""

    facts: list[Fact] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    oddities: list[Finding] = field(default_factory=list)
    clocks: list[Clock] = field(default_factory=list)
    fill_in: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    exit_code: int = 0

    def as_json(self) -> dict[str, Any]:
        """Everything as JSON; times that are none become null."""
        out: dict[str, Any] = asdict(self)
        for rows in (out["facts"], out["findings"], out["oddities"]):
            for row in rows:
                row |= {k: None for k, v in row.items() if isinstance(v, float) and not np.isfinite(v)}
        return out


def check_folder(folder: Path) -> Report:
    """Read a flight folder as far as it can be read and say what is odd; nothing is written."""
    report = Report()
    try:
        found = read_sources(folder)
    except GateError as fault:
        _refuse(report, folder, [*fault.faults, *_vehicle_faults(folder)], fault.exit_code)
        return report
    gate = found.gate
    if gate.config or gate.faults:
        _refuse(report, folder, [*gate.config, *gate.faults], 3 if gate.faults else 2)
    report.facts = _facts(found)
    report.findings = sorted(gate.findings, key=lambda f: (f.source, np.nan_to_num(f.start_s, nan=-np.inf)))
    with np.errstate(invalid="ignore"):
        _compare(found, report)
    return report


def _vehicle_faults(folder: Path) -> list[str]:
    """Faults of the vehicle file, which is not reached where flight.toml has some."""
    try:
        named = read_toml(folder / "flight.toml").get("vehicle")
    except GateError:
        return []
    if not isinstance(named, str) or not named.endswith(".toml"):
        return []
    try:
        vehicle_from_toml(vehicle_path(named, folder))
    except GateError as fault:
        return [f"vehicle: {words}" for words in fault.faults]
    return []


def _refuse(report: Report, folder: Path, faults: list[str], code: int) -> None:
    report.fill_in = left_to_fill_in(folder)
    report.refused = [words for words in faults if FILL_IN not in words]
    report.exit_code = code


def _facts(found: Sources) -> list[Fact]:
    spec = found.spec
    tables: list[tuple[str, str, FloatArray, FloatArray]] = []
    for name, triad in found.triads.items():
        tables.append((name, getattr(spec.sensors, name).file, triad.time_s, triad.measured_sensor))
    if found.sun is not None and spec.sensors.sun is not None:
        some = np.isfinite(found.sun.az_el_head_rad).any(axis=(1, 2))
        tables.append(("sun", spec.sensors.sun.file, found.sun.time_s, np.where(some, 0.0, np.nan)[:, None]))
    for name, radar in found.radars.items():
        tables.append((name, spec.radars[name].file, radar.time_s, radar.range_az_el))
    for name, fixes in found.gnss.items():
        tables.append((name, spec.gnss[name].file, fixes.time_s, fixes.position_ecef_m))
    for name, barometer in found.barometers.items():
        tables.append((name, spec.barometers[name].file, barometer.time_s, barometer.height_m[:, None]))
    if found.frames is not None and spec.frames is not None:
        tables.append(("frames", spec.frames.file, found.frames.time_s, found.frames.time_s[:, None]))
    out = []
    for name, file, t, values in tables:
        rate = float(1.0 / np.median(np.diff(t))) if len(t) > 1 else np.nan
        missing = int((~np.isfinite(values).all(axis=1)).sum())
        out.append(Fact(name, file, len(t), float(t[0]), float(t[-1]), rate, missing))
    return out


def _compare(found: Sources, report: Report) -> None:
    """Sensors against each other and against physics."""
    report.oddities += tracks.apart_in_time(found) + inertial.at_rest(found) + inertial.lever(found)
    trackers = tracks.tracks(found)
    for name, radar in found.radars.items():
        report.oddities += tracks.free_fall(found, name, radar)
    for name, fixes in found.gnss.items():
        report.oddities += tracks.receiver_velocity(found, name, fixes)
    doubted = {f.source for f in report.oddities}
    for name in trackers:
        if name not in doubted:
            _against_accelerometer(found, name, report)
    names = [name for name in trackers if name not in doubted]
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            odd, clock = tracks.apart(found, first, second)
            report.oddities += odd
            if clock is not None and clock[1] < TOLD_S:
                report.clocks.append(Clock(second, first, *clock))
    if names:
        _against_place(found, names, report)
    odd, clock = pressure_and_field.turning_field(found)
    report.oddities += odd
    if clock is not None and clock[1] < TOLD_S:
        _say_clock(report, Clock("magnetometer", "rates", *clock), found.triads["magnetometer"].time_s)


def _against_accelerometer(found: Sources, name: str, report: Report) -> None:
    sensed = found.triads.get("accelerometer")
    record = tracks.tracks(found)[name]
    if sensed is None:
        return
    position = tracks.position_of(record)
    seen = best_comparison(record.time_s, position, sensed.time_s, sensed.measured_sensor)
    if seen is not None and seen.misfit < FITS:
        already = any(f.source == "accelerometer" for f in report.oddities)
        report.oddities += [] if already else inertial.against_track(found, name, seen)
        if seen.lag_sd_s < TOLD_S:
            _say_clock(report, Clock(name, "accelerometer", seen.lag_s, seen.lag_sd_s), record.time_s)
    force = track_force(record.time_s, position, 8.0)
    if force is not None and not any(f.source == "accelerometer" and "drag" in f.what for f in report.oddities):
        report.oddities += inertial.entry_axis(found, force)
    if force is not None and not report.oddities:
        report.oddities += inertial.turned_force(found, force)
    if force is not None and not report.oddities:
        report.oddities += tracks.attitude_and_force(found, force)


def _say_clock(report: Report, clock: Clock, time_s: FloatArray) -> None:
    report.clocks.append(clock)
    if abs(clock.late_s) > max(CLOCK_SD * clock.sd_s, CLOCK_S):
        which = "later than" if clock.late_s > 0 else "earlier than"
        words = f"its times are {which} the {clock.against}'s by {abs(clock.late_s):.3f} +- {clock.sd_s:.3f} s"
        hint = f"; if it is the one that is wrong: time.offset_s = {-clock.late_s:.3f}"
        report.oddities.append(Finding(clock.source, words + hint, float(time_s[0]), float(time_s[-1])))


def _against_place(found: Sources, names: list[str], report: Report) -> None:
    """Barometers and the magnetometer's size against the first track that is not in doubt."""
    record = tracks.tracks(found)[next((n for n in names if n in found.gnss), names[0])]
    position = tracks.position_of(record)
    whole = np.isfinite(position).all(axis=1)
    t, position = record.time_s[whole], position[whole]
    height = earth.geodetic_from_ecef(position)[2]
    for name, barometer in found.barometers.items():
        report.oddities += pressure_and_field.barometer_unit(found, name, barometer, t, height)
    report.oddities += pressure_and_field.field_size(found, t, position)


WIDE = 160  # of a log file: a table need not be squeezed there
console = Console(soft_wrap=True, width=None if sys.stdout.isatty() else WIDE)
LONGEST_NAME = 28  # that leaves room for the rest of a table on 80 columns


def check(folder: Path, as_json: bool) -> None:
    """Print what a flight folder holds, what is odd about it and what is refused; leave with its exit code."""
    report = check_folder(folder)
    if as_json:
        sys.stdout.write(json.dumps(report.as_json(), indent=2, allow_nan=False) + "\n")
    else:
        print_report(report)
    if report.exit_code:
        sys.exit(report.exit_code)


def print_report(report: Report) -> None:
    """Tables and lines for a reader."""
    if report.facts:
        table = Table(title="Sensors")
        for name in ("source", "rows", "from s", "to s", "rate Hz", "missing", "file"):
            left = name in ("source", "file")
            # names stay whole on one line, as two radars may differ in their ends; files are folded
            whole = name != "file" and max(len(f.source) for f in report.facts) <= LONGEST_NAME
            table.add_column(name, justify="left" if left else "right", overflow="fold", no_wrap=whole)
        for f in report.facts:
            span = (f"{f.start_s:.3f}", f"{f.end_s:.3f}", f"{f.rate_hz:.4g}")
            table.add_row(escape(f.source), str(f.rows), *span, str(f.missing), escape(f.file))
        console.print(table)
    _lines("[yellow]found[/]", report.findings)
    _lines("[red]odd[/]  ", report.oddities)
    for clock in report.clocks:
        late = f"{clock.late_s:+.3f} +- {clock.sd_s:.3f} s late against {clock.against}"
        console.print(f"clock {escape(clock.source)}: {escape(late)}", highlight=False)
    for words in report.fill_in:
        console.print(f"[cyan]to fill in[/] {escape(words)}", highlight=False)
    for words in report.refused:
        console.print(f"[red]refused[/] {escape(words)}", highlight=False)
    console.print(_summary(report))


def _lines(mark: str, findings: list[Finding]) -> None:
    for finding in findings:
        console.print(f"{mark} {escape(str(finding))}", highlight=False)


def _summary(report: Report) -> str:
    counts = (
        (len(report.findings), "findings", "finding"),
        (len(report.oddities), "oddities", "oddity"),
        (len(report.fill_in), "values still to fill in", "value still to fill in"),
        (len(report.refused), "refused", "refused"),
    )
    said = ", ".join(f"{count} {what if count > 1 else one}" for count, what, one in counts if count)
    return said or "nothing found that would be in the way"
