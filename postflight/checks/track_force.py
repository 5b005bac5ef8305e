"""Which specific force does a track imply, and how does it compare with an accelerometer's?

A quadratic is fitted to the positions (inertial axes) of each window of width ``W``; its second derivative less
gravitation is the mean specific force there, weighted over the window by ``(1 - u^2)^2`` with ``u = 2 (t - t_k) / W``:
the kernel of the second derivative of a least-squares quadratic (Savitzky and Golay, Anal. Chem. 36, 1964). The same
kernel over the accelerometer's readings makes both comparable without integrating attitudes, as magnitudes alone are
compared. A time bias ``d`` of the track and a scale ``k`` follow from ``F_track(t) = k a(t - d)`` by least squares.

Assumptions: the force hardly changes its direction within a window, and the track's errors scatter within it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray
from postflight.checks.units_and_axes import TimeBias, interval_around

_LEAST_SAMPLES = 6  # of a window
_LEAST_WINDOWS = 8  # for a scale and a lag, with their scatter
_STRIDES = 2  # windows overlap by half
_SIGNAL = 4.0  # magnitudes below so many standard deviations are mostly noise
_LARGEST_LAG_S = 5.0  # of a clock set by hand; hours and leap seconds are looked for elsewhere
_LAG_STEPS = 401  # 25 ms, between which a parabola finds the least
_LEAST_MISFIT = 0.25  # a window's scatter holds what a quadratic leaves out, and is too large by as much
_OVERLAP = np.sqrt(1.5)  # neighbouring windows share half of their samples
_FITS = 5.0  # reduced chi-square beyond which one lag and one scale do not describe a comparison
_WIDTHS_S = (1.0, 2.0, 4.0, 8.0, 16.0)  # of windows, from a precise receiver's to a coarse radar's


@dataclass(frozen=True)
class TrackForce:
    """Mean specific force of windows of one track.

    Parameters
    ----------
    time_s : (n,) float
    width_s : float
    position_m, velocity_mps : (n, 3) float
        Inertial axes (ECEF at time zero).
    force_mps2 : (n, 3) float
        Specific force, the same axes.
    covariance : (n, 3, 3) float
        Of the force, from the scatter of the positions about their quadratic.
    """

    time_s: FloatArray
    width_s: float
    position_m: FloatArray
    velocity_mps: FloatArray
    force_mps2: FloatArray
    covariance: FloatArray
    planet: earth.Planet = earth.WGS84

    def size(self) -> tuple[FloatArray, FloatArray]:
        """Return the magnitude (n,) of the force and its standard deviation along its direction, m/s^2."""
        size = np.linalg.norm(self.force_mps2, axis=1)
        along = self.force_mps2 / np.maximum(size, 1e-12)[:, None]
        sd = np.sqrt(np.einsum("ki,kij,kj->k", along, self.covariance, along))
        spread = np.einsum("kii->k", self.covariance) - sd**2  # normal to it: lengthens
        return np.sqrt(np.maximum(size**2 - spread, 0.0)), np.maximum(sd, 1e-6)

    @property
    def relative_velocity_mps(self) -> FloatArray:
        """Velocity (n, 3) relative to the rotating Earth, inertial axes."""
        return self.velocity_mps - np.cross(self.planet.rate_ecef_radps, self.position_m)


@dataclass(frozen=True)
class Comparison:
    """Track against accelerometer: the track's tags are ``lag_s`` late, its force ``scale`` times the reading."""

    lag_s: float
    lag_sd_s: float
    scale: float
    scale_sd: float
    misfit: float  # reduced chi-square
    start_s: float
    end_s: float


def track_force(
    time_s: FloatArray, position_ecef_m: FloatArray, width_s: float, planet: earth.Planet = earth.WGS84
) -> TrackForce | None:
    """Fit quadratics to windows of a track.

    Parameters
    ----------
    time_s : (n,) float
    position_ecef_m : (n, 3) float
        NaN is missing.
    width_s : float
        Of a window.

    Returns
    -------
    TrackForce or None
        None where fewer than eight windows are covered by samples.
    """
    whole = np.isfinite(position_ecef_m).all(axis=1)
    t, p = time_s[whole], position_ecef_m[whole]
    if len(t) < _LEAST_SAMPLES:
        return None
    p = rotations.rotate(rotations.conjugate(earth.q_ecef_eci(t, planet)), p)
    rows = []
    for centre in np.arange(t[0] + width_s / 2, t[-1] - width_s / 2, width_s / _STRIDES):
        low, high = np.searchsorted(t, [centre - width_s / 2, centre + width_s / 2])
        count = high - low
        edges = np.concatenate([[centre - width_s / 2], t[low:high], [centre + width_s / 2]])
        if count < _LEAST_SAMPLES or np.diff(edges).max() > 0.35 * width_s:
            continue
        middle = float(t[low:high].mean())  # the quadratic's second derivative belongs there
        u = t[low:high] - middle
        design = np.column_stack([np.ones(count), u, 0.5 * u * u])
        fit, *_ = np.linalg.lstsq(design, p[low:high], rcond=None)
        residual = p[low:high] - design @ fit
        variance = np.linalg.inv(design.T @ design)[2, 2]
        rows.append((middle, *fit, residual.T @ residual / (count - 3) * variance))
    if len(rows) < _LEAST_WINDOWS:
        return None
    centres, place, velocity, acceleration, covariance = (np.array(part) for part in zip(*rows, strict=True))
    force = acceleration - earth.gravitation(place, planet)
    return TrackForce(centres, width_s, place, velocity, force, covariance, planet)


