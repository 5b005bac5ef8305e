"""By how much did the coefficients in flight differ from the preflight table, along Mach number?

Unknown are the deflection's history, every input on which its methods depend (`estimators.fusion`), and in place of one
error of each coefficient its increment along Mach number::

    C_A = C_A,table (1 + d_A(M)),   C_N, C_m alike,   C_mq = C_mq,table + d_mq(M)

at all angles of attack. A priori each increment is a Gaussian process of the variance that the vehicle file states: a
constant and a Gauss-Markov process along the logarithm of the Mach number, which forgets over `SHAPE_LENGTH`; the
vehicle file says which part of the variance the latter has (``ca_shape_part`` and so on). Straight lines join the knots
at which it is sought.

Forces act at the shell, at its own angle of attack. What the methods read of the deflection depends on the
coefficients, so that an increment of C_N or C_m and a deflection are confounded until several readings of the one
deflection, or flow and rates that move while Mach number stays, tell them apart: all are unknowns of one least-squares
problem, solved by Gauss-Newton from the fused answer. As in the fusion, the process of the deflection has no say in the
inputs. The size of C_A is in the force along the shell's axis alone (`estimators.balance.axial_residual`)::

    log(-m f_x / (q S C_A)) = error

where C_A, density and mass are one product: what of it belongs to C_A is told apart by their a priori uncertainties
alone, and the standard deviation has the rest. The covariance is that of all increments at all Mach numbers, with
deflection and other inputs integrated over.

Assumed: errors of coefficients that are factors at all angles of attack (of C_mq a shift), Gaussian; what the other
estimators of the deflection assume.

References
----------
C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", MIT Press 2006, chapter 2.
S. Dutta, R. Braun, "Statistical entry, descent, and landing performance reconstruction of the Mars Science
Laboratory", J. Spacecraft Rockets 51 (2014) 1048 (density and drag are not separable without pressures).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, diags_array

from estimators.balance import Swing, axial_residual
from estimators.deflection_spline import FREE_RADPS2, InputPosterior, Inputs, NormalEquations, Rows, Solution, Spline
from estimators.evidence import Deflection, Evidence, corrected_loads, input_responses, swing_responses
from estimators.fusion import LoadsReader, knots_of, places, shares_of_spans, span_of, whitened
from estimators.loads import FlightLoads
from flightmodel.aerodynamics import AeroTable
from flightmodel.atmosphere import DENSITY_LENGTH_M, unresolved_variance
from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.statistics import KNOTS_A_LENGTH, correlation
from flightmodel.vehicle import Uncertainty, Vehicle

COEFFICIENTS = ("C_A", "C_N", "C_m", "C_mq")
STATED = ("ca", "cn", "cm", "cmq")  # their names in files
# log of the ratio of Mach numbers over which an error of shape forgets: about a flow regime, as in `recon.atmosphere`
SHAPE_LENGTH = float(np.log(2.0))
_KNOT_LOG_MACH = 0.05  # lines between them leave out 1 % of a process's variance
_LEAST_MACH = 0.1  # the logarithm's end: an increment is the same from here to still air
# over which readings of moment and axial force are averaged: about the joint's period, at which their model leaves most
# out, and short against the vehicle's pitching, by which moments and the deflection are told apart
_AVERAGED_S = 0.4
_LEAST_SD = 1e-6  # of a coefficient that is stated to be known, whose response per sd would else be none
_LEAST_FALL_MPS = 1.0  # of a vehicle that flies level, which crosses no knot of the density
# step over its sd, all inputs together: of one alone it adds 2 % to its error
_SETTLED_SD = 0.2
_MOST_STEPS = 12


@dataclass(frozen=True)
class Processes:
    """A priori Gaussian processes of the increments at ``k`` knots of the logarithm of the Mach number.

    Parameters
    ----------
    log_mach : (k,) float
        Rising, evenly.
    stated_sd, shape_part : (4,) float
        Of each coefficient, in order of `COEFFICIENTS`: sd, and the part of the variance that changes with Mach number.
    """

    log_mach: FloatArray
    stated_sd: FloatArray
    shape_part: FloatArray

    @classmethod
    def over(cls, mach: FloatArray, stated: Uncertainty) -> Processes:
        """Processes whose knots reach over Mach numbers (n,), of a vehicle file's uncertainty."""
        first, last = np.floor(np.log(mach.min()) / _KNOT_LOG_MACH), np.ceil(np.log(mach.max()) / _KNOT_LOG_MACH)
        return cls(
            _KNOT_LOG_MACH * np.arange(first, max(last, first + 1.0) + 1.0),
            np.array([getattr(stated, name) for name in STATED]),
            np.array([getattr(stated, f"{name}_shape_part") for name in STATED]),
        )

    def roots(self) -> FloatArray:
        """Increments (4, k, k + 1) at the knots per unit normal, the first of which is the constant part."""
        shape = np.linalg.cholesky(correlation(self.log_mach, SHAPE_LENGTH))
        constant = np.ones((len(shape), 1))
        return np.array(
            [
                max(float(sd), _LEAST_SD) * np.hstack([np.sqrt(1.0 - part) * constant, np.sqrt(part) * shape])
                for sd, part in zip(self.stated_sd, self.shape_part, strict=True)
            ]
        )

    def weights(self, mach: FloatArray) -> FloatArray:
        """Weights (n, k) of the lines between knots at Mach numbers (n,); the outer knots' beyond them."""
        at = np.clip((np.log(mach) - self.log_mach[0]) / _KNOT_LOG_MACH, 0.0, len(self.log_mach) - 1.0)
        k = np.minimum(at.astype(int), len(self.log_mach) - 2)
        out = np.zeros((len(mach), len(self.log_mach)))
        row = np.arange(len(mach))
        out[row, k], out[row, k + 1] = 1.0 - (at - k), at - k
        return out

    def at(self, mach: FloatArray, increments: FloatArray) -> FloatArray:
        """Mean increments (4, n) at any Mach numbers (n,), given those at the knots (4, k)."""
        log_mach, own = np.log(np.maximum(mach, _LEAST_MACH)), len(self.log_mach)
        out = []
        for part, values in zip(self.shape_part, increments, strict=True):
            joint = correlation(np.concatenate([self.log_mach, log_mach]), SHAPE_LENGTH, 1.0 - part)
            # singular where no part of the variance changes with Mach number
            out.append(joint[own:, :own] @ np.linalg.lstsq(joint[:own, :own], values)[0])
        return np.array(out)

    def flown(self, table: AeroTable, increments: FloatArray) -> AeroTable:
        """Table with the increments (4, k) at the knots applied; the knots become breakpoints of the table."""
        mach = np.union1d(table.mach, np.exp(self.log_mach))
        c = table.at(mach[:, None], table.alpha_rad)
        d = self.at(mach, increments).T[:, None, :]
        c[..., :3] *= 1.0 + d[..., :3]
        c[..., 3] += d[..., 3]
        return replace(table, mach=mach, coefficients=np.ascontiguousarray(c))


