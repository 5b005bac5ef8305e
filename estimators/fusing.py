"""What is the combined answer of all methods of a flight, and do they agree?

Camera, misalignment and trim are fused into one posterior of the deflection and of their common inputs
(`estimators.fusion`); every pair is tested and every input scored as a fault hypothesis (`estimators.agreement`); the
fused history against dynamic pressure gives the Southwell lines (`estimators.southwell`). The camera's time bias is
estimated with the rest where the deflection moves enough to observe it.

Where the methods contradict each other, each is tried as the faulty one by leaving it out. If the others agree without
one and only without that one, it stays out (`Fused.left_out`). If the readings cannot tell, the answer is the
mixture of what may be true, with the differences in its covariance (`Fused.alternatives`): the others without
each method, or a posterior in which the likeliest fault's inputs are as good as unknown.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from estimators.agreement import CONFIDENCE, HYPOTHESES, Agreement, agreement, fault_hypotheses
from estimators.deflection_spline import Inputs, Solution
from estimators.evidence import CAMERA_TIME_BIAS, Deflection, Evidence, evidence_of_history, moved_evidence
from estimators.fusion import (
    FarInputsError,
    LoadsReader,
    Method,
    fuse,
    knots_of,
    loads_reader,
    time_bias_is_observable,
)
from estimators.loads import MIN_AXIAL_MPS2, FlightLoads
from estimators.misalignment import estimate_misalignment, misalignment_evidence
from estimators.southwell import Limbs, southwell_limbs
from estimators.trim import estimate_trim, trim_evidence
from flightmodel.checks import Check, DivergenceError, FloatArray, GateError, Result
from flightmodel.deflection import DeflectionHistory, history_from_lateral

_METHODS: dict[str, Method] = {"misalignment": misalignment_evidence, "trim": trim_evidence}
_FREED = 10.0  # times its stated sd an input is as good as unknown: a fault of two stated sd is a fifth of it
_LARGEST_LOG = 50.0  # of odds; more is rounding beside one
_OFF_SD = 4.0
CAMERA_PLANE_SD_RAD = np.deg2rad(1.0)  # of the camera's clocking about the axis
# a priori sd of a camera time bias that is stated as zero, when it is tested: of a recorder's delay; of a wrong second
_WIDE_BIAS_SD_S = 0.3, 1.0


@dataclass(frozen=True)
class CameraTimeBias:
    """Time bias of the camera's frames against the trajectory (late: positive), s, its sd, and whether it was used."""

    offset_s: float
    sd_s: float
    applied: bool

    @property
    def remark(self) -> str:
        """One sentence."""
        used = "corrected in the fusion" if self.applied else "not applied: time_bias_sd_s in [frames] is 0"
        bias_s = round(self.offset_s, 3) + 0.0  # no minus before a zero
        return f"camera time bias {bias_s:+.3f} s, late positive (1 sd {self.sd_s:.3f} s), {used}"

    @property
    def cause(self) -> str:
        """Cause to correct before any other is suspected; empty if the time bias is not significant."""
        return f"the film's time tags come first ({self.remark}), correct them in frames.csv" if self.is_off else ""

    @property
    def is_off(self) -> bool:
        """Whether a bias stated as zero is significant."""
        return not self.applied and abs(self.offset_s) > _OFF_SD * self.sd_s


