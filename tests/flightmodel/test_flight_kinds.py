"""Flights other than an entry vehicle's: receivers, barometers, mounts without a vehicle, motion, what is refused."""

from __future__ import annotations

import re

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.atmosphere import height_from_pressure, profile_from_sounding, standard_sounding, us76
from flightmodel.checks import ConfigError, GateError
from flightmodel.earth import q_ecef_body_from_pointing, undulation_m
from flightmodel.flightfolder import read_flight
from tests.refusing import numbers_in, refuses

DEG = np.pi / 180.0
HEAD = 'name = "small"\nt0_utc = "2022-06-24T15:17:17.5Z"\n'
GNSS = '[gnss.gps]\nfile = "gps.csv"\nheight_is = "ellipsoid"\n'
BALLISTIC = '[motion]\nmodel = "ballistic"\ndrag_area_per_mass_m2pkg = 0.01\n'
PRIOR = "[attitude_prior]\nt_s = 0.0\nazimuth_deg = 30.0\nelevation_deg = 80.0\nroll_deg = 10.0\n"
TRIADS = """\
[sensors.accelerometer]
file = "imu.csv"
mount = "body"
columns = { ax = { column = "fx", unit = "mps2" }, ay = { column = "fy", unit = "mps2" }, az = { column = "fz", unit = "mps2" } }
[sensors.rates]
file = "imu.csv"
columns = { p = { column = "wx", unit = "degps" }, q = { column = "wy", unit = "degps" }, r = { column = "wz", unit = "degps" } }
"""  # noqa: E501
BARO = '[barometers.baro]\nfile = "baro.csv"\nheight_is = "ellipsoid"\n'
LAT, LON = 32.9, -106.9
T = np.arange(0.0, 20.0, 0.5)


@pytest.fixture
def folder(tmp_path):
    """Write a table by name, header and rows; and flight.toml; ``read`` reads it."""

    class Folder:
        root = tmp_path

        def table(self, name, header, *columns):
            rows = [",".join(f"{v:.9g}" if np.isfinite(v) else "" for v in row) for row in zip(*columns, strict=True)]
            (tmp_path / name).write_text("\n".join([header, *rows]) + "\n")

        def read(self, *sections):
            (tmp_path / "flight.toml").write_text("\n".join([HEAD, *sections]))
            return read_flight(tmp_path)

        def refused(self, sections, codes, *names, kind=ConfigError):
            with refuses(*codes.split(), names=[re.escape(name) for name in names], kind=kind):
                self.read(*sections)

    made = Folder()
    up = 10.0 * T
    made.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m", T, LAT + 0 * T, LON + 1e-5 * T, 1400 + up)
    phase = np.sin(7.0 * T)
    made.table("imu.csv", "t_s,fx,fy,fz,wx,wy,wz", T, 10 + phase, phase, 2 * phase, 30 + phase, 3 * phase, phase)
    made.table("baro.csv", "t_s,height_m", T, 1400 + up + phase)
    return made


def findings(telemetry, source):
    return {f.code: f.what for f in telemetry.findings if f.source == source}


# what is read


def test_receiver_alone_is_enough_with_ballistic_motion(folder):
    telemetry = folder.read(GNSS, BALLISTIC)
    assert telemetry.vehicle is None
    assert telemetry.accelerometer is None
    assert telemetry.radars == {}
    assert telemetry.motion.model == "ballistic"
    record = telemetry.gnss["gps"]
    lat, lon, height = earth.geodetic_from_ecef(record.position_ecef_m)
    np.testing.assert_allclose(lat, LAT * DEG, atol=1e-9)
    np.testing.assert_allclose(lon, (LON + 1e-5 * T) * DEG, atol=1e-9)
    np.testing.assert_allclose(height, 1400 + 10 * T, atol=1e-3)
    assert np.isnan(record.velocity_ecef_mps).all()
    assert telemetry.span_s() == (0.0, 19.5)
    assert "gps.csv" in telemetry.hashes


def test_standard_air_stands_in_and_is_told(folder):
    telemetry = folder.read(GNSS, BALLISTIC)
    assert list(findings(telemetry, "atmosphere")) == ["no-sounding"]
    air = telemetry.sounding
    assert (air.altitude_m[0], air.altitude_m[-1]) == (0.0, 120e3)
    np.testing.assert_array_equal(air.density_kgpm3, us76(air.altitude_m)[0])
    assert set(air.density_sd[air.altitude_m <= 40e3]) == {0.10}
    assert set(air.density_sd[(air.altitude_m >= 80e3) & (air.altitude_m <= 100e3)]) == {0.24}
    assert set(air.wind_sd_mps) == {15.0}
    assert not air.wind_north_mps.any()


def test_height_above_sea_level_gets_the_undulation(folder):
    before = folder.read(GNSS, BALLISTIC).gnss["gps"].position_ecef_m
    above_sea = GNSS.replace('"ellipsoid"', '"msl"\ngeoid_undulation_m = -24.0')
    after = folder.read(above_sea, BALLISTIC).gnss["gps"].position_ecef_m
    up = earth.ned_from_ecef(after - before, before)
    np.testing.assert_allclose(up, np.tile([0.0, 0.0, 24.0], (len(T), 1)), atol=1e-5)


