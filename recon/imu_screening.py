"""Which samples of an inertial sensor can be used, and what does bridging the others cost? Gaps, frozen data, offsets.

White noise of ``sd`` per sample at ``rate`` hertz drives the integrals with density ``sd^2 / rate``; quantisation adds
``resolution^2 / 12`` to the variance of a sample. Not used are samples without a value, blocks that repeat others and,
axis by axis, frozen samples and transient offsets that the trackers do not support. What counts as a gap follows from
the samples nearby: a logger may change its rate in flight. Between slow samples the straight line misses about a
twelfth of their second difference.

**Gaps** are bridged by a cubic that meets level and slope on both sides, or, where the signal oscillates, by a line
from the mean before to the mean after. The error of either is measured: the same bridge is laid over pieces of the same
length in the neighbouring good data, and the scatter E of its integral there, from the worse side, becomes the density
``E^2 / length`` inside the gap. The bridge with the smaller error is taken, axis by axis. Rejected offsets may be real
motion for all that: there, the square of what the bridge differs from them adds to ``E^2``. At a stop every bridge
errs to one side, all of ``n`` alike, so that their sum errs by ``n E`` and not by the root of ``n`` times ``E``: each
counts ``n`` times.

**Frozen data.** White noise on a constant signal leaves a reading of step ``d`` at one value for ``n`` samples with
probability ``P^(n - 1)``, at most ``P = erf(d / (2 sqrt(2) sd))``. Where the readings next to a run repeat more often
than that (a slow signal, a logger faster than its sensor) their share is ``P``. A sensor whose steps are coarser than
its noise may rest at one value for minutes, and is accepted; so is a run from the first sample on, which may be a
vehicle at rest.

**Repeated blocks.** A block of samples that is equal, in all axes, to one before it was sent twice under different
times. Noise makes two readings equal with probability ``P`` as above.

**Transient offsets.** A vehicle's motion does not jump from one sample to the next and jump back to where it would have
been; a transient offset does, and so do blocks of samples in the wrong order. The jump between two samples is the
difference of the parabolas through `_REACH` samples on either side, carried to the middle. It is one where it exceeds
the jumps nearby (or the sensor's noise, where that is larger) by far, and the samples between jumps whose sum is zero
are a transient offset. One jump alone may be the vehicle's own: a stage, a parachute. The pulse of a thruster comes and
goes, too; so offsets are accepted where the trackers support them (`recon.fault_detection`), and where they are not
accepted they still add to the process noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import erf

from flightmodel.checks import BoolArray, FloatArray, GateError, IntArray, Issue
from flightmodel.gate import runs
from flightmodel.instruments import TriadSpec
from flightmodel.statistics import NORMAL_MAD
from flightmodel.telemetry import TriadRecord

_SLOPE_SPAN_S = 0.06  # over which a signal beside a gap is straight: a seventh of a period at 2.5 Hz
_NEARBY_STEPS = 31  # of which the median is the usual step
_SLOWER = 1.5  # than the record's own usual step
_GAP, _LONG_GAP = 1.5, 4.5  # usual steps: a straight line serves up to the second, as good as the signal is smooth
_LEAST_SAMPLES = 10  # of a stretch between gaps: shorter ones carry no trajectory
_AXES = "xyz"
LONGEST_LAG_S = 0.08  # a fifth of a period at 2.5 Hz: a longer one is found by `recon.oscillation`
_SHORTEST_S = 0.004  # that a step is longer than usual: below it the lag cannot be measured
_LEAST_EXCESS = 0.5  # of a usual step that a step is longer
_MOST_GAPS = 8  # that are tested, the longest


@dataclass(frozen=True)
class BridgedSensor:
    """One inertial sensor (accelerometer or gyros, three axes) without its missing samples.

    Parameters
    ----------
    time_s, measured_sensor : (n,), (n, 3) float
        Valid samples and the samples of the bridges.
    density : (n, 3) float
        White-noise density from each time to the next, body axes.
    in_gap : (n,) bool
        Whether the interval from each time to the next lies in a gap of any axis.
    findings : tuple of Issue
    offsets : tuple of TransientOffset
        All that were found, whether accepted or not.
    """

    spec: TriadSpec
    time_s: FloatArray
    measured_sensor: FloatArray
    density: FloatArray
    in_gap: BoolArray
    findings: tuple[Issue, ...]
    offsets: tuple[TransientOffset, ...] = ()

    @property
    def of_bridge(self) -> BoolArray:
        """Which samples (n,) are of a bridge: they have a gap on both sides."""
        return self.in_gap & np.concatenate([[False], self.in_gap[:-1]])


class _Unused(NamedTuple):
    """Samples to be bridged: times (n,), rejected values (NaN if none), saturated side (0 none), both (n, k)."""

    time_s: FloatArray
    rejected: FloatArray
    stop: IntArray


def bridge(record: TriadRecord, sensor: int = 0, rejected: tuple[TransientOffset, ...] = ()) -> BridgedSensor:
    """Bridge the gaps of one sensor and enlarge the noise density in them.

    Parameters
    ----------
    record : TriadRecord
    sensor : int
        0 for the accelerometer, 1 for the gyros.
    rejected : tuple of TransientOffset
        Those that are not used; all others are.

    Raises
    ------
    GateError
        Where an axis has fewer than ten good samples: there is nothing to integrate.
    """
    spec = record.spec
    t, x, good, findings = _usable(record)
    offsets = _find_offsets(spec, t, x, good, sensor)
    excluded = _exclude(t, x, good, [d for d in rejected if d in offsets], findings, spec.name)
    stop = _at_a_stop(x, good)
    grid = _with_bridges(t)
    column, density = np.empty((len(grid), 3)), np.empty((len(grid), 3))
    in_gap = np.zeros(len(grid), dtype=bool)
    errors: dict[tuple[float, float], dict[str, float]] = {}
    masks = {axis.tobytes(): axis for axis in good.T}  # axes that miss the same samples are bridged together
    for mask in masks.values():
        axes = np.flatnonzero((good == mask[:, None]).all(axis=0))
        column[:, axes], density[:, axes], gaps, sizes_by_span = _bridge_axes(
            spec, t[mask], x[np.ix_(mask, axes)], grid, _Unused(t, excluded[:, axes], stop[:, axes])
        )
        in_gap |= gaps
        for span, sizes in sizes_by_span.items():
            errors.setdefault(span, {}).update(zip((_AXES[a] for a in axes), sizes, strict=True))
    for (start, end), lost in sorted(errors.items()):
        names = ", ".join(sorted(lost))
        which = "samples" if len(lost) == 3 else f"usable samples of {names}"
        remark = f"no {which} for {end - start:.3f} s, bridged; 1 sd of the integral over the gap "
        remark += ", ".join(f"{lost[a]:.3g}" for a in sorted(lost)) + f" (SI; sensor {names})"
        findings.append(Issue(remark, "gap-bridged", spec.name, start, end))
    density = density @ (spec.dcm_body_sensor**2).T
    return BridgedSensor(spec, grid, column, density, in_gap, tuple(findings), offsets)


def _usable(record: TriadRecord) -> tuple[FloatArray, FloatArray, BoolArray, list[Issue]]:
    """Times, samples and which of them are good (n, 3), from the first to the last time that all axes measure."""
    t, x, spec = record.time_s, record.measured_sensor, record.spec
    good = np.isfinite(x)
    findings = _exclude_repeated(spec, t, x, good)
    for axis in range(3):
        there = np.flatnonzero(good[:, axis])
        good[there, axis] = ~frozen_samples(x[there, axis], spec.noise_sd)
        count = int(good[:, axis].sum())
        if count < _LEAST_SAMPLES:
            one = len(there) >= _LEAST_SAMPLES
            why = f"all {len(there)} samples hold one value" if one else f"only {count} usable samples"
            what = f"{spec.name}: sensor axis {_AXES[axis]}: {why}; check its columns and units"
            raise GateError(what, code="sensor-axis-unusable")
    inside = [np.flatnonzero(g) for g in good.T]
    first, last = max(int(k[0]) for k in inside), min(int(k[-1]) for k in inside)
    rows = np.arange(len(t))
    rows = rows[(rows >= first) & (rows <= last) & good.any(axis=1)]
    ended = [_AXES[a] for a in range(3) if np.isfinite(x[last + 1 :, a]).any() and inside[a][-1] == last]
    if ended and last < len(t) - _LEAST_SAMPLES:
        remark = f"{', '.join(ended)} frozen at one value to the end of the record: the trajectory ends before it"
        findings.append(Issue(remark, "frozen-data", spec.name, float(t[last]), float(t[-1])))
    return t[rows], x[rows], good[rows], findings


def _find_offsets(
    spec: TriadSpec, t: FloatArray, x: FloatArray, good: BoolArray, sensor: int
) -> tuple[TransientOffset, ...]:
    """All transient offsets among the good samples (n, 3)."""
    out = []
    for axis in range(3):
        rows = np.flatnonzero(good[:, axis])
        for a, b, offset in transient_offsets(t[rows], x[rows, axis], spec.noise_sd):
            out.append(TransientOffset(sensor, axis, float(t[rows[a]]), float(t[rows[b]]), offset))
    return tuple(out)


def _exclude(
    t: FloatArray, x: FloatArray, good: BoolArray, rejected: list[TransientOffset], findings: list[Issue], name: str
) -> FloatArray:
    """Remove rejected samples from ``good`` (n, 3), in place, and return them (n, 3), NaN elsewhere."""
    out = np.full(x.shape, np.nan)
    for d in rejected:
        rows = np.flatnonzero((t >= d.start_s) & (t <= d.end_s) & good[:, d.axis])
        out[rows, d.axis], good[rows, d.axis] = x[rows, d.axis], False
        remark = f"transient offset of {_AXES[d.axis]} by about {d.offset:.3g} (SI): excluded; added to process noise"
        findings.append(Issue(remark, "transient-offset", name, d.start_s, d.end_s))
    return out


def _exclude_repeated(spec: TriadSpec, t: FloatArray, x: FloatArray, good: BoolArray) -> list[Issue]:
    """Take blocks of samples that repeat others out of ``good`` (n, 3), in place; one finding for each."""
    whole = np.flatnonzero(good.all(axis=1))
    repeated, blocks = repeated_samples(x[whole], spec.noise_sd)
    good[whole[repeated]] = False
    return [
        Issue(
            f"{b - a + 1} samples repeat those from {t[whole[a0]]:.3f} s on under other times: excluded",
            "repeated-block", spec.name, float(t[whole[a]]), float(t[whole[b]]),
        )
        for a, b, a0 in blocks
    ]  # fmt: skip


def _with_bridges(t: FloatArray) -> FloatArray:
    """Times and, in gaps where there are none, those at which samples would have come."""
    step = np.diff(t)
    usual = usual_steps(step)
    extra = [t]
    for k in np.flatnonzero(step > _LONG_GAP * usual).tolist():
        times = t[k] + np.arange(1, int(np.ceil(step[k] / usual[k] - 0.5))) * usual[k]
        extra.append(times[times < t[k + 1] - 0.5 * usual[k]])
    return np.sort(np.concatenate(extra), kind="stable")


def _bridge_axes(
    spec: TriadSpec, t: FloatArray, x: FloatArray, grid: FloatArray, unused: _Unused
) -> tuple[FloatArray, FloatArray, BoolArray, dict[tuple[float, float], FloatArray]]:
    """Samples (n, k) on the grid, densities (n, k) in sensor axes, gaps (n,), and the error of each long bridge."""
    step = np.diff(t)
    usual = usual_steps(step)
    sample_var = _sample_var(spec)
    density = sample_var * np.append(usual, usual[-1])[:, None] + _interpolation_density(x, usual)
    wide = np.zeros(len(t), dtype=bool)
    wide[:-1] = step > _GAP * usual
    density[:-1][wide[:-1]] = sample_var * step[wide[:-1], None]
    column = np.column_stack([np.interp(grid, t, axis) for axis in x.T])
    errors = {}
    gaps = np.flatnonzero(step > _LONG_GAP * usual)
    same_side = _same_side_count(unused, t[gaps], t[gaps + 1])
    for k, times in zip(gaps.tolist(), same_side, strict=True):
        sizes, oscillates = _bridge_error_sd(t, x, k, step[k])
        a, b = np.searchsorted(grid, [t[k], t[k + 1]])
        cubic, line = _bridges(t, x, k, k + 1, grid[a + 1 : b])
        column[a + 1 : b] = np.where(oscillates, line, cubic)
        sizes = np.hypot(sizes, _difference_from_rejected(unused, grid[a : b + 1], column[a : b + 1])) * np.sqrt(times)
        density[k] += sizes**2 / step[k]
        errors[float(t[k]), float(t[k + 1])] = sizes
    held = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 1)
    return column, density[held], wide[held], errors


def _sample_var(spec: TriadSpec) -> float:
    """White variance of a sample, with its quantisation."""
    return max(spec.noise_sd**2 + spec.resolution**2 / 12.0, 1e-24)


def with_noise(sensor: BridgedSensor, noise_sd: float) -> BridgedSensor:
    """Sensor with the same samples and bridges, of another white noise."""
    spec = replace(sensor.spec, noise_sd=noise_sd)
    step = np.diff(sensor.time_s, append=2.0 * sensor.time_s[-1] - sensor.time_s[-2])
    least = _sample_var(spec) * step
    density = sensor.density + (least - _sample_var(sensor.spec) * step)[:, None]
    return replace(sensor, spec=spec, density=np.maximum(density, least[:, None]))


def _at_a_stop(x: FloatArray, good: BoolArray) -> IntArray:
    """Saturated side of unusable samples (n, 3): 1 at their column's largest value, -1 at its smallest, else 0."""
    stands = np.isfinite(x) & ~good
    high, low = stands & (x == np.nanmax(x, axis=0)), stands & (x == np.nanmin(x, axis=0))
    return high.astype(np.int64) - low.astype(np.int64)


