"""What may pass a gate: exceptions and checks of arrays where data enter the toolkit.

Public entry points check once and then trust; compiled kernels check nothing.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from numbers import Integral
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Progress = Callable[[float, str], None]  # fraction done, and what is being done


T_co = TypeVar("T_co", covariant=True)


class Result(Protocol[T_co]):
    """What has, or will have, a result: a `concurrent.futures.Future`, or work in another process."""

    def result(self) -> T_co:
        """Wait for it."""
        ...


def part_of(report: Progress, first: float, last: float) -> Progress:
    """Progress callback of a subtask that covers the fractions ``first`` to ``last`` of the whole task."""
    return lambda fraction, what: report(first + (last - first) * fraction, what)


class Issue(str):
    """Something that is said of data, a model or an answer: its words, with a stable code, its source and its span.

    A refusal, a finding or a suspicion. It is a text: ``str(issue)`` gives its words.

    Parameters
    ----------
    words : str
        What is said, with the value and what to try; of a refusal also where: file and line, or source and time.
    code : str
        Lower-case words joined by hyphens (``"data-gap"``), for scripts and tests. The words may be edited freely; the
        code stays. Where none is given, that of the words is kept.
    source : str or tuple of str
        Sensor, file or model that it is about; empty where the words say it.
    start_s, end_s : float
        Span that it is about; NaN where it is not about a time.
    """

    code: str
    source: str
    sources: tuple[str, ...]
    start_s: float
    end_s: float

    def __new__(
        cls, words: str, code: str = "", source: str | tuple[str, ...] = "", start_s: float = nan, end_s: float = nan
    ) -> Issue:
        """Text with its code and place."""
        issue = super().__new__(cls, words)
        issue.code = code or getattr(words, "code", "")
        issue.sources = (source,) * bool(source) if isinstance(source, str) else source
        issue.source, issue.start_s, issue.end_s = ", ".join(issue.sources), start_s, end_s
        return issue

    @property
    def what(self) -> str:
        """Its words alone."""
        return str(self)

    @property
    def line(self) -> str:
        """Source, words and span, for tables and logs."""
        if not isfinite(self.start_s):
            return f"{self.source}: {self}"
        first, last = f"{self.start_s:.3f}", f"{self.end_s:.3f} s"
        return f"{self.source}: {self} ({f'at {last}' if self.end_s == self.start_s else f'{first} to {last}'})"

    def as_row(self) -> dict[str, str | float]:
        """Columns of ``findings.csv``."""
        named = "source", "what", "start_s", "end_s", "code"
        return {name: getattr(self, name) for name in named}


NO_FAULT = Issue("")


@dataclass(frozen=True)
class Check:
    """One statistic, the band it should lie in, whether it does, and what follows.

    Parameters
    ----------
    code : str
        Short and stable: ``"nis"``, ``"whiteness"``, ...
    name : str
        The statistic and what it is of.
    value, low, high : float
    passed : bool
    remark : str
        What was found and, where the check failed, what that means and what to check.
    source : str
        Tracker or sensor that it is about; empty where it is about the flight.
    component : str
        Component or error of that source that it is about.
    symptom : str
        What was found, without what follows.
    """

    code: str
    name: str
    value: float
    low: float
    high: float
    passed: bool
    remark: str
    source: str = ""
    component: str = ""
    symptom: str = ""

    @classmethod
    def of(
        cls, code: str, name: str, value: float, low: float, high: float, good: str, bad: str,
        *, advice: str = "", source: str = "", component: str = "",
    ) -> Check:  # fmt: skip
        """Check with the symptom that fits, ``good`` or ``bad``; ``advice`` follows where it failed."""
        passed = bool(low <= value <= high)
        symptom = good if passed else bad
        remark = f"{symptom}: {advice}" if advice and not passed else symptom
        return cls(code, name, float(value), float(low), float(high), passed, remark, source, component, symptom)


class GateError(ValueError):
    """Data refused at a gate; carries every fault found, one line each.

    Parameters
    ----------
    faults : str or sequence of str
        Each: what is wrong, where (file and line, or source and time), and what to try; an `Issue` has its own code.
    code : str
        Code of those faults that have none of their own.
    """

    exit_code = 3

    def __init__(self, faults: str | Sequence[str], code: str = "") -> None:
        listed = (faults,) if isinstance(faults, str) else tuple(faults)
        self.faults: tuple[Issue, ...] = tuple(Issue(words, getattr(words, "code", "") or code) for words in listed)
        super().__init__("\n".join(self.faults))

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the faults, in their order."""
        return tuple(fault.code for fault in self.faults)


