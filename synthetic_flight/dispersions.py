"""Which quantities of a flight are dispersed, by how much, and which flight follows from one set of draws?

Every dispersed quantity is a *factor* and takes one number ``u`` between 0 and 1; its deviation is ``F^-1(u)`` of its
distribution. The day-of-flight atmosphere takes its whole random structure from the digits of its number. Run ``k``
draws the number of each factor from ``SeedSequence(seed, spawn_key=(k, name of the factor))``: it is the same on one
worker or a thousand, and one factor more or less leaves the others' numbers as they are. Factors are independent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, ValidationError
from scipy.special import ndtri

from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.checks import FloatArray, GateError
from flightmodel.config import KeyFault, NonNegative, Section, Time
from flightmodel.instruments import with_keys
from flightmodel.vehicle import CompliantJoint, MassProperties, Vehicle
from synthetic_flight.instrument_errors import name_key
from synthetic_flight.scenarios import Initial, Scenario
from synthetic_flight.weather import day_of_flight_atmosphere

_SMALLEST = 2.0**-54  # a draw of exactly zero would be an infinite deviation
WIND_FADE_M = (110e3, 130e3)
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
T = TypeVar("T", bound=Section)


class Shift(Section):
    """Deviation that is added to a value: normal with a standard deviation, or uniform between two bounds."""

    normal: NonNegative | None = None
    uniform: tuple[Number, Number] | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            names = ", ".join(type(self).model_fields)
            yield "", None, f"exactly one of {names} is wanted; got {', '.join(given) or 'none'}"
        elif self.uniform is not None and not self.uniform[0] < self.uniform[1]:
            yield "uniform", list(self.uniform), "a lower and a higher bound are wanted"

    def at(self, u: float) -> float:
        """Deviation at the cumulative probability ``u``."""
        if self.uniform is not None:
            return self.uniform[0] + (self.uniform[1] - self.uniform[0]) * u
        return float((self.normal or 0.0) * ndtri(u))


class Factor(Shift):
    """Relative deviation (factor minus one): normal, uniform, or that of a lognormal factor."""

    lognormal: NonNegative | None = None

    def at(self, u: float) -> float:
        """Deviation at the cumulative probability ``u``."""
        return float(np.expm1(self.lognormal * ndtri(u))) if self.lognormal is not None else super().at(u)


@with_keys(dict.fromkeys(Initial.model_fields, (Shift | None, None)))
class InitialDispersions(Section):
    """Dispersions of the state at the start of the scenario; keys and units are the scenario's own."""


class MassDispersions(Section):
    """Dispersions of both bodies; stations are positive aft, the centerbody carries the vehicle's c.g. offset."""

    aeroshell_mass: Factor | None = None
    centerbody_mass: Factor | None = None
    aeroshell_inertia: Factor | None = None
    centerbody_inertia: Factor | None = None
    aeroshell_cg_station_m: Shift | None = None
    centerbody_cg_station_m: Shift | None = None
    offset_y_m: Shift | None = None
    offset_z_m: Shift | None = None


class AeroDispersions(Section):
    """Dispersions of the aerodynamic coefficients: factors on C_A, C_N and C_m, a shift of C_mq."""

    ca: Factor | None = None
    cn: Factor | None = None
    cm: Factor | None = None
    cmq: Shift | None = None


class JointDispersions(Section):
    """Dispersions of the joint."""

    stiffness: Factor | None = None
    damping: Factor | None = None
    torsion_stiffness: Factor | None = None
    station_m: Shift | None = None
    freeplay_deg: Shift | None = None
    quadratic_nmprad2: Shift | None = None
    hardening_nmprad3: Shift | None = None
    damping_hardening_nmsprad3: Shift | None = None


class AirDispersions(Section):
    """Dispersions of the atmosphere: one day per flight or one for all, a density factor, a wind at all altitudes."""

    day: bool = True
    density: Factor | None = None
    wind_north_mps: Shift | None = None
    wind_east_mps: Shift | None = None


