"""How did the shell deflect, by the films of several cameras, simultaneous or switched? One history, one covariance.

Every film is fitted by its own oriented camera (`estimators.camera`), relative to its own benchmark frame. One smooth
process of the deflection is then fitted to all frames at once, each camera ``c`` with systematic errors of its own::

    read_c(t) = theta(t - b_c) - R_c(t) theta(t_c) + P_c(t) p_c + e_c(t)

``b_c`` is its time bias against the camera whose time is known best, in whose time tags the answer is, ``theta(t_c)``
the deflection in its benchmark frame, of which a part ``R_c`` is missing in every reading, ``p_c`` its clocking about
the axis (with the plane's normal ``P_c``), and ``e_c`` half a constant bias, which grows with the deflection as the
readings' sd does (focal length, joint), half Gauss-Markov with the light. The process has a say in these errors: what a
switch would show as a step is a difference of two cameras' biases, as far as their sd allow. The benchmark frames'
deflections share their static part; what is left is the joint's oscillation, common to cameras with the same benchmark
time. A benchmark frame that others saw deflected has that much of an a priori sd: they determine it.

Two cameras are tested by the difference of their readings where both look (`estimators.agreement`), and each by how far
it is off the others where it may be off by any constant, which a switch tests too. Where a test fails, each camera is
tried as the faulty one: if the others agree without it and only without it, it is left out. Otherwise all the cameras'
sd are multiplied by the root of chi-square over its degrees of freedom (Birge's ratio), so that the answer's sd holds
what they differ by.

Assumed: errors of different cameras are independent beside the benchmark's; a joint's station that is wrong for all of
them alike is in each one's sd, and averages out between them as if it were not.

References
----------
R. T. Birge, "The calculation of errors by the method of least squares", Physical Review 40 (1932) 207.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from estimators.agreement import Pair, agreement
from estimators.benchmark import BenchmarkDeflection, RelativeDeflections
from estimators.deflection_spline import Inputs, Solution
from estimators.evidence import (
    CAMERA_PLANE,
    CAMERA_TIME_BIAS,
    Deflection,
    Evidence,
    evidence_of_readings,
    moved_evidence,
)
from estimators.fusion import LEAST_SAMPLES, equations_of, fuse, span_of, with_unresolved_swing
from flightmodel.checks import DivergenceError
from flightmodel.deflection import DeflectionHistory, history_from_lateral
from flightmodel.trajectory import nearest_index

# of the variance of the benchmark's deflection: 0.06 deg statically of 0.12 deg in all (`frame_solution.AprioriSd`)
STATIC_PART = 0.25
_RATE_HZ = 50.0
_ABOUT_S = 1.0  # about a benchmark: a switch leaves a frame or two out
_LEAST_INFORMATION = 0.05  # of a direction of a camera's biases, for it to be tested
_SHAPE = "shell's shape under load"
_BENCHMARK, _OFFSET = "benchmark frames' deflection", "offset of one camera"
_ANY_OFFSET_RAD = float(np.deg2rad(20.0))  # sd of an offset about which nothing is known: larger than any deflection


@dataclass(frozen=True)
class CameraReadings:
    """Readings of one camera.

    Parameters
    ----------
    name : str
    read : RelativeDeflections
        Relative to its benchmark frame; NaN where a frame was refused.
    benchmark : BenchmarkDeflection
        Deflection there; zero with its a priori covariance where nothing determines it.
    plane_sd_rad : float
        Of its clocking about the axis.
    """

    name: str
    read: RelativeDeflections
    benchmark: BenchmarkDeflection
    plane_sd_rad: float

    @property
    def frames(self) -> int:
        """Frames with an answer."""
        return int(self.read.answered.sum())

    def late_against(self, clock: CameraReadings) -> float:
        """A priori sd of the time bias against another camera's, s; zero against its own."""
        return 0.0 if self is clock else float(np.hypot(self.read.time_bias_sd_s, clock.read.time_bias_sd_s))

    def evidence(self, clock: CameraReadings, wider: float = 1.0) -> Evidence:
        """Readings with the camera's errors as inputs, all sd ``wider`` times the stated ones but the time bias's.

        The time bias is against the camera whose time tags count.
        """
        apart_s = self.late_against(clock)
        read, start = self.read, self.benchmark
        theta_yz, crossed = read.added_to(start)
        value, axes = np.linalg.eigh(np.nan_to_num(read.own_covariance + crossed))
        covariance = (axes * np.maximum(value, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1)
        known = np.isfinite(theta_yz).all(axis=1)
        time_s, theta_yz, covariance = read.time_s[known], theta_yz[known], wider**2 * covariance[known]
        one = evidence_of_readings(
            f"camera {self.name}", time_s, theta_yz, covariance, apart_s, wider * self.plane_sd_rad
        )
        root = wider * read.per_benchmark[known] @ np.linalg.cholesky(start.covariance + 1e-18 * np.eye(2))
        inputs = {f"{CAMERA_PLANE} {self.name}" if n == CAMERA_PLANE else n: j for n, j in one.by_input.items()}
        if read.by_shape is not None:
            inputs[_SHAPE] = wider * read.by_shape[known]
        inputs[_BENCHMARK] = np.sqrt(STATIC_PART) * root
        inputs[f"{_BENCHMARK} at {read.benchmark_s:.1f} s"] = np.sqrt(1.0 - STATIC_PART) * root
        return replace(one, by_input=inputs, time_bias=f"{CAMERA_TIME_BIAS} {self.name}")


@dataclass(frozen=True)
class JoinedCameras:
    """One answer of several cameras.

    Parameters
    ----------
    at_frames, smooth : DeflectionHistory
        At all used frames' times, and at any time; method ``"camera"``.
    tests : tuple of Pair
        Of all cameras, at their stated uncertainties.
    left_out : str or None
        Camera that contradicts the others, which agree without it.
    wider : float
        Factor on the cameras' sd where who contradicts cannot be determined.
    solution : Solution
    readings : tuple of CameraReadings
        Those that were used or left out.
    """

    at_frames: DeflectionHistory
    smooth: DeflectionHistory
    tests: tuple[Pair, ...]
    left_out: str | None
    wider: float
    solution: Solution
    readings: tuple[CameraReadings, ...]

    @property
    def agree(self) -> bool:
        """Whether no test failed."""
        return all(test.passed for test in self.tests)

    @property
    def suspect(self) -> str:
        """The camera left out, else those of the worst test; empty where all agree."""
        if self.agree:
            return ""
        return self.left_out or " and ".join(min(self.tests, key=lambda test: test.p_value).methods)

    @property
    def remark(self) -> str:
        """One sentence."""
        if self.agree:
            return "the cameras agree within their stated uncertainties"
        failed = ", ".join(" and ".join((*t.methods, "the others")[:2]) for t in self.tests if not t.passed)
        words = f"{failed}: readings differ beyond the cameras' stated uncertainties"
        if self.left_out is not None:
            return f"{words}; the others agree without {self.left_out}, which is left out"
        return f"{words}; which one errs cannot be determined, the sd of all are {self.wider:.1f} times the stated ones"

    def to_frame(self) -> pd.DataFrame:
        """One row a camera.

        Returns
        -------
        DataFrame
            ``camera, used, frames, from_s, to_s, benchmark_s, bias_y_sd, bias_z_sd`` (how far its constant bias was
            moved, in its sd), ``time_bias_s, time_bias_sd_s`` (against the best
            clock), ``chance`` (least of its tests').
        """
        rows, clock = [], best_clock([one for one in self.readings if one.name != self.left_out])
        for one in self.readings:
            known = one.read.time_s[one.read.answered]
            bias, late, late_sd = (np.nan, np.nan), 0.0, 0.0
            inputs, own = self.solution.inputs, f"camera {one.name}"
            if own in inputs:
                mean = inputs[own][0]
                bias = mean[0], mean[len(mean) // 2]
            timing = f"{CAMERA_TIME_BIAS} {one.name}"
            if timing in inputs:
                mean, cov = inputs[timing]
                late, late_sd = (float(x) * one.late_against(clock) for x in (mean[0], np.sqrt(cov[0, 0])))
            chance = min((t.p_value for t in self.tests if one.name in t.methods), default=np.nan)
            used = one.name != self.left_out
            span = (float(known[0]), float(known[-1])) if len(known) else (np.nan, np.nan)
            rows.append((one.name, used, one.frames, *span, one.read.benchmark_s, *bias, late, late_sd, chance))
        names = ["camera", "used", "frames", "from_s", "to_s", "benchmark_s", "bias_y_sd", "bias_z_sd"]
        return pd.DataFrame(rows, columns=[*names, "time_bias_s", "time_bias_sd_s", "chance"])


def join_cameras(cameras: list[CameraReadings], swing_hz: float | None = None) -> JoinedCameras:
    """Fit one deflection history to the readings of several cameras.

    Parameters
    ----------
    cameras : list of CameraReadings
        At least one with `LEAST_SAMPLES` frames; those with fewer are not used.
    swing_hz : float, optional
        Frequency at which the joint swings; see `estimators.fusion.smoothed`.

    Raises
    ------
    DivergenceError
        Where there are too few readings, or their time biases do not settle.
    """
    enough = _with_loaded_benchmarks([one for one in cameras if one.frames >= LEAST_SAMPLES])
    history, solution, tests = _joined(enough, 1.0)
    left_out, wider, used = None, 1.0, enough
    if not all(test.passed for test in tests):
        left_out = _left_out(enough)
        if left_out is not None:
            used = [one for one in enough if one.name != left_out]
        else:
            wider = float(np.sqrt(max(test.chi_square / test.degrees for test in tests)))
        history, solution, _ = _joined(used, wider)
    frames = np.unique(np.concatenate([one.read.time_s[one.read.answered] for one in used]))
    at = np.isin(history.time_s, frames)
    words = f"from {len(used)} cameras with systematic errors of their own: {', '.join(one.name for one in used)}"
    at_frames, smooth = (
        history_from_lateral(
            history.time_s[rows], history.theta_yz_rad[rows], history.lateral_cov_without_plane[rows], "camera", words
        )
        for rows in (at, np.ones(len(at), dtype=bool))
    )
    if swing_hz is not None:
        smooth = with_unresolved_swing(at_frames, smooth, swing_hz)
    return JoinedCameras(at_frames, smooth, tuple(tests), left_out, wider, solution, tuple(enough))


def _with_loaded_benchmarks(cameras: list[CameraReadings]) -> list[CameraReadings]:
    """Cameras with the benchmark's a priori sd set from what cameras with earlier benchmarks read at that time.

    The a priori sd holds before the load; a camera that was switched on later has no such frame. The smallest of
    several readings counts: one camera that errs must not set the others free.
    """
    out = []
    for one in cameras:
        at, sizes = one.read.benchmark_s, [np.inf]
        for other in cameras:
            time_s = other.read.time_s[other.read.answered]
            if other.read.benchmark_s < at and np.abs(time_s - at).min() < _ABOUT_S:
                k = int(np.abs(time_s - at).argmin())
                sizes.append(float(np.linalg.norm(other.read.theta_yz_rad[other.read.answered][k])))
        sd = np.sqrt(0.5 * np.trace(one.benchmark.covariance))
        if one.benchmark.with_readings is None and sd < min(sizes) < np.inf:
            start = replace(one.benchmark, covariance=min(sizes) ** 2 * np.eye(2))
            out.append(replace(one, benchmark=start))
        else:
            out.append(one)
    return out


def best_clock(cameras: list[CameraReadings]) -> CameraReadings:
    """Reference camera: the one with the smallest time-bias sd, in whose time tags the answer is; first of equals."""
    return min(cameras, key=lambda one: one.read.time_bias_sd_s)


def _joined(cameras: list[CameraReadings], wider: float) -> tuple[DeflectionHistory, Solution, list[Pair]]:
    """Deflection and posterior of some cameras, and the tests of their agreement."""
    if not cameras:
        raise DivergenceError("camera: no camera has enough frames with an answer", code="too-few-data")
    evidence = [one.evidence(best_clock(cameras), wider) for one in cameras]
    known = np.sort(np.concatenate([one.time_s for one in evidence]))
    grid = np.arange(np.ceil(known.min() * _RATE_HZ), np.floor(known.max() * _RATE_HZ) + 1.0) / _RATE_HZ
    at_s = np.unique(np.concatenate([known, grid]))
    # a grid time within rounding of a frame's would be a row of its own
    at_s = at_s[np.isin(at_s, known) | (np.abs(at_s - known[nearest_index(known, at_s)]) > 1e-6)]

    def read(inputs: Inputs, about: Deflection | None) -> list[Evidence]:
        return [moved_evidence(one, inputs, about) for one in evidence]

    # 1.5 usual steps of the slowest camera from a frame the process still answers, 0.5 s at least
    near_s = max(0.5, *(1.5 * float(np.median(np.diff(one.time_s))) for one in evidence))
    history, solution = fuse(read, "camera", at_s, near_s=near_s, free_process=False)
    tests: list[Pair] = []
    if len(cameras) > 1 and wider == 1.0:
        timed = _timed(evidence, solution)
        tests = [*_pair_tests(timed, solution), *_offset_tests(timed)]
    return history, solution, tests


def _timed(evidence: list[Evidence], solution: Solution) -> list[Evidence]:
    """Readings moved by the fitted time biases; the remaining time-bias errors are inputs like any other."""
    known = {name: value for name, value in solution.inputs.items() if name.startswith(CAMERA_TIME_BIAS)}
    out = []
    for one in evidence:
        moved = moved_evidence(one, {name: mean for name, (mean, _) in known.items()}, solution.deflection)
        own = {name: cov[0, 0] for name, (_, cov) in known.items() if name in moved.by_input}
        left = {name: np.sqrt(var) * moved.by_input[name] for name, var in own.items()}
        out.append(replace(moved, by_input=moved.by_input | left, time_bias_sd_s=0.0, time_bias=""))
    return out


def _pair_tests(timed: list[Evidence], solution: Solution) -> list[Pair]:
    """Differences of every two cameras in overlapping spans, corrected for the motion between their frames."""
    still = [replace(e, theta_yz_rad=e.theta_yz_rad - solution.deflection(e.time_s)) for e in timed]
    pairs = agreement(still).pairs
    return [replace(pair, methods=tuple(m.removeprefix("camera ") for m in pair.methods)) for pair in pairs]


def _offset_tests(timed: list[Evidence]) -> list[Pair]:
    """Offset of each camera, left free, from the others, over its sd from all errors.

    The process's size is then the motion's own: taken as motion, an offset at a switch would make it large enough to
    explain the step.
    """
    out, free = [], []
    for k, one in enumerate(timed):
        anything = np.zeros((len(one.time_s), 2, 2 * len(timed)))
        anything[:, :, 2 * k : 2 * k + 2] = _ANY_OFFSET_RAD * np.eye(2)
        free.append(replace(one, by_input=one.by_input | {_OFFSET: anything}))
    whole = equations_of(free, {}, span_of(free))
    offsets = np.arange(whole.place[_OFFSET].start, whole.place[_OFFSET].stop)
    others = np.setdiff1d(np.arange(len(whole.matrix.corner)), offsets)
    for k, one in enumerate(timed):
        alone = whole.with_inputs(np.concatenate([others, offsets[2 * k : 2 * k + 2]]))
        found = alone.solved(alone.process_size(), "camera").input_posterior
        mean, covariance = found.mean[-2:], found.covariance[-2:, -2:]
        if np.trace(covariance) < 2.0 - _LEAST_INFORMATION:  # else nothing connects it with the others
            square = float(mean @ np.linalg.solve(covariance, mean))
            out.append(Pair((one.method.removeprefix("camera "),), square, 2))
    return out


def _left_out(cameras: list[CameraReadings]) -> str | None:
    """The only camera whose exclusion makes the others agree; None if there is not exactly one."""
    if len(cameras) < 3:
        return None
    sound = []
    for one in cameras:
        try:
            _, _, tests = _joined([other for other in cameras if other is not one], 1.0)
        except DivergenceError:
            continue
        if all(test.passed for test in tests):
            sound.append(one.name)
    return sound[0] if len(sound) == 1 else None
