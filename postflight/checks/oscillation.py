"""Do accelerometer and gyros sense one oscillation, at one time and in one set of axes? (`recon.oscillation`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flightmodel.checks import GateError
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding
from postflight.checks.units_and_axes import TimeBias
from recon.imu_screening import bridge
from recon.oscillation import DELIVERED, LAG, LAG_STEP_S, Oscillation, axes_check, oscillation


class Swings(NamedTuple):
    """Remarks about axes, and the time bias of the accelerometer against the gyros; None where nothing shows it."""

    remarks: list[Finding]
    bias: TimeBias | None


def oscillation_of(found: Sources) -> Swings:
    """Compare accelerometer and gyros by the oscillation of the vehicle; ``triads-axes`` or none."""
    force, rate = found.triads.get("accelerometer"), found.triads.get("rates")
    if force is None or rate is None or found.spec.motion.model != "strapdown":
        return Swings([], None)
    try:
        sensors = bridge(force, 0), bridge(rate, 1)
    except GateError:
        return Swings([], None)
    swings: Oscillation | None = oscillation(*sensors, -np.inf, np.inf, found.vehicle)
    if swings is None:
        return Swings([], None)
    if swings.kind in (DELIVERED, LAG):
        return Swings([], TimeBias("accelerometer", "rates", swings.lag_s, LAG_STEP_S / 2.0))
    check = axes_check(swings, *sensors)
    span = float(force.time_s[0]), float(force.time_s[-1])
    return Swings([Finding("accelerometer, rates", check.remark, *span, "triads-axes")], None)
