"""What sensor makers and estimators must both know of an instrument: where it sits, how it errs on paper.

What ``flight.toml`` says of each instrument: its table, where it sits, and how it errs on paper.

Standard deviations stand as an analyst writes them, angles in degrees; the records hold SI. Where each default comes
from is said in ``docs/flight-folder.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from flightmodel.checks import FloatArray
from flightmodel.config import Angle, Duration, Fraction, KeyFaults, Place
from flightmodel.tables import Declared, Source


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


Sd = Annotated[float, Field(ge=1e-12, le=1e6)]  # its square is a number that can be divided by
SdOrNone = Annotated[float, Field(ge=0.0, le=1e6)]
Undulation = Annotated[float, Field(ge=-120.0, le=120.0)]  # of the geoid, whose extremes are -106 and +85 m
BodyAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
AXIS = {
    sign + name: factor * np.eye(3)[k] for k, name in enumerate("xyz") for sign, factor in (("+", 1.0), ("-", -1.0))
}


class Mounted(Source):
    """A triad: which way its axes point, by a package of the vehicle file (``mount``) or by body axes (``axes``)."""

    mount: str | None = None
    axes: tuple[BodyAxis, BodyAxis, BodyAxis] | None = None
    position_from_datum_body_m: tuple[Place, Place, Place] | None = None
    bias_time_constant_s: Duration = 100.0

    @model_validator(mode="after")
    def _one_mount(self) -> Mounted:
        faults: list[tuple[str, object, str]] = []
        if self.axes is not None:
            if self.mount is not None:
                faults.append(("axes", list(self.axes), f"mount = '{self.mount}' says it too; keep one of the two"))
            dcm = self.dcm_body_sensor
            if not np.allclose(dcm @ dcm.T, np.eye(3)):
                words = "two sensor axes point along the same body axis; each wants one of its own"
                faults.append(("axes", list(self.axes), words))
            elif np.linalg.det(dcm) < 0.0:
                words = "these axes are left-handed (a mirror image); turn one of the signs or swap two axes"
                faults.append(("axes", list(self.axes), words))
        elif self.position_from_datum_body_m is not None and self.mount != "body":
            words = 'goes with axes = ["+x", "+y", "+z"] or mount = "body"; a package of the vehicle has its own place'
            faults.append(("position_from_datum_body_m", list(self.position_from_datum_body_m), words))
        if faults:
            raise KeyFaults(faults)
        return self

    @property
    def dcm_body_sensor(self) -> FloatArray:
        """Mounting that ``axes`` say, ``v_body = dcm_body_sensor @ v_sensor``, (3, 3); body axes by default."""
        return np.column_stack([AXIS[name] for name in self.axes or ("+x", "+y", "+z")])

    @property
    def place_m(self) -> FloatArray:
        """Place from the datum, body axes, (3,), m; the datum where nothing is said."""
        return np.array(self.position_from_datum_body_m or (0.0, 0.0, 0.0))


class TriadEntry(Mounted):
    """Accelerometer triad: file, mounting, errors from the data sheet (one standard deviation)."""

    noise_sd_mps2: Sd = 0.049
    bias_sd_mps2: SdOrNone = 0.098
    bias_wander_sd_mps2: SdOrNone = 0.0
    scale_sd: SdOrNone = 0.003
    mount_sd_deg: SdOrNone = 0.2
    time_bias_sd_s: SdOrNone = 0.001
    resolution_mps2: SdOrNone = 0.0


class RatesEntry(Mounted):
    """Rate gyros, along body axes unless ``axes`` say otherwise."""

    noise_sd_degps: Sd = 0.05
    bias_sd_degps: SdOrNone = 0.05
    bias_wander_sd_degps: SdOrNone = 0.0
    scale_sd: SdOrNone = 0.003
    mount_sd_deg: SdOrNone = 0.15
    time_bias_sd_s: SdOrNone = 0.001
    resolution_degps: SdOrNone = 0.0


class MagnetometerEntry(Mounted):
    """Magnetometer: file, mounting, errors; the bias holds the vehicle's hard iron too.

    ``reversed`` is for one that reads the field with the opposite sign along all its axes.
    """

    noise_sd_ut: Sd = 0.2
    bias_sd_ut: SdOrNone = 0.5
    bias_wander_sd_ut: SdOrNone = 0.0
    scale_sd: SdOrNone = 0.003
    soft_iron_sd: SdOrNone = 0.0
    mount_sd_deg: SdOrNone = 0.2
    resolution_ut: SdOrNone = 0.0
    reversed: bool = False


class SunEntry(Source):
    """Two-axis Sun sensors, one head looking outward at each clocking angle; an empty cell where a head sees no Sun."""

    heads_lv_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=8)] = (45.0, 135.0, 225.0, 315.0)
    field_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0
    noise_sd_deg: Sd = 1.0
    bias_sd_deg: SdOrNone = 0.5
    mount_sd_deg: SdOrNone = 0.2


class TrackingSource(Source):
    """A table of places; of rows closer than ``every_s`` some are predicted and not used (a smoothed, oversampled one).

    Errors that last several rows are no white noise: taken for it, a hundred rows of one error count as a hundred.
    """

    every_s: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0


class RadarEntry(TrackingSource):
    """A tracking radar and its site (WGS-84)."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-360.0, le=360.0)]
    height_m: Annotated[float, Field(ge=-1e3, le=1e5)]
    tracks: Literal["cg", "datum"] = "cg"
    range_sd_m: Sd = 5.0
    angle_sd_deg: Sd = 0.0086
    azimuth_sd_deg: Sd | None = None
    elevation_sd_deg: Sd | None = None
    range_bias_sd_m: SdOrNone = 3.0
    angle_bias_sd_deg: SdOrNone = 0.003
    time_bias_sd_s: SdOrNone = 0.001
    mislevel_sd_deg: SdOrNone = 0.0
    droop_sd_deg: SdOrNone = 0.0
    skew_sd_deg: SdOrNone = 0.0
    nonorthogonality_sd_deg: SdOrNone = 0.0
    wander_sd_deg: SdOrNone = 0.0
    wander_time_constant_s: Duration = 20.0
    refraction_sd: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    range_scale_sd: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0


