"""What does a run write? Tables, headers, summary in ``runs/<utc>-<hash8>[-<name>]/``, complete or not at all.

The hash covers inputs, settings and version, so equal runs carry equal hashes, and the same inputs give the same bytes
in every file but ``run.json``, which alone holds times and machine (and the report that shows the run's name).
``inputs/`` keeps flight.toml and the vehicle file as they were read.

``bet_header.json`` states what the numbers of ``bet.csv`` refer to (epoch, frames, vehicle, atmosphere, sensors,
settings, version); events and peaks are read from that table, residual statistics and covariances from the
reconstruction.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import json
import platform
import re
import shutil
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import asdict, fields
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import events
from flightmodel.checks import Check, DivergenceError, FloatArray, GateError, Issue
from flightmodel.deflection import QUANTILE_COLUMNS
from flightmodel.earth import WGS84, name_of
from flightmodel.files import PARTIAL, abandoned, open_file, partial_path, write_file, writing
from flightmodel.tables import column_about
from flightmodel.telemetry import Telemetry
from postflight.deflections import Deflections, headline
from postflight.methods import NO_VIDEO
from postflight.reconstruction import AttitudeCheck, Reconstruction, attitude_table
from recon.measurements import component_unit

DIGITS = "%.10g"
_COPY = "copy the flight folder to where you may write"
_ATTEMPTS = 100  # at the place that equal runs of other processes take in the same second
FACTS = "run.json"
INPUTS = "inputs"  # folder of flight.toml and the vehicle file as they were read
_FORMAT = 1
_ROWS = 500  # of a table, made text at a time
_SMOOTH_CAMERA = "camera_smooth"
_COVARIANCE_RATE_HZ = 1.0
_FRAMES = {
    "eci": "equal to ECEF at time zero (epoch_utc), then fixed in space",
    "ecef": "WGS-84, Earth-fixed; velocities relative to the rotating Earth",
    "ned": "north, east, down at the vehicle, geodetic",
    "body": "of the centerbody: x forward out of the nose; datum is the nose",
    "rotation": "q_ecef_body is scalar first and takes body components to ECEF; Euler 3-2-1 from NED: yaw about down, "
    "then pitch, then roll; small rotations are right-hand vectors in body axes",
    "rates": "p, q, r: of the body relative to inertial space, body components",
    "flow": "with (u, v, w) the velocity relative to the air in body axes: alpha = atan2(w, u), beta = asin(v / V), "
    "total alpha = atan2(hypot(v, w), u); clock: LV clocking angle of (v, w)",
    "wind": "velocity of the air mass, north and east",
    "force": "specific force in body axes; C_A along -x, C_N the size of the normal force, reference area below",
}
_DEGREES = {"rad": "deg", "rad/s": "deg/s"}
_STATISTICS = ("source", "component", "unit", "count", "edited", "mean", "sd", "rms_normalised", "lag1", "nis")
# peak of the size of which column of bet.csv
_PEAKS = {
    "dynamic pressure": "dynamic_pressure_pa",
    "Mach number": "mach",
    "airspeed": "airspeed_mps",
    "axial deceleration": "ax_cg_mps2",
    "total angle of attack in the pulse": "alpha_total_wind_deg",
    "altitude": "alt_m",
}
_EVENT_COLUMNS = ("alt_m", "speed_ground_mps", "flight_path_deg", "mach", "dynamic_pressure_pa", "alpha_total_wind_deg")


class Results:
    """Folder that tables and JSON objects are written to."""

    def __init__(self, path: Path) -> None:
        """Take the folder, which need not exist yet."""
        self.path = path

    def write_csv(self, name: str, table: pd.DataFrame) -> None:
        """Write a table."""
        written = plain_text(table)
        with (self.path / name).open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(written)
            numbers = written.shape[1] > 1 and bool((written.dtypes == np.float64).all())
            for first in range(0, len(written), _ROWS):  # as text a trajectory would be 40 MB
                rows = written[first : first + _ROWS]
                if numbers:
                    file.write(_lines(rows.to_numpy()))
                else:
                    writer.writerows(zip(*(_cells(column) for _, column in rows.items()), strict=True))

    def write_json(self, name: str, value: Any) -> None:
        """Write one JSON object; NaN becomes null."""
        text = json.dumps(_no_nan(value), indent=2, allow_nan=False)
        (self.path / name).write_text(text + "\n")


class RunFolder(Results):
    """A run folder under construction: use as a context; it is renamed into place when the block ends well."""

    def __init__(
        self,
        flight_folder: Path,
        telemetry: Telemetry,
        settings: dict[str, Any],
        name: str = "",
        as_read: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """Take what identifies the run, the ``name`` it is given, and the files that it keeps as they were read."""
        self.hash8 = run_hash(telemetry.hashes, settings, version("postflight"))
        self.name = name
        self.as_read = as_read
        self.finished: datetime | None = None
        self.left_out: list[Issue] = []
        self.settings = settings
        self.telemetry = telemetry
        self.parent = flight_folder / "runs"
        super().__init__(Path())

    def __enter__(self) -> RunFolder:
        """Make the partial folder beside the final one."""
        with writing(self.parent, _COPY):
            self.parent.mkdir(exist_ok=True)
            for left in abandoned(self.parent):
                shutil.rmtree(left, ignore_errors=True)  # refuses what is no folder, or a link to one
            self.path = partial_path(self.parent / "run")
            (self.path / "figures").mkdir(parents=True)
            for place, content in self.as_read.items():
                write_file(self.path / INPUTS / place, content)
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, _: object) -> None:
        """Rename if complete or if answers are kept; remove otherwise, even if the renaming itself is interrupted."""
        partial, kept = self.path, self.finished is not None
        try:
            with writing(self.parent, _COPY):
                if kind is None or kept:
                    self._finish()
                if isinstance(fault, OSError):
                    raise fault
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            if kind is not None and not kept:
                with contextlib.suppress(OSError):  # of other runs
                    self.parent.rmdir()

    def keep(self, summary: dict[str, Any]) -> None:
        """Write the summary and ``run.json``: from here on the folder stays, whatever ends the command."""
        missing = [*summary.get("missing", ()), *self.left_out]
        self.write_json("summary.json", summary | {"missing": missing})
        self.write_facts()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Run a step on which no answer depends; if it is refused, record that in `left_out` and go on."""
        try:
            yield
        except (GateError, DivergenceError) as fault:
            self.left_out.append(Issue(f"{name}: {fault}", fault.codes[0]))

    def write_facts(self) -> datetime:
        """Write ``run.json`` and return the run's time."""
        now = datetime.now(UTC)
        facts = {
            **({"name": self.name} if self.name else {}),
            "finished_utc": now.isoformat(timespec="seconds"),
            "version": version("postflight"),
            "python": platform.python_version(),
            "packages": {name: version(name) for name in ("numpy", "scipy", "numba", "filterpy", "trimesh")},
            "settings": self.settings,
            "inputs_sha256": self.telemetry.hashes,
        }
        self.write_json(FACTS, facts)
        self.finished = now
        return now

    def _finish(self) -> None:
        now = self.finished or self.write_facts()
        for half in self.path.rglob(f".{PARTIAL}-*"):  # of a process that was stopped
            half.unlink(missing_ok=True)
        label = f"-{self.name}" if self.name else ""
        final = self.parent / f"{now.strftime('%Y%m%dT%H%M%SZ')}-{self.hash8}{label}"
        for _ in range(_ATTEMPTS):
            shutil.rmtree(final, ignore_errors=True)
            try:
                self.path.rename(final)
            except OSError as fault:
                if fault.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                continue
            self.path = final
            return
        raise GateError(f"{final}: other processes write the same run; run it again", "cannot-write")


