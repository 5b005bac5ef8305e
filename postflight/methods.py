"""Which methods can run on the data at hand, and what do the others lack?

One place decides (`Inputs.missing`): ``postflight check`` says it in its first line, and a method that is asked for
without its data is refused with the same words.

| method | needs |
|---|---|
| trajectory | a tracker (radar or receiver), or an entry state |
| camera | a film and a vehicle file |
| misalignment, trim, fused | the trajectory with accelerometer and gyros, or a table of loads; a vehicle file |
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flightmodel.checks import GateError, Issue
from flightmodel.film import FILM_SUFFIXES
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Telemetry

if TYPE_CHECKING:  # `postflight check` waits for no estimator and no filter
    from estimators.loads import FlightLoads

NO_VIDEO = "video-missing"  # code of the refusal
BY_LOADS = ("misalignment", "trim", "fused")
_NO_TRACKER = Issue(
    "there is no radar, receiver or entry state, which the trajectory needs: state [radars.NAME], [gnss.NAME] or "
    "[start.state]; a table of another trajectory takes its place ([loads], pf.read_loads)",
    "tracker-missing",
)
_OTHER_TEAMS = Issue("the trajectory is another team's table of loads, so none is reconstructed", "tracker-missing")
_NO_FILM = Issue("there is no film, which the camera needs: [frames] in flight.toml names one", NO_VIDEO)
_NO_VEHICLE = Issue(
    'there is no vehicle file, which every estimate of the deflection needs: write vehicle = "..." in flight.toml',
    "vehicle-missing",
)
_NO_TRIADS = Issue(
    "there are no inertial sensors, which misalignment, trim and the fusion need: state [sensors.accelerometer] and "
    "[sensors.rates]",
    "inertial-missing",
)


@dataclass(frozen=True)
class Inputs:
    """Available data: vehicle file, film, accelerometer with gyros, tracker (or entry state), table of loads."""

    vehicle: bool = False
    film: bool = False
    inertial: bool = False
    tracker: bool = False
    loads: bool = False

    @classmethod
    def of(cls, given: Telemetry | Sources | FlightLoads) -> Inputs:
        """Find what telemetry, the sources of a flight folder, or loads hold."""
        if isinstance(given, Sources):
            inertial, state, loads = {"accelerometer", "rates"} <= set(given.triads), given.state, given.loads
        elif isinstance(given, Telemetry):
            inertial, state = given.accelerometer is not None and given.rates is not None, given.start.state
            loads = given.loads
        else:
            return cls(vehicle=True, loads=True)
        tracker = bool(given.radars or given.gnss or state is not None)
        return cls(given.vehicle is not None, bool(given.films), inertial, tracker, loads is not None)

    def missing(self) -> dict[str, Issue]:
        """Reason why a method cannot run, by method; methods that can run are left out."""
        out = {}
        if not self.tracker:
            out["trajectory"] = _OTHER_TEAMS if self.loads else _NO_TRACKER
        if not (self.film and self.vehicle):
            out["camera"] = _NO_VEHICLE if self.film else _NO_FILM
        if not (self.vehicle and (self.loads or (self.inertial and self.tracker))):
            why = _NO_VEHICLE if not self.vehicle else _NO_TRIADS if not self.inertial else _NO_TRACKER
            out |= dict.fromkeys(BY_LOADS, why)
        return out

    def require(self, method: str) -> None:
        """Raise `GateError` with the reason where a method cannot run."""
        if method in (missing := self.missing()):
            raise GateError([missing[method]])

    @property
    def names(self) -> str:
        """Methods that can run, in words."""
        missing = self.missing()
        can = [method for method in ("trajectory", "camera", *BY_LOADS) if method not in missing]
        if not missing:
            return f"all ({', '.join(can)})"
        if self.loads and not (self.tracker or self.film):
            return "misalignment and trim from loads"
        return f"{can[0]} alone" if len(can) == 1 else ", ".join(can) or "nothing"

    def __str__(self) -> str:
        """Methods that can run, and what the others lack."""
        return "; ".join([self.names, *dict.fromkeys(self.missing().values())])


def runs_alone(folder: Path, vehicle: Path, named: set[str]) -> dict[str, Inputs]:
    """Find tables and pictures of a folder from which a method runs without flight.toml.

    Parameters
    ----------
    folder : Path
    vehicle : Path
        Vehicle file.
    named : set of str
        Tables that flight.toml reads, relative to the folder, which are left out.

    Returns
    -------
    dict of Inputs
        What each command, written out, has data for.
    """
    from postflight.film_alone import read_film
    from postflight.loads_table import read_loads

    def telemetry_of(film: Path, times: Path) -> Telemetry:
        return read_film(film, times, vehicle).telemetry

    out: dict[str, Inputs] = {}
    tables = [path for place in (folder, folder / "telemetry") for path in sorted(place.glob("*.csv"))]
    for table in (path for path in tables if path.relative_to(folder).as_posix() not in named):
        beside = sorted(path for path in table.parent.iterdir() if path.is_dir() or path.suffix in FILM_SUFFIXES)
        attempts: dict[str, Callable[[], FlightLoads | Telemetry]] = {
            f"--loads {table}": partial(read_loads, table, vehicle),
            **{f"--film {film} --times {table}": partial(telemetry_of, film, table) for film in beside},
        }
        for words, read in attempts.items():
            with suppress(GateError):
                out[f"postflight deflection {words} --vehicle {vehicle}"] = Inputs.of(read())
    return out
