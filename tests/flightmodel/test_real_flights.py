"""Recorded flights read as their flight.toml says: axes, signs, units and time tags held to physics and to each other.

One flight's data are in the tree; the others' lie where POSTFLIGHT_REALDATA says (licences).
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.flightfolder import read_flight
from flightmodel.geomagnetism_and_sun import magnetic_field_ecef_t

FLIGHTS = Path(__file__).parents[1] / "data" / "real_flights"
REAL = os.environ.get("POSTFLIGHT_REALDATA")
needs_data = [
    pytest.mark.realdata,
    pytest.mark.skipif(REAL is None, reason="POSTFLIGHT_REALDATA names no folder of recorded flights"),
]


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """Read a flight of which only flight.toml is in the tree: its tables are copied beside it."""
    flown = {}

    def one(name):
        if name not in flown:
            folder = tmp_path_factory.mktemp(name)
            tables = FLIGHTS / name if any((FLIGHTS / name).glob("*.csv")) else Path(str(REAL)) / name
            for path in (FLIGHTS / name / "flight.toml", *tables.glob("*.csv")):
                shutil.copy(path, folder)
            flown[name] = read_flight(folder)
        return flown[name]

    return one


def body(record, start, end):
    """Times and samples in body axes of a triad between two times."""
    rows = (record.time_s >= start) & (record.time_s < end)
    return record.time_s[rows], record.measured_sensor[rows] @ record.spec.dcm_body_sensor.T


def heights(record, start, end):
    """Times and ellipsoidal heights of fixes between two times."""
    rows = (record.time_s >= start) & (record.time_s < end)
    return record.time_s[rows], earth.geodetic_from_ecef(record.position_ecef_m[rows])[2]


def level_angle(field_body, expected_body):
    """Angle between two fields as seen along body x: how far a roll is off, deg."""
    off = [np.arctan2(v[2], v[1]) for v in (field_body, expected_body)]
    return abs(np.rad2deg(np.angle(np.exp(1j * (off[0] - off[1])))))


# a rocket with receiver and barometer alone


def test_prometheus_flies_by_receiver_and_barometer(read):
    flight = read("rocketpy_prometheus")
    assert flight.accelerometer is None
    assert flight.attitude_prior is None
    assert flight.motion.model == "ballistic"
    fixes, baro = flight.gnss["gps"], flight.barometers["baro"]
    step = np.diff(fixes.time_s)
    np.testing.assert_allclose(step, np.round(step), atol=1e-6, err_msg="a receiver fixes on the second")
    # pad at 1394 m above sea level, apogee at 5524 m by the receiver itself, less the undulation of -24 m
    _, pad = heights(fixes, -2.0, 0.0)
    t, h = heights(fixes, 0.0, 60.0)
    np.testing.assert_allclose(pad, 1394.0 - 24.0, atol=0.01)
    assert h.max() == pytest.approx(5524.0 - 24.0, abs=0.01)
    assert 28.0 < t[np.argmax(h)] < 29.5
    # the standard's heights: too low by 6 % of the climb on a hot day, and by the day's pressure
    at_apogee = np.interp(28.0, baro.time_s, baro.height_m)
    climb = (at_apogee - (1330.0 - 24.0)) / (h.max() - pad[0])
    assert 0.92 < climb < 0.97


def test_prometheus_free_of_thrust_falls_as_things_fall(read):
    """Time tags on the fix's own clock: near apogee, where there is no drag, heights bend by 9.8 m/s each second."""
    t, h = heights(read("rocketpy_prometheus").gnss["gps"], 20.0, 28.5)
    bend = 2.0 * np.polyfit(t, h, 2)[0]
    assert bend == pytest.approx(-9.8, abs=0.6)


# one radar


class TestRadar36353:
    pytestmark = needs_data

    def test_reads_one_radar_and_nothing_else(self, read):
        flight = read("radar_36353")
        assert list(flight.radars) == ["B"]
        assert flight.vehicle is None
        assert flight.span_s() == pytest.approx((64.0, 690.0), abs=0.06)

    def test_coast_is_free_fall_to_293_km(self, read):
        record = read("radar_36353").radars["B"]
        s = record.spec
        rows = (record.time_s > 250.0) & (record.time_s < 310.0)
        t = record.time_s[rows] - 280.0
        p = earth.ecef_from_radar(record.range_az_el[rows], s.latitude_rad, s.longitude_rad, s.height_m)
        position, velocity, half = np.polynomial.polynomial.polyfit(t, p, 3)[:3]
        w = earth.OMEGA_ECEF_RADPS
        fall = earth.gravitation(position) - 2.0 * np.cross(w, velocity) - np.cross(w, np.cross(w, position))
        # 0.035 mrad at 295 km are 10 m that wander within 2.5 s: 24 independent ones bend a parabola by 0.02
        np.testing.assert_allclose(2.0 * half, fall, atol=0.05)
        assert earth.geodetic_from_ecef(p)[2].max() == pytest.approx(293.3e3, abs=1e3)

    def test_noise_is_the_steps_it_is_written_in(self, read):
        record = read("radar_36353").radars["B"]
        rows = (record.time_s > 200.0) & (record.time_s < 400.0)
        white = np.diff(record.range_az_el[rows], n=3, axis=0).std(axis=0) / np.sqrt(20.0)
        assert white[0] == pytest.approx(1.0 / np.sqrt(12.0), rel=0.2)
        assert (white[1:] < np.deg2rad(2e-4)).all()


