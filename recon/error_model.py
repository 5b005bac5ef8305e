"""Which systematic errors are estimated, with what a priori sd and correlation, and which are only considered?

Every block is a first-order Gauss-Markov process about zero, ``de/dt = -e / tau + noise``, started at its prior
standard deviation and kept there by its noise; an infinite ``tau`` is a constant. Errors of the air decorrelate with
altitude instead: ``exp(-|climb| / length)``. A *considered* error (Schmidt) is never estimated, but its effect stays in
the covariance of everything else. The drivers of the motion come first (`recon.motion`).

References
----------
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from flightmodel.checks import FloatArray, GateError, nearest_name
from flightmodel.instruments import BarometerSpec, GnssSpec, RadarSite, SunHeads, TriadSpec
from flightmodel.telemetry import Motion as MotionSpec
from recon.state import Wander

AXES = ("x", "y", "z")
DENSITY_LENGTH_M, WIND_LENGTH_M = 5000.0, 3000.0  # correlation lengths of the air's errors, by soundings


@dataclass(frozen=True)
class Block:
    """One kind of error of one instrument: components with one unit, one prior and one correlation."""

    instrument: str
    components: tuple[str, ...]
    unit: str
    prior_sd: float
    time_constant_s: float = np.inf
    altitude_m: float = np.inf
    walk_var_per_s: float = 0.0
    considered: bool = False


@dataclass(frozen=True)
class ErrorModel:
    """All errors beside the nine kinematic ones, in the order of ``States.sensor_errors``; drivers first."""

    blocks: tuple[Block, ...]

    def _each(self, name: str) -> list[object]:
        return [getattr(b, name) for b in self.blocks for _ in b.components]

    @property
    def names(self) -> list[str]:
        """Instrument and component of every error."""
        return [f"{b.instrument} {c}" for b in self.blocks for c in b.components]

    @property
    def instruments(self) -> list[str]:
        """Instrument of every error."""
        return [str(name) for name in self._each("instrument")]

    @property
    def units(self) -> list[str]:
        """Unit of every error."""
        return [str(unit) for unit in self._each("unit")]

    @property
    def prior_sd(self) -> FloatArray:
        """Prior standard deviation of every error, (m,)."""
        return np.array(self._each("prior_sd"), dtype=float)

    @property
    def size(self) -> int:
        """Number of errors."""
        return len(self.names)

    @property
    def wander(self) -> Wander:
        """Gauss-Markov model of every error; a considered one is constant."""
        considered = np.array(self._each("considered"), dtype=bool)
        tau, length, walk = (
            np.array(self._each(name), dtype=float) for name in ("time_constant_s", "altitude_m", "walk_var_per_s")
        )
        forever = np.where(considered, np.inf, tau), np.where(considered, np.inf, length)
        return Wander(*forever, self.prior_sd, np.where(considered, 0.0, walk), considered)

    @property
    def wandering(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Which errors (w,) are not constant."""
        w = self.wander
        moves = np.isfinite(w.time_constant_s) | np.isfinite(w.altitude_m) | (w.walk_var_per_s > 0.0)
        return np.flatnonzero(moves).astype(np.int64)

    def column(self, instrument: str, component: str) -> int:
        """Where an error stands among all errors; -1 where it is not modelled."""
        name = f"{instrument} {component}"
        names = self.names
        return names.index(name) if name in names else -1

    def considering(self, names: Iterable[str]) -> ErrorModel:
        """Model in which the named errors are considered: ``"accelerometer mount"``, ``"radar1 time bias"``, ...

        Raises
        ------
        GateError
            Where a name fits no error; with the nearest known one.
        """
        wanted = list(names)
        blocks = tuple(replace(b, considered=True) if _fits(b, wanted) else b for b in self.blocks)
        known = sorted({f"{b.instrument} {_kind(c)}" for b in self.blocks for c in b.components})
        faults = [
            f"considered error '{name}'{nearest_name(name, known)}: no such error; known: {', '.join(known)}"
            for name in wanted
            if not any(_fits(b, [name]) for b in self.blocks)
        ]
        if faults:
            raise GateError(faults, code="error-unknown")
        return ErrorModel(blocks)


def _kind(component: str) -> str:
    """Component without its axis."""
    stem, _, last = component.rpartition(" ")
    return stem if last in (*AXES, "north", "east", "down") and stem else component


def _fits(block: Block, names: list[str]) -> bool:
    spelt = [f"{block.instrument} {part}" for c in block.components for part in (c, _kind(c))]
    return any(name in names for name in spelt)


