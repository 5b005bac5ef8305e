"""Two inertial triads on one grid: what was measured, what a gap hides, and what that costs.

White noise of ``sd`` per sample at ``rate`` hertz drives the integrals with density ``sd^2 / rate``; quantisation adds
``resolution^2 / 12`` to the variance of a sample. A gap is bridged by a cubic that meets level and slope on both
sides. What the bridge may miss is measured, not guessed: the same bridge is laid over pieces of the same length in
the neighbouring good data, and the scatter E^2 of its integral there becomes the density ``E^2 / length`` inside the
gap, per body axis, from the worse side. What counts as a gap is told by the samples nearby: a logger may change its
rate in flight. Between slow samples the straight line misses about a twelfth of their second difference.

Mechanisation joins samples by straight lines. `unbent` moves them so that the lines have the integral of the curve;
else the error of the joins would be as large as the coning and sculling that are corrected for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray, GateError
from flightmodel.instruments import TriadSpec
from flightmodel.telemetry import Finding, TriadRecord
from flightmodel.trajectory import interpolate_rows
from recon.motion import Motion, strapdown_motion
from recon.state import BoolArray, IntArray

SAME_INSTANT_S = 2e-6
SLOPE_SPAN_S = 0.06
NEARBY_STEPS = 31  # of which the median is the usual step
SLOWER = 1.5  # than the record's own usual step


@dataclass(frozen=True)
class Bridged:
    """One triad without its missing samples.

    Parameters
    ----------
    time_s, measured_sensor : (n,), (n, 3) float
        Valid samples and the samples of the bridges.
    density : (n, 3) float
        White-noise density from each time to the next, body axes.
    in_gap : (n,) bool
        Whether the interval from each time to the next lies in a gap.
    """

    spec: TriadSpec
    time_s: FloatArray
    measured_sensor: FloatArray
    density: FloatArray
    in_gap: BoolArray
    findings: tuple[Finding, ...]


def valid_samples(record: TriadRecord) -> tuple[FloatArray, FloatArray]:
    """Times and samples without the rows that hold a NaN.

    Raises
    ------
    GateError
        With fewer than ten good samples there is nothing to integrate.
    """
    good = np.isfinite(record.measured_sensor).all(axis=1)
    if good.sum() < 10:
        raise GateError(f"{record.spec.name}: only {int(good.sum())} usable samples; check its columns and units")
    return record.time_s[good], record.measured_sensor[good]


def bridge(record: TriadRecord) -> Bridged:
    """Bridge the gaps of one triad and say where noise grows with them."""
    spec = record.spec
    t, x = valid_samples(record)
    step = np.diff(t)
    usual = usual_steps(step)
    sample_var = max(spec.noise_sd**2 + spec.resolution**2 / 12.0, 1e-24)
    density = sample_var * np.append(usual, usual[-1])[:, None] + _between_slow(t, x, usual, spec.dcm_body_sensor)
    in_gap = np.zeros(len(t), dtype=bool)
    findings: list[Finding] = []
    extra_t: list[FloatArray] = []
    extra_x: list[FloatArray] = []
    extra_density: list[FloatArray] = []
    for k in np.flatnonzero(step > 1.5 * usual).tolist():
        length, nominal = step[k], usual[k]
        in_gap[k] = True
        density[k] = sample_var * length
        if length <= 4.5 * nominal:  # a few samples: the straight line is as good as the signal is smooth
            continue
        missed = _missed_sd(t, x, k, length, spec.dcm_body_sensor)
        density[k] += missed**2 / length
        times = t[k] + np.arange(1, int(np.ceil(length / nominal - 0.5))) * nominal
        times = times[times < t[k + 1] - 0.5 * nominal]
        extra_t.append(times)
        extra_x.append(_cubic(t, x, k, k + 1, times))
        extra_density.append(np.tile(density[k], (len(times), 1)))
        words = f"no samples for {length:.3f} s, bridged; integral over the gap uncertain by " + ", ".join(
            f"{m:.3g}" for m in missed
        )
        findings.append(Finding(spec.name, words + " (SI; body x, y, z)", float(t[k]), float(t[k + 1])))
    if extra_t:
        gap_flags = np.ones(sum(len(e) for e in extra_t), dtype=bool)
        all_t = np.concatenate([t, *extra_t])
        order = np.argsort(all_t, kind="stable")
        x = np.concatenate([x, *extra_x])[order]
        density = np.concatenate([density, *extra_density])[order]
        in_gap = np.concatenate([in_gap, gap_flags])[order]
        t = all_t[order]
    return Bridged(spec, t, x, density, in_gap, tuple(findings))


def usual_steps(step: FloatArray) -> FloatArray:
    """Step (n,) that is usual about each step, the median of `NEARBY_STEPS`."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(step, size=min(NEARBY_STEPS, len(step)), mode="nearest"))


def _between_slow(t: FloatArray, x: FloatArray, usual: FloatArray, dcm: FloatArray) -> FloatArray:
    """Density (n, 3), body axes, of what a straight line misses where samples come slower than the record's usual."""
    out = np.zeros((len(t), 3))
    slow = np.flatnonzero(usual > SLOWER * float(np.median(usual)))
    slow = slow[(slow > 0) & (slow < len(t) - 1)]
    bend = (x[slow + 1] - 2.0 * x[slow] + x[slow - 1]) @ dcm.T
    out[slow] = (bend / 12.0) ** 2 * usual[slow, None]
    return out


