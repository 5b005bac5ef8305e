"""What the estimators that use accelerometers and the BET look at: motion of the centerbody and the flow it met.

Made from a best-estimated trajectory and corrected sensors; it holds no truth. Lateral vectors are in body y, z.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import BoolArray, FloatArray, check_shape
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.vehicle import Vehicle

# below this axial deceleration the ratio of forces and the moment balance carry no information
MIN_AXIAL_MPS2 = 0.3 * STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class PulseData:
    """Everything on one time grid.

    Parameters
    ----------
    time_s : (n,) float
    specific_force_body_mps2 : (n, 3) float
        At the vehicle's unbent c.g., body axes.
    force_noise_sd_mps2 : float
        Its white noise, each axis.
    force_root_mps2 : (n, 3, 9) float
        Its error per unit normal of nine that stand for the accelerometer's constant errors.
    flow_root_rad : (n, 2, 9) float
        What of the flow's error goes with the same nine: attitude and accelerometer were found together.
    rate_body_radps, angular_acceleration_body_radps2 : (n, 3) float
    angular_acceleration_sd_radps2 : float
    flow_yz_rad : (n, 2) float
        Total angle of attack of the centerbody, wind-relative, as a lateral vector (length is the angle).
    flow_cov : (n, 2, 2) float
    wind_flow_sd_rad : (n,) float
        What of the flow's error is the wind's, each component.
    altitude_m : (n,) float
    mach, dynamic_pressure_pa, dynamic_pressure_sd_pa, airspeed_mps : (n,) float
    vehicle : Vehicle
        Pre-flight model.
    force_clock_sd_s, rate_clock_sd_s : float
        How well the clocks of accelerometer and gyros are known, s; zero: they are right.
    cg_from_sensor_m : (3,) float
        Arm over which the gyros carried the accelerometer's reading to the c.g., body axes.
    """

    time_s: FloatArray
    specific_force_body_mps2: FloatArray
    force_noise_sd_mps2: float
    force_root_mps2: FloatArray
    flow_root_rad: FloatArray
    rate_body_radps: FloatArray
    angular_acceleration_body_radps2: FloatArray
    angular_acceleration_sd_radps2: float
    flow_yz_rad: FloatArray
    flow_cov: FloatArray
    wind_flow_sd_rad: FloatArray
    altitude_m: FloatArray
    mach: FloatArray
    dynamic_pressure_pa: FloatArray
    dynamic_pressure_sd_pa: FloatArray
    airspeed_mps: FloatArray
    vehicle: Vehicle
    force_clock_sd_s: float = 0.0
    rate_clock_sd_s: float = 0.0
    cg_from_sensor_m: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Check shapes once."""
        n = len(self.time_s)
        for name, shape in (
            ("specific_force_body_mps2", (n, 3)),
            ("force_root_mps2", (n, 3, 9)),
            ("flow_root_rad", (n, 2, 9)),
            ("rate_body_radps", (n, 3)),
            ("angular_acceleration_body_radps2", (n, 3)),
            ("flow_yz_rad", (n, 2)),
            ("flow_cov", (n, 2, 2)),
        ):
            check_shape(f"pulse.{name}", getattr(self, name), shape)

    @property
    def informative(self) -> BoolArray:
        """Mask ``(n,)`` of samples where the deceleration is large enough."""
        return -self.specific_force_body_mps2[:, 0] >= MIN_AXIAL_MPS2

    @property
    def through_pulse(self) -> BoolArray:
        """Mask ``(n,)`` of the informative samples up to the end of the pressure pulse.

        After it the vehicle swings to angles at which lateral vectors no longer add.
        """
        after = np.flatnonzero(pressure_pulse(self.dynamic_pressure_pa))
        return np.asarray(self.informative & (np.arange(len(self.time_s)) <= after[-1]))


def carried(rate_body_radps: FloatArray, turn_body_radps2: FloatArray, arm_m: FloatArray) -> FloatArray:
    """Specific force ``(n, 3)`` at the end of an arm less that at its beginning, m/s^2."""
    return np.cross(turn_body_radps2, arm_m) + np.cross(rate_body_radps, np.cross(rate_body_radps, arm_m))


def lateral_and_size(vectors_yz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors ``(n, 2)`` (zero for zero) and lengths ``(n,)``."""
    size = np.linalg.norm(vectors_yz, axis=-1)
    return vectors_yz / np.where(size > 0.0, size, 1.0)[..., None], size
