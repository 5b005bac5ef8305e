"""Refraction against a ray traced by other equations, and against closed forms where they hold."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flightmodel.refraction import Refractivity, refracted, site_radius_m
from tests.refusing import refuses

LAT, HEIGHT = 0.66, 12.0
AIR = Refractivity(350.0, 7000.0)


def traced(apparent_rad, target_radius_m, air):
    """End point (across, up from the site) and electrical length of a ray, by d(n t)/ds = grad n in the plane."""
    r0 = site_radius_m(LAT, HEIGHT)

    def slope(_, y):
        place, momentum = y[:2], y[2:4]
        r = np.hypot(*place)
        n = 1.0 + 1e-6 * float(air.at(np.array(r - r0 + HEIGHT)))
        step = 1.0
        dn = 1e-6 * float(air.at(np.array(r - r0 + HEIGHT + step)) - air.at(np.array(r - r0 + HEIGHT - step))) / 2.0
        return np.concatenate([momentum / n, dn * place / r, [n]])

    def above(_, y):
        return np.hypot(y[0], y[1]) - target_radius_m

    above.terminal = True
    n0 = 1.0 + 1e-6 * float(air.at(np.array(HEIGHT)))
    start = [0.0, r0, n0 * np.cos(apparent_rad), n0 * np.sin(apparent_rad), 0.0]
    ray = solve_ivp(slope, (0.0, 3e6), start, method="DOP853", events=above, rtol=1e-12, atol=1e-9, max_step=2e3)
    x, y, *_, length = ray.y_events[0][0]
    return x, y - r0, length


@pytest.mark.parametrize(
    ("slant", "elevation_deg"), [(156e3, 16.0), (120e3, 4.0), (300e3, 1.0), (230e3, 62.0), (15e3, 0.6)]
)
def test_ray_traced_independently_meets_the_target(slant, elevation_deg):
    el = np.deg2rad(elevation_deg)
    delay, bend = (float(x[0]) for x in refracted(np.array([slant]), np.array([el]), LAT, HEIGHT, AIR))
    r0 = site_radius_m(LAT, HEIGHT)
    target = np.hypot(slant * np.cos(el), r0 + slant * np.sin(el))
    across, up, length = traced(el + bend, target, AIR)
    # quadrature to 1e-8 of bends of some mrad; the tracer's own error is 1e-12 of 1e6 m
    assert np.arctan2(up, across) == pytest.approx(el, abs=2e-9)
    assert length - slant == pytest.approx(delay, abs=2e-4)
    assert bend > 1e-4
    assert delay > 2.0


def test_closed_forms():
    """Straight up the delay is the column of N; from outside the air the bend is N cot E, to N's square and H/R."""
    delay, bend = refracted(np.array([200e3]), np.array([0.5 * np.pi - 1e-9]), LAT, HEIGHT, AIR)
    assert delay[0] == pytest.approx(350e-6 * 7000.0 * np.exp(-HEIGHT / 7000.0), rel=1e-6)
    el, far = np.deg2rad(40.0), 2.0e7
    delay, bend = refracted(np.array([far]), np.array([el]), LAT, HEIGHT, AIR)
    n = 350e-6 * np.exp(-HEIGHT / 7000.0)
    # a flat layer bends by N cot E; curvature takes H / (R sin^2 E) of it, the lever H / (far sin E) next to nothing
    curved = n / np.tan(el) * (1.0 - 7000.0 / (6.37e6 * np.sin(el) ** 2))
    assert bend[0] == pytest.approx(curved, rel=2e-3)


def test_without_air_there_is_no_refraction():
    delay, bend = refracted(np.full(3, 150e3), np.deg2rad([1.0, 20.0, 80.0]), LAT, HEIGHT, Refractivity(0.0, 7000.0))
    np.testing.assert_allclose(delay, 0.0, atol=1e-6)
    np.testing.assert_allclose(bend, 0.0, atol=1e-13)


def test_measured_profile():
    """Samples of the exponential give its refraction; a humid layer near the ground bends more."""
    heights = np.arange(0.0, 30001.0, 1000.0)
    place = np.array([156e3]), np.deg2rad([8.0])
    same = Refractivity(1.0, 7000.0, heights, 350.0 * np.exp(-heights / 7000.0))
    np.testing.assert_allclose(refracted(*place, LAT, HEIGHT, same), refracted(*place, LAT, HEIGHT, AIR), rtol=1e-9)
    humid = Refractivity(1.0, 7000.0, heights, 350.0 * np.exp(-heights / 7000.0) + 60.0 * (heights < 500.0))
    assert refracted(*place, LAT, HEIGHT, humid)[1][0] > 1.1 * refracted(*place, LAT, HEIGHT, AIR)[1][0]
    with refuses("argument-value"):
        Refractivity(1.0, 7000.0, heights[::-1], heights)
