"""How does a vehicle file look from the side? Its outline with c.g., joint, centre of pressure and cameras to scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flightmodel.checks import FloatArray, check_type
from flightmodel.deflection import lv_direction
from flightmodel.geometry import forward_profile, torus_circles
from flightmodel.linear import levers, slopes_at
from flightmodel.vehicle import Vehicle
from postflight.plots.style import COLOUR, in_style, titled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIGHT = 0.25  # length of a camera's line of sight, of the base radius: seen, and not in the way


@in_style
def figure_vehicle(vehicle: Vehicle, mach: float | None = None) -> Figure:
    """Draw a vehicle from the side, flow from the left, clocking angle 0 up, to scale.

    Parameters
    ----------
    vehicle : Vehicle
        Drawn undeflected, as it starts; a body with a mesh by its mesh, the other by ``[geometry]``.
    mach : float, optional
        Of the centre of pressure; by default the largest of the coefficient table.
    """
    from matplotlib.figure import Figure

    check_type("figure_vehicle", vehicle, Vehicle, "pf.read_vehicle(file)")
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    ax = figure.subplots()
    _bodies(ax, vehicle)
    at = float(vehicle.aero.mach[-1]) if mach is None else mach
    (slopes,) = slopes_at(vehicle, np.array([at]))
    marks: list[tuple[str, FloatArray, str, str]] = [
        ("joint", vehicle.joint_m, "D", COLOUR["second"]),
        ("c.g. of the aeroshell", vehicle.aeroshell.cg_m, "v", COLOUR["estimate"]),
        ("c.g. of the centerbody", vehicle.centerbody.cg_m, "^", COLOUR["estimate"]),
        ("c.g.", vehicle.cg_m, ".", COLOUR["truth"]),
    ]
    if slopes.cn_alpha > 0.0:
        pressure = np.array([vehicle.cg_m[0] - levers(vehicle, slopes)[1], 0.0, 0.0])
        marks.append((f"centre of pressure, Mach {at:g}", pressure, "X", COLOUR["corrected"]))
    for label, place, marker, colour in marks:
        ax.plot(*_seen(place), marker=marker, ls="", ms=9, color=colour, mec=COLOUR["gap"], label=label)
    _cameras(ax, vehicle)
    ax.axhline(0.0, color=COLOUR["zero"], lw=0.6, ls="-.", zorder=0)
    ax.set(aspect="equal", xlabel="station aft of the nose (m)", ylabel="towards 0 deg LV (m)")
    ax.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
    return titled(figure, f"{vehicle.name}, {vehicle.mass_kg:.4g} kg", "undeflected, to scale; flow from the left")


def _seen(points_body_m: FloatArray) -> FloatArray:
    """Station aft of the nose and height towards 0 deg LV, (2, ...), m, of points (..., 3) in body axes."""
    return np.stack([-points_body_m[..., 0], points_body_m @ lv_direction(0.0)])


def _bodies(ax: Axes, vehicle: Vehicle) -> None:
    """Draw the outlines: skin and tori in section, the centerbody as a box, or a mesh's triangles."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle, Rectangle

    shell, length, radius = vehicle.geometry, vehicle.geometry.centerbody_length_m, vehicle.geometry.centerbody_radius_m
    if "centerbody" not in vehicle.meshes:
        ax.add_patch(Rectangle((0.0, -radius), length, 2.0 * radius, fc=COLOUR["prior_band"], ec=COLOUR["limit"]))
    if "aeroshell" not in vehicle.meshes:
        station, height = forward_profile(shell).T
        for side in (1.0, -1.0):
            ax.plot(station, side * height, color=COLOUR["limit"], lw=1.5)
            for s, r in zip(*torus_circles(shell), strict=True):
                torus = Circle((s, side * r), shell.torus_minor_radius_m, fc=COLOUR["prior_band"], ec=COLOUR["limit"])
                ax.add_patch(torus)
    for mesh in vehicle.meshes.values():
        triangles = np.moveaxis(_seen(mesh.vertices_m[mesh.faces]), 0, -1)
        ax.add_collection(PolyCollection(list(triangles), fc=COLOUR["prior_band"], ec="face"))
    ax.autoscale_view()


def _cameras(ax: Axes, vehicle: Vehicle) -> None:
    """Draw each camera's place and line of sight."""
    for k, camera in enumerate(vehicle.cameras.values()):
        tilt, clock = np.deg2rad([camera.axis_from_forward_deg, camera.clock_lv_deg])
        sight = np.cos(tilt) * np.array([1.0, 0.0, 0.0]) + np.sin(tilt) * lv_direction(float(clock))
        from_to = np.stack([camera.position_m, camera.position_m + _SIGHT * vehicle.geometry.base_radius_m * sight])
        label = "camera and line of sight" if k == 0 else None
        ax.plot(*_seen(from_to), color=COLOUR["nominal"], marker="s", markevery=[0], ms=5, label=label)
