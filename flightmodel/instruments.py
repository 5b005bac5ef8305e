"""On which properties of an instrument must flight file, filter and simulator agree? Errors, mounting, keys.

Each instrument is one record in SI: where it sits, and one row an error. A row (`ErrorRow`) states the error's prior in
flight.toml, the error states it becomes in the filter, and the sizes from which the simulator draws it. From the rows
follow the keys of flight.toml (`RadarEntry`, ...), the filter's blocks (`recon.state`), the keys of a scenario
file and the lines of flight.toml that a synthetic flight gets (`synthetic_flight.instrument_errors`). What is left to
write for a new error is its partial derivative in `recon.measurements`.

Every error is a constant of the flight, normal about zero with the stated standard deviation, unless its row names a
time constant: then it is first-order Gauss-Markov. Standard deviations stand in files as an analyst writes them, angles
in degrees; records hold SI.

References
----------
Range Commanders Council 753-95 (error model of tracking radars).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, create_model

from flightmodel.checks import FloatArray, Issue
from flightmodel.config import Angle, Duration, ErrorAngle, Fraction, KeyFault, NonNegative, Place, Section
from flightmodel.earth import undulation_m
from flightmodel.tables import Declared, Source, Thinning


def _none_or_some(hertz: float) -> float:
    if 0.0 < hertz < 1e-3:
        raise ValueError("0 for none, or at least 0.001 Hz is wanted")
    return hertz


BUTTERWORTH = np.sqrt(0.5)  # damping of second-order filters and servos
Bandwidth = Annotated[float, Field(ge=0.0, le=1e5), AfterValidator(_none_or_some)]
Sd = Annotated[float, Field(ge=1e-12, le=1e6)]  # its square is a number that can be divided by
SdOrNone = Annotated[float, Field(ge=0.0, le=1e6)]
SlowClock = Annotated[float, Field(ge=0.0, le=60.0)]
Undulation = Annotated[float, Field(ge=-120.0, le=120.0)]  # of the geoid, whose extremes are -106 and +85 m
BodyAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
AXIS = {
    sign + name: factor * np.eye(3)[k] for k, name in enumerate("xyz") for sign, factor in (("+", 1.0), ("-", -1.0))
}
# sizes that a scenario may give: of triads in their own everyday unit, of lengths in metres
Size = Annotated[float, Field(ge=0.0, le=1e4)]
LateClock = Annotated[float, Field(ge=0.0, le=10.0)]
TimeConstant = Annotated[float, Field(ge=1e-3, le=1e6)]
SIMULATED = {
    "m": Size,
    "m/s": Size,
    "s": LateClock,
    "rad": ErrorAngle,
    "1": Fraction,
    "": Size,
}  # by the unit of the error

Response = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class ErrorRow:
    """One error of an instrument: how it is stated, estimated and simulated.

    Parameters
    ----------
    name : str
        Field of the instrument's record, SI: ``"droop_sd_rad"``.
    unit : str
        Of the error states, SI; ``"1"`` for a factor. Of a triad's signal, "" until `triad_table` names it.
    prior : float or None
        Default in flight.toml, in the file's unit.
    limits : type
        Numbers that flight.toml may state.
    states : tuple of str
        Error states of the filter, in its order; none for white noise.
    least : float or None
        The states are always there, with at least this standard deviation (SI). None: only where one is stated.
    time_constant : tuple of str, float, str
        Field of the record and flight.toml's key, its default there, s, and the scenario's key; empty for a constant.
    simulated : tuple of str or None
        The scenario's keys; several are independent errors which one prior covers. None: the file's key without
        ``_sd``. Empty: the simulator has no such error.
    required : bool
        The scenario must give the first of them; all others are 0 where it does not.
    step : str
        The scenario's key of a quantisation step, which stands in for noise of 0.
    left_out : bool
        Flight.toml of a synthetic flight does not hold it where it is 0.
    physical : (float, float) or None
        Range outside which the error cannot be, SI; None: any size is possible.
    response : tuple of int, callable; or None
        Component of the reading that the simulator adds it to, and what it adds there: of the error (1,), slant range
        m, azimuth and elevation rad (n,).
    """

    name: str
    unit: str
    prior: float | None
    limits: Any = SdOrNone
    states: tuple[str, ...] = ()
    least: float | None = None
    time_constant: tuple[str, float, str] = ("", 0.0, "")
    simulated: tuple[str, ...] | None = ()
    required: bool = False
    step: str = ""
    left_out: bool = False
    physical: tuple[float, float] | None = None
    response: tuple[int, Response] | None = None
    to_si: float = 1.0
    suffix: str = ""

    @property
    def key(self) -> str:
        """Key in flight.toml."""
        return (f"{self.name.removesuffix('_rad')}_deg" if self.name.endswith("_rad") else self.name) + self.suffix

    @property
    def scenario_keys(self) -> tuple[str, ...]:
        """Keys in a scenario file."""
        named = (self.key.replace("_sd", ""),) if self.simulated is None else self.simulated
        return tuple(key.replace("{suffix}", self.suffix) for key in named)

    @property
    def title(self) -> str:
        """Name of the error: ``"range scale"``."""
        return self.name.partition("_sd")[0].replace("_", " ")


def error_row(
    unit: str, prior: float | None, limits: Any = SdOrNone, at: Any = MISSING, late: bool = False, **row: Any
) -> Any:
    """Field of an instrument's record with its `ErrorRow`.

    ``at`` is the record's own default; ``late`` fields are given by keyword alone.
    """
    return field(default=at, kw_only=late, metadata={"row": ErrorRow("", unit, prior, limits, **row)})


@dataclass(frozen=True)
class InstrumentTable:
    """Rows of one kind of instrument, in the order in which the filter holds its states."""

    rows: tuple[ErrorRow, ...]

    @property
    def states(self) -> tuple[str, ...]:
        """Error states of the filter, all rows'."""
        return tuple(state for row in self.rows for state in row.states)

    def from_file(self, entry: BaseModel) -> dict[str, Any]:
        """Numbers of the record, SI, by its field's name, from an entry of flight.toml."""
        out: dict[str, Any] = {}
        for row in self.rows:
            stated = getattr(entry, row.key)
            out[row.name] = None if stated is None else float(stated * row.to_si)
            if row.time_constant[0]:
                out[row.time_constant[0]] = getattr(entry, row.time_constant[0])
        return out

    def from_scenario(self, section: BaseModel) -> dict[str, tuple[float, ...]]:
        """Sizes of the independent errors of each row that the simulator draws, SI, by its record's field.

        Time constants stand by their own names.
        """
        out = {row.name: tuple(getattr(section, key) * row.to_si for key in row.scenario_keys) for row in self.rows}
        constants = [row.time_constant for row in self.rows if row.time_constant[2]]
        return out | {name: (getattr(section, key),) for name, _, key in constants}

    def file_keys(self) -> dict[str, tuple[Any, float | None]]:
        """Type and default of each key of flight.toml."""
        out: dict[str, tuple[Any, float | None]] = {}
        for row in self.rows:
            out[row.key] = (row.limits if row.prior is not None else row.limits | None, row.prior)
            key, default, _ = row.time_constant
            if key:
                out[key] = (Duration, default)
        return out

    def scenario_keys(self) -> dict[str, tuple[Any, Any]]:
        """Type and default of each key of a scenario's section; ``...`` where it must be given."""
        out: dict[str, tuple[Any, Any]] = {}
        for row in self.rows:
            for k, key in enumerate(row.scenario_keys):
                out[key] = (SIMULATED[row.unit if not row.suffix else ""], ... if row.required and k == 0 else 0.0)
            _, default, key = row.time_constant
            if key:
                out[key] = (TimeConstant, default)
        return out


