"""Recorded flights reconstructed as their flight.toml describes them: verdicts, and tracking that was never used.

Withheld tracking shares the trajectory's slow errors, so its mean square is no chi-square of its count. The band 0.7 to
1.4 of the rms is that of about thirty independent residuals at 99.9 % either way; a few tens is what a flight has.
Lower bounds are lower where a receiver's own filter makes neighbouring fixes smoother than any white noise that also
describes their errors from one second to the next.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel import earth, rotations
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import resample
from recon.consistency import summary
from recon.noise_levels import noise_levels
from recon.reconstruct import reconstruct
from recon.settings import Settings

FLIGHTS = Path(__file__).parents[1] / "data" / "real_flights"
REAL = os.environ.get("POSTFLIGHT_REALDATA")
needs_data = [
    pytest.mark.realdata,
    pytest.mark.slow,
    pytest.mark.skipif(REAL is None, reason="POSTFLIGHT_REALDATA names no folder of recorded flights"),
]
# what an analyst wrote down of a flight's traps, taken out again
ALL_TIMES = (r"(?m)^use_s = .*\n", "")
THRUST_UNSTATED = (r"(?m)^powered_s.*\n", "")
DRAG = "drag_area_per_mass_m2pkg = {:.9f}"
DISTURBED_UNSTATED = (r"(?m)^\[\[motion\.disturbed\]\]\n(.+\n){3}", "")


@pytest.fixture(scope="module")
def fly(tmp_path_factory):
    """``fly(name, *edits, **settings)``: reconstruct a flight, its flight.toml and noise as asked; each but once."""
    flown = {}

    def one(name, *edits, proposed_noise=False, **settings):
        key = (name, edits, proposed_noise, tuple(sorted(settings.items())))
        if key not in flown:
            folder = tmp_path_factory.mktemp(name)
            tables = FLIGHTS / name if any((FLIGHTS / name).glob("*.csv")) else Path(str(REAL)) / name
            for path in tables.glob("*.csv"):
                shutil.copy(path, folder)
            text = (FLIGHTS / name / "flight.toml").read_text()
            for pattern, new in edits:
                text, count = re.subn(pattern, new, text)
                assert count, pattern
            (folder / "flight.toml").write_text(text)
            telemetry, chosen = read_flight(folder), Settings(**settings)
            if proposed_noise:
                telemetry = noise_levels(telemetry, chosen).telemetry
            flown[key] = reconstruct(telemetry, chosen)
        return flown[key]

    return one


def red(flight):
    return {v.name for v in flight.consistency_checks if not v.passed}


def foretold(flight, *sources):
    """Rms normalised residual of withheld measurements by source and component."""
    table = summary(flight.held_out)
    table = table[table.source.isin(sources)] if sources else table
    return dict(zip(table.source + " " + table.component, table.rms_normalised, strict=True))


def heights(flight):
    return flight.smoothed.time_s, earth.geodetic_from_ecef(flight.smoothed.position_ecef_m)[2]


def sd_at(flight, at_s, part):
    k = int(np.argmin(np.abs(flight.smoothed.time_s - at_s)))
    return float(np.linalg.norm(flight.smoothed.sd()[k, part]))


def disturbances(flight):
    return [(f.start_s, f.end_s) for f in flight.findings if f.source == "motion"]


def largest_difference(flight, other):
    """Largest component of the position difference over the first flight's span, in combined standard deviations."""
    a = flight.smoothed
    b = resample(other.smoothed, a.time_s)
    sd = np.sqrt(a.sd()[:, POSITION] ** 2 + b.sd()[:, POSITION] ** 2)
    return float((np.abs(b.position_ecef_m - a.position_ecef_m) / sd).max())


def some_overlap(spans, start, end):
    return any(a < end and start < b for a, b in spans)


POSITION, ATTITUDE = slice(0, 3), slice(6, 9)


# receiver and barometer alone


