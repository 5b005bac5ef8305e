"""Which systematic errors the filter estimates, how large they may be, and how they wander.

Every block is a first-order Gauss-Markov process about zero, ``de/dt = -e / tau + noise``, started at its prior
standard deviation and kept there by its noise; an infinite ``tau`` is a constant. Order: nine inertial blocks in the
order of `recon._kernels` (18 components), then four components for each radar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.instruments import RadarSite, TriadSpec
from recon.state import KINEMATIC

AXES = ("x", "y", "z")
RADAR_ERRORS = 4


@dataclass(frozen=True)
class Block:
    """One kind of error of one instrument: components with one unit, one prior and one time constant."""

    instrument: str
    components: tuple[str, ...]
    unit: str
    prior_sd: float
    time_constant_s: float = np.inf


@dataclass(frozen=True)
class ErrorModel:
    """All estimated sensor errors, in the order of ``States.sensor_errors``."""

    blocks: tuple[Block, ...]

    @property
    def names(self) -> list[str]:
        """Instrument and component of every error."""
        return [f"{b.instrument} {c}" for b in self.blocks for c in b.components]

    @property
    def instruments(self) -> list[str]:
        """Instrument of every error."""
        return [b.instrument for b in self.blocks for _ in b.components]

    @property
    def units(self) -> list[str]:
        """Unit of every error."""
        return [b.unit for b in self.blocks for _ in b.components]

    @property
    def prior_sd(self) -> FloatArray:
        """Prior standard deviation of every error, (m,)."""
        return np.array([b.prior_sd for b in self.blocks for _ in b.components])

    @property
    def time_constant_s(self) -> FloatArray:
        """Time constant of every error, (m,), infinite for constants."""
        return np.array([b.time_constant_s for b in self.blocks for _ in b.components])

    @property
    def size(self) -> int:
        """Number of sensor errors."""
        return len(self.names)

    def radar_slice(self, index: int) -> slice:
        """Where the errors of the ``index``-th radar stand in the full error vector."""
        start = KINEMATIC + 18 + RADAR_ERRORS * index
        return slice(start, start + RADAR_ERRORS)

    def decay(self, dt_s: FloatArray) -> FloatArray:
        """Factor by which each error's mean decays over each step, ``(k, m)``."""
        return np.asarray(np.exp(-np.asarray(dt_s)[..., None] / self.time_constant_s))

    def noise_var(self, decay: FloatArray) -> FloatArray:
        """Variance that keeps each error at its prior standard deviation, ``(k, m)``; zero for constants."""
        return np.asarray(self.prior_sd**2 * (1.0 - decay**2))


def triad_blocks(spec: TriadSpec, unit: str, bias_time_constant_s: float) -> list[Block]:
    """Bias, scale and mount of one inertial triad; a prior of zero becomes a millionth of a typical one."""

    def block(kind: str, unit: str, sd: float, least: float, tau: float = np.inf) -> Block:
        return Block(spec.name, tuple(f"{kind} {axis}" for axis in AXES), unit, max(sd, least), tau)

    return [
        block("bias", unit, spec.bias_sd, 1e-9, bias_time_constant_s),
        block("scale", "1", spec.scale_sd, 1e-9),
        block("mount", "rad", spec.mount_sd_rad, 1e-9),
    ]


def radar_blocks(site: RadarSite) -> list[Block]:
    """Range, angle and time-tag bias of one radar; time tag minus true time."""
    return [
        Block(site.name, ("range bias",), "m", max(site.range_bias_sd_m, 1e-6)),
        Block(site.name, ("azimuth bias", "elevation bias"), "rad", max(site.angle_bias_sd_rad, 1e-12)),
        Block(site.name, ("time bias",), "s", max(site.time_bias_sd_s, 1e-12)),
    ]


def build_error_model(
    accelerometer: TriadSpec, rates: TriadSpec, sites: list[RadarSite], bias_time_constant_s: float
) -> ErrorModel:
    """Error model of two inertial triads and any number of radars."""
    blocks = triad_blocks(accelerometer, "m/s2", bias_time_constant_s)
    blocks += triad_blocks(rates, "rad/s", bias_time_constant_s)
    for site in sites:
        blocks += radar_blocks(site)
    return ErrorModel(tuple(blocks))
