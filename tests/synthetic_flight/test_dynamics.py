from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.vehicle import AeroTerms
from synthetic_flight import dynamics, simulate
from synthetic_flight.simulate import integrate, state_from_ecef
from tests.oracles import two_body

from .conftest import entry_state, free_state, undamped, with_joint


def entry_45_km():
    rng = np.random.default_rng(1)
    r = earth.ecef_from_geodetic(-0.7, 2.1, 45e3)
    v = rng.normal(size=3) * 300 - r / np.linalg.norm(r) * 900
    x = v / np.linalg.norm(v)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    q = rotations.q_from_dcm(np.column_stack([x, y, np.cross(x, y)])[None])[0]
    q = rotations.boxplus(q, np.array([0.3, 0.1, -0.2]))
    bent = rotations.exp(np.array([0.003, 0.05, 0.06]))
    state = state_from_ecef(0.0, r, v, q, rng.normal(size=3), bent)
    state[17:20] += rng.normal(size=3) * 0.3
    return state


def windy():
    z = np.arange(0.0, 100e3, 500.0)
    n = len(z)
    return AtmosphereProfile(z, np.zeros(n), np.zeros(n), np.tile([12.0, -23.0, 0.0], (n, 1)), np.ones(n), np.ones(n))


def kernel_rates(state, vehicle, table, locked=False, added=0.0):
    s = simulate.workspace(state[None], simulate.parameter_vector(vehicle)[None])
    s[dynamics.ADDED] = added
    s[dynamics.TRIAL : dynamics.TRIAL + dynamics.STATES] = state
    terms = (0,) * (vehicle.aero_terms != AeroTerms())
    dynamics.rates(s, (0,), (), terms, *simulate.kernel_tables(vehicle, table), earth.WGS84, locked, added > 0.0)
    # as recorded: forces and moments in ECI
    vectors = s[dynamics.FORCE : dynamics.FORCE + 9].reshape(3, 3) @ s[dynamics.R_A : dynamics.R_A + 9].reshape(3, 3).T
    aux = np.concatenate(
        [s[dynamics.ALTITUDE : dynamics.ALTITUDE + 6], vectors.ravel(), s[dynamics.RATE + 14 : dynamics.RATE + 17]]
    )
    return s[dynamics.RATE : dynamics.RATE + dynamics.STATES], aux


@pytest.mark.parametrize("quadratic_nmprad2", [0.0, 3e4])
def test_kernel_equals_the_readable_form_with_every_term_alive(generic_vehicle, quadratic_nmprad2):
    generic_vehicle = with_joint(generic_vehicle, quadratic_nmprad2=quadratic_nmprad2)
    state, profile = entry_45_km(), windy()
    dy, aux = kernel_rates(state, generic_vehicle, simulate.atmosphere_table(profile))
    force, _ = two_body.aerodynamics(state, generic_vehicle, profile)
    # the kernel reads density every 50 m, linear in its logarithm: (50 m / 7 km)^2 / 8 of curvature at most
    np.testing.assert_allclose(aux[12:15], force, rtol=2e-7)
    want = two_body.rates(state, generic_vehicle, two_body.flight_loads(state, generic_vehicle, profile))
    np.testing.assert_allclose(dy, want, rtol=1e-6, atol=1e-7)
    # with the kernel's own aerodynamic force, the mechanics agrees to rounding
    drag_free, _ = kernel_rates(state, generic_vehicle, simulate.vacuum_table())
    want = two_body.rates(state, generic_vehicle, two_body.flight_loads(state, generic_vehicle, None))
    np.testing.assert_allclose(drag_free, want, rtol=1e-11, atol=1e-11)


def twist_acceleration(state, rate):
    """Second derivative of the twist along the motion, by central differences of the angle itself, rad/s^2."""

    def twisted(t):
        turned = [
            rotations.multiply(state[q], rotations.exp(t * state[w] + 0.5 * t * t * rate[w] + t**3 / 12.0 * bent))
            for q, w, bent in (
                (slice(6, 10), slice(14, 17), np.cross(state[14:17], rate[14:17])),
                (slice(10, 14), slice(17, 20), np.cross(state[17:20], rate[17:20])),
            )
        ]
        return dynamics.twist(*turned)

    h = 1e-3
    near, far = (twisted(k * h) - 2.0 * twisted(0.0) + twisted(-k * h) for k in (1, 2))
    return (16.0 * near - far) / (12.0 * h * h)


