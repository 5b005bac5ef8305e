"""Figures of the deflection estimates; every function returns a `matplotlib.figure.Figure` that needs no display."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from estimators.camera_fit import OrientedCamera


def figure_camera_overlay(
    oriented: OrientedCamera,
    frames: Sequence[NDArray[np.uint8]],
    times_s: Sequence[float],
    theta_rad: Sequence[float],
    plane_lv_rad: Sequence[float],
) -> Figure:
    """Frames side by side, the virtual camera over the right part of each (seed paper Figure 2.3).

    The dashed yellow line is the smallest row of the virtual camera's edge, the solid one that of the edge found in
    the frame; where they coincide the hypothesised deflection fits.

    Parameters
    ----------
    oriented : OrientedCamera
    frames : sequence of (h, w) uint8
        Benchmark first, then e.g. the frame of the largest deflection.
    times_s, theta_rad, plane_lv_rad : sequence of float
        Of each frame.
    """
    from matplotlib.figure import Figure

    from estimators.horizon import find_horizon
    from estimators.overlay import Overlay, horizon_row

    figure = Figure(figsize=(6.0 * len(frames), 4.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(frames)))
    view, overlay = oriented.view, Overlay(oriented.view)
    for k, axis in enumerate(axes):
        theta, plane = float(theta_rad[k]), float(plane_lv_rad[k])
        axis.imshow(overlay.blended(np.asarray(frames[k]), theta, plane), interpolation="nearest")
        axis.axhline(horizon_row(view, theta, plane), color="yellow", linestyle="--", linewidth=1.0)
        found = find_horizon(np.asarray(frames[k]), oriented.lines, view.camera.size_px)
        if found.is_usable:
            axis.axhline(found.lowest_row_px, color="yellow", linewidth=1.4)
        bent = f"{np.rad2deg(theta):.1f} deg in plane {np.rad2deg(plane):.0f} deg" if theta else "taken as not bent"
        axis.set_title(f"({chr(97 + k)}) {times_s[k]:.2f} s: {bent}", fontsize=10)
        axis.set_axis_off()
    return figure
