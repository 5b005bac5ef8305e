"""Trackers that contradict each other: the uncertainty grows to hold both answers, and the words say who."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from flightmodel.telemetry import RadarRecord
from flightmodel.trajectory import difference
from recon.consistency import consistency_check
from recon.fault_isolation import LeftOut, denied_findings, denied_points, edited_with_denied, is_about, suspects
from recon.reconstruct import reconstruct, reconstruct_once
from recon.settings import Settings

FAST = Settings(output_rate_hz=5.0)


def spoiled(telemetry, name, azimuth=0.0, seconds=0.0, noise=0.0):
    """Telemetry with one radar's azimuth turned, its tags shifted or its noise grown (to the last by ``noise`` sd)."""
    record = telemetry.radars[name]
    site, track = record.site, record.range_az_el.copy()
    track[:, 1] += azimuth
    sd = np.array([site.range_sd_m, site.angle_sd_rad / np.cos(0.8), site.angle_sd_rad])
    track += noise * sd * np.random.default_rng(1).standard_normal(track.shape)
    changed = RadarRecord(site, record.time_s + seconds, track, record.point)
    return replace(telemetry, radars=telemetry.radars | {name: changed})


def nees(trajectory, truth):
    d = difference(trajectory, truth.trajectory(trajectory.time_s))[:, :3]
    return np.einsum("ni,ni->n", d, np.linalg.solve(trajectory.covariance[:, :3, :3], d[..., None])[..., 0])


@pytest.mark.parametrize(("name", "before_it"), [("north", 100.0), ("west", 0.0)])
def test_azimuth_bias_far_beyond_its_sd_is_paid_for(mini_sense, mini_truth, name, before_it):
    """0.1 deg where 0.005 or less is stated: the filter keeps to north, and the truth is inside the answer anyhow."""
    telemetry, _ = mini_sense(40)
    wrong = spoiled(telemetry, name, azimuth=np.deg2rad(0.1))
    before, after = reconstruct_once(wrong, FAST), reconstruct(wrong, FAST)
    assert np.array_equal(before.smoothed.position_ecef_m, after.smoothed.position_ecef_m)
    assert any(not v.passed for v in after.consistency_checks)
    assert max(s.apart_m for s in after.left_out) > 50.0
    assert nees(after.smoothed, mini_truth).mean() < 12.0
    assert nees(before.smoothed, mini_truth).mean() > before_it
    assert [f.source for f in after.findings if "enlarged" in f.what] == ["north"]
    words = suspects(after.consistency_checks, after.left_out)[0]
    assert name in words


def test_good_flights_are_not_run_again(mini_sense):
    telemetry, _ = mini_sense(41)
    found = reconstruct(telemetry, FAST)
    assert not found.left_out
    assert not suspects(found.consistency_checks, found.left_out)
    assert np.array_equal(found.smoothed.covariance, reconstruct_once(telemetry, FAST).smoothed.covariance)


def test_late_time_tags_of_one_radar_are_laid_on_it(mini_sense, mini_truth):
    telemetry, _ = mini_sense(42)
    found = reconstruct(spoiled(telemetry, "north", seconds=0.05), FAST)
    words = suspects(found.consistency_checks, found.left_out)[0]
    assert "north" in words
    assert nees(found.smoothed, mini_truth).mean() < 12.0


def test_noise_of_one_radar_is_laid_on_it_and_moves_nothing(mini_sense, mini_truth):
    telemetry, _ = mini_sense(43)
    found = reconstruct(spoiled(telemetry, "west", noise=1.5), FAST)
    words = suspects(found.consistency_checks, found.left_out)[0]
    assert words.startswith("west (")
    assert "without it all else agrees" in words
    assert nees(found.smoothed, mini_truth).mean() < 12.0


def test_a_lone_radar_is_not_left_out(mini_sense):
    telemetry, _ = mini_sense(44)
    lone = replace(telemetry, radars={"north": telemetry.radars["north"]})
    found = reconstruct(spoiled(lone, "north", noise=2.0), FAST)
    assert not found.left_out
    assert "a second tracker would tell" in suspects(found.consistency_checks, found.left_out)[0]


def test_wrong_mount_is_laid_on_the_inertial_sensors(mini_sense):
    wrong = np.zeros(9)
    wrong[7] = np.deg2rad(2.0)
    telemetry, _ = mini_sense(802, accelerometer_errors=wrong)
    found = reconstruct(telemetry, FAST)
    words = " ".join(suspects(found.consistency_checks, found.left_out))
    assert "accelerometer mount" in words


# ------------------------------------------------------------------------------------------------- sentences alone