def _same_side_count(unused: _Unused, start_s: FloatArray, end_s: FloatArray) -> IntArray:
    """How many gaps (g, k) from ``start_s`` to ``end_s`` err to the same side as each: those at one stop."""
    middle = np.searchsorted(unused.time_s, 0.5 * (start_s + end_s)) - 1
    side = unused.stop[middle]
    return np.where(side > 0, (side > 0).sum(axis=0), np.where(side < 0, (side < 0).sum(axis=0), 1))


def _difference_from_rejected(unused: _Unused, grid: FloatArray, bridge: FloatArray) -> FloatArray:
    """Integral (k,) over a gap of what rejected samples, where there are any, differ from its bridge (g, k)."""
    a, b = np.searchsorted(unused.time_s, [grid[0], grid[-1]], side="right")
    t, values = unused.time_s[a : b - 1], unused.rejected[a : b - 1]
    if len(t) == 0:
        return np.zeros(bridge.shape[1])
    off = values - np.column_stack([np.interp(t, grid, axis) for axis in bridge.T])
    step = (grid[-1] - grid[0]) / (len(t) + 1)
    return np.asarray(np.abs(np.nansum(off, axis=0)) * step)


def usual_steps(step: FloatArray) -> FloatArray:
    """Step (n,) that is usual about each step, the median of `_NEARBY_STEPS`."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(step, size=min(_NEARBY_STEPS, len(step)), mode="nearest"))


def _interpolation_density(x: FloatArray, usual: FloatArray) -> FloatArray:
    """Density (n, k) of the error of a straight line where samples come slower than the record's usual."""
    out = np.zeros(x.shape)
    slow = np.flatnonzero(usual > _SLOWER * float(np.median(usual)))
    slow = slow[(slow > 0) & (slow < len(x) - 1)]
    second_difference = x[slow + 1] - 2.0 * x[slow] + x[slow - 1]
    out[slow] = (second_difference / 12.0) ** 2 * usual[slow, None]
    return out


