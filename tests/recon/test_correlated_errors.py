"""Errors of trackers that last several rows: estimated with all rows, or thinned by component and span."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel.checks import ConfigError
from flightmodel.config import parse_section
from flightmodel.gate import oversampled
from flightmodel.instruments import GnssEntry, RadarEntry
from flightmodel.tables import ThinnedSpan, spaced, spacing_s
from recon.measurements import radar_instrument
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.setup import build_problem, track_points

from .ballistic_flight import SITES, SPEC, fly, squared_errors, watch

SITE = {"file": "r.csv", "latitude_deg": 10.0, "longitude_deg": 20.0, "height_m": 30.0}
LOOKED_AT_S = (10.0, 25.0, 45.0, 65.0)
ANGLES = (ThinnedSpan(every_s=1.0, components=("az", "el")),)
# range and angles that err for seconds more than they scatter, read five times a second
SLOW = [
    replace(
        site, range_sd_m=2.0, range_wander_sd_m=25.0, range_wander_time_constant_s=2.0, wander_sd_rad=3e-4,
        wander_time_constant_s=2.0,
    )
    for site in SITES
]  # fmt: skip


def every(value):
    return RadarEntry.model_validate(SITE | {"every_s": value}).every_s


def test_every_form_is_read():
    assert RadarEntry.model_validate(SITE).every_s == (ThinnedSpan(every_s=0.0),)
    assert every(4.0) == (ThinnedSpan(every_s=4.0),)
    assert every({"az": 4.0, "el": 2.0}) == (
        ThinnedSpan(every_s=4.0, components=("az",)),
        ThinnedSpan(every_s=2.0, components=("el",)),
    )
    t = np.arange(0.0, 10.0)
    spans = every([{"every_s": 4.0}, {"from_s": 3.0, "to_s": 6.0, "components": ["range"], "every_s": 0.0}])
    assert list(spacing_s(spans, t, "range")) == [4.0] * 3 + [0.0] * 3 + [4.0] * 4
    assert (spacing_s(spans, t, "az") == 4.0).all()
    assert list(t[spaced(t, spacing_s(spans, t, "range"))]) == [0.0, 3.0, 4.0, 5.0, 9.0]
    assert list(t[spaced(t, spacing_s(spans, t, "az"))]) == [0.0, 4.0, 8.0]


def test_all_faults_of_a_table_are_named_at_once():
    bad = [
        {"every_s": -1.0},
        {"every_s": 1.0, "from_s": 9.0, "to_s": 3.0},
        {"every_s": 1.0, "components": ["height", "azimuth"]},
        {"every_s": 1.0, "until_s": 4.0},
    ]
    with pytest.raises(ConfigError) as refused:
        parse_section(RadarEntry, SITE | {"every_s": bad}, "flight.toml")
    text = str(refused.value)
    for part in ("every_s.0.every_s", "every_s.1.to_s", "every_s.2.components.1", "every_s.3.until_s"):
        assert part in text
    with pytest.raises(ConfigError, match="not among what is measured here: az, el"):
        parse_section(RadarEntry, SITE | {"measures": ["az", "el"], "every_s": {"range": 1.0}}, "flight.toml")
    with pytest.raises(ConfigError, match="not among what is measured here: position"):
        parse_section(GnssEntry, {"file": "g.csv", "velocity": False, "every_s": {"velocity": 1.0}}, "flight.toml")


def test_what_is_thinned_is_said():
    t = 0.25 * np.arange(40)
    (finding,) = oversampled("r", t, ANGLES, ("range", "az", "el"))
    assert finding.what == (
        "30 (az), 30 (el) of 40 rows lie closer than every_s = 1 s: they are predicted and not used"
    )
    (finding,) = oversampled("r", t, (ThinnedSpan(every_s=1.0),), ("range", "az", "el"))
    assert finding.what.startswith("30 of 40 rows lie closer than every_s = 1 s")


def test_components_thinned_alike_share_rows_and_the_track_stays_whole():
    t, states = fly(0, end_s=30.0)
    telemetry = watch(t, states, 0)
    thinned = replace(telemetry, radars={n: replace(r, every_s=ANGLES) for n, r in telemetry.radars.items()})
    record = thinned.radars["near"]
    one = radar_instrument("near", record, np.zeros(3))
    assert len(one.time_s) == 2 * len(record.time_s)
    assert (one.count == np.where(one.spacing_s == 0.0, 1, 2)).all()
    plain = build_problem(telemetry, Settings(output_rate_hz=1.0), None)
    problem = build_problem(thinned, Settings(output_rate_hz=1.0), None)
    for a, b in zip(track_points(problem.instruments), track_points(plain.instruments), strict=True):
        assert np.array_equal(a, b)
    used = problem.observed.usable
    ranges, angles = used & (problem.group == 0), used & (problem.group == 1)
    assert ranges.sum() == len(plain.row)
    assert angles.sum() == pytest.approx(len(plain.row) / 5.0, abs=4.0)
    coarse = problem.thinned(2.0)[0]
    assert {*coarse.group} == {0, 1}
    held = build_problem(thinned, Settings(output_rate_hz=1.0, hold_out_every=2), None).observed.usable
    assert (held & ranges).sum() == pytest.approx(ranges.sum() / 2, abs=2)
    assert (held & angles).sum() == pytest.approx(angles.sum() / 2, abs=2)


def test_rows_of_their_own_give_the_same_trajectory():
    """Range and angles in two rows are two updates by independent noise: the same answer as one of all three."""
    t, states = fly(0, end_s=30.0)
    telemetry = watch(t, states, 0)
    split = (ThinnedSpan(every_s=1e-3, components=("range",)),)
    apart = replace(telemetry, radars={n: replace(r, every_s=split) for n, r in telemetry.radars.items()})
    settings = Settings(output_rate_hz=2.0, gate_probability=1.0 - 1e-12)
    one, two = (reconstruct(each, settings).smoothed for each in (telemetry, apart))
    sd = one.sd()[:, :3]
    assert (np.abs(one.position_ecef_m - two.position_ecef_m) < 1e-3 * sd).all()
    assert np.allclose(two.sd()[:, :3], sd, rtol=1e-4)


def test_correlated_errors_of_range_and_angles_are_as_large_as_stated():
    """All rows used, slow errors as states: the errors meet the covariance; taken for white noise they do not."""
    runs, modelled, white = 8, [], []
    for seed in range(runs):
        t, states = fly(seed, end_s=70.0)
        telemetry = watch(t, states, seed, SLOW)
        modelled.append(
            squared_errors(reconstruct(telemetry, Settings(output_rate_hz=2.0)).smoothed, states, LOOKED_AT_S)
        )
        if seed < 3:
            as_white = {name: without_wander(r) for name, r in telemetry.radars.items()}
            as_white = reconstruct(replace(telemetry, radars=as_white), Settings(output_rate_hz=2.0))
            white.append(squared_errors(as_white.smoothed, states, LOOKED_AT_S))
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * runs) / runs
    mean = np.mean(modelled, axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean
    assert np.mean(white) > 2.0 * np.mean(modelled)


def test_the_peak_of_a_reentry_is_lost_by_thinning_and_kept_by_states():
    """Half of the errors 2 s long, rows five times a second: at 4 s the drag's change about its peak is not sampled."""
    spec = replace(SPEC, drag_area_per_mass_m2pkg=0.008, drag_sd=0.7, drag_time_constant_s=20.0, side_sd=0.01)
    slow = [replace(s, angle_sd_rad=3e-5, range_wander_sd_m=8.0, wander_sd_rad=1e-4) for s in SLOW]
    off: dict[str, list[float]] = {"states": [], "thinned": []}
    for seed in range(300, 306):
        t, states = fly(seed, 100.0, spec, 125e3, (-800.0, 6500.0, 2200.0))
        velocity = np.array([s.velocity_ecef_mps for s in states])[::10]
        telemetry = replace(watch(t, states, seed, slow), motion=spec)
        four = (ThinnedSpan(every_s=4.0),)
        thinned = {n: replace(without_wander(r), every_s=four) for n, r in telemetry.radars.items()}
        for name, each in {"states": telemetry, "thinned": replace(telemetry, radars=thinned)}.items():
            found = reconstruct(each, Settings(output_rate_hz=2.0)).smoothed
            on = np.isin(np.round(20.0 * found.time_s), np.round(20.0 * t[::10]))
            off[name].append(peak(found.time_s[on], found.velocity_ecef_mps[on]) / peak(t[::10], velocity) - 1.0)
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in off.items()}
    assert rms["states"] < 0.04
    assert rms["thinned"] > 1.5 * rms["states"]


