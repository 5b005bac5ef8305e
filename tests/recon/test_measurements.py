"""Predictions of every kind of instrument: twin, derivatives with every term alive, and geometry done another way."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.instruments import BarometerSpec, GnssSpec, RadarSite, TriadSpec, sun_angles_from_direction
from flightmodel.telemetry import BarometerRecord, GnssRecord, RadarRecord, TriadRecord
from recon.measurements import (
    FIELD,
    HEIGHT,
    POSITION,
    RADAR,
    RANGE_RATE,
    SLOT_NAMES,
    SLOTS,
    SUN,
    VELOCITY,
    Instrument,
    barometer_instrument,
    gnss_instruments,
    magnetometer_instrument,
    radar_instrument,
    wrapped,
)
from recon.propagation import strapdown_motion
from recon.settings import Settings
from recon.setup import tracking_instruments
from synthetic_flight import sensing
from synthetic_flight.instrument_errors import Radar, child
from tests.oracles.plain_measurements import NodeMotion, predict

from .one_node import motion_at, predicted

LATITUDE, LONGITUDE, HEIGHT_M = -0.58, 0.31, 40.0
ARM = np.array([0.41, -0.36, 0.73])
# its rate of change, the specific force, and partials by the gyros' errors
RATE = np.vstack(
    [[0.63, -0.2, 0.31], [2.0, -1.4, 0.7], [-35.0, 4.0, 9.0], np.random.default_rng(8).normal(size=(9, 3))]
)
ACCELERATION = np.array([-40.0, 25.0, -12.0])
KINDS = {"radar": RADAR, "position": POSITION, "velocity": VELOCITY, "height": HEIGHT, "field": FIELD, "sun": SUN}
KINDS |= {"range rate": RANGE_RATE}
# every term alive; a pedestal bad enough that its errors' own change with direction shows
ERRORS = {
    RADAR: [
        4.0,
        2e-4,
        -1e-4,
        2.5e-3,
        3e-4,
        -2e-4,
        2e-4,
        1e-4,
        -3e-4,
        1e-4,
        -1e-4,
        0.3,
        2e-5,
        3.0,
        -2.0,
        4.0,
        2e-4,
        -1.0,
        5.0,
        2.0,
        -1e-4,
        -6.0,
        0.4,
    ],
    POSITION: [3.0, -4.0, 5.0, 0.02],
    VELOCITY: [0.2, -0.3, 0.1, 0.02],
    HEIGHT: [50.0, 0.01, -30.0, 0.05],
    FIELD: [5e-7, -3e-7, 2e-7, 0.01, -0.02, 0.015, 0.02, -0.01, 0.03, 0.01, -0.02, 0.005, 1e-7, -2e-7, 3e-7],
    RANGE_RATE: [0.3, -0.2, 0.0, 0.02],
    SUN: [0.004, -0.003, 0.03, 0.0, 0.01, -0.02, 0.015, -0.01],
}
KNOWN = {
    RADAR: [3.2e-4, 4e-4, -3e-4],
    FIELD: [1.2e-5, -2.1e-5, 0.7e-5],
    SUN: [0.3, -0.8, np.sqrt(1.0 - 0.09 - 0.64)],
}
# what one component should be told apart by, to give every partial a size
SIZE = {
    RADAR: [1.0, 1e-5, 1e-5], POSITION: [1.0] * 3, VELOCITY: [1.0] * 3, HEIGHT: [1.0] * 3, FIELD: [1e-8] * 3,
    SUN: [1e-4] * 3,
}  # fmt: skip


def instrument(kind, arm=ARM):
    dcm = earth.dcm_ned_ecef(LATITUDE, LONGITUDE)
    site = earth.ecef_from_geodetic(LATITUDE, LONGITUDE, HEIGHT_M)
    if kind in (FIELD, SUN):
        dcm = rotations.dcm_from_q(rotations.exp(np.array([0.3, -0.8, 0.5])))
    if kind == HEIGHT:
        site = np.array([5e4, 0.0, 0.0])
    if kind == SUN:
        site = np.array([-0.9, 0.0, 0.0])  # a field wide enough for the nadir
    nothing = (np.zeros(1), *(np.zeros((1, 3)),) * 3)
    return Instrument("i", kind, "i", arm, site, dcm, *nothing, np.zeros(1, dtype=int), np.zeros(1))


def padded(values):
    return np.array([*values, *[0.0] * (SLOTS - len(values))])


def known(kind):
    return np.array(KNOWN.get(kind, [0.0] * 3))


def place():
    """Position, velocity and attitude of a southern flight."""
    q = rotations.exp(np.random.default_rng(7).normal(0.0, 1.0, 3))
    return earth.ecef_from_geodetic(-0.57, 0.32, 8e4), np.array([900.0, -700.0, 500.0]), q


def compiled(source, e, position, velocity, q, rate=RATE, acceleration=ACCELERATION):
    return predicted(source, known(source.kind), e, position, velocity, q, rate, acceleration)


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_kernel_equals_readable_twin(kind):
    rng = np.random.default_rng(3)
    source = instrument(kind)
    for _ in range(20):
        e = padded(ERRORS[kind]) * rng.normal(0.0, 1.0, SLOTS)
        position = earth.ecef_from_geodetic(-0.58 + rng.normal(0, 0.02), 0.31 + rng.normal(0, 0.02), 8e4)
        velocity, q = rng.normal(0.0, 900.0, 3), rotations.exp(rng.normal(0.0, 1.0, 3))
        fast = compiled(source, e, position, velocity, q)
        at = NodeMotion(position, velocity, rotations.dcm_from_q(q), RATE, ACCELERATION)
        plain = predict(source, known(kind), e, at)
        # the kernel's geodesy is a series: height to a micrometre, latitude to 1e-7 rad
        loose = kind == HEIGHT
        for one, other in zip(fast, plain, strict=True):
            size = np.abs(other).max(axis=-1, keepdims=True) + 1e-300
            assert (np.abs(one - other) / size).max() < (2e-7 if loose else 1e-12)
    assert fast[0].shape == (3,)


def by_differences(source, e, at):
    """Partials by state and by errors, central differences."""
    position, velocity, q = at
    by_state, by_error = np.empty((3, 9)), np.zeros((3, SLOTS))
    for j, step in enumerate([10.0] * 3 + [10.0] * 3 + [1e-3] * 3):
        d = np.zeros(9)
        d[j] = step
        ends = [
            compiled(source, e, position + s * d[:3], velocity + s * d[3:6], rotations.boxplus(q, s * d[6:]))[0]
            for s in (1.0, -1.0)
        ]
        by_state[:, j] = wrapped(source.kind, ends[0] - ends[1]) / (2.0 * step)
    for j, name in enumerate(SLOT_NAMES[source.kind]):
        if j >= 4 and source.kind in (VELOCITY, RANGE_RATE):
            break  # the gyros' errors, by which the motion at a node differs
        step = 1e-4 * max(abs(e[j]), 1e-9 if source.kind == FIELD and j < 3 else 1e-3)
        if j == 3 or (source.kind == RADAR and 13 <= j < 20):
            step = max(step, 1e-5 if j == 3 else 1e-2)  # of a range of 300 km less leaves six digits
        d = np.zeros(SLOTS)
        d[j] = step
        ends = [compiled(source, e + s * d, position, velocity, q)[0] for s in (1.0, -1.0)]
        by_error[:, j] = wrapped(source.kind, ends[0] - ends[1]) / (2.0 * step) if name else 0.0
    return by_state, by_error


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_partials_are_derivatives_with_every_term_alive(kind):
    source, e = instrument(kind), padded(ERRORS[kind])
    _, by_state, by_error = compiled(source, e, *place())
    state, error = by_differences(source, e, place())
    gyros = slice(4, 14 if kind in (VELOCITY, RANGE_RATE) else 4)
    by_error[:, gyros] = 0.0
    for group in (slice(0, 3), slice(3, 6), slice(6, 9)):
        if kind == SUN and group.start == 0:
            # left out on purpose: the nadir, whose light turns the Sun by a degree, itself turns by 1e-5 deg in a metre
            assert np.abs(state[:, group]).max() < 1e-8
            continue
        size = np.abs(state[:, group]).max(axis=1, keepdims=True)
        # differences of 10 m, 10 m/s, 1 mrad: third order and rounding below 1e-5. Left out on purpose: the Earth's
        # turn seen by a turned arm (7e-5 rad/s of 0.6 rad/s) in velocities, of which a range rate sees a part
        allowed = {VELOCITY: 3e-4, RANGE_RATE: 6e-4}.get(kind, 1e-5) if group.start == 6 else 1e-5
        assert (np.abs(by_state[:, group] - state[:, group]) <= allowed * size + 1e-16).all(), (group, by_state, state)
    size = np.abs(error).max(axis=0)
    assert (np.abs(by_error - error).max(axis=0) <= 5e-6 * size).all()
    named = np.array([bool(n) for n in SLOT_NAMES[kind]])
    named[gyros] = False
    assert (size[: len(named)][named] > 0.0).all(), "a slot that does nothing"
    assert not by_error[:, len(named) :].any()
    reads = {FIELD: [False, False, True], SUN: [False, False, True], VELOCITY: [False, True, True]}
    alive = [np.abs(by_state[:, g : g + 3]).max() > 0.0 for g in (0, 3, 6)]
    assert alive == reads.get(kind, [True, True, True])


@pytest.mark.parametrize("degrees", [2.5, 5.0, 40.0, 85.0])
def test_radar_partials_from_horizon_to_zenith(degrees):
    """Near the horizon the bending's own change with elevation is a tenth of the partial, near the zenith the tilt."""
    position = earth.ecef_from_radar(np.array([3e5, 1.1, np.deg2rad(degrees)]), LATITUDE, LONGITUDE, HEIGHT_M)
    _, velocity, q = place()
    source, e = instrument(RADAR), padded(ERRORS[RADAR])
    _, by_state, by_error = compiled(source, e, position, velocity, q)
    state, error = by_differences(source, e, (position, velocity, q))
    size = np.abs(state[:, :3]).max(axis=1, keepdims=True)
    assert (np.abs(by_state - state)[:, :3] <= 1e-5 * size).all()
    assert np.allclose(by_error, error, rtol=1e-5, atol=1e-9)