def red(name, words="bad", value=9.0):
    return consistency_check("test", name, value, 0.0, 3.0, "good", words)


def test_names_of_verdicts_are_told_apart():
    assert is_about(red("NIS north"), "north")
    assert is_about(red("whiteness north azimuth"), "north")
    assert not is_about(red("whiteness northern azimuth"), "north")
    assert not is_about(red("filter-smoother position"), "position")
    assert not is_about(red("sounding wind"), "wind")


def test_one_cure_names_the_tracker_and_nothing_else():
    consistency_checks = (
        red("NIS west", "large: noise"),
        red("data sheet accelerometer", "accelerometer bias x is larger"),
    )
    left_out = (LeftOut("north", (consistency_checks[0],)), LeftOut("west", ()))
    assert suspects(consistency_checks, left_out) == ("west (large): without it all else agrees",)


def test_two_cures_are_a_contradiction():
    consistency_checks = (red("edited west", "100 of 200 points edited: it and the rest"),)
    left_out = (LeftOut("north", (), 300.0, True, 1.0, 2.0), LeftOut("west", ()))
    words = suspects(consistency_checks, left_out)[0]
    assert words.startswith("north and west contradict each other by up to 300 m")


def test_no_cure_names_what_all_trackers_meet():
    consistency_checks = (
        red("NIS west"),
        red("NIS north"),
        red("data sheet rates", "rates scale y is larger than stated"),
    )
    left_out = (LeftOut("north", consistency_checks), LeftOut("west", None))
    words = suspects(consistency_checks, left_out)
    assert words[0].startswith("inertial sensors or motion")
    assert "rates scale y" in words[0]
    assert len(words) == 1


def test_mounts_are_seen_only_against_each_other():
    words = suspects((red("data sheet rates", "rates mount y is larger than the data sheet allows: check"),), ())[0]
    assert words.startswith("inertial sensors: rates mount y")
    assert "against each other" in words


def test_air_comes_last():
    consistency_checks = (
        red("sounding density", "density at 48 km is far"),
        red("data sheet rates", "rates bias x is larger"),
    )
    words = suspects(consistency_checks, ())
    assert words[0].startswith("inertial sensors: rates bias x")
    assert words[1] == "the air: density at 48 km is far"


def test_motion_is_named_where_nothing_else_is():
    assert suspects((red("filter-smoother attitude"),), ())[0].startswith("the motion")


# ------------------------------------------------------------------------------------------------- points denied


def table(source, time_s, residual):
    rows = {"time_s": time_s, "source": source, "component": "range", "residual": residual, "predicted_sd": 1.0}
    return pd.DataFrame(rows | {"accepted": np.abs(residual) < 5.0, "used": True})


def test_points_of_a_lone_culprit_are_judged_by_the_rest():
    t = np.arange(100.0)
    off = np.where((t >= 20.0) & (t < 30.0) | (t == 50.0), 40.0, 0.5)
    residuals = pd.concat([table("gps", t, 0.0 * t), table("gps2", t, off)])
    judged = residuals.assign(residual=np.concatenate([off, off]))
    thinned = judged[judged.time_s % 2 == 0]
    lone = (LeftOut("gps", (), 300.0, True), LeftOut("gps2", (red("NIS gps"),)))
    for seen in (judged, thinned):
        denied = denied_points(lone, {"gps": seen}, residuals, 0.9999)
        assert list(denied) == ["gps"]
        assert set(range(21, 29)) | {50} <= set(denied["gps"]) <= set(range(19, 31)) | {49, 50, 51}
    denied = denied_points(lone, {"gps": judged}, residuals, 0.9999)
    assert [(f.source, f.start_s, f.end_s) for f in denied_findings(denied)] == [("gps", 20, 29), ("gps", 50, 50)]
    consistency_checks = (consistency_check("edited", "edited gps", 0.0, 0.0, 0.05, "none", "many"), red("NIS gps2"))
    edited, other = edited_with_denied(consistency_checks, residuals, denied)
    assert (edited.value, edited.passed, other) == (pytest.approx(0.11), False, consistency_checks[1])


def test_points_are_denied_to_none_where_two_cure_or_none_lies_apart():
    t = np.arange(10.0)
    far = {name: table(name, t, 40.0 + 0.0 * t) for name in ("north", "west")}
    both = (LeftOut("north", (), 300.0, True), LeftOut("west", (), 300.0, True))
    near = (LeftOut("north", (), 3.0), LeftOut("west", (red("NIS north"),)))
    for left_out in (both, near):
        assert denied_points(left_out, far, pd.concat(far.values()), 0.9999) == {}