def with_keys(keys: dict[str, tuple[Any, Any]]) -> Callable[[type[Model]], type[Model]]:
    """Class decorator that adds keys to a section of a file; those that the class has itself stay as they are."""

    def added(section: type[Model]) -> type[Model]:
        new: dict[str, Any] = {key: form for key, form in keys.items() if not hasattr(section, key)}
        new = {key: form for key, form in new.items() if key not in section.model_fields}
        return create_model(
            section.__name__, __base__=section, __module__=section.__module__, __doc__=section.__doc__, **new
        )

    return added


def table_of(record: type) -> InstrumentTable:
    """Rows of an instrument's record, named and with the factor from the file's unit to SI."""
    rows = []
    for each in fields(record):
        if "row" in each.metadata:
            to_si = float(np.deg2rad(1.0)) if each.name.endswith("_rad") else 1.0
            rows.append(replace(each.metadata["row"], name=each.name, to_si=to_si))
    return InstrumentTable(tuple(rows))


@dataclass(frozen=True)
class InstrumentSpec:
    """What an instrument's table in flight.toml states: its ``name`` there, its place, and its errors, one row each."""

    name: str


@dataclass(frozen=True)
class TriadSpec(InstrumentSpec):
    """Three orthogonal sensors (accelerometers, rate gyros or magnetometers) on the centerbody.

    Parameters
    ----------
    position_from_datum_body_m : (3,) float
        Where the triad sits, body axes, m.
    dcm_body_sensor : (3, 3) float
        Nominal mounting: ``v_body = dcm_body_sensor @ v_sensor``.
    noise_sd, bias_sd, scale_sd, mount_sd_rad : float
        White noise per sample (m/s^2, rad/s or T), bias (hard iron with it), scale factor, mounting rotation per axis;
        one standard deviation each, as the data sheet gives them.
    time_bias_sd_s : float
        Of its clock: time tag minus true time, constant over a flight.
    resolution : float
        Quantisation step, m/s^2, rad/s or T; 0 for none.
    soft_iron_sd : float
        Of a magnetometer: elements of the symmetric matrix by which the vehicle's iron distorts the field.
    bias_wander_sd, bias_time_constant_s : float
        A second part of the bias that varies slowly (Gauss-Markov): its standard deviation, in the triad's unit, and
        time constant; 0 for none.
    """

    position_from_datum_body_m: FloatArray
    dcm_body_sensor: FloatArray
    noise_sd: float = error_row("", 0.0, Sd, simulated=None, required=True)
    bias_sd: float = error_row(
        "", 0.0, states=("bias x", "bias y", "bias z"), least=1e-9, simulated=None, required=True
    )
    scale_sd: float = error_row(
        "1", 0.003, states=("scale x", "scale y", "scale z"), least=1e-9, required=True,
        simulated=("scale", "scale_asymmetry"),
    )  # fmt: skip
    mount_sd_rad: float = error_row(
        "rad", 0.2, states=("mount x", "mount y", "mount z"), least=1e-9, required=True,
        simulated=("mount_deg", "nonorthogonality_deg"),
    )  # fmt: skip
    time_bias_sd_s: float = error_row("s", 0.001, at=0.0, late=True, states=("time bias",), simulated=None)
    resolution: float = error_row("", 0.0, at=0.0, simulated=None)
    soft_iron_sd: float = error_row(
        "1", 0.0, at=0.0, states=("soft iron xy", "soft iron xz", "soft iron yz"), simulated=None
    )
    bias_wander_sd: float = error_row(
        "", 0.0, at=0.0, simulated=("drift{suffix}",), left_out=True,
        time_constant=("bias_time_constant_s", 100.0, "drift_time_constant_s"),
    )  # fmt: skip
    bias_time_constant_s: float = np.inf


