"""Which attitudes, rates and sensor errors fit all sightings of a flight best, and how well are they known?

At every knot an attitude ``q`` and a rate ``w`` (inertial, body axes). Between knots ``dt`` apart the rate wanders as
the integral of white angular acceleration of density ``g``, for which

    w' - w = noise, sd g sqrt(dt);    q' = q exp(dt (w + w') / 4) and noise about it, sd g sqrt(dt^3 / 12)

(to second order in a step's turn), independent of each other. With the sightings and the priors of the sensor errors
this is one least-squares problem, solved by Gauss and Newton: what an iterated Kalman smoother finds. The normal matrix
is a band (knots) with a border (errors); LAPACK factors the band, the errors follow from the border's Schur complement.

How fast the rate wanders is learnt from the flight, for each body axis and each stretch of `STRETCH_S`, by MacKay's
fixed point for the maximum of the marginal likelihood, ``g^2 = sum r^2 / gamma``: ``r`` are the estimated steps of the
rate over ``sqrt(dt)``, ``gamma`` their number less the part of it that the data left open.

Errors that multiply the motion (scale, soft iron) need one more term. The most probable motion *and* scale together are
a motion too small and a scale too large: every knot pulls its motion towards rest. The scale that is most probable with
the motion integrated out also pays for the volume of motions that fit, ``-log det(band) / 2``, and there the two pulls
cancel (Laplace's approximation). `_volume_slope` is this term's slope.

References
----------
B. Bell, SIAM J. Optim. 4 (1994) 626 (smoother as Gauss-Newton). D. MacKay, "Bayesian interpolation", Neural Computation
4 (1992) 415, section 4. K. Takahashi, J. Fagan, M. Chin, PICA 1973 (blocks of the inverse from the factor). L. Tierney,
J. Kadane, J. Amer. Statist. Assoc. 81 (1986) 82 (Laplace's approximation of marginal posteriors).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flightmodel import rotations
from flightmodel.checks import BoolArray, FloatArray
from recon.vector_models import Linear, linearise
from recon.vector_sensors import ErrorTerms, Sightings

BLOCK, BAND = 6, 12
ROTATION, RATE = slice(0, 3), slice(3, 6)
STRETCH_S = 5.0
LEAST_DENSITY, FIRST_DENSITY, MOST_DENSITY = 2e-4, 0.05, 20.0  # rad/s^2 per root hertz; the least is 0.011 deg
RATE_PRIOR_SD = 10.0  # rad/s: no information, but a knot without neighbours stays solvable
MOST_LEARNING, MOST_STEPS = 12, 30
LEARNT_RAD, SETTLED_RAD = 5e-4, 1e-6
SMALL_RAD = 1e-5
EDIT_SD, MOST_EDITED = 5.0, 0.05


@dataclass(frozen=True)
class Knots:
    """Evenly spaced times, some left out.

    Parameters
    ----------
    time_s : (n,) float
    step_s : float
    linked : (n - 1,) bool
        Whether the next knot is one step later.
    """

    time_s: FloatArray
    step_s: float
    linked: BoolArray


@dataclass
class Fit:
    """Where the fit stands, and what it ends with.

    Parameters
    ----------
    q_eci_body : (n, 4) float
    rate_radps : (n, 3) float
        Of the body against inertial space, body axes.
    errors : (m,) float
        Sensor errors in the order of `ErrorTerms`.
    density : (n - 1, 3) float
        Of the angular acceleration between knots, rad/s^2 per root hertz, body axes.
    covariance : (n, 6, 6) float
        Of rotation and rate, with what the sensor errors leave open.
    error_covariance : (m, m) float
    misfit : dict
        For each sensor: sum of squared residuals in units of their noise, and what it should be.
    steps : int
    converged : bool
    """

    q_eci_body: FloatArray
    rate_radps: FloatArray
    errors: FloatArray
    density: FloatArray
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, BLOCK, BLOCK)))
    error_covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    misfit: dict[str, tuple[float, float]] = field(default_factory=dict)
    steps: int = 0
    converged: bool = False


@dataclass(frozen=True)
class Normal:
    """Normal equations: blocks of knots (n, 6, 6) and of links (n - 1, 6, 6), border (n, 6, m), errors (m, m)."""

    diagonal: FloatArray
    below: FloatArray
    border: FloatArray
    errors: FloatArray
    knot_side: FloatArray
    error_side: FloatArray


@dataclass(frozen=True)
class Solved:
    """Step of all unknowns, and covariances.

    ``own`` (n, 6, 6) is the knots' covariance with the sensor errors known, ``next_by_own`` (n - 1, 6, 6) that of a
    later knot with the one before, ``carried`` (n, 6, m) how much of an error a knot takes on, with its sign turned.
    """

    knots: FloatArray
    errors: FloatArray
    own: FloatArray
    next_by_own: FloatArray
    carried: FloatArray
    error_covariance: FloatArray


def smooth(
    knots: Knots, sightings: list[Sightings], terms: ErrorTerms, q_eci_body: FloatArray
) -> tuple[Fit, list[Sightings]]:
    """Fit of all sightings, started at attitudes ``(n, 4)``; also the sightings that were kept.

    Blocks further than `EDIT_SD` from the fit are left out of a second one, unless they are more than `MOST_EDITED` of
    a sensor's: then it is not a few that are wrong, and the misfit says so.
    """
    turn = np.where(knots.linked[:, None], rotations.boxminus(q_eci_body[1:], q_eci_body[:-1]) / knots.step_s, 0.0)
    rate = 0.5 * (np.vstack([turn[:1], turn]) + np.vstack([turn, turn[-1:]])) if len(turn) else np.zeros((1, 3))
    fit = Fit(q_eci_body, rate, np.zeros(terms.size), np.full((len(turn), 3), FIRST_DENSITY))
    _iterate(fit, knots, sightings, terms)
    kept = [_edited(seen, fit) for seen in sightings]
    if any(len(few.knot) < len(all_.knot) for few, all_ in zip(kept, sightings, strict=True)):
        _iterate(fit, knots, kept, terms)
    return fit, kept


def _iterate(fit: Fit, knots: Knots, sightings: list[Sightings], terms: ErrorTerms) -> None:
    """Gauss-Newton steps, first with the densities learnt along, then with these kept, until attitudes stay."""
    slope = np.zeros(terms.size)
    learning = True
    for fit.steps in range(1, MOST_STEPS + 1):
        linear = [linearise(seen, fit.q_eci_body, fit.rate_radps, fit.errors) for seen in sightings]
        normal = _normal(fit, knots, sightings, linear, terms)
        normal.error_side[:] -= slope
        solved = _solve(normal)
        for seen, line in zip(sightings, linear, strict=True):
            if learning and seen.is_field:
                slope[seen.terms] = _volume_slope(seen, line, fit, solved.own)
        fit.q_eci_body = rotations.boxplus(fit.q_eci_body, solved.knots[:, ROTATION])
        fit.rate_radps = fit.rate_radps + solved.knots[:, RATE]
        fit.errors = fit.errors + solved.errors
        moved = float(np.abs(solved.knots[:, ROTATION]).max())
        fit.converged = not learning and moved < SETTLED_RAD
        if fit.converged:
            break
        if learning:
            _learn_density(fit, knots, solved)
            learning = fit.steps < MOST_LEARNING and moved > LEARNT_RAD
    spread = solved.carried @ solved.error_covariance
    fit.covariance = solved.own + spread @ np.swapaxes(solved.carried, 1, 2)
    fit.error_covariance = solved.error_covariance
    fit.misfit = {
        seen.name: _misfit(seen, line, fit.covariance[seen.knot], -spread[seen.knot], solved.error_covariance)
        for seen, line in zip(sightings, linear, strict=True)
    }


def _normal(fit: Fit, knots: Knots, sightings: list[Sightings], linear: list[Linear], terms: ErrorTerms) -> Normal:
    n, m = len(knots.time_s), terms.size
    diagonal, border, knot_side = np.zeros((n, BLOCK, BLOCK)), np.zeros((n, BLOCK, m)), np.zeros((n, BLOCK))
    diagonal[:, range(3, 6), range(3, 6)] = RATE_PRIOR_SD**-2.0
    knot_side[:, RATE] = -fit.rate_radps * RATE_PRIOR_SD**-2.0
    errors: FloatArray = np.asarray(np.linalg.inv(terms.covariance), dtype=float)
    error_side = -errors @ fit.errors
    for seen, line in zip(sightings, linear, strict=True):
        weight = seen.noise_sd[:, None, None] ** -2.0
        weighted = np.swapaxes(line.by_knot, 1, 2) * weight
        diagonal[seen.knot] += weighted @ line.by_knot
        knot_side[seen.knot] += (weighted @ line.residual[:, :, None])[:, :, 0]
        border[seen.knot[:, None], :, seen.terms] += np.swapaxes(weighted @ line.by_errors, 1, 2)
        late = line.by_errors * weight
        errors[np.ix_(seen.terms, seen.terms)] += _summed(late, line.by_errors)
        error_side[seen.terms] += np.einsum("rij,ri->j", late, line.residual)

    residual, early, late = _links(fit, knots)
    var = fit.density**2 * np.where(knots.linked, knots.step_s, np.inf)[:, None]
    weight = np.concatenate([12.0 / (var * knots.step_s**2), 1.0 / var], axis=1)[:, None, :]
    early_weighted, late_weighted = np.swapaxes(early, 1, 2) * weight, np.swapaxes(late, 1, 2) * weight
    diagonal[:-1] += early_weighted @ early
    diagonal[1:] += late_weighted @ late
    knot_side[:-1] -= (early_weighted @ residual[:, :, None])[:, :, 0]
    knot_side[1:] -= (late_weighted @ residual[:, :, None])[:, :, 0]
    return Normal(diagonal, late_weighted @ early, border, errors, knot_side, error_side)


def _links(fit: Fit, knots: Knots) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n - 1, 6) of the motion's model and their derivatives with the earlier and the later knot."""
    q, w, dt = fit.q_eci_body, fit.rate_radps, knots.step_s
    turn = 0.5 * dt * (w[1:] + w[:-1])
    off = rotations.boxminus(q[1:], rotations.boxplus(q[:-1], turn))
    skewed = rotations.skew(turn)
    by_rate = -0.5 * dt * (np.eye(3) - 0.5 * skewed + skewed @ skewed / 6.0)
    early, late = np.zeros((len(turn), BLOCK, BLOCK)), np.zeros((len(turn), BLOCK, BLOCK))
    early[:, ROTATION, ROTATION] = -rotations.dcm_from_q(rotations.multiply(rotations.conjugate(q[1:]), q[:-1]))
    late[:, ROTATION, ROTATION] = np.eye(3) + 0.5 * rotations.skew(off)
    early[:, ROTATION, RATE] = late[:, ROTATION, RATE] = by_rate
    early[:, RATE, RATE], late[:, RATE, RATE] = -np.eye(3), np.eye(3)
    return np.hstack([off, w[1:] - w[:-1]]), early, late


