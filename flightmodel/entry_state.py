"""What does flight.toml state about an entry: the state at its start, and its drag without a vehicle file?

A state is Cartesian, or radius (or height), latitude, longitude, speed, flight-path angle and azimuth. It goes to
planet-fixed axes, its covariance by central differences of the whole conversion,

    P_fixed = J P J^T + (v, g)(v, g)^T t_sd^2,   J = d(position, velocity) / d(what is stated)

where the second part is what its time may err against the sensors' clock, in free fall (``v, g`` against the planet).

``axes`` says against what a velocity is: ``"fixed"``, the rotating planet; ``"inertial"``, planet-fixed axes at t0 held
still; ``"j2000"``, ICRF (Mars alone). Latitude and longitude are always of the planet. With ``radius_m`` latitude is
planetocentric and the horizontal is normal to the radius; with ``altitude_m`` both are geodetic, as elsewhere here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from flightmodel import earth, rotations, tables
from flightmodel.checks import FloatArray, GateError, Issue
from flightmodel.config import Angle, Elevation, KeyFault, Latitude, Longitude, Section, Time
from flightmodel.gate import Gate
from flightmodel.tables import Source
from flightmodel.telemetry import StatedDrag, StatePrior, TriadRecord

Axes = Literal["fixed", "inertial", "j2000"]
Triple = tuple[float, float, float]
Size = Annotated[float, Field(gt=0.0, le=1e8)]
Percent = Annotated[float, Field(ge=0.0, le=300.0)]
_LOWEST_M, _HIGHEST_M = -1e4, 1e6  # Hellas; beyond the atmospheres' tables
_SUPERSONIC, _MOST_C_A = 2.0, 2.0  # Newtonian flow: 2 sin^2 of a plate across it; behind a normal shock it is less
_MOST_AWAY_S = 86400.0  # of an entry's readings from its state: a day
_FELT = 50.0  # times noise and bias, from which a reading is a force
_CARTESIAN = ("position_m", "velocity_mps")
_SPHERICAL = ("latitude_deg", "longitude_deg", "speed_mps", "flight_path_deg", "azimuth_deg")


class StateEntry(Section):
    """State at one time with standard deviations, or a covariance of its six numbers in their order and units."""

    t_s: Time
    t_sd_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.1  # assumed: times of entry are printed to tenths
    axes: Axes
    position_m: Triple | None = None
    velocity_mps: Triple | None = None
    position_sd_m: Size | tuple[Size, Size, Size] | None = None
    velocity_sd_mps: Size | tuple[Size, Size, Size] | None = None
    radius_m: Size | None = None
    altitude_m: Annotated[float, Field(ge=-1e4, le=1e6)] | None = None
    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    speed_mps: Annotated[float, Field(gt=0.0, le=2e4)] | None = None
    flight_path_deg: Elevation | None = None
    azimuth_deg: Angle | None = None
    radius_sd_m: Size | None = None
    altitude_sd_m: Size | None = None
    latitude_sd_deg: Size | None = None
    longitude_sd_deg: Size | None = None
    speed_sd_mps: Size | None = None
    flight_path_sd_deg: Size | None = None
    azimuth_sd_deg: Size | None = None
    covariance: Annotated[tuple[Annotated[tuple[float, ...], Field(min_length=6, max_length=6)], ...],
                          Field(min_length=6, max_length=6)] | None = None  # fmt: skip

    @property
    def _values(self) -> tuple[str, ...]:
        """Keys of the form that is stated, in the covariance's order."""
        if any(getattr(self, key) is not None for key in _CARTESIAN):
            return _CARTESIAN
        return ("altitude_m" if self.radius_m is None else "radius_m", *_SPHERICAL)

    @staticmethod
    def _sd_key(key: str) -> str:
        stem, _, unit = key.rpartition("_")
        return f"{stem}_sd_{unit}"

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        wanted = self._values
        sds = tuple(map(self._sd_key, wanted))
        for key in type(self).model_fields:
            if key in ("t_s", "t_sd_s", "axes", "covariance"):
                continue
            value = getattr(self, key)
            if key in wanted and value is None:
                words = "is missing: state position_m and velocity_mps, or radius_m or altitude_m with "
                words += ", ".join(_SPHERICAL)
                yield key, None, words
            elif key in sds and (value is None) == (self.covariance is None):
                yield key, value, "state each standard deviation, or covariance instead of all of them"
            elif key not in (*wanted, *sds) and value is not None:
                yield key, value, f"does not go with {wanted[0]}; keep one form of the state"
        if self.axes == "j2000" and wanted != _CARTESIAN:
            words = 'latitude and longitude are of the planet: axes = "fixed" or "inertial" says against what it moves'
            yield "axes", self.axes, words
        if self.covariance is not None:
            matrix = np.array(self.covariance)
            variance = np.diagonal(matrix)
            scale = np.sqrt(np.maximum(variance, 1e-300))
            unit = matrix / np.outer(scale, scale)
            if (variance <= 0.0).any() or not np.allclose(unit, unit.T, atol=1e-6) \
                    or np.linalg.eigvalsh(0.5 * (unit + unit.T))[0] < -1e-6:  # fmt: skip
                words = Issue("a covariance is symmetric with positive eigenvalues", "argument-value")
                yield "covariance", "...", words

    def prior(self, t0_utc: str, planet: earth.Planet) -> StatePrior:
        """State in planet-fixed axes, with its covariance."""
        parts = [np.atleast_1d(np.asarray(getattr(self, key), dtype=float)) for key in self._values]
        stated = np.concatenate(parts)
        if self.covariance is not None:
            covariance = 0.5 * (np.array(self.covariance) + np.array(self.covariance).T)
        else:
            sd = [
                np.broadcast_to(getattr(self, self._sd_key(key)), p.shape)
                for key, p in zip(self._values, parts, strict=True)
            ]
            covariance = np.diag(np.concatenate(sd) ** 2)
        state = self._fixed(stated, t0_utc, planet)
        height = float(earth.geodetic_from_ecef(state[:3], planet)[2])
        if not _LOWEST_M <= height <= _HIGHEST_M:
            name = earth.name_of(planet).capitalize()
            words = (
                f"its height above {name}'s ellipsoid is {height / 1000.0:.0f} km: radius_m is from {name}'s centre, "
                "altitude_m from the ellipsoid, in metres; of an altitude above a sphere state radius_m, the sum"
            )
            raise GateError(words, "value-range")
        step = 0.1 * np.sqrt(np.diagonal(covariance))
        moved = [
            self._fixed(stated + h, t0_utc, planet) - self._fixed(stated - h, t0_utc, planet) for h in np.diag(step)
        ]
        jacobian = np.array(moved).T / (2.0 * step)
        late = self.t_sd_s * _in_free_fall(state, planet)
        whole = jacobian @ covariance @ jacobian.T + np.outer(late, late)
        return StatePrior(self.t_s, state[:3], state[3:], 0.5 * (whole + whole.T))

    def _fixed(self, stated: FloatArray, t0_utc: str, planet: earth.Planet) -> FloatArray:
        """Position and velocity (6,) in planet-fixed axes."""
        if self._values == _CARTESIAN:
            return np.concatenate(fixed_axes(self.axes, t0_utc, self.t_s, stated[:3], stated[3:], planet))
        (size, speed), (lat, lon, path, azimuth) = stated[[0, 3]], np.deg2rad(stated[[1, 2, 4, 5]])
        ned = speed * np.array([np.cos(path) * np.cos(azimuth), np.cos(path) * np.sin(azimuth), -np.sin(path)])
        axes = earth.dcm_ned_ecef(float(lat), float(lon))
        if self.radius_m is None:
            position = earth.ecef_from_geodetic(float(lat), float(lon), float(size), planet)
        else:
            position = -size * axes[2]
        velocity = axes.T @ ned
        if self.axes == "inertial":
            velocity = velocity - np.cross(planet.rate_ecef_radps, position)
        return np.concatenate([position, velocity])


