"""Free-molecular coefficients against closed forms, and the bridge between them and the continuum."""

import numpy as np
import pytest

from flightmodel.aerodynamics import Aerodynamics, FreeMolecular, Shape, SphereCone, aerodynamics_from
from flightmodel.atmosphere import gas_constant, mean_free_path, us76
from flightmodel.earth import MARS
from flightmodel.sphere_cone import bridge, sphere_cone_free_molecular, wall_speed_ratio

ALPHA = np.deg2rad(np.array([0.0, 4.0, 17.0, 45.0, 70.0]))


def test_mean_free_path_as_the_standard_prints_it():
    # US76 table: 6.6328e-8 m at sea level, 1.4223e-1 m at 100 km (where its mean molar mass is 28.40, not 28.96)
    assert mean_free_path(us76(0.0)[0]) == pytest.approx(6.6328e-8, rel=2e-4)
    assert mean_free_path(us76(100e3)[0], gas_constant(100e3)) == pytest.approx(1.4223e-1, rel=1e-3)
    number = 4.669e12 + 9.584e13 + 1.252e11 + 4.868e12 + 8.96e10  # table VIII at 400 km: N2, O, O2, He, H
    expected = 1.0 / (np.sqrt(2.0) * np.pi * 3.65e-10**2 * number)
    assert mean_free_path(us76(400e3)[0], gas_constant(400e3)) == pytest.approx(expected, rel=1e-3)


def test_mean_free_path_on_mars_is_that_of_a_gas_as_viscous():
    """Hard spheres by Chapman and Enskog: path = 16 / 5 viscosity / (density sqrt(2 pi R T)), first approximation."""
    gas, temperature, viscosity = MARS.gas_jpkgk, 273.15, 13.7e-6
    expected = 3.2 * viscosity / 1.016 / (1e-4 * np.sqrt(2.0 * np.pi * gas * temperature))
    assert mean_free_path(1e-4, gas, MARS) == pytest.approx(expected, rel=0.01)


def test_bridge_is_the_published_sine_square():
    kn = np.array([1e-9, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 1e4])
    # phi = pi (3/8 + log10(Kn)/8) between its ends: 0, 1/8, 2/8, 3/8, 4/8 of pi
    want = [0.0, 0.0, *np.sin(np.pi * np.array([1, 2, 3]) / 8) ** 2, 1.0, 1.0]
    np.testing.assert_allclose(bridge(kn), want, atol=1e-12)


@pytest.mark.parametrize("wall", [0.0, 0.28])
def test_flat_plate(wall):
    # diffuse plate: incoming momentum 2 cos(alpha) along the flow, recoil sqrt(pi) w cos(alpha) along the normal
    got = sphere_cone_free_molecular(ALPHA, np.deg2rad(89.9999), 1e-4, 1.5, 3.0, wall)
    c, s = np.cos(ALPHA), np.sin(ALPHA)
    np.testing.assert_allclose(got[:, 0], 2 * c * c + np.sqrt(np.pi) * wall * c, atol=1e-4)
    np.testing.assert_allclose(got[:, 1], 2 * s * c, atol=1e-4)
    np.testing.assert_allclose(got[:, 2], 0.0, atol=1e-4)
    # turning about its middle moves panels at z along x in proportion; the moment is the integral of z times the
    # change of 2 (u.n)(u_x + sqrt(pi)/2 w), so C_mq = -(4 c + sqrt(pi) w)(2/l^2) R^2/4 with l = 3, R = 1.5
    np.testing.assert_allclose(got[:, 3], -(4 * c + np.sqrt(np.pi) * wall) * 0.5 * 1.5**2 / 9.0, atol=1e-4)


@pytest.mark.parametrize("wall", [0.0, 0.06, 0.28])
def test_sphere(wall):
    # a hemisphere, and at zero angle the lee side feels nothing: C_D = 2 + 2 sqrt(pi)/3 w (Bird, 7.4, S to infinity)
    got = sphere_cone_free_molecular(np.array([0.0]), 1e-5, 1.0, 1.0 + 1e-10, 2.0, wall, 200)[0]
    assert got[0] == pytest.approx(2.0 + 2.0 * np.sqrt(np.pi) / 3.0 * wall, rel=1e-5)
    np.testing.assert_allclose(got[1:3], 0.0, atol=1e-12)