def test_where_no_undulation_is_stated_the_model_gives_it(folder):
    before = folder.read(GNSS, BARO, BALLISTIC)
    after = folder.read(GNSS.replace("ellipsoid", "msl"), BARO.replace("ellipsoid", "msl"), BALLISTIC)
    fixes = after.gnss["gps"].position_ecef_m
    up = earth.ned_from_ecef(fixes - before.gnss["gps"].position_ecef_m, fixes)
    expected = float(undulation_m(LAT * DEG, LON * DEG))
    assert abs(expected) > 5.0
    np.testing.assert_allclose(up, np.tile([0.0, 0.0, -expected], (len(T), 1)), atol=1e-3)
    raised = after.barometers["baro"].height_m - before.barometers["baro"].height_m
    np.testing.assert_allclose(raised, expected, atol=1e-3)
    assert [f.source for f in after.findings if f.code == "values-converted"] == ["gps", "baro"]


def test_ecef_columns_are_read_before_geodetic_ones_and_velocities_either_way(folder):
    at = earth.ecef_from_geodetic(LAT * DEG, LON * DEG, 1400 + 10 * T)
    ned = np.column_stack([3.0 + 0 * T, -2.0 + 0 * T, -10.0 + 0 * T])
    v = earth.ecef_from_ned(ned, at)
    geodetic = (LAT + 0 * T, LON + 0 * T, 9999 + 0 * T)
    header = "t_s,lat_deg,lon_deg,alt_m,x_ecef_m,y_ecef_m,z_ecef_m"
    folder.table("gps.csv", f"{header},vx_ecef_mps,vy_ecef_mps,vz_ecef_mps", T, *geodetic, *at.T, *v.T)
    one = folder.read('[gnss.gps]\nfile = "gps.csv"\n', BALLISTIC).gnss["gps"]
    np.testing.assert_allclose(one.position_ecef_m, at, rtol=0.0, atol=0.01)
    np.testing.assert_allclose(one.velocity_ecef_mps, v, rtol=0.0, atol=1e-6)
    folder.table("gps.csv", f"{header},vn_mps,ve_mps,vd_mps", T, *geodetic, *at.T, *ned.T)
    two = folder.read('[gnss.gps]\nfile = "gps.csv"\n', BALLISTIC).gnss["gps"]
    np.testing.assert_allclose(two.velocity_ecef_mps, v, rtol=0.0, atol=1e-6)
    silent = folder.read('[gnss.gps]\nfile = "gps.csv"\nvelocity = false\n', BALLISTIC).gnss["gps"]
    assert np.isnan(silent.velocity_ecef_mps).all()
    # geodetic columns that are declared are meant
    meant = GNSS + 'columns = { alt = { column = "alt_m", unit = "m" } }\n'
    height = earth.geodetic_from_ecef(folder.read(meant, BALLISTIC).gnss["gps"].position_ecef_m)[2]
    np.testing.assert_allclose(height, 9999.0, atol=1e-3)


def test_a_receiver_of_velocities_alone_is_read(folder):
    folder.table("doppler.csv", "t_s,vx_ecef_mps,vy_ecef_mps,vz_ecef_mps", T, 3 + 0 * T, T, -T)
    alone = '[gnss.doppler]\nfile = "doppler.csv"\n'
    telemetry = folder.read(GNSS, alone, BALLISTIC)
    record = telemetry.gnss["doppler"]
    np.testing.assert_allclose(record.velocity_ecef_mps, np.column_stack([3 + 0 * T, T, -T]))
    assert np.isnan(record.position_ecef_m).all()
    assert not any("horizontal" in key or "wander" in key for key in telemetry.assumed["gnss.doppler"])
    assert "speed_sd_mps" in telemetry.assumed["gnss.doppler"]
    # local and inertial axes need a place
    inertial = alone + 'axes = "inertial"\n'
    folder.refused([GNSS, inertial, BALLISTIC], "column-missing", "x_ecef_m", kind=GateError)
    folder.table("doppler.csv", "t_s,vn_mps,ve_mps,vd_mps", T, T, T, T)
    folder.refused([GNSS, alone, BALLISTIC], "column-missing", "vx_ecef_mps", kind=GateError)
    folder.table("doppler.csv", "t_s,vx_ecef_mps,vy_ecef_mps,vz_ecef_mps", T, T, T, np.nan * T)
    folder.refused([GNSS, alone, BALLISTIC], "too-few-rows", "velocity", kind=GateError)


def test_noise_of_its_own_for_each_fix(folder):
    fix = (T, LAT + 0 * T, LON + 0 * T, 1400 + T)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,hacc,vertical_sd_m", *fix, 2 + T, np.where(T < 2.0, np.nan, 4.0))
    columns = 'columns = { horizontal_sd = { column = "hacc", unit = "ft" } }\n'
    telemetry = folder.read(GNSS + columns, BALLISTIC)
    sd = telemetry.gnss["gps"].sd
    np.testing.assert_allclose(sd[:, 0], 0.3048 * (2 + T))
    np.testing.assert_array_equal(np.isnan(sd[:, 1]), T < 2.0)
    assert np.isnan(sd[:, 2:]).all()
    # what each fix states is not taken from the defaults; what some do not state is
    assert "horizontal_sd_m" not in telemetry.assumed["gnss.gps"]
    assert "vertical_sd_m" in telemetry.assumed["gnss.gps"]
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,horizontal_sd_m", *fix, 0 * T)
    folder.refused([GNSS, BALLISTIC], "value-range", "horizontal_sd", kind=GateError)