# what a spreadsheet takes for a formula; a name such as -x, of letters and digits, computes nothing
_FORMULA = re.compile(r"[=@\t\r＝＠]|[+\-＋－].*[^A-Za-z0-9_+-]", re.DOTALL)


def plain_text(table: pd.DataFrame) -> pd.DataFrame:
    """Table in which an apostrophe stands before every text that a spreadsheet would execute."""
    texts = [name for name in table if not pd.api.types.is_numeric_dtype(table[name])]

    def neutral(cell: Any) -> Any:
        return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell

    return table.assign(**{name: table[name].map(neutral) for name in texts})


def _lines(values: FloatArray) -> str:
    """Rows of numbers as `_cells` and `csv` write them, in one operation, which takes less than half the time."""
    line = ",".join([DIGITS] * values.shape[1]) + "\n"
    return (line * len(values) % tuple(values.ravel().tolist())).replace("nan", "")


def _cells(column: pd.Series) -> list[Any]:
    """Cells of a column as `DataFrame.to_csv` with a float format writes them, in a third of the time."""
    if column.dtype == np.float64:
        values = column.to_numpy()
        return ["" if missing else DIGITS % x for x, missing in zip(values.tolist(), np.isnan(values), strict=True)]
    cells: list[Any] = column.astype(object).where(column.notna(), "").tolist()
    return cells


