"""A run against another team's trajectory: planted differences are named with their size, and nothing else is."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flightmodel import earth, rotations
from flightmodel.checks import GateError
from flightmodel.earth import undulation_m
from flightmodel.trajectory import resample
from postflight import exports
from postflight import systematic_differences as differences
from postflight.intake.other_trajectory import OtherTrajectory, read_other
from postflight.report.compare import PAGE_NAME
from postflight.report.compare_other import OTHER_TABLES, title_of
from postflight.run_folder import read_csv
from postflight.runs import find_run, trajectory_of
from postflight.systematic_differences import systematic_differences
from tests.in_process import runner
from tests.postflight.report.conftest import HOSTILE
from tests.refusing import printed_codes, refuses

STEP_S = 0.13  # of the other's epochs, none of which is the run's


@pytest.fixture(scope="module")
def run(reported):
    """Trajectory, and times and matrices of its covariance."""
    path = find_run(reported)
    with np.load(path / "covariance.npz") as stored:
        return trajectory_of(read_csv(path / "bet.csv")), stored["t_s"], stored["covariance"]


@pytest.fixture(scope="module")
def other(run):
    """The run at other times, with white noise of 5 cm, 5 mm/s and 0.01 deg."""
    path = run[0]
    at = resample(path, np.arange(path.time_s[0] + 0.07, path.time_s[-1], STEP_S))
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((3, len(at.time_s), 3)) * np.array([0.05, 0.005, np.deg2rad(0.01)])[:, None, None]
    return OtherTrajectory(
        "other",
        at.time_s,
        at.position_ecef_m + noise[0],
        at.velocity_ecef_mps + noise[1],
        rotations.boxplus(at.q_ecef_body, noise[2]),
        np.empty(0),
        np.empty((0, 6, 6)),
        (),
    )


def found(run, other):
    path, times, covariance = run
    return systematic_differences(path, times, covariance, other)


WAY = np.array([2.0, -1.0, 2.0]) / 3.0


def late(other):
    return replace(other, time_s=other.time_s + 0.020)


def shifted(other):
    ned = earth.dcm_ned_ecef(*earth.geodetic_from_ecef(other.position_ecef_m[len(other.time_s) // 2])[:2])
    return replace(other, position_ecef_m=other.position_ecef_m + ned.T @ WAY)


def turned_track(other):
    first = other.position_ecef_m[0]
    ned = earth.dcm_ned_ecef(*earth.geodetic_from_ecef(first)[:2])
    turn = rotations.exp(np.deg2rad(0.3) * ned[2])
    place = first + rotations.rotate(turn, other.position_ecef_m - first)
    return replace(other, position_ecef_m=place, velocity_ecef_mps=rotations.rotate(turn, other.velocity_ecef_mps))


def turned_body(other):
    return replace(other, q_ecef_body=rotations.boxplus(other.q_ecef_body, np.deg2rad(0.3) * WAY))


def above_the_geoid(other):
    latitude, longitude, height = earth.geodetic_from_ecef(other.position_ecef_m)
    height = height - undulation_m(latitude, longitude) + 0.4  # another geoid model
    return replace(other, position_ecef_m=earth.ecef_from_geodetic(latitude, longitude, height))


def inertial(other):
    carried = np.cross(earth.OMEGA_ECEF_RADPS, other.position_ecef_m)
    return replace(other, velocity_ecef_mps=other.velocity_ecef_mps + carried)


@pytest.mark.parametrize(
    ("plant", "name", "size"),
    [
        (late, "time-offset", [20.0]),
        (shifted, "shift", WAY),
        (turned_track, "track-rotation", [0.0, 0.0, 0.3]),
        (turned_body, "attitude-body", 0.3 * WAY),
        (inertial, "inertial-velocity", [1.0]),
    ],
)
def test_a_planted_difference_is_named_alone_with_its_size(run, other, plant, name, size):
    """To four of its sd, of one to three components each: one in 5000 chances."""
    (effect,) = found(run, plant(other)).effects
    assert effect.name == name
    assert (np.abs(effect.value - size) < 4.0 * effect.sd).all(), effect.words
    assert np.linalg.norm(effect.sd) < 0.2 * np.linalg.norm(size)


def test_heights_above_the_geoid_are_named(run, other):
    """The model's own metre is left as a shift upwards of 0.4 m."""
    effects = {effect.name: effect for effect in found(run, above_the_geoid(other)).effects}
    assert set(effects) == {"height-datum", "shift"}
    assert effects["height-datum"].value[0] == pytest.approx(
        -float(undulation_m(*earth.geodetic_from_ecef(other.position_ecef_m[0])[:2])), abs=0.5
    )
    np.testing.assert_allclose(effects["shift"].value, [0.0, 0.0, -0.4], atol=0.05)


