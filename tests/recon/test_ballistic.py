"""Flight by gravity and drag: twin, derivatives, an independent integrator, energy, noise, and honest covariance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec, solve_ivp
from scipy.stats import chi2

from flightmodel import earth, rotations
from recon import propagation
from recon.propagation import ballistic_motion, propagate
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.state import States, boxminus, boxplus
from tests.oracles import ballistic as plain_ballistic

from .ballistic_flight import (
    LATITUDE,
    LONGITUDE,
    SPEC,
    across_plane,
    entry_state,
    fly,
    squared_errors,
    watch,
    windy_sounding,
)

ACROSS = across_plane(entry_state())
DRIVERS = np.array([0.1, 0.05, -0.08, 0.7, -1.1, 0.6])
NODES = np.array([0.0, 0.3137, 5.0, 20.0, 60.0, 61.003])
# position, velocity, rotation, drag, side forces, density, winds
STEPS = np.repeat([10.0, 0.05, 1e-3, 1e-3, 1e-3], 3)


def airless(motion):
    """Same motion without drag."""
    return motion._replace(drag_m2pkg=0.0)


@pytest.fixture(scope="module")
def carried():
    spec = replace(SPEC, drag_area_per_mass_m2pkg=0.01, powered_s=((10.0, 12.0),))
    motion, index = ballistic_motion(spec, windy_sounding(), ACROSS, NODES)
    start = entry_state(60e3, (800.0, 1500.0, 900.0))
    return motion, index, replace(start, sensor_errors=np.concatenate([DRIVERS, [9.0, 9.0]]))


@pytest.mark.parametrize(
    ("first", "last"), [(0, 1), (0, 2), (2, 0), pytest.param(0, 5, marks=pytest.mark.long), (4, 5), (5, 4)]
)
def test_kernel_equals_readable_twin(carried, first, last):
    """60 s of entry at up to 50 g amplify a position's rounding of 1e-9 m; 2e-6 m measured."""
    motion, index, start = carried
    fast = propagate(motion, index[first], index[last], start)
    plain = plain_ballistic.propagate(motion, index[first], index[last], start)
    assert np.abs(fast.state.position_ecef_m - plain.state.position_ecef_m).max() < 1e-9 * 6.4e6
    assert np.abs(fast.state.velocity_ecef_mps - plain.state.velocity_ecef_mps).max() < 1e-9 * 1900.0
    assert np.array_equal(fast.state.q_ecef_body, start.q_ecef_body)
    # partials are differences of 1e-4 in a driver: rounding 1e-12 of a force
    size = np.abs(plain.transition).reshape(3, 3, 5, 3).max(axis=(1, 3)).repeat(3, axis=0).repeat(3, axis=1)
    assert (np.abs(fast.transition - plain.transition) <= 1e-8 * size).all()
    assert np.abs(fast.noise - plain.noise).max() <= 1e-9 * np.abs(plain.noise).max()


@pytest.mark.parametrize(("first", "last"), [(0, 2), (0, 5), (3, 0)])
def test_transition_is_the_derivative_in_every_column(carried, first, last):
    """Second order in a step of 0.05 s half way, tables with knots: 1.2e-4 of a column measured."""
    motion, index, start = carried
    transition = propagate(motion, index[first], index[last], start).transition
    for j in range(15):
        e = np.zeros(17)
        e[j] = STEPS[j]
        ends = [propagate(motion, index[first], index[last], boxplus(start, s * e)).state for s in (1.0, -1.0)]
        column = boxminus(*ends)[:9] / (2.0 * STEPS[j])
        for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
            size = np.abs(column[rows]).max()
            assert np.abs(transition[rows, j] - column[rows]).max() <= 2e-4 * size + 1e-12, (j, rows)
    assert (np.abs(transition[:6, 9:]).max(axis=0) > 0.5).all()  # every driver does something
    assert np.array_equal(transition[6:9], np.hstack([np.zeros((3, 6)), np.eye(3), np.zeros((3, 6))]))


