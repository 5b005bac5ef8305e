"""Each systematic error of a radar, against geometry or a formula that the code does not use."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from flightmodel import earth, rotations
from flightmodel.refraction import refracted
from synthetic_flight import sensing
from synthetic_flight.instrument_errors import Dropouts, Radar, child
from synthetic_flight.scenarios import fly_scenario, read_scenario
from synthetic_flight.sensing import pedestal_errors, sense_radar

MIL = np.rad2deg(1e-3)  # a milliradian in degrees: large, so that second order shows
SITE = {"latitude_deg": 37.841, "longitude_deg": -75.485, "height_m": 12.0, "rate_hz": 10.0}
NOTHING = dict.fromkeys(("range_sd_m", "angle_sd_deg", "range_bias_m", "angle_bias_deg", "time_bias_s"), 0.0)


@pytest.fixture(scope="module")
def truth():
    """Upward leg from 110 km: 60 s, spinning."""
    whole = read_scenario("irve2_reference")
    time = whole.spec.time.model_copy(update={"stop_s": 150.0, "telemetry_from_s": 95.0, "inflated_s": None})
    return fly_scenario(replace(whole, spec=whole.spec.model_copy(update={"time": time})), 3)


def radar(**terms):
    return Radar(**{**SITE, **NOTHING, **terms})


def sensed(truth, seed=0, **terms):
    return sense_radar(truth, radar(**terms), 100.0, np.random.default_rng(seed))


def sky():
    """Directions all around, 5 to 70 deg up: range m, azimuth, elevation."""
    az, el = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False), np.deg2rad(np.linspace(5.0, 70.0, 14)))
    return np.column_stack([np.linspace(5e4, 3e5, az.size), az.ravel(), el.ravel()])


def beam(az, el):
    """North, east, down."""
    return np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), -np.sin(el)])


def pointed(target, roll, skew):
    """Encoder angles at which a pedestal's beam hits a direction: azimuth turn, tilted elevation axis, skewed horn."""
    horn = np.array([np.cos(skew), np.sin(skew), 0.0])  # off the plane square to the elevation axis

    def miss(angles):
        az, el = angles
        # turn about down by azimuth; lean of the elevation axis, about forward; raise about that axis
        turn = Rotation.from_euler("ZXY", [az, roll, el]).as_matrix()
        return (turn @ horn - target) @ across

    az0, el0 = np.arctan2(target[1], target[0]), np.arcsin(-target[2])
    across = np.column_stack([[-np.sin(az0), np.cos(az0), 0.0], np.cross(target, [-np.sin(az0), np.cos(az0), 0.0])])
    return fsolve(miss, [az0, el0], xtol=1e-13) - [az0, el0]


@pytest.mark.parametrize("term", ["skew_deg", "nonorthogonality_deg"])
def test_axes_of_the_pedestal_against_its_geometry(term):
    """Exact pointing of a pedestal with a bent horn or a leaning axis: the formula holds to second order."""
    places = sky()
    error = pedestal_errors(places, radar(**{term: MIL}), np.random.default_rng(2))
    low = int(np.argmin(places[:, 2]))
    at_horizon = (
        error[low, 1] * np.cos(places[low, 2]) if term == "skew_deg" else error[low, 1] / np.tan(places[low, 2])
    )
    assert abs(at_horizon) > 1e-5
    for k in range(0, len(places), 29):
        # azimuth that the encoder shows too much is what the horn points too little, or an axis whose right end is high
        roll, skew = (0.0, -at_horizon) if term == "skew_deg" else (-at_horizon, 0.0)
        exact = pointed(beam(*places[k, 1:]), roll, skew)
        # second order: (1e-3)^2 tan E sec E, at most 8e-6
        np.testing.assert_allclose(error[k, 1:], exact, atol=9e-6)
        assert error[k, 0] == 0.0


def test_droop_is_the_weight_across_the_beam():
    places = sky()
    error = pedestal_errors(places, radar(droop_deg=MIL), np.random.default_rng(5))
    across = np.linalg.norm(np.cross(np.array([beam(*p[1:]) for p in places]), [0.0, 0.0, 1.0]), axis=1)
    np.testing.assert_allclose(error[:, 2] / across, error[0, 2] / across[0], rtol=1e-12)
    assert np.abs(error[0, 2]) > 1e-5
    assert not error[:, :2].any()


