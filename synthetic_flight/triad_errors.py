"""How three real sensors distort what three ideal ones would say; the parts of that which other instruments share.

In the order of the signal's way: bandwidth, delay, misalignment of the triad, axes that are not square to each other,
scale (with another one for negative values), bias and its slow drift, noise, range, quantisation, dropped samples. What
is constant over a flight is drawn once. Each quantity beyond the first four (mounting, scale, bias, noise) draws from a
child of the instrument's generator with a name of its own, so that adding one leaves the others as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flightmodel import rotations
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.trajectory import interpolate_rows
from synthetic_flight import _air_kernels

BUTTERWORTH = np.sqrt(0.5)
CHILD = 0  # stands between an instrument's key and its child's: no name holds a NUL


@dataclass(frozen=True)
class DropoutErrors:
    """Bursts of lost samples: how many a second, how long on average, and stated intervals, s."""

    rate_hz: float = 0.0
    mean_s: float = 0.0
    outages_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class TriadErrors:
    """Errors of a triad, SI; the first four are standard deviations, drawn in this order: mount, scale, bias, noise.

    Parameters
    ----------
    mount_rad, scale, bias, noise : float
        Turn of the triad per axis, scale factor, constant bias, white noise per sample.
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
    """Return the generator of one error of an instrument, without drawing from the instrument's own."""
    seed = rng.bit_generator.seed_seq
    assert isinstance(seed, np.random.SeedSequence)
    key = (*seed.spawn_key, CHILD, *name_key(name))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))


def low_pass(values: FloatArray, step_s: float, bandwidth_hz: float, order: int) -> FloatArray:
    """Rows ``(n, m)`` at equal steps behind a low-pass that was at rest at the first row.

    Exact for values that run straight between the rows (first-order hold).
    """
    w = 2.0 * np.pi * bandwidth_hz
    if order == 1:
        return filtered(values, step_s, [w], [1.0, w])
    return filtered(values, step_s, [w * w], [1.0, 2.0 * BUTTERWORTH * w, w * w])


def filtered(values: FloatArray, step_s: float, numerator: list[float], denominator: list[float]) -> FloatArray:
    """Rows ``(n, m)`` behind a transfer function of unit gain in s, at rest at the first row; first-order hold."""
    from scipy import signal  # half a second to import

    top, bottom, _ = signal.cont2discrete((numerator, denominator), step_s, method="foh")
    top = np.asarray(top).ravel()
    start = signal.lfilter_zi(top, bottom)
    out, _ = signal.lfilter(top, bottom, values, axis=0, zi=start[:, None] * values[:1])
    return np.asarray(out)


def gauss_markov(
    time_s: FloatArray, sd: float, time_constant_s: float, columns: int, rng: np.random.Generator
) -> FloatArray:
    """Stationary Gauss-Markov sequences ``(n, columns)`` at increasing times, each of standard deviation ``sd``."""
    keep = np.exp(-np.diff(time_s) / time_constant_s)
    white = rng.standard_normal((len(time_s), columns))
    out = np.empty_like(white)
    _air_kernels.gauss_markov(keep, white, out)
    return sd * out


def kept(time_s: FloatArray, spec: DropoutErrors, rng: np.random.Generator) -> BoolArray:
    """Which samples arrive: bursts begin at random (Poisson) and last exponentially distributed times."""
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
    """By how much a triad's clock is late in one flight, beyond its delay."""
    return errors.time_bias_s * float(child(rng, "time bias").standard_normal()) if errors.time_bias_s > 0.0 else 0.0


def sampled(
    at_s: FloatArray, time_s: FloatArray, ideal: FloatArray, errors: TriadErrors, late_s: float = 0.0
) -> FloatArray:
    """Values ``(n, 3)`` of an ideal signal at sampling times, behind bandwidth, delay and a clock that is ``late_s``.

    ``ideal`` (m, 3) stands on an even grid ``time_s`` (m,) that begins before the samples.
    """
    if errors.bandwidth_hz > 0.0:
        ideal = low_pass(ideal, float(time_s[1] - time_s[0]), errors.bandwidth_hz, int(errors.order))
    return interpolate_rows(at_s - errors.delay_s - late_s, time_s, ideal)


def measured(
    at_s: FloatArray, sensed: FloatArray, errors: TriadErrors, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times and values ``(k, 3)`` that a triad delivers of the signal ``sensed`` (n, 3) in its nominal axes."""
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
    """Sensing directions, row by row, of axes that are not square: x stays, y leans to x, z to x and y, (3, 3)."""
    yx, zx, zy = tilt_rad
    rows = np.array([[1.0, 0.0, 0.0], [yx, 1.0, 0.0], [zx, zy, 1.0]])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def quantised(values: FloatArray, limit: tuple[float, float, float] | None, resolution: float) -> FloatArray:
    """Values ``(n, 3)`` as an analogue-digital converter gives them: whole steps, and no more of them than it has."""
    if resolution <= 0.0:
        return np.clip(values, -np.array(limit), np.array(limit)) if limit else values
    counts = np.round(values / resolution)
    if limit:
        most = np.floor(np.array(limit) / resolution + 1e-9)
        counts = np.clip(counts, -most, most)
    return counts * resolution