def test_entry_follows_an_independent_integrator(carried):
    """Forces written here from the day's air and the Earth's shape; DOP853. Step error of 0.05 s: 5e-5 m measured."""
    motion, index, start = carried
    table = propagation.air_table(windy_sounding())
    spin = earth.OMEGA_ECEF_RADPS

    def slope(_t, y):
        r, v = y[:3], y[3:]
        latitude, longitude, height = (float(x) for x in earth.geodetic_from_ecef(r))
        row = int((height - propagation.AIR_FROM_M) // propagation.AIR_STEP_M)
        w = (height - propagation.AIR_FROM_M) / propagation.AIR_STEP_M - row
        log_density, north, east, density_sd, wind_sd = (1.0 - w) * table[row] + w * table[row + 1]
        ned = earth.dcm_ned_ecef(latitude, longitude)
        wind = ned.T @ [north + DRIVERS[4] * wind_sd, east + DRIVERS[5] * wind_sd, 0.0]
        u = v - wind
        speed = np.linalg.norm(u)
        pressure = 0.5 * np.exp(log_density + DRIVERS[3] * density_sd) * speed**2
        push = pressure * 0.01 * np.exp(DRIVERS[0])
        flow = u / speed
        across = np.cross(np.cross(flow, ACROSS), flow)
        across /= np.linalg.norm(across)
        force = push * (-flow + DRIVERS[1] * across + DRIVERS[2] * np.cross(flow, across))
        return np.r_[v, force + earth.gravitation(r) - np.cross(spin, np.cross(spin, r)) - 2.0 * np.cross(spin, v)]

    y = np.r_[start.position_ecef_m, start.velocity_ecef_mps]
    end = solve_ivp(slope, (0.0, 20.0), y, method="DOP853", rtol=1e-11, atol=1e-8, max_step=0.2).y[:, -1]
    state = propagate(motion, 0, index[3], start).state
    assert np.abs(state.position_ecef_m - end[:3]).max() < 5e-4
    assert np.abs(state.velocity_ecef_mps - end[3:]).max() < 2e-5
    assert np.linalg.norm(end[3:]) < 0.85 * np.linalg.norm(start.velocity_ecef_mps)


def test_a_parachute_that_sinks_straight_down_has_side_forces_with_steady_axes():
    """Level and upright axes turn by 90 deg for 0.1 m/s of drift here; the flow itself by 1 deg."""
    calm = replace(SPEC, drag_area_per_mass_m2pkg=0.4)
    motion, _ = ballistic_motion(calm, windy_sounding(), ACROSS, np.array([0.0, 5.0]))
    start = entry_state(2e3, (0.0, 0.0, 7.0), errors=6)
    wind = np.array(
        [np.interp(2e3, propagation.AIR_FROM_M + 100.0 * np.arange(len(motion.air)), c) for c in motion.air.T]
    )
    ned = earth.dcm_ned_ecef(LATITUDE, LONGITUDE)
    down = np.array([wind[1], wind[2], 7.0])
    drivers = np.array([0.0, 0.3, -0.2, 0.0, 0.0, 0.0])

    def push(drift):
        velocity = (down + drift) @ ned
        sides, none = (
            plain_ballistic.acceleration(motion, start.position_ecef_m, velocity, d) for d in (drivers, 0.0 * drivers)
        )
        return sides - none

    still = push(np.zeros(3))
    assert np.linalg.norm(still) > 2.0
    for drift in np.array([[0.1, 0.0, 0.0], [0.0, -0.1, 0.0], [-0.1, 0.1, 0.0]]):
        turned = np.linalg.norm(push(drift) - still) / np.linalg.norm(still)
        assert turned < 1.1 * np.linalg.norm(drift) / 7.0


@pytest.mark.parametrize("drag", [4.0, *(pytest.param(drag, marks=pytest.mark.long) for drag in (40.0, 400.0))])
def test_a_drag_that_stops_the_vehicle_within_a_step_is_followed(drag):
    """Against Radau's method with differences of its ends; drag takes 3 to 300 times the airspeed in the step."""
    spec = replace(SPEC, drag_area_per_mass_m2pkg=drag)
    motion, index = ballistic_motion(spec, windy_sounding(), ACROSS, np.array([0.0, 0.05]))
    start = entry_state(9e3, (300.0, 0.0, 0.0), errors=6)

    def slope(_t, y):
        return np.r_[y[3:], plain_ballistic.acceleration(motion, y[:3], y[3:], np.zeros(6))]

    def end(velocity):
        y = np.r_[start.position_ecef_m, velocity]
        return solve_ivp(slope, (0.0, 0.05), y, method="Radau", rtol=1e-9, atol=1e-9).y[:, -1]

    step, truth = propagate(motion, index[0], index[1], start), end(start.velocity_ecef_mps)
    assert np.linalg.norm(truth[3:]) < 0.5 * 300.0
    assert np.abs(step.state.position_ecef_m - truth[:3]).max() < 1e-3
    assert np.abs(step.state.velocity_ecef_mps - truth[3:]).max() < 1e-3 * 300.0
    plain = plain_ballistic.propagate(motion, index[0], index[1], start)
    assert np.abs(step.state.velocity_ecef_mps - plain.state.velocity_ecef_mps).max() < 1e-9 * 300.0
    # differences of 1e-4 in a driver, of a force of 1e6 m/s^2 here
    assert np.abs(step.transition - plain.transition).max() < 1e-6 * np.abs(plain.transition).max()
    assert np.abs(step.noise - plain.noise).max() < 1e-6 * plain.noise.max()
    by_velocity = [(end(start.velocity_ecef_mps + d) - end(start.velocity_ecef_mps - d)) / 2.0 for d in np.eye(3)]
    assert np.abs(step.transition[3:6, 3:6] - np.transpose(by_velocity)[3:]).max() < 0.01


def test_air_table_is_the_days_air():
    table = propagation.air_table(windy_sounding())
    sounding = windy_sounding()
    row = int((12e3 - propagation.AIR_FROM_M) / propagation.AIR_STEP_M)
    assert np.isclose(np.exp(table[row, 0]), sounding.density_kgpm3[12], rtol=1e-6)
    assert np.allclose(table[row, 1:], [sounding.wind_north_mps[12], sounding.wind_east_mps[12], 0.10, 15.0], rtol=1e-6)


def test_without_air_energy_stays():
    """Jacobi's constant in the turning frame, with J2: 400 s over 600 km, Runge-Kutta steps of 0.05 s."""
    motion, index = ballistic_motion(SPEC, windy_sounding(), ACROSS, np.array([0.0, 400.0]))
    start = entry_state(200e3, (1500.0, 2500.0, -1500.0), errors=6)

    def jacobi(s):
        turn = np.cross(earth.OMEGA_ECEF_RADPS, s.position_ecef_m)
        return 0.5 * (s.velocity_ecef_mps @ s.velocity_ecef_mps - turn @ turn) - earth.potential(s.position_ecef_m)

    end = propagate(airless(motion), index[0], index[1], start).state
    assert np.linalg.norm(end.position_ecef_m - start.position_ecef_m) > 500e3
    assert abs(jacobi(end) - jacobi(start)) < 1e-13 * 8000 * abs(jacobi(start))
    # without J2 or the centrifugal part it would not: both are 1e-3 of it
    spherical = 0.5 * end.velocity_ecef_mps @ end.velocity_ecef_mps - earth.GM_M3PS2 / np.linalg.norm(
        end.position_ecef_m
    )
    begun = 0.5 * start.velocity_ecef_mps @ start.velocity_ecef_mps - earth.GM_M3PS2 / np.linalg.norm(
        start.position_ecef_m
    )
    assert abs(spherical - begun) > 1e-5 * abs(begun)


def test_air_takes_energy_only_and_wind_turns_with_the_earth():
    """A body at rest in still air that turns with the Earth feels no force of the air."""
    motion, index = ballistic_motion(SPEC, windy_sounding(), ACROSS, np.array([0.0, 0.05]))
    still = motion._replace(air=motion.air * [1.0, 0.0, 0.0, 1.0, 1.0])
    start = entry_state(20e3, (0.0, 0.0, 0.0), errors=6)
    with_air, without = (
        propagate(m, index[0], index[1], start).state.velocity_ecef_mps for m in (still, airless(still))
    )
    assert np.abs(with_air - without).max() < 1e-5
    assert np.abs(with_air).max() > 0.3  # 0.05 s of falling


def test_noise_is_the_integral_of_the_transition(carried):
    """Q = int phi(t, s) q phi(t, s)^T ds, the transitions from differences of trajectories; powered span in it."""
    motion, index, start = carried
    nodes = np.linspace(0.0, 20.0, 81)
    spec = replace(SPEC, drag_area_per_mass_m2pkg=0.01, powered_s=((10.0, 12.0),), powered_sd_mps2=3.0)
    motion, index = ballistic_motion(spec, windy_sounding(), ACROSS, nodes)
    claimed = propagate(motion, index[0], index[-1], start).noise[:6, :6]
    states = [start]
    for k in range(80):
        states.append(propagate(motion, index[k], index[k + 1], states[-1]).state)
    response = []
    for k in range(81):
        columns = []
        for j in range(3, 6):
            e = np.zeros(17)
            e[j] = 0.05
            ends = [propagate(motion, index[k], index[-1], boxplus(states[k], s * e)).state for s in (1.0, -1.0)]
            columns.append(boxminus(*ends)[:6] / 0.1)
        response.append(np.array(columns).T)
    response = np.array(response)

    def integrand(t):
        k = min(int(t / 0.25), 79)
        w = t / 0.25 - k
        b = (1.0 - w) * response[k] + w * response[k + 1]
        density = SPEC.acceleration_density**2 + (9.0 if 10.0 <= t < 12.0 else 0.0)
        return density * b @ b.T

    whole = sum(quad_vec(integrand, a, b, epsrel=1e-8)[0] for a, b in ((0.0, 10.0), (10.0, 12.0), (12.0, 20.0)))
    sd = np.sqrt(np.diag(whole))
    assert (np.abs(claimed - whole) / np.outer(sd, sd)).max() < 2e-3  # responses joined over 0.25 s


def test_powered_spans_open_the_noise():
    spec = replace(SPEC, powered_s=((1.0, 2.0), (3.0, 3.5)), powered_sd_mps2=7.0)
    motion, _ = ballistic_motion(spec, windy_sounding(), ACROSS, np.array([0.0, 0.5, 4.0]))
    t = motion.time_s
    assert np.diff(t).max() < propagation.GRID_STEP_S + 1e-9
    powered = ((t >= 1.0) & (t < 2.0)) | ((t >= 3.0) & (t < 3.5))
    assert np.allclose(motion.force_density[powered], SPEC.acceleration_density**2 + 49.0)
    assert np.allclose(motion.force_density[~powered], SPEC.acceleration_density**2)


@pytest.mark.parametrize(("gap", "runs"), [(None, 6), ((30.0, 55.0), 6)])
def test_falls_err_as_they_claim(gap, runs):
    """Falls drawn from the model itself, radars with biases, with and without a gap in which only drag carries on."""
    at = (10.0, 25.0, 45.0, 65.0)
    values = []
    for seed in range(runs):
        t, states = fly(seed, end_s=70.0)
        r = reconstruct(watch(t, states, seed, gap_s=gap), Settings(output_rate_hz=2.0))
        assert r.provenance["motion"] == "ballistic"
        assert np.allclose(np.diagonal(r.smoothed.covariance, axis1=1, axis2=2)[:, 6:9], np.pi**2 / 3.0)
        values.append([squared_errors(r.smoothed, states, at), squared_errors(r.filtered, states, at)])
        table = r.sensor_errors.set_index("name")
        assert (table.sd[:6] < 1.001 * table.prior_sd[:6]).all()
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * runs) / runs
    mean = np.mean(values, axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean


def test_a_gap_costs_the_same_at_any_output_rate():
    """Drivers stand still within a step; nodes half a second apart keep that from showing."""
    t, states = fly(1, end_s=70.0)
    telemetry = watch(t, states, 1, gap_s=(30.0, 60.0))
    sd = [
        r.smoothed.sd()[int(np.argmin(np.abs(r.smoothed.time_s - 50.0))), :6]
        for r in (reconstruct(telemetry, Settings(output_rate_hz=rate)) for rate in (20.0, 0.1))
    ]
    assert np.allclose(sd[0], sd[1], rtol=0.01)


@pytest.mark.long
def test_reentry_of_the_known_benchmark_errs_as_it_claims():
    """The geometry of Julier and Uhlmann's re-entry, seen as a missile's: speed 7 km/s, drag known to a factor of two.

    Their planet neither turns nor bulges, so their numbers do not carry over; what does is a strongly non-linear fall
    of 200 s, a radar on the ground below, and a drag whose logarithm starts 0.7 off with a standard deviation of one.
    """
    spec = replace(SPEC, drag_area_per_mass_m2pkg=0.008, drag_sd=0.7, drag_time_constant_s=200.0, side_sd=0.01)
    values, at = [], (20.0, 40.0, 60.0, 80.0, 95.0)
    runs = 50
    for seed in range(runs):
        t, states = fly(seed, 100.0, spec, 125e3, (-800.0, 6500.0, 2200.0))
        telemetry = replace(watch(t, states, seed), motion=spec)
        r = reconstruct(telemetry, Settings(output_rate_hz=1.0))
        values.append([squared_errors(r.smoothed, states, at), squared_errors(r.filtered, states, at)])
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * runs) / runs
    mean = np.mean(values, axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean


def test_readable_acceleration_has_no_attitude_in_it(carried):
    motion, index, start = carried
    turned = States(
        start.position_ecef_m, start.velocity_ecef_mps, rotations.exp(np.array([0.3, 1.0, -2.0])), start.sensor_errors
    )
    one, other = (propagate(motion, index[0], index[3], s).state for s in (start, turned))
    assert np.array_equal(one.position_ecef_m, other.position_ecef_m)
    assert np.array_equal(other.q_ecef_body, turned.q_ecef_body)
