"""What should an analyst know of a flight folder before running it? Facts, findings, cross-checks and refusals.

Facts: rows, span, rate of every table. Findings: what the readers saw (gaps, frozen, saturated, repeated, unordered
rows). Cross-checks: sensors against each other and against physics, in units, axes, time tags; a remark is made only
where the data prove it. A sensor with a remark is not compared further, so that one fault makes one remark. Each
finding, remark and refusal has a stable code.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.markup import escape
from rich.table import Table

from flightmodel import earth
from flightmodel.checks import FloatArray, GateError, Issue
from flightmodel.config import FILL_IN, read_toml
from flightmodel.film import NO_PICTURE, Frames, film_fault, image_fault
from flightmodel.flightfolder import Sources, assumed_errors, read_sources
from flightmodel.gate import FROZEN_S
from flightmodel.tabular import Tabular
from flightmodel.telemetry import GnssRecord, RadarRecord
from flightmodel.vehicle import Vehicle, vehicle_from_toml, vehicle_path
from postflight.checks import inertial, pressure_and_field, tracks
from postflight.checks.track_force import best_comparison, bias_of, track_force
from postflight.checks.units_and_axes import TimeBias, clock_remarks
from postflight.checks.vehicle_check import vehicle_issues
from postflight.intake.flight_form import placeholders
from postflight.methods import Inputs, runs_alone
from postflight.streams import write_out
from postflight.terminal import EXIT_CHECK_FAILED, few_of_each, terminal

_FORCE_WIDTH_S = 8.0  # the second derivative of a radar track of 5 m at 10 Hz is then good to 0.25 m/s2
WIDE = 160  # of a log file: a table need not be squeezed there
_FROZEN_FRAMES = 3  # two may be those of a changed frame rate
_LONGEST_NAME = 28  # that leaves room for the rest of a table on 80 columns
console = terminal(width=None if sys.stdout.isatty() else WIDE)


@dataclass(frozen=True)
class Fact:
    """Summary of one table: rows, first and last time, typical samples per second, rows with a missing value."""

    source: str
    file: str
    rows: int
    start_s: float
    end_s: float
    rate_hz: float
    missing: int


@dataclass(repr=False)
class Report(Tabular):
    """Result of a check; ``exit_code`` is the command's.

    ``inputs`` are those of the flight, ``alone`` what commands without flight.toml have data for.
    """

    facts: list[Fact] = field(default_factory=list)
    findings: list[Issue] = field(default_factory=list)
    cross_checks: list[Issue] = field(default_factory=list)
    time_biases: list[TimeBias] = field(default_factory=list)
    assumed: dict[str, dict[str, float]] = field(default_factory=dict)
    fill_in: list[str] = field(default_factory=list)
    refused: list[Issue] = field(default_factory=list)
    inputs: Inputs | None = None
    alone: dict[str, Inputs] = field(default_factory=dict)
    exit_code: int = 0

    def to_frame(self) -> pd.DataFrame:
        """Return findings, suspicious cross-checks, placeholders and refusals: one row each, with its code."""
        seen = [("found", f) for f in self.findings] + [("suspicious", f) for f in self.cross_checks]
        rows = [(kind, f.code, f.source, f.what, f.start_s, f.end_s) for kind, f in seen]
        rows += [("to fill in", "placeholder", "", words, np.nan, np.nan) for words in self.fill_in]
        rows += [("refused", fault.code, "", str(fault), np.nan, np.nan) for fault in self.refused]
        return pd.DataFrame(rows, columns=["kind", "code", "source", "message", "start_s", "end_s"])

    def _about(self) -> str:
        """Number of findings of each kind, in words."""
        counts = (
            (len(self.findings), "findings", "finding"),
            (len(self.cross_checks), "suspicious cross-checks", "suspicious cross-check"),
            (len(self.fill_in), "values still to fill in", "value still to fill in"),
            (len(self.refused), "refused", "refused"),
        )
        stated = ", ".join(f"{count} {what if count > 1 else one}" for count, what, one in counts if count)
        return stated or "no findings; all can be read"

    @property
    def can_run(self) -> str:
        """Methods that can run, and the missing inputs of the others."""
        words = ["nothing before the refused inputs are corrected"] if self.refused else []
        words += ["nothing before the placeholders are filled in"] if self.fill_in and not self.refused else []
        if self.inputs is not None and not words:
            words.append(str(self.inputs))
        return "; ".join([*words, *(f"{inputs.names} ({command})" for command, inputs in self.alone.items())])

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON; missing times become null."""
        biases = self.time_biases
        return {
            "can_run": self.can_run,
            "facts": _rows(self.facts),
            "findings": _rows(self.findings),
            "cross_checks": _rows(self.cross_checks),
            "oddities": _rows(self.cross_checks),  # the former name, until the next release
            "clocks": [row | {"worth_a_look": b.is_worth_a_look} for row, b in zip(_rows(biases), biases, strict=True)],
            "assumed": self.assumed,
            "fill_in": self.fill_in,
            "refused": self.refused,
            "refused_codes": [fault.code for fault in self.refused],
            "exit_code": self.exit_code,
        }