def _level_and_slope(t: FloatArray, x: FloatArray, at: int, side: int) -> tuple[FloatArray, FloatArray]:
    """Level and slope at sample ``at`` of a parabola through the samples on one side (-1 before, +1 after)."""
    far = at + side * max(6, int(_SLOPE_SPAN_S / max(abs(t[min(at + 1, len(t) - 1)] - t[at - 1]) / 2.0, 1e-4)))
    lo, hi = max(0, min(at, far)), min(len(t), max(at, far) + 1)
    tau = t[lo:hi] - t[at]
    keep = np.abs(tau) <= 3.0 * _SLOPE_SPAN_S  # not across another gap
    if keep.sum() < 4:
        return x[at], np.zeros(x.shape[1])
    coefficients = np.polynomial.polynomial.polyfit(tau[keep], x[lo:hi][keep], 2)
    return coefficients[0], coefficients[1]


def _mean(t: FloatArray, x: FloatArray, at: int, span_s: float) -> tuple[float, FloatArray]:
    """Mean time and sample of the samples up to ``span_s`` before (negative) or after sample ``at``."""
    a, b = np.searchsorted(t, sorted((t[at], t[at] + span_s)))
    rows = slice(a, max(b, a) + 1)
    return float(t[rows].mean()), x[rows].mean(axis=0)


