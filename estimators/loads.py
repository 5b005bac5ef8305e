"""What loads did the vehicle fly through? The input of the estimators that use accelerometers and the trajectory.

Motion of the centerbody and the flow that it met, on one time grid, made from a best-estimated trajectory (BET) and
corrected sensors; it holds no truth. Lateral vectors are in body y, z.

`loads_from_arrays` makes them from another team's trajectory. Force and rate are then means over half windows ``h`` to
both sides of an even grid, and the angular acceleration is the difference of the rate's means after and before over
``2 h``. Of a table no denser than the grid they are its samples, and a cubic spline's derivative. White noise is
measured by fourth differences, which a motion below a tenth of the sampling rate hardly enters.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from flightmodel import rotations
from flightmodel.airdata import pressure_pulse
from flightmodel.checks import BoolArray, FloatArray, GateError, check_increasing, check_shape
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.instruments import LoadsErrors
from flightmodel.vehicle import Vehicle

# below this axial deceleration the ratio of forces and the moment balance carry no information
MIN_AXIAL_MPS2 = 0.3 * STANDARD_GRAVITY_MPS2
_POINTS = ("point_from_datum_m", "cg_from_sensor_m")  # arrays that are no histories
SLOPE_AT_RAD = np.deg2rad(2.0)  # where the coefficients' slopes by alpha are taken
GRID_HZ = 20.0  # of loads from a table: eight samples a period of a joint at 2.5 Hz
LEAST_ROWS = 20  # for an answer with a history
_DENSE = 1.5  # samples a step of the grid, from which they are averaged
_FOURTH_DIFFERENCE_VAR = 70.0  # of white noise of variance 1: 1 + 16 + 36 + 16 + 1


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
    def alpha_total_wind_rad(self) -> FloatArray:
        """Total angle of attack of the centerbody, wind-relative (n,)."""
        return lateral_and_size(self.flow_yz_rad)[1]

    @property
    def alpha_total_wind_sd_rad(self) -> FloatArray:
        """Standard deviation (n,) of the total angle of attack."""
        towards, _ = lateral_and_size(self.flow_yz_rad)
        return np.sqrt(np.einsum("ni,nij,nj->n", towards, self.flow_cov, towards))

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


def pitching_radps(vehicle: Vehicle, mach: float, dynamic_pressure_pa: float, spin_radps: float) -> float:
    """Rate, rad/s, at which transverse rates turn in body axes: rigid pitching at a dynamic pressure, and spin."""
    _, normal, moment, _ = vehicle.aero.at(mach, SLOPE_AT_RAD) / SLOPE_AT_RAD
    restoring_m = -(moment * vehicle.reference.length_m - normal * vehicle.cg_m[0])
    inertia = 0.5 * (vehicle.inertia[1, 1] + vehicle.inertia[2, 2])
    square = dynamic_pressure_pa * vehicle.reference.area_m2 * restoring_m / inertia
    return float(np.sqrt(max(square, 0.0)) + abs(spin_radps))


@dataclass(frozen=True)
class LoadsColumns:
    """What a table of another trajectory states, in SI units, body axes of the centerbody.

    Parameters
    ----------
    time_s : (n,) float
        Increasing.
    specific_force_body_mps2 : (n, 3) float
        Of the accelerometer, ``cg_from_sensor_m`` from the c.g.
    rate_body_radps : (n, 3) float
        Relative to inertial space.
    flow_yz_rad : (n, 2) float
        Total angle of attack as a lateral vector, relative to the air.
    mach, dynamic_pressure_pa, airspeed_mps, altitude_m : (n,) float
    flow_sd_rad : (n,) float, optional
        Of each component of the flow, wind included; else by `LoadsErrors`.
    dynamic_pressure_sd_pa : (n,) float, optional
    wind_sd_mps : (n,) float, optional
    """

    time_s: FloatArray
    specific_force_body_mps2: FloatArray
    rate_body_radps: FloatArray
    flow_yz_rad: FloatArray
    mach: FloatArray
    dynamic_pressure_pa: FloatArray
    airspeed_mps: FloatArray
    altitude_m: FloatArray
    flow_sd_rad: FloatArray | None = None
    dynamic_pressure_sd_pa: FloatArray | None = None
    wind_sd_mps: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check the order of times once."""
        check_increasing("loads.time_s", self.time_s)