def test_two_at_once_are_separated(run, other):
    effects = {effect.name: effect for effect in found(run, inertial(late(turned_body(other)))).effects}
    assert set(effects) == {"inertial-velocity", "time-offset", "attitude-body"}
    assert effects["time-offset"].value[0] == pytest.approx(20.0, abs=1.0)


def test_a_clock_of_another_time_scale_is_found(run, other):
    """GPS time is 15 s ahead of UTC in 2009: the track is looked for over 40 s to both sides."""
    result = found(run, replace(other, time_s=other.time_s + 15.0))
    assert result.effects[0].name == "time-offset"
    assert result.effects[0].value[0] == pytest.approx(15e3, abs=1.0)
    assert result.effects[0].beyond


def test_nothing_is_named_where_nothing_differs(run, other):
    result = found(run, other)
    assert result.effects == ()
    assert "No systematic difference" in result.paragraph
    assert result.rms("position")[0] == pytest.approx(np.sqrt(3.0) * 0.05, rel=0.1)


def test_chi_square_is_the_differences_own(run, other):
    """Against a sum written out; the other's covariance is added to the run's."""
    path, times, _ = run
    mine = np.tile(np.diag([4.0] * 3 + [0.04] * 3 + [1e-4] * 3), (len(times), 1, 1))
    theirs = np.tile(np.diag([5.0] * 3 + [0.05] * 3), (2, 1, 1))
    stated = replace(shifted(other), covariance_time_s=path.time_s[[0, -1]], covariance=theirs)
    result = systematic_differences(path, times, mine, stated)
    table = result.histories()
    given = table[[f"position_{a}_m" for a in ("north", "east", "down")]].to_numpy()
    assert result.chi_square["position"][0] == pytest.approx((given**2 / 9.0).sum(axis=1).mean() / 3.0, rel=1e-3)
    np.testing.assert_allclose(table["position_north_sd_m"], 3.0, atol=1e-3)
    np.testing.assert_allclose(result.effects[0].stated_sd, 3.0, rtol=1e-2)  # kept over the flight: no averaging
    assert not result.effects[0].beyond  # 1 m is nothing against 3 m
    assert result.both_stated


# ------------------------------------------------------------------------------------- what the covariances allow

SD = np.repeat([7.0, 0.1, np.deg2rad(0.2)], 3)  # of each of two teams, constant over the flight
SEEN = ("time-offset", "shift", "track-rotation")


def two_teams(run, other, errors):
    """The run as another team has it, both with covariances by `SD`; errors (n, 9) in north, east, down and body."""
    path, times, _ = run
    ned = earth.dcm_ned_ecef(*earth.geodetic_from_ecef(other.position_ecef_m)[:2])
    place, speed = (np.einsum("nji,nj->ni", ned, errors[:, k : k + 3]) for k in (0, 3))
    covariance = np.diag(SD**2)
    theirs = replace(
        other,
        position_ecef_m=other.position_ecef_m + place,
        velocity_ecef_mps=other.velocity_ecef_mps + speed,
        q_ecef_body=rotations.boxplus(other.q_ecef_body, errors[:, 6:]),
        covariance_time_s=other.time_s[[0, -1]],
        covariance=np.tile(covariance, (2, 1, 1)),
    )
    return (path, times, np.tile(covariance, (len(times), 1, 1))), theirs


