"""Where are the results of a run? In ``runs/<utc>-<hash8>/``, as CSV and JSON, complete or not there at all.

The hash covers inputs, settings and version, so equal runs carry equal hashes, and the same inputs give the same bytes
in every file but ``run.json``, which alone holds times and machine. What the tables contain: `postflight.product`.
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
from flightmodel.telemetry import Finding, Telemetry
from postflight.attitude import AttitudeCheck, attitude_table
from postflight.deflections import NO_VIDEO, Deflections, quantiles_at
from postflight.product import event_table, header, peak_table, residual_statistics, slow_covariance
from postflight.reconstruction import Reconstruction, bet_table

DIGITS = "%.10g"
_COPY = "copy the flight folder to where you may write"
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
        with writing(self.parent, _COPY):
            self.parent.mkdir(exist_ok=True)
            remove_abandoned(self.parent)
            self.path = Path(tempfile.mkdtemp(prefix=f"{PARTIAL}{os.getpid()}-", dir=self.parent))
            (self.path / "figures").mkdir()
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, _: object) -> None:
        """Rename when whole; remove otherwise, also where the end itself is interrupted."""
        partial = self.path
        try:
            with writing(self.parent, _COPY):
                if isinstance(fault, OSError):
                    raise fault
                if kind is None:
                    self._finish()
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def write_facts(self) -> datetime:
        """Write ``run.json`` and return the run's time: at the end, or earlier for what reads it (the report)."""
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
    """Eight hexadecimal digits of inputs, settings and version, which equal runs share."""
    facts = json.dumps([inputs_sha256, settings, made_by], sort_keys=True)
    return hashlib.sha256(facts.encode()).hexdigest()[:8]


def remove_abandoned(parent: Path) -> None:
    """Remove incomplete folders, named `PARTIAL`, process number, ``-`` and anything, of processes that ended."""
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
        raise GateError(f"{flight_folder}: no finished run; use `postflight run {flight_folder}` first", "run-missing")
    return runs[-1]


def method_summary(answers: Deflections, at_s: float) -> dict[str, dict[str, Any]]:
    """Each method's deflection at one time, and reason and code where it has none."""
    out: dict[str, dict[str, Any]] = {}
    for method, history in answers.histories.items():
        theta, sd = np.rad2deg(history.at(at_s))
        known = history.time_s[np.isfinite(history.theta_rad)]
        largest = int(np.nanargmax(history.theta_rad))
        quantiles = np.rad2deg(quantiles_at(history, at_s))
        out[method] = {
            "deflection_deg": float(theta),
            "sd_deg": float(sd),
            "quantiles_deg": [float(x) for x in quantiles] if np.isfinite(quantiles).all() else None,
            "largest_deg": float(np.rad2deg(history.theta_rad[largest])),
            "largest_at_s": float(history.time_s[largest]),
            "assumptions": history.assumptions,
        }
        if not np.isfinite(theta):
            words = f"no data at {at_s:.2f} s; answers span {known[0]:.2f} to {known[-1]:.2f} s"
            out[method] |= {"deflection_deg": None, "sd_deg": None, "reason": words, "code": "no-answer"}
    for method, reason in answers.refused.items():
        out[method] = {
            "deflection_deg": None,
            "sd_deg": None,
            "reason": reason,
            "code": reason.code,
            "applicable": reason.code != NO_VIDEO,
        }
    return out


def write_reconstruction(run: RunFolder, flight: Reconstruction, answers: Deflections | None = None) -> pd.DataFrame:
    """Write trajectory, covariance, residuals, checks, sensor errors, events, air, findings; return the events.

    The checks of the deflection are among them where its ``answers`` are given.
    """
    bet = flight.solution
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
    of_deflection = () if answers is None else answers.consistency_checks
    checks = pd.DataFrame([vars(v) for v in (*flight.consistency_checks, *of_deflection)])
    run.write_csv("consistency_checks.csv", checks)
    # the table's name and columns of version 0.1, for scripts that read it; to go with version 0.3
    run.write_csv(
        "verdicts.csv",
        checks.drop(columns=["code", "source", "component", "symptom"]).rename(columns={"remark": "words"}),
    )
    run.write_csv("sensor_errors.csv", bet.sensor_errors)
    event_rows = event_table(flight, table)
    run.write_csv("events.csv", event_rows)
    if flight.as_flown is not None:
        run.write_csv("air_profile.csv", flight.as_flown.profile)
        run.write_csv("drag_ratio.csv", flight.as_flown.drag)
        run.write_csv("air_parameters.csv", flight.as_flown.parameters)
    if flight.attitude is not None and flight.attitude.comparison is not None:
        run.write_csv("attitude_check.csv", attitude_table(flight.attitude, bet))
    findings = [vars(f) for f in (*flight.findings, *without_attitude(flight))]
    run.write_csv("findings.csv", pd.DataFrame(findings, columns=["source", "what", "start_s", "end_s", "code"]))
    return event_rows


def without_attitude(flight: Reconstruction) -> tuple[Finding, ...]:
    """Finding on the empty columns of a flight without inertial sensors; none with them."""
    if flight.has_attitude:
        return ()
    words = "no inertial sensors carried the attitude: attitude, rates and flow angles are empty in bet.csv"
    return (Finding("attitude", words, np.nan, np.nan, "attitude-missing"),)


def write_answers(run: RunFolder, answers: Deflections) -> None:
    """Write a table for each method that answered, and those of the fusion."""
    for method, history in answers.histories.items():
        run.write_csv(f"deflection_{method}.csv", history.to_frame())
    if answers.smooth_camera is not None:
        run.write_csv("camera_smooth.csv", answers.smooth_camera.to_frame())
    if answers.fused is not None:
        run.write_csv("fusion_inputs.csv", answers.fused.input_frame())
        run.write_csv("fusion_agreement.csv", answers.fused.agreement_frame())


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


def summary(flight: Reconstruction, answers: Deflections, event_rows: pd.DataFrame) -> dict[str, Any]:
    """Return the results of a run in short, for ``summary.json``; ``event_rows`` is its `event_table`."""
    at_peak = event_rows.iloc[int((event_rows["t_s"] - flight.peak_s).abs().argmin())]
    alpha = [float(at_peak["alpha_total_wind_deg"]), float(at_peak["alpha_total_wind_3sd_deg"]) / 3.0]
    checks = (*flight.consistency_checks, *answers.consistency_checks)
    return {
        "flight": flight.telemetry.name,
        "synthetic": flight.telemetry.synthetic,
        "peak_dynamic_pressure_pa": float(at_peak["dynamic_pressure_pa"]),
        "peak_dynamic_pressure_s": float(flight.peak_s),
        "alpha_total_wind_deg": alpha[0] if flight.has_attitude else None,
        "alpha_total_wind_sd_deg": alpha[1] if flight.has_attitude else None,
        "methods": method_summary(answers, flight.peak_s),
        "agreement": None if answers.fused is None else answers.fused.remark,
        "left_out": None if answers.fused is None else answers.fused.left_out,
        "film_clock": None if answers.fused is None else answers.fused.time_bias_summary(),
        "southwell": None if answers.fused is None else answers.fused.southwell_summary(),
        "missing": list(flight.missing),
        "attitude_check": attitude_summary(flight.attitude),
        "verdicts_passed": sum(check.passed for check in checks),
        "suspect": flight.suspects[0] if flight.suspects else None,
        "suspects": list(flight.suspects),
        "verdicts_failed": [f"{check.name}: {check.remark}" for check in checks if not check.passed],
    }