def test_below_two_degrees_the_bending_stays_and_partials_with_it():
    position = earth.ecef_from_radar(np.array([3e5, 1.1, np.deg2rad(1.0)]), LATITUDE, LONGITUDE, HEIGHT_M)
    _, velocity, q = place()
    source, e = instrument(RADAR), padded(ERRORS[RADAR])
    _, by_state, _ = compiled(source, e, position, velocity, q)
    state, _ = by_differences(source, e, (position, velocity, q))
    assert (np.abs(by_state - state)[:, :3] <= 1e-5 * np.abs(state[:, :3]).max(axis=1, keepdims=True)).all()


@pytest.mark.parametrize(("kind", "first"), [(FIELD, 6), (SUN, 4)])
def test_how_far_the_partials_of_a_mount_hold(kind, first):
    """Right Jacobian to second order: 1e-3 off at 25 deg; to first order of nothing, as it was, at a tenth of one."""
    source = instrument(kind)
    axis = np.array([0.48, -0.6, 0.64])
    worst = {}
    for degrees in (1.0, 5.0, 10.0, 20.0):
        e = np.zeros(SLOTS)
        e[first : first + 3] = np.deg2rad(degrees) * axis
        _, _, by_error = compiled(source, e, *place())
        _, error = by_differences(source, e, place())
        columns = slice(first, first + 3)
        worst[degrees] = np.abs(by_error - error)[:, columns].max() / np.abs(error[:, columns]).max()
    assert worst[5.0] < 1e-4
    assert worst[20.0] < 2e-3
    # third order of a rotation
    assert 5.0 < worst[20.0] / worst[10.0] < 11.0
    e = np.zeros(SLOTS)
    _, _, at_zero = compiled(source, e, *place())
    e[first : first + 3] = np.deg2rad(0.1) * axis
    _, error = by_differences(source, e, place())
    columns = slice(first, first + 3)
    assert np.abs(at_zero - error)[:, columns].max() / np.abs(error[:, columns]).max() > 5e-4


