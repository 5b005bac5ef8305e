"""The estimators' balances close on true histories of the simulator, every term alive, at rest and under spin.

True motion, true air and true forces go in, nothing is measured; what is left of a balance at the true deflection is
what the equation leaves out of the simulator's physics.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from estimators.balance import Swing, axial_residual, force_residual, moment_residual
from estimators.loads import FlightLoads
from estimators.misalignment import misalignment_evidence
from estimators.trim import moment_term, solve_trim, trim_evidence, trim_model
from flightmodel import airdata, earth, rotations
from flightmodel.atmosphere import standard_atmosphere
from flightmodel.vehicle import AeroTerms
from synthetic_flight.simulate import fly, state_from_ecef
from tests.oracles.plain_balance import axes, relative_rate
from tests.synthetic_flight.conftest import with_constant_cmq

from .conftest import VEHICLE

START_S, EPOCH = 420.0, "2009-08-17T12:50:00Z"
RPM = (0.0, 6.0, 30.0, 60.0)


def start(rpm, lateral_radps, off_rad, bent_rad):
    """Near peak pressure: 45 km, 1050 m/s; ``off_rad`` off the velocity and ``bent_rad`` bent, both vectors (y, z)."""
    r = earth.ecef_from_geodetic(np.deg2rad(37.0), np.deg2rad(-74.3), 45e3)
    path, azimuth = np.deg2rad([-76.5, 130.0])
    way = np.array([np.cos(path) * np.cos(azimuth), np.cos(path) * np.sin(azimuth), -np.sin(path)])
    v = earth.ecef_from_ned(1050.0 * way, r)
    x = v / np.linalg.norm(v)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    q = rotations.q_from_dcm(np.column_stack([x, y, np.cross(x, y)])[None])[0]
    q = rotations.boxplus(q, np.array([0.0, *off_rad]))
    spin = np.array([rpm * 2.0 * np.pi / 60.0, *lateral_radps])
    return state_from_ecef(START_S, r, v, q, spin, rotations.exp(np.array([0.0, *bent_rad])))


def pulse_of_truth(truth):
    vehicle, n = truth.vehicle, len(truth.time_s)
    air = airdata.air_data(truth.trajectory, truth.profile, vehicle.cg_m)
    return FlightLoads(
        time_s=truth.time_s,
        specific_force_body_mps2=truth.specific_force_body(vehicle.cg_m),
        force_noise_sd_mps2=0.0,
        force_root_mps2=np.zeros((n, 3, 9)),
        flow_root_rad=np.zeros((n, 2, 9)),
        rate_root_radps=np.zeros((n, 3, 9)),
        rate_body_radps=truth.state_eci[:, 14:17],
        angular_acceleration_body_radps2=truth.angular_acceleration_body_radps2,
        angular_acceleration_sd_radps2=0.0,
        flow_yz_rad=airdata.lateral_angles(air.velocity_air_body_mps),
        flow_cov=np.zeros((n, 2, 2)),
        wind_flow_sd_rad=np.zeros(n),
        altitude_m=air.altitude_m,
        mach=truth.mach,
        dynamic_pressure_pa=truth.dynamic_pressure_pa,
        dynamic_pressure_sd_pa=np.zeros(n),
        airspeed_mps=air.airspeed_mps,
        vehicle=vehicle,
        point_from_datum_m=vehicle.cg_m,
    )


def living(cmq=None):
    """Vehicle with an offset, products of inertia, three moments that differ, and pitch damping of some size."""
    body = VEHICLE.centerbody.model_copy(
        update={
            "cg_from_datum_body_m": (-0.52, 0.006, -0.002),
            "inertia_kgm2": ((2.1, 0.1, -0.25), (0.1, 25.0, 0.6), (-0.25, 0.6, 23.0)),
        }
    )
    aero = VEHICLE.aero if cmq is None else with_constant_cmq(VEHICLE.aero, cmq)
    return replace(VEHICLE, centerbody=body, aero=aero)


def left_deg(truth, swing):
    """What is left of both balances at a swing, as a deflection, deg (n, 2) each."""
    pulse, vehicle = pulse_of_truth(truth), truth.vehicle
    force = force_residual(vehicle, swing, pulse)
    moment = moment_residual(vehicle, swing, pulse) / trim_model(vehicle).xbar_m
    return np.rad2deg(force), np.rad2deg(moment)


def swing_of(truth):
    """True deflection and its derivatives, those by a spline through the records."""
    return Swing.of(CubicSpline(truth.time_s, truth.deflection.theta_yz_rad), truth.time_s)


@pytest.mark.parametrize("cmq", [None, -1.0])
@pytest.mark.parametrize("bent_deg", [0.0, 3.0, 30.0])
@pytest.mark.parametrize("rpm", RPM)
def test_balances_of_a_locked_joint_close(rpm, bent_deg, cmq):
    # bent by up to 30 deg and locked there, the equations leave nothing out: an oscillation of 4 deg, rates of
    # 0.2 rad/s across the spin and pitch damping leave rounding
    bent = np.deg2rad(bent_deg) * np.array([0.8, -0.6])
    state = start(rpm, [0.1, -0.15], np.array([0.03, -0.04]) - bent, bent)
    vehicle = living(cmq)
    stop = START_S + (0.2 if bent_deg > 10.0 else 2.0)  # bent so far it soon turns fast and wide
    truth = fly(vehicle, standard_atmosphere(), state, START_S, stop, EPOCH, 0.002, 0.01, START_S + 9.0)
    force, moment = left_deg(truth, Swing.held(truth.deflection.theta_yz_rad))
    np.testing.assert_allclose(force, 0.0, atol=1e-5)
    # damping takes the c.g.'s airspeed, not the nose's: of a fast turn by the 30 deg's lever it leaves more
    np.testing.assert_allclose(moment, 0.0, atol=5e-3 if bent_deg > 10.0 else 2e-4)
    if bent_deg < 10.0:
        # and the deflection is found from nothing
        pulse = pulse_of_truth(truth)
        for evidence in (trim_evidence, misalignment_evidence):
            read = evidence(pulse).theta_yz_rad
            np.testing.assert_allclose(np.rad2deg(read - truth.deflection.theta_yz_rad), 0.0, atol=1e-3)


@pytest.mark.parametrize("rpm", RPM)
def test_balances_close_with_terms_beyond_the_table_and_not_without(rpm):
    """Coning, roll dependence and increments by deflection, a locked joint bent by 5 deg; one left out leaves 0.05."""
    bent = np.deg2rad([4.0, -3.0])
    terms = {
        "coning": {"cnr_less_cmq": -20.0},
        "axial": {"ca_deflection": 20.0},
        "normal": {"cn_deflection": 0.3},
        "moment": {"cm_deflection": -0.1},
        "roll": {"roll_order": 2, "roll_share": 0.3, "roll_clock_lv_deg": 20.0},
    }
    vehicle = living(-1.0)
    every = {key: value for one in terms.values() for key, value in one.items()}
    flown = replace(vehicle, aero_terms=AeroTerms(**every))
    state = start(rpm, [0.1, -0.15], np.array([0.08, -0.06]) - bent, bent)
    truth = fly(flown, standard_atmosphere(), state, START_S, START_S + 2.0, EPOCH, 0.002, 0.01, START_S + 9.0)
    swing = Swing.held(truth.deflection.theta_yz_rad)
    force, moment = left_deg(truth, swing)
    np.testing.assert_allclose(force, 0.0, atol=1e-5)
    # damping takes the c.g.'s airspeed, not the nose's
    np.testing.assert_allclose(moment, 0.0, atol=1e-3)
    np.testing.assert_allclose(axial_residual(flown, swing, pulse_of_truth(truth)), 0.0, atol=1e-5)
    for name, own in terms.items():
        rest = {key: value for key, value in every.items() if key not in own}
        other = replace(truth, vehicle=replace(flown, aero_terms=AeroTerms(**rest)))
        assert max(np.abs(left).max() for left in left_deg(other, swing)) > 0.05, name


def test_each_term_of_the_balances_is_alive():
    # what a term weighs, as a deflection in deg, at 30 rpm: left out, it does not close to a tenth of that
    state = start(30.0, [0.1, -0.15], [0.03, -0.04], np.deg2rad([4.0, -3.0]))
    vehicle = living(-1.0)
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 2.0, EPOCH, 0.002, 0.01, START_S + 9.0)
    bent = Swing.held(truth.deflection.theta_yz_rad)
    pulse = pulse_of_truth(truth)

    def largest(**changed):
        one = replace(pulse, **changed)
        force = force_residual(vehicle, bent, one)
        moment = moment_residual(vehicle, bent, one) / trim_model(vehicle).xbar_m
        return [float(np.rad2deg(np.abs(x).max())) for x in (force, moment)]

    still = np.zeros_like(pulse.rate_body_radps)
    assert min(largest(rate_body_radps=still)) > 0.05  # centrifugal and gyroscopic
    assert largest(angular_acceleration_body_radps2=still)[1] > 0.5
    undamped = replace(vehicle, aero=with_constant_cmq(vehicle.aero, 0.0))
    assert np.rad2deg(np.abs(moment_residual(undamped, bent, pulse)).max()) > 0.01
    # the undeflected vehicle's inertia and c.g. instead of the deflected one's
    straight = _small_angle(vehicle, pulse)
    assert np.rad2deg(np.abs(straight - truth.deflection.theta_yz_rad).max()) > 0.05


def _small_angle(vehicle, pulse):
    model = trim_model(vehicle)
    return solve_trim(model, pulse.mach, pulse.flow_yz_rad, moment_term(model, pulse))


@pytest.mark.parametrize("spin_radps", [0.0, 0.63, 3.14])
def test_free_rotation_needs_no_offset(spin_radps):
    # angular momentum at rest in inertial space: I w' + w x I w is nothing, whatever the tensor
    tensor = rotations.rotate(rotations.exp(np.array([0.2, -0.3, 0.1])), np.diag([48.0, 60.0, 66.0]))
    tensor = tensor @ rotations.dcm_from_q(rotations.exp(np.array([0.2, -0.3, 0.1]))).T
    tensor = 0.5 * (tensor + tensor.T)
    momentum, step = tensor @ np.array([spin_radps, 0.2, -0.3]), 1e-4
    turn = np.array([spin_radps, 0.2, -0.3])

    def rate(time_s):
        # momentum in axes that turn with the body, by small steps of the body's own rate
        q, w, n = np.array([1.0, 0.0, 0.0, 0.0]), turn, 40
        for _ in range(n):
            half = rotations.boxplus(q, 0.5 * time_s / n * w)
            w = np.linalg.solve(tensor, rotations.rotate(rotations.conjugate(half), momentum))
            q = rotations.boxplus(q, time_s / n * w)
            w = np.linalg.solve(tensor, rotations.rotate(rotations.conjugate(q), momentum))
        return w

    turning = (rate(step) - rate(-step)) / (2.0 * step)
    state = start(0.0, [0.0, 0.0], [0.01, 0.0], [0.0, 0.0])
    truth = fly(VEHICLE, standard_atmosphere(), state, START_S, START_S + 0.02, EPOCH, 0.002, 0.01, START_S + 1.0)
    one = pulse_of_truth(truth)
    n = len(one.time_s)
    moving = replace(
        one, rate_body_radps=np.tile(turn, (n, 1)), angular_acceleration_body_radps2=np.tile(turning, (n, 1))
    )
    model = replace(trim_model(VEHICLE), aero=with_constant_cmq(VEHICLE.aero, 0.0), inertia_kgm2=tensor)
    # 1 N m at this pressure is 0.1 mm of offset; differences over 0.1 ms leave 1e-6 of the moments of some N m
    np.testing.assert_allclose(moment_term(model, moving), 0.0, atol=1e-9)


def swinging():
    """Vehicle whose shell has its c.g. 0.8 m aft of the joint: the bodies' reduced mass is a third of the swing."""
    joint = VEHICLE.joint.model_copy(update={"bending_damping_nmsprad": 0.0, "bending_stiffness_nmprad": 9000.0})
    return replace(
        VEHICLE,
        joint=joint,
        aeroshell=VEHICLE.aeroshell.model_copy(update={"cg_from_datum_body_m": (-1.0, 0.0, 0.0)}),
        centerbody=VEHICLE.centerbody.model_copy(update={"cg_from_datum_body_m": (-0.52, 0.0, 0.0)}),
        aero=VEHICLE.aero.scaled(cm=1.6),
    )