@pytest.mark.slow
class TestPrometheus:
    def test_every_verdict_is_green(self, fly):
        assert not red(fly("rocketpy_prometheus"))

    @pytest.mark.parametrize("mass", [0.99, 1.01])
    def test_a_mass_that_differs_by_a_hundredth_hardly_moves_it(self, fly, mass):
        other = fly("rocketpy_prometheus", (r"(?m)^drag_area_per_mass_m2pkg = 0\.012$", DRAG.format(0.012 / mass)))
        assert not red(other)
        assert largest_difference(fly("rocketpy_prometheus"), other) < 0.05

    def test_apogee_is_what_the_receiver_itself_says(self, fly):
        t, h = heights(fly("rocketpy_prometheus"))
        # 5524 m above the sea in steps of 1 m, undulation -24 m; 4 m of wander
        assert h.max() == pytest.approx(5500.0, abs=12.0)
        assert t[np.argmax(h)] == pytest.approx(29.0, abs=0.7)

    def test_every_other_fix_is_foretold_by_the_rest(self, fly):
        ratio = foretold(fly("rocketpy_prometheus"), "gps")
        assert len(ratio) == 3
        assert all(0.4 < r < 1.4 for r in ratio.values()), ratio

    def test_three_fixes_of_four_are_foretold(self, fly):
        ratio = foretold(fly("rocketpy_prometheus", hold_out_every=2), "gps")
        assert all(0.7 < r < 1.4 for r in ratio.values()), ratio

    def test_ten_seconds_under_the_drogue_and_before_apogee_are_foretold(self, fly):
        r = fly("rocketpy_prometheus", hold_out_spans_s=((18.0, 28.0), (90.0, 100.0)))
        inside = r.held_out[
            (r.held_out.source == "gps") & (r.held_out.time_s.between(18, 28) | r.held_out.time_s.between(90, 100))
        ]
        z = (inside.residual / inside.predicted_sd).groupby(inside.component).apply(lambda s: np.sqrt(np.mean(s**2)))
        # two holes of ten seconds: each is one error that lasts, so a component has about four independent ones
        low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], 4) / 4)
        assert ((z > low) & (z < high)).all(), z

    def test_barometer_between_its_readings_is_foretold(self, fly):
        assert 0.7 < foretold(fly("rocketpy_prometheus"), "baro")["baro height"] < 1.4

    def test_barometer_never_used_lies_where_its_errors_allow(self, fly):
        """Height by air pressure against height by satellites: independent to the hot day's 6 %."""
        r = fly("rocketpy_prometheus", without=("baro",))
        assert 0.2 < foretold(r, "baro")["baro height"] < 2.2

    def test_thrust_drogue_and_landing_are_found_unstated(self, fly):
        """What powered_s and use_s state is found from the track, and the flight between comes out the same."""
        raw = fly("rocketpy_prometheus", ALL_TIMES, THRUST_UNSTATED)
        found = disturbances(raw)
        assert some_overlap(found, 0.0, 6.0)
        assert some_overlap(found, 28.4, 36.0)
        assert some_overlap(found, 224.0, 229.0)
        assert not some_overlap(found, 45.0, 150.0)
        assert largest_difference(fly("rocketpy_prometheus"), raw) < 3.0


# one radar


class TestBlackBrant:
    pytestmark = needs_data

    def test_only_a_servos_elevation_is_not_white(self, fly):
        """docs/known-limits.md says why."""
        assert red(fly("radar_36353")) <= {"whiteness B elevation"}

    def test_refraction_is_possible_and_without_droop_it_is_not(self, fly):
        """-0.38 +/- 0.08 of refraction, and no word, was what a pedestal that droops looked like."""
        checks = {v.code: v for v in fly("radar_36353").consistency_checks}
        assert checks["physical-range"].passed
        stiff = fly("radar_36353", (r"(?m)^droop_sd_deg.*\n", ""))
        check = next(v for v in stiff.consistency_checks if v.code == "physical-range")
        assert not check.passed
        assert (check.source, check.component) == ("B", "refraction")
        assert "droop" in check.remark

    def test_points_between_are_foretold(self, fly):
        r = fly("radar_36353")
        coast = r.held_out[r.held_out.time_s.between(150.0, 500.0)]
        z2 = ((coast.residual / coast.predicted_sd) ** 2).groupby(coast.component).mean()
        assert (np.sqrt(z2) > 0.7).all(), z2
        assert (np.sqrt(z2) < 1.4).all(), z2

    def test_forty_seconds_of_coast_and_eight_of_entry_are_foretold(self, fly):
        r = fly("radar_36353", hold_out_spans_s=((300.0, 340.0), (500.0, 508.0)))
        for start, end in ((300.0, 340.0), (500.0, 508.0)):
            hole = r.held_out[r.held_out.time_s.between(start, end)]
            z = (hole.residual / hole.predicted_sd).groupby(hole.component).apply(lambda s: np.sqrt(np.mean(s**2)))
            assert (z < 2.2).all(), z  # one hole is about two independent errors: 99.9 % of chi-square of two, 13.8 / 2

    def test_no_acceleration_is_left_over(self, fly):
        assert not disturbances(fly("radar_36353"))

    def test_echoes_gaps_and_loss_are_found_unstated(self, fly):
        """Thrust behind a minute's gap, points that settle, echoes before landing, loss: found, the coast unharmed."""
        stated, raw = fly("radar_36353"), fly("radar_36353", ALL_TIMES, DISTURBED_UNSTATED)
        found = disturbances(raw)
        assert some_overlap(found, 1.65, 60.7)
        assert not some_overlap(found, 100.0, 650.0)
        assert largest_difference(stated, raw) < 3.0
        assert sd_at(raw, 30.0, POSITION) > 5e3

    def test_drag_has_the_history_of_a_body_that_enters_and_opens_a_parachute(self, fly):
        r = fly("radar_36353")
        t, h = heights(r)
        v = r.smoothed.velocity_ecef_mps
        braking = -np.gradient(np.linalg.norm(v, axis=1), t)
        peak = t[(t > 480.0) & (t < 560.0)][np.argmax(braking[(t > 480.0) & (t < 560.0)])]
        assert peak == pytest.approx(523.0, abs=3.0)
        assert h.max() == pytest.approx(293.9e3, abs=0.5e3)