def test_radar_sees_the_tracked_point_at_the_true_time():
    """Moving the tracked point back by the time bias along its own arc and reading it with `earth` gives the same."""
    position, velocity, q = place()
    e = padded([4.0, 2e-4, -1e-4, 2.5e-3])
    h, _, _ = compiled(instrument(RADAR), e, position, velocity, q)
    c = rotations.dcm_from_q(q)
    turn = RATE[0] - c.T @ earth.OMEGA_ECEF_RADPS
    pulled = ACCELERATION + c @ (np.cross(RATE[1], ARM) + np.cross(turn, np.cross(turn, ARM)))
    point = position + c @ ARM - 2.5e-3 * (velocity + c @ np.cross(turn, ARM)) + 0.5 * 2.5e-3**2 * pulled
    z = earth.radar_from_ecef(point, LATITUDE, LONGITUDE, HEIGHT_M)
    assert np.allclose(wrapped(RADAR, h - z), [4.0, 2e-4 + KNOWN[RADAR][1], -1e-4 + KNOWN[RADAR][2]], rtol=1e-6)


def test_a_time_bias_follows_the_flight_to_second_order(mini_truth):
    """Seen point of a spinning 8 g flight against the truth itself: what is left grows with the cube of the bias."""
    t, arm = 128.0, np.array([0.4, -0.3, 0.6])
    truth = mini_truth.trajectory(np.array([t]), arm)  # any point will do: the arm of the tracked one is from here
    h = 1e-3
    around = mini_truth.trajectory(np.array([t - h, t + h]), arm)
    acceleration = np.diff(around.velocity_ecef_mps, axis=0)[0] / (2.0 * h)
    receiver = instrument(POSITION, np.zeros(3))
    left = []
    for tau in (0.02, 0.04, 0.08):
        e = padded([0.0, 0.0, 0.0, tau])
        reading, _, _ = compiled(
            receiver, e, truth.position_ecef_m[0], truth.velocity_ecef_mps[0], truth.q_ecef_body[0],
            np.vstack([truth.omega_body_eci_body_radps[:1], np.zeros((11, 3))]), acceleration,
        )  # fmt: skip
        seen = mini_truth.trajectory(np.array([t - tau]), arm).position_ecef_m[0]
        left.append(np.linalg.norm(reading - receiver.dcm @ (seen - receiver.site_ecef_m)))
    # jerk of 10 to 20 m/s^3: 0.1 mm at 20 ms
    assert left[-1] < 20.0 * 0.08**3 / 6.0
    assert np.allclose(np.diff(np.log2(left)), 3.0, atol=0.3)