def test_an_inertia_of_the_twist_is_a_torsion_against_its_acceleration(generic_vehicle, measured):
    """The readable form with that torsion as a load on both bodies gives the kernel's accelerations."""
    state, added = entry_45_km(), 0.7
    plain, _ = kernel_rates(state, generic_vehicle, simulate.vacuum_table())
    slowed, _ = kernel_rates(state, generic_vehicle, simulate.vacuum_table(), added=added)
    before, after = twist_acceleration(state, plain), twist_acceleration(state, slowed)
    assert abs(after) < 0.9 * abs(before)
    ends = [rotations.rotate(q, np.array([1.0, 0.0, 0.0])) for q in (state[6:10], state[10:14])]
    torsion = -added * after * (ends[0] + ends[1]) / (1.0 + ends[0] @ ends[1])
    loads = two_body.flight_loads(state, generic_vehicle, None)
    loads = replace(loads, moment_body_nm=torsion, moment_shell_nm=loads.moment_shell_nm - torsion)
    want = two_body.rates(state, generic_vehicle, loads)
    # differences of 1 ms: 1e-12 of the angle's rounding over h^2, 1e-6 of the acceleration
    measured("accelerations with a slowed twist, rad/s^2 of 1", np.abs(slowed - want).max() / abs(before), 1e-5)


def test_kernel_bridges_to_free_molecular_flow_as_the_readable_form(generic_vehicle):
    alpha = generic_vehicle.aero.alpha_rad
    free = np.column_stack([2.4 * np.cos(alpha), 0.3 * np.sin(alpha), -0.2 * np.sin(2 * alpha), 0.1 + 0.0 * alpha])
    vehicle = replace(generic_vehicle, aero=replace(generic_vehicle.aero, free_molecular=free))
    state, profile = entry_45_km(), windy()
    state[:3] *= 1.0 + 58e3 / np.linalg.norm(state[:3])  # 103 km: nearly half way
    _, aux = kernel_rates(state, vehicle, simulate.atmosphere_table(profile))
    force, _ = two_body.aerodynamics(state, vehicle, profile)
    plain = replace(generic_vehicle, aero=replace(generic_vehicle.aero, free_molecular=None))
    continuum, _ = two_body.aerodynamics(state, plain, profile)
    assert np.linalg.norm(force) > 1.1 * np.linalg.norm(continuum)
    # the bridge is linear between rows 50 m apart: 50 m is 1 % of a decade's 12 km
    np.testing.assert_allclose(aux[12:15], force, rtol=2e-5, atol=1e-9)


def test_joint_point_of_both_bodies_has_one_acceleration(generic_vehicle):
    # differentiate the joint's position as seen from each body along a short flight: no drift, one point
    states, _ = integrate(generic_vehicle, simulate.atmosphere_table(windy()), entry_45_km(), 1e-4, 1, 2001)
    where = dynamics.points(states, generic_vehicle)
    arm_a = rotations.rotate(
        states[:, 10:14], np.broadcast_to(generic_vehicle.joint_m - generic_vehicle.aeroshell.cg_m, (2001, 3))
    )
    np.testing.assert_allclose(where["shell"][0] + arm_a, where["joint"][0], atol=1e-8)
    # and each body's c.g. obeys Newton's law with the recorded joint force: velocity change equals the impulse
    dt = 1e-4
    _, aux = integrate(generic_vehicle, simulate.atmosphere_table(windy()), entry_45_km(), dt, 1, 2001)
    g = earth.gravitation(where["body"][0])
    acceleration = aux[:, 6:9] / generic_vehicle.centerbody.mass_kg + g
    impulse = np.sum(0.5 * dt * (acceleration[1:] + acceleration[:-1]), axis=0)
    np.testing.assert_allclose(where["body"][1][-1] - where["body"][1][0], impulse, atol=2e-6)


