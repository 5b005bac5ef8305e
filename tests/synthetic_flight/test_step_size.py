from dataclasses import replace

import numpy as np
import pytest

from flightmodel import rotations
from flightmodel.checks import ConfigError
from synthetic_flight import dynamics, simulate
from synthetic_flight.dynamics import joint_modes, largest_step_s
from synthetic_flight.simulate import fly, integrate
from tests.refusing import refuses

from .conftest import free_state


def with_joint(vehicle, **changes):
    return replace(vehicle, joint=vehicle.joint.model_copy(update=changes))


@pytest.mark.parametrize(
    ("stiffness", "damping"), [(4335.0, 0.0), (2.0e7, 0.0), (2.0e7, 3000.0), (4335.0, 2.0e5)], ids=str
)
def test_steps_beside_the_limit_do_as_it_says(vehicle, stiffness, damping):
    # bending alone: torsion soft; 3 % beside the limit grows or does not
    joint = {"bending_stiffness_nmprad": stiffness, "bending_damping_nmsprad": damping}
    body = with_joint(vehicle, **joint, torsion_stiffness_nmprad=10.0, torsion_damping_nmsprad=0.0)
    longest = largest_step_s(*joint_modes(body)["bending"])
    state = free_state(body)
    state[14:20] = 0.0
    state[17:19] = 1e-4
    for factor, stays in ((0.97, True), (1.03, False)):
        states, aux = integrate(body, simulate.vacuum_table(), state, factor * longest, 50, 21)
        assert (len(states) == 21 and aux[-1, 5] < 0.2) == stays


def test_torsion_counts_and_nothing_moves_without_a_spring(vehicle):
    inertia, _, stiffness = joint_modes(vehicle)["torsion"]
    assert np.sqrt(stiffness / inertia) / (2.0 * np.pi) == pytest.approx(54.0, abs=0.1)
    assert largest_step_s(inertia, 0.0, stiffness) == pytest.approx(2.828 / np.sqrt(stiffness / inertia), rel=1e-3)
    assert largest_step_s(inertia, 0.0, 0.0) == np.inf


def test_too_long_a_step_is_refused_with_the_longest(vehicle):
    from flightmodel.atmosphere import standard_atmosphere

    stiff = with_joint(vehicle, bending_stiffness_nmprad=1.0e7)
    state = free_state(vehicle)
    with refuses("step-too-long", names=[r"\b4 ms", "bending", r"1\d\d\.\d Hz"], kind=ConfigError):
        fly(stiff, standard_atmosphere(), state, 0.0, 1.0, "2009-08-17T12:52:00Z", 0.004, 0.004)


def spun(vehicle, twist_rad, rate_radps=0.0):
    """State in space of a vehicle whose joint is twisted, and nothing else."""
    state = free_state(vehicle)
    state[6:14] = np.concatenate([rotations.exp(np.array([twist_rad, 0.0, 0.0])), [1.0, 0.0, 0.0, 0.0]])
    state[14:20] = [rate_radps, 0.0, 0.0, 0.0, 0.0, 0.0]
    return state


def test_a_step_too_long_for_the_twist_slows_it(vehicle):
    """A sixtieth of a second: the 54 Hz of the twist become 2 / step, and it dies; momentum stays."""
    state = spun(vehicle, 0.02)
    states, _ = integrate(vehicle, simulate.vacuum_table(), state, 1.0 / 60.0, 1, 301)
    twist = dynamics.twist(states[:, 6:10], states[:, 10:14])
    assert len(states) == 301
    assert np.abs(twist).max() < 0.0201
    assert np.abs(twist[-10:]).max() < 1e-6
    # of momentum that the spins exchange; fourth-order steps of two radians turn the bodies' axes a little
    exchanged = vehicle.centerbody.inertia[0, 0] * np.abs(states[:, 14]).max()
    momentum = dynamics.angular_momentum(states, vehicle)
    assert np.abs(momentum - momentum[0]).max() < 1e-3 * exchanged


def test_the_twist_under_load_nears_that_of_short_steps(vehicle):
    """A centerbody whose principal axes are not the joint's twists it as it swings: off by the step squared."""
    inertia, _, stiffness = joint_modes(vehicle)["torsion"]
    damping = 0.2 * np.sqrt(inertia * stiffness)
    body = with_joint(vehicle, torsion_damping_nmsprad=damping, bending_stiffness_nmprad=435.0)
    products = ((2.0, 0.2, 0.1), (0.2, 25.0, 0.0), (0.1, 0.0, 25.0))
    body = replace(body, centerbody=body.centerbody.model_copy(update={"inertia_kgm2": products}))
    twists = []
    for step in (1.0 / 60.0, 1.0 / 120.0, 1.0 / 2000.0):
        states, _ = integrate(body, simulate.vacuum_table(), free_state(body), step, round(0.1 / step), 101)
        # after the free vibration of the start
        twists.append(dynamics.twist(states[:, 6:10], states[:, 10:14])[20:])
    error = [np.abs(t - twists[-1]).max() for t in twists[:2]]
    assert error[0] < 0.3 * np.abs(twists[-1]).max()
    assert 3.0 < error[0] / error[1] < 5.0


@pytest.mark.parametrize("damping", [0.0, 1.0, 30.0, 3e3])
def test_the_added_inertia_is_the_least_that_brings_the_roots_inside(damping):
    inertia, stiffness, step = 0.5, 6e4, 1.0 / 60.0
    added = float(dynamics.added_twist_inertia(inertia, damping, stiffness, step))
    largest = np.abs(np.roots([inertia + added, damping, stiffness])).max()
    assert largest * step == pytest.approx(dynamics.SURELY_STABLE, rel=1e-9)
    assert dynamics.added_twist_inertia(inertia, damping, stiffness, 1e-5) == 0.0


def test_a_step_that_blurs_the_joint_is_refused(vehicle):
    inertia, _, _ = joint_modes(vehicle)["bending"]
    ten_hz = with_joint(vehicle, bending_stiffness_nmprad=inertia * (2.0 * np.pi * 10.0) ** 2)
    with refuses("step-too-long", names=["10.0 Hz", "16.7 ms", "6.4 ms"], kind=ConfigError):
        dynamics.check_resolved(ten_hz, 1.0 / 60.0)
    dynamics.check_resolved(ten_hz, 0.0063)
    dynamics.check_resolved(vehicle, 1.0 / 60.0)