@pytest.mark.parametrize("kind", [VELOCITY, RANGE_RATE])
def test_gyros_errors_move_an_antenna_beside_the_accelerometer(kind):
    """Partials by bias, scale, mount and clock of the gyros, through the motion at a node and against differences."""
    rng, source, at = np.random.default_rng(11), instrument(kind), place()
    mounts = [rotations.dcm_from_q(rotations.exp(rng.normal(0.0, 1.0, 3))) for _ in range(2)]
    force, rate, one = rng.normal(0.0, 20.0, (2, 3)), rng.normal(0.0, 9.0, (2, 3)), np.ones((2, 3))
    motion = strapdown_motion(np.array([0.0, 0.01]), force, rate, one, one, *mounts, clocks=True)

    def seen(errors):
        return compiled(source, np.zeros(SLOTS), *at, *motion_at(motion, 1, *at, errors))

    errors = np.append(rng.normal(0.0, 0.01, 18), [0.0, 1e-3])
    by_gyros = seen(errors)[2][:, 4:14]
    for j, slot in enumerate([*range(9, 18), 19]):
        step = 1e-5 * np.eye(20)[slot]
        want = (seen(errors + step)[0] - seen(errors - step)[0]) / 2e-5
        # a mount's partial is its matrix to first order in the mount
        assert np.abs(by_gyros[:, j] - want).max() < (2e-4 if 6 <= j < 9 else 1e-7) * np.abs(by_gyros).max(), j
    assert (np.abs(by_gyros).max(axis=0) > 0.1).all()


