"""What does the report's 3-D view show? The vehicle as polygons, its deflection and the relative wind at every time.

Polygons are in body axes, undeflected; the page rotates the aeroshell about the joint itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray
from flightmodel.deflection import HOLE_FACTOR, lv_direction
from flightmodel.geometry import aft_profile, forward_profile, revolved, rim_curve
from flightmodel.vehicle import Vehicle
from postflight.report.source import Rows, rounded
from postflight.run_folder import answer_table
from postflight.runs import Run

_CONE_PIECES, _POSES = 8, 3000


def solid(vehicle: Vehicle) -> dict[str, Any]:
    """Vertices, mm in body axes of the undeflected vehicle, and quadrangles of aft side, forward skin and centerbody.

    Seen from outside, a quadrangle's vertices go round against the clock.
    """
    geometry = vehicle.geometry
    per_gore = max(1, -(-48 // geometry.gore_count))  # 48 sections or more in all
    sections = per_gore * geometry.gore_count
    aft = aft_profile(geometry, 7)
    forward = forward_profile(geometry)
    forward = np.concatenate([forward[:-1], np.linspace(forward[-2], forward[-1], _CONE_PIECES + 1)[1:]])
    # the centerbody shows where it comes out of the shell; it ends in a lid
    stations = np.linspace(aft[0, 0], geometry.centerbody_length_m, _CONE_PIECES)
    body = np.column_stack([stations, np.full(_CONE_PIECES, geometry.centerbody_radius_m)])
    body = np.concatenate([body, [[geometry.centerbody_length_m, 0.0]]])
    gores = np.repeat(np.arange(sections) // per_gore, len(aft) - 1).tolist()
    return {
        "aft": _surface(aft[::-1], sections) | {"gores": gores},
        "forward": _surface(forward, sections),
        "centerbody": _surface(body, sections),
        "rim": _mm(rim_curve(geometry, np.linspace(0.0, 2.0 * np.pi, 73))),
        "joint": round(1e3 * vehicle.joint.station_m),
        "length": round(1e3 * geometry.centerbody_length_m),
        "radius": round(1e3 * geometry.base_radius_m),
    }


def _surface(profile_station_radius_m: FloatArray, sections: int) -> dict[str, Any]:
    """Surface of revolution of a meridian that has the vehicle on its right, going out from the nose or aft."""
    clocks = 2.0 * np.pi * np.arange(sections) / sections
    m, faces = len(profile_station_radius_m), []
    for k in range(sections):
        here, there = k * m, (k + 1) % sections * m
        faces += [[here + i, there + i, there + i + 1, here + i + 1] for i in range(m - 1)]
    return {"vertices": _mm(revolved(profile_station_radius_m, clocks).reshape(-1, 3)), "faces": faces}


def _mm(points_m: FloatArray) -> list[list[int]]:
    return np.rint(1e3 * np.asarray(points_m)).astype(int).tolist()


def poses(run: Run, rows: Rows) -> dict[str, Any]:
    """Deflection (body y, z, deg) by the best method, and direction of the relative wind (body y, z, deg), over time.

    Vectors, so that a page may draw straight lines between them where clocking angles would wrap.
    """
    bet = run.tables["bet"].iloc[rows]
    known = bet["alpha_total_wind_deg"].notna()
    thin = _thinned(bet[known])
    flow = _lateral(thin["alpha_total_wind_deg"], thin["clock_lv_deg"])
    out: dict[str, Any] = {"flow": {"t": rounded(thin["t_s"].to_numpy(), 3)} | flow}
    method = best_method(run)
    if method is not None:
        table = _thinned(run.tables[answer_table(method, run.tables)])
        t = table["t_s"].to_numpy()
        out["deflection"] = {"t": rounded(t, 3), "method": method, "hole": hole_s(t)}
        out["deflection"] |= _lateral(table["theta_deg"], table["plane_lv_deg"])
    return out


def _thinned(table: pd.DataFrame) -> pd.DataFrame:
    """Rows at equal steps, at most ``_POSES``."""
    return table.iloc[:: -(-len(table) // _POSES) or 1]


def hole_s(time_s: FloatArray) -> float:
    """Largest interval between answers across which a line is drawn, s."""
    return round(HOLE_FACTOR * float(np.median(np.diff(time_s))), 4) if len(time_s) > 1 else 0.0


def _lateral(size: Any, clock: Any) -> dict[str, list[float | None]]:
    yz = np.asarray(size, dtype=float)[:, None] * lv_direction(np.deg2rad(np.asarray(clock, dtype=float)))[:, 1:]
    return {"y": rounded(yz[:, 0], 4), "z": rounded(yz[:, 1], 4)}


def best_method(run: Run) -> str | None:
    """Fusion, or else the method with the smallest sd at peak dynamic pressure; None where none answers there."""
    answers = {name: m for name, m in run.summary["methods"].items() if m["deflection_deg"] is not None}
    if "fused" in answers:
        return "fused"
    return min(answers, key=lambda name: answers[name]["sd_deg"], default=None)