def test_heights_above_the_ground_start_from_its_own(folder):
    folder.table("baro.csv", "t_s,height_m", T, 10.0 * T)
    baro = '[barometers.baro]\nfile = "baro.csv"\nheight_is = "ground"\n'
    telemetry = folder.read(GNSS, baro + "ground_height_m = 1400.0\n", BALLISTIC)
    np.testing.assert_allclose(telemetry.barometers["baro"].height_m, 1400.0 + 10.0 * T)
    folder.refused([GNSS, baro, BALLISTIC], "keys-conflict", "ground_height_m")
    folder.refused([GNSS, BARO + "ground_height_m = 1400.0\n", BALLISTIC], "keys-conflict", "ground_height_m")
    folder.table("baro.csv", "t_s,pressure_pa", T, 9e4 - 100.0 * T)
    folder.refused([GNSS, baro + "ground_height_m = 1400.0\n", BALLISTIC], "height-datum", "pressures")


def test_a_unit_with_a_minus_turns_one_axis_round(folder):
    plain = folder.read(GNSS, TRIADS, PRIOR).rates.measured_sensor
    turned = folder.read(GNSS, TRIADS.replace('"wy", unit = "degps"', '"wy", unit = "-degps"'), PRIOR).rates
    np.testing.assert_array_equal(turned.measured_sensor, plain * [1.0, -1.0, 1.0])
    minus = '[gnss.gps.columns]\nalt = { column = "alt_m", unit = "-m" }\n'
    folder.refused([GNSS + minus, BALLISTIC], "key-value", "'-m'")


def test_weak_fixes_are_left_out_and_counted(folder):
    nsat = np.where(T < 5.0, 5, 9)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,sats", T, LAT + 0 * T, LON + 0 * T, 1400 + T, nsat)
    telemetry = folder.read(GNSS, 'min_satellites = 7\nsatellites_column = "sats"', BALLISTIC)
    assert telemetry.gnss["gps"].time_s[0] == 5.0
    assert numbers_in(findings(telemetry, "gps")["too-few-rows"]) == [10.0, 40.0, 7.0]


def test_a_fix_that_is_held_until_the_next_counts_once(folder):
    # a log at 2 Hz of a receiver at 0.5 Hz, that loses its last two fixes
    at = np.minimum(2.0 * np.floor(T / 2.0), 16.0)
    fix = (LAT + 1e-5 * at, LON + 0 * at, 1400 + 50 * at)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,horizontal_sd_m", T, *fix, 2 + T)
    telemetry = folder.read(GNSS, BALLISTIC)
    record = telemetry.gnss["gps"]
    np.testing.assert_array_equal(record.time_s, np.arange(0.0, 17.0, 2.0))
    np.testing.assert_allclose(record.sd[:, 0], 2 + record.time_s)
    found = findings(telemetry, "gps")
    assert numbers_in(found["rows-left-out"]) == [31.0, 40.0, 3.5]
    assert "data-frozen" not in found
    # what moves in one column is a fix of its own, and so is one without a position where the velocity goes on
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,vn_mps,ve_mps,vd_mps", T, *fix, T, 0 * T, 0 * T)
    telemetry = folder.read(GNSS, BALLISTIC)
    assert len(telemetry.gnss["gps"].time_s) == len(T)
    assert "rows-left-out" not in findings(telemetry, "gps")


def test_empty_cells_are_missing_fixes(folder):
    alt = np.where(T == 3.0, np.nan, 1400 + T)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m", T, LAT + 0 * T, LON + 0 * T, alt)
    record = folder.read(GNSS, BALLISTIC).gnss["gps"]
    assert np.flatnonzero(np.isnan(record.position_ecef_m).any(axis=1)).tolist() == [6]


def test_barometer_by_height_and_by_pressure(folder):
    heights = folder.read(GNSS, BARO, BALLISTIC).barometers["baro"]
    np.testing.assert_allclose(heights.height_m, 1400 + 10 * T + np.sin(7.0 * T), atol=1e-3)
    true = np.linspace(-200.0, 30e3, len(T))
    folder.table("baro.csv", "t_s,pressure_pa", T, us76(true)[2])
    telemetry = folder.read(GNSS, BARO, BALLISTIC)
    np.testing.assert_allclose(telemetry.barometers["baro"].height_m, true, atol=0.01)
    assert "use_s" in findings(telemetry, "baro")["values-converted"]


def test_pressure_height_follows_the_days_air():
    sounding = standard_sounding()
    warm = profile_from_sounding(sounding)
    z = np.linspace(0.0, 60e3, 301) + 7.0
    np.testing.assert_allclose(height_from_pressure(warm, warm.at(z).pressure_pa), z, atol=0.01)
    assert np.isnan(height_from_pressure(warm, np.array([np.nan])))[0]