def triad_blocks(spec: TriadSpec, unit: str) -> list[Block]:
    """Bias, scale and mount of one sensor of three axes; a prior of zero becomes a millionth of a typical one."""

    def block(kind: str, unit: str, sd: float, walk: float = 0.0) -> Block:
        return Block(spec.name, tuple(f"{kind} {axis}" for axis in AXES), unit, max(sd, 1e-9), walk_var_per_s=walk)

    # a Gauss-Markov part beside a constant one: below its time constant it is a random walk, and one error holds both
    walk = 2.0 * spec.bias_wander_sd**2 / spec.bias_time_constant_s
    return [
        block("bias", unit, float(np.hypot(spec.bias_sd, spec.bias_wander_sd)), walk),
        block("scale", "1", spec.scale_sd),
        block("mount", "rad", spec.mount_sd_rad),
    ]


def clock_blocks(force: TriadSpec, rate: TriadSpec) -> list[Block]:
    """Time biases of both sensors; none where neither may err."""
    if max(force.time_bias_sd_s, rate.time_bias_sd_s) <= 0.0:
        return []
    return [Block(spec.name, ("time bias",), "s", max(spec.time_bias_sd_s, 1e-9)) for spec in (force, rate)]


def ballistic_blocks(motion: MotionSpec) -> list[Block]:
    """Drivers of ballistic flight; density and winds in units of the sounding's standard deviations."""
    tau = motion.drag_time_constant_s
    return [
        Block("vehicle", ("drag",), "1", motion.drag_sd, tau),
        Block("vehicle", ("side force across", "side force within"), "1", motion.side_sd, tau),
        Block("air", ("density",), "sd", 1.0, altitude_m=DENSITY_LENGTH_M),
        Block("air", ("wind north", "wind east"), "sd", 1.0, altitude_m=WIND_LENGTH_M),
    ]


def radar_blocks(site: RadarSite) -> list[Block]:
    """Errors of one radar (RCC 753-95); those that the flight file states none of are left out."""
    name, tau = site.name, site.wander_time_constant_s
    always = [
        Block(name, ("range bias",), "m", max(site.range_bias_sd_m, 1e-6)),
        Block(name, ("azimuth bias", "elevation bias"), "rad", max(site.angle_bias_sd_rad, 1e-12)),
        Block(name, ("time bias",), "s", max(site.time_bias_sd_s, 1e-12)),
    ]
    stated = [
        Block(name, ("tilt north", "tilt east"), "rad", site.mislevel_sd_rad),
        Block(name, ("droop",), "rad", site.droop_sd_rad),
        Block(name, ("skew",), "rad", site.skew_sd_rad),
        Block(name, ("non-orthogonality",), "rad", site.nonorthogonality_sd_rad),
        Block(name, ("traverse wander", "elevation wander"), "rad", site.wander_sd_rad, tau),
        Block(name, ("refraction",), "1", site.refraction_sd),
        Block(name, ("range scale",), "1", site.range_scale_sd),
    ]
    return always + [b for b in stated if b.prior_sd > 0.0]


def gnss_blocks(spec: GnssSpec) -> list[Block]:
    """Gauss-Markov position error along north, east and down, and the latency of one receiver."""
    axes = tuple(f"wander {axis}" for axis in ("north", "east", "down"))
    blocks = [
        Block(spec.name, axes, "m", spec.wander_sd_m, spec.wander_time_constant_s),
        Block(spec.name, ("time bias",), "s", spec.time_bias_sd_s),
    ]
    return [b for b in blocks if b.prior_sd > 0.0]


def barometer_blocks(spec: BarometerSpec) -> list[Block]:
    """Errors of a height from air pressure."""
    blocks = [
        Block(spec.name, ("bias",), "m", spec.bias_sd_m),
        Block(spec.name, ("scale",), "1", spec.scale_sd),
        Block(spec.name, ("wander",), "m", spec.wander_sd_m, spec.wander_time_constant_s),
        Block(spec.name, ("time bias",), "s", spec.time_bias_sd_s),
    ]
    return [b for b in blocks if b.prior_sd > 0.0]


def magnetometer_blocks(spec: TriadSpec) -> list[Block]:
    """Bias, scale and mount of a magnetometer, and the iron of the vehicle about it."""
    iron = Block(spec.name, ("soft iron xy", "soft iron xz", "soft iron yz"), "1", spec.soft_iron_sd)
    return triad_blocks(spec, "T") + ([iron] if spec.soft_iron_sd > 0.0 else [])


def sun_blocks(spec: SunHeads) -> list[Block]:
    """Bias and mounting of every head, counted from 1."""
    blocks: list[Block] = []
    for number in range(1, len(spec.clock_lv_rad) + 1):
        head = f"{spec.name}{number}"
        blocks.append(Block(head, ("bias across", "bias along"), "rad", spec.bias_sd_rad))
        blocks.append(Block(head, tuple(f"mount {axis}" for axis in AXES), "rad", spec.mount_sd_rad))
    return [b for b in blocks if b.prior_sd > 0.0]
