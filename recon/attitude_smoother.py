"""Which attitudes, rates and sensor errors fit all magnetometer and Sun readings best, and with what covariance?

Samples are averaged in blocks about evenly spaced *knots*; a block's mean stands at its samples' mean time, a *lag*
from its knot. Sensors are predicted as the filter predicts them (`recon.measurements.magnetometer_model`, `sun_model`)
from two directions in inertial axes, in which a free vehicle's rate is steady: the field of IGRF at the vehicle (which
changes by 25 nT/km at most, 0.03 deg in direction, so a raw radar track is accurate enough) and the Sun's. Besides the
errors of the data sheets there are those that no data sheet states (`UnstatedErrors`): ``f``, the error of IGRF
(inertial axes, constant), a drift of the magnetometer's bias (linear between nodes, Gauss-Markov at the nodes), ``e``,
earthlight in the Sun heads, and the age of a Sun sample. So what is observed is the field ``b + f`` and the Sun ``s - e
up``, both in body axes by ``q exp(rate lag / 2)``.

At every knot an attitude ``q`` and a rate ``w`` (inertial, body axes). Between knots ``dt`` apart the rate is the
integral of white angular acceleration of density ``g``, for which

    w' - w = noise, sd g sqrt(dt);    q' = q exp(dt (w + w') / 4) and noise about it, sd g sqrt(dt^3 / 12)

(to second order in a step's rotation), independent of each other. With the observations and the priors of the sensor
errors this is one least-squares problem, solved by Gauss and Newton: an iterated Kalman smoother. The normal matrix is
a band (knots) with a border (errors), `flightmodel.arrow`.

The density is estimated from the flight, for each body axis and each stretch of `_STRETCH_S`, by MacKay's fixed point
for the maximum of the marginal likelihood, ``g^2 = sum r^2 / gamma``: ``r`` are the estimated steps of the rate over
``sqrt(dt)``, ``gamma`` their number less the part of it that the data leave undetermined.

Errors that multiply the motion (scale, soft iron) need one more term. The most probable motion *and* scale together are
a motion too small and a scale too large. The scale that is most probable with the motion integrated out also includes
the volume of motions that fit, ``-log det(band) / 2``, and is unbiased (Laplace's approximation). `_volume_slope` is
this term's slope.

`solve_vectors` needs no start: two directions give an attitude in closed form, from which the smoother starts.

References
----------
F. Markley, "Attitude determination using vector observations and the singular value decomposition", J. Astronautical
Sciences 36 (1988) 245. M. Shuster, S. Oh, "Three-axis attitude determination from vector observations", J. Guidance and
Control 4 (1981) 70 (covariance of QUEST). B. Bell, SIAM J. Optim. 4 (1994) 626 (smoother as Gauss-Newton). D. MacKay,
"Bayesian interpolation", Neural Computation 4 (1992) 415, section 4. L. Tierney, J. Kadane, J. Amer. Statist. Assoc. 81
(1986) 82 (Laplace's approximation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from flightmodel import earth, rotations
from flightmodel.arrow import Arrow
from flightmodel.checks import BoolArray, FloatArray, IntArray
from flightmodel.geomagnetism_and_sun import magnetic_field_ecef_t, sun_direction_ecef
from flightmodel.instruments import SunHeads, TriadSpec, direction_from_sun_angles, sun_angles_from_direction
from flightmodel.statistics import NORMAL_MAD
from flightmodel.telemetry import SunRecord, TriadRecord
from recon.measurements import SLOTS, magnetometer_model, sun_model
from recon.state import AXES

Position = Callable[[FloatArray], FloatArray]
_MAGNETOMETER, _HEADS = "magnetometer", "sun heads"
_FIELD_SLOTS, _SUN_SLOTS = np.arange(12), np.array([0, 1, 4, 5, 6])  # of `recon.measurements.SLOT_NAMES`
_FIELD_ERROR, _DRIFT = 12, 15  # where these stand among the magnetometer's terms
_AGE = 7  # and the last among a head's, after earthlight's two
_LEAST = 1e-9  # stands for a prior of zero: a fraction, rad or s; and a ten-thousandth of it for tesla
_BLOCK = 6
_ROTATION, _RATE = slice(0, 3), slice(3, 6)
_STRETCH_S = 5.0  # over which the motion is taken as equally rough: a few periods of coning or pitching
_RATE_PRIOR_SD = 10.0  # rad/s: no information, but a knot without neighbours stays solvable
_SMALL_RAD = 1e-5  # of a numerical derivative: its square is rounding
_EDIT_SD, _MOST_EDITED = 5.0, 0.05  # of white noise one in two million; more are no outliers


@dataclass(frozen=True)
class UnstatedErrors:
    """Standard deviations of what no data sheet states.

    Parameters
    ----------
    field_sd_t : float
        What IGRF leaves out (crust, currents above), per axis, constant over the flight.
    drift_sd_t, drift_time_constant_s : float
        Gauss-Markov drift of the magnetometer's bias, where its data sheet states none.
    earthlight_sd : float
        Weight of the Earth against the Sun in a head, at the nadir; twice, once for all heads and once for those that
        have the nadir in their field.
    sun_time_sd_s : float
        Age of a Sun sample at its time tag, against the magnetometer's.
    """

    field_sd_t: float = 1e-7
    drift_sd_t: float = 5e-8
    drift_time_constant_s: float = 100.0
    earthlight_sd: float = 0.01
    sun_time_sd_s: float = 0.005


@dataclass(frozen=True)
class ErrorTerms:
    """Errors of magnetometer and Sun heads: name, instrument and unit of each, and their prior covariance (m, m)."""

    names: tuple[str, ...]
    instruments: tuple[str, ...]
    units: tuple[str, ...]
    covariance: FloatArray
    drift_nodes_s: FloatArray

    @property
    def size(self) -> int:
        """Number of errors."""
        return len(self.names)

    @property
    def prior_sd(self) -> FloatArray:
        """Prior standard deviation of every error, (m,)."""
        return np.sqrt(np.diagonal(self.covariance))

    def of(self, *instruments: str) -> IntArray:
        """Where the errors of some instruments stand, in the order asked for."""
        return np.array([i for wanted in instruments for i, owner in enumerate(self.instruments) if owner == wanted])


def _head_name(index: int) -> str:
    """Name of a Sun head, counted from one as in the columns of its file."""
    return f"sun head {index + 1}"


def error_terms(magnetometer: TriadSpec, sun: SunHeads, start_s: float, end_s: float) -> ErrorTerms:
    """Errors of two data sheets and of what they leave out, over a flight from ``start_s`` to ``end_s``."""
    unstated, rows = UnstatedErrors(), list[tuple[str, str, str, float]]()

    def add(instrument: str, kind: str, parts: tuple[str, ...], unit: str, sd: float) -> None:
        least = 1e-4 * _LEAST if unit == "T" else _LEAST
        rows.extend((f"{instrument} {kind} {part}", instrument, unit, max(sd, least)) for part in parts)

    add(_MAGNETOMETER, "bias", AXES, "T", magnetometer.bias_sd)
    # the diagonal of the soft iron is one with the scale
    add(_MAGNETOMETER, "scale", AXES, "1", float(np.hypot(magnetometer.scale_sd, magnetometer.soft_iron_sd)))
    add(_MAGNETOMETER, "mount", AXES, "rad", magnetometer.mount_sd_rad)
    add(_MAGNETOMETER, "soft iron", ("xy", "xz", "yz"), "1", magnetometer.soft_iron_sd)
    add(_MAGNETOMETER, "field", AXES, "T", unstated.field_sd_t)
    first = len(rows)
    # temperature, and with it the magnetometer's bias, changes in minutes
    nodes = np.linspace(start_s, end_s, max(2, int(np.ceil((end_s - start_s) / 60.0)) + 1))
    drift, time_constant_s = unstated.drift_sd_t, unstated.drift_time_constant_s
    if magnetometer.bias_wander_sd > 0.0:
        drift, time_constant_s = magnetometer.bias_wander_sd, magnetometer.bias_time_constant_s
    for node in nodes:
        add(_MAGNETOMETER, f"drift at {node:.0f} s", AXES, "T", drift)
    for head in range(len(sun.clock_lv_rad)):
        add(_head_name(head), "bias", ("az", "el"), "rad", sun.bias_sd_rad)
        add(_head_name(head), "mount", AXES, "rad", sun.mount_sd_rad)
    add(_HEADS, "earthlight", ("everywhere", "with nadir in field"), "1", unstated.earthlight_sd)
    add(_HEADS, "sample", ("age",), "s", unstated.sun_time_sd_s)
    names, instruments, units, sd = zip(*rows, strict=True)
    covariance = np.diag(np.array(sd) ** 2)
    drifts = slice(first, first + 3 * len(nodes))
    # nodes of an infinite time constant would make the covariance singular
    separation = np.maximum(np.abs(nodes[:, None] - nodes) / time_constant_s, 1e-3 * (1.0 - np.eye(len(nodes))))
    covariance[drifts, drifts] = sd[first] ** 2 * np.kron(np.exp(-separation), np.eye(3))
    return ErrorTerms(names, instruments, units, covariance, nodes)


@dataclass(frozen=True)
class VectorObservations:
    """Block means of one sensor, at most one a knot.

    Parameters
    ----------
    name : str
        ``"magnetometer"`` or that of a Sun head.
    dcm_body_sensor : (3, 3) float
        Nominal mounting.
    terms : (p,) int
        Which of the `ErrorTerms` it has, in the order in which its model takes them.
    edge : float
        Cosine of the angle from a head's axis to the edge of its field; of no meaning for the magnetometer.
    knot : (r,) int
    lag_s : (r,) float
        From the knot to the samples' mean time.
    measured : (r, 3) or (r, 2) float
        Field in sensor axes, T; or azimuth and elevation in the head's, rad.
    noise_sd : (r,) float
        Of a mean, T; or rad normal to the line of sight.
    reference_eci : (r, 3) float
        Field, T; or unit vector to the Sun.
    up_eci : (r, 3) float
        Away from the Earth's centre.
    drift : (r, k) float
        Share of each node of the magnetometer's drifting bias; no columns for Sun heads.
    constant_sd_rad : float
        Of a direction by all constant errors together, per axis.
    """

    name: str
    dcm_body_sensor: FloatArray
    terms: IntArray
    edge: float
    knot: IntArray
    lag_s: FloatArray
    measured: FloatArray
    noise_sd: FloatArray
    reference_eci: FloatArray
    up_eci: FloatArray
    drift: FloatArray
    constant_sd_rad: float

    @property
    def is_field(self) -> bool:
        """Whether the sensor is the magnetometer."""
        return self.measured.shape[1] == 3

    def directions_body(self) -> FloatArray:
        """Measured unit vectors ``(r, 3)`` in body axes, assuming nominal mounting and no sensor errors."""
        sensor = self.measured if self.is_field else direction_from_sun_angles(self.measured)
        return unit(sensor @ self.dcm_body_sensor.T)

    def take(self, rows: BoolArray, number: IntArray) -> VectorObservations:
        """Some of the rows, with new ``number`` of their knots."""
        names = ("lag_s", "measured", "noise_sd", "reference_eci", "up_eci", "drift")
        return replace(self, knot=number, **{name: getattr(self, name)[rows] for name in names})


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors ``(..., 3)`` made one long."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _block_means(
    time_s: FloatArray, values: FloatArray, knots_s: FloatArray, step_s: float
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Means of complete samples by nearest knot.

    Parameters
    ----------
    time_s : (n,) float
    values : (n, m) float
        Rows with NaN are left out.
    knots_s : (k,) float
        Evenly spaced by ``step_s``.

    Returns
    -------
    knot, count : (r,) int
        Knots that have samples, and how many.
    mean_time_s : (r,) float
    means : (r, m) float
    """
    number = np.round((time_s - knots_s[0]) / step_s).astype(int)
    good = np.isfinite(values).all(axis=1) & (number >= 0) & (number < len(knots_s))
    number, size = number[good], len(knots_s)
    count = np.bincount(number, minlength=size)
    knot = np.flatnonzero(count)
    # against the knot, so that a time keeps its digits
    columns = (time_s[good] - knots_s[number], *values[good].T)
    sums = [np.bincount(number, weights=column, minlength=size)[knot] for column in columns]
    means = np.column_stack(sums) / count[knot, None]
    return knot, count[knot], knots_s[knot] + means[:, 0], means[:, 1:]


