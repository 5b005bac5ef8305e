"""How far is the aeroshell deflected against the centerbody? One type for the truth and for every estimate of it.

The bending angle ``theta`` is the angle between the two bodies' x axes. Its plane is the clocking angle, in the
launch-vehicle (LV) frame, towards which the shell's nose axis tilts in the centerbody's frame; the shell's rim on
that side moves aft, towards a camera that sits there, and the centerbody's aft end swings to that side. Clocking
direction ``phi`` is ``(0, -cos(phi), sin(phi))`` in body axes (POST2 y lies at 180 deg, z at 90 deg; seed paper,
section II).

As a lateral vector, ``theta_yz = theta * (-cos(plane), sin(plane))``. With ``d`` the clocking direction, the rotation
vector of the shell against the body is ``theta * x_hat x d``; that of the body against the shell is its opposite.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from flightmodel.checks import FloatArray, IntArray, check_finite, check_increasing, check_shape
from flightmodel.tabular import Tabular

if TYPE_CHECKING:
    import pandas as pd

HOLE_FACTOR = 3.0
QUANTILES = (0.05, 0.16, 0.50, 0.84, 0.95)
QUANTILE_COLUMNS = tuple(f"theta_p{100 * p:.0f}_deg" for p in QUANTILES)
_ANGLES_DEG = "theta_deg", "theta_sd_deg", "plane_lv_deg", "plane_sd_deg"
UNIFORM_VAR = np.pi**2 / 3.0  # of a clocking angle that may be anything


def lv_direction(clock_lv_rad: FloatArray | float) -> FloatArray:
    """Unit vectors ``(..., 3)`` in body axes of clocking angles in the LV frame, rad."""
    phi = np.asarray(clock_lv_rad, dtype=float)
    return np.stack([np.zeros_like(phi), -np.cos(phi), np.sin(phi)], axis=-1)


def lv_clock(lateral_yz: FloatArray) -> FloatArray:
    """Clocking angle in the LV frame, rad in [0, 2 pi), of lateral vectors ``(..., 2)`` in body y, z."""
    lateral_yz = np.asarray(lateral_yz, dtype=float)
    return np.mod(np.arctan2(lateral_yz[..., 1], -lateral_yz[..., 0]), 2.0 * np.pi)


def rotation_vector_body_shell(theta_rad: FloatArray, plane_lv_rad: FloatArray) -> FloatArray:
    """Rotation vector, rad, of the shell against the body: ``q_body_shell = exp(it)``."""
    size = np.asarray(theta_rad, dtype=float)[..., None]
    return rotation_vector_of_lateral(size * lv_direction(plane_lv_rad)[..., 1:])


def rotation_vector_of_lateral(theta_yz_rad: FloatArray) -> FloatArray:
    """Rotation vectors ``(..., 3)``, rad, of the shell against the body: ``x_hat x theta`` of lateral ones (..., 2)."""
    y, z = np.moveaxis(theta_yz_rad, -1, 0)
    return np.stack([np.zeros_like(y), -z, y], axis=-1)


@dataclass(frozen=True, repr=False)
class DeflectionHistory(Tabular):
    """Bending angle and plane over time.

    Parameters
    ----------
    time_s : (n,) float
        Seconds after t0, strictly increasing.
    theta_rad : (n,) float
        Bending angle, rad. NaN where the method has no answer (the reason stands in ``assumptions``).
    plane_lv_rad : (n,) float
        Clocking angle of the bending plane in the LV frame, rad.
    covariance : (n, 2, 2) float or None
        Of ``(theta, plane)``, rad^2. A plane that is assumed carries the variance of the assumption.
    method : str
        ``"camera"``, ``"misalignment"``, ``"trim"``, ``"fused"`` or ``"truth"``.
    assumptions : str
        In words.
    curved_quantiles_rad : (n, 5) float or None
        `QUANTILES` of the angle, of a posterior that is not Gaussian; None: the covariance says it all.
    """

    time_s: FloatArray
    theta_rad: FloatArray
    plane_lv_rad: FloatArray
    covariance: FloatArray | None
    method: str
    assumptions: str = field(default="")
    curved_quantiles_rad: FloatArray | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Check shapes and time order once."""
        n = len(self.time_s)
        check_finite(f"{self.method}.time_s", self.time_s)
        check_increasing(f"{self.method}.time_s", self.time_s)
        check_shape(f"{self.method}.theta_rad", self.theta_rad, (n,))
        check_shape(f"{self.method}.plane_lv_rad", self.plane_lv_rad, (n,))
        if self.covariance is not None:
            check_shape(f"{self.method}.covariance", self.covariance, (n, 2, 2))

    def to_frame(self) -> pd.DataFrame:
        """Angle and plane with standard deviations; rows without an answer are left out.

        Returns
        -------
        DataFrame
            ``t_s, theta_deg, theta_sd_deg, plane_lv_deg, plane_sd_deg`` and, of the angle, ``theta_p5_deg``,
            ``theta_p16_deg``, ``theta_p50_deg``, ``theta_p84_deg``, ``theta_p95_deg``.
        """
        import pandas as pd

        plane_sd = np.full(len(self.time_s), np.nan)
        if self.covariance is not None:
            plane_sd = np.sqrt(self.covariance[:, 1, 1])
        angles = self.theta_rad, self.theta_sd_rad, self.plane_lv_rad, plane_sd, *self.theta_quantiles_rad.T
        names = *_ANGLES_DEG, *QUANTILE_COLUMNS
        table = pd.DataFrame({"t_s": self.time_s} | dict(zip(names, np.rad2deg(angles), strict=True)))
        return table[np.isfinite(self.theta_rad)]

    def _about(self) -> str:
        known = np.isfinite(self.theta_rad)
        if not known.any():
            return f"{self.method}, no answer"
        k = self.largest()
        largest = f"largest {np.rad2deg(self.theta_rad[k]):.2f} deg at {self.time_s[k]:.2f} s"
        return f"{self.method}, {known.sum()} samples, {largest}"

    @property
    def theta_sd_rad(self) -> FloatArray:
        """Standard deviation of the angle, rad; NaN without covariance."""
        if self.covariance is None:
            return np.full(len(self.time_s), np.nan)
        return np.sqrt(self.covariance[:, 0, 0])

    @cached_property
    def theta_quantiles_rad(self) -> FloatArray:
        """Angle ``(n, 5)``, rad, below which `QUANTILES` of the posterior lie; NaN without covariance.

        The length of a lateral vector is not normal: near zero a sd says too little of it, and it is never negative.
        """
        if self.curved_quantiles_rad is not None:
            return self.curved_quantiles_rad
        out = np.full((len(self.time_s), len(QUANTILES)), np.nan)
        cov = self.lateral_cov_without_plane
        known = np.flatnonzero(np.isfinite(cov[:, 0, 0]) & np.isfinite(self.theta_rad))
        for k in drawn_together(known):
            value, axes = np.linalg.eigh(cov[k])
            root = axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]
            out[k] = length_quantiles(self.theta_yz_rad[k, None] + standard_normals(2) @ root.transpose(0, 2, 1))
        return out

    @property
    def theta_yz_rad(self) -> FloatArray:
        """Lateral deflection vector ``(n, 2)`` in body y, z, rad."""
        return self.theta_rad[:, None] * lv_direction(self.plane_lv_rad)[:, 1:]

    @property
    def lateral_cov(self) -> FloatArray:
        """Covariance ``(n, 2, 2)`` of the lateral vectors, rad^2; NaN without one, and where the plane is not known.

        Not known is a plane whose sd has ended at a uniform one's: what it was across is then lost.
        """
        n = len(self.time_s)
        if self.covariance is None:
            return np.full((n, 2, 2), np.nan)
        towards, sideways = lateral_axes(self.plane_lv_rad)
        turn = np.stack([towards, sideways * self.theta_rad[:, None]], axis=-1)
        cov = turn @ self.covariance @ turn.transpose(0, 2, 1)
        lost = self.covariance[:, 1, 1] > UNIFORM_VAR * (1.0 - 1e-6)
        return np.where(lost[:, None, None], np.nan, cov)

    @property
    def lateral_cov_without_plane(self) -> FloatArray:
        """`lateral_cov` ``(n, 2, 2)``, rad^2; where the plane is not known, as well known across as along."""
        cov = self.lateral_cov
        lost = np.isnan(cov[:, 0, 0]) & np.isfinite(self.theta_sd_rad)
        cov[lost] = self.theta_sd_rad[lost, None, None] ** 2 * np.eye(2)
        return cov

    def largest(self, within_s: tuple[float, float] = (-np.inf, np.inf)) -> int:
        """Index of the answer with the largest magnitude within a span of time; of all answers if the span has none."""
        inside = (self.time_s >= within_s[0]) & (self.time_s <= within_s[1]) & np.isfinite(self.theta_rad)
        size = np.where(inside, self.theta_rad, np.nan) if inside.any() else self.theta_rad
        return int(np.nanargmax(np.abs(size)))

    def angle_at(self, time_s: float) -> tuple[float, float]:
        """Angle and its sd, rad, at one time by linear interpolation between answers; NaN outside them and in holes.

        A hole is a distance between answers of more than three times the usual one. The sd holds what a straight line
        between answers misses of a curved history.
        """
        known = np.isfinite(self.theta_rad)
        t = self.time_s[known]
        if len(t) < 2 or not t[0] <= time_s <= t[-1]:
            return float("nan"), float("nan")
        k = int(np.clip(np.searchsorted(t, time_s, side="right") - 1, 0, len(t) - 2))
        if t[k + 1] - t[k] > HOLE_FACTOR * np.median(np.diff(t)) and time_s not in (t[k], t[k + 1]):
            return float("nan"), float("nan")
        theta, sd = self.theta_rad[known], self.theta_sd_rad[known]
        missed = interpolation_error(t, theta, time_s)
        return float(np.interp(time_s, t, theta)), float(np.hypot(np.interp(time_s, t, sd), missed))

    def at(self, time_s: float) -> pd.Series:
        """Answer at one time, in degrees, by interpolation between answers (`angle_at`).

        Parameters
        ----------
        time_s : float

        Returns
        -------
        Series
            ``t_s, theta_deg, theta_sd_deg, plane_lv_deg, plane_sd_deg``. All but the time are NaN outside the answers
            and in holes.
        """
        import pandas as pd

        theta, sd = self.angle_at(time_s)
        plane, plane_sd = np.nan, np.nan
        if np.isfinite(theta):
            known = np.isfinite(self.theta_rad)
            t = self.time_s[known]
            plane = float(lv_clock(np.array([np.interp(time_s, t, c) for c in self.theta_yz_rad[known].T])))
            if self.covariance is not None:
                plane_sd = float(np.interp(time_s, t, np.sqrt(self.covariance[known, 1, 1])))
        degrees = dict(zip(_ANGLES_DEG, np.rad2deg([theta, sd, plane, plane_sd]), strict=True))
        return pd.Series({"t_s": float(time_s)} | degrees, name=self.method)

    def plot(self) -> Any:
        """Figure of angle and plane over time with a band of one standard deviation.

        Returns
        -------
        matplotlib.figure.Figure
            That of ``postflight.plots.figure_deflection``.
        """
        # figures belong to the floor above, which is named here and not imported
        return pkgutil.resolve_name("postflight.plots:figure_deflection")(self)