# inertial units


class TestPsas:
    pytestmark = needs_data

    def test_on_the_pad_it_feels_gravity_along_the_nose(self, read):
        flight = read("psas_l12")
        _, force = body(flight.accelerometer, -4.5, -0.5)
        np.testing.assert_allclose(force.mean(axis=0), [9.8, 0.0, 0.0], atol=0.2)
        _, rate = body(flight.rates, -4.5, -0.5)
        assert (np.abs(rate.mean(axis=0)) < np.deg2rad(0.5)).all()

    def test_fixes_on_the_pad_and_at_apogee(self, read):
        fixes = read("psas_l12").gnss["venus8"]
        pad = earth.ecef_from_geodetic(np.deg2rad(43.7961328), np.deg2rad(-120.6517534), 1389.36 - 19.2)
        assert np.linalg.norm(fixes.position_ecef_m[0] - pad) < 1.0
        assert not ((fixes.time_s > 0.0) & (fixes.time_s < 31.0)).any()
        _, h = heights(fixes, 31.0, 33.1)
        assert h.max() - 1370.2 == pytest.approx(5103.0, abs=5.0)
        assert np.isnan(fixes.velocity_ecef_mps).all()

    def test_lift_off_is_at_zero(self, read):
        t, force = body(read("psas_l12").accelerometer, -1.0, 1.0)
        assert t[np.argmax(force[:, 0] > 30.0)] == pytest.approx(0.0, abs=0.15)

    def test_field_has_the_earths_sign_and_the_prior_its_roll(self, read):
        flight = read("psas_l12")
        _, up = body(flight.magnetometer, -4.5, -0.5)
        _, down = body(flight.magnetometer, 34.0, 35.0)
        assert up[:, 0].mean() < -40e-6, "nose up: the field points out of the tail at 66 deg of dip"
        assert down[:, 0].mean() > 40e-6
        prior, at = flight.attitude_prior, flight.gnss["venus8"].position_ecef_m[:1]
        field = magnetic_field_ecef_t(at, flight.t0_utc)[0]
        expected = rotations.rotate(rotations.conjugate(prior.q_ecef_body), field)
        iron = -1e-6 * np.array([0.0, 4.3, 3.0])
        assert level_angle(up.mean(axis=0) - iron, expected) < 10.0


class TestPiccard:
    pytestmark = needs_data

    def test_thrust_and_free_fall_along_the_nose(self, read):
        flight = read("euroc21_piccard")
        _, thrust = body(flight.accelerometer, 1.0, 2.0)
        np.testing.assert_allclose(thrust.mean(axis=0), [97.0, 0.0, 0.0], atol=5.0)
        _, apogee = body(flight.accelerometer, 33.0, 36.0)
        np.testing.assert_allclose(apogee.mean(axis=0), 0.0, atol=0.2)

    def test_fixes_bend_as_free_fall_does_and_end_where_they_are_written(self, read):
        fixes = read("euroc21_piccard").gnss["gps"]
        _, pad = heights(fixes, -2.0, 0.0)
        t, h = heights(fixes, 24.0, 38.0)
        np.testing.assert_allclose(pad, 155.0 + 54.0, atol=0.01)
        assert h.max() == pytest.approx(6339.0 + 54.0, abs=0.01)
        assert 2.0 * np.polyfit(t, h, 2)[0] == pytest.approx(-9.8, abs=0.6)

    def test_time_tags_fit_the_accelerometer(self, read):
        """Climb between two fixes by the accelerometer alone, upright: a tag 0.7 s off would be 100 m."""
        flight = read("euroc21_piccard")
        t, force = body(flight.accelerometer, -0.3, 30.0)
        up = force[:, 0] * 1.05 * np.cos(np.deg2rad(4.0)) - 9.8
        speed = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (up[1:] + up[:-1]))])
        climb = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (speed[1:] + speed[:-1]))])
        at, h = heights(flight.gnss["gps"], 8.0, 13.0)
        np.testing.assert_allclose(np.diff(np.interp(at, t, climb)), np.diff(h), rtol=0.05)

    def test_magnetometer_turns_as_the_roll_gyro_says(self, read):
        flight = read("euroc21_piccard")
        t, field = body(flight.magnetometer, 15.0, 30.0)
        iron = 1e-6 * np.array([11.0, 15.5])
        phase = np.unwrap(np.arctan2(field[:, 2] - iron[1], field[:, 1] - iron[0]))
        _, rate = body(flight.rates, 15.0, 30.0)
        turned = np.sum(0.5 * np.diff(t) * (rate[1:, 0] + rate[:-1, 0]))
        # a vector fixed in space turns backwards in a body that rolls forwards
        assert phase[-1] - phase[0] == pytest.approx(-turned, rel=0.03)

    def test_prior_fits_the_field_at_ignition(self, read):
        flight = read("euroc21_piccard")
        _, up = body(flight.magnetometer, -0.3, 0.0)
        prior, at = flight.attitude_prior, flight.gnss["gps"].position_ecef_m[:1]
        expected = rotations.rotate(rotations.conjugate(prior.q_ecef_body), magnetic_field_ecef_t(at, flight.t0_utc)[0])
        assert level_angle(up.mean(axis=0) - 1e-6 * np.array([0.0, 11.0, 15.5]), expected) < 20.0

    def test_only_the_bays_settled_heights_are_used(self, read):
        flight = read("euroc21_piccard")
        baro = flight.barometers["baro"]
        assert baro.time_s[0] >= 36.0
        t, h = heights(flight.gnss["gps"], 36.0, 45.0)
        off = np.interp(t, baro.time_s, baro.height_m) - h
        assert (np.abs(off) < 300.0).all()