@pytest.mark.parametrize("rpm", RPM)
def test_a_ringing_joint_is_read_through_its_rate_and_acceleration(rpm):
    # half a degree of swinging at 4 Hz moves the readings by as much again; what is left beside it is the difference
    # of a spline through records 1 ms apart, and of the trim 54 Hz of twist, which the equations do not have
    vehicle = swinging()
    state = start(rpm, [0.1, -0.15], [0.005, -0.0065], [0.005, -0.006])
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 1.5, EPOCH, 0.0005, 0.001)
    swing, inner = swing_of(truth), slice(10, -10)
    held = [x[inner] for x in left_deg(truth, Swing.held(swing.theta_yz_rad))]
    for left, without, allowed in zip(left_deg(truth, swing), held, (0.0005, 0.005), strict=True):
        assert np.sqrt(np.mean(without**2)) > 0.3
        assert np.sqrt(np.mean(left[inner] ** 2)) < allowed * np.sqrt(np.mean(without**2))
    # Coriolis: under spin the rate of the swing counts as well
    if rpm == 60.0:
        no_rate = replace(swing, rate_yz_radps=np.zeros_like(swing.rate_yz_radps))
        for left, without in zip(left_deg(truth, no_rate), held, strict=True):
            assert np.sqrt(np.mean(left[inner] ** 2)) > 0.02 * np.sqrt(np.mean(without**2))


