"""A joint that creeps: the standard linear solid against its own equations, and the laws that it must keep.

Authority: matrix exponential of the linear equations, written here from the textbook (Findley, Lai, Onaran, "Creep and
relaxation of nonlinear viscoelastic materials", 1976, ch. 5), and the energy that the dashpot takes.
"""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import simpson
from scipy.linalg import expm

from flightmodel import earth, rotations
from flightmodel.checks import ConfigError
from flightmodel.linear import Slopes, linear_matrix, modes, static_trim
from flightmodel.vehicle import CompliantJoint
from synthetic_flight import dynamics, simulate
from synthetic_flight.ensemble import Start, fly_ensemble
from synthetic_flight.simulate import Schedule, integrate
from tests.oracles import two_body

from .conftest import bent_entry_state, free_state, undamped, with_joint

SMALL_RAD = 1e-4  # squares of it are 1e-8


@pytest.mark.parametrize(("share", "time_s"), [(0.1, 1.0), (0.3, 10.0), (0.5, 60.0), (0.5, 1.0)])
def test_a_free_joint_moves_as_the_linear_solid(vehicle, measured, share, time_s):
    """``I e'' = -K (e - b) - C e'``, ``tau b' + b = s / (1 - s) (e - b)``: twenty seconds, fifty periods."""
    one = with_joint(vehicle, creep_share=share, creep_time_s=time_s)
    body = one.centerbody.model_copy(
        update={"cg_from_datum_body_m": (one.centerbody.cg_from_datum_body_m[0], 0.0, 0.0)}
    )
    one = replace(one, centerbody=body)
    inertia, damping, stiffness = dynamics.joint_modes(one)["bending"]
    ratio = share / (1.0 - share)
    matrix = np.array(
        [
            [0.0, 1.0, 0.0],
            [-stiffness / inertia, -damping / inertia, stiffness / inertia],
            [ratio / time_s, 0.0, -(1.0 + ratio) / time_s],
        ]
    )
    state = np.concatenate([free_state(one)[:6], np.tile([1.0, 0.0, 0.0, 0.0], 2), np.zeros(6), np.zeros(2)])
    # the body's x axis from the shell's: towards y and z alike, creep half way
    state[6:10] = rotations.exp(SMALL_RAD * np.array([0.0, -0.8, 0.6]))
    state[20:] = 0.5 * SMALL_RAD * np.array([0.6, 0.8])
    states, _ = integrate(one, simulate.vacuum_table(), state, 5e-4, 200, 201)
    felt = dynamics.spring_deflection(states) + states[:, 20:]
    first = SMALL_RAD * np.array([1.0, 0.0, 0.5])
    want = np.array([expm(matrix * t) @ first for t in 0.1 * np.arange(201)])
    for column, got in ((0, felt), (2, states[:, 20:])):
        off = np.abs(got - want[:, [column]] * [0.6, 0.8]).max()
        measured(f"linear solid, {share:g} of the compliance, {time_s:g} s", off / SMALL_RAD, 1e-6)


def test_the_kernel_equals_the_readable_form(generic_vehicle, measured):
    one = with_joint(undamped(generic_vehicle), creep_share=0.35, creep_time_s=2.0, torsion_stiffness_nmprad=0.0)
    one = with_joint(one, quadratic_nmprad2=3e4)
    state = np.append(bent_entry_state([0.004, 0.05, -0.06], [0.1, 0.2, 0.3]), [0.03, -0.02])
    s = simulate.workspace(state[None], simulate.parameter_vector(one)[None])
    s[dynamics.TRIAL : dynamics.TRIAL + dynamics.STATES] = state[:20]
    s[dynamics.CREEP + 2 : dynamics.CREEP + 4] = state[20:]
    tables = simulate.kernel_tables(one, simulate.vacuum_table())
    dynamics.rates(s, (0,), (0, 0), (), *tables, earth.WGS84, False, False)
    moment, creep_rate = two_body.creeping_moment(one, state)
    in_eci = s[dynamics.R_A : dynamics.R_A + 9].reshape(3, 3) @ s[dynamics.MOMENT : dynamics.MOMENT + 3]
    # central differences of 1e-5 rad: 1e-10 of cubic terms, 1e-16 / 1e-5 of rounding
    measured("moment of a joint that creeps, relative", np.linalg.norm(in_eci - moment) / np.linalg.norm(moment), 1e-8)
    np.testing.assert_allclose(s[dynamics.CREEP + 4 : dynamics.CREEP + 6], creep_rate, rtol=1e-12)
    assert abs(moment @ rotations.rotate(state[6:10], np.array([1.0, 0, 0]))) < 1e-6 * np.linalg.norm(moment)