def _rows(items: Iterable[Any]) -> list[dict[str, Any]]:
    """Dataclasses and issues as JSON objects."""
    rows = [item.as_row() if isinstance(item, Issue) else asdict(item) for item in items]
    return [{k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()} for row in rows]


def check_folder(folder: Path) -> Report:
    """Read a flight folder as far as it can be read and cross-check it; nothing is written.

    Parameters
    ----------
    folder : Path
        With a flight.toml.

    Returns
    -------
    Report
        Refusals are in it and never raised.
    """
    report = Report()
    if not (folder / "flight.toml").exists() and _runs_alone(report, folder, None):
        return report
    try:
        found = read_sources(folder, needs_path=False)
    except GateError as fault:
        _refuse(report, folder, [*fault.faults, *_vehicle_faults(folder)], fault.exit_code)
        report.findings = _not_used(folder)
        return report
    gate = found.gate
    if gate.config or gate.faults:
        _refuse(report, folder, [*gate.config, *gate.faults], 3 if gate.faults else 2)
    report.assumed = assumed_errors(found.spec, found.radars, found.gnss)
    report.facts = _facts(found) + _loads(report, found)
    report.inputs = Inputs.of(found)
    if found.vehicle is not None and "misalignment" in report.inputs.missing():
        _runs_alone(report, folder, found.vehicle.source)
    report.findings = _not_used(folder) + sorted(
        gate.findings, key=lambda f: (f.source, np.nan_to_num(f.start_s, nan=-np.inf))
    )
    with np.errstate(invalid="ignore"):
        _cross_check(found, report)
    return report


def _runs_alone(report: Report, folder: Path, vehicle: Path | None) -> bool:
    """Whether a method runs by tables and pictures that flight.toml does not name; the only vehicle file by default."""
    found = [vehicle] if vehicle else [*folder.glob("*.toml"), *folder.glob("vehicle/*.toml")]
    if len(found) == 1:
        report.alone = runs_alone(folder, found[0], _named(folder) or set())
    return bool(report.alone)


def _named(folder: Path) -> set[str] | None:
    """All strings of flight.toml; None if it cannot be read."""
    try:
        return set(_texts(read_toml(folder / "flight.toml")))
    except GateError:
        return None


def _not_used(folder: Path) -> list[Issue]:
    """Tables below ``telemetry/`` that flight.toml does not name, so that no command reads them."""
    named = _named(folder)
    if named is None:
        return []
    there = sorted(path.relative_to(folder).as_posix() for path in (folder / "telemetry").glob("*.csv"))
    words = "no table of flight.toml reads it; declare its columns there, or remove it"
    return [Issue(words, "file-not-used", name) for name in there if name not in named]


