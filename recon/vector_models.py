"""What does an attitude make a magnetometer and a Sun head measure, and how does that change with attitude and errors?

With the attitude ``C = dcm_eci_body`` and the nominal mounting ``D`` of a sensor

    magnetometer  m = (1 + S) exp(mu)^T D^T (1 + E) C^T (b + f) + beta + drift + noise
    Sun head      (az, el) of exp(mu)^T D^T C^T (s - e up), plus (bias + noise) / (cos el, 1)

in the sensor's own axes: scale ``S`` (diagonal), mount ``mu``, bias ``beta`` (electronics and hard iron), the symmetric
``E`` of the soft iron (body axes), ``f`` what IGRF leaves out (inertial axes, constant), ``e`` the pull of the sunlit
Earth. A Sun sample of age ``tau`` shows what was there ``tau`` before its time. A lag from a knot the attitude is
``q exp(rate lag / 2)``.

`solve_vectors` needs no start: two directions give an attitude in closed form, which the smoother is started from.

References
----------
F. Markley, "Attitude determination using vector observations and the singular value decomposition", J. Astronautical
Sciences 36 (1988) 245. M. Shuster, S. Oh, "Three-axis attitude determination from vector observations", J. Guidance and
Control 4 (1981) 70 (covariance of QUEST).

What do magnetometer and Sun heads see of known directions, block by block, and how may they err?

Samples are averaged in blocks about evenly spaced *knots*; a block's mean stands at its samples' mean time, a *lag*
from its knot. Beside each mean stands what it is of, in inertial axes (in which a free vehicle's rate is steady): the
field of IGRF at the vehicle, or the direction of the Sun. Only the field needs the vehicle's place, and not exactly: it
changes by 25 nT/km at most, 0.03 deg in direction, so a raw radar track is plenty.

Errors are constants over the flight, with standard deviations from the data sheets, and what the sheets leave out
(`Unstated`): what IGRF does, a slowly wandering bias of the magnetometer (straight lines between nodes, Gauss-Markov at
the nodes), the light of the Earth in the Sun heads and the age of a Sun sample. How they act: `recon.vector_models`.

Which attitudes, rates and sensor errors fit all sightings of a flight best, and how well are they known?

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

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.geomagnetism_and_sun import magnetic_field_ecef_t, sun_direction_ecef
from flightmodel.instruments import SunHeads, TriadSpec, direction_from_sun_angles, sun_angles_from_direction
from flightmodel.telemetry import SunRecord, TriadRecord

IntArray = NDArray[np.int64]
Position = Callable[[FloatArray], FloatArray]
MAGNETOMETER, HEADS = "magnetometer", "sun heads"
AXES = ("x", "y", "z")
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # places of a symmetric matrix's six elements
LEAST = 1e-9  # stands for a prior of zero: a fraction, rad or s; and a ten-thousandth of it for tesla
DRIFT_SPACING_S = 60.0


@dataclass(frozen=True)
class Unstated:
    """Standard deviations of what no data sheet states.

    Parameters
    ----------
    field_sd_t : float
        What IGRF leaves out (crust, currents above), per axis, constant over the flight.
    drift_sd_t, drift_time_constant_s : float
        Gauss-Markov wander of the magnetometer's bias, where its data sheet states none.
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


def head_name(index: int) -> str:
    """Name of a Sun head, counted from one as in the columns of its file."""
    return f"sun head {index + 1}"