@pytest.mark.parametrize(
    ("freeplay_deg", "quadratic_nmprad2", "tolerance"), [(0.0, 0.0, 1e-10), (0.0, 3e4, 1e-10), (0.4, 0.0, 1e-9)]
)
def test_energy_and_momentum_of_the_free_undamped_system(generic_vehicle, freeplay_deg, quadratic_nmprad2, tolerance):
    # the freeplay's corner is smooth in slope, not in curvature, which costs the fourth-order steps their order there
    # 1e10 m away gravity's gradient is 1e-15 /s^2: motion about the c.g. is free
    vehicle = undamped(generic_vehicle)
    vehicle = with_joint(vehicle, freeplay_deg=freeplay_deg, quadratic_nmprad2=quadratic_nmprad2)
    states, aux = integrate(vehicle, simulate.vacuum_table(), free_state(vehicle), 5e-5, 10000, 201)
    energy = dynamics.internal_energy(states, vehicle)
    inside = energy[0]
    assert 5.0 < inside < 1000.0  # joules of rotation and springs, not of orbit
    assert aux[:, 5].max() > 1.05 * aux[:, 5].min()  # the joint works
    np.testing.assert_allclose(energy, inside, rtol=tolerance)
    spin = dynamics.angular_momentum(states, vehicle)
    np.testing.assert_allclose(spin, np.broadcast_to(spin[0], spin.shape), atol=1e-12 * np.linalg.norm(spin[0]))


def test_energy_near_the_earth_with_gravity_alive(generic_vehicle):
    vehicle = undamped(generic_vehicle)
    r = earth.ecef_from_geodetic(0.6, -1.2, 300e3)
    bent = rotations.exp(np.array([0.01, 0.05, 0.03]))
    state = state_from_ecef(0.0, r, np.array([500.0, -800, 300]), rotations.exp(np.array([0.3, -1.0, 0.5])),
                            np.array([0.6, 0.2, -0.3]), bent)  # fmt: skip
    states, _ = integrate(vehicle, simulate.vacuum_table(), state, 2.5e-4, 4000, 101)
    energy = dynamics.energy(states, vehicle)
    # 9e9 J in all: relative 1e-9 would be 9 J, more than the joint holds; rounding allows 1e-4 J
    np.testing.assert_allclose(energy, energy[0], atol=2e-4)
    # about the Earth's axis nothing pulls: J2 is symmetric
    where = dynamics.points(states, vehicle)
    axial = dynamics.angular_momentum(states, vehicle)[:, 2]
    axial = axial + vehicle.mass_kg * np.cross(states[:, :3], states[:, 3:6])[:, 2]
    np.testing.assert_allclose(axial, axial[0], rtol=1e-12)
    assert set(where) == {"body", "shell", "joint", "nose"}


def test_damping_only_takes_energy(generic_vehicle):
    state = free_state(generic_vehicle)
    states, _ = integrate(generic_vehicle, simulate.vacuum_table(), state, 5e-4, 200, 101)
    energy = dynamics.energy(states, generic_vehicle)
    assert (np.diff(energy) < 0.0).all()


def planar_release(vehicle, theta_rad):
    state = free_state(vehicle)
    state[6:10] = state[10:14] = [1.0, 0.0, 0.0, 0.0]
    state[10:14] = rotations.exp(np.array([0.0, theta_rad, 0.0]))
    state[14:20] = 0.0
    return state


@pytest.mark.parametrize("frequency_hz", [2.0, 2.5, 4.0])
def test_free_free_frequency_is_eq_7_and_ring_down_eq_8(vehicle, frequency_hz):
    # eq. [7]'s inertias are about the joint, so it holds for a joint that does not move sideways; a free joint
    # recoils. Hold the joint by making it the c.g. of both bodies, with the same inertias about it
    ia, icb = vehicle.transverse_inertia_about_joint()
    k = (2 * np.pi * frequency_hz) ** 2 * ia * icb / (ia + icb)
    critical = 2.0 * np.sqrt(k * ia * icb / (ia + icb))
    zeta = 0.02
    joint = vehicle.joint.model_copy(
        update={
            "bending_stiffness_nmprad": k,
            "bending_damping_nmsprad": zeta * critical,
            "torsion_damping_nmsprad": 0.0,
        }
    )

    def balanced(body, inertia):
        tensor = ((body.inertia[0, 0], 0.0, 0.0), (0.0, inertia, 0.0), (0.0, 0.0, inertia))
        return body.model_copy(update={"cg_from_datum_body_m": tuple(vehicle.joint_m), "inertia_kgm2": tensor})

    held = replace(
        vehicle, joint=joint, aeroshell=balanced(vehicle.aeroshell, ia), centerbody=balanced(vehicle.centerbody, icb)
    )
    assert held.free_free_frequency_hz() == pytest.approx(frequency_hz, rel=1e-12)
    states, _ = integrate(held, simulate.vacuum_table(), planar_release(held, 0.05), 5e-4, 4, 4001)
    _, nose = dynamics.deflection_angle(states[:, 6:10], states[:, 10:14])
    theta, t = np.arctan2(-nose[:, 2], nose[:, 0]), 2e-3 * np.arange(4001)
    up = np.flatnonzero((theta[:-1] < 0) & (theta[1:] >= 0))
    cross = t[up] - theta[up] * 2e-3 / (theta[up + 1] - theta[up])
    damped = np.polyfit(np.arange(len(cross)), cross, 1)[0]
    assert 1.0 / damped == pytest.approx(frequency_hz * np.sqrt(1 - zeta**2), rel=1e-5)
    peaks = np.flatnonzero((theta[1:-1] > theta[:-2]) & (theta[1:-1] > theta[2:])) + 1
    decrement = -np.polyfit(np.arange(len(peaks)), np.log(theta[peaks]), 1)[0]
    # (the logarithmic decrement of a 2 ms record: its peaks are sampled to 1e-4 of their height)
    assert decrement / np.hypot(2 * np.pi, decrement) == pytest.approx(zeta, rel=2e-3)


