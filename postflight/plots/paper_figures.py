"""Figures in the manner of the seed paper (AIAA 2011-2571), by its own numbers, of the flight at hand.

=====  ==========================================================================================
1.3    angle of attack and normal acceleration against the bounds of a rigid vehicle
2.3    onboard frames with the virtual camera laid over
2.5    angle of attack by the trajectory and by uncorrected accelerometers
2.7    the same with the accelerometers rotated by the estimated deflection
2.9    static trim angle over joint stiffness
=====  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.camera_fit import OrientedCamera
from estimators.loads import FlightLoads
from estimators.misalignment import aerodynamic_angle, aeroshell_acceleration, psi_from_acceleration
from estimators.trim import static_trim
from flightmodel.airdata import AirData, pressure_pulse
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.geometry import BodyMesh
from flightmodel.trajectory import interpolate_rows
from flightmodel.vehicle import Vehicle
from postflight.deflections import Deflections
from postflight.flight import Flight
from postflight.plots.overlay import deflection_at, oriented_camera
from postflight.plots.style import COLOUR, MANY, TIME, band, in_style, legend_above, note, titled
from postflight.plots.subject import (
    Drawable,
    bet_of,
    film_of,
    flow_of,
    history_of,
    loads_of,
    reconstruction_of,
    time_label,
    words_of,
)
from postflight.reconstruction import Reconstruction
from postflight.runs import Run
from postflight.studies.preflight import Bounds, bounds_of, entry_bounds

_LOOK_UP_END_DEG = 60.0  # of the coefficient tables, where the paper's axis ends too


def window(air: AirData | FlightLoads) -> tuple[float, float]:
    """Times shown, s: from 80 km or so to well after the pressure pulse."""
    pulse = air.time_s[pressure_pulse(air.dynamic_pressure_pa)]
    width = pulse[-1] - pulse[0]
    first, last = pulse[0] - 0.75 * width, pulse[-1] + 0.5 * width
    return float(max(first, air.time_s[0])), float(min(last, air.time_s[-1]))


def trajectory_angle(ax: Axes, air: AirData | FlightLoads, label: str) -> None:
    """Draw the trajectory's total angle of attack with its standard deviation."""
    alpha, sd = np.rad2deg(air.alpha_total_wind_rad), np.rad2deg(air.alpha_total_wind_sd_rad)
    ax.plot(air.time_s, alpha, color=COLOUR["estimate"], lw=1.4, label=label)
    band(ax, air.time_s, alpha, sd, COLOUR["estimate"])


def fit_height(
    ax: Axes, air: AirData | FlightLoads, most: float = 180.0, of: tuple[str, ...] = ("",), room: float = 1.15
) -> None:
    """Fit the top of an angle axis, deg, to the visible part of lines whose labels start with ``of``."""
    first, last = window(air)
    lines = [
        np.asarray(line.get_xydata(), dtype=np.float64) for line in ax.lines if str(line.get_label()).startswith(of)
    ]
    shown = [xy[(xy[:, 0] >= first) & (xy[:, 0] <= last), 1] for xy in lines]
    top = room * max((float(np.nanmax(y)) for y in shown if np.isfinite(y).any()), default=most)
    ax.set_ylim(0.0, min(top, most))