def error_terms(magnetometer: TriadSpec, sun: SunHeads, unstated: Unstated, start_s: float, end_s: float) -> ErrorTerms:
    """Errors of two data sheets and of what they leave out, over a flight from ``start_s`` to ``end_s``."""
    rows: list[tuple[str, str, str, float]] = []

    def add(instrument: str, kind: str, parts: tuple[str, ...], unit: str, sd: float) -> None:
        least = 1e-4 * LEAST if unit == "T" else LEAST
        rows.extend((f"{instrument} {kind} {part}", instrument, unit, max(sd, least)) for part in parts)

    add(MAGNETOMETER, "bias", AXES, "T", magnetometer.bias_sd)
    add(MAGNETOMETER, "scale", AXES, "1", magnetometer.scale_sd)
    add(MAGNETOMETER, "mount", AXES, "rad", magnetometer.mount_sd_rad)
    add(MAGNETOMETER, "soft iron", tuple(AXES[i] + AXES[j] for i, j in SYMMETRIC), "1", magnetometer.soft_iron_sd)
    add(MAGNETOMETER, "field", AXES, "T", unstated.field_sd_t)
    first = len(rows)
    nodes = np.linspace(start_s, end_s, max(2, int(np.ceil((end_s - start_s) / DRIFT_SPACING_S)) + 1))
    drift, time_constant_s = unstated.drift_sd_t, unstated.drift_time_constant_s
    if magnetometer.bias_wander_sd > 0.0:
        drift, time_constant_s = magnetometer.bias_wander_sd, magnetometer.bias_time_constant_s
    for node in nodes:
        add(MAGNETOMETER, f"drift at {node:.0f} s", AXES, "T", drift)
    for head in range(len(sun.clock_lv_rad)):
        add(head_name(head), "bias", ("az", "el"), "rad", sun.bias_sd_rad)
        add(head_name(head), "mount", AXES, "rad", sun.mount_sd_rad)
    add(HEADS, "earthlight", ("everywhere", "with nadir in field"), "1", unstated.earthlight_sd)
    add(HEADS, "sample", ("age",), "s", unstated.sun_time_sd_s)
    names, instruments, units, sd = zip(*rows, strict=True)
    covariance = np.diag(np.array(sd) ** 2)
    wander = slice(first, first + 3 * len(nodes))
    # nodes that never part would be one, many times
    apart = np.maximum(np.abs(nodes[:, None] - nodes) / time_constant_s, 1e-3 * (1.0 - np.eye(len(nodes))))
    covariance[wander, wander] = sd[first] ** 2 * np.kron(np.exp(-apart), np.eye(3))
    return ErrorTerms(names, instruments, units, covariance, nodes)


@dataclass(frozen=True)
class Sightings:
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
        Of a mean, T; or rad across the line of sight.
    reference_eci : (r, 3) float
        Field, T; or unit vector to the Sun.
    up_eci : (r, 3) float
        Away from the Earth's centre.
    drift : (r, k) float
        Share of each node of the magnetometer's wandering bias; no columns for Sun heads.
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
        """Measured unit vectors ``(r, 3)`` in body axes, the sensor taken as mounted nominally and free of errors."""
        sensor = self.measured if self.is_field else direction_from_sun_angles(self.measured)
        return unit(sensor @ self.dcm_body_sensor.T)

    def take(self, rows: BoolArray, knot: IntArray | None = None) -> Sightings:
        """Some of the rows; ``knot`` holds their new knot numbers, where these change."""
        names = ("lag_s", "measured", "noise_sd", "reference_eci", "up_eci", "drift")
        number = self.knot[rows] if knot is None else knot
        return replace(self, knot=number, **{name: getattr(self, name)[rows] for name in names})


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors ``(..., 3)`` made one long."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def block_means(
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