def read_csv(path: Path) -> pd.DataFrame:
    """Read a table of a run back."""
    with open_file(path) as file:
        return pd.read_csv(file)


def run_hash(inputs_sha256: dict[str, str], settings: dict[str, Any], made_by: str) -> str:
    """Eight hexadecimal digits of inputs, settings and version, which equal runs share."""
    facts = json.dumps([inputs_sha256, settings, made_by], sort_keys=True)
    return hashlib.sha256(facts.encode()).hexdigest()[:8]


def _no_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _no_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_no_nan(v) for v in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value


def method_summary(answers: Deflections) -> dict[str, dict[str, Any]]:
    """Each method's row of `Deflections.to_frame` by the names of ``summary.json``, with the code of its reason."""
    out: dict[str, dict[str, Any]] = {}
    cycle = answers.cycle_s
    for row in answers.to_frame().to_dict(orient="records"):
        method, answer = row["method"], {"deflection_deg": row["theta_deg"], "sd_deg": row["theta_sd_deg"]}
        if method in answers.histories:
            quantiles = [row[name] for name in QUANTILE_COLUMNS]
            answer |= {
                "quantiles_deg": quantiles if np.isfinite(quantiles).all() else None,
                "largest_deg": row["largest_deg"],
                "largest_at_s": row["largest_t_s"],
                "assumptions": answers[method].assumptions,
            }
            if cycle is not None:
                answer |= {"mean_deg": row["mean_deg"], "mean_sd_deg": row["mean_sd_deg"], "mean_over_s": list(cycle)}
        if row["reason"]:
            code = answers.refused[method].code if method in answers.refused else "no-answer"
            answer |= {"deflection_deg": None, "sd_deg": None, "reason": row["reason"], "code": code}
        if method in answers.refused:
            answer["applicable"] = code != NO_VIDEO
        out[method] = answer
    return out


def best_in_words(answers: Deflections) -> str:
    """Return the headline of the best answer; empty where no method answers at peak q."""
    if answers.best is None:
        return ""
    row = method_summary(answers)[answers.best]
    return f"{headline(row, at='at peak q' if answers.knows_peak else 'there')} ({answers.best})"


