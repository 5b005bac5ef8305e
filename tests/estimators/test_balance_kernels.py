"""The compiled balances against their readable form, far beyond what any shell does, and where the numbers end."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import balance
from estimators.balance import Swing
from flightmodel.atmosphere import standard_atmosphere
from flightmodel.vehicle import AeroTerms
from synthetic_flight.simulate import fly
from tests.oracles import plain_balance

from .test_closure import EPOCH, START_S, living, pulse_of_truth, start


@pytest.fixture(scope="module")
def loads():
    state = start(30.0, [0.1, -0.15], [0.03, -0.04], np.deg2rad([4.0, -3.0]))
    truth = fly(living(-1.0), standard_atmosphere(), state, START_S, START_S + 2.0, EPOCH, 0.002, 0.01, START_S + 9.0)
    return pulse_of_truth(truth).rows(np.arange(len(truth.time_s)) % 5 == 0)


def swing_of(size_rad, count):
    draws = size_rad * np.random.default_rng(7).standard_normal((3, count, 2))
    return Swing(draws[0], 3.0 * draws[1], 30.0 * draws[2])


@pytest.mark.parametrize("size_rad", [0.0, 1e-9, 1e-3, 0.1, 0.5])
@pytest.mark.parametrize("name", ["force_residual", "axial_residual", "moment_residual"])
def test_kernels_leave_what_the_readable_balances_leave(loads, name, size_rad):
    swing = swing_of(size_rad, len(loads.time_s))
    got, want = (getattr(module, name)(loads.vehicle, swing, loads) for module in (balance, plain_balance))
    # second differences over (1e-4 s)^2 leave rounding of 1e-8 m/s^2 of their own
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("name", ["force_residual", "axial_residual", "moment_residual"])
def test_a_fast_shell_at_small_angles_too(loads, name):
    """Where the rate's terms in the angle come from series."""
    slow = swing_of(1.0, len(loads.time_s))
    swing = Swing(0.003 * slow.theta_yz_rad, slow.rate_yz_radps, slow.acceleration_yz_radps2)
    got, want = (getattr(module, name)(loads.vehicle, swing, loads) for module in (balance, plain_balance))
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-7)  # rounding of larger rates


TERMS = AeroTerms(
    cl=0.01, clp=-0.2, cnr_less_cmq=-0.7, ca_deflection=0.9, cn_deflection=0.4, cm_deflection=-0.2, roll_order=3,
    roll_share=0.15, roll_clock_lv_deg=25.0,
)  # fmt: skip


@pytest.mark.parametrize("size_rad", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("name", ["force_residual", "axial_residual", "moment_residual"])
def test_terms_beyond_the_table_are_those_of_the_readable_balances(loads, name, size_rad):
    swing, vehicle = swing_of(size_rad, len(loads.time_s)), replace(loads.vehicle, aero_terms=TERMS)
    got, want = (getattr(module, name)(vehicle, swing, loads) for module in (balance, plain_balance))
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-8)
    if name != "axial_residual" or size_rad > 0.0:  # of these it has the deflection's alone
        assert np.abs(got - getattr(balance, name)(loads.vehicle, swing, loads)).max() > 1e-4


@pytest.mark.parametrize("name", ["force_residual", "axial_residual", "moment_residual"])
@pytest.mark.parametrize("mach", [0.0, 0.3, 3.0, 50.0])
def test_coefficients_are_held_beyond_the_table_s_mach_numbers(loads, name, mach):
    there = replace(loads, mach=np.full(len(loads.time_s), mach))
    swing = swing_of(0.1, len(loads.time_s))
    got, want = (getattr(module, name)(loads.vehicle, swing, there) for module in (balance, plain_balance))
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-8)


def test_a_flow_that_is_no_number_leaves_none(loads):
    flow = loads.flow_yz_rad.copy()
    flow[3] = np.nan
    left = balance.moment_residual(loads.vehicle, swing_of(0.1, len(flow)), replace(loads, flow_yz_rad=flow))
    assert np.isnan(left[3]).all()
    assert np.isfinite(np.delete(left, 3, axis=0)).all()
