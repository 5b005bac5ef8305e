"""How an attitude follows from where the nose points: azimuth, elevation and roll of the body at a place.

``q_ecef_body = q_ecef_ned * q_ned_body`` with ``q_ned_body`` the turns by azimuth about down, by elevation about the
body's y, by roll about its x. At roll 0 the body's y axis is horizontal, to the right of one who looks along x; of a
rocket that stands upright with azimuth 0 it points east and z points north.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray


def q_ecef_body_from_pointing(
    azimuth_rad: float, elevation_rad: float, roll_rad: float, latitude_rad: float, longitude_rad: float
) -> FloatArray:
    """Attitude (4,) of a body whose x axis has this azimuth from true north and elevation at a place (WGS-84)."""
    down, right, forward = np.eye(3)[2], np.eye(3)[1], np.eye(3)[0]
    q_ned_body = rotations.multiply(
        rotations.exp(azimuth_rad * down),
        rotations.multiply(rotations.exp(elevation_rad * right), rotations.exp(roll_rad * forward)),
    )
    dcm = earth.dcm_ned_ecef(latitude_rad, longitude_rad).T @ rotations.dcm_from_q(q_ned_body)
    return np.asarray(rotations.q_from_dcm(dcm[None])[0])