class TestNavego:
    pytestmark = needs_data

    def test_axes_and_signs_carry_the_truth_for_ten_seconds(self, read):
        """Strapdown from the first attitude with the stated biases removed: right to metres, wrong by far otherwise."""
        flight = read("navego_synthetic")
        truth = np.loadtxt(Path(str(REAL)) / "navego_synthetic" / "truth_first_200s.csv", delimiter=",", skiprows=1)
        lat, lon, height = truth[:, 1:4].T
        p = earth.ecef_from_geodetic(lat[0], lon[0], height[0])
        v = earth.ecef_from_ned(truth[0, 4:7], p)
        q = flight.attitude_prior.q_ecef_body
        t, force = body(flight.accelerometer, 0.0, 10.0001)
        _, rate = body(flight.rates, 0.0, 10.0001)
        force, rate = force - 0.164, rate - 3.65e-3
        w = earth.OMEGA_ECEF_RADPS
        for k, dt in enumerate(np.diff(t)):
            spin = 0.5 * (rate[k] + rate[k + 1]) - rotations.rotate(rotations.conjugate(q), w)
            middle = rotations.boxplus(q, 0.5 * dt * spin)
            a = rotations.rotate(middle, 0.5 * (force[k] + force[k + 1])) + earth.gravitation(p)
            a = a - 2.0 * np.cross(w, v) - np.cross(w, np.cross(w, p))
            p, v, q = p + dt * v + 0.5 * dt**2 * a, v + dt * a, rotations.boxplus(q, dt * spin)
        at = np.searchsorted(truth[:, 0], 10.0 - 1e-6)
        expected = earth.ecef_from_geodetic(lat[at], lon[at], height[at])
        assert np.linalg.norm(expected - earth.ecef_from_geodetic(lat[0], lon[0], height[0])) > 50.0, "it moves"
        # 0.01 m/s^2 of bias left (by three axes alike) makes 0.5 m in 10 s, the first sample's slip another 0.2 m
        assert np.linalg.norm(p - expected) < 3.0

    def test_fixes_scatter_about_the_truth_as_stated(self, read):
        flight = read("navego_synthetic")
        truth = np.loadtxt(Path(str(REAL)) / "navego_synthetic" / "truth_first_200s.csv", delimiter=",", skiprows=1)
        fixes = flight.gnss["receiver"]
        rows = fixes.time_s < 200.0
        true = earth.ecef_from_geodetic(*(np.interp(fixes.time_s[rows], truth[:, 0], c) for c in truth[:, 1:4].T))
        error = earth.ned_from_ecef(fixes.position_ecef_m[rows] - true, true)
        sd = [fixes.spec.horizontal_sd_m, fixes.spec.horizontal_sd_m, fixes.spec.vertical_sd_m]
        n = rows.sum()
        # chi-square of n errors, 4 standard deviations
        np.testing.assert_allclose((error**2).mean(axis=0) / np.square(sd), 1.0, atol=4.0 * np.sqrt(2.0 / n))
        v = earth.ecef_from_ned(
            np.column_stack([np.interp(fixes.time_s[rows], truth[:, 0], c) for c in truth[:, 4:7].T]), true
        )
        assert (fixes.velocity_ecef_mps[rows] - v).std() == pytest.approx(0.051, rel=0.1)
