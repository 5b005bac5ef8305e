"""Partials of the attitude smoother's observations are derivatives, and its sensors are those of the filter."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from recon import attitude_smoother as smoother
from recon._measurement_kernels import FIELD, SLOTS, SUN
from recon.measurements import Instrument
from tests.oracles.plain_measurements import NodeMotion, predict

from .conftest import EPOCH, MAGNETOMETER
from .conftest import SUN as HEADS

STEP_S = 0.2


@pytest.fixture(scope="module")
def observed(mini_everything, mini_truth):
    """Observations, attitudes, rates and errors of every kind, none of them zero."""
    telemetry = mini_everything(3)
    knots_s = np.arange(110.0, 114.0, STEP_S)
    unstated = smoother.UnstatedErrors()
    terms = smoother.error_terms(MAGNETOMETER, HEADS, unstated, knots_s[0], knots_s[-1])
    about = EPOCH, knots_s, STEP_S, lambda at: mini_truth.state(at)[0], terms
    out = [
        smoother.observe_magnetometer(telemetry.magnetometer, *about),
        *smoother.observe_sun(replace(telemetry.sun, spec=HEADS), *about),
    ]
    rng = np.random.default_rng(1)
    truth = rotations.multiply(rotations.conjugate(earth.q_ecef_eci(knots_s)), mini_truth.state(knots_s)[2])
    q = rotations.boxplus(truth, 0.01 * rng.standard_normal((len(knots_s), 3)))
    rate = np.array([0.6, 0.1, -0.2]) + 0.05 * rng.standard_normal((len(knots_s), 3))
    return out, q, rate, terms.prior_sd * rng.standard_normal(terms.size)


def test_partials_are_derivatives(observed):
    """Central differences; the right Jacobian of mounts of a degree is right to 1e-6 of itself."""
    seen, q, rate, errors = observed
    assert len(seen) >= 2
    for one in seen:
        # residuals of zero: the Sun's are scaled by the cosine of its elevation, which is taken as constant
        for _ in range(100):
            one = replace(one, measured=one.measured - smoother.linearise(one, q, rate, errors).residual)
        line = smoother.linearise(one, q, rate, errors)
        size = np.abs(line.by_knot).max()

        def slope(q_of, rate_of, errors_of, h, one=one):
            a, b = (smoother.linearise(one, q_of(s), rate_of(s), errors_of(s)).residual for s in (h, -h))
            return -(a - b) / (2.0 * h)

        for j in range(3):
            axis = np.eye(3)[j]
            by_rotation = slope(lambda s, a=axis: rotations.boxplus(q, s * a), lambda _: rate, lambda _: errors, 1e-5)
            by_rate = slope(lambda _: q, lambda s, a=axis: rate + s * a, lambda _: errors, 1e-4)
            assert np.abs(by_rotation - line.by_knot[:, :, j]).max() < 2e-4 * size
            # first order in the rotation over a lag, some 0.06 rad: half of that is left out
            half = 0.5 * np.abs(one.lag_s).max() * np.linalg.norm(rate, axis=1).max()
            assert np.abs(by_rate - line.by_knot[:, :, 3 + j]).max() < half * np.abs(line.by_knot[:, :, 3:]).max()
        for j, term in enumerate(one.terms):
            h = 1e-9 if one.is_field and j in (0, 1, 2, *range(12, len(one.terms))) else 1e-5
            moved = slope(lambda _: q, lambda _: rate, lambda s, k=term: errors + s * np.eye(len(errors))[k], h)
            scale = max(np.abs(line.by_errors[:, :, j]).max(), 1e-3 * size)
            # a head's azimuth bias is a distance normal to the line of sight: its change with elevation is left out
            bias = 0.0 if one.is_field else np.abs(errors[one.terms[:2]]).max()
            assert np.abs(moved - line.by_errors[:, :, j]).max() < (1e-3 + bias) * scale, (one.name, j)


def test_sensors_are_predicted_as_the_filter_predicts_them(observed):
    seen, q, rate, errors = observed
    for one in seen:
        e = np.zeros(SLOTS)
        own = errors[one.terms].copy()
        if one.is_field:
            e[:12], own[12:] = own[:12], 0.0
        else:
            e[[0, 1, 4, 5, 6]], own[5:] = own[:5], 0.0
        plain = errors.copy()
        plain[one.terms] = own
        line = smoother.linearise(one, q, rate, plain)
        kind = FIELD if one.is_field else SUN
        nothing = np.zeros(3)
        instrument = Instrument(
            one.name,
            kind,
            one.name,
            nothing,
            nothing,
            one.dcm_body_sensor,
            nothing,
            nothing,
            nothing,
            nothing,
            nothing,
            nothing,
        )
        for row in range(len(one.knot)):
            turn = rotations.exp(rate[one.knot[row]] * one.lag_s[row])
            c = rotations.dcm_from_q(rotations.multiply(q[one.knot[row]], turn))
            h = predict(instrument, one.reference_eci[row], e, NodeMotion(nothing, nothing, c, nothing, nothing))[0]
            off = one.measured[row] - h[: one.measured.shape[1]]
            if not one.is_field:
                off[0] = np.cos(h[1]) * (np.mod(off[0] + np.pi, 2.0 * np.pi) - np.pi)
            assert np.allclose(off, line.residual[row], rtol=1e-9, atol=1e-12 * np.abs(one.measured[row]).max())