def slow_errors(other, rng):
    """Errors of both teams (n, 9), each a wave of 100 s with its sd."""
    t = other.time_s[:, None] / 100.0
    a, b = rng.standard_normal((2, 9)) * SD * np.sqrt(2.0)
    return a * np.cos(2.0 * np.pi * t) + b * np.sin(2.0 * np.pi * t)


@pytest.fixture(scope="module")
def teams(run, other):
    return two_teams(run, other, slow_errors(other, np.random.default_rng(8)))


@pytest.mark.parametrize(
    ("plant", "name"), [(late, "time-offset"), (turned_track, "track-rotation"), (above_the_geoid, "height-datum")]
)
def test_what_two_teams_covariances_do_not_allow_is_named_alone(teams, plant, name):
    """20 ms at 70 m/s2 are 1.4 m/s, 0.3 deg turn 1 km/s by 5 m/s, of an sd of 0.14 m/s; 40 m are four times 10 m."""
    mine, theirs = teams
    result = found(mine, plant(theirs))
    assert [effect.name for effect in result.effects if effect.beyond] == [name], result.paragraph
    heading = title_of(result)
    assert heading.startswith(f"{result.label}: {name.replace('-', ' ')}")
    assert ("; " in heading) == (len(result.effects) > 1)


@pytest.mark.parametrize("plant", [shifted, turned_body, lambda other: other])
def test_what_is_within_is_not_beyond(teams, plant):
    """1 m of 10 m, 0.3 deg of 0.28 deg an axis."""
    mine, theirs = teams
    result = found(mine, plant(theirs))
    assert not any(effect.beyond for effect in result.effects), result.paragraph
    assert title_of(result).endswith(" within the covariances" if result.effects else "no systematic difference")


def test_errors_of_any_correlation_in_time_stay_within_what_is_allowed(run, other):
    """Size squared is a chi-square at most: reached by errors that last the whole flight, not passed by white ones."""
    few = np.linspace(0, len(other.time_s) - 1, 60).astype(int)
    thin = replace(
        other,
        time_s=other.time_s[few],
        position_ecef_m=other.position_ecef_m[few],
        velocity_ecef_mps=other.velocity_ecef_mps[few],
        q_ecef_body=other.q_ecef_body[few],
    )
    mine, theirs = two_teams(run, thin, np.zeros((60, 9)))
    fit = differences._Fit(mine[0], mine[1:], theirs, 0.0)
    solved, epochs = fit.solved(SEEN), len(fit.time_s)
    rng = np.random.default_rng(3)
    draws = 150
    for correlated, least in ((True, 0.5), (False, 0.0)):
        squares = {name: np.empty(draws) for name in SEEN}
        for k in range(draws):
            u = np.tile(rng.standard_normal(9), (epochs, 1)) if correlated else rng.standard_normal((epochs, 9))
            drawn = replace(solved, x=np.zeros(fit.count), left=np.einsum("nij,nj->ni", fit.root, u))
            for name in SEEN:
                squares[name][k] = differences._Allowed.of(drawn, name).size ** 2
        for name in SEEN:
            p = len(differences._EFFECTS[name][0])
            most = p + 4.0 * np.sqrt(2.0 * p / draws)  # of the mean of chi-squares
            assert least * p < squares[name].mean() < most, (name, correlated)


