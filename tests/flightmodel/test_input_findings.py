"""Findings on fixes that a receiver cannot have followed, and on attitudes that a filter is not linear about."""

import numpy as np
import pytest

from flightmodel.flightfolder import read_flight
from tests.refusing import numbers_in

HEAD = 'name = "boost"\nt0_utc = "2024-03-23T18:54:37Z"\n'
GNSS = '[gnss.gps]\nfile = "gps.csv"\nheight_is = "ellipsoid"\n'
TRIADS = """\
[sensors.accelerometer]
file = "imu.csv"
mount = "body"
columns = { ax = { column = "fx", unit = "g" }, ay = { column = "fy", unit = "g" }, az = { column = "fz", unit = "g" } }
[sensors.rates]
file = "imu.csv"
columns = { p = { column = "wx", unit = "degps" }, q = { column = "wx", unit = "degps" }, r = { column = "wx", unit = "degps" } }
"""  # noqa: E501
PRIOR = "[attitude_prior]\nt_s = 0.0\nazimuth_deg = 30.0\nelevation_deg = 80.0\nroll_deg = 10.0\nsd_deg = {}\n"
BALLISTIC = '[motion]\nmodel = "ballistic"\ndrag_area_per_mass_m2pkg = 0.01\n'


@pytest.fixture
def findings(tmp_path):
    """Findings by code of a rocket that burns from 2 to 5 s with so many g, and jerks at 12 s."""

    def read(boost_g, *sections, sd=3.0):
        t = np.round(0.02 * np.arange(1000), 2)
        force = np.where((t >= 2.0) & (t < 5.0), boost_g, 0.5)
        force = np.where(np.abs(t - 12.0) < 0.05, 30.0, force) + 0.01 * np.sin(31.0 * t)
        rows = [f"{a},{f},0.01,0.02,{np.sin(a)}" for a, f in zip(t, force, strict=True)]
        (tmp_path / "imu.csv").write_text("\n".join(["t_s,fx,fy,fz,wx", *rows]))
        fixes = [f"{a},32.9,{-106.9 + 1e-5 * a},{1400 + 10 * a}" for a in np.arange(0.5, 19.0, 1.0)]
        (tmp_path / "gps.csv").write_text("\n".join(["t_s,lat_deg,lon_deg,alt_m", *fixes]))
        (tmp_path / "flight.toml").write_text("\n".join([HEAD, *sections, TRIADS, PRIOR.format(sd)]))
        return {f.code: f for f in read_flight(tmp_path).findings}

    return read


def test_fixes_at_more_than_a_receiver_follows_are_named(findings):
    found = findings(9.0, GNSS)["fixes-beyond-dynamics"]
    # at 2.5 s half of the second before was at 9 g, at 5.5 s again; a jerk of 0.1 s is none
    assert (found.start_s, found.end_s) == (2.5, 5.5)
    assert numbers_in(found.what)[:4] == [4.0, 19.0, 4.0, 9.0]
    assert found.source == "gps"


@pytest.mark.parametrize("sections", [(GNSS + "most_g = 20.0\n",), (GNSS, BALLISTIC)])
def test_a_receiver_made_for_it_and_a_flight_without_inertial_sensors_have_no_such_finding(sections, findings):
    assert "fixes-beyond-dynamics" not in findings(9.0, *sections)


def test_gentle_flights_have_no_such_finding(findings):
    assert not {"fixes-beyond-dynamics", "attitude-wide"} & set(findings(3.0, GNSS))


def test_an_attitude_that_is_hardly_known_is_named(findings):
    found = findings(3.0, GNSS, sd="[180.0, 4.0, 4.0]")["attitude-wide"]
    assert numbers_in(found.what)[:2] == [180.0, 30.0]
    assert "body x" in found.what