class Heights(TrackingSource):
    """A table with heights: above what, and by how much the two surfaces differ."""

    height_is: Literal["ellipsoid", "msl"] | None = None
    geoid_undulation_m: Undulation | None = None

    @model_validator(mode="after")
    def _undulation_known(self) -> Heights:
        if self.height_is == "msl" and self.geoid_undulation_m is None:
            words = (
                "heights above mean sea level need geoid_undulation_m, the height of the geoid above the WGS-84 "
                "ellipsoid at the place (EGM96 or EGM2008; -107 to 85 m)"
            )
            raise KeyFaults([("height_is", self.height_is, words)])
        if self.height_is != "msl" and self.geoid_undulation_m is not None:
            words = 'is used only with height_is = "msl"; say that, or remove it'
            raise KeyFaults([("geoid_undulation_m", self.geoid_undulation_m, words)])
        return self

    @property
    def to_ellipsoid_m(self) -> float:
        """What is added to a height of the table."""
        return self.geoid_undulation_m or 0.0


class GnssEntry(Heights):
    """A satellite navigation receiver: its table, antenna, errors, and which fixes are good enough."""

    antenna_from_datum_body_m: tuple[Place, Place, Place] = (0.0, 0.0, 0.0)
    horizontal_sd_m: Sd = 5.0
    vertical_sd_m: Sd = 10.0
    speed_sd_mps: Sd = 0.5
    vertical_speed_sd_mps: Sd = 1.0
    wander_sd_m: SdOrNone = 3.0
    wander_time_constant_s: Duration = 100.0
    time_bias_sd_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.5
    velocity: bool = True
    min_satellites: Annotated[int, Field(ge=1, le=64)] | None = None
    satellites_column: str = "nsat"
    min_fix_mode: Annotated[int, Field(ge=1, le=9)] | None = None
    fix_mode_column: str = "fix_mode"

    def declared(self, short: str) -> Declared | None:
        """Return the declared column of a quantity; counts are named by keys of their own and have no unit."""
        counts = {"nsat": self.satellites_column, "fix_mode": self.fix_mode_column}
        return Declared(counts[short], "1") if short in counts else super().declared(short)


class BarometerEntry(Heights):
    """A static pressure sensor: its table of heights or pressures, and its errors."""

    sd_m: Sd = 3.0
    bias_sd_m: SdOrNone = 60.0
    scale_sd: Fraction = 0.03
    wander_sd_m: SdOrNone = 5.0
    wander_time_constant_s: Duration = 30.0
    time_bias_sd_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.2


class AtmosphereEntry(Source):
    """The day's sounding; standard deviations default to those of rocketsondes and balloons."""

    @model_validator(mode="after")
    def _no_times(self) -> AtmosphereEntry:
        if self.use_s is not None:
            raise KeyFaults([("use_s", [list(span) for span in self.use_s], "a sounding is by altitude, not by time")])
        return self


class FramesEntry(Source):
    """Onboard video as a list of frames: column ``frame`` holds file names below ``folder``, or numbers in ``film``."""

    folder: str | None = None
    film: str | None = None
    camera: str = "camera5"
    benchmark_s: float = 421.0
    time_bias_sd_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