def test_mislevel_against_the_first_order_formula():
    """A zenith that leans by tau towards A_t raises what stands there: dE = tau cos(A - A_t), dA = that, by a quarter
    turn later, times tan E.
    """
    places = sky()
    error = pedestal_errors(places, radar(mislevel_deg=MIL), np.random.default_rng(7))
    north, east = 1e-3 * child(np.random.default_rng(7), "mislevel").standard_normal(2)
    # turned about north by n and about east by e, the zenith leans by n to the east and by -e to the north
    tau, towards = np.hypot(north, east), np.arctan2(north, -east)
    az, el = places[:, 1], places[:, 2]
    # second order: tau^2 tan^2 E and less
    bound = 1.5 * tau**2 / np.cos(el) ** 2
    assert (np.abs(error[:, 2] - tau * np.cos(az - towards)) < bound).all()
    assert (np.abs(error[:, 1] - tau * np.sin(az - towards) * np.tan(el)) < bound).all()
    assert tau > 3e-4


def test_encoders_err_once_and_twice_a_turn():
    places = sky()
    for term, turns in (("encoder_once_deg", 1), ("encoder_twice_deg", 2)):
        error = pedestal_errors(places, radar(**{term: MIL}), np.random.default_rng(1))
        ring = error[:60, 1]  # one elevation, 60 azimuths: its Fourier lines
        lines = np.abs(np.fft.rfft(ring))
        assert lines[turns] > 1e-3
        assert np.delete(lines, turns).max() < 1e-12
        column = error[::60, 2]  # one azimuth, all elevations
        el = places[::60, 2]
        base = np.column_stack([np.sin(turns * el), np.cos(turns * el)])
        fit, *_ = np.linalg.lstsq(base, column, rcond=None)
        np.testing.assert_allclose(base @ fit, column, atol=1e-15)
        assert np.linalg.norm(fit) > 1e-4


SIZES = {
    "range_scale": (1e-4, lambda e, p: e[:, 0] / p[:, 0]),
    "skew_deg": (MIL, lambda e, p: e[:, 1] * np.cos(p[:, 2])),
    "nonorthogonality_deg": (MIL, lambda e, p: e[:, 1] / np.tan(p[:, 2])),
    "droop_deg": (MIL, lambda e, p: e[:, 2] / np.cos(p[:, 2])),
}


@pytest.mark.parametrize("term", SIZES)
def test_sizes_are_those_declared(term):
    size, factor = SIZES[term]
    places = sky()[:30]
    drawn = [
        factor(pedestal_errors(places, radar(**{term: size}), np.random.default_rng(seed)), places)[0]
        for seed in range(300)
    ]
    # 300 draws: 4.1 % of a standard deviation
    assert np.std(drawn) == pytest.approx(1e-3 if size == MIL else size, rel=0.17)


def test_transit_shows_the_vehicle_where_it_was_hit(truth):
    at, clean = sensed(truth)
    _, late = sensed(truth, transit_time=True)
    earlier = clean[:, 0] / 299792458.0
    speed = np.gradient(clean, at, axis=0)
    # second order: (R/c)^2 / 2 x 100 m/s^2 is 1e-5 m; the gradient errs by h^2 / 6 of the third derivative
    np.testing.assert_allclose((late - clean)[2:-2], (-speed * earlier[:, None])[2:-2], rtol=0.02, atol=1e-7)
    assert np.abs(late - clean)[:, 0].max() > 0.2


