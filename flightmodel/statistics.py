"""How do errors hang together along time or altitude, and how is an ensemble of histories summed up?

Correlated errors are one constant and one first-order Gauss-Markov process of the same unit variance,

``rho(x, y) = c + (1 - c) exp(-|x - y| / L)``,

with the constant part ``c`` and the correlation length (or time) ``L``. Ensembles are summed up by the percentiles that
correspond to two standard deviations of a normal distribution and by the median.

References
----------
A. Gelb (ed.), Applied Optimal Estimation, MIT Press, 1974, section 3.8 (exponentially correlated processes).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.special import gammaincinv

from flightmodel.checks import BoolArray, FloatArray

ACCEPTED_ODDS = math.log(1000.0)  # from which one hypothesis is accepted over another, as a logarithm
NORMAL_MAD = 1.4826  # sd of a normal variable over the median of its absolute values
KNOTS_A_LENGTH = 3  # of a Gauss-Markov history, in one correlation length
BAND_PERCENTILES = (2.3, 50.0, 97.7)
BAND_COLUMNS = tuple(f"p{p:g}" for p in BAND_PERCENTILES)


def chi_square_quantile(probability: float, degrees: float) -> float:
    """Quantile of the chi-square distribution with ``degrees``; avoids the slow import of `scipy.stats`."""
    return float(2.0 * gammaincinv(0.5 * degrees, probability))


def decimals(sd: float) -> int:
    """Decimals in which a value with this standard deviation is printed.

    The standard deviation keeps two digits below 355, 3.55, 0.0355, ... and one above (Particle Data Group, *Review of
    Particle Physics*, introduction, section 5.3); digits left of the point stay. Without one there are two decimals.
    """
    if not (math.isfinite(sd) and sd > 0.0):
        return 2
    exponent = math.floor(math.log10(sd))
    return min(max((sd < 3.55 * 10.0**exponent) - exponent, 0), 9)


def pair(value: float, sd: float) -> str:
    """``4.91 ± 0.08``: a value and its standard deviation in the `decimals` that this deserves."""
    places = decimals(sd)
    return f"{value:.{places}f} ± {sd:.{places}f}"


def correlation(at: FloatArray, length: float, constant_part: float = 0.0) -> FloatArray:
    """Correlation ``(n, n)`` of an error at places ``(n,)``; ``length`` in their unit."""
    apart = np.abs(at[:, None] - at[None, :])
    return constant_part + (1.0 - constant_part) * np.exp(-apart / length)


def correlation_inverse(
    at: FloatArray, length: float, constant_part: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Inverse of `correlation` at rising places ``(n,)``, as ``tridiagonal - u u^T``.

    Parameters
    ----------
    at : (n,) float
    length : float
        In the unit of ``at``.
    constant_part : float

    Returns
    -------
    tuple
        Diagonal ``(n,)``, what lies beside it ``(n - 1,)``, and ``u (n,)``.

    Notes
    -----
    A Gauss-Markov error depends on its neighbours alone: with ``c = exp(-apart / length)`` its inverse correlation has
    ``-c / (1 - c^2)`` beside the diagonal. The constant part adds an outer product (Sherman-Morrison).
    """
    keep = np.exp(-np.diff(at) / length)
    fresh = (1.0 - constant_part) * (1.0 - keep**2)
    diagonal = np.full(len(at), 1.0 / (1.0 - constant_part))
    diagonal[1:] += keep**2 / fresh
    diagonal[:-1] += keep**2 / fresh
    beside = -keep / fresh
    row_sums = diagonal.copy()
    row_sums[1:] += beside
    row_sums[:-1] += beside
    return diagonal, beside, row_sums * np.sqrt(constant_part / (1.0 + constant_part * row_sums.sum()))


def symmetric_root(covariance: FloatArray) -> FloatArray:
    """Symmetric roots of covariances ``(..., k, k)``: smooth in time whatever the order of the eigenvalues."""
    value, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.sqrt(np.maximum(value, 0.0))[..., None, :]) @ np.swapaxes(axes, -1, -2))


def paired_covariance(root: FloatArray, together: FloatArray, other: FloatArray) -> FloatArray:
    """Covariance ``(n k, m k)`` of ``root_i x_i`` (n, k, k) with ``other_j x_j`` (m, k, k), normals ``x`` of unit size.

    ``together`` (n, m): their correlation, the same for each of the k.
    """
    return np.einsum("iab,ij,jcb->iajc", root, together, other).reshape(len(root) * root.shape[1], -1)