class ConfigError(GateError):
    """A configuration file (flight, vehicle, scenario) or an option that cannot be used."""

    exit_code = 2


class TableRangeError(GateError):
    """A look-up outside the range of its table; nothing is extrapolated in silence."""


class DivergenceError(GateError):
    """The simulated vehicle tumbled or its joint diverged where the caller needs a bounded flight."""


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return ``" (did you mean 'x'?)"`` for a misspelt name, or an empty string."""
    folded = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(name.lower(), list(folded), n=1, cutoff=0.5)
    return f" (did you mean '{folded[close[0]]}'?)" if close else ""


def check_type(name: str, value: object, kinds: type | tuple[type, ...], made_by: str) -> None:
    """Raise `GateError` where an argument of the public interface is of another type; say what makes the right one."""
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
        given = type(value).__name__
        raise GateError(f"{name}: {wanted} wanted ({made_by}), {given} given", code="argument-type")


def check_path(name: str, value: str | Path) -> Path:
    """Return the path, or raise `GateError` where an argument of the public interface is none."""
    check_type(name, value, (str, Path), "the path of a folder")
    return Path(value)


def check_whole(name: str, value: int | None, low: int) -> None:
    """Raise `ConfigError` where an argument of the public interface is no whole number from ``low``; None is none."""
    if value is not None and (isinstance(value, bool) or not isinstance(value, Integral) or value < low):
        raise ConfigError(f"{name} = {value!r}: a whole number from {low} is wanted", code="value-range")


def check_shape(name: str, array: FloatArray, shape: tuple[int | None, ...]) -> FloatArray:
    """Return ``array`` as contiguous float64, or raise `GateError` where its shape differs.

    ``None`` in ``shape`` accepts any length of that axis.
    """
    out = np.ascontiguousarray(array, dtype=np.float64)
    fits = out.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, out.shape, strict=True))
    if not fits:
        raise GateError(f"{name}: shape {out.shape} where {shape} is wanted", code="argument-value")
    return out


def check_finite(name: str, array: FloatArray, or_missing: bool = False) -> None:
    """Raise `GateError` naming the first entry that is NaN or infinite; with ``or_missing`` NaN is a missing value."""
    bad = np.isinf(array) if or_missing else ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise GateError(
            f"{name}: {int(bad.sum())} values are not finite, the first at index {first}", code="not-finite"
        )


def check_increasing(name: str, time_s: FloatArray) -> None:
    """Raise `GateError` where times do not strictly increase."""
    step = np.diff(time_s)
    if (step <= 0).any():
        k = int(np.argmax(step <= 0))
        raise GateError(
            f"{name}: time does not increase at index {k + 1}: {time_s[k]:.6f} s then {time_s[k + 1]:.6f} s",
            code="argument-value",
        )


def check_unit_quaternion(name: str, q: FloatArray) -> None:
    """Raise `GateError` where a quaternion's norm differs from one by more than a millionth."""
    off = np.abs(np.linalg.norm(q, axis=-1) - 1.0)
    if (off > 1e-6).any():
        raise GateError(f"{name}: not a unit quaternion (norm off by {float(off.max()):.2e})", code="argument-value")


def check_positive_definite(name: str, matrix: FloatArray) -> None:
    """Raise `GateError` where a symmetric matrix has an eigenvalue that is not positive."""
    lowest = float(np.linalg.eigvalsh(matrix).min())
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0) or lowest <= 0.0:
        raise GateError(
            f"{name}: not symmetric positive definite (lowest eigenvalue {lowest:.3g})", code="argument-value"
        )
