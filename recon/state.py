"""What does the filter estimate? Kinematics and systematic errors of instruments, and error coordinates about them.

A state is position and velocity of the accelerometer (ECEF, m and m/s relative to the Earth), attitude of the
body and the vector of sensor errors. Error coordinates add, except for rotation, which is a right-hand vector in body
axes, rad: ``state = nominal [+] error``. Following the accelerometer rather than the datum keeps lever arms, and with
them derivatives of the gyro signal, out of the integration; `recon.reconstruct` moves the answer to the datum.

Every block of sensor errors (`ErrorModel`) is a first-order Gauss-Markov process about zero, ``de/dt = -e / tau +
noise``, started at its prior standard deviation and kept there by its noise; an infinite ``tau`` is a constant. Errors
of the air decorrelate with altitude instead: ``exp(-|climb| / length)``. A *considered* error (Schmidt) is never
estimated, but its effect stays in the covariance of everything else. The drivers of the motion come first
(`recon.propagation`).

References
----------
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from flightmodel import rotations
from flightmodel.atmosphere import DENSITY_LENGTH_M, WIND_LENGTH_M
from flightmodel.checks import BoolArray, Check, FloatArray, GateError, IntArray, nearest_name
from flightmodel.instruments import (
    ACCELEROMETER,
    RATES,
    SUN,
    BarometerSpec,
    GnssSpec,
    InstrumentTable,
    RadarSite,
    SitesSpec,
    SunHeads,
    TriadSpec,
)
from flightmodel.telemetry import Motion as MotionSpec

POSITION, VELOCITY, ROTATION = slice(0, 3), slice(3, 6), slice(6, 9)
KINEMATIC = 9
# of ballistic motion, owner and name
DRIVERS = (
    ("vehicle", "drag"), ("vehicle", "side force across"), ("vehicle", "side force within"),
    ("air", "density"), ("air", "wind north"), ("air", "wind east"),
)  # fmt: skip
Spec = TriadSpec | RadarSite | SitesSpec | GnssSpec | BarometerSpec | SunHeads
AXES = ("x", "y", "z")
MOST_KEPT_SD = 0.98  # of the a priori sd: an error that keeps more of it was not observable


@dataclass(frozen=True)
class States:
    """States at ``n`` nodes (or one, without the leading axis).

    Parameters
    ----------
    position_ecef_m, velocity_ecef_mps : (n, 3) float
        Of the accelerometer.
    q_ecef_body : (n, 4) float
    sensor_errors : (n, m) float
        In the order of `ErrorModel`, which starts with the 18 errors of the inertial sensors.
    """

    position_ecef_m: FloatArray
    velocity_ecef_mps: FloatArray
    q_ecef_body: FloatArray
    sensor_errors: FloatArray

    def __getitem__(self, index: int | slice | IntArray) -> States:
        """State of one node, of a range, or of chosen nodes."""
        return States(
            self.position_ecef_m[index],
            self.velocity_ecef_mps[index],
            self.q_ecef_body[index],
            self.sensor_errors[index],
        )


def boxplus(states: States, error: FloatArray) -> States:
    """States moved by errors ``(..., 9 + m)``."""
    return States(
        states.position_ecef_m + error[..., POSITION],
        states.velocity_ecef_mps + error[..., VELOCITY],
        rotations.boxplus(states.q_ecef_body, error[..., ROTATION]),
        states.sensor_errors + error[..., KINEMATIC:],
    )


def boxminus(states: States, reference: States) -> FloatArray:
    """Errors ``(..., 9 + m)`` that `boxplus` needs to go from the reference to ``states``."""
    return np.concatenate(
        [
            states.position_ecef_m - reference.position_ecef_m,
            states.velocity_ecef_mps - reference.velocity_ecef_mps,
            rotations.boxminus(states.q_ecef_body, reference.q_ecef_body),
            states.sensor_errors - reference.sensor_errors,
        ],
        axis=-1,
    )


class Wander(NamedTuple):
    """Gauss-Markov model of each error (m,).

    Time constant and altitude over which it decorrelates, at its stationary sd; variance of a random walk per second;
    whether it is only considered.
    """

    time_constant_s: FloatArray
    altitude_m: FloatArray
    sd: FloatArray
    walk_var_per_s: FloatArray
    considered: BoolArray


def packed(matrices: FloatArray) -> FloatArray:
    """Lower triangles ``(..., N (N + 1) / 2)`` of symmetric matrices ``(..., N, N)``."""
    return np.asarray(matrices[(..., *np.tril_indices(matrices.shape[-1]))])


def unpacked(triangles: FloatArray, count: int | None = None) -> FloatArray:
    """Symmetric matrices ``(..., c, c)`` from packed lower triangles; of their first ``count`` rows where given."""
    size = int(np.sqrt(2 * triangles.shape[-1]))
    c = size if count is None else count
    row, column = np.indices((c, c))
    low, high = np.minimum(row, column), np.maximum(row, column)
    return np.take(triangles, high * (high + 1) // 2 + low, axis=-1)


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
            raise GateError(faults, code="name-unknown")
        return ErrorModel(blocks)


def _kind(component: str) -> str:
    """Component without its axis."""
    stem, _, last = component.rpartition(" ")
    return stem if last in (*AXES, "north", "east", "down") and stem else component


def _fits(block: Block, names: list[str]) -> bool:
    spelt = [f"{block.instrument} {part}" for c in block.components for part in (c, _kind(c))]
    return any(name in names for name in spelt)


def instrument_blocks(table: InstrumentTable, spec: Spec, name: str = "") -> list[Block]:
    """Errors of one instrument, by its rows; those of which flight.toml states none are left out.

    Of a triad the constant and the slowly varying part of the bias are one error: over times below the latter's time
    constant it walks. ``name`` is that of one head of several.
    """
    blocks = []
    for row in table.rows:
        sd = getattr(spec, row.name)
        tau, walk = getattr(spec, row.time_constant[0]) if row.time_constant[0] else np.inf, 0.0
        if isinstance(spec, TriadSpec) and row.name == "bias_sd":
            sd, walk = _bias(spec)
        if row.states and (sd > 0.0 or row.least is not None):
            blocks.append(Block(name or spec.name, row.states, row.unit, max(sd, row.least or 0.0), tau, np.inf, walk))
    return blocks


def _bias(spec: TriadSpec) -> tuple[float, float]:
    """Sd of a bias with its slowly varying part, and the variance by which it walks in a second."""
    sd = float(np.hypot(spec.bias_sd, spec.bias_wander_sd))
    walk = 2.0 * spec.bias_wander_sd**2 / spec.bias_time_constant_s
    return sd, walk


def imu_blocks(force: TriadSpec, rate: TriadSpec) -> list[Block]:
    """Errors of both inertial triads, then their time biases: of both, or of neither where neither may err."""
    blocks = instrument_blocks(ACCELEROMETER, replace(force, time_bias_sd_s=0.0))
    blocks += instrument_blocks(RATES, replace(rate, time_bias_sd_s=0.0))
    if max(force.time_bias_sd_s, rate.time_bias_sd_s) > 0.0:
        blocks += [Block(spec.name, ("time bias",), "s", max(spec.time_bias_sd_s, 1e-9)) for spec in (force, rate)]
    return blocks


def deceleration_blocks(spec: TriadSpec, trim_sd_rad: float, tracked: bool) -> list[Block]:
    """Errors of an accelerometer that measures ballistic flight's deceleration alone; the trim's with its scale.

    Without a tracker the bias is considered: to first order thin air three times as dense as expected is a bias. Half a
    count is in it: counts are rounded, cut off or rounded down, and what is below the first one reads as nothing.
    """
    bias, walk = _bias(spec)
    bias = float(np.hypot(bias, 0.5 * spec.resolution))
    return [
        Block(spec.name, ("bias",), "m/s2", max(bias, 1e-9), walk_var_per_s=walk, considered=not tracked),
        Block(spec.name, ("scale",), "1", max(float(np.hypot(spec.scale_sd, trim_sd_rad**2)), 1e-9)),
        Block(spec.name, ("time bias",), "s", max(spec.time_bias_sd_s, 1e-9)),
    ]


def sun_blocks(spec: SunHeads) -> list[Block]:
    """Errors of every head, counted from 1."""
    heads = range(1, len(spec.clock_lv_rad) + 1)
    return [block for k in heads for block in instrument_blocks(SUN, spec, f"{spec.name}{k}")]


def ballistic_blocks(motion: MotionSpec) -> list[Block]:
    """Drivers of ballistic flight; density and winds in units of the sounding's standard deviations."""
    tau = motion.drag_time_constant_s
    return [
        Block("vehicle", ("drag",), "1", motion.drag_sd, tau),
        Block("vehicle", ("side force across", "side force within"), "1", motion.side_sd, motion.side_time_constant_s),
        Block("air", ("density",), "sd", 1.0, altitude_m=DENSITY_LENGTH_M),
        Block("air", ("wind north", "wind east"), "sd", 1.0, altitude_m=WIND_LENGTH_M),
    ]


