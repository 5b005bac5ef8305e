"""What sensor makers and estimators must both know of an instrument: where it sits, how it errs on paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray


@dataclass(frozen=True)
class TriadSpec:
    """Three orthogonal sensors (accelerometers, rate gyros or magnetometers) on the centerbody.

    Parameters
    ----------
    name : str
        As in the flight file.
    position_from_datum_body_m : (3,) float
        Where the triad sits, body axes, m.
    dcm_body_sensor : (3, 3) float
        Nominal mounting: ``v_body = dcm_body_sensor @ v_sensor``.
    noise_sd, bias_sd, scale_sd, mount_sd_rad : float
        White noise per sample (m/s^2, rad/s or T), bias (hard iron with it), scale factor, mounting rotation per axis;
        one standard deviation each, as the data sheet gives them.
    resolution : float
        Quantisation step, m/s^2, rad/s or T; 0 for none.
    soft_iron_sd : float
        Of a magnetometer: elements of the symmetric matrix by which the vehicle's iron bends the field.
    bias_wander_sd, bias_time_constant_s : float
        A second part of the bias that varies slowly (Gauss-Markov): its standard deviation, in the triad's unit, and
        time constant; 0 for none.
    time_bias_sd_s : float
        Of its clock: time tag minus true time, constant over a flight.
    """

    name: str
    position_from_datum_body_m: FloatArray
    dcm_body_sensor: FloatArray
    noise_sd: float
    bias_sd: float
    scale_sd: float
    mount_sd_rad: float
    resolution: float = 0.0
    soft_iron_sd: float = 0.0
    bias_wander_sd: float = 0.0
    bias_time_constant_s: float = np.inf
    time_bias_sd_s: float = 0.0


@dataclass(frozen=True)
class RadarSite:
    """A tracking radar: slant range, azimuth from true north, elevation, refraction removed.

    Parameters
    ----------
    name : str
        As in the flight file.
    latitude_rad, longitude_rad, height_m : float
        WGS-84.
    range_sd_m, angle_sd_rad : float
        White noise per sample; the angle's across the line of sight, so azimuth scatters ``1 / cos(elevation)`` more.
    azimuth_sd_rad, elevation_sd_rad : float or None
        The same of one angle, where the two differ; azimuth's across the line of sight too.
    range_bias_sd_m, angle_bias_sd_rad, time_bias_sd_s : float
        Systematic errors, constant over a flight, one standard deviation.
    mislevel_sd_rad, droop_sd_rad, skew_sd_rad, nonorthogonality_sd_rad : float
        Systematic errors of the pedestal (RCC 753-95): its tilt about north and about east, and the factors of cos E in
        elevation, sec E and tan E in azimuth. 0 where nothing is stated.
    wander_sd_rad, wander_time_constant_s : float
        Slow (Gauss-Markov) error of both angles across the line of sight.
    refraction_sd : float
        Of the part of the air's bending that is left in the elevations: 1 where nothing is known of a correction.
    range_scale_sd : float
        Of range error over range: velocity of light, oscillator.
    """

    name: str
    latitude_rad: float
    longitude_rad: float
    height_m: float
    range_sd_m: float
    angle_sd_rad: float
    range_bias_sd_m: float
    angle_bias_sd_rad: float
    time_bias_sd_s: float
    mislevel_sd_rad: float = 0.0
    droop_sd_rad: float = 0.0
    skew_sd_rad: float = 0.0
    nonorthogonality_sd_rad: float = 0.0
    wander_sd_rad: float = 0.0
    wander_time_constant_s: float = 20.0
    refraction_sd: float = 0.0
    range_scale_sd: float = 0.0
    azimuth_sd_rad: float | None = None
    elevation_sd_rad: float | None = None

    @property
    def angles_sd_rad(self) -> tuple[float, float]:
        """White noise across the line of sight, in azimuth's direction and in elevation's."""
        azimuth, elevation = self.azimuth_sd_rad, self.elevation_sd_rad
        return (
            self.angle_sd_rad if azimuth is None else azimuth,
            self.angle_sd_rad if elevation is None else elevation,
        )


@dataclass(frozen=True)
class GnssSpec:
    """A satellite navigation receiver and its antenna.

    Parameters
    ----------
    name : str
        As in the flight file.
    antenna_from_datum_body_m : (3,) float
        Where the antenna sits, body axes, m.
    horizontal_sd_m, vertical_sd_m : float
        White noise of a fix: of each horizontal axis, and of height.
    speed_sd_mps, vertical_speed_sd_mps : float
        White noise of a velocity: of each horizontal axis, and of the vertical one.
    wander_sd_m, wander_time_constant_s : float
        Slowly wandering (Gauss-Markov) part of the position's error, of each axis; 0 for none. Satellites' clocks and
        orbits, the ionosphere and reflections change in minutes, so that one fix repeats the error of the last.
    time_bias_sd_s : float
        Time tag minus true time, constant over a flight: a receiver's latency, or the second that its clock rounds to.
    """

    name: str
    antenna_from_datum_body_m: FloatArray
    horizontal_sd_m: float
    vertical_sd_m: float
    speed_sd_mps: float
    vertical_speed_sd_mps: float
    wander_sd_m: float = 0.0
    wander_time_constant_s: float = 100.0
    time_bias_sd_s: float = 0.0


@dataclass(frozen=True)
class BarometerSpec:
    """A static pressure sensor read as a height.

    Parameters
    ----------
    name : str
        As in the flight file.
    sd_m : float
        White noise of a height.
    bias_sd_m : float
        Constant error: the day's pressure at sea level, the sensor's offset, the undulation of the geoid.
    scale_sd : float
        Error proportional to the height above the first reading: a day warmer or colder than the profile, of which
        1 % in temperature is 1 % in height.
    wander_sd_m, wander_time_constant_s : float
        Slowly wandering (Gauss-Markov) error: the vehicle's own flow, winds; 0 for none.
    time_bias_sd_s : float
        Time tag minus true time, with the lag of a vented bay.
    """

    name: str
    sd_m: float
    bias_sd_m: float
    scale_sd: float
    wander_sd_m: float = 0.0
    wander_time_constant_s: float = 100.0
    time_bias_sd_s: float = 0.0


@dataclass(frozen=True)
class SunHeads:
    """Two-axis Sun sensors on the centerbody, each looking outward at its clocking angle.

    Parameters
    ----------
    name : str
        As in the flight file.
    clock_lv_rad : (k,) float
        Clocking angle of each head.
    field_rad : float
        Full cone about a head's axis in which it sees the Sun.
    noise_sd_rad, bias_sd_rad, mount_sd_rad : float
        White noise per sample and constant error across the line of sight, mounting rotation per axis of each head.
    """

    name: str
    clock_lv_rad: FloatArray
    field_rad: float
    noise_sd_rad: float
    bias_sd_rad: float
    mount_sd_rad: float

    @property
    def dcm_body_head(self) -> FloatArray:
        """Nominal mounting of each head, ``v_body = dcm_body_head[k] @ v_head``, (k, 3, 3)."""
        return np.array([dcm_body_from_sun_head(float(clock)) for clock in self.clock_lv_rad])


def dcm_body_from_clocking(x_axis_lv_rad: float, y_axis_lv_rad: float) -> FloatArray:
    """Mounting of a package whose x and y axes are clocked in the LV frame; z completes the right-hand set.

    Returns
    -------
    (3, 3) float
        ``dcm_body_sensor``.
    """
    from flightmodel.deflection import lv_direction

    x_axis, y_axis = lv_direction(x_axis_lv_rad), lv_direction(y_axis_lv_rad)
    return np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])


def dcm_body_from_sun_head(clock_lv_rad: float) -> FloatArray:
    """Mounting of a Sun head: z along its axis, outward at the clocking angle; x forward, along body x.

    Returns
    -------
    (3, 3) float
        ``dcm_body_head``.
    """
    from flightmodel.deflection import lv_direction

    forward, outward = np.array([1.0, 0.0, 0.0]), lv_direction(clock_lv_rad)
    return np.column_stack([forward, np.cross(outward, forward), outward])


def sun_angles_from_direction(direction_head: FloatArray) -> FloatArray:
    """Azimuth about the head's x from z towards y, and elevation from there towards x, rad ``(..., 2)``.

    ``direction_head`` (..., 3) are unit vectors in head axes. A point ``d`` away across the line of sight differs by
    ``d / cos(elevation)`` in azimuth.
    """
    x, y, z = np.moveaxis(np.asarray(direction_head, dtype=float), -1, 0)
    return np.stack([np.arctan2(y, z), np.arctan2(x, np.hypot(y, z))], axis=-1)


def direction_from_sun_angles(az_el_rad: FloatArray) -> FloatArray:
    """Unit vectors ``(..., 3)`` in head axes: inverse of `sun_angles_from_direction`."""
    az, el = np.moveaxis(np.asarray(az_el_rad, dtype=float), -1, 0)
    return np.stack([np.sin(el), np.cos(el) * np.sin(az), np.cos(el) * np.cos(az)], axis=-1)
