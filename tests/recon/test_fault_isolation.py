"""Trackers that contradict each other: the covariance grows to cover both answers, and hypotheses name the source."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from flightmodel.checks import Check
from flightmodel.telemetry import RadarRecord
from flightmodel.trajectory import difference
from recon.estimate import estimate
from recon.fault_isolation import (
    LeftOut,
    edit_checks_with_rejected,
    is_about,
    isolate_faults,
    rejected_point_findings,
    rejected_points,
)
from recon.reconstruct import reconstruct
from recon.settings import Settings

FAST = Settings(output_rate_hz=5.0)


def spoiled(telemetry, name, azimuth=0.0, seconds=0.0, noise=0.0):
    """Telemetry with one radar's azimuth turned, its tags shifted or its noise grown (to the last by ``noise`` sd)."""
    record = telemetry.radars[name]
    site, track = record.spec, record.range_az_el.copy()
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
    before, after = estimate(wrong, FAST), reconstruct(wrong, FAST)
    assert np.array_equal(before.smoothed.position_ecef_m, after.smoothed.position_ecef_m)
    assert any(not v.passed for v in after.consistency_checks)
    assert max(s.distance_m for s in after.left_out) > 50.0
    assert nees(after.smoothed, mini_truth).mean() < 12.0
    assert nees(before.smoothed, mini_truth).mean() > before_it
    assert [f.source for f in after.findings if f.code == "tracker-inconsistent"] == ["north"]
    assert name in isolate_faults(after.consistency_checks, after.left_out)[0].sources


def test_good_flights_are_not_run_again(mini_sense):
    telemetry, _ = mini_sense(41)
    found = reconstruct(telemetry, FAST)
    assert not found.left_out
    assert not isolate_faults(found.consistency_checks, found.left_out)
    assert np.array_equal(found.smoothed.covariance, estimate(telemetry, FAST).smoothed.covariance)


def test_late_time_tags_of_one_radar_are_laid_on_it(mini_sense, mini_truth):
    telemetry, _ = mini_sense(42)
    found = reconstruct(spoiled(telemetry, "north", seconds=0.05), FAST)
    assert "north" in isolate_faults(found.consistency_checks, found.left_out)[0].sources
    assert nees(found.smoothed, mini_truth).mean() < 12.0


def test_noise_of_one_radar_is_laid_on_it_and_moves_nothing(mini_sense, mini_truth):
    telemetry, _ = mini_sense(43)
    found = reconstruct(spoiled(telemetry, "west", noise=1.5), FAST)
    first = isolate_faults(found.consistency_checks, found.left_out)[0]
    assert (first.code, first.sources) == ("tracker", ("west",))
    assert nees(found.smoothed, mini_truth).mean() < 12.0


def test_a_lone_radar_is_not_left_out(mini_sense):
    telemetry, _ = mini_sense(44)
    lone = replace(telemetry, radars={"north": telemetry.radars["north"]})
    found = reconstruct(spoiled(lone, "north", noise=2.0), FAST)
    assert not found.left_out
    first = isolate_faults(found.consistency_checks, found.left_out)[0]
    assert (first.code, first.sources) == ("tracker-or-motion", ("north",))


def test_wrong_mount_is_laid_on_the_inertial_sensors(mini_sense):
    wrong = np.zeros(9)
    wrong[7] = np.deg2rad(2.0)
    telemetry, _ = mini_sense(802, accelerometer_errors=wrong)
    found = reconstruct(telemetry, FAST)
    hypotheses = isolate_faults(found.consistency_checks, found.left_out)
    assert any("accelerometer" in h.sources and "accelerometer mount" in h for h in hypotheses)


# ------------------------------------------------------------------------------------------------- hypotheses alone


def failed(code, source="", component="", symptom="bad"):
    name = f"{code} {source} {component}".strip()
    return Check.of(code, name, 9.0, 0.0, 3.0, "good", symptom, source=source, component=component)


def codes(checks, left_out=()):
    return [(h.code, h.sources) for h in isolate_faults(tuple(checks), tuple(left_out))]


def test_a_check_is_about_its_own_source_alone():
    assert is_about(failed("nis", "north"), "north")
    assert is_about(failed("whiteness", "north", "azimuth"), "north")
    assert not is_about(failed("whiteness", "northern", "azimuth"), "north")
    assert not is_about(failed("filter-smoother", component="position"), "position")
    assert not is_about(failed("sounding-wind", "wind"), "wind")


def test_one_resolving_exclusion_names_the_tracker_and_nothing_else():
    symptom = "residuals at 99 sd"
    checks = failed("nis", "west", symptom=symptom), failed("data-sheet", "accelerometer", "bias x")
    left_out = LeftOut("north", (checks[0],)), LeftOut("west", ())
    assert codes(checks, left_out) == [("tracker", ("west",))]
    (only,) = isolate_faults(checks, left_out)
    assert symptom in only


