"""Errors that all radar sites share: in the covariance where stated, named where a place or a receiver differs."""

import re
from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth
from flightmodel.instruments import BarometerSpec, GnssSpec, SitesSpec
from flightmodel.telemetry import KnownPlace
from recon import survey
from recon.estimate import estimate
from recon.fault_isolation import isolate_faults
from recon.reconstruct import reconstruct
from recon.settings import Settings
from tests.recon.conftest import SITES, measure_barometer, measure_gnss

DEG = np.pi / 180.0
QUICK = Settings(output_rate_hz=2.0)
PLANTED = {
    "survey north": {"latitude_rad": 0.01 * DEG},
    "survey east": {"longitude_rad": -0.01 * DEG},
    "height datum": {"height_m": 30.0},
    "north": {"azimuth": 0.05 * DEG},
}


def resited(telemetry, latitude_rad=0.0, longitude_rad=0.0, height_m=0.0, azimuth=0.0):
    """Telemetry whose sites are stated elsewhere than they stand; readings whose azimuths start elsewhere."""
    radars = {}
    for name, record in telemetry.radars.items():
        s = record.spec
        site = replace(
            s,
            latitude_rad=s.latitude_rad + latitude_rad,
            longitude_rad=s.longitude_rad + longitude_rad,
            height_m=s.height_m + height_m,
        )
        radars[name] = replace(record, spec=site, range_az_el=record.range_az_el + np.array([0.0, azimuth, 0.0]))
    return replace(telemetry, radars=radars)


def known_places(truth, sd_m=5.0):
    """Where the datum was, to `sd_m`, at two times."""
    at = np.array([112.0, 150.0])
    path = truth.trajectory(at)
    rng = np.random.default_rng(5)
    out = []
    for t, point in zip(at, path.position_ecef_m, strict=True):
        lat, lon, height = (float(x) for x in earth.geodetic_from_ecef(point + sd_m * rng.standard_normal(3)))
        out.append(KnownPlace(f"p{t:.0f}", float(t), lat, lon, height, sd_m, sd_m))
    return tuple(out)


def failed(solution):
    return {(v.code, v.component) for v in solution.consistency_checks if not v.passed}


def test_places_of_a_sound_flight_pass(mini_truth, mini_sense):
    telemetry = replace(mini_sense(3)[0], places=known_places(mini_truth))
    solution = reconstruct(telemetry, QUICK)
    checks = [v for v in solution.consistency_checks if v.code == "place"]
    assert len(checks) == 2
    assert all(v.passed for v in checks)
    # the states that stand by to name an error do not move the answer
    plain = reconstruct(replace(telemetry, places=()), QUICK)
    apart = np.abs(plain.smoothed.position_ecef_m - solution.smoothed.position_ecef_m)
    assert apart.max() < 1e-3


@pytest.mark.parametrize("cause", PLANTED)
def test_a_common_error_is_named_by_known_places(mini_truth, mini_sense, cause):
    telemetry = replace(resited(mini_sense(4)[0], **PLANTED[cause]), places=known_places(mini_truth))
    solution = reconstruct(telemetry, QUICK)
    red = failed(solution)
    assert ("place", cause) in red
    # a shift no residual shows; two azimuths turned about two sites contradict the ranges a little
    assert cause == "north" or red == {("place", cause)}
    # the size of what was planted, stated minus true: m, deg
    size = {"survey north": 1110.0, "survey east": -935.0, "height datum": 30.0, "north": 0.05}[cause]
    remark = next(v.remark for v in solution.consistency_checks if v.component == cause)
    found = float(re.search(rf"(?<!survey ){cause} ([-+][\d.e+]+)", remark)[1])
    assert found == pytest.approx(size, rel=0.25)
    suspects = isolate_faults(solution.consistency_checks, solution.left_out)
    assert [(s.code, s.sources) for s in suspects][:1] == [("sites", ("sites",))]


def test_one_place_without_height_shows_a_latitude(mini_truth, mini_sense):
    place = replace(known_places(mini_truth)[0], height_m=np.nan, sd_m=100.0)
    telemetry = replace(resited(mini_sense(5)[0], latitude_rad=0.01 * DEG), places=(place,))
    assert failed(reconstruct(telemetry, QUICK)) == {("place", "survey north")}