def write_reconstruction(run: RunFolder, flight: Reconstruction, answers: Deflections | None = None) -> pd.DataFrame:
    """Write trajectory, covariance, residuals, checks, sensor errors, events, air, findings; return the events.

    The checks of the deflection are among them where its ``answers`` are given.
    """
    bet, table = flight.solution, flight.table
    run.write_csv("bet.csv", table)
    run.write_json("bet_header.json", header(flight))
    slow = slow_covariance(flight)
    np.savez_compressed(run.path / "covariance.npz", t_s=slow["t_s"], covariance=slow["covariance"])
    run.write_csv("peaks.csv", peak_table(flight, table))
    run.write_csv("residual_statistics.csv", in_degrees(residual_statistics(flight), "mean", "sd"))
    run.write_csv("residuals.csv", _residuals(bet.residuals))
    if len(bet.held_out):
        run.write_csv("withheld.csv", _residuals(bet.held_out))
    write_all_checks(run, flight, answers)
    run.write_csv("sensor_errors.csv", in_degrees(bet.sensor_errors, "prior_sd", "estimate", "sd"))
    event_rows = event_table(flight, table)
    run.write_csv("events.csv", event_rows)
    if flight.as_flown is not None:
        run.write_csv("air_profile.csv", flight.as_flown.profile)
        run.write_csv("drag_ratio.csv", flight.as_flown.drag)
        run.write_csv("air_parameters.csv", flight.as_flown.parameters)
    if flight.density is not None:
        run.write_csv("density_by_drag.csv", flight.density)
    if flight.attitude is not None and flight.attitude.comparison is not None:
        run.write_csv("attitude_check.csv", attitude_table(flight.attitude, bet))
    findings = [f.as_row() for f in (*flight.findings, *without_attitude(flight))]
    run.write_csv("findings.csv", pd.DataFrame(findings, columns=["source", "what", "start_s", "end_s", "code"]))
    return event_rows


def without_attitude(flight: Reconstruction) -> tuple[Issue, ...]:
    """Finding on the empty columns of a flight without inertial sensors; none with them."""
    if flight.has_attitude:
        return ()
    words = "no inertial sensors carried the attitude: attitude, rates and flow angles are empty in bet.csv"
    return (Issue(words, "attitude-missing", "attitude"),)


def write_all_checks(run: RunFolder, flight: Reconstruction, answers: Deflections | None) -> None:
    """Write the checks of a trajectory and its deflections, also as version 0.1 named them."""
    of_deflection = () if answers is None else answers.consistency_checks
    checks = write_checks(run, (*flight.consistency_checks, *of_deflection))
    # the table's name and columns of version 0.1, for scripts that read it; to go with version 0.3
    run.write_csv(
        "verdicts.csv",
        checks.drop(columns=["code", "source", "component", "symptom"]).rename(columns={"remark": "words"}),
    )


def write_checks(run: Results, checks: Iterable[Check]) -> pd.DataFrame:
    """Write ``consistency_checks.csv``, and return it."""
    table = pd.DataFrame([vars(v) for v in checks], columns=[f.name for f in fields(Check)])
    run.write_csv("consistency_checks.csv", table)
    return table


def write_answers(run: Results, answers: Deflections) -> None:
    """Write a table for each method that answered, and those of the fusion."""
    for method, history in answers.histories.items():
        run.write_csv(f"deflection_{method}.csv", history.to_frame())
    if answers.smooth_camera is not None:
        run.write_csv(f"{_SMOOTH_CAMERA}.csv", answers.smooth_camera.to_frame())
    if answers.camera is not None:
        run.write_csv("camera_frames.csv", answers.camera.frames)
        if answers.camera.shape is not None:
            run.write_csv("shell_shape.csv", answers.camera.shape.to_frame())
        if answers.camera.joined is not None:
            run.write_csv("cameras.csv", answers.camera.joined.to_frame())
    if answers.fused is not None:
        run.write_csv("fusion_inputs.csv", answers.fused.input_frame())
        run.write_csv("fusion_agreement.csv", answers.fused.agreement_frame())


def write_increments(run: RunFolder, answers: Deflections) -> None:
    """Write the tables of the aerodynamic increments, where there are any."""
    if answers.increments is not None:
        run.write_csv("aero_increments.csv", answers.increments.to_frame())
        run.write_csv("aero_increments_correlations.csv", answers.increments.correlations())
        answers.increments.write_table(run.path)


def answer_table(method: str, present: Container[str]) -> str:
    """Stem of the table with a method's answer at any time, of those ``present`` in a run folder.

    Of the camera it is the smooth one where there is one; ``deflection_camera.csv`` has its frames.
    """
    frames = f"deflection_{method}"
    return _SMOOTH_CAMERA if method == "camera" and frames in present and _SMOOTH_CAMERA in present else frames


