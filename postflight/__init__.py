"""What an entry vehicle really did, and how far its flexible aeroshell deflected: the public interface.

``import postflight as pf`` is all that a notebook or a script needs::

    flight = pf.read_flight("my-flight")        # telemetry behind the gate
    bet = pf.reconstruct(flight)                # best-estimated trajectory, air data, consistency checks
    answer = pf.fuse(bet)                       # the deflection by every method, and fused
    answer = pf.fuse(pf.read_loads("bet.csv", "vehicle.toml"))  # the same on another team's trajectory
    history = pf.estimate_camera(pf.read_film("pictures", "frames.csv", "vehicle.toml"))  # a film and no trajectory
    changed = flight.with_(c_n=1.1, wind=None)  # a what-if is a changed flight
    run = pf.read_run("my-flight")              # what `postflight run` left: run.trajectory, run.air, run.deflections

Every result prints itself in one line, shows as a table in a notebook, and gives its data by ``to_frame()`` with units
in the column names. Everything that is not listed here is internal.

Conventions
-----------
- SI and radians in memory, degrees in tables and files; a name ends in its unit (``_m``, ``_mps``, ``_rad``, ``_deg``).
- Frames: ``eci`` (equal to ECEF at the flight's t0, then fixed), ``ecef`` (WGS-84), ``ned``, ``body`` (centerbody: x
  out of the nose), ``shell`` (aeroshell; equal to body undeflected), ``lv`` (clocking angles about the axis), ``cam``
  (OpenCV).
- ``v_to = dcm_to_from @ v_from``; quaternions ``q_to_from`` are Hamilton, scalar first.
- ``theta`` is the angle between the x axes of the two bodies, ``plane_lv`` the clocking angle towards which the shell's
  nose axis tilts in the body frame.
- ``error = estimate - truth``, ``residual = measured - predicted``; +/- is one standard deviation (``_sd``).
- Times are seconds after the flight's t0; heights are above the WGS-84 ellipsoid; wind is the velocity of the air mass.

CONVENTIONS.md has them all. Refusals are `GateError`, a `ValueError`, with a stable code for each fault
(``error.codes``).
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimators.loads import FlightLoads
    from flightmodel.checks import GateError
    from flightmodel.deflection import DeflectionHistory
    from flightmodel.trajectory import Trajectory
    from postflight import plots
    from postflight.checks.vehicle_check import check_vehicle, read_vehicle
    from postflight.deflections import (
        Deflections,
        aero_increments,
        estimate_camera,
        estimate_misalignment,
        estimate_trim,
        fuse,
    )
    from postflight.film_alone import read_film
    from postflight.flight import Flight, read_flight
    from postflight.flown_coefficients import AeroIncrements
    from postflight.interface import check_flight, compare, monte_carlo, score, simulate, write_report
    from postflight.loads_table import read_loads
    from postflight.reconciliation.command import reconcile
    from postflight.reconstruction import Reconstruction, air_data, reconstruct
    from postflight.runs import Run, read_run
    from recon.settings import Settings
    from synthetic_flight.scenarios import read_scenario

# imported on first use, so that `postflight --help` answers at once
_DOOR = {
    name: module
    for module, names in {
        "flightmodel.checks": "GateError",
        "postflight.flight": "read_flight Flight",
        "postflight.interface": "check_flight simulate score monte_carlo compare write_report",
        "postflight.reconstruction": "reconstruct Reconstruction air_data",
        "recon.settings": "Settings",
        "flightmodel.trajectory": "Trajectory",
        "postflight.loads_table": "read_loads",
        "postflight.film_alone": "read_film",
        "postflight.runs": "read_run Run",
        "estimators.loads": "FlightLoads",
        "postflight.deflections": "Deflections aero_increments estimate_camera estimate_misalignment estimate_trim "
        "fuse",
        "postflight.flown_coefficients": "AeroIncrements",
        "flightmodel.deflection": "DeflectionHistory",
        "postflight.checks.vehicle_check": "check_vehicle read_vehicle",
        "synthetic_flight.scenarios": "read_scenario",
        "postflight.reconciliation.command": "reconcile",
    }.items()
    for name in names.split()
}

__all__ = [
    "AeroIncrements",
    "DeflectionHistory",
    "Deflections",
    "Flight",
    "FlightLoads",
    "GateError",
    "Reconstruction",
    "Run",
    "Settings",
    "Trajectory",
    "aero_increments",
    "air_data",
    "check_flight",
    "check_vehicle",
    "compare",
    "estimate_camera",
    "estimate_misalignment",
    "estimate_trim",
    "fuse",
    "monte_carlo",
    "plots",
    "read_film",
    "read_flight",
    "read_loads",
    "read_run",
    "read_scenario",
    "read_vehicle",
    "reconcile",
    "reconstruct",
    "score",
    "simulate",
    "write_report",
]


def _require_own_packages() -> None:
    """Raise `ImportError` if a script or another distribution shadows one of our packages (docs/decisions/0012)."""
    ours = Path(__file__).parents[1]
    for name in ("flightmodel", "recon", "estimators", "synthetic_flight"):
        found = find_spec(name)
        if found and found.origin and ours / name not in Path(found.origin).parents:
            raise ImportError(
                f"{found.origin} hides the package '{name}' of postflight ({ours / name}): rename it, start Python in "
                "another folder, or install postflight in an environment of its own"
            )


_require_own_packages()


def __getattr__(name: str) -> Any:
    """Import a public name on its first use."""
    if name == "plots":
        return import_module("postflight.plots")
    if name not in _DOOR:
        raise AttributeError(f"module 'postflight' has no attribute '{name}'; public names: {', '.join(__all__)}")
    found = getattr(import_module(_DOOR[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Public names."""
    return sorted(__all__)
