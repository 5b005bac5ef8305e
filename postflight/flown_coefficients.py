"""How do the in-flight coefficients differ from the preflight table? Increments, and the table as flown.

The increments are those of `estimators.increments`: of forces, moments and rates through the pressure pulse, given the
flow, its air, the mass properties and every reading of the deflection. A run leaves them as ``aero_increments.csv``
with their correlations, and as a coefficient table, ``aero_as_flown.csv`` with its sidecar, that a vehicle file takes
as it takes any other (docs/aero-increments.md).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from estimators.evidence import Deflection
from estimators.fusing import Fused
from estimators.increments import COEFFICIENTS, STATED, Increments, estimate_increments
from estimators.loads import FlightLoads
from flightmodel.aerodynamics import COLUMNS, AeroTable
from flightmodel.checks import Check, FloatArray
from flightmodel.files import write_file
from flightmodel.tabular import Tabular
from recon.state import MOST_KEPT_SD, data_sheet_check

TABLE = "aero_as_flown"
_ANGLE_DIGITS = 13  # angles must be evenly spaced to 1e-9
_BAD = "is beyond the preflight table's uncertainty: check the coefficient table, then mass properties and sensors"
_GOOD = "increments are within the table's stated uncertainty; largest:"


@dataclass(frozen=True, repr=False)
class AeroIncrements(Tabular):
    """Increments of the coefficients along Mach number through the pressure pulse.

    Parameters
    ----------
    found : Increments
    pulse : FlightLoads
        What they were found from; its vehicle has the preflight table.
    deflection : callable
        From times to the lateral vectors that they were found with.
    confidence : float
        Of the checks.
    name : str
        Of the flight.
    """

    found: Increments
    pulse: FlightLoads
    deflection: Deflection
    confidence: float
    name: str

    @cached_property
    def sd(self) -> FloatArray:
        """Standard deviations (4, k)."""
        return np.sqrt(np.diag(self.found.covariance)).reshape(len(COEFFICIENTS), -1)

    @property
    def determined(self) -> FloatArray:
        """Mask (4, k) of the increments that the flight determines: sd below `MOST_KEPT_SD` of the stated one."""
        return np.asarray(self.sd < MOST_KEPT_SD * self.found.processes.stated_sd[:, None])

    @cached_property
    def preflight(self) -> FloatArray:
        """Coefficients (4, k) of the preflight table at the shell's rms angle of attack near each Mach number."""
        return self.pulse.vehicle.aero.at(self.found.mach, self._near("alpha")).T

    def _near(self, what: str) -> FloatArray:
        """Time, s, or rms angle of attack of the shell, rad, near each knot (k,)."""
        weights = self.found.processes.weights(self.pulse.mach)
        total = np.maximum(weights.sum(axis=0), np.finfo(float).tiny)
        if what == "time":
            return np.asarray(weights.T @ self.pulse.time_s / total)
        flow = self.pulse.flow_yz_rad - self.deflection(self.pulse.time_s)
        return np.asarray(np.sqrt(weights.T @ np.sum(flow**2, axis=1) / total))

    def to_frame(self) -> pd.DataFrame:
        """One row a Mach number, the columns of ``aero_increments.csv`` (docs/aero-increments.md).

        ``mach, t_s, alpha_shell_deg``; of ``ca, cn, cm, cmq`` the preflight table's value there, increment, its sd and
        the a priori one, all without unit; correlations of the increments at that Mach number. Empty where the flight
        does not determine an increment.
        """
        columns: dict[str, FloatArray] = {
            "mach": self.found.mach,
            "t_s": self._near("time"),
            "alpha_shell_deg": np.rad2deg(self._near("alpha")),
        }
        for k, name in enumerate(STATED):
            scale, seen = self._scale[k], self.determined[k]
            columns |= {
                f"{name}_preflight": self.preflight[k],
                f"{name}_increment": np.where(seen, scale * self.found.mean[k], np.nan),
                f"{name}_increment_sd": np.where(seen, np.abs(scale) * self.sd[k], np.nan),
                f"{name}_prior_sd": np.abs(scale) * self.found.processes.stated_sd[k],
            }
        knots, correlation = np.arange(len(self.found.mach)), self._correlation
        for a, b in combinations(range(len(STATED)), 2):
            # of what is C_m's increment and not its factor: the signs of the table's own values
            sign = np.sign(self._scale[a] * self._scale[b])
            both = self.determined[a] & self.determined[b]
            at = correlation[a * len(knots) + knots, b * len(knots) + knots]
            columns[f"correlation_{STATED[a]}_{STATED[b]}"] = np.where(both, sign * at, np.nan)
        return pd.DataFrame(columns)

    @property
    def _scale(self) -> FloatArray:
        """Scale (4, k) of the posterior's increments: the preflight value of all but C_mq."""
        return np.concatenate([self.preflight[:3], np.ones_like(self.preflight[3:])])

    @cached_property
    def _correlation(self) -> FloatArray:
        sd = self.sd.ravel()
        return np.asarray(self.found.covariance / np.outer(sd, sd))

    def correlations(self) -> pd.DataFrame:
        """Correlations of all increments at all Mach numbers: ``coefficient, mach``, then a column each in that order.

        Of C_A, C_N and C_m they are those of the fractions of the preflight value.
        """
        mach = [f"{m:.3f}" for m in self.found.mach]
        table = pd.DataFrame(self._correlation, columns=[f"{name}_{m}" for name in STATED for m in mach])
        table.insert(0, "coefficient", np.repeat(STATED, len(mach)))
        table.insert(1, "mach", np.tile(self.found.mach, len(STATED)))
        return table

    @property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Whether each coefficient's increments agree with the vehicle file's uncertainty; none if not observable."""
        found = []
        for k, name in enumerate(COEFFICIENTS):
            prior_sd = np.full(len(self.found.mach), self.found.processes.stated_sd[k])
            places = [f"{name} at Mach {m:.1f}" for m in self.found.mach]
            label = f"preflight table {name}"
            found.append(
                data_sheet_check(
                    "aero-increment", label, "", places, self.found.mean[k], prior_sd, self.sd[k], self.confidence,
                    _BAD, _GOOD,
                )
            )  # fmt: skip
        return tuple(check for check in found if check is not None)

    def summary(self) -> dict[str, Any]:
        """Increments at the largest dynamic pressure, for ``summary.json``: as fractions, but C_mq's absolute."""
        peak = int(np.argmax(self.pulse.dynamic_pressure_pa))
        at = int(np.argmax(self.found.processes.weights(self.pulse.mach[[peak]])[0]))
        out: dict[str, Any] = {"mach": float(self.found.mach[at])}
        for k, name in enumerate(STATED):
            seen = bool(self.determined[k, at])
            out[name] = {
                "increment": float(self.found.mean[k, at]) if seen else None,
                "sd": float(self.sd[k, at]) if seen else None,
                "prior_sd": float(self.found.processes.stated_sd[k]),
            }
        return out

    @property
    def table(self) -> AeroTable:
        """Coefficient table as flown: the preflight table with mean increments, which fade to their constant part."""
        return self.found.processes.flown(self.pulse.vehicle.aero, self.found.mean)

    def write_table(self, folder: Path) -> None:
        """Write the table as flown and its sidecar into a folder."""
        write_aero_table(folder / f"{TABLE}.csv", self.table)
        vehicle, sd = self.pulse.vehicle, np.sqrt(np.mean(self.sd**2, axis=1))
        lines = [
            # of TOML's basic strings JSON's escapes are a part
            f"source = {json.dumps(f'{vehicle.name} as flown by {self.name}: its preflight table and increments')}",
            'licence = "that of the preflight table"',
            f"area_m2 = {vehicle.reference.area_m2:.10g}",
            f"length_m = {vehicle.reference.length_m:.10g}",
            "moment_reference_station_m = 0.0",
            "",
            f"[uncertainty] # rms of what is left from Mach {self.found.mach[0]:.2g} to {self.found.mach[-1]:.2g}",
            *(f"{name} = {value:.4f}" for name, value in zip(STATED[:3], sd, strict=False)),
        ]
        write_file(folder / f"{TABLE}.toml", "\n".join(lines) + "\n")

    @property
    def about(self) -> str:
        """Increments at the largest dynamic pressure, in one line."""
        return self._about()

    def _about(self) -> str:
        peak = self.summary()
        shown = [
            f"{label} {100 * peak[name]['increment']:+.1f} +/- {100 * peak[name]['sd']:.1f} %"
            for label, name in zip(COEFFICIENTS[:3], STATED, strict=False)
            if peak[name]["increment"] is not None
        ]
        if peak["cmq"]["increment"] is not None:
            shown.append(f"C_mq {peak['cmq']['increment']:+.2f} +/- {peak['cmq']['sd']:.2f}")
        return f"at Mach {peak['mach']:.1f}: {', '.join(shown) or 'none determined'}"


def increments_of(answer: Fused, confidence: float, name: str) -> AeroIncrements:
    """Increments from what stands behind a fused deflection.

    Parameters
    ----------
    answer : Fused
    confidence : float
        Of the checks.
    name : str
        Of the flight.

    Raises
    ------
    DivergenceError
        Where they do not settle.
    """
    found = estimate_increments(answer.reader, answer.solution)
    return AeroIncrements(found, answer.reader.pulse, answer.solution.deflection, confidence, name)


def write_aero_table(path: Path, table: AeroTable) -> None:
    """Write a coefficient table as `flightmodel.aerodynamics.read_aero_table` reads it."""
    m, a = (c.ravel() for c in np.meshgrid(table.mach, np.rad2deg(table.alpha_rad), indexing="ij"))
    rows = np.column_stack([m, a, table.coefficients.reshape(-1, 4)])
    form = ",".join(["%.10g", f"%.{_ANGLE_DIGITS}g", *["%.10g"] * 4])
    lines = [",".join(COLUMNS), *(form % tuple(row) for row in rows.tolist())]
    write_file(path, "\n".join(lines) + "\n")