def mixture_moments(weight: FloatArray, means: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean ``(k,)`` and covariance ``(k, k)`` of a mixture of distributions with these ``(n, k)`` and ``(n, k, k)``."""
    mean = weight @ means
    off = means - mean
    return mean, np.einsum("n,nij->ij", weight, covariances) + (weight * off.T) @ off


def correlation_root(
    at: FloatArray, length: float, constant_part: float = 0.0, knots_a_length: int = KNOTS_A_LENGTH
) -> FloatArray:
    """Errors ``(n, k)`` of unit variance at places ``(n,)`` per unit normal: ``root @ root.T`` is their correlation.

    The Gauss-Markov part is drawn at knots, ``knots_a_length`` in ``length``, with straight lines between; ``at``
    may be in any order. A constant part, where there is one, is the first column.
    """
    root, rest = correlation_root_and_rest(at, length, constant_part, knots_a_length)
    # straight lines between knots are a little too small
    light = root if constant_part == 0.0 else root[:, 1:]
    light *= np.sqrt((1.0 - constant_part) / (1.0 - constant_part - rest))[:, None]
    return root


def correlation_root_and_rest(
    at: FloatArray, length: float, constant_part: float, knots_a_length: int
) -> tuple[FloatArray, FloatArray]:
    """Errors ``(n, k)`` as `correlation_root` has them, and the variance (n,) of what lies off the straight lines."""
    root = _gauss_markov_root(at, length, knots_a_length)
    rest = (1.0 - constant_part) * np.maximum(1.0 - np.sum(root**2, axis=1), 0.0)
    if constant_part == 0.0:
        return root, rest
    constant = np.full(len(at), np.sqrt(constant_part))
    return np.column_stack([constant, np.sqrt(1.0 - constant_part) * root]), rest


def _gauss_markov_root(at: FloatArray, length: float, knots_a_length: int) -> FloatArray:
    return knots_root(at, length / knots_a_length, lambda knots: correlation(knots, length))


def knots_root(at: FloatArray, spacing: float, correlation_of: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Errors ``(n, k)`` at places ``(n,)`` per unit normal, drawn at knots with straight lines between.

    Parameters
    ----------
    at : (n,) float
        In any order.
    spacing : float
        Of the knots, at most; in the unit of ``at``.
    correlation_of : callable
        From the knots (k,) to the correlation (k, k) of the error at them.
    """
    if len(at) == 0 or np.ptp(at) == 0.0:
        return np.ones((len(at), 1))
    low, high = float(at.min()), float(at.max())
    knots = np.linspace(low, high, max(2, int(np.ceil((high - low) / spacing)) + 1))
    position = np.clip((at - low) / max(knots[1] - knots[0], 1e-12), 0.0, len(knots) - 1.0)
    k = np.minimum(position.astype(int), len(knots) - 2)
    fraction = position - k
    between = np.zeros((len(at), len(knots)))
    row = np.arange(len(at))
    between[row, k], between[row, k + 1] = 1.0 - fraction, fraction
    together = correlation_of(knots)
    try:
        root = np.linalg.cholesky(together)
    except np.linalg.LinAlgError:  # knots so close together that they are one
        root = symmetric_root(together)
    return np.asarray(between @ root)


def jackknife_variance(without: FloatArray) -> FloatArray:
    """Variance ``(...)`` of an estimate by the estimates ``(n, ...)`` without each of ``n`` parts of the data.

    B. Efron, *The Jackknife, the Bootstrap and Other Resampling Plans*, SIAM, 1982.
    """
    n = len(without)
    return np.asarray((n - 1) / n * np.sum((without - without.mean(axis=0)) ** 2, axis=0))


def percentile_band(values: FloatArray, axis: int = 0) -> FloatArray:
    """Lower limit, median and upper limit of an ensemble along ``axis``, first in the result (`BAND_PERCENTILES`)."""
    return np.asarray(np.percentile(values, BAND_PERCENTILES, axis=axis))


def inside(
    time_s: FloatArray, values: FloatArray, band_time_s: FloatArray, low: FloatArray, high: FloatArray
) -> BoolArray:
    """Mask (n,) of values at times (n,) between two limits that are given at other times."""
    return np.asarray(
        (values >= np.interp(time_s, band_time_s, low)) & (values <= np.interp(time_s, band_time_s, high))
    )
