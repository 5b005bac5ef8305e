"""Problems of the filter for tests, and how two answers are compared."""

import numpy as np

from recon.estimate import bridge_inertial_sensors
from recon.settings import Settings
from recon.setup import build_problem
from recon.state import unpacked


def build(telemetry, **options):
    """The filter's problem of the first seconds of a flight."""
    options = {"output_rate_hz": 5.0, "end_s": 112.0} | options
    return build_problem(telemetry, Settings(**options), bridge_inertial_sensors(telemetry))


def off_in_states(a, b, triangles):
    """Largest difference of errors (n, N) in standard deviations of packed covariances (n, ...)."""
    sd = np.sqrt(np.diagonal(unpacked(triangles), axis1=1, axis2=2))
    return float((np.abs(a - b)[:, : sd.shape[1]] / sd).max())


def off_in_covariance(a, b):
    """Largest difference of packed covariances, scaled to correlations."""
    one, other = unpacked(a), unpacked(b)
    sd = np.sqrt(np.diagonal(one, axis1=-2, axis2=-1))
    return float((np.abs(one - other) / (sd[..., :, None] * sd[..., None, :])).max())