@pytest.mark.parametrize("kind", [POSITION, VELOCITY, RANGE_RATE])
def test_no_tracker_sees_all_clocks_late_alike(kind):
    """The vehicle further on its way by what every tag is late reads the same: else a filter finds the time of day."""
    source, (position, velocity, q) = instrument(kind), place()
    c = rotations.dcm_from_q(q)
    _, by_state, by_error = compiled(source, np.zeros(SLOTS), position, velocity, q)
    ahead = np.concatenate([velocity, ACCELERATION, RATE[0] - c.T @ earth.OMEGA_ECEF_RADPS])
    clocks = by_error[:, 3] + (by_error[:, 13] if kind != POSITION else 0.0)
    np.testing.assert_allclose(by_state @ ahead, -clocks, atol=1e-9 * np.abs(by_state @ ahead).max() + 3e-4 * 0.3)
    if kind != POSITION:
        assert np.abs(by_error[:, 13]).max() > 0.5  # m/s a second


def test_a_late_velocity_of_a_fast_spinner_is_that_of_its_circle():
    """An antenna on a circle about the spin axis, as the accelerometer is: its velocity at the tag's true time."""
    w, tau, arm = np.array([37.7, 0.0, 0.0]), 2e-3, np.array([0.0, 0.2, -0.1])
    position, velocity, q = place()
    c = rotations.dcm_from_q(q)
    own = np.array([0.0, 0.05, 0.03])  # accelerometer from the spin axis
    turning = np.zeros((12, 3))
    turning[0], turning[2] = w + c.T @ earth.OMEGA_ECEF_RADPS, np.cross(w, np.cross(w, own))
    e = padded([0.0, 0.0, 0.0, tau])
    moving = velocity + c @ np.cross(w, own)
    found = compiled(instrument(VELOCITY, arm), e, position, moving, q, turning, c @ turning[2])
    earlier = rotations.dcm_from_q(rotations.boxplus(q, -tau * w))
    ned = earth.dcm_ned_ecef(LATITUDE, LONGITUDE)
    want = ned @ (velocity + earlier @ np.cross(w, own + arm))
    radius, turned = np.linalg.norm((own + arm)[1:]), 37.7 * tau
    assert np.linalg.norm(found[0] - want) < 37.7 * radius * turned**3 / 5.0
    assert 37.7 * radius * turned**2 / 2.0 > 0.02  # what the second order is, m/s
    partial = -ned @ earlier @ np.cross(w, np.cross(w, own + arm))
    np.testing.assert_allclose(found[2][:, 3], partial, atol=37.7**2 * radius * turned**2)


def test_receiver_and_height_equal_geometry():
    position, velocity, q = place()
    c = rotations.dcm_from_q(q)
    point = position + c @ ARM
    swing = c @ np.cross(RATE[0] - c.T @ earth.OMEGA_ECEF_RADPS, ARM)
    ned = earth.dcm_ned_ecef(LATITUDE, LONGITUDE)
    site = earth.ecef_from_geodetic(LATITUDE, LONGITUDE, HEIGHT_M)
    h, _, _ = compiled(instrument(POSITION), padded([3.0, -4.0, 5.0]), position, velocity, q)
    assert np.allclose(h, ned @ (point - site) + [3.0, -4.0, 5.0], atol=1e-8)
    h, _, _ = compiled(instrument(VELOCITY), np.zeros(SLOTS), position, velocity, q)
    assert np.allclose(h, ned @ (velocity + swing), atol=1e-10)
    h, _, _ = compiled(instrument(HEIGHT), padded([50.0, 0.01, -30.0]), position, velocity, q)
    height = earth.geodetic_from_ecef(point)[2]
    assert np.isclose(h[0], height + 20.0 + 0.01 * (height - 5e4), atol=2e-6)


