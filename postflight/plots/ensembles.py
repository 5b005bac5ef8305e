"""Bands of a Monte Carlo study over time, and Sobol indices as bars."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

BLUE, ORANGE = "#0072B2", "#D55E00"  # distinct in hue and in grey (Okabe and Ito)
MOST_BARS = 15
LABEL = {
    "alpha_total_deg": "centerbody total\nangle of attack (deg)",
    "alpha_shell_deg": "aeroshell total\nangle of attack (deg)",
    "deflection_deg": "deflection (deg)",
    "normal_g": "centerbody normal\nacceleration (g)",
    "axial_g": "axial deceleration (g)",
    "dynamic_pressure_pa": "dynamic pressure (Pa)",
    "mach": "Mach number",
    "altitude_m": "altitude (m)",
    "rate_degps": "lateral rate (deg/s)",
}


def words_in_corner(figure: Figure, words: str) -> None:
    """Say what was flown, below everything else."""
    figure.supxlabel(words, x=0.995, ha="right", fontsize=7, color="0.4")


def figure_bands(bands: pd.DataFrame, title: str, synthetic: str) -> Figure:
    """Every history with its 2.3, 50 and 97.7 percentiles."""
    names = list(dict.fromkeys(bands["history"]))
    figure = Figure(figsize=(7.2, 2.2 * len(names) + 0.8), layout="constrained")
    for ax, name in zip(figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0], names, strict=True):
        rows = bands[bands["history"] == name]
        t = rows["time_s"]
        ax.fill_between(t, rows["p2.3"], rows["p97.7"], color=BLUE, alpha=0.25, lw=0, label="2.3 to 97.7 %")
        ax.plot(t, rows["p50"], color=BLUE, lw=1.3, label="50 %")
        ax.set_ylabel(LABEL[name])
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0)
    first, last = figure.get_axes()[0], figure.get_axes()[-1]
    first.legend(fontsize=8, frameon=False, loc="upper left")
    last.set_xlabel("time after launch (s)")
    figure.suptitle(title, fontsize=10)
    words_in_corner(figure, synthetic)
    return figure


def figure_sobol(table: pd.DataFrame, title: str, synthetic: str) -> Figure:
    """First-order and total indices with their intervals, the largest total on top."""
    left_out = max(0, len(table) - MOST_BARS)
    table = table.sort_values("total", kind="stable").tail(MOST_BARS)
    place = np.arange(len(table))
    figure = Figure(figsize=(7.2, 0.36 * len(table) + 1.6), layout="constrained")
    ax = figure.subplots()
    for k, (name, label, colour) in enumerate(
        (("first", "first order: alone", ORANGE), ("total", "total: with others", BLUE))
    ):
        low, high = (np.abs(table[f"{name}_{end}_95"] - table[name]) for end in ("low", "high"))
        ax.barh(place + 0.2 * (2 * k - 1), table[name], 0.36, color=colour, label=label)
        ax.errorbar(table[name], place + 0.2 * (2 * k - 1), xerr=[low, high], fmt="none", ecolor="0.25", lw=0.9)
    ax.set_yticks(place, table["factor"], fontsize=8)
    ax.axvline(0.0, color="0.3", lw=0.8)
    more = f"; {left_out} factors with smaller totals are not shown" if left_out else ""
    ax.set_xlabel(f"share of the variance (bars) and 95 % interval (lines){more}")
    ax.grid(alpha=0.3, axis="x")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize=8, frameon=False, loc="lower right")
    figure.suptitle(title, fontsize=10)
    words_in_corner(figure, synthetic)
    return figure
