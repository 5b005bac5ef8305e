"""What came down from a flight, after the gate: SI units, radians, checked once; the types all floors share.

Reading and writing of flight folders: `flightmodel.flightfolder`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flightmodel.checks import FloatArray, check_increasing, check_shape
from flightmodel.instruments import RadarSite, SunHeads, TriadSpec
from flightmodel.vehicle import CameraMount, Vehicle


@dataclass(frozen=True)
class TriadRecord:
    """Samples of three orthogonal sensors in their own axes.

    Parameters
    ----------
    spec : TriadSpec
    time_s : (n,) float
        Strictly increasing, seconds after t0.
    measured_sensor : (n, 3) float
        Specific force m/s^2, rate of the body against inertial space rad/s, or magnetic field T, in sensor axes; NaN
        is missing.
    """

    spec: TriadSpec
    time_s: FloatArray
    measured_sensor: FloatArray

    def __post_init__(self) -> None:
        """Check once."""
        check_increasing(self.spec.name, self.time_s)
        check_shape(self.spec.name, self.measured_sensor, (len(self.time_s), 3))


@dataclass(frozen=True)
class SunRecord:
    """What Sun heads saw.

    Parameters
    ----------
    spec : SunHeads
    time_s : (n,) float
        Strictly increasing, seconds after t0.
    az_el_head_rad : (n, k, 2) float
        Azimuth and elevation of the Sun in each head's axes (`flightmodel.instruments.sun_angles_from_direction`); NaN
        where a head sees no Sun.
    """

    spec: SunHeads
    time_s: FloatArray
    az_el_head_rad: FloatArray

    def __post_init__(self) -> None:
        """Check once."""
        check_increasing(self.spec.name, self.time_s)
        check_shape(self.spec.name, self.az_el_head_rad, (len(self.time_s), len(self.spec.clock_lv_rad), 2))


@dataclass(frozen=True)
class RadarRecord:
    """Track points of one radar: slant range m, azimuth from true north rad, elevation rad; NaN is missing.

    ``point`` is what is tracked: ``"cg"`` (skin track, centroid of the echo near the c.g.) or ``"datum"``.
    """

    site: RadarSite
    time_s: FloatArray
    range_az_el: FloatArray
    point: str = "cg"

    def __post_init__(self) -> None:
        """Check once."""
        check_increasing(self.site.name, self.time_s)
        check_shape(self.site.name, self.range_az_el, (len(self.time_s), 3))


@dataclass(frozen=True)
class Sounding:
    """Atmosphere of the day by altitude, as measured before the flight; wind is where the air goes.

    ``density_sd`` is a fraction of the density; sds come from the file, or from the default error model of
    `flightmodel.atmosphere.default_sounding_sd`.
    """

    altitude_m: FloatArray
    density_kgpm3: FloatArray
    temperature_k: FloatArray
    pressure_pa: FloatArray
    wind_north_mps: FloatArray
    wind_east_mps: FloatArray
    density_sd: FloatArray
    wind_sd_mps: FloatArray


@dataclass(frozen=True)
class AttitudePrior:
    """Attitude at one time from another source, with one standard deviation per body axis."""

    time_s: float
    q_ecef_body: FloatArray
    sd_rad: float


@dataclass(frozen=True)
class Frames:
    """Onboard video: when each frame was taken, and where it lies; decoded only when asked for."""

    camera: CameraMount
    camera_name: str
    time_s: FloatArray
    paths: tuple[Path, ...]
    benchmark_s: float

    @property
    def benchmark(self) -> int:
        """Index of the frame nearest to the benchmark time."""
        return int(np.argmin(np.abs(self.time_s - self.benchmark_s)))


@dataclass(frozen=True)
class Finding:
    """Something in the data that an analyst should know; never an error and never repaired in silence.

    Times are NaN where it is not about a time.
    """

    source: str
    what: str
    start_s: float
    end_s: float

    def __str__(self) -> str:
        """One line for tables and logs."""
        if not np.isfinite(self.start_s):
            return f"{self.source}: {self.what}"
        where = (
            f"at {self.start_s:.3f} s" if self.end_s == self.start_s else f"{self.start_s:.3f} to {self.end_s:.3f} s"
        )
        return f"{self.source}: {self.what} ({where})"


@dataclass(frozen=True)
class Telemetry:
    """Everything measured on one flight, plus what the analyst states about vehicle and start."""

    name: str
    t0_utc: str
    synthetic: bool
    vehicle: Vehicle
    accelerometer: TriadRecord
    rates: TriadRecord
    radars: dict[str, RadarRecord]
    sounding: Sounding
    attitude_prior: AttitudePrior
    frames: Frames | None = None
    magnetometer: TriadRecord | None = None
    sun: SunRecord | None = None
    events: tuple[tuple[str, float], ...] = ()
    findings: tuple[Finding, ...] = ()
    hashes: dict[str, str] = field(default_factory=dict)

    def span_s(self) -> tuple[float, float]:
        """First and last time that accelerometer, rates and at least one radar cover together."""
        first_radar = min(r.time_s[0] for r in self.radars.values())
        last_radar = max(r.time_s[-1] for r in self.radars.values())
        triads = (self.accelerometer, self.rates)
        start = max(first_radar, *(t.time_s[0] for t in triads))
        return float(start), float(min(last_radar, *(t.time_s[-1] for t in triads)))
