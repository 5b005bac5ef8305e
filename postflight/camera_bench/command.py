"""The command ``postflight camera``: a bench for a flight folder's film, until Ctrl-C."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from flightmodel.camera_edits import EDITS_FILE
from flightmodel.checks import ConfigError, GateError, nearest_name
from postflight.camera_bench.server import HOST, serve
from postflight.camera_bench.session import Session
from postflight.commands import compile_kernels, console
from postflight.flight import Flight, read_flight


def open_bench(folder: Path, camera: str | None, port: int, browser: bool) -> None:
    """Serve the bench's page on this machine until interrupted.

    Raises
    ------
    GateError
        Where the folder has no video or cannot be read, or the port is taken.
    """
    session = session_of(read_flight(folder, needs_path=False), folder, camera)
    try:
        server, address = serve(session, port)
    except (OSError, SystemExit):  # the library ends the process itself
        session.close()
        raise GateError(f"--port {port}: {HOST} does not offer it; leave --port out", code="port-taken") from None
    console.print(f"film of {folder} at {address}", markup=False)
    console.print(f"decisions are saved in {folder / EDITS_FILE}; Ctrl-C ends the bench", markup=False)
    console.file.flush()  # into a pipe, too, before the page is waited for
    if browser:
        webbrowser.open(address)
    try:
        server.serve_forever()
    finally:
        server.server_close()
        session.close()


def session_of(flight: Flight, folder: Path, camera: str | None = None) -> Session:
    """Session for a camera's film, of several the first without a name; `GateError` where there is none such."""
    films = flight.telemetry.films
    if not films:
        raise GateError(f"{folder}: the flight has no video; [frames] in flight.toml names it", code="video-missing")
    name = next(iter(films)) if camera is None else camera
    if name not in films:
        words = f"--camera {name}{nearest_name(name, films)}: the flight has films of {', '.join(films)}"
        raise ConfigError(words, code="camera-unknown")
    compile_kernels("camera")
    return Session(folder, films[name], flight.telemetry.required_vehicle())
