"""What is the one answer of all methods of a flight, and do they agree?

Camera, misalignment and trim are fused into one posterior of the deflection and of their common inputs
(`estimators.fusion`); every pair is tested and every input scored as a fault hypothesis (`estimators.agreement`); the
fused history against dynamic pressure gives the Southwell lines (`estimators.southwell`). The camera's time bias is
estimated with the rest where the deflection moves enough to observe it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from estimators.agreement import Agreement, agreement, fault_hypotheses
from estimators.evidence import CAMERA_TIME_BIAS, Evidence, evidence_of_history, moved_evidence
from estimators.fusion import FarInputsError, Fused, Read, fuse, loads_reader, time_bias_is_observable
from estimators.loads import MIN_AXIAL_MPS2, FlightLoads
from estimators.misalignment import misalignment_evidence
from estimators.southwell import Limbs, southwell_limbs
from estimators.trim import trim_evidence
from flightmodel.checks import BoolArray, DivergenceError, FloatArray, GateError
from flightmodel.deflection import DeflectionHistory

_OFF_SD = 4.0
CAMERA_PLANE_SD_RAD = np.deg2rad(1.0)  # of the camera's clocking about the axis
_WIDE_BIAS_SD_S = 0.3  # a priori sd of a camera time bias that is stated as zero, when it is tested


@dataclass(frozen=True)
class CameraTimeBias:
    """Time bias of the camera's frames against the trajectory (late: positive), s, its sd, and whether it was used."""

    offset_s: float
    sd_s: float
    applied: bool

    @property
    def remark(self) -> str:
        """One sentence."""
        way = "late" if self.offset_s > 0.0 else "early"
        used = "corrected in the fusion" if self.applied else "not applied: time_bias_sd_s in [frames] is 0"
        return f"camera time bias {self.offset_s:+.3f} s (1 sd {self.sd_s:.3f} s): frames are tagged {way}; {used}"

    @property
    def is_off(self) -> bool:
        """Whether a bias stated as zero is significant."""
        return not self.applied and abs(self.offset_s) > _OFF_SD * self.sd_s


@dataclass(frozen=True)
class FusedAnswer:
    """Posterior of deflection and inputs, tests of the methods against each other, and the Southwell lines.

    ``limbs`` is None where the pulse gives no line; ``limbs_remark`` says why, or what the lines show.
    """

    fused: Fused
    agreement: Agreement
    limbs: Limbs | None
    limbs_remark: str
    camera_time_bias: CameraTimeBias | None = None

    def time_bias_summary(self) -> dict[str, Any] | None:
        """Camera time bias for ``summary.json``; None without a camera history that observes it."""
        bias = self.camera_time_bias
        if bias is None:
            return None
        return {"offset_s": bias.offset_s, "sd_s": bias.sd_s, "applied": bias.applied, "words": bias.remark}

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
        rows = []
        for k, (name, (mean, cov)) in enumerate(self.fused.inputs.items()):
            rows.append((name, mean[0], np.sqrt(cov[0, 0]), *self.fused.correlation[2 + k, :2]))
        names = ["input", "moved_sd", "sd_left", "correlation_with_deflection_y", "correlation_with_deflection_z"]
        return pd.DataFrame(rows, columns=names)

    def agreement_frame(self) -> pd.DataFrame:
        """One row a pair of methods: ``methods, chi_square, degrees, chance, passed``."""
        rows = [(" and ".join(p.methods), p.chi_square, p.degrees, p.p_value, p.passed) for p in self.agreement.pairs]
        return pd.DataFrame(rows, columns=["methods", "chi_square", "degrees", "chance", "passed"])


