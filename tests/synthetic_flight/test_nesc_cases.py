"""The flight kernel flies NASA's 6-DOF check cases 1, 2, 4, 6, 7 and 9 as NASA's own simulators do.

Authority: NASA/TM-2015-218675, simulators 01, 04 and 05 (30 s each). A rigid body is a vehicle with a locked joint.
Proved: gravitation (J2 and inverse square), the ellipsoidal and the round Earth, its rotation, drag, wind, the
rotational equations of motion. The data carry 12 digits: 1e-5 m of ECI position, 1e-8 m of altitude.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flightmodel import earth, rotations
from flightmodel.atmosphere import AtmosphereProfile
from synthetic_flight import simulate
from synthetic_flight.simulate import integrate

from .rigid import rigid_vehicle

DATA = Path(__file__).parents[1] / "data" / "nesc"
DEFINITION = json.loads((DATA / "cases.json").read_text())
CONSTANTS = DEFINITION["constants"]
CASES = {c["case"]: c for c in DEFINITION["cases"]}
TIME_S = np.arange(31.0)
AXES = "XYZ"
# the simulators of case 4 start 6 380 151.1809 m from the centre: the authalic radius, and 0.204 m less than the
# definition's feet make
ROUND_EARTH_M = 6371007.1809
EULER = [f"euler_deg_{a}" for a in ("Yaw", "Pitch", "Roll")]
RATES = [f"omega_eci_body_degps_{a}" for a in ("Roll", "Pitch", "Yaw")]


def flown_by_nasa(case, simulator):
    frame = pd.read_csv(DATA / "check_cases_1hz.csv")
    rows = frame[(frame.case == case) & (frame.sim == simulator)]
    assert np.array_equal(rows.t_s, TIME_S)
    return rows


def q_ned_body_from_euler(yaw, pitch, roll):
    """3-2-1 angles, rad, to quaternions ``(..., 4)``."""
    parts = [rotations.exp(np.multiply.outer(a, e)) for a, e in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)]
    return rotations.multiply(rotations.multiply(parts[0], parts[1]), parts[2])


def q_ecef_ned(latitude, longitude):
    return rotations.q_from_dcm(np.swapaxes(earth.dcm_ned_ecef(latitude, longitude), -1, -2))


# case 4: round and at rest, with NASA's constant
ROUND_EARTH = earth.WGS84._replace(
    gm_m3ps2=CONSTANTS["GM_m3ps2"], j2=0.0, semi_major_m=ROUND_EARTH_M, flattening=0.0, rate_radps=0.0
)


def fly(case, vehicle, step_s=0.005, planet=earth.WGS84, drag=1.0):
    """Altitude, ECI and ECEF positions, NED velocity, q_ned_body and rates (deg/s) each second, as NASA tabulates."""
    setting, start = CASES[case], CASES[case]["initial"]
    round_earth = case == 4
    planet = ROUND_EARTH if round_earth else planet
    rate = planet.rate_radps
    body = rigid_vehicle(
        vehicle,
        setting["mass_kg"],
        np.diag(setting["inertia_kgm2"]),
        setting["S_m2"],
        drag * setting["CD"],
        apart_m=(1e-3, 2e-3, -1e-3) if setting["body"] == "sphere" else (3e-4, 1e-4, -2e-4),
    )
    wind = np.array([0.0, setting["wind"].get("v_east_mps", 0.0), 0.0])
    knots = np.array([-1000.0, 12000.0])
    air = AtmosphereProfile(knots, np.zeros(2), np.zeros(2), np.tile(wind, (2, 1)), np.ones(2), np.ones(2), fade_m=1e12)
    height = start["alt_m"]
    r = np.array([ROUND_EARTH_M + height, 0.0, 0.0])
    if not round_earth:
        r = earth.ecef_from_geodetic(np.deg2rad(start["lat_deg"]), np.deg2rad(start["lon_deg"]), height)
    # every case starts above latitude and longitude zero, ECI equal to ECEF
    to_ned = earth.dcm_ned_ecef(0.0, 0.0)
    v = to_ned.T @ np.array(start["v_ned_mps"]) + np.cross([0.0, 0.0, rate], r)
    attitude = q_ned_body_from_euler(*np.deg2rad([start["yaw_deg"], start["pitch_deg"], start["roll_deg"]]))
    q = rotations.multiply(q_ecef_ned(0.0, 0.0), attitude)
    w = np.deg2rad(start["omega_eci_body_degps"])
    state = np.concatenate([r, v, q, q, w, w])
    states, _ = integrate(
        body,
        simulate.atmosphere_table(air),
        state,
        step_s,
        round(1.0 / step_s),
        31,
        lock_records=31,
        planet=planet,
    )
    r, v = states[:, 0:3], states[:, 3:6]
    half = -0.5 * rate * TIME_S
    to_ecef = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    r_ecef = rotations.rotate(to_ecef, r)
    v_ecef = rotations.rotate(to_ecef, v) - np.cross([0.0, 0.0, rate], r_ecef)
    if round_earth:
        distance = np.linalg.norm(r_ecef, axis=-1)
        lat, lon = np.arcsin(r_ecef[:, 2] / distance), np.arctan2(r_ecef[:, 1], r_ecef[:, 0])
        altitude = distance - ROUND_EARTH_M
    else:
        lat, lon, altitude = earth.geodetic_from_ecef(r_ecef)
    from_ned = q_ecef_ned(lat, lon)
    q_ned_body = rotations.multiply(rotations.conjugate(from_ned), rotations.multiply(to_ecef, states[:, 6:10]))
    return {
        "altitude": altitude,
        "eci": r,
        "ecef": r_ecef,
        "v_ned": rotations.rotate(rotations.conjugate(from_ned), v_ecef),
        "q_ned_body": q_ned_body,
        "rates": np.rad2deg(states[:, 14:17]),
    }


def apart(a, b):
    return np.linalg.norm(np.asarray(a) - np.asarray(b), axis=-1).max()


@pytest.mark.parametrize("simulator", [4, 5])
@pytest.mark.parametrize("case", [1, 2, 4, 6, 7, 9])
def test_altitude_position_and_velocity(vehicle, measured, case, simulator):
    ours, nasa = fly(case, vehicle), flown_by_nasa(case, simulator)
    name = f"case {case}, simulator 0{simulator}: "
    if CASES[case]["CD"] == 0.0:
        # one gravity field, one integral: what is left is the digits of NASA's files
        altitude, position, velocity = 1e-6, 5e-5, 1e-8
    else:
        # NASA's own best simulators (04, 05, 06) part by 3 mm (case 9, at 431 m/s at sea level: 0.1 m). What is left is
        # the standard atmosphere's last digits: ours lies 0.7e-6 below 04's density and 3.4e-6 below 05's, and 1e-6 of
        # density makes 1.2 mm of altitude and 2.0 mm of path in case 9
        altitude = position = 0.010 if case == 9 else 0.005
        velocity = 1e-3
    measured(name + "altitude", np.abs(ours["altitude"] - nasa.alt_m).max(), altitude, "m")
    measured(name + "ECI position", apart(ours["eci"], nasa[[f"r_eci_m_{a}" for a in AXES]]), position, "m")
    if simulator == 5:
        ecef = nasa[[f"r_ecef_m_{a}" for a in AXES]]
        measured(name + "ECEF position", apart(ours["ecef"], ecef), position, "m")
    measured(name + "NED velocity", apart(ours["v_ned"], nasa[[f"v_ned_mps_{a}" for a in AXES]]), velocity, "m/s")


@pytest.mark.parametrize("simulator", [1, 4])
def test_attitude_of_the_tumbling_brick(vehicle, measured, simulator):
    ours, nasa = fly(2, vehicle), flown_by_nasa(2, simulator)
    theirs = q_ned_body_from_euler(*np.deg2rad(nasa[EULER].to_numpy()).T)
    angle = np.rad2deg(np.linalg.norm(rotations.boxminus(ours["q_ned_body"], theirs), axis=-1))
    # simulators 05 and 06 part from these two by 0.01 deg and 0.005 deg/s; 01 and 04 agree to their 12 digits, and so
    # must we: 0.001 deg is what their report calls agreement, 1e-6 deg what equal equations must give
    measured(f"case 2, simulator 0{simulator}: attitude", angle.max(), 1e-6, "deg")
    measured(f"case 2, simulator 0{simulator}: rates", apart(ours["rates"], nasa[RATES]), 1e-6, "deg/s")


@pytest.mark.parametrize("case", [1, 4, 6, 7, 9])
def test_sphere_keeps_its_inertial_attitude(vehicle, measured, case):
    # no moment on a sphere: it turns against NED as the Earth does and as NED turns along the path (1e-5 deg for 1 m)
    ours, nasa = fly(case, vehicle), flown_by_nasa(case, 5)
    theirs = q_ned_body_from_euler(*np.deg2rad(nasa[EULER].to_numpy()).T)
    angle = np.rad2deg(np.linalg.norm(rotations.boxminus(ours["q_ned_body"], theirs), axis=-1))
    measured(f"case {case}, simulator 05: attitude", angle.max(), 1e-5, "deg")


def test_steps_are_small_enough(vehicle, measured):
    measured(
        "case 9: step of 5 ms against 1 ms", apart(fly(9, vehicle)["eci"], fly(9, vehicle, 1e-3)["eci"]), 1e-5, "m"
    )


@pytest.mark.parametrize(
    ("case", "fault"),
    [
        (1, {"planet": earth.WGS84._replace(j2=earth.J2 * 1.0001)}),
        (1, {"planet": earth.WGS84._replace(rate_radps=earth.OMEGA_RADPS * 1.0001)}),
        (9, {"drag": 1.0001}),
    ],
    ids=["J2", "Earth rate", "drag"],
)
def test_one_part_in_ten_thousand_is_seen(vehicle, case, fault):
    # the limits above have teeth: each fault moves altitude or path beyond them
    off = np.abs(fly(case, vehicle, **fault)["eci"] - fly(case, vehicle)["eci"]).max()
    assert off > (0.010 if case == 9 else 5e-5)