def observe_magnetometer(
    record: TriadRecord, t0_utc: str, knots_s: FloatArray, step_s: float, position: Position, terms: ErrorTerms
) -> VectorObservations:
    """Block means of the magnetometer beside IGRF at their places."""
    spec = record.spec
    knot, count, at, field = _block_means(record.time_s, record.measured_sensor, knots_s, step_s)
    sd = max(np.hypot(spec.noise_sd, spec.resolution / np.sqrt(12.0)), 1e-4 * _LEAST)
    place, turn = position(at), rotations.conjugate(earth.q_ecef_eci(at))
    nodes, sd_of = terms.drift_nodes_s, terms.prior_sd
    # one axis of each kind stands for all; bias and field error rotate a direction by their part of the field
    angle = np.hypot(sd_of[0], sd_of[_FIELD_ERROR]) / max(float(np.median(np.linalg.norm(field, axis=1))), _LEAST)
    reference, up = (rotations.rotate(turn, x) for x in (magnetic_field_ecef_t(place, t0_utc), unit(place)))
    drift = np.column_stack([np.interp(at, nodes, share) for share in np.eye(len(nodes))])
    constant = float(np.linalg.norm([angle, sd_of[3], sd_of[6], sd_of[9]]))
    return VectorObservations(
        _MAGNETOMETER, spec.dcm_body_sensor, terms.of(_MAGNETOMETER), 0.0, knot, at - knots_s[knot], field,
        sd / np.sqrt(count), reference, up, drift, constant,
    )  # fmt: skip