def _texts(value: Any) -> Iterator[str]:
    """Every text in the tables of a TOML file."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def _vehicle_faults(folder: Path) -> list[Issue]:
    """Faults of the vehicle file, which are not reached if flight.toml has faults of its own."""
    try:
        named = read_toml(folder / "flight.toml").get("vehicle")
    except GateError:
        return []
    if not isinstance(named, str) or not named.endswith(".toml"):
        return []
    try:
        vehicle_from_toml(vehicle_path(named, folder))
    except GateError as fault:
        return [Issue(f"vehicle: {words}", words.code) for words in fault.faults]
    return []


def _refuse(report: Report, folder: Path, faults: Sequence[Issue], code: int) -> None:
    still_open = placeholders(folder)
    report.fill_in = [f"{path}: key '{key}' {FILL_IN}" for path, keys in still_open.items() for key in keys]
    report.refused = [fault for fault in faults if FILL_IN not in fault]
    report.exit_code = code


def _loads(report: Report, found: Sources) -> list[Fact]:
    """Summary of the table of loads; its faults are added to the refusals."""
    if found.loads is None or found.vehicle is None:
        return []
    from postflight.loads_table import read_table_of_loads

    table, entry = found.loads, found.loads.stated
    try:
        loads, _, stated = read_table_of_loads(table.path, found.vehicle, table.columns, entry, table.time_s)
    except GateError as fault:
        _refuse(report, found.gate.folder, [*report.refused, *fault.faults], report.exit_code or fault.exit_code)
        return []
    left = {key: sd for key, sd in report.assumed.pop("loads", {}).items() if key not in stated}
    report.assumed |= {"loads": left} if left else {}
    t = loads.time_s
    return [Fact("loads", entry.file, len(t), float(t[0]), float(t[-1]), float(1.0 / np.median(np.diff(t))), 0)]


def _facts(found: Sources) -> list[Fact]:
    spec = found.spec
    tables: list[tuple[str, str, FloatArray, FloatArray]] = []
    for name, triad in found.triads.items():
        channels = triad.measured_sensor[:, np.isfinite(triad.measured_sensor).any(axis=0)]
        tables.append((name, getattr(spec.sensors, name).file, triad.time_s, channels))
    if found.sun is not None and spec.sensors.sun is not None:
        some = np.isfinite(found.sun.az_el_head_rad).any(axis=(1, 2))
        tables.append(("sun", spec.sensors.sun.file, found.sun.time_s, np.where(some, 0.0, np.nan)[:, None]))
    for name, radar in found.radars.items():
        measured = radar.range_az_el[:, np.isfinite(radar.range_az_el).any(axis=0)]
        tables.append((name, spec.radars[name].file, radar.time_s, measured))
    for name, fixes in found.gnss.items():
        measured = fixes.position_ecef_m if fixes.has_positions else fixes.velocity_ecef_mps
        tables.append((name, spec.gnss[name].file, fixes.time_s, measured))
    for name, barometer in found.barometers.items():
        tables.append((name, spec.barometers[name].file, barometer.time_s, barometer.height_m[:, None]))
    for table, name in spec.film_names.items():
        if name in found.films:
            time_s = found.films[name].time_s
            tables.append((table, spec.films[table].file, time_s, time_s[:, None]))
    out = []
    for name, file, t, values in tables:
        rate = float(1.0 / np.median(np.diff(t))) if len(t) > 1 else np.nan
        missing = int((~np.isfinite(values).all(axis=1)).sum())
        out.append(Fact(name, file, len(t), float(t[0]), float(t[-1]), rate, missing))
    return out


def _cross_check(found: Sources, report: Report) -> None:
    """Compare sensors with each other and with physics."""
    # an entry's one channel has neither a size nor axes to compare
    whole = {name: t for name, t in found.triads.items() if np.isfinite(t.measured_sensor).any(axis=0).all()}
    found, remarks = replace(found, triads=whole), report.cross_checks
    remarks += (
        inertial.sparse(found)
        + tracks.outside_time(found)
        + inertial.at_rest(found)
        + inertial.lever(found)
        + inertial.place(found)
    )
    for radar in found.radars.values():
        remarks += tracks.free_fall(found, radar)
    for fixes in found.gnss.values():
        remarks += tracks.receiver_velocity(found, fixes)
    suspicious = {f.source for f in remarks}
    trackers = {name: record for name, record in tracks.tracks(found).items() if name not in suspicious}
    names = list(trackers)
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            apart, bias = tracks.tracker_pair(trackers, first, second, found.spec.body)
            remarks += apart
            _keep_sharp(report, bias)
    for name, record in trackers.items():
        _against_accelerometer(found, name, record, report)
    strapdown = found.spec.motion.model == "strapdown"
    swings = inertial.oscillation_of(found.triads if strapdown else {}, found.vehicle)
    remarks += [f for f in swings.remarks if not any(map(_doubts_accelerometer, remarks))]
    _keep_sharp(report, swings.bias)
    rotation, lag = pressure_and_field.field_rotation(found)
    if lag is not None:
        _keep_sharp(report, TimeBias("magnetometer", "rates", *lag))
    remarks += clock_remarks(report.time_biases, list(found.triads))
    for record in trackers.values():
        _axes_and_attitude(found, record, report)
    if trackers:
        _against_place(found, trackers, report)
    remarks += rotation
    # last: gyros and attitude are only compared where nothing else is suspicious
    remarks += benchmark_frame(found)
    remarks += vehicle_issues(found.vehicle) if found.vehicle is not None else []
    report.findings += text_in_films(found) + frozen_films(found)


def _doubts_accelerometer(remark: Issue) -> bool:
    """Whether a remark questions the accelerometer's unit, scale or axes."""
    return remark.source == "accelerometer" and remark.code in ("unit-suspect", "accelerometer-scale", "axes-suspect")