def test_field_and_sun_equal_geometry():
    position, velocity, q = place()
    source, e = instrument(FIELD), padded(ERRORS[FIELD])
    c = rotations.dcm_from_q(q)
    mount = source.dcm @ rotations.dcm_from_q(rotations.exp(e[6:9]))
    iron = np.array([[1 + e[3], e[9], e[10]], [e[9], 1 + e[4], e[11]], [e[10], e[11], 1 + e[5]]])
    h, _, _ = compiled(source, e, position, velocity, q)
    assert np.allclose(h, iron @ mount.T @ c.T @ (known(FIELD) + e[12:15]) + e[0:3], rtol=1e-12)
    source, e = instrument(SUN), padded(ERRORS[SUN])
    mount = source.dcm @ rotations.dcm_from_q(rotations.exp(e[4:7]))
    up = position / np.linalg.norm(position)
    light = known(SUN) - (e[2] + e[7]) * up
    az, el = sun_angles_from_direction(mount.T @ c.T @ light)
    h, _, _ = compiled(source, e, position, velocity, q)
    # of the bias the light's three hundredths are left out
    assert np.allclose(h[:2], [az + e[0] / np.cos(el) / np.linalg.norm(light), el + e[1]], rtol=1e-12)
    # a head that has not the nadir in its field takes only the light that all take
    away = replace(source, site_ecef_m=np.ones(3))
    light = known(SUN) - e[7] * up
    az, el = sun_angles_from_direction(mount.T @ c.T @ light)
    h, _, by_error = compiled(away, e, position, velocity, q)
    assert np.allclose(h[:2], [az + e[0] / np.cos(el) / np.linalg.norm(light), el + e[1]], rtol=1e-12)
    assert not by_error[:, 2].any()
    # a late tag: what was read before
    late, plain = e.copy(), e.copy()
    late[3] = 1e-4
    before = compiled(source, plain, position, velocity, rotations.boxplus(q, -1e-4 * RATE[0]))[0]
    assert np.allclose(compiled(source, late, position, velocity, q)[0], before, atol=1e-8)


TERMS = {  # slot of ours: name of the drawn error in the simulator's pedestal
    "droop": ("droop_deg", 2),
    "skew": ("skew_deg", 1),
    "non-orthogonality": ("nonorthogonality_deg", 1),
    "range scale": ("range_scale", 0),
}


@pytest.mark.parametrize("name", TERMS)
@pytest.mark.parametrize("place_rad", [(0.4, 0.1), (2.9, 0.7), (5.1, 1.2)])
def test_pedestal_terms_have_the_simulators_signs_and_sizes(name, place_rad):
    field, component = TERMS[name]
    size = 1e-5 if name == "range scale" else 1e-3
    spec = Radar(
        latitude_deg=-33.0, longitude_deg=18.0, height_m=40.0, rate_hz=10.0, range_sd_m=0.0, angle_sd_deg=0.0,
        range_bias_m=0.0, angle_bias_deg=0.0, time_bias_s=0.0, **{field: size},
    )  # fmt: skip
    seen = np.array([[2e5, *place_rad], [2e5, 1.0, 0.5]])
    out = sensing.pedestal_errors(seen, spec, np.random.default_rng(4))
    slot = SLOT_NAMES[RADAR].index(name)
    drawn = child(np.random.default_rng(4), name.replace("non-", "non")).standard_normal(1)[0]
    drawn *= size if name == "range scale" else np.deg2rad(size)
    for direction, error in zip(seen, out, strict=True):
        _, _, ours = partials_towards(direction)
        assert np.allclose(error, drawn * ours[:, slot], rtol=1e-9, atol=1e-15)
        assert error[component] != 0.0