def attitude_summary(check: AttitudeCheck | None) -> dict[str, Any] | None:
    """Comparison with the attitude of magnetometer and Sun alone; None for a flight without them."""
    if check is None:
        return None
    comparison = check.comparison
    if comparison is None:
        return {"passed": None, "independent": not check.dependence, "words": check.findings[-1].what}
    return {
        "passed": all(v.passed for v in check.consistency_checks),
        "independent": not check.dependence,
        "words": check.remark,
        "rms_body_deg": [float(x) for x in np.rad2deg(np.sqrt(np.mean(comparison.difference_body_rad**2, axis=0)))],
        "mean_body_deg": [float(x) for x in np.rad2deg(comparison.mean_body_rad)],
        "share_inside_3sd": comparison.share_inside,
    }


def increments_summary(answers: Deflections) -> dict[str, Any] | None:
    """Aerodynamic increments at peak pressure, or reason and code where they were refused; None without a fusion."""
    if answers.increments is not None:
        return answers.increments.summary()
    fault = answers.no_increments
    return None if fault is None else {"reason": str(fault), "code": fault.code}


def summary(flight: Reconstruction, answers: Deflections, event_rows: pd.DataFrame) -> dict[str, Any]:
    """Return the results of a run in short, for ``summary.json``; ``event_rows`` is its `event_table`."""
    at_peak = event_rows.iloc[int((event_rows["t_s"] - flight.peak_s).abs().argmin())]
    alpha = [float(at_peak["alpha_total_wind_deg"]), float(at_peak["alpha_total_wind_3sd_deg"]) / 3.0]
    checks, camera = (*flight.consistency_checks, *answers.consistency_checks), answers.camera
    return {
        "flight": flight.telemetry.name,
        "synthetic": flight.telemetry.synthetic,
        "changes": list(flight.flight.changes),
        "peak_dynamic_pressure_pa": float(at_peak["dynamic_pressure_pa"]),
        "peak_dynamic_pressure_s": float(flight.peak_s),
        "alpha_total_wind_deg": alpha[0] if flight.has_attitude else None,
        "alpha_total_wind_sd_deg": alpha[1] if flight.has_attitude else None,
        "methods": method_summary(answers),
        "agreement": None if answers.fused is None else answers.fused.remark,
        "left_out": None if answers.fused is None else answers.fused.left_out,
        "film_clock": None if answers.fused is None else answers.fused.time_bias_summary(),
        "shell_shape": None if camera is None or camera.shape is None else camera.shape.summary(),
        "southwell": None if answers.fused is None else answers.fused.southwell_summary(),
        "aero_increments": increments_summary(answers),
        "missing": list(flight.missing),
        "rests_on": list(flight.rests_on),
        "attitude_check": attitude_summary(flight.attitude),
        "verdicts_passed": sum(check.passed for check in checks),
        "suspect": flight.suspects[0] if flight.suspects else None,
        "suspects": list(flight.suspects),
        "verdicts_failed": [f"{check.name}: {check.remark}" for check in checks if not check.passed],
    }


def header(flight: Reconstruction) -> dict[str, Any]:
    """Head of ``bet.csv`` for ``bet_header.json``; nothing in it depends on when or where it was made."""
    telemetry, bet = flight.telemetry, flight.solution
    settings = bet.provenance["settings"]
    return {
        "format": _FORMAT,
        "postflight": version("postflight"),
        "flight": telemetry.name,
        "synthetic": telemetry.synthetic,
        "changes": list(flight.flight.changes),
        "epoch_utc": telemetry.t0_utc,
        **({} if telemetry.planet == WGS84 else {"planet": name_of(telemetry.planet)}),
        "start_s": bet.provenance["start_s"],
        "end_s": bet.provenance["end_s"],
        "point": "datum (the nose); air data and flow angles at the c.g.",
        "motion": bet.provenance["motion"],
        "frames": _FRAMES,
        "standard_deviations": "1 sd, of the smoothed trajectory and, in air data, of the sounding",
        "vehicle": _vehicle(flight),
        "atmosphere": _atmosphere(flight),
        "sensors": _sensors(flight),
        "assumed": telemetry.assumed,
        "settings": settings,
        "inputs_sha256": telemetry.hashes,
        "missing": list(flight.missing),
    }


