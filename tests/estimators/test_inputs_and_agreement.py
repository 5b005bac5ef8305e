"""Responses to inputs with every term alive, and the statistics of pairs, culprits and limbs, drawn and brute force."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.agreement import SPAN_S, WIDER, agreement
from estimators.deflection_spline import InputPosterior
from estimators.evidence import (
    ACCELEROMETER,
    CAMERA_TIME_BIAS,
    CONSTANT_PART,
    LIGHT_TIME_S,
    PRESSURE,
    WIND,
    Evidence,
    corrected_loads,
    evidence_of_history,
    flow_inputs,
    moved_evidence,
    moved_vehicle,
)
from estimators.fusion import LEFT_OUT_RAD, LEFT_OUT_TIME_S, fuse
from estimators.misalignment import misalignment_evidence
from estimators.southwell import LEFT_OUT, southwell_limbs
from estimators.trim import SLOPE_AT_RAD, estimate_trim, static_trim, trim_curvature, trim_evidence
from flightmodel import rotations
from flightmodel.airdata import lateral_angles
from flightmodel.deflection import history_from_lateral
from flightmodel.linear import Slopes, linear_matrix
from flightmodel.statistics import correlation

from .conftest import VEHICLE, pulse_of


def alive():
    """Pulse that turns and accelerates in turning, whose attitude errs with the accelerometer."""
    rng = np.random.default_rng(4)
    pulse, _ = pulse_of(rng, 30)
    n = len(pulse.time_s)
    return replace(
        pulse,
        rate_body_radps=rng.normal(0.0, 0.2, (n, 3)),
        angular_acceleration_body_radps2=rng.normal(0.0, 0.6, (n, 3)),
        flow_root_rad=np.deg2rad(0.08) * rng.normal(size=(n, 2, 9)),
        rate_root_radps=0.02 * rng.normal(size=(n, 3, 9)),
        flow_cov=np.tile(np.deg2rad(0.6) ** 2 * np.eye(2), (n, 1, 1)),
        dynamic_pressure_sd_pa=0.04 * pulse.dynamic_pressure_pa,
    )


@pytest.mark.parametrize("method", [misalignment_evidence, trim_evidence])
def test_every_response_is_that_of_moving_the_input(method):
    # J against a finite change of 1e-3 sd: second order leaves 1e-3 of J at the most for all that is smooth
    pulse, rng = alive(), np.random.default_rng(5)
    base = method(pulse)
    for name, response in base.by_input.items():
        x = 1e-3 * rng.normal(size=response.shape[2])
        change = method(corrected_loads(pulse, {name: x})).theta_yz_rad - base.theta_yz_rad
        scale = np.abs(response).max() * 1e-3 + 1e-9
        np.testing.assert_allclose(change, response @ x, atol=0.03 * scale + 2e-8, err_msg=name)
    if method is trim_evidence:
        assert np.abs(base.by_input[PRESSURE]).max() > 1e-4


@pytest.mark.parametrize("method", [misalignment_evidence, trim_evidence])
def test_far_from_any_solution_there_is_no_reading_rather_than_an_error(method):
    # turned over, or not a number: where the balance does not move with the deflection nothing is read
    pulse = alive()
    for far in (np.pi, 1e3, np.nan):

        def about(time_s, derivative=0, far=far):
            return np.full((len(time_s), 2), far if derivative == 0 else 0.0)

        read = method(pulse, about).theta_yz_rad
        assert read.shape == (len(pulse.time_s), 2)
        if np.isnan(far):
            assert np.isnan(read).all()


def test_under_spin_the_gyros_errors_move_the_trim():
    # gyroscopic: a lateral rate that is read wrong, at 50 rpm; nothing else of the sensors errs here
    pulse, rng = alive(), np.random.default_rng(6)
    spinning = pulse.rate_body_radps + np.array([5.2, 0.0, 0.0])
    none = np.zeros_like(pulse.force_root_mps2), np.zeros_like(pulse.flow_root_rad)
    pulse = replace(pulse, rate_body_radps=spinning, force_root_mps2=none[0], flow_root_rad=none[1])
    base, x = trim_evidence(pulse), 1e-2 * rng.normal(size=9)
    response = base.by_input[ACCELEROMETER]
    assert np.rad2deg(np.abs(response).max()) > 0.02
    change = trim_evidence(corrected_loads(pulse, {ACCELEROMETER: x})).theta_yz_rad - base.theta_yz_rad
    np.testing.assert_allclose(change, response @ x, atol=0.03 * np.abs(response @ x).max())


def coning(alpha_rad, precession_radps, spin_radps):
    """Loads of a body whose axis goes round a steady flow, and the matrices (n, 3, 3) that turn body into flow axes."""
    pulse, _ = pulse_of(np.random.default_rng(12), 600)
    since = pulse.time_s - pulse.time_s[0]
    x, z = np.eye(3)[0], np.eye(3)[2]
    q = rotations.multiply(
        rotations.exp(precession_radps * since[:, None] * x),
        rotations.multiply(rotations.exp(alpha_rad * z), rotations.exp(spin_radps * since[:, None] * x)),
    )
    dcm = rotations.dcm_from_q(q)
    rate = spin_radps * x + precession_radps * dcm[:, 0]
    flow = lateral_angles(1000.0 * dcm[:, 0])
    return replace(pulse, rate_body_radps=rate, flow_yz_rad=flow, wind_flow_sd_rad=np.full(len(since), 1e-3)), dcm


@pytest.mark.parametrize("alpha_deg", [3.0, 25.0, 45.0])
def test_a_steady_wind_stays_steady_however_the_body_cones(alpha_deg):
    # a metre a second across 1000 m/s is the two constant columns of the wind and nothing else; the gyro's own roll
    # would have gone on by 5.9 rad at 25 deg
    pulse, dcm = coning(np.deg2rad(alpha_deg), 2.1, 1.3)
    since = pulse.time_s[-1] - pulse.time_s[0]
    assert 2.1 * since * (1.0 - np.cos(np.deg2rad(25.0))) > 5.0
    change = lateral_angles(np.einsum("nji,j->ni", dcm, [1000.0, 0.6, -0.8])) - pulse.flow_yz_rad
    columns = flow_inputs(pulse)[WIND]
    steady = np.sqrt(3.0) * columns[:, :, [0, columns.shape[2] // 2]]
    size = np.linalg.lstsq(steady.reshape(-1, 2), change.ravel())[0]
    assert np.hypot(*size) == pytest.approx(1.0, abs=0.06)  # half of alpha / sin(alpha) - 1 at 45 deg
    left = change - steady @ size
    assert np.sqrt(np.mean(left**2)) < (0.003 if alpha_deg < 10.0 else 0.06) * np.sqrt(np.mean(change**2))


def test_moved_vehicle_is_moved_as_its_names_say():
    known = VEHICLE.uncertainty
    aft = moved_vehicle(VEHICLE, {"aeroshell c.g. station": 1.0})
    assert aft.aeroshell.cg_m[0] - VEHICLE.aeroshell.cg_m[0] == pytest.approx(-known.cg_station_m)
    heavy = moved_vehicle(VEHICLE, {"centerbody mass": 1.0, "aeroshell pitch inertia": -2.0})
    assert heavy.centerbody.mass_kg / VEHICLE.centerbody.mass_kg == pytest.approx(1.0 + known.mass)
    factor = 1.0 - 2.0 * known.inertia
    np.testing.assert_allclose(heavy.aeroshell.inertia, np.diag([1.0, factor, factor]) * VEHICLE.aeroshell.inertia)
    rolled = moved_vehicle(VEHICLE, {"centerbody roll inertia": 1.0, "centerbody product xz": 2.0}).centerbody.inertia
    size = known.inertia_products * VEHICLE.centerbody.inertia[1, 1]
    np.testing.assert_allclose(rolled[0], [(1.0 + known.inertia) * VEHICLE.centerbody.inertia[0, 0], 0.0, 2.0 * size])
    np.testing.assert_allclose(rolled, rolled.T)
    # the vehicle's offset errs as two bodies' lateral c.g.s err that are known by themselves
    masses = np.array([VEHICLE.aeroshell.mass_kg, VEHICLE.centerbody.mass_kg])
    want = known.cg_lateral_m * np.linalg.norm(masses) / masses.sum()
    for axis, name in ((1, "initial offset y"), (2, "initial offset z")):
        moved = moved_vehicle(VEHICLE, {name: 1.0}).cg_m[axis] - VEHICLE.cg_m[axis]
        assert moved == pytest.approx(want, rel=1e-12)


def test_a_curved_input_shifts_and_widens_by_its_second_moment():
    # b x^2 of a standard normal x: mean b, variance 2 b b'; five Gauss-Hermite nodes are exact
    curvature = np.array([[2e-3, -1e-3]])
    one = Evidence(
        "trim", np.zeros(1), np.zeros((1, 2)), *[np.zeros((1, 2, 2))] * 2, {}, np.zeros((1, 2, 2)), 1.0, curvature
    )
    node, weight = np.polynomial.hermite_e.hermegauss(5)
    weight = weight / weight.sum()
    values = curvature[0] * node[:, None] ** 2
    mean = weight @ values
    np.testing.assert_allclose(one.mean_yz_rad[0], mean, rtol=1e-12)
    np.testing.assert_allclose(one.covariance[0], (weight * (values - mean).T) @ (values - mean), rtol=1e-12)


def test_trim_s_curvature_is_half_its_second_difference_by_the_moment_s_coefficient():
    pulse, _ = pulse_of(np.random.default_rng(9), 12)

    def read(size):
        return trim_evidence(replace(pulse, vehicle=moved_vehicle(pulse.vehicle, {"C_m": size}))).theta_yz_rad

    want = 0.5 * (read(1.0) - 2.0 * read(0.0) + read(-1.0))
    got = trim_curvature(pulse)
    # steps of sqrt(3) sd against one: the fourth derivative's part differs
    np.testing.assert_allclose(got, want, atol=0.15 * np.abs(want).max())
    assert np.abs(want).max() > 1e-5


def test_trim_s_own_noise_is_that_of_the_angular_acceleration():
    one, _ = pulse_of(np.random.default_rng(10), 1)
    pulse = replace(one, angular_acceleration_sd_radps2=0.05)
    rng = np.random.default_rng(11)
    evidence = trim_evidence(pulse)
    drawn = []
    for _ in range(600):
        turned = replace(pulse, angular_acceleration_body_radps2=0.05 * rng.standard_normal((1, 3)))
        drawn.append(trim_evidence(turned, with_inputs=False).theta_yz_rad[0])
    # both axes alike: the pitch inertia stands for both, which differ by 1 %; 600 draws know a variance to 6 %
    ratio = np.trace(np.cov(np.array(drawn).T)) / np.trace(evidence.independent_cov[0])
    assert ratio == pytest.approx(1.0, abs=0.2)


def test_a_history_s_evidence_has_the_history_s_covariance():
    # what lasts and what forgets add up to it; between the knots of what forgets a few percent are lost
    t = np.arange(0.0, 20.0, 0.2)
    yz = 0.03 + 0.01 * np.column_stack([np.sin(0.4 * t), np.cos(0.3 * t)])
    root = 1e-3 * np.array([[2.0, 0.0], [0.7, 1.1]])
    history = history_from_lateral(t, yz, np.tile(root @ root.T, (len(t), 1, 1)), "camera", "")
    covariance = evidence_of_history(history).covariance
    share = np.trace(covariance, axis1=1, axis2=2) / np.trace(root @ root.T)
    assert share.min() > 0.9
    assert share.max() < 1.1


@pytest.mark.parametrize("frames_hz", [1.0, 4.0, 10.0, 30.0])
def test_a_camera_s_errors_between_knots_are_no_motion(frames_hz):
    # mean chi-square of errors of the stated covariance by what the fusion takes them to have, beside its own floor.
    # What lies off straight lines between knots is shared by the frames there; with three knots in the correlation time
    # and no error off the lines it would be 2, 9, 4 and 2
    t, sd = np.arange(0.0, 29.3, 1.0 / frames_hz), np.deg2rad(0.4)
    stated = sd**2 * correlation(t, LIGHT_TIME_S, CONSTANT_PART)
    far, cov = np.tile([0.2, 0.0], (len(t), 1)), np.tile(sd**2 * np.eye(2), (len(t), 1, 1))
    one = evidence_of_history(history_from_lateral(t, far, cov, "camera", ""))
    response = one.by_input["camera"][:, 0]
    taken = response @ response.T + np.diag(one.independent_cov[:, 0, 0])
    np.testing.assert_allclose(np.diag(taken), sd**2, rtol=1e-6)
    floor = LEFT_OUT_RAD**2 * LEFT_OUT_TIME_S / one.averaged_s * np.eye(len(t))
    assert np.trace(np.linalg.solve(taken + floor, stated + floor)) / len(t) == pytest.approx(1.0, abs=0.1)


def test_of_many_swings_that_fit_alike_the_clock_s_own_term_chooses():
    # a steady ringing at 2.5 Hz fits an offset of 0.05 s as well as one of 0.45 or -0.35 s; the clock is known to 0.2 s
    t = 430.0 + np.arange(0.0, 8.0, 0.02)
    frames = t[0] + np.arange(0.0, 8.0, 1.0 / 30.0)

    def ringing(at):
        return 0.02 * np.sin(2.0 * np.pi * 2.5 * (at - 430.0))[:, None] * np.array([0.8, -0.6])

    def told(name, at, values, sd_rad, time_bias_sd_s):
        n = len(at)
        return Evidence(
            name, at, values, *[np.zeros((n, 2, 2))] * 2, {}, np.tile(sd_rad**2 * np.eye(2), (n, 1, 1)), 0.01,
            time_bias_sd_s=time_bias_sd_s,
        )  # fmt: skip

    late = 0.05
    own = told("misalignment", t, ringing(t), 2e-4, 0.0)
    film = told("camera", frames, ringing(frames - late), 1e-3, 0.2)
    _, found = fuse(lambda inputs, about: [own, moved_evidence(film, inputs, about)])
    mean, covariance = found.inputs[CAMERA_TIME_BIAS]
    assert 0.2 * mean[0] == pytest.approx(late, abs=0.005)
    assert 0.2 * np.sqrt(covariance[0, 0]) < 0.005


def pair(rng, noises, shared=True):
    """Two methods' readings of no deflection, drawn from their own statement; the second has every fourth time."""
    t = 430.0 + 0.05 * np.arange(240)
    x = rng.standard_normal(2)
    out = []
    for k, (name, every, gain) in enumerate((("misalignment", 1, 1.0), ("trim", 4, 0.4))):
        at = t[::every]
        response = gain * 2e-3 * np.stack([np.cos(0.3 * (at - 430.0)), np.ones(len(at))], axis=-1)
        j = np.stack([response, 0.5 * response[:, ::-1]], axis=1)  # (n, 2, 2)
        noise = noises[k] * rng.standard_normal((len(at), 2))
        cov = np.tile(noises[k] ** 2 * np.eye(2), (len(at), 1, 1))
        read = -(j @ x) + noise
        out.append(Evidence(name, at, read, *[np.zeros((len(at), 2, 2))] * 2, {WIND: j} if shared else {}, cov, 0.05))
    return out


