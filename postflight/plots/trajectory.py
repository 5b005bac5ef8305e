"""Figures of the trajectory as a product: the air of the day, residuals, filter against smoother, angles with bands."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import FloatArray
from flightmodel.trajectory import difference, resample
from postflight.attitude import AttitudeCheck
from postflight.plots.paper_figures import stamp
from postflight.reconstruction import Reconstruction
from postflight.sensitivity import GROUPS, largest_of_groups
from recon.atmosphere import ReconstructedAir

LEAST_LOST = 1e-3  # of the filter's variance that the smoother takes away, for a difference to be drawn
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "0.55"


def _clean(*axes: Axes) -> None:
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)


def _bands(
    ax: Axes, height_km: FloatArray, middle: FloatArray, sd: FloatArray, prior: FloatArray, prior_sd: FloatArray
) -> None:
    """Prior and posterior along altitude, one sd and (pale) three of the posterior."""
    ax.fill_betweenx(height_km, prior - prior_sd, prior + prior_sd, color="0.87", lw=0, label="sounding, 1 sd")
    ax.plot(prior, height_km, color=GREY, lw=1, ls=":")
    ax.fill_betweenx(height_km, middle - sd, middle + sd, color=BLUE, alpha=0.25, lw=0, label="reconstructed, 1 sd")
    ax.plot(middle, height_km, color=BLUE, lw=1.4)


def figure_air(flight: Reconstruction, day: ReconstructedAir) -> Figure:
    """Density ratio and winds along altitude with prior and posterior bands; measured over predicted drag."""
    figure = Figure(figsize=(9.6, 6.6), layout="constrained")
    upper, lower = list(np.asarray(figure.subfigures(2, 1, height_ratios=(1.7, 1.0))))
    axes = upper.subplots(1, 3, sharey=True)
    ratio_ax = lower.subplots()
    _clean(*axes, ratio_ax)
    p = day.profile
    z = p["altitude_m"].to_numpy() / 1000.0
    wind = profile_from_sounding(flight.telemetry.sounding).at(1000.0 * z).wind_ned_mps
    column = {name: p[name].to_numpy() for name in p}
    one = np.ones(len(z))
    prior_wind = column["wind_prior_sd_mps"]
    _bands(axes[0], z, column["density_ratio"], column["density_ratio_sd"], one, column["density_ratio_prior_sd"])
    for ax, k, way in ((axes[1], 0, "north"), (axes[2], 1, "east")):
        _bands(
            ax, z, wind[:, k] + column[f"wind_{way}_change_mps"], column[f"wind_{way}_sd_mps"], wind[:, k], prior_wind
        )
        ax.set_xlabel(f"wind towards {way} (m/s)")
    axes[0].set(xlabel="density / sounding's density", ylabel="altitude (km)")
    axes[1].legend(fontsize=8, frameon=False, loc="lower left")
    d = day.drag
    mach, ratio, prior_sd = (d[name].to_numpy() for name in ("mach", "ratio", "ratio_prior_sd"))
    order = np.argsort(mach)
    ratio_ax.fill_between(mach[order], 1.0 - prior_sd[order], 1.0 + prior_sd[order], color="0.87", lw=0,
                          label="density and C_A before the flight, 1 sd")  # fmt: skip
    ratio_ax.axhline(1.0, color=GREY, lw=1, ls=":")
    ratio_ax.plot(mach, ratio, ".", ms=3, color=BLUE, label="axial force, measured / predicted (0.4 s means)")
    low, high = np.percentile(ratio, [1, 99])
    room = max(1.3 * np.abs(np.array([low, high]) - 1.0).max(), 1.5 * float(np.median(prior_sd)))
    ratio_ax.set(xlabel="Mach number", ylabel="drag ratio", ylim=(1.0 - room, 1.0 + room))
    ratio_ax.legend(fontsize=8, frameon=False, loc="lower right", ncols=2)
    figure.suptitle("Air of the day: from the deceleration along the reconstructed trajectory", fontsize=11)
    stamp(figure, flight.telemetry)
    return figure


def figure_sensitivity(flight: Reconstruction, table: pd.DataFrame) -> Figure:
    """Change of each group of quantities at peak pressure in standard deviations, a bar a rerun.

    Diamonds: the same over what the change itself should be, where that is known.
    """
    names = list(dict.fromkeys(table["rerun"]))
    failed = set(table["rerun"][table["quantity"].isna()])
    shown = largest_of_groups(table)
    groups = [g for g in GROUPS if g in set(shown["group"])]
    columns = 4
    figure = Figure(figsize=(10.5, 0.6 + (0.9 + 0.22 * len(names)) * -(-len(groups) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(groups) // columns), columns, sharey=True, squeeze=False).ravel()
    for ax, group in zip(grid, groups, strict=False):
        part = shown[shown["group"] == group].set_index("rerun").reindex(names)
        y = np.arange(len(names))
        over_sd, over_expected = (part[c].to_numpy(dtype=float) for c in ("change_over_sd", "change_over_expected_sd"))
        ax.barh(y, np.nan_to_num(over_sd), height=0.7, color=BLUE, alpha=0.75)
        ax.plot(over_expected, y, "D", ms=4, color=ORANGE)
        far = float(np.nanmax(np.abs(np.concatenate([over_sd, over_expected, [3.0]]))))
        for edge in (-3.0, 3.0):
            ax.axvline(edge, color="0.3", lw=0.7, ls=":")
        ax.axvline(0.0, color="0.3", lw=0.7)
        ax.set(xlim=(-1.15 * far, 1.15 * far), title=group)
        ax.title.set_fontsize(9)
        ax.set_yticks(y, [f"{n} (failed)" if n in failed else n for n in names], fontsize=8)
        ax.tick_params(axis="x", labelsize=7)
        ax.set_axisbelow(True)
        _clean(ax)
    grid[0].invert_yaxis()
    for ax in grid[len(groups) :]:
        ax.set_visible(False)
    figure.suptitle(
        "What moves when a source is left out or an assumption changed, at peak dynamic pressure\n"
        "bars: in reported standard deviations; diamonds: in those of the change itself; dotted: 3",
        fontsize=10,
    )
    stamp(figure, flight.telemetry)
    return figure


def figure_attitude(flight: Reconstruction, check: AttitudeCheck) -> Figure:
    """Attitude from magnetometer and Sun minus the trajectory's about three body axes, with what it may be."""
    comparison = check.comparison
    assert comparison is not None
    figure = Figure(figsize=(7.2, 7.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    _clean(*axes)
    t, off, sd = comparison.time_s, np.rad2deg(comparison.difference_body_rad), np.rad2deg(comparison.sd_body_rad)
    own = np.rad2deg(resample(flight.solution.smoothed, t).sd()[:, 6:9])
    # stretches without Sun or field have no rows; a line across them would show what nobody knows
    whole = np.append(np.diff(t) < 1.5 * float(np.median(np.diff(t))), True)
    for k, ax in enumerate(axes):
        ax.fill_between(
            t, -3.0 * sd[:, k], 3.0 * sd[:, k], where=whole, color="0.87", lw=0, label="3 sd of the difference"
        )
        for sign in (-3.0, 3.0):
            label = "3 sd of the trajectory" if sign > 0 else None
            ax.plot(t, np.where(whole, sign * own[:, k], np.nan), color=GREY, lw=0.8, ls=":", label=label)
        ax.plot(
            t, np.where(whole, off[:, k], np.nan), color=BLUE, lw=0.9, label="magnetometer and Sun minus trajectory"
        )
        ax.axhline(0.0, color="0.3", lw=0.6)
        rms = float(np.sqrt(np.mean(off[:, k] ** 2)))
        ax.set_ylabel(f"about body {'xyz'[k]} (deg)\nrms {rms:.2f}", fontsize=9)
        far = 1.4 * max(float(np.percentile(np.abs(off[:, k]), 99.5)), 3.0 * float(np.median(sd[:, k])))
        ax.set_ylim(-far, far)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=7, frameon=False, ncols=3, loc="outside lower left")
    axes[-1].set_xlabel("time after launch (s)")
    title = "Attitude from magnetometer and Sun sensors alone against the trajectory's"
    figure.suptitle(
        title + ("\n(not independent: the trajectory rests on them too)" if check.dependence else ""), fontsize=10
    )
    stamp(figure, flight.telemetry)
    return figure


def figure_filter_and_smoother(flight: Reconstruction) -> Figure:
    """What the filter knew at each time and what the smoother knows, and their difference over its sd (McReynolds)."""
    bet = flight.solution
    filtered, smoothed = bet.filtered, bet.smoothed
    assert filtered.covariance is not None
    assert smoothed.covariance is not None
    groups = [("position", "m", 1.0), ("velocity", "m/s", 1.0), ("attitude", "deg", 180.0 / np.pi)]
    groups = groups if flight.has_attitude else groups[:2]
    figure = Figure(figsize=(10.0, 0.8 + 2.2 * len(groups)), layout="constrained")
    grid = figure.subplots(len(groups), 2, sharex=True)
    _clean(*grid.ravel())
    t, off = smoothed.time_s, difference(filtered, smoothed)
    var_filter, var_smoother = (np.diagonal(p, axis1=1, axis2=2) for p in (filtered.covariance, smoothed.covariance))
    lost = var_filter - var_smoother
    # towards the end both are the same, and the ratio of nothing to nothing
    sure = lost > LEAST_LOST * var_filter
    ratio = np.where(sure, off / np.sqrt(np.where(sure, lost, 1.0)), np.nan)
    for k, ((name, unit, scale), (known, apart)) in enumerate(zip(groups, grid, strict=True)):
        part = slice(3 * k, 3 * k + 3)
        for var, colour, label in ((var_filter, ORANGE, "filter"), (var_smoother, BLUE, "smoother")):
            known.semilogy(t, scale * np.sqrt(var[:, part].sum(axis=1)), color=colour, lw=1.2, label=label)
        known.set_ylabel(f"{name}, sd ({unit})", fontsize=9)
        for column, colour, axis in zip(ratio[:, part].T, (BLUE, ORANGE, GREEN), "xyz", strict=True):
            apart.plot(t, column, color=colour, lw=0.8, label=axis)
        for edge in (-3.0, 3.0):
            apart.axhline(edge, color="0.3", lw=0.8, ls=":")
        far = 4.5
        if np.isfinite(ratio[:, part]).any():
            far = min(max(far, 1.1 * float(np.nanpercentile(np.abs(ratio[:, part]), 99.5))), 30.0)
        frame = "body" if name == "attitude" else "ECEF"
        apart.set_ylim(-far, far)
        apart.set_ylabel(f"difference over\nits sd ({frame})", fontsize=9)
        apart.legend(fontsize=7, frameon=False, ncols=3, loc="upper right")
    grid[0, 0].legend(fontsize=8, frameon=False, ncols=2, loc="upper right")
    for ax in grid[-1]:
        ax.set_xlabel("time after launch (s)")
    figure.suptitle("Filter against smoother: how well each knows, and their difference (dotted: 3 sd)", fontsize=10)
    stamp(figure, flight.telemetry)
    return figure