def _vehicle(flight: Reconstruction) -> dict[str, Any] | None:
    vehicle = flight.telemetry.vehicle
    if vehicle is None:
        return None
    return {
        "name": vehicle.name,
        "reference_area_m2": vehicle.reference.area_m2,
        "reference_length_m": vehicle.reference.length_m,
        "mass_kg": vehicle.mass_kg,
        "cg_from_datum_body_m": [float(x) for x in vehicle.cg_m],
        "inertia_about_cg_kgm2": [[float(x) for x in row] for row in vehicle.inertia],
        **({"mass_steps": [step.model_dump() for step in vehicle.mass_steps]} if vehicle.mass_steps else {}),
        "uncertainty": vehicle.uncertainty.model_dump(),
    }


def _atmosphere(flight: Reconstruction) -> dict[str, Any]:
    sounding = flight.telemetry.sounding
    files = [name for name in flight.telemetry.hashes if "atmosphere" in name or "sounding" in name]
    return {
        "file": files[0] if files else None,
        "lowest_m": float(sounding.altitude_m[0]),
        "highest_m": float(sounding.altitude_m[-1]),
        "density_sd": [float(np.min(sounding.density_sd)), float(np.max(sounding.density_sd))],
        "wind_sd_mps": [float(np.min(sounding.wind_sd_mps)), float(np.max(sounding.wind_sd_mps))],
        "columns": "rho, p, t, mach, winds, alpha: with the sounding's air (with [drag] as flown, where that is known "
        "better); density_ratio: as-flown density over the sounding's",
    }


def _sensors(flight: Reconstruction) -> list[dict[str, Any]]:
    """Every sensor with its stated accuracies, SI units and radians."""
    has = flight.telemetry
    onboard = [r for r in (has.accelerometer, has.rates, has.magnetometer, has.sun) if r is not None]
    out = [{"samples": len(r.time_s), **_plain(asdict(r.spec))} for r in onboard]
    out += [{"samples": len(r.time_s), "tracks": r.point, **_plain(asdict(r.spec))} for r in has.radars.values()]
    return out + [
        {"samples": len(r.time_s), **_plain(asdict(r.spec))}
        for records in (has.gnss, has.barometers)
        for r in records.values()
    ]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def event_table(flight: Reconstruction, table: pd.DataFrame) -> pd.DataFrame:
    """Events with the values of ``bet.csv`` there; the ``_3sd_`` columns hold three standard deviations."""
    air = flight.air
    named = [(name, t) for name, t in flight.telemetry.events if air.time_s[0] <= t <= air.time_s[-1]]
    peak = f"largest dynamic pressure ({flight.peak_lies})" if flight.peak_lies else "peak dynamic pressure"
    named.append((peak, flight.peak_s))
    named += events.descent_events(air.time_s, air.altitude_m, air.mach)
    rows = []
    for name, t in sorted(named, key=lambda event: event[1]):
        row: dict[str, object] = {"event": name, "t_s": t}
        for column in _EVENT_COLUMNS:
            row[column], sd = value_and_sd(table, column, t)
            row[column_about(column, "3sd")] = 3.0 * sd
        rows.append(row)
    names = [c for column in _EVENT_COLUMNS for c in (column, column_about(column, "3sd"))]
    return pd.DataFrame(rows, columns=["event", "t_s", *names])


def value_and_sd(table: pd.DataFrame, column: str, at_s: float) -> tuple[float, float]:
    """Value of a column of ``bet.csv`` at a time, and its standard deviation, in the column's unit."""
    time_s, values, sd = (table[name].to_numpy(dtype=float) for name in ("t_s", column, column_about(column)))
    value = events.value_at(time_s, values, at_s)
    # a cubic through a touch of zero may pass below it
    return max(value, 0.0) if values.min() >= 0.0 else value, float(np.interp(at_s, time_s, sd))