@pytest.mark.parametrize("noises", [(6e-3, 6e-3), (1e-2, 2e-3)])
def test_pairs_that_agree_fail_as_often_as_chance_lets_them(noises):
    # chances of what is drawn as it is stated are uniform; what equations leave out (0.05 deg a mean) is small here
    rng = np.random.default_rng(8)
    found = [agreement(pair(rng, noises)).pairs[0] for _ in range(400)]
    assert found[0].degrees == 2 * int(np.ceil(12.0 / SPAN_S))
    share = np.mean([p.chi_square for p in found]) / found[0].degrees
    # 400 draws of some 12 degrees know the mean to 2 %; what is left out takes up to a few percent of it
    assert 0.80 < share < 1.06
    chances = np.array([p.p_value for p in found])
    assert 0.35 < np.mean(chances < 0.5) < 0.58
    assert np.mean(chances < 0.1) < 0.15


def still(time_s, derivative=0):
    """Deflection of nothing."""
    return np.zeros((len(time_s), 2))


def resting(name, time_s, theta_yz, coefficient):
    """Readings of a joint at rest, known to a milliradian and a coefficient."""
    rest, cov = np.zeros((len(time_s), 2, 2)), np.tile(1e-6 * np.eye(2), (len(time_s), 1, 1))
    return Evidence(name, time_s, theta_yz, rest, rest, {"C_m": coefficient}, cov, 0.05)