def sight_magnetometer(
    record: TriadRecord, t0_utc: str, knots_s: FloatArray, step_s: float, position: Position, terms: ErrorTerms
) -> Sightings:
    """Block means of the magnetometer beside IGRF at their places."""
    spec = record.spec
    knot, count, at, field = block_means(record.time_s, record.measured_sensor, knots_s, step_s)
    sd = max(np.hypot(spec.noise_sd, spec.resolution / np.sqrt(12.0)), 1e-4 * LEAST)
    place, turn = position(at), rotations.conjugate(earth.q_ecef_eci(at))
    nodes, sd_of = terms.drift_nodes_s, terms.prior_sd
    # one axis of each kind stands for all; bias and drift turn a direction by their part of the field
    across = np.hypot(sd_of[0], sd_of[15]) / max(float(np.median(np.linalg.norm(field, axis=1))), LEAST)
    return Sightings(
        MAGNETOMETER,
        spec.dcm_body_sensor,
        terms.of(MAGNETOMETER),
        0.0,
        knot,
        at - knots_s[knot],
        field,
        sd / np.sqrt(count),
        rotations.rotate(turn, magnetic_field_ecef_t(place, t0_utc)),
        rotations.rotate(turn, unit(place)),
        np.column_stack([np.interp(at, nodes, share) for share in np.eye(len(nodes))]),
        float(np.linalg.norm([across, sd_of[3], sd_of[6], sd_of[9]])),
    )


def sight_sun(
    record: SunRecord, t0_utc: str, knots_s: FloatArray, step_s: float, position: Position, terms: ErrorTerms
) -> list[Sightings]:
    """Block means of every Sun head that ever sees the Sun."""
    out, spec = [], record.spec
    for head, dcm in enumerate(spec.dcm_body_head):
        seen = direction_from_sun_angles(record.az_el_head_rad[:, head])
        knot, count, at, mean = block_means(record.time_s, seen, knots_s, step_s)
        if len(knot) == 0:
            continue
        turn = rotations.conjugate(earth.q_ecef_eci(at))
        out.append(
            Sightings(
                head_name(head),
                dcm,
                terms.of(head_name(head), HEADS),
                float(np.cos(0.5 * spec.field_rad)),
                knot,
                at - knots_s[knot],
                sun_angles_from_direction(mean),
                max(spec.noise_sd_rad, LEAST) / np.sqrt(count),
                rotations.rotate(turn, sun_direction_ecef(t0_utc, at)),
                rotations.rotate(turn, unit(position(at))),
                np.empty((len(knot), 0)),
                float(np.linalg.norm([spec.bias_sd_rad, spec.mount_sd_rad, *terms.prior_sd[terms.of(HEADS)[:2]]])),
            )
        )
    return out


@dataclass(frozen=True)
class Linear:
    """Residuals (r, c) of a sensor's sightings, and how its prediction changes.

    ``by_knot`` (r, c, 6): with rotation and rate at its knot, body axes; ``by_errors`` (r, c, p): with the errors of
    ``Sightings.terms``.
    """

    residual: FloatArray
    by_knot: FloatArray
    by_errors: FloatArray


def linearise(seen: Sightings, q_eci_body: FloatArray, rate_radps: FloatArray, errors: FloatArray) -> Linear:
    """Residuals and derivatives about attitudes (k, 4), rates (k, 3) in body axes at all knots, and all errors (m,)."""
    own, rate = errors[seen.terms], rate_radps[seen.knot]
    since = seen.lag_s if seen.is_field else seen.lag_s - own[7]
    turn = rotations.exp(rate * since[:, None])
    to_body = rotations.dcm_from_q(rotations.conjugate(rotations.multiply(q_eci_body[seen.knot], turn)))
    residual, by_rotation, by_errors = _field(seen, to_body, own) if seen.is_field else _sun(seen, to_body, own)
    if not seen.is_field:
        by_errors[:, :, 7] = -np.einsum("rij,rj->ri", by_rotation, rate)
    at_knot = by_rotation @ rotations.dcm_from_q(rotations.conjugate(turn))
    return Linear(residual, np.concatenate([at_knot, by_rotation * since[:, None, None]], axis=2), by_errors)