def _triad_table(unit: str, state_unit: str, to_si: float, without: tuple[str, ...], **changed: Any) -> InstrumentTable:
    """Rows of a triad whose signal is in ``unit`` in files; ``changed``: fields of rows that differ for this triad."""
    rows = []
    for row in table_of(TriadSpec).rows:
        if row.name in without:
            continue
        if row.unit == "":
            row = replace(row, unit=state_unit, to_si=to_si, suffix=f"_{unit}")
        rows.append(replace(row, **changed.get(row.name, {})))
    return InstrumentTable(tuple(rows))


ACCELEROMETER = _triad_table(
    "mps2", "m/s2", 1.0, ("soft_iron_sd",), noise_sd={"prior": 0.049}, bias_sd={"prior": 0.098}
)
RATES = _triad_table(
    "degps", "rad/s", float(np.deg2rad(1.0)), ("soft_iron_sd",),
    noise_sd={"prior": 0.05}, bias_sd={"prior": 0.05}, mount_sd_rad={"prior": 0.15},
)  # fmt: skip
MAGNETOMETER = _triad_table(
    "ut", "T", 1e-6, ("time_bias_sd_s",),
    noise_sd={"prior": 0.2}, bias_sd={"prior": 0.5, "simulated": ("bias_ut", "hard_iron_ut")},
)  # fmt: skip


