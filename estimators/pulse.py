"""What the estimators that use accelerometers and the BET look at: motion of the centerbody and the flow it met.

Made from a best-estimated trajectory and corrected sensors; it holds no truth. Lateral vectors are in body y, z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import BoolArray, FloatArray, check_shape
from flightmodel.vehicle import Vehicle

# below this axial deceleration the ratio of forces and the moment balance carry no information
MIN_AXIAL_MPS2 = 0.3 * 9.80665


@dataclass(frozen=True)
class PulseData:
    """Everything on one time grid.

    Parameters
    ----------
    time_s : (n,) float
    specific_force_body_mps2 : (n, 3) float
        At the vehicle's unbent c.g., body axes.
    specific_force_cov : (n, 3, 3) float
        Its covariance, (m/s^2)^2.
    rate_body_radps, angular_acceleration_body_radps2 : (n, 3) float
    angular_acceleration_sd_radps2 : float
    flow_yz_rad : (n, 2) float
        Total angle of attack of the centerbody, wind-relative, as a lateral vector (length is the angle).
    flow_cov : (n, 2, 2) float
    mach, dynamic_pressure_pa, dynamic_pressure_sd_pa, airspeed_mps : (n,) float
    vehicle : Vehicle
        Pre-flight model.
    """

    time_s: FloatArray
    specific_force_body_mps2: FloatArray
    specific_force_cov: FloatArray
    rate_body_radps: FloatArray
    angular_acceleration_body_radps2: FloatArray
    angular_acceleration_sd_radps2: float
    flow_yz_rad: FloatArray
    flow_cov: FloatArray
    mach: FloatArray
    dynamic_pressure_pa: FloatArray
    dynamic_pressure_sd_pa: FloatArray
    airspeed_mps: FloatArray
    vehicle: Vehicle

    def __post_init__(self) -> None:
        """Check shapes once."""
        n = len(self.time_s)
        for name, shape in (
            ("specific_force_body_mps2", (n, 3)),
            ("specific_force_cov", (n, 3, 3)),
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


def lateral_and_size(vectors_yz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors ``(n, 2)`` (zero for zero) and lengths ``(n,)``."""
    size = np.linalg.norm(vectors_yz, axis=-1)
    return vectors_yz / np.where(size > 0.0, size, 1.0)[..., None], size