def observe_sun(
    record: SunRecord, t0_utc: str, knots_s: FloatArray, step_s: float, position: Position, terms: ErrorTerms
) -> list[VectorObservations]:
    """Block means of every Sun head that ever has the Sun in its field."""
    out, spec, edge = [], record.spec, float(np.cos(0.5 * record.spec.field_rad))
    shared = terms.prior_sd[terms.of(_HEADS)[:2]]
    constant = float(np.linalg.norm([spec.bias_sd_rad, spec.mount_sd_rad, *shared]))
    for head, dcm in enumerate(spec.dcm_body_head):
        observed = direction_from_sun_angles(record.az_el_head_rad[:, head])
        knot, count, at, mean = _block_means(record.time_s, observed, knots_s, step_s)
        if len(knot) == 0:
            continue
        name, turn = _head_name(head), rotations.conjugate(earth.q_ecef_eci(at))
        reference, up = (rotations.rotate(turn, x) for x in (sun_direction_ecef(t0_utc, at), unit(position(at))))
        noise_sd = max(spec.noise_sd_rad, _LEAST) / np.sqrt(count)
        out.append(VectorObservations(
            name, dcm, terms.of(name, _HEADS), edge, knot, at - knots_s[knot], sun_angles_from_direction(mean),
            noise_sd, reference, up, np.empty((len(knot), 0)), constant,
        ))  # fmt: skip
    return out