_CLEAR_SD = 4.0  # of a cycle: a minimum lies so many sd below its neighbouring maxima


def cycle_about(history: DeflectionHistory, at_s: float) -> tuple[float, float] | None:
    """Times of the minima before and after a time, s: the oscillation cycle around it; None if no cycle is distinct.

    A minimum counts where the angle rises to both sides by `_CLEAR_SD` of its sd at ``at_s``.
    """
    sd = history.angle_at(at_s)[1]
    known = np.isfinite(history.theta_rad)
    if not np.isfinite(sd):
        return None
    t, theta = history.time_s[known], history.theta_rad[known]
    at = t[_clear_minima(theta, max(_CLEAR_SD * sd, 1e-9))]
    before, after = at[at <= at_s], at[at > at_s]
    if not len(before) or not len(after):
        return None
    inside = (t >= before[-1]) & (t <= after[0])
    if np.diff(t[inside]).max() > HOLE_FACTOR * np.median(np.diff(t)):
        return None
    return float(before[-1]), float(after[0])


def _clear_minima(values: FloatArray, rise: float) -> IntArray:
    """Indices of minima with a prominence of at least that much among values (n,)."""

    def rises(k: int, side: FloatArray) -> bool:
        lower = np.flatnonzero(side < values[k])
        return bool(side[: lower[0] if len(lower) else None].max(initial=values[k]) >= values[k] + rise)

    lowest = 1 + np.flatnonzero((values[1:-1] < values[:-2]) & (values[1:-1] <= values[2:]))
    clear = [k for k in lowest.tolist() if rises(k, values[:k][::-1]) and rises(k, values[k + 1 :])]
    return np.array(clear, dtype=np.int64)


