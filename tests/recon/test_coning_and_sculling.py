"""Motions that fool a strapdown mechanisation, whose outcome is known: coning, sculling, and rates straight in time.

The correction is exact to fourth order where signals are straight in time. Samples of a sinusoid are not, and the
error of joining them by straight lines is just as large as what is corrected for;
`recon.propagation.with_exact_integrals` takes it away.
"""

from functools import cache
from unittest import mock

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flightmodel import earth, rotations
from recon import propagation
from recon.propagation import propagate, strapdown_motion, with_exact_integrals
from recon.state import States
from tests.oracles import strapdown as plain_strapdown

SPAN_S = 2.0
ANGLE, OMEGA, PUSH = 0.05, 2.0 * np.pi * 3.0, 30.0
POSITION, VELOCITY = earth.ecef_from_geodetic(-0.6, 1.2, 9e4), np.array([1500.0, -900.0, 700.0])
COUNTS = (100, 200)


def coning(t):
    """Attitude to inertial axes, rate and force: an axis that draws a cone of 0.05 rad three times a second."""
    t, zero = np.asarray(t), np.zeros_like(t)
    half, cos, sin = 0.5 * ANGLE, np.cos(OMEGA * t), np.sin(OMEGA * t)
    q = np.stack([np.cos(half) + zero, zero, np.sin(half) * cos, np.sin(half) * sin], -1)
    swing = OMEGA * np.sin(ANGLE)
    rate = np.stack([-2.0 * OMEGA * np.sin(half) ** 2 + zero, -swing * sin, swing * cos], -1)
    return q, rate, np.stack([zero] * 3, -1)


def sculling(t):
    """Turning about x in phase with pushing along y: a steady acceleration along z that no sample shows."""
    t, zero = np.asarray(t), np.zeros_like(t)
    angle = ANGLE * np.sin(OMEGA * t)
    q = np.stack([np.cos(0.5 * angle), np.sin(0.5 * angle), zero, zero], -1)
    rate = np.stack([ANGLE * OMEGA * np.cos(OMEGA * t), zero, zero], -1)
    return q, rate, np.stack([zero, PUSH * np.sin(OMEGA * t), zero], -1)


def straight_rate(t):
    return np.array([0.5, -0.3, 0.2]) + np.multiply.outer(t, [-0.6, 0.9, 1.1])


def straight_force(t):
    return np.array([-40.0, 5.0, 3.0]) + np.multiply.outer(t, [20.0, -9.0, 14.0])


@cache
def truth(motion=None):
    """Position, velocity and attitude in Earth-fixed axes at the end, integrated in inertial axes by DOP853."""

    def rhs(t, s):
        if motion is None:
            q, rate, force = s[6:10] / np.linalg.norm(s[6:10]), straight_rate(t), straight_force(t)
        else:
            q, rate, force = motion(t)
        turn = 0.5 * rotations.multiply(s[6:10], np.concatenate([[0.0], rate]))
        return np.concatenate([s[3:6], earth.gravitation(s[0:3]) + rotations.dcm_from_q(q) @ force, turn])

    q0 = np.array([1.0, 0.0, 0.0, 0.0]) if motion is None else motion(0.0)[0]
    start = np.concatenate([POSITION, VELOCITY + np.cross(earth.OMEGA_ECEF_RADPS, POSITION), q0])
    y = solve_ivp(rhs, (0.0, SPAN_S), start, method="DOP853", rtol=1e-13, atol=1e-10, max_step=0.01).y[:, -1]
    turn = earth.q_ecef_eci(SPAN_S)
    position = rotations.rotate(turn, y[0:3])
    velocity = rotations.rotate(turn, y[3:6]) - np.cross(earth.OMEGA_ECEF_RADPS, position)
    q = y[6:10] / np.linalg.norm(y[6:10]) if motion is None else motion(SPAN_S)[0]
    return position, velocity, rotations.multiply(turn, q)