def test_refraction_is_left_in_by_its_residual(truth):
    _, clean = sensed(truth)
    air = {"surface": 350.0, "scale_height_m": 7000.0}
    _, whole = sensed(truth, refraction=air)
    _, part = sensed(truth, refraction={**air, "residual": 0.1})
    delay, bend = refracted(clean[:, 0], clean[:, 2], np.deg2rad(37.841), 12.0, radar(refraction=air).refraction.air)
    np.testing.assert_allclose(whole - clean, np.column_stack([delay, 0.0 * delay, bend]), atol=1e-8)
    np.testing.assert_allclose(part - clean, 0.1 * (whole - clean), atol=1e-8)
    # outside the air the bend is near N cot E: the sign and size that an operator expects
    np.testing.assert_allclose((whole - clean)[:, 2], 350e-6 / np.tan(clean[:, 2]), rtol=0.1)
    _, removed = sensed(truth, refraction={**air, "residual": 0.0})
    np.testing.assert_array_equal(removed, clean)


def test_servo_lags_by_the_acceleration(truth):
    at, clean = sensed(truth)
    _, lagging = sensed(truth, angle_servo_hz=0.5)
    w = np.pi
    angles = np.unwrap(clean[:, 1:], axis=0)
    rate = np.gradient(angles, at, axis=0)
    acceleration = np.gradient(rate, at, axis=0)
    jerk = np.gradient(acceleration, at, axis=0)
    # (1 - H) / s^2 = 1 / w^2 (1 - 2 zeta s / w + ...): the next term is the jerk's
    expected = -(acceleration - np.sqrt(2.0) / w * jerk) / w**2
    inside = slice(100, -10)  # ten seconds after the first point the start is forgotten
    error = (lagging - clean)[inside, 1:] - expected[inside]
    assert np.abs(error).max() < 0.05 * np.abs(expected[inside]).max()
    assert np.abs(expected[inside]).max() > 1e-6
    assert not (lagging - clean)[:, 0].any()


def test_wander_is_slow_and_across_the_line_of_sight():
    t = 5.0 * np.arange(20000)
    observed = np.column_stack([np.full(len(t), 1e5), np.zeros(len(t)), np.full(len(t), 1.0)])
    out = sensing.wander(t, observed, radar(wander_deg=MIL), np.random.default_rng(2))
    across = out[:, 1:] * [np.cos(1.0), 1.0]
    # 20000 values correlated over 4 of them are 2500 independent ones: 1.4 % of a standard deviation
    np.testing.assert_allclose(across.std(axis=0), 1e-3, rtol=0.06)
    for column in across.T:
        assert np.corrcoef(column[1:], column[:-1])[0, 1] == pytest.approx(np.exp(-5.0 / 20.0), abs=0.03)
    assert abs(np.corrcoef(across.T)[0, 1]) < 0.08
    assert not out[:, 0].any()


def test_range_wander_is_slow_and_leaves_the_angles():
    t = 5.0 * np.arange(20000)
    observed = np.column_stack([np.full(len(t), 1e5), np.zeros(len(t)), np.full(len(t), 1.0)])
    out = sensing.wander(t, observed, radar(range_wander_m=8.0), np.random.default_rng(2))
    assert out[:, 0].std() == pytest.approx(8.0, rel=0.06)
    assert np.corrcoef(out[1:, 0], out[:-1, 0])[0, 1] == pytest.approx(np.exp(-5.0 / 20.0), abs=0.03)
    assert not out[:, 1:].any()


def test_range_rate_is_the_speed_along_the_line_of_sight(truth):
    """Of the datum against the turning Earth, late tags read what was; the white noise asked for is 1 um/s."""
    at, sensed_there = sensed(truth, tracks="datum", range_rate_sd_mps=1e-6)
    rows = np.searchsorted(truth.time_s, at - 1e-6)
    site = earth.ecef_from_geodetic(np.deg2rad(37.841), np.deg2rad(-75.485), 12.0)
    line = truth.trajectory.position_ecef_m[rows] - site
    along = np.sum(truth.trajectory.velocity_ecef_mps[rows] * line, axis=1) / np.linalg.norm(line, axis=1)
    np.testing.assert_allclose(sensed_there[:, 3], along, atol=2e-3)
    assert np.abs(along).max() > 300.0
    _, without = sensed(truth, tracks="datum")
    np.testing.assert_array_equal(sensed_there[:, :3], without)


