"""A servo's lag: its size by hand, in the filter's answer, and by name where nobody stated it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from flightmodel import earth
from flightmodel.checks import ConfigError
from flightmodel.config import parse_section
from flightmodel.instruments import RadarEntry
from recon.estimate import estimate
from recon.measurements import RADAR, Instrument, servo_lag
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.state import States

QUICK = Settings(output_rate_hz=5.0)
HZ = 0.3
RANGE_M, DOWN_M = 50e3, -20e3


def circling(azimuth, time_s):
    """States of a target on a level circle about a site at the origin, its azimuth given over time."""
    az = azimuth(time_s)
    rate = (azimuth(time_s + 1e-4) - azimuth(time_s - 1e-4)) / 2e-4
    n = len(time_s)
    place = np.column_stack([RANGE_M * np.cos(az), RANGE_M * np.sin(az), np.full(n, DOWN_M)])
    speed = np.column_stack([-RANGE_M * np.sin(az) * rate, RANGE_M * np.cos(az) * rate, np.zeros(n)])
    return States(place, speed, np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), np.zeros((n, 0)))


def radar(hz):
    nothing = (np.zeros(1), *(np.zeros((1, 3)),) * 3)
    return Instrument(
        "i", RADAR, "i", np.zeros(3), np.zeros(3), np.eye(3), *nothing, np.zeros(1, dtype=int), np.zeros(1), servo_hz=hz
    )


def test_behind_a_steady_angular_acceleration_it_is_that_over_the_bandwidth_squared():
    t = np.arange(0.0, 60.0, 0.1)
    lag = servo_lag(radar(HZ), t, circling(lambda s: 0.5 * 2e-4 * s**2 + 6.0, t), t)
    settled = t > 10.0
    np.testing.assert_allclose(lag[settled, 0], -2e-4 / (2.0 * np.pi * HZ) ** 2, rtol=1e-2)
    assert np.abs(lag[:, 1]).max() < 1e-12


@pytest.mark.parametrize("ratio", [0.1, 0.5, 2.0])
def test_behind_a_swing_it_has_the_transfer_functions_size_and_phase(ratio):
    t, w = np.arange(0.0, 120.0, 0.05), 2.0 * np.pi * HZ
    swing = ratio * w
    lag = servo_lag(radar(HZ), t, circling(lambda s: 0.02 * np.sin(swing * s), t), t)[:, 0]
    s = 1j * swing
    want = 0.02 * np.imag(-(s**2) / (s**2 + np.sqrt(2.0) * w * s + w**2) * np.exp(s * t))
    inner = t > 30.0
    assert np.abs(lag[inner] - want[inner]).max() < 0.02 * np.abs(want).max()


def lagging(telemetry, truth, hz=HZ, **stated):
    """Telemetry whose radars read what a servo makes of the true angles, from a second integration."""
    w = 2.0 * np.pi * hz
    radars = {}
    for name, record in telemetry.radars.items():
        site = record.spec
        t = np.arange(record.time_s[0] - 4.0, record.time_s[-1] + 0.1, 0.02)
        place = truth.trajectory(t).position_ecef_m
        angles = earth.radar_from_ecef(place, site.latitude_rad, site.longitude_rad, site.height_m)[:, 1:]
        bent = angles - angles[0] - (t - t[0])[:, None] * (angles[1] - angles[0]) / (t[1] - t[0])
        behind = ([-1.0, 0.0, 0.0], [1.0, np.sqrt(2.0) * w, w * w])
        lag = np.column_stack([np.interp(record.time_s, t, signal.lsim(behind, c, t - t[0])[1]) for c in bent.T])
        z = record.range_az_el + np.column_stack([np.zeros(len(lag)), lag])
        radars[name] = replace(record, range_az_el=z, spec=replace(site, **stated))
    return replace(telemetry, radars=radars)


def velocity_z(solution, truth):
    """Root mean square of the velocity's error over its sd, and of the error, m/s, through the pulse."""
    path = solution.smoothed
    rows = (path.time_s > 120.0) & (path.time_s < 140.0)
    off = path.velocity_ecef_mps[rows] - truth.trajectory(path.time_s[rows]).velocity_ecef_mps
    sd = np.sqrt(np.diagonal(path.covariance[rows], axis1=1, axis2=2)[:, 3:6])
    return float(np.sqrt(np.mean((off / sd) ** 2))), float(np.sqrt(np.mean(off**2)))


@pytest.mark.parametrize("engine", ["compiled", "filterpy"])
def test_stated_it_leaves_the_velocity_true(mini_truth, mini_sense, engine):
    telemetry = mini_sense(4)[0]
    settings = replace(QUICK, engine=engine)
    stated = lagging(telemetry, mini_truth, angle_servo_hz=HZ, servo_lag_sd=0.1)
    with_it, error = velocity_z(estimate(stated, settings), mini_truth)
    without, blurred = velocity_z(estimate(lagging(telemetry, mini_truth), settings), mini_truth)
    assert with_it < 1.6  # rms of a few independent errors of unit variance, 3 sd
    assert without > 2.5
    assert error < 0.4 * blurred


def test_a_bandwidth_that_is_off_is_estimated(mini_truth, mini_sense):
    stated = lagging(mini_sense(5)[0], mini_truth, angle_servo_hz=1.2 * HZ, servo_lag_sd=0.4)
    table = estimate(stated, QUICK).sensor_errors.set_index("name")
    rows = table.loc[[f"{name} servo lag" for name in stated.radars]]
    # the lag goes with the bandwidth to the power of -2, if it is slow
    assert (np.abs(rows.estimate - 0.44) < 4.0 * rows.sd).all()
    assert (rows.sd < 0.2).any()


@pytest.mark.parametrize("stated", [{}, {"angle_servo_hz": 2.0}], ids=["not stated", "stated ten times too fast"])
def test_a_slow_servo_that_is_not_stated_is_named(mini_truth, mini_sense, stated):
    solution = reconstruct(lagging(mini_sense(4)[0], mini_truth, hz=0.2, **stated), QUICK)
    assert any(not check.passed for check in solution.consistency_checks)
    assert solution.single_faults[0].code == "servo-lag"


def test_a_lag_without_a_servo_is_refused():
    entry = {"file": "radar.csv", "latitude_deg": 1.0, "longitude_deg": 2.0, "height_m": 3.0, "servo_lag_sd": 0.2}
    with pytest.raises(ConfigError, match="angle_servo_hz"):
        parse_section(RadarEntry, entry, "radars.north")
