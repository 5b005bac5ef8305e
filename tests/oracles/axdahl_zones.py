"""For which stiffness and damping of its joint does a vehicle diverge, oscillate with growing amplitude, or settle?

Run: ``python -m tests.oracles.axdahl_zones [PICTURE]`` (half a minute); without a name it draws
``docs/images/axdahl_zones.png``.

Axdahl's stability map twice: from eigenvalues (`flightmodel.linear`) and from flights of the nonlinear simulator.
The flights need constant speed and dynamic pressure although the vehicle decelerates. They get them by falling at
terminal speed through air of constant density: gravity then acts on each body as deceleration does, ``g = q S C_A /
m``, so the linear equations hold unchanged. On Earth that fixes ``q_E = m g / (S C_A)``; a flight at dynamic pressure
``q`` and speed ``V`` is similar to a fall at ``q_E`` and ``V sqrt(q_E / q)`` with stiffness scaled by ``q_E / q``, and
its rates are ``sqrt(q / q_E)`` times those of the fall. Falls start above the pole, where the air that rotates with the
Earth has no velocity.

References
----------
Axdahl, AIAA 2009-2963; summary in Bose et al., AIAA 2011-2571.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

import postflight as pf
from flightmodel import earth, rotations
from flightmodel.aerodynamics import AeroTable
from flightmodel.atmosphere import AtmosphereProfile, us76
from flightmodel.checks import FloatArray
from flightmodel.linear import (
    DIVERGENT,
    STABLE,
    UNSTABLE,
    Slopes,
    critical_stiffness_nmprad,
    linear_matrix,
    modes,
)
from flightmodel.vehicle import MassProperties, Vehicle, vehicle_from_toml, vehicle_path
from synthetic_flight import simulate
from synthetic_flight.simulate import integrate

# the reference vehicle at Mach 3.2 with 0.7 of the Newtonian static stability, C_mq constant and destabilising
ZONES = ("stable", "dynamically unstable", "divergent")  # STABLE, UNSTABLE, DIVERGENT
SLOPES = Slopes(ca=1.54, cn_alpha=0.3065, cm_alpha=-0.2333, cmq=0.2)
PRESSURE_PA, SPEED_MPS = 1150.0, 1040.0
FALL_S, FALL_STEP_S, RECORD_S = 120.0, 0.01, 0.1
LARGE_RAD = 0.2
START_M = 60.0e3
ZONE_NAMES = {STABLE: "stable", UNSTABLE: "unstable", DIVERGENT: "divergent"}
# area and mark of each zone: colours of the project's figures
FILL = {zone: pf.plots.ZONE[name][0] for zone, name in ZONE_NAMES.items()}
MARK = {
    zone: (mark, pf.plots.ZONE[ZONE_NAMES[zone]][1])
    for zone, mark in ((STABLE, "o"), (UNSTABLE, "^"), (DIVERGENT, "x"))
}


@dataclass(frozen=True)
class JointGrid:
    """Joints of one vehicle at one pressure and speed: stiffness (k,), and damping (c,) of critical at each of it."""

    vehicle: Vehicle
    slopes: Slopes
    pressure_pa: float
    speed_mps: float
    stiffness_nmprad: FloatArray
    damping_ratio: FloatArray  # of critical: seed paper eq. [8]


@dataclass(frozen=True)
class StabilityMap:
    """Largest growth rates (k, c), 1/s, and zones (k, c) over a grid of joints, and the static limit of divergence."""

    grid: JointGrid
    growth_rate_radps: FloatArray
    zone: NDArray[np.int64]
    critical_stiffness_nmprad: float


def on_axis(vehicle: Vehicle, slopes: Slopes) -> Vehicle:
    """Copy as the linear model takes it: c.g.s on the axis, round inertias, coefficients linear in the angle."""

    def plain(body: MassProperties) -> MassProperties:
        lateral = 0.5 * float(body.inertia[1, 1] + body.inertia[2, 2])
        tensor = ((float(body.inertia[0, 0]), 0.0, 0.0), (0.0, lateral, 0.0), (0.0, 0.0, lateral))
        return MassProperties(
            mass_kg=body.mass_kg, cg_from_datum_body_m=(float(body.cg_m[0]), 0.0, 0.0), inertia_kgm2=tensor
        )

    alpha = np.linspace(0.0, np.pi, 3)
    one = np.ones(3)
    row = np.column_stack([slopes.ca * one, slopes.cn_alpha * alpha, slopes.cm_alpha * alpha, slopes.cmq * one])
    return replace(
        vehicle,
        aeroshell=plain(vehicle.aeroshell),
        centerbody=plain(vehicle.centerbody),
        aero=AeroTable(np.array([0.0, 100.0]), alpha, np.stack([row, row])),
    )


def with_spring(vehicle: Vehicle, stiffness_nmprad: float, damping_ratio: float, twist_factor: float = 1.0) -> Vehicle:
    """Copy with a linear bending spring, its damper a share of critical; torsion stiffness times ``twist_factor``."""
    update = {
        "bending_stiffness_nmprad": stiffness_nmprad,
        "torsion_stiffness_nmprad": vehicle.joint.torsion_stiffness_nmprad * twist_factor,
        "freeplay_deg": 0.0,
        "hardening_nmprad3": 0.0,
        "damping_hardening_nmsprad3": 0.0,
    }
    made = replace(vehicle, joint=vehicle.joint.model_copy(update=update))
    damping = damping_ratio * made.critical_damping_nmsprad()
    return replace(made, joint=made.joint.model_copy(update={"bending_damping_nmsprad": damping}))


def linear_map(grid: JointGrid) -> StabilityMap:
    """Map from the eigenvalues of the linear model."""
    plain = on_axis(grid.vehicle, grid.slopes)

    def at(stiffness: float, damping: float) -> tuple[float, int]:
        sprung = with_spring(plain, stiffness, damping)
        found = modes(linear_matrix(sprung, grid.slopes, grid.pressure_pa, grid.speed_mps))
        return found.growth_rate_radps, found.zone

    return _map(grid, plain, at)


def flown_map(grid: JointGrid) -> StabilityMap:
    """Map from flights of the nonlinear simulator, released with the shell tilted by half a milliradian."""
    plain = on_axis(grid.vehicle, grid.slopes)
    start = _release()
    gravity = float(np.linalg.norm(earth.gravitation(start[:3] - np.array([0.0, 0.0, 0.5 * START_M]))))
    fall_pa = plain.mass_kg * gravity / (plain.reference.area_m2 * grid.slopes.ca)
    factor = fall_pa / grid.pressure_pa
    fall_mps = grid.speed_mps * float(np.sqrt(factor))
    start[5] -= fall_mps
    air = simulate.atmosphere_table(_even_air(2.0 * fall_pa / fall_mps**2))

    def at(stiffness: float, damping: float) -> tuple[float, int]:
        fallen = with_spring(plain, stiffness * factor, damping, factor)
        n = round(FALL_S / RECORD_S) + 1
        states, _ = integrate(fallen, air, start, FALL_STEP_S, round(RECORD_S / FALL_STEP_S), n)
        growth, zone = _growth(states)
        return growth / float(np.sqrt(factor)), zone

    return _map(grid, plain, at)


def _map(grid: JointGrid, plain: Vehicle, at: Callable[[float, float], tuple[float, int]]) -> StabilityMap:
    pairs = [[at(float(k), float(c)) for c in grid.damping_ratio] for k in grid.stiffness_nmprad]
    growth = np.array([[pair[0] for pair in row] for row in pairs])
    zone = np.array([[pair[1] for pair in row] for row in pairs], dtype=np.int64)
    return StabilityMap(grid, growth, zone, critical_stiffness_nmprad(plain, grid.slopes, grid.pressure_pa))


def _even_air(density_kgpm3: float) -> AtmosphereProfile:
    """Still air of constant density over the whole fall, as a ratio to the standard atmosphere at the tables' knots."""
    z = np.arange(-1000.0, START_M + 20.0e3, simulate.ATMOSPHERE_STEP_M)
    ratio = np.log(density_kgpm3 / us76(z)[0])
    nothing, one = np.zeros(len(z)), np.ones(len(z))
    return AtmosphereProfile(z, ratio, nothing, np.zeros((len(z), 3)), one, one)


