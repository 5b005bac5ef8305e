"""The process that draws a run's figures: its warnings arrive, and where it dies the figures are drawn all the same."""

import os
import signal

import pytest

from postflight import drawing


def draw_here(monkeypatch):
    done = []
    monkeypatch.setattr(drawing, "_draw", lambda job: done.append(job))
    return done


def test_a_killed_process_costs_no_figure(monkeypatch):
    done = draw_here(monkeypatch)
    with drawing.DrawingProcess() as process:
        os.kill(process._process.pid, signal.SIGKILL)
        process._process.join()
        with process.at_work(1, 2):
            pass
    assert done == [(1, 2)]


def test_a_process_that_cannot_start_costs_no_figure(monkeypatch):
    done = draw_here(monkeypatch)

    def refused(_self):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", refused)
    with drawing.DrawingProcess() as process, process.at_work(1, 2):
        pass
    assert done == [(1, 2)]


def test_a_fault_of_the_block_ends_the_process_before_it_is_raised():
    with drawing.DrawingProcess() as process:
        with pytest.raises(RuntimeError, match="own fault"), process.at_work("no job"):
            raise RuntimeError("own fault")
        assert not process._process.is_alive()


class Silent:
    """Stands for the other end: what it says is set beforehand."""

    def __init__(self, says):
        self.says = says

    def send(self, _job):
        pass

    def recv(self):
        return self.says

    def close(self):
        pass


@pytest.fixture
def answering(monkeypatch):
    def with_answer(says):
        process = drawing.DrawingProcess()
        process._here, process._process = Silent(says), type("Ended", (), {"pid": None})
        return process

    return with_answer


def test_warnings_of_the_process_are_given_here(answering):
    with (
        pytest.warns(RuntimeWarning, match="fusion.png was not drawn"),
        answering([(RuntimeWarning, "fusion.png was not drawn")]).at_work(),
    ):
        pass


def test_a_file_that_cannot_be_written_is_raised_here(answering):
    with pytest.raises(OSError, match="No space left"), answering(OSError(28, "No space left on device")).at_work():
        pass