def _mounted(dcm_body_sensor: FloatArray, mount_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sensor-from-body matrix with its mount, and the rotation that a change of the mount's vector causes."""
    k = rotations.skew(mount_rad)
    return (dcm_body_sensor @ rotations.dcm_from_q(rotations.exp(mount_rad))).T, np.eye(3) - 0.5 * k + k @ k / 6.0


def _field(seen: Sightings, dcm_body_eci: FloatArray, own: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual, change with a rotation of the body and with the errors; ``own`` in the order of `error_terms`."""
    bias, scale, mount, iron, extra = own[0:3], own[3:6], own[6:9], own[9:15], own[15:18]
    bent = np.eye(3)
    for (i, j), value in zip(SYMMETRIC, iron, strict=True):
        bent[i, j] += value
        bent[j, i] = bent[i, j]
    to_sensor, turn = _mounted(seen.dcm_body_sensor, mount)
    body = np.einsum("rij,rj->ri", dcm_body_eci, seen.reference_eci + extra)
    turned = body @ (to_sensor @ bent).T
    gain = (1.0 + scale)[:, None] * to_sensor
    by_errors = np.zeros((len(body), 3, len(own)))
    by_errors[:, range(3), range(3)] = 1.0
    by_errors[:, range(3), range(3, 6)] = turned
    by_errors[:, :, 6:9] = (1.0 + scale)[:, None] * (rotations.skew(turned) @ turn)
    for number, (i, j) in enumerate(SYMMETRIC, 9):
        by_errors[:, :, number] = gain[:, i] * body[:, [j]] + (gain[:, j] * body[:, [i]] if i != j else 0.0)
    by_errors[:, :, 15:18] = gain @ bent @ dcm_body_eci
    for node, share in enumerate(seen.drift.T):
        by_errors[:, range(3), range(18 + 3 * node, 21 + 3 * node)] = share[:, None]
    residual = seen.measured - turned * (1.0 + scale) - bias - seen.drift @ own[18:].reshape(-1, 3)
    return residual, gain @ bent @ rotations.skew(body), by_errors


def _sun(seen: Sightings, dcm_body_eci: FloatArray, own: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As `_field`; residuals are across the line of sight, and the derivative with the sample's age is left out."""
    bias, mount, light = own[0:2], own[2:5], own[5:7]
    to_head, turn = _mounted(seen.dcm_body_sensor, mount)
    up = np.einsum("rij,rj->ri", dcm_body_eci, seen.up_eci)
    below = up @ seen.dcm_body_sensor[:, 2] < -seen.edge  # the nadir stands in the head's field
    body = np.einsum("rij,rj->ri", dcm_body_eci, seen.reference_eci) - (light[0] + light[1] * below)[:, None] * up
    head = body @ to_head.T
    az, el = sun_angles_from_direction(head).T
    # across the line of sight, towards growing azimuth and growing elevation
    towards_az = np.stack([np.zeros_like(az), np.cos(az), -np.sin(az)], axis=-1)
    towards_el = np.stack([np.cos(el), -np.sin(el) * np.sin(az), -np.sin(el) * np.cos(az)], axis=-1)
    across = np.stack([towards_az, towards_el], axis=1) / np.linalg.norm(head, axis=1)[:, None, None]
    by_errors = np.zeros((len(body), 2, len(own)))
    by_errors[:, range(2), range(2)] = 1.0
    by_errors[:, :, 2:5] = across @ rotations.skew(head) @ turn
    by_errors[:, :, 5] = -np.einsum("rij,rj->ri", across @ to_head, up)
    by_errors[:, :, 6] = by_errors[:, :, 5] * below[:, None]
    off = seen.measured - np.column_stack([az, el])
    off[:, 0] = np.cos(el) * (np.mod(off[:, 0] + np.pi, 2.0 * np.pi) - np.pi)
    return off - bias, across @ to_head @ rotations.skew(body), by_errors


def solve_vectors(
    direction_body: FloatArray, direction_eci: FloatArray, sd_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Attitudes that fit measured directions best, one time after another (Wahba's problem), with their covariance.

    Parameters
    ----------
    direction_body, direction_eci : (n, m, 3) float
        Unit vectors of ``m`` directions, in body axes and in those that the attitude is against.
    sd_rad : (n, m) float
        Of each direction, per axis across it; infinite for one that is missing.

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