@pytest.mark.parametrize(("swing_rad", "constant_rad", "fails"), [(0.02, 0.0, False), (0.0, 0.02, True)])
def test_a_swing_that_no_spline_follows_is_no_disagreement(swing_rad, constant_rad, fails):
    # a stiff joint rings at 8.2 Hz, and the trim reads a degree of it; it knows the deflection well only where the
    # vehicle passes its trim angle, three samples in ten, and a film has four frames a second: neither is compared
    # at those moments alone
    rng, t, failed = np.random.default_rng(11), 430.0 + 0.05 * np.arange(240), []
    for _ in range(60):
        waves = swing_rad * np.cos(2.0 * np.pi * 8.2 * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 2))
        coefficient = 0.05 * np.sin(2.0 * np.pi * t + rng.uniform(0.0, 2.0 * np.pi))[:, None, None] * [[0.8], [-0.6]]
        noise, none = 1e-3 * rng.standard_normal((3, len(t), 2)), np.zeros((len(t), 2, 1))
        trim = waves + constant_rad + noise[0] - coefficient[:, :, 0] * rng.standard_normal()
        readings = [
            resting("misalignment", t, noise[1], none),
            resting("trim", t, trim, coefficient),
            resting("camera", t[::5], noise[2, ::5], none[::5]),
        ]
        failed.append([not p.passed for p in agreement(readings, deflection=still).pairs])
    # misalignment and trim, misalignment and film, trim and film
    assert (np.abs(np.mean(failed, axis=0) - [fails, False, fails]) < 0.05).all()