def mean_over(history: DeflectionHistory, span_s: tuple[float, float]) -> tuple[float, float]:
    """Mean of the angle over a span, and an upper bound of its sd, rad; NaN where the history does not cover it.

    The bound is the mean of the standard deviations: that of the mean is no larger, whatever the errors' correlation.
    """
    known = np.isfinite(history.theta_rad)
    t = history.time_s[known]
    at = np.array([span_s[0], *t[(t > span_s[0]) & (t < span_s[1])], span_s[1]])
    if len(at) < 5 or not (t[0] <= span_s[0] and span_s[1] <= t[-1]):
        return float("nan"), float("nan")
    if np.diff(at).max() > HOLE_FACTOR * np.median(np.diff(t)):
        return float("nan"), float("nan")
    values = (np.interp(at, t, x[known]) for x in (history.theta_rad, history.theta_sd_rad))
    mean, sd = (float(np.trapezoid(x, at) / (at[-1] - at[0])) for x in values)
    return mean, sd


_DRAWS, _ROWS = 768, 256


@cache
def standard_normals(dimensions: Literal[2, 3]) -> FloatArray:
    """Evenly spread draws ``(768, dimensions)`` of independent unit normals, always the same.

    Two are a spiral: equal steps of probability in the radius, golden angles about it (Vogel 1979, a better way to
    construct the sunflower head); the third has equal steps of probability in an order that knows nothing of the
    spiral. Quantiles of a pair's distance from any point are right to 0.055 standard deviations (of as many of Sobol's
    points to 0.067).
    """
    from scipy.special import ndtri

    k = np.arange(_DRAWS) + 0.5
    radius, angle = np.sqrt(-2.0 * np.log1p(-k / _DRAWS)), np.pi * (3.0 - np.sqrt(5.0)) * k
    third = ndtri(np.sqrt(2.0) * k % 1.0)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), third])[:, :dimensions]