def test_body_axes_and_own_axes_turn_the_same_samples_alike(folder):
    plain = folder.read(GNSS, TRIADS, PRIOR).accelerometer
    np.testing.assert_array_equal(plain.spec.dcm_body_sensor, np.eye(3))
    np.testing.assert_array_equal(plain.spec.position_from_datum_body_m, np.zeros(3))
    axes = 'axes = ["-z", "+y", "+x"]\nposition_from_datum_body_m = [-1.0, 0.1, 0.2]'
    turned = folder.read(GNSS, TRIADS.replace('mount = "body"', axes), PRIOR).accelerometer
    body = turned.measured_sensor @ turned.spec.dcm_body_sensor.T
    sensor = plain.measured_sensor
    np.testing.assert_array_equal(body, np.column_stack([sensor[:, 2], sensor[:, 1], -sensor[:, 0]]))
    np.testing.assert_array_equal(turned.spec.position_from_datum_body_m, [-1.0, 0.1, 0.2])


def test_rates_have_axes_too_and_a_slow_bias(folder):
    slow = 'axes = ["+y", "-x", "+z"]\nbias_wander_sd_degps = 0.2\nbias_time_constant_s = 60.0\ncolumns = { p'
    rates = folder.read(GNSS, TRIADS.replace("columns = { p", slow), PRIOR).rates
    np.testing.assert_array_equal(rates.spec.dcm_body_sensor @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(rates.spec.dcm_body_sensor @ [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0])
    assert rates.spec.bias_wander_sd == pytest.approx(0.2 * DEG)
    assert rates.spec.bias_time_constant_s == 60.0
    assert folder.read(GNSS, TRIADS, PRIOR).rates.spec.bias_time_constant_s == np.inf


def test_reversed_magnetometer(folder):
    folder.table("mag.csv", "t_s,x,y,z", T, 20 + np.sin(T), np.cos(T), 40 + np.sin(2 * T))
    columns = ", ".join(f'b{a} = {{ column = "{a}", unit = "ut" }}' for a in "xyz")
    section = f'[sensors.magnetometer]\nfile = "mag.csv"\nmount = "body"\ncolumns = {{ {columns} }}\n'
    plain = folder.read(GNSS, TRIADS, PRIOR, section).magnetometer
    turned = folder.read(GNSS, TRIADS, PRIOR, section, "reversed = true").magnetometer
    np.testing.assert_array_equal(turned.measured_sensor, -plain.measured_sensor)


def test_pointing_conventions():
    lat, lon = 40.0 * DEG, -100.0 * DEG
    to_ned = earth.dcm_ned_ecef(lat, lon)

    def axes(azimuth, elevation, roll):
        q = q_ecef_body_from_pointing(azimuth * DEG, elevation * DEG, roll * DEG, lat, lon)
        return to_ned @ rotations.dcm_from_q(q)

    level = axes(0.0, 0.0, 0.0)  # columns: body x, y, z in north, east, down
    np.testing.assert_allclose(level, np.eye(3), atol=1e-12)
    upright = axes(0.0, 90.0, 0.0)
    np.testing.assert_allclose(upright, np.column_stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]]), atol=1e-12)
    tilted = axes(120.0, 35.0, 0.0)
    c, s = np.cos(35 * DEG), np.sin(35 * DEG)
    np.testing.assert_allclose(tilted[:, 0], [c * np.cos(120 * DEG), c * np.sin(120 * DEG), -s], atol=1e-12)
    assert abs(tilted[2, 1]) < 1e-12, "y is horizontal at roll 0"
    assert np.cross(tilted[:, 0], tilted[:, 1])[2] > 0.0, "y is to the right"
    rolled = axes(0.0, 0.0, 90.0)
    np.testing.assert_allclose(rolled[:, 1], [0.0, 0.0, 1.0], atol=1e-12)


def test_prior_by_pointing_takes_the_place_of_the_first_fix(folder):
    telemetry = folder.read(GNSS, TRIADS, PRIOR + "sd_deg = [20.0, 2.0, 3.0]")
    q = q_ecef_body_from_pointing(30 * DEG, 80 * DEG, 10 * DEG, LAT * DEG, LON * DEG)
    np.testing.assert_allclose(telemetry.attitude_prior.q_ecef_body, q, atol=1e-9)
    np.testing.assert_allclose(telemetry.attitude_prior.sd_rad, np.array([20.0, 2.0, 3.0]) * DEG)
    elsewhere = PRIOR + "latitude_deg = 10.0\nlongitude_deg = 20.0\nsd_deg = 4"
    prior = folder.read(GNSS, TRIADS, elsewhere).attitude_prior
    q = q_ecef_body_from_pointing(30 * DEG, 80 * DEG, 10 * DEG, 10 * DEG, 20 * DEG)
    np.testing.assert_allclose(prior.q_ecef_body, q, atol=1e-12)
    np.testing.assert_allclose(prior.sd_rad, np.full(3, 4.0 * DEG))


