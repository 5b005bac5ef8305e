"""How attitudes are written: scalar-first Hamilton quaternions on ``(..., 4)`` arrays.

``q_to_from`` and ``dcm_to_from`` turn the components of a vector: ``v_to = dcm_to_from @ v_from``;
inner names touch, ``q_ned_body = q_ned_ecef * q_ecef_body``. Small rotations are right-hand vectors in the
*from* frame: ``boxplus(q, d) = q * exp(d/2)``.

References
----------
J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, sections 1-4.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray


def _components(values: FloatArray) -> list[FloatArray]:
    values = np.asarray(values, dtype=float)
    return [values[..., k] for k in range(values.shape[-1])]


def multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    """Hamilton product of ``(..., 4)`` quaternions."""
    pw, px, py, pz = _components(p)
    qw, qx, qy, qz = _components(q)
    w = pw * qw - px * qx - py * qy - pz * qz
    out = np.empty((*w.shape, 4))
    out[..., 0] = w
    out[..., 1] = pw * qx + px * qw + py * qz - pz * qy
    out[..., 2] = pw * qy - px * qz + py * qw + pz * qx
    out[..., 3] = pw * qz + px * qy - py * qx + pz * qw
    return out


def conjugate(q: FloatArray) -> FloatArray:
    """Inverse of unit quaternions: ``q_from_to`` from ``q_to_from``."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def exp(rotation_rad: FloatArray) -> FloatArray:
    """Quaternion of a rotation vector ``(..., 3)``, rad; exact at zero."""
    d = np.asarray(rotation_rad, dtype=float)
    half = 0.5 * np.linalg.norm(d, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * d], axis=-1)


def log(q: FloatArray) -> FloatArray:
    """Rotation vector ``(..., 3)``, rad, of the shorter way round (norm at most pi)."""
    q = np.asarray(q, dtype=float)
    q = np.where(q[..., :1] < 0.0, -q, q)
    s = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(s, q[..., :1])
    factor = np.where(s > 1e-12, angle / np.where(s > 1e-12, s, 1.0), 2.0)
    return factor * q[..., 1:]


def boxplus(q_to_from: FloatArray, rotation_from_rad: FloatArray) -> FloatArray:
    """Turn an attitude by a small rotation given in the *from* frame."""
    return multiply(q_to_from, exp(rotation_from_rad))


def boxminus(q_to_from: FloatArray, reference_to_from: FloatArray) -> FloatArray:
    """Rotation in the *from* frame, rad, that `boxplus` needs to go from the reference to ``q_to_from``."""
    return log(multiply(conjugate(reference_to_from), q_to_from))


def dcm_from_q(q: FloatArray) -> FloatArray:
    """Direction cosine matrices ``(..., 3, 3)``."""
    w, x, y, z = _components(q)
    out = np.empty((*w.shape, 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return out


def q_from_dcm(dcm: FloatArray) -> FloatArray:
    """Unit quaternions ``(..., 4)`` of direction cosine matrices, continuous in sign along the first axis."""
    from scipy.spatial.transform import Rotation

    dcm = np.asarray(dcm, dtype=float)
    q = np.roll(Rotation.from_matrix(dcm.reshape(-1, 3, 3)).as_quat(), 1, axis=-1)
    return continuous(q).reshape(*dcm.shape[:-2], 4)


def continuous(q: FloatArray) -> FloatArray:
    """Flip signs so that neighbours along the first axis lie in one hemisphere."""
    q = np.array(q, dtype=float)
    if len(q) > 1:
        flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0.0, -1.0, 1.0)
        q[1:] *= np.cumprod(flips)[:, None]
    return q


def rotate(q_to_from: FloatArray, v_from: FloatArray) -> FloatArray:
    """Components of vectors ``(..., 3)`` in the *to* frame."""
    return np.einsum("...ij,...j->...i", dcm_from_q(q_to_from), np.asarray(v_from, dtype=float))


def slerp(time_s: FloatArray, q: FloatArray, at_s: FloatArray) -> FloatArray:
    """Attitudes at other times by the shortest arc between neighbours; times must lie inside ``time_s``."""
    k = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    fraction = (at_s - time_s[k]) / (time_s[k + 1] - time_s[k])
    return continuous(boxplus(q[k], fraction[:, None] * boxminus(q[k + 1], q[k])))


def skew(v: FloatArray) -> FloatArray:
    """Matrices ``(..., 3, 3)`` with ``skew(a) @ b = a x b``."""
    x, y, z = _components(v)
    out = np.zeros((*x.shape, 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def lever_arm_acceleration(
    rate_radps: FloatArray, angular_acceleration_radps2: FloatArray, arm_m: FloatArray
) -> FloatArray:
    """Specific force ``(n, 3)`` at the end of an arm less that at its beginning, m/s^2: ``w' x r + w x (w x r)``."""
    swing = np.cross(rate_radps, np.cross(rate_radps, arm_m))
    return np.asarray(np.cross(angular_acceleration_radps2, arm_m) + swing)