def _bridges(t: FloatArray, x: FloatArray, before: int, after: int, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cubic and line from sample ``before`` to sample ``after`` at ``times``, both (m, k)."""
    x0, s0 = _level_and_slope(t, x, before, -1)
    x1, s1 = _level_and_slope(t, x, after, 1)
    length = t[after] - t[before]
    u = ((times - t[before]) / length)[:, None]
    cubic = (
        (1.0 + 2.0 * u) * (1.0 - u) ** 2 * x0
        + u * (1.0 - u) ** 2 * length * s0
        + u**2 * (3.0 - 2.0 * u) * x1
        - u**2 * (1.0 - u) * length * s1
    )
    (t0, m0), (t1, m1) = _mean(t, x, before, -length), _mean(t, x, after, length)
    return cubic, m0 + ((times - t0) / (t1 - t0))[:, None] * (m1 - m0)


def _bridge_error_sd(t: FloatArray, x: FloatArray, k: int, length: float) -> tuple[FloatArray, BoolArray]:
    """Error sd (k,) of the better bridge's integral over the gap after sample ``k``, and where that is the line."""
    worse = np.zeros((2, x.shape[1]))
    found = False
    reach = max(2.0, 4.0 * length)
    for side in (-1, 1):
        edge = t[k] - reach if side < 0 else t[k + 1]
        misses = []
        for start in edge + np.linspace(0.0, reach - length, 24):
            a, b = np.searchsorted(t, [start, start + length])
            if b - a < 2 or a < 2 or b > len(t) - 2 or np.diff(t[a : b + 1]).max() > 0.2 * length:
                continue
            both = np.array(_bridges(t, x, int(a), int(b), t[a : b + 1]))
            misses.append(np.trapezoid(both - x[a : b + 1], t[a : b + 1], axis=1))
        if len(misses) >= 3:
            found = True
            worse = np.maximum(worse, np.sqrt(np.mean(np.square(misses), axis=0)))
    if not found:  # no good data nearby: the scatter of the whole record
        return np.std(x, axis=0) * length, np.zeros(x.shape[1], dtype=bool)
    return worse.min(axis=0), np.asarray(worse[1] < worse[0])


# ---- transient offsets

_REACH = 6  # samples of the parabola on either side
_NEARBY, _BESIDE = 201, 41  # jumps whose median size is the usual one: about a jump, and on either side of it
_LEAST_JUMP_SD = 7.0  # a record of a million samples of white noise holds none
_CANCEL_SD = 4.0  # of the sum of jumps that cancel
_LONGEST_S = 10.0  # of a transient offset: a longer one is a bias that the filter estimates
_UNEVEN = 0.25  # of the usual step: by no more do the steps about a jump differ
_LEAST_REPEATED = 10  # samples equal to earlier ones in a row, where chance alone would ask for fewer
_HASH = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)  # odd, of mixed bits
_SEED = 10  # samples in a row by which a block is found