def _against_accelerometer(found: Sources, name: str, record: RadarRecord | GnssRecord, report: Report) -> None:
    """Compare scale and time tags of the accelerometer with one track's specific force."""
    sensed, remarks = found.triads.get("accelerometer"), report.cross_checks
    if sensed is None:
        return
    planet = found.spec.body
    seen = best_comparison(
        record.time_s, tracks.position_of(record, planet), sensed.time_s, sensed.measured_sensor, planet
    )
    bias = bias_of(name, seen)
    if seen is not None and bias is not None:
        if not any(f.source == "accelerometer" for f in remarks):
            remarks += inertial.against_track(found, name, seen)
        _keep_sharp(report, bias)


def _axes_and_attitude(found: Sources, record: RadarRecord | GnssRecord, report: Report) -> None:
    """Compare axes and attitude of the inertial sensors with one track's specific force."""
    remarks = report.cross_checks
    force = track_force(record.time_s, tracks.position_of(record, found.spec.body), _FORCE_WIDTH_S, found.spec.body)
    if force is None or "accelerometer" not in found.triads:
        return
    if not any(f.source == "accelerometer" and f.code == "axes-suspect" for f in remarks):
        remarks += inertial.entry_axis(found, force)
    if not remarks:
        remarks += inertial.gyro_axes(found, force)
    if not remarks:
        remarks += inertial.attitude_prior(found, force)


def _keep_sharp(report: Report, bias: TimeBias | None) -> TimeBias | None:
    """Add a time bias to the report if its standard deviation is small enough, else return None."""
    if bias is None or not bias.is_sharp:
        return None
    report.time_biases.append(bias)
    return bias


def _against_place(found: Sources, trackers: dict[str, RadarRecord | GnssRecord], report: Report) -> None:
    """Compare barometers and the magnetometer's magnitude with the first track, preferably a receiver's."""
    record = trackers[next((name for name in trackers if name in found.gnss), next(iter(trackers)))]
    position = tracks.position_of(record, found.spec.body)
    whole = np.isfinite(position).all(axis=1)
    t, position = record.time_s[whole], position[whole]
    height = earth.geodetic_from_ecef(position, found.spec.body)[2]
    for barometer in found.barometers.values():
        report.cross_checks += pressure_and_field.barometer_unit(found, barometer, t, height)
    report.cross_checks += pressure_and_field.field_size(found, t, position)


# the command


def check(folder: Path, as_json: bool, strict: bool = False) -> None:
    """Print what a flight folder holds, what is suspicious and what is refused; leave with its exit code.

    With ``strict`` a suspicious cross-check makes it 5 where nothing is refused.
    """
    report = check_folder(folder)
    if strict and report.cross_checks:
        report.exit_code = report.exit_code or EXIT_CHECK_FAILED
    if as_json:
        write_out(json.dumps(report.as_json(), indent=2, allow_nan=False) + "\n")
    else:
        print_report(report)
    if report.exit_code:
        sys.exit(report.exit_code)


