"""Figures of the simulator's own theory; every function returns a `matplotlib.figure.Figure` that needs no display."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from postflight.plots.style import COLOUR, ZONE, in_style
from synthetic_flight.linear import DIVERGENT, STABLE, UNSTABLE, ZONES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from synthetic_flight.stability_map import StabilityMap


_NAMES = {STABLE: "stable", UNSTABLE: "unstable", DIVERGENT: "divergent"}
_FILL = {zone: ZONE[name][0] for zone, name in _NAMES.items()}
_MARK = {zone: (mark, ZONE[_NAMES[zone]][1]) for zone, mark in ((STABLE, "o"), (UNSTABLE, "^"), (DIVERGENT, "x"))}


@in_style
def figure_axdahl_zones(linear: StabilityMap, flown: StabilityMap) -> Figure:
    """Zones of the linear model as areas with lines of growth rate, flights of the simulator as marks.

    Parameters
    ----------
    linear, flown : StabilityMap
        Of one vehicle at one pressure and speed; grids may differ, damping ratios above zero.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure = Figure(figsize=(8.6, 5.6))
    axis = figure.subplots()
    x, y = 1e-3 * linear.stiffness_nmprad, 100.0 * linear.damping_ratio
    axis.contourf(x, y, linear.zone.T, levels=[-0.5, 0.5, 1.5, 2.5], colors=[_FILL[k] for k in sorted(_FILL)])
    divergent = linear.zone == DIVERGENT
    for inside, levels in ((divergent, [2.0, 4.0]), (~divergent, [-0.05, 0.0, 0.05, 0.1])):
        growth = np.where(inside, linear.growth_rate_radps, np.nan).T
        lines = axis.contour(x, y, growth, levels=levels, colors=COLOUR["limit"], linewidths=0.8)
        axis.clabel(lines, fontsize=8, fmt="%g 1/s")
    k, c = np.meshgrid(1e-3 * flown.stiffness_nmprad, 100.0 * flown.damping_ratio, indexing="ij")
    handles: list[Patch | Line2D] = []
    for zone, (mark, colour) in _MARK.items():
        inside = flown.zone == zone
        axis.plot(k[inside], c[inside], mark, color=colour, markersize=4.5, fillstyle="none", linestyle="none")
        handles.append(Patch(facecolor=_FILL[zone], label=f"{ZONES[zone]}: linear model"))
        handles.append(
            Line2D([], [], marker=mark, color=colour, fillstyle="none", linestyle="none", label=f"{ZONES[zone]}: flown")
        )
    axis.axvline(1e-3 * linear.critical_stiffness_nmprad, color=COLOUR["limit"], linestyle="--", linewidth=1.0)
    handles.append(
        Line2D([], [], color=COLOUR["limit"], linestyle="--", label="static limit q S C_A xbar (1 + xbar/L)")
    )
    axis.set(xscale="log", yscale="log", xlabel="bending stiffness (kN m/rad)", ylabel="joint damping (% of critical)")
    axis.set_title(
        f"q {linear.pressure_pa:.0f} Pa, V {linear.speed_mps:.0f} m/s, C_mq {linear.slopes.cmq:+.1f} constant",
        fontsize=10,
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    ticks = [t for t in (2, 3, 4, 6, 10, 20, 40, 100) if x[0] <= t <= x[-1]]
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    return figure