@dataclass(frozen=True)
class TransientOffset:
    """Readings of one axis of a sensor (0 accelerometer, 1 gyros) that jump away and back, by ``offset`` on average."""

    sensor: int
    axis: int
    start_s: float
    end_s: float
    offset: float


def transient_offsets(time_s: FloatArray, column: FloatArray, noise_sd: float) -> list[tuple[int, int, float]]:
    """First and last sample of each run between jumps that cancel, and the mean offset by the jumps.

    Parameters
    ----------
    time_s, column : (n,) float
        Samples that are there.
    noise_sd : float
        White noise of a sample, in the column's unit.
    """
    out: list[tuple[int, int, float]] = []
    if len(column) < 4 * _REACH:
        return out
    size, sd = _jumps(time_s, column, noise_sd)
    at = _significant_jumps(size, sd)
    first = 0
    while first < len(at) - 1:
        near = at[first:][time_s[at[first:]] - time_s[at[first]] <= _LONGEST_S]
        offset, offset_sd = np.cumsum(size[near]), np.sqrt(np.cumsum(sd[near] ** 2))
        closes = np.flatnonzero(np.abs(offset[1:]) < _CANCEL_SD * offset_sd[1:])
        if len(closes):
            last = int(closes[0]) + 1
            mean = np.average(offset[:last], weights=np.diff(time_s[near[: last + 1]]))
            out.append((int(near[0]) + 1, int(near[last]), float(mean)))
            first += last
        first += 1
    return out


