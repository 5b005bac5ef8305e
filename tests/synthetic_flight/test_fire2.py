"""The flight kernel repeats NASA's own trajectory of Project FIRE II, from 120 km to 22 km through 74 g.

Authority: NASA TN D-3569 table V (1966): a three-degree-of-freedom simulation through the sounded atmosphere,
11.35 km/s relative to the Earth. Proved: an entry as a whole, i.e. density over altitude, drag, J2 gravity, rotating
ellipsoid, over a hundredfold of dynamic pressure. The table's numbers were copied from a scan; empty means unreadable.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import PchipInterpolator

from flightmodel import earth, rotations
from flightmodel.atmosphere import AtmosphereProfile, us76
from synthetic_flight import simulate
from synthetic_flight.simulate import integrate, state_from_ecef

from .rigid import rigid_vehicle

TABLE = Path(__file__).parents[1] / "data" / "fire2" / "trajectory_table_v.csv"
START_S, STOP_S, RECORD_S = 1618.25, 1687.75, 0.25
MASS_KG, AREA_M2, DRAG_AREA_PER_MASS = 86.568, 0.354657, 6.1493e-3
INERTIA = np.diag([3.511, 2.806, 2.874])


def sounded(table):
    """Density of the table, 2 q / V^2 where it cannot be read; its logarithm by monotone cubics between the rows.

    Three rows cannot be read between 1656.25 and 1658.25 s, 31.7 to 30.4 km, where the sounding is irregular (its local
    scale height falls from 6.3 to 4.6 km) and the vehicle loses 365 m/s a second. A logarithm linear across that gap
    makes 8.3 m/s of speed at 1658.25 s, cubics 5.9 m/s; everywhere before it the two are within 1.8 m/s of the table.
    """
    density = table.rho_kgm3.fillna(2.0 * table.q_pa / table.v_rel_mps**2)
    known = (density.notna() & table.alt_m.notna()).to_numpy()
    altitude, log_density = table.alt_m[known].to_numpy()[::-1], np.log(density[known].to_numpy())[::-1]
    z = np.arange(20e3, 121.9e3, 50.0)
    n = len(z)
    held = np.clip(z, altitude[0], altitude[-1])
    ratio = PchipInterpolator(altitude, log_density)(held) - np.log(us76(z)[0])
    return AtmosphereProfile(z, ratio, np.zeros(n), np.zeros((n, 3)), np.ones(n), np.ones(n))


@pytest.fixture(scope="module")
def table():
    return pd.read_csv(TABLE)


@pytest.fixture(scope="module")
def flight(vehicle, table):
    """Ours at the table's times."""
    drag = DRAG_AREA_PER_MASS * MASS_KG / AREA_M2
    body = rigid_vehicle(vehicle, MASS_KG, INERTIA, AREA_M2, drag, apart_m=(0.02, 0.01, -0.01))
    start = table[table.t_s == START_S].iloc[0]
    r = earth.ecef_from_geodetic(np.deg2rad(start.lat_deg), np.deg2rad(start.lon_deg), start.alt_m)
    path, heading = np.deg2rad([start.fpa_deg, start.heading_deg])
    v_ned = start.v_rel_mps * np.array([np.cos(path) * np.cos(heading), np.cos(path) * np.sin(heading), -np.sin(path)])
    v = earth.ecef_from_ned(v_ned, r)
    x = v / np.linalg.norm(v)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    q = rotations.q_from_dcm(np.column_stack([x, y, np.cross(x, y)])[None])[0]
    state = state_from_ecef(0.0, r, v, q, np.array([17.907, 0.0, 0.0]))
    n = round((STOP_S - START_S) / RECORD_S) + 1
    states, aux = integrate(body, simulate.atmosphere_table(sounded(table)), state, 0.005, 50, n, lock_records=n)
    to_ecef = earth.q_ecef_eci(RECORD_S * np.arange(n))
    r = rotations.rotate(to_ecef, states[:, :3])
    v = rotations.rotate(to_ecef, states[:, 3:6]) - np.cross(earth.OMEGA_ECEF_RADPS, r)
    lat, lon, height = earth.geodetic_from_ecef(r)
    ned = earth.ned_from_ecef(v, r)
    at = np.round((table.t_s.to_numpy() - START_S) / RECORD_S).astype(int)
    fields = {
        "altitude": height,
        "speed": np.linalg.norm(ned, axis=1),
        "path": np.rad2deg(np.arcsin(-ned[:, 2] / np.linalg.norm(ned, axis=1))),
        "heading": np.rad2deg(np.arctan2(ned[:, 1], ned[:, 0])),
        "latitude": np.rad2deg(lat),
        "longitude": np.rad2deg(lon),
        "deceleration": np.linalg.norm(aux[:, 12:15], axis=1) / MASS_KG / earth.STANDARD_GRAVITY_MPS2,
        "pressure": aux[:, 3],
    }
    inside = (at >= 0) & (at < n)
    return inside, {name: value[np.where(inside, at, 0)] for name, value in fields.items()}


def test_speed_before_the_unreadable_rows(flight, table, measured):
    inside, ours = flight
    theirs = table.v_rel_mps.to_numpy()
    use = inside & np.isfinite(theirs) & (table.t_s.to_numpy() < 1657.0)
    # a third of 5.9 m/s; 3.1 of the 11.4 km/s are left here
    measured("speed before the unreadable rows", np.abs(ours["speed"] - theirs)[use].max(), 2.0, "m/s")


@pytest.mark.parametrize(
    ("quantity", "column", "limit", "unit"),
    [
        # density between the readable rows (300 to 2900 m apart) is a guess, worth the difference of two interpolations
        # (7 against 5 m, 8 against 6 m/s, 0.006 against 0.004 deg); a drag 0.1 % off moves the last altitude by 20 m
        ("altitude", "alt_m", 10.0, "m"),
        ("speed", "v_rel_mps", 6.0, "m/s"),
        ("path", "fpa_deg", 0.005, "deg"),
        # 0.001 deg is 110 m on the ground after 800 km of flight
        ("heading", "heading_deg", 0.005, "deg"),
        ("latitude", "lat_deg", 0.001, "deg"),
        ("longitude", "lon_deg", 0.001, "deg"),
    ],
)
def test_trajectory(flight, table, measured, quantity, column, limit, unit):
    inside, ours = flight
    theirs = table[column].to_numpy()
    use = inside & np.isfinite(theirs)
    assert use.sum() > 45
    measured(quantity, np.abs(ours[quantity] - theirs)[use].max(), limit, unit)


def test_peak_deceleration(flight, table, measured):
    inside, ours = flight
    theirs = -table.accel_g.to_numpy()
    use = inside & np.isfinite(theirs)
    peak = int(np.nanargmax(theirs))
    assert theirs[peak] == pytest.approx(74.3, abs=0.05)
    # where the table's density is used as printed: 1e-3, i.e. 38 m of altitude or 3.4 m/s of 6728
    measured("peak deceleration", abs(ours["deceleration"][use].max() / theirs[peak] - 1.0), 1e-3)
    assert int(np.argmax(np.where(use, ours["deceleration"], 0.0))) == peak