def test_prior_by_pointing_takes_the_place_of_the_first_radar_point(folder):
    folder.table("track.csv", "t_s,range_m,az_deg,el_deg", T, 5000 + T, 90 + 0 * T, 0.1 + T)
    radar = '[radars.one]\nfile = "track.csv"\nlatitude_deg = 32.0\nlongitude_deg = -106.0\nheight_m = 1200.0\n'
    q = folder.read(radar, TRIADS, PRIOR).attitude_prior.q_ecef_body
    near = q_ecef_body_from_pointing(30 * DEG, 80 * DEG, 10 * DEG, 32 * DEG, (-106.0 + 5000 / 111e3 / 0.848) * DEG)
    assert np.linalg.norm(rotations.boxminus(q, near)) < 1e-4


def test_use_s_and_offset_and_repeats(folder):
    twice = np.sort(np.concatenate([T, T[4:8]]))
    folder.table("baro.csv", "t_s,height_m", twice, 1400 + 10 * twice)
    section = BARO + 'time = { offset_s = 2.0, repeats = "first" }\nuse_s = [[2.0, 6.0], [10.0, 12.0]]'
    telemetry = folder.read(GNSS, BALLISTIC, section)
    record = telemetry.barometers["baro"]
    inside = T[((T >= 0.0) & (T <= 4.0)) | ((T >= 8.0) & (T <= 10.0))]
    np.testing.assert_allclose(record.time_s, inside + 2.0)
    np.testing.assert_allclose(record.height_m, 1400 + 10 * inside)
    told = findings(telemetry, "baro")
    assert numbers_in(told["rows-left-out"]) == [4.0]
    assert numbers_in(told["rows-outside-span"]) == [26.0, 40.0, 2.0, 6.0, 10.0, 12.0]


def test_samples_outside_use_s_may_be_wild(folder):
    wild = np.where(T > 15.0, 1e9, 1400 + T)
    folder.table("baro.csv", "t_s,height_m", T, wild)
    assert folder.read(GNSS, BALLISTIC, BARO + "use_s = [[0.0, 15.0]]").barometers["baro"].height_m.max() < 1500
    folder.refused([GNSS, BALLISTIC, BARO], "value-range", "baro.csv: line", kind=GateError)


def test_hours_minutes_and_seconds_of_a_day(folder):
    hours = np.array([23.0, 23.0, 0.0, 0.0])
    minutes, seconds = np.array([59.0, 59.0, 0.0, 0.0]), np.array([57.5, 59.5, 1.5, 3.5])
    header, place = "h,m,s,lat_deg,lon_deg,alt_m", (np.full(4, LAT), np.full(4, LON), 1400 + np.arange(4.0))
    folder.table("gps.csv", header, hours, minutes, seconds, *place)
    head = 'name = "small"\nt0_utc = "2022-06-24T23:59:58.5Z"\n'
    section = GNSS + 'time = { format = "utc_hms", columns = ["h", "m", "s"] }'
    (folder.root / "flight.toml").write_text("\n".join([head, section, BALLISTIC]))
    np.testing.assert_allclose(read_flight(folder.root).gnss["gps"].time_s, [-1.0, 1.0, 3.0, 5.0], atol=1e-6)
    folder.table("gps.csv", header, np.array([23.0, 24.0, 0.0, 0.0]), minutes, seconds, *place)
    folder.refused([section, BALLISTIC], "time-format", "24:59:59.5", "utc_hms", kind=GateError)


def test_motion_is_carried(folder):
    drag = "drag_sd = 2.0\nside_sd = 0.3\nacceleration_density = 0.01\n"
    section = BALLISTIC + drag + "powered_s = [[0.0, 5.0], [9.0, 11.0]]\npowered_sd_mps2 = 60.0\n"
    motion = folder.read(GNSS, section).motion
    assert (motion.drag_area_per_mass_m2pkg, motion.drag_sd, motion.powered_sd_mps2) == (0.01, 2.0, 60.0)
    assert (motion.side_sd, motion.acceleration_density) == (0.3, 0.01)
    assert motion.powered_s == ((0.0, 5.0), (9.0, 11.0))


def test_what_needs_a_vehicle_says_which_key_to_add(folder):
    telemetry = folder.read(GNSS, BALLISTIC)
    with refuses("vehicle-missing"):
        telemetry.required_vehicle()
    with refuses("inertial-missing"):
        telemetry.required_triads()


# what is refused


def test_nothing_that_tracks_is_refused(folder):
    folder.refused([BALLISTIC], "tracker-missing")
    folder.refused([BALLISTIC, BARO], "tracker-missing")


def test_one_triad_alone_is_refused(folder):
    only_force, only_rates = (TRIADS[: TRIADS.index("[sensors.rates]")], TRIADS[TRIADS.index("[sensors.rates]") :])
    folder.refused([GNSS, PRIOR, only_force], "inertial-missing", "[sensors.rates]")
    folder.refused([GNSS, PRIOR, only_rates], "inertial-missing", "[sensors.accelerometer]")


def test_strapdown_without_sensors_or_attitude_is_refused(folder):
    folder.refused([GNSS], "attitude-missing inertial-missing", 'motion.model = "strapdown"')
    folder.refused([GNSS, TRIADS], "attitude-missing", "[attitude_prior]", "[sensors.sun]")