class Window(Section):
    """Part of the flight that is recorded, s, and its steps: for peaks, for histories, and of the integration.

    ``step_s`` is the longest step after inflation; none given, the scenario's own.
    """

    from_s: Time
    to_s: Time
    step_s: Annotated[float, Field(ge=1e-4, le=0.1)] | None = None
    record_s: Annotated[float, Field(ge=1e-3, le=1.0)] = 0.02
    history_s: Annotated[float, Field(ge=1e-3, le=10.0)] = 0.1

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if not self.from_s < self.to_s:
            yield "to_s", self.to_s, f"after from_s = {self.from_s:g} is wanted"
        ratio = self.history_s / self.record_s
        if ratio < 0.999 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            yield "history_s", self.history_s, f"a whole multiple of record_s = {self.record_s:g} is wanted"
        if (self.to_s - self.from_s) / self.record_s > 200_000:
            yield "record_s", self.record_s, "more than 200 000 records a flight; a longer one is wanted"

    @property
    def records(self) -> int:
        """Number of records of a flight through the window, the first one at ``from_s``."""
        return int(np.floor((self.to_s - self.from_s) / self.record_s + 1e-6)) + 1

    @property
    def per_history(self) -> int:
        """Number of records between two points of a history."""
        return round(self.history_s / self.record_s)

    def history_time_s(self) -> FloatArray:
        """Times of the points of a history, s."""
        return self.from_s + self.history_s * np.arange((self.records - 1) // self.per_history + 1, dtype=np.float64)


class Dispersions(Section):
    """Dispersed quantities of a Monte Carlo study, with their distributions."""

    joint_is: Literal["flexible", "locked"] = "flexible"
    initial: InitialDispersions = InitialDispersions()
    mass: MassDispersions = MassDispersions()
    aerodynamics: AeroDispersions = AeroDispersions()
    joint: JointDispersions = JointDispersions()
    atmosphere: AirDispersions = AirDispersions()

    def factors(self) -> dict[str, Shift | None]:
        """Distribution of every factor by its name, ``section.key``; None for the day, which is a profile."""
        out: dict[str, Shift | None] = {}
        for section in ("initial", "mass", "aerodynamics", "joint", "atmosphere"):
            part = getattr(self, section)
            for key in type(part).model_fields:
                value = getattr(part, key)
                if isinstance(value, Shift):
                    out[f"{section}.{key}"] = value
                elif value is True:
                    out[f"{section}.{key}"] = None
        return out


def draws(dispersions: Dispersions, seed: int, run: int) -> dict[str, float]:
    """Return the number between 0 and 1 of every factor in one run."""
    return {name: draw_one(seed, run, name) for name in dispersions.factors()}


def draw_one(seed: int, run: int, name: str) -> float:
    """Return the number between 0 and 1 of one factor in one run."""
    sequence = np.random.SeedSequence(seed, spawn_key=(run, *name_key(name)))
    return max(float(np.random.default_rng(sequence).random()), _SMALLEST)


def run_seed(seed: int, run: int) -> int:
    """Return the seed of one run's atmosphere and instruments, which are drawn apart from its factors."""
    return int(np.random.SeedSequence(seed, spawn_key=(run,)).generate_state(1, np.uint64)[0] >> 1)


def rng_from_draw(u: float) -> np.random.Generator:
    """Return the random generator of a factor that is a whole profile."""
    return np.random.default_rng(np.random.SeedSequence(int(u * 2.0**53)))


@dataclass(frozen=True)
class Case:
    """One dispersed flight before it is flown; ``scales`` are the factors on C_A, C_N, C_m and the shift of C_mq."""

    scenario: Scenario
    profile: AtmosphereProfile
    scales: tuple[float, float, float, float]

    @property
    def vehicle(self) -> Vehicle:
        """Vehicle as flown, but for `scales`."""
        return self.scenario.vehicle


def dispersed_case(scenario: Scenario, dispersions: Dispersions, u: dict[str, float]) -> Case:
    """Make the flight that one set of draws describes.

    Parameters
    ----------
    u : dict
        A number between 0 and 1 for every factor of ``dispersions``.

    Raises
    ------
    GateError
        Where the draws are outside what can fly: a negative mass, freeplay or stiffness, a latitude beyond the pole.
    """
    deviation = {name: law.at(u[name]) for name, law in dispersions.factors().items() if law is not None}

    def of(name: str) -> float:
        return deviation.get(name, 0.0)

    start = scenario.spec.initial
    moved = {key: getattr(start, key) + of(f"initial.{key}") for key in InitialDispersions.model_fields}
    initial = _checked(Initial, moved, "initial")
    spec = scenario.spec.model_copy(update={"initial": initial})
    flown = replace(scenario, spec=spec, vehicle=dispersed_vehicle(scenario.vehicle, of))
    # one day for all flights is that of u = 0.5, whatever the seed
    rng = rng_from_draw(u.get("atmosphere.day", 0.5))
    profile = day_of_flight_atmosphere(scenario.spec.atmosphere, rng, scenario.mean_air)
    scales = dispersed_scales(of)
    return Case(flown, _dispersed_air(profile, of), scales)


def dispersed_scales(of: Callable[[str], float]) -> tuple[float, float, float, float]:
    """Return factors on C_A, C_N, C_m and the shift of C_mq from the deviations that ``of`` gives by name."""
    ca, cn, cm = (1.0 + of(f"aerodynamics.{name}") for name in ("ca", "cn", "cm"))
    if min(ca, cn, cm) <= 0.0:
        raise GateError(
            f"drawn outside what can fly: aerodynamics: factors {ca:.3g}, {cn:.3g}, {cm:.3g} on C_A, C_N, C_m",
            code="draw-impossible",
        )
    return ca, cn, cm, of("aerodynamics.cmq")


def dispersed_vehicle(vehicle: Vehicle, of: Callable[[str], float]) -> Vehicle:
    """Vehicle with mass and joint deviations, each given by ``of`` from the factor's name; coefficients unchanged."""
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    # the offset is the whole vehicle's, the centerbody carries it
    carried = (vehicle.mass_kg / body.mass_kg) * np.array([0.0, of("mass.offset_y_m"), of("mass.offset_z_m")])
    shifted = ("station_m", "freeplay_deg", "quadratic_nmprad2", "hardening_nmprad3", "damping_hardening_nmsprad3")
    springs = {key: getattr(joint, key) + of(f"joint.{key}") for key in shifted} | {
        "bending_stiffness_nmprad": joint.bending_stiffness_nmprad * (1.0 + of("joint.stiffness")),
        "bending_damping_nmsprad": joint.bending_damping_nmsprad * (1.0 + of("joint.damping")),
        "torsion_stiffness_nmprad": joint.torsion_stiffness_nmprad * (1.0 + of("joint.torsion_stiffness")),
    }
    return replace(
        vehicle,
        joint=_checked(CompliantJoint, {**joint.model_dump(), **springs}, "joint"),
        aeroshell=_dispersed_body(shell, "aeroshell", of, np.zeros(3)),
        centerbody=_dispersed_body(body, "centerbody", of, carried),
    )


def _dispersed_body(
    part: MassProperties, name: str, of: Callable[[str], float], lateral_m: FloatArray
) -> MassProperties:
    cg = part.cg_m + lateral_m - [of(f"mass.{name}_cg_station_m"), 0.0, 0.0]
    values = {
        "mass_kg": part.mass_kg * (1.0 + of(f"mass.{name}_mass")),
        "cg_from_datum_body_m": tuple(cg.tolist()),
        "inertia_kgm2": tuple(map(tuple, (part.inertia * (1.0 + of(f"mass.{name}_inertia"))).tolist())),
    }
    return _checked(MassProperties, values, name)


def _checked(model: type[T], values: dict[str, Any], where: str) -> T:
    try:
        return model.model_validate(values)
    except ValidationError as fault:
        keys = [f"{where}.{'.'.join(map(str, e['loc']))} = {e['input']!r:.40}: {e['msg']}" for e in fault.errors()]
        raise GateError(f"drawn outside what can fly: {'; '.join(keys)}", code="draw-impossible") from None


def _dispersed_air(profile: AtmosphereProfile, of: Callable[[str], float]) -> AtmosphereProfile:
    density, wind = 1.0 + of("atmosphere.density"), [of("atmosphere.wind_north_mps"), of("atmosphere.wind_east_mps")]
    if density <= 0.0:
        raise GateError(
            f"drawn outside what can fly: atmosphere.density: a factor of {density:.3g}", code="draw-impossible"
        )
    if density == 1.0 and not any(wind):
        return profile
    winds = profile.wind_ned_mps.copy()
    winds[:, :2] += np.interp(profile.altitude_m, WIND_FADE_M, [1.0, 0.0])[:, None] * wind
    return replace(profile, log_density_ratio=profile.log_density_ratio + np.log(density), wind_ned_mps=winds)
