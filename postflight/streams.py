"""How does text from files reach standard output? Without control characters, and without failing on a closed stream.

A name in a delivery may hold escape sequences that rewrite what stands above, or bidirectional marks that show a number
backwards; a reader such as `head` may close its end of the pipe, a log may take ASCII only. Beside the streams of a
command's process stand its threads.
"""

from __future__ import annotations

import os
import sys
import unicodedata
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TextIO, TypeVar

_HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # control, format (bidi, zero width), half a character, line ends
_KEPT = {"\n", "\t"}
_P = ParamSpec("_P")
_R = TypeVar("_R")


def visible(text: str) -> str:
    """Text with ``?`` in place of every invisible control or format character."""
    if text.isascii() and text.isprintable():
        return text
    return "".join("?" if unicodedata.category(c) in _HIDDEN and c not in _KEPT else c for c in text)


def write_out(text: str, stream: TextIO | None = None) -> None:
    """Write text to standard output or another stream; discard it if the reader has gone."""
    stream = stream or sys.stdout
    try:
        stream.write(visible(text))
        stream.flush()
    except BrokenPipeError:
        into_nothing(stream)


def into_nothing(stream: Any) -> None:
    """Redirect a stream's buffered and future output to the null device."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, stream.fileno())
    os.close(nothing)


def open_streams() -> None:
    """Make standard streams such that no character and no closed descriptor can end a command."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed by the caller: the next file opened would take its number, and be printed into
            os.open(os.devnull, os.O_RDWR)
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream: TextIO | None = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def close_streams() -> None:
    """Flush buffered output; a closed pipe is not an error."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            into_nothing(stream)


# threads of linear algebra: sums of several round otherwise than sums of one, and bytes would depend on the cores

# read by the libraries behind numpy and scipy when they are loaded
THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def pin_threads() -> None:
    """Limit linear algebra of this process and its children to one thread; before numpy is imported."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))


def on_one_thread(work: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a function's linear algebra run on one thread, however it was started.

    Its matrices are banded or small, and there are hundreds: two threads that wait for each other take twice as long
    for one where nothing else runs, and hundreds of times on a busy machine.
    """

    @wraps(work)
    def limited(*arguments: _P.args, **named: _P.kwargs) -> _R:
        from threadpoolctl import threadpool_limits  # after what it is to find

        with threadpool_limits(limits=1, user_api="blas"):
            return work(*arguments, **named)

    return limited
