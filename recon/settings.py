"""Which settings does a reconstruction have? Each with its type, allowed values and default.

The same names are the keys of ``[reconstruction]`` in flight.toml; `Settings.from_mapping` reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, StrictStr, TypeAdapter, ValidationError

from flightmodel.checks import ConfigError, Issue, nearest_name
from flightmodel.tables import ordered_spans

COMPILED, FILTERPY = ENGINES = ("compiled", "filterpy")  # of `recon.kalman`
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]  # whole ones too, but no text and no true or false
Whole = Annotated[Number, Field(multiple_of=1.0), AfterValidator(int)]
Rate = Annotated[Number, Field(ge=0.1, le=1000.0)]
Zero = Annotated[Number, Field(ge=0.0, le=0.0)]
Probability = Annotated[Number, Field(ge=0.5, lt=1.0)]
Spans = Annotated[tuple[tuple[Number, Number], ...], AfterValidator(ordered_spans)]
Engine = Annotated[
    Literal["compiled", "filterpy"], BeforeValidator(lambda name: FILTERPY if name == "readable" else name)
]


def _allowed(words: str, code: str = "value-range") -> dict[str, str]:
    return {"allowed": words, "code": code}


@cache
def _rules() -> dict[str, TypeAdapter[Any]]:
    """Types of the settings, as they are checked."""
    return {name: TypeAdapter(kind) for name, kind in get_type_hints(Settings, include_extras=True).items()}


@dataclass(frozen=True)
class Settings:
    """Settings of a reconstruction.

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
        measured deceleration filtered, whatever is set (`recon.first_passes.needs_no_reference`).
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
        ``"compiled"`` or ``"filterpy"``: the same answer, the second much slower (`recon.kalman`).

    Raises
    ------
    ConfigError
        With every value that is not allowed.
    """

    output_rate_hz: Rate = field(default=20.0, metadata=_allowed("0.1 to 1000"))
    pulse_rate_hz: Zero | Rate = field(default=0.0, metadata=_allowed("0 (none) or 0.1 to 1000"))
    start_s: Number | None = field(default=None, metadata=_allowed("a time in s"))
    end_s: Number | None = field(default=None, metadata=_allowed("a time in s"))
    carry_on_s: Annotated[Number, Field(ge=0.0, le=1e5)] = field(default=0.0, metadata=_allowed("0 to 100000"))
    passes: Annotated[Whole, Field(ge=0, le=10)] = field(default=3, metadata=_allowed("0 to 10"))
    gate_probability: Probability = field(default=0.9999, metadata=_allowed("0.5 to 1 (1 excluded)"))
    check_confidence: Probability = field(default=0.999, metadata=_allowed("0.5 to 1 (1 excluded)"))
    angle_noise: Literal["traverse", "axis"] = field(
        default="traverse", metadata=_allowed("one of traverse, axis", "value-range")
    )
    consider: tuple[StrictStr, ...] = field(default=(), metadata=_allowed("a list of names"))
    without: tuple[StrictStr, ...] = field(default=(), metadata=_allowed("a list of names"))
    hold_out_every: Annotated[Zero, AfterValidator(int)] | Annotated[Whole, Field(ge=2, le=1000)] = field(
        default=0, metadata=_allowed("0 (none) or 2 to 1000")
    )
    hold_out_spans_s: Spans = field(
        default=(), metadata=_allowed("a list of spans [from, to] in s that end after they begin")
    )
    attitude_sensors: StrictBool = field(default=False, metadata=_allowed("true or false"))
    engine: Engine = field(default="compiled", metadata=_allowed(f"one of {', '.join(ENGINES)}", "value-range"))

    def __post_init__(self) -> None:
        """Check every value once."""
        faults = []
        for setting in fields(self):
            value, allowed = getattr(self, setting.name), setting.metadata["allowed"]
            try:
                object.__setattr__(self, setting.name, _rules()[setting.name].validate_python(value))
            except ValidationError:
                shown, code = f"'{value}'" if isinstance(value, str) else f"{value}", setting.metadata["code"]
                known = allowed.removeprefix("one of ").split(", ") if code == "value-range" else ()
                faults.append(Issue(f"{setting.name} {shown}{nearest_name(str(value), known)} must be {allowed}", code))
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
            Issue(
                f"[reconstruction] {key}{nearest_name(key, names)}: no such setting; known: {', '.join(names)}",
                "name-unknown",
            )
            for key in values
            if key not in names
        ]
        try:
            chosen = cls(**{key: value for key, value in values.items() if key in names})  # type: ignore[arg-type]
        except ConfigError as wrong:
            faults += [Issue(f"[reconstruction] {fault}", fault.code) for fault in wrong.faults]
        if faults:
            raise ConfigError(faults)
        return chosen
