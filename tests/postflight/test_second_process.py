"""The process beside a run's own: its warnings arrive, and where it dies its work is done all the same."""

import importlib
import os
import signal
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from postflight import second_process
from postflight.deflections import Deflections

FOLDER = Path("figures")


def draw_here(monkeypatch):
    done = []
    monkeypatch.setattr(second_process, "_draw", lambda part, *rest: done.append((part, *rest)))
    return done


def all_parts(process):
    process.draw_trajectory("flight", FOLDER)
    process.draw_deflections(Deflections(bet="flight"))
    process.draw_studies(1, 2, 3)


def drawn(done):
    parts = [("trajectory", ()), ("deflections", (Deflections(bet=None),)), ("studies", (1, 2, 3))]
    return done == [(part, "flight", FOLDER, arguments) for part, arguments in parts]


def test_a_killed_process_costs_no_figure(monkeypatch):
    done = draw_here(monkeypatch)
    with second_process.SecondProcess(draws=True) as process:
        process.read_film("flight", fuses=True)
        os.kill(process._process.pid, signal.SIGKILL)
        process._process.join()
        all_parts(process)
        assert process.camera() is None
        assert process.time_bias() is None
        process.finish()
    assert drawn(done)


def test_a_process_that_cannot_start_costs_no_figure(monkeypatch):
    done = draw_here(monkeypatch)

    def refused(_self):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.process.BaseProcess.start", refused)
    with second_process.SecondProcess(draws=True) as process:
        all_parts(process)
        process.finish()
    assert drawn(done)


def test_leaving_early_ends_the_process_whatever_it_was_given():
    """Also where it has not begun to read: more than a pipe holds is on its way."""
    with second_process.SecondProcess(draws=True) as process:
        process.draw_trajectory(bytes(10_000_000), FOLDER)
        assert process._process.is_alive()
    assert not process._process.is_alive()


def halved(number):
    if number < 0:
        raise ValueError("a negative number")
    if number > 100:
        warnings.warn("a large number", RuntimeWarning, stacklevel=2)
    return 0.5 * number, os.getpid()


def test_what_is_asked_for_is_done_in_the_other_process_and_its_warnings_and_errors_are_given_here():
    with second_process.SecondProcess() as process:
        for number in (3.0, 200.0, -1.0):
            process.ask(halved, number)
        assert process.answer() == (1.5, process._process.pid)
        with pytest.warns(RuntimeWarning, match="a large number"):
            assert process.answer() == (100.0, process._process.pid)
        with pytest.raises(ValueError, match="a negative number"):
            process.answer()


def arrow():
    import pandas as pd

    before = "pyarrow" in sys.modules, pd.Series(["a", None]).isna().tolist()
    importlib.import_module("pyarrow")
    return before


def test_pandas_is_loaded_without_arrow_which_stays_at_hand(monkeypatch):
    pytest.importorskip("pyarrow", reason="pyarrow comes with the parquet extra")
    monkeypatch.setattr(second_process, "_THREADS", Path("nowhere"))  # a fork has what is loaded here
    with second_process.SecondProcess() as process:
        process.ask(arrow)
        assert process.answer() == (False, [False, True])


KILLED = """
import os, signal, sys
from postflight.second_process import SecondProcess

process = SecondProcess().__enter__()
print(type(process._process).__name__, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_a_fork_ends_with_the_process_that_was_killed():
    done = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, timeout=60)
    assert done.stdout == "ForkProcess\n"  # after its end: it holds the other side of this pipe


def test_what_a_killed_process_was_asked_for_is_done_here():
    with second_process.SecondProcess() as process:
        os.kill(process._process.pid, signal.SIGKILL)
        process._process.join()
        process.ask(halved, 3.0)
        assert process.answer() == (1.5, os.getpid())


class Silent:
    """Stands for the other end: what it says is set beforehand."""

    def __init__(self, *says):
        self.says = list(says)

    def send_bytes(self, _job):
        pass

    def recv(self):
        if not self.says:
            raise EOFError
        return self.says.pop(0)


@pytest.fixture
def answering():
    def with_answers(*says):
        process = second_process.SecondProcess(draws=True)
        process._here, process._sender = Silent(*says), ThreadPoolExecutor(1)
        all_parts(process)
        return process

    return with_answers


def test_warnings_of_the_process_are_given_here(answering):
    with pytest.warns(RuntimeWarning, match="fusion.png was not drawn"):
        answering([], [(RuntimeWarning, "fusion.png was not drawn")], []).finish()


def test_a_file_that_cannot_be_written_is_raised_here(answering):
    with pytest.raises(OSError, match="No space left"):
        answering([], OSError(28, "No space left on device")).finish()


def test_what_a_process_that_died_amid_its_work_did_not_draw_is_drawn_here(answering, monkeypatch):
    done = draw_here(monkeypatch)
    answering([]).finish()
    assert [part for part, *_ in done] == ["deflections", "studies"]


def test_the_film_is_what_comes_first(answering):
    process = answering("what it answers", [], [], [])
    process._reading = True
    assert process.camera() == "what it answers"
    assert process.camera() is None
    process.finish()
