"""An entry on Earth by its state and one published deceleration: FIRE II, NASA TN D-3569, table V (not shipped)."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import postflight as pf
from flightmodel import earth

TABLE = Path(os.environ.get("POSTFLIGHT_REALDATA", "")) / "entry_flights" / "fire2_trajectory_tableV.csv"
FLIGHT = """
name = "FIRE II"
t0_utc = "1965-05-22T21:54:59Z"

[start.state]
t_s = 1618.25
t_sd_s = 0.01
axes = "fixed"
altitude_m = 120477.84
latitude_deg = -7.3966393
longitude_deg = -16.905391
speed_mps = 11351.531
flight_path_deg = -14.708113
azimuth_deg = 122.8611
altitude_sd_m = 30.0
latitude_sd_deg = 0.0005
longitude_sd_deg = 0.0005
speed_sd_mps = 3.0
flight_path_sd_deg = 0.01
azimuth_sd_deg = 0.01

[drag]
c_a = 1.5009
c_a_sd_percent = 1.0
diameter_m = 0.672
mass_kg = 86.568

[motion]
model = "ballistic"
trim_sd_deg = 0.5

[sensors.accelerometer]
file = "table_v.csv"
measures = ["ax"]
axes = ["+x", "+y", "+z"]
columns = { ax = { column = "accel_g", unit = "g" } }
noise_sd_mps2 = 0.01
bias_sd_mps2 = 0.002
scale_sd = 0.001
time_bias_sd_s = 0.0
"""


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.skipif(not TABLE.is_file(), reason="POSTFLIGHT_REALDATA names no folder with the published table")
def test_the_published_deceleration_gives_the_published_speed_height_and_density(tmp_path):
    """At 0.5 to 3 s between rows, through the day's sounded air of which nothing is stated: the standard stands for it.

    The peak of 74 g takes 7 km/s; density follows within 1 % where the deceleration is known best.
    """
    table = pd.read_csv(TABLE)
    table[["t_s", "accel_g"]].dropna().to_csv(tmp_path / "table_v.csv", index=False)
    (tmp_path / "flight.toml").write_text(FLIGHT)
    bet = pf.reconstruct(pf.read_flight(tmp_path))
    assert not [check.code for check in bet.consistency_checks if not check.passed]
    path = bet.trajectory
    there = table.dropna(subset=["alt_m", "v_rel_mps"])
    there = there[there.t_s > 1620.0]
    speed = np.linalg.norm(path.velocity_ecef_mps, axis=1)
    along = path.velocity_ecef_mps / speed[:, None]
    speed_sd = np.sqrt(np.einsum("ni,nij,nj->n", along, path.covariance[:, 3:6, 3:6], along))
    latitude, longitude, height = earth.geodetic_from_ecef(path.position_ecef_m)
    down = earth.dcm_ned_ecef(latitude, longitude)[:, 2]
    height_sd = np.sqrt(np.einsum("ni,nij,nj->n", down, path.covariance[:, :3, :3], down))
    for true, found, sd in ((there.v_rel_mps, speed, speed_sd), (there.alt_m, height, height_sd)):
        off = (np.interp(there.t_s, path.time_s, found) - true) / np.interp(there.t_s, path.time_s, sd)
        assert np.abs(off).max() < 3.0
    air, density = table.dropna(subset=["q_pa", "v_rel_mps"]), bet.density
    air = air[(air.t_s > density.time_s.min()) & (air.t_s < density.time_s.max())]
    flown = np.interp(air.t_s, density.time_s, np.log(density.density_kgpm3))
    ratio = flown - np.log(2.0 * air.q_pa / air.v_rel_mps**2)
    part = np.interp(air.t_s, density.time_s, density.density_sd_kgpm3 / density.density_kgpm3)
    assert np.abs(ratio / part).max() < 3.0
    assert np.abs(ratio[part < 0.03]).max() < 0.03
    assert (part < 0.03).sum() > 5
