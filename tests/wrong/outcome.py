"""What do `check` and a run say of a flight folder, and how wrong is each answer, in units of its stated sd?"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import GateError
from flightmodel.deflection import DeflectionHistory
from postflight.checks.folder_check import check_folder
from postflight.deflections import METHODS, estimate
from postflight.flight import read_flight
from postflight.reconstruction import Reconstruction, reconstruct

CONFIDENTLY_WRONG_SD = 4.0


@dataclass
class Outcome:
    """What ``check``'s cross-checks, the run and the readers named, first ones first, as (code, suspects); errors."""

    check: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    run: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    data: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    red: list[tuple[str, str]] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    errors_sd: dict[str, float] = field(default_factory=dict)

    @property
    def named(self) -> list[tuple[str, tuple[str, ...]]]:
        """All that was named: ``check`` is run first, and gaps alone are no faults."""
        return [*self.check, *self.run, *self.data]

    @property
    def worst(self) -> tuple[str, float]:
        """Answer with the largest error, in sd."""
        return max(self.errors_sd.items(), key=lambda item: item[1], default=("no answer", 0.0))

    @property
    def is_wrong(self) -> bool:
        """Whether an answer is confidently wrong."""
        return self.worst[1] > CONFIDENTLY_WRONG_SD


def outcome_of(folder: Path, truth: Path) -> Outcome:
    """Check and run a folder in memory; ``truth`` is the folder of the truth's tables."""
    out = Outcome()
    report = check_folder(folder)
    out.check = [(f.code, (f.source,)) for f in report.cross_checks]
    out.refused = [f"check {fault.code}" for fault in report.refused]
    # the film lies there whether a case reads it or not
    out.data = [(f.code, (f.source,)) for f in report.findings if f.code != "file-not-used"]
    try:
        bet = reconstruct(read_flight(folder))
        answers = estimate(bet, tuple(m for m in METHODS if m != "camera" or bet.telemetry.frames is not None))
    except GateError as fault:
        out.refused += [f"run {code}" for code in fault.codes]
        return out
    out.run = [(s.code, tuple(getattr(s, "sources", ()))) for s in bet.suspects]
    out.run += [(c.code, (c.source,)) for c in answers.consistency_checks if not c.passed]
    checks = (*bet.consistency_checks, *answers.consistency_checks)
    out.red = [(c.code, c.source) for c in checks if not c.passed]
    out.refused += [f"{method} {reason.code}" for method, reason in answers.refused.items()]
    out.errors_sd = _trajectory_errors(bet, truth)
    for method, history in answers.continuous.items():
        out.errors_sd[method] = _deflection_error(history, truth)
    return out


def _trajectory_errors(bet: Reconstruction, truth: Path) -> dict[str, float]:
    """Root mean square of error over sd through the pulse: position, velocity, total angle of attack."""
    true = pd.read_csv(truth / "truth.csv")
    path, air = bet.trajectory, bet.air
    t = path.time_s
    inside = (t > true.t_s.iloc[0]) & (t < true.t_s.iloc[-1])
    pressure = np.interp(t, true.t_s, true.dynamic_pressure_pa)
    rows = inside & pressure_pulse(pressure)
    out = {}
    assert path.covariance is not None
    for name, columns, estimate_, part in (
        ("position", ("rx_ecef_m", "x_ecef_m"), path.position_ecef_m, slice(0, 3)),
        ("velocity", ("vx_ecef_mps", "vx_ecef_mps"), path.velocity_ecef_mps, slice(3, 6)),
    ):
        first = next(c for c in columns if c in true)
        there = np.column_stack([np.interp(t, true.t_s, true[first.replace("x_", f"{a}_")]) for a in "xyz"])
        error, cov = (estimate_ - there)[rows], path.covariance[rows, part, part]
        square = np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])
        out[name] = float(np.sqrt(np.mean(square) / 3.0))
    column = next(c for c in ("alpha_body_deg", "alpha_total_wind_deg") if c in true)
    error = air.alpha_total_wind_rad - np.deg2rad(np.interp(air.time_s, true.t_s, true[column]))
    sd = air.alpha_total_wind_sd_rad
    out["angle of attack"] = float(np.sqrt(np.nanmean((error / sd)[rows] ** 2)))
    return out


def _deflection_error(history: DeflectionHistory, truth: Path) -> float:
    """Error over sd at the true peak of dynamic pressure or, where larger, its root mean square over the pulse."""
    own = truth / "deflection.csv"
    true, pressure = pd.read_csv(own if own.is_file() else truth / "truth.csv"), pd.read_csv(truth / "truth.csv")
    peak = float(pressure.t_s[pressure.dynamic_pressure_pa.idxmax()])
    pulse = pressure.t_s[pressure_pulse(pressure.dynamic_pressure_pa.to_numpy())]
    t = history.time_s[(history.time_s > pulse.iloc[0]) & (history.time_s < pulse.iloc[-1])]
    z = []
    for at in (peak, *t[:: max(1, len(t) // 200)]):
        theta, sd = history.angle_at(float(at))
        z.append((theta - np.deg2rad(np.interp(at, true.t_s, true.theta_deg))) / sd if sd > 0.0 else np.nan)
    z = np.abs(np.array(z))
    rest = np.sqrt(np.nanmean(z[1:] ** 2)) if np.isfinite(z[1:]).any() else 0.0
    return float(np.nanmax([z[0], rest]))
