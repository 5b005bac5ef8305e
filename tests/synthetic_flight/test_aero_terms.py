"""What a table over Mach number and angle of attack cannot say: roll, coning, dependence on roll and deflection."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from flightmodel import rotations
from flightmodel.vehicle import AeroTerms, CompliantJoint
from synthetic_flight import simulate
from synthetic_flight.ensemble import Start, fly_ensemble
from synthetic_flight.simulate import Schedule, integrate
from tests.oracles import two_body

from .conftest import bent_entry_state
from .test_dynamics import entry_45_km, kernel_rates, windy

ALL = {
    "cl": 0.01, "clp": -0.3, "cnr_less_cmq": -0.7, "ca_deflection": 0.9, "cn_deflection": 0.4, "cm_deflection": -0.2,
    "roll_order": 3, "roll_share": 0.15, "roll_clock_lv_deg": 25.0,
}  # fmt: skip


def with_terms(vehicle, **terms):
    return replace(vehicle, aero_terms=AeroTerms(**terms))


def test_the_kernel_equals_the_readable_form_with_every_term_alive(generic_vehicle):
    one, state, profile = with_terms(generic_vehicle, **ALL), entry_45_km(), windy()
    got, aux = kernel_rates(state, one, simulate.atmosphere_table(profile))
    force, _ = two_body.aerodynamics(state, one, profile)
    np.testing.assert_allclose(aux[12:15], force, rtol=2e-7)
    want = two_body.rates(state, one, two_body.flight_loads(state, one, profile))
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", [name for name in ALL if not name.startswith("roll_")] + ["roll"])
def test_each_term_is_alive_and_alone_equals_the_readable_form(generic_vehicle, name):
    roll = {key: value for key, value in ALL.items() if key.startswith("roll_")}
    one = with_terms(generic_vehicle, **(roll if name == "roll" else {name: ALL[name]}))
    state, profile = entry_45_km(), windy()
    table = simulate.atmosphere_table(profile)
    got, plain = (kernel_rates(state, v, table)[0] for v in (one, generic_vehicle))
    want = two_body.rates(state, one, two_body.flight_loads(state, one, profile))
    change = np.linalg.norm(want[14:] - plain[14:])
    assert change > 1e-3
    assert np.linalg.norm(got - want) < 1e-3 * change + 1e-6


def test_a_locked_joint_turns_with_them_as_a_flexible_one_does(generic_vehicle):
    """A shell that turns as the centerbody: the moments about the composite c.g. are equal however the joint is."""
    one, state = with_terms(generic_vehicle, **ALL), bent_entry_state([0.0, 0.05, -0.03], [0.0, 0.0, 0.0], 45e3)
    state[17:20] = rotations.rotate(
        rotations.multiply(rotations.conjugate(state[10:14]), state[6:10]), state[14:17]
    )  # rates of one rigid body
    table = simulate.atmosphere_table(windy())
    (locked, _), (free, _) = (kernel_rates(state, one, table, locked=x) for x in (True, False))
    np.testing.assert_allclose(locked[3:6], free[3:6], rtol=1e-12)
    plain, _ = kernel_rates(state, generic_vehicle, table, locked=True)
    assert np.linalg.norm(locked[14:17] - plain[14:17]) > 1e-3


def test_roll_settles_at_the_ratio_of_its_two_coefficients(vehicle):
    """``p l / 2V -> -cl / clp``, held by air of one density and speed, at rate ``q S l^2 clp / (2 V I_x)``."""
    one = with_terms(vehicle, cl=0.003, clp=-0.1)
    state = bent_entry_state([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 45e3, 1050.0)
    state[14:20] = 0.0
    table = simulate.atmosphere_table(windy())
    rates = []
    for roll in (0.0, 1.0, 2.0):
        state[14] = state[17] = roll
        turn, aux = kernel_rates(state, one, table, locked=True)
        rates.append(turn[14])
    length, speed = one.reference.length_m, np.sqrt(2.0 * aux[3] / aux[1])
    load = aux[3] * one.reference.area_m2 * length
    inertia = one.inertia[0, 0]
    assert rates[0] == pytest.approx(load * 0.003 / inertia, rel=2e-2)  # products of inertia are small
    slope = -load * 0.1 * length / (2.0 * speed) / inertia
    assert rates[1] - rates[0] == pytest.approx(slope, rel=1e-2)
    assert rates[2] - rates[1] == pytest.approx(slope, rel=1e-2)


def test_flights_with_terms_fly_in_lanes_as_alone_and_zeros_change_no_bit(vehicle):
    one, state = with_terms(vehicle, **ALL), bent_entry_state([0.0, 0.02, 0.01], [0.0, 0.0, 0.0])
    air = simulate.atmosphere_table(windy())
    alone, _ = integrate(one, air, state, 0.002, 10, 51)
    schedule = Schedule(0.002, 10, 51)
    (flown,) = fly_ensemble(one, lambda _: Start(state, simulate.parameter_vector(one), air), [0], schedule)
    np.testing.assert_allclose(flown.states, alone, rtol=1e-9, atol=1e-12)
    plain, _ = integrate(vehicle, air, state, 0.002, 10, 51)
    zeros, _ = integrate(with_terms(vehicle, cl=0.0), air, state, 0.002, 10, 51)
    np.testing.assert_array_equal(plain, zeros)
    assert np.abs(alone[-1, 14:20] - plain[-1, 14:20]).max() > 1e-3


def test_impossible_terms_and_springs_are_refused():
    with pytest.raises(ValidationError, match="roll_share"):
        AeroTerms(roll_order=2)
    joint = {"station_m": 0.2, "bending_stiffness_nmprad": 4e3, "torsion_stiffness_nmprad": 1.0}
    CompliantJoint(**joint, quadratic_nmprad2=-1e4, hardening_nmprad3=1e4)  # falls to a third, and rises again
    for hardening in (0.0, 5e3):
        with pytest.raises(ValidationError):
            CompliantJoint(**joint, quadratic_nmprad2=-1e4, hardening_nmprad3=hardening)
