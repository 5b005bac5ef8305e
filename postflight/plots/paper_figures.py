"""Figures of a run in the manner of the seed paper's 1.3, 2.5 and 2.7, and the one-page picture of the answer."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.misalignment import aerodynamic_angle, aeroshell_acceleration, psi_from_acceleration
from flightmodel.airdata import pressure_pulse
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.telemetry import Telemetry
from postflight.deflections import Deflections
from postflight.plots.ensembles import words_in_corner
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds

# distinct in hue and in grey (Okabe and Ito)
COLOUR = {
    "camera": "#0072B2",
    "misalignment": "#D55E00",
    "trim": "#009E73",
    "fused": "#CC79A7",
    "truth": "#000000",
}
LABEL = {
    "camera": "video (virtual camera)",
    "misalignment": "accelerometers (misalignment)",
    "trim": "trim angle",
    "fused": "all fused",
}
LINE = {"camera": "-", "misalignment": "--", "trim": "-.", "fused": "-"}


def _axes(figure: Figure, rows: int = 1) -> list[Axes]:
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    return list(axes)


def stamp(figure: Figure, telemetry: Telemetry) -> None:
    """Name the flight in a corner, and whether it is synthetic."""
    tag = "SYNTHETIC flight" if telemetry.synthetic else "flight"
    words_in_corner(figure, f"{telemetry.name}: {tag}")


def _window(flight: Reconstruction) -> tuple[float, float]:
    """Return from 80 km or so to well after the pulse."""
    pulse = flight.air.time_s[pressure_pulse(flight.air.dynamic_pressure_pa)]
    width = pulse[-1] - pulse[0]
    first, last = pulse[0] - 0.75 * width, pulse[-1] + 0.5 * width
    return float(max(first, flight.air.time_s[0])), float(min(last, flight.air.time_s[-1]))


def figure_1_3(flight: Reconstruction, bounds: Bounds) -> Figure:
    """Total angle of attack and normal acceleration against a rigid vehicle's Monte Carlo bounds (Figure 1.3)."""
    figure = Figure(figsize=(7.2, 7.0), layout="constrained")
    upper, lower = _axes(figure, 2)
    air, pulse = flight.air, flight.required_loads()
    for ax, band, nominal in (
        (upper, bounds.alpha_total_deg, bounds.nominal_alpha_deg),
        (lower, bounds.normal_g, bounds.nominal_normal_g),
    ):
        ax.fill_between(
            bounds.time_s,
            band[0],
            band[2],
            color="0.85",
            label=f"2.3 to 97.7 % of {bounds.flights} rigid flights",
        )
        ax.plot(bounds.time_s, band[1], color="0.55", lw=1, label="rigid, 50 %")
        ax.plot(bounds.time_s, nominal, color="0.3", lw=1, ls=":", label="rigid, nominal")
    alpha, sd = np.rad2deg(air.alpha_total_wind_rad), np.rad2deg(air.alpha_total_wind_sd_rad)
    upper.plot(air.time_s, alpha, color="#0072B2", lw=1.4, label="BET, wind-relative")
    upper.fill_between(air.time_s, alpha - sd, alpha + sd, color="#0072B2", alpha=0.2, lw=0)
    ground = np.rad2deg(air.alpha_total_ground_rad)
    upper.plot(air.time_s, ground, color="#56B4E9", lw=1, ls="--", label="BET, no wind")
    normal = np.hypot(*pulse.specific_force_body_mps2[:, 1:].T) / STANDARD_GRAVITY_MPS2
    lower.plot(pulse.time_s, normal, color="#0072B2", lw=1.4, label="measured, at the c.g.")
    upper.set(ylabel="total angle of attack (deg)", ylim=(0, 16), xlim=_window(flight))
    lower.set(ylabel="normal acceleration (g)", ylim=(0, None), xlabel="time after launch (s)")
    for ax in (upper, lower):
        ax.legend(fontsize=7, loc="upper left", frameon=False)
    figure.suptitle("Flight against a rigid vehicle (in the manner of AIAA 2011-2571, Figure 1.3)", fontsize=10)
    stamp(figure, flight.telemetry)
    return figure