def test_free_joint_recoils_by_the_two_body_formula(vehicle):
    # with both c.g.s off the joint its reaction adds -(m r) terms: I_eff from the planar mass matrix
    plain = undamped(vehicle)
    (ma, mb), (ia, ib) = (plain.aeroshell.mass_kg, plain.centerbody.mass_kg), plain.transverse_inertia_about_joint()
    plain = replace(plain, centerbody=plain.centerbody.model_copy(update={"cg_from_datum_body_m": (-0.52, 0.0, 0.0)}))
    ra, rb, m = 0.38, 0.32, ma + mb
    mass = np.array(
        [[ia - (ma * ra) ** 2 / m, -ma * mb * ra * rb / m], [-ma * mb * ra * rb / m, ib - (mb * rb) ** 2 / m]]
    )
    k = plain.joint.bending_stiffness_nmprad * np.array([[1, -1], [-1, 1]])
    want = np.sqrt(np.max(np.linalg.eigvals(np.linalg.solve(mass, k)).real)) / (2 * np.pi)
    states, _ = integrate(plain, simulate.vacuum_table(), planar_release(plain, 0.002), 5e-4, 4, 2001)
    _, nose = dynamics.deflection_angle(states[:, 6:10], states[:, 10:14])
    theta = np.arctan2(-nose[:, 2], nose[:, 0])
    up = np.flatnonzero((theta[:-1] < 0) & (theta[1:] >= 0))
    cross = up - theta[up] / (theta[up + 1] - theta[up])
    got = 1.0 / (2e-3 * np.polyfit(np.arange(len(cross)), cross, 1)[0])
    assert got == pytest.approx(want, rel=1e-4)
    assert got > 1.02 * plain.free_free_frequency_hz()  # and it is not eq. [7]'s


def test_stiff_joint_converges_to_the_locked_rigid_body(vehicle):
    table, state = simulate.atmosphere_table(windy()), entry_state(vehicle, alpha_deg=6.0, spin_rpm=6.0)

    def stiffer(factor):
        k, c = 4335.0 * factor, 2.0 * 0.3 * np.sqrt(4335.0 * factor * 17.57)
        update = {"bending_stiffness_nmprad": k, "torsion_stiffness_nmprad": k}
        update |= {"bending_damping_nmsprad": c, "torsion_damping_nmsprad": c}
        return replace(vehicle, joint=vehicle.joint.model_copy(update=update))

    rigid, aux = integrate(vehicle, table, state, 2.5e-4, 400, 301, lock_records=301)
    assert aux[:, 5].max() < 1e-7  # the lock holds
    parted = []
    for factor in (250.0, 1000.0):
        hinged, _ = integrate(stiffer(factor), table, state, 2.5e-4, 400, 301)
        parted.append(rotations.boxminus(hinged[:, 6:10], rigid[:, 6:10]))
    moved = rotations.boxminus(rigid[:, 6:10], np.broadcast_to(rigid[0, 6:10], (301, 4)))
    # flexibility is a perturbation of first order in 1/K: four times stiffer, a quarter of the difference
    sizes = [np.sqrt(np.mean(p**2)) for p in parted]
    assert sizes[0] / sizes[1] == pytest.approx(4.0, rel=0.15)
    assert sizes[1] < 1e-3 * np.sqrt(np.mean(moved**2))


