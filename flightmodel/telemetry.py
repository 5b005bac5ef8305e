"""What came down from a flight, after the gate: SI units, radians, checked once; the types all floors share.

Reading and writing of flight folders: `flightmodel.flightfolder`.

A rest on the pad with which the data begin (`find_rest`): half-second blocks of samples are at rest where accelerometer
and gyros scatter no more than in the first blocks, their means stay within that scatter, and the specific force has
about the size of gravity: in free fall there is none, under a parachute it shakes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from flightmodel.checks import FloatArray, GateError, Issue, check_increasing, check_shape
from flightmodel.earth import WGS84, Planet
from flightmodel.instruments import (
    BarometerSpec,
    GnssSpec,
    InstrumentSpec,
    LoadsEntry,
    RadarSite,
    SitesSpec,
    SunHeads,
    TriadSpec,
)
from flightmodel.tables import ThinnedSpan
from flightmodel.vehicle import Vehicle

if TYPE_CHECKING:
    from flightmodel.film import Frames

BLOCK_S = 0.5
LARGEST_GAP_S = 0.1  # of inertial data: beside a longer one a window's mean is not of its middle
LEAST_REST_S = 2.0  # shorter, and a vehicle that starts at once may pass
_GRAVITY_MPS2 = 9.8
_GRAVITY_SHARE = 0.25  # by which an accelerometer may read another size: a weak one is to be found, not to be missed
_SCATTER = 3.0  # times that of the first blocks


@dataclass(frozen=True)
class SensorRecord:
    """Readings of one instrument, as its file has them after the gate; what derives from it names them.

    Parameters
    ----------
    spec : InstrumentSpec
    time_s : (n,) float
        Strictly increasing, seconds after t0.
    """

    SHAPES: ClassVar[dict[str, tuple[int | None, ...]]] = {}  # of what is read at one time, by field
    spec: InstrumentSpec
    time_s: FloatArray

    def __post_init__(self) -> None:
        """Check once."""
        check_increasing(self.spec.name, self.time_s)
        for name, shape in self.SHAPES.items():
            check_shape(self.spec.name, getattr(self, name), (len(self.time_s), *shape))


@dataclass(frozen=True)
class TriadRecord(SensorRecord):
    """Samples of three orthogonal sensors in their own axes.

    Parameters
    ----------
    measured_sensor : (n, 3) float
        Specific force m/s^2, rate of the body against inertial space rad/s, or magnetic field T, in sensor axes; NaN
        is missing.
    """

    SHAPES = {"measured_sensor": (3,)}
    spec: TriadSpec
    measured_sensor: FloatArray


@dataclass(frozen=True)
class SunRecord(SensorRecord):
    """Readings of Sun heads.

    Parameters
    ----------
    az_el_head_rad : (n, k, 2) float
        Azimuth and elevation of the Sun in each head's axes (`flightmodel.instruments.sun_angles_from_direction`); NaN
        where a head sees no Sun.
    """

    spec: SunHeads
    az_el_head_rad: FloatArray

    def __post_init__(self) -> None:
        """Check once, the number of heads too."""
        super().__post_init__()
        check_shape(self.spec.name, self.az_el_head_rad, (len(self.time_s), len(self.spec.clock_lv_rad), 2))


@dataclass(frozen=True)
class RadarRecord(SensorRecord):
    """Readings of one radar, telescope or Doppler station; NaN is missing.

    Parameters
    ----------
    range_az_el : (n, 3) float
        Slant range m, azimuth from true north and elevation rad; columns that it does not measure are NaN.
    point : str
        What is tracked: ``"cg"`` (skin track, centroid of the echo near the c.g.) or ``"datum"``.
    every_s : tuple of ThinnedSpan
        Of points closer than this some are predicted, not used.
    range_rate_mps : (n,) float or None
    sd : (n, 4) float or None
        Noise of each range, azimuth, elevation, range rate; NaN, or None, where the site's holds.
    """

    SHAPES = {"range_az_el": (3,)}
    spec: RadarSite
    range_az_el: FloatArray
    point: str = "cg"
    every_s: tuple[ThinnedSpan, ...] = ()
    range_rate_mps: FloatArray | None = None
    sd: FloatArray | None = None


@dataclass(frozen=True)
class GnssRecord(SensorRecord):
    """Fixes of one satellite navigation receiver, of its antenna.

    Parameters
    ----------
    position_ecef_m : (n, 3) float
        NaN is missing; of a receiver that gives velocities alone, all are.
    velocity_ecef_mps : (n, 3) float
        Relative to the rotating Earth; NaN where the receiver gives none.
    every_s : tuple of ThinnedSpan
        Of fixes closer than this some are predicted, not used.
    sd : (n, 4) float, optional
        White noise of each fix in place of the stated one, NaN where that holds: of each horizontal axis and of height,
        m; of each horizontal axis of the velocity and of the vertical one, m/s.
    """

    SHAPES = {"position_ecef_m": (3,), "velocity_ecef_mps": (3,)}
    spec: GnssSpec
    position_ecef_m: FloatArray
    velocity_ecef_mps: FloatArray
    every_s: tuple[ThinnedSpan, ...] = ()
    sd: FloatArray | None = None

    @property
    def has_positions(self) -> bool:
        """Whether it gives positions, not velocities alone."""
        return bool(np.isfinite(self.position_ecef_m).all(axis=1).any())


@dataclass(frozen=True)
class BarometerRecord(SensorRecord):
    """Heights by static pressure.

    Parameters
    ----------
    height_m : (n,) float
        Above the WGS-84 ellipsoid; NaN is missing.
    every_s : tuple of ThinnedSpan
        Of heights closer than this some are predicted, not used.
    """

    SHAPES = {"height_m": ()}
    spec: BarometerSpec
    height_m: FloatArray
    every_s: tuple[ThinnedSpan, ...] = ()


@dataclass(frozen=True)
class Sounding:
    """Atmosphere of the day by altitude, as measured before the flight; wind is where the air goes.

    ``density_sd`` is a fraction of the density; sds come from the file, or from the default error model of
    `flightmodel.atmosphere.default_sounding_sd`; that of the temperature is a sounding's where None.
    """

    altitude_m: FloatArray
    density_kgpm3: FloatArray
    temperature_k: FloatArray
    pressure_pa: FloatArray
    wind_north_mps: FloatArray
    wind_east_mps: FloatArray
    density_sd: FloatArray
    wind_sd_mps: FloatArray
    planet: Planet = WGS84
    temperature_sd_k: FloatArray | None = None


@dataclass(frozen=True)
class StatePrior:
    """Position and velocity at one time from another source: what navigation gives at the entry interface.

    Parameters
    ----------
    time_s : float
    position_ecef_m, velocity_ecef_mps : (3,) float
        Of the tracked point, in axes fixed to the planet, relative to it.
    covariance : (6, 6) float
    """

    time_s: float
    position_ecef_m: FloatArray
    velocity_ecef_mps: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        """Check once."""
        check_shape("start's position", self.position_ecef_m, (3,))
        check_shape("start's velocity", self.velocity_ecef_mps, (3,))
        check_shape("start's covariance", self.covariance, (6, 6))


@dataclass(frozen=True)
class StatedDrag:
    """Axial force coefficient and mass properties of a flight without a vehicle file.

    Parameters
    ----------
    mach, c_a : (k,) float
        Linear between, constant outside.
    area_m2, mass_kg : float
    sd : float
        Of ``C_A S / m``, as a fraction: of C_A and mass together.
    """

    mach: FloatArray
    c_a: FloatArray
    area_m2: float
    mass_kg: float
    sd: float

    def area_per_mass_m2pkg(self, mach: FloatArray) -> FloatArray:
        """``C_A S / m`` at Mach numbers (n,)."""
        return np.interp(mach, self.mach, self.c_a) * self.area_m2 / self.mass_kg


@dataclass(frozen=True)
class AttitudePrior:
    """Attitude at one time from another source, with one standard deviation per body axis."""

    time_s: float
    q_ecef_body: FloatArray
    sd_rad: FloatArray

    def __post_init__(self) -> None:
        """Check once."""
        check_shape("attitude prior", self.q_ecef_body, (4,))
        check_shape("attitude prior's standard deviation", self.sd_rad, (3,))


@dataclass(frozen=True)
class Start:
    """What is known of the start: a span at rest on the Earth, and where the launcher points.

    Parameters
    ----------
    at_rest : (float, float) or None
        From and to, s; None where the vehicle already moves.
    sd_mps : float
        Velocity that may be left then, of each axis: a rocket that sways in the wind.
    azimuth_rad, azimuth_sd_rad : float or None, float
        Of the body's x axis on its launcher, from true north.
    state : StatePrior or None
        Position and velocity that another source gives; then the reconstruction begins there, with or without trackers.
    """

    at_rest: tuple[float, float] | None = None
    sd_mps: float = 0.01
    azimuth_rad: float | None = None
    azimuth_sd_rad: float = 0.0
    state: StatePrior | None = None


@dataclass(frozen=True)
class KnownPlace:
    """Where the vehicle is known to have been by other means than its trackers: a pad, a place of recovery.

    Parameters
    ----------
    name : str
    time_s : float
    latitude_rad, longitude_rad, height_m : float
        WGS-84; the height is NaN where it is not known.
    sd_m, height_sd_m : float
        Of each of north and east, and of the height.
    """

    name: str
    time_s: float
    latitude_rad: float
    longitude_rad: float
    height_m: float
    sd_m: float
    height_sd_m: float


@dataclass(frozen=True)
class UnmodelledSpan:
    """Span with acceleration or rotation that neither the model nor the sensors' stated noise covers.

    Parameters
    ----------
    start_s, end_s : float
    sd_mps2, sd_radps : float
        Acceleration and rate that may be missed for about a second at a time, of each axis.
    """

    start_s: float
    end_s: float
    sd_mps2: float
    sd_radps: float


@dataclass(frozen=True)
class Motion:
    """Stated, not measured, properties of the vehicle's motion.

    Parameters
    ----------
    model : str
        ``"strapdown"``: accelerometers and gyros carry the state. ``"ballistic"``: gravitation and drag do, and, in
        stated spans, an acceleration of which only the size is known.
    drag_area_per_mass_m2pkg : float
        ``C_D S / m`` before anything is learnt.
    drag_sd, drag_time_constant_s : float
        Standard deviation of its natural logarithm, and how long it stays what it is (Gauss-Markov).
    side_sd, side_time_constant_s : float
        Of forces normal to the flow, as a fraction of the drag, and how long they stay what they are.
    trim_sd_rad : float
        Of the angle between body x and the flow where an accelerometer without gyros measures the deceleration.
    acceleration_density : float
        Root power spectral density, (m/s^2)/sqrt(Hz) per axis, of what ballistic flight leaves out everywhere.
    powered_s : tuple of (float, float)
        Spans in which thrust or an opening parachute acts.
    powered_sd_mps2 : float
        Acceleration that may act there, of each axis.
    disturbed : tuple of UnmodelledSpan
        Spans with a size of their own, with or without inertial sensors.
    """

    model: Literal["strapdown", "ballistic"] = "strapdown"
    drag_area_per_mass_m2pkg: float = 0.0
    drag_sd: float = 1.0
    drag_time_constant_s: float = 10.0
    side_sd: float = 0.1
    side_time_constant_s: float = 10.0
    trim_sd_rad: float = 0.0
    acceleration_density: float = 0.002
    powered_s: tuple[tuple[float, float], ...] = ()
    powered_sd_mps2: float = 50.0
    disturbed: tuple[UnmodelledSpan, ...] = ()


@dataclass(frozen=True)
class LoadsTable:
    """Table of another team's trajectory, as it lies there; `postflight.loads_table` makes loads of it.

    ``columns`` are names of columns, with a unit behind a colon, of those quantities that the header leaves open;
    ``time_s`` (n,) are times that are written as clock times.
    """

    path: Path
    stated: LoadsEntry
    columns: dict[str, str]
    time_s: FloatArray | None = None


@dataclass(frozen=True)
class Telemetry:
    """Everything measured on one flight, plus what the analyst states about vehicle, start and motion.

    Rates are not there without an accelerometer; an accelerometer alone measures the deceleration of ballistic flight.
    At least one radar or receiver is there, but where ``start`` gives a state, or the film or another team's ``loads``
    are looked at alone.
    """

    name: str
    t0_utc: str
    synthetic: bool
    vehicle: Vehicle | None
    accelerometer: TriadRecord | None
    rates: TriadRecord | None
    radars: dict[str, RadarRecord]
    sounding: Sounding
    attitude_prior: AttitudePrior | None
    films: dict[str, Frames] = field(default_factory=dict)  # by camera
    magnetometer: TriadRecord | None = None
    sun: SunRecord | None = None
    events: tuple[tuple[str, float], ...] = ()
    findings: tuple[Issue, ...] = ()
    hashes: dict[str, str] = field(default_factory=dict)
    gnss: dict[str, GnssRecord] = field(default_factory=dict)
    barometers: dict[str, BarometerRecord] = field(default_factory=dict)
    motion: Motion = Motion()
    reconstruction: dict[str, object] = field(default_factory=dict)  # settings of [reconstruction]
    sites: SitesSpec = field(default_factory=SitesSpec)
    places: tuple[KnownPlace, ...] = ()
    start: Start = Start()
    assumed: dict[str, dict[str, float]] = field(default_factory=dict)  # sds that no file states, by table and key
    drag: StatedDrag | None = None  # without a vehicle file
    planet: Planet = WGS84
    loads: LoadsTable | None = None

    @property
    def frames(self) -> Frames | None:
        """Film of the first camera; None without video."""
        return next(iter(self.films.values()), None)

    @property
    def has_other_positions(self) -> bool:
        """Whether a receiver's positions or a barometer can contradict what all radar sites share."""
        return bool(self.barometers) or any(record.has_positions for record in self.gnss.values())

    def span_s(self) -> tuple[float, float]:
        """First and last time that all triads and at least one radar or receiver cover together."""
        trackers = [r.time_s for r in self.radars.values()] + [r.time_s for r in self.gnss.values()]
        triads = [t.time_s for t in (self.accelerometer, self.rates) if t is not None]
        if self.start.state is not None:
            trackers.append(np.array([self.start.state.time_s, np.inf]))
        start = max([min(t[0] for t in trackers), *(t[0] for t in triads)])
        return float(start), float(min([max(t[-1] for t in trackers), *(t[-1] for t in triads)]))

    def required_vehicle(self) -> Vehicle:
        """Return the vehicle, or raise `GateError` where flight.toml names none."""
        if self.vehicle is None:
            raise GateError(
                f"flight '{self.name}' names no vehicle, whose mass properties and coefficients are needed here; add "
                'vehicle = "..." to flight.toml (a vehicle that ships with the toolkit, or the path of a vehicle file)',
                code="vehicle-missing",
            )
        return self.vehicle

    @property
    def can_tell_load(self) -> bool:
        """Whether a path and what moves along it give the load at the frames of a film.

        By inertial sensors the moment in the joint, else the dynamic pressure alone.
        """
        moves = self.motion.model == "ballistic" or (self.accelerometer is not None and self.rates is not None)
        return self.vehicle is not None and moves and bool(self.radars or self.gnss)

    @property
    def drag_accelerometer(self) -> TriadRecord | None:
        """The accelerometer whose deceleration the drag of ballistic flight follows; None where none does."""
        return self.accelerometer if self.motion.trim_sd_rad > 0.0 else None

    def required_triads(self) -> tuple[TriadRecord, TriadRecord]:
        """Return accelerometer and rates, or raise `GateError` where flight.toml names none."""
        if self.accelerometer is None or self.rates is None:
            raise GateError(
                f"flight '{self.name}' has no inertial sensors, which are needed here; add [sensors.accelerometer] and "
                "[sensors.rates] to flight.toml",
                code="inertial-missing",
            )
        return self.accelerometer, self.rates


