"""The process beside a command's own: its warnings arrive, and where it dies its work is done all the same."""

import os
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import wait

import pytest

from postflight.beside import Beside, same

NAMED = "tests.postflight.test_beside:halved"


def halved(number):
    if number < 0:
        raise ValueError("a negative number")
    if number > 100:
        warnings.warn("a large number", RuntimeWarning, stacklevel=2)
    return 0.5 * number, os.getpid()


def first(pair, other):
    return pair[0] + other, os.getpid()


def refused(*_):
    raise OSError(28, "No space left on device", "figures/fusion.png")


def worker(beside):
    """Number of its process, once it works."""
    return beside.submit(os.getpid).result()


def kill(beside):
    """Kill its process, and wait until that is known."""
    running = beside.submit(time.sleep, 60.0)
    os.kill(next(iter(beside._pool._processes)), signal.SIGKILL)
    wait([running.future])


def test_what_is_submitted_is_done_in_the_other_process_and_its_warnings_and_errors_are_given_here():
    with Beside() as beside:
        tasks = [beside.submit(NAMED if number == 3.0 else halved, number) for number in (3.0, 200.0, -1.0)]
        assert tasks[0].result() == (1.5, worker(beside))
        with pytest.warns(RuntimeWarning, match="a large number"):
            assert tasks[1].result() == (100.0, worker(beside))
        with pytest.raises(ValueError, match="a negative number"):
            tasks[2].result()


def test_a_task_as_an_argument_stands_for_its_result_which_stays_there():
    with Beside() as beside:
        kept = beside.keep(halved, 3.0)
        assert beside.submit(first, kept, 1.0).result() == (2.5, worker(beside))
        assert kept.future.result() == (None, [])
        lost = beside.submit(first, beside.keep(halved, -1.0), 1.0)
        with pytest.raises(ValueError, match="a negative number"):
            lost.result()


def test_arguments_are_those_of_the_moment_of_submission():
    with Beside() as beside:
        given = [1.0]
        task = beside.submit(same, given)
        given.append(2.0)
        assert task.result() == [1.0]


def test_a_file_that_cannot_be_written_is_raised_here():
    with Beside() as beside, pytest.raises(OSError, match="No space left"):
        beside.submit(refused).result()


def test_what_a_killed_process_was_asked_for_is_done_here():
    with Beside() as beside:
        before = beside.keep(halved, 3.0)
        kill(beside)
        assert before.result() == (1.5, os.getpid())
        assert before.result() is before.result(), "once"
        assert beside.submit(first, before, 1.0).result() == (2.5, os.getpid())
        with pytest.warns(RuntimeWarning, match="a large number"):
            assert beside.submit(halved, 200.0).result() == (100.0, os.getpid())


def test_a_process_that_cannot_start_costs_nothing(monkeypatch):
    def no_process(_self):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.process.BaseProcess.start", no_process)
    with Beside() as beside:
        assert beside.submit(first, beside.keep(halved, 3.0), 1.0).result() == (2.5, os.getpid())


def test_leaving_early_ends_the_process_whatever_it_was_given():
    """Also where it has not begun to read: more than a pipe holds is on its way."""
    with Beside() as beside:
        for _ in range(3):
            beside.submit(same, bytes(10_000_000))
        processes = list(beside._pool._processes.values())
        assert len(processes) == 1
        assert processes[0].is_alive()
    beside.close()
    assert not processes[0].is_alive()


KILLED = """
import os, signal
from postflight.beside import Beside

if __name__ == "__main__":
    beside = Beside()
    print(beside.submit(os.getpid).result(), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_process_ends_with_its_parent_that_was_killed(tmp_path):
    (tmp_path / "killed.py").write_text(KILLED)
    run = [sys.executable, str(tmp_path / "killed.py")]
    done = subprocess.run(run, capture_output=True, text=True, timeout=60)  # after its end: it holds the pipe, too
    assert done.stdout.strip().isdigit(), done.stderr
    assert done.returncode == -signal.SIGKILL