def _jumps(time_s: FloatArray, column: FloatArray, noise_sd: float) -> tuple[FloatArray, FloatArray]:
    """Jump from each sample to the next and its standard deviation, (n - 1,); no jump where steps are uneven."""
    from scipy.ndimage import median_filter, minimum_filter

    n = len(column)
    reach = -(np.arange(_REACH) + 0.5)
    weight = np.linalg.pinv(np.vander(reach, 3, increasing=True))[0]
    size = np.zeros(n - 1)
    for i, w in enumerate(weight):
        size[_REACH - 1 : n - _REACH] += w * (
            column[_REACH + i : n - _REACH + 1 + i] - column[_REACH - 1 - i : n - _REACH - i]
        )
    usual = NORMAL_MAD * median_filter(np.abs(size), size=min(_NEARBY, len(size)), mode="nearest")
    beside = NORMAL_MAD * median_filter(np.abs(size), size=min(_BESIDE, len(size)), mode="nearest")
    k, away = np.arange(len(size)), _REACH + _BESIDE // 2 + 1
    for there in (np.maximum(k - away, 0), np.minimum(k + away, len(size) - 1)):
        usual = np.maximum(usual, beside[there])  # where vibration begins, all are jumps
    step = np.diff(time_s)
    even = np.abs(step / np.median(step) - 1.0) < _UNEVEN
    size[~minimum_filter(even, size=2 * _REACH, mode="nearest")] = 0.0
    least = noise_sd * np.sqrt(2.0 * np.sum(weight**2))
    return size, np.maximum(np.maximum(usual, least), np.finfo(float).tiny)


def _significant_jumps(size: FloatArray, sd: FloatArray) -> IntArray:
    """Significant jumps (k,), each the largest within reach."""
    from scipy.ndimage import maximum_filter

    height = np.abs(size) / sd
    return np.flatnonzero((height > _LEAST_JUMP_SD) & (height == maximum_filter(height, size=4 * _REACH - 1)))


