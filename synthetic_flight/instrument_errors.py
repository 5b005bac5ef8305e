"""How does a scenario file describe instruments, and how do three real sensors distort what ideal ones would measure?

Keys and sizes of errors come from the tables of `flightmodel.instruments` (one standard deviation of what is drawn once
a flight, degrees and everyday units); the classes here add what the simulator alone has: rates, bandwidth, dropouts,
quantisation, waves of encoders, the air of a radar, the film. Every error beyond the first few may be left out and is
then absent.

A triad's signal, in the order of its way: bandwidth, delay, misalignment of the triad, axes that are not square to each
other, scale (with another one for negative values), bias and its slow drift, noise, range, quantisation, dropped
samples. Each quantity beyond the first four (mounting, scale, bias, noise) draws from a child of the instrument's
generator with a name of its own, so that adding one leaves the others as they were.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from flightmodel import rotations
from flightmodel._kernels import kernel
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.config import (
    Angle,
    Elevation,
    ErrorAngle,
    Fraction,
    KeyFault,
    Latitude,
    Longitude,
    Name,
    Place,
    SampleRate,
    Section,
    Time,
)
from flightmodel.instruments import (
    ACCELEROMETER,
    BUTTERWORTH,
    GNSS,
    MAGNETOMETER,
    RADAR,
    RATES,
    SUN,
    Bandwidth,
    InstrumentTable,
    Size,
    servo_faults,
    with_keys,
)
from flightmodel.refraction import Refractivity
from flightmodel.trajectory import interpolate_rows

CHILD = 0  # stands between an instrument's key and its child's: no name holds a NUL


@dataclass(frozen=True)
class DropoutErrors:
    """Dropouts: bursts per second and their mean length, s, and stated intervals, s."""

    rate_hz: float = 0.0
    mean_s: float = 0.0
    outages_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class TriadErrors:
    """Errors of a triad, SI; the first four are standard deviations, drawn in this order: mount, scale, bias, noise.

    Parameters
    ----------
    mount_rad, scale, bias, noise : float
        Rotation of the triad per axis, scale factor, constant bias, white noise per sample.
    nonorthogonality_rad, scale_asymmetry, drift : float
        Standard deviations of each axis's tilt towards the others, of what negative values gain over the scale, and of
        a Gauss-Markov drift.
    drift_time_constant_s : float
    bandwidth_hz, order : float, int
        Corner (-3 dB) of a low-pass of first order, or second (Butterworth); 0 for none.
    delay_s : float
        A sample stamped t shows what was there at ``t - delay_s``.
    time_bias_s : float
        Standard deviation of a constant that adds to the delay.
    limit : (3,) float or None
        Largest magnitude of each axis; beyond it the sensor reads the limit.
    resolution : float
        Quantisation step, 0 for none.
    dropouts : DropoutErrors
    """

    mount_rad: float
    scale: float
    bias: float
    noise: float
    resolution: float = 0.0
    nonorthogonality_rad: float = 0.0
    scale_asymmetry: float = 0.0
    drift: float = 0.0
    drift_time_constant_s: float = 100.0
    bandwidth_hz: float = 0.0
    order: int = 2
    delay_s: float = 0.0
    time_bias_s: float = 0.0
    limit: tuple[float, float, float] | None = None
    dropouts: DropoutErrors = field(default_factory=DropoutErrors)


def name_key(name: str) -> list[int]:
    """Return a name as the words of a seed's key, four bytes each."""
    raw = name.encode()
    return [int.from_bytes(raw[i : i + 4], "big") for i in range(0, len(raw), 4)]


def child(rng: np.random.Generator, name: str) -> np.random.Generator:
    """Return the generator of one instrument error without advancing the instrument's own."""
    seed = rng.bit_generator.seed_seq
    assert isinstance(seed, np.random.SeedSequence)
    key = (*seed.spawn_key, CHILD, *name_key(name))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))


def low_pass(values: FloatArray, step_s: float, bandwidth_hz: float, order: int) -> FloatArray:
    """Rows ``(n, m)`` at equal steps after a low-pass filter that starts at rest.

    Exact for values that run straight between the rows (first-order hold).
    """
    w = 2.0 * np.pi * bandwidth_hz
    if order == 1:
        return filtered(values, step_s, [w], [1.0, w])
    return filtered(values, step_s, [w * w], [1.0, 2.0 * BUTTERWORTH * w, w * w])


