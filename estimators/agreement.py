"""Do the methods agree, and if not, which of their inputs is most likely wrong?

What a method's readings have beyond the fused deflection, less that of another method, holds no deflection, only the
inputs on which they depend::

    d = mean(off_a) - mean(off_b) = -(mean(J_a) - mean(J_b)) x + e,      off = read - theta - B theta' - A theta''

with ``x ~ N(0, 1)``: means over spans of time, each method's over all of its own samples. Its chi-square against that
covariance is the test of a pair. The joint swings faster than the deflection's spline can follow (a stiff one at 8 Hz):
what ``A theta''`` leaves of that in a sample, a degree in the trim late in the pulse, averages out over the samples of
a span. It does not over a few that are chosen by their sd, which come at one phase of the motion, nor over one method's
samples at the times of another's, whose rate the swing may be near.

Each input is a fault hypothesis: how much likelier are all readings together if its stated sd is `WIDER` times too
small (prior inflation)? With mean ``m`` and covariance ``P`` of its unit normals after the fusion, the log of that
likelihood ratio is

    gain = m' (1/(WIDER^2 - 1) + V)^-1 m / 2 - log det(1 + (WIDER^2 - 1) V) / 2,      V = 1 - P

(``V`` is ``J' C^-1 J`` of the readings' whole covariance ``C``, and ``m`` is ``J' C^-1 d``). Directions with an
information gain below `_LEAST_INFORMATION` are left out: the methods' neglected terms would move them far at no cost.

Faults that occur have few directions and a size: a coefficient table of another configuration, a package mounted
askew, a c.g. measured before the last change, a camera clocked by another drawing. With the columns ``D`` of such a
fault (`fault_hypotheses`), the error being ``D`` times a standard normal vector, the same log is

    gain = m' D (1 + D' V D)^-1 D' m / 2 - log det(1 + D' V D) / 2

and a hypothesis with both has the mean of both likelihoods. No other decision among these faults finds more of them at
as many false alarms, where their sizes are as stated and their signs unknown (Neyman, Pearson).

Directions of the inputs that are not separately observable show in the singular values of the whitened ``J``: a
direction with the singular value ``s`` keeps ``1 / (1 + s^2)`` of its variance.

Assumed: Gaussian errors and priors, readings linear in the inputs, one fault at a time.

References
----------
J. Neyman, E. S. Pearson, "On the problem of the most efficient tests of statistical hypotheses", Philosophical
Transactions of the Royal Society A 231 (1933) 289.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.special import chdtrc

from estimators.deflection_spline import InputPosterior
from estimators.evidence import (
    ACCELEROMETER,
    ATTITUDE,
    CAMERA_PLANE,
    CAMERA_TIME_BIAS,
    PRESSURE,
    VEHICLE_INPUTS,
    WIND,
    Deflection,
    Evidence,
    offset_sd_m,
)
from estimators.fusion import shares_of_spans, span_numbers
from estimators.loads import FlightLoads
from flightmodel.checks import BoolArray, FloatArray

COEFFICIENTS, MOUNT = "aerodynamic coefficients", "accelerometer's mounting or bias"
OFFSET, CAMERA_MISALIGNED = "initial c.g. offset", "camera's orientation, benchmark or plane"
HYPOTHESES = {
    COEFFICIENTS: ("C_A", "C_N", "C_m", "C_mq"),
    MOUNT: (ACCELEROMETER,),
    OFFSET: ("initial offset y", "initial offset z"),
    "mass properties": tuple(n for n in VEHICLE_INPUTS if n.startswith(("aeroshell", "centerbody"))),
    "attitude of the trajectory": (ATTITUDE,),
    "sounded wind": (WIND,),
    "sounded density": (PRESSURE,),
    CAMERA_MISALIGNED: ("camera", CAMERA_PLANE),
    CAMERA_TIME_BIAS: (CAMERA_TIME_BIAS,),
}
# sizes of faults
_FAULT_COEFFICIENT = 0.15  # of C_m and C_N, each by itself
FAULT_MOUNT_RAD = np.deg2rad(0.5)  # normal to the long axis; about it the drag hardly changes direction
_FAULT_OFFSET_M = 0.005  # of the centerbody's c.g.
_FAULT_PLANE_RAD = np.deg2rad(25.0)  # as uncertain as the plane that the paper assumes
# difference of two methods
SPAN_S = 2.0
_LEFT_OUT_RAD = np.deg2rad(0.05)  # neglected by the methods' equations, in each mean: up to 0.05 deg at the pulse's end
_LARGEST_STEP = 2.5  # usual steps: over a wider hole readings are not interpolated
_LARGEST_SD_RAD = np.deg2rad(1.0)  # of a difference that is tested: beyond it the methods are not linear
# a sounding's errors may hold waves shorter than the fusion's model
CONFIDENCE = 0.999
WIDER = 4.0
_LEAST_INFORMATION = 0.05  # part of a direction's variance that the readings must have taken away
# odds at which an input is named though every pair passes, with which a twentieth of sound flights is said to disagree
# (of 107, docs/deflection.md: at 5 one in fourteen); higher where its stated error is only assumed
_LARGEST_GAIN, _LARGEST_ASSUMED_GAIN = np.log(7.0), np.log(1e4)
_ASSUMED = ("mass properties", "attitude of the trajectory", "sounded wind", "sounded density")
_ALSO = np.log(100.0)  # odds below which the next hypothesis is named too: odds were found to be overconfident


@dataclass(frozen=True)
class Pair:
    """Test of two methods or cameras, or of one camera against all others.

    Parameters
    ----------
    methods : tuple of str
    chi_square : float
        Of their differences.
    degrees : int
        Degrees of freedom.
    """

    methods: tuple[str, ...]
    chi_square: float
    degrees: int

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square."""
        return float(chdtrc(self.degrees, self.chi_square))

    @property
    def passed(self) -> bool:
        """Whether the difference is within the stated uncertainties."""
        return self.p_value > 1.0 - CONFIDENCE