def _solve(normal: Normal) -> Solved:
    from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

    n, m = len(normal.diagonal), len(normal.errors)
    band = np.zeros((BAND, BLOCK * n))
    for i in range(BLOCK):
        for j in range(BLOCK):
            if i >= j:
                band[i - j, j::BLOCK] = normal.diagonal[:, i, j]
            band[BLOCK + i - j, j:-BLOCK:BLOCK] = normal.below[:, i, j]
    factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
    sides = np.concatenate([normal.border, normal.knot_side[:, :, None]], axis=2).reshape(-1, m + 1)
    answer = cho_solve_banded((factor, True), sides, check_finite=False).reshape(n, BLOCK, m + 1)
    carried, alone = answer[:, :, :m], answer[:, :, m]
    schur = cho_factor(normal.errors - _summed(normal.border, carried))
    errors = cho_solve(schur, normal.error_side - np.einsum("nij,ni->j", normal.border, alone))
    own, next_by_own = _blocks_of_inverse(factor, n)
    return Solved(alone - carried @ errors, errors, own, next_by_own, carried, cho_solve(schur, np.eye(m)))


def _summed(left: FloatArray, right: FloatArray) -> FloatArray:
    """Sum over n of ``left[n].T @ right[n]``: small products, which BLAS does not share out among its threads.

    One product of all rows would be; beside other work on the machine its threads then wait for each other for seconds.
    """
    return np.asarray((np.swapaxes(left, 1, 2) @ right).sum(axis=0))