def _in_free_fall(state: FloatArray, planet: earth.Planet) -> FloatArray:
    """Rate of change (6,) of a position and velocity in planet-fixed axes by gravitation alone."""
    spin = planet.rate_ecef_radps
    turning = 2.0 * np.cross(spin, state[3:]) + np.cross(spin, np.cross(spin, state[:3]))
    return np.concatenate([state[3:], earth.gravitation(state[:3], planet) - turning])


def fixed_axes(
    axes: Axes, t0_utc: str, time_s: FloatArray | float, position_m: FloatArray, velocity_mps: FloatArray,
    planet: earth.Planet,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Positions and velocities (..., 3) in planet-fixed axes, relative to the planet, from other axes."""
    if axes == "fixed":
        return position_m, velocity_mps
    if axes == "j2000":
        dcm = earth.planet_from_j2000(t0_utc, time_s, planet)
    else:
        dcm = rotations.dcm_from_q(earth.q_ecef_eci(time_s, planet))
    position = np.einsum("...ij,...j->...i", dcm, position_m)
    moving = np.einsum("...ij,...j->...i", dcm, velocity_mps)
    return position, moving - np.cross(planet.rate_ecef_radps, position)


class DragEntry(Section):
    """Drag of a flight without a vehicle file: C_A (one number, or a table over Mach number), area and mass."""

    c_a: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    table: Source | None = None
    c_a_sd_percent: Percent
    area_m2: Size | None = None
    diameter_m: Size | None = None
    mass_kg: Size
    mass_sd_percent: Percent = 0.0

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        for one, other in (("c_a", "table"), ("area_m2", "diameter_m")):
            if (getattr(self, one) is None) == (getattr(self, other) is None):
                yield one, getattr(self, one), f"state {one} or {other}, one of the two"
        if self.c_a_sd_percent == self.mass_sd_percent == 0.0:
            yield "c_a_sd_percent", 0.0, "no coefficient and mass are known exactly; state what they may err"


def read_drag(gate: Gate, entry: DragEntry) -> StatedDrag | None:
    """Stated drag; None, with the faults kept, where its table is refused."""
    mach, c_a = np.zeros(1), np.array([entry.c_a or 0.0])
    if entry.table is not None:
        table = gate.table("drag.table", entry.table, tables.AXIAL, timed=False)
        if table is None:
            return None
        before = len(gate.faults)
        gate.refuse_rows(table, "c_a", 1e-6, 10.0, "no axial force coefficient")
        mach, c_a = table.columns["mach"], table.columns["c_a"]
        if len(gate.faults) == before and not (np.isfinite(mach + c_a).all() and (np.diff(mach) > 0.0).all()):
            gate.refuse(f"drag.table: {table.path}: Mach numbers grow from row to row, without gaps", "time-backwards")
        if len(gate.faults) > before:
            return None
    fast = (mach >= _SUPERSONIC) | (len(mach) == 1)
    if fast.any() and (largest := float(c_a[fast].max())) > _MOST_C_A:
        words = (
            f"C_A of {largest:.3g}: stagnation pressure on all of the frontal area gives {_MOST_C_A:g}; "
            "is area_m2 or diameter_m of the same reference as c_a?"
        )
        gate.findings.append(Issue(words, "drag-large", "drag"))
    area = entry.area_m2 if entry.diameter_m is None else 0.25 * np.pi * entry.diameter_m**2
    assert area is not None
    sd = 0.01 * float(np.hypot(entry.c_a_sd_percent, entry.mass_sd_percent))
    return StatedDrag(mach, c_a, float(area), entry.mass_kg, sd)


def refuse_misread_entry(gate: Gate, record: TriadRecord, state: StatePrior) -> None:
    """Refuse a deceleration that counts positive along body x, and times that are days from the entry's state.

    A drag pushes nowhere forward: of a sign that is wrong the reconstruction diverges, or rejects every reading.
    """
    name = record.spec.name
    away = max(record.time_s[0] - state.time_s, state.time_s - record.time_s[-1])
    if away > _MOST_AWAY_S:
        gate.refuse(
            f"{name}: readings from {record.time_s[0]:.6g} to {record.time_s[-1]:.6g} s, the state is of "
            f"{state.time_s:.6g} s: all times count from t0_utc; state offset_s of a spacecraft's clock, or its unit",
            "time-not-covered",
        )
    axial = record.spec.dcm_body_sensor[0]
    used = np.abs(axial) > 1e-9
    reading = record.measured_sensor[:, used] @ axial[used]
    felt = reading[np.abs(reading) > _FELT * max(record.spec.noise_sd, record.spec.bias_sd)]
    if len(felt) and np.median(felt) > 0.0:
        gate.refuse(
            f"{name}: along body x it reads {np.median(felt):+.2g} m/s2 in the middle of what it feels, and a drag "
            'reads negative: where the file counts a deceleration positive, state axes = ["-x", "+y", "-z"]',
            "deceleration-sign",
        )