def _release() -> FloatArray:
    """State above the pole, nose down and at rest, the shell tilted by half a milliradian against the body."""
    down = rotations.q_from_dcm(np.array([[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]]))[0]
    tilted = rotations.boxplus(down, np.array([0.0, 5.0e-4, 0.0]))
    # 1 m off the axis, where longitude is defined
    where = earth.ecef_from_geodetic(0.5 * np.pi, 0.0, START_M) * np.array([0.0, 0.0, 1.0]) + np.array([1.0, 0.0, 0.0])
    return np.concatenate([where, np.zeros(3), down, tilted, np.zeros(6)])


def _growth(states: FloatArray) -> tuple[float, int]:
    """Growth rate, 1/s, and zone of a fall: from the size of all angles in the last two quarters of its small ones."""
    axes = [rotations.rotate(states[:, i : i + 4], np.tile([1.0, 0.0, 0.0], (len(states), 1))) for i in (6, 10)]
    tilts = np.column_stack([axes[0][:, :2], axes[1][:, :2]])
    size = np.sqrt(np.sum(tilts**2, axis=1))
    large = np.flatnonzero(size > LARGE_RAD)
    end = int(large[0]) if len(large) else len(size)
    quarter = max(end // 4, 2)
    late, before = size[end - quarter : end], size[end - 2 * quarter : end - quarter]
    growth = 0.5 * float(np.log(np.mean(late**2) / np.mean(before**2))) / (quarter * RECORD_S)
    if growth <= 0.0:
        return growth, STABLE
    bending = (axes[1] - axes[0])[end - quarter : end, 0]
    return growth, UNSTABLE if bending.min() < 0.0 < bending.max() else DIVERGENT


@pf.plots.in_style
def figure_axdahl_zones(linear: StabilityMap, flown: StabilityMap) -> Figure:
    """Zones of the linear model as areas with lines of growth rate, flights of the simulator as marks.

    Parameters
    ----------
    linear, flown : StabilityMap
        Of one vehicle at one pressure and speed; grids may differ, damping ratios above zero.
    """
    figure = Figure(figsize=(8.6, 5.6))
    axis = figure.subplots()
    x, y = 1e-3 * linear.grid.stiffness_nmprad, 100.0 * linear.grid.damping_ratio
    axis.contourf(x, y, linear.zone.T, levels=[-0.5, 0.5, 1.5, 2.5], colors=[FILL[k] for k in sorted(FILL)])
    divergent = linear.zone == DIVERGENT
    for inside, levels in ((divergent, [2.0, 4.0]), (~divergent, [-0.05, 0.0, 0.05, 0.1])):
        growth = np.where(inside, linear.growth_rate_radps, np.nan).T
        lines = axis.contour(x, y, growth, levels=levels, colors=pf.plots.COLOUR["limit"], linewidths=0.8)
        axis.clabel(lines, fontsize=8, fmt="%g 1/s")
    k, c = np.meshgrid(1e-3 * flown.grid.stiffness_nmprad, 100.0 * flown.grid.damping_ratio, indexing="ij")
    handles: list[Patch | Line2D] = []
    for zone, (mark, colour) in MARK.items():
        inside = flown.zone == zone
        axis.plot(k[inside], c[inside], mark, color=colour, markersize=4.5, fillstyle="none", linestyle="none")
        handles.append(Patch(facecolor=FILL[zone], label=f"{ZONES[zone]}: linear model"))
        handles.append(
            Line2D([], [], marker=mark, color=colour, fillstyle="none", linestyle="none", label=f"{ZONES[zone]}: flown")
        )
    axis.axvline(1e-3 * linear.critical_stiffness_nmprad, color=pf.plots.COLOUR["limit"], linestyle="--", linewidth=1.0)
    label = "static limit q S C_A xbar (1 + xbar/L)"
    handles.append(Line2D([], [], color=pf.plots.COLOUR["limit"], linestyle="--", label=label))
    axis.set(xscale="log", yscale="log", xlabel="bending stiffness (kN m/rad)", ylabel="joint damping (% of critical)")
    at = linear.grid
    axis.set_title(
        f"q {at.pressure_pa:.0f} Pa, V {at.speed_mps:.0f} m/s, C_mq {at.slopes.cmq:+.1f} constant",
        fontsize=10,
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    ticks = [t for t in (2, 3, 4, 6, 10, 20, 40, 100) if x[0] <= t <= x[-1]]
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    return figure


def main(picture: Path) -> None:
    """Draw the map of the reference vehicle."""
    setting = (vehicle_from_toml(vehicle_path("irve2_reference")), SLOPES, PRESSURE_PA, SPEED_MPS)
    fine = linear_map(JointGrid(*setting, np.geomspace(2.0e3, 5.0e4, 160), np.geomspace(1e-3, 0.4, 120)))
    flights = flown_map(JointGrid(*setting, np.geomspace(2.1e3, 4.7e4, 26), np.geomspace(1.2e-3, 0.34, 15)))
    figure_axdahl_zones(fine, flights).savefig(picture, dpi=130)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "docs" / "images" / "axdahl_zones.png")
