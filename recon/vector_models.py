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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray
from flightmodel.instruments import sun_angles_from_direction
from recon.vector_sensors import SYMMETRIC, Sightings


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