# inertial units


class TestPsas:
    pytestmark = needs_data

    def test_every_verdict_is_green(self, fly):
        assert not red(fly("psas_l12"))

    def test_first_fix_after_half_a_minute_without_one_is_foretold(self, fly):
        """Kilometres off, as dead reckoning through violent shaking is, and as far as its covariance says."""
        table = fly("psas_l12").residuals
        first = table[table.used & (table.time_s > 30.0)].head(3)
        nis = float(((first.residual / first.predicted_sd) ** 2).sum())
        assert nis < chi2.ppf(0.999, 3)
        assert first.predicted_sd.max() > 500.0

    def test_apogee_is_what_the_withheld_receiver_says(self, fly):
        _, h = heights(fly("psas_l12"))
        assert h.max() - 1370.2 == pytest.approx(5103.0, abs=30.0)  # dead reckoning alone: 5626

    def test_a_second_and_a_half_of_fixes_are_foretold(self, fly):
        r = fly("psas_l12", hold_out_spans_s=((31.0, 32.5),))
        ratio = foretold(r, "venus8")
        # 8 m that wander within 10 s are one error per component in these two seconds: 99.9 % of chi-square of one
        assert all(value < 3.3 for value in ratio.values()), ratio

    def test_attitude_after_the_shaking_is_said_to_be_poor(self, fly):
        r = fly("psas_l12")
        assert np.rad2deg(sd_at(r, 0.0, ATTITUDE)) < 25.0
        assert np.rad2deg(sd_at(r, 20.0, ATTITUDE)) > 20.0

    def test_it_stands_still_on_its_pad(self, fly):
        """The rest that reading the flight proposes, stated: 1.4 m/s +/- 4 become a centimetre."""
        loose = fly("psas_l12")
        still = fly("psas_l12", (r"(?m)^\[attitude_prior\]", "[start]\nat_rest = [-4.53, -1.03]\n\n[attitude_prior]"))
        assert not red(still)
        on_pad = still.smoothed.time_s < -1.0
        speed = np.linalg.norm(still.smoothed.velocity_ecef_mps, axis=1)
        assert on_pad.sum() > 30
        assert speed[on_pad].max() < 0.03
        assert sd_at(still, -2.0, slice(3, 6)) < 0.02 < sd_at(loose, -2.0, slice(3, 6))


class TestPiccard:
    pytestmark = needs_data

    def test_receiver_and_sensors_agree(self, fly):
        # two counts of turns, two turns apart, explain receiver and barometer alike (odds of 12 to 1)
        assert red(fly("euroc21_piccard")) <= {"NIS baro", "filter-smoother position", "phase of the spin"}

    def test_proposed_noise_foretells_held_out_fixes(self, fly):
        proposed = fly("euroc21_piccard", proposed_noise=True, hold_out_every=2)
        ratio = foretold(proposed, "gps")
        assert all(0.2 < value < 1.6 for value in ratio.values()), ratio
        assert "held out gps" not in red(proposed)

    def test_a_bad_fix_that_is_held_out_turns_the_check_red(self, fly):
        # proposals from the fixes between make the one at 10.24 s 6 sd wrong
        early = (r"\[11\.0, 68\.0\]", "[9.0, 68.0]")
        proposed = fly("euroc21_piccard", early, proposed_noise=True, hold_out_every=2)
        assert "held out gps" in red(proposed)

    def test_every_other_fix_is_foretold_by_the_rest(self, fly):
        ratio = foretold(fly("euroc21_piccard", hold_out_every=2), "gps")
        # nine fixes whose errors last: between one and nine independent ones
        assert all(0.2 < value < 1.6 for value in ratio.values()), ratio

    def test_apogee_is_what_the_receiver_says(self, fly):
        _, h = heights(fly("euroc21_piccard"))
        assert h.max() == pytest.approx(6339.0 + 54.0, abs=20.0)

    def test_rocket_stands_on_its_pad_before_it_flies(self, fly):
        # without a rest, the start velocity hangs on an accelerometer that reads 5 % less under thrust
        flight = fly("euroc21_piccard")
        t, h = heights(flight)
        sd_m = 8.0 + sd_at(flight, t[0], slice(0, 3))
        assert sd_m < 35.0
        assert h[0] == pytest.approx(155.0 + 54.0, abs=2.0 * sd_m)
        assert (np.diff(t) > 0.0).all()


