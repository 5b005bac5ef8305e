"""How stiff is the joint and how large was the offset, from the growth of the deflection with the load?

A joint that yields by ``theta = (z_0 / xbar) u / (1 - u)``, ``u = q kappa / K`` (`estimators.trim`), gives a
straight line of ``1 / theta`` against ``1 / q``, as R. V. Southwell plotted columns near buckling::

    1 / theta = (xbar / z_0) (q_crit / q - 1),     q_crit = K / kappa

It crosses zero at the dynamic pressure at which the joint diverges; its height at infinite load is the offset.
``1 / theta`` of a small deflection is all error, so the curve itself is fitted: deflection along its mean direction
against ``u / (1 - u)``, whitened by the history's covariance, of which `evidence.CONSTANT_PART` is a constant bias.
Rise and fall of the pulse are fitted separately too: their difference is hysteresis (freeplay, a joint that sags, gas
that warms).

Assumed: quasi-static means over `SPAN_S`, a linear joint, kappa and the offset's plane constant over the pulse. Means
of true histories lie about such a line by `LEFT_OUT` at peak pressure, by more where oscillation is slower. The dynamic
pressure's own error scales ``q_crit`` and leaves ``q / q_crit`` as it is.

References
----------
R. V. Southwell, "On the analysis of experimental observations in problems of elastic stability", Proceedings of the
Royal Society A 135 (1932) 601.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from estimators.evidence import CONSTANT_PART
from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.statistics import chi_square_quantile

SPAN_S = 1.6  # a period of the slow aerodynamic mode
LEAST_SPANS = 4  # two on either side of the peak, for a line each
_MOST_LOG_SD = 3.0  # of offset or margin: a factor of twenty
CONFIDENCE = 0.90  # of the interval, as of the reconciliation's
_SURE = 0.999  # of what is said to be hysteresis, or no static deflection: one false alarm in a thousand
LEFT_OUT = 0.10  # sd of means against the static line, of the deflection at peak; elsewhere as the period, 1/sqrt(q)
_LOG_BEYOND = (-27.0, 27.0)  # of the critical load over the largest, less one: a double has no more
_MOST_LOADS = 50.0  # the stiffness of a joint this many times stiffer than its load is not observable


@dataclass(frozen=True)
class Southwell:
    """Line through the loading branch, the unloading branch or the whole pulse.

    Parameters
    ----------
    critical_pressure_pa, offset_angle_rad : float
        ``q_crit`` and ``z_0 / xbar``.
    critical_interval_pa, offset_interval_rad : (low, high)
        With the confidence of `CONFIDENCE`.
    covariance : (2, 2) float
        Of their logarithms.
    pressure_pa, theta_rad, theta_sd_rad : (n,) float
        Means over spans that were fitted.
    """

    critical_pressure_pa: float
    offset_angle_rad: float
    critical_interval_pa: tuple[float, float]
    offset_interval_rad: tuple[float, float]
    covariance: FloatArray
    pressure_pa: FloatArray
    theta_rad: FloatArray
    theta_sd_rad: FloatArray

    def deflection(self, pressure_pa: FloatArray) -> FloatArray:
        """Deflection, rad, at dynamic pressures below the critical one; NaN at and above it."""
        u = np.asarray(pressure_pa) / self.critical_pressure_pa
        return np.where(u < 1.0, self.offset_angle_rad * u / np.where(u < 1.0, 1.0 - u, 1.0), np.nan)


@dataclass(frozen=True)
class Limbs:
    """Southwell lines of rise, fall and both; ``hysteresis_sd``: difference of the two in standard deviations."""

    both: Southwell
    rise: Southwell | None
    fall: Southwell | None
    hysteresis_sd: float
    remark: str


def southwell_limbs(
    history: DeflectionHistory, time_s: FloatArray, pressure_pa: FloatArray, pressure_sd: float
) -> Limbs:
    """Fit a history against the dynamic pressure (n,) at ``time_s``: whole pulse, rise, and fall.

    ``pressure_sd`` is the sd of the pressure at its peak, a fraction.

    Raises
    ------
    DivergenceError
        Where the means do not stay in one plane, or the whole pulse gives no line; a limb that gives none is left out,
        with a remark.
    """
    t, q, theta, across, sd, across_sd = _span_means(history, time_s, pressure_pa)
    _check_static(q, theta, across, across_sd)
    both = southwell(q, theta, sd, pressure_sd)
    top = t[np.argmax(q)]
    limbs: dict[str, Southwell | None] = {}
    remarks = []
    for name, part in (("rise", t <= top), ("fall", t >= top)):
        try:
            limbs[name] = southwell(q[part], theta[part], sd[part], pressure_sd)
        except DivergenceError as fault:
            limbs[name] = None
            remarks.append(f"no line of the {name} alone ({fault})")
    rise, fall = limbs["rise"], limbs["fall"]
    apart = float("nan")
    if rise is not None and fall is not None:
        middle = np.array([0.8 * float(q.max())])
        change = float(np.log(fall.deflection(middle)[0] / rise.deflection(middle)[0]))
        apart = change / float(np.hypot(_log_sd(rise, middle[0]), _log_sd(fall, middle[0])))
        limit = ndtri(0.5 + 0.5 * _SURE)
        found = "hysteresis" if abs(apart) > limit else "no significant hysteresis"
        remarks.insert(0, f"fall over rise {np.exp(change):.2f} at 80 % of peak load ({apart:+.1f} sd): {found}")
    return Limbs(both, rise, fall, apart, "; ".join(remarks))


def _span_means(history: DeflectionHistory, time_s: FloatArray, pressure_pa: FloatArray) -> tuple[FloatArray, ...]:
    """Means over spans: time, pressure, deflection along its mean direction and across it, and the sd of both."""
    cov = history.lateral_cov
    known = np.isfinite(history.theta_rad) & np.isfinite(cov[:, 0, 0])
    t, yz, cov = history.time_s[known], history.theta_yz_rad[known], cov[known]
    q = np.interp(t, time_s, pressure_pa)
    if len(t) == 0:
        raise DivergenceError("Southwell plot: the history has no answer with a sd", code="too-few-data")
    weight = q / np.trace(cov, axis1=1, axis2=2)
    direction = weight @ yz
    direction = direction / np.linalg.norm(direction)
    axes = (direction, np.array([-direction[1], direction[0]]))
    sds = [np.sqrt(np.einsum("i,nij,j->n", axis, cov, axis)) for axis in axes]
    _, which, count = np.unique(np.floor((t - t[0]) / SPAN_S), return_inverse=True, return_counts=True)
    return tuple(np.bincount(which, v) / count for v in (t, q, *(yz @ axis for axis in axes), *sds))


def _check_static(pressure_pa: FloatArray, theta_rad: FloatArray, across_rad: FloatArray, sd_rad: FloatArray) -> None:
    """Raise `DivergenceError` where means lie farther across their direction than a static deflection's may.

    An offset of the vehicle deflects the shell in one plane. A vehicle that spins about as fast as it pitches swings
    slowly in its own axes; means over `SPAN_S` then follow the swing, across that plane as along it.
    """
    if not len(pressure_pa):
        return
    left_out = (LEFT_OUT * theta_rad) ** 2 * pressure_pa.max() / pressure_pa
    found = float(np.sum(across_rad**2 / (sd_rad**2 + left_out)))
    if found > chi_square_quantile(_SURE, len(across_rad)):
        raise DivergenceError(
            f"Southwell plot: means over {SPAN_S} s lie {np.sqrt(found / len(across_rad)):.1f} times as far across the "
            "deflection's plane as a static deflection's do: the vehicle swings as slowly as it spins",
            code="deflection-not-static",
        )


def southwell(
    pressure_pa: FloatArray, theta_rad: FloatArray, theta_sd_rad: FloatArray, pressure_sd: float = 0.0
) -> Southwell:
    """Fit deflection against dynamic pressure, all of whose values have a common relative error ``pressure_sd``.

    Raises
    ------
    DivergenceError
        Where there are too few spans, or the deflection does not grow faster than the load, or not towards one side.
    """
    if len(theta_rad) < LEAST_SPANS:
        raise DivergenceError(
            f"Southwell plot: {len(theta_rad)} spans of {SPAN_S} s where {LEAST_SPANS} are needed", code="too-few-data"
        )
    from scipy.optimize import least_squares  # a tenth of a second, for whoever never fits

    constant = np.sqrt(CONSTANT_PART) * theta_sd_rad
    top = float(pressure_pa.max())
    neglected = (LEFT_OUT * theta_rad) ** 2 * top / pressure_pa
    cov = np.outer(constant, constant) + np.diag((1.0 - CONSTANT_PART) * theta_sd_rad**2 + neglected)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))

    def model(x: FloatArray) -> FloatArray:
        # u / (1 - u), written without a difference that may be zero: that of the largest load to the critical one
        to_critical = top - pressure_pa + top * np.exp(np.clip(x[0], *_LOG_BEYOND))
        return np.asarray(np.exp(x[1]) * pressure_pa / to_critical)

    start = np.array([0.0, np.log(max(float(np.median(theta_rad)), 1e-4))])
    fit = least_squares(lambda x: whiten @ (model(x) - theta_rad), start, max_nfev=200)
    beyond = float(np.exp(fit.x[0]))
    normal = fit.jac.T @ fit.jac
    if not fit.success or np.linalg.cond(normal) > 1e12 or beyond > _MOST_LOADS:
        raise DivergenceError(
            "Southwell plot: the deflection does not grow faster than the load: stiffness not observable",
            code="not-observable",
        )
    # of the logarithm of q_crit = top (1 + e^x)
    scale = np.diag([beyond / (1.0 + beyond), 1.0])
    covariance = scale @ np.linalg.inv(normal) @ scale
    if np.diag(np.linalg.inv(normal)).max() > _MOST_LOG_SD**2:
        raise DivergenceError(
            "Southwell plot: the deflection is within its error bars: neither stiffness nor offset observable",
            code="not-observable",
        )
    k = ndtri(0.5 + 0.5 * CONFIDENCE)
    crit, offset = top * (1.0 + beyond), float(np.exp(fit.x[1]))
    sd_x = np.sqrt(np.linalg.inv(normal)[0, 0])
    # the logarithm of the margin over the largest load is normal, that of the pressure's scale too
    ends = (np.log((1.0 + np.exp(fit.x[0] + side * k * sd_x)) / (1.0 + beyond)) for side in (-1.0, 1.0))
    low, high = (crit * np.exp(np.sign(end) * np.hypot(end, k * pressure_sd)) for end in ends)
    spread = np.exp(k * np.sqrt(covariance[1, 1]))
    return Southwell(
        crit, offset, (float(low), float(high)), (float(offset / spread), float(offset * spread)), covariance,
        pressure_pa, theta_rad, theta_sd_rad,
    )  # fmt: skip


def _log_sd(line: Southwell, pressure_pa: float) -> float:
    """Sd of the logarithm of the deflection at a pressure."""
    u = pressure_pa / line.critical_pressure_pa
    partial = np.array([-1.0 / (1.0 - u), 1.0])
    return float(np.sqrt(partial @ line.covariance @ partial))
