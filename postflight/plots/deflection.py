"""Figures of the deflection estimates; every function returns a `matplotlib.figure.Figure` that needs no display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from estimators.camera_fit import OrientedCamera
    from estimators.fusion import Fused
    from estimators.southwell import Limbs
    from estimators.trim import StaticTrim
    from flightmodel.geometry import BodyMesh


def figure_camera_overlay(
    oriented: OrientedCamera,
    frames: Sequence[NDArray[np.uint8]],
    times_s: Sequence[float],
    theta_rad: Sequence[float],
    plane_lv_rad: Sequence[float],
    meshes: Mapping[str, BodyMesh] | None = None,
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
    meshes : mapping, optional
        A user's own, by body; see `estimators.overlay.Overlay`.
    """
    from matplotlib.figure import Figure

    from estimators.edge import find_horizon
    from estimators.overlay import Overlay, horizon_row

    figure = Figure(figsize=(6.0 * len(frames), 4.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(frames)))
    view, overlay = oriented.view, Overlay(oriented.view, meshes or {})
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


def figure_static_trim(static: StaticTrim, offsets_m: Sequence[float], joint_nmprad: float, title: str) -> Figure:
    """Trim angle over joint stiffness for several offsets, with the divergence limit (seed paper Figure 2.9)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axis = figure.subplots()
    stiffness = np.geomspace(2e3, 1e5, 600)
    axis.set_xlim(2e3, 1e5)
    for offset in offsets_m:
        axis.semilogx(stiffness, np.rad2deg(static.trim_angle(stiffness, offset)), label=f"{100 * offset:.2f} cm")
    axis.axvline(static.critical_stiffness_nmprad, color="black", linestyle="--", linewidth=1.0, label="divergence")
    axis.axvline(joint_nmprad, color="grey", linewidth=1.0, label="the vehicle's joint")
    margin = static.stiffness_for_growth(0.25)
    axis.axvline(margin, color="grey", linestyle=":", linewidth=1.0, label="25 % growth")
    axis.set(xlabel="joint stiffness, N m/rad", ylabel="trim angle of attack of the shell, deg", ylim=(0.0, 20.0))
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.3, which="both")
    axis.legend(title="initial c.g. offset", fontsize=8)
    return figure


def figure_fusion(fused: Fused, limbs: Limbs | None, words: str) -> Figure:
    """Fused angle and plane, the Southwell plot, and what the methods together say of what they lean on."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    (angle, line), (plane, inputs) = figure.subplots(2, 2)
    history = fused.history
    bent = history.theta_sd_rad < history.theta_rad
    _band(angle, history.time_s, np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad))
    angle.set(ylabel="deflection, deg", xlabel="time, s", ylim=(0.0, None))
    covariance = history.covariance
    assert covariance is not None
    plane_sd = np.rad2deg(np.sqrt(covariance[:, 1, 1]))
    clock = np.where(bent, np.rad2deg(history.plane_lv_rad), np.nan)
    _band(plane, history.time_s, clock, plane_sd)
    plane.set(ylabel="plane, deg LV (where bent by more than its sd)", xlabel="time, s", ylim=(0.0, 360.0))
    if limbs is None:
        line.set_axis_off()
        line.text(0.5, 0.5, "no Southwell line", ha="center", transform=line.transAxes)
    else:
        _southwell(line, limbs)
    names = list(fused.inputs)
    mean = [fused.inputs[n][0][0] for n in names]
    left = [np.sqrt(fused.inputs[n][1][0, 0]) for n in names]
    inputs.errorbar(mean, range(len(names)), xerr=left, fmt="o", color="#CC79A7", capsize=3)
    inputs.axvspan(-1.0, 1.0, color="grey", alpha=0.15)
    inputs.set_yticks(range(len(names)), names, fontsize=8)
    inputs.set(xlabel="found, in stated standard deviations (grey: stated)")
    for axis in (angle, plane, line, inputs):
        axis.grid(alpha=0.3)
    figure.suptitle(fill(words, 130), fontsize=10)
    return figure


def figure_correlation(fused: Fused, singular_values: FloatArray) -> Figure:
    """Inputs that are not separately observable: singular values, and correlation given all readings.

    A direction of the inputs with the singular value ``s`` keeps ``1 / (1 + s^2)`` of its a priori variance.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 6.0), layout="constrained")
    values, table = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
    better = int(np.sum(singular_values > 1.0))
    values.semilogy(np.arange(1, len(singular_values) + 1), singular_values, ".", color="#CC79A7")
    values.axhline(1.0, color="black", linewidth=0.8, linestyle="--")
    values.set(xlabel="direction of the inputs", ylabel="singular value", ylim=(1e-3, None))
    values.set_title(
        f"information gain: {better} of {len(singular_values)} directions\nbetter known than a priori (above line)",
        fontsize=10,
    )
    values.grid(alpha=0.3)
    image = table.imshow(fused.correlation, cmap="PuOr", vmin=-1.0, vmax=1.0)
    names = range(len(fused.names))
    table.set_xticks(names, fused.names, rotation=90, fontsize=7)
    table.set_yticks(names, fused.names, fontsize=7)
    apart = np.abs(np.triu(fused.correlation, 1))
    i, j = np.unravel_index(np.argmax(apart), apart.shape)
    least = f"strongest correlation: {fused.names[i]} and {fused.names[j]} ({fused.correlation[i, j]:+.2f})"
    table.set_title(f"correlation given all readings, at {fused.at_s:.1f} s\n{least}", fontsize=10)
    figure.colorbar(image, ax=table, shrink=0.7)
    return figure


def _band(axis: Axes, time_s: FloatArray, value: FloatArray, sd: FloatArray) -> None:
    axis.plot(time_s, value, color="#CC79A7")
    axis.fill_between(time_s, value - 2.0 * sd, value + 2.0 * sd, color="#CC79A7", alpha=0.2, label="2 sd")


def _southwell(axis: Axes, limbs: Limbs) -> None:
    both = limbs.both
    seen = both.theta_rad > 2.0 * both.theta_sd_rad
    q, theta, sd = both.pressure_pa[seen], both.theta_rad[seen], both.theta_sd_rad[seen]
    axis.errorbar(
        1e3 / q, 1.0 / np.rad2deg(theta), yerr=np.rad2deg(sd) / np.rad2deg(theta) ** 2, fmt="o", color="black"
    )
    over = np.linspace(1e3 / both.critical_pressure_pa, 1e3 / q.min() if len(q) else 5.0, 200)[1:]
    for name, limb, colour in (
        ("both", both, "black"),
        ("rise", limbs.rise, "#0072B2"),
        ("fall", limbs.fall, "#D55E00"),
    ):
        if limb is not None:
            axis.plot(over, 1.0 / np.rad2deg(limb.deflection(1e3 / over)), color=colour, label=name, linewidth=1.0)
    low, high = both.critical_interval_pa
    axis.set(xlabel="1000 / dynamic pressure, 1/Pa", ylabel="1 / deflection, 1/deg", xlim=(0.0, None), ylim=(0.0, None))
    axis.set_title(f"diverges at {both.critical_pressure_pa:.0f} Pa (90 %: {low:.0f} to {high:.0f})", fontsize=10)
    axis.legend(fontsize=8)
