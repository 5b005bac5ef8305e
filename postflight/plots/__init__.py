"""Every figure of the project, in one style: functions that return a `matplotlib.figure.Figure` and need no display.

``pf.plots.figure_2_5(bet)`` draws one of a reconstruction, ``pf.plots.save(figure, path)`` writes it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from postflight.plots.deflection import figure_correlation, figure_fusion, figure_summary
    from postflight.plots.overlay import write_overlay_film
    from postflight.plots.paper_figures import figure_1_3, figure_2_3, figure_2_5, figure_2_7, figure_2_9
    from postflight.plots.reconciliation import figure_modes, figure_posterior, figure_reconciled
    from postflight.plots.run_figures import draw_camera, draw_run
    from postflight.plots.studies import (
        figure_bands,
        figure_joints,
        figure_preflight,
        figure_sobol,
        figure_table_3_1,
    )
    from postflight.plots.style import COLOUR, in_style, save, stamp
    from postflight.plots.trajectory import (
        figure_air,
        figure_attitude,
        figure_filter_and_smoother,
        figure_flown,
        figure_residuals,
        figure_sensitivity,
    )

# imported on first use: matplotlib takes half a second
_DOOR = {
    "COLOUR": "style",
    "draw_camera": "run_figures",
    "draw_run": "run_figures",
    "figure_1_3": "paper_figures",
    "figure_2_3": "paper_figures",
    "figure_2_5": "paper_figures",
    "figure_2_7": "paper_figures",
    "figure_2_9": "paper_figures",
    "figure_air": "trajectory",
    "figure_attitude": "trajectory",
    "figure_bands": "studies",
    "figure_correlation": "deflection",
    "figure_filter_and_smoother": "trajectory",
    "figure_flown": "trajectory",
    "figure_fusion": "deflection",
    "figure_joints": "studies",
    "figure_modes": "reconciliation",
    "figure_posterior": "reconciliation",
    "figure_preflight": "studies",
    "figure_reconciled": "reconciliation",
    "figure_residuals": "trajectory",
    "figure_sensitivity": "trajectory",
    "figure_sobol": "studies",
    "figure_summary": "deflection",
    "figure_table_3_1": "studies",
    "in_style": "style",
    "save": "style",
    "stamp": "style",
    "write_overlay_film": "overlay",
}

__all__ = [
    "COLOUR",
    "draw_camera",
    "draw_run",
    "figure_1_3",
    "figure_2_3",
    "figure_2_5",
    "figure_2_7",
    "figure_2_9",
    "figure_air",
    "figure_attitude",
    "figure_bands",
    "figure_correlation",
    "figure_filter_and_smoother",
    "figure_flown",
    "figure_fusion",
    "figure_joints",
    "figure_modes",
    "figure_posterior",
    "figure_preflight",
    "figure_reconciled",
    "figure_residuals",
    "figure_sensitivity",
    "figure_sobol",
    "figure_summary",
    "figure_table_3_1",
    "in_style",
    "save",
    "stamp",
    "write_overlay_film",
]


def __getattr__(name: str) -> Any:
    """Import a figure on its first use."""
    if name not in _DOOR:
        raise AttributeError(f"module 'postflight.plots' has no attribute '{name}'; names: {', '.join(__all__)}")
    return getattr(import_module(f"postflight.plots.{_DOOR[name]}"), name)


def __dir__() -> list[str]:
    """Public names."""
    return sorted(__all__)
