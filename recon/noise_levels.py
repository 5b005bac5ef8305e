"""How noisy are trackers, inertial sensors and the process model in this flight? By the likelihood of the innovations.

Data sheets and defaults are right within a factor. The filter's innovations say what the noise of the flight was: with
levels ``k`` (white noise, slow errors and their time constants, the noise of inertial sensors as process noise, or that
of ballistic motion)

    log L(k) = -1/2 sum (min(nis, gate) + log det S)

over all measurements that the filter uses (Mehra; Schweppe). It is maximised over the logarithms, with normal laws of
these beforehand; about its maximum the posterior is normal, too (Laplace). Proposed is the root of a level's mean
square, ``exp(mean + v)`` with the logarithm's variance ``v``, which is what a prediction's variance needs, and a time
constant's median. What is stated is taken for the same of the prior, so that a level on which the flight bears nothing
stays as it is.

Rows that ``every_s`` leaves out have no part in it. Without it what lasts from one row to the next is a slow error, of
which size and time constant are sought, too; errors of another kind (a receiver's own filter) then pass for these.

Assumed: the model has the right kinds of errors; passes are linearised about one reconstruction.

References
----------
R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE Transactions on Automatic Control
15 (1970) 175. F. C. Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE Transactions on
Information Theory 11 (1965) 61.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import ndtri

from flightmodel import tables
from flightmodel.checks import FloatArray, GateError, Progress
from flightmodel.instruments import ACCELEROMETER, RATES, BarometerSpec, GnssSpec, InstrumentSpec, RadarSite, table_of
from flightmodel.telemetry import Telemetry
from recon import estimate, kalman
from recon.estimate import Linearised
from recon.settings import Settings

_PRIOR_SD = np.log(3.0)  # of a level's logarithm: data sheets and defaults were found to be up to ten times too large
_REACH = np.log(100.0)  # farther from what is stated the numbers of flight.toml end
_LEAST_CHANGE = 0.1  # of a logarithm, that is worth proposing
_LEAST_GAIN = np.log(20.0)  # of the likelihood, below which nothing is proposed: levels accepted before stay
_DIFFERENCE = 0.02  # of a logarithm: its effect on log L is far above the rounding of thousands of terms
_MOST_ROUNDS = 3
_RELINEARISED = 0.1  # change of a logarithm that moves the trajectory about which passes are linearised
# of each kind of record: fields of its noise, which may only scale what is stated, and time constants
_TRACKERS = {
    "radars": ("range_sd_m", "angle_sd_rad", "azimuth_sd_rad", "elevation_sd_rad", "range_rate_sd_mps",
               "wander_sd_rad", "wander_time_constant_s", "range_wander_sd_m", "range_wander_time_constant_s",
               "range_rate_wander_sd_mps", "range_rate_wander_time_constant_s"),
    "gnss": ("horizontal_sd_m", "vertical_sd_m", "speed_sd_mps", "vertical_speed_sd_mps",
             "wander_sd_m", "wander_time_constant_s", "velocity_wander_sd_mps", "velocity_wander_time_constant_s"),
    "barometers": ("sd_m", "wander_sd_m", "wander_time_constant_s"),
}  # fmt: skip
_FIXES = [q.canonical for q in tables.GNSS_SD]  # noise that a receiver may state of each fix
_TRIADS = ("noise_sd", "bias_wander_sd", "bias_time_constant_s")
_BALLISTIC = ("drag_sd", "drag_time_constant_s", "side_sd", "acceleration_density")


@dataclass(frozen=True)
class NoiseLevel:
    """One noise level: its key in flight.toml, its stated value and its estimate from the flight.

    Parameters
    ----------
    table, key : str
        Of flight.toml: ``"gnss.gps"``, ``"horizontal_sd_m"``.
    stated, proposed, low, high : float
        In the file's unit; ``low`` and ``high`` hold the level with 90 %. What hardly differs from what is stated is
        proposed as it is.
    """

    table: str
    key: str
    stated: float
    proposed: float
    low: float
    high: float

    @property
    def changed(self) -> bool:
        """Whether the proposed value differs from the stated one."""
        return self.proposed != self.stated


@dataclass(frozen=True)
class NoiseLevels:
    """All levels of a flight, the telemetry with those proposed, and what the log likelihood gains by them."""

    levels: tuple[NoiseLevel, ...]
    telemetry: Telemetry
    gain: float

    def to_frame(self) -> pd.DataFrame:
        """One row a level: ``table, key, stated, proposed, low, high``."""
        return pd.DataFrame([vars(level) for level in self.levels])


@dataclass(frozen=True)
class _Place:
    """Where a level is in telemetry (record's kind, its name or "", field) and in flight.toml, and its unit there."""

    kind: str
    name: str
    field: str
    table: str
    key: str
    to_si: float

    def of(self, telemetry: Telemetry) -> float:
        """Level, SI."""
        return float(getattr(self._spec(telemetry), self.field))

    def set(self, telemetry: Telemetry, value: float) -> Telemetry:
        """Telemetry with another level, SI."""
        changed = replace(self._spec(telemetry), **{self.field: value})
        if self.kind == "motion":
            return replace(telemetry, motion=changed)
        record = replace(self._record(telemetry), spec=changed)
        whole: Any = {**getattr(telemetry, self.kind), self.name: record} if self.name else record
        parts: dict[str, Any] = {self.kind: whole}
        return replace(telemetry, **parts)

    def _record(self, telemetry: Telemetry) -> Any:
        kind = getattr(telemetry, self.kind)
        return kind[self.name] if self.name else kind

    def _spec(self, telemetry: Telemetry) -> Any:
        record = self._record(telemetry)
        return record if self.kind == "motion" else record.spec


def noise_levels(
    telemetry: Telemetry, settings: Settings | None = None, progress: Progress | None = None
) -> NoiseLevels:
    """Most probable noise levels, given the flight's innovations.

    Parameters
    ----------
    telemetry : Telemetry
    settings : Settings, optional
        Those of ``[reconstruction]`` in the flight's file where not given. What these hold out has no part in it.
    progress : callable, optional

    Raises
    ------
    GateError
        ``input-missing``: nothing states a level above zero. Others as `recon.reconstruct.reconstruct`.
    """
    settings = settings or Settings.from_mapping(telemetry.reconstruction)
    report = progress or (lambda _fraction, _what: None)
    places = _places(telemetry, settings)
    if not places:
        raise GateError("noise levels: nothing in flight.toml states one above zero", code="input-missing")
    stated = np.log([place.of(telemetry) for place in places])
    slow = np.array([place.field.endswith("time_constant_s") for place in places])
    prior = stated - np.where(slow, 0.0, _PRIOR_SD**2)
    at = stated
    for number in range(_MOST_ROUNDS):
        report(number / _MOST_ROUNDS, f"noise levels, round {number + 1}")
        about = estimate.linearised(_with(telemetry, places, at), settings)
        found = _Likelihood(telemetry, places, prior, settings, about)
        before, at = at, found.maximised(at)
        if np.abs(at - before).max() < _RELINEARISED:
            break
    covariance = found.covariance(at)
    variance = np.diag(covariance)
    proposed = at + np.where(slow, 0.0, variance)
    proposed = np.where(np.abs(proposed - stated) < _LEAST_CHANGE, stated, proposed)
    gain = found.log_likelihood(proposed) - found.log_likelihood(stated)
    if gain < _LEAST_GAIN:
        proposed, gain = stated, 0.0
    ends = at + np.sqrt(variance) * ndtri([[0.05], [0.95]])
    rows = zip(places, *np.exp([stated, proposed, *ends]), strict=True)
    levels = [NoiseLevel(place.table, place.key, *(float(x) / place.to_si for x in values)) for place, *values in rows]
    report(1.0, "noise levels")
    return NoiseLevels(tuple(levels), _with(telemetry, places, proposed), float(gain))


def _with(telemetry: Telemetry, places: list[_Place], logs: FloatArray) -> Telemetry:
    for place, value in zip(places, np.exp(logs).tolist(), strict=True):
        telemetry = place.set(telemetry, value)
    return telemetry


def _places(telemetry: Telemetry, settings: Settings) -> list[_Place]:
    """All non-zero noise levels in use."""
    out: list[_Place] = []
    for kind, record_type in (("radars", RadarSite), ("gnss", GnssSpec), ("barometers", BarometerSpec)):
        for name, record in getattr(telemetry, kind).items():
            if name not in settings.without:
                out += _of_record(kind, name, record, table_of(record_type), f"{kind}.{name}", _TRACKERS[kind])
    if telemetry.motion.model == "ballistic":
        if telemetry.motion.trim_sd_rad > 0.0:  # the drag follows a measured deceleration: its sd is no noise
            return out
        fields = [f for f in _BALLISTIC if getattr(telemetry.motion, f) > 0.0]
        return out + [_Place("motion", "", f, "motion", f, 1.0) for f in fields]
    for kind, table in (("accelerometer", ACCELEROMETER), ("rates", RATES)):
        record = getattr(telemetry, kind)
        if record is not None:
            out += _of_record(kind, "", record, table, f"sensors.{kind}", _TRIADS)
    return out


def _of_record(kind: str, name: str, record: Any, table: Any, section: str, fields: tuple[str, ...]) -> list[_Place]:
    """Levels of one instrument, of those readings that it has."""
    spec: InstrumentSpec = record.spec
    keys = {row.name: (row.key, row.to_si) for row in table.rows}
    keys |= {row.time_constant[0]: (row.time_constant[0], 1.0) for row in table.rows if row.time_constant[0]}
    wanders = {row.time_constant[0]: row.name for row in table.rows if row.time_constant[0]}
    out = []
    for field in fields:
        value, size = getattr(spec, field), wanders.get(field, field)
        still = getattr(spec, size) == 0.0
        if value is None or not 0.0 < value < np.inf or still or not _has_reading(kind, record, size):
            continue
        out.append(_Place(kind, name, field, section, *keys[field]))
    return out


def _has_reading(kind: str, record: Any, field: str) -> bool:
    """Whether a record has the readings that a level is about, and no noise of their own row by row."""
    if kind == "gnss":
        moving = "speed" in field or "velocity" in field
        read = record.velocity_ecef_mps if moving else record.position_ecef_m
        own = record.sd is not None and field in _FIXES and bool(np.isfinite(record.sd[:, _FIXES.index(field)]).any())
        return not own and bool(np.isfinite(read).any())
    if kind != "radars":
        return True
    column = {"range_sd_m": 0, "azimuth_sd_rad": 1, "elevation_sd_rad": 2, "range_wander_sd_m": 0}.get(field)
    if field.startswith("range_rate"):
        return record.range_rate_mps is not None
    own = record.sd is not None and column is not None and bool(np.isfinite(record.sd[:, column]).any())
    if field == "angle_sd_rad":
        both = record.spec.azimuth_sd_rad is not None and record.spec.elevation_sd_rad is not None
        return not both and bool(np.isfinite(record.range_az_el[:, 1:]).any())
    return not own and (column is None or bool(np.isfinite(record.range_az_el[:, column]).any()))


@dataclass(frozen=True)
class _Likelihood:
    """Log likelihood of levels (n,) as logarithms, all passes about one trajectory; ``prior``: their a priori means."""

    telemetry: Telemetry
    places: list[_Place]
    prior: FloatArray
    settings: Settings
    about: Linearised

    def log_likelihood(self, logs: FloatArray) -> float:
        """Log likelihood of the innovations."""
        problem = self.about.problem_of(_with(self.telemetry, self.places, logs), self.settings)
        run = kalman.forward(problem, self.about.states, self.settings.engine)
        return kalman.log_likelihood(problem, run)[0]

    def cost(self, logs: FloatArray) -> float:
        """Minus the log posterior."""
        away = (logs - self.prior) / _PRIOR_SD
        likelihood = self.log_likelihood(logs)
        return float(0.5 * away @ away - likelihood) if np.isfinite(likelihood) else 1e12

    def maximised(self, start: FloatArray) -> FloatArray:
        """Levels of the highest posterior."""
        first = self.cost(start)
        # enough where a further step would gain 0.02 of log likelihood
        options = {"eps": _DIFFERENCE, "maxiter": 15, "ftol": 0.02 / max(abs(first), 1.0)}
        bounds = [(a - _REACH, a + _REACH) for a in self.prior]
        found = minimize(self.cost, start, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x) if found.fun < first else start

    def covariance(self, at: FloatArray) -> FloatArray:
        """Inverse of the cost's second derivatives."""
        n, step = len(at), 5.0 * _DIFFERENCE
        middle, unit = self.cost(at), step * np.eye(n)
        up, down = ([self.cost(at + side * d) for d in unit] for side in (1.0, -1.0))
        curvature = np.zeros((n, n))
        for i in range(n):
            curvature[i, i] = (up[i] + down[i] - 2.0 * middle) / step**2
            for j in range(i):
                both = self.cost(at + unit[i] + unit[j]) + middle - up[i] - up[j]
                curvature[i, j] = curvature[j, i] = both / step**2
        # gates and edits leave kinks: no direction is known less than a priori
        values, axes = np.linalg.eigh(curvature)
        return np.asarray((axes / np.maximum(values, 1.0 / _PRIOR_SD**2)) @ axes.T)
