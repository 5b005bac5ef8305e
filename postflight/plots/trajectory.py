"""How good is the reconstructed trajectory? Path, residuals, filter and smoother, air, attitude, sensitivity."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import FloatArray
from flightmodel.trajectory import difference
from postflight.plots.style import AXES, BAND, COLOUR, TIME, band, drawn_unit, in_style, legend_above, limits, titled
from postflight.plots.subject import Drawable, bet_of, lacking, reconstruction_of, words_of
from postflight.reconstruction import attitude_table
from postflight.runs import Run
from postflight.sensitivity import GROUPS, largest_of_groups, sensitivity
from recon.measurements import component_unit


@in_style
def figure_flown(flown: Drawable) -> Figure:
    """Altitude, speed and their standard deviations: the picture of a flight without a vehicle file.

    Parameters
    ----------
    flown : Reconstruction, Run or Deflections

    Raises
    ------
    GateError
        Where there is no trajectory.
    """
    figure = Figure(figsize=(7.2, 7.0))
    high, fast, sure = figure.subplots(3, 1, sharex=True)
    flight = bet_of("figure_flown", flown)
    bet, air = flight.trajectory, flight.air
    high.plot(air.time_s, air.altitude_m / 1e3, color=COLOUR["estimate"])
    high.set_ylabel("altitude (km)")
    fast.plot(air.time_s, np.linalg.norm(bet.velocity_ecef_mps, axis=1), color=COLOUR["estimate"])
    fast.set(ylabel="ground speed (m/s)", ylim=(0, None))
    for first, colour, label in ((0, COLOUR["estimate"], "position (m)"), (3, COLOUR["second"], "velocity (m/s)")):
        sure.semilogy(air.time_s, np.linalg.norm(bet.sd()[:, first : first + 3], axis=1), color=colour, label=label)
    sure.set(ylabel="standard deviation", xlabel=TIME)
    sure.legend(loc="best")
    found = [f for f in flight.findings if f.source == "motion"]
    for ax in (high, fast, sure):
        for f in found:
            ax.axvspan(f.start_s, f.end_s, color=COLOUR["flagged"], alpha=0.3, lw=0)
    title = "Reconstructed flight" + ("; shaded: unmodelled acceleration" if found else "")
    return titled(figure, title, words_of(flown))


@in_style
def figure_residuals(flown: Drawable) -> Figure:
    """Tested innovations of each source and component, with predicted 3-sd lines and edited points marked.

    Parameters
    ----------
    flown : Reconstruction, Run or Deflections

    Raises
    ------
    GateError
        Where there is no trajectory, or no measurement was tried.
    """
    flight = bet_of("figure_residuals", flown)
    table = flight.tables["residuals"] if isinstance(flight, Run) else flight.solution.residuals
    if not table["used"].any():
        raise lacking("figure_residuals", flight, "residual", "a flight with a tracker")
    pairs = list(table[table["used"]].groupby(["source", "component"], sort=False))
    figure = Figure(figsize=(7.2, 1.5 * len(pairs) + 0.8))
    axes = figure.subplots(len(pairs), 1, sharex=True, squeeze=False)[:, 0]
    for ax, ((source, component), rows) in zip(axes, pairs, strict=True):
        scale, unit = drawn_unit(rows["unit"].iloc[0] if "unit" in rows else component_unit(component))
        good = rows["accepted"].to_numpy(dtype=bool)
        t, r = rows["time_s"].to_numpy(), scale * rows["residual"].to_numpy()
        sd = scale * rows["predicted_sd"].to_numpy()
        ax.plot(t[good], r[good], ".", ms=1.5 if len(t) > 500 else 3, color=COLOUR["estimate"])
        limit = 6.0 * float(np.median(sd))
        _edited(ax, t[~good], r[~good], limit)
        if not good.all():
            count = f"{np.count_nonzero(~good)} of {len(good)} edited"
            ax.set_title(count, fontsize=7, color=COLOUR["edited"], loc="right", pad=2)
        for sign in (-3, 3):
            ax.plot(t, sign * sd, color=COLOUR["limit"], lw=0.7)
        ax.set_ylabel(f"{source}\n{component} ({unit})", fontsize=7)
        ax.set_ylim(-limit, limit)
    axes[-1].set_xlabel(TIME)
    title = "Residuals before each update with 3 sd; edited points crossed, arrows where they lie outside"
    return titled(figure, title, words_of(flown))


def _edited(ax: Axes, time_s: FloatArray, residual: FloatArray, limit: float) -> None:
    """Crosses, or arrows at the edge where a residual lies beyond it."""
    shown = np.clip(residual, -0.95 * limit, 0.95 * limit)
    beyond = np.abs(residual) > 0.95 * limit
    for rows, mark in ((~beyond, "x"), (beyond & (shown > 0.0), "^"), (beyond & (shown < 0.0), "v")):
        ax.plot(time_s[rows], shown[rows], mark, ms=4, color=COLOUR["edited"])


@in_style
def figure_filter_and_smoother(flown: Drawable) -> Figure:
    """Standard deviations of filter and smoother, and their difference over its own (McReynolds).

    Parameters
    ----------
    flown : Reconstruction, or Deflections of one

    Raises
    ------
    GateError
        Of a run, which does not store the filter's trajectory, and where there is none.
    """
    flight = reconstruction_of("figure_filter_and_smoother", flown, "filter's trajectory")
    bet = flight.solution
    filtered, smoothed = bet.filtered, bet.smoothed
    assert filtered.covariance is not None
    assert smoothed.covariance is not None
    groups = [("position", "m", 1.0), ("velocity", "m/s", 1.0), ("attitude", "deg", 180.0 / np.pi)]
    groups = groups if flight.has_attitude else groups[:2]
    figure = Figure(figsize=(10.0, 0.8 + 2.2 * len(groups)))
    grid = figure.subplots(len(groups), 2, sharex=True)
    t, off = smoothed.time_s, difference(filtered, smoothed)
    var_filter, var_smoother = (np.diagonal(p, axis1=1, axis2=2) for p in (filtered.covariance, smoothed.covariance))
    lost = var_filter - var_smoother
    # towards the end both are the same, and the ratio of nothing to nothing: a thousandth of the variance must be lost
    sure = lost > 1e-3 * var_filter
    ratio = np.where(sure, off / np.sqrt(np.where(sure, lost, 1.0)), np.nan)
    for k, ((name, unit, scale), (spread, apart)) in enumerate(zip(groups, grid, strict=True)):
        part = slice(3 * k, 3 * k + 3)
        for var, label in ((var_filter, "filter"), (var_smoother, "smoother")):
            spread.semilogy(t, scale * np.sqrt(var[:, part].sum(axis=1)), color=COLOUR[label], label=label)
        spread.set_ylabel(f"{name}, sd ({unit})")
        for column, (axis, colour) in zip(ratio[:, part].T, AXES.items(), strict=True):
            apart.plot(t, column, color=colour, lw=0.8, label=axis)
        limits(apart)
        far = 4.5
        if np.isfinite(ratio[:, part]).any():
            far = min(max(far, 1.1 * float(np.nanpercentile(np.abs(ratio[:, part]), 99.5))), 30.0)
        apart.set_ylim(-far, far)
        apart.set_ylabel(f"difference over\nits sd ({'body' if name == 'attitude' else 'ECEF'})")
        legend_above(apart, 3)
    legend_above(grid[0, 0], 2)
    for ax in grid[-1]:
        ax.set_xlabel(TIME)
    title = "Filter against smoother: standard deviations, and the difference over its own (dotted: 3 sd)"
    return titled(figure, title, words_of(flown))


@in_style
def figure_air(flown: Drawable) -> Figure:
    """As-flown density and wind along altitude with prior and posterior bands; measured over predicted drag.

    Parameters
    ----------
    flown : Reconstruction, Run or Deflections

    Raises
    ------
    GateError
        Where there is no trajectory, or no as-flown atmosphere.
    """
    flight = bet_of("figure_air", flown)
    day = flight.as_flown
    if day is None:
        raise lacking("figure_air", flight, "as-flown atmosphere", "a flight with vehicle and accelerometers")
    figure = Figure(figsize=(9.6, 6.6))
    upper, lower = list(np.asarray(figure.subfigures(2, 1, height_ratios=(1.7, 1.0))))
    axes = upper.subplots(1, 3, sharey=True)
    column = {name: day.profile[name].to_numpy() for name in day.profile}
    height_km = column["altitude_m"] / 1000.0
    wind = profile_from_sounding(flight.telemetry.sounding).at(1000.0 * height_km).wind_ned_mps
    one = np.ones(len(height_km))
    found = column["density_ratio"], column["density_ratio_sd"]
    _along_height(axes[0], height_km, found, (one, column["density_ratio_prior_sd"]))
    for k, (ax, way) in enumerate(zip(axes[1:], ("north", "east"), strict=True)):
        found = wind[:, k] + column[f"wind_{way}_change_mps"], column[f"wind_{way}_sd_mps"]
        _along_height(ax, height_km, found, (wind[:, k], column["wind_prior_sd_mps"]))
        ax.set_xlabel(f"wind velocity, {way} (m/s)")
    axes[0].set(xlabel="density / sounding's density", ylabel="altitude (km)")
    upper.legend(*axes[1].get_legend_handles_labels(), ncols=3, loc="outside lower left")
    _drag(lower.subplots(), day.drag)
    return titled(
        figure, "As-flown atmosphere from the deceleration along the reconstructed trajectory", words_of(flown)
    )


def _along_height(
    ax: Axes, height_km: FloatArray, found: tuple[FloatArray, FloatArray], prior: tuple[FloatArray, FloatArray]
) -> None:
    """Values and standard deviations (n,), prior and posterior, along altitude."""
    for (middle, sd), colour, edge, alpha, stroke, label in (
        (prior, COLOUR["prior_band"], COLOUR["prior"], 1.0, ":", "sounding"),
        (found, COLOUR["estimate"], COLOUR["estimate"], BAND, "-", "reconstructed"),
    ):
        ax.fill_betweenx(height_km, middle - sd, middle + sd, color=colour, alpha=alpha, lw=0, label=f"{label}, 1 sd")
        ax.plot(middle, height_km, color=edge, ls=stroke, label=label)


def _drag(ax: Axes, drag: pd.DataFrame) -> None:
    """Axial force, measured over predicted, along Mach number."""
    mach, ratio, prior_sd = (drag[name].to_numpy() for name in ("mach", "ratio", "ratio_prior_sd"))
    order = np.argsort(mach)
    one = np.ones(len(mach))
    label = "a priori density and C_A, 1 sd"
    band(ax, mach[order], one, prior_sd[order], COLOUR["prior_band"], alpha=1.0, label=label)
    ax.axhline(1.0, color=COLOUR["prior"], lw=1, ls=":")
    label = "axial force, measured / predicted (0.4 s means)"
    ax.plot(mach, ratio, ".", ms=3, color=COLOUR["estimate"], label=label)
    low, high = np.percentile(ratio, [1, 99])
    room = max(1.3 * np.abs(np.array([low, high]) - 1.0).max(), 1.5 * float(np.median(prior_sd)))
    ax.set(xlabel="Mach number", ylabel="drag ratio", ylim=(1.0 - room, 1.0 + room))
    legend_above(ax, 2)


@in_style
def figure_attitude(flown: Drawable) -> Figure:
    """Attitude from magnetometer and Sun minus the trajectory's about three body axes, with its 3-sd band.

    Parameters
    ----------
    flown : Reconstruction, Run or Deflections

    Raises
    ------
    GateError
        Where there is no such comparison.
    """
    table, independent = _attitude(flown)
    figure = Figure(figsize=(7.2, 7.0))
    axes = figure.subplots(3, 1, sharex=True)
    t = table["t_s"].to_numpy()
    off, sd, own = (
        table[[f"{name.format(a)}_deg" for a in "xyz"]].to_numpy()
        for name in ("difference_{}_body", "difference_{}_body_sd", "bet_{}_body_sd")
    )
    # stretches without Sun or field have no rows; a line across them would show what nobody measured
    whole = np.append(np.diff(t) < 1.5 * float(np.median(np.diff(t))), True)
    for k, (ax, axis) in enumerate(zip(axes, "xyz", strict=True)):
        wide = 3.0 * sd[:, k]
        ax.fill_between(t, -wide, wide, where=whole, color=COLOUR["prior_band"], lw=0, label="3 sd of the difference")
        for sign, label in ((-3.0, None), (3.0, "3 sd of the trajectory")):
            edge = np.where(whole, sign * own[:, k], np.nan)
            ax.plot(t, edge, color=COLOUR["limit"], lw=0.8, ls=":", label=label)
        label = "magnetometer and Sun minus trajectory"
        ax.plot(t, np.where(whole, off[:, k], np.nan), color=COLOUR["estimate"], lw=0.9, label=label)
        ax.axhline(0.0, color=COLOUR["zero"], lw=0.6)
        ax.set_ylabel(f"about body {axis} (deg)\nrms {float(np.sqrt(np.mean(off[:, k] ** 2))):.2f}")
        far = 1.4 * max(float(np.percentile(np.abs(off[:, k]), 99.5)), 3.0 * float(np.median(sd[:, k])))
        ax.set_ylim(-far, far)
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=2, loc="outside lower left")
    axes[-1].set_xlabel(TIME)
    title = "Attitude from magnetometer and Sun sensors alone against the trajectory's"
    if not independent:
        title += "\n(not independent: the trajectory depends on these sensors too)"
    return titled(figure, title, words_of(flown))


def _attitude(flown: Drawable) -> tuple[pd.DataFrame, bool]:
    """Table of the comparison (``attitude_check.csv``), and whether the two attitudes are independent."""
    flight = bet_of("figure_attitude", flown)
    if isinstance(flight, Run) and "attitude_check" in flight.tables:
        return flight.tables["attitude_check"], flight.summary["attitude_check"]["independent"]
    if isinstance(flight, Run) or flight.attitude is None or flight.attitude.comparison is None:
        wanted = "a flight with magnetometer and Sun sensors"
        raise lacking("figure_attitude", flight, "attitude by magnetometer and Sun", wanted)
    return attitude_table(flight.attitude, flight.solution), not flight.attitude.dependence


@in_style
def figure_sensitivity(flown: Drawable, table: pd.DataFrame | None = None) -> Figure:
    """Change of each group of quantities at peak pressure in standard deviations, a bar a rerun.

    Diamonds: the same over what the change itself should be, where that is known.

    Parameters
    ----------
    flown : Reconstruction, Run or Deflections
    table : DataFrame, optional
        ``sensitivity.csv``. A run has its own; otherwise the flight is reconstructed again without each source.

    Raises
    ------
    GateError
        Where there is no trajectory, or a run without the table.
    """
    if table is None:
        flight = bet_of("figure_sensitivity", flown)
        stored = flight.tables.get("sensitivity") if isinstance(flight, Run) else None
        what = "sensitivity.csv"
        table = sensitivity(reconstruction_of("figure_sensitivity", flown, what)) if stored is None else stored
    names = list(dict.fromkeys(table["rerun"]))
    failed = set(table["rerun"][table["quantity"].isna()])
    shown = largest_of_groups(table)
    groups = [g for g in GROUPS if g in set(shown["group"])]
    columns = 4
    figure = Figure(figsize=(10.5, 0.6 + (0.9 + 0.22 * len(names)) * -(-len(groups) // columns)))
    grid = figure.subplots(-(-len(groups) // columns), columns, sharey=True, squeeze=False).ravel()
    y = np.arange(len(names))
    for ax, group in zip(grid, groups, strict=False):
        part = shown[shown["group"] == group].set_index("rerun").reindex(names)
        over_sd, over_expected = (part[c].to_numpy(dtype=float) for c in ("change_over_sd", "change_over_expected_sd"))
        ax.barh(y, np.nan_to_num(over_sd), height=0.7, color=COLOUR["estimate"], alpha=0.75)
        ax.plot(over_expected, y, "D", ms=4, color=COLOUR["second"])
        far = float(np.nanmax(np.abs(np.concatenate([over_sd, over_expected, [3.0]]))))
        limits(ax, vertical=True)
        ax.axvline(0.0, color=COLOUR["zero"], lw=0.7)
        ax.set(xlim=(-1.15 * far, 1.15 * far), title=group)
        ax.set_yticks(y, [f"{n} (failed)" if n in failed else n for n in names], fontsize=8)
        ax.tick_params(axis="x", labelsize=7)
    grid[0].invert_yaxis()
    for ax in grid[len(groups) :]:
        ax.set_visible(False)
    title = "Change at peak dynamic pressure when a source is left out or an assumption changed\n"
    title += "bars: in reported standard deviations; diamonds: in those of the change itself; dotted: 3"
    return titled(figure, title, words_of(flown))
