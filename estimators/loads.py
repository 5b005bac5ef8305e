"""What loads did the vehicle fly through? The input of the estimators that use accelerometers and the trajectory.

Motion of the centerbody and the flow that it met, on one time grid, made from a best-estimated trajectory (BET) and
corrected sensors; it holds no truth. Lateral vectors are in body y, z.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import BoolArray, FloatArray, check_shape
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.vehicle import Vehicle

# below this axial deceleration the ratio of forces and the moment balance carry no information
MIN_AXIAL_MPS2 = 0.3 * STANDARD_GRAVITY_MPS2
_POINTS = ("point_from_datum_m", "cg_from_sensor_m")  # arrays that are no histories


@dataclass(frozen=True)
class FlightLoads:
    """Forces, rates and flow along the flight, each with its errors.

    Parameters
    ----------
    time_s : (n,) float
    specific_force_body_mps2 : (n, 3) float
        At ``point_from_datum_m``, body axes.
    force_noise_sd_mps2 : float
        Its white noise, each axis.
    force_root_mps2 : (n, 3, k) float
        Its error per unit normal of those that stand for the constant errors of accelerometer and gyros.
    flow_root_rad : (n, 2, k) float
        The flow's error per unit normal of the same: attitude and sensors were estimated together.
    rate_root_radps : (n, 3, k) float
        The rate's.
    rate_body_radps, angular_acceleration_body_radps2 : (n, 3) float
    angular_acceleration_sd_radps2 : float
    flow_yz_rad : (n, 2) float
        Total angle of attack of the centerbody, wind-relative, as a lateral vector (length is the angle).
    flow_cov : (n, 2, 2) float
    wind_flow_sd_rad : (n,) float
        The wind's part of the flow's error, each component.
    altitude_m : (n,) float
    mach, dynamic_pressure_pa, dynamic_pressure_sd_pa, airspeed_mps : (n,) float
    vehicle : Vehicle
        Pre-flight model.
    point_from_datum_m : (3,) float
        Point of the centerbody at which force and flow are given: the c.g. of the undeflected vehicle, as stated.
    accelerometer_time_bias_sd_s, gyro_time_bias_sd_s : float
        A priori sd of the sensors' time biases, s; zero: none.
    cg_from_sensor_m : (3,) float
        Arm over which the gyros carried the accelerometer's reading to the c.g., body axes.
    half_window_s : float
        Force and rate are means over so much to both sides; the angular acceleration is the difference of the rate's
        means over whole windows before and after.
    swing_radps : float
        Fastest that lateral vectors swing in body axes: rigid pitching and spin; 0: as slow as may be.

    Raises
    ------
    GateError
        Where an array has another shape.
    """

    time_s: FloatArray
    specific_force_body_mps2: FloatArray
    force_noise_sd_mps2: float
    force_root_mps2: FloatArray
    flow_root_rad: FloatArray
    rate_root_radps: FloatArray
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
    point_from_datum_m: FloatArray
    accelerometer_time_bias_sd_s: float = 0.0
    gyro_time_bias_sd_s: float = 0.0
    cg_from_sensor_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    half_window_s: float = 0.0
    swing_radps: float = 0.0

    def __post_init__(self) -> None:
        """Check shapes once."""
        n, k = len(self.time_s), np.shape(self.force_root_mps2)[-1]
        for name, shape in (
            ("specific_force_body_mps2", (n, 3)),
            ("force_root_mps2", (n, 3, k)),
            ("flow_root_rad", (n, 2, k)),
            ("rate_root_radps", (n, 3, k)),
            ("rate_body_radps", (n, 3)),
            ("angular_acceleration_body_radps2", (n, 3)),
            ("flow_yz_rad", (n, 2)),
            ("flow_cov", (n, 2, 2)),
        ):
            check_shape(f"loads.{name}", getattr(self, name), shape)

    def rows(self, use: BoolArray) -> FlightLoads:
        """Loads at chosen samples."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _POINTS}
        chosen: dict[str, Any] = {name: v[use] for name, v in values.items() if isinstance(v, np.ndarray)}
        return replace(self, **chosen)

    @property
    def informative(self) -> BoolArray:
        """Mask ``(n,)`` of samples where the deceleration is large enough."""
        return -self.specific_force_body_mps2[:, 0] >= MIN_AXIAL_MPS2

    @property
    def quarter_swing_s(self) -> float:
        """A quarter of the fastest swing's period, at least the samples' spacing, s; infinite where it is not given."""
        if self.swing_radps == 0.0 or len(self.time_s) < 2:
            return np.inf
        return max(0.5 * np.pi / self.swing_radps, float(np.median(np.diff(self.time_s))))

    @property
    def through_pulse(self) -> BoolArray:
        """Mask ``(n,)`` of the informative samples up to the end of the pressure pulse.

        After it the vehicle oscillates to angles at which lateral vectors no longer add.
        """
        after = np.flatnonzero(pressure_pulse(self.dynamic_pressure_pa))
        return np.asarray(self.informative & (np.arange(len(self.time_s)) <= after[-1]))


def lateral_and_size(vectors_yz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors ``(n, 2)`` (zero for zero) and lengths ``(n,)``."""
    size = np.linalg.norm(vectors_yz, axis=-1)
    return vectors_yz / np.where(size > 0.0, size, 1.0)[..., None], size