@pytest.mark.parametrize("rpm", RPM)
def test_readings_about_the_true_swing_are_the_deflection(rpm):
    # read = theta + B theta' + A theta'': with the true derivatives taken off again
    vehicle = swinging()
    state = start(rpm, [0.1, -0.15], [0.005, -0.0065], [0.005, -0.006])
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 1.5, EPOCH, 0.0005, 0.001)
    spline, inner = CubicSpline(truth.time_s, truth.deflection.theta_yz_rad), slice(10, -10)
    for evidence, allowed in ((trim_evidence, 0.02), (misalignment_evidence, 0.001)):
        one = evidence(pulse_of_truth(truth), spline)
        read = one.theta_yz_rad - np.einsum("nij,nj->ni", one.by_rate_s, spline(truth.time_s, 1))
        read -= np.einsum("nij,nj->ni", one.by_acceleration_s2, spline(truth.time_s, 2))
        off = np.rad2deg(read - truth.deflection.theta_yz_rad)[inner]
        assert np.sqrt(np.mean(off**2)) < allowed


def test_the_shell_s_rate_is_the_derivative_of_its_axes():
    # of swings that go round: differences of the matrices, whose skew part is the rate
    rng, step = np.random.default_rng(6), 1e-6
    swing = Swing(rng.uniform(-0.5, 0.5, (40, 2)), rng.uniform(-3.0, 3.0, (40, 2)), np.zeros((40, 2)))
    ahead, behind = (axes(Swing.held(swing.theta_yz_rad + s * swing.rate_yz_radps)) for s in (step, -step))
    turning = (ahead - behind) / (2.0 * step) @ axes(swing).transpose(0, 2, 1)
    rate = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=-1)
    np.testing.assert_allclose(relative_rate(swing), rate, atol=1e-8)