def without_wander(record):
    """The same readings, of which all error is stated as white noise."""
    s = record.spec
    range_sd, angle_sd = np.hypot(s.range_sd_m, s.range_wander_sd_m), np.hypot(s.angle_sd_rad, s.wander_sd_rad)
    white = replace(s, range_sd_m=range_sd, angle_sd_rad=angle_sd, range_wander_sd_m=0.0, wander_sd_rad=0.0)
    return replace(record, spec=white)


def peak(time_s, velocity_mps):
    """Largest rate of change of a velocity (n, 3) away from the ends, m/s^2."""
    size = np.linalg.norm(np.gradient(velocity_mps, time_s, axis=0), axis=1)
    return size[(time_s > 5.0) & (time_s < 92.0)].max()


def test_engines_agree_on_slow_errors_and_rows_apart():
    t, states = fly(0, end_s=20.0)
    telemetry = watch(t, states, 0, SLOW)
    radars = {n: replace(r, every_s=ANGLES) for n, r in telemetry.radars.items()}
    settings = Settings(output_rate_hz=1.0)
    one, two = (
        reconstruct(replace(telemetry, radars=radars), replace(settings, engine=engine)).smoothed
        for engine in (settings.engine, "filterpy")
    )
    sd = one.sd()[:, :3]
    assert (np.abs(one.position_ecef_m - two.position_ecef_m) < 1e-3 * sd).all()
    assert np.allclose(two.sd()[:, :3], sd, rtol=1e-4)
