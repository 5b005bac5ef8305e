"""Mass properties that change in flight: the hardware moves on undisturbed, forces act on the new mass; faults."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.atmosphere import standard_atmosphere
from flightmodel.checks import ConfigError
from flightmodel.config import parse_section
from flightmodel.vehicle import MassStep
from synthetic_flight.ensemble import fly_legs
from synthetic_flight.simulate import Schedule, fly
from tests.refusing import refuses

from .conftest import bent_entry_state

AT_S, STOP_S = 0.8, 1.6


def lighter(vehicle, at_s=AT_S, factor=0.7, aside_m=0.02):
    body = vehicle.centerbody
    cg = (body.cg_m + np.array([0.0, aside_m, 0.0])).tolist()
    changed = body.model_copy(update={"mass_kg": factor * body.mass_kg, "cg_from_datum_body_m": tuple(cg)})
    return replace(vehicle, mass_steps=(MassStep(from_s=at_s, centerbody=changed),))


@pytest.fixture(scope="module")
def stepped(vehicle):
    changing = lighter(vehicle)
    state = bent_entry_state([0.0, 0.03, -0.02], [0.0, 0.0, 0.0], altitude_m=50e3)
    return changing, fly(changing, standard_atmosphere(), state, 0.0, STOP_S, "2009-08-17T12:52:00Z")


def test_phases_hold_their_own_masses(vehicle):
    changing = lighter(vehicle)
    assert [p[:2] for p in changing.phases(0.0, STOP_S)] == [(0.0, AT_S), (AT_S, STOP_S)]
    assert changing.at(AT_S - 1e-6).mass_kg == vehicle.mass_kg
    after = vehicle.mass_kg - 0.3 * vehicle.centerbody.mass_kg
    assert changing.at(AT_S).mass_kg == pytest.approx(after)
    np.testing.assert_allclose(changing.mass_at(np.array([0.0, AT_S, 2.0])), [vehicle.mass_kg, after, after])
    # a what-if changes every phase
    heavy = changing.with_bodies(lambda _, part: part.model_copy(update={"mass_kg": 2.0 * part.mass_kg}))
    np.testing.assert_allclose(heavy.mass_at(np.array([0.0, 1.0])), [2.0 * vehicle.mass_kg, 2.0 * after])


def test_hardware_moves_on_undisturbed(stepped):
    """Place and velocity of the datum at the step are where the records before it lead."""
    changing, truth = stepped
    k = int(np.searchsorted(truth.time_s, AT_S - 1e-9))
    path, h = truth.trajectory, truth.time_s[1] - truth.time_s[0]
    # velocity: its slope changes with the mass; over one record that is a g or two times 4 ms
    jump = path.velocity_ecef_mps[k] - 2.0 * path.velocity_ecef_mps[k - 1] + path.velocity_ecef_mps[k - 2]
    assert np.linalg.norm(jump) < 100.0 * h
    middle = 0.5 * h * (path.velocity_ecef_mps[k] + path.velocity_ecef_mps[k - 1])
    assert np.linalg.norm(path.position_ecef_m[k] - path.position_ecef_m[k - 1] - middle) < 1e-3
    np.testing.assert_allclose(path.q_ecef_body[k], path.q_ecef_body[k - 1], atol=0.02)
    # the composite c.g. did move against the datum
    moved = changing.at(AT_S).cg_m - changing.at(0.0).cg_m
    assert np.linalg.norm(moved) > 0.01


def test_drag_acts_on_the_mass_that_is_left(stepped):
    """Mass times axial force over dynamic pressure, C_A S, does not know of the step; the specific force does."""
    changing, truth = stepped
    k = int(np.searchsorted(truth.time_s, AT_S - 1e-9))
    # over a joint's period on each side
    for side in (slice(k - 100, k), slice(k, k + 100)):
        vehicle = changing.at(float(truth.time_s[side][0]))
        felt = truth.specific_force_body(vehicle.cg_m)[side, 0] * vehicle.mass_kg / truth.dynamic_pressure_pa[side]
        found = np.mean(-felt) / vehicle.reference.area_m2
        stated = vehicle.aero.at(truth.mach[side], truth.alpha_shell_rad[side])[:, 0].mean()
        # the deflection's cosine, and what the lateral force of a deflected shell gives along the body
        assert found == pytest.approx(stated, rel=0.02)
    # and to_frame's energy is that of each record's own masses
    assert len(truth.to_frame()) == len(truth.time_s)


def test_a_step_that_changes_nothing_changes_nothing(vehicle):
    same = replace(vehicle, mass_steps=(MassStep(from_s=AT_S, centerbody=vehicle.centerbody),))
    state = bent_entry_state([0.0, 0.03, -0.02], [0.0, 0.0, 0.0])
    one, two = (fly(v, standard_atmosphere(), state, 0.0, STOP_S, "2009-08-17T12:52:00Z") for v in (vehicle, same))
    # positions of 6.4e6 m are taken apart and put together once
    np.testing.assert_allclose(two.state_eci, one.state_eci, rtol=1e-9, atol=1e-8)


def test_events_give_the_times_and_unknown_ones_are_refused(vehicle):
    step = MassStep(event="cover gone", centerbody=vehicle.centerbody)
    named = replace(vehicle, mass_steps=(step, MassStep(from_s=5.0, aeroshell=vehicle.aeroshell)))
    timed = named.with_events([("cover gone", 7.0)])
    assert [s.from_s for s in timed.mass_steps] == [5.0, 7.0]
    with refuses("name-unknown", names=["cover gon"], kind=ConfigError):
        named.with_events([("cover gonne", 7.0)])


def test_faults_of_a_step_are_named():
    for tables in ({"from_s": 1.0}, {"aeroshell": {}}, {"from_s": 1.0, "event": "x"}):
        with pytest.raises(ConfigError):
            parse_section(MassStep, tables, "vehicle.toml")


def test_ensembles_refuse_them(vehicle):
    with refuses("mass-changes", kind=ConfigError):
        fly_legs(lighter(vehicle), [], [], [Schedule(0.002, 1, 1)])
