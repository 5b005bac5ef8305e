"""Can the camera be oriented on the benchmark frame, and does the frame show the features that the vehicle file states?

The frame is tried as a run would use it, which takes seconds where the camera's lens is not calibrated. Nothing is
estimated from any other frame.
"""

from __future__ import annotations

from flightmodel.checks import GateError
from flightmodel.film import Frames
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding
from flightmodel.vehicle import Vehicle


def benchmark_frame(found: Sources) -> list[Finding]:
    """Check that every camera's benchmark frame orients it.

    Returns
    -------
    list of Finding
        Why it does not, with the code that a run would refuse the film with; or ``features-not-found`` (or the code of
        the failed orientation) where another way had to be taken than by the features that the vehicle file states.
    """
    films = {table: found.films[name] for table, name in found.spec.film_names.items() if name in found.films}
    return [finding for table, frames in films.items() for finding in _tried(table, frames, found.vehicle)]


def _tried(source: str, frames: Frames, vehicle: Vehicle | None) -> list[Finding]:
    if vehicle is None or not len(frames.time_s):
        return []
    from postflight.filming import orient_on_film  # which a folder without video needs not wait for

    at = float(frames.time_s[frames.benchmark])
    try:
        oriented = orient_on_film(frames, vehicle)
    except GateError as fault:
        return [Finding(source, str(fault), at, at, fault.codes[0])]
    if oriented.stated_refused:
        words = f"{oriented.stated_refused}; a run goes by the edge and the shell's texture"
        return [Finding(source, words, at, at, oriented.stated_refused.code)]
    return []