def data_sheet_check(
    code: str,
    label: str,
    source: str,
    components: list[str],
    estimate: FloatArray,
    prior_sd: FloatArray,
    sd: FloatArray,
    confidence: float,
    bad: str = "is larger than the data sheet allows: check mounting, units and calibration",
    good: str = "estimated sensor errors are consistent with the data sheet; largest:",
) -> Check | None:
    """Largest normalised shift (k,) of a priori errors of one source from zero; None where no error was observable.

    The remark names the ``components`` entry that moved most: ``bad`` follows its name, ``good`` goes before it.
    """
    observable = sd < MOST_KEPT_SD * prior_sd
    if not observable.any():
        return None
    shift = np.abs(estimate[observable]) / np.sqrt(prior_sd[observable] ** 2 - sd[observable] ** 2)
    tail = 0.5 * (1.0 - confidence) / int(observable.sum())
    worst = str(np.array(components, dtype=object)[observable][int(np.argmax(shift))])
    name = f"{source} {worst}".strip()
    symptom, _, advice = bad.partition(": ")
    return Check.of(
        code, label, float(shift.max()), 0.0, float(-ndtri(tail)), f"{good} {name}, {shift.max():.1f} sd",
        f"{name} {symptom}", advice=advice, source=source, component=worst,
    )  # fmt: skip