def test_range_rate_wanders_about_its_bias(truth):
    t = 101.0 + np.arange(4000) * 0.012
    spec = radar(range_rate_sd_mps=1e-6, range_rate_wander_mps=0.2, range_rate_wander_time_constant_s=0.1)
    clean = radar(range_rate_sd_mps=1e-6)
    biased = radar(range_rate_sd_mps=1e-6, range_rate_bias_mps=0.3)
    given = [sensing.range_rates(truth, each, t, t, np.random.default_rng(5)) for each in (spec, biased, clean)]
    off = [each - given[2] for each in given]
    # 4000 values correlated over 16: 250 independent ones, 4.5 % of a standard deviation
    assert off[0].std() == pytest.approx(0.2, rel=0.18)
    assert np.corrcoef(off[0][1:], off[0][:-1])[0, 1] == pytest.approx(np.exp(-0.12), abs=0.03)
    assert np.ptp(off[1]) < 1e-5
    assert 0.01 < abs(off[1].mean()) < 1.2


def test_errors_of_a_range_rate_that_is_not_measured_are_refused():
    with pytest.raises(ValueError, match="range_rate_sd_mps"):
        radar(range_rate_wander_mps=0.2)


def test_datum_and_cg_are_separated(truth):
    """The nose is half a metre ahead: the ranges differ by the lever arm's part along the line of sight."""
    at, cg = sensed(truth)
    _, nose = sensed(truth, tracks="datum")
    arm = -truth.vehicle.cg_m
    rows = np.searchsorted(truth.time_s, at - 1e-6)
    arm_ecef = rotations.rotate(truth.trajectory.q_ecef_body[rows], np.broadcast_to(arm, (len(at), 3)))
    site = earth.ecef_from_geodetic(np.deg2rad(37.841), np.deg2rad(-75.485), 12.0)
    line = truth.trajectory.position_ecef_m[rows] - site
    along = np.sum(arm_ecef * line, axis=1) / np.linalg.norm(line, axis=1)
    # arm^2 / 2R is a micrometre; the joint is straight but for its own elasticity
    np.testing.assert_allclose(nose[:, 0] - cg[:, 0], along, atol=2e-3)
    assert np.abs(along).max() > 0.3


def test_steps_limits_and_losses(truth):
    at, clean = sensed(truth)
    _, stepped = sensed(truth, range_resolution_m=2.0, angle_resolution_deg=0.01)
    np.testing.assert_allclose(np.mod(stepped[:, 0] / 2.0 + 0.5, 1.0), 0.5, atol=1e-6)
    np.testing.assert_allclose(np.mod(np.rad2deg(stepped[:, 1:]) / 0.01 + 0.5, 1.0), 0.5, atol=1e-6)
    assert np.abs(stepped - clean)[:, 0].max() <= 1.0 + 1e-9
    middle = float(np.median(clean[:, 0]))
    near_at, _ = sensed(truth, max_range_m=middle)
    np.testing.assert_array_equal(near_at, at[clean[:, 0] <= middle])
    high = float(np.rad2deg(np.median(clean[:, 2])))
    high_at, _ = sensed(truth, min_elevation_deg=high)
    np.testing.assert_array_equal(high_at, at[np.rad2deg(clean[:, 2]) >= high])
    lost_at, _ = sensed(truth, dropouts=Dropouts(outages_s=((110.0, 112.0),)))
    np.testing.assert_array_equal(lost_at, at[(at < 110.0) | (at >= 112.0)])


def test_one_error_more_leaves_the_others_draws(truth):
    noise = {"range_sd_m": 5.0, "angle_sd_deg": 0.01, "range_bias_m": 3.0, "angle_bias_deg": 0.01, "time_bias_s": 0.01}
    _, plain = sensed(truth, 4, **noise)
    _, drooping = sensed(truth, 4, **noise, droop_deg=MIL, wander_deg=0.0)
    np.testing.assert_array_equal(plain[:, :2], drooping[:, :2])
    clean = sensed(truth)[1]
    ratio = (drooping - plain)[:, 2] / np.cos(clean[:, 2])
    # the time error moves the place at which the cosine is taken: 30 ms of 1 deg/s
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=2e-3)
    assert abs(ratio.mean()) > 1e-5
