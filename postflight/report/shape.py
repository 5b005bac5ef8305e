"""The vehicle as polygons for the page's 3-D view, and how it lay in the air at every time drawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.deflection import HOLE_FACTOR, lv_direction
from flightmodel.geometry import aft_profile, revolved, rim_curve, seam_clocks_rad, vehicle_meshes
from flightmodel.vehicle import ShellGeometry, Vehicle
from postflight.report.source import Run
from postflight.report.thinning import Rows, rounded

LEAST_SECTIONS, POINTS_PER_TORUS, RATE_HZ = 36, 6, 10.0


def solid(vehicle: Vehicle) -> dict[str, Any]:
    """Vertices, mm in body axes of the unbent vehicle, and polygons of aft side, forward skin and centerbody."""
    geometry = vehicle.geometry
    aft, faces, gores = aft_side(geometry)
    meshes = vehicle_meshes(geometry, clock_sections=len(aft), torus_sections=3)
    skin, body = meshes["forward_skin"], meshes["centerbody"]
    clocks = np.linspace(0.0, 2.0 * np.pi, 73)
    return {
        "aft": {"vertices": _mm(aft.reshape(-1, 3)), "faces": faces, "gores": gores},
        "forward": {"vertices": _mm(skin.vertices), "faces": skin.faces.tolist()},
        "centerbody": {"vertices": _mm(body.vertices), "faces": body.faces.tolist()},
        "rim": _mm(rim_curve(geometry, clocks)),
        "joint": round(1e3 * vehicle.joint.station_m),
        "length": round(1e3 * geometry.centerbody_length_m),
        "radius": round(1e3 * geometry.base_radius_m),
    }


def aft_side(geometry: ShellGeometry) -> tuple[FloatArray, list[list[int]], list[int]]:
    """Vertices ``(clocks, m, 3)`` of the aft side, its quadrangles, and which gore each lies in."""
    per_gore = max(1, -(-LEAST_SECTIONS // geometry.gore_count))
    profile = aft_profile(geometry, POINTS_PER_TORUS)
    sections, m = per_gore * geometry.gore_count, len(profile)
    clocks = seam_clocks_rad(geometry)[0] + 2.0 * np.pi * np.arange(sections) / sections
    faces, gores = [], []
    for k in range(sections):
        here, there = k * m, (k + 1) % sections * m
        for i in range(m - 1):
            faces.append([here + i, here + i + 1, there + i + 1, there + i])
            gores.append(k // per_gore)
    return revolved(profile, clocks), faces, gores


def _mm(points_m: FloatArray) -> list[list[int]]:
    return np.rint(1e3 * np.asarray(points_m)).astype(int).tolist()


def poses(run: Run, rows: Rows) -> dict[str, Any]:
    """Bending vector (body y, z, deg) by the best method, and where the air comes from (body y, z, deg), over time.

    Vectors, so that a page may draw straight lines between them where clocking angles would wrap.
    """
    bet = run.tables["bet"].iloc[rows]
    known = bet["alpha_total_wind_deg"].notna()
    thin = bet[known].iloc[:: max(1, len(bet[known]) // 3000)]
    out: dict[str, Any] = {
        "flow": {"t": rounded(thin["t_s"].to_numpy(), 3)} | _lateral(thin["alpha_total_wind_deg"], thin["clock_lv_deg"])
    }
    method = best_method(run)
    if method is not None:
        table = run.tables[f"deflection_{method}"]
        t = table["t_s"].to_numpy()
        out["bend"] = {"t": rounded(t, 3), "method": method, "hole": hole_s(t)}
        out["bend"] |= _lateral(table["theta_deg"], table["plane_lv_deg"])
    return out


def hole_s(time_s: FloatArray) -> float:
    """Distance between answers above which nothing is drawn between them, s."""
    return round(HOLE_FACTOR * float(np.median(np.diff(time_s))), 4) if len(time_s) > 1 else 0.0


def _lateral(size: Any, clock: Any) -> dict[str, list[float | None]]:
    yz = np.asarray(size, dtype=float)[:, None] * lv_direction(np.deg2rad(np.asarray(clock, dtype=float)))[:, 1:]
    return {"y": rounded(yz[:, 0], 4), "z": rounded(yz[:, 1], 4)}


def best_method(run: Run) -> str | None:
    """Fusion, or else the method that is surest at peak dynamic pressure; None where none answers there."""
    told = {name: m for name, m in run.summary["methods"].items() if m["deflection_deg"] is not None}
    if "fused" in told:
        return "fused"
    return min(told, key=lambda name: told[name]["sd_deg"], default=None)
