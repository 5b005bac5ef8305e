"""Parts of the filter's kernels called for one node."""

import numpy as np

from flightmodel import rotations
from flightmodel.earth import WGS84
from recon import _measurement_kernels
from recon._measurement_kernels import SLOTS


def motion_at(motion, index, position, velocity, q, errors):
    """Rate with its partials (12, 3) and acceleration (3,) at a grid point."""
    c, rate, acceleration = np.empty((3, 3)), np.empty((12, 3)), np.empty(3)
    _measurement_kernels.node_motion(motion, index, position, velocity, q, errors, c, rate, acceleration)
    return rate, acceleration


def predicted(source, known, e, position, velocity, q, rate, acceleration):
    """Prediction (3,) of one instrument with its partials by state (3, 9) and by its own errors (3, `SLOTS`)."""
    h, by_state, by_error = np.empty(3), np.empty((3, 9)), np.empty((3, SLOTS))
    c = rotations.dcm_from_q(q)
    _measurement_kernels.predict(
        source.kind, source.arm_body_m, source.site_ecef_m, source.dcm, known, e, position, velocity, c, rate,
        acceleration, h, by_state, by_error, WGS84,
    )  # fmt: skip
    return h, by_state, by_error


def height(state, planet=WGS84):
    """Geodetic height of one state, m."""
    return _measurement_kernels.geodetic(*state.position_ecef_m, planet)[2]