def test_two_errors_at_once_are_not_taken_for_one(mini_truth, mini_sense):
    telemetry = resited(mini_sense(6)[0], latitude_rad=0.01 * DEG, height_m=300.0)
    telemetry = replace(telemetry, places=known_places(mini_truth))
    assert failed(reconstruct(telemetry, QUICK)) == {("place", "")}


@pytest.mark.parametrize("cause", ["survey north", "height datum"])
def test_a_receiver_names_the_sites_not_itself(mini_truth, mini_sense, cause):
    spec = GnssSpec("receiver", np.array([-0.7, 0.2, 0.9]), 3.0, 5.0, 0.2, 0.3)
    fixes = measure_gnss(mini_truth, spec, np.arange(100.5, 158.0, 1.0), np.random.default_rng(8))
    telemetry = replace(resited(mini_sense(7)[0], **PLANTED[cause]), gnss={"receiver": fixes})
    solution = reconstruct(telemetry, QUICK)
    assert ("sites", cause) in failed(solution)
    assert isolate_faults(solution.consistency_checks, solution.left_out)[0].code == "sites"


def test_a_barometer_shows_the_height_datum(mini_truth, mini_sense):
    spec = BarometerSpec("baro", 5.0, 4.0, 0.0, 0.0, 30.0, 0.0)
    heights = measure_barometer(mini_truth, spec, np.arange(100.5, 158.0, 1.0), np.random.default_rng(9))
    telemetry = replace(resited(mini_sense(8)[0], height_m=35.0), barometers={"baro": heights})
    assert ("sites", "height datum") in failed(reconstruct(telemetry, QUICK))


def test_stated_errors_of_the_sites_are_in_the_covariance(mini_truth, mini_sense):
    """Flights whose sites err as stated, own and common: errors at mid-flight against their covariance."""
    common = SitesSpec("sites", 60.0, 80.0, 0.02 * DEG)
    own = {"survey_sd_m": 30.0, "height_sd_m": 40.0, "north_sd_rad": 0.01 * DEG}
    squares, plain = [], []
    for seed in range(12):
        rng = np.random.default_rng([seed, 77])
        telemetry = mini_sense(seed)[0]
        east, north, up, turn = rng.standard_normal(4) * [60.0, 60.0, 80.0, 0.02 * DEG]
        radars = {}
        for name, record in telemetry.radars.items():
            e = rng.standard_normal(4) * [30.0, 30.0, 40.0, 0.01 * DEG] + [east, north, up, turn]
            s = record.spec
            true = earth.ecef_from_geodetic(s.latitude_rad, s.longitude_rad, s.height_m)
            stated = true + earth.dcm_ned_ecef(s.latitude_rad, s.longitude_rad).T @ [e[1], e[0], -e[2]]
            lat, lon, height = (float(x) for x in earth.geodetic_from_ecef(stated))
            site = replace(s, latitude_rad=lat, longitude_rad=lon, height_m=height, **own)
            radars[name] = replace(record, spec=site, range_az_el=record.range_az_el + np.array([0.0, e[3], 0.0]))
        bet = estimate(replace(telemetry, radars=radars, sites=common), QUICK).smoothed
        k = len(bet.time_s) // 2
        off = (bet.position_ecef_m - mini_truth.trajectory(bet.time_s).position_ecef_m)[k]
        squares.append(off @ np.linalg.solve(bet.covariance[k, :3, :3], off))
        plain.append(np.linalg.norm(off))
    from scipy.stats import chi2

    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(squares))
    assert low < sum(squares) < high
    assert np.mean(plain) > 50.0  # the errors are alive


def test_what_is_not_stated_is_said(mini_sense):
    telemetry = mini_sense(1)[0]
    lines = survey.rests_on(telemetry, QUICK)
    assert len(lines) == 3
    assert all("not stated" in line and SITES[0].name in line for line in lines)
    stated = replace(telemetry, sites=SitesSpec("sites", 0.5, 1.0, 0.003 * DEG))
    position, height, azimuth = survey.rests_on(stated, QUICK)
    assert "0.5 m common" in position
    assert "1 m common" in height
    assert "0.003 deg common" in azimuth