def test_ballistic_without_drag_is_refused(folder):
    folder.refused(
        [GNSS, '[motion]\nmodel = "ballistic"\n'], "keys-conflict", "motion.model", "drag_area_per_mass_m2pkg"
    )


def test_mounts_that_contradict_or_lack_a_vehicle_are_refused(folder):
    folder.refused(
        [GNSS, PRIOR, TRIADS.replace('mount = "body"', 'mount = "body"\naxes = ["+x", "+y", "+z"]')], "keys-conflict"
    )
    folder.refused([GNSS, PRIOR, TRIADS.replace('mount = "body"', 'mount = "suba"')], "input-missing", 'mount = "body"')
    folder.refused([GNSS, PRIOR, TRIADS.replace('mount = "body"\n', "")], "input-missing")
    place = 'mount = "suba"\nposition_from_datum_body_m = [0.0, 0.0, 0.0]'
    folder.refused(
        [GNSS, PRIOR, TRIADS.replace('mount = "body"', place)], "keys-conflict", "position_from_datum_body_m"
    )
    named = ['vehicle = "irve2_reference"', GNSS, PRIOR, TRIADS.replace('mount = "body"', 'mount = "sub"')]
    folder.refused(named, "name-unknown", "sensors.accelerometer.mount = 'sub'", "suba")


def test_heights_above_what_must_be_said(folder):
    folder.refused([GNSS.replace('height_is = "ellipsoid"\n', ""), BALLISTIC], "height-datum", "gnss.gps")
    folder.refused([GNSS + "geoid_undulation_m = 20.0\n", BALLISTIC], "keys-conflict", "height_is")
    folder.refused([GNSS, BARO.replace('height_is = "ellipsoid"\n', ""), BALLISTIC], "height-datum", "barometers.baro")
    folder.refused([GNSS.replace("ellipsoid", "geoid"), BALLISTIC], "key-value", "gnss.gps.height_is", "'geoid'")


def test_bad_fixes_are_refused_by_line(folder):
    lat = np.where(T == 2.0, 0.0, LAT)
    lon = np.where(T == 2.0, 0.0, LON)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m", T, lat, lon, 1400 + T)
    folder.refused([GNSS, BALLISTIC], "fix-impossible", "gps.csv: line 6", "min_satellites", kind=GateError)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m", T, LAT + 60 + 0 * T, LON + 0 * T, 1400 + T)
    folder.refused([GNSS, BALLISTIC], "value-range", "gps.csv: line 2", kind=GateError)
    folder.table("gps.csv", "t_s,x_ecef_m,y_ecef_m,z_ecef_m", T, 0 * T, 0 * T, 0 * T)
    folder.refused([GNSS, BALLISTIC], "fix-impossible", "40 in all", kind=GateError)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg", T, LAT + 0 * T, LON + 0 * T)
    folder.refused([GNSS, BALLISTIC], "column-missing", "alt_m", kind=GateError)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,vn_mps", T, LAT + 0 * T, LON + 0 * T, 1400 + T, T)
    folder.refused([GNSS, BALLISTIC], "column-missing", "vd, ve", "velocity = false", kind=GateError)


def test_no_fix_good_enough_is_refused(folder):
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m,nsat", T, LAT + 0 * T, LON + 0 * T, 1400 + T, 5 + 0 * T)
    folder.refused([GNSS + "min_satellites = 6\n", BALLISTIC], "too-few-rows", "0 fixes", kind=GateError)
    folder.refused([GNSS + "min_fix_mode = 3\n", BALLISTIC], "column-missing", "'fix_mode'", kind=GateError)


def test_declaring_both_kinds_of_position_is_refused(folder):
    both = 'columns = { x = { column = "x_ecef_m", unit = "m" }, lat = { column = "lat_deg", unit = "deg" } }\n'
    header = "t_s,lat_deg,lon_deg,alt_m,x_ecef_m,y_ecef_m,z_ecef_m"
    at = earth.ecef_from_geodetic(LAT * DEG, LON * DEG, 1400 + T)
    folder.table("gps.csv", header, T, LAT + 0 * T, LON + 0 * T, 1400 + T, *at.T)
    folder.refused([GNSS + both, BALLISTIC], "columns-ambiguous")


def test_barometer_tables_that_are_not_clear_are_refused(folder):
    folder.table("baro.csv", "t_s,height_m,pressure_pa", T, 1400 + T, 86e3 - T)
    folder.refused([GNSS, BARO, BALLISTIC], "columns-ambiguous")
    declared = BARO + 'columns = { pressure = { column = "pressure_pa", unit = "pa" } }\n'
    np.testing.assert_allclose(
        folder.read(GNSS, declared, BALLISTIC).barometers["baro"].height_m,
        height_from_pressure(profile_from_sounding(standard_sounding()), 86e3 - T),
        atol=1e-3,
    )
    folder.table("baro.csv", "t_s,alt", T, 1400 + T)
    folder.refused([GNSS, BARO, BALLISTIC], "column-missing", "height_m", kind=GateError)
    folder.table("baro.csv", "t_s,pressure_pa", T, 860 * 1e3 - T)
    folder.refused([GNSS, BARO, BALLISTIC], "value-range", "baro.csv: line 2", kind=GateError)