@pytest.mark.parametrize("place_rad", [(0.4, 0.1), (2.9, 0.7), (5.1, 1.2)])
def test_tilt_is_the_turned_pedestal_to_first_order(place_rad):
    _, _, ours = partials_towards(np.array([2e5, *place_rad]))
    for tilt in (np.array([1e-4, 0.0]), np.array([0.0, 1e-4]), np.array([-2e-4, 3e-4])):
        exact = sensing.mislevel(np.array(place_rad[:1]), np.array(place_rad[1:]), tilt)[0]
        # second order: tilt^2 tan^2 E
        second = (tilt @ tilt) * (1.0 + np.tan(place_rad[1]) ** 2)
        assert np.abs(exact - ours[1:, 4:6] @ tilt).max() < second
        assert np.abs(exact).max() > 20.0 * second


def partials_towards(range_az_el):
    position = earth.ecef_from_radar(range_az_el, LATITUDE, LONGITUDE, HEIGHT_M)
    return compiled(instrument(RADAR, np.zeros(3)), np.zeros(SLOTS), position, np.zeros(3), np.array([1.0, 0, 0, 0]))


def test_datum_and_cg_tracks_differ_by_the_arm():
    site = RadarSite("r", LATITUDE, LONGITUDE, HEIGHT_M, 5.0, 1e-4, 5.0, 1e-4, 2e-3)
    cg, imu = np.array([-0.54, 0.004, 0.0]), np.array([-0.95, 0.04, -0.03])
    track = np.array([[1e5, 0.1, 0.2], [1e5, 0.1, 0.2]])
    radars = {point: RadarRecord(site, np.array([0.0, 1.0]), track, point) for point in ("cg", "datum")}
    telemetry = SimpleNamespace(
        radars=radars,
        gnss={},
        barometers={},
        accelerometer=True,
        rates=True,
        planet=earth.WGS84,
        drag_accelerometer=None,
        vehicle=SimpleNamespace(cg_m=cg),
    )
    arms = {i.name: i.arm_body_m for i in tracking_instruments(telemetry, Settings(), imu)}
    assert np.allclose(arms["datum"], -imu)
    assert np.allclose(arms["cg"] - arms["datum"], cg)


def test_angles_wrap():
    assert np.allclose(wrapped(RADAR, np.array([0.0, 0.02 - 2.0 * np.pi, 0.0]))[1], 0.02)
    assert np.allclose(wrapped(SUN, np.array([2.0 * np.pi - 0.02, 0.0, 0.0]))[0], -0.02)
    assert wrapped(POSITION, np.array([9.0, 9.0, 9.0])).max() == 9.0


def test_traverse_noise_grows_with_elevation_and_missing_components_are_infinite():
    site = RadarSite("r", LATITUDE, LONGITUDE, HEIGHT_M, 5.0, 1e-4, 5.0, 1e-4, 2e-3)
    track = np.array([[1e5, 0.3, 0.1], [1e5, 0.3, 1.1], [1e5, np.nan, 0.2], [np.nan] * 3, [np.nan, 0.1, np.nan]])
    radar = radar_instrument("r", RadarRecord(site, np.arange(5.0), track), ARM)
    assert np.allclose(np.sqrt(radar.variance[0]), [5.0, 1e-4 / np.cos(0.1), 1e-4])
    assert np.allclose(np.sqrt(radar.variance[1]), [5.0, 1e-4 / np.cos(1.1), 1e-4])
    assert np.array_equal(np.isinf(radar.variance), np.isnan(track[[0, 1, 2, 4]]))
    assert np.array_equal(radar.time_s, [0.0, 1.0, 2.0, 4.0])
    assert np.isfinite(radar.value).all()
    assert np.array_equal(radar.count, [3, 3, 2, 1])
    axis = radar_instrument("r", RadarRecord(site, np.arange(5.0), track), ARM, traverse=False)
    assert np.allclose(np.sqrt(axis.variance[1]), [5.0, 1e-4, 1e-4])


