"""How large was the deflection, and how sure is that? The methods over time, their fusion, what limits it."""

from __future__ import annotations

from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estimators.southwell import SPAN_S, Limbs
from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import DeflectionHistory
from postflight.deflections import Deflections, with_increments
from postflight.flown_coefficients import AeroIncrements
from postflight.plots.overlay import benchmark_and_largest
from postflight.plots.paper_figures import fit_height, trajectory_angle, window
from postflight.plots.style import (
    COLOUR,
    LABEL,
    STROKE,
    WIDE_BAND,
    band,
    in_style,
    legend_above,
    note,
    titled,
    with_holes,
)
from postflight.plots.subject import (
    FUSE,
    Drawable,
    answers_of,
    bet_of,
    flow_of,
    fused_of,
    lacking,
    time_label,
    words_of,
)
from postflight.run_folder import best_in_words
from postflight.runs import Run


@in_style
def figure_summary(
    flown: Drawable,
    answers: Deflections | None = None,
    truth: tuple[FloatArray, FloatArray] | None = None,
    *,
    pictures: bool = True,
) -> Figure:
    """The answer on one page: onboard frames above, deflection by every method, angle of attack and pressure below.

    Parameters
    ----------
    flown : Deflections or Run
        With ``answers`` also Reconstruction or FlightLoads.
    answers : Deflections, optional
        Those that were given as ``flown``, or of the run, without.
    truth : ((n,) s, (n,) deg), optional
        Of a synthetic flight, to be given only when everything is estimated.
    pictures : bool
        Whether benchmark frame and frame of the largest deflection stand on top, where the camera answered.

    Raises
    ------
    GateError
        Where there is no deflection, or neither trajectory nor loads.
    """
    answers = answers or answers_of("figure_summary", flown)
    air = flow_of("figure_summary", flown)
    pictures = pictures and "camera" in answers.histories and answers.loads is None
    figure = Figure(figsize=(9.0, 9.0 if pictures else 6.4))
    place = figure
    if pictures:
        top, place = list(np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.9))))
        picture = top.subplots()
        telemetry = bet_of("figure_summary", flown).telemetry
        strip, caption = benchmark_and_largest(telemetry, answers.histories["camera"])
        picture.imshow(strip)
        picture.set_title(caption, fontsize=8)
        picture.axis("off")
    upper, lower = place.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    _methods(upper, answers, truth)
    peak_s = float(air.time_s[np.nanargmax(air.dynamic_pressure_pa)]) if answers.bet is None else answers.bet.peak_s
    upper.axvline(peak_s, color=COLOUR["limit"], lw=0.8, ls=":")
    upper.set(ylabel="deflection of aeroshell\nagainst centerbody (deg)", xlim=window(air), ylim=(0, _top_deg(answers)))
    legend_above(upper, 5, "bands: 1 sd; dotted: peak q")
    trajectory_angle(lower, air, "centerbody total angle of attack, 1 sd")
    lower.set(ylabel="angle of attack (deg)", xlabel=time_label(flown))
    fit_height(lower, air)
    legend_above(lower, 1)
    pressure = lower.twinx()
    pressure.plot(air.time_s, air.dynamic_pressure_pa, color=COLOUR["prior"], lw=1)
    pressure.set(ylabel="dynamic pressure\n(Pa), grey", ylim=(0, None))
    pressure.grid(visible=False)
    return titled(figure, best_in_words(answers) or "Deflection of the aeroshell by each method", words_of(flown))


@in_style
def figure_deflection(flown: DeflectionHistory | Deflections | Run) -> Figure:
    """Angle and plane of the deflection over time, by one method or by each, with bands of one standard deviation.

    Parameters
    ----------
    flown : DeflectionHistory, Deflections or Run

    Raises
    ------
    GateError
        Where there is no deflection.
    """
    if isinstance(flown, DeflectionHistory):
        answers = Deflections({flown.method: flown})
    else:
        answers = answers_of("figure_deflection", flown)
    figure = Figure(figsize=(9.0, 6.0))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    _methods(upper, answers)
    upper.set(ylabel="deflection of aeroshell\nagainst centerbody (deg)", ylim=(0, _top_deg(answers)))
    legend_above(upper, 5, "bands: 1 sd")
    if answers.knows_peak:
        upper.set_xlim(window(flow_of("figure_deflection", answers)))
    for method, history in answers.continuous.items():
        clear = np.isfinite(history.theta_rad) & ~(history.theta_sd_rad > history.theta_rad)
        plane = np.where(clear, np.rad2deg(history.plane_lv_rad), np.nan)
        lower.plot(history.time_s, plane, ".", ms=2, color=COLOUR.get(method, COLOUR["estimate"]))
    lower.set(ylabel="plane (deg LV), where\ndeflection > its sd", xlabel=time_label(answers), ylim=(0.0, 360.0))
    return titled(figure, "Deflection of the aeroshell", words_of(answers))