@dataclass(frozen=True)
class RestReadings:
    """Mean and standard deviation (3,) of a triad's whole samples in a span, sensor axes, and how many there are."""

    mean: FloatArray
    sd: FloatArray
    count: int

    @property
    def noise_sd(self) -> float:
        """White noise of a sample, all axes alike."""
        return float(np.sqrt(np.mean(self.sd**2)))


def mean_readings(record: TriadRecord, span_s: tuple[float, float]) -> RestReadings:
    """What a triad reads from one time to another."""
    inside = (record.time_s >= span_s[0]) & (record.time_s <= span_s[1])
    samples = record.measured_sensor[inside]
    samples = samples[np.isfinite(samples).all(axis=1)]
    if len(samples) < 2:
        return RestReadings(np.full(3, np.nan), np.full(3, np.nan), len(samples))
    return RestReadings(samples.mean(axis=0), samples.std(axis=0, ddof=1), len(samples))


def find_rest(force: TriadRecord, rate: TriadRecord) -> tuple[float, float] | None:
    """Span at rest at the start of the data, minus one block at its end; None if shorter than `LEAST_REST_S`."""
    start_s = max(force.time_s[0], rate.time_s[0])
    end_s = min(force.time_s[-1], rate.time_s[-1])
    still: list[tuple[RestReadings, RestReadings]] = []
    at = start_s
    while at + BLOCK_S <= end_s:
        block = mean_readings(force, (at, at + BLOCK_S)), mean_readings(rate, (at, at + BLOCK_S))
        if not _is_still(block, still, (force, rate)):
            break
        still.append(block)
        at += BLOCK_S
    length = BLOCK_S * (len(still) - (at + BLOCK_S <= end_s))
    return (float(start_s), float(start_s + length)) if length >= LEAST_REST_S else None


def _is_still(
    block: tuple[RestReadings, RestReadings],
    before: list[tuple[RestReadings, RestReadings]],
    records: tuple[TriadRecord, TriadRecord],
) -> bool:
    size = float(np.linalg.norm(block[0].mean))
    if not abs(size - _GRAVITY_MPS2) < _GRAVITY_SHARE * _GRAVITY_MPS2:
        return False
    for k, record in enumerate(records):
        first = [b[k] for b in before[:3]] or [block[k]]
        scatter = np.median([b.sd for b in first], axis=0) + record.spec.resolution + 1e-9
        mean = np.median([b.mean for b in first], axis=0)
        if (block[k].sd > _SCATTER * scatter).any() or (np.abs(block[k].mean - mean) > _SCATTER * scatter).any():
            return False
    return True