def repeated_samples(measured: FloatArray, noise_sd: float) -> tuple[BoolArray, list[tuple[int, int, int]]]:
    """Samples (n,) that repeat a block before them, and first and last of each block with the first it repeats.

    Parameters
    ----------
    measured : (n, 3) float
        Samples that are there.
    noise_sd : float
    """
    n = len(measured)
    out: BoolArray = np.zeros(n, dtype=bool)
    moving = np.append(True, (measured[1:] != measured[:-1]).any(axis=1))
    likely = float(np.prod([repeat_by_noise(column, noise_sd) for column in measured.T]))
    with np.errstate(divide="ignore"):
        least = max(_LEAST_REPEATED, np.log(_CHANCE / max(n, 1) ** 2) / np.log(min(likely, 1.0 - 1e-9)))
    lag = _lag_to_the_same(measured)
    blocks = []
    for a, b in zip(*runs(np.append(False, (lag[1:] == lag[:-1]) & (lag[1:] > 1))), strict=True):
        if out[b] or moving[a - 1 : b + 1].sum() < min(least, _SEED):
            continue
        # by chance one of its samples may repeat a nearer one, too, so that the block falls into parts
        shift = int(lag[b])
        alike = np.append(np.zeros(shift, dtype=bool), (measured[shift:] == measured[:-shift]).all(axis=1))
        first, last = runs(alike)
        k = int(np.searchsorted(first, b, side="right")) - 1
        start, end = int(first[k]), int(last[k])
        if moving[start : end + 1].sum() >= least:
            out[start : end + 1] = True
            blocks.append((start, end, start - shift))
    return out, blocks


def _lag_to_the_same(measured: FloatArray) -> IntArray:
    """How many samples before each (n,) the nearest one stands that is equal in all axes; 0 for none."""
    bits = np.ascontiguousarray(measured + 0.0).view(np.uint64)  # -0 becomes 0
    mark = bits[:, 0] * _HASH[0] + bits[:, 1] * _HASH[1] + bits[:, 2] * _HASH[2]
    order = np.argsort(mark, kind="stable")
    lag = np.zeros(len(measured), dtype=np.int64)
    follows = (measured[order[1:]] == measured[order[:-1]]).all(axis=1)
    lag[order[1:][follows]] = (order[1:] - order[:-1])[follows]
    return lag


# ---- frozen data

_LEAST_FROZEN_SAMPLES = 5  # fewer equal readings are rounding
_NEIGHBOURS, _LEAST_NEIGHBOURS = 200, 20  # readings on either side that show how often values repeat
_CHANCE = 1e-6  # of one such run in a whole record
_CHANCE_AT_STOP = 1e-3  # of one among the runs at a column's largest or smallest value, which a stop explains
_SAME_STEP = 1e-9  # of the largest value: two readings closer than this differ by rounding


def frozen_samples(column: FloatArray, noise_sd: float) -> BoolArray:
    """Samples (n,) of a column that are frozen at one value for longer than chance allows; NaN equals nothing.

    Parameters
    ----------
    column : (n,) float
    noise_sd : float
        White noise of a sample, in the column's unit.
    """
    out: BoolArray = np.zeros(len(column), dtype=bool)
    same = column[1:] == column[:-1]
    first, last = runs(same)
    last = last + 1
    long = last - first + 1 >= _LEAST_FROZEN_SAMPLES
    first, last = first[long & (first > 0)], last[long & (first > 0)]
    if not len(first):
        out[:] = bool(len(column) >= _LEAST_FROZEN_SAMPLES and same.all() and noise_sd > 0.0)
        return out
    chance = np.maximum(repeat_by_noise(column, noise_sd), _repeat_nearby(same, first, last))
    with np.errstate(divide="ignore"):
        surprise = (last - first) * np.log(chance)
    at_stop = (column[first] == np.nanmin(column)) | (column[first] == np.nanmax(column))
    frozen = surprise < np.log(_CHANCE / len(column))
    frozen |= at_stop & (surprise < np.log(_CHANCE_AT_STOP / max(1, int(at_stop.sum()))))
    for a, b in zip(first[frozen], last[frozen], strict=True):
        out[a : b + 1] = True
    return out


def frozen_rows(record: TriadRecord) -> BoolArray:
    """Samples (n,) of which an axis along body x is frozen, as at the end of its range: they do not show the drag."""
    out: BoolArray = np.zeros(len(record.time_s), dtype=bool)
    for column in record.measured_sensor.T[np.abs(record.spec.dcm_body_sensor[0]) > 1e-9]:
        there = np.flatnonzero(np.isfinite(column))
        out[there] |= frozen_samples(column[there], record.spec.noise_sd)
    return out