def _blocks_of_inverse(factor: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Blocks of the inverse on the diagonal (n, 6, 6) and below it (n - 1, 6, 6), from the last knot to the first."""
    corner, below = np.zeros((n, BLOCK, BLOCK)), np.zeros((n - 1, BLOCK, BLOCK))
    for i in range(BLOCK):
        for j in range(BLOCK):
            if i >= j:
                corner[:, i, j] = factor[i - j, j::BLOCK]
            below[:, i, j] = factor[BLOCK + i - j, j:-BLOCK:BLOCK]
    inverse = np.linalg.inv(corner)
    own = np.swapaxes(inverse, 1, 2) @ inverse
    gain = below @ inverse[:-1]
    for k in range(n - 2, -1, -1):
        own[k] += gain[k].T @ own[k + 1] @ gain[k]
    return own, -own[1:] @ gain


def _volume_slope(seen: Sightings, line: Linear, fit: Fit, own: FloatArray) -> FloatArray:
    """Slope of half the band's log-determinant with a sensor's errors, (p,); ``own`` (n, 6, 6) inverts the band.

    The change of a derivative with an error is that of the error's derivative with a rotation, taken by difference.
    """
    weighted = line.by_knot[:, :, ROTATION] @ own[seen.knot][:, ROTATION, ROTATION]
    weighted /= seen.noise_sd[:, None, None] ** 2
    slope = np.zeros(len(seen.terms))
    for axis, turn in enumerate(SMALL_RAD * np.eye(3)):
        turned = linearise(seen, rotations.boxplus(fit.q_eci_body, turn), fit.rate_radps, fit.errors)
        slope += np.tensordot(weighted[:, :, axis], (turned.by_errors - line.by_errors) / SMALL_RAD, 2)
    return slope


def _learn_density(fit: Fit, knots: Knots, solved: Solved) -> None:
    """Move the densities towards where they agree with the estimated rates.

    Downwards twice as far as the fixed point says, as there it is slow where the data tell little.
    """
    linked = knots.linked[:, None]
    own = np.diagonal(solved.own[:, RATE, RATE], axis1=1, axis2=2)
    cross = np.diagonal(solved.next_by_own[:, RATE, RATE], axis1=1, axis2=2)
    carried = np.diff(solved.carried[:, RATE], axis=0)
    left_open = own[1:] + own[:-1] - 2.0 * cross + np.sum((carried @ solved.error_covariance) * carried, axis=2)
    var = fit.density**2 * knots.step_s
    known = np.where(linked, 1.0 - left_open / var, 0.0)
    squares = np.where(linked, np.diff(fit.rate_radps, axis=0) ** 2 / var, 0.0)
    stretch = ((knots.time_s[:-1] - knots.time_s[0]) // STRETCH_S).astype(int)
    for axis in range(3):
        gamma = np.maximum(np.bincount(stretch, weights=known[:, axis]), 0.0)
        total = np.bincount(stretch, weights=squares[:, axis])
        # half a step as it was believed, for stretches that tell nothing
        factor = ((total + 0.5) / (gamma + 0.5))[stretch]
        moved = fit.density[:, axis] * np.where(factor < 1.0, factor, np.sqrt(factor))
        fit.density[:, axis] = np.clip(moved, LEAST_DENSITY, MOST_DENSITY)


def _misfit(
    seen: Sightings, line: Linear, knot_cov: FloatArray, cross: FloatArray, error_cov: FloatArray
) -> tuple[float, float]:
    """Sum of squared residuals in units of their noise, and what it should be after the fit."""
    late = np.swapaxes(line.by_errors, 1, 2)
    mixed = line.by_knot @ cross[:, :, seen.terms] @ late
    fitted = line.by_knot @ knot_cov @ np.swapaxes(line.by_knot, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
    fitted += line.by_errors @ error_cov[np.ix_(seen.terms, seen.terms)] @ late
    taken = np.trace(fitted, axis1=1, axis2=2) / seen.noise_sd**2
    squares = np.sum(line.residual**2, axis=1) / seen.noise_sd**2
    return float(squares.sum()), float(np.sum(line.residual.shape[1] - taken))


def _edited(seen: Sightings, fit: Fit) -> Sightings:
    """Sightings without the few that lie far from the fit."""
    line = linearise(seen, fit.q_eci_body, fit.rate_radps, fit.errors)
    off = np.abs(line.residual).max(axis=1) / seen.noise_sd
    far = np.asarray(off > EDIT_SD * max(1.0, 1.4826 * float(np.median(off))))
    return seen.take(~far) if 0.0 < far.mean() <= MOST_EDITED else seen