def print_report(report: Report) -> None:
    """Print tables and lines for a reader, codes in brackets; first what can run."""
    console.print(f"can run: {escape(report.can_run)}", highlight=False)
    if report.facts:
        table = Table(title="Sensors")
        for name in ("source", "rows", "from s", "to s", "rate Hz", "missing", "file"):
            left = name in ("source", "file")
            # names stay whole on one line, as two radars may differ in their ends; files are folded
            whole = name != "file" and max(len(f.source) for f in report.facts) <= _LONGEST_NAME
            table.add_column(name, justify="left" if left else "right", overflow="fold", no_wrap=whole)
        for f in report.facts:
            span = (f"{f.start_s:.3f}", f"{f.end_s:.3f}", f"{f.rate_hz:.4g}")
            table.add_row(escape(f.source), str(f.rows), *span, str(f.missing), escape(f.file))
        console.print(table)
    for words, code in few_of_each(report.findings):
        console.coded("[yellow]found[/]", words, code)
    for remark in report.cross_checks:
        console.coded("[red]suspicious[/]", remark.line, remark.code)
    for bias in report.time_biases:
        mark = "[yellow]worth a look[/] time bias" if bias.is_worth_a_look else "time bias"
        console.coded(mark, f"{bias.source}: {bias.late_s:+.3f} +/- {bias.sd_s:.3f} s against {bias.against}")
    for section, sizes in report.assumed.items():
        keys = ", ".join(f"{key} = {size:g}" for key, size in sizes.items())
        console.coded("[yellow]assumed[/]", f"[{section}] {keys}: not stated in flight.toml", "default-assumed")
    for open_key in report.fill_in:
        console.coded("[cyan]to fill in[/]", open_key, "placeholder")
    for fault in report.refused:
        console.coded("[red]refused[/]", fault, fault.code)
    console.print(report._about())


# a camera's benchmark frame, tried as a run would use it: seconds where the lens is not calibrated


def benchmark_frame(found: Sources) -> list[Issue]:
    """Check that every camera's benchmark frame orients it.

    Returns
    -------
    list of Issue
        Why it does not, with the code that a run would refuse the film with; or ``features-not-found`` (or the code of
        the failed orientation) where another way had to be taken than by the features that the vehicle file states.
    """
    films = {table: found.films[name] for table, name in found.spec.film_names.items() if name in found.films}
    return [finding for table, frames in films.items() for finding in _tried(table, frames, found.vehicle)]


def _tried(source: str, frames: Frames, vehicle: Vehicle | None) -> list[Issue]:
    if vehicle is None or not len(frames.time_s):
        return []
    from postflight.filming import orient_on_film  # which a folder without video needs not wait for

    at = float(frames.time_s[frames.benchmark])
    try:
        oriented = orient_on_film(frames, vehicle)
    except GateError as fault:
        return [Issue(str(fault), fault.codes[0], source, at, at)]
    if oriented.stated_refused:
        words = f"{oriented.stated_refused}; a run goes by the edge and the shell's texture"
        return [Issue(words, oriented.stated_refused.code, source, at, at)]
    return []


def text_in_films(found: Sources) -> list[Issue]:
    """Find text burnt into films; it is masked in the camera's measurements."""
    out = []
    for name, frames in found.films.items():
        hidden = frames.burnt_in
        if hidden is not None:
            share = f"{100.0 * np.mean(hidden):.0f} % of the picture"
            words = f"text burnt into the film, or dead lines of its detector: {share} is left out"
            out.append(Issue(words, "text-burnt-in", name, float(frames.time_s[0]), float(frames.time_s[-1])))
    return out


def frozen_films(found: Sources) -> list[Issue]:
    """Find bit-identical repeated pictures, which noise rules out: ``frame-frozen`` for each stretch."""
    return [one for name, film in found.films.items() for one in _repeats(name, film)]


def _repeats(name: str, film: Frames) -> list[Issue]:
    filed_px = film.filed_px or film.camera.size_px
    last = 0 if film.numbers is None else int(film.numbers[-1])
    fault = (lambda path: film_fault(path, filed_px, last)) if last else (lambda path: image_fault(path, filed_px))
    if not len(film.time_s) or any(map(fault, film.paths)):
        return []
    out, first, before = [], 0, NO_PICTURE
    for k, now in enumerate(chain(film.pictures(), [NO_PICTURE])):
        if k and now.size and np.array_equal(now, before):
            continue
        start, end = float(film.time_s[first]), float(film.time_s[max(k - 1, 0)])
        if k - first >= _FROZEN_FRAMES and end - start >= FROZEN_S:
            words = f"{k - first} frames repeat one picture: the film stood still there; leave them out (use_s)"
            out.append(Issue(words, "frame-frozen", name, start, end))
        first, before = k, now
    return out