@dataclass(frozen=True)
class Increments:
    """Posterior of the increments: of C_A, C_N, C_m fractions of the table's, of C_mq its change.

    Parameters
    ----------
    processes : Processes
    posterior : InputPosterior
        Of the unit normals of the processes, by the coefficients' names, and of all other inputs.
    """

    processes: Processes
    posterior: InputPosterior

    @property
    def mach(self) -> FloatArray:
        """Knots (k,)."""
        return np.exp(self.processes.log_mach)

    def of(self, normals: FloatArray) -> FloatArray:
        """Increments (4, k) at the knots of unit normals (total,) of all inputs."""
        at = self.posterior.place
        parts = [root @ normals[at[name]] for name, root in zip(COEFFICIENTS, self.processes.roots(), strict=True)]
        return np.array(parts)

    @property
    def mean(self) -> FloatArray:
        """Increments (4, k), in order of `COEFFICIENTS`."""
        return self.of(self.posterior.mean)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (4 k, 4 k) of ``mean.ravel()``."""
        knots, at = len(self.processes.log_mach), self.posterior.place
        pick = np.zeros((len(COEFFICIENTS) * knots, len(self.posterior.mean)))
        for k, (name, root) in enumerate(zip(COEFFICIENTS, self.processes.roots(), strict=True)):
            pick[k * knots : (k + 1) * knots, at[name]] = root
        return np.asarray(pick @ self.posterior.covariance @ pick.T)


def estimate_increments(reader: LoadsReader, start: Solution) -> Increments:
    """Increments of all coefficients along the Mach numbers at which the deflection is read.

    Parameters
    ----------
    reader : LoadsReader
        Of the loads by all methods that read them, and of others' readings.
    start : Solution
        Of the fusion.

    Raises
    ------
    DivergenceError
        Where the steps do not settle.
    """
    reader = _instantaneous(reader)
    vehicle, mach = reader.pulse.vehicle, reader.pulse.mach
    processes = Processes.over(mach, vehicle.uncertainty)
    deflection, inputs = start.deflection, _from_factors(processes, start)
    roots, before = processes.roots(), np.inf
    for _ in range(_MOST_STEPS):
        increments = np.array([root @ inputs[name] for name, root in zip(COEFFICIENTS, roots, strict=True)])
        flown = replace(vehicle, aero=processes.flown(vehicle.aero, increments))
        normal = _equations(reader.with_vehicle(flown), deflection, inputs, _Slopes(processes, roots, increments))
        answer = normal.solved(FREE_RADPS2, "aerodynamic increments")
        mean, found = answer.input_posterior.mean, answer.deflection
        step = mean.copy()
        for name, place in normal.place.items():
            step[place] -= inputs.get(name, 0.0)
        moved = float(np.linalg.norm(answer.factor.corner.T @ step))
        if moved < _SETTLED_SD:
            return Increments(processes, answer.input_posterior)
        if moved > 0.5 * before:  # whole steps lead to and fro between two points
            mean, found = mean - 0.5 * step, _halfway(deflection, found)
        deflection, before = found, moved
        inputs = {name: mean[place] for name, place in normal.place.items()}
    raise DivergenceError(
        f"aerodynamic increments: after {_MOST_STEPS} steps they still move by {moved:.2g} sd in all, where "
        f"{_SETTLED_SD:g} are allowed; check the coefficient table and its [uncertainty]",
        code="not-converged",
    )


def _halfway(one: Deflection, other: Deflection) -> Deflection:
    """Mean of two deflections, as a function of times and derivative."""
    return lambda time_s, derivative=0: 0.5 * (one(time_s, derivative) + other(time_s, derivative))


def _instantaneous(reader: LoadsReader) -> LoadsReader:
    """Reader of instantaneous loads, not window means, to second order.

    A mean over a window is too large by half the second derivative times the window's variance: ``h^2 / 3`` of ``h`` to
    both sides, ``(2 h)^2 / 6`` of the difference of two means over ``2 h`` side by side. Of a vehicle that pitches and
    rolls at 1 Hz each this is 2 % of the angular acceleration, whose share of the moment C_m has. The derivatives are
    those of the part that the spline can follow, without the noise.
    """
    even, h = reader.smooth, reader.pulse.half_window_s
    if h == 0.0:
        return reader
    from scipy.interpolate import CubicSpline  # a fifth of a second to import

    variance = {
        "specific_force_body_mps2": h**2 / 3.0,
        "rate_body_radps": h**2 / 3.0,
        "angular_acceleration_body_radps2": (2.0 * h) ** 2 / 6.0,
    }
    change = {
        name: -0.5 * var * CubicSpline(even.time_s, getattr(even, name))(even.time_s, 2)
        for name, var in variance.items()
    }

    def moved(one: FlightLoads) -> FlightLoads:
        return replace(one, **{name: getattr(one, name) + by for name, by in change.items()})

    return replace(reader, pulse=moved(reader.pulse), smooth=moved(even))


def _from_factors(processes: Processes, start: Solution) -> Inputs:
    """Fused inputs, one factor of each coefficient as the processes' unit normals of a constant."""
    inputs = {name: mean for name, (mean, _) in start.inputs.items()}
    for name, root, sd in zip(COEFFICIENTS, processes.roots(), processes.stated_sd, strict=True):
        factor = float(inputs[name][0]) if name in inputs else 0.0
        inputs[name] = np.linalg.lstsq(root, np.full(len(root), sd * factor))[0]
    return inputs


