"""Figures of a reconciliation: the flight, and what the simulator with the joint found makes of it."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from flightmodel.checks import FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.telemetry import Telemetry
from postflight.plots.paper_figures import COLOUR, stamp
from postflight.reconciliation.answer import stiffness_and_offset
from postflight.reconciliation.fit import Reconciled
from postflight.reconciliation.modes import ModalStiffness
from postflight.reconciliation.posterior import Posterior, linear_quantities, quantities

FOUND, MEASURED = "#0072B2", "#000000"
HIGHEST_HZ = 5.0


def figure_reconciled(
    found: Reconciled, telemetry: Telemetry, bent: DeflectionHistory, fused: DeflectionHistory | None
) -> Figure:
    """Rate and lateral force, measured and flown by the joint found; deflection; stiffness against offset."""
    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    axes = figure.subplots(3, 2)
    seen, read = found.problem.observed, found.problem.predicted(found.unknowns)
    flown = read.windows + found.problem.instrument_rows(read) @ found.unknowns.instruments
    t = seen.time_s.ravel()
    rate, force = np.rad2deg(flown[..., 1].ravel()), flown[..., 4].ravel() / STANDARD_GRAVITY_MPS2
    _pair(axes[0, 0], t, np.rad2deg(seen.rate_radps[..., 1].ravel()), rate, "body rate y (deg/s)")
    _pair(
        axes[0, 1], t, seen.specific_force_mps2[..., 1].ravel() / STANDARD_GRAVITY_MPS2, force, "specific force y (g)"
    )
    left = found.residuals.sensors
    _residuals(axes[1, 0], t, left[..., :3], "rates: residual / sd")
    _residuals(axes[1, 1], t, left[..., 3:], "specific force: residual / sd")
    _deflection(axes[2, 0], bent, fused)
    _ridge(axes[2, 1], found)
    for ax in axes.ravel():
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    for ax in axes.ravel()[:5]:
        ax.set_xlabel("time after launch (s)")
    figure.suptitle("Joint reconciled with the flight", fontsize=12)
    stamp(figure, telemetry)
    return figure


def _pair(ax: Axes, t: FloatArray, measured: FloatArray, flown: FloatArray, label: str) -> None:
    ax.plot(t, measured, color=MEASURED, lw=1.2, label="measured")
    ax.plot(t, flown, color=FOUND, lw=1.0, ls="--", label="flown with the joint found")
    ax.set_ylabel(label)
    ax.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0)


def _residuals(ax: Axes, t: FloatArray, residual: FloatArray, label: str) -> None:
    for axis, (name, colour) in enumerate(zip("xyz", ("#0072B2", "#D55E00", "#009E73"), strict=True)):
        ax.plot(t, residual[..., axis].ravel(), color=colour, lw=0, marker=".", ms=1.5, label=name)
    for gate in (-3.0, 3.0):
        ax.axhline(gate, color="0.5", lw=0.8, ls=":")
    ax.set_ylim(-5.0, 5.0)
    ax.set_ylabel(label)
    ax.legend(frameon=False, fontsize=8, loc="upper left", ncols=3, markerscale=4)


def _deflection(ax: Axes, history: DeflectionHistory, fused: DeflectionHistory | None) -> None:
    if fused is not None:
        ax.plot(
            fused.time_s, np.rad2deg(fused.theta_rad), color=COLOUR["fused"], lw=2.5, alpha=0.6, label="fused methods"
        )
    theta, sd = np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad)
    ax.plot(history.time_s, theta, color=FOUND, lw=1.2, label="with the joint found")
    ax.fill_between(history.time_s, theta - sd, theta + sd, color=FOUND, alpha=0.25, lw=0, label="1 sd")
    ax.set_ylabel("deflection (deg)")
    ax.set_ylim(bottom=0.0)
    ax.legend(frameon=False, fontsize=8, loc="upper left")


def _ridge(ax: Axes, found: Reconciled) -> None:
    """Ellipses of 1 and 2 sd of stiffness and size of the offset."""
    mean, covariance = stiffness_and_offset(found)
    root = np.linalg.cholesky(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    for size, style in ((1.0, "-"), (2.0, "--")):
        x, y = mean[:, None] + size * root @ np.stack([np.cos(turn), np.sin(turn)])
        ax.plot(x, y, color=FOUND, ls=style, lw=1.2, label=f"{size:g} sd")
    ax.plot(*mean, color=FOUND, marker="+", ms=10, lw=0)
    ax.set_xlabel("bending stiffness (N m/rad)")
    ax.set_ylabel("c.g. offset (cm)")
    share = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    ax.set_title(f"correlation {share:+.2f}", fontsize=9)
    ax.legend(frameon=False, fontsize=8)


def figure_posterior(posterior: Posterior, telemetry: Telemetry) -> Figure:
    """Every pair of quantities: samples, and the ellipses of 1 and 2 sd of the linear problem."""
    table = quantities(posterior.found.problem.unknown, posterior.samples)
    best, covariance = linear_quantities(posterior)
    n = len(best)
    figure = Figure(figsize=(2.0 * n, 2.0 * n), layout="constrained")
    axes = figure.subplots(n, n, squeeze=False)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    values = table.to_numpy()
    for row in range(n):
        for column in range(n):
            ax = axes[row, column]
            if column > row:
                ax.axis("off")
            elif column == row:
                _histogram(ax, values[:, row], best[row], float(np.sqrt(covariance[row, row])))
            else:
                ax.plot(values[:, column], values[:, row], ".", color="0.55", ms=1.0, alpha=0.4, rasterized=True)
                pair = [column, row]
                root = np.linalg.cholesky(covariance[np.ix_(pair, pair)] + 1e-12 * np.diag(np.diag(covariance)[pair]))
                for size, style in ((1.0, "-"), (2.0, "--")):
                    ax.plot(*(best[pair][:, None] + size * root @ circle), color=FOUND, ls=style, lw=1.0)
            ax.xaxis.set_major_locator(MaxNLocator(3))
            ax.tick_params(labelsize=7, labelleft=column == 0 and row > 0, labelbottom=row == n - 1)
            if row == n - 1:
                ax.set_xlabel(table.columns[column], fontsize=8)
            if column == 0 and row > 0:
                ax.set_ylabel(table.columns[row], fontsize=8)
    figure.suptitle("Posterior of the joint: samples, and ellipses of the linear problem (1 and 2 sd)", fontsize=12)
    stamp(figure, telemetry)
    return figure


def _histogram(ax: Axes, values: FloatArray, best: float, sd: float) -> None:
    ax.hist(values, bins=40, density=True, color="0.7")
    x = np.linspace(*ax.get_xlim(), 200)
    ax.plot(x, np.exp(-0.5 * ((x - best) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi)), color=FOUND, lw=1.0)
    ax.set_yticks([])


def figure_modes(found: ModalStiffness, telemetry: Telemetry) -> Figure:
    """Spectra through the pulse with the linear model's modes over them; what lies along every stiffness's track."""
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[2.0, 1.0])
    shown = np.abs(found.frequency_hz) < HIGHEST_HZ
    picture = left.pcolormesh(
        found.time_s, found.frequency_hz[shown], found.power.T[shown], shading="nearest", cmap="Greys", vmin=0.0
    )
    figure.colorbar(picture, ax=left, label="ln of power over noise")
    for sense in (1.0, -1.0):
        left.plot(found.time_s, sense * found.joint_hz, color=FOUND, lw=1.2, label="joint" if sense > 0.0 else None)
        label = "aerodynamic" if sense > 0.0 else None
        left.plot(found.time_s, sense * found.aerodynamic_hz, color="#D55E00", lw=1.2, ls="--", label=label)
    left.set_xlabel("time after launch (s)")
    left.set_ylabel("frequency in axes that do not spin (Hz)")
    left.legend(frameon=False, fontsize=8, loc="upper left")
    told = found.stiffness_nmprad / found.factor[int(np.argmax(found.gathered))]
    right.plot(found.factor * told, found.gathered, color=FOUND, lw=1.2)
    low, high = found.stiffness_nmprad - found.sd_nmprad, found.stiffness_nmprad + found.sd_nmprad
    right.axvspan(low, high, color=FOUND, alpha=0.2, lw=0, label="1 sd")
    right.set_xlabel("bending stiffness (N m/rad)")
    right.set_ylabel("gathered along the joint's track")
    right.grid(alpha=0.3)
    right.spines[["top", "right"]].set_visible(False)
    right.legend(frameon=False, fontsize=8)
    figure.suptitle("Modes of the lateral motion and the linear model", fontsize=12)
    stamp(figure, telemetry)
    return figure