def mechanised(motion, count, corrected=True, moved=True):
    """End of a mechanisation with so many steps, with or without the correction and with samples moved or not."""
    t = np.linspace(0.0, SPAN_S, count + 1)
    if motion is None:
        q, rate, force = np.array([[1.0, 0.0, 0.0, 0.0]]), straight_rate(t), straight_force(t)
    else:
        q, rate, force = motion(t)
    if moved and motion is not None:
        longer = np.arange(-1, count + 2) * SPAN_S / count  # the motion goes on before and after
        _, rate, force = motion(longer)
        rate, force = with_exact_integrals(longer, rate)[1:-1], with_exact_integrals(longer, force)[1:-1]
    zero = np.zeros((count + 1, 3))
    grid = strapdown_motion(t, force, rate, zero, zero, np.eye(3), np.eye(3))
    start = States(POSITION, VELOCITY, q[0], np.zeros(18))
    if corrected:
        return propagate(grid, 0, count, start).state
    with mock.patch.object(propagation.np, "cross", lambda _a, b: np.zeros_like(b)):
        return plain_strapdown.propagate(grid, 0, count, start).state


def errors(motion, known, what, **options):
    out = []
    for count in COUNTS:
        end = mechanised(motion, count, **options)
        if what == "attitude":
            out.append(np.linalg.norm(rotations.boxminus(end.q_ecef_body, known[2])))
        else:
            out.append(np.linalg.norm(end.velocity_ecef_mps - known[1]))
    return np.array(out)


def order(values):
    return np.log2(values[:-1] / values[1:])


@pytest.mark.parametrize(("motion", "what"), [(coning, "attitude"), (sculling, "velocity")])
def test_correction_turns_second_order_into_fourth(motion, what):
    known = truth(motion)
    with_it, without = errors(motion, known, what), errors(motion, known, what, corrected=False)
    assert (without > np.array([30.0, 150.0]) * with_it).all()  # measured 43 and 198, 56 and 223
    assert (order(with_it) > 3.8).all()
    assert np.allclose(order(without), 2.0, atol=0.1)


@pytest.mark.parametrize(("motion", "what"), [(coning, "attitude"), (sculling, "velocity")])
def test_samples_as_they_are_leave_half_of_it(motion, what):
    """A straight join of sinusoidal samples errs by (W dt)^2 / 6 of the drift, uncorrected by twice that."""
    known = truth(motion)
    with_it = errors(motion, known, what, moved=False)
    without = errors(motion, known, what, corrected=False, moved=False)
    assert np.allclose(without / with_it, 2.0, atol=0.05)
    drift = 0.5 * ANGLE**2 * OMEGA * SPAN_S if what == "attitude" else 0.5 * ANGLE * PUSH * SPAN_S
    step = OMEGA * SPAN_S / np.array(COUNTS)
    assert np.allclose(with_it, drift * step**2 / 6.0, rtol=0.05)


def test_straight_rates_and_forces_are_integrated_to_fourth_order():
    known = truth()
    attitude, rough = errors(None, known, "attitude"), errors(None, known, "attitude", corrected=False)
    assert (rough > 100.0 * attitude).all()
    assert (order(attitude) > 3.8).all()
    assert np.allclose(order(rough), 2.0, atol=0.1)
    # a push sideways while turning, w x (w x f) dt^2 / 24, is left out of the velocity: second order, below 1e-7 of
    # a push at 0.6 rad/s and 100 Hz
    velocity = errors(None, known, "velocity")
    assert (errors(None, known, "velocity", corrected=False) > 2.0 * velocity).all()


def test_moved_samples_keep_the_integral_of_noise():
    rng = np.random.default_rng(1)
    t = np.arange(400) * 0.01
    x = rng.standard_normal((400, 3))
    # sums agree but for the ends; uneven steps stay
    inner = slice(50, 350)
    assert np.abs(with_exact_integrals(t, x)[inner].sum(axis=0) - x[inner].sum(axis=0)).max() < 1.0
    t[200:] += 0.004
    even = np.r_[1:199, 201:399]
    changed = np.flatnonzero((with_exact_integrals(t, x) != x).any(axis=1))
    assert np.array_equal(changed, even)