@dataclass(frozen=True)
class _Slopes:
    """Responses to one error of a coefficient as responses to its increment's unit normals along Mach number."""

    processes: Processes
    roots: FloatArray
    increments: FloatArray

    def along(self, by_input: Inputs, mach: FloatArray) -> Inputs:
        """Responses (n, c, j), those to a coefficient (n, c, 1) expanded to its process's unit normals (n, c, k)."""
        weights, out = self.processes.weights(mach), dict(by_input)
        for k, name in enumerate(COEFFICIENTS):
            if name in by_input:
                per_sd = self.roots[k] / max(float(self.processes.stated_sd[k]), _LEAST_SD)
                if name != "C_mq":  # a factor on what is flown, of which the increment is a part
                    per_sd = per_sd / (1.0 + self.increments[k])[:, None]
                out[name] = by_input[name] * (weights @ per_sd)[:, None, :]
        return out


def _equations(reader: LoadsReader, about: Deflection, inputs: Inputs, slopes: _Slopes) -> NormalEquations:
    """Normal equations of the readings and of the axial force, linear about a deflection and inputs."""
    pulse = reader.pulse
    others = {name: x for name, x in inputs.items() if name not in COEFFICIENTS}
    readings: list[Evidence] = []
    for one in reader(others, about):
        mach = np.exp(np.interp(one.time_s, pulse.time_s, np.log(pulse.mach)))
        by_input = slopes.along(one.by_input, mach)
        readings.append(replace(one, by_input=by_input, averaged_s=min(one.averaged_s, _AVERAGED_S)))
    spline = Spline.over(*span_of(readings), knots_of(pulse))
    axial = _axial_reading(reader, about, others, spline)
    by_input = slopes.along(axial.by_input, pulse.mach)
    # a coefficient that nothing depends on, as one that is stated to be known, has its place too
    every = {name: np.empty((0, 1, slopes.roots.shape[2])) for name in COEFFICIENTS}
    place = places([every, *(one.by_input for one in readings), by_input])
    parts = [whitened(one, spline, place, inputs) for one in readings]
    return NormalEquations.of_rows(spline, place, [*parts, _axial_rows(axial, by_input, place, inputs, pulse)])