def figure_2_5(flight: Reconstruction) -> Figure:
    """BET angle of attack and the one inferred from the uncorrected accelerometers (Figure 2.5)."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    (ax,) = _axes(figure)
    _bet_line(ax, flight, "BET, centerbody")
    pulse = flight.required_loads()
    use = pulse.informative
    inferred = aerodynamic_angle(flight.telemetry.required_vehicle().aero, pulse.mach, pulse.specific_force_body_mps2)
    ax.plot(pulse.time_s, _where(use, inferred), color="black", lw=1.2, label="C_N/C_A look-up, no adjustment")
    _no_answer(ax, use, inferred, pulse.time_s)
    ax.set(xlim=_window(flight), ylim=(0, 60), ylabel="total angle of attack (deg)", xlabel="time after launch (s)")
    ax.legend(fontsize=8, frameon=False, loc="upper left")
    figure.suptitle("Angle of attack: BET against uncorrected accelerometers (AIAA 2011-2571, Figure 2.5)", fontsize=10)
    stamp(figure, flight.telemetry)
    return figure


def figure_2_7(flight: Reconstruction, history: DeflectionHistory) -> Figure:
    """The same with the accelerometers turned by the estimated deflection, and the BET biased by it (Figure 2.7)."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    (ax,) = _axes(figure)
    pulse, aero = flight.required_loads(), flight.telemetry.required_vehicle().aero
    use, force = pulse.informative, pulse.specific_force_body_mps2
    raw = aerodynamic_angle(aero, pulse.mach, force)
    turned = aeroshell_acceleration(force, np.nan_to_num(history.theta_rad), psi_from_acceleration(force))
    biased = np.linalg.norm(pulse.flow_yz_rad - history.theta_yz_rad, axis=1)
    ax.plot(pulse.time_s, _where(use, raw), color="black", lw=1, label="C_N/C_A look-up, no adjustment")
    ax.plot(pulse.time_s, _where(use, aerodynamic_angle(aero, pulse.mach, turned)), color="#009E73", lw=1.4,
            label="C_N/C_A look-up, turned by the deflection in the plane of a_N (eq. [4])")  # fmt: skip
    ax.plot(
        pulse.time_s, np.rad2deg(biased), color="#0072B2", lw=1.4, ls="--", label="BET less the deflection: aeroshell"
    )
    ax.set(xlim=_window(flight), ylim=(0, 60), ylabel="total angle of attack (deg)", xlabel="time after launch (s)")
    ax.legend(fontsize=8, frameon=False, loc="upper left")
    figure.suptitle("Angle of attack of the aeroshell, both ways (AIAA 2011-2571, Figure 2.7)", fontsize=10)
    stamp(figure, flight.telemetry)
    return figure


def _bet_line(ax: Axes, flight: Reconstruction, label: str) -> None:
    air = flight.air
    alpha, sd = np.rad2deg(air.alpha_total_wind_rad), np.rad2deg(air.alpha_total_wind_sd_rad)
    ax.plot(air.time_s, alpha, color="#0072B2", lw=1.4, label=label)
    ax.fill_between(air.time_s, alpha - sd, alpha + sd, color="#0072B2", alpha=0.2, lw=0)


def _where(mask: BoolArray, angle_rad: FloatArray) -> FloatArray:
    return np.where(mask, np.rad2deg(angle_rad), np.nan)


def _no_answer(ax: Axes, use: BoolArray, inferred: FloatArray, time_s: FloatArray) -> None:
    beyond = use & ~np.isfinite(inferred)
    if beyond.any():
        ax.plot(time_s[beyond], np.full(beyond.sum(), 59.0), "k^", ms=3, label="beyond the look-up (60 deg)")


def draw_histories(
    ax: Axes, histories: dict[str, DeflectionHistory], truth: tuple[FloatArray, FloatArray] | None = None
) -> None:
    """Deflection over time, each method with a band of one standard deviation; truth as (s, deg) where known."""
    for method, history in histories.items():
        theta, sd = np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad)
        many = len(history.time_s) > 400
        ax.plot(history.time_s, theta, LINE[method], color=COLOUR[method], lw=1.2, label=LABEL[method], ms=3,
                marker="" if many else ".")  # fmt: skip
        ax.fill_between(history.time_s, theta - sd, theta + sd, color=COLOUR[method], alpha=0.15, lw=0)
    if truth is not None:
        ax.plot(*truth, color=COLOUR["truth"], lw=0.8, label="truth (synthetic)")


def figure_summary(
    flight: Reconstruction,
    answers: Deflections,
    truth: tuple[FloatArray, FloatArray] | None = None,
    frames: tuple[NDArray[np.uint8], str] | None = None,
) -> Figure:
    """The answer on one page: what the camera saw above, deflection, angles and pressure below.

    Parameters
    ----------
    frames : ((h, w, 3) uint8, str), optional
        Picture to show on top (benchmark and peak frame with overlay), and its caption.
    """
    figure = Figure(figsize=(9.0, 9.0 if frames is not None else 6.4), layout="constrained")
    if frames is not None:
        top, bottom = list(np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.9))))
        picture = top.subplots()
        picture.imshow(frames[0])
        picture.set_title(frames[1], fontsize=8)
        picture.axis("off")
        axes = bottom.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    else:
        axes = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    draw_histories(axes[0], answers.histories, truth)
    axes[0].axvline(flight.peak_s, color="0.5", lw=0.8, ls=":")
    axes[0].set(
        ylabel="deflection of aeroshell\nagainst centerbody (deg)",
        xlim=_window(flight),
        ylim=(0, _top(answers.histories.values())),
    )
    axes[0].legend(fontsize=8, frameon=False, loc="upper left", title="bands: 1 sd; dotted: peak q", title_fontsize=8)
    _bet_line(axes[1], flight, "centerbody total angle of attack, BET")
    axes[1].set(ylabel="angle of attack (deg)", xlabel="time after launch (s)", ylim=(0, 16))
    pressure = axes[1].twinx()
    pressure.plot(flight.air.time_s, flight.air.dynamic_pressure_pa, color="0.6", lw=1)
    pressure.set_ylabel("dynamic pressure (Pa), grey")
    pressure.set_ylim(0, None)
    pressure.spines["top"].set_visible(False)
    axes[1].legend(fontsize=8, frameon=False, loc="upper left")
    figure.suptitle("How far the aeroshell bent, three ways", fontsize=12)
    stamp(figure, flight.telemetry)
    return figure