def _top_deg(answers: Deflections) -> float:
    """Upper limit of an axis of deflections, deg."""
    largest = [np.nanmax(np.rad2deg(h.theta_rad)) for h in answers.histories.values() if np.isfinite(h.theta_rad).any()]
    return 1.25 * float(max(largest, default=5.0))


def _methods(ax: Axes, answers: Deflections, truth: tuple[FloatArray, FloatArray] | None = None) -> None:
    """Deflection over time, each method with a band of one standard deviation; truth as (s, deg) where known.

    Frames are dots; between them the camera's smooth answer is drawn.
    """
    if answers.smooth_camera is not None:
        frames = answers.histories["camera"]
        ax.plot(frames.time_s, np.rad2deg(frames.theta_rad), ".", color=COLOUR["camera"], ms=3, label="_frames")
    for method, history in answers.continuous.items():
        t, (theta, sd) = with_holes(history.time_s, [np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad)])
        mark = "" if len(history.time_s) > 400 else "."  # of many answers none is marked
        colour = COLOUR.get(method, COLOUR["estimate"])
        style: dict[str, Any] = {"color": colour, "ls": STROKE.get(method, "-"), "marker": mark, "ms": 3}
        ax.plot(t, theta, label=LABEL.get(method, method), **style)
        band(ax, t, theta, sd, colour, alpha=WIDE_BAND)
    if truth is not None:
        ax.plot(*truth, color=COLOUR["truth"], lw=0.8, label="truth (synthetic)")


@in_style
def figure_fusion(flown: Deflections) -> Figure:
    """Fused angle and plane, the Southwell plot, and the estimate of each input the methods depend on.

    Parameters
    ----------
    flown : Deflections

    Raises
    ------
    GateError
        Where there is no fused answer. A run does not store what stands behind it.
    """
    fused = fused_of("figure_fusion", flown)
    figure = Figure(figsize=(11.0, 7.5))
    (angle, line), (plane, inputs) = figure.subplots(2, 2)
    history = fused.history
    theta, sd = np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad)
    assert history.covariance is not None
    plane_sd = np.rad2deg(np.sqrt(history.covariance[:, 1, 1]))
    clock = np.where(sd < theta, np.rad2deg(history.plane_lv_rad), np.nan)
    for ax, values, spread, label, top in (
        (angle, theta, sd, "deflection (deg)", None),
        (plane, clock, plane_sd, "plane (deg LV), where deflection > its sd", 360.0),
    ):
        t, (drawn, sd_drawn) = with_holes(history.time_s, [values, spread])
        ax.plot(t, drawn, color=COLOUR["fused"], label="fused")
        band(ax, t, drawn, sd_drawn, COLOUR["fused"], label="1 sd")
        ax.set(ylabel=label, xlabel=time_label(flown), ylim=(0.0, top))
        legend_above(ax, 2)
    if fused.limbs is None:
        line.set_axis_off()
        line.text(0.5, 0.5, "no Southwell line", ha="center", transform=line.transAxes)
    else:
        _southwell(line, fused.limbs)
    names = list(fused.solution.inputs)
    found = fused.solution.inputs.values()
    mean, left = [value[0] for value, _ in found], [np.sqrt(cov[0, 0]) for _, cov in found]
    inputs.errorbar(mean, range(len(names)), xerr=left, fmt="o", color=COLOUR["fused"], capsize=3)
    inputs.axvspan(-1.0, 1.0, color=COLOUR["prior_band"], lw=0, zorder=0)
    inputs.set_yticks(range(len(names)), names, fontsize=min(8.0, 160.0 / len(names)))
    inputs.set(xlabel="estimate and 1 sd, in a priori standard deviations (grey: a priori)")
    return titled(figure, fill(f"{fused.agreement.remark}; {fused.limbs_remark}", 130), words_of(flown))


