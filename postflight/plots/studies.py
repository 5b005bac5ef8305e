"""Figures of the paper's studies: 1.3 before and after the joint is made flexible, Table 3.1, 3.1, 3.2 and 3.3."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from flightmodel.checks import FloatArray
from postflight.plots.ensembles import words_in_corner
from postflight.studies.joints import JointStudy
from postflight.studies.preflight import Bounds

# distinct in hue and, with their strokes, in grey (Okabe and Ito)
COLOURS = ("#000000", "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
STROKES = ((0, (4, 2)), "-", "-", (0, (5, 1)), "-", (0, (1, 1)), (0, (3, 1, 1, 1)))
BLUE, ORANGE = "#0072B2", "#E69F00"
HIGHEST = {"alpha_total_deg": 25.0, "normal_g": 2.5}


def _tidy(ax: Axes) -> None:
    ax.grid(alpha=0.3)
    ax.spines[["top", "right"]].set_visible(False)


def figure_table_3_1(table: pd.DataFrame, synthetic: str) -> Figure:
    """Stiffness and damping against frequency and damping ratio: the paper's as points, the equations as lines."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    springs, dampers = table[table["quantity"] == "K"], table[table["study"] == "damping"]
    for ax, rows, x, y, label in (
        (left, springs, "frequency_hz", "bending stiffness (N m/rad)", "free-free frequency (Hz)"),
        (right, dampers, "damping_percent", "damping (N m s/rad)", "share of critical at 2.5 Hz (%)"),
    ):
        ax.plot(rows[x], rows["equation"], color=BLUE, lw=1.4, label="eqs. [7], [8], reduced inertia 17.569 kg m²")
        ax.plot(rows[x], rows["paper"].astype(float), "o", ms=5, mfc="none", color="black", label="paper, Table 3.1")
        ax.plot(rows[x], rows["vehicle"], color=ORANGE, lw=1.0, ls="--", label="with the vehicle's own inertias")
        ax.set(xlabel=label, ylabel=y)
        _tidy(ax)
    right.set(xscale="log", yscale="log", xticks=[0.5, 1, 2.5, 5, 10, 20], yticks=[3, 10, 30, 100])
    for axis in (right.xaxis, right.yaxis):
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter("")
    left.legend(fontsize=7, frameon=False, loc="upper left")
    figure.suptitle("Stiffness and damping against frequency (AIAA 2011-2571, Table 3.1)", fontsize=10)
    words_in_corner(figure, synthetic)
    return figure


def figure_joints(study: JointStudy, quantity: str, label: str, title: str, synthetic: str) -> Figure:
    """One quantity of every flight of a study over time, up to a tumble; the legend names those beyond the axis."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    ax = figure.subplots()
    largest = 0.0
    highest, beyond = HIGHEST[quantity], []
    for k, flight in enumerate(study.flights):
        tumbling = flight.alpha_total_deg > 90.0
        shown = int(np.argmax(tumbling)) if tumbling.any() else len(tumbling)
        values = getattr(flight, quantity)[:shown]
        name = f"{flight.label}, tumbles at {flight.time_s[shown]:.1f} s" if tumbling.any() else flight.label
        ax.plot(flight.time_s[:shown], values, color=COLOURS[k], ls=STROKES[k], lw=1.6 if k == 0 else 1.2, label=name)
        largest = max(largest, float(np.max(values)))
        if np.max(values) > highest:
            beyond.append(flight.label)
    ax.axvline(study.peak_s, color="0.5", lw=0.8, ls=":")
    ax.set(xlabel="time after launch (s); dotted: peak dynamic pressure", ylabel=label)
    ax.set_ylim(0.0, min(highest, 1.15 * largest))
    ax.set_xlim(study.flights[0].time_s[0], study.flights[0].time_s[-1])
    _tidy(ax)
    note = f"beyond the axis: {', '.join(beyond)}" if beyond else None
    ax.legend(fontsize=8, frameon=False, loc="upper left", title=note, title_fontsize=7)
    figure.suptitle(title, fontsize=10)
    words_in_corner(figure, synthetic)
    return figure


def figure_preflight(
    rigid: Bounds, flexible: Bounds, flight: pd.DataFrame, window: tuple[float, float], words: str, synthetic: str
) -> Figure:
    """Figure 1.3 twice: the flight against a rigid vehicle's bounds, and against those with the flexible joint.

    Parameters
    ----------
    flight : DataFrame
        Columns ``time_s, alpha_total_deg, normal_g``.
    window : (float, float)
        Times shown, s.
    words : str
        Which share of the pulse is inside, under the title.
    """
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for column, (bounds, name) in enumerate(((rigid, "joint locked"), (flexible, "flexible joint"))):
        for row, (quantity, band, nominal, label) in enumerate(
            (
                ("alpha_total_deg", bounds.alpha_total_deg, bounds.nominal_alpha_deg, "total angle of attack (deg)"),
                ("normal_g", bounds.normal_g, bounds.nominal_normal_g, "normal acceleration (g)"),
            )
        ):
            ax = axes[row, column]
            _band(ax, bounds.time_s, band, nominal)
            ax.plot(flight["time_s"], flight[quantity], color="black", lw=1.2, label="flight, reconstructed")
            _tidy(ax)
            if column == 0:
                ax.set_ylabel(label)
        axes[0, column].set_title(f"{name}: {bounds.flights} flights", fontsize=9)
        axes[1, column].set_xlabel("time after launch (s)")
    shown = (flight["time_s"] >= window[0]) & (flight["time_s"] <= window[1])
    for row, quantity in enumerate(("alpha_total_deg", "normal_g")):
        top = float(flight.loc[shown, quantity].max())
        axes[row, 0].set_ylim(0.0, 2.2 * top)
    axes[0, 0].set_xlim(*window)
    axes[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    figure.suptitle(f"Flight against bounds of its own entry (AIAA 2011-2571, Figure 1.3)\n{words}", fontsize=10)
    words_in_corner(figure, synthetic)
    return figure


def _band(ax: Axes, time_s: FloatArray, band: FloatArray, nominal: FloatArray) -> None:
    ax.fill_between(time_s, band[0], band[2], color=BLUE, alpha=0.25, lw=0, label="2.3 to 97.7 %")
    ax.plot(time_s, band[1], color=BLUE, lw=1.2, label="50 %")
    ax.plot(time_s, nominal, color="#D55E00", lw=1.0, ls="--", label="nominal")