@dataclass(frozen=True)
class Fused:
    """Posterior of deflection and inputs, tests of the methods against each other, and the Southwell lines.

    Parameters
    ----------
    history : DeflectionHistory
        At the times of the method with most samples; the mixture where there are alternatives.
    solution : Solution
        Posterior of the methods that are used.
    agreement : Agreement
        Of all methods.
    reader : LoadsReader
        Of the loads, and of the camera where it is not left out, whatever was made of their disagreement.
    best_s : float
        Time of the smallest deflection sd by the posterior.
    limbs : Limbs or None
        None where the pulse gives no line; ``limbs_remark`` says why, or what the lines show.
    camera_time_bias : CameraTimeBias or None
    left_out : str or None
        Method that contradicts the others, which agree without it.
    alternatives : tuple of str
        What the answer is a mixture of, in words; empty where the readings agree.
    """

    history: DeflectionHistory
    solution: Solution
    agreement: Agreement
    reader: LoadsReader
    best_s: float
    limbs: Limbs | None = None
    limbs_remark: str = ""
    camera_time_bias: CameraTimeBias | None = None
    left_out: str | None = None
    alternatives: tuple[str, ...] = ()

    @property
    def remark(self) -> str:
        """Whether the methods agree, and the measures taken if they do not."""
        bias = self.camera_time_bias
        words = self.agreement.explained("" if bias is None else bias.cause)
        if self.left_out is not None:
            words += f"; the {self.left_out} contradicts the others, which agree without it: it is left out"
        if self.alternatives:
            words += f"; the answer spans what may be true ({'; '.join(self.alternatives)}), its sd their differences"
        return words

    @property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Whether the methods agree, and whether the camera's time bias is what is stated.

        A time bias that is off comes first: what else the agreement suspects supposes that the frames' times are right.
        """
        passed = not self.agreement.hypotheses and self.left_out is None and not self.alternatives
        likeliest = self.agreement.likeliest
        least = min((p.p_value for p in self.agreement.pairs), default=1.0)
        # a method that is no sensor is wrong by an input of its own
        bias = self.camera_time_bias
        is_late = bias is not None and bias.is_off
        blamed = "camera" if is_late or self.left_out == "camera" else ", ".join(likeliest) or self.left_out or ""
        source = "" if passed else blamed
        name = "deflection methods agree: least chance of a pair"
        checks = [Check("deflection-methods", name, least, 1.0 - CONFIDENCE, 1.0, passed, self.remark, source)]
        if bias is not None and not bias.applied:
            size, source = abs(bias.offset_s) / bias.sd_s, "camera" if bias.is_off else ""
            name = "camera time bias over its sd"
            clock = Check("camera-time-bias", name, size, 0.0, _OFF_SD, not bias.is_off, bias.remark, source)
            checks.insert(0 if bias.is_off else 1, clock)
        return tuple(checks)

    def time_bias_summary(self) -> dict[str, Any] | None:
        """Camera time bias for ``summary.json``; None without a camera history that observes it."""
        bias = self.camera_time_bias
        return None if bias is None else vars(bias) | {"words": bias.remark}

    def southwell_summary(self) -> dict[str, Any]:
        """Critical dynamic pressure and offset with their intervals, for ``summary.json``."""
        if self.limbs is None:
            return {"critical_pressure_pa": None, "words": self.limbs_remark}
        line = self.limbs.both
        return {
            "critical_pressure_pa": line.critical_pressure_pa,
            "critical_pressure_90_percent_pa": list(line.critical_interval_pa),
            "offset_over_xbar_deg": float(np.rad2deg(line.offset_angle_rad)),
            "offset_over_xbar_90_percent_deg": [float(x) for x in np.rad2deg(line.offset_interval_rad)],
            "words": self.limbs_remark,
        }

    def input_frame(self) -> pd.DataFrame:
        """Posterior of each input's leading unit normal, and its correlation with the deflection.

        Columns ``input, moved_sd, sd_left, correlation_with_deflection_y, correlation_with_deflection_z``.
        """
        rows, correlation = [], self.solution.correlation_at(self.best_s)
        for k, (name, (mean, cov)) in enumerate(self.solution.inputs.items()):
            rows.append((name, mean[0], np.sqrt(cov[0, 0]), *correlation[2 + k, :2]))
        names = ["input", "moved_sd", "sd_left", "correlation_with_deflection_y", "correlation_with_deflection_z"]
        return pd.DataFrame(rows, columns=names)

    def agreement_frame(self) -> pd.DataFrame:
        """One row a pair of methods: ``methods, chi_square, degrees, chance, passed``."""
        rows = [(" and ".join(p.methods), p.chi_square, p.degrees, p.p_value, p.passed) for p in self.agreement.pairs]
        return pd.DataFrame(rows, columns=["methods", "chi_square", "degrees", "chance", "passed"])


def fuse_flight(
    loads: FlightLoads,
    camera: DeflectionHistory | None,
    camera_time_bias_sd_s: float = 0.0,
    time_bias: Result[CameraTimeBias | None] | None = None,
) -> Fused:
    """Fuse accelerometers, moment balance and, where there is one, the camera's history.

    A camera time bias with the a priori sd ``camera_time_bias_sd_s`` is estimated with the rest. One that is stated as
    zero is not applied, but tested in a fusion of its own, so that a significant one does not go unnoticed. It is not
    observable from a deflection that hardly moves: then it is taken as zero without a test.

    Parameters
    ----------
    loads : FlightLoads
    camera : DeflectionHistory or None
        With the benchmark frame taken as undeflected.
    camera_time_bias_sd_s : float
    time_bias : Result, optional
        `time_bias_if_free` of the same flight, where it is worked out elsewhere meanwhile.

    Raises
    ------
    GateError
        Where the deceleration carries no information.
    DivergenceError
        Where no two methods have a common answer, with the reason.
    """
    if not loads.through_pulse.any():
        raise GateError(
            f"fused: no sample with an axial deceleration above {MIN_AXIAL_MPS2:.1f} m/s^2: no information on the "
            "deflection",
            code="deceleration-too-small",
        )

    sources = _Sources(loads, camera)
    observable = camera is not None and sources.shows_time_bias()
    bias_sd_s = camera_time_bias_sd_s if observable else 0.0

    def bias() -> CameraTimeBias | None:
        if not observable or bias_sd_s > 0.0:
            return None
        return _tested_time_bias(sources) if time_bias is None else time_bias.result()

    try:
        answer = sources.answer(sources.names, bias_sd_s)
    except DivergenceError as fault:
        resolved = _without_each(sources, bias_sd_s)
        if resolved is None:
            raise _explained(fault, sources, bias_sd_s, bias()) from None
        answer = replace(resolved, agreement=sources.tested(fault, bias_sd_s))
    else:
        if not all(pair.passed for pair in answer.agreement.pairs):
            answer = replace(_without_each(sources, bias_sd_s) or answer, agreement=answer.agreement)
        elif answer.agreement.hypotheses:
            answer = _with_faults_freed(sources, answer, bias_sd_s)
    seen = tuple(n for n in sources.names if n != "camera" or answer.left_out != "camera")
    limbs, remark = _limbs(answer.history, loads)
    return replace(
        answer, reader=sources.reader(seen, bias_sd_s), limbs=limbs, limbs_remark=remark,
        camera_time_bias=answer.camera_time_bias or bias(),
    )  # fmt: skip


def time_bias_if_free(loads: FlightLoads, camera: DeflectionHistory) -> CameraTimeBias | None:
    """Camera time bias as `fuse_flight` tests one that is stated as zero; None where that is not observable."""
    sources = _Sources(loads, camera)
    return _tested_time_bias(sources) if sources.shows_time_bias() else None


@dataclass(frozen=True)
class _Sources:
    """Methods of a flight that may be fused, all or some of them."""

    loads: FlightLoads
    camera: DeflectionHistory | None

    @property
    def names(self) -> tuple[str, ...]:
        """Methods with readings."""
        seen = self.camera is not None and np.isfinite(self.camera.theta_rad).any()
        return (*_METHODS, "camera") if seen else tuple(_METHODS)

    @cached_property
    def by_loads(self) -> LoadsReader:
        """Reader of all methods that read the loads."""
        return loads_reader(self.loads, _METHODS, [])

    def reader(self, names: tuple[str, ...], bias_sd_s: float) -> LoadsReader:
        """Reader of some methods."""
        others = []
        if "camera" in names and self.camera is not None:
            others = [evidence_of_history(self.camera, bias_sd_s, CAMERA_PLANE_SD_RAD)]
        return replace(self.by_loads, methods={n: m for n, m in _METHODS.items() if n in names}, others=others)

    def shows_time_bias(self) -> bool:
        """Whether the deflection moves enough for the camera's time bias to be observed."""
        return time_bias_is_observable(self.reader(self.names, _WIDE_BIAS_SD_S[0]), knots_of(self.loads))

    def answer(self, names: tuple[str, ...], bias_sd_s: float, freed: tuple[str, ...] = ()) -> Fused:
        """Common posterior of some methods and the test of their agreement; `DivergenceError` without one.

        Inputs in ``freed`` are as good as unknown.
        """
        reader = self.reader(names, bias_sd_s)

        def scaled(values: Inputs) -> Inputs:
            return {name: _FREED * x if name in freed else x for name, x in values.items()}

        def read(inputs: Inputs, about: Deflection | None) -> list[Evidence]:
            return [replace(one, by_input=scaled(one.by_input)) for one in reader(scaled(inputs), about)]

        history, solution = fuse(read, knot_s=knots_of(self.loads))
        # at the stated inputs, but with the readings' slopes at the posterior's: far inputs are curved
        inputs = {name: mean for name, (mean, _) in solution.inputs.items()}
        back = {name: -mean for name, mean in inputs.items()}
        stated = [moved_evidence(one, back, solution.deflection) for one in read(inputs, solution.deflection)]
        faults = fault_hypotheses(self.loads, solution.input_posterior, CAMERA_PLANE_SD_RAD)
        tests = agreement(stated, solution.input_posterior, solution.deflection, faults)
        bias = _time_bias(solution, bias_sd_s, True) if CAMERA_TIME_BIAS in inputs else None
        variance = np.trace(history.lateral_cov_without_plane, axis1=1, axis2=2)
        best_s = float(history.time_s[np.argmin(variance)])
        return Fused(history, solution, tests, reader, best_s, camera_time_bias=bias)

    def tested(self, fault: DivergenceError, bias_sd_s: float) -> Agreement:
        """Test of all methods' agreement without a common answer."""
        posterior = fault.input_posterior if isinstance(fault, FarInputsError) else None
        faults = None if posterior is None else fault_hypotheses(self.loads, posterior, CAMERA_PLANE_SD_RAD)
        return agreement(self.reader(self.names, bias_sd_s)({}, None), posterior, faults=faults)


