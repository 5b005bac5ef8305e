"""What does a second process do for a command? It has the camera's answer while the first reconstructs, then draws.

Of a reconciliation it does what does not need the fit.

Figures take as much processor time as the trajectory, and nothing waits for them but the end of the command; a film
takes a quarter of it, and needs no trajectory. The process is started early, so that it has matplotlib loaded when
there is something to draw, and is given each part of the figures as soon as its numbers are there. It ends with the
process that started it, however that ends. Where it cannot be started, or is killed, what is missing is done here.

Where nothing runs beside the command yet, it is a fork: what a program loads takes longer than a film. Later a fork
would copy locks that other threads hold, and the program is loaded anew.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from postflight.streams import leave_arrow_out, return_large_arrays

if TYPE_CHECKING:  # the process decides first how pandas is loaded
    import pandas as pd

    from estimators.camera import FilmFit
    from estimators.fusing import CameraTimeBias
    from postflight.deflections import Deflections
    from postflight.filming import CameraAnswer
    from postflight.flight import Flight
    from postflight.flown_coefficients import AeroIncrements
    from postflight.reconstruction import Reconstruction
    from postflight.studies.preflight import Bounds

_THREADS = Path("/proc/self/task")  # of this process, those of libraries too; of Linux alone
_Part = Literal["trajectory", "deflections", "studies"]  # functions draw_... of `postflight.plots.run_figures`
_Warnings = list[tuple[type[Warning], str]]


class SecondProcess:
    """A process that works beside this one: use as a context, best before any thread is started.

    `close` it before the folder that it draws into is left.

    Parameters
    ----------
    draws : bool
        Whether it will draw: it makes ready for that.
    """

    def __init__(self, draws: bool = False) -> None:
        self._draws, self._figures = draws, Path()
        self._asked: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._flight: Reconstruction | None = None
        self._drawing: list[tuple[_Part, tuple[Any, ...]]] = []
        self._reading, self._fuses, self._tests = False, False, False

    def __enter__(self) -> SecondProcess:
        """Start it."""
        self._here, there = multiprocessing.Pipe()
        self._process = _made(there, self._here, self._draws)
        with contextlib.suppress(OSError):
            self._process.start()
        there.close()
        self._sender = ThreadPoolExecutor(1)  # the other may not be ready to take it
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        """End it, also in the middle of its work."""
        self.close()

    def close(self) -> None:
        """End it, also in the middle of its work; once it has ended, do nothing."""
        if self._process.pid is not None:
            self._process.terminate()
            self._process.join()
        self._sender.shutdown(cancel_futures=True)
        self._here.close()

    def read_film(self, flight: Flight, fuses: bool = False) -> None:
        """Let it read the film of a flight's one camera; with the trajectory it then has the camera's answer.

        For an answer that ``fuses`` it also tests the camera's time bias.
        """
        self._reading, self._fuses = True, fuses
        self._send(("film", (flight,)))

    def camera(self) -> CameraAnswer | None:
        """What the camera answers, once it does; None where that was not asked for or could not be done."""
        found: CameraAnswer | None = None
        if self._reading:
            self._reading = False
            with contextlib.suppress(EOFError, OSError):
                found = self._here.recv()
        return found

    def time_bias(self) -> tuple[CameraTimeBias | None] | None:
        """Camera time bias as tested, after `camera`; None where that was not asked for or could not be done."""
        found: tuple[CameraTimeBias | None, _Warnings] | None = None
        if self._tests:
            self._tests = False
            with contextlib.suppress(EOFError, OSError):
                found = self._here.recv()
        if found is None:
            return None
        _warn(found[1])
        return (found[0],)

    def ask(self, work: Callable[..., Any], *arguments: Any) -> None:
        """Let it call a function, which is found by its module and name."""
        self._asked.append((work, arguments))
        self._send(("work", (work, arguments)))

    def answer(self) -> Any:
        """What the earliest function that was asked for returns; called here where the other process failed."""
        work, arguments = self._asked.pop(0)
        found: tuple[Any, _Warnings] | None = None
        with contextlib.suppress(EOFError, OSError):
            found = self._here.recv()
        if found is None:  # an error, too, is raised here
            return work(*arguments)
        _warn(found[1])
        return found[0]

    def draw_trajectory(self, flight: Reconstruction, figures: Path) -> None:
        """Let it draw the trajectory into a folder, as all that follows; the camera's answer comes first."""
        self._flight, self._figures = flight, figures
        self._send(("flight", (flight, figures)))
        if self._reading:
            self._send(("camera", ()))
            self._tests = self._fuses
            if self._tests:
                self._send(("time bias", ()))
        self._draw("trajectory")

    def draw_deflections(self, answers: Deflections) -> None:
        """Let it draw the answers; after the trajectory."""
        self._draw("deflections", replace(answers, bet=None))  # which it has

    def draw_studies(
        self, bounds: Bounds | None, reran: pd.DataFrame | None, increments: AeroIncrements | None = None
    ) -> None:
        """Let it draw Figure 1.3, the sensitivity and the aerodynamic increments; after the trajectory."""
        self._draw("studies", bounds, reran, increments)

    def finish(self) -> None:
        """Wait until everything is drawn; warnings of the other process are given here.

        Raises
        ------
        OSError
            Where it could not write a file.
        """
        self.camera()
        self.time_bias()
        for part, arguments in self._drawing:
            try:
                found: _Warnings | OSError = self._here.recv()
            except (EOFError, OSError):
                _draw(part, self._flight, self._figures, arguments)
                continue
            if isinstance(found, OSError):
                raise found
            _warn(found)

    def _draw(self, part: _Part, *arguments: Any) -> None:
        self._drawing.append((part, arguments))
        self._send((part, arguments))

    def _send(self, what: Any) -> None:
        # where nobody receives, those who wait for an answer find out
        self._sender.submit(self._here.send_bytes, ForkingPickler.dumps(what))