def _southwell(ax: Axes, limbs: Limbs) -> None:
    both = limbs.both
    clear = both.theta_rad > 2.0 * both.theta_sd_rad
    q, theta, sd = both.pressure_pa[clear], both.theta_rad[clear], both.theta_sd_rad[clear]
    error, label = np.rad2deg(sd) / np.rad2deg(theta) ** 2, f"means of {SPAN_S:g} s, 1 sd"
    ax.errorbar(1e3 / q, 1.0 / np.rad2deg(theta), yerr=error, fmt="o", color=COLOUR["measured"], label=label)
    over = np.linspace(1e3 / both.critical_pressure_pa, 1e3 / q.min() if len(q) else 5.0, 200)[1:]
    shown = (("both", both, "measured"), ("rise", limbs.rise, "estimate"), ("fall", limbs.fall, "second"))
    for name, limb, colour in shown:
        if limb is not None:
            ax.plot(over, 1.0 / np.rad2deg(limb.deflection(1e3 / over)), color=COLOUR[colour], label=name, lw=1.0)
    low, high = both.critical_interval_pa
    ax.set(xlabel="1 / dynamic pressure (1/kPa)", ylabel="1 / deflection (1/deg)", xlim=(0.0, None), ylim=(0.0, None))
    words = f"{both.critical_pressure_pa:.0f} Pa (90 %: {low:.0f} to {high:.0f})"
    ax.set_title(f"Southwell plot: critical pressure {words}")
    ax.legend(loc="lower right")


@in_style
def figure_correlation(flown: Deflections) -> Figure:
    """Which directions of the inputs the measurements determine, and which inputs stay correlated.

    A direction of the inputs of singular value ``s`` keeps ``1 / (1 + s^2)`` of its a priori variance.

    Parameters
    ----------
    flown : Deflections

    Raises
    ------
    GateError
        Where there is no fused answer. A run does not store what stands behind it.
    """
    fused = fused_of("figure_correlation", flown)
    singular_values = fused.agreement.singular_values
    figure = Figure(figsize=(11.0, 6.0))
    values, table = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
    better = int(np.sum(singular_values > 1.0))
    values.semilogy(np.arange(1, len(singular_values) + 1), singular_values, ".", color=COLOUR["fused"])
    values.axhline(1.0, color=COLOUR["limit"], lw=0.8, ls="--")
    values.set(xlabel="direction of the inputs", ylabel="singular value", ylim=(1e-3, None))
    values.set_title(
        f"information gain: {better} of {len(singular_values)} parameter directions\n"
        "are better determined than a priori (above the line)"
    )
    names, correlation = (
        ["deflection y", "deflection z", *fused.solution.inputs],
        fused.solution.correlation_at(fused.best_s),
    )
    image = table.imshow(correlation, cmap="PuOr", vmin=-1.0, vmax=1.0)
    table.grid(visible=False)
    table.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    table.set_yticks(range(len(names)), names, fontsize=7)
    size = np.abs(np.triu(correlation, 1))
    i, j = np.unravel_index(np.argmax(size), size.shape)
    most = f"largest: {names[i]} and {names[j]} ({correlation[i, j]:+.2f})"
    table.set_title(f"correlation given all readings, at {fused.best_s:.1f} s\n{most}")
    figure.colorbar(image, ax=table, shrink=0.7, label="correlation coefficient")
    note(figure, words_of(flown))
    return figure


# aerodynamic increments along Mach number

_PANELS = {
    "C_A: increment (%)": 100.0,
    "C_N: increment (%)": 100.0,
    "C_m: increment (%)": 100.0,
    "C_mq: increment": 1.0,
}


@in_style
def figure_increments(flown: AeroIncrements | Deflections) -> Figure:
    """Increments of the four coefficients along Mach number, before the flight and after it, with 1 sd.

    Parameters
    ----------
    flown : AeroIncrements or Deflections
        Of deflections without them they are estimated.

    Raises
    ------
    GateError
        Where there are none.
    """
    increments = flown if isinstance(flown, AeroIncrements) else _increments(flown)
    figure = Figure(figsize=(9.6, 6.6))
    axes = figure.subplots(2, 2, sharex=True)
    for k, (ax, (label, scale)) in enumerate(zip(axes.flat, _PANELS.items(), strict=True)):
        _along_mach(ax, increments, k, scale)
        ax.set_ylabel(label)
    for ax in axes[1]:
        ax.set_xlabel("Mach number")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(labels), loc="outside lower left")
    return titled(figure, "Aerodynamic coefficients in flight against the preflight table", words_of(flown))


def _increments(flown: Deflections) -> AeroIncrements:
    """Increments of the answers; estimated if the answers hold none."""
    found = with_increments(flown) if isinstance(flown, Deflections) and flown.increments is None else flown
    if isinstance(found, Deflections) and found.increments is not None:
        return found.increments
    if isinstance(found, Deflections) and found.no_increments is not None:
        raise GateError([found.no_increments])
    raise lacking("figure_increments", flown, "increments", FUSE, "pf.aero_increments(bet)")


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
    # a panel shows 2.5 a priori sd at least
    top = max(2.5 * prior_sd, 1.1 * float(np.max(np.abs(mean) + sd)))
    ax.set_ylim(-top, top)