@dataclass(frozen=True)
class Agreement:
    """Every pair's test, the gain of each fault hypothesis, and the singular values of the whitened responses."""

    pairs: tuple[Pair, ...]
    gains: dict[str, float]
    singular_values: FloatArray

    @property
    def hypotheses(self) -> tuple[str, ...]:
        """Fault hypotheses, the likeliest first; none where every pair agrees and no gain is large."""
        least = {name: _LARGEST_ASSUMED_GAIN if name in _ASSUMED else _LARGEST_GAIN for name in self.gains}
        if all(p.passed for p in self.pairs) and not any(gain > least[name] for name, gain in self.gains.items()):
            return ()
        return tuple(sorted(self.gains, key=lambda name: -self.gains[name]))

    @property
    def likeliest(self) -> tuple[str, ...]:
        """The likeliest fault hypothesis, and the next where it is hardly less likely."""
        found = [h for h in self.hypotheses if self.gains[h] > 0.0]
        return tuple(h for h in found[:2] if self.gains[h] > self.gains[found[0]] - _ALSO)

    @property
    def remark(self) -> str:
        """One sentence."""
        return self.explained("")

    def explained(self, cause: str) -> str:
        """One sentence; ``cause``: an independently found error, which is named before any input is suspected."""
        if not self.pairs:
            return "only one method has an answer: no independent measurement to compare it with"
        failed = [" and ".join(p.methods) for p in self.pairs if not p.passed]
        if not failed and not self.hypotheses:
            return "the methods agree within their stated uncertainties"
        named = " or the ".join(self.likeliest)
        would = f": an error of the {named} explains it best" if named else ", and no error of one input explains it"
        would = f": {cause}" if cause else would
        return f"{', '.join(failed) or 'the methods'} disagree beyond their stated uncertainties{would}"


def fault_hypotheses(loads: FlightLoads, input_posterior: InputPosterior, plane_sd_rad: float) -> dict[str, FloatArray]:
    """Columns ``(inputs, directions)`` of each fault of known size and unknown sign, by the name of its hypothesis.

    A misaligned accelerometer brings an error of the attitude with it: the reconstruction estimated both together.

    Parameters
    ----------
    loads : FlightLoads
    input_posterior : InputPosterior
        For the place of each input's unit normals.
    plane_sd_rad : float
        Of one unit normal of the camera's clocking.
    """
    known, size = loads.vehicle.uncertainty, len(input_posterior.mean)
    offset = _FAULT_OFFSET_M / np.sqrt(2.0)
    single = {
        COEFFICIENTS: {"C_m": (_FAULT_COEFFICIENT, known.cm), "C_N": (_FAULT_COEFFICIENT, known.cn)},
        OFFSET: {f"initial offset {axis}": (offset, offset_sd_m(loads.vehicle)) for axis in "yz"},
        CAMERA_MISALIGNED: {CAMERA_PLANE: (_FAULT_PLANE_RAD, plane_sd_rad)},
    }
    out = {}
    for hypothesis, inputs in single.items():
        there = {name: wrong / sd for name, (wrong, sd) in inputs.items() if name in input_posterior.place and sd > 0.0}
        out[hypothesis] = np.zeros((size, len(there)))
        for k, (name, normals) in enumerate(there.items()):
            out[hypothesis][input_posterior.place[name].start, k] = normals
    if ACCELEROMETER in input_posterior.place:
        pulse = loads.rows(loads.through_pulse)
        force, root = pulse.specific_force_body_mps2, pulse.force_root_mps2.reshape(-1, pulse.force_root_mps2.shape[2])
        axes = FAULT_MOUNT_RAD / np.sqrt(2.0) * np.eye(3)[1:]
        misaligned = np.column_stack([np.cross(axis, force).ravel() for axis in axes])
        out[MOUNT] = np.zeros((size, 2))
        out[MOUNT][input_posterior.place[ACCELEROMETER]] = np.linalg.lstsq(root, misaligned, rcond=1e-6)[0]
    return {hypothesis: columns for hypothesis, columns in out.items() if columns.any()}