def _without_each(sources: _Sources, bias_sd_s: float) -> Fused | None:
    """Answer where all methods contradict each other: without the one at fault, or a mixture; None if there is none."""
    if len(sources.names) == 2:
        return _of_either(sources)
    rest = {}
    for name in sources.names:
        others = tuple(n for n in sources.names if n != name)
        try:
            rest[name] = sources.answer(others, bias_sd_s if "camera" in others else 0.0)
        except DivergenceError:
            continue
    sound = {n: a for n, a in rest.items() if all(p.passed for p in a.agreement.pairs)}
    if len(sound) == 1:
        ((name, answer),) = sound.items()
        return replace(answer, left_out=name)
    among = sound or rest
    if not among:
        return None
    base = among.get("trim", next(iter(among.values())))
    histories = {f"without {name}": answer.history for name, answer in among.items()}
    return _mixed(base, histories, np.ones(len(histories)))


def _of_either(sources: _Sources) -> Fused | None:
    """Mixture of misalignment alone and trim alone, each sample by sample: trim alone does not follow the joint."""
    histories = {
        "misalignment alone": estimate_misalignment(sources.loads),
        "trim alone": estimate_trim(sources.loads),
    }
    for name in sources.names:
        try:
            return _mixed(sources.answer((name,), 0.0), histories, np.ones(2))
        except DivergenceError:
            continue
    return None