@dataclass(frozen=True)
class Linear:
    """Residuals (r, c) of a sensor's observations, and how its prediction changes.

    ``by_knot`` (r, c, 6): with rotation and rate at its knot, body axes; ``by_errors`` (r, c, p): with the errors of
    ``VectorObservations.terms``.
    """

    residual: FloatArray
    by_knot: FloatArray
    by_errors: FloatArray


def linearise(
    observed: VectorObservations, q_eci_body: FloatArray, rate_radps: FloatArray, errors: FloatArray
) -> Linear:
    """Residuals and derivatives about attitudes (k, 4), rates (k, 3) in body axes at all knots, and all errors (m,)."""
    own, rate = errors[observed.terms], rate_radps[observed.knot]
    since = observed.lag_s if observed.is_field else observed.lag_s - own[_AGE]
    turn = rotations.exp(rate * since[:, None])
    dcm_body_eci = rotations.dcm_from_q(rotations.conjugate(rotations.multiply(q_eci_body[observed.knot], turn)))
    linear = _magnetometer if observed.is_field else _sun_head
    residual, body, by_body, by_errors = linear(observed, dcm_body_eci, own)
    by_rotation = by_body @ rotations.skew(body)
    if not observed.is_field:
        by_errors[:, :, _AGE] = -np.einsum("rij,rj->ri", by_rotation, rate)
    at_knot = by_rotation @ rotations.dcm_from_q(rotations.conjugate(turn))
    return Linear(residual, np.concatenate([at_knot, by_rotation * since[:, None, None]], axis=2), by_errors)