@dataclass(frozen=True)
class RadarSite(InstrumentSpec):
    """A tracking radar: slant range, azimuth from true north, elevation, refraction removed.

    Parameters
    ----------
    latitude_rad, longitude_rad, height_m : float
        WGS-84.
    angle_servo_hz : float
        Bandwidth of the servo with which the antenna follows the target (`recon.measurements`); 0: it does not lag.

    All others are standard deviations, one row each.
    """

    latitude_rad: float
    longitude_rad: float
    height_m: float
    # white noise per sample; the angle's normal to the line of sight, so azimuth scatters 1 / cos E more
    range_sd_m: float = error_row("m", 5.0, Sd, simulated=("range_sd_m",), required=True, step="range_resolution_m")
    angle_sd_rad: float = error_row(
        "rad", 0.0086, Sd, simulated=("angle_sd_deg",), required=True, step="angle_resolution_deg"
    )
    # constants of the flight; over its arc an encoder's waves are hardly separable from a bias
    range_bias_sd_m: float = error_row("m", 3.0, states=("range bias",), least=1e-6, simulated=None, required=True)
    angle_bias_sd_rad: float = error_row(
        "rad", 0.003, states=("azimuth bias", "elevation bias"), least=1e-12, required=True,
        simulated=("angle_bias_deg", "encoder_once_deg", "encoder_twice_deg"),
    )  # fmt: skip
    time_bias_sd_s: float = error_row("s", 0.001, states=("time bias",), least=1e-12, simulated=None, required=True)
    # the pedestal: its tilt about north and about east (an exact rotation), then factors of its two axes
    mislevel_sd_rad: float = error_row(
        "rad", 0.0, at=0.0, states=("tilt north", "tilt east"), simulated=None, left_out=True
    )
    droop_sd_rad: float = error_row(
        "rad", 0.0, at=0.0, states=("droop",), simulated=None, left_out=True,
        response=(2, lambda error, _slant, _az, el: error * np.cos(el)),
    )  # fmt: skip
    skew_sd_rad: float = error_row(
        "rad", 0.0, at=0.0, states=("skew",), simulated=None, left_out=True,
        response=(1, lambda error, _slant, _az, el: error / np.cos(el)),
    )  # fmt: skip
    nonorthogonality_sd_rad: float = error_row(
        "rad", 0.0, at=0.0, states=("non-orthogonality",), simulated=None, left_out=True,
        response=(1, lambda error, _slant, _az, el: error * np.tan(el)),
    )  # fmt: skip
    # slow error of both angles, normal to the line of sight
    wander_sd_rad: float = error_row(
        "rad", 0.0, at=0.0, states=("traverse wander", "elevation wander"), simulated=None, left_out=True,
        time_constant=("wander_time_constant_s", 20.0, "wander_time_constant_s"),
    )  # fmt: skip
    wander_time_constant_s: float = 20.0
    # part of the air's refraction that is left in the elevations: 1 where nothing is known of a correction. Air bends
    # downwards only; N at the surface is at most 450, of which the model's 320 are 1 / 1.4
    refraction_sd: float = error_row(
        "1", 0.0, Annotated[float, Field(ge=0.0, le=10.0)], at=0.0, states=("refraction",),
        simulated=("refraction_left",), left_out=True, physical=(0.0, 1.4),
    )  # fmt: skip
    # range error over range: velocity of light, oscillator
    range_scale_sd: float = error_row(
        "1", 0.0, Annotated[float, Field(ge=0.0, le=0.1)], at=0.0, states=("range scale",), simulated=None,
        left_out=True, response=(0, lambda error, slant, _az, _el: error * slant),
    )  # fmt: skip
    # where the site is and where its azimuths start: stated minus true place, azimuth reading minus azimuth from north
    survey_sd_m: float = error_row("m", 0.0, at=0.0, states=("survey north", "survey east"), left_out=True)
    height_sd_m: float = error_row("m", 0.0, at=0.0, states=("survey height",), left_out=True)
    north_sd_rad: float = error_row("rad", 0.0, at=0.0, states=("north",), left_out=True)
    # Doppler: white noise, and an oscillator's constant offset
    range_rate_sd_mps: float = error_row("m/s", 0.1, Sd, at=0.1, simulated=("range_rate_sd_mps",), left_out=True)
    range_rate_bias_sd_mps: float = error_row(
        "m/s", 0.0, at=0.0, states=("range rate bias",), simulated=None, left_out=True
    )
    range_rate_wander_sd_mps: float = error_row(
        "m/s", 0.0, at=0.0, states=("range rate wander",), simulated=None, left_out=True,
        time_constant=("range_rate_wander_time_constant_s", 5.0, "range_rate_wander_time_constant_s"),
    )  # fmt: skip
    range_rate_wander_time_constant_s: float = 5.0
    # slow error of the range: its tracking loop, multipath, a beacon's delay with the signal's strength
    range_wander_sd_m: float = error_row(
        "m", 0.0, at=0.0, states=("range wander",), simulated=None, left_out=True,
        time_constant=("range_wander_time_constant_s", 20.0, "range_wander_time_constant_s"),
    )  # fmt: skip
    range_wander_time_constant_s: float = 20.0
    # of the angles behind an accelerating target: a fraction of the lag that the servo's bandwidth makes
    servo_lag_sd: float = error_row(
        "1", 0.0, Annotated[float, Field(ge=0.0, le=10.0)], at=0.0, states=("servo lag",), simulated=None,
        left_out=True, physical=(-1.0, np.inf),
    )  # fmt: skip
    # white noise of one angle, where the two differ; azimuth's normal to the line of sight too
    azimuth_sd_rad: float | None = error_row("rad", None, Sd, at=None)
    elevation_sd_rad: float | None = error_row("rad", None, Sd, at=None)
    angle_servo_hz: float = 0.0

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """Latitude and longitude, rad, and height, m."""
        return self.latitude_rad, self.longitude_rad, self.height_m

    @property
    def angles_sd_rad(self) -> tuple[float, float]:
        """White noise normal to the line of sight, in azimuth's direction and in elevation's."""
        azimuth, elevation = self.azimuth_sd_rad, self.elevation_sd_rad
        return (
            self.angle_sd_rad if azimuth is None else azimuth,
            self.angle_sd_rad if elevation is None else elevation,
        )