def _with_faults_freed(sources: _Sources, answer: Fused, bias_sd_s: float) -> Fused:
    """Mixture of the answer as stated and those without the likeliest faults' inputs, by their odds."""
    histories, odds = {"all inputs as stated": answer.history}, [1.0]
    for fault in answer.agreement.likeliest:
        try:
            freed = sources.answer(sources.names, bias_sd_s, HYPOTHESES[fault])
        except DivergenceError:
            continue
        histories[f"another {fault}"] = freed.history
        odds.append(float(np.exp(min(answer.agreement.gains[fault], _LARGEST_LOG))))
    return _mixed(answer, histories, np.array(odds)) if len(odds) > 1 else answer


def _mixed(answer: Fused, histories: dict[str, DeflectionHistory], weights: FloatArray) -> Fused:
    """Answer with the mixture of several histories, at its own times; the covariance includes their differences."""
    t, own = answer.history.time_s, answer.history
    yz, cov, weight = [], [], []
    for history, one in zip(histories.values(), weights / weights.sum(), strict=True):
        lateral_cov = history.lateral_cov_without_plane
        known = np.isfinite(lateral_cov[:, 0, 0]) & np.isfinite(history.theta_rad)
        if known.sum() < 2:
            continue
        at = history.time_s[known]
        yz.append(np.stack([np.interp(t, at, c) for c in history.theta_yz_rad[known].T], -1))
        flat = lateral_cov[known].reshape(-1, 4)
        cov.append(np.stack([np.interp(t, at, c) for c in flat.T], -1).reshape(-1, 2, 2))
        weight.append(one)
    share = np.array(weight)[:, None, None] / np.sum(weight)
    mean = np.sum(share * np.array(yz), axis=0)
    apart = np.array(yz) - mean
    total = np.sum(share[..., None] * (np.array(cov) + apart[..., :, None] * apart[..., None, :]), axis=0)
    history = history_from_lateral(t, mean, total, own.method, own.assumptions)
    return replace(answer, history=history, alternatives=tuple(histories))