def _magnetometer(
    observed: VectorObservations, dcm_body_eci: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residual (r, 3), field in body axes (r, 3), partials by it and by the errors ``own`` (p,) of `error_terms`."""
    body = np.einsum("rij,rj->ri", dcm_body_eci, observed.reference_eci + own[_FIELD_ERROR:_DRIFT])
    e = np.zeros((len(body), SLOTS))
    e[:, _FIELD_SLOTS] = own[:_FIELD_ERROR]
    e[:, 0:3] += observed.drift @ own[_DRIFT:].reshape(-1, 3)
    predicted, by_body, by_slot = magnetometer_model(observed.dcm_body_sensor, body, e)
    by_drift = np.einsum("rk,ij->rikj", observed.drift, np.eye(3)).reshape(len(body), 3, -1)
    by_errors = np.concatenate([by_slot[:, :, _FIELD_SLOTS], by_body @ dcm_body_eci, by_drift], axis=2)
    return observed.measured - predicted, body, by_body, by_errors


def _sun_head(
    observed: VectorObservations, dcm_body_eci: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `_magnetometer`; residuals (r, 2) are normal to the line of sight, the derivative by the age is left out."""
    e = np.zeros(SLOTS)
    e[_SUN_SLOTS] = own[: len(_SUN_SLOTS)]
    up = np.einsum("rij,rj->ri", dcm_body_eci, observed.up_eci)
    below = up @ observed.dcm_body_sensor[:, 2] < -observed.edge  # the nadir is in the head's field
    light = np.column_stack([np.ones(len(up)), below]) @ own[5:_AGE]
    body = np.einsum("rij,rj->ri", dcm_body_eci, observed.reference_eci) - light[:, None] * up
    size = np.linalg.norm(body, axis=1)
    body = unit(body)
    predicted, by_body, by_slot = sun_model(observed.dcm_body_sensor, body, e)
    by_light = -np.einsum("rij,rj->ri", by_body, up) / size[:, None]
    by_errors = np.concatenate(
        [by_slot[:, :, _SUN_SLOTS], by_light[:, :, None], (by_light * below[:, None])[:, :, None],
         np.zeros((len(up), 2, 1))], axis=2,
    )  # fmt: skip
    off = observed.measured - predicted
    off[:, 0] = np.mod(off[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    # an error of azimuth is worth less the nearer the Sun stands to the head's x axis
    scale = np.ones((len(up), 2))
    scale[:, 0] = np.cos(predicted[:, 1])
    return scale * off, body, scale[:, :, None] * by_body, scale[:, :, None] * by_errors


def solve_vectors(
    direction_body: FloatArray, direction_eci: FloatArray, sd_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Attitudes that fit measured directions best, at each time (Wahba's problem), with their covariance.

    Parameters
    ----------
    direction_body, direction_eci : (n, m, 3) float
        Unit vectors of ``m`` directions, in body axes and in those that the attitude is against.
    sd_rad : (n, m) float
        Of each direction, per axis normal to it; infinite for one that is missing.

    Returns
    -------
    q_eci_body : (n, 4) float
    covariance : (n, 3, 3) float
        Of the rotation in body axes, rad^2; no angle is taken as worse known than pi.

    Notes
    -----
    Markley: with ``sum w_i v_i^T / sd_i^2 = U S V^T`` (``w`` body, ``v`` eci) the matrix to body is
    ``U diag(1, 1, det U det V) V^T``. Shuster and Oh: ``P^-1 = sum (1 - w_i w_i^T) / sd_i^2``.
    """
    weight = sd_rad**-2.0
    left, _, right = np.linalg.svd(np.einsum("nm,nmi,nmj->nij", weight, direction_body, direction_eci))
    left[:, :, 2] *= (np.linalg.det(left) * np.linalg.det(right))[:, None]
    q = rotations.q_from_dcm(np.swapaxes(left @ right, 1, 2))
    along = np.einsum("nm,nmi,nmj->nij", weight, direction_body, direction_body)
    known, axes = np.linalg.eigh(weight.sum(axis=1)[:, None, None] * np.eye(3) - along)
    return q, (axes / np.maximum(known, np.pi**-2)[:, None, :]) @ np.swapaxes(axes, 1, 2)


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
    """State of the fit during the iterations, and its final results.

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
        Of rotation and rate, with the sensor errors' covariance.
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
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, _BLOCK, _BLOCK)))
    error_covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    misfit: dict[str, tuple[float, float]] = field(default_factory=dict)
    steps: int = 0
    converged: bool = False


def smooth(
    knots: Knots, observations: list[VectorObservations], terms: ErrorTerms, q_eci_body: FloatArray
) -> tuple[Fit, list[VectorObservations]]:
    """Fit of all observations, started at attitudes ``(n, 4)``; also the observations that were kept.

    Blocks further than `_EDIT_SD` from the fit are edited and the rest fitted again, unless they are more than
    `_MOST_EDITED` of a sensor's: then they are no outliers, and the misfit is large.
    """
    turn = np.where(knots.linked[:, None], rotations.boxminus(q_eci_body[1:], q_eci_body[:-1]) / knots.step_s, 0.0)
    rate = 0.5 * (np.vstack([turn[:1], turn]) + np.vstack([turn, turn[-1:]])) if len(turn) else np.zeros((1, 3))
    fit = Fit(q_eci_body, rate, np.zeros(terms.size), np.full((len(turn), 3), 0.05))
    _iterate(fit, knots, observations, terms)
    kept = [_edited(observed, fit) for observed in observations]
    if any(len(few.knot) < len(all_.knot) for few, all_ in zip(kept, observations, strict=True)):
        _iterate(fit, knots, kept, terms)
    return fit, kept


def _iterate(fit: Fit, knots: Knots, observations: list[VectorObservations], terms: ErrorTerms) -> None:
    """Gauss-Newton steps, first with the densities estimated too, then with these kept, to convergence."""
    slope = np.zeros(terms.size)
    estimate_density = True
    for fit.steps in range(1, 31):
        linear = [linearise(observed, fit.q_eci_body, fit.rate_radps, fit.errors) for observed in observations]
        arrow, right = _normal(fit, knots, observations, linear, terms)
        right[-terms.size :] -= slope
        factor = arrow.factor()
        own, next_by_own = factor.inverse_blocks(_BLOCK)
        gain, fit.error_covariance = factor.gain.reshape(-1, _BLOCK, terms.size), factor.border_covariance
        for observed, line in zip(observations, linear, strict=True):
            if estimate_density and observed.is_field:
                slope[observed.terms] = _volume_slope(observed, line, fit, own)
        of_knots, of_errors = np.split(factor.solve(right), [-terms.size])
        step = of_knots.reshape(-1, _BLOCK)
        fit.q_eci_body = rotations.boxplus(fit.q_eci_body, step[:, _ROTATION])
        fit.rate_radps = fit.rate_radps + step[:, _RATE]
        fit.errors = fit.errors + of_errors
        moved = float(np.abs(step[:, _ROTATION]).max())
        fit.converged = not estimate_density and moved < 1e-6  # rad: rounding
        if fit.converged:
            break
        if estimate_density:
            _update_density(fit, knots, own, next_by_own, gain)
            estimate_density = fit.steps < 12 and moved > 5e-4  # rad: 0.03 deg
    cross = gain @ fit.error_covariance
    fit.covariance = own + cross @ np.swapaxes(gain, 1, 2)
    fit.misfit = {
        observed.name: _misfit(observed, line, fit, cross) for observed, line in zip(observations, linear, strict=True)
    }


def _normal(
    fit: Fit, knots: Knots, observations: list[VectorObservations], linear: list[Linear], terms: ErrorTerms
) -> tuple[Arrow, FloatArray]:
    """Normal equations of a step, the knots' unknowns first, then the errors', and their right-hand side."""
    n, m = len(knots.time_s), terms.size
    diagonal, border, knot_side = np.zeros((n, _BLOCK, _BLOCK)), np.zeros((n, _BLOCK, m)), np.zeros((n, _BLOCK))
    diagonal[:, range(3, 6), range(3, 6)] = _RATE_PRIOR_SD**-2.0
    knot_side[:, _RATE] = -fit.rate_radps * _RATE_PRIOR_SD**-2.0
    errors: FloatArray = np.asarray(np.linalg.inv(terms.covariance), dtype=float)
    error_side = -errors @ fit.errors
    for observed, line in zip(observations, linear, strict=True):
        weight = observed.noise_sd[:, None, None] ** -2.0
        weighted = np.swapaxes(line.by_knot, 1, 2) * weight
        diagonal[observed.knot] += weighted @ line.by_knot
        knot_side[observed.knot] += (weighted @ line.residual[:, :, None])[:, :, 0]
        border[observed.knot[:, None], :, observed.terms] += np.swapaxes(weighted @ line.by_errors, 1, 2)
        late = line.by_errors * weight
        errors[np.ix_(observed.terms, observed.terms)] += np.tensordot(late, line.by_errors, ((0, 1), (0, 1)))
        error_side[observed.terms] += np.einsum("rij,ri->j", late, line.residual)

    residual, early, late = _links(fit, knots)
    var = fit.density**2 * np.where(knots.linked, knots.step_s, np.inf)[:, None]
    weight = np.concatenate([12.0 / (var * knots.step_s**2), 1.0 / var], axis=1)[:, None, :]
    early_weighted, late_weighted = np.swapaxes(early, 1, 2) * weight, np.swapaxes(late, 1, 2) * weight
    diagonal[:-1] += early_weighted @ early
    diagonal[1:] += late_weighted @ late
    knot_side[:-1] -= (early_weighted @ residual[:, :, None])[:, :, 0]
    knot_side[1:] -= (late_weighted @ residual[:, :, None])[:, :, 0]
    arrow = Arrow.of_blocks(diagonal, late_weighted @ early, border.reshape(-1, m), errors)
    return arrow, np.concatenate([knot_side.ravel(), error_side])


def _links(fit: Fit, knots: Knots) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n - 1, 6) of the motion's model and their derivatives with the earlier and the later knot."""
    q, w, dt = fit.q_eci_body, fit.rate_radps, knots.step_s
    turn = 0.5 * dt * (w[1:] + w[:-1])
    off = rotations.boxminus(q[1:], rotations.boxplus(q[:-1], turn))
    skewed = rotations.skew(turn)
    by_rate = -0.5 * dt * (np.eye(3) - 0.5 * skewed + skewed @ skewed / 6.0)
    early, late = np.zeros((len(turn), _BLOCK, _BLOCK)), np.zeros((len(turn), _BLOCK, _BLOCK))
    early[:, _ROTATION, _ROTATION] = -rotations.dcm_from_q(rotations.multiply(rotations.conjugate(q[1:]), q[:-1]))
    late[:, _ROTATION, _ROTATION] = np.eye(3) + 0.5 * rotations.skew(off)
    early[:, _ROTATION, _RATE] = late[:, _ROTATION, _RATE] = by_rate
    early[:, _RATE, _RATE], late[:, _RATE, _RATE] = -np.eye(3), np.eye(3)
    return np.hstack([off, w[1:] - w[:-1]]), early, late


def _volume_slope(observed: VectorObservations, line: Linear, fit: Fit, own: FloatArray) -> FloatArray:
    """Derivative of half the band's log-determinant by a sensor's errors, (p,); ``own`` (n, 6, 6): the band's inverse.

    The change of a derivative with an error is that of the error's derivative with a rotation, taken by difference.
    """
    weighted = line.by_knot[:, :, _ROTATION] @ own[observed.knot][:, _ROTATION, _ROTATION]
    weighted /= observed.noise_sd[:, None, None] ** 2
    slope = np.zeros(len(observed.terms))
    for axis, turn in enumerate(_SMALL_RAD * np.eye(3)):
        turned = linearise(observed, rotations.boxplus(fit.q_eci_body, turn), fit.rate_radps, fit.errors)
        slope += np.tensordot(weighted[:, :, axis], (turned.by_errors - line.by_errors) / _SMALL_RAD, 2)
    return slope


def _update_density(fit: Fit, knots: Knots, own: FloatArray, next_by_own: FloatArray, gain: FloatArray) -> None:
    """Move the densities towards where they agree with the estimated rates.

    Given the knots' covariance (n, 6, 6) with the errors known, that of each with the one before (n - 1, 6, 6), and how
    the knots change with the errors (n, 6, m).

    Downwards twice as far as the fixed point's step, which is slow there where the data contain little information.
    """
    linked = knots.linked[:, None]
    rate_var, cross = (np.diagonal(x[:, _RATE, _RATE], axis1=1, axis2=2) for x in (own, next_by_own))
    by_errors = np.diff(gain[:, _RATE], axis=0)
    undetermined = rate_var[1:] + rate_var[:-1] - 2.0 * cross
    undetermined += np.sum((by_errors @ fit.error_covariance) * by_errors, axis=2)
    var = fit.density**2 * knots.step_s
    determined = np.where(linked, 1.0 - undetermined / var, 0.0)
    squares = np.where(linked, np.diff(fit.rate_radps, axis=0) ** 2 / var, 0.0)
    stretch = ((knots.time_s[:-1] - knots.time_s[0]) // _STRETCH_S).astype(int)
    for axis in range(3):
        gamma = np.maximum(np.bincount(stretch, weights=determined[:, axis]), 0.0)
        total = np.bincount(stretch, weights=squares[:, axis])
        # half a step at the assumed density, for stretches without information
        factor = ((total + 0.5) / (gamma + 0.5))[stretch]
        moved = fit.density[:, axis] * np.where(factor < 1.0, factor, np.sqrt(factor))
        fit.density[:, axis] = np.clip(moved, 2e-4, 20.0)  # the least is 0.011 deg/s^2 per root hertz


def _misfit(observed: VectorObservations, line: Linear, fit: Fit, cross: FloatArray) -> tuple[float, float]:
    """Sum of squared normalised residuals, and its expected value after the fit."""
    late = np.swapaxes(line.by_errors, 1, 2)
    mixed = line.by_knot @ cross[observed.knot][:, :, observed.terms] @ late
    fitted = line.by_knot @ fit.covariance[observed.knot] @ np.swapaxes(line.by_knot, 1, 2)
    fitted += mixed + np.swapaxes(mixed, 1, 2)
    fitted += line.by_errors @ fit.error_covariance[np.ix_(observed.terms, observed.terms)] @ late
    taken = np.trace(fitted, axis1=1, axis2=2) / observed.noise_sd**2
    squares = np.sum(line.residual**2, axis=1) / observed.noise_sd**2
    return float(squares.sum()), float(np.sum(line.residual.shape[1] - taken))


def _edited(observed: VectorObservations, fit: Fit) -> VectorObservations:
    """Observations without the few that lie far from the fit."""
    line = linearise(observed, fit.q_eci_body, fit.rate_radps, fit.errors)
    off = np.abs(line.residual).max(axis=1) / observed.noise_sd
    far = np.asarray(off > _EDIT_SD * max(1.0, NORMAL_MAD * float(np.median(off))))
    return observed.take(~far, observed.knot[~far]) if 0.0 < far.mean() <= _MOST_EDITED else observed