@dataclass(frozen=True)
class SitesSpec:
    """What the survey of all radar sites shares: one network, one datum of heights, one azimuth mark.

    Parameters
    ----------
    survey_sd_m : float
        Stated minus true place, each of north and east.
    height_datum_sd_m : float
        Stated minus true height: the geoid's undulation, a height system.
    north_sd_rad : float
        Azimuth readings minus azimuths from true north.
    """

    name: str = "sites"
    survey_sd_m: float = error_row("m", 0.0, at=0.0, states=("survey north", "survey east"))
    height_datum_sd_m: float = error_row("m", 0.0, at=0.0, states=("height datum",))
    north_sd_rad: float = error_row("rad", 0.0, at=0.0, states=("north",))


@dataclass(frozen=True)
class GnssSpec(InstrumentSpec):
    """A satellite navigation receiver and its antenna.

    Parameters
    ----------
    antenna_from_datum_body_m : (3,) float
        Where the antenna sits, body axes, m.
    horizontal_sd_m, vertical_sd_m : float
        White noise of a fix: of each horizontal axis, and of height.
    speed_sd_mps, vertical_speed_sd_mps : float
        White noise of a velocity: of each horizontal axis, and of the vertical one.
    wander_sd_m, wander_time_constant_s : float
        Slowly varying (Gauss-Markov) part of the position's error, of each axis; 0 for none. Satellites' clocks and
        orbits, the ionosphere and reflections change in minutes, so that one fix repeats the error of the last.
    time_bias_sd_s : float
        Time tag minus true time, constant over a flight: a receiver's latency, or the second that its clock rounds to.
    velocity_wander_sd_mps, velocity_wander_time_constant_s : float
        Slowly varying (Gauss-Markov) part of the velocity's error, of each axis: the receiver's own filter makes
        neighbouring velocities repeat their errors; 0 for none.
    """

    antenna_from_datum_body_m: FloatArray
    horizontal_sd_m: float = error_row("m", 5.0, Sd, simulated=("horizontal_sd_m",), required=True)
    vertical_sd_m: float = error_row("m", 10.0, Sd, simulated=("vertical_sd_m",), required=True)
    speed_sd_mps: float = error_row("m/s", 0.5, Sd, simulated=("speed_sd_mps",), required=True)
    vertical_speed_sd_mps: float = error_row("m/s", 1.0, Sd, simulated=("vertical_speed_sd_mps",), required=True)
    wander_sd_m: float = error_row(
        "m", 3.0, at=0.0, states=("wander north", "wander east", "wander down"), simulated=None,
        time_constant=("wander_time_constant_s", 100.0, "wander_time_constant_s"),
    )  # fmt: skip
    wander_time_constant_s: float = 100.0
    time_bias_sd_s: float = error_row("s", 0.5, SlowClock, at=0.0, states=("time bias",), simulated=None)
    velocity_wander_sd_mps: float = error_row(
        "m/s", 0.0, at=0.0, states=("velocity wander north", "velocity wander east", "velocity wander down"),
        simulated=None, left_out=True,
        time_constant=("velocity_wander_time_constant_s", 5.0, "velocity_wander_time_constant_s"),
    )  # fmt: skip
    velocity_wander_time_constant_s: float = 5.0


