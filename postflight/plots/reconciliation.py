"""Does the simulator with the estimated joint fly like the flight? Its signals, posterior, and modes."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from flightmodel.checks import FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from postflight.plots.style import AXES, BAND, COLOUR, TIME, band, ellipses, in_style, legend_above, limits, titled
from postflight.plots.subject import lacking, words_of
from postflight.reconciliation.fit import JointFit
from postflight.reconciliation.modes import ModalStiffness
from postflight.reconciliation.posterior import (
    Posterior,
    linear_quantities,
    quantities,
    sample,
    stiffness_and_offset,
)
from postflight.reconstruction import Reconstruction

_FOUND = COLOUR["estimate"]


class Reconciled(Protocol):
    """What `reconcile` returns: `Reconciliation`."""

    @property
    def bet(self) -> Reconstruction:
        """What was reconciled."""

    @property
    def fit(self) -> JointFit:
        """Parameters, covariance and residuals."""

    @property
    def deflection(self) -> DeflectionHistory:
        """Deflection of the simulated flight."""

    def modal_stiffness(self) -> ModalStiffness:
        """Bending stiffness by the joint's frequency."""


def _fit_of(figure: str, given: Reconciled) -> JointFit:
    """Fit of a reconciliation; `GateError` for anything else."""
    if not isinstance(getattr(given, "fit", None), JointFit):
        raise lacking(figure, given, "fitted joint", "pf.reconcile(bet)")
    return given.fit


@in_style
def figure_reconciled(reconciliation: Reconciled, fused: DeflectionHistory | None = None) -> Figure:
    """Rate and lateral force, measured and simulated; deflection; stiffness against offset.

    Parameters
    ----------
    reconciliation : Reconciliation
    fused : DeflectionHistory, optional
        To be drawn beside the deflection with the estimated joint.

    Raises
    ------
    GateError
        For anything but a reconciliation.
    """
    found = _fit_of("figure_reconciled", reconciliation)
    history = reconciliation.deflection
    figure = Figure(figsize=(10.0, 9.0))
    axes = figure.subplots(3, 2)
    seen, read = found.problem.measured, found.problem.predict(found.parameters)
    flown = read.windows + found.problem.instrument_response(read) @ found.parameters.instruments
    t = seen.time_s.ravel()
    rate, force_g = np.rad2deg(flown[..., 1].ravel()), flown[..., 4].ravel() / STANDARD_GRAVITY_MPS2
    _pair(axes[0, 0], t, np.rad2deg(seen.rate_radps[..., 1].ravel()), rate, "body rate y (deg/s)")
    measured_g = seen.specific_force_mps2[..., 1].ravel() / STANDARD_GRAVITY_MPS2
    _pair(axes[0, 1], t, measured_g, force_g, "specific force y (g)")
    left = found.residuals.sensors
    _residuals(axes[1, 0], t, left[..., :3], "rates: residual / sd")
    _residuals(axes[1, 1], t, left[..., 3:], "specific force: residual / sd")
    _deflection(axes[2, 0], history, fused)
    _ridge(axes[2, 1], found)
    for ax in axes.ravel()[:5]:
        ax.set_xlabel(TIME)
    return titled(figure, "Joint reconciled with the flight", words_of(reconciliation.bet))


def _pair(ax: Axes, t: FloatArray, measured: FloatArray, flown: FloatArray, label: str) -> None:
    ax.plot(t, measured, color=COLOUR["measured"], label="measured")
    ax.plot(t, flown, color=_FOUND, lw=1.0, ls="--", label="simulated with the estimated joint")
    ax.set_ylabel(label)
    legend_above(ax, 2)


def _residuals(ax: Axes, t: FloatArray, residual: FloatArray, label: str) -> None:
    for axis, (name, colour) in enumerate(AXES.items()):
        ax.plot(t, residual[..., axis].ravel(), color=colour, lw=0, marker=".", ms=1.5, label=name)
    limits(ax)
    far = max(5.0, 1.05 * float(np.nanmax(np.abs(residual), initial=0.0)))
    ax.set(ylabel=label, ylim=(-far, far))
    ax.legend(ncols=3, markerscale=4)


def _deflection(ax: Axes, history: DeflectionHistory, fused: DeflectionHistory | None) -> None:
    if fused is not None:
        theta = np.rad2deg(fused.theta_rad)
        ax.plot(fused.time_s, theta, color=COLOUR["fused"], lw=2.5, alpha=0.6, label="fused methods")
    theta, sd = np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad)
    ax.plot(history.time_s, theta, color=_FOUND, label="with the estimated joint")
    band(ax, history.time_s, theta, sd, _FOUND, label="1 sd")
    ax.set(ylabel="deflection (deg)", ylim=(0.0, None))
    legend_above(ax, 3)


