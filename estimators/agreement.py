"""Do the methods agree, and if not, what is most likely wrong?

The difference of two methods' readings at one time holds no deflection, only what they lean on::

    d(t) = read_a - read_b - (A_a - A_b) theta'' = -(J_a - J_b) x + e,      x ~ N(0, 1)

taken at the sparser one's times and averaged over spans. Its chi-square against that covariance is the test of a
pair. Which input is to blame is asked of each: how much likelier are all readings together if this one is `WIDER` times
less well known than stated? With mean ``m`` and covariance ``P`` of its unit normals after the fusion, its log is

    gain = m' (1/(WIDER^2 - 1) + V)^-1 m / 2 - log det(1 + (WIDER^2 - 1) V) / 2,      V = 1 - P

(``V`` is ``J' C^-1 J`` of the readings' whole covariance ``C``, and ``m`` is ``J' C^-1 d``). Directions of which less
than `LEAST_TOLD` was learnt are left out: what the equations of the methods neglect would move them far at no cost.

Errors that happen have few directions and a size. Of those in `estimators.agreement`, of columns ``D``, the same is

    gain = m' D (1 + D' V D)^-1 D' m / 2 - log det(1 + D' V D) / 2

and such a suspect has the mean of both likelihoods. No other decision among these errors finds more of them at as many
false alarms, where their sizes are as stated and the sides they fall to are not known (Neyman, Pearson).

What the readings cannot tell apart is in the singular values of the whitened ``J``: a direction of the inputs with the
singular value ``s`` keeps ``1 / (1 + s^2)`` of its variance.

What a gross error of each thing the methods lean on would look like: of known size, to an unknown side.

Sizes are of errors that happen and that stated uncertainties do not mean: a coefficient table of another
configuration, a package bolted on askew, a c.g. measured before the last change, a camera clocked by another drawing.
Each is a matrix of columns in the inputs' unit normals; the error is these times a standard normal vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.stats import chi2

from estimators.evidence import (
    ACCELEROMETER,
    ATTITUDE,
    CAMERA_PLANE,
    FILM_CLOCK,
    PRESSURE,
    VEHICLE_INPUTS,
    WIND,
    Deflection,
    Evidence,
    offset_sd_m,
)
from estimators.fusion import Learnt, means_over_spans
from estimators.loads import PulseData
from flightmodel.checks import BoolArray, FloatArray

COEFFICIENTS, MOUNT = "aerodynamic coefficients", "accelerometer's mounting or bias"
OFFSET, CAMERA_TURNED = "initial c.g. offset", "camera's orientation, benchmark or plane"
GROSS_COEFFICIENT = 0.15  # of C_m and C_N, each by itself
GROSS_MOUNT_RAD = np.deg2rad(0.5)  # across the long axis; about it the drag hardly turns
GROSS_OFFSET_M = 0.005  # of the centerbody's c.g.
GROSS_PLANE_RAD = np.deg2rad(25.0)


def gross_errors(pulse: PulseData, learnt: Learnt, plane_sd_rad: float) -> dict[str, FloatArray]:
    """Columns ``(inputs, directions)`` of each gross error, by the name of the suspect.

    A mount that is turned turns the attitude with it: the reconstruction found both from one measurement.

    Parameters
    ----------
    pulse : PulseData
    learnt : Learnt
        Says where each input's unit normals stand.
    plane_sd_rad : float
        What one unit normal of the camera's plane is.
    """
    known, size = pulse.vehicle.uncertainty, len(learnt.mean)
    offset = GROSS_OFFSET_M / np.sqrt(2.0)
    single = {
        COEFFICIENTS: {"C_m": (GROSS_COEFFICIENT, known.cm), "C_N": (GROSS_COEFFICIENT, known.cn)},
        OFFSET: {f"initial offset {axis}": (offset, offset_sd_m(pulse.vehicle)) for axis in "yz"},
        CAMERA_TURNED: {CAMERA_PLANE: (GROSS_PLANE_RAD, plane_sd_rad)},
    }
    out = {}
    for suspect, inputs in single.items():
        there = {name: wrong / sd for name, (wrong, sd) in inputs.items() if name in learnt.place and sd > 0.0}
        out[suspect] = np.zeros((size, len(there)))
        for k, (name, normals) in enumerate(there.items()):
            out[suspect][learnt.place[name].start, k] = normals
    if ACCELEROMETER in learnt.place:
        use = pulse.through_pulse
        force, root = pulse.specific_force_body_mps2[use], pulse.force_root_mps2[use].reshape(-1, 9)
        axes = GROSS_MOUNT_RAD / np.sqrt(2.0) * np.eye(3)[1:]
        turned = np.column_stack([np.cross(axis, force).ravel() for axis in axes])
        out[MOUNT] = np.zeros((size, 2))
        out[MOUNT][learnt.place[ACCELEROMETER]] = np.linalg.lstsq(root, turned, rcond=1e-6)[0]
    return {suspect: columns for suspect, columns in out.items() if columns.any()}


SPAN_S = 2.0
LEFT_OUT_RAD = np.deg2rad(0.05)  # of the methods' own equations, in each mean: up to 0.05 deg where the pulse ends
HOLE = 2.5  # usual steps: through a wider one readings are not joined by lines
SWING_STEP_S = 0.1
# a sounding's errors may hold waves that the fusion's air does not know: 5 of 50 sound flights fail a pair at 1 %
CONFIDENCE = 0.999
WIDER = 4.0
LEAST_TOLD = 0.05  # part of a direction's variance that the readings must have taken away
CAMERA = "camera"
LARGEST_SD_RAD = np.deg2rad(1.0)  # of a reading that is held against another
# odds at which an input is taken as wrong though every pair passes; more where the stated error is only assumed
LARGEST_GAIN, LARGEST_ASSUMED_GAIN = np.log(5.0), np.log(1e4)
ASSUMED = ("mass properties", "attitude of the trajectory", "sounded wind", "sounded density")
ALSO = np.log(100.0)  # odds below which the next suspect is named too: odds were seen to be overconfident
BLAME = {
    COEFFICIENTS: ("C_A", "C_N", "C_m", "C_mq"),
    MOUNT: (ACCELEROMETER,),
    OFFSET: ("initial offset y", "initial offset z"),
    "mass properties": tuple(n for n in VEHICLE_INPUTS if n.startswith(("aeroshell", "centerbody"))),
    "attitude of the trajectory": (ATTITUDE,),
    "sounded wind": (WIND,),
    "sounded density": (PRESSURE,),
    CAMERA_TURNED: (CAMERA, CAMERA_PLANE),
    "film's clock": (FILM_CLOCK,),
}


@dataclass(frozen=True)
class Pair:
    """Test of two methods: ``chi_square`` of ``degrees`` and the chance of a larger one."""

    methods: tuple[str, str]
    chi_square: float
    degrees: int
    chance: float

    @property
    def passed(self) -> bool:
        """Whether the difference is what the error bars allow."""
        return self.chance > 1.0 - CONFIDENCE


@dataclass(frozen=True)
class Agreement:
    """Every pair's test, the gain of each possible culprit, and the singular values of what tells them apart."""

    pairs: tuple[Pair, ...]
    gains: dict[str, float]
    singular_values: FloatArray

    @property
    def suspects(self) -> tuple[str, ...]:
        """Possible culprits, the likeliest first; none where every pair agrees and none stands out."""
        least = {name: LARGEST_ASSUMED_GAIN if name in ASSUMED else LARGEST_GAIN for name in self.gains}
        if all(p.passed for p in self.pairs) and not any(gain > least[name] for name, gain in self.gains.items()):
            return ()
        return tuple(sorted(self.gains, key=lambda name: -self.gains[name]))

    @property
    def named(self) -> tuple[str, ...]:
        """The likeliest suspect, and the next where it is hardly less likely."""
        suspects = [s for s in self.suspects if self.gains[s] > 0.0]
        return tuple(s for s in suspects[:2] if self.gains[s] > self.gains[suspects[0]] - ALSO)

    @property
    def words(self) -> str:
        """One sentence."""
        if not self.pairs:
            return "only one method answers: nothing to hold it against"
        failed = [f"{a} and {b}" for a, b in (p.methods for p in self.pairs if not p.passed)]
        if not failed and not self.suspects:
            return "the methods agree within their error bars"
        suspects = " or the ".join(self.named)
        would = f": the {suspects} would explain it best" if suspects else ", and no single input would explain it"
        return f"{', '.join(failed) or 'the methods'} disagree beyond their error bars{would}"


