"""The flight's kernels on single states and steps, quick enough to run interpreted."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from synthetic_flight import dynamics, film, instrument_errors, simulate
from synthetic_flight.simulate import integrate
from tests.oracles import plain_film, two_body

from .test_dynamics import entry_45_km, kernel_rates, windy

PARTS = [slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 14), slice(14, 17), slice(17, 20)]


def bent_by(state, vehicle, theta_rad):
    """The same state with the shell bent by so much about one lateral axis."""
    out = state.copy()
    out[10:14] = rotations.multiply(state[6:10], rotations.exp(np.array([0.004, 0.6 * theta_rad, -0.8 * theta_rad])))
    return out


# within the dead band of 0.4 deg, in its rounded corner, beyond it, and far beyond, where spring and damper harden
@pytest.mark.parametrize("theta_deg", [0.2, 0.4, 0.43, 3.0, 12.0])
def test_rates_are_those_of_the_readable_form(generic_vehicle, theta_deg):
    state, profile = bent_by(entry_45_km(), generic_vehicle, np.deg2rad(theta_deg)), windy()
    state[:3] *= 1.0 + 17.0 / np.linalg.norm(state[:3])  # between two rows of the air's table
    got, aux = kernel_rates(state, generic_vehicle, simulate.atmosphere_table(profile))
    force, _ = two_body.aerodynamics(state, generic_vehicle, profile)
    # log density is linear between rows: half way it errs by its curvature, 0.1 / (7 km)^2, times (50 m)^2 / 8: 6e-7
    np.testing.assert_allclose(aux[12:15], force, rtol=1e-6, atol=1e-9 * np.linalg.norm(force))
    want = two_body.rates(state, generic_vehicle, two_body.flight_loads(state, generic_vehicle, profile))
    for part in PARTS:  # loads a millionth off move each body's rates by as much of what the loads do
        assert np.linalg.norm(got[part] - want[part]) < 2e-6 * max(np.linalg.norm(want[part]), 1.0)
    airless, _ = kernel_rates(state, generic_vehicle, simulate.vacuum_table())
    want = two_body.rates(state, generic_vehicle, two_body.flight_loads(state, generic_vehicle, None))
    np.testing.assert_allclose(airless, want, rtol=1e-11, atol=1e-11)


def test_a_locked_joint_makes_one_rigid_body(generic_vehicle):
    # about the composite c.g.: J w' + w x J w is the moment of all loads; the joint's force is what the body lacks
    state, profile = entry_45_km(), windy()
    state[17:20] = rotations.rotate(
        rotations.multiply(rotations.conjugate(state[10:14]), state[6:10]), state[14:17]
    )  # one rate
    got, aux = kernel_rates(state, generic_vehicle, simulate.atmosphere_table(profile), locked=True)
    about = dynamics.offsets(state, generic_vehicle)
    loads = two_body.flight_loads(state, generic_vehicle, profile)
    w = rotations.rotate(state[6:10], state[14:17])
    inertia, moment = np.zeros((3, 3)), loads.moment_shell_nm.copy()
    for part, name, q, force in (
        (generic_vehicle.centerbody, "body", state[6:10], loads.force_body_n),
        (generic_vehicle.aeroshell, "shell", state[10:14], loads.force_shell_n),
    ):
        r, c = about[name][0], rotations.dcm_from_q(q)
        inertia += c @ part.inertia @ c.T + part.mass_kg * (r @ r * np.eye(3) - np.outer(r, r))
        moment += np.cross(r, force)
    turn = np.linalg.solve(inertia, moment - np.cross(w, inertia @ w))
    for columns, q in ((slice(14, 17), state[6:10]), (slice(17, 20), state[10:14])):
        np.testing.assert_allclose(rotations.rotate(q, got[columns]), turn, rtol=1e-5, atol=1e-7)
    body, r = generic_vehicle.centerbody, about["body"][0]
    acceleration = got[3:6] + np.cross(turn, r) + np.cross(w, np.cross(w, r))
    np.testing.assert_allclose(aux[6:9], body.mass_kg * acceleration - loads.force_body_n, rtol=1e-5, atol=1e-4)


def test_a_step_is_runge_and_kutta_s_of_fourth_order(generic_vehicle):
    # once more from the right-hand side alone; quaternions of length one again after the step
    state, table, h = entry_45_km(), simulate.atmosphere_table(windy()), 2e-3

    def slope(y):
        return kernel_rates(y, generic_vehicle, table)[0]

    k1 = slope(state)
    k2 = slope(state + 0.5 * h * k1)
    k3 = slope(state + 0.5 * h * k2)
    k4 = slope(state + h * k3)
    want = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    for part in (slice(6, 10), slice(10, 14)):
        want[part] /= np.linalg.norm(want[part])
    states, _ = integrate(generic_vehicle, table, state, h, 1, 2)
    np.testing.assert_allclose(states[1], want, rtol=1e-13, atol=1e-13)


def test_dead_band_is_that_of_the_readable_form():
    freeplay, corner = np.deg2rad(0.4), 0.1
    for theta in np.deg2rad(np.linspace(0.0, 1.0, 41)):
        got = dynamics.beyond_freeplay(theta, *simulate.freeplay_corner(freeplay, corner))
        assert got == pytest.approx(float(dynamics.angle_beyond_freeplay(theta, freeplay, corner)), abs=1e-17)
    # the integral from rest to beyond is that of the sharp corner but for what the rounding gives away: half^2 / 12...
    half = corner * freeplay
    grid = np.linspace(freeplay - half, freeplay + half, 4001)
    area = np.trapezoid([dynamics.beyond_freeplay(x, *simulate.freeplay_corner(freeplay, corner)) for x in grid], grid)
    assert area == pytest.approx((2.0 * half) ** 3 / (12.0 * half), rel=1e-6)


def test_gauss_markov_noise_is_stationary_row_by_row():
    # each row of unit white noise by itself: what is left of it later, and how much of it comes in
    keep = np.array([0.9, 0.2, 0.7])
    weight = np.empty((4, 4))
    for row in range(4):
        white, out = np.zeros((4, 1)), np.empty((4, 1))
        white[row] = 1.0
        instrument_errors.unit_gauss_markov(keep, white, out)
        weight[:, row] = out[:, 0]
    covariance = weight @ weight.T
    np.testing.assert_allclose(np.diag(covariance), 1.0, rtol=1e-14)
    for i in range(4):
        for j in range(i, 4):
            assert covariance[i, j] == pytest.approx(np.prod(keep[i:j]), rel=1e-13)


def test_air_turns_with_the_earth_and_blows_from_where_it_should(generic_vehicle):
    # at rest against still air there is no flow; against a wind there is the wind's, from the other side
    calm = replace(windy(), wind_ned_mps=np.zeros_like(windy().wind_ned_mps))
    state = entry_45_km()
    state[14:20] = 0.0
    _, aux = kernel_rates(state, generic_vehicle, simulate.atmosphere_table(calm))
    nose = dynamics.points(state, generic_vehicle)["nose"][0]
    state[3:6] = np.cross(earth.OMEGA_ECEF_RADPS, nose)
    _, still = kernel_rates(state, generic_vehicle, simulate.atmosphere_table(calm))
    assert still[2] < 1e-9 * aux[2]
    _, blown = kernel_rates(state, generic_vehicle, simulate.atmosphere_table(windy()))
    sound = float(calm.at(still[0]).sound_speed_mps)
    assert blown[2] * sound == pytest.approx(np.hypot(12.0, 23.0), rel=1e-6)


def test_a_locked_joint_carries_the_difference_of_gravity(generic_vehicle):
    # without air and at rest: the joint's force is what keeps the body from falling as its own place asks for
    state = entry_45_km()
    state[14:20] = 0.0
    got, aux = kernel_rates(state, generic_vehicle, simulate.vacuum_table(), locked=True)
    about, loads = dynamics.offsets(state, generic_vehicle), two_body.flight_loads(state, generic_vehicle, None)
    turn = rotations.rotate(state[6:10], got[14:17])
    body = generic_vehicle.centerbody
    want = body.mass_kg * (got[3:6] + np.cross(turn, about["body"][0])) - loads.force_body_n
    assert 1e-6 < np.linalg.norm(want) < 1e-2
    np.testing.assert_allclose(aux[6:9], want, atol=2e-9)


def seen_along(rays, eye, light, shell_and_warp, body, painted, shadows):
    """Depth and radiance (h, w) of a shell in body axes that rays (h, w, 3) meet."""
    depth, shade = np.empty((2, *rays.shape[:2]))
    free, flat = np.full(depth.size, np.nan if shadows else 1.0), rays.reshape(-1, 3)
    film.cast(rays, np.ones(depth.shape, dtype=bool), np.eye(3), eye, *shell_and_warp, depth)
    film.see_sun(flat, depth.ravel(), np.eye(3), eye, light, *shell_and_warp, body, free)
    film.shade_shell(flat, depth.ravel(), free, np.eye(3), eye, light, *shell_and_warp, painted, shade.ravel())
    return depth, shade


@pytest.mark.parametrize("bent", [None, film.Warp(0.01, -0.006, 0.004, 0.005, -0.003)])
def test_the_film_s_rays_meet_what_plain_ones_do(generic_vehicle, bent):
    geometry = generic_vehicle.geometry
    eye, light = np.array([-1.4, 0.17, 0.09]), np.array([-0.5, -0.81, 0.3])
    rng = np.random.default_rng(4)
    rays = np.array([0.5, 0.8, 0.4]) + 0.3 * rng.standard_normal((8, 5, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    shell, warp = film.shell_terms(geometry), film.warp_terms(bent)
    body = (np.zeros(3), np.array([-1.0, 0.0, 0.0]), 0.19, 1.5)
    depth, shade = seen_along(rays, eye, light, (shell, warp), body, True, False)
    stack = plain_film.Stack(geometry)
    stack.warp = bent
    plain = plain_film.Rays(rays.reshape(-1, 3).T.astype(np.float32), eye)
    t, gap = stack.march(plain, np.full(40, 0.05, dtype=np.float32), 400)
    met = (np.abs(gap) < 1e-3).reshape(8, 5)
    assert 10 < met.sum() < 40
    np.testing.assert_array_equal(np.isfinite(depth), met)
    np.testing.assert_allclose(depth[met], t.reshape(8, 5)[met], atol=2e-3)
    np.testing.assert_allclose(shade[met], stack.shade(plain, t, light).reshape(8, 5)[met], atol=0.01)
    near, closest = np.empty((2, 40))
    film.closest(rays.reshape(-1, 3), t.astype(float), np.eye(3), eye, shell, warp, near, closest)
    want, far = stack.closest(plain, t)
    np.testing.assert_allclose(near, far, atol=1e-4)
    np.testing.assert_allclose(closest, want, atol=2e-3)


def test_the_way_to_the_stack_meets_nothing_before_it(generic_vehicle):
    """Between a point aft of the stack and where its shadow ray goes on, no torus is near: sampled densely."""
    geometry = generic_vehicle.geometry
    rng = np.random.default_rng(5)
    stack, share = plain_film.Stack(geometry), np.empty(30)
    light = np.array([-0.25, -0.9, 0.27])
    light /= np.linalg.norm(light)
    r, clock, out = rng.uniform(0.4, 1.3, 30), rng.uniform(0.0, 2.0 * np.pi, 30), rng.uniform(0.12, 0.3, 30)
    station = stack.s0 + ((r - stack.r0) * stack.cos + out) / stack.sin
    points = np.column_stack([-station, -r * np.cos(clock), r * np.sin(clock)])
    film.sunlit(points, light, film.shell_terms(geometry), film.warp_terms(None), share)
    ways = np.linspace(0.0, 4.0, 4001)
    for point, seen in zip(points, share, strict=True):
        along = (point + ways[:, None] * light).T
        gap = stack.gap(plain_film.Rays(along.astype(np.float32), np.zeros(3)), np.float32(1.0))
        free = np.min(gap[1:] / (film.SUN_DIAMETER * ways[1:]))
        assert seen == pytest.approx(np.clip(free, 0.0, 1.0), abs=0.05)
    assert 0.2 < np.mean(share > 0.5) < 0.8


def test_the_film_s_shadows_are_those_of_a_sampled_ray(generic_vehicle):
    """Every pixel's ray towards the Sun, sampled each millimetre, against the centerbody and the tori."""
    geometry, light = generic_vehicle.geometry, np.array([-0.5, -0.77, -0.35])
    light /= np.linalg.norm(light)
    eye, away = np.array([-1.4, 0.174, 0.089]), np.array([0.0, 0.89, 0.455])
    nose, radius, length = np.array([-0.1, 0.03, 0.0]), geometry.centerbody_radius_m, 1.2
    across = np.cross(away, [1.0, 0.0, 0.0])
    grid = [
        [0.6, 0.0, 0.0] + up * away + side * across for up in (0.5, 0.8, 1.1) for side in np.linspace(-0.9, 0.9, 12)
    ]
    rays = np.array(grid).reshape(3, 12, 3)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    body, shell, warp = (
        (nose, np.array([-1.0, 0.0, 0.0]), radius, length),
        film.shell_terms(geometry),
        film.warp_terms(None),
    )
    depth, lit = seen_along(rays, eye, light, (shell, warp), body, False, False)
    _, dark = seen_along(rays, eye, light, (shell, warp), body, False, True)
    _, unlit = seen_along(rays, eye, 0.0 * light, (shell, warp), body, False, False)
    stack, seen = plain_film.Stack(geometry), []
    for i, j in zip(*np.nonzero((lit - unlit > 0.05) & np.isfinite(depth)), strict=True):
        at = eye + depth[i, j] * rays[i, j] + np.arange(0.01, 3.0, 0.001)[:, None] * light
        gap = stack.gap(plain_film.Rays(at.T.astype(np.float32), np.zeros(3)), np.float32(1.0))
        off = np.hypot(*(at - nose)[:, 1:].T) - radius
        inside = (off < 0.0) & (at[:, 0] < nose[0]) & (at[:, 0] > nose[0] - length)
        near = abs(np.min(off[(at[:, 0] < nose[0]) & (at[:, 0] > nose[0] - length)], initial=1.0))
        end = np.min(np.abs(at[off < 0.0, 0] - (nose[0] - length)), initial=1.0)
        if near > 0.02 and end > 0.02 and abs(np.min(gap[30:])) > 0.02:  # no half shadow
            seen.append((bool(inside.any()), bool((gap < 0.0).any()), (dark - unlit)[i, j] / (lit - unlit)[i, j]))
    by_body, by_shell, share = np.array(seen).T
    np.testing.assert_allclose(share, np.where(by_body + by_shell > 0.0, 0.0, 1.0), atol=1e-6)
    assert by_body.sum() >= 2
    assert (share > 0.5).sum() > 5
