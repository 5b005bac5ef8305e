"""What the air of the day was, given the trajectory: density and winds along altitude, from the measured deceleration.

The sounding is a prior. Its errors are processes along altitude (exponential correlation, 5 km for density, 3 km for
winds) with its own standard deviations; the accelerometers then say at every height how hard the air pushed,

    f = q S / m (-C_A(M, |a|) e_x - C_N(M, |a|) a/|a| + C_A t),   q = rho |u|^2 / 2,   u = v - wind,   a = a_body + t

with ``a_body`` the flow's lateral angle against the centerbody and ``t = G (q / q_max) a_body + b`` what a bent shell, a
trimmed c.g. or a mounting adds to it: a gain and an offset that turns with the body, while winds do not. Coefficient
scales are unknown within their pre-flight standard deviations, attitude and velocity within the trajectory's own. All
are found at once by least squares. Density and C_A enter as a product: without pressure ports a constant factor between
them stays open, and the standard deviations say so.

References
----------
S. Dutta, R. Braun, "Statistical entry, descent, and landing performance reconstruction of the Mars Science
Laboratory", J. Spacecraft Rockets 51 (2014) 1048 (density and drag are not separable without pressures).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flightmodel.aerodynamics import AeroTable
from flightmodel.airdata import lateral_angles
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.checks import FloatArray, GateError
from recon.consistency import Verdict, sheet_verdict
from recon.error_model import DENSITY_LENGTH_M, WIND_LENGTH_M

KNOT_M, KNOT_S, TRAJECTORY_TIME_S = 1000.0, 5.0, 20.0
LEAST_AXIAL_MPS2 = 0.5  # below, the deceleration says nothing about the air
LEAST_SAMPLES = 20
# of the deceleration, along and across: what coefficients and a swinging joint leave open
MODEL_PART, LATERAL_PART, MODEL_FLOOR_MPS2 = 0.01, 0.02, 0.03
GAIN_SD, OFFSET_SD_RAD = 1.0, np.deg2rad(3.0)
SETTLED_SD, MOST_STEPS = 1e-3, 20


@dataclass(frozen=True)
class AirSamples:
    """Means over windows long enough to average the joint's swinging.

    Parameters
    ----------
    time_s, altitude_m : (n,) float
    velocity_ned_mps : (n, 3) float
        Of the c.g. against the rotating Earth.
    dcm_ned_body : (n, 3, 3) float
    specific_force_body_mps2 : (n, 3) float
        At the c.g.
    velocity_sd_mps, attitude_sd_rad : (n,) float
        Of the trajectory, per axis.
    """

    time_s: FloatArray
    altitude_m: FloatArray
    velocity_ned_mps: FloatArray
    dcm_ned_body: FloatArray
    specific_force_body_mps2: FloatArray
    velocity_sd_mps: FloatArray
    attitude_sd_rad: FloatArray

    def rows(self, keep: FloatArray) -> AirSamples:
        """Chosen samples."""
        return AirSamples(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Drag:
    """What pushes: coefficients, reference area over mass, and how well coefficients are known (fractions)."""

    table: AeroTable
    area_per_mass_m2pkg: float
    ca_sd: float
    cn_sd: float


@dataclass(frozen=True)
class ReconstructedAir:
    """Air of the day with what was learnt from the flight.

    Parameters
    ----------
    profile : DataFrame
        ``altitude_m``; ``density_ratio`` (to the sounding) and winds north and east, each with ``_sd`` and
        ``_prior_sd``.
    drag : DataFrame
        ``time_s, altitude_m, mach, ratio, ratio_sd``: measured over predicted axial force with the sounding's air.
    parameters : DataFrame
        ``name, unit, prior_sd, estimate, sd`` of coefficient scales, gain and offsets.
    verdicts : tuple of Verdict
    """

    profile: pd.DataFrame
    drag: pd.DataFrame
    parameters: pd.DataFrame
    verdicts: tuple[Verdict, ...]


PARAMETERS = ("C_A scale", "C_N scale", "flexure gain", "offset y", "offset z")
UNITS = ("1", "1", "1", "rad", "rad")


class _Model:
    """Forces as a function of 14 quantities that each sample sees: density, winds, five parameters, six errors."""

    def __init__(self, samples: AirSamples, profile: AtmosphereProfile, drag: Drag) -> None:
        self.samples, self.drag = samples, drag
        self.air = profile.at(samples.altitude_m)
        self.scale = self.forces(np.zeros((len(samples.time_s), 14)), gain=False)[1]

    def forces(self, x: FloatArray, gain: bool = True) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Specific force (n, 3), dynamic pressure (n,), Mach number (n,)."""
        s, air = self.samples, self.air
        wind = air.wind_ned_mps.copy()
        wind[:, :2] += x[:, 1:3] * air.wind_sd_mps[:, None]
        u_ned = s.velocity_ned_mps + x[:, 11:14] * s.velocity_sd_mps[:, None] - wind
        u = np.einsum("nji,nj->ni", s.dcm_ned_body, u_ned)
        u = u + np.cross(u, x[:, 8:11] * s.attitude_sd_rad[:, None])
        speed = np.linalg.norm(u, axis=1)
        q = 0.5 * air.density_kgpm3 * np.exp(x[:, 0] * air.density_sd) * speed**2
        mach = speed / air.sound_speed_mps
        body = lateral_angles(u)
        share = q / self.scale.max() if gain else np.zeros_like(q)
        tilt = (x[:, 5] * share)[:, None] * body + x[:, 6:8]
        flow = body + tilt
        size = np.linalg.norm(flow, axis=1)
        coefficients = self.drag.table.at(mach, np.clip(size, 0.0, np.pi))
        ca, cn = coefficients[:, 0] * np.exp(x[:, 3]), coefficients[:, 1] * np.exp(x[:, 4])
        direction = flow / np.maximum(size, 1e-12)[:, None]
        push = (q * self.drag.area_per_mass_m2pkg)[:, None]
        lateral = -cn[:, None] * direction + ca[:, None] * tilt
        return push * np.column_stack([-ca, lateral]), q, mach

    def linearised(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Forces (n, 3) and partials (n, 3, 14), central differences."""
        step = 1e-4
        partials = np.empty((len(x), 3, 14))
        for j in range(14):
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


def _process_information(knots: FloatArray, length: float) -> FloatArray:
    """Inverse covariance (k, k) of an exponentially correlated process of unit variance on knots."""
    return np.asarray(np.linalg.inv(np.exp(-np.abs(knots[:, None] - knots[None, :]) / length)))


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
        Where the air never pushes hard enough for `LEAST_SAMPLES` windows.
    """
    keep = -samples.specific_force_body_mps2[:, 0] >= LEAST_AXIAL_MPS2
    if keep.sum() < LEAST_SAMPLES:
        raise GateError(
            f"air: {int(keep.sum())} windows with a deceleration above {LEAST_AXIAL_MPS2} m/s^2; "
            f"{LEAST_SAMPLES} are the least from which density and winds can be learnt"
        )
    samples = samples.rows(keep)
    model = _Model(samples, profile, drag)
    height, moment = _knots(samples.altitude_m, KNOT_M), _knots(samples.time_s, KNOT_S)
    by_height, by_time = _interpolation(samples.altitude_m, height), _interpolation(samples.time_s, moment)
    prior_sd = np.array([drag.ca_sd, drag.cn_sd, GAIN_SD, OFFSET_SD_RAD, OFFSET_SD_RAD])
    blocks = [by_height] * 3 + [np.tile(sd, (len(samples.time_s), 1)) for sd in prior_sd] + [by_time] * 6
    information = [_process_information(height, DENSITY_LENGTH_M), *[_process_information(height, WIND_LENGTH_M)] * 2]
    information += [np.eye(1)] * 5 + [_process_information(moment, TRAJECTORY_TIME_S)] * 6
    estimate, covariance, residual = _least_squares(model, blocks, information)
    return _product(model, height, prior_sd, estimate, covariance, residual, confidence)


def _least_squares(
    model: _Model, blocks: list[FloatArray], information: list[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normalised unknowns (u,), their covariance, and residuals (n, 3) in standard deviations."""
    from scipy.linalg import block_diag, cho_factor, cho_solve

    prior = block_diag(*information)
    x = np.zeros(len(prior))
    edges = np.cumsum([0, *(b.shape[1] for b in blocks)])
    measured = model.samples.specific_force_body_mps2
    sd = np.hypot(MODEL_FLOOR_MPS2, np.array([MODEL_PART, LATERAL_PART, LATERAL_PART]) * np.abs(measured[:, :1]))
    for _ in range(MOST_STEPS):
        local = np.column_stack([b @ x[i:j] for b, i, j in zip(blocks, edges[:-1], edges[1:], strict=True)])
        force, partials = model.linearised(local)
        residual = (measured - force) / sd
        jacobian = np.concatenate(
            [(partials[:, :, k] / sd)[:, :, None] * b[:, None, :] for k, b in enumerate(blocks)], axis=2
        ).reshape(-1, len(x))
        factor = cho_factor(jacobian.T @ jacobian + prior)
        step = cho_solve(factor, jacobian.T @ residual.ravel() - prior @ x)
        x = x + step
        covariance = cho_solve(factor, np.eye(len(x)))
        if np.abs(step / np.sqrt(np.diag(covariance))).max() < SETTLED_SD:
            break
    return x, covariance, residual


def _product(
    model: _Model,
    height: FloatArray,
    prior_sd: FloatArray,
    estimate: FloatArray,
    covariance: FloatArray,
    residual: FloatArray,
    confidence: float,
) -> ReconstructedAir:
    """Tables and verdicts."""
    k = len(height)
    sd = np.sqrt(np.diag(covariance))
    there = profile_sd(model, height)
    density, north, east = (slice(i * k, (i + 1) * k) for i in range(3))
    ratio = np.exp(estimate[density] * there[0])
    profile = pd.DataFrame(
        {
            "altitude_m": height,
            "density_ratio": ratio,
            "density_ratio_sd": ratio * sd[density] * there[0],
            "density_ratio_prior_sd": there[0],
            "wind_north_change_mps": estimate[north] * there[1],
            "wind_north_sd_mps": sd[north] * there[1],
            "wind_east_change_mps": estimate[east] * there[1],
            "wind_east_sd_mps": sd[east] * there[1],
            "wind_prior_sd_mps": there[1],
        }
    )
    own = slice(3 * k, 3 * k + 5)
    parameters = pd.DataFrame(
        {
            "name": PARAMETERS,
            "unit": UNITS,
            "prior_sd": prior_sd,
            "estimate": estimate[own] * prior_sd,
            "sd": sd[own] * prior_sd,
        }
    )
    s = model.samples
    force, q, mach = model.forces(np.zeros((len(s.time_s), 14)))
    drag = pd.DataFrame(
        {
            "time_s": s.time_s,
            "altitude_m": s.altitude_m,
            "mach": mach,
            "dynamic_pressure_pa": q,
            "ratio": s.specific_force_body_mps2[:, 0] / force[:, 0],
            "ratio_sd": np.hypot(MODEL_PART, MODEL_FLOOR_MPS2 / np.abs(force[:, 0])),
        }
    )
    verdicts = []
    for name, part, unit in (("density", density, "km"), ("wind north", north, "km"), ("wind east", east, "km")):
        names = [f"{name} at {h / 1000:.0f} {unit}" for h in height]
        verdicts.append(sheet_verdict("sounding", names, estimate[part], np.ones(k), sd[part], confidence))
    # C_N is not judged: a shell that bends changes the normal force as a wrong C_N does
    axial = ["pre-flight C_A scale"]
    verdicts.append(sheet_verdict("coefficients", axial, estimate[own][:1], np.ones(1), sd[own][:1], confidence))
    return ReconstructedAir(profile, drag, parameters, tuple(v for v in verdicts if v is not None))


def profile_sd(model: _Model, height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Standard deviations of density's logarithm and of winds at the knots (k,), as the samples saw them."""
    order = np.argsort(model.samples.altitude_m)
    at = model.samples.altitude_m[order]
    return (
        np.interp(height, at, model.air.density_sd[order]),
        np.interp(height, at, model.air.wind_sd_mps[order]),
    )
