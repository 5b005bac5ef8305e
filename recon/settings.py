"""What may an analyst choose about a reconstruction? Every setting with its type, allowed values and default, once.

The same names are the keys of ``[reconstruction]`` in flight.toml; `Settings.from_mapping` reads them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any

from flightmodel.checks import ConfigError, Fault, nearest_name

COMPILED, FILTERPY = ENGINES = ("compiled", "filterpy")  # of `recon.ekf` and `recon.smoother`
_SYNONYMS = {"readable": FILTERPY}  # of an engine


def _setting(default: object, allowed: str, convert: Callable[[Any], object], code: str = "setting-range") -> Any:
    """Declare a setting; ``convert`` gives the value as it is kept, or raises `ValueError` or `TypeError`."""
    return field(default=default, metadata={"allowed": allowed, "convert": convert, "code": code})


def _as_number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise TypeError
    return float(value)


def _number(
    default: float, low: float, high: float, also: float | None = None, below: bool = False, whole: bool = False
) -> Any:
    """A number from ``low`` to ``high`` (``below`` it where asked), or ``also``, which means none."""

    def convert(value: Any) -> float:
        number = _as_number(value)
        if number != also and not (low <= number < high if below else low <= number <= high):
            raise ValueError
        if whole and number != int(number):
            raise ValueError
        return int(number) if whole else number

    none, end = "" if also is None else f"{also:g} (none) or ", " (1 excluded)" if below else ""
    return _setting(default, f"{none}{low:g} to {high:g}{end}", convert)


def _time() -> Any:
    return _setting(None, "a time in s", lambda value: None if value is None else _as_number(value))


def _flag(default: bool) -> Any:
    def convert(value: Any) -> bool:
        if not isinstance(value, bool):
            raise TypeError
        return value

    return _setting(default, "true or false", convert)


def _choice(default: str, known: tuple[str, ...], synonyms: Mapping[str, str] | None = None) -> Any:
    def convert(value: Any) -> str:
        name = (synonyms or {}).get(value, value) if isinstance(value, str) else ""
        if name not in known:
            raise ValueError(nearest_name(str(value), known))
        return name

    return _setting(default, f"one of {', '.join(known)}", convert, "setting-choice")


def _names() -> Any:
    def convert(value: Any) -> tuple[str, ...]:
        if not isinstance(value, (list, tuple)) or not all(isinstance(name, str) for name in value):
            raise TypeError
        return tuple(value)

    return _setting((), "a list of names", convert)


def _spans() -> Any:
    def convert(value: Any) -> tuple[tuple[float, float], ...]:
        spans = tuple((_as_number(a), _as_number(b)) for a, b in value)
        if not all(a < b for a, b in spans):
            raise ValueError
        return spans

    return _setting((), "a list of spans [from, to] in s that end after they begin", convert)


@dataclass(frozen=True)
class Settings:
    """What an analyst may choose.

    Parameters
    ----------
    output_rate_hz : float
        Of the trajectories.
    pulse_rate_hz : float
        Of the trajectories where the specific force exceeds half of the descent's largest; 0 for no other rate there,
        so that equal spans have equal times. A flight's own settings have 50 where flight.toml states none.
    start_s, end_s : float or None
        Span; the data's own common span where None.
    carry_on_s : float
        How long the trajectory goes on after the last measurement of the trackers, by inertial sensors or ballistic.
    passes : int
        Largest number of forward passes over all data. The first filter runs on thinned data about its own estimate,
        iterated until attitudes converge; each pass over all data is linearised about the smoothed trajectory before
        it, and another follows only where one moved the result by more than a hundredth of its standard deviation.
        With 0, a single extended Kalman filter over all data about its own estimate; so is a ballistic flight with a
        measured deceleration filtered, whatever is set (`recon.linearisation.needs_no_reference`).
    gate_probability : float
        A measurement is edited where its normalised innovation squared is beyond this chi-square quantile.
    check_confidence : float
        Two-sided confidence of each consistency check.
    angle_noise : str
        ``"traverse"`` or ``"axis"``, see `recon.measurements`.
    consider : tuple of str
        Errors that are not estimated but whose effect stays in the covariance (Schmidt): ``"accelerometer mount"``, ...
    without : tuple of str
        Sources (radars, receivers, barometers; ``"magnetometer"``, ``"sun1"``, ... where attitude sensors are on) that
        are predicted but never used, not even for the start.
    hold_out_every : int
        Every so many measurements of each tracker one is held out: predicted but not used; 0 for none.
    hold_out_spans_s : tuple of (float, float)
        Spans in which all trackers are held out.
    attitude_sensors : bool
        Whether magnetometer and Sun sensors are measurements too; otherwise they only start and check the attitude.
    engine : str
        ``"compiled"`` or ``"filterpy"``: the same answer, the second much slower (`recon.ekf`).

    Raises
    ------
    ConfigError
        With every value that is not allowed.
    """

    output_rate_hz: float = _number(20.0, 0.1, 1000.0)
    pulse_rate_hz: float = _number(0.0, 0.1, 1000.0, also=0.0)
    start_s: float | None = _time()
    end_s: float | None = _time()
    carry_on_s: float = _number(0.0, 0.0, 1e5)
    passes: int = _number(3, 0, 10, whole=True)
    gate_probability: float = _number(0.9999, 0.5, 1.0, below=True)
    check_confidence: float = _number(0.999, 0.5, 1.0, below=True)
    angle_noise: str = _choice("traverse", ("traverse", "axis"))
    consider: tuple[str, ...] = _names()
    without: tuple[str, ...] = _names()
    hold_out_every: int = _number(0, 2, 1000, also=0, whole=True)
    hold_out_spans_s: tuple[tuple[float, float], ...] = _spans()
    attitude_sensors: bool = _flag(False)
    engine: str = _choice(COMPILED, ENGINES, _SYNONYMS)

    def __post_init__(self) -> None:
        """Check every value once."""
        faults = []
        for setting in fields(self):
            value, rule = getattr(self, setting.name), setting.metadata
            try:
                object.__setattr__(self, setting.name, rule["convert"](value))
            except (TypeError, ValueError, OverflowError) as wrong:
                shown = f"'{value}'" if isinstance(value, str) else f"{value}"
                hint = str(wrong) if rule["code"] == "setting-choice" else ""
                faults.append(Fault(f"{setting.name} {shown}{hint} must be {rule['allowed']}", rule["code"]))
        if faults:
            raise ConfigError(faults)

    @classmethod
    def from_mapping(cls, values: Mapping[str, object]) -> Settings:
        """Settings from keys and values, as of ``[reconstruction]`` in flight.toml; the rest have their defaults.

        Raises
        ------
        ConfigError
            With every unknown key (and the nearest known one) and every value that is not allowed.
        """
        names = [setting.name for setting in fields(cls)]
        faults = [
            Fault(
                f"[reconstruction] {key}{nearest_name(key, names)}: no such setting; known: {', '.join(names)}",
                "setting-unknown",
            )
            for key in values
            if key not in names
        ]
        try:
            chosen = cls(**{key: value for key, value in values.items() if key in names})  # type: ignore[arg-type]
        except ConfigError as wrong:
            faults += [Fault(f"[reconstruction] {fault}", fault.code) for fault in wrong.faults]
        if faults:
            raise ConfigError(faults)
        return chosen