def loads_from_arrays(
    vehicle: Vehicle, stated: LoadsColumns, errors: LoadsErrors, cg_from_sensor_m: FloatArray
) -> FlightLoads:
    """Loads of a flight whose trajectory somebody else made.

    Parameters
    ----------
    vehicle : Vehicle
        Pre-flight model.
    stated : LoadsColumns
    errors : LoadsErrors
        Of what is not stated.
    cg_from_sensor_m : (3,) float
        From the accelerometer to the c.g. of the undeflected vehicle, body axes, m.

    Raises
    ------
    GateError
        ``too-few-data`` with fewer than 20 rows.
    """
    if len(stated.time_s) < LEAST_ROWS:
        raise GateError(f"loads: {len(stated.time_s)} rows; at least {LEAST_ROWS} are wanted", "too-few-data")
    t, h, force, rate, turn = _on_grid(stated)

    def at(values: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(t, stated.time_s, column) for column in np.atleast_2d(values.T)])

    mach, pressure, airspeed, altitude = (
        at(column)[:, 0] for column in (stated.mach, stated.dynamic_pressure_pa, stated.airspeed_mps, stated.altitude_m)
    )
    samples = max(1.0, 2.0 * h / float(np.median(np.diff(stated.time_s))))
    noise = errors.accelerometer_noise_sd_mps2
    noise = white_noise_sd(stated.specific_force_body_mps2) if noise is None else noise
    rate_noise = errors.rate_noise_sd_degps
    rate_noise = white_noise_sd(stated.rate_body_radps) if rate_noise is None else np.deg2rad(rate_noise)
    wind_mps = errors.wind_sd_mps if stated.wind_sd_mps is None else at(stated.wind_sd_mps)[:, 0]
    wind = wind_mps / np.maximum(airspeed, 1.0)
    alone = np.hypot(np.deg2rad(errors.flow_angle_sd_deg), wind)
    flow_sd = alone if stated.flow_sd_rad is None else at(stated.flow_sd_rad)[:, 0]
    given, part = stated.dynamic_pressure_sd_pa, 0.01 * errors.dynamic_pressure_sd_percent
    pressure_sd = part * pressure if given is None else at(given)[:, 0]
    force_root, rate_root, flow_root = _roots(force, rate, np.sqrt(np.maximum(flow_sd**2 - wind**2, 0.0)), errors)
    peak = int(np.argmax(pressure))
    return FlightLoads(
        time_s=t,
        specific_force_body_mps2=force + rotations.lever_arm_acceleration(rate, turn, cg_from_sensor_m),
        force_noise_sd_mps2=noise / np.sqrt(samples),
        force_root_mps2=force_root,
        flow_root_rad=flow_root,
        rate_root_radps=rate_root,
        rate_body_radps=rate,
        angular_acceleration_body_radps2=turn,
        angular_acceleration_sd_radps2=float(np.sqrt(2.0 / samples) * rate_noise / (2.0 * h)),
        flow_yz_rad=at(stated.flow_yz_rad),
        flow_cov=flow_sd[:, None, None] ** 2 * np.eye(2),
        wind_flow_sd_rad=np.minimum(wind, flow_sd),
        altitude_m=altitude,
        mach=mach,
        dynamic_pressure_pa=pressure,
        dynamic_pressure_sd_pa=pressure_sd,
        airspeed_mps=airspeed,
        vehicle=vehicle,
        point_from_datum_m=vehicle.cg_m,
        accelerometer_time_bias_sd_s=errors.time_bias_sd_s,
        gyro_time_bias_sd_s=errors.time_bias_sd_s,
        cg_from_sensor_m=cg_from_sensor_m,
        half_window_s=h,
        swing_radps=pitching_radps(vehicle, float(mach[peak]), float(pressure[peak]), float(rate[peak, 0])),
    )


def white_noise_sd(values: FloatArray) -> float:
    """Standard deviation of the white noise of even samples (n, k), all columns together, by fourth differences."""
    fourth = np.diff(values, n=4, axis=0)
    scatter = np.median(np.abs(fourth)) / 0.6745  # of a normal variable: the motion's peaks do not count
    return float(scatter / np.sqrt(_FOURTH_DIFFERENCE_VAR))


def _on_grid(stated: LoadsColumns) -> tuple[FloatArray, float, FloatArray, FloatArray, FloatArray]:
    """Times (m,), half window s, force, rate and angular acceleration (m, 3) on an even grid."""
    from scipy.interpolate import CubicSpline

    t, step = stated.time_s, float(np.median(np.diff(stated.time_s)))
    force, rate = stated.specific_force_body_mps2, stated.rate_body_radps
    if step * GRID_HZ * _DENSE > 1.0:
        return t, 0.5 * step, force, rate, np.asarray(CubicSpline(t, rate)(t, 1))
    h = 0.5 / GRID_HZ
    at = np.arange(np.ceil((t[0] + 2.0 * h) * GRID_HZ), np.floor((t[-1] - 2.0 * h) * GRID_HZ) + 1.0) / GRID_HZ
    sums = [CubicSpline(t, values).antiderivative() for values in (force, rate)]

    def mean(k: int, low: FloatArray, high: FloatArray) -> FloatArray:
        return np.asarray((sums[k](high) - sums[k](low)) / (high - low)[:, None])

    turn = (mean(1, at, at + 2.0 * h) - mean(1, at - 2.0 * h, at)) / (2.0 * h)
    return at, h, mean(0, at - h, at + h), mean(1, at - h, at + h), turn


def _roots(
    force: FloatArray, rate: FloatArray, angle_sd: FloatArray, errors: LoadsErrors
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors of force and rate (n, 3, 17) and flow (n, 2, 17) per unit normal.

    Bias, scale and mount of the accelerometer, bias and scale of the gyros, and of the flow's angle, whose sd without
    the wind is ``angle_sd`` (n,), what turns with the body: the mount of an inertial platform, an air data probe. No
    table states how much of the error does: half of the variance here, and the rest is the attitude's, which keeps its
    direction in space.
    """
    axes, n = np.eye(3), len(force)
    force_root, rate_root, flow_root = (np.zeros((n, k, 17)) for k in (3, 3, 2))
    force_root[:, :, 0:3] = errors.accelerometer_bias_sd_mps2 * axes
    force_root[:, :, 3:6] = errors.accelerometer_scale_sd * force[:, :, None] * axes
    force_root[:, :, 6:9] = np.deg2rad(errors.accelerometer_mount_sd_deg) * rotations.skew(force)
    rate_root[:, :, 9:12] = np.deg2rad(errors.rate_bias_sd_degps) * axes
    rate_root[:, :, 12:15] = errors.rate_scale_sd * rate[:, :, None] * axes
    flow_root[:, :, 15:17] = np.sqrt(0.5) * angle_sd[:, None, None] * np.eye(2)
    return force_root, rate_root, flow_root
