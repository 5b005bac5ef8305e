from dataclasses import replace

import numpy as np
import pytest

from flightmodel.checks import ConfigError
from synthetic_flight import simulate
from synthetic_flight.dynamics import joint_modes, largest_step_s
from synthetic_flight.ensemble import Schedule, fly_ensemble
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
    with refuses("step-too-long", names=["torsion", r"\b53\."], kind=ConfigError):
        list(fly_ensemble(vehicle, lambda _: None, [0], Schedule(0.01, 1, 2)))