def agreement(
    evidence: list[Evidence],
    learnt: Learnt | None = None,
    deflection: Deflection | None = None,
    gross: dict[str, FloatArray] | None = None,
) -> Agreement:
    """Test all pairs of methods over the spans in which both answer, and score what they lean on.

    Parameters
    ----------
    evidence : list of Evidence
        As told: no input moved.
    learnt : Learnt, optional
        What the fusion says of the inputs; without it there are no suspects.
    deflection : callable, optional
        From times to lateral vectors (n, 2), rad: what of it swings is taken out of the readings.
    gross : dict of str to (k, r) float, optional
        Gross errors that suspects may have (`estimators.agreement`).
    """
    pairs: list[Pair] = []
    for a, b in combinations(evidence, 2):
        d, cov = _difference(a, b, deflection)
        if len(d):
            square = float(d @ cho_solve(cho_factor(cov), d))
            pairs.append(Pair((a.method, b.method), square, len(d), float(chi2.sf(square, len(d)))))
    if learnt is None or not pairs:
        return Agreement(tuple(pairs), {}, np.empty(0))
    gains = {}
    for culprit, inputs in BLAME.items():
        rows = [np.arange(learnt.place[n].start, learnt.place[n].stop) for n in inputs if n in learnt.place]
        if CAMERA in inputs and CAMERA in learnt.place:  # of its own error what lasts: the first of each axis
            rows[0] = rows[0][[0, len(rows[0]) // 2]]
        wider = _gain(learnt, np.concatenate(rows)) if rows else None
        scores = [] if wider is None else [wider]
        if gross is not None and culprit in gross:
            scores.append(gross_gain(learnt, gross[culprit]))
        if scores:
            gains[culprit] = float(np.logaddexp.reduce(scores) - np.log(len(scores)))
    told = np.clip(np.linalg.eigvalsh(np.eye(len(learnt.mean)) - learnt.covariance), 0.0, 1.0 - 1e-12)
    return Agreement(tuple(pairs), gains, np.sqrt(told / (1.0 - told))[::-1])


def _gain(learnt: Learnt, rows: NDArray[np.int64]) -> float | None:
    """Log of how much likelier all readings are with these inputs `WIDER` times less well known; None if untold."""
    told, axes = np.linalg.eigh(np.eye(len(rows)) - learnt.covariance[np.ix_(rows, rows)])
    known = told > LEAST_TOLD
    if not known.any():
        return None
    more, along = WIDER**2 - 1.0, (axes.T @ learnt.mean[rows])[known]
    told = told[known]
    return float(0.5 * np.sum(along**2 / (1.0 / more + told)) - 0.5 * np.sum(np.log1p(more * told)))


def gross_gain(learnt: Learnt, columns: FloatArray) -> float:
    """Log of how much likelier all readings are with an error that is ``columns`` (k, r) times unit normals."""
    told = np.eye(columns.shape[1]) + columns.T @ (columns - learnt.covariance @ columns)
    along = columns.T @ learnt.mean
    return float(0.5 * along @ np.linalg.solve(told, along) - 0.5 * np.linalg.slogdet(told)[1])


def _difference(a: Evidence, b: Evidence, deflection: Deflection | None) -> tuple[FloatArray, FloatArray]:
    """Differences (2 n,) and their covariance: at the sparser one's times, averaged over spans of `SPAN_S`."""
    a, b = _well_read(a), _well_read(b)
    if len(a.time_s) < 2 or len(b.time_s) < 2:
        return np.empty(0), np.empty((0, 0))
    sparse, dense = sorted((a, b), key=lambda e: -float(np.median(np.diff(e.time_s))))
    after = np.searchsorted(dense.time_s, sparse.time_s).clip(1, len(dense.time_s) - 1)
    step = dense.time_s[after] - dense.time_s[after - 1]
    part = (sparse.time_s - dense.time_s[after - 1]) / step
    both = (part >= 0.0) & (part <= 1.0) & (step < HOLE * np.median(np.diff(dense.time_s)))
    time_s, after, part = sparse.time_s[both], after[both], part[both]
    if not len(time_s):
        return np.empty(0), np.empty((0, 0))

    def between(values: FloatArray) -> FloatArray:
        w = part.reshape((-1,) + (1,) * (values.ndim - 1))
        return np.asarray((1.0 - w) * values[after - 1] + w * values[after])

    d = sparse.theta_yz_rad[both] - between(dense.theta_yz_rad)
    if deflection is not None:
        swing = sparse.by_acceleration_s2[both] - between(dense.by_acceleration_s2)
        d -= np.einsum("nij,nj->ni", swing, _second_derivative(deflection, time_s))
    names = dict.fromkeys([*sparse.by_input, *dense.by_input])
    responses = [_less(sparse.by_input.get(n), dense.by_input.get(n), both, between) for n in names]
    noise = sparse.independent_cov[both] + between(dense.independent_cov)
    share = means_over_spans(time_s, SPAN_S, from_s=0.0)
    columns = np.tensordot(share, np.concatenate(responses, axis=2), axes=1).reshape(2 * len(share), -1)
    blocks = np.einsum("bn,nij->bij", share**2, noise) + LEFT_OUT_RAD**2 * np.eye(2)
    return (share @ d).ravel(), columns @ columns.T + block_diag(*blocks)


def _well_read(one: Evidence) -> Evidence:
    """Evidence where its sum of errors is below `LARGEST_SD_RAD`."""
    keep = np.isfinite(one.theta_yz_rad).all(axis=1)
    keep &= np.trace(one.covariance, axis1=1, axis2=2) < LARGEST_SD_RAD**2
    return replace(
        one,
        time_s=one.time_s[keep],
        theta_yz_rad=one.theta_yz_rad[keep],
        by_acceleration_s2=one.by_acceleration_s2[keep],
        by_input={name: j[keep] for name, j in one.by_input.items()},
        independent_cov=one.independent_cov[keep],
        bend=None,
    )


def _less(
    sparse: FloatArray | None, dense: FloatArray | None, both: BoolArray, between: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Response of the difference to an input on which one of the two may not lean."""
    if sparse is None:
        assert dense is not None
        return -between(dense)
    return sparse[both] if dense is None else sparse[both] - between(dense)


def _second_derivative(deflection: Deflection, time_s: FloatArray) -> FloatArray:
    before, at, after = (deflection(time_s + shift) for shift in (-SWING_STEP_S, 0.0, SWING_STEP_S))
    return np.asarray((before - 2.0 * at + after) / SWING_STEP_S**2)
