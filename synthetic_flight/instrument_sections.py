"""How a scenario file describes the instruments: their places, rates and errors, degrees and everyday units.

Every error beyond the first few may be left out and is then absent. Sizes are one standard deviation of what is drawn
once a flight, unless said otherwise.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from flightmodel.config import Section
from flightmodel.refraction import Refractivity
from synthetic_flight.triad_errors import DropoutErrors, TriadErrors

NonNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]
Vector = tuple[float, float, float]
Limits = tuple[Positive, Positive, Positive]


class Dropouts(Section):
    """Lost samples: bursts at a mean rate and of a mean length, and stated intervals ``[from, to]``."""

    rate_hz: NonNegative = 0.0
    mean_s: NonNegative = 0.0
    outages_s: tuple[tuple[float, float], ...] = ()

    @model_validator(mode="after")
    def _ordered(self) -> Dropouts:
        for start, stop in self.outages_s:
            if stop <= start:
                raise ValueError(f"outage from {start} to {stop} s does not end after it starts")
        if (self.rate_hz > 0.0) != (self.mean_s > 0.0):
            raise ValueError("rate_hz and mean_s are given together")
        return self

    @property
    def errors(self) -> DropoutErrors:
        """As the instruments take them."""
        return DropoutErrors(self.rate_hz, self.mean_s, self.outages_s)


class Triad(Section):
    """What accelerometers, gyros and magnetometers have in common.

    ``bandwidth_hz`` is the corner of a low-pass of ``filter_order`` (0 for none); beyond the low-pass's own lag a
    sample shows what was there ``delay_s`` earlier (negative where stamps were corrected for that lag);
    ``nonorthogonality_deg`` tilts the axes against each other; negative values have another scale by
    ``scale_asymmetry``.
    """

    rate_hz: Positive
    scale: NonNegative
    mount_deg: NonNegative
    nonorthogonality_deg: NonNegative = 0.0
    scale_asymmetry: NonNegative = 0.0
    drift_time_constant_s: Positive = 100.0
    bandwidth_hz: NonNegative = 0.0
    filter_order: Literal[1, 2] = 2
    delay_s: float = 0.0
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
            limit=(limit[0] * unit, limit[1] * unit, limit[2] * unit) if limit else None,
            dropouts=self.dropouts.errors if self.dropouts else DropoutErrors(),
        )


class Accelerometer(Triad):
    """Errors of the accelerometer triad; ``elements_sensor_m`` puts each of the three at its own place in the package.

    ``range_mps2`` is of each axis of the package (z is aft in Sub-A).
    """

    noise_mps2: NonNegative
    bias_mps2: NonNegative
    drift_mps2: NonNegative = 0.0
    range_mps2: Limits | None = None
    resolution_mps2: NonNegative = 0.0
    elements_sensor_m: tuple[Vector, Vector, Vector] | None = None

    @property
    def errors(self) -> TriadErrors:
        """In SI."""
        return self._errors(
            1.0, self.noise_mps2, self.bias_mps2, self.drift_mps2, self.resolution_mps2, self.range_mps2
        )


class Rates(Triad):
    """Errors of the rate gyros."""

    noise_degps: NonNegative
    bias_degps: NonNegative
    drift_degps: NonNegative = 0.0
    range_degps: Limits | None = None
    resolution_degps: NonNegative = 0.0

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
    noise_ut: NonNegative
    bias_ut: NonNegative
    hard_iron_ut: NonNegative = 0.0
    soft_iron: NonNegative = 0.0
    drift_ut: NonNegative = 0.0
    range_ut: Limits | None = None
    resolution_ut: NonNegative = 0.0

    @property
    def errors(self) -> TriadErrors:
        """In tesla."""
        return self._errors(1e-6, self.noise_ut, self.bias_ut, self.drift_ut, self.resolution_ut, self.range_ut)


class SunSensors(Section):
    """Two-axis Sun sensors around the roll axis, one head at each clocking angle.

    Noise and bias are across the line of sight. ``field_deg`` is the full cone about a head's axis. ``albedo`` is the
    weight of the sunlit Earth against the Sun in a head that has the nadir in its field (0 for none).
    """

    rate_hz: Positive
    heads_lv_deg: Annotated[tuple[float, ...], Field(min_length=1, max_length=8)] = (45.0, 135.0, 225.0, 315.0)
    field_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0
    noise_deg: NonNegative
    bias_deg: NonNegative
    mount_deg: NonNegative
    resolution_deg: NonNegative = 0.0
    delay_s: float = 0.0
    albedo: NonNegative = 0.0
    dropouts: Dropouts | None = None


class AirRefraction(Section):
    """Refraction of a radar's beam: an exponential profile, or a measured one as ``[height_m, N]`` pairs.

    ``residual`` is the fraction that the range's own correction leaves in the data: 1 is uncorrected.
    """

    surface: NonNegative = 315.0
    scale_height_m: Positive = 7350.0
    profile: Annotated[tuple[tuple[float, Positive], ...], Field(min_length=2)] | None = None
    residual: float = 1.0

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
    was when it was hit. Points beyond ``max_range_m`` or below ``min_elevation_deg`` are not tracked.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    rate_hz: Positive
    offset_s: NonNegative = 0.0
    tracks: Literal["cg", "datum"] = "cg"
    range_sd_m: NonNegative
    angle_sd_deg: NonNegative
    range_bias_m: NonNegative
    angle_bias_deg: NonNegative
    time_bias_s: NonNegative
    range_scale: NonNegative = 0.0
    mislevel_deg: NonNegative = 0.0
    skew_deg: NonNegative = 0.0
    nonorthogonality_deg: NonNegative = 0.0
    droop_deg: NonNegative = 0.0
    encoder_once_deg: NonNegative = 0.0
    encoder_twice_deg: NonNegative = 0.0
    wander_deg: NonNegative = 0.0
    wander_time_constant_s: Positive = 20.0
    angle_servo_hz: NonNegative = 0.0
    transit_time: bool = False
    refraction: AirRefraction | None = None
    range_resolution_m: NonNegative = 0.0
    angle_resolution_deg: NonNegative = 0.0
    max_range_m: Positive | None = None
    min_elevation_deg: float | None = None
    dropouts: Dropouts | None = None


class Video(Section):
    """When the onboard camera records."""

    camera: str
    start_s: float
    stop_s: float
    rate_hz: Positive
    benchmark_s: float


class Attitude(Section):
    """The attitude that the range states to start from."""

    t_s: float
    sd_deg: Positive