def test_what_the_dashpot_takes_is_what_the_energy_loses(generic_vehicle, measured):
    """With freeplay and hardening, in space: energy falls by the integral of ``tau b'^2`` over the compliance."""
    one = with_joint(undamped(generic_vehicle), creep_share=0.4, creep_time_s=1.5, freeplay_corner=0.5)
    state = np.append(free_state(one), [0.01, -0.02])
    states, _ = integrate(one, simulate.vacuum_table(), state, 2.5e-4, 8, 2001)
    energy = dynamics.internal_energy(states, one)
    rate = np.array([two_body.creeping_moment(one, each)[1] for each in states])
    joint = one.joint
    power = joint.creep_time_s / joint.delayed_compliance_radpnm * np.sum(rate**2, axis=1)
    taken = simpson(power, dx=2e-3)
    assert taken > 0.1 * energy[0]
    measured("energy that creep takes, relative", abs((energy[0] - energy[-1]) / taken - 1.0), 1e-6)
    momentum = dynamics.angular_momentum(states, one)
    assert np.abs(momentum - momentum[0]).max() < 1e-8 * np.linalg.norm(momentum[0])


def test_flights_with_and_without_creep_fly_side_by_side_alone_and_in_turn(vehicle):
    """In lanes as alone; a share of nothing is no creep; a flight goes on from its own creep."""
    one, state = with_joint(vehicle, creep_share=0.3, creep_time_s=3.0), bent_entry_state([0, 0.02, 0.01], [0, 0, 0])
    air, schedule = simulate.vacuum_table(), Schedule(0.002, 10, 51)
    (flown,) = fly_ensemble(one, lambda _: Start(state, simulate.parameter_vector(one), air), [0], schedule)
    alone, _ = integrate(one, air, state, 0.002, 10, 51)
    np.testing.assert_allclose(flown.states, alone, rtol=1e-9, atol=1e-12)
    on, _ = integrate(one, air, alone[25], 0.002, 10, 26)
    np.testing.assert_allclose(on[-1], alone[-1], rtol=1e-12, atol=1e-15)
    assert np.linalg.norm(alone[-1, 20:]) > 1e-5
    none, _ = integrate(with_joint(vehicle, creep_time_s=3.0), air, state, 0.002, 10, 51)
    assert none.shape == (51, 20)
    with_states, _ = integrate(vehicle, air, np.append(state, [0.0, 0.0]), 0.002, 10, 51)
    np.testing.assert_allclose(with_states[:, :20], none, rtol=1e-12, atol=1e-12)
    assert not with_states[:, 20:].any()


def test_the_linear_model_creeps(vehicle):
    """Its matrix without air has the free joint's roots; what stays under load is that of the held stiffness."""
    one = with_joint(vehicle, creep_share=0.3, creep_time_s=5.0)
    slopes = Slopes(1.5, 0.6, -0.3, -0.1)
    matrix = linear_matrix(one, slopes, 0.0, 1200.0)
    roots = modes(matrix).eigenvalues_radps
    inertia, damping, stiffness = dynamics.joint_modes(one)["bending"]
    ratio = 0.3 / 0.7
    cubic = np.polyadd(
        np.polymul([inertia, damping, stiffness], [5.0, 1.0 + ratio]), np.polymul([stiffness * -ratio], [1.0])
    )
    for root in np.roots(cubic):
        assert np.abs(roots - root).min() < 1e-6 * abs(root)
    # a joint between held and fast stiffness diverges, slowly
    fast, held = (static_trim(with_joint(vehicle, creep_share=s), slopes, 800.0, 1e-3)[1] for s in (0.0, 0.3))
    soft = with_joint(vehicle, bending_stiffness_nmprad=vehicle.joint.bending_stiffness_nmprad * 0.7)
    assert held == pytest.approx(static_trim(soft, slopes, 800.0, 1e-3)[1])
    assert held > fast


def test_impossible_creep_is_refused(vehicle):
    with pytest.raises(ValidationError):
        CompliantJoint(station_m=0.2, bending_stiffness_nmprad=0.0, torsion_stiffness_nmprad=1.0, creep_share=0.1)
    fast = with_joint(vehicle, creep_share=0.9, creep_time_s=0.1, torsion_stiffness_nmprad=10.0)
    dynamics.check_step(fast, 0.01)
    with pytest.raises(ConfigError) as refusal:
        dynamics.check_step(fast, 0.03)
    assert refusal.value.codes == ("step-too-long",)