def _made(there: Connection, here: Connection, draws: bool) -> Any:
    """The process, not started yet: a fork where this thread is the only one."""
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):  # an interrupt that waits for the end of an import: it comes first
            thread.join()
    forks = _THREADS.is_dir() and len(list(_THREADS.iterdir())) == 1
    context: Any = multiprocessing.get_context("fork" if forks else "spawn")  # there is no type for both
    return context.Process(target=_serve, args=(there, here if forks else None, draws), daemon=True)


def _warn(given: _Warnings) -> None:
    for category, words in given:
        warnings.warn(category(words), stacklevel=3)


def _draw(part: _Part, flight: Reconstruction | None, figures: Path, arguments: tuple[Any, ...]) -> None:
    from postflight.plots import run_figures

    getattr(run_figures, f"draw_{part}")(flight, figures, *arguments)


def _drawn(part: _Part, flight: Reconstruction | None, figures: Path, arguments: tuple[Any, ...]) -> Any:
    """Draw, and return the warnings, or why a file could not be written."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            _draw(part, flight, figures, arguments)
        except OSError as fault:
            return fault
    return [(one.category, str(one.message)) for one in given]


def _answered(work: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, _Warnings] | None:
    """What a function returns, and the warnings; None where it raises an error."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            found = work(*arguments)
        except Exception:  # the first process calls it again, and has the error
            return None
    return found, [(one.category, str(one.message)) for one in given]


def _film(flight: Flight) -> FilmFit | None:
    """What the film shows; None where it cannot be used, which the first process then finds out and says."""
    from flightmodel.checks import GateError
    from postflight.filming import camera_film

    try:
        return camera_film(flight)
    except (GateError, OSError):
        return None


def _camera(bet: Reconstruction | None, film: FilmFit | None) -> CameraAnswer | None:
    """What the camera answers with a trajectory; None as of `_film`."""
    from flightmodel.checks import GateError
    from postflight.filming import camera_answer

    try:
        return None if bet is None or film is None else camera_answer(bet.flight, bet, film=film)
    except (GateError, OSError):
        return None


def _time_bias(bet: Reconstruction, seen: CameraAnswer) -> CameraTimeBias | None:
    from estimators.fusing import time_bias_if_free

    return time_bias_if_free(bet.required_loads(), seen.plain)


def _serve(connection: Connection, other_end: Connection | None, draws: bool) -> None:
    """Be ready, do what is asked in its order, and send back what came of it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C is for the process that started this one
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a fork has the command's own
    if other_end is not None:  # a fork's copy: with it open, the end of the other process would not be seen
        other_end.close()
    leave_arrow_out()
    if draws:  # of a reconciliation's arrays `return_large_arrays` is no use
        return_large_arrays()
    film: FilmFit | None = None
    flight: Reconstruction | None = None
    seen: CameraAnswer | None = None
    figures = Path()
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            if draws and not connection.poll():
                import postflight.plots.run_figures  # noqa: F401 - makes ready while nothing is asked
            kind, arguments = connection.recv()
            if kind == "film":
                film = _film(*arguments)
            elif kind == "flight":
                flight, figures = arguments
            elif kind == "work":
                connection.send(_answered(*arguments))
            elif kind == "camera":
                seen = _camera(flight, film)
                connection.send(seen)
            elif kind == "time bias":
                connection.send(_answered(_time_bias, (flight, seen)))
            else:
                connection.send(_drawn(kind, flight, figures, arguments))