@dataclass(frozen=True)
class BarometerSpec(InstrumentSpec):
    """A static pressure sensor read as a height.

    Parameters
    ----------
    sd_m : float
        White noise of a height.
    bias_sd_m : float
        Constant error: the day's pressure at sea level, the sensor's offset, the undulation of the geoid.
    scale_sd : float
        Error proportional to the height above the first reading: a day warmer or colder than the profile, of which
        1 % in temperature is 1 % in height.
    wander_sd_m, wander_time_constant_s : float
        Slowly varying (Gauss-Markov) error: the vehicle's own flow, winds; 0 for none.
    time_bias_sd_s : float
        Time tag minus true time, with the lag of a vented bay.
    """

    sd_m: float = error_row("m", 3.0, Sd)
    bias_sd_m: float = error_row("m", 60.0, states=("bias",))
    scale_sd: float = error_row("1", 0.03, Fraction, states=("scale",))
    wander_sd_m: float = error_row(
        "m", 5.0, at=0.0, states=("wander",), time_constant=("wander_time_constant_s", 30.0, "")
    )
    wander_time_constant_s: float = 100.0
    time_bias_sd_s: float = error_row("s", 0.2, SlowClock, at=0.0, states=("time bias",))


@dataclass(frozen=True)
class SunHeads(InstrumentSpec):
    """Two-axis Sun sensors on the centerbody, each looking outward at its clocking angle.

    Parameters
    ----------
    clock_lv_rad : (k,) float
        Clocking angle of each head.
    field_rad : float
        Full cone about a head's axis in which it sees the Sun.
    noise_sd_rad, bias_sd_rad, mount_sd_rad : float
        White noise per sample and constant error normal to the line of sight, mounting rotation per axis of each head.
    """

    clock_lv_rad: FloatArray
    field_rad: float
    noise_sd_rad: float = error_row("rad", 1.0, Sd, simulated=None, required=True, step="resolution_deg")
    bias_sd_rad: float = error_row("rad", 0.5, states=("bias across", "bias along"), simulated=None, required=True)
    mount_sd_rad: float = error_row("rad", 0.2, states=("mount x", "mount y", "mount z"), simulated=None, required=True)

    @property
    def dcm_body_head(self) -> FloatArray:
        """Nominal mounting of each head, ``v_body = dcm_body_head[k] @ v_head``, (k, 3, 3)."""
        return np.array([dcm_body_from_sun_head(float(clock)) for clock in self.clock_lv_rad])


RADAR, SITES, GNSS, BAROMETER, SUN = (
    table_of(record) for record in (RadarSite, SitesSpec, GnssSpec, BarometerSpec, SunHeads)
)


def dcm_body_from_clocking(x_axis_lv_rad: float, y_axis_lv_rad: float) -> FloatArray:
    """Mounting of a package whose x and y axes are clocked in the LV frame; z completes the right-hand set.

    Returns
    -------
    (3, 3) float
        ``dcm_body_sensor``.
    """
    from flightmodel.deflection import lv_direction

    x_axis, y_axis = lv_direction(x_axis_lv_rad), lv_direction(y_axis_lv_rad)
    return np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])


def dcm_body_from_sun_head(clock_lv_rad: float) -> FloatArray:
    """Mounting of a Sun head: z along its axis, outward at the clocking angle; x forward, along body x.

    Returns
    -------
    (3, 3) float
        ``dcm_body_head``.
    """
    from flightmodel.deflection import lv_direction

    forward, outward = np.array([1.0, 0.0, 0.0]), lv_direction(clock_lv_rad)
    return np.column_stack([forward, np.cross(outward, forward), outward])


def sun_angles_from_direction(direction_head: FloatArray) -> FloatArray:
    """Azimuth about the head's x from z towards y, and elevation from there towards x, rad ``(..., 2)``.

    ``direction_head`` (..., 3) are unit vectors in head axes. A point ``d`` away normal to the line of sight differs by
    ``d / cos(elevation)`` in azimuth.
    """
    x, y, z = np.moveaxis(np.asarray(direction_head, dtype=float), -1, 0)
    return np.stack([np.arctan2(y, z), np.arctan2(x, np.hypot(y, z))], axis=-1)


def direction_from_sun_angles(az_el_rad: FloatArray) -> FloatArray:
    """Unit vectors ``(..., 3)`` in head axes: inverse of `sun_angles_from_direction`."""
    az, el = np.moveaxis(np.asarray(az_el_rad, dtype=float), -1, 0)
    return np.stack([np.sin(el), np.cos(el) * np.sin(az), np.cos(el) * np.cos(az)], axis=-1)


