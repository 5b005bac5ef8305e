"""Flights side by side: the same flights, in order, in any company, in vector registers."""

import re
from dataclasses import replace

import numba
import numpy as np
import pytest

from flightmodel import earth
from flightmodel._kernels import FASTMATH
from flightmodel.checks import ConfigError
from synthetic_flight import _kernels, simulate
from synthetic_flight.ensemble import LANES, Start, fly_ensemble
from synthetic_flight.scenarios import child_rng
from synthetic_flight.simulate import Schedule, integrate
from synthetic_flight.weather import AUGUST, DayOfFlightAtmosphere, day_of_flight_atmosphere

from .conftest import entry_state

SCHEDULE = Schedule(step_s=0.005, per_record=40, records=51)  # 10 s


@pytest.fixture(scope="module")
def dispersed(vehicle):
    """Every flight another vehicle, another start, another day."""

    def start_of(run):
        rng = np.random.default_rng([7, run])
        stiffness = 4335.0 * np.exp(0.2 * rng.standard_normal())
        joint = vehicle.joint.model_copy(update={"bending_stiffness_nmprad": stiffness})
        factors = 1.0 + 0.05 * rng.standard_normal(3)
        profile = day_of_flight_atmosphere(DayOfFlightAtmosphere(), child_rng(run, "atmosphere"), AUGUST)
        state = entry_state(vehicle, alpha_deg=3.0 + rng.random(), spin_rpm=10.0 * rng.random())
        state[:3] *= 1.0 - 30e3 / np.linalg.norm(state[:3])
        p = simulate.parameter_vector(replace(vehicle, joint=joint), *factors, cmq_shift=0.1 * rng.standard_normal())
        return Start(state, p, simulate.atmosphere_table(profile))

    return start_of


def test_lanes_fly_what_one_flight_alone_flies(vehicle, dispersed):
    flown = list(fly_ensemble(vehicle, dispersed, range(20), SCHEDULE))
    assert [f.run for f in flown] == list(range(20))
    for f in (flown[0], flown[7], flown[19]):
        start = dispersed(f.run)
        # the vehicle alone: the same parameters, coefficients scaled in the table instead
        p = start.parameters
        joint = vehicle.joint.model_copy(update={"bending_stiffness_nmprad": float(p[52])})
        alone = replace(vehicle, joint=joint, aero=vehicle.aero.scaled(*p[63:67]))
        states, aux = integrate(alone, start.atmosphere, start.state, 0.005, 40, 51)
        # other instruction order only: 2000 steps of rounding, grown by a motion that is nearly unstable
        np.testing.assert_allclose(f.states[:, :3], states[:, :3], atol=2e-6)
        np.testing.assert_allclose(f.states[:, 6:], states[:, 6:], atol=1e-9)
        np.testing.assert_allclose(f.aux, aux, rtol=1e-6, atol=1e-6)
        assert aux[-1, 3] > 100.0  # pascals: the air is alive


def test_a_flight_is_the_same_bytes_in_any_company(vehicle, dispersed):
    together = {f.run: f for f in fly_ensemble(vehicle, dispersed, range(18), SCHEDULE, workers=2)}
    alone = next(fly_ensemble(vehicle, dispersed, [5], SCHEDULE, workers=1))
    last = next(fly_ensemble(vehicle, dispersed, [17, 3], SCHEDULE, workers=1))
    assert together[5].states.tobytes() == alone.states.tobytes()
    assert together[17].aux.tobytes() == last.aux.tobytes()


def test_a_diverging_joint_ends_its_own_flight_only(vehicle, dispersed):
    def start_of(run):
        start = dispersed(run)
        if run == 3:
            start.parameters[52] = -2.0e4  # a spring that pushes
        if run == 4:
            start.state[14] = np.nan
        return start

    flown = list(fly_ensemble(vehicle, start_of, range(6), SCHEDULE))
    assert [f.diverged for f in flown] == [False, False, False, True, True, False]
    assert len(flown[3].states) < 51
    assert len(flown[4].states) == 0  # not a number from the start
    assert all(np.isfinite(f.states).all() and len(f.states) == 51 for f in flown if not f.diverged)


def test_wrong_schedules_are_refused(vehicle, dispersed):
    for schedule, workers in ((replace(SCHEDULE, step_s=0.0), 1), (SCHEDULE, 0)):
        with pytest.raises(ConfigError) as refusal:
            list(fly_ensemble(vehicle, dispersed, range(2), schedule, workers=workers))
        assert refusal.value.codes == ("argument-value",)


@pytest.mark.parametrize(
    "name", ["_attitudes", "_position", "_flow", "_loads", "_joint", "_creep", "_joined", "_rigid"]
)
def test_vector_loops_are_in_vector_registers(vehicle, name):
    """A branch or an alias that the compiler cannot see through would undo this in silence."""
    lanes, planet = (0,) * LANES, earth.WGS84
    s = simulate.workspace(np.zeros((LANES, 20)), np.tile(simulate.parameter_vector(vehicle), (LANES, 1)))
    loop = getattr(_kernels, name)
    anew = numba.njit(error_model="numpy", fastmath=FASTMATH)(loop.py_func)
    anew(s, lanes, planet) if loop.py_func.__code__.co_argcount == 3 else anew(s, lanes)
    (assembly,) = anew.inspect_asm().values()
    arithmetic = r"\n\s+v?(?:f?n?m?add|f?n?m?sub|fn?m(?:add|sub)\d+|mul|div|sqrt|add|sub)"
    packed, scalar = (len(re.findall(arithmetic + kind, assembly)) for kind in ("pd", "sd"))
    if not re.search(r"[xyz]mm", assembly):
        pytest.skip("no x86 vector registers on this machine")
    assert packed > 10 * scalar, f"{name}: {packed} vector instructions, {scalar} scalar ones"