def _level_and_slope(t: FloatArray, x: FloatArray, at: int, side: int) -> tuple[FloatArray, FloatArray]:
    """Level and slope at sample ``at`` of a parabola through the samples on one side (-1 before, +1 after)."""
    far = at + side * max(6, int(SLOPE_SPAN_S / max(abs(t[min(at + 1, len(t) - 1)] - t[at - 1]) / 2.0, 1e-4)))
    lo, hi = max(0, min(at, far)), min(len(t), max(at, far) + 1)
    tau = t[lo:hi] - t[at]
    keep = np.abs(tau) <= 3.0 * SLOPE_SPAN_S  # not across another gap
    if keep.sum() < 4:
        return x[at], np.zeros(3)
    coefficients = np.polynomial.polynomial.polyfit(tau[keep], x[lo:hi][keep], 2)
    return coefficients[0], coefficients[1]


def _cubic(t: FloatArray, x: FloatArray, before: int, after: int, times: FloatArray) -> FloatArray:
    """Cubic bridge from sample ``before`` to sample ``after`` at ``times``, (k, 3)."""
    x0, s0 = _level_and_slope(t, x, before, -1)
    x1, s1 = _level_and_slope(t, x, after, 1)
    length = t[after] - t[before]
    u = ((times - t[before]) / length)[:, None]
    return (
        (1.0 + 2.0 * u) * (1.0 - u) ** 2 * x0
        + u * (1.0 - u) ** 2 * length * s0
        + u**2 * (3.0 - 2.0 * u) * x1
        - u**2 * (1.0 - u) * length * s1
    )


def _missed_sd(t: FloatArray, x: FloatArray, k: int, length: float, dcm: FloatArray) -> FloatArray:
    """Scatter of the bridge's integral over the gap after sample ``k``, body axes (3,), from neighbouring data."""
    worse = np.zeros(3)
    found = False
    reach = max(2.0, 4.0 * length)
    for side in (-1, 1):
        edge = t[k] - reach if side < 0 else t[k + 1]
        starts = edge + np.linspace(0.0, reach - length, 24)
        misses = []
        for start in starts:
            a, b = np.searchsorted(t, [start, start + length])
            if b - a < 2 or a < 2 or b > len(t) - 2 or np.diff(t[a : b + 1]).max() > 0.2 * length:
                continue
            bridged = _cubic(t, x, int(a), int(b), t[a : b + 1])
            misses.append(np.trapezoid((bridged - x[a : b + 1]) @ dcm.T, t[a : b + 1], axis=0))
        if len(misses) >= 3:
            found = True
            worse = np.maximum(worse, np.sqrt(np.mean(np.square(misses), axis=0)))
    if not found:  # nothing to learn from nearby: as if the signal could do anything it did in the whole record
        worse = np.std(x @ dcm.T, axis=0) * length
    return worse


def unbent(time_s: FloatArray, samples: FloatArray) -> FloatArray:
    """Samples (n, 3) whose straight joins have the integral of the curve: less a twelfth of the second difference.

    Where steps are uneven by a twentieth, at gaps and ends, samples stay as they are. White noise keeps its integral.
    """
    out = samples.copy()
    step = np.diff(time_s)
    even = np.abs(np.diff(step)) < 0.05 * step[1:]
    bend = samples[2:] - 2.0 * samples[1:-1] + samples[:-2]
    out[1:-1][even] -= bend[even] / 12.0
    return out


def inertial_motion(force: Bridged, rate: Bridged, node_time_s: FloatArray) -> tuple[Motion, IntArray]:
    """Both triads from first to last node, on the faster one's times and the nodes', and each node's index."""
    first, last = node_time_s[0], node_time_s[-1]
    finer = rate if np.median(np.diff(rate.time_s)) < 0.9 * np.median(np.diff(force.time_s)) else force
    inner = finer.time_s[(finer.time_s > first) & (finer.time_s < last)]
    near = np.searchsorted(node_time_s, inner)
    clear = (inner - node_time_s[np.clip(near - 1, 0, None)] > SAME_INSTANT_S) & (
        node_time_s[np.clip(near, None, len(node_time_s) - 1)] - inner > SAME_INSTANT_S
    )
    t = np.sort(np.concatenate([inner[clear], node_time_s]))
    motion = strapdown_motion(
        t,
        interpolate_rows(t, force.time_s, unbent(force.time_s, force.measured_sensor)),
        interpolate_rows(t, rate.time_s, unbent(rate.time_s, rate.measured_sensor)),
        _held(t, force),
        _held(t, rate),
        force.spec.dcm_body_sensor,
        rate.spec.dcm_body_sensor,
    )
    return motion, np.searchsorted(t, node_time_s).astype(np.int64)


def _held(at: FloatArray, triad: Bridged) -> FloatArray:
    """Density of the interval that each grid point opens."""
    k = np.clip(np.searchsorted(triad.time_s, at + SAME_INSTANT_S, side="right") - 1, 0, len(triad.time_s) - 1)
    return np.ascontiguousarray(triad.density[k])
