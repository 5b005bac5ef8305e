"""Run folders: every result of one run as CSV and JSON, whole or not there at all.

``runs/<utc>-<hash8>/``: the hash covers inputs, settings and version, so equal runs carry equal hashes, and the same
inputs give the same bytes in every file but ``run.json``, which alone holds times and machine.

A file that is whole or not there at all.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import tempfile
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel.checks import GateError, writing
from flightmodel.deflection import DeflectionHistory
from flightmodel.telemetry import Finding, Telemetry
from postflight.attitude import AttitudeCheck, attitude_table
from postflight.flight import NO_VIDEO, Answers, Flight
from postflight.fusing import agreement_table, input_table
from postflight.product import bet_table, event_table, header, peak_table, residual_statistics, slow_covariance

DIGITS = "%.10g"
COPY = "copy the flight folder to where you may write"
PARTIAL = ".partial-"  # before the number of the process that writes it


class RunFolder:
    """A run folder under construction: use as a context; it is renamed into place when the block ends well."""

    def __init__(self, flight_folder: Path, telemetry: Telemetry, settings: dict[str, Any]) -> None:
        self.hash8 = run_hash(telemetry.hashes, settings, version("postflight"))
        self.finished: datetime | None = None
        self.settings = settings
        self.telemetry = telemetry
        self.parent = flight_folder / "runs"
        self.path = Path()

    def __enter__(self) -> RunFolder:
        """Make the partial folder beside the final one."""
        with writing(self.parent, COPY):
            self.parent.mkdir(exist_ok=True)
            remove_abandoned(self.parent)
            self.path = Path(tempfile.mkdtemp(prefix=f"{PARTIAL}{os.getpid()}-", dir=self.parent))
            (self.path / "figures").mkdir()
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, _: object) -> None:
        """Rename when whole; remove otherwise, also where the end itself is interrupted."""
        partial = self.path
        try:
            with writing(self.parent, COPY):
                if isinstance(fault, OSError):
                    raise fault
                if kind is None:
                    self._finish()
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def write_facts(self) -> datetime:
        """Write ``run.json`` and return the run's time: when everything is there, or earlier for who reads it."""
        now = datetime.now(UTC)
        facts = {
            "finished_utc": now.isoformat(timespec="seconds"),
            "version": version("postflight"),
            "python": platform.python_version(),
            "packages": {name: version(name) for name in ("numpy", "scipy", "numba", "filterpy", "trimesh")},
            "settings": self.settings,
            "inputs_sha256": self.telemetry.hashes,
        }
        self.write_json("run.json", facts)
        self.finished = now
        return now

    def _finish(self) -> None:
        now = self.finished or self.write_facts()
        final = self.parent / f"{now.strftime('%Y%m%dT%H%M%SZ')}-{self.hash8}"
        if final.exists():
            shutil.rmtree(final)
        self.path.chmod(0o755)
        self.path.rename(final)
        self.path = final

    def write_csv(self, name: str, table: pd.DataFrame) -> None:
        """Write a table."""
        table.to_csv(self.path / name, index=False, float_format=DIGITS, lineterminator="\n")

    def write_json(self, name: str, value: Any) -> None:
        """Write one JSON object; NaN becomes null."""
        text = json.dumps(_no_nan(value), indent=2, allow_nan=False)
        (self.path / name).write_text(text + "\n")


def run_hash(inputs_sha256: dict[str, str], settings: dict[str, Any], made_by: str) -> str:
    """Eight digits that equal runs share: of inputs, settings and version."""
    facts = json.dumps([inputs_sha256, settings, made_by], sort_keys=True)
    return hashlib.sha256(facts.encode()).hexdigest()[:8]


def remove_abandoned(parent: Path) -> None:
    """Remove the folders that processes which are gone left half-written: killed where they could not tidy up.

    Such a folder is named `PARTIAL`, process number, ``-`` and anything.
    """
    for path in parent.iterdir():
        number, dash, _ = path.name.removeprefix(PARTIAL).partition("-")
        if not path.name.startswith(PARTIAL) or not dash or not number.isdigit():
            continue
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            shutil.rmtree(path, ignore_errors=True)  # refuses what is no folder, or a link to one
        except (PermissionError, OverflowError):
            continue


def _no_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _no_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_no_nan(v) for v in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value


def newest_run(flight_folder: Path) -> Path:
    """Return the newest run that has a summary; `GateError` where there is none."""
    finished = (flight_folder / "runs").glob("*/summary.json")
    runs = sorted(path.parent for path in finished if not path.parent.name.startswith("."))
    if not runs:
        raise GateError(f"{flight_folder}: no finished run; use `postflight run {flight_folder}` first")
    return runs[-1]


def deflection_table(history: DeflectionHistory) -> pd.DataFrame:
    """Angle and plane with standard deviations; rows without an answer are left out."""
    keep = np.isfinite(history.theta_rad)
    plane_sd = np.full(len(keep), np.nan)
    if history.covariance is not None:
        plane_sd = np.sqrt(history.covariance[:, 1, 1])
    table = pd.DataFrame(
        {
            "t_s": history.time_s,
            "theta_deg": np.rad2deg(history.theta_rad),
            "theta_sd_deg": np.rad2deg(history.theta_sd_rad),
            "plane_lv_deg": np.rad2deg(history.plane_lv_rad),
            "plane_sd_deg": np.rad2deg(plane_sd),
        }
    )
    return table[keep]