def frozen_findings(record: TriadRecord) -> list[Issue]:
    """Spans of `frozen_rows`, which are left out."""
    first, last = runs(frozen_rows(record))
    t, remark = record.time_s, "frozen at one value (the end of its range, or no new data): left out"
    return [
        Issue(remark, "frozen-data", record.spec.name, float(t[a]), float(t[b]))
        for a, b in zip(first, last, strict=True)
    ]


def repeat_by_noise(column: FloatArray, noise_sd: float) -> float:
    """Largest probability that noise leaves a reading where it is."""
    if noise_sd <= 0.0:
        return 1.0
    steps = np.abs(np.diff(column))
    steps = steps[steps > _SAME_STEP * np.nanmax(np.abs(column))]
    return float(erf(steps.min() / (2.0 * np.sqrt(2.0) * noise_sd))) if len(steps) else 1.0


def _repeat_nearby(same: BoolArray, first: IntArray, last: IntArray) -> FloatArray:
    """Share (k,) of readings that repeat next to each run ``first`` to ``last``, on the side where more of them do."""
    count = np.concatenate([[0], np.cumsum(same)])

    def share(low: IntArray, high: IntArray) -> FloatArray:
        size = high - low
        return np.where(size >= _LEAST_NEIGHBOURS, (count[high] - count[low] + 1.0) / (size + 2.0), 0.0)

    before = share(np.maximum(first - 1 - _NEIGHBOURS, 0), np.maximum(first - 1, 0))
    after = share(np.minimum(last + 1, len(same)), np.minimum(last + 1 + _NEIGHBOURS, len(same)))
    return np.asarray(np.maximum(before, after))


class ClockJump(NamedTuple):
    """Tags that jump ahead ``by_s`` at ``at_s``, mid-gap; late ones come ``after`` it, or early ones before.

    ``sensors`` that jump together: 0 the accelerometer, 1 the gyros.
    """

    sensors: tuple[int, ...]
    at_s: float
    by_s: float
    after: bool = True


def gaps_of_tags(records: tuple[TriadRecord, TriadRecord]) -> list[ClockJump]:
    """Short gaps of either sensor or, at one time, of both."""
    found = []
    for sensor, record in enumerate(records):
        step = np.diff(record.time_s)
        usual = usual_steps(step)
        longer = step - usual
        for k in np.flatnonzero((longer > _LEAST_EXCESS * usual) & (longer > _SHORTEST_S) & (longer < LONGEST_LAG_S)):
            found.append(ClockJump((sensor,), float(record.time_s[k] + 0.5 * step[k]), float(longer[k])))
    out: list[ClockJump] = []
    for gap in sorted(found, key=lambda g: g.at_s):
        last = out[-1] if out else None
        if last is not None and gap.at_s - last.at_s < 0.5 * min(gap.by_s, last.by_s) and gap.sensors != last.sensors:
            out[-1] = last._replace(sensors=(0, 1), by_s=0.5 * (last.by_s + gap.by_s))
        else:
            out.append(gap)
    longest = sorted(out, key=lambda g: -g.by_s)[:_MOST_GAPS]
    return sorted(longest, key=lambda g: g.at_s)


def with_corrected_tags(record: TriadRecord, sensor: int, jumps: tuple[ClockJump, ...]) -> TriadRecord:
    """Record whose tags are corrected beyond its jumps."""
    t = record.time_s.copy()
    for jump in (j for j in jumps if sensor in j.sensors):
        later = record.time_s > jump.at_s
        t += np.where(later, -jump.by_s, 0.0) if jump.after else np.where(later, 0.0, jump.by_s)
    return replace(record, time_s=t)


def jump_findings(jumps: tuple[ClockJump, ...], names: tuple[str, str]) -> list[Issue]:
    """One finding for each sensor and jump."""
    out = []
    for jump in jumps:
        remark = f"time tags jump {1e3 * jump.by_s:.1f} ms ahead while no sample is missing: those "
        remark += "after it were set back" if jump.after else "before it were set forward"
        span = jump.at_s - 0.5 * jump.by_s, jump.at_s + 0.5 * jump.by_s
        out += [Issue(remark, "clock-jump", names[sensor], *span) for sensor in jump.sensors]
    return out
