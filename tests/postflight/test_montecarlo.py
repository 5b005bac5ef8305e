"""A study's numbers come from its runs alone: any workers, any kill, any resume; folders refuse what does not fit."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

from flightmodel.checks import ConfigError, GateError
from flightmodel.files import PARTIAL, machine
from flightmodel.vehicle import DATA
from postflight.montecarlo import commands, execution
from postflight.montecarlo.bands import (
    chunk_path,
    coverage,
    is_narrow,
    merge,
    percentile_interval,
    read_chunk,
    write_merged,
)
from postflight.montecarlo.execution import Wanted, fly_jobs, status, study_of
from postflight.montecarlo.study import METHODS, TRIAL_SCALARS, Stop, read_study, run_trials, whole_trial
from synthetic_flight import ensemble
from tests.refusing import refuses

from .killing import start_command
from .short_flights import DISPERSIONS, ENTRY, FLIGHTS, content, fly, quiet, write_short

PARTIAL_GLOB = f".{PARTIAL}-*"


def test_flights_are_all_there_and_differ(reference, study_path, tmp_path):
    assert sum(name.startswith("chunks/") for name in reference) == 6
    fly(study_path, tmp_path / "study")
    table = pd.read_csv(tmp_path / "study" / "flights.csv")
    assert table["run"].tolist() == list(range(FLIGHTS))
    assert table["peak_deflection_deg"].nunique() == FLIGHTS
    assert table["reason"].isna().all()
    bands = pd.read_csv(tmp_path / "study" / "bands.csv")
    one = bands[bands["history"] == "deflection_deg"]
    assert len(one) == 41
    assert (one["p2.3"] <= one["p50"]).all()
    assert (one["p50"] <= one["p97.7"]).all()
    # bands are of the histories themselves
    every = np.concatenate([read_chunk(tmp_path / "study", k).histories[:, 1] for k in range(6)])
    np.testing.assert_allclose(one["p97.7"], np.percentile(every, 97.7, axis=0), rtol=1e-6)


def test_two_processes_make_the_same_bytes(reference, study_path, tmp_path):
    fly(study_path, tmp_path / "study", workers=2)
    assert content(tmp_path / "study") == reference


def test_bands_in_slabs_are_the_same(reference, study_path, tmp_path, monkeypatch):
    monkeypatch.setattr("postflight.montecarlo.bands.BAND_BYTES", 7 * 4 * FLIGHTS * 2)
    fly(study_path, tmp_path / "study")
    assert content(tmp_path / "study") == reference


def command(path, folder, *more):
    arguments = ("montecarlo", "run", path, folder, *more)
    return start_command(*arguments, stdout=subprocess.PIPE, start_new_session=True)


def chunks_in(folder):
    return len(list((folder / "chunks").glob("chunk-*.npz")))


def wait_for_chunks(process, folder, count):
    until = time.monotonic() + 60.0
    while chunks_in(folder) < count:
        assert process.poll() is None, process.stderr.read().decode()
        assert time.monotonic() < until
        time.sleep(0.002)


@pytest.mark.long
def test_a_run_killed_twice_goes_on_to_the_same_bytes(study_path, tmp_path):
    """Killed without warning, once alone and once with two processes, whose workers follow their parent."""
    flights, folder = 96, tmp_path / "killed"
    fly(study_path, tmp_path / "whole", flights=flights)
    total = chunks_in(tmp_path / "whole")
    for workers, count in (("1", 2), ("2", 8)):
        process = command(study_path, folder, "--flights", str(flights), "--workers", workers)
        wait_for_chunks(process, folder, count)
        process.kill()
        process.wait()
        assert count <= chunks_in(folder) < total
        wait_until_alone(process.pid)
    before = {p: p.stat().st_mtime_ns for p in (folder / "chunks").glob("chunk-*.npz")}
    left = chunks_in(folder)
    fly(study_path, folder, flights=flights, workers=1)
    assert content(folder) == content(tmp_path / "whole")
    # nothing that was there has been flown again
    assert len(before) == left
    assert all(p.stat().st_mtime_ns == when for p, when in before.items())


def alive_in_session(leader):
    out = subprocess.run(["ps", "-o", "pid=", "-s", str(leader)], capture_output=True, text=True, check=False).stdout
    return [int(word) for word in out.split() if int(word) != leader]


def wait_until_alone(leader):
    until = time.monotonic() + 10.0
    while alive_in_session(leader):
        assert time.monotonic() < until, "worker processes outlive their parent"
        time.sleep(0.05)


@pytest.mark.slow
def test_control_c_leaves_a_folder_that_goes_on(study_path, tmp_path):
    flights, folder = 96, tmp_path / "stopped"
    process = command(study_path, folder, "--flights", str(flights), "--workers", "2")
    wait_for_chunks(process, folder, 3)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of them
    output, printed = (text.decode() for text in process.communicate(timeout=30))
    assert process.returncode == 130
    assert "Traceback" not in printed
    assert "interrupted" in printed
    assert "resumes" in output
    wait_until_alone(process.pid)
    assert not list(folder.rglob(PARTIAL_GLOB))
    found = status(folder)
    assert 3 <= found.chunks < found.chunks_wanted
    fly(study_path, folder, flights=flights)
    assert status(folder).flights == flights


@pytest.mark.slow
def test_a_stopped_study_leaves_no_thread_or_process(study_path):
    """A thread of the pool that outlives it may end while Python does, with a traceback on the screen."""
    threads, processes = set(threading.enumerate()), set(multiprocessing.active_children())
    jobs = [(number, range(4 * number, 4 * number + 4)) for number in range(24)]
    flying = fly_jobs(read_study(str(study_path)), jobs, 2, None)
    next(flying)
    flying.close()
    assert set(threading.enumerate()) <= threads
    assert set(multiprocessing.active_children()) <= processes


def test_a_longer_study_keeps_what_was_flown(reference, study_path, tmp_path):
    folder = tmp_path / "study"
    fly(study_path, folder, flights=10)  # the last chunk is not full
    early = chunk_path(folder, 0).stat().st_mtime_ns
    fly(study_path, folder)
    assert content(folder) == reference
    assert chunk_path(folder, 0).stat().st_mtime_ns == early
    with refuses("file-exists", names=[r"\b24\b"], kind=ConfigError):
        fly(study_path, folder, flights=10)


def test_damaged_and_abandoned_files_are_flown_again(reference, study_path, tmp_path):
    folder = tmp_path / "study"
    fly(study_path, folder)
    chunk_path(folder, 2).write_bytes(chunk_path(folder, 2).read_bytes()[:700])
    whole = bytearray(chunk_path(folder, 3).read_bytes())
    whole[400] ^= 255
    chunk_path(folder, 3).write_bytes(whole)
    chunk_path(folder, 4).unlink()
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (folder / "chunks" / f".{PARTIAL}-{machine()}-{ended.pid}-00000000-chunk-000001.npz").write_bytes(b"half")
    assert status(folder).chunks == 3
    study = read_study(str(study_path))
    with refuses("study-damaged", names=[r"\b3\b.*\b6\b"]):
        merge(study, folder, FLIGHTS)
    fly(study_path, folder)
    assert content(folder) == reference


def test_other_settings_are_refused_with_what_differs(study_path, tmp_path):
    folder = tmp_path / "study"
    fly(study_path, folder, flights=4)
    other = tmp_path / "other"
    other.mkdir()
    changed = write_short(
        other, DISPERSIONS.replace("normal = 300.0", "normal = 250.0").replace("seed = 7", "seed = 8")
    )
    names = [r"'initial\.altitude_m\.normal'.*\b300\.0\b.*\b250\.0\b", r"'seed'.*\b7\b.*\b8\b"]
    with refuses("file-exists", names=names, kind=ConfigError) as refused:
        fly(changed, folder, flights=4)
    assert "mass" not in str(refused.value)
    scenario = other / "short.toml"
    scenario.write_text(scenario.read_text().replace("speed_mps = 1600.0", "speed_mps = 1601.0"))
    (other / "dispersions.toml").write_text(DISPERSIONS)
    with refuses("file-exists", names=[r"speed_mps'.*\b1600\.0\b.*\b1601\.0\b"], kind=ConfigError):
        fly(changed, folder, flights=4)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").write_text("mine")
    with pytest.raises(ConfigError) as refused:
        fly(study_path, tmp_path / "full", flights=4)
    assert refused.value.codes == ("file-exists",)


@pytest.mark.parametrize(
    ("old", "new", "named", "code"),
    [
        ('"peak_normal_g"', '"peak_normal"', "outputs.scalars", "name-unknown"),
        ('"alpha_total_deg"', '"alpha_total"', "outputs.histories", "name-unknown"),
        ("seed = 7", "sed = 7", "'seed'", None),
        ("[joint]", "[joints]", "'joint'", None),
        ("to_s = 406.0", "to_s = 500.0", "412", "time-not-covered"),
        ("seed = 7", 'mode = "whole"', "atmosphere.density", "whole-mode-dispersion"),
        ("chunk = 4", "chunk = 0", "chunk", None),
    ],
)
def test_wrong_files_are_refused(tmp_path, old, new, named, code):
    """Faults of single keys have the gate's codes, those between keys the study's own."""
    with pytest.raises(ConfigError) as refused:
        read_study(str(write_short(tmp_path, DISPERSIONS.replace(old, new))))
    assert named in str(refused.value)
    assert code is None or code in refused.value.codes


def test_a_failed_flight_is_a_row_and_can_be_flown_again(reference, study_path, tmp_path, monkeypatch):
    folder, case = tmp_path / "study", ensemble.dispersed_case
    seen = iter(range(FLIGHTS))

    def unlucky(*arguments):
        if (k := next(seen)) in (5, 6):
            raise GateError("out of luck")
        if k == 20:
            raise ZeroDivisionError("a defect")
        return case(*arguments)

    monkeypatch.setattr(ensemble, "dispersed_case", unlucky)
    fly(study_path, folder)
    found = status(folder)
    assert found.failed == {"out of luck": 2, "ZeroDivisionError: a defect": 1}
    table = pd.read_csv(folder / "flights.csv")
    assert table[table["reason"].notna()]["run"].tolist() == [5, 6, 20]
    assert table.loc[5, "peak_deflection_deg"] != table.loc[5, "peak_deflection_deg"]
    assert json.loads((folder / "summary.json").read_text())["failed"] == 3
    assert (pd.read_csv(folder / "percentiles.csv")["flights"] == FLIGHTS - 3).all()
    monkeypatch.setattr(ensemble, "dispersed_case", case)
    study, flights = study_of(folder)
    assert execution.retry_failed(study, folder, Wanted(flights), quiet) == (3, 0)
    write_merged(folder, merge(study, folder, flights))
    assert content(folder) == reference


def test_a_study_of_failures_alone_is_an_error(tmp_path):
    path = write_short(tmp_path, DISPERSIONS.replace("normal = 0.07", "uniform = [-3.0, -2.0]"))
    with refuses("every-flight-failed", names=["C_A, C_N, C_m"]):
        commands.run(str(path), tmp_path / "study", 6, 1, None, None)
    assert len(pd.read_csv(tmp_path / "study" / "flights.csv")) == 6


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("peak_deflection_deg", "option-format"),
        ("peak_deflection_deg=-1", "option-format"),
        ("peak_deflection=1", "name-unknown"),
    ],
)
def test_a_wrong_width_is_refused(study_path, tmp_path, text, code):
    with pytest.raises(ConfigError) as refused:
        commands.run(str(study_path), tmp_path / "study", 6, 1, None, text)
    assert refused.value.codes == (code,)


def test_intervals_cover_as_order_statistics_say():
    """Against the exact binomial coverage of the ranks, and by drawing."""
    n, percentile, confidence = 300, 97.7, 0.95
    low, high = percentile_interval(np.arange(1.0, n + 1.0), percentile, confidence)
    below = binom(n, percentile / 100.0)
    exact = below.cdf(high - 1) - below.cdf(low - 1)  # the low-th smallest <= q < the high-th
    assert confidence <= exact < 0.98
    rng, rounds = np.random.default_rng(5), 600
    draws = np.sort(rng.standard_exponential((rounds, n)), axis=1)
    truth = -np.log(1.0 - percentile / 100.0)
    held = np.mean((draws[:, int(low) - 1] <= truth) & (truth <= draws[:, int(high) - 1]))
    assert abs(held - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / rounds)
    assert np.isnan(percentile_interval(np.arange(20.0), percentile, confidence)[1])


def test_the_stop_rule_stops_at_the_same_flight_on_any_workers(study_path, tmp_path):
    stop = Stop(output="peak_deflection_deg", width=0.05, percentile=50.0)
    one = fly(study_path, tmp_path / "one", flights=200, stop=stop)
    fly(study_path, tmp_path / "two", flights=200, workers=2, stop=stop)
    held = content(tmp_path / "one")
    assert held == content(tmp_path / "two")
    flights = status(tmp_path / "one").flights_wanted
    assert 8 <= flights < 200
    assert flights % 4 == 0
    values = pd.read_csv(tmp_path / "one" / "flights.csv")["peak_deflection_deg"].to_numpy()
    assert is_narrow(values, 50.0, 0.95, 0.05)
    assert not is_narrow(values[:-4], 50.0, 0.95, 0.05)
    # asked again: nothing to fly
    assert execution.run(one, tmp_path / "one", Wanted(200, stop=stop), quiet) == flights


def test_chunks_that_come_out_of_order_do_not_stop_it_earlier(study_path, tmp_path):
    fly(study_path, tmp_path / "study")
    study = read_study(str(study_path))
    chunks = [read_chunk(tmp_path / "study", k) for k in range(6)]
    stop = Stop(output="peak_deflection_deg", width=1e9, percentile=50.0)
    enough = execution._Enough(study, stop, FLIGHTS)
    assert not enough.add(3, chunks[3])
    assert not enough.add(1, chunks[1])
    assert enough.add(0, chunks[0]) or enough.add(2, chunks[2])
    assert enough.reached in (8, 12, 16)


def test_a_worker_that_is_killed_is_a_message(study_path, monkeypatch):
    study = read_study(str(study_path))
    jobs = [(k, study.runs_of(k, 400)) for k in range(100)]
    flown = execution.fly_jobs(study, jobs, 2, None)
    next(flown)
    import multiprocessing

    os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
    with pytest.raises(GateError) as refusal:
        list(flown)
    assert refusal.value.codes == ("worker-killed",)


def test_coverage_counts_errors_by_their_own_bars():
    rng = np.random.default_rng(1)
    table = pd.DataFrame({"trim_error_deg": 2.0 * rng.standard_normal(4000), "trim_sd_deg": 2.0})
    found = coverage(table)["trim"]
    assert abs(found["inside_1_sd"] - 0.6827) < 4.0 * np.sqrt(0.6827 * 0.3173 / 4000)
    assert abs(found["rms_over_sd"] - 1.0) < 4.0 / np.sqrt(8000)


@pytest.mark.slow
def test_a_whole_trial_recovers_its_truth(tmp_path):
    """From the dispersed truth through telemetry to the estimators."""
    shipped = (DATA / "dispersions" / "irve2_whole.toml").read_text()
    text = shipped.replace('scenario = "irve2_reference"', 'scenario = "short.toml"')
    study = read_study(str(write_short(tmp_path, text, ENTRY)))
    plan = replace(study.plan, scalars=TRIAL_SCALARS)
    rows = run_trials(partial(whole_trial, plan, 3), plan, [1])
    found = rows[0].scalars
    assert rows[0].reason == ""
    assert np.isfinite([found[name] for name in TRIAL_SCALARS]).all()
    assert found["truth_deg"] > 1.0
    for method in METHODS:
        # one flight: within four of its own standard deviations
        assert abs(found[f"{method}_error_deg"]) < 4.0 * found[f"{method}_sd_deg"]
    assert found["bet_position_m"] < 100.0