def test_instruments_without_a_reading_are_none():
    t = np.arange(3.0)
    nothing = np.full((3, 3), np.nan)
    spec = GnssSpec("g", np.zeros(3), 1.0, 1.0, 0.1, 0.1)
    assert gnss_instruments("g", GnssRecord(spec, t, nothing, nothing), np.zeros(3)) == []
    some = np.tile(earth.ecef_from_geodetic(0.1, 0.2, 1e4), (3, 1))
    assert [i.kind for i in gnss_instruments("g", GnssRecord(spec, t, some, nothing), np.zeros(3))] == [POSITION]
    height = BarometerRecord(BarometerSpec("b", 1.0, 1.0, 0.0), t, np.full(3, np.nan))
    assert len(barometer_instrument("b", height, np.zeros(3)).time_s) == 0


def test_noise_of_a_magnetometer_holds_its_resolution():
    spec = TriadSpec("m", np.zeros(3), np.eye(3), 1e-7, 0.0, 0.0, 0.0, resolution=6e-7)
    record = TriadRecord(spec, np.arange(2.0), np.full((2, 3), 2e-5))
    found = magnetometer_instrument("m", record, np.zeros((2, 3)), np.arange(2))
    assert np.allclose(found.variance, 1e-14 + 3.6e-13 / 12.0)


def test_a_receivers_noise_is_each_fixs_own_where_it_is_stated():
    n = 3
    spec = GnssSpec("gps", np.zeros(3), 5.0, 10.0, 0.5, 1.0)
    own = np.array([[2.0, 3.0, 0.2, 0.4], [np.nan] * 4, [2.0, np.nan, np.nan, 0.4]])
    place = np.tile([7e6, 0.0, 0.0], (n, 1))
    record = GnssRecord(spec, np.arange(n) + 0.0, place, np.zeros((n, 3)), sd=own)
    position, velocity = gnss_instruments("gps", record, np.zeros(3))
    np.testing.assert_allclose(np.sqrt(position.variance), [[2.0, 2.0, 3.0], [5.0, 5.0, 10.0], [2.0, 2.0, 10.0]])
    np.testing.assert_allclose(np.sqrt(velocity.variance), [[0.2, 0.2, 0.4], [0.5, 0.5, 1.0], [0.5, 0.5, 0.4]])
    # velocities alone, in the local axes of another place; without one there are none
    alone = GnssRecord(spec, np.arange(n) + 0.0, np.full((n, 3), np.nan), np.tile([1.0, 0.0, 0.0], (n, 1)))
    assert gnss_instruments("gps", alone, np.zeros(3)) == []
    (only,) = gnss_instruments("gps", alone, np.zeros(3), near_ecef_m=place[0])
    np.testing.assert_allclose(only.value, np.tile([0.0, 0.0, -1.0], (n, 1)), atol=1e-12)


def test_noise_of_a_distant_fix_lies_north_east_and_down_of_it():
    """Over 13 deg of latitude the first fix's north takes in 5 % of the variance that is down here."""
    latitude = np.deg2rad([38.0, 25.0, 25.0])
    place = earth.ecef_from_geodetic(latitude, np.full(3, -2.5), np.zeros(3))
    place[2] = np.nan  # a velocity alone
    spec = GnssSpec("gps", np.zeros(3), 3.0, 5.0, speed_sd_mps=0.1, vertical_speed_sd_mps=0.2)
    instruments = gnss_instruments("gps", GnssRecord(spec, np.arange(3.0), place, np.ones((3, 3))), np.zeros(3))
    c, s = np.cos(np.deg2rad(13.0)) ** 2, np.sin(np.deg2rad(13.0)) ** 2
    for one, across, down in zip(instruments, (3.0, 0.1), (5.0, 0.2), strict=True):
        far = [c * across**2 + s * down**2, across**2, s * across**2 + c * down**2]
        expected = np.array([[across**2, across**2, down**2], far, far])[: len(one.time_s)]
        np.testing.assert_allclose(one.variance, expected, rtol=1e-9)