@in_style
def figure_1_3(flown: Drawable, bounds: Bounds | None = None, flights: int = 100) -> Figure:
    """Total angle of attack and normal acceleration against a rigid vehicle's Monte Carlo bounds (Figure 1.3).

    Parameters
    ----------
    flown : Reconstruction, Run or Deflections
        With ``bounds`` also FlightLoads.
    bounds : Bounds, optional
        Those of a run are its own. Otherwise the rigid vehicle is simulated ``flights`` times from the flight's state.
    flights : int

    Raises
    ------
    GateError
        Where there are no loads, or no trajectory to simulate from.
    """
    if bounds is None:
        bounds = _bounds(flown, flights)
    figure = Figure(figsize=(7.2, 7.0))
    upper, lower = figure.subplots(2, 1, sharex=True)
    air, pulse = flow_of("figure_1_3", flown), loads_of("figure_1_3", flown)
    for ax, (bound, nominal) in zip((upper, lower), bounds.by_quantity.values(), strict=True):
        share = f"2.3 to 97.7 % of {bounds.flights} rigid flights"
        ax.fill_between(bounds.time_s, bound[0], bound[2], color=COLOUR["prior_band"], lw=0, label=share)
        ax.plot(bounds.time_s, bound[1], color=COLOUR["prior"], lw=1, label="rigid, 50 %")
        ax.plot(bounds.time_s, nominal, color=COLOUR["limit"], lw=1, ls=":", label="rigid, nominal")
    trajectory_angle(upper, air, "trajectory, wind-relative, 1 sd")
    if isinstance(air, AirData):
        ground = np.rad2deg(air.alpha_total_ground_rad)
        upper.plot(air.time_s, ground, color=COLOUR["ground"], lw=1, ls="--", label="trajectory, no wind")
    normal = np.hypot(*pulse.specific_force_body_mps2[:, 1:].T) / STANDARD_GRAVITY_MPS2
    lower.plot(pulse.time_s, normal, color=COLOUR["estimate"], lw=1.4, label="measured, at the c.g.")
    upper.set(ylabel="total angle of attack (deg)", xlim=window(air))
    fit_height(upper, air, of=("trajectory",), room=1.5)  # a rigid vehicle may tumble: its band ends with the axis
    lower.set(ylabel="normal acceleration (g)", ylim=(0, None), xlabel=TIME)
    legend_above(upper, 3)
    legend_above(lower, 4)
    title = "Flight against a rigid vehicle (in the manner of AIAA 2011-2571, Figure 1.3)"
    return titled(figure, title, words_of(flown))


def _bounds(flown: Drawable, flights: int) -> Bounds:
    """Bounds of the rigid vehicle: those that a run stored, else simulated."""
    bet = bet_of("figure_1_3 without bounds", flown)
    if isinstance(bet, Run) and "rigid_bounds" in bet.tables:
        return bounds_of(bet.tables["rigid_bounds"])
    return entry_bounds(reconstruction_of("figure_1_3", flown, "rigid_bounds.csv"), None, flights)


@in_style
def figure_2_3(
    flown: Flight | Reconstruction | Run | Deflections,
    history: DeflectionHistory | None = None,
    camera: str | None = None,
) -> Figure:
    """Benchmark frame and frame of the largest deflection, the virtual camera over the right part of each (Figure 2.3).

    The dashed yellow line is the smallest row of the virtual camera's edge, the solid one that of the edge found near
    it in the frame (beyond may be the Earth's limb). Where they coincide the deflection fits.

    Parameters
    ----------
    flown : Deflections or Run
        With a ``history`` also Flight or Reconstruction.
    history : DeflectionHistory, optional
        The camera's; that of the answers without.
    camera : str, optional
        Name of one of several cameras; the first without.

    Raises
    ------
    GateError
        Where there is no answer of the camera, or no film.
    """
    telemetry, own = film_of("figure_2_3", flown, history, camera)
    oriented, benchmark = oriented_camera(telemetry, own)
    frames, pick = telemetry.frames, [benchmark, own.largest()]
    assert frames is not None
    times = [float(t) for t in frames.time_s[pick]]
    theta, plane = zip(*(deflection_at(own, t) for t in times), strict=True)
    meshes = telemetry.required_vehicle().meshes
    figure = frames_with_camera(oriented, [frames.picture(k) for k in pick], times, theta, plane, meshes)
    note(figure, words_of(flown))
    return figure