class Mounted(Source):
    """A triad: which way its axes point, by a package of the vehicle file (``mount``) or by body axes (``axes``)."""

    mount: str | None = None
    axes: tuple[BodyAxis, BodyAxis, BodyAxis] | None = None
    position_from_datum_body_m: tuple[Place, Place, Place] | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.axes is not None:
            if self.mount is not None:
                yield "axes", list(self.axes), f"mount = '{self.mount}' states the same; keep one of the two"
            dcm = self.dcm_body_sensor
            if not np.allclose(dcm @ dcm.T, np.eye(3)):
                words = "two sensor axes point along the same body axis; each wants one of its own"
                yield "axes", list(self.axes), Issue(words, "axes-parallel")
            elif np.linalg.det(dcm) < 0.0:
                words = (
                    "left-handed axes (a mirror image): change a sign, swap two, or give one column a unit as -degps"
                )
                yield "axes", list(self.axes), Issue(words, "axes-left-handed")
        elif self.position_from_datum_body_m is not None and self.mount != "body":
            words = 'goes with axes = ["+x", "+y", "+z"] or mount = "body"; a package of the vehicle has its own place'
            yield "position_from_datum_body_m", list(self.position_from_datum_body_m), words

    @property
    def dcm_body_sensor(self) -> FloatArray:
        """Mounting that ``axes`` say, ``v_body = dcm_body_sensor @ v_sensor``, (3, 3); body axes by default."""
        return np.column_stack([AXIS[name] for name in self.axes or ("+x", "+y", "+z")])

    @property
    def place_m(self) -> FloatArray:
        """Place from the datum, body axes, (3,), m; the datum where none is stated."""
        return np.array(self.position_from_datum_body_m or (0.0, 0.0, 0.0))


@with_keys(ACCELEROMETER.file_keys())
class TriadEntry(Mounted):
    """Accelerometer triad, or single channels of one: file, mounting, data sheet's errors (one standard deviation)."""

    measures: Annotated[tuple[Literal["ax", "ay", "az"], ...], Field(min_length=1, max_length=3)] = ("ax", "ay", "az")


@with_keys(RATES.file_keys())
class RatesEntry(Mounted):
    """Rate gyros, along body axes unless ``axes`` say otherwise."""


@with_keys(MAGNETOMETER.file_keys())
class MagnetometerEntry(Mounted):
    """Magnetometer: file, mounting, errors; the bias holds the vehicle's hard iron too.

    ``reversed`` is for one that reads the field with the opposite sign along all its axes.
    """

    reversed: bool = False


@with_keys(SUN.file_keys())
class SunEntry(Source):
    """Two-axis Sun sensors, one head looking outward at each clocking angle; an empty cell where a head sees no Sun."""

    heads_lv_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=8)] = (45.0, 135.0, 225.0, 315.0)
    field_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0


class TrackingSource(Source):
    """A table of places; of rows closer than ``every_s`` (`flightmodel.tables`) some are predicted, not used.

    Errors that last several rows are no white noise: taken for it, a hundred rows of one error count as a hundred.
    """

    every_s: Thinning = Field(default=0.0)  # type: ignore[arg-type]  # its plain form, read as any other

    @property
    def components(self) -> tuple[str, ...]:
        """What ``every_s`` may name."""
        return ("height",)

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        named = {c for span in self.every_s for c in span.components}
        words = f"is not among what is measured here: {', '.join(self.components)}"
        for component in sorted(named - {*self.components}):
            yield "every_s", component, words


def servo_faults(key: str, stated: float, servo_hz: float) -> Iterable[KeyFault]:
    """Yield that a fraction of a servo's lag is stated, of a flight or a scenario, and no bandwidth."""
    if stated > 0.0 and servo_hz == 0.0:
        yield key, stated, "a fraction of the servo's lag: state its bandwidth, angle_servo_hz, too"


TrackerReading = Literal["range", "az", "el", "range_rate"]


@with_keys(RADAR.file_keys())
class RadarEntry(TrackingSource):
    """A tracking radar, a telescope, a ranging or Doppler station: what it measures, and its site (WGS-84)."""

    measures: Annotated[tuple[TrackerReading, ...], Field(min_length=1)] = ("range", "az", "el")

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-360.0, le=360.0)]
    height_m: Annotated[float, Field(ge=-1e3, le=1e5)]
    tracks: Literal["cg", "datum"] = "cg"
    angle_servo_hz: Bandwidth = 0.0

    @property
    def components(self) -> tuple[str, ...]:
        """What ``every_s`` may name."""
        return self.measures

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        yield from super().key_faults()
        yield from servo_faults("servo_lag_sd", getattr(self, "servo_lag_sd", 0.0), self.angle_servo_hz)


@with_keys(SITES.file_keys())
class SitesEntry(Section):
    """Survey errors common to all radar sites."""