def test_two_resolving_exclusions_are_a_contradiction():
    left_out = LeftOut("north", (), 300.0, True, 1.0, 2.0), LeftOut("west", ())
    first = isolate_faults((failed("edited", "west"),), left_out)[0]
    assert (first.code, first.sources) == ("trackers-contradict", ("north", "west"))
    assert "300 m" in first


def test_without_a_resolving_exclusion_what_all_trackers_share_is_named():
    checks = failed("nis", "west"), failed("nis", "north"), failed("data-sheet", "rates", "scale y")
    left_out = LeftOut("north", checks), LeftOut("west", None)
    assert codes(checks, left_out) == [("inertial-or-motion", ("rates",))]


def test_residuals_of_one_tracker_alone_are_said_to_be_that():
    checks = (failed("whiteness", "west", "range"),)
    assert codes(checks, (LeftOut("north", checks), LeftOut("west", checks))) == [("tracker-residuals", ("west",))]


def test_mounts_are_observable_only_relative_to_each_other():
    checks = failed("data-sheet", "rates", "mount y"), failed("data-sheet", "accelerometer", "mount z")
    (only,) = isolate_faults(checks, ())
    assert (only.code, only.sources) == ("inertial-sensors", ("rates", "accelerometer"))
    assert all(f"{c.source} {c.component}" in only for c in checks)


def test_a_clock_lag_is_laid_on_the_inertial_sensors():
    assert codes([failed("clock-lag", component="time bias")]) == [("inertial-sensors", ("accelerometer", "rates"))]


def test_attitude_and_air_come_last():
    symptom = "12 sd at 48 km"
    checks = (
        failed("sounding-density", symptom=symptom), failed("data-sheet", "rates", "bias x"),
        failed("attitude-nees", "magnetometer"), failed("attitude-data-sheet", "sun head 1", "bias az"),
    )  # fmt: skip
    found = isolate_faults(checks, ())
    assert [h.code for h in found] == ["inertial-sensors", "attitude", "air"]
    assert symptom in found[-1]


def test_the_vehicle_comes_before_the_air_where_its_drag_is_farther_off():
    checks = (
        replace(failed("sounding-density", symptom="density"), value=5.0, high=4.0),
        replace(failed("pre-flight-drag"), value=9.0, high=3.0),
    )
    found = isolate_faults(checks, ())
    assert [h.sources for h in found] == [("vehicle", "atmosphere"), ("atmosphere", "vehicle")]


def test_motion_is_named_where_nothing_else_is():
    assert codes([failed("filter-smoother", component="attitude")]) == [("motion", ())]


# ------------------------------------------------------------------------------------------------- points rejected


def table(source, time_s, residual):
    rows = {"time_s": time_s, "source": source, "component": "range", "residual": residual, "predicted_sd": 1.0}
    return pd.DataFrame(rows | {"accepted": np.abs(residual) < 5.0, "used": True})


def test_points_of_the_only_inconsistent_tracker_are_judged_by_the_rest():
    t = np.arange(100.0)
    off = np.where((t >= 20.0) & (t < 30.0) | (t == 50.0), 40.0, 0.5)
    residuals = pd.concat([table("gps", t, 0.0 * t), table("gps2", t, off)])
    judged = residuals.assign(residual=np.concatenate([off, off]))
    thinned = judged[judged.time_s % 2 == 0]
    lone = (LeftOut("gps", (), 300.0, True), LeftOut("gps2", (failed("nis", "gps"),)))
    for seen in (judged, thinned):
        rejected = rejected_points(lone, {"gps": seen}, residuals, 0.9999)
        assert list(rejected) == ["gps"]
        assert set(range(21, 29)) | {50} <= set(rejected["gps"]) <= set(range(19, 31)) | {49, 50, 51}
    rejected = rejected_points(lone, {"gps": judged}, residuals, 0.9999)
    assert [(f.source, f.start_s, f.end_s) for f in rejected_point_findings(rejected)] == [
        ("gps", 20, 29),
        ("gps", 50, 50),
    ]
    consistency_checks = (
        Check.of("edited", "edited gps", 0.0, 0.0, 0.05, "none", "many"),
        failed("nis", "gps2"),
    )
    edited, other = edit_checks_with_rejected(consistency_checks, residuals, rejected)
    assert (edited.value, edited.passed, other) == (pytest.approx(0.11), False, consistency_checks[1])


def test_no_points_are_rejected_where_two_resolve_or_none_is_inconsistent():
    t = np.arange(10.0)
    far = {name: table(name, t, 40.0 + 0.0 * t) for name in ("north", "west")}
    both = (LeftOut("north", (), 300.0, True), LeftOut("west", (), 300.0, True))
    near = (LeftOut("north", (), 3.0), LeftOut("west", (failed("nis", "north"),)))
    for left_out in (both, near):
        assert rejected_points(left_out, far, pd.concat(far.values()), 0.9999) == {}
