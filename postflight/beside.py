"""How does work run beside a command? In processes of `concurrent.futures`, which end with the command's own.

`Beside` is one process for whatever need not be waited for: the film is read and tested while the trajectory is
estimated, and figures are drawn as soon as their numbers are there. Where it cannot be started, or is killed, or its
work fails, the same function is called here instead, when its result is asked for: the answers are the same.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pkgutil
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cached_property
from itertools import count
from multiprocessing.connection import wait
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Generic, TypeVar

from postflight.streams import THREAD_VARIABLES, pin_threads

T = TypeVar("T")
_KEPT: dict[int, Any] = {}  # results of a worker process by the number of their task


@contextlib.contextmanager
def worker_pool(workers: int, start: str = "spawn") -> Iterator[ProcessPoolExecutor]:
    """Pool of processes with one thread of linear algebra each; unfinished work is stopped at the end."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context(start), initializer=_begin)
    pin_threads()
    try:
        yield pool
    finally:
        for process in (pool._processes or {}).values():
            process.terminate()
        # a pipe full of jobs that nobody reads any more would hold the pool's thread for ever (CPython's issue 94777)
        if (jobs := getattr(pool, "_call_queue", None)) is not None:
            jobs._reader.close()
        # waits for the pool's own thread too: one that still ends while Python does closes a pipe that Python writes to
        pool.shutdown(cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def start_method() -> str:
    """Return the start method of processes: fork only if this is the sole thread, since a fork copies held locks.

    A fork has what this process loaded, which takes longer to load than a film to read.
    """
    threads = Path("/proc/self/task")  # those of libraries too; of Linux alone
    return "fork" if threads.is_dir() and len(list(threads.iterdir())) == 1 else "spawn"


def _begin() -> None:
    """Prepare a worker process: its parent handles Ctrl-C, and it ends with its parent, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a fork has the command's own
    parent = multiprocessing.parent_process()
    assert parent is not None
    sentinel = parent.sentinel

    def follow() -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


class Task(Generic[T]):
    """Task submitted to a `Beside`; as an argument of later tasks it stands for its result, kept in the worker."""

    def __init__(self, number: int, work: Callable[..., T] | str, arguments: tuple[Any, ...]) -> None:
        self._number, self._work, self._arguments = number, work, arguments
        self.future: Future[tuple[Any, list[tuple[type[Warning], str]]] | None] | None = None

    def __reduce__(self) -> tuple[Callable[[int], Any], tuple[int]]:
        return _kept, (self._number,)

    def result(self) -> T:
        """Return the result and issue its warnings; the work is repeated here if the worker process failed."""
        return self._result

    @cached_property
    def _result(self) -> T:
        done = None
        if self.future is not None:
            with contextlib.suppress(BrokenProcessPool, CancelledError):
                done = self.future.result()
        if done is None:
            return _call(self._work, [a.result() if isinstance(a, Task) else a for a in self._arguments])
        for category, words in done[1]:
            warnings.warn(category(words), stacklevel=4)
        return done[0]


class Beside:
    """One process that works beside this one: use as a context, or `close` it before the folder that it writes into."""

    def __init__(self) -> None:
        self._ending = contextlib.ExitStack()
        self._pool = self._ending.enter_context(worker_pool(1, start_method()))
        self._numbers = count()

    def __enter__(self) -> Beside:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process, even in the middle of its work."""
        self.close()

    def close(self) -> None:
        """End the process, even in the middle of its work; do nothing if it has ended."""
        self._ending.close()

    def submit(self, work: Callable[..., T] | str, *arguments: Any) -> Task[T]:
        """Run a function in the worker, or one named ``module:function``, which is not imported here."""
        return self._begun(Task(next(self._numbers), work, arguments), True)

    def keep(self, work: Callable[..., T] | str, *arguments: Any) -> Task[T]:
        """Run a function in the worker and keep its result there as an argument of later tasks."""
        return self._begun(Task(next(self._numbers), work, arguments), False)

    def _begun(self, task: Task[T], wanted: bool) -> Task[T]:
        # packed now: the pool would do so in a thread, while here what is computed on demand is added to arguments
        job = bytes(ForkingPickler.dumps((task._work, task._arguments)))
        with contextlib.suppress(OSError, BrokenProcessPool):
            task.future = self._pool.submit(_answered, task._number, job, wanted)
        return task


def same(value: T) -> T:
    """Return the argument unchanged: with `Beside.keep`, several tasks can use it."""
    return value


def _kept(number: int) -> Any:
    return _KEPT[number]


def _call(work: Callable[..., Any] | str, arguments: Any) -> Any:
    return (pkgutil.resolve_name(work) if isinstance(work, str) else work)(*arguments)


def _answered(number: int, job: bytes, wanted: bool) -> tuple[Any, list[tuple[type[Warning], str]]] | None:
    """Result and warnings of a job in the worker; None if it raises, in which case the parent process repeats it."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            _KEPT[number] = _call(*ForkingPickler.loads(job))
        except Exception:
            return None
    return _KEPT[number] if wanted else None, [(one.category, str(one.message)) for one in given]
