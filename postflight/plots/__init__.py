"""Every figure of the project, in one style: functions that return a `matplotlib.figure.Figure` and need no display.

``from postflight import plots; plots.figure_2_5(flight)``: the functions stand in `__all__`, imported on demand.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "paper_figures": ("figure_1_3", "figure_2_3", "figure_2_5", "figure_2_7", "figure_2_9"),
    "deflection": ("figure_summary", "figure_fusion", "figure_correlation"),
    "trajectory": (
        "figure_flown", "figure_residuals", "figure_filter_and_smoother", "figure_air", "figure_attitude",
        "figure_sensitivity",
    ),
    "reconciliation": ("figure_reconciled", "figure_posterior", "figure_modes"),
    "studies": ("figure_bands", "figure_sobol", "figure_table_3_1", "figure_joints", "figure_preflight"),
    "overlay": ("benchmark_and_largest", "write_overlay_film"),
    "run_figures": ("draw_camera", "draw_run"),
    "style": ("COLOUR", "in_style", "save", "stamp"),
}  # fmt: skip
_HOME = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Import a figure's module when it is first asked for, so that commands without figures stay fast."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
