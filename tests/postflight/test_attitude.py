"""The check of the attitude in a run: what is written, what is said, and when it is no independent check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from postflight.flight import Flight
from postflight.reconstruction import DEPENDENCE, attitude_table, check_attitude, reconstruction_from
from postflight.run_folder import attitude_summary
from recon.estimate import estimate
from recon.fault_isolation import isolate_faults
from recon.settings import Settings

SETTINGS = Settings(output_rate_hz=10.0)


@pytest.fixture(scope="module")
def telemetry(mini_flight):
    return mini_flight(3)


@pytest.fixture(scope="module")
def bet(telemetry):
    return estimate(telemetry, SETTINGS)


@pytest.fixture(scope="module")
def check(telemetry, bet):
    return check_attitude(telemetry, bet)


def turned(telemetry, angle_deg):
    """Telemetry whose magnetometer is mounted otherwise than flight.toml says."""
    record = telemetry.magnetometer
    turn = rotations.dcm_from_q(rotations.exp(np.deg2rad([angle_deg, 0.0, 0.0])))
    spec = replace(record.spec, dcm_body_sensor=turn @ record.spec.dcm_body_sensor)
    return replace(telemetry, magnetometer=replace(record, spec=spec))


def test_a_good_flight_passes_and_the_check_is_independent(check, telemetry, bet):
    assert all(v.passed for v in check.consistency_checks), check.consistency_checks
    assert check.dependence == ""
    story = attitude_summary(check)
    assert story["passed"]
    assert story["independent"]
    assert story["words"] == check.remark
    flight = replace(reconstruction_from(Flight(telemetry), bet), attitude=check)
    assert set(check.consistency_checks) <= set(flight.consistency_checks)


def test_table_is_the_trajectory_turned_by_the_difference(check, bet):
    table = attitude_table(check, bet)
    columns = [f"difference_{a}_body_deg" for a in "xyz"]
    path = bet.smoothed
    k = np.flatnonzero(np.isin(np.round(path.time_s, 6), np.round(table.t_s, 6)))
    assert len(k) == len(table) > 250
    q = rotations.boxplus(path.q_ecef_body[k], np.deg2rad(table[columns].to_numpy()))
    latitude, longitude, _ = earth.geodetic_from_ecef(path.position_ecef_m[k])
    dcm = earth.dcm_ned_ecef(latitude, longitude) @ rotations.dcm_from_q(q)
    assert np.allclose(np.sin(np.deg2rad(-table.pitch_ned_deg)), dcm[:, 2, 0], atol=1e-9)
    yaw = np.deg2rad(table.yaw_ned_deg) - np.arctan2(dcm[:, 1, 0], dcm[:, 0, 0])
    assert np.allclose(np.sin(yaw), 0.0, atol=1e-7)
    for a in "xyz":
        both = np.hypot(table[f"independent_{a}_body_sd_deg"], table[f"bet_{a}_body_sd_deg"])
        assert np.allclose(both, table[f"difference_{a}_body_sd_deg"])


def test_a_magnetometer_that_was_turned_is_named(telemetry, bet):
    found = check_attitude(turned(telemetry, 15.0), bet)
    red = [v for v in found.consistency_checks if not v.passed]
    assert red
    assert attitude_summary(found)["passed"] is False
    first = isolate_faults(tuple(red), ())[0]
    assert first.code == "attitude"
    assert "magnetometer" in first


@pytest.mark.parametrize("how", ["start", "filter"])
def test_dependence_of_the_trajectory_on_the_same_sensors_is_stated(telemetry, bet, how):
    if how == "start":
        found = check_attitude(replace(telemetry, attitude_prior=None), bet)
    else:
        used = dict(bet.provenance["settings"]) | {"attitude_sensors": True}
        found = check_attitude(telemetry, replace(bet, provenance=bet.provenance | {"settings": used}))
    assert found.dependence == how
    assert DEPENDENCE[how] in found.remark
    assert found.consistency_checks[0].remark == found.remark
    assert attitude_summary(found)["independent"] is False


def test_without_sensors_there_is_no_check_and_without_light_a_finding(telemetry, bet):
    assert check_attitude(replace(telemetry, sun=None), bet) is None
    dark = replace(
        telemetry, sun=replace(telemetry.sun, az_el_head_rad=np.full_like(telemetry.sun.az_el_head_rad, np.nan))
    )
    found = check_attitude(dark, bet)
    assert found.comparison is None
    assert not found.consistency_checks
    assert [f.code for f in found.findings] == ["attitude-check-missing"]
    assert attitude_summary(found)["passed"] is None
    assert attitude_summary(None) is None