def test_prior_must_have_one_form(folder):
    words = "azimuth_deg, elevation_deg and roll_deg"
    folder.refused([GNSS, TRIADS, PRIOR.replace("roll_deg = 10.0\n", "")], "keys-conflict", "attitude_prior", words)
    folder.refused([GNSS, TRIADS, PRIOR + "q_ecef_body = [1.0, 0.0, 0.0, 0.0]\n"], "keys-conflict", "q_ecef_body")
    folder.refused([GNSS, TRIADS, PRIOR + "latitude_deg = 10.0\n"], "keys-conflict")
    folder.refused([GNSS, TRIADS, PRIOR + "sd_deg = [1.0, 2.0]\n"], "key-missing", "attitude_prior.sd_deg")
    folder.refused([GNSS, TRIADS, PRIOR + "sd_deg = 0\n"], "key-value", "attitude_prior.sd_deg")


def with_axes(axes):
    return [GNSS, PRIOR, TRIADS.replace('mount = "body"', f"axes = {axes}")]


@pytest.mark.parametrize(
    ("sections", "code", "names", "kind"),
    [
        *(
            (with_axes(axes), code, ("sensors.accelerometer.axes", name), ConfigError)
            for axes, code, name in (
                ('["+x", "+y", "-z"]', "axes-left-handed", "axes"),
                ('["+x", "+x", "+z"]', "axes-parallel", "axes"),
                ('["+x", "-x", "+z"]', "axes-parallel", "axes"),
                ('["x", "+y", "+z"]', "key-value", "axes.0"),
            )
        ),
        *(
            ([GNSS + line, BALLISTIC], code, (name,), GateError)
            for line, code, name in (
                ("use_s = [[5.0, 5.0]]", "key-value", "use_s"),
                ("use_s = []", "key-value", "use_s"),
                ("use_s = [[100.0, 200.0]]", "too-few-rows", "0 rows"),
                ("min_satelites = 6", "key-unknown", "'min_satellites'"),
                ("horizontal_sd_m = 0.0", "key-value", "gnss.gps.horizontal_sd_m"),
                ("time_bias_sd_s = 100.0", "key-value", "gnss.gps.time_bias_sd_s"),
                ("antenna_from_datum_body_m = [0.0, 0.0, 1000.0]", "key-value", "antenna_from_datum_body_m"),
                ('time = { format = "utc_hms" }', "keys-conflict", "time"),
                ('time = { repeats = "last" }', "key-value", "repeats"),
                ("geoid_undulation_m = 500.0", "key-value", "geoid_undulation_m"),
                ("velocity = 1", "key-value", "velocity"),
                ('columns = { latt = { column = "lat_deg", unit = "deg" } }', "name-unknown", "'lat'"),
            )
        ),
    ],
)
def test_slips_of_the_pen_are_refused(folder, sections, code, names, kind):
    folder.refused(sections, code, *names, kind=kind)


def test_a_name_stands_once_and_a_sounding_has_no_spans(folder):
    folder.refused([GNSS, BARO.replace("barometers.baro", "barometers.gps"), BALLISTIC], "given-twice", "'gps'")
    folder.table("air.csv", "alt_m,rho_kgpm3,t_k", T, 1.2 - 0.001 * T, 280 + T)
    folder.refused(
        [GNSS, BALLISTIC, '[atmosphere]\nfile = "air.csv"\nuse_s = [[0.0, 5.0]]'], "keys-conflict", "atmosphere.use_s"
    )


def test_a_sounding_may_reach_into_the_thermosphere(folder):
    """417 K at 125 km, by the standard, were refused as no temperature of air; 417 K at 12.5 km still are."""
    air = '[atmosphere]\nfile = "air.csv"'
    for scale, refused in ((1.0, False), (0.1, True)):
        z = np.arange(0.0, 180e3, 1e3)
        columns = scale * z, *us76(z)[:2], 0 * z, 0 * z
        folder.table("air.csv", "alt_m,rho_kgpm3,t_k,wind_n_mps,wind_e_mps", *columns)
        if refused:
            folder.refused([GNSS, BALLISTIC, air], "value-range", "temperature", kind=GateError)
        else:
            assert folder.read(GNSS, BALLISTIC, air).sounding.temperature_k[-1] > 500.0


def test_video_needs_a_vehicle(folder):
    folder.refused(
        [GNSS, BALLISTIC, '[frames]\nfile = "gps.csv"\nfolder = "."'], "vehicle-missing", "frames", 'vehicle = "..."'
    )


def test_no_second_in_common_is_refused(folder):
    late = GNSS.replace('"gps.csv"', '"gps.csv"\ntime = { offset_s = 19.0 }')
    folder.refused([late, TRIADS, PRIOR], "time-not-covered", "accelerometer", "rates", "receivers", kind=GateError)


# the survey that trackers share