def test_locked_body_is_euler_s_rigid_body(generic_vehicle):
    # kinetic energy and momentum of the locked body, and its recorded joint force by Newton's law
    state = free_state(generic_vehicle)
    state[10:14] = state[6:10]
    state[17:20] = state[14:17]
    states, aux = integrate(generic_vehicle, simulate.vacuum_table(), state, 1e-3, 20, 501, lock_records=501)
    w, inertia = states[:, 14:17], generic_vehicle.inertia
    kinetic = 0.5 * np.einsum("ni,ij,nj->n", w, inertia, w)
    np.testing.assert_allclose(kinetic, kinetic[0], rtol=1e-10)
    spin = rotations.rotate(states[:, 6:10], w @ inertia.T)
    np.testing.assert_allclose(spin, np.broadcast_to(spin[0], spin.shape), atol=1e-9 * np.linalg.norm(spin[0]))
    where = dynamics.points(states, generic_vehicle)
    arm = rotations.rotate(
        states[:, 6:10], np.broadcast_to(generic_vehicle.centerbody.cg_m - generic_vehicle.cg_m, w.shape)
    )
    rate = rotations.rotate(states[:, 6:10], w)
    turn = rotations.rotate(states[:, 6:10], aux[:, 15:18])
    want = generic_vehicle.centerbody.mass_kg * (np.cross(turn, arm) + np.cross(rate, np.cross(rate, arm)))
    np.testing.assert_allclose(aux[:, 6:9], want, atol=1e-9)
    assert where["joint"][0].shape == (501, 3)


def test_integrator_is_of_fourth_order(generic_vehicle):
    state, table = entry_45_km(), simulate.atmosphere_table(windy())
    smooth = replace(generic_vehicle, joint=generic_vehicle.joint.model_copy(update={"freeplay_deg": 0.0}))
    ends = [integrate(smooth, table, state, 0.2 / n, n, 2)[0][-1] for n in (25, 50, 100, 800)]
    errors = [np.linalg.norm((e - ends[-1])[14:20]) for e in ends[:-1]]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.35)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4.0, abs=0.35)


def test_mirrored_flight_is_the_mirrored_path(vehicle):
    # mirror y -> -y of the vehicle about its own x-z plane: bending in the mirrored plane, same size
    plain = replace(
        vehicle,
        centerbody=vehicle.centerbody.model_copy(update={"cg_from_datum_body_m": (-0.52, 0.006, 0.002)}),
    )
    mirrored = replace(
        vehicle,
        centerbody=vehicle.centerbody.model_copy(update={"cg_from_datum_body_m": (-0.52, -0.006, 0.002)}),
    )
    r = np.array([0.0, 0.0, 6378137.0 + 60e3])  # above the pole, moving down the axis: the setting has no side
    still = AtmosphereProfile(np.array([0.0, 1e5]), np.zeros(2), np.zeros(2), np.zeros((2, 3)), np.ones(2), np.ones(2))
    table = simulate.atmosphere_table(still)
    down = rotations.q_from_dcm(np.array([[[0.0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]]]))[0]
    ends = []
    for body in (plain, mirrored):
        state = np.concatenate([r, [0.0, 0.0, -1500.0], down, down, np.zeros(6)])
        states, _ = integrate(body, table, state, 1e-3, 10, 1001)
        ends.append(dynamics.deflection_angle(states[:, 6:10], states[:, 10:14])[1])
    # the Earth turns under the flight (0.5 m/s of side wind here breaks the symmetry by 5e-4 of the angle)
    assert np.abs(ends[0][:, 1]).max() > 0.002
    np.testing.assert_allclose(ends[1][:, 1], -ends[0][:, 1], atol=2e-5)
    np.testing.assert_allclose(ends[1][:, 2], ends[0][:, 2], atol=2e-5)


def test_freeplay_corner_is_smooth_and_exact_outside():
    freeplay, corner = 0.01, 0.1
    theta = np.linspace(0.0, 0.03, 30001)
    d = np.array([dynamics.beyond_freeplay(x, *simulate.freeplay_corner(freeplay, corner)) for x in theta])
    np.testing.assert_allclose(d, dynamics.angle_beyond_freeplay(theta, freeplay, corner), atol=1e-17)
    assert (d[theta <= 0.009] == 0.0).all()
    np.testing.assert_allclose(d[theta >= 0.011], theta[theta >= 0.011] - freeplay, atol=1e-15)
    slope = np.diff(d) / np.diff(theta)
    assert np.abs(np.diff(slope)).max() < 1.1e-6 / 0.002  # no jump: at most the corner's own curvature per step
    assert slope.max() <= 1.0 + 1e-9
