"""From what is a figure drawn? From a reconstruction, a run, loads or answers, as a notebook has them at hand.

Each figure asks here for the part that it draws. What has no such part is refused, with what to pass instead.
"""

from __future__ import annotations

from estimators.fusing import Fused
from estimators.loads import FlightLoads
from flightmodel.airdata import AirData
from flightmodel.checks import GateError
from flightmodel.deflection import DeflectionHistory
from flightmodel.telemetry import Telemetry
from postflight.deflections import Deflections
from postflight.filming import by_camera, keep_oriented
from postflight.flight import RECONSTRUCT, Flight
from postflight.methods import NO_VIDEO
from postflight.plots.style import TIME, flight_words
from postflight.reconstruction import Reconstruction
from postflight.runs import Run

Drawable = Reconstruction | Run | FlightLoads | Deflections
RUN, FUSE, LOADS = "pf.read_run(folder)", "pf.fuse(bet)", "pf.read_loads(table, vehicle)"


def lacking(figure: str, given: object, part: str, *wanted: str) -> GateError:
    """Error for an argument that lacks the data of a figure."""
    return GateError(f"{figure}: {type(given).__name__} has no {part}; pass {' or '.join(wanted)}", "argument-type")


def source_of(given: object) -> object:
    """Trajectory or loads from which deflections were made; anything else is its own source."""
    if isinstance(given, Deflections):
        return given.loads if given.bet is None else given.bet
    return given


def bet_of(figure: str, given: object) -> Reconstruction | Run:
    """Reconstruction or run that holds the trajectory; `GateError` if there is none."""
    bet = source_of(given)
    if isinstance(bet, Reconstruction | Run):
        return bet
    raise lacking(figure, given, "trajectory", RECONSTRUCT, RUN)


def reconstruction_of(figure: str, given: object, part: str) -> Reconstruction:
    """Computed reconstruction, the only source of a part that runs do not store; `GateError` if there is none."""
    bet = source_of(given)
    if isinstance(bet, Reconstruction):
        return bet
    raise lacking(figure, given, part, RECONSTRUCT)


def loads_of(figure: str, given: object) -> FlightLoads:
    """Motion and flow at the c.g.; `GateError` where there are none."""
    source = source_of(given)
    if isinstance(source, FlightLoads):
        return source
    if isinstance(source, Reconstruction | Run):
        return source.required_loads()
    raise lacking(figure, given, "loads", RECONSTRUCT, RUN, LOADS)


def flow_of(figure: str, given: object) -> AirData | FlightLoads:
    """Air data along the trajectory, or the loads, which name the flow alike; `GateError` where there are none."""
    source = source_of(given)
    return source.air if isinstance(source, Reconstruction | Run) else loads_of(figure, given)


def answers_of(figure: str, given: object) -> Deflections:
    """Deflections by method; `GateError` where there are none."""
    if isinstance(given, Deflections):
        return given
    if isinstance(given, Run):
        return given.deflections
    raise lacking(figure, given, "deflection", FUSE, RUN)


def history_of(figure: str, given: object, method: str) -> DeflectionHistory:
    """Deflection by one method; `GateError` with the reason where there is none."""
    try:
        return answers_of(figure, given)[method]
    except KeyError as fault:
        raise GateError(f"{figure}: {fault.args[0]}", "input-missing") from None


def fused_of(figure: str, given: object) -> Fused:
    """Posterior behind the fused answer; `GateError` where there is none."""
    answers = given if isinstance(given, Deflections) else Deflections()
    if answers.fused is None:
        raise lacking(figure, given, "posterior of the fusion, which no run stores", FUSE)
    return answers.fused


def film_of(
    figure: str, flown: object, history: DeflectionHistory | None, camera: str | None
) -> tuple[Telemetry, DeflectionHistory]:
    """Telemetry with one camera, and its deflection at every frame (NaN where it has no answer).

    The deflection is the camera's of the answers where no ``history`` is given, the camera the first where none is
    named; `GateError` where there is no film or no answer.
    """
    flight = flown if isinstance(flown, Flight) else bet_of(figure, flown).flight
    if isinstance(flown, Deflections) and flown.camera is not None:
        keep_oriented(flight.telemetry, flown.camera.oriented)
    seen = by_camera(flight.telemetry, history or history_of(figure, flown, "camera"))
    name = next(iter(seen), None) if camera is None else camera
    if name not in seen:
        raise GateError(f"{figure}: no answer of a camera {name or ''}; cameras: {', '.join(seen)}", NO_VIDEO)
    return seen[name]


def words_of(given: object) -> str:
    """Words for a figure's corner: the flight, whether it is synthetic, and what a what-if assumes."""
    source = source_of(given)
    if isinstance(source, Run):
        return flight_words(source.header["flight"], bool(source.header["synthetic"]), source.changes)
    if isinstance(source, Reconstruction | Flight):
        flight = source if isinstance(source, Flight) else source.flight
        if not flight.telemetry.t0_utc:  # a film alone
            return "; ".join((f"{flight.telemetry.required_vehicle().name}: film '{flight.name}'", *flight.changes))
        return flight_words(flight.name, flight.telemetry.synthetic, flight.changes)
    return f"{source.vehicle.name}: loads of a table" if isinstance(source, FlightLoads) else ""


def time_label(given: object) -> str:
    """Label of a time axis; times of a table or film without a flight have their own zero."""
    return TIME if isinstance(source_of(given), Reconstruction | Run | AirData) else "time (s)"