# ------------------------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize("form", ["oem", "csv", "nc"])
def test_a_runs_own_export_reads_back_as_itself(reported, run, tmp_path, form):
    source = exports.read_source(reported)
    (tmp_path / f"x.{form}").write_bytes(exports.FORMS[form](source))
    theirs = read_other(tmp_path / f"x.{form}", source.header["epoch_utc"])
    path, times, covariance = run
    np.testing.assert_allclose(theirs.time_s, path.time_s, atol=2e-6)
    np.testing.assert_allclose(theirs.position_ecef_m, path.position_ecef_m, atol=2e-3)
    np.testing.assert_allclose(theirs.velocity_ecef_mps, path.velocity_ecef_mps, atol=1e-5)
    if form == "oem":
        np.testing.assert_allclose(theirs.covariance_time_s, times, atol=2e-6)
        np.testing.assert_allclose(theirs.covariance, covariance[:, :6, :6], rtol=1e-6, atol=1e-9)
        assert theirs.q_ecef_body is None
    else:
        np.testing.assert_allclose(theirs.q_ecef_body, path.q_ecef_body, atol=1e-8)
        assert theirs.covariance.shape[1:] == (9, 9)


def test_a_table_of_others_is_read_by_its_header(run, tmp_path):
    path, epoch = run[0], "2009-08-17T12:52:00Z"
    latitude, longitude, height = earth.geodetic_from_ecef(path.position_ecef_m)
    ned = earth.ned_from_ecef(path.velocity_ecef_mps, path.position_ecef_m)
    table = pd.DataFrame(
        {"Time (s)": path.time_s, "Latitude (deg)": np.rad2deg(latitude), "Longitude (deg)": np.rad2deg(longitude),
         "Altitude MSL (km)": (height - undulation_m(latitude, longitude)) / 1e3,
         "V North (ft/s)": ned[:, 0] / 0.3048, "V East (ft/s)": ned[:, 1] / 0.3048, "V Down (ft/s)": ned[:, 2] / 0.3048}
    )  # fmt: skip
    table.to_csv(tmp_path / "team.csv", index=False)
    theirs = read_other(tmp_path / "team.csv", epoch)
    np.testing.assert_allclose(theirs.position_ecef_m, path.position_ecef_m, atol=1e-3)
    np.testing.assert_allclose(theirs.velocity_ecef_mps, path.velocity_ecef_mps, atol=1e-6)
    table.rename(columns={"Altitude MSL (km)": "Altitude MSL"}).to_csv(tmp_path / "team.csv", index=False)
    with refuses("unit-unknown"):
        read_other(tmp_path / "team.csv", epoch)


OEM = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2026-01-01T00:00:00
ORIGINATOR = TEAM

META_START
OBJECT_NAME = X
CENTER_NAME = EARTH
REF_FRAME = ITRF-97
TIME_SYSTEM = UTC
META_STOP

