"""Figure of the aerodynamic increments along Mach number."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from postflight.aero_increments import AeroIncrements
from postflight.plots.style import COLOUR, band, in_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANELS = (
    ("C_A: increment (%)", 100.0),
    ("C_N: increment (%)", 100.0),
    ("C_m: increment (%)", 100.0),
    ("C_mq: increment", 1.0),
)
_SHOWN_SD = 2.5  # a priori ones that a panel shows at least


@in_style
def figure_increments(increments: AeroIncrements) -> Figure:
    """Increments of the four coefficients along Mach number, before the flight and after it, with 1 sd."""
    figure = Figure(figsize=(9.6, 6.6))
    axes = figure.subplots(2, 2, sharex=True)
    for k, (ax, (label, scale)) in enumerate(zip(axes.flat, _PANELS, strict=True)):
        _along_mach(ax, increments, k, scale)
        ax.set_ylabel(label)
    for ax in axes[1]:
        ax.set_xlabel("Mach number")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(labels), loc="outside lower left")
    figure.suptitle("Aerodynamic coefficients in flight against the preflight table")
    return figure


def _along_mach(ax: Axes, increments: AeroIncrements, k: int, scale: float) -> None:
    mach, prior_sd = increments.found.mach, scale * increments.found.processes.stated_sd[k]
    nothing = np.zeros(len(mach))
    band(ax, mach, nothing, nothing + prior_sd, COLOUR["prior_band"], alpha=1.0, label="preflight table, 1 sd")
    ax.axhline(0.0, color=COLOUR["prior"], lw=1.0, ls=":")
    mean, sd = scale * increments.found.mean[k], scale * increments.sd[k]
    seen = increments.determined[k]
    shown = np.where(seen, mean, np.nan)
    ax.plot(mach, shown, color=COLOUR["estimate"], label="in flight")
    band(ax, mach, shown, sd, COLOUR["estimate"], label="1 sd")
    if not seen.any():
        ax.text(0.5, 0.9, "not determined by this flight", ha="center", transform=ax.transAxes)
    top = max(_SHOWN_SD * prior_sd, 1.1 * float(np.max(np.abs(mean) + sd)))
    ax.set_ylim(-top, top)