def test_survey_and_places_are_read_in_si(folder):
    sites = "[sites]\nsurvey_sd_m = 0.3\nheight_datum_sd_m = 0.5\nnorth_sd_deg = 0.01\n"
    place = '[[places]]\nname = "pad"\nt_s = 1.5\nlatitude_deg = 33.0\nlongitude_deg = -106.0\nsd_m = 2.0\n'
    prior = PRIOR + "latitude_deg = 32.9\nlongitude_deg = -106.9\n"
    telemetry = folder.read(prior, GNSS, BALLISTIC, sites, place)
    assert (telemetry.sites.survey_sd_m, telemetry.sites.height_datum_sd_m) == (0.3, 0.5)
    assert telemetry.sites.north_sd_rad == pytest.approx(0.01 * DEG)
    stated, pad = telemetry.places
    assert (stated.name, stated.time_s, stated.sd_m) == ("attitude_prior", 0.0, 100.0)
    assert (pad.name, pad.latitude_rad, pad.sd_m) == ("pad", pytest.approx(33.0 * DEG), 2.0)
    assert np.isnan([stated.height_m, pad.height_m]).all()


def test_no_tracker_is_called_as_all_sites_together(folder):
    folder.refused([GNSS.replace("gnss.gps", "gnss.sites"), BALLISTIC], "given-twice", "sites")


# on the pad


def test_a_rest_is_read_and_stands_for_an_attitude(folder):
    start = "[start]\nat_rest = [1.0, 3.0]\nazimuth_deg = 90.0\n"
    telemetry = folder.read(GNSS, TRIADS, start)
    assert telemetry.attitude_prior is None
    assert telemetry.start.at_rest == (1.0, 3.0)
    assert (telemetry.start.azimuth_rad, telemetry.start.azimuth_sd_rad) == pytest.approx((90.0 * DEG, 2.0 * DEG))


def test_what_is_wrong_with_a_rest(folder):
    folder.refused([GNSS, BALLISTIC, "[start]\nat_rest = [1.0, 3.0]\n"], "keys-conflict", "at_rest")
    folder.refused([GNSS, TRIADS, PRIOR, "[start]\nat_rest = [3.0, 1.0]\n"], "keys-conflict", "at_rest")
    folder.refused([GNSS, TRIADS, PRIOR, "[start]\nazimuth_deg = 10.0\n"], "keys-conflict", "at_rest")


# trackers that measure a part of a position

SITE = 'file = "site.csv"\nlatitude_deg = 32.5\nlongitude_deg = -107.0\nheight_m = 1200.0\n'


def test_a_telescope_with_noise_of_its_own_and_a_doppler_station(folder):
    az, el = 350.0 + T, 40.0 + T
    folder.table("site.csv", "t_s,az_deg,el_deg,el_sd_deg", T, az, el, np.where(T > 5.0, 0.01, np.nan))
    folder.table("doppler.csv", "t_s,rr", T, 1000.0 - 10.0 * T)
    telescope = f'[radars.eye]\n{SITE}measures = ["az", "el"]\n'
    doppler = f'[radars.ear]\n{SITE}measures = ["range_rate"]\n'.replace("site.csv", "doppler.csv")
    columns = 'columns = { range_rate = { column = "rr", unit = "kmh" } }\n'
    radars = folder.read(GNSS, BALLISTIC, telescope, doppler, columns).radars
    eye, ear = radars["eye"], radars["ear"]
    assert np.isnan(eye.range_az_el[:, 0]).all()
    np.testing.assert_allclose(eye.range_az_el[:, 2], el * DEG)
    assert eye.range_rate_mps is None
    assert np.isnan(eye.sd[0]).all()
    assert eye.sd[-1, 2] == pytest.approx(0.01 * DEG)
    assert np.isnan(ear.range_az_el).all()
    np.testing.assert_allclose(ear.range_rate_mps, (1000.0 - 10.0 * T) / 3.6)


def test_what_is_wrong_with_a_part(folder):
    folder.table("site.csv", "t_s,az_deg,el_deg,el_sd_deg", T, T, 40.0 + T, 0.0 * T)
    eye = f"[radars.eye]\n{SITE}"
    # a column that is not there is refused unless the file says that it is not measured
    folder.refused([GNSS, BALLISTIC, eye], "column-missing", "range_m", kind=GateError)
    folder.refused([GNSS, BALLISTIC, eye, 'measures = ["az", "el"]\n'], "value-range", "el_sd", kind=GateError)
    folder.refused([GNSS, BALLISTIC, eye, "measures = []\n"], "key-value", "measures")


def test_a_rest_with_a_large_bias_is_found(folder):
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 8.0, 0.05)
    noise = 0.02 * rng.standard_normal((6, len(t)))
    folder.table("imu.csv", "t_s,fx,fy,fz,wx,wy,wz", t, 9.8 + noise[0], *noise[1:3], 2.0 + noise[3], *noise[4:])
    fixes = np.full(len(T), 1400.0)
    folder.table("gps.csv", "t_s,lat_deg,lon_deg,alt_m", T, LAT + 0 * T, LON + 0 * T, fixes)
    telemetry = folder.read(GNSS, TRIADS, PRIOR)
    assert "rest-found" in findings(telemetry, "start")
    assert "bias-beyond-data-sheet" in findings(telemetry, "rates")
    assert "rest-found" not in findings(folder.read(GNSS, TRIADS, "[start]\nat_rest = [0.5, 6.0]\n"), "start")
