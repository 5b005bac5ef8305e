"""Who draws a run's figures? A second process, made ready while the first one reconstructs.

Figures take as much processor time as the trajectory, and nothing waits for them but the end of the command. The
process is started early, so that it has matplotlib loaded when there is something to draw; it does one job, and ends
with the process that started it, however that ends. Where it cannot be started, or is killed, the job is done here.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import warnings
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType

import pandas as pd

from postflight.deflections import Deflections
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds

Process = multiprocessing.get_context("spawn").Process  # a fork would copy locks that other threads hold
_Job = tuple[Reconstruction, Deflections, Path, Bounds | None, pd.DataFrame | None]
_Warnings = list[tuple[type[Warning], str]]


class DrawingProcess:
    """A process that draws while this one goes on: use as a context."""

    def __enter__(self) -> DrawingProcess:
        """Start it."""
        self._here, there = multiprocessing.Pipe()
        self._process = Process(target=_serve, args=(there,), daemon=True)
        with contextlib.suppress(OSError):
            self._process.start()
        there.close()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        """End it, also in the middle of its job."""
        self._here.close()
        if self._process.pid is not None:
            self._process.terminate()
            self._process.join()

    @contextlib.contextmanager
    def at_work(self, *job: *_Job) -> Iterator[None]:
        """Let it draw (`run_figures.draw_run`) while the block runs; leaving the block waits for its end.

        Warnings of the other process are given here.

        Raises
        ------
        OSError
            Where it could not write a file.
        """
        try:
            with contextlib.suppress(OSError):  # where nobody receives, `_finish` finds out
                self._here.send(job)
            yield
            self._finish(job)
        except BaseException:
            self.__exit__()  # nothing is written any more when the caller clears up
            raise

    def _finish(self, job: _Job) -> None:
        try:
            found: _Warnings | OSError = self._here.recv()
        except (EOFError, OSError):
            _draw(job)
            return
        if isinstance(found, OSError):
            raise found
        for category, words in found:
            warnings.warn(category(words), stacklevel=3)


def _draw(job: _Job) -> None:
    from postflight.plots import run_figures

    run_figures.draw_run(*job)


def _serve(connection: Connection) -> None:
    """Be ready, do one job, and send back its warnings or why a file could not be written."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C is for the process that started this one
    import postflight.plots.run_figures  # noqa: F401 - makes ready

    with warnings.catch_warnings(record=True) as given, contextlib.suppress(EOFError, BrokenPipeError):
        warnings.simplefilter("always")
        job: _Job = connection.recv()
        try:
            _draw(job)
            connection.send([(one.category, str(one.message)) for one in given])
        except OSError as fault:
            connection.send(fault)