def filtered(values: FloatArray, step_s: float, numerator: list[float], denominator: list[float]) -> FloatArray:
    """Rows ``(n, m)`` after a transfer function in s of unit gain, starting at rest; first-order hold."""
    from scipy import signal  # half a second to import

    top, bottom, _ = signal.cont2discrete((numerator, denominator), step_s, method="foh")
    top = np.asarray(top).ravel()
    start = signal.lfilter_zi(top, bottom)
    out, _ = signal.lfilter(top, bottom, values, axis=0, zi=start[:, None] * values[:1])
    return np.asarray(out)


@kernel
def unit_gauss_markov(keep, white, out):
    """Write Gauss-Markov noise of unit variance into ``out`` (n, m); ``keep`` (n - 1,): correlation from row to row."""
    for i in range(out.shape[1]):
        out[0, i] = white[0, i]
        for k in range(1, out.shape[0]):
            out[k, i] = keep[k - 1] * out[k - 1, i] + math.sqrt(1.0 - keep[k - 1] * keep[k - 1]) * white[k, i]


def gauss_markov(
    time_s: FloatArray, sd: float, time_constant_s: float, columns: int, rng: np.random.Generator
) -> FloatArray:
    """Stationary Gauss-Markov sequences ``(n, columns)`` at increasing times, each of standard deviation ``sd``."""
    keep = np.exp(-np.diff(time_s) / time_constant_s)
    white = rng.standard_normal((len(time_s), columns))
    out = np.empty_like(white)
    unit_gauss_markov(keep, white, out)
    return sd * out


def kept(time_s: FloatArray, spec: DropoutErrors, rng: np.random.Generator) -> BoolArray:
    """Mask of received samples: dropouts begin at random (Poisson) and last exponentially distributed times."""
    keep = np.ones(len(time_s), dtype=bool)
    bursts = [*spec.outages_s]
    if spec.rate_hz > 0.0 and spec.mean_s > 0.0:
        span = float(time_s[-1] - time_s[0])
        starts = time_s[0] + span * rng.random(rng.poisson(spec.rate_hz * span))
        bursts += list(zip(starts, starts + rng.exponential(spec.mean_s, len(starts)), strict=True))
    for start, stop in bursts:
        keep[np.searchsorted(time_s, start) : np.searchsorted(time_s, stop)] = False
    return keep


def clock_late_s(errors: TriadErrors, rng: np.random.Generator) -> float:
    """Lateness of a triad's clock in one flight, s, in addition to its delay."""
    return errors.time_bias_s * float(child(rng, "time bias").standard_normal()) if errors.time_bias_s > 0.0 else 0.0


def sampled(
    at_s: FloatArray, time_s: FloatArray, ideal: FloatArray, errors: TriadErrors, late_s: float = 0.0
) -> FloatArray:
    """Values ``(n, 3)`` of an ideal signal at sampling times, after bandwidth, delay and a clock that is ``late_s``.

    ``ideal`` (m, 3) stands on an even grid ``time_s`` (m,) that begins before the samples.
    """
    if errors.bandwidth_hz > 0.0:
        ideal = low_pass(ideal, float(time_s[1] - time_s[0]), errors.bandwidth_hz, int(errors.order))
    return interpolate_rows(at_s - errors.delay_s - late_s, time_s, ideal)


