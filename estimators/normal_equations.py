"""Normal equations of the fusion: a cubic spline for the deflection's lateral vector, unit normals for every input.

A prior holds the spline's second derivative at its knots white, and says next to nothing of the deflection's size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from estimators.evidence import Deflection, Evidence
from flightmodel.checks import DivergenceError, FloatArray

KNOT_S = 0.1  # a quarter of the joint's period: knots at half of it cannot follow its swinging
# of the joint, at each knot; three of it are 1 deg of swinging at the joint's 2.85 Hz, 20 deg at the slow aerodynamic
# mode's 0.65 Hz, so that swinging is no reason to believe in other inputs
ACCELERATION_SD_RADPS2 = 2.0
SIZE_SD_RAD = 1.0  # of the deflection itself: says nothing
# what the methods' equations leave out, second order in the angles and gusts shorter than the wind's knots: with true
# inputs 0.01 to 0.02 deg rms over the pulses of thirty flights, forgotten within half a second
LEFT_OUT_RAD, LEFT_OUT_TIME_S = np.deg2rad(0.02), 0.4
Inputs = dict[str, FloatArray]


@dataclass(frozen=True)
class Learnt:
    """What readings say of all inputs: ``mean`` (k,) and ``covariance`` (k, k) of their unit normals, by place."""

    mean: FloatArray
    covariance: FloatArray
    place: dict[str, slice]


@dataclass(frozen=True)
class Spline:
    """Cubic B-spline with even knots."""

    knots_s: FloatArray
    count: int
    _full: FloatArray

    @classmethod
    def over(cls, low: float, high: float) -> Spline:
        """Return the spline whose knots reach from ``low`` to ``high``, s."""
        inner = low + KNOT_S * np.arange(int(np.ceil((high - low) / KNOT_S)) + 1)
        full = np.concatenate([inner[0] - KNOT_S * np.arange(3, 0, -1), inner, inner[-1] + KNOT_S * np.arange(1, 4)])
        return cls(np.asarray(inner), len(full) - 4, np.asarray(full))

    def rows(self, time_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Values (n, count) of every basis function, or of its derivative."""
        basis = BSpline(self._full, np.eye(self.count), 3)
        at = np.clip(time_s, self.knots_s[0], self.knots_s[-1])
        return np.asarray(basis(at, nu=derivative))


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of the deflection's spline (y, then z) and of the inputs; where each input's normals stand."""

    spline: Spline
    place: dict[str, slice]
    normal: FloatArray
    right: FloatArray

    @classmethod
    def of(cls, told: list[Evidence], inputs: Inputs, span_s: tuple[float, float]) -> NormalEquations:
        """Return the equations of what methods read at ``inputs``; the spline reaches over ``span_s``."""
        spline = Spline.over(*span_s)
        place: dict[str, slice] = {}
        total = 0
        for name, response in (item for e in told for item in e.by_input.items()):
            if name not in place:
                place[name] = slice(total, total + response.shape[2])
                total = place[name].stop
        size = 2 * spline.count
        normal, right = np.zeros((size + total,) * 2), np.zeros(size + total)
        for one in told:
            rows, want = whitened(one, spline, place, inputs)
            normal += rows.T @ rows
            right += rows.T @ want
        curvature = spline.rows(spline.knots_s, 2) / ACCELERATION_SD_RADPS2
        bending = curvature.T @ curvature + np.eye(spline.count) / SIZE_SD_RAD**2
        for axis in range(2):
            part = slice(axis * spline.count, (axis + 1) * spline.count)
            normal[part, part] += bending
        normal[range(size, len(right)), range(size, len(right))] += 1.0
        return cls(spline, place, normal, right)

    def deflection(self, found: FloatArray) -> Deflection:
        """Lateral vectors (n, 2) of a solution, from times."""
        coefficients = found[: 2 * self.spline.count].reshape(2, -1)
        return lambda time_s: self.spline.rows(time_s) @ coefficients.T

    def solved(self, method: str) -> tuple[FloatArray, FloatArray]:
        """Posterior mean and covariance of all unknowns."""
        factor = self._factor(method)
        upper = np.triu(dpotri(factor)[0])
        return cho_solve((factor, False), self.right), upper + np.triu(upper, 1).T

    def mean(self, method: str) -> FloatArray:
        """Posterior mean of all unknowns."""
        return np.asarray(cho_solve((self._factor(method), False), self.right))

    def _factor(self, method: str) -> FloatArray:
        try:
            return np.asarray(cho_factor(self.normal)[0])
        except np.linalg.LinAlgError:
            raise DivergenceError(f"{method}: the readings do not determine the deflection") from None


def whitened(one: Evidence, spline: Spline, place: dict[str, slice], inputs: Inputs) -> tuple[FloatArray, FloatArray]:
    """Rows ``(2 n, unknowns)`` of the least-squares problem and what they should give, errors of unit variance."""
    keep = np.isfinite(one.theta_yz_rad).all(axis=1)
    n, m = int(keep.sum()), spline.count
    value, second = spline.rows(one.time_s[keep]), spline.rows(one.time_s[keep], 2)
    swing = one.by_acceleration_s2[keep]
    rows = np.zeros((n, 2, 2 * m + max((p.stop for p in place.values()), default=0)))
    for axis in range(2):
        for other in range(2):
            rows[:, axis, other * m : (other + 1) * m] = swing[:, axis, other, None] * second
        rows[:, axis, axis * m : (axis + 1) * m] += value
    want = one.theta_yz_rad[keep].copy()
    for name, every in one.by_input.items():
        response = every[keep]
        rows[:, :, 2 * m + place[name].start : 2 * m + place[name].stop] = -response
        if name in inputs:
            want -= response @ inputs[name]
    share = means_over_spans(one.time_s[keep], one.averaged_s, one.time_s[keep][0])
    rows = (share @ rows.reshape(n, -1)).reshape(len(share), 2, -1)
    cov = np.einsum("bn,nij->bij", share**2, one.independent_cov[keep])
    cov += LEFT_OUT_RAD**2 * LEFT_OUT_TIME_S / one.averaged_s * np.eye(2)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    return (whiten @ rows).reshape(2 * len(share), -1), (whiten @ (share @ want)[:, :, None]).ravel()


def means_over_spans(time_s: FloatArray, width_s: float, from_s: float) -> FloatArray:
    """Weights (bins, n) of the means over spans of time, one of which begins at ``from_s``; empty ones are left out."""
    which = np.floor((time_s - from_s) / width_s + 1e-6).astype(int)
    _, which, count = np.unique(which, return_inverse=True, return_counts=True)
    out = np.zeros((len(count), len(time_s)))
    out[which, np.arange(len(time_s))] = 1.0 / count[which]
    return out