@dataclass(frozen=True)
class _AxialReading:
    """The axial residual, linear: ``by_deflection @ coefficients + by_input @ x = want`` and two errors.

    Parameters
    ----------
    by_deflection : (n, 2 m) float, sparse
        Per coefficient of the deflection's spline.
    by_input : dict of str to (n, 1, k) float
    want : (n,) float
        For inputs counted from where it is linear.
    independent_var, density_density : (n,) float
        Variance of a sample's own error; power density, s, of what the knots of the density's error leave out.
    """

    by_deflection: csr_array
    by_input: Inputs
    want: FloatArray
    independent_var: FloatArray
    density_density: FloatArray


def _axial_reading(reader: LoadsReader, about: Deflection, others: Inputs, spline: Spline) -> _AxialReading:
    """Axial force about a deflection; inputs act on the part that the spline can follow, as in the reader."""
    pulse, swing = reader.pulse, Swing.of(about, reader.pulse.time_s)
    at = corrected_loads(reader.smooth, others)
    base = axial_residual(at.vehicle, swing, at)

    def left(one: FlightLoads = at, of: Vehicle = at.vehicle, moved: Swing = swing) -> FloatArray:
        return axial_residual(of, moved, one)

    by_input, noise = input_responses(left, at, base, -np.ones((len(base), 1, 1)))
    raw, even = (axial_residual(pulse.vehicle, swing, one) for one in (pulse, reader.smooth))
    by_order = list(swing_responses(lambda moved: left(moved=moved), swing, base))
    want = -(base + raw - even)[:, 0]
    for response, order in zip(by_order, swing.orders, strict=True):
        want += np.sum(response[:, 0] * order, axis=1)
    spacing_m = DENSITY_LENGTH_M / KNOTS_A_LENGTH
    part = pulse.dynamic_pressure_sd_pa / pulse.dynamic_pressure_pa
    crossing_s = spacing_m / np.maximum(np.abs(np.gradient(pulse.altitude_m, pulse.time_s)), _LEAST_FALL_MPS)
    left_out = part**2 * unresolved_variance(spacing_m, DENSITY_LENGTH_M) * crossing_s
    by_deflection = spline.responses(pulse.time_s, by_order)
    return _AxialReading(by_deflection, by_input, want, noise[:, 0, 0], left_out)


def _axial_rows(
    axial: _AxialReading, by_input: Inputs, place: dict[str, slice], inputs: Inputs, pulse: FlightLoads
) -> Rows:
    """Rows of the least-squares problem, as `whitened`."""
    want, rows = axial.want.copy(), np.zeros((len(axial.want), max(p.stop for p in place.values())))
    for name, response in by_input.items():
        rows[:, place[name]] = response[:, 0]
        if name in inputs:
            want += response[:, 0] @ inputs[name]
    keep = np.isfinite(want)  # of a force that points forward there is no logarithm
    share = shares_of_spans(pulse.time_s[keep], _AVERAGED_S, pulse.time_s[0])
    var = share.power(2) @ axial.independent_var[keep] + share @ axial.density_density[keep] / _AVERAGED_S
    averaged = diags_array(1.0 / np.sqrt(var)) @ share
    return Rows(averaged @ axial.by_deflection[np.flatnonzero(keep)], averaged @ rows[keep], averaged @ want[keep])