2009-229T12:52:00.5 6378.0 1.0 2.0 0.1 0.2 0.3
2009-08-17T12:52:01.500000 6377.0 1.0 2.0 0.1 0.2 0.3
2009-08-17T12:52:02.5Z 6376.0 1.0 2.0 0.1 0.2 0.3 0.0 0.0 0.0
"""


def test_oem_times_by_day_of_year_and_accelerations(tmp_path):
    (tmp_path / "x.oem").write_text(OEM)
    theirs = read_other(tmp_path / "x.oem", "2009-08-17T12:52:00Z")
    np.testing.assert_allclose(theirs.time_s, [0.5, 1.5, 2.5], atol=1e-9)
    np.testing.assert_allclose(theirs.position_ecef_m[:, 0], [6378e3, 6377e3, 6376e3])
    np.testing.assert_allclose(theirs.velocity_ecef_mps[0], [100.0, 200.0, 300.0])


@pytest.mark.parametrize(
    ("old", "new", "codes"),
    [
        ("ITRF-97", "EME2000", {"oem-frame"}),
        ("= UTC", "= GPS", {"oem-frame"}),
        ("6377.0 1.0 2.0 0.1 0.2 0.3", "6377.0 1.0 2.0 0.1 0.2", {"file-unreadable"}),
        ("6377.0", "nan", {"file-unreadable"}),
        ("6377.0", "63_77", {"file-unreadable"}),
        ("META_STOP", "", {"file-unreadable"}),
        ("12:52:01.5", "12:52:03.5", {"time-backwards"}),
        ("2009-08-17T12:52:01.500000 6377.0", "", {"file-unreadable"}),
    ],
)
def test_oem_that_cannot_be_compared_is_refused(tmp_path, old, new, codes):
    (tmp_path / "x.oem").write_text(OEM.replace(old, new))
    with pytest.raises(GateError) as fault:
        read_other(tmp_path / "x.oem", "2009-08-17T12:52:00Z")
    assert set(fault.value.codes) == codes


def test_positions_in_another_unit_are_refused_and_a_lone_one_is_left_out(tmp_path):
    (tmp_path / "x.oem").write_text(OEM.replace(".0 1.0 2.0", "000.0 1000.0 2000.0"))
    with refuses("value-range"):
        read_other(tmp_path / "x.oem", "2009-08-17T12:52:00Z")
    one = "2009-08-17T12:52:03.500000 63750.0 1.0 2.0 0.1 0.2 0.3\n"
    (tmp_path / "x.oem").write_text(OEM + one + one.replace("03.5", "04.5").replace("63750.0", "0.0"))
    theirs = read_other(tmp_path / "x.oem", "2009-08-17T12:52:00Z")
    assert len(theirs.time_s) == 4
    assert len(theirs.notes) == 1


def test_a_covariance_in_another_frame_is_left_out_and_said(tmp_path):
    rows = "\n".join(" ".join("1e-6" for _ in range(k + 1)) for k in range(6))
    block = f"COVARIANCE_START\nEPOCH = 2009-08-17T12:52:00\nCOV_REF_FRAME = RTN\n{rows}\nCOVARIANCE_STOP\n"
    (tmp_path / "x.oem").write_text(OEM + block)
    theirs = read_other(tmp_path / "x.oem", "2009-08-17T12:52:00Z")
    assert len(theirs.covariance_time_s) == 0
    assert len(theirs.notes) == 1


def test_the_command_writes_tables_and_one_page_that_needs_nothing(reported, tmp_path, capsys, monkeypatch):
    source = exports.read_source(reported)
    lines = exports.FORMS["oem"](source).decode()
    hostile = tmp_path / f"{HOSTILE.replace('/', '_')}.oem"
    hostile.write_text(lines)
    start = runner(capsys, monkeypatch)
    done = start("compare", reported, hostile, "--output", tmp_path / "made")
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "made").iterdir()} == {PAGE_NAME, *(f"{name}.csv" for name in OTHER_TABLES)}
    text = (tmp_path / "made" / PAGE_NAME).read_text()
    assert hostile.name not in text
    assert "No systematic difference" in text
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)[1]
    assert "default-src 'none'" in policy
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])
    assert len(data["panels"]) == 6  # no attitude in an OEM
    assert len(pd.read_csv(tmp_path / "made" / "differences_over_time.csv")) > 100


def test_what_is_no_pair_of_a_run_and_a_file_is_refused(reported, tmp_path, capsys, monkeypatch):
    start = runner(capsys, monkeypatch)
    (tmp_path / "x.oem").write_text(OEM)
    for words in ((tmp_path / "x.oem", reported), (reported, reported, tmp_path / "x.oem"), (tmp_path / "x.oem",)):
        done = start("compare", *words)
        assert (done.returncode, printed_codes(done.stderr)) == (2, ["compare-runs"])
    done = start("compare", reported, tmp_path / "x.oem")
    assert (done.returncode, printed_codes(done.stderr)) == (3, ["time-not-covered"])
    copy = shutil.copytree(find_run(reported), Path(tmp_path / "flight" / "runs" / "20300101T000000Z-01234567"))
    (copy / "covariance.npz").write_bytes(b"no archive")
    done = start("compare", copy, tmp_path / "x.oem")
    assert (done.returncode, printed_codes(done.stderr)) == (3, ["run-incomplete"])