def test_cold_wall_gives_the_drag_of_the_projected_area():
    # with no recoil the force is the momentum of the stream tube: 2 A_projected / S along the flow, for any convex body
    got = sphere_cone_free_molecular(ALPHA[:4], np.deg2rad(60.0), 0.38, 1.5, 3.0, 0.0)
    c, s = np.cos(ALPHA[:4]), np.sin(ALPHA[:4])
    drag, lift = got[:, 0] * c + got[:, 1] * s, got[:, 1] * c - got[:, 0] * s
    np.testing.assert_allclose(lift, 0.0, atol=2e-4)
    # the base disc alone is seen while the cone's whole surface meets the flow
    np.testing.assert_allclose(drag, 2.0 * c, atol=2e-4)
    # and that force acts through the disc's centre, 0.81 m aft: C_m = -C_N x_b / l
    x_base = 0.38 * (1 - np.sin(np.deg2rad(60))) + (1.5 - 0.38 * 0.5) / np.tan(np.deg2rad(60))
    np.testing.assert_allclose(got[:, 2], -got[:, 1] * x_base / 3.0, atol=2e-4)


def test_axial_coefficient_at_orbital_and_at_sounding_rocket_speed():
    for wall_k, speed, want in ((300.0, 7800.0, 2.08), (300.0, 1500.0, 2.43)):
        ratio = wall_speed_ratio(wall_k, speed)
        got = sphere_cone_free_molecular(np.array([0.0]), np.deg2rad(60.0), 0.38, 1.5, 3.0, ratio)[0, 0]
        # cone alone: sqrt(pi) w sin(60); the cap adds to it
        assert got == pytest.approx(want, abs=0.006)
        assert got > 2.0 + np.sqrt(np.pi) * ratio * np.sin(np.deg2rad(60.0))


def test_table_passes_from_continuum_to_free_molecules():
    spec = Aerodynamics(
        sphere_cone=SphereCone(half_angle_deg=60.0, nose_radius_m=0.38, base_radius_m=1.5, cmq=-0.1),
        free_molecular=FreeMolecular(),
    )
    shape = Shape(np.deg2rad(60.0), 0.38, 1.5, 2.0 * np.pi * 1.5**2, 3.0)
    table, _ = aerodynamics_from(spec, shape, ())
    alpha = np.deg2rad(np.array([0.0, 12.0, 12.0, 150.0]))
    plain = table.at(5.0, alpha)
    np.testing.assert_array_equal(table.at(5.0, alpha, np.full(4, 1e-4)), plain)
    free = table.at(5.0, alpha, np.full(4, 20.0))
    np.testing.assert_allclose(free[1], table.free_molecular[12], rtol=1e-9)
    assert free[0, 0] == pytest.approx(2.43 / 2.0, abs=0.004)  # on twice the area
    half = table.at(5.0, alpha, 0.1)
    np.testing.assert_allclose(half, 0.5 * (plain + free), rtol=1e-9, atol=1e-15)  # log10 Kn = -1 is half-way
    twice = table.scaled(ca=2.0)
    np.testing.assert_allclose(twice.at(5.0, alpha, 20.0)[:, 0], 2.0 * free[:, 0])
    # drag rises with altitude alone: at 85 km by 3 %, above 110 km by more than a third
    thin = [mean_free_path(us76(z)[0], gas_constant(z)) / 3.0 for z in (70e3, 85e3, 95e3, 110e3)]
    ca = [table.at(5.0, 0.0, kn)[0] / plain[0, 0] for kn in thin]
    assert ca[0] < 1.001
    assert ca[1] < 1.04
    assert ca[3] > 1.33
    assert (np.diff(ca) > 0).all()
