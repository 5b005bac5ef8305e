"""What was the as-flown atmosphere? Density and winds along altitude, from the trajectory and the deceleration.

The sounding is a prior. Half the variance of its errors is constant along altitude, half is Gauss-Markov (correlation
length 5 km for density, 3 km for winds); the accelerometers measure the force of the air at every height,

    f_x  = -q S / m (C_A(M, |a|) (1 - t^2 / 2) + C_N(M, |a|) a.t / |a|)
    f_yz =  q S / m (C_A t - C_N a / |a|),   q = rho |u|^2 / 2,   u = v - wind,   a = a_body + t

with ``a_body`` the flow's lateral angle relative to the centerbody and ``t = (G a_body + B) s / (1 - g s) + b`` the
contribution of a deflected aeroshell, a shifted c.g. and a misalignment (``s`` is the share of the largest dynamic
pressure): the deflection of a compliant joint is proportional to the load, and grows as the load nears divergence.
``B`` and ``b`` rotate with the body, while winds do not: spin separates them. Forces are means over windows, in which a
spinning body turns: what the flow's angle does to C_A comes from the mean of its square, what it does across from its
mean. Coefficients are unknown within their pre-flight standard deviations, C_A by a factor on all Mach numbers and by
one that changes with them (Gauss-Markov along the logarithm of the Mach number; ``ca_shape_part`` of the variance);
attitude and velocity within the trajectory's own covariance; the force within that of the accelerometer's errors and
of the c.g. All are estimated at once by least squares.

Density, C_A and 1 / m enter as a product: without pressure ports a constant factor among them is not observable, and
the standard deviations include it. ``C_A scale`` is the log of flown over stated ``C_A / m``, mean over the pressure
pulse.

References
----------
S. Dutta, R. Braun, "Statistical entry, descent, and landing performance reconstruction of the Mars Science
Laboratory", J. Spacecraft Rockets 51 (2014) 1048 (density and drag are not separable without pressures).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from flightmodel import earth, rotations
from flightmodel.aerodynamics import AeroTable
from flightmodel.airdata import lateral_angles
from flightmodel.atmosphere import (
    DENSITY_LENGTH_M,
    WIND_LENGTH_M,
    AtmosphereProfile,
    gas_constant,
    mean_free_path,
    sounding_correlation,
    unresolved_variance,
)
from flightmodel.checks import BoolArray, Check, FloatArray, GateError
from flightmodel.least_squares import Estimate, Linearised, least_squares
from flightmodel.statistics import correlation
from flightmodel.telemetry import LARGEST_GAP_S, Telemetry
from flightmodel.trajectory import Trajectory, interpolate_rows, resample
from flightmodel.vehicle import Vehicle
from recon.estimate import TrajectorySolution
from recon.state import data_sheet_check

# a third of the winds' correlation length
_KNOT_M, _TRAJECTORY_TIME_S = 1000.0, 20.0
LEAST_AXIAL_MPS2 = 0.5  # below, the deceleration does not depend on the air measurably
_LEAST_SAMPLES = 20  # windows: fewer say little of a profile
# of the deceleration, axial and lateral: model error of coefficients and of an oscillating joint
_AXIAL_PART, _LATERAL_PART, _MODEL_FLOOR_MPS2 = 0.01, 0.02, 0.03
_SETTLED_SD = 1e-2  # far below any error
_FLEXURE_SD = (1.0, 0.3, *[float(np.deg2rad(3.0))] * 4)  # gain, growth, offsets
# log of the ratio of Mach numbers over which the error of C_A's shape forgets: about a flow regime, as the sources of
# coefficients (ranges, tunnels, CFD) change from one to the next; assumed
CA_SHAPE_LENGTH = float(np.log(2.0))
_BAD_DENSITY = (
    "is beyond the sounding's uncertainty: density, C_A, area or mass is wrong, which the drag does not separate; "
    "check the vehicle file and the sounding"
)
_BAD_WIND = "is beyond the sounding's uncertainty: the winds differed from the sounding, or C_N of the vehicle is wrong"
_BAD_DRAG = (
    "is beyond the pre-flight uncertainty: C_A, area, mass or density is wrong, which the drag does not separate; "
    "check the vehicle file and the sounding"
)
# half the window over which sensors are averaged: well below the joint's period, well above the sampling interval
HALF_WINDOW_S = 0.05
_WINDOW_S = 0.4  # over which the joint's oscillation is averaged
_EDGE_S = 0.05  # half the windows over which rates are averaged at both ends
_POINTS = 9  # at which a window's attitude is interpolated


@dataclass(frozen=True)
class AirSamples:
    """Means over windows long enough to average the joint's oscillation.

    Parameters
    ----------
    time_s, altitude_m : (n,) float
    velocity_ned_mps : (n, 3) float
        Of the c.g. against the rotating Earth.
    dcm_ned_body : (n, 3, 3) float
        Mean matrix of the window, not quite orthogonal: it maps body-axis components to means, too.
    specific_force_body_mps2 : (n, 3) float
        At the c.g.
    error_root_ned : (n, 6, 6) float
        Root of the trajectory's covariance: velocity m/s and rotation rad, estimate minus truth, NED axes.
    force_root_body_mps2 : (n, 3, 12) float
        Error of the specific force per unit normal of nine errors of the accelerometer and three of the c.g.
    """

    time_s: FloatArray
    altitude_m: FloatArray
    velocity_ned_mps: FloatArray
    dcm_ned_body: FloatArray
    specific_force_body_mps2: FloatArray
    error_root_ned: FloatArray
    force_root_body_mps2: FloatArray

    def rows(self, keep: BoolArray) -> AirSamples:
        """Chosen samples."""
        return AirSamples(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Drag:
    """Aerodynamic force model: coefficients, reference area over mass, sd of both (fractions), reference length.

    ``area_per_mass_m2pkg`` is one number, or one for each sample (n,) where mass changes in flight.
    ``ca_shape_sd`` is the part of ``ca_sd`` that changes with Mach number.
    """

    table: AeroTable
    area_per_mass_m2pkg: FloatArray | float
    ca_sd: float
    cn_sd: float
    length_m: float
    ca_shape_sd: float

    def rows(self, keep: BoolArray) -> Drag:
        """Force model of chosen samples."""
        per_mass = self.area_per_mass_m2pkg
        return replace(self, area_per_mass_m2pkg=per_mass[keep]) if isinstance(per_mass, np.ndarray) else self

    @property
    def ca_constant_sd(self) -> float:
        """Part of ``ca_sd`` that is one factor at all Mach numbers."""
        return float(np.sqrt(self.ca_sd**2 - self.ca_shape_sd**2))


@dataclass(frozen=True)
class ReconstructedAir:
    """As-flown atmosphere.

    Parameters
    ----------
    profile : DataFrame
        ``altitude_m``; ``density_ratio`` (to the sounding) and winds north and east, each with ``_sd`` and
        ``_prior_sd``.
    drag : DataFrame
        ``time_s, altitude_m, mach, dynamic_pressure_pa, ratio, ratio_prior_sd``: measured over predicted axial force
        with the sounding's air and the pre-flight C_A.
    parameters : DataFrame
        ``name, unit, prior_sd, estimate, sd`` of coefficient scales, gain and offsets. Scales are logs of flown over
        stated coefficient over mass, C_A's the mean over the pressure pulse.
    consistency_checks : tuple of Check
    """

    profile: pd.DataFrame
    drag: pd.DataFrame
    parameters: pd.DataFrame
    consistency_checks: tuple[Check, ...]


_PARAMETERS = {
    "C_A scale": "1",
    "C_N scale": "1",
    "flexure gain": "1",
    "flexure growth": "1",
    "load offset y": "rad",
    "load offset z": "rad",
    "offset y": "rad",
    "offset z": "rad",
}
# of each sample: density, two winds, parameters, errors of velocity and attitude, C_A's shape, errors of the force
_SHAPE, _FORCE, _FORCE_ERRORS = 3 + len(_PARAMETERS) + 6, 3 + len(_PARAMETERS) + 7, 12
_UNKNOWNS = _FORCE + _FORCE_ERRORS


class _Model:
    """Forces as a function of the unknowns of each sample, in the order of `_UNKNOWNS`."""

    def __init__(self, samples: AirSamples, profile: AtmosphereProfile, drag: Drag) -> None:
        self.samples, self.drag = samples, drag
        self.air = profile.at(samples.altitude_m)
        gas = gas_constant(samples.altitude_m, profile.planet)
        self.knudsen = mean_free_path(self.air.density_kgpm3, gas, profile.planet) / drag.length_m
        still = np.zeros((len(samples.time_s), _UNKNOWNS))
        self.largest_pa = float(self.forces(still, 1.0)[1].max())

    def forces(self, x: FloatArray, largest_pa: float | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Specific force (n, 3), dynamic pressure (n,), Mach number (n,)."""
        s, air = self.samples, self.air
        ca_scale, cn_scale, gain, growth = x[:, 3:7].T
        error = np.einsum("nij,nj->ni", s.error_root_ned, x[:, 11:17])
        wind = air.wind_ned_mps.copy()
        wind[:, :2] += x[:, 1:3] * air.wind_sd_mps[:, None]
        u_ned = s.velocity_ned_mps - error[:, 0:3] - wind
        u_ned = u_ned + np.cross(error[:, 3:6], u_ned)
        u = np.einsum("nji,nj->ni", s.dcm_ned_body, u_ned)
        speed = np.linalg.norm(u_ned, axis=1)
        q = 0.5 * air.density_kgpm3 * np.exp(x[:, 0] * air.density_sd) * speed**2
        mach = speed / air.sound_speed_mps
        body = lateral_angles(u)
        share = q / (self.largest_pa if largest_pa is None else largest_pa)
        share = share / np.maximum(1.0 - growth * share, 0.1)  # of its stiffness load leaves a joint a tenth at least
        tilt = share[:, None] * (gain[:, None] * body + x[:, 7:9]) + x[:, 9:11]
        flow, bend = body + tilt, gain * share
        # mean squares and product over the window: what turns in it has no mean, but keeps the axis' angle to the flow
        total = np.arctan2(np.sqrt(np.maximum(speed**2 - u[:, 0] ** 2, 0.0)), u[:, 0])
        turning = np.maximum(total**2 - np.sum(body**2, axis=1), 0.0)
        size = np.sqrt(np.sum(flow**2, axis=1) + (1.0 + bend) ** 2 * turning)
        tilt_square = np.sum(tilt**2, axis=1) + bend**2 * turning
        along = np.sum(tilt * flow, axis=1) + bend * (1.0 + bend) * turning
        coefficients = self.drag.table.at(mach, np.clip(size, 0.0, np.pi), self.knudsen)
        ca = coefficients[:, 0] * np.exp(ca_scale + self.drag.ca_shape_sd * x[:, _SHAPE])
        slope = coefficients[:, 1] * np.exp(cn_scale) / np.maximum(size, 1e-12)
        axial = -ca * (1.0 - 0.5 * tilt_square) - slope * along
        lateral = -slope[:, None] * flow + ca[:, None] * tilt
        force = (q * self.drag.area_per_mass_m2pkg)[:, None] * np.column_stack([axial, lateral])
        return force + np.einsum("nij,nj->ni", s.force_root_body_mps2, x[:, _FORCE:]), q, mach

    def linearised(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Forces (n, 3) and partials (n, 3, _UNKNOWNS), central differences."""
        step = 1e-4
        partials = np.empty((len(x), 3, _UNKNOWNS))
        partials[:, :, _FORCE:] = self.samples.force_root_body_mps2
        for j in range(_FORCE):
            up, down = x.copy(), x.copy()
            up[:, j] += step
            down[:, j] -= step
            partials[:, :, j] = (self.forces(up)[0] - self.forces(down)[0]) / (2.0 * step)
        return self.forces(x)[0], partials


def _interpolation(at: FloatArray, knots: FloatArray) -> FloatArray:
    """Weights (n, k) of linear interpolation."""
    k = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    w = np.clip((at - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)
    out = np.zeros((len(at), len(knots)))
    out[np.arange(len(at)), k], out[np.arange(len(at)), k + 1] = 1.0 - w, w
    return out


def _inverse(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(covariance))


def _knots(at: FloatArray, spacing: float) -> FloatArray:
    first, last = np.floor(at.min() / spacing), np.ceil(at.max() / spacing)
    return spacing * np.arange(first, max(last, first + 1.0) + 1.0)


def reconstruct_air(
    samples: AirSamples, profile: AtmosphereProfile, drag: Drag, confidence: float = 0.999
) -> ReconstructedAir:
    """Density and winds along altitude from a trajectory and the deceleration along it.

    Raises
    ------
    GateError
        Where fewer than `_LEAST_SAMPLES` windows have a deceleration large enough, or no solution is found.
    """
    keep = -samples.specific_force_body_mps2[:, 0] >= LEAST_AXIAL_MPS2
    if keep.sum() < _LEAST_SAMPLES:
        raise GateError(
            f"air: {int(keep.sum())} windows with a deceleration above {LEAST_AXIAL_MPS2} m/s^2; "
            f"at least {_LEAST_SAMPLES} are needed to estimate density and winds",
            code="too-few-data",
        )
    samples, drag = samples.rows(keep), drag.rows(keep)
    model = _Model(samples, profile, drag)
    drag_ratio = _drag_ratio(model)
    height = _knots(samples.altitude_m, _KNOT_M)
    blocks, information = _prior(samples, drag, drag_ratio["mach"].to_numpy(), height)
    found = _estimated(model, blocks, information)
    estimate, covariance = found.value, found.covariance
    sd = np.sqrt(np.diag(covariance))
    rows = slice(3 * len(height), 3 * len(height) + len(_PARAMETERS))
    own, own_sd, prior_sd = estimate[rows].copy(), sd[rows].copy(), np.array([drag.ca_sd, drag.cn_sd, *_FLEXURE_SD])
    prior_sd[0], own[0], own_sd[0] = _ca_of_pulse(model, drag_ratio, blocks, information, estimate, covariance)
    sound = _consistency_checks(height, estimate, sd, (own[0], own_sd[0]), confidence)
    return ReconstructedAir(
        _profile(model, height, estimate, sd),
        drag_ratio,
        _parameters(prior_sd, own, own_sd),
        (*sound, *_residual_checks(found.linear.residual.reshape(-1, 3))),
    )


def _prior(
    samples: AirSamples, drag: Drag, mach: FloatArray, height: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """`_UNKNOWNS` of the samples per unknown of the flight, (n, k) each, and a priori information (k, k) of these.

    The flight's unknowns are in a priori standard deviations.
    """
    log_mach = np.log(np.maximum(mach, 0.1))
    time, by_mach = _knots(samples.time_s, _TRAJECTORY_TIME_S / 4.0), _knots(log_mach, 0.1)
    one = np.ones((len(mach), 1))
    blocks = [_interpolation(samples.altitude_m, height)] * 3
    blocks += [sd * one for sd in (drag.ca_constant_sd, drag.cn_sd, *_FLEXURE_SD)]
    blocks += [_interpolation(samples.time_s, time)] * 6 + [_interpolation(log_mach, by_mach)] + [one] * _FORCE_ERRORS
    lengths = (DENSITY_LENGTH_M, WIND_LENGTH_M, WIND_LENGTH_M)
    information = [_inverse(sounding_correlation(height, length)) for length in lengths]
    information += [np.eye(1)] * len(_PARAMETERS) + [_inverse(correlation(time, _TRAJECTORY_TIME_S))] * 6
    information += [_inverse(correlation(by_mach, CA_SHAPE_LENGTH))] + [np.eye(1)] * _FORCE_ERRORS
    return blocks, information


def _ca_of_pulse(
    model: _Model,
    drag_ratio: pd.DataFrame,
    blocks: list[FloatArray],
    information: list[FloatArray],
    estimate: FloatArray,
    covariance: FloatArray,
) -> tuple[float, float, float]:
    """Log factor of C_A, mean over the pressure pulse: its a priori sd, and estimate and sd in units of that.

    At the peak alone it would lean to the sounding's own errors, which also say where that is.
    """
    first = np.cumsum([0, *(b.shape[1] for b in blocks)])
    q = drag_ratio["dynamic_pressure_pa"].to_numpy()
    shape = model.drag.ca_shape_sd * blocks[_SHAPE][q >= 0.5 * q.max()].mean(axis=0)
    prior_sd = float(np.hypot(model.drag.ca_constant_sd, np.sqrt(shape @ _inverse(information[_SHAPE]) @ shape)))
    weights = np.zeros(len(estimate))
    weights[first[3]] = model.drag.ca_constant_sd / prior_sd
    weights[first[_SHAPE] : first[_SHAPE + 1]] = shape / prior_sd
    return prior_sd, float(weights @ estimate), float(np.sqrt(weights @ covariance @ weights))


def _estimated(model: _Model, blocks: list[FloatArray], information: list[FloatArray]) -> Estimate:
    """Normalised unknowns (u,), and residuals of the forces (3 n,) in standard deviations."""
    prior = block_diag(*information)
    edges = np.cumsum([0, *(b.shape[1] for b in blocks)])
    measured = model.samples.specific_force_body_mps2
    sd = np.hypot(_MODEL_FLOOR_MPS2, np.array([_AXIAL_PART, _LATERAL_PART, _LATERAL_PART]) * np.abs(measured[:, :1]))

    def linearised(x: FloatArray) -> Linearised:
        local = np.column_stack([b @ x[i:j] for b, i, j in zip(blocks, edges[:-1], edges[1:], strict=True)])
        force, partials = model.linearised(local)
        by_unknown = [(partials[:, :, k] / sd)[:, :, None] * b[:, None, :] for k, b in enumerate(blocks)]
        jacobian = np.concatenate(by_unknown, axis=2).reshape(-1, len(x))
        return Linearised.of(((measured - force) / sd).ravel(), jacobian, 1.0, prior, x)

    found = least_squares(linearised, np.zeros(len(prior)), _SETTLED_SD)
    if not found.converged:
        raise GateError(
            "air: no density and winds near the sounding's explain the deceleration along this trajectory; see the "
            "consistency checks, and check the accelerometer's axes, units and mount",
            code="not-converged",
        )
    return found


def _profile(model: _Model, height: FloatArray, estimate: FloatArray, sd: FloatArray) -> pd.DataFrame:
    """Density ratio and winds at the knots (k,) that lie among the samples."""
    k = len(height)
    order = np.argsort(model.samples.altitude_m)
    at = model.samples.altitude_m[order]
    density_sd, wind_sd = (
        np.interp(height, at, values[order]) for values in (model.air.density_sd, model.air.wind_sd_mps)
    )
    density, north, east = (slice(i * k, (i + 1) * k) for i in range(3))
    ratio = np.exp(estimate[density] * density_sd)
    # samples determine the mean wind about a knot; the wind's structure between knots adds to its variance
    within = unresolved_variance(_KNOT_M, WIND_LENGTH_M)
    north_sd, east_sd = (np.sqrt(np.minimum(sd[part] ** 2 + within, 1.0)) for part in (north, east))
    table = pd.DataFrame(
        {
            "altitude_m": height,
            "density_ratio": ratio,
            "density_ratio_sd": ratio * sd[density] * density_sd,
            "density_ratio_prior_sd": density_sd,
            "wind_north_change_mps": estimate[north] * wind_sd,
            "wind_north_sd_mps": north_sd * wind_sd,
            "wind_east_change_mps": estimate[east] * wind_sd,
            "wind_east_sd_mps": east_sd * wind_sd,
            "wind_prior_sd_mps": wind_sd,
        }
    )
    return table[(height >= at[0]) & (height <= at[-1])].reset_index(drop=True)


def _parameters(prior_sd: FloatArray, estimate: FloatArray, sd: FloatArray) -> pd.DataFrame:
    """Coefficient scales and flexure from estimates in a priori standard deviations."""
    return pd.DataFrame(
        {
            "name": list(_PARAMETERS),
            "unit": list(_PARAMETERS.values()),
            "prior_sd": prior_sd,
            "estimate": estimate * prior_sd,
            "sd": sd * prior_sd,
        }
    )


def _drag_ratio(model: _Model) -> pd.DataFrame:
    """Measured over predicted axial force, with the sounding's air and the pre-flight coefficients."""
    s = model.samples
    force, q, mach = model.forces(np.zeros((len(s.time_s), _UNKNOWNS)))
    return pd.DataFrame(
        {
            "time_s": s.time_s,
            "altitude_m": s.altitude_m,
            "mach": mach,
            "dynamic_pressure_pa": q,
            "ratio": s.specific_force_body_mps2[:, 0] / force[:, 0],
            "ratio_prior_sd": np.hypot(model.air.density_sd, model.drag.ca_sd),
        }
    )


def _residual_checks(residual: FloatArray) -> list[Check]:
    """Do the forces follow the model (n, 3)?"""
    out = []
    for name, part in (("axial", residual[:, :1]), ("lateral", residual[:, 1:])):
        rms = float(np.sqrt(np.mean(part**2)))
        out.append(
            Check.of(
                "force-residuals", f"air residuals {name}", rms, 0.0, 2.0, "forces follow the model",
                "forces do not follow the model", advice="check the coefficients; look for thrust or contact",
                source="air", component=name,
            )
        )  # fmt: skip
    return out


def _consistency_checks(
    height: FloatArray, estimate: FloatArray, sd: FloatArray, ca: tuple[float, float], confidence: float
) -> tuple[Check, ...]:
    """Are density, winds and C_A (estimate and sd over its a priori sd) consistent with sounding and vehicle file?"""
    k = len(height)
    heights = [f"at {h / 1000:.0f} km" for h in height]
    wind = [f"wind {way} {h}" for way in ("north", "east") for h in heights]

    def check(
        code: str, label: str, names: list[str], found: FloatArray, found_sd: FloatArray, bad: str
    ) -> Check | None:
        good = "within stated uncertainty; largest:"
        return data_sheet_check(code, label, "", names, found, np.ones(len(names)), found_sd, confidence, bad, good)

    density, winds = slice(0, k), slice(k, 3 * k)
    names = [f"density {h}" for h in heights]
    checks = (
        check("sounding-density", "sounding density", names, estimate[density], sd[density], _BAD_DENSITY),
        check("sounding-wind", "sounding wind", wind, estimate[winds], sd[winds], _BAD_WIND),
        # C_N is not checked: a deflected aeroshell changes the normal force as a wrong C_N does
        check("pre-flight-drag", "pre-flight C_A", ["C_A"], np.array(ca[:1]), np.array(ca[1:]), _BAD_DRAG),
    )
    return tuple(v for v in checks if v is not None)


def _window_means(time_s: FloatArray, values: FloatArray, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Means ``(k, m)`` of piecewise linear ``values`` (n, m) over windows; uneven samples are weighted by time."""
    area = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(0.5 * np.diff(time_s)[:, None] * (values[1:] + values[:-1]), axis=0)]
    )

    def integral(at: FloatArray) -> FloatArray:
        at = np.clip(at, time_s[0], time_s[-1])
        k = np.clip(np.searchsorted(time_s, at, side="right") - 1, 0, len(time_s) - 2)
        h = (at - time_s[k])[:, None]
        slope = (values[k + 1] - values[k]) / (time_s[k + 1] - time_s[k])[:, None]
        return area[k] + values[k] * h + 0.5 * slope * h**2

    width = np.clip(end_s, time_s[0], time_s[-1]) - np.clip(start_s, time_s[0], time_s[-1])
    return (integral(end_s) - integral(start_s)) / np.maximum(width, 1e-9)[:, None]


@dataclass(frozen=True)
class CgAccelerations:
    """Window means of the corrected inertial sensors at times (k,), body axes.

    Parameters
    ----------
    specific_force_sensor_mps2, specific_force_cg_mps2 : (k, 3) float
        At the accelerometer, and carried to the c.g. by the gyros.
    rate_radps, angular_acceleration_radps2 : (k, 3) float
    samples : float
        Number of samples in a window.
    """

    specific_force_sensor_mps2: FloatArray
    specific_force_cg_mps2: FloatArray
    rate_radps: FloatArray
    angular_acceleration_radps2: FloatArray
    samples: float


def windows_are_whole(bet: TrajectorySolution, grid: FloatArray) -> BoolArray:
    """Mask (n,) of times with sensor data on both sides and no telemetry gap near."""
    return _without_gap(bet.imu_time_s, grid, 2.0 * HALF_WINDOW_S)


def _without_gap(t_imu: FloatArray, at: FloatArray, reach_s: float) -> BoolArray:
    """Mask (n,) of times with sensor data to both sides and no gap beside which a mean is not of its middle."""
    if len(t_imu) < 2:
        return np.zeros(len(at), dtype=bool)
    gap = np.flatnonzero(np.diff(t_imu) > LARGEST_GAP_S + 1e-6)  # tags are decimals: ten a second are not quite
    ends = np.concatenate([[-np.inf], t_imu[gap + 1]])  # of the gap before the first there is none
    last = ends[np.searchsorted(t_imu[gap], at + reach_s)]  # of the gaps that begin before the window ends
    return np.asarray((at - reach_s >= t_imu[0]) & (at + reach_s <= t_imu[-1]) & (at - reach_s >= last))


def too_sparse(bet: TrajectorySolution, window_s: float) -> GateError:
    """Message that no window of that length has complete inertial data."""
    usual = float(np.median(np.diff(bet.imu_time_s))) if len(bet.imu_time_s) > 1 else np.inf
    return GateError(
        f"accelerometer and rates: no {window_s:.1f} s with samples of both at most {LARGEST_GAP_S:g} s apart "
        f"(usually {usual:.3g} s): forces at the c.g. need ten samples a second; deliver the data at their full rate",
        code="too-few-data",
    )


def cg_accelerations(
    bet: TrajectorySolution, t: FloatArray, cg_from_sensor_m: FloatArray, h: float = HALF_WINDOW_S
) -> CgAccelerations:
    """Corrected sensors, averaged over ``h`` s on both sides of times whose windows are whole."""
    t_imu = bet.imu_time_s
    force = _window_means(t_imu, bet.specific_force_body_mps2, t - h, t + h)
    rate = _window_means(t_imu, bet.rate_body_radps, t - h, t + h)
    after = _window_means(t_imu, bet.rate_body_radps, t, t + 2 * h)
    before = _window_means(t_imu, bet.rate_body_radps, t - 2 * h, t)
    turn = (after - before) / (2 * h)
    at_cg = force + rotations.lever_arm_acceleration(rate, turn, cg_from_sensor_m)
    return CgAccelerations(force, at_cg, rate, turn, max(1.0, 2 * h / float(np.median(np.diff(t_imu)))))


def as_flown_atmosphere(
    telemetry: Telemetry, bet: TrajectorySolution, profile: AtmosphereProfile, confidence: float
) -> ReconstructedAir:
    """Density and winds along altitude from the reconstruction and the corrected deceleration.

    Raises
    ------
    GateError
        Where there is no vehicle or no inertial sensor, or the deceleration is too small.
    """
    vehicle = telemetry.required_vehicle()
    known = vehicle.uncertainty
    samples = _air_samples(telemetry, bet)
    changing = bool(vehicle.mass_steps)
    drag = Drag(
        vehicle.aero,
        vehicle.reference.area_m2 / (vehicle.mass_at(samples.time_s) if changing else vehicle.mass_kg),
        float(np.hypot(known.ca, known.mass)),
        float(np.hypot(known.cn, known.mass)),
        vehicle.reference.length_m,
        float(np.sqrt(known.ca_shape_part) * known.ca),
    )
    return reconstruct_air(samples, profile, drag, confidence)


def _air_samples(telemetry: Telemetry, bet: TrajectorySolution) -> AirSamples:
    """Means over windows of `_WINDOW_S`, side by side, wherever no telemetry gap is near."""
    cg = telemetry.required_vehicle().cg_m
    accelerometer, _ = telemetry.required_triads()
    t = _window_times(bet)
    if len(t) == 0:
        raise too_sparse(bet, _WINDOW_S + 2.0 * _EDGE_S)
    arm = cg - accelerometer.spec.position_from_datum_body_m
    inside = _WINDOW_S * ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5)
    dense = resample(bet.smoothed, (t[:, None] + inside).ravel())

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(values.reshape(len(t), _POINTS, *values.shape[1:]).mean(axis=1))

    middle = resample(bet.smoothed, t)
    lat, lon, altitude = earth.geodetic_from_ecef(middle.position_ecef_m, middle.planet)
    dcm_ned_ecef = earth.dcm_ned_ecef(lat, lon)
    dcm = rotations.dcm_from_q(dense.q_ecef_body)
    spin = dense.omega_body_eci_body_radps - dcm.transpose(0, 2, 1) @ dense.planet.rate_ecef_radps
    velocity = dense.velocity_ecef_mps + np.einsum("nij,nj->ni", dcm, np.cross(spin, cg))
    return AirSamples(
        t,
        altitude,
        np.einsum("nij,nj->ni", dcm_ned_ecef, mean(velocity)),
        dcm_ned_ecef @ mean(dcm),
        _force_means(bet, arm, t),
        _error_roots(middle, dcm_ned_ecef),
        _force_roots(telemetry.required_vehicle(), bet, t),
    )


def _window_times(bet: TrajectorySolution) -> FloatArray:
    """Middles of the windows in which the sensors are whole."""
    t_imu, t_bet = bet.imu_time_s, bet.smoothed.time_s
    reach = 0.5 * _WINDOW_S + _EDGE_S
    first, last = max(t_imu[0], t_bet[0]) + reach, min(t_imu[-1], t_bet[-1]) - reach
    t = np.arange(first, last, _WINDOW_S)
    return t[_without_gap(t_imu, t, reach)]


def _force_means(bet: TrajectorySolution, arm_body_m: FloatArray, t: FloatArray) -> FloatArray:
    """Specific force at a point ``arm_body_m`` from the accelerometer, body axes, means over the windows."""
    half = 0.5 * _WINDOW_S
    force = _window_means(bet.imu_time_s, bet.specific_force_body_mps2, t - half, t + half)
    return force + _lever_means(bet, t) @ arm_body_m


def _lever_means(bet: TrajectorySolution, t: FloatArray) -> FloatArray:
    """Change of the specific force per metre from the accelerometer (k, 3, 3), body axes, means over the windows."""
    t_imu, rate, half = bet.imu_time_s, bet.rate_body_radps, 0.5 * _WINDOW_S
    ends = [_window_means(t_imu, rate, at - _EDGE_S, at + _EDGE_S) for at in (t - half, t + half)]
    turn = (ends[1] - ends[0]) / _WINDOW_S
    square = np.einsum("ni,nj->nij", rate, rate) - np.sum(rate**2, axis=1)[:, None, None] * np.eye(3)
    centripetal = _window_means(t_imu, square.reshape(-1, 9), t - half, t + half).reshape(-1, 3, 3)
    return np.asarray(centripetal + rotations.skew(turn))


def _force_roots(vehicle: Vehicle, bet: TrajectorySolution, t: FloatArray) -> FloatArray:
    """Errors of the specific force at the c.g. (k, 3, 12) per unit normal of the accelerometer's and the c.g.'s."""
    known = vehicle.uncertainty
    share = np.hypot(vehicle.aeroshell.mass_kg, vehicle.centerbody.mass_kg) / vehicle.mass_kg
    cg_sd = share * np.array([known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m])
    own = bet.accelerometer_root[:, 3:]
    sensor = interpolate_rows(t, bet.smoothed.time_s, own.reshape(len(own), -1)).reshape(-1, 3, 9)
    return np.concatenate([sensor, _lever_means(bet, t) * cg_sd], axis=2)


def _error_roots(trajectory: Trajectory, dcm_ned_ecef: FloatArray) -> FloatArray:
    """Roots (n, 6, 6) of the covariance of velocity and rotation in NED axes."""
    assert trajectory.covariance is not None
    turn = np.zeros((len(trajectory.time_s), 6, 6))
    turn[:, 0:3, 0:3] = dcm_ned_ecef
    turn[:, 3:6, 3:6] = dcm_ned_ecef @ rotations.dcm_from_q(trajectory.q_ecef_body)
    return np.asarray(np.linalg.cholesky(turn @ trajectory.covariance[:, 3:9, 3:9] @ turn.transpose(0, 2, 1)))