class Heights(TrackingSource):
    """A table with heights: above what, and by how much the two surfaces differ.

    Those of altimeters for sport rockets and drones are above the ground that they started from: ``ground_height_m``.
    """

    height_is: Literal["ellipsoid", "msl", "ground"] | None = None
    geoid_undulation_m: Undulation | None = None
    ground_height_m: Annotated[float, Field(ge=-1000.0, le=9000.0)] | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        yield from super().key_faults()
        if self.height_is != "msl" and self.geoid_undulation_m is not None:
            words = 'is used only with height_is = "msl"; say that, or remove it'
            yield "geoid_undulation_m", self.geoid_undulation_m, words
        if (self.height_is == "ground") != (self.ground_height_m is not None):
            words = 'and height_is = "ground" need each other: m above the ellipsoid, where heights are zero'
            yield "ground_height_m", self.ground_height_m, words

    def to_ellipsoid_m(self, latitude_rad: FloatArray | float, longitude_rad: FloatArray | float) -> FloatArray:
        """Offset, m, from the table's heights to ellipsoidal ones at places (...,): ground, stated geoid, or EGM96."""
        if self.height_is == "ground":
            return np.full(np.shape(latitude_rad), self.ground_height_m)
        if self.height_is != "msl":
            return np.zeros(np.shape(latitude_rad))
        if self.geoid_undulation_m is not None:
            return np.full(np.shape(latitude_rad), self.geoid_undulation_m)
        return undulation_m(latitude_rad, longitude_rad)


@with_keys(GNSS.file_keys())
class GnssEntry(Heights):
    """A satellite navigation receiver: its table, antenna, errors, and which fixes are good enough.

    ``axes`` are those of positions x, y, z and of their velocities: planet-fixed ones, these at t0, or J2000 (Mars).
    ``most_g`` is the acceleration that it can follow, by its data sheet.
    """

    antenna_from_datum_body_m: tuple[Place, Place, Place] = (0.0, 0.0, 0.0)
    velocity: bool = True
    axes: Literal["fixed", "inertial", "j2000"] = "fixed"
    min_satellites: Annotated[int, Field(ge=1, le=64)] | None = None
    satellites_column: str = "nsat"
    min_fix_mode: Annotated[int, Field(ge=1, le=9)] | None = None
    fix_mode_column: str = "fix_mode"
    most_g: Annotated[float, Field(ge=1.0, le=1e4)] = 4.0

    @property
    def components(self) -> tuple[str, ...]:
        """What ``every_s`` may name."""
        return ("position", "velocity") if self.velocity else ("position",)

    def declared(self, short: str) -> Declared | None:
        """Return the declared column of a quantity; counts are named by keys of their own and have no unit."""
        counts = {"nsat": self.satellites_column, "fix_mode": self.fix_mode_column}
        return Declared(counts[short], "1") if short in counts else super().declared(short)


@with_keys(BAROMETER.file_keys())
class BarometerEntry(Heights):
    """A static pressure sensor: its table of heights or pressures, and its errors."""


class AtmosphereEntry(Source):
    """The day's sounding; standard deviations default to those of rocketsondes and balloons."""

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.use_s is not None:
            yield "use_s", [list(span) for span in self.use_s], "a sounding is by altitude, not by time"


class FramesEntry(Source):
    """Onboard video as a list of frames: column ``frame`` holds file names below ``folder``, or numbers in ``film``."""

    folder: str | None = None
    film: str | None = None
    camera: str = "camera5"
    benchmark_s: float = 421.0
    time_bias_sd_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0


class LoadsErrors(Section):
    """Standard deviations of what a table of loads does not state; each widens the answer.

    The defaults are those of a good entry instrumentation: an accelerometer of 5 mg, gyros of 0.05 deg/s, a flow angle
    known to 0.3 deg beside the wind, winds of a sounding of the day, a dynamic pressure known to 3 %. Noises that are
    not stated are measured.
    """

    accelerometer_noise_sd_mps2: NonNegative | None = None
    accelerometer_bias_sd_mps2: NonNegative = 0.05
    accelerometer_scale_sd: NonNegative = 0.002
    accelerometer_mount_sd_deg: ErrorAngle = 0.1
    rate_noise_sd_degps: NonNegative | None = None
    rate_bias_sd_degps: NonNegative = 0.05
    rate_scale_sd: NonNegative = 0.002
    flow_angle_sd_deg: ErrorAngle = 0.3
    wind_sd_mps: NonNegative = 3.0
    dynamic_pressure_sd_percent: NonNegative = 3.0
    time_bias_sd_s: NonNegative = 0.001


class LoadsEntry(Source, LoadsErrors):
    """Table of another team's trajectory: its file, columns, errors, and where its accelerometer is.

    ``acceleration_at`` is ``"cg"``, a package of the vehicle file, or a place from the datum in body axes, m. Columns
    that the header leaves no doubt about need not be named.
    """

    acceleration_at: str | tuple[Place, Place, Place] = "cg"