class TestNavego:
    """Data by others, with their truth: errors as large as claimed."""

    pytestmark = needs_data

    @pytest.fixture(scope="class")
    def errors(self, fly):
        """Position, velocity (NED) and attitude errors (k, 3) with their standard deviations at the truth's times."""
        r = fly("navego_synthetic", output_rate_hz=10.0)
        truth = np.loadtxt(Path(str(REAL)) / "navego_synthetic" / "truth_first_200s.csv", delimiter=",", skiprows=1)
        s = r.smoothed
        rows = np.flatnonzero(np.isin(np.round(s.time_s, 3), np.round(truth[:, 0], 3)) & (s.time_s > 3.0))
        at = np.searchsorted(np.round(truth[:, 0], 3), np.round(s.time_s[rows], 3))
        true = truth[at]
        place = earth.ecef_from_geodetic(*true[:, 1:4].T)
        dcm = earth.dcm_ned_ecef(true[:, 1], true[:, 2])
        position = s.position_ecef_m[rows] - place
        velocity = s.velocity_ecef_mps[rows] - earth.ecef_from_ned(true[:, 4:7], place)
        turned = np.empty((len(rows), 3))
        for k, (row, (roll, pitch, yaw)) in enumerate(zip(rows, true[:, 7:10], strict=True)):
            ned_body = np.eye(3)
            for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
                ned_body = ned_body @ rotations.dcm_from_q(rotations.exp(angle * np.eye(3)[axis]))
            d = (dcm[k].T @ ned_body).T @ rotations.dcm_from_q(s.q_ecef_body[row])
            turned[k] = 0.5 * np.array([d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]])
        sd = s.sd()[rows]
        return [(position, sd[:, :3]), (velocity, sd[:, 3:6]), (turned, sd[:, 6:9])]

    def test_every_verdict_is_green(self, fly):
        assert not red(fly("navego_synthetic", output_rate_hz=10.0))

    @pytest.mark.parametrize(("which", "largest"), [(0, 0.4), (1, 0.012), (2, np.deg2rad(0.1))])
    def test_errors_are_small(self, errors, which, largest):
        """Rms of each axis: 0.4 m from fixes of 5 m, 0.012 m/s, 0.1 deg."""
        error, _ = errors[which]
        assert (np.sqrt((error**2).mean(axis=0)) < largest).all()

    @pytest.mark.parametrize("which", [0, 1, 2])
    def test_errors_are_as_large_as_claimed(self, errors, which):
        error, sd = errors[which]
        z2 = float(((error / sd) ** 2).mean())
        # a car that drives straight keeps its errors for minutes: at the least one independent error an axis
        low, high = chi2.ppf([0.0005, 0.9995], 3) / 3
        assert low < z2 < high

    def test_its_samples_are_means_over_their_interval(self, fly):
        """Tagged at their ends they would make the receiver's clock half a sample, 2.5 ms, wrong."""
        r = fly("navego_synthetic", (r"(?m)^time = \{ offset_s = -0.0025 \}\n", ""), output_rate_hz=10.0)
        row = r.sensor_errors.set_index("name").loc["receiver time bias"]
        assert row.estimate == pytest.approx(-2.5e-3, abs=3.5 * row.sd)
        assert row.estimate < -1e-3


@needs_data[0]
@needs_data[1]
@needs_data[2]
def test_mars_science_laboratory_by_positions_alone(fly):
    """The deceleration of the filter's air is that of the positions' own second difference less gravitation."""
    found = fly("msl_entry")
    force_mps2, peak_s = 123.5, 80.35  # largest, lift and drag, of the table's own second difference
    drag = np.exp(found.drag.log_drag) * np.sum(found.smoothed.velocity_ecef_mps**2, axis=1) / 2.0
    k = int(np.argmax(drag))
    assert found.smoothed.time_s[k] == pytest.approx(peak_s, abs=0.5)
    # lift of a quarter of the drag is 3 % of the force
    assert drag[k] == pytest.approx(force_mps2 / np.hypot(1.0, 0.24), rel=0.01)