def frames_with_camera(
    oriented: OrientedCamera,
    frames: Sequence[NDArray[np.uint8]],
    times_s: Sequence[float],
    theta_rad: Sequence[float],
    plane_lv_rad: Sequence[float],
    meshes: Mapping[str, BodyMesh] | None = None,
) -> Figure:
    """Frames side by side, the virtual camera over the right part of each, as `figure_2_3` has two.

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
    from estimators.frame_edits import unedited
    from estimators.overlay import Overlay
    from estimators.virtual_camera import deformation_of

    height, width = np.shape(frames[0])[:2]
    figure = Figure(figsize=(6.0 * len(frames), 6.0 * height / width + 0.65))
    axes = np.atleast_1d(figure.subplots(1, len(frames)))
    view, overlay = oriented.view, Overlay(oriented.view, meshes or {})
    for k, ax in enumerate(axes):
        theta, plane = float(theta_rad[k]), float(plane_lv_rad[k])
        ax.imshow(overlay.blended(np.asarray(frames[k]), theta, plane), interpolation="nearest")
        hypothesis = deformation_of(theta, plane)
        lines = view.lines_at(oriented.clocks_rad, hypothesis)
        if len(lines.origin_px):  # else the edge is out of the picture
            ax.axhline(lines.origin_px[:, 1].min(), color=COLOUR["edge"], ls="--", lw=1.0)
        found = oriented.coherent_edge(unedited(np.asarray(frames[k])), hypothesis)
        if np.isfinite(found.lowest_row_px):
            ax.axhline(found.lowest_row_px, color=COLOUR["edge"], lw=1.4)
        answer = f"{np.rad2deg(theta):.1f} deg in plane {np.rad2deg(plane):.0f} deg LV" if theta else "taken as zero"
        ax.set_title(f"({chr(97 + k)}) {times_s[k]:.2f} s: deflection {answer}")
        ax.set_axis_off()
    return figure


@in_style
def figure_2_5(flown: Drawable) -> Figure:
    """Angle of attack by the trajectory and inferred from the uncorrected accelerometers (Figure 2.5).

    Parameters
    ----------
    flown : Reconstruction, Run, FlightLoads or Deflections

    Raises
    ------
    GateError
        Where there are no loads.
    """
    figure = Figure(figsize=(7.2, 4.2))
    ax = figure.subplots()
    pulse, air = loads_of("figure_2_5", flown), flow_of("figure_2_5", flown)
    trajectory_angle(ax, air, "centerbody by the trajectory, 1 sd")
    use = pulse.informative
    inferred = aerodynamic_angle(pulse.vehicle.aero, pulse.mach, pulse.specific_force_body_mps2)
    _look_up(ax, pulse.time_s, use, inferred, COLOUR["measured"], "C_N/C_A look-up, accelerometers uncorrected")
    beyond = use & ~np.isfinite(inferred)
    if beyond.any():
        edge = np.full(beyond.sum(), _LOOK_UP_END_DEG - 1.0)
        label = f"beyond the look-up ({_LOOK_UP_END_DEG:.0f} deg)"
        ax.plot(pulse.time_s[beyond], edge, "^", ms=3, color=COLOUR["measured"], label=label)
    _angles(ax, air)
    title = "Angle of attack: trajectory against uncorrected accelerometers (AIAA 2011-2571, Figure 2.5)"
    return titled(figure, title, words_of(flown))


@in_style
def figure_2_7(flown: Drawable, history: DeflectionHistory | None = None) -> Figure:
    """Figure 2.5 with the accelerometers rotated by the estimated deflection, and the trajectory less it (Figure 2.7).

    Parameters
    ----------
    flown : Deflections or Run
        With a ``history`` also Reconstruction or FlightLoads.
    history : DeflectionHistory, optional
        Of any method, interpolated to the times of the loads; that of the misalignment without.

    Raises
    ------
    GateError
        Where there are no loads, or no deflection.
    """
    figure = Figure(figsize=(7.2, 4.2))
    ax = figure.subplots()
    pulse, air = loads_of("figure_2_7", flown), flow_of("figure_2_7", flown)
    use, force, aero = pulse.informative, pulse.specific_force_body_mps2, pulse.vehicle.aero
    theta_yz = _at_loads(history or history_of("figure_2_7", flown, "misalignment"), pulse.time_s)
    size = np.linalg.norm(theta_yz, axis=1)
    raw = aerodynamic_angle(aero, pulse.mach, force)
    rotated = aeroshell_acceleration(force, np.nan_to_num(size), psi_from_acceleration(force))
    corrected = aerodynamic_angle(aero, pulse.mach, rotated)
    biased = np.linalg.norm(pulse.flow_yz_rad - theta_yz, axis=1)
    _look_up(ax, pulse.time_s, use, raw, COLOUR["measured"], "C_N/C_A look-up, accelerometers uncorrected")
    label = "C_N/C_A look-up, rotated by the deflection in the plane of a_N (eq. [4])"
    _look_up(ax, pulse.time_s, use & np.isfinite(size), corrected, COLOUR["corrected"], label)
    label = "trajectory less the deflection: aeroshell"
    ax.plot(pulse.time_s, np.rad2deg(biased), color=COLOUR["estimate"], lw=1.4, ls="--", label=label)
    _angles(ax, air)
    return titled(figure, "Angle of attack of the aeroshell, both ways (AIAA 2011-2571, Figure 2.7)", words_of(flown))


def _at_loads(history: DeflectionHistory, time_s: FloatArray) -> FloatArray:
    """Lateral deflection (m, 2), rad, at other times; NaN outside the answers."""
    known = np.isfinite(history.theta_rad)
    answered = history.time_s[known]
    out = interpolate_rows(time_s, answered, history.theta_yz_rad[known])
    out[(time_s < answered[0]) | (time_s > answered[-1])] = np.nan
    return out


def _look_up(ax: Axes, time_s: FloatArray, use: BoolArray, angle_rad: FloatArray, colour: str, label: str) -> None:
    ax.plot(time_s, np.where(use, np.rad2deg(angle_rad), np.nan), color=colour, label=label)


def _angles(ax: Axes, air: AirData | FlightLoads) -> None:
    ax.set(xlim=window(air), ylabel="total angle of attack (deg)", xlabel=time_label(air))
    fit_height(ax, air, most=_LOOK_UP_END_DEG)
    legend_above(ax, 1)


@in_style
def figure_2_9(flown: Drawable) -> Figure:
    """Trim angle over joint stiffness at peak pressure for several c.g. offsets, with divergence (Figure 2.9).

    Parameters
    ----------
    flown : Reconstruction, Run, FlightLoads or Deflections

    Raises
    ------
    GateError
        Where there are no loads, or the vehicle has no static trim.
    """
    figure = Figure(figsize=(7.2, 4.2))
    ax = figure.subplots()
    pulse = loads_of("figure_2_9", flown)
    vehicle, mach, pressure = _at_peak(pulse)
    static, joint_nmprad = static_trim(vehicle, mach, pressure), vehicle.joint.bending_stiffness_nmprad
    marks = (static.critical_stiffness_nmprad, joint_nmprad, static.stiffness_for_growth(0.25))
    # a joint 20 times as stiff as wanted is shown; a locked one lies beyond the axis
    ends = 0.5 * min(marks), 2.0 * max(marks[2], min(joint_nmprad, 20.0 * marks[2]))
    stiffness = np.geomspace(*ends, 600)
    own = float(np.linalg.norm(vehicle.cg_m[1:]))
    offsets_m = sorted({round(own, 5), 0.01, 0.0254})  # its own, and those of the paper's figure
    for offset, colour in zip(offsets_m, MANY[1:], strict=False):
        angle = np.rad2deg(static.trim_angle(stiffness, offset))
        ax.semilogx(stiffness, angle, color=colour, label=f"{100 * offset:.2f} cm")
    labels = ("divergence", "the vehicle's joint", "25 % growth")
    for at, stroke, label in zip(marks, ("--", "-", ":"), labels, strict=True):
        ax.axvline(at, color=COLOUR["limit"], ls=stroke, lw=1.0, label=label)
    ax.set(xlabel="joint stiffness (N m/rad)", ylabel="trim angle of attack of the aeroshell (deg)")
    ax.set(xlim=ends, ylim=(0.0, 20.0))
    ax.legend(title="initial c.g. offset", loc="upper right", frameon=True, framealpha=0.9)
    title = f"Static trim at {pressure:.0f} Pa, Mach {mach:.1f} (AIAA 2011-2571, Figure 2.9)"
    return titled(figure, title, words_of(flown))


def has_static_trim(loads: FlightLoads) -> bool:
    """Whether the vehicle has a static trim at peak pressure, so that `figure_2_9` can be drawn."""
    try:
        static_trim(*_at_peak(loads))
    except GateError:
        return False
    return True


def _at_peak(loads: FlightLoads) -> tuple[Vehicle, float, float]:
    """Vehicle, Mach number and dynamic pressure, Pa, at the peak of dynamic pressure."""
    k = int(np.argmax(loads.dynamic_pressure_pa))
    return loads.vehicle, float(loads.mach[k]), float(loads.dynamic_pressure_pa[k])