def test_gain_is_the_likelihood_of_worse_known_inputs():
    # all readings y = J x + e once more by their whole covariance: log N(y; 0, C + (WIDER^2 - 1) J J') - log N(y; 0, C)
    rng = np.random.default_rng(3)
    methods = pair(rng, (2e-3, 1e-3))
    j = -np.concatenate([e.by_input[WIND].reshape(-1, 2) for e in methods])
    y = np.concatenate([e.theta_yz_rad.ravel() for e in methods]) + 3.0 * (j @ np.array([1.0, -0.8]))
    noise = np.concatenate([np.repeat(e.independent_cov[:, 0, 0], 2) for e in methods])

    def log_density(size):
        c = np.diag(noise) + size**2 * j @ j.T
        return -0.5 * y @ np.linalg.solve(c, y) - 0.5 * np.linalg.slogdet(c)[1]

    covariance = np.linalg.inv(np.eye(2) + (j.T / noise) @ j)
    learnt = InputPosterior(covariance @ (j.T / noise) @ y, covariance, {WIND: slice(0, 2)})
    gain = agreement(methods, learnt).gains["sounded wind"]
    assert gain == pytest.approx(log_density(WIDER) - log_density(1.0), rel=1e-6)


def test_limbs_of_one_line_differ_by_a_standard_deviation():
    # bendings drawn as each limb's fit takes them, with a lasting error of its own (half of the variance) and an
    # independent one: the difference over its own sd scatters by one; one limb's error alone would make it 1.4 times
    rng, found = np.random.default_rng(2), []
    q = np.concatenate([np.linspace(250.0, 1200.0, 8), np.linspace(1150.0, 300.0, 8)])
    t = 430.0 + 1.6 * np.arange(16)
    u = q / 1900.0
    theta, sd = 0.03 * u / (1.0 - u), np.full(16, 6e-4)
    swing = LEFT_OUT * theta * np.sqrt(q.max() / q)
    for _ in range(120):
        lasting = np.repeat(rng.standard_normal(2), 8)
        drawn = theta + np.sqrt(0.5) * sd * (lasting + rng.standard_normal(16)) + swing * rng.standard_normal(16)
        cov = np.tile(np.eye(2), (16, 1, 1)) * (sd**2)[:, None, None]
        history = history_from_lateral(t, np.column_stack([drawn, 0.0 * drawn]), cov, "fused", "")
        limbs = southwell_limbs(history, t, q, 0.0)
        if np.isfinite(limbs.hysteresis_sd):
            found.append(limbs.hysteresis_sd)
    assert len(found) > 90
    # 90 draws know an sd to 8 %; limbs that show no margin fall out and take the tails
    assert 0.7 < np.std(found) < 1.08


