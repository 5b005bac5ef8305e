"""How a scenario file describes the instruments: their places, rates and errors, degrees and everyday units.

Every error beyond the first few may be left out and is then absent. Sizes are one standard deviation of what is drawn
once a flight, unless said otherwise.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from flightmodel.config import (
    Angle,
    Elevation,
    ErrorAngle,
    Fraction,
    KeyFaults,
    Latitude,
    Longitude,
    SampleRate,
    Section,
    Time,
)
from flightmodel.refraction import Refractivity
from synthetic_flight.triad_errors import DropoutErrors, TriadErrors


def _none_or_some(hertz: float) -> float:
    if 0.0 < hertz < 1e-3:
        raise ValueError("0 for none, or at least 0.001 Hz is wanted")
    return hertz


# sizes of errors: of triads in their own everyday unit, of ranges in metres
Size = Annotated[float, Field(ge=0.0, le=1e4)]
RangeError = Annotated[float, Field(ge=0.0, le=1e4)]
Bandwidth = Annotated[float, Field(ge=0.0, le=1e5), AfterValidator(_none_or_some)]
Delay = Annotated[float, Field(ge=-10.0, le=10.0)]
TimeConstant = Annotated[float, Field(ge=1e-3, le=1e6)]
Limit = Annotated[float, Field(gt=0.0, le=1e6)]
Offset = Annotated[float, Field(ge=-10.0, le=10.0)]
Height = Annotated[float, Field(ge=-500.0, le=1e4)]
ProfileHeight = Annotated[float, Field(ge=-1e3, le=1e6)]
Refractive = Annotated[float, Field(gt=0.0, le=1000.0)]
Vector = tuple[Offset, Offset, Offset]
Limits = tuple[Limit, Limit, Limit]


class Dropouts(Section):
    """Lost samples: bursts at a mean rate and of a mean length, and stated intervals ``[from, to]``."""

    rate_hz: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    mean_s: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0
    outages_s: tuple[tuple[Time, Time], ...] = ()

    @model_validator(mode="after")
    def _ordered(self) -> Dropouts:
        faults: list[tuple[str, object, str]] = [
            (f"outages_s.{k}", [start, stop], "the outage does not end after it starts")
            for k, (start, stop) in enumerate(self.outages_s)
            if stop <= start
        ]
        if (self.rate_hz > 0.0) != (self.mean_s > 0.0):
            words = f"with mean_s = {self.mean_s:g}; give both positive for bursts, or both zero for none"
            faults.append(("rate_hz", self.rate_hz, words))
        if faults:
            raise KeyFaults(faults)
        return self

    @property
    def errors(self) -> DropoutErrors:
        """As the instruments take them."""
        return DropoutErrors(self.rate_hz, self.mean_s, self.outages_s)


class Triad(Section):
    """What accelerometers, gyros and magnetometers have in common.

    ``bandwidth_hz`` is the corner of a low-pass of ``filter_order`` (0 for none); beyond the low-pass's own lag a
    sample shows what was there ``delay_s`` earlier (negative where stamps were corrected for that lag), and by a
    constant of the flight of standard deviation ``time_bias_s`` more (accelerometers and gyros alone);
    ``nonorthogonality_deg`` tilts the axes against each other; negative values have another scale by
    ``scale_asymmetry``.
    """

    rate_hz: SampleRate
    scale: Fraction
    mount_deg: ErrorAngle
    nonorthogonality_deg: ErrorAngle = 0.0
    scale_asymmetry: Fraction = 0.0
    drift_time_constant_s: TimeConstant = 100.0
    bandwidth_hz: Bandwidth = 0.0
    filter_order: Literal[1, 2] = 2
    delay_s: Delay = 0.0
    time_bias_s: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    dropouts: Dropouts | None = None

    def _errors(
        self, unit: float, noise: float, bias: float, drift: float, resolution: float, limit: Limits | None
    ) -> TriadErrors:
        return TriadErrors(
            mount_rad=float(np.deg2rad(self.mount_deg)),
            scale=self.scale,
            bias=bias * unit,
            noise=noise * unit,
            resolution=resolution * unit,
            nonorthogonality_rad=float(np.deg2rad(self.nonorthogonality_deg)),
            scale_asymmetry=self.scale_asymmetry,
            drift=drift * unit,
            drift_time_constant_s=self.drift_time_constant_s,
            bandwidth_hz=self.bandwidth_hz,
            order=self.filter_order,
            delay_s=self.delay_s,
            time_bias_s=self.time_bias_s,
            limit=(limit[0] * unit, limit[1] * unit, limit[2] * unit) if limit else None,
            dropouts=self.dropouts.errors if self.dropouts else DropoutErrors(),
        )


class Accelerometer(Triad):
    """Errors of the accelerometer triad; ``elements_sensor_m`` puts each of the three at its own place in the package.

    ``range_mps2`` is of each axis of the package (z is aft in Sub-A).
    """

    noise_mps2: Size
    bias_mps2: Size
    drift_mps2: Size = 0.0
    range_mps2: Limits | None = None
    resolution_mps2: Size = 0.0
    elements_sensor_m: tuple[Vector, Vector, Vector] | None = None

    @property
    def errors(self) -> TriadErrors:
        """In SI."""
        return self._errors(
            1.0, self.noise_mps2, self.bias_mps2, self.drift_mps2, self.resolution_mps2, self.range_mps2
        )


class Rates(Triad):
    """Errors of the rate gyros."""

    noise_degps: Size
    bias_degps: Size
    drift_degps: Size = 0.0
    range_degps: Limits | None = None
    resolution_degps: Size = 0.0

    @property
    def errors(self) -> TriadErrors:
        """In rad/s."""
        unit = float(np.deg2rad(1.0))
        return self._errors(
            unit, self.noise_degps, self.bias_degps, self.drift_degps, self.resolution_degps, self.range_degps
        )


class Magnetometer(Triad):
    """The magnetometer: ``mount`` names a package of the vehicle file.

    ``hard_iron_ut`` is the field of the vehicle's own magnets, per body axis; ``soft_iron`` the size of the elements of
    the symmetric matrix by which its iron bends the field.
    """

    mount: str = "magnetometer"
    noise_ut: Size
    bias_ut: Size
    hard_iron_ut: Size = 0.0
    soft_iron: Fraction = 0.0
    drift_ut: Size = 0.0
    range_ut: Limits | None = None
    resolution_ut: Size = 0.0

    @property
    def errors(self) -> TriadErrors:
        """In tesla."""
        return self._errors(1e-6, self.noise_ut, self.bias_ut, self.drift_ut, self.resolution_ut, self.range_ut)


class SunSensors(Section):
    """Two-axis Sun sensors around the roll axis, one head at each clocking angle.

    Noise and bias are across the line of sight. ``field_deg`` is the full cone about a head's axis. ``albedo`` is the
    weight of the sunlit Earth against the Sun in a head that has the nadir in its field (0 for none).
    """

    rate_hz: SampleRate
    heads_lv_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=8)] = (45.0, 135.0, 225.0, 315.0)
    field_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0
    noise_deg: ErrorAngle
    bias_deg: ErrorAngle
    mount_deg: ErrorAngle
    resolution_deg: ErrorAngle = 0.0
    delay_s: Delay = 0.0
    albedo: Fraction = 0.0
    dropouts: Dropouts | None = None


class AirRefraction(Section):
    """Refraction of a radar's beam: an exponential profile, or a measured one as ``[height_m, N]`` pairs.

    ``residual`` is the fraction that the range's own correction leaves in the data: 1 is uncorrected.
    """

    surface: Annotated[float, Field(ge=0.0, le=1000.0)] = 315.0
    scale_height_m: Annotated[float, Field(ge=500.0, le=1e5)] = 7350.0
    profile: Annotated[tuple[tuple[ProfileHeight, Refractive], ...], Field(min_length=2)] | None = None
    residual: Annotated[float, Field(ge=-10.0, le=10.0)] = 1.0

    @model_validator(mode="after")
    def _increasing(self) -> AirRefraction:
        heights = [height for height, _ in self.profile or ()]
        if any(b <= a for a, b in pairwise(heights)):
            raise ValueError("heights of the refractivity profile must increase")
        return self

    @property
    def air(self) -> Refractivity:
        """The profile."""
        if self.profile is None:
            return Refractivity(self.surface, self.scale_height_m)
        table = np.array(self.profile)
        return Refractivity(self.surface, self.scale_height_m, table[:, 0], table[:, 1])


class Radar(Section):
    """A radar's site and errors, one standard deviation of each; the systematic ones are those of RCC 753-95.

    ``mislevel_deg`` is the tilt of the pedestal about north and about east; ``skew_deg`` (RF axis against the elevation
    axis) errs in azimuth by sec E, ``nonorthogonality_deg`` by tan E, ``droop_deg`` in elevation by cos E;
    ``encoder_once_deg`` and ``encoder_twice_deg`` go once and twice a turn of each encoder. ``angle_servo_hz`` is the
    bandwidth of a tracking servo without velocity lag. ``transit_time`` leaves in that an echo shows where the vehicle
    was when it was hit. Points beyond ``max_range_m`` or below ``min_elevation_deg`` (the horizon) are not tracked.
    """

    latitude_deg: Latitude
    longitude_deg: Longitude
    height_m: Height
    rate_hz: SampleRate
    offset_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0
    tracks: Literal["cg", "datum"] = "cg"
    range_sd_m: RangeError
    angle_sd_deg: ErrorAngle
    range_bias_m: RangeError
    angle_bias_deg: ErrorAngle
    time_bias_s: Annotated[float, Field(ge=0.0, le=10.0)]
    range_scale: Fraction = 0.0
    mislevel_deg: ErrorAngle = 0.0
    skew_deg: ErrorAngle = 0.0
    nonorthogonality_deg: ErrorAngle = 0.0
    droop_deg: ErrorAngle = 0.0
    encoder_once_deg: ErrorAngle = 0.0
    encoder_twice_deg: ErrorAngle = 0.0
    wander_deg: ErrorAngle = 0.0
    wander_time_constant_s: TimeConstant = 20.0
    angle_servo_hz: Bandwidth = 0.0
    transit_time: bool = False
    refraction: AirRefraction | None = None
    range_resolution_m: RangeError = 0.0
    angle_resolution_deg: ErrorAngle = 0.0
    max_range_m: Annotated[float, Field(gt=0.0, le=1e9)] | None = None
    min_elevation_deg: Elevation = 0.0
    dropouts: Dropouts | None = None


class FilmQuality(Section):
    """How the real camera differs from its drawing, and how it records; see `synthetic_flight.video.Imaging`."""

    pointing_deg: ErrorAngle = 0.5
    focal: Fraction = 0.01
    centre_px: Annotated[float, Field(ge=0.0, le=1e4)] = 1.0
    k1: Fraction = 0.003
    k2: Fraction = 0.0
    position_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.002
    noise_grey: Annotated[float, Field(ge=0.0, le=255.0)] = 2.5
    blur_px: Annotated[float, Field(gt=0.0, le=100.0)] = 0.8
    vignetting: Fraction = 0.38
    interlace_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    quality: Annotated[int, Field(ge=0, le=100)] = 0
    painted: bool = True
    built_deg: ErrorAngle = 0.0
    loaded_deg: ErrorAngle = 0.0


class Video(Section):
    """When the onboard camera records, and how well."""

    camera: str
    start_s: Time
    stop_s: Time
    rate_hz: Annotated[float, Field(ge=1e-3, le=1000.0)]
    benchmark_s: Time
    format: Literal["png", "avi", "webm"] = "png"
    time_offset_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    earth: bool = False
    imaging: FilmQuality = FilmQuality()

    @model_validator(mode="after")
    def _ordered(self) -> Video:
        if self.stop_s < self.start_s:
            raise KeyFaults([("stop_s", self.stop_s, f"after start_s = {self.start_s:g} is wanted")])
        if not self.start_s <= self.benchmark_s <= self.stop_s:
            words = f"a time of the video, {self.start_s:g} to {self.stop_s:g} s, is wanted"
            raise KeyFaults([("benchmark_s", self.benchmark_s, words)])
        return self


class Attitude(Section):
    """The attitude that the range states to start from."""

    t_s: Time
    sd_deg: Annotated[float, Field(gt=0.0, le=180.0)]