def _explained(
    fault: DivergenceError, sources: _Sources, bias_sd_s: float, bias: CameraTimeBias | None
) -> DivergenceError:
    """A failed fusion with the fault hypotheses, and the camera time bias with which there is an answer."""
    if bias is None or not bias.is_off:
        return DivergenceError(f"{fault}; {sources.tested(fault, bias_sd_s).remark}", code=fault.codes[0])
    return DivergenceError(f"{bias.cause}: with it there is a common answer; {fault}", code="camera-time-bias")


def _limbs(history: DeflectionHistory, loads: FlightLoads) -> tuple[Limbs | None, str]:
    """Southwell lines of the fused history, and a remark."""
    peak = int(np.argmax(loads.dynamic_pressure_pa))
    pressure_sd = float(loads.dynamic_pressure_sd_pa[peak] / loads.dynamic_pressure_pa[peak])
    try:
        limbs = southwell_limbs(history, loads.time_s, loads.dynamic_pressure_pa, pressure_sd)
    except DivergenceError as fault:
        return None, str(fault)
    return limbs, limbs.remark


def _tested_time_bias(sources: _Sources) -> CameraTimeBias | None:
    """Estimate of a camera time bias stated as zero; None where there is no common answer with it free.

    Where there is none by all methods, without the trim, the least exact: a vehicle that spins fast looks alike a
    period later, and the search for the bias, before it knows any other input, may begin at the wrong one.
    """
    wide_s, names = _WIDE_BIAS_SD_S[-1], sources.names
    without_trim = tuple(n for n in names if n != "trim")
    for sd_s, of in (*((sd_s, names) for sd_s in _WIDE_BIAS_SD_S), (wide_s, without_trim)):
        with contextlib.suppress(DivergenceError):
            _, solution = fuse(sources.reader(of, sd_s), knot_s=knots_of(sources.loads))
            return _time_bias(solution, sd_s, False)
    return None


def _time_bias(solution: Solution, prior_sd_s: float, applied: bool) -> CameraTimeBias:
    mean, covariance = solution.inputs[CAMERA_TIME_BIAS]
    return CameraTimeBias(prior_sd_s * float(mean[0]), prior_sd_s * float(np.sqrt(covariance[0, 0])), applied)
