"""Motions known in closed form: pendulum, free double pendulum, heavy symmetric top; and turned copies of a flight.

Authority: classical mechanics (Goldstein, ch. 5 for the top), worked out here without the package's equations. The
ground is a second body of 1e9 kg, so everything about it holds to 1e-9.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from flightmodel import rotations
from flightmodel.vehicle import MassProperties
from synthetic_flight import dynamics, simulate
from synthetic_flight.simulate import integrate
from tests.oracles import two_body

from .conftest import bent_entry_state, free_state, undamped, with_joint
from .plain_loads import SmoothAir
from .rigid import on_the_ground

G = 9.80665
UP = rotations.exp(np.array([0.0, -0.5 * np.pi, 0.0]))  # takes x to +z of the inertial frame
DOWN = rotations.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


def exactly(body, loads, state, time_s, event=None):
    return solve_ivp(
        lambda _, y: two_body.rates(y, body, loads),
        (0.0, time_s[-1]),
        state,
        method="DOP853",
        t_eval=time_s,
        events=event,
        rtol=1e-11,
        atol=1e-12,
    )


def swing(body, q_ground, q_body, rate, time_s, event=None):
    loads = two_body.Loads(np.zeros(3), np.array([0.0, 0.0, -G * body.aeroshell.mass_kg]), np.zeros(3))
    state = np.concatenate([np.zeros(6), q_ground, q_body, np.zeros(3), rate])
    offset, velocity = dynamics.offsets(state, body)["joint"]
    state[0:3], state[3:6] = -offset, -velocity
    return exactly(body, loads, state, time_s, event)


@pytest.mark.parametrize("amplitude_deg", [5.0, 60.0, 120.0])
def test_period_of_the_physical_pendulum(vehicle, measured, amplitude_deg):
    # T = 4 sqrt(I / m g l) K(sin(a/2)); c.g. off the axis, so that the arm is not a body axis; planar about body y
    mass, cg, amplitude = 3.0, np.array([0.7, 0.0, 0.2]), np.deg2rad(amplitude_deg)
    body = on_the_ground(vehicle, mass, cg, np.diag([0.3, 0.5, 0.4]))
    arm = np.linalg.norm(cg)
    tilt = np.arctan2(cg[2], cg[0])
    # turning by +angle about y takes x towards -z: hanging is DOWN turned by the arm's own angle
    start = rotations.boxplus(DOWN, np.array([0.0, tilt + amplitude, 0.0]))
    want = 4.0 * np.sqrt((0.5 + mass * arm**2) / (mass * G * arm)) * ellipk(np.sin(0.5 * amplitude) ** 2)

    def turning(_, y):
        return y[18]

    run = swing(body, DOWN, start, np.zeros(3), np.array([0.0, 2.2 * want]), turning)
    times = run.t_events[0]
    times = times[times > 0.1 * want]  # at rest at the start
    assert len(times) == 4
    # the ground recoils by 1e-9
    measured(f"pendulum of {amplitude_deg:.0f} deg: period, relative", abs((times[3] - times[1]) / want - 1.0), 1e-8)


@pytest.mark.parametrize("stiffness", [0.0, 60.0])
def test_free_double_pendulum(vehicle, measured, stiffness):
    # two bodies tumbling about each other in space, in one plane: with s1, s2 the c.g.s from the joint, mu the reduced
    # mass, d = theta2 - theta1 of the arms, c = mu s1 s2:
    #   (I1 + mu s1^2) th1'' - c cos d th2'' + c sin d th2'^2 = -dV/dth1, and 1 <-> 2 with the other sign of d
    light = MassProperties(
        mass_kg=3.0, cg_from_datum_body_m=(-0.9, 0.0, 0.15), inertia_kgm2=((0.5, 0, 0), (0, 0.8, 0), (0, 0, 0.7))
    )
    heavy = MassProperties(
        mass_kg=7.0, cg_from_datum_body_m=(0.3, 0.0, -0.1), inertia_kgm2=((1.1, 0, 0), (0, 1.4, 0), (0, 0, 0.9))
    )
    one = with_joint(
        replace(undamped(vehicle), centerbody=heavy, aeroshell=light),
        bending_stiffness_nmprad=stiffness,
        torsion_stiffness_nmprad=0.0,
    )
    arms = [part.cg_m - one.joint_m for part in (heavy, light)]
    sizes = [np.linalg.norm(a) for a in arms]
    # an angle is positive about y, which takes x to -z
    phases = [np.arctan2(-a[2], a[0]) for a in arms]
    mu = heavy.mass_kg * light.mass_kg / one.mass_kg
    c = mu * sizes[0] * sizes[1]
    a1, a2 = heavy.inertia[1, 1] + mu * sizes[0] ** 2, light.inertia[1, 1] + mu * sizes[1] ** 2

    def derivative(_, y):
        t1, t2, w1, w2 = y
        d = t2 + phases[1] - t1 - phases[0]
        spring = stiffness * (t2 - t1)
        right = np.array([spring - c * np.sin(d) * w2**2, -spring + c * np.sin(d) * w1**2])
        return np.concatenate([[w1, w2], np.linalg.solve([[a1, -c * np.cos(d)], [-c * np.cos(d), a2]], right)])

    time = 0.05 * np.arange(101)
    # without a spring the arms tumble over each other; with it they swing to and fro
    first = np.array([0.0, 0.4, -1.0, 4.0 if stiffness == 0.0 else 2.0])
    want = solve_ivp(derivative, (0.0, time[-1]), first, method="DOP853", t_eval=time, rtol=1e-12, atol=1e-13).y
    state = free_state(one)
    state[6:10], state[10:14] = (rotations.exp(np.array([0.0, angle, 0.0])) for angle in first[:2])
    state[14:20] = [0.0, first[2], 0.0, 0.0, first[3], 0.0]
    if stiffness:
        states, _ = integrate(one, simulate.vacuum_table(), state, 1e-4, 500, len(time))
        assert len(states) == len(time)
    else:
        # a kernel's flight ends where the joint passes 90 deg; the readable equations go on
        none = two_body.Loads(np.zeros(3), np.zeros(3), np.zeros(3))
        states = exactly(one, none, state, time).y.T
    # both angles about y, unwrapped
    got = [2.0 * np.unwrap(np.arctan2(q[:, 2], q[:, 0]), period=np.pi) for q in (states[:, 6:10], states[:, 10:14])]
    name = f"free double pendulum, K {stiffness:.0f}: "
    bent = np.abs(want[1] - want[0]).max()
    assert bent > (4.0 if stiffness == 0.0 else 0.45)
    # both integrated to 1e-11; tumbling doubles a difference every second or so
    measured(name + "angles", np.abs(np.array(got) - want[:2]).max(), 1e-8, "rad")
    energy = dynamics.internal_energy(states, one)
    measured(name + "energy, relative", np.abs(energy / energy[0] - 1.0).max(), 1e-10)


TOP_ARM_M, TOP_MASS_KG, TOP_SPIN_INERTIA, TOP_SIDE_INERTIA = 0.4, 2.0, 0.9, 0.5
LEAN, SPIN_RADPS = np.deg2rad(35.0), 8.0


def top(vehicle):
    inertia = np.diag([TOP_SPIN_INERTIA, TOP_SIDE_INERTIA, TOP_SIDE_INERTIA])
    return on_the_ground(vehicle, TOP_MASS_KG, (TOP_ARM_M, 0.0, 0.0), inertia)


def steady_precession():
    """Slow and fast root of ``A W^2 cos t - C s W + m g l = 0``; s is the spin about the axis, inertial."""
    a = TOP_SIDE_INERTIA + TOP_MASS_KG * TOP_ARM_M**2
    roots = np.roots([a * np.cos(LEAN), -TOP_SPIN_INERTIA * SPIN_RADPS, TOP_MASS_KG * G * TOP_ARM_M])
    assert np.isreal(roots).all()
    return a, np.sort(roots.real)


def leaning(precession, nutation=0.0):
    """Attitude of the top, leaning off +z, and its rates in its own axes."""
    q = rotations.boxplus(UP, np.array([0.0, -LEAN, 0.0]))
    rate = precession * rotations.rotate(rotations.conjugate(q), np.array([0.0, 0.0, 1.0]))
    rate[0] = SPIN_RADPS
    rate[1] -= nutation
    return q, rate


@pytest.mark.parametrize("root", [0, 1])
def test_steady_precession_of_the_heavy_top(vehicle, measured, root):
    _, roots = steady_precession()
    precession = roots[root]
    q, rate = leaning(precession)
    time = np.linspace(0.0, 3.0, 31)
    run = swing(top(vehicle), UP, q, rate, time)
    axis = rotations.rotate(run.y[10:14].T, np.tile([1.0, 0.0, 0.0], (len(time), 1)))
    name = f"top, {('slow', 'fast')[root]} precession {precession:.4f} rad/s: "
    lean = np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), axis[:, 2])
    # the ground's recoil, 1e-9
    measured(name + "lean stays", np.abs(lean - LEAN).max(), 1e-8, "rad")
    azimuth = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    turned = (azimuth - azimuth[0]) / precession
    measured(name + "rate, relative", np.abs(turned[1:] / time[1:] - 1.0).max(), 1e-7)


def test_nutation_of_the_heavy_top(vehicle, measured):
    # small nutation about steady precession: n^2 = (C s / A - 2 W cos t)^2 + (W sin t)^2
    a, roots = steady_precession()
    want = np.hypot(TOP_SPIN_INERTIA * SPIN_RADPS / a - 2.0 * roots[0] * np.cos(LEAN), roots[0] * np.sin(LEAN))
    q, rate = leaning(roots[0], nutation=1e-3)

    def leaning_rate(_, y):
        # of the axis away from the vertical: d/dt of up . x = up . (w x x)
        up = rotations.rotate(rotations.conjugate(y[10:14]), np.array([0.0, 0.0, 1.0]))
        return up[1] * y[19] - up[2] * y[18]

    run = swing(top(vehicle), UP, q, rate, np.array([0.0, 5.0]), leaning_rate)
    times = run.t_events[0]
    assert len(times) > 8
    got = np.pi / np.polyfit(np.arange(len(times)), times, 1)[0]
    # a nutation of 1e-4 rad makes a difference of its square
    measured(f"top: nutation at {want:.3f} rad/s, relative", abs(got / want - 1.0), 1e-6)


@pytest.mark.parametrize("angle_deg", [90.0, 180.0, 37.0])
def test_turned_axes_fly_the_same_path(generic_vehicle, measured, angle_deg):
    # name y and z of both bodies anew (y -> z, z -> -y, and other turns about x): c.g.s, inertias, attitudes and rates
    # turn, the path does not
    one = with_joint(generic_vehicle, freeplay_corner=0.5)
    turn = rotations.exp(np.array([np.deg2rad(angle_deg), 0.0, 0.0]))  # new axes from old
    dcm = rotations.dcm_from_q(turn)

    def renamed(part):
        tensor = dcm @ part.inertia @ dcm.T
        tensor = 0.5 * (tensor + tensor.T)
        update = {"inertia_kgm2": tuple(map(tuple, tensor)), "cg_from_datum_body_m": tuple(dcm @ part.cg_m)}
        return part.model_copy(update=update)

    other = replace(one, aeroshell=renamed(one.aeroshell), centerbody=renamed(one.centerbody))
    state = bent_entry_state([0.004, 0.03, 0.02], [0.03, 0.1, -0.06], 58e3)
    back = rotations.conjugate(turn)
    copy = state.copy()
    copy[6:10], copy[10:14] = rotations.multiply(state[6:10], back), rotations.multiply(state[10:14], back)
    copy[14:17], copy[17:20] = dcm @ state[14:17], dcm @ state[17:20]
    table = simulate.atmosphere_table(SmoothAir())
    states, aux = integrate(one, table, state, 1e-3, 100, 101)
    turned, _ = integrate(other, table, copy, 1e-3, 100, 101)
    assert aux[:, 3].max() > 500.0
    again = [rotations.multiply(turned[:, i : i + 4], np.broadcast_to(turn, (101, 4))) for i in (6, 10)]
    apart = [
        np.linalg.norm(rotations.boxminus(q, states[:, i : i + 4]), axis=1).max()
        for q, i in zip(again, (6, 10), strict=True)
    ]
    # rounding, grown by a joint near divergence over 10 s
    measured(f"axes turned by {angle_deg:.0f} deg: attitudes after 10 s", max(apart), 1e-9, "rad")
    rates = np.abs(turned[:, 14:17] @ dcm - states[:, 14:17]).max()
    measured(f"axes turned by {angle_deg:.0f} deg: rates", rates, 1e-8, "rad/s")
    # coordinates of 6e6 m: 1e-9 m each step
    measured(f"axes turned by {angle_deg:.0f} deg: position", np.abs(turned[:, :3] - states[:, :3]).max(), 1e-7, "m")
