"""How do many flights scatter? Monte Carlo bands, and the paper's studies of the joint.

The paper's (AIAA 2011-2571): Table 3.1 as a figure, Figures 3.1 to 3.3, and Figure 1.3 before and after the joint is
made flexible.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from flightmodel.checks import GateError, check_type
from flightmodel.vehicle import Vehicle
from postflight.montecarlo.bands import Merged
from postflight.plots.style import COLOUR, MANY, STROKES, TIME, in_style, percentiles, titled
from postflight.plots.subject import lacking, reconstruction_of, words_of
from postflight.reconstruction import Reconstruction
from postflight.studies.joints import STUDIES, JointStudy, table_3_1
from postflight.studies.preflight import Bounds, pulse_columns, shares
from postflight.studies.shell_test import ShellTest
from synthetic_flight.scenarios import Scenario

_ALPHA, _NORMAL = "centerbody total angle of attack (deg)", "centerbody normal acceleration (g)"
# figure of the paper: its study, title, quantity and label
JOINT_FIGURES = {
    "3.1": ("damping", "Damping of the joint at 2.5 Hz, % of critical", "alpha_total_deg", _ALPHA),
    "3.2": ("stiffness", "Stiffness of the joint at 0.5 % of critical", "alpha_total_deg", _ALPHA),
    "3.3": ("stiffness", "Stiffness of the joint at 0.5 % of critical", "normal_g", _NORMAL),
}
_HIGHEST = {"alpha_total_deg": 25.0, "normal_g": 2.5}  # shown of a joint study; a tumble goes beyond
_LABEL = {
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


@in_style
def figure_bands(merged: Merged, words: str = "SYNTHETIC flights") -> Figure:
    """Every history of a Monte Carlo study with its 2.3, 50 and 97.7 percentiles.

    Parameters
    ----------
    merged : Merged
        Of `monte_carlo`, whose dispersions file keeps histories.
    words : str
        For the corner.

    Raises
    ------
    GateError
        Where the study kept no histories.
    """
    check_type("figure_bands", merged, Merged, "pf.monte_carlo(dispersions, folder)")
    bands = merged.bands
    if not len(bands):
        raise lacking("figure_bands", merged, "history", "a study whose [outputs] names histories")
    names = list(dict.fromkeys(bands["history"]))
    figure = Figure(figsize=(7.2, 2.2 * len(names) + 0.8))
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for ax, name in zip(axes, names, strict=True):
        rows = bands[bands["history"] == name]
        percentiles(ax, *(rows[c].to_numpy() for c in ("time_s", "p2.3", "p50", "p97.7")))
        ax.set_ylabel(_LABEL[name])
        ax.margins(x=0)
    axes[0].legend()
    axes[-1].set_xlabel(TIME)
    title = f"{merged.summary['flights']} dispersed flights: 2.3, 50 and 97.7 % of them"
    return titled(figure, title, words)


@in_style
def figure_table_3_1(vehicle: Vehicle) -> Figure:
    """Stiffness and damping against frequency and damping ratio: the paper's as points, the equations as lines.

    Parameters
    ----------
    vehicle : Vehicle
        Of `read_vehicle`; its own inertias are drawn beside the paper's.
    """
    check_type("figure_table_3_1", vehicle, Vehicle, "pf.read_vehicle(file)")
    table = table_3_1(vehicle)
    figure = Figure(figsize=(7.2, 3.6))
    left, right = figure.subplots(1, 2)
    springs, dampers = table[table["quantity"] == "K"], table[table["study"] == "damping"]
    for ax, rows, x, y, label in (
        (left, springs, "frequency_hz", "bending stiffness (N m/rad)", "free-free frequency (Hz)"),
        (right, dampers, "damping_percent", "damping (N m s/rad)", "share of critical at 2.5 Hz (%)"),
    ):
        equation = "eqs. [7], [8], reduced inertia 17.569 kg m²"
        ax.plot(rows[x], rows["equation"], color=COLOUR["estimate"], label=equation)
        paper = rows["paper"].astype(float)
        ax.plot(rows[x], paper, "o", ms=5, mfc="none", color=COLOUR["paper"], label="paper, Table 3.1")
        ax.plot(rows[x], rows["vehicle"], color=COLOUR["nominal"], lw=1.0, ls="--", label="the vehicle's own inertias")
        ax.set(xlabel=label, ylabel=y)
    right.set(xscale="log", yscale="log", xticks=[0.5, 1, 2.5, 5, 10, 20], yticks=[3, 10, 30, 100])
    for axis in (right.xaxis, right.yaxis):
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter("")
    left.legend(fontsize=7)
    title = "Stiffness and damping against frequency (AIAA 2011-2571, Table 3.1)"
    return titled(figure, title, f"vehicle: {vehicle.name}")


@in_style
def figure_joints(scenario: Scenario, number: str = "3.1", study: JointStudy | None = None) -> Figure:
    """Angle of attack or normal acceleration of every joint of a study over time (Figures 3.1 to 3.3).

    A flight is shown up to a tumble; the legend names those that go beyond the axis.

    Parameters
    ----------
    scenario : Scenario
        Of `read_scenario`.
    number : str
        Figure of the paper: ``"3.1"``, ``"3.2"`` or ``"3.3"``.
    study : JointStudy, optional
        The study's flights; they are flown without.

    Raises
    ------
    GateError
        For another figure.
    """
    check_type("figure_joints", scenario, Scenario, "pf.read_scenario(file)")
    if number not in JOINT_FIGURES:
        raise GateError(f"figure_joints: figure {number}; known are {', '.join(JOINT_FIGURES)}", "name-unknown")
    name, title, quantity, label = JOINT_FIGURES[number]
    study = STUDIES[name](scenario, 0) if study is None else study
    figure = Figure(figsize=(7.2, 4.4))
    ax = figure.subplots()
    largest = 0.0
    highest, beyond = _HIGHEST[quantity], []
    for k, flight in enumerate(study.flights):
        tumbling = flight.alpha_total_deg > 90.0
        shown = int(np.argmax(tumbling)) if tumbling.any() else len(tumbling)
        values = getattr(flight, quantity)[:shown]
        name = f"{flight.label}, tumbles at {flight.time_s[shown]:.1f} s" if tumbling.any() else flight.label
        ax.plot(flight.time_s[:shown], values, color=MANY[k], ls=STROKES[k], lw=1.6 if k == 0 else 1.2, label=name)
        largest = max(largest, float(np.max(values)))
        if np.max(values) > highest:
            beyond.append(flight.label)
    ax.axvline(study.peak_s, color=COLOUR["limit"], lw=0.8, ls=":")
    ax.set(xlabel=f"{TIME}; dotted: peak dynamic pressure", ylabel=label, ylim=(0.0, min(highest, 1.15 * largest)))
    ax.set_xlim(study.flights[0].time_s[0], study.flights[0].time_s[-1])
    ax.legend(title=f"beyond the axis: {', '.join(beyond)}" if beyond else None)
    words = f"SYNTHETIC flights of {scenario.spec.name}"
    return titled(figure, f"{title} (AIAA 2011-2571, Figure {number})", words)


class WithBounds(Protocol):
    """Object with bands of dispersed entries, joint locked and flexible: a `Reconciliation`."""

    bet: Reconstruction

    def bounds(self) -> tuple[Bounds, Bounds]:
        """Fly both sets of entries."""
        ...


@in_style
def figure_preflight(
    flown: Reconstruction | WithBounds, rigid: Bounds | None = None, flexible: Bounds | None = None
) -> Figure:
    """Figure 1.3 twice: the flight against a rigid vehicle's bounds, and against those with the flexible joint.

    Parameters
    ----------
    flown : Reconciliation
        With ``rigid`` and ``flexible`` also Reconstruction.
    rigid, flexible : Bounds, optional
        Of `Reconciliation.bounds`; they are flown without.

    Raises
    ------
    GateError
        Where there are no bounds to draw, or no loads.
    """
    if rigid is None or flexible is None:
        if not hasattr(flown, "bounds"):
            raise lacking("figure_preflight", flown, "bounds", "pf.reconcile(bet)", "rigid and flexible bounds")
        rigid, flexible = flown.bounds()
    bet = reconstruction_of("figure_preflight", getattr(flown, "bet", flown), "bounds")
    flight, first_s, last_s = pulse_columns(bet), *bet.pulse_s
    window = first_s - 10.0, last_s + 5.0
    table = shares(bet, rigid, flexible)
    inside = "; ".join(
        f"{joint} {quantity.split('_')[0]} {100 * share:.0f} %"
        for joint, quantity, share in zip(table["joint"], table["quantity"], table["share_inside"], strict=True)
    )
    figure = Figure(figsize=(9.0, 6.4))
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    shown = flight["time_s"].between(*window)
    rows = {"alpha_total_deg": "total angle of attack (deg)", "normal_g": "normal acceleration (g)"}
    for column, (bounds, name) in enumerate(((rigid, "joint locked"), (flexible, "flexible joint"))):
        for ax, quantity in zip(axes[:, column], rows, strict=True):
            bands, nominal = bounds.by_quantity[quantity]
            percentiles(ax, bounds.time_s, *bands)
            ax.plot(bounds.time_s, nominal, color=COLOUR["nominal"], lw=1.0, ls="--", label="nominal")
            ax.plot(flight["time_s"], flight[quantity], color=COLOUR["measured"], label="flight, reconstructed")
        axes[0, column].set_title(f"{name}: {bounds.flights} flights")
        axes[1, column].set_xlabel(TIME)
    for ax, (quantity, label) in zip(axes[:, 0], rows.items(), strict=True):
        ax.set(ylabel=label, ylim=(0.0, 2.2 * float(flight.loc[shown, quantity].max())))
    axes[0, 0].set_xlim(*window)
    axes[0, 0].legend()
    title = f"Flight against bounds of its own entry (AIAA 2011-2571, Figure 1.3)\ninside, of the pulse: {inside}"
    return titled(figure, title, words_of(bet))


@in_style
def figure_shell_test(found: ShellTest, title: str) -> Figure:
    """Load against angle, measured, by the selected law and by a linear spring; residuals of both over time."""
    figure = Figure(figsize=(7.2, 3.4))
    ax, left = figure.subplots(1, 2)
    test, selected = found.selected.test, found.selected
    ax.plot(np.rad2deg(test.angle_rad), test.moment_nm, color=COLOUR["estimate"], label="measured")
    shown = (("selected", selected, "second"), ("not selected", found.fits[0], "limit"))
    for name, fit, colour in shown if selected is not found.fits[0] else shown[1:]:
        label = f"{name}: {' and '.join(fit.laws) or 'straight spring'}, rms {100.0 * fit.rms_share:.1f} %"
        fitted = np.rad2deg(test.angle_rad - fit.residual_rad)
        ax.plot(fitted, test.moment_nm, color=COLOUR[colour], lw=1.0, label=label)
        left.plot(test.time_s, 100.0 * fit.residual_rad / test.largest_rad, color=COLOUR[colour], lw=1.0)
    ax.set(xlabel="angle (deg)", ylabel="moment in the joint (N m)")
    ax.legend(fontsize=7)
    left.axhline(0.0, color=COLOUR["zero"], lw=0.8)
    left.set(xlabel="time (s)", ylabel="measured less fitted (% of the largest)")
    figure.suptitle(title)
    return figure
