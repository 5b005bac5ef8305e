"""One answer from all methods of a flight, and whether they agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from estimators.agreement import Agreement, agreement, gross_errors
from estimators.evidence import FILM_CLOCK, Evidence, evidence_of_history, moved_evidence
from estimators.fusion import FarInputsError, Fused, Read, clock_is_seen, fuse, pulse_reader
from estimators.loads import PulseData
from estimators.misalignment import misalignment_evidence
from estimators.southwell import Limbs, southwell_limbs
from estimators.trim import trim_evidence
from flightmodel.checks import BoolArray, DivergenceError, FloatArray, GateError
from flightmodel.deflection import DeflectionHistory

OFF_SD = 4.0
CAMERA_PLANE_SD_RAD = np.deg2rad(1.0)  # of where the camera sits around the axis
LOOSE_CLOCK_SD_S = 0.3  # of a film's clock that is taken as right, when it is asked whether it is


@dataclass(frozen=True)
class FilmClock:
    """How late the film's times are against the trajectory's, s, with its sd, and whether it was used."""

    offset_s: float
    sd_s: float
    applied: bool

    @property
    def words(self) -> str:
        """One sentence."""
        late = f"the film's clock is {'late' if self.offset_s > 0.0 else 'early'} by {abs(self.offset_s):.3f} s"
        used = "allowed for in the fusion" if self.applied else "not applied: time_bias_sd_s in [frames] is 0"
        return f"{late} (1 sd {self.sd_s:.3f} s) against the trajectory's, {used}"

    @property
    def is_off(self) -> bool:
        """Whether times that were taken as right are proved not to be."""
        return not self.applied and abs(self.offset_s) > OFF_SD * self.sd_s


@dataclass(frozen=True)
class FusedAnswer:
    """Posterior of deflection and inputs, tests of the methods against each other, and the Southwell lines."""

    fused: Fused
    agreement: Agreement
    limbs: Limbs | None
    limbs_words: str
    film_clock: FilmClock | None = None

    def clock_summary(self) -> dict[str, Any] | None:
        """Film's clock against the trajectory's, for ``summary.json``; None without a film that tells."""
        clock = self.film_clock
        if clock is None:
            return None
        facts = {"offset_s": clock.offset_s, "sd_s": clock.sd_s, "applied": clock.applied}
        return facts | {"words": clock.words}

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
    pulse: PulseData,
    camera: DeflectionHistory | None,
    joint_station_m: float | None = None,
    film_clock_sd_s: float = 0.0,
) -> FusedAnswer:
    """Fuse accelerometers, moment balance and, where there is one, the camera's history.

    A film's clock that may be off by ``film_clock_sd_s`` is found with the rest. One that is taken as right (zero)
    moves nothing, but is asked for in a fusion of its own, so that what is off does not stay unseen. A deflection that
    hardly moves tells no time: then the clock is taken as right, and nothing is said of it.

    Raises
    ------
    GateError
        Where the deceleration carries no information.
    DivergenceError
        Where there is no common answer; it says why.
    """
    if not pulse.through_pulse.any():
        raise GateError("fused: the deceleration carries no information at any time")

    def trim(
        pulse: PulseData, use: BoolArray, about_yz_rad: FloatArray | None, *, with_inputs: bool = True
    ) -> Evidence:
        return trim_evidence(pulse, joint_station_m, use=use, about_yz_rad=about_yz_rad, with_inputs=with_inputs)

    def reader(clock_sd_s: float) -> Read:
        seen = [] if camera is None else [evidence_of_history(camera, clock_sd_s, CAMERA_PLANE_SD_RAD)]
        return pulse_reader(
            pulse, {"misalignment": misalignment_evidence, "trim": trim}, [e for e in seen if len(e.time_s)]
        )

    seen = camera is not None and clock_is_seen(reader(LOOSE_CLOCK_SD_S))
    told_sd_s = film_clock_sd_s if seen else 0.0
    read = reader(told_sd_s)
    try:
        fused = fuse(read)
    except DivergenceError as fault:
        learnt = fault.learnt if isinstance(fault, FarInputsError) else None
        gross = None if learnt is None else gross_errors(pulse, learnt, CAMERA_PLANE_SD_RAD)
        words = f"{fault}; {agreement(read({}, None), learnt, gross=gross).words}"
        clock = _asked_clock(reader) if seen and told_sd_s == 0.0 else None
        if clock is not None and clock.is_off:
            words += f"; there is an answer if {clock.words}"
        raise DivergenceError(words) from None
    try:
        peak = int(np.argmax(pulse.dynamic_pressure_pa))
        pressure_sd = float(pulse.dynamic_pressure_sd_pa[peak] / pulse.dynamic_pressure_pa[peak])
        limbs = southwell_limbs(fused.history, pulse.time_s, pulse.dynamic_pressure_pa, pressure_sd)
        words = limbs.words
    except DivergenceError as fault:
        limbs, words = None, str(fault)
    # as told, but by what the answer says the readings' slopes are: far inputs are curved
    inputs = {name: mean for name, (mean, _) in fused.inputs.items()}
    back = {name: -mean for name, mean in inputs.items()}
    told = [moved_evidence(one, back, fused.deflection) for one in read(inputs, fused.deflection)]
    clock = None
    if told_sd_s > 0.0:
        clock = _film_clock(fused, told_sd_s, True)
    elif seen:
        clock = _asked_clock(reader)
    gross = gross_errors(pulse, fused.learnt, CAMERA_PLANE_SD_RAD)
    return FusedAnswer(fused, agreement(told, fused.learnt, fused.deflection, gross), limbs, words, clock)


def _asked_clock(reader: Callable[[float], Read]) -> FilmClock | None:
    """What a clock that is taken as right would be found to be; None where there is no common answer with it free."""
    try:
        return _film_clock(fuse(reader(LOOSE_CLOCK_SD_S)), LOOSE_CLOCK_SD_S, False)
    except DivergenceError:
        return None


def _film_clock(fused: Fused, told_sd_s: float, applied: bool) -> FilmClock:
    mean, covariance = fused.inputs[FILM_CLOCK]
    return FilmClock(told_sd_s * float(mean[0]), told_sd_s * float(np.sqrt(covariance[0, 0])), applied)


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