def fuse_flight(
    loads: FlightLoads,
    camera: DeflectionHistory | None,
    joint_station_m: float | None = None,
    camera_time_bias_sd_s: float = 0.0,
) -> FusedAnswer:
    """Fuse accelerometers, moment balance and, where there is one, the camera's history.

    A camera time bias with the a priori sd ``camera_time_bias_sd_s`` is estimated with the rest. One that is stated as
    zero is not applied, but tested in a fusion of its own, so that a significant one does not go unnoticed. It is not
    observable from a deflection that hardly moves: then it is taken as zero without a test.

    Parameters
    ----------
    loads : FlightLoads
    camera : DeflectionHistory or None
        With the benchmark frame taken as undeflected.
    joint_station_m : float, optional
        Assumed joint, m aft of the nose; None: the vehicle's.
    camera_time_bias_sd_s : float

    Raises
    ------
    GateError
        Where the deceleration carries no information.
    DivergenceError
        Where there is no common answer, with the reason.
    """
    if not loads.through_pulse.any():
        raise GateError(
            f"fused: no sample with an axial deceleration above {MIN_AXIAL_MPS2:.1f} m/s^2: no information on the "
            "deflection",
            code="deceleration-too-small",
        )

    def trim(
        loads: FlightLoads, use: BoolArray, about_yz_rad: FloatArray | None, *, with_inputs: bool = True
    ) -> Evidence:
        return trim_evidence(loads, joint_station_m, use=use, about_yz_rad=about_yz_rad, with_inputs=with_inputs)

    def reader(bias_sd_s: float) -> Read:
        others = [] if camera is None else [evidence_of_history(camera, bias_sd_s, CAMERA_PLANE_SD_RAD)]
        methods = {"misalignment": misalignment_evidence, "trim": trim}
        return loads_reader(loads, methods, [e for e in others if len(e.time_s)])

    observable = camera is not None and time_bias_is_observable(reader(_WIDE_BIAS_SD_S))
    bias_sd_s = camera_time_bias_sd_s if observable else 0.0
    read = reader(bias_sd_s)
    try:
        fused = fuse(read)
    except DivergenceError as fault:
        raise _explained(fault, loads, read, reader if observable and bias_sd_s == 0.0 else None) from None
    limbs, remark = _limbs(fused, loads)
    # at the stated inputs, but with the readings' slopes at the posterior's: far inputs are curved
    inputs = {name: mean for name, (mean, _) in fused.inputs.items()}
    back = {name: -mean for name, mean in inputs.items()}
    stated = [moved_evidence(one, back, fused.deflection) for one in read(inputs, fused.deflection)]
    bias = None
    if bias_sd_s > 0.0:
        bias = _time_bias(fused, bias_sd_s, True)
    elif observable:
        bias = _tested_time_bias(reader)
    faults = fault_hypotheses(loads, fused.input_posterior, CAMERA_PLANE_SD_RAD)
    tests = agreement(stated, fused.input_posterior, fused.deflection, faults)
    return FusedAnswer(fused, tests, limbs, remark, bias)


def _explained(
    fault: DivergenceError, loads: FlightLoads, read: Read, reader: Callable[[float], Read] | None
) -> DivergenceError:
    """A failed fusion with the fault hypotheses, and the camera time bias with which there is an answer."""
    posterior = fault.input_posterior if isinstance(fault, FarInputsError) else None
    faults = None if posterior is None else fault_hypotheses(loads, posterior, CAMERA_PLANE_SD_RAD)
    message = f"{fault}; {agreement(read({}, None), posterior, faults=faults).remark}"
    bias = None if reader is None else _tested_time_bias(reader)
    if bias is None or not bias.is_off:
        return DivergenceError(message, code=fault.codes[0])
    return DivergenceError(f"{message}; there is an answer with a {bias.remark}", code="camera-time-bias")


def _limbs(fused: Fused, loads: FlightLoads) -> tuple[Limbs | None, str]:
    """Southwell lines of the fused history, and a remark."""
    peak = int(np.argmax(loads.dynamic_pressure_pa))
    pressure_sd = float(loads.dynamic_pressure_sd_pa[peak] / loads.dynamic_pressure_pa[peak])
    try:
        limbs = southwell_limbs(fused.history, loads.time_s, loads.dynamic_pressure_pa, pressure_sd)
    except DivergenceError as fault:
        return None, str(fault)
    return limbs, limbs.remark


def _tested_time_bias(reader: Callable[[float], Read]) -> CameraTimeBias | None:
    """Estimate of a camera time bias stated as zero; None where there is no common answer with it free."""
    try:
        return _time_bias(fuse(reader(_WIDE_BIAS_SD_S)), _WIDE_BIAS_SD_S, False)
    except DivergenceError:
        return None


def _time_bias(fused: Fused, prior_sd_s: float, applied: bool) -> CameraTimeBias:
    mean, covariance = fused.inputs[CAMERA_TIME_BIAS]
    return CameraTimeBias(prior_sd_s * float(mean[0]), prior_sd_s * float(np.sqrt(covariance[0, 0])), applied)