def peak_table(flight: Reconstruction, table: pd.DataFrame) -> pd.DataFrame:
    """Peak values with times and standard deviations; ``inside`` is false where one lies at an end of the data."""
    peaks = dict(_PEAKS)
    if flight.deceleration is not None:
        column = peaks["deceleration"] = "deceleration_mps2"
        table = table.assign(**dict(zip((column, column_about(column)), flight.deceleration, strict=True)))
    q = table["dynamic_pressure_pa"].to_numpy()
    pulse, time_s = q >= 0.5 * q.max(), table["t_s"].to_numpy()
    rows = []
    for name, column in peaks.items():
        size = np.abs(table[column].to_numpy(dtype=float))
        use = np.isfinite(size) & (pulse if "pulse" in name else size > -1.0)
        if name in ("Mach number", "airspeed"):
            use &= flight.air.altitude_m < events.HIGHEST_M
        if not use.any():
            continue
        k = int(np.flatnonzero(use)[np.argmax(size[use])])
        inside = 0 < k < len(size) - 1 and bool(use[k - 1] and use[k + 1])
        inside &= name != "dynamic pressure" or not flight.peak_lies
        first = int(np.clip(k - 1, 0, len(size) - 3))
        near = slice(first, first + 3)
        at = events.find_peak(time_s[near], size[near])[0] if use[near].all() else time_s[k]
        rows.append((name, column, at, *value_and_sd(table, column, at), inside))
    return pd.DataFrame(rows, columns=["peak", "column", "t_s", "value", "sd", "inside"])


def _residuals(residuals: pd.DataFrame) -> pd.DataFrame:
    """Residuals as they are written: each row with its unit, angles in degrees."""
    with_units = residuals.assign(unit=residuals["component"].map(component_unit))
    return in_degrees(with_units, "residual", "predicted_sd")


def in_degrees(table: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """Table with a column ``unit`` as it is written: rows of angles and their rates in degrees."""
    turned = table["unit"].isin(list(_DEGREES))
    out = table.copy()
    for column in columns:
        out[column] = np.where(turned, np.rad2deg(table[column].to_numpy(dtype=float)), table[column])
    out["unit"] = table["unit"].replace(_DEGREES)
    return out


def residual_statistics(flight: Reconstruction) -> pd.DataFrame:
    """Statistics of the residuals of each source and component; edited points are in ``count`` and ``edited`` alone.

    Mean and sd are in metres and radians (m/s for velocities); ``rms_normalised`` is over the predicted sd and should
    be one; ``lag1``, the autocorrelation of successive residuals, should be zero; ``nis`` is the source's own.
    """
    checks = flight.solution.consistency_checks
    nis = {check.name.removeprefix("NIS "): check.value for check in checks if check.code == "nis"}
    rows = []
    for (source, component), part in flight.solution.residuals.groupby(["source", "component"], sort=False):
        good = part[part["accepted"]]
        r, z = good["residual"].to_numpy(), (good["residual"] / good["predicted_sd"]).to_numpy()
        unit = component_unit(component)
        values = (np.nan,) * 4
        if len(r) > 2:
            values = (float(r.mean()), float(r.std(ddof=1)), float(np.sqrt((z**2).mean())), _lag1(z))
        edited = len(part) - len(good)
        rows.append((source, component, unit, len(part), edited, *values, nis.get(source, np.nan)))
    return pd.DataFrame(rows, columns=list(_STATISTICS))


def _lag1(z: FloatArray) -> float:
    centred = z - z.mean()
    return float(centred[1:] @ centred[:-1] / max(float(centred @ centred), 1e-300))


def slow_covariance(flight: Reconstruction) -> dict[str, FloatArray]:
    """Whole covariances (k, 9, 9) at `_COVARIANCE_RATE_HZ`: position ECEF m, velocity ECEF m/s, rotation body rad."""
    bet = flight.solution.smoothed
    assert bet.covariance is not None
    ticks = np.floor(bet.time_s * _COVARIANCE_RATE_HZ + 1e-6)
    rows = np.flatnonzero(np.diff(ticks, prepend=-np.inf) > 0.0)
    return {"t_s": bet.time_s[rows], "covariance": bet.covariance[rows]}
