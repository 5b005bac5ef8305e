"""Every figure of the project, in one style: functions that return a `matplotlib.figure.Figure` and need no display.

``pf.plots.figure_2_5(bet)`` draws one, and ``pf.plots.save(figure, path)`` writes it as PNG, PDF or SVG. A figure takes
a reconstruction, a run (`read_run`), loads (`read_loads`) or deflections (`fuse`), whatever has what it draws; anything
else is refused with what to pass.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from postflight.plots.deflection import (
        figure_correlation,
        figure_deflection,
        figure_fusion,
        figure_increments,
        figure_summary,
    )
    from postflight.plots.overlay import write_overlay_film
    from postflight.plots.paper_figures import figure_1_3, figure_2_3, figure_2_5, figure_2_7, figure_2_9
    from postflight.plots.reconciliation import figure_modes, figure_posterior, figure_reconciled
    from postflight.plots.run_figures import draw_camera, draw_run
    from postflight.plots.studies import (
        figure_bands,
        figure_joints,
        figure_preflight,
        figure_table_3_1,
    )
    from postflight.plots.style import COLOUR, ZONE, in_style, save
    from postflight.plots.trajectory import (
        figure_air,
        figure_attitude,
        figure_filter_and_smoother,
        figure_flown,
        figure_residuals,
        figure_sensitivity,
    )
    from postflight.plots.vehicle import figure_vehicle

# imported on first use: matplotlib takes half a second
_DOOR = {
    "paper_figures": ("figure_1_3", "figure_2_3", "figure_2_5", "figure_2_7", "figure_2_9"),
    "deflection": (
        "figure_correlation", "figure_deflection", "figure_fusion", "figure_increments", "figure_summary",
    ),
    "trajectory": (
        "figure_air", "figure_attitude", "figure_filter_and_smoother", "figure_flown", "figure_residuals",
        "figure_sensitivity",
    ),
    "reconciliation": ("figure_modes", "figure_posterior", "figure_reconciled"),
    "studies": ("figure_bands", "figure_joints", "figure_preflight", "figure_table_3_1"),
    "vehicle": ("figure_vehicle",),
    "overlay": ("write_overlay_film",),
    "run_figures": ("draw_camera", "draw_run"),
    "style": ("COLOUR", "ZONE", "in_style", "save"),
}  # fmt: skip
_MODULE = {name: module for module, names in _DOOR.items() for name in names}

__all__ = [
    "COLOUR", "ZONE", "draw_camera", "draw_run", "figure_1_3", "figure_2_3", "figure_2_5", "figure_2_7", "figure_2_9",
    "figure_air", "figure_attitude", "figure_bands", "figure_correlation", "figure_deflection",
    "figure_filter_and_smoother", "figure_flown", "figure_fusion", "figure_increments", "figure_joints",
    "figure_modes", "figure_posterior", "figure_preflight", "figure_reconciled", "figure_residuals",
    "figure_sensitivity", "figure_summary", "figure_table_3_1", "figure_vehicle", "in_style", "save",
    "write_overlay_film",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a figure on its first use."""
    if name not in _MODULE:
        raise AttributeError(f"module 'postflight.plots' has no attribute '{name}'; names: {', '.join(__all__)}")
    return getattr(import_module(f"postflight.plots.{_MODULE[name]}"), name)


def __dir__() -> list[str]:
    """Public names."""
    return sorted(__all__)
