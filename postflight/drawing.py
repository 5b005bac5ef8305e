"""Who draws a run's figures? A second process, made ready while the first one reconstructs.

Figures take as much processor time as the trajectory, and nothing waits for them but the end of the command. The
process is started early, so that it has matplotlib loaded when there is something to draw, and is given each part of
the figures as soon as its numbers are there. It ends with the process that started it, however that ends. Where it
cannot be started, or is killed, what is missing is drawn here.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import pandas as pd

from postflight.deflections import Deflections
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds

Process = multiprocessing.get_context("spawn").Process  # a fork would copy locks that other threads hold
_Part = Literal["trajectory", "deflections", "studies"]  # functions draw_... of `postflight.plots.run_figures`
_Warnings = list[tuple[type[Warning], str]]


class DrawingProcess:
    """A process that draws while this one goes on: use as a context, inside that of the folder it draws into.

    Parameters
    ----------
    folder : Path
        Of the figures.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._flight: Reconstruction | None = None
        self._given: list[tuple[_Part, tuple[Any, ...]]] = []

    def __enter__(self) -> DrawingProcess:
        """Start it."""
        self._here, there = multiprocessing.Pipe()
        self._process = Process(target=_serve, args=(there, self._folder), daemon=True)
        with contextlib.suppress(OSError):
            self._process.start()
        there.close()
        self._sender = ThreadPoolExecutor(1)  # the other may not be ready to take it
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        """End it, also in the middle of its work."""
        if self._process.pid is not None:
            self._process.terminate()
            self._process.join()
        self._sender.shutdown(cancel_futures=True)
        self._here.close()

    def trajectory(self, flight: Reconstruction) -> None:
        """Let it draw the trajectory."""
        self._flight = flight
        self._send(flight)
        self._draw("trajectory")

    def deflections(self, answers: Deflections) -> None:
        """Let it draw the answers; after the trajectory."""
        self._draw("deflections", replace(answers, bet=None))  # which it has

    def studies(self, bounds: Bounds | None, reran: pd.DataFrame | None) -> None:
        """Let it draw Figure 1.3 and the sensitivity; after the trajectory."""
        self._draw("studies", bounds, reran)

    def finish(self) -> None:
        """Wait until everything is drawn; warnings of the other process are given here.

        Raises
        ------
        OSError
            Where it could not write a file.
        """
        self._send(None)
        for part, arguments in self._given:
            try:
                found: _Warnings | OSError = self._here.recv()
            except (EOFError, OSError):
                _draw(part, self._flight, self._folder, arguments)
                continue
            if isinstance(found, OSError):
                raise found
            for category, words in found:
                warnings.warn(category(words), stacklevel=2)

    def _draw(self, part: _Part, *arguments: Any) -> None:
        self._given.append((part, arguments))
        self._send((part, arguments))

    def _send(self, what: Any) -> None:
        # where nobody receives, `finish` finds out
        self._sender.submit(self._here.send_bytes, ForkingPickler.dumps(what))


def _draw(part: _Part, flight: Reconstruction | None, folder: Path, arguments: tuple[Any, ...]) -> None:
    from postflight.plots import run_figures

    getattr(run_figures, f"draw_{part}")(flight, folder, *arguments)


def _serve(connection: Connection, folder: Path) -> None:
    """Be ready, draw each part, and send back its warnings or why a file could not be written."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C is for the process that started this one
    import postflight.plots.run_figures  # noqa: F401 - makes ready

    with contextlib.suppress(EOFError, BrokenPipeError):
        flight: Reconstruction = connection.recv()
        while (job := connection.recv()) is not None:
            with warnings.catch_warnings(record=True) as given:
                warnings.simplefilter("always")
                try:
                    _draw(job[0], flight, folder, job[1])
                    connection.send([(one.category, str(one.message)) for one in given])
                except OSError as fault:
                    connection.send(fault)