def interpolation_error(known_s: FloatArray, values: FloatArray, time_s: float) -> float:
    """Error of linear interpolation between values ``(n,)``: their second difference times ``s (1 - s) / 2``.

    It is taken as large as the largest about ``time_s``: among few of them all may be small where values are no denser
    than the swings.
    """
    if not known_s[0] <= time_s <= known_s[-1] or len(known_s) < 3:
        return 0.0
    k = int(np.clip(np.searchsorted(known_s, time_s, side="right") - 1, 0, len(known_s) - 2))
    share = (time_s - known_s[k]) / (known_s[k + 1] - known_s[k])
    around = np.diff(values[max(k - 3, 0) : k + 5], n=2)
    return float(0.5 * share * (1.0 - share) * np.abs(around).max(initial=0.0))


def lateral_axes(plane_lv_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit lateral vectors ``(n, 2)`` along clocking angles, and normal to them: the derivative of ``(-cos, sin)``."""
    return lv_direction(plane_lv_rad)[..., 1:], np.stack([np.sin(plane_lv_rad), np.cos(plane_lv_rad)], axis=-1)


def polar_from_lateral(
    theta_yz_rad: FloatArray, covariance_yz: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle ``(n,)``, plane ``(n,)`` and their covariance ``(n, 2, 2)`` from lateral vectors ``(n, 2)``, rad.

    Where the angle is small against its sd the plane is unknown: its variance ends at that of a uniform one, pi^2/3.
    """
    size = np.linalg.norm(theta_yz_rad, axis=-1)
    plane = np.where(np.isfinite(size), lv_clock(theta_yz_rad), 0.0)
    towards, sideways = lateral_axes(plane)
    turn = np.stack([towards, sideways / np.maximum(size, 1e-9)[..., None]], axis=-2)
    cov = turn @ covariance_yz @ np.swapaxes(turn, -1, -2)
    with np.errstate(invalid="ignore"):
        shrink = np.minimum(1.0, np.sqrt(UNIFORM_VAR / cov[..., 1, 1]))
    cov[..., 0, 1] *= shrink
    cov[..., 1, 0] *= shrink
    cov[..., 1, 1] *= shrink**2
    return size, plane, cov


def drawn_together(rows: IntArray) -> Iterator[IntArray]:
    """Split rows into chunks (k,) that limit memory: the draws of all rows together would be a run's largest arrays."""
    for first in range(0, len(rows), _ROWS):
        yield rows[first : first + _ROWS]


def length_quantiles(drawn: FloatArray) -> FloatArray:
    """`QUANTILES` ``(n, 5)`` of the lengths of vectors ``(n, k, 2)`` drawn from n distributions."""
    return np.asarray(np.quantile(np.linalg.norm(drawn, axis=2), QUANTILES, axis=1).T)


def history_from_lateral(
    time_s: FloatArray,
    theta_yz_rad: FloatArray,
    covariance_yz: FloatArray,
    method: str,
    assumptions: str,
    curved_quantiles_rad: FloatArray | None = None,
) -> DeflectionHistory:
    """History from lateral deflection vectors ``(n, 2)`` in body y, z and their covariance ``(n, 2, 2)``, rad.

    Rows that hold NaN stay NaN.
    """
    theta, plane, cov = polar_from_lateral(theta_yz_rad, covariance_yz)
    return DeflectionHistory(time_s, theta, plane, cov, method, assumptions, curved_quantiles_rad)