def best_comparison(
    time_s: FloatArray,
    position_ecef_m: FloatArray,
    sensed_time_s: FloatArray,
    sensed_mps2: FloatArray,
    planet: earth.Planet = earth.WGS84,
) -> Comparison | None:
    """Compare at several window widths and return the comparison of the smallest lag sd (then scale sd).

    Parameters
    ----------
    time_s : (n,) float
    position_ecef_m : (n, 3) float
        Of the track.
    sensed_time_s : (m,) float
    sensed_mps2 : (m, 3) float
        The accelerometer's readings, in any axes.

    Returns
    -------
    Comparison or None
        None where no force above the noise changes with time.
    """
    found = []
    for width in _WIDTHS_S:
        force = track_force(time_s, position_ecef_m, width, planet)
        one = _compare(force, sensed_time_s, sensed_mps2) if force is not None else None
        if one is not None:
            found.append(one)
    return min(found, key=lambda c: (c.lag_sd_s, c.scale_sd)) if found else None


def coasting(force: TrackForce, time_s: FloatArray, sensed_mps2: FloatArray, below_mps2: float) -> BoolArray:
    """Return the windows in which an accelerometer (times (n,), readings (n, 3)) reads less than ``below_mps2``."""
    grid, seen = _smoothed(time_s, np.linalg.norm(sensed_mps2, axis=1), force.width_s)
    at = np.interp(force.time_s, grid, seen, left=np.nan, right=np.nan)
    return np.asarray(np.nan_to_num(at, nan=np.inf) < below_mps2)


def _smoothed(time_s: FloatArray, values: FloatArray, width_s: float) -> tuple[FloatArray, FloatArray]:
    """Values (n,) through the windows' kernel, on an even grid of times; NaN near gaps and ends."""
    from scipy.integrate import cumulative_trapezoid  # a tenth of a second

    whole = np.isfinite(values)
    t, v = time_s[whole], values[whole]
    step = max(float(np.median(np.diff(t))), width_s / 200)
    grid = np.arange(t[0], t[-1], step)
    half = max(1, round(0.5 * width_s / step))
    kernel = (1 - (np.arange(-half, half + 1) / (half + 0.5)) ** 2) ** 2
    kernel /= kernel.sum()
    if len(grid) < len(kernel):
        return grid, np.full(len(grid), np.nan)
    # cells of means first: a fast sensor's noise would fold into the grid
    total = cumulative_trapezoid(v, t, initial=0.0)
    mean = np.interp(grid + step / 2, t, total) - np.interp(grid - step / 2, t, total)
    width = np.minimum(grid + step / 2, t[-1]) - np.maximum(grid - step / 2, t[0])
    out = np.convolve(mean / width, kernel, mode="same")
    bad = interval_around(t, grid) > max(0.25 * width_s, 3 * step)
    bad[[0, -1]] = True
    near = np.convolve(bad.astype(float), np.ones(2 * half + 1), mode="same") > 0.5
    return grid, np.where(near, np.nan, out)


def _compare(force: TrackForce, time_s: FloatArray, sensed_mps2: FloatArray) -> Comparison | None:
    """Time bias and scale of a track against the magnitude of an accelerometer's readings (n, 3)."""
    size, sd = force.size()
    use = size > _SIGNAL * sd
    grid, seen = _smoothed(time_s, np.linalg.norm(sensed_mps2, axis=1), force.width_s)
    inside = (force.time_s > grid[0] + _LARGEST_LAG_S) & (force.time_s < grid[-1] - _LARGEST_LAG_S)
    late = force.time_s[use & inside]
    if len(late) < _LEAST_WINDOWS:
        return None
    f, sd = size[use & inside], sd[use & inside]
    lags = np.linspace(-_LARGEST_LAG_S, _LARGEST_LAG_S, _LAG_STEPS)
    model = np.array([np.interp(late - lag, grid, seen) for lag in lags])
    whole = np.isfinite(model).all(axis=0)
    if whole.sum() < _LEAST_WINDOWS:
        return None
    model, f, sd, late = model[:, whole], f[whole], sd[whole], late[whole]
    sd = np.hypot(sd, 0.01 * f)  # the kernel's own error where samples are few
    weight = sd**-2
    scale = (model * f * weight).sum(axis=1) / np.maximum((model**2 * weight).sum(axis=1), 1e-30)
    chi2 = ((f - scale[:, None] * model) ** 2 * weight).sum(axis=1)
    k = int(np.argmin(chi2))
    misfit = float(chi2[k]) / (len(f) - 2)
    inflation = np.sqrt(max(misfit, _LEAST_MISFIT))
    scale_sd = float(1.0 / np.sqrt((model[k] ** 2 * weight).sum())) * inflation * _OVERLAP
    lag, lag_sd = 0.0, np.inf
    if 0 < k < _LAG_STEPS - 1:
        low, mid, high = chi2[k - 1 : k + 2]
        step = lags[1] - lags[0]
        curvature = (low - 2 * mid + high) / step**2
        lag = float(lags[k] + 0.5 * step * (low - high) / (low - 2 * mid + high))
        lag_sd = float(np.sqrt(2.0 / curvature) * inflation * _OVERLAP)
    return Comparison(lag, lag_sd, float(scale[k]), float(scale_sd), misfit, float(late[0]), float(late[-1]))


def bias_of(name: str, seen: Comparison | None) -> TimeBias | None:
    """Time bias of a track against the accelerometer; None if the comparison does not determine it."""
    if seen is None or not seen.misfit < _FITS:
        return None
    return TimeBias(name, "accelerometer", seen.lag_s, seen.lag_sd_s)
