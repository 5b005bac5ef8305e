"""Web page of the camera bench, served to this machine only.

The server listens on 127.0.0.1 alone. Every address begins with a random token that only the printed address holds;
the Host header must name this machine (another site's name that resolves to it is refused), a request that changes
anything must come from the page itself, as JSON. Pages load nothing from anywhere else.
"""

from __future__ import annotations

import hmac
import json
import secrets
import webbrowser
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from werkzeug.exceptions import BadRequest, HTTPException, NotFound
from werkzeug.serving import BaseWSGIServer, WSGIRequestHandler, make_server
from werkzeug.wrappers import Request, Response

from flightmodel.camera_edits import EDITS_FILE
from flightmodel.checks import ConfigError, FloatArray, GateError, nearest_name
from postflight.camera_bench.session import Session
from postflight.commands import compile_kernels, console
from postflight.flight import Flight, read_flight
from postflight.plots.style import OVER_FRAME, PAGE

HOST = "127.0.0.1"
_MOST_BYTES = 4_000_000
_KINDS = {"page.html": "text/html", "page.js": "text/javascript", "page.css": "text/css"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class _LocalRequest(Request):
    trusted_hosts = [HOST, "localhost"]
    max_content_length = _MOST_BYTES


class _SilentHandler(WSGIRequestHandler):
    """Request handler that logs nothing, since log lines would contain the token."""

    def log(self, type: str, message: str, *args: Any) -> None:
        """Log nothing."""


class Bench:
    """WSGI application of one session.

    Parameters
    ----------
    session : Session
    token : str, optional
        What every address begins with; drawn at random.
    """

    def __init__(self, session: Session, token: str = "") -> None:
        self.session = session
        self.token = token or secrets.token_urlsafe(24)

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        """Answer one request."""
        request = _LocalRequest(environ)
        try:
            response = self._answer(request)
        except GateError as fault:
            said = [{"words": str(one), "code": one.code} for one in fault.faults]
            status = 409 if "edits-changed" in fault.codes else 422
            response = _json({"faults": said}, status)
        except HTTPException as refused:
            response = Response(f"{refused.code} {refused.name}\n", refused.code, content_type="text/plain")
        response.headers.update(_HEADERS)
        return response(environ, start_response)

    def _answer(self, request: _LocalRequest) -> Response:
        port = request.host.rpartition(":")[2]  # refuses an untrusted Host
        token, _, rest = request.path.lstrip("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.token.encode()) or not request.path.startswith(f"/{token}/"):
            raise NotFound
        if request.method == "POST" and rest == "edits":
            return self._save(request, port)
        if request.method != "GET":
            raise BadRequest
        name = rest or "page.html"
        if name in _KINDS:
            data = resources.files("postflight.camera_bench").joinpath("page", name).read_text()
            if name == "page.css":
                colours = " ".join(f"--{meaning}: {value};" for meaning, value in {**PAGE, **OVER_FRAME}.items())
                data = f":root {{ {colours} }}\n{data}"
            return Response(data, content_type=f"{_KINDS[name]}; charset=utf-8")
        if rest == "state":
            return _json(self.session.state())
        kind, _, number = rest.partition("/")
        count = self.session.count if kind in ("picture", "frame") else 0
        if not number.isascii() or not number.isdigit() or len(number) > 9 or int(number) >= count:
            raise NotFound
        if kind == "picture":
            return Response(self.session.picture(int(number)), content_type="image/png")
        theta, plane = (_number(request, key) for key in ("theta_deg", "plane_deg"))
        tried = [None if angle is None else float(np.deg2rad(angle)) for angle in (theta, plane)]
        return _json(self.session.frame(int(number), tried[0], tried[1], _pose(request)))

    def _save(self, request: _LocalRequest, port: str) -> Response:
        """Save the page's decisions; requests from another origin, or not in JSON, are refused."""
        own = {f"http://{name}:{port}" for name in (HOST, "localhost")}
        if request.headers.get("Origin", "") not in own or request.mimetype != "application/json":
            raise BadRequest
        try:
            sent = json.loads(request.get_data(as_text=True))
            rows, revision = sent["edits"], sent["revision"]
        except (ValueError, KeyError, TypeError, RecursionError):
            raise BadRequest from None
        if not isinstance(rows, list) or not isinstance(revision, str):
            raise BadRequest
        return _json(self.session.save(rows, revision))


def _json(content: Any, status: int = 200) -> Response:
    return Response(json.dumps(content, allow_nan=False), status, content_type="application/json")


def _number(request: Request, key: str) -> float | None:
    """Finite number of a query; None without one."""
    text = request.args.get(key)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        raise BadRequest from None
    if not abs(value) <= 360.0:
        raise BadRequest
    return value


def _pose(request: Request) -> FloatArray | None:
    """Pose (4,) of a query, rad and a factor; None without one."""
    turned = [_number(request, key) for key in ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg", "focal_factor")]
    if any(value is None for value in turned):
        return None
    pose = np.array(turned, dtype=float)
    if not 0.5 <= pose[3] <= 2.0 or np.abs(pose[:3]).max() > 45.0:
        raise BadRequest
    return np.array([*np.deg2rad(pose[:3]), pose[3]])


def serve(session: Session, port: int = 0) -> tuple[BaseWSGIServer, str]:
    """Create a session's server, to be started by `BaseWSGIServer.serve_forever`, and the page's address.

    Parameters
    ----------
    session : Session
    port : int
        0 takes any free one.

    Raises
    ------
    OSError
        Where the port is taken.
    """
    bench = Bench(session)
    server = make_server(HOST, port, bench, threaded=True, request_handler=_SilentHandler)
    return server, f"http://{HOST}:{server.server_port}/{bench.token}/"


# the command


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
    """Session of a camera's film, the first one without a name; `GateError` if there is no such film."""
    films = flight.telemetry.films
    if not films:
        raise GateError(f"{folder}: the flight has no video; [frames] in flight.toml names it", code="video-missing")
    name = next(iter(films)) if camera is None else camera
    if name not in films:
        words = f"--camera {name}{nearest_name(name, films)}: the flight has films of {', '.join(films)}"
        raise ConfigError(words, code="name-unknown")
    compile_kernels("camera")
    return Session(folder, films[name], flight.telemetry.required_vehicle())