def measured(
    at_s: FloatArray, sensed: FloatArray, errors: TriadErrors, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times and values ``(k, 3)`` measured by a triad from the true signal ``sensed`` (n, 3) in its nominal axes."""
    turn = rotations.dcm_from_q(rotations.exp(errors.mount_rad * rng.standard_normal(3)))
    factor = 1.0 + errors.scale * rng.standard_normal(3)
    offset = errors.bias * rng.standard_normal(3)
    turned = sensed @ turn
    if errors.nonorthogonality_rad > 0.0:
        tilt = errors.nonorthogonality_rad * child(rng, "nonorthogonality").standard_normal(3)
        turned = turned @ tilted_axes(tilt).T
    scaled = turned * factor
    if errors.scale_asymmetry > 0.0:
        extra = errors.scale_asymmetry * child(rng, "scale asymmetry").standard_normal(3)
        scaled = scaled + np.minimum(turned, 0.0) * extra
    out = scaled + offset + errors.noise * rng.standard_normal(sensed.shape)
    if errors.drift > 0.0:
        out = out + gauss_markov(at_s, errors.drift, errors.drift_time_constant_s, 3, child(rng, "drift"))
    out = quantised(out, errors.limit, errors.resolution)
    keep = kept(at_s, errors.dropouts, child(rng, "dropouts"))
    return at_s[keep], out[keep]


def tilted_axes(tilt_rad: FloatArray) -> FloatArray:
    """Sensing directions (3, 3), row by row, of non-orthogonal axes: x stays, y tilts to x, z to x and y."""
    yx, zx, zy = tilt_rad
    rows = np.array([[1.0, 0.0, 0.0], [yx, 1.0, 0.0], [zx, zy, 1.0]])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def quantised(values: FloatArray, limit: tuple[float, float, float] | None, resolution: float) -> FloatArray:
    """Values ``(n, 3)`` from an analogue-digital converter: quantised and saturated."""
    if resolution <= 0.0:
        return np.clip(values, -np.array(limit), np.array(limit)) if limit else values
    counts = np.round(values / resolution)
    if limit:
        most = np.floor(np.array(limit) / resolution + 1e-9)
        counts = np.clip(counts, -most, most)
    return counts * resolution


RangeError = Annotated[float, Field(ge=0.0, le=1e4)]
Delay = Annotated[float, Field(ge=-10.0, le=10.0)]
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

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        for k, (start, stop) in enumerate(self.outages_s):
            if stop <= start:
                yield f"outages_s.{k}", [start, stop], "the outage does not end after it starts"
        if (self.rate_hz > 0.0) != (self.mean_s > 0.0):
            words = f"with mean_s = {self.mean_s:g}; give both positive for bursts, or both zero for none"
            yield "rate_hz", self.rate_hz, words

    @property
    def errors(self) -> DropoutErrors:
        """Dropouts in the form that the instruments take."""
        return DropoutErrors(self.rate_hz, self.mean_s, self.outages_s)


class Triad(Section):
    """Settings common to accelerometers, gyros and magnetometers beside the errors of their table.

    ``bandwidth_hz`` is the corner of a low-pass of ``filter_order`` (0 for none); beyond the low-pass's own lag a
    sample shows what was there ``delay_s`` earlier (negative where stamps were corrected for that lag), and by a
    constant of the flight of standard deviation ``time_bias_s`` more (accelerometers and gyros alone);
    ``nonorthogonality_deg`` tilts the axes against each other; negative values have another scale by
    ``scale_asymmetry``.
    """

    table: ClassVar[InstrumentTable]
    full_scale_key: ClassVar[str]  # largest magnitude of each axis
    rate_hz: SampleRate
    bandwidth_hz: Bandwidth = 0.0
    filter_order: Literal[1, 2] = 2
    delay_s: Delay = 0.0
    time_bias_s: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    dropouts: Dropouts | None = None

    @property
    def sizes(self) -> dict[str, tuple[float, ...]]:
        """Sizes of the drawn errors, SI, by field of `flightmodel.instruments.TriadSpec`."""
        return self.table.from_scenario(self)

    @property
    def errors(self) -> TriadErrors:
        """Errors of the triad in SI units."""
        size, limit = self.sizes, getattr(self, self.full_scale_key)
        unit = next(row.to_si for row in self.table.rows if row.name == "noise_sd")
        return TriadErrors(
            mount_rad=size["mount_sd_rad"][0],
            scale=size["scale_sd"][0],
            bias=size["bias_sd"][0],
            noise=size["noise_sd"][0],
            resolution=size["resolution"][0],
            nonorthogonality_rad=size["mount_sd_rad"][1],
            scale_asymmetry=size["scale_sd"][1],
            drift=size["bias_wander_sd"][0],
            drift_time_constant_s=size["bias_time_constant_s"][0],
            bandwidth_hz=self.bandwidth_hz,
            order=self.filter_order,
            delay_s=self.delay_s,
            time_bias_s=self.time_bias_s,
            limit=(limit[0] * unit, limit[1] * unit, limit[2] * unit) if limit else None,
            dropouts=self.dropouts.errors if self.dropouts else DropoutErrors(),
        )


@with_keys(ACCELEROMETER.scenario_keys())
class Accelerometer(Triad):
    """Errors of the accelerometer triad; ``mount`` names its package of the vehicle file.

    ``elements_sensor_m`` puts each of the three at its own place in the package; ``range_mps2`` is of each of its axes
    (z is aft in Sub-A).
    """

    table, full_scale_key = ACCELEROMETER, "range_mps2"
    mount: Name = "suba"
    range_mps2: Limits | None = None
    elements_sensor_m: tuple[Vector, Vector, Vector] | None = None


@with_keys(RATES.scenario_keys())
class Rates(Triad):
    """Errors of the rate gyros."""

    table, full_scale_key = RATES, "range_degps"
    range_degps: Limits | None = None


@with_keys(MAGNETOMETER.scenario_keys())
class Magnetometer(Triad):
    """The magnetometer: ``mount`` names a package of the vehicle file.

    ``hard_iron_ut`` is the field of the vehicle's own magnets, per body axis; ``soft_iron`` the size of the elements of
    the symmetric matrix by which its iron distorts the field.
    """

    table, full_scale_key = MAGNETOMETER, "range_ut"
    mount: str = "magnetometer"
    range_ut: Limits | None = None


@with_keys(SUN.scenario_keys())
class SunSensors(Section):
    """Two-axis Sun sensors around the roll axis, one head at each clocking angle.

    Noise and bias are normal to the line of sight; ``field_deg`` is the full cone about a head's axis. ``albedo`` is
    the weight of the sunlit Earth against the Sun in a head that has the nadir in its field (0 for none).
    """

    rate_hz: SampleRate
    heads_lv_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=8)] = (45.0, 135.0, 225.0, 315.0)
    field_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0
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

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        heights = [height for height, _ in self.profile or ()]
        if any(b <= a for a, b in pairwise(heights)):
            yield "", None, "heights of the refractivity profile must increase"

    @property
    def air(self) -> Refractivity:
        """Refractivity profile."""
        if self.profile is None:
            return Refractivity(self.surface, self.scale_height_m)
        table = np.array(self.profile)
        return Refractivity(self.surface, self.scale_height_m, table[:, 0], table[:, 1])


@with_keys(RADAR.scenario_keys())
class Radar(Section):
    """A radar's site and errors, one standard deviation of each; the systematic ones are those of RCC 753-95.

    Sizes of errors are those of `flightmodel.instruments.RadarSite`; ``encoder_once_deg`` and ``encoder_twice_deg`` go
    once and twice a turn of each encoder. ``angle_servo_hz`` is the bandwidth of a tracking servo without velocity lag.
    ``transit_time`` leaves in that an echo shows where the vehicle was when it was hit. Points beyond ``max_range_m``
    or below ``min_elevation_deg`` (the horizon) are not tracked. Range rates are measured where ``range_rate_sd_mps``
    is above 0.
    """

    latitude_deg: Latitude
    longitude_deg: Longitude
    height_m: Height
    rate_hz: SampleRate
    offset_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0
    tracks: Literal["cg", "datum"] = "cg"
    angle_servo_hz: Bandwidth = 0.0
    transit_time: bool = False
    refraction: AirRefraction | None = None
    range_rate_sd_mps: Size = 0.0
    range_resolution_m: RangeError = 0.0
    angle_resolution_deg: ErrorAngle = 0.0
    max_range_m: Annotated[float, Field(gt=0.0, le=1e9)] | None = None
    min_elevation_deg: Elevation = 0.0
    dropouts: Dropouts | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        for key in ("range_rate_bias_mps", "range_rate_wander_mps"):
            if getattr(self, key, 0.0) > 0.0 and self.range_rate_sd_mps == 0.0:
                words = "of a range rate that is not measured: state its noise, range_rate_sd_mps, too"
                yield key, getattr(self, key), words
        yield from servo_faults("servo_lag", getattr(self, "servo_lag", 0.0), self.angle_servo_hz)

    @property
    def refraction_left(self) -> float:
        """Fraction of the refraction that the range's correction leaves uncorrected."""
        return 0.0 if self.refraction is None else abs(self.refraction.residual)


@with_keys(GNSS.scenario_keys())
class Gnss(Section):
    """A satellite navigation receiver: its antenna and errors, those of `flightmodel.instruments.GnssSpec`.

    Fixes hold position and velocity; intervals without any (blackout) are ``dropouts``.
    """

    rate_hz: SampleRate
    offset_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0
    antenna_from_datum_body_m: tuple[Place, Place, Place] = (0.0, 0.0, 0.0)
    dropouts: Dropouts | None = None


ShapeAngle = Annotated[float, Field(ge=-5.0, le=5.0)]


class FilmQuality(Section):
    """Differences of the real camera from its drawing, and recording quality; see `synthetic_flight.film.Imaging`."""

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
    readout_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    quality: Annotated[int, Field(ge=0, le=100)] = 0
    painted: bool = True
    shadows: bool = True
    built_deg: ErrorAngle = 0.0
    loaded_deg: ErrorAngle = 0.0
    loaded_shape_deg: tuple[ShapeAngle, ShapeAngle, ShapeAngle, ShapeAngle, ShapeAngle] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.interlace_s and self.readout_s:
            yield "readout_s", self.readout_s, "either fields (interlace_s) or rows in turn"


class Video(Section):
    """Recording times and quality of the onboard camera."""

    camera: str
    start_s: Time
    stop_s: Time
    rate_hz: Annotated[float, Field(ge=1e-3, le=1000.0)]
    benchmark_s: Time
    format: Literal["png", "avi", "webm"] = "png"
    time_offset_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    earth: bool = False
    imaging: FilmQuality = FilmQuality()

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.stop_s < self.start_s:
            yield "stop_s", self.stop_s, f"after start_s = {self.start_s:g} is wanted"
        if not self.start_s <= self.benchmark_s <= self.stop_s:
            words = f"a time of the video, {self.start_s:g} to {self.stop_s:g} s, is wanted"
            yield "benchmark_s", self.benchmark_s, words


class Attitude(Section):
    """Initial attitude stated by the range."""

    t_s: Time
    sd_deg: Annotated[float, Field(gt=0.0, le=180.0)]


LAST_DIGIT = 1e-6  # of the telemetry's files: noise below it is not in them, and an estimator wants none of zero


def stated_errors(table: InstrumentTable, section: Section, if_there: bool = False) -> list[str]:
    """Lines of flight.toml with an instrument's nominal errors, without drawn values.

    Parameters
    ----------
    table : InstrumentTable
    section : Section
        The instrument's of a scenario.
    if_there : bool
        Those rows alone that are left out where they are zero; without it, the others.
    """
    lines = []
    for row in table.rows:
        sds = [getattr(section, key) for key in row.scenario_keys]
        if not sds or row.left_out != if_there or (row.left_out and not any(sds)):
            continue
        noise = not row.states and not row.left_out and row.name.partition("_sd")[1]
        step = getattr(section, row.step) if row.step else 0.0
        lines.append(f"{row.key} = {_noise_sd(sds[0], step) if noise else _together(*sds)}")
        key, _, scenario_key = row.time_constant
        if key:
            lines.append(f"{key} = {getattr(section, scenario_key)}")
    return lines


def _noise_sd(sd: float, resolution: float) -> float:
    """Return the stated standard deviation; for an ideal instrument, that of its resolution or the last digit."""
    return sd if sd >= LAST_DIGIT else max(LAST_DIGIT, round(resolution / np.sqrt(12.0), 9))


def _together(*sds: float) -> float:
    """Return the root sum square stated for independent errors; a single one is returned as it was written."""
    present = [sd for sd in sds if sd > 0.0]
    return present[0] if len(present) == 1 else float(f"{np.linalg.norm(present):.4g}")