def _ridge(ax: Axes, found: JointFit) -> None:
    """Ellipses of 1 and 2 sd of stiffness and size of the offset."""
    mean, covariance = stiffness_and_offset(found)
    ellipses(ax, mean, covariance)
    ax.plot(*mean, color=_FOUND, marker="+", ms=10, lw=0)
    share = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    ax.set(xlabel="bending stiffness (N m/rad)", ylabel="c.g. offset (cm)", title=f"correlation {share:+.2f}")
    ax.legend(loc="best")


@in_style
def figure_posterior(reconciliation: Reconciled, posterior: Posterior | None = None) -> Figure:
    """Every pair of quantities: samples, and the ellipses of 1 and 2 sd of the linear problem.

    Parameters
    ----------
    reconciliation : Reconciliation
    posterior : Posterior, optional
        Its samples; emcee draws them where none are given.

    Raises
    ------
    ConfigError
        Where the sampler (emcee) is not installed.
    """
    fit = _fit_of("figure_posterior", reconciliation)
    posterior = sample(fit) if posterior is None else posterior
    table = quantities(posterior.fit.problem.vehicle_parameters, posterior.samples)
    best, covariance = linear_quantities(posterior)
    n = len(best)
    figure = Figure(figsize=(2.0 * n, 2.0 * n))
    axes = figure.subplots(n, n, squeeze=False)
    values = table.to_numpy()
    for (row, column), ax in np.ndenumerate(axes):
        if column > row:
            ax.axis("off")
        elif column == row:
            _histogram(ax, values[:, row], float(best[row]), float(np.sqrt(covariance[row, row])))
        else:
            pair = [column, row]
            ax.plot(*values[:, pair].T, ".", color=COLOUR["prior"], ms=1.0, alpha=0.4, rasterized=True)
            ellipses(ax, best[pair], covariance[np.ix_(pair, pair)] + 1e-12 * np.diag(np.diag(covariance)[pair]))
        ax.xaxis.set_major_locator(MaxNLocator(3))
        ax.tick_params(labelsize=7, labelleft=column == 0 and row > 0, labelbottom=row == n - 1)
        if row == n - 1:
            ax.set_xlabel(table.columns[column], fontsize=8)
        if column == 0 and row > 0:
            ax.set_ylabel(table.columns[row], fontsize=8)
    title = "Posterior of the joint: samples, and ellipses of the linear problem (1 and 2 sd)"
    return titled(figure, title, words_of(reconciliation.bet))


def _histogram(ax: Axes, values: FloatArray, best: float, sd: float) -> None:
    ax.hist(values, bins=40, density=True, color=COLOUR["prior_band"])
    x = np.linspace(*ax.get_xlim(), 200)
    ax.plot(x, np.exp(-0.5 * ((x - best) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi)), color=_FOUND, lw=1.0)
    ax.set_yticks([])


@in_style
def figure_modes(reconciliation: Reconciled, modal: ModalStiffness | None = None) -> Figure:
    """Spectra through the pulse with the linear model's modes over them; power along the track of every stiffness.

    Parameters
    ----------
    reconciliation : Reconciliation
    modal : ModalStiffness, optional
        Of `Reconciliation.modal_stiffness`.

    Raises
    ------
    GateError
        Where the joint's mode is not detected.
    """
    _fit_of("figure_modes", reconciliation)
    found = reconciliation.modal_stiffness() if modal is None else modal
    figure = Figure(figsize=(9.0, 4.8))
    left, right = figure.subplots(1, 2, width_ratios=[2.0, 1.0])
    left.grid(visible=False)
    shown = np.abs(found.frequency_hz) < 5.0
    picture = left.pcolormesh(
        found.time_s, found.frequency_hz[shown], found.power.T[shown], shading="nearest", cmap="Greys", vmin=0.0
    )
    figure.colorbar(picture, ax=left, label="ln of power over noise")
    for sense in (1.0, -1.0):
        left.plot(found.time_s, sense * found.joint_hz, color=_FOUND, label="joint" if sense > 0.0 else None)
        label = "aerodynamic" if sense > 0.0 else None
        left.plot(found.time_s, sense * found.aerodynamic_hz, color=COLOUR["second"], ls="--", label=label)
    left.set(xlabel=TIME, ylabel="frequency in non-spinning axes (Hz)")
    left.legend()
    simulated = found.stiffness_nmprad / found.factor[int(np.argmax(found.mean_log_power))]
    right.plot(found.factor * simulated, found.mean_log_power, color=_FOUND)
    low, high = found.stiffness_nmprad - found.sd_nmprad, found.stiffness_nmprad + found.sd_nmprad
    right.axvspan(low, high, color=_FOUND, alpha=BAND, lw=0, label="1 sd")
    right.set(xlabel="bending stiffness (N m/rad)", ylabel="power along the joint's track")
    right.legend()
    return titled(figure, "Modes of the lateral motion and the linear model", words_of(reconciliation.bet))