def test_critical_stiffness_is_where_the_linear_model_diverges():
    # another model's eigenvalue: just below the critical stiffness a motion grows without oscillating, just above none
    mach, pressure = 3.2, 1180.0
    body = VEHICLE.centerbody.model_copy(update={"cg_from_datum_body_m": (-0.52, 0.0, 0.0)})
    on_axis = replace(VEHICLE, centerbody=body)
    slope = on_axis.aero.at(mach, SLOPE_AT_RAD) / SLOPE_AT_RAD
    slopes = Slopes(float(on_axis.aero.at(mach, 0.0)[0]), float(slope[1]), float(slope[2]), 0.0)
    critical = static_trim(on_axis, mach, pressure).critical_stiffness_nmprad

    def grows(factor):
        joint = on_axis.joint.model_copy(
            update={"bending_stiffness_nmprad": factor * critical, "bending_damping_nmsprad": 0.0}
        )
        values = np.linalg.eigvals(linear_matrix(replace(on_axis, joint=joint), slopes, pressure, 1e6))
        return values[np.abs(values.imag) < 1e-9].real.max(initial=0.0)

    assert grows(0.995) > 0.05
    assert grows(1.005) < 0.01


def test_a_flight_without_samples_or_with_a_known_moment_has_its_trim():
    # no sample decelerates enough; C_m stated as known has no response
    pulse, _ = pulse_of(np.random.default_rng(14), 12)
    weak = replace(pulse, specific_force_body_mps2=0.01 * pulse.specific_force_body_mps2)
    assert np.isnan(estimate_trim(weak).theta_rad).all()
    known = replace(VEHICLE, uncertainty=VEHICLE.uncertainty.model_copy(update={"cm": 0.0}))
    history = estimate_trim(replace(pulse, vehicle=known))
    assert np.isfinite(history.theta_quantiles_rad).all()
