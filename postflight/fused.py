"""One answer from all methods of a flight, and whether they agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from estimators.agreement import Agreement, agreement
from estimators.evidence import Evidence, evidence_of_history, moved_evidence
from estimators.fusion import Fused, fuse, pulse_reader
from estimators.misalignment import misalignment_evidence
from estimators.pulse import PulseData
from estimators.southwell import Limbs, southwell_limbs
from estimators.trim import trim_evidence
from flightmodel.checks import BoolArray, DivergenceError, FloatArray, GateError
from flightmodel.deflection import DeflectionHistory


@dataclass(frozen=True)
class FusedAnswer:
    """Posterior of deflection and inputs, tests of the methods against each other, and the Southwell lines."""

    fused: Fused
    agreement: Agreement
    limbs: Limbs | None
    limbs_words: str

    def southwell_summary(self) -> dict[str, Any]:
        """Critical dynamic pressure and offset with their intervals, for ``summary.json``."""
        if self.limbs is None:
            return {"critical_pressure_pa": None, "words": self.limbs_words}
        line = self.limbs.both
        return {
            "critical_pressure_pa": line.critical_pressure_pa,
            "critical_pressure_90_percent_pa": list(line.critical_interval_pa),
            "offset_over_xbar_deg": float(np.rad2deg(line.offset_angle_rad)),
            "offset_over_xbar_90_percent_deg": [float(x) for x in np.rad2deg(line.offset_interval_rad)],
            "words": self.limbs_words,
        }


def fuse_flight(
    pulse: PulseData, camera: DeflectionHistory | None, joint_station_m: float | None = None
) -> FusedAnswer:
    """Fuse accelerometers, moment balance and, where there is one, the camera's history.

    Raises
    ------
    GateError
        Where the deceleration carries no information.
    DivergenceError
        Where there is no common answer; it says why.
    """
    if not pulse.through_pulse.any():
        raise GateError("fused: the deceleration carries no information at any time")

    def trim(at: PulseData, use: BoolArray, about: FloatArray | None) -> Evidence:
        return trim_evidence(at, joint_station_m, use=use, about_yz_rad=about)

    seen = [] if camera is None else [evidence_of_history(camera)]
    seen = [e for e in seen if len(e.time_s)]
    read = pulse_reader(pulse, {"misalignment": misalignment_evidence, "trim": trim}, seen)
    try:
        fused = fuse(read)
    except DivergenceError as fault:
        raise DivergenceError(f"{fault}; {agreement(read({}, None)).words}") from None
    try:
        limbs = southwell_limbs(fused.history, pulse.time_s, pulse.dynamic_pressure_pa)
        words = limbs.words
    except DivergenceError as fault:
        limbs, words = None, str(fault)
    # as told, but by what the answer says the readings' slopes are: far inputs are curved
    inputs = {name: mean for name, (mean, _) in fused.inputs.items()}
    back = {name: -mean for name, mean in inputs.items()}
    told = [moved_evidence(one, back) for one in read(inputs, fused.deflection)]
    return FusedAnswer(fused, agreement(told), limbs, words)


def input_table(answer: FusedAnswer) -> pd.DataFrame:
    """What the methods together say of each input's leading unit normal, and its correlation with the deflection.

    Columns ``input, moved_sd, sd_left, correlation_with_deflection_y, correlation_with_deflection_z``.
    """
    fused, rows = answer.fused, []
    for k, (name, (mean, cov)) in enumerate(fused.inputs.items()):
        rows.append((name, mean[0], np.sqrt(cov[0, 0]), *fused.correlation[2 + k, :2]))
    names = ["input", "moved_sd", "sd_left", "correlation_with_deflection_y", "correlation_with_deflection_z"]
    return pd.DataFrame(rows, columns=names)


def agreement_table(answer: FusedAnswer) -> pd.DataFrame:
    """Return one row a pair of methods: ``methods, chi_square, degrees, chance, passed``."""
    rows = [(" and ".join(p.methods), p.chi_square, p.degrees, p.chance, p.passed) for p in answer.agreement.pairs]
    return pd.DataFrame(rows, columns=["methods", "chi_square", "degrees", "chance", "passed"])