def agreement(
    evidence: list[Evidence],
    input_posterior: InputPosterior | None = None,
    deflection: Deflection | None = None,
    faults: dict[str, FloatArray] | None = None,
) -> Agreement:
    """Test all pairs of methods over the spans in which both answer, and score the inputs on which they depend.

    Parameters
    ----------
    evidence : list of Evidence
        At the stated inputs.
    input_posterior : InputPosterior, optional
        Of the fusion; without it there are no fault hypotheses.
    deflection : callable, optional
        From times to lateral vectors (n, 2), rad: its oscillation is taken out of the readings.
    faults : dict of str to (k, r) float, optional
        Columns of `fault_hypotheses`.
    """
    pairs: list[Pair] = []
    for a, b in combinations(evidence, 2):
        d, cov = _difference(a, b, deflection)
        if len(d):
            square = float(d @ cho_solve(cho_factor(cov), d))
            pairs.append(Pair((a.method, b.method), square, len(d)))
    if input_posterior is None or not pairs:
        return Agreement(tuple(pairs), {}, np.empty(0))
    gains = {}
    for hypothesis, inputs in HYPOTHESES.items():
        rows = [
            np.arange(input_posterior.place[n].start, input_posterior.place[n].stop)
            for n in inputs
            if n in input_posterior.place
        ]
        if "camera" in inputs and "camera" in input_posterior.place:  # its own constant error: the first of each axis
            rows[0] = rows[0][[0, len(rows[0]) // 2]]
        wider = _inflation_gain(input_posterior, np.concatenate(rows)) if rows else None
        scores = [] if wider is None else [wider]
        if faults is not None and hypothesis in faults:
            scores.append(fault_gain(input_posterior, faults[hypothesis]))
        if scores:
            gains[hypothesis] = float(np.logaddexp.reduce(scores) - np.log(len(scores)))
    information = np.clip(
        np.linalg.eigvalsh(np.eye(len(input_posterior.mean)) - input_posterior.covariance), 0.0, 1.0 - 1e-12
    )
    return Agreement(tuple(pairs), gains, np.sqrt(information / (1.0 - information))[::-1])


def _inflation_gain(input_posterior: InputPosterior, rows: NDArray[np.int64]) -> float | None:
    """Log likelihood ratio of these inputs' sd inflated `WIDER` times; None without information on them."""
    information, axes = np.linalg.eigh(np.eye(len(rows)) - input_posterior.covariance[np.ix_(rows, rows)])
    informed = information > _LEAST_INFORMATION
    if not informed.any():
        return None
    more, along = WIDER**2 - 1.0, (axes.T @ input_posterior.mean[rows])[informed]
    information = information[informed]
    return float(0.5 * np.sum(along**2 / (1.0 / more + information)) - 0.5 * np.sum(np.log1p(more * information)))


def fault_gain(input_posterior: InputPosterior, columns: FloatArray) -> float:
    """Log likelihood ratio of an error that is ``columns`` (k, r) times unit normals."""
    spread = np.eye(columns.shape[1]) + columns.T @ (columns - input_posterior.covariance @ columns)
    along = columns.T @ input_posterior.mean
    return float(0.5 * along @ np.linalg.solve(spread, along) - 0.5 * np.linalg.slogdet(spread)[1])


def _difference(a: Evidence, b: Evidence, deflection: Deflection | None) -> tuple[FloatArray, FloatArray]:
    """Differences (2 n,) of the methods' means over spans of `SPAN_S` in which both answer, and their covariance.

    Without a common deflection the denser one's readings are those at the sparser one's times, the joint at rest.
    """
    a, b = (_chosen(one, np.asarray(np.isfinite(one.theta_yz_rad).all(axis=1))) for one in (a, b))
    if len(a.time_s) < 2 or len(b.time_s) < 2:
        return np.empty(0), np.empty((0, 0))
    sparse, dense = sorted((a, b), key=lambda e: -float(np.median(np.diff(e.time_s))))
    sparse = _chosen(sparse, _answered(dense, sparse.time_s))
    if deflection is not None:
        of_sparse, of_dense = (span_numbers(one.time_s, SPAN_S, from_s=0.0) for one in (sparse, dense))
        sparse, dense = _chosen(sparse, np.isin(of_sparse, of_dense)), _chosen(dense, np.isin(of_dense, of_sparse))
    if not len(sparse.time_s):
        return np.empty(0), np.empty((0, 0))
    share = shares_of_spans(sparse.time_s, SPAN_S, from_s=0.0).toarray()
    dense_share = share @ _between(dense.time_s, sparse.time_s)
    if deflection is not None:
        dense_share = shares_of_spans(dense.time_s, SPAN_S, from_s=0.0).toarray()
    d, by_input, noise = _means(sparse, share, deflection)
    other, other_by_input, other_noise = _means(dense, dense_share, deflection)
    none, names = np.zeros((len(d), 2, 1)), dict.fromkeys([*by_input, *other_by_input])
    apart = [none, *(by_input.get(n, none) - other_by_input.get(n, none) for n in names)]
    columns = np.concatenate(apart, axis=2).reshape(2 * len(d), -1)
    cov = columns @ columns.T + block_diag(*(noise + other_noise + _LEFT_OUT_RAD**2 * np.eye(2)))
    tested = np.repeat(np.diag(cov).reshape(-1, 2).sum(axis=1) < _LARGEST_SD_RAD**2, 2)
    return (d - other).ravel()[tested], cov[np.ix_(tested, tested)]


def _means(
    one: Evidence, share: FloatArray, deflection: Deflection | None
) -> tuple[FloatArray, dict[str, FloatArray], FloatArray]:
    """Span means of the readings minus the deflection and its motion (n, 2), of their responses and of their noise."""
    off = one.theta_yz_rad
    if deflection is not None:
        off = off - deflection(one.time_s)
        off -= np.einsum("nij,nj->ni", one.by_rate_s, deflection(one.time_s, 1))
        off -= np.einsum("nij,nj->ni", one.by_acceleration_s2, deflection(one.time_s, 2))
    by_input = {name: np.tensordot(share, response, axes=1) for name, response in one.by_input.items()}
    return share @ off, by_input, np.einsum("bn,nij->bij", share**2, one.independent_cov)


def _between(known_s: FloatArray, at_s: FloatArray) -> FloatArray:
    """Weights (n, k) of values at ``known_s`` (k,) on straight lines between them at times (n,) within."""
    after = np.searchsorted(known_s, at_s).clip(1, len(known_s) - 1)
    part, row = (at_s - known_s[after - 1]) / (known_s[after] - known_s[after - 1]), np.arange(len(at_s))
    out = np.zeros((len(at_s), len(known_s)))
    out[row, after - 1], out[row, after] = 1.0 - part, part
    return out


def _answered(one: Evidence, time_s: FloatArray) -> BoolArray:
    """Whether times (n,) lie between readings of a method that are no further apart than `_LARGEST_STEP`."""
    after = np.searchsorted(one.time_s, time_s).clip(1, len(one.time_s) - 1)
    step = one.time_s[after] - one.time_s[after - 1]
    near = step < _LARGEST_STEP * np.median(np.diff(one.time_s))
    return np.asarray(near & (time_s >= one.time_s[after - 1]) & (time_s <= one.time_s[after]))


def _chosen(one: Evidence, keep: BoolArray) -> Evidence:
    """Evidence of chosen samples (n,)."""
    names = ("time_s", "theta_yz_rad", "by_rate_s", "by_acceleration_s2", "independent_cov")
    of_rows: dict[str, Any] = {name: getattr(one, name)[keep] for name in names}
    by_input = {name: j[keep] for name, j in one.by_input.items()}
    return replace(one, **of_rows, by_input=by_input, half_curvature_rad=None)