def _top(histories: Iterable[DeflectionHistory]) -> float:
    largest = [np.nanmax(np.rad2deg(h.theta_rad)) for h in histories if np.isfinite(h.theta_rad).any()]
    return 1.25 * float(max(largest, default=5.0))


def figure_flown(flight: Reconstruction) -> Figure:
    """Altitude, speed and their standard deviations: the picture of a flight without a vehicle to speak of."""
    figure = Figure(figsize=(7.2, 7.0), layout="constrained")
    high, fast, sure = _axes(figure, 3)
    bet, air = flight.solution.smoothed, flight.air
    high.plot(air.time_s, air.altitude_m / 1e3, color="#0072B2", lw=1.4)
    high.set_ylabel("altitude (km)")
    fast.plot(air.time_s, np.linalg.norm(bet.velocity_ecef_mps, axis=1), color="#0072B2", lw=1.4)
    fast.set(ylabel="speed against\nthe ground (m/s)", ylim=(0, None))
    sd = bet.sd()
    for part, colour, label in ((slice(0, 3), "#0072B2", "position (m)"), (slice(3, 6), "#D55E00", "velocity (m/s)")):
        sure.semilogy(air.time_s, np.linalg.norm(sd[:, part], axis=1), color=colour, lw=1.2, label=label)
    sure.set(ylabel="standard deviation", xlabel="time after launch (s)")
    sure.legend(fontsize=8, frameon=False)
    found = [f for f in flight.solution.findings if f.source == "motion"]
    for ax in (high, fast, sure):
        for f in found:
            ax.axvspan(f.start_s, f.end_s, color="#E69F00", alpha=0.3, lw=0)
    extra = "; shaded: accelerations that nothing on board told" if found else ""
    figure.suptitle("The flight as reconstructed" + extra, fontsize=10)
    stamp(figure, flight.telemetry)
    return figure


def residual_unit(component: str) -> tuple[float, str]:
    """Scale and unit in which a component's residuals are drawn."""
    if component.startswith("velocity"):
        return 1.0, "m/s"
    if component.startswith("field"):
        return 1e6, "uT"
    return (1e3, "mrad") if component in ("azimuth", "elevation") else (1.0, "m")


def figure_residuals(flight: Reconstruction) -> Figure:
    """Innovations of each source and component that were tried, with the predicted 3-sd lines; edited points marked."""
    table = flight.solution.residuals
    pairs = list(table[table["used"]].groupby(["source", "component"], sort=False))
    figure = Figure(figsize=(7.2, 1.5 * len(pairs) + 0.8), layout="constrained")
    for ax, (name, rows) in zip(_axes(figure, len(pairs)), pairs, strict=True):
        source, component = name
        scale, unit = residual_unit(component)
        good = rows["accepted"].to_numpy(dtype=bool)
        t, r = rows["time_s"].to_numpy(), scale * rows["residual"].to_numpy()
        sd = scale * rows["predicted_sd"].to_numpy()
        ax.plot(t[good], r[good], ".", ms=1.5 if len(t) > 500 else 3, color="#0072B2")
        limit = 6.0 * float(np.median(sd))
        far = np.clip(r[~good], -0.95 * limit, 0.95 * limit)
        beyond = np.abs(r[~good]) > 0.95 * limit
        ax.plot(t[~good][~beyond], far[~beyond], "x", ms=4, color="#D55E00")
        for sign, arrow in ((1.0, "^"), (-1.0, "v")):
            off = beyond & (far * sign > 0.0)
            ax.plot(t[~good][off], far[off], arrow, ms=4, color="#D55E00")
        if not good.all():
            ax.set_title(
                f"{np.count_nonzero(~good)} of {len(good)} edited", fontsize=7, color="#D55E00", loc="right", pad=2
            )
        for sign in (-3, 3):
            ax.plot(t, sign * sd, color="0.3", lw=0.7)
        ax.set_ylabel(f"{source}\n{component} ({unit})", fontsize=7)
        ax.set_ylim(-limit, limit)
    figure.get_axes()[-1].set_xlabel("time after launch (s)")
    figure.suptitle(
        "Residuals before each update with 3 sd; edited points crossed, arrows where they lie outside", fontsize=10
    )
    stamp(figure, flight.telemetry)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG whose bytes depend on the picture alone."""
    figure.savefig(path, dpi=110, metadata={"Software": None})
