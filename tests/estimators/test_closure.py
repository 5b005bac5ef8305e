"""The estimators' balances close on true histories of the simulator, at rest, at 6 rpm and at 30 rpm.

True motion, true air and true forces go in, nothing is measured; what an estimator then reads beyond the true
deflection is what its equation leaves out of the simulator's physics. The flow is taken at the nose, as the simulator
takes it.
"""

from dataclasses import replace

import numpy as np
import pytest

from estimators.loads import FlightLoads
from estimators.misalignment import misalignment_evidence
from estimators.trim import moment_term, shell_inertia, trim_evidence, trim_model
from flightmodel import airdata, earth, rotations
from flightmodel.atmosphere import standard_atmosphere
from synthetic_flight.simulate import fly, state_from_ecef
from tests.oracles import two_body

from .conftest import VEHICLE

START_S, EPOCH = 420.0, "2009-08-17T12:50:00Z"
RPM = (0.0, 6.0, 30.0)


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
    at_nose = airdata.air_data(truth.trajectory, truth.profile, np.zeros(3))
    return FlightLoads(
        time_s=truth.time_s,
        specific_force_body_mps2=truth.specific_force_body(vehicle.cg_m),
        force_noise_sd_mps2=0.0,
        force_root_mps2=np.zeros((n, 3, 9)),
        flow_root_rad=np.zeros((n, 2, 9)),
        rate_body_radps=truth.state_eci[:, 14:17],
        angular_acceleration_body_radps2=truth.angular_acceleration_body_radps2,
        angular_acceleration_sd_radps2=0.0,
        flow_yz_rad=airdata.lateral_angles(at_nose.velocity_air_body_mps),
        flow_cov=np.zeros((n, 2, 2)),
        wind_flow_sd_rad=np.zeros(n),
        altitude_m=at_nose.altitude_m,
        mach=at_nose.mach,
        dynamic_pressure_pa=at_nose.dynamic_pressure_pa,
        dynamic_pressure_sd_pa=np.zeros(n),
        airspeed_mps=at_nose.airspeed_mps,
        vehicle=vehicle,
    )


@pytest.mark.parametrize("cmq", [None, -1.0])
@pytest.mark.parametrize("rpm", RPM)
def test_a_rigid_vehicle_is_read_as_unbent(rpm, cmq):
    # the joint locked, the equations of both methods leave nothing out: an oscillation of 4 deg, rates of 0.3 rad/s
    # across the spin and pitch damping of its own and of a strong one leave rounding. What each term weighs here, as a
    # reading in deg: I w' 1.6 (at every spin), damping 0.03 and 0.10, w x I w 0.014 at 6 rpm and 0.06 at 30 rpm
    vehicle = VEHICLE if cmq is None else replace(VEHICLE, aero=VEHICLE.aero.with_constant_cmq(cmq))
    state = start(rpm, [0.1, -0.15], [0.03, -0.04], [0.0, 0.0])
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 3.0, EPOCH, 0.002, 0.01, START_S + 9.0)
    pulse = pulse_of_truth(truth)
    assert pulse.informative.all()
    straight = np.zeros((len(truth.time_s), 2))
    for evidence in (trim_evidence, misalignment_evidence):
        read = evidence(pulse, about_yz_rad=straight).theta_yz_rad
        np.testing.assert_allclose(np.rad2deg(read), 0.0, atol=2e-4)
    # and found from nothing
    np.testing.assert_allclose(np.rad2deg(trim_evidence(pulse).theta_yz_rad), 0.0, atol=2e-4)


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
    model = replace(trim_model(VEHICLE), aero=VEHICLE.aero.with_constant_cmq(0.0), inertia_kgm2=tensor)
    # 1 N m at this pressure is 0.1 mm of offset; differences over 0.1 ms leave 1e-6 of the moments of some N m
    np.testing.assert_allclose(moment_term(model, moving, one.informative, True), 0.0, atol=1e-9)


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
def test_a_ringing_joint_is_read_through_its_acceleration(rpm):
    # half a degree of swinging at 4 Hz moves both readings by as much again. What of the swing is left in a reading,
    # by projection on it: rounding of second order, and what spin does to a swing that is written in body axes, of the
    # order of (spin / joint's frequency)^2; its part across the swing (Coriolis) does not project
    vehicle = swinging()
    state = start(rpm, [0.0, 0.0], [0.005, -0.0065], [0.005, -0.006])
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 1.5, EPOCH, 0.001, 0.002)
    pulse, theta = pulse_of_truth(truth), truth.deflection.theta_yz_rad
    t = truth.time_s
    acceleration = np.gradient(np.gradient(theta, t, axis=0), t, axis=0)
    inner = slice(5, -5)  # differences at the ends are one-sided
    for evidence in (trim_evidence, misalignment_evidence):
        one = evidence(pulse, about_yz_rad=theta)
        swing = np.einsum("nij,nj->ni", one.by_acceleration_s2, acceleration)[inner]
        left = one.theta_yz_rad[inner] - theta[inner] - swing
        assert np.rad2deg(np.sqrt(np.mean(swing**2))) > 0.3
        share = np.sum(left * swing) / np.sum(swing * swing)
        spin = rpm * 2.0 * np.pi / 60.0
        assert abs(share) < 0.005 + 2.0 * (spin / (2.0 * np.pi * 4.0)) ** 2
        if rpm == 0.0:
            assert np.sqrt(np.mean(left**2)) < 0.01 * np.sqrt(np.mean(swing**2))


def test_shell_inertia_is_the_momentum_that_a_swing_gives():
    # in free space, straight and at rest, a moment in the joint swings both bodies; the vehicle's momentum about its
    # c.g. stays nothing: I w_body' + S theta'' = 0
    vehicle = swinging()
    body = vehicle.centerbody.model_copy(update={"cg_from_datum_body_m": (-0.6, 0.0, 0.0)})
    vehicle = replace(vehicle, centerbody=body)
    bent = np.array([0.0, 1e-5, 0.0])
    q = np.array([1.0, 0.0, 0.0, 0.0])
    state = np.concatenate([[1e12, 0.0, 0.0], np.zeros(3), q, rotations.exp(bent), np.zeros(6)])
    nothing = two_body.Loads(np.zeros(3), np.zeros(3), np.zeros(3))
    _, turn_body, _, turn_shell, _ = two_body.accelerations(state, vehicle, nothing)
    swing = turn_shell[1] - turn_body[1]
    assert abs(swing) > 1e-3
    assert shell_inertia(vehicle) == pytest.approx(-vehicle.inertia[1, 1] * turn_body[1] / swing, rel=1e-8)
