"""What a Monte Carlo study is: a dispersions file with its scenario, and all that decides its numbers.

Two studies are the same where their settings are: everything but how many flights are wanted and when to stop. A folder
holds flights of one study alone.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from flightmodel.checks import ConfigError, nearest_name
from flightmodel.config import Section, parse_section, read_toml
from flightmodel.vehicle import DATA, Vehicle
from postflight.montecarlo import whole
from postflight.montecarlo.design import Design, design_for
from synthetic_flight.dispersed_ensemble import Plan, legs
from synthetic_flight.dispersions import Dispersions, Window, draws
from synthetic_flight.outputs import QUANTITIES, SCALARS, check_names
from synthetic_flight.scenarios import read_scenario

PERCENTILES = (2.3, 50.0, 97.7)
MOST_FLIGHTS = 10_000_000
CONFIDENCE = 0.95
Flights = Annotated[int, Field(ge=1, le=MOST_FLIGHTS)]


class Outputs(Section):
    """What is kept of every flight: named numbers, and histories for the bands."""

    scalars: tuple[str, ...]
    histories: tuple[str, ...] = ()


class Stop(Section):
    """Enough flights: the interval of one output's percentile is narrower than a width, in the output's unit."""

    output: str
    width: Annotated[float, Field(gt=0.0)]
    percentile: Annotated[float, Field(gt=0.0, lt=100.0)] = 97.7
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = CONFIDENCE


class DispersionsFile(Dispersions):
    """The whole of a dispersions file."""

    scenario: str
    flights: Flights = 1000
    seed: Annotated[int, Field(ge=0)] = 0
    mode: Literal["simulation", "whole"] = "simulation"
    chunk: Annotated[int, Field(ge=1, le=4096)] = 64
    window: Window
    outputs: Outputs
    stop: Stop | None = None


@dataclass(frozen=True)
class Study:
    """A study ready to fly.

    Parameters
    ----------
    spec : DispersionsFile
    plan : Plan
        With the outputs that the mode gives.
    source : Path
    design : Design or None
        Where draws come from another design than random ones (`postflight.montecarlo.sobol`).
    """

    spec: DispersionsFile
    plan: Plan
    source: Path
    design: Design | None = None

    @property
    def named(self) -> str:
        """How the dispersions file is found again: the name of a shipped one, or its whole path."""
        shipped = self.source.parent == DATA / "dispersions"
        return self.source.stem if shipped else str(self.source.resolve())

    def draws_of(self, run: int) -> dict[str, float]:
        """Return the number between 0 and 1 of every factor in one run."""
        if self.design is not None:
            return self.design.draws_of(run)
        return draws(self.plan.dispersions, self.spec.seed, run)

    def runs_of(self, chunk: int, flights: int) -> list[int]:
        """Run numbers of one chunk of a study of so many flights."""
        first = chunk * self.spec.chunk
        return list(range(first, min(first + self.spec.chunk, flights)))

    def chunks(self, flights: int) -> int:
        """Return how many chunks so many flights are."""
        return -(-flights // self.spec.chunk)

    def settings(self) -> dict[str, Any]:
        """All that decides the numbers, flat: key to value."""
        scenario = self.plan.scenario
        out = _flat("", self.spec.model_dump(mode="json", exclude={"flights", "stop", "scenario"}))
        out |= _flat("scenario.", scenario.spec.model_dump(mode="json"))
        out |= _flat("vehicle.", vehicle_facts(scenario.vehicle))
        return out | ({} if self.design is None else _flat("sobol.", self.design.settings()))


def vehicle_facts(vehicle: Vehicle) -> dict[str, Any]:
    """What of a vehicle decides how it flies and what the analyst knows of it."""
    table = vehicle.aero.coefficients.tobytes() + vehicle.aero.mach.tobytes() + vehicle.aero.alpha_rad.tobytes()
    if vehicle.aero.free_molecular is not None:
        table += vehicle.aero.free_molecular.tobytes()
    parts = ("reference", "joint", "aeroshell", "centerbody", "uncertainty", "geometry")
    facts = {name: getattr(vehicle, name).model_dump(mode="json") for name in parts}
    return facts | {"coefficients_sha256": hashlib.sha256(table).hexdigest()}


def sobol_study(study: Study, by: str, base: int) -> Study:
    """Return a study that flies Saltelli's design instead of random draws, one column a factor or a section."""
    if study.spec.mode == "whole":
        raise ConfigError(f"{study.source}: mode = 'whole': Sobol indices are of simulations alone")
    design = design_for(tuple(study.spec.factors()), by, base, study.spec.seed)
    return replace(study, plan=replace(study.plan, histories=()), design=design)


def _flat(prefix: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix.removesuffix("."): value}
    out: dict[str, Any] = {}
    for key, part in value.items():
        out |= _flat(f"{prefix}{key}.", part)
    return out


def shipped_dispersions() -> list[str]:
    """Names of the dispersions files that ship with the toolkit."""
    return sorted(p.stem for p in (DATA / "dispersions").glob("*.toml"))


def dispersions_path(name: str) -> Path:
    """Find a dispersions file: a path, or the name of one that ships with the toolkit."""
    if name.endswith(".toml"):
        return Path(name)
    shipped = shipped_dispersions()
    if name not in shipped:
        hint = f"{nearest_name(name, shipped)}; shipped: {', '.join(shipped)}; a path ends in .toml"
        raise ConfigError(f"no dispersions file '{name}'{hint}")
    return DATA / "dispersions" / f"{name}.toml"


def read_study(name: str) -> Study:
    """Read a dispersions file and its scenario.

    Parameters
    ----------
    name : str
        Path of a TOML file, or the name of one that ships with the toolkit. A scenario given as a path is looked for
        beside the file.

    Raises
    ------
    ConfigError
        With every fault of the file.
    """
    path = dispersions_path(name)
    spec = parse_section(DispersionsFile, read_toml(path), str(path))
    own = path.parent / spec.scenario
    scenario = read_scenario(str(own) if spec.scenario.endswith(".toml") else spec.scenario)
    faults: list[str] = []
    known = whole.SCALARS if spec.mode == "whole" else SCALARS
    histories = () if spec.mode == "whole" else tuple(QUANTITIES)
    for key, names, allowed in (
        ("outputs.scalars", spec.outputs.scalars, known),
        ("outputs.histories", spec.outputs.histories, histories),
        ("stop.output", () if spec.stop is None else (spec.stop.output,), spec.outputs.scalars),
    ):
        try:
            check_names(names, allowed)
        except ConfigError as fault:
            faults += [f"{path}: key '{key}': {words}" for words in fault.faults]
    if spec.mode == "whole":
        faults += [f"{path}: {words}" for words in whole.not_possible(spec)]
    try:
        legs(scenario.spec.time, spec.window, spec.joint_is == "locked")
    except ConfigError as fault:
        faults += [f"{path}: {words}" for words in fault.faults]
    if faults:
        raise ConfigError(faults)
    return Study(spec, Plan(scenario, spec, spec.window, spec.outputs.scalars, spec.outputs.histories), path)