def test_what_is_left_of_the_moments_is_a_shift_of_the_cg():
    # the c.g. a millimetre to a side: the balance is left with that millimetre, on that side
    state = start(6.0, [0.1, -0.15], [0.03, -0.04], [0.0, 0.0])
    vehicle = living()
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 0.1, EPOCH, 0.002, 0.01, START_S + 9.0)
    pulse, held = pulse_of_truth(truth), Swing.held(truth.deflection.theta_yz_rad)
    share = vehicle.centerbody.mass_kg / vehicle.mass_kg
    for axis in range(2):
        place = np.array(vehicle.centerbody.cg_from_datum_body_m)
        place[1 + axis] += 1e-3 / share
        body = vehicle.centerbody.model_copy(update={"cg_from_datum_body_m": tuple(place.tolist())})
        left = moment_residual(replace(vehicle, centerbody=body), held, pulse)
        np.testing.assert_allclose(left, np.tile(1e-3 * np.eye(2)[axis], (len(left), 1)), atol=2e-5)


@pytest.mark.parametrize("bent_deg", [0.0, 30.0])
@pytest.mark.parametrize("rpm", RPM)
def test_the_force_along_the_shell_s_axis_closes(rpm, bent_deg):
    bent = np.deg2rad(bent_deg) * np.array([0.8, -0.6])
    state = start(rpm, [0.1, -0.15], np.array([0.03, -0.04]) - bent, bent)
    truth = fly(living(-1.0), standard_atmosphere(), state, START_S, START_S + 0.2, EPOCH, 0.002, 0.01, START_S + 9.0)
    pulse, held = pulse_of_truth(truth), Swing.held(truth.deflection.theta_yz_rad)
    # the simulator's dynamic pressure is the nose's, and nothing else is left out
    np.testing.assert_allclose(axial_residual(truth.vehicle, held, pulse), 0.0, atol=1e-6)
    if bent_deg:
        straight = axial_residual(truth.vehicle, Swing.held(0.0 * truth.deflection.theta_yz_rad), pulse)
        assert np.abs(straight).min() > 0.01