def method_summary(answers: Answers, at_s: float) -> dict[str, dict[str, Any]]:
    """Each method's deflection at one time, and the reason where it has none."""
    out: dict[str, dict[str, Any]] = {}
    for method, history in answers.histories.items():
        theta, sd = np.rad2deg(history.at(at_s))
        known = history.time_s[np.isfinite(history.theta_rad)]
        largest = int(np.nanargmax(history.theta_rad))
        out[method] = {
            "deflection_deg": float(theta),
            "sd_deg": float(sd),
            "largest_deg": float(np.rad2deg(history.theta_rad[largest])),
            "largest_at_s": float(history.time_s[largest]),
            "assumptions": history.assumptions,
        }
        if not np.isfinite(theta):
            out[method]["deflection_deg"] = out[method]["sd_deg"] = None
            out[method]["reason"] = f"no data at {at_s:.2f} s; answers span {known[0]:.2f} to {known[-1]:.2f} s"
    for method, reason in answers.refused.items():
        out[method] = {"deflection_deg": None, "sd_deg": None, "reason": reason, "applicable": reason != NO_VIDEO}
    return out


def write_reconstruction(run: RunFolder, flight: Flight) -> None:
    """Trajectory, its header and covariance, residuals, verdicts, sensor errors, events, air, findings."""
    bet = flight.reconstruction
    table = bet_table(flight)
    run.write_csv("bet.csv", table)
    run.write_json("bet_header.json", header(flight))
    slow = slow_covariance(flight)
    np.savez_compressed(run.path / "covariance.npz", t_s=slow["t_s"], covariance=slow["covariance"])
    run.write_csv("peaks.csv", peak_table(flight, table))
    run.write_csv("residual_statistics.csv", residual_statistics(flight))
    run.write_csv("residuals.csv", bet.residuals)
    if len(bet.held_out):
        run.write_csv("withheld.csv", bet.held_out)
    checks = pd.DataFrame([vars(v) for v in flight.consistency_checks])
    run.write_csv("consistency_checks.csv", checks)
    # the table's name and columns of version 0.1, for scripts that read it; to go with version 0.3
    run.write_csv(
        "verdicts.csv",
        checks.drop(columns=["code", "source", "component", "symptom"]).rename(columns={"remark": "words"}),
    )
    run.write_csv("sensor_errors.csv", bet.sensor_errors)
    run.write_csv("events.csv", event_table(flight, table))
    if flight.day is not None:
        run.write_csv("air_profile.csv", flight.day.profile)
        run.write_csv("drag_ratio.csv", flight.day.drag)
        run.write_csv("air_parameters.csv", flight.day.parameters)
    if flight.attitude is not None and flight.attitude.comparison is not None:
        run.write_csv("attitude_check.csv", attitude_table(flight.attitude, bet))
    findings = [vars(f) for f in (*flight.findings, *without_attitude(flight))]
    run.write_csv("findings.csv", pd.DataFrame(findings, columns=["source", "what", "start_s", "end_s"]))


def without_attitude(flight: Flight) -> tuple[Finding, ...]:
    """Finding that says what is not in the tables of a flight without inertial sensors; none with them."""
    if flight.has_attitude:
        return ()
    words = "no inertial sensors carried the attitude: attitude, rates and flow angles are empty in bet.csv"
    return (Finding("attitude", words, np.nan, np.nan),)


def write_answers(run: RunFolder, answers: Answers) -> None:
    """One CSV a method that answered."""
    for method, history in answers.histories.items():
        run.write_csv(f"deflection_{method}.csv", deflection_table(history))
    if answers.smooth_camera is not None:
        run.write_csv("camera_smooth.csv", deflection_table(answers.smooth_camera))
    if answers.fused is not None:
        run.write_csv("fusion_inputs.csv", input_table(answers.fused))
        run.write_csv("fusion_agreement.csv", agreement_table(answers.fused))


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
        "words": check.words,
        "rms_body_deg": [float(x) for x in np.rad2deg(np.sqrt(np.mean(comparison.difference_body_rad**2, axis=0)))],
        "mean_body_deg": [float(x) for x in np.rad2deg(comparison.mean_body_rad)],
        "share_inside_3sd": comparison.share_inside,
    }


def summary(flight: Flight, answers: Answers) -> dict[str, Any]:
    """Return the short story of a run, for ``summary.json``."""
    air, peak = flight.air, flight.peak_s
    k = int(np.searchsorted(air.time_s, peak).clip(0, len(air.time_s) - 1))
    consistency_checks = flight.consistency_checks
    return {
        "flight": flight.telemetry.name,
        "synthetic": flight.telemetry.synthetic,
        "peak_dynamic_pressure_pa": float(air.dynamic_pressure_pa[k]),
        "peak_dynamic_pressure_s": float(peak),
        "alpha_total_wind_deg": float(np.rad2deg(air.alpha_total_wind_rad[k])) if flight.has_attitude else None,
        "alpha_total_wind_sd_deg": float(np.rad2deg(air.alpha_total_wind_sd_rad[k])) if flight.has_attitude else None,
        "methods": method_summary(answers, peak),
        "agreement": None if answers.fused is None else answers.fused.agreement.words,
        "film_clock": None if answers.fused is None else answers.fused.clock_summary(),
        "southwell": None if answers.fused is None else answers.fused.southwell_summary(),
        "missing": list(flight.missing),
        "attitude_check": attitude_summary(flight.attitude),
        "verdicts_passed": sum(v.passed for v in consistency_checks),
        "suspect": flight.suspects[0] if flight.suspects else None,
        "suspects": list(flight.suspects),
        "verdicts_failed": [f"{v.name}: {v.remark}" for v in consistency_checks if not v.passed],
    }


def write_file(path: Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, beside its place and rename it; folders on the way are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
