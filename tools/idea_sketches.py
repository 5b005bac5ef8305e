"""Draws the sketches of docs/idea.md: the reference vehicle's own geometry, angles larger than in flight.

``python tools/idea_sketches.py`` writes ``docs/images/idea/*.svg``. Outline, joint, c.g.s, camera and coefficients
are those of the shipped vehicle file. Answers are the golden numbers of the demo and those that the paper publishes.

In a side view the flow comes from the left and the plane of the drawing is the plane of deflection. Its lower side is
the side towards which the shell's nose tilts, so that the lower rim moves aft (CONVENTIONS.md, "Deflection").
"""

import json
import re
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon, Rectangle

import postflight as pf
from flightmodel.camera import camera_from_mount
from flightmodel.deflection import lv_clock
from flightmodel.geometry import bend, forward_profile, torus_circles, torus_limb
from flightmodel.linear import slopes_at
from postflight.plots.style import COLOUR, in_style, save
from postflight.scoring import PUBLISHED_DEG

ROOT = Path(__file__).parents[1]
VEHICLE = pf.read_vehicle("irve2_reference")
SHELL, BODY = VEHICLE.geometry, VEHICLE.centerbody
JOINT = np.array([-VEHICLE.joint_m[0], 0.0])  # station, height
MACH = 3.1  # at peak dynamic pressure
THETA_DEG, SHELL_ALPHA_DEG = 3.84, 5.2  # means of the entry in docs/paper.md, Figures 2.5 and 2.7
PLANE_LV_DEG, A_N_LV_DEG = 200.0, 20.0  # the paper, section II
EXAGGERATED = 3.0
THETA, ALPHA = EXAGGERATED * THETA_DEG, EXAGGERATED * SHELL_ALPHA_DEG
NEAR = {"bbox": {"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85}}


def ahead(angle_deg):
    """Unit vector that points out of the nose, the angle below the horizontal."""
    return -np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])


def turned(points, angle_deg):
    """Points (n, 2) of the undeflected shell after a deflection about the joint: nose down, lower rim aft."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return (np.asarray(points) - JOINT) @ np.array([[c, s], [-s, c]]) + JOINT


def side_view(ax, theta_deg, body_deg=0.0, pale=False):
    """Draw both bodies from the side; ``body_deg`` turns the centerbody about the joint instead of the shell."""
    face, edge = COLOUR["prior_band"], COLOUR["prior"] if pale else COLOUR["limit"]
    radius, length = SHELL.centerbody_radius_m, SHELL.centerbody_length_m
    box = turned([[0, -radius], [length, -radius], [length, radius], [0, radius]], body_deg)
    ax.add_patch(Polygon(box, closed=True, fc=face, ec=edge, zorder=1))
    profile = forward_profile(SHELL)
    for side in (1.0, -1.0):
        ax.plot(*turned(profile * [1.0, side], theta_deg).T, color=edge, lw=1.5, zorder=2)
        for centre in turned(np.column_stack(torus_circles(SHELL)) * [1.0, side], theta_deg):
            ax.add_patch(Circle(centre, SHELL.torus_minor_radius_m, fc=face, ec=edge, zorder=2))


def canvas(width, height, x, y):
    figure = Figure(figsize=(width, height), layout="none")
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    blank(ax, x, y)
    return figure, ax


def blank(ax, x, y):
    ax.set(xlim=x, ylim=y, aspect="equal")
    ax.axis("off")


def arrow(ax, start, along, colour, lw=2.0):
    style = {"arrowstyle": "-|>", "color": colour, "lw": lw, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 13}
    ax.annotate("", np.add(start, along), start, arrowprops=style, zorder=6)


def says(ax, place, words, colour=COLOUR["truth"], **named):
    ax.text(*place, words, color=colour, zorder=8, **{"fontsize": 9.5, "ha": "center", "va": "center", **NEAR, **named})


def arc(ax, centre, radius, first_deg, last_deg, colour):
    """Arc between two directions ahead, angles below the horizontal."""
    first, last = 180 + first_deg, 180 + last_deg
    ax.add_patch(Arc(centre, 2 * radius, 2 * radius, theta1=first, theta2=last, color=colour, lw=1.8, zorder=5))


def line(ax, start, along, **named):
    ax.plot(*np.stack([start, np.add(start, along)]).T, **{"color": COLOUR["limit"], "lw": 1.0, "zorder": 3, **named})


@in_style
def words():
    """Body, shell, angle of attack, deflection, normal acceleration."""
    figure, ax = canvas(8.0, 5.0, (-3.05, 2.95), (-1.85, 1.9))
    side_view(ax, THETA)
    whole = THETA + ALPHA
    line(ax, JOINT, 2.55 * ahead(0), ls="-.")
    line(ax, JOINT, 2.35 * ahead(THETA), ls="--", color=COLOUR["fused"])
    arrow(ax, JOINT, 2.35 * ahead(whole), COLOUR["estimate"])
    arc(ax, JOINT, 2.05, 0.0, THETA, COLOUR["fused"])
    arc(ax, JOINT, 1.75, THETA, whole, COLOUR["corrected"])
    arc(ax, JOINT, 1.15, 0.0, whole, COLOUR["estimate"])
    says(ax, (-2.0, 0.13), "axis of the centerbody")
    says(ax, JOINT + 2.05 * ahead(THETA / 2) - [0.36, 0], "deflection θ", COLOUR["fused"])
    says(
        ax, JOINT + 1.75 * ahead(THETA + ALPHA / 2) - [0.5, 0.03], "angle of attack\nof the shell", COLOUR["corrected"]
    )
    named(ax, JOINT + 1.15 * ahead(0.2 * whole), (-0.9, 0.5), "angle of attack α")
    ax.texts[-1].set_color(COLOUR["estimate"])
    says(ax, JOINT + 2.35 * ahead(whole) + [0.1, -0.16], "velocity through the air", COLOUR["estimate"])
    place = np.array([-VEHICLE.sensors["suba"].position_from_datum_body_m[0], 0.0])
    a_n = np.array([0.0, 0.62])
    arrow(ax, place, a_n, COLOUR["misalignment"])
    arrow(ax, place, [1.25, 0.0], COLOUR["misalignment"])
    ax.plot(*place, "s", color=COLOUR["misalignment"], ms=6, zorder=7)
    says(ax, place + a_n + [0.06, 0.02], "normal acceleration", COLOUR["misalignment"], ha="left")
    says(ax, np.add(place, [1.3, 0.0]), "deceleration", COLOUR["misalignment"], ha="left")
    ax.plot(*JOINT, "D", color=COLOUR["truth"], ms=6, zorder=7)
    named(ax, (1.35, -0.16), (1.75, -0.62), "centerbody (rigid): cameras,\naccelerometers, gyros")
    named(ax, turned([[0.82, 1.36]], THETA)[0], (1.3, 1.32), "aeroshell (inflated)")
    named(ax, JOINT, (0.98, -0.36), "joint")
    named(ax, turned([[0.84, -1.45]], THETA)[0] + [0.04, 0], (1.95, -1.45), "the rim moves aft on this side")
    return figure


def named(ax, place, words_at, text):
    ax.annotate(text, place, words_at, fontsize=9.5, ha="center", va="center", zorder=8, **NEAR,
                arrowprops={"arrowstyle": "-", "color": COLOUR["limit"], "lw": 0.8, "shrinkB": 1})  # fmt: skip


@in_style
def plane():
    """The vehicle from behind with the plane of deflection and what else has a clocking angle."""
    figure, ax = canvas(6.2, 4.6, (-2.95, 2.95), (-2.15, 2.23))
    _, radius = torus_circles(SHELL)
    for r in [*(radius - SHELL.torus_minor_radius_m), radius[-1] + SHELL.torus_minor_radius_m]:
        ax.add_patch(Circle((0, 0), r, fc="none", ec=COLOUR["prior"], lw=0.8))
    ax.add_patch(Circle((0, 0), SHELL.centerbody_radius_m, fc=COLOUR["prior_band"], ec=COLOUR["limit"], zorder=3))
    for angle in (0, 90, 180, 270):
        says(ax, 1.72 * clocked(angle), f"{angle}°", COLOUR["limit"], fontsize=8.5)
    (camera, *_) = [mount for name, mount in VEHICLE.cameras.items() if name == "camera5"]
    offset = np.rad2deg(lv_clock(VEHICLE.cg_m[1:])) % 360.0
    line(ax, 1.6 * clocked(PLANE_LV_DEG), -3.2 * clocked(PLANE_LV_DEG), color=COLOUR["fused"], lw=2.0, ls="--")
    arrow(ax, (0, 0), 1.15 * clocked(A_N_LV_DEG), COLOUR["misalignment"])
    line(ax, (0, 0), 1.3 * clocked(offset), color=COLOUR["corrected"], lw=1.5)
    ax.plot(*(0.62 * clocked(camera.clock_lv_deg)), "s", color=COLOUR["camera"], ms=7, zorder=6)
    line(ax, (0, 0), 1.3 * clocked(camera.clock_lv_deg), color=COLOUR["camera"], lw=1.5)
    spots = (
        (1.45 * clocked(PLANE_LV_DEG), (2.05, -1.72), f"plane of deflection {PLANE_LV_DEG:.0f}°:\nthe rim moves aft",
         "fused"),
        (1.0 * clocked(A_N_LV_DEG), (-2.1, 1.75), f"normal acceleration {A_N_LV_DEG:.0f}°", "misalignment"),
        (1.2 * clocked(offset), (0.75, -1.98), f"c.g. offset {offset:.0f}°", "corrected"),
        (1.15 * clocked(camera.clock_lv_deg), (-2.1, -1.62), f"camera {camera.clock_lv_deg:.0f}°", "camera"),
    )  # fmt: skip
    for place, at, text, colour in spots:
        named(ax, place, at, text)
        ax.texts[-1].set_color(COLOUR[colour])
    says(ax, (2.1, 1.9), "seen from behind,\nclocking angles (LV)", COLOUR["limit"])
    return figure


def clocked(angle_deg):
    """Unit vector of a clocking angle seen from behind: 0 up, 90 left."""
    return np.array([-np.sin(np.deg2rad(angle_deg)), np.cos(np.deg2rad(angle_deg))])


@in_style
def camera():
    """A camera on the centerbody, and the shell's edge in its picture without and with deflection."""
    figure = Figure(figsize=(8.0, 3.2), layout="none")
    ax = figure.add_axes((0.0, 0.0, 0.46, 1.0))
    blank(ax, (-0.45, 2.25), (-1.72, 1.9))
    side_view(ax, THETA)
    mount = VEHICLE.cameras["camera5"]
    lens = np.array([mount.station_m, -mount.radius_m])
    lean = np.deg2rad(mount.axis_from_forward_deg)
    for off, style in ((0.0, "-"), (-0.36, ":"), (0.36, ":")):
        line(ax, lens, 1.15 * np.array([-np.cos(lean + off), -np.sin(lean + off)]), color=COLOUR["camera"], ls=style)
    ax.plot(*lens, "s", color=COLOUR["camera"], ms=7, zorder=7)
    says(ax, np.add(lens, [0.2, -0.2]), "camera", COLOUR["camera"])
    named(ax, turned([[0.79, -1.36]], THETA)[0], (0.05, -1.45), "the rim has moved\ntowards the camera")
    view = camera_from_mount(mount)
    clocks = np.deg2rad(mount.clock_lv_deg + np.linspace(-80.0, 80.0, 161))
    eye = view.position_body_m
    edges = {}
    for theta in (0.0, THETA):
        back = bend(eye, -np.deg2rad(theta), np.deg2rad(mount.clock_lv_deg), -VEHICLE.joint_m[0])
        points = bend(
            torus_limb(SHELL, back, clocks), np.deg2rad(theta), np.deg2rad(mount.clock_lv_deg), -VEHICLE.joint_m[0]
        )
        edges[theta] = view.project(points)
    for place, theta, title in ((0.48, 0.0, "benchmark frame, no load"), (0.74, THETA, "frame under load")):
        ax = figure.add_axes((place, 0.2, 0.24, 0.6))
        frame(ax, mount, edges, theta)
        ax.set_title(title, fontsize=9.5)
    return figure


def frame(ax, mount, edges, theta):
    """One picture: sky above the edge, shell below it, and of a deflected shell the benchmark's edge."""
    ax.set(xlim=(0, mount.width_px), ylim=(mount.height_px, 0), aspect="equal", xticks=[], yticks=[])
    ax.grid(visible=False)
    ax.add_patch(Rectangle((0, 0), mount.width_px, mount.height_px, fc="#E9EEF3", ec="none"))
    below = [[mount.width_px + 400, mount.height_px + 400], [-400, mount.height_px + 400]]
    edge = edges[theta][np.argsort(edges[theta][:, 0])]
    ax.add_patch(Polygon(np.concatenate([edge, below]), fc=COLOUR["prior_band"], ec="none"))
    ax.plot(*edge.T, color=COLOUR["camera"], lw=2)
    if theta:
        ax.plot(*edges[0.0].T, color=COLOUR["limit"], lw=1.2, ls="--")
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)


@in_style
def misalignment():
    """The force turns with the shell: its tilt is the deflection, and what the coefficients explain."""
    figure, ax = canvas(8.0, 3.5, (-0.75, 3.55), (-0.9, 0.98))
    side_view(ax, THETA, pale=True)
    slope = np.rad2deg(force_ratio() * np.deg2rad(ALPHA))
    start = np.array([-VEHICLE.sensors["suba"].position_from_datum_body_m[0], 0.0])
    line(ax, start, [2.0, 0.0], ls="-.")
    line(ax, start, -2.0 * ahead(THETA), ls="--", color=COLOUR["fused"])
    arrow(ax, start, -2.0 * ahead(THETA + slope), COLOUR["misalignment"], lw=2.4)
    ax.plot(*start, "s", color=COLOUR["misalignment"], ms=7, zorder=7)
    for radius, first, last, colour in ((1.3, 0.0, THETA, "fused"), (1.75, THETA, THETA + slope, "corrected")):
        ax.add_patch(
            Arc(start, 2 * radius, 2 * radius, theta1=first, theta2=last, color=COLOUR[colour], lw=2, zorder=5)
        )
    named(ax, start, (1.15, -0.55), "accelerometer")
    says(ax, (2.95, 0.0), "axis of the\ncenterbody", ha="left")
    says(ax, start - 2.0 * ahead(THETA) + [0.04, -0.06], "axis of\nthe shell", COLOUR["fused"], ha="left", va="center")
    says(ax, (1.65, 0.42), "measured force", COLOUR["misalignment"])
    says(ax, start - 1.3 * ahead(0.45 * THETA) + [0.05, 0.0], "deflection θ", COLOUR["fused"], ha="left")
    named(ax, start - 1.75 * ahead(THETA + 0.5 * slope), (2.72, 0.78), "explained by C_N / C_A")
    ax.texts[-1].set_color(COLOUR["corrected"])
    return figure


def force_ratio():
    """Slope of C_N / C_A with the shell's angle of attack, 1/rad."""
    (slopes,) = slopes_at(VEHICLE, np.array([MACH]))
    return slopes.cn_alpha / slopes.ca


@in_style
def trim():
    """The deflection moves the c.g. off the shell's axis, and the vehicle trims where the force passes through it."""
    figure, ax = canvas(8.0, 3.6, (-1.35, 2.95), (-1.05, 0.88))
    side_view(ax, 0.0, body_deg=-THETA, pale=True)
    start = -BODY.cg_m[0] * np.array([1.0, 0.0]) - [0.0, EXAGGERATED * np.hypot(*BODY.cg_m[1:])]
    (body,) = turned([start], -THETA)
    shell = np.array([-VEHICLE.aeroshell.cg_m[0], 0.0])
    cg = (BODY.mass_kg * body + VEHICLE.aeroshell.mass_kg * shell) / VEHICLE.mass_kg
    centre = np.array([cg[0] - cg[1] / np.tan(force_ratio() * np.deg2rad(ALPHA)), 0.0])
    line(ax, (-1.1, 0.0), [3.9, 0.0], ls="--", color=COLOUR["fused"])
    line(ax, cg, 1.0 * (centre - cg), color=COLOUR["misalignment"], lw=1.2, ls=":")
    arrow(ax, cg, 0.62 * (centre - cg), COLOUR["misalignment"], lw=2.4)
    arrow(ax, JOINT, 1.2 * ahead(ALPHA), COLOUR["estimate"])
    arc(ax, JOINT, 0.95, 0.0, ALPHA, COLOUR["corrected"])
    ax.plot(*centre, "X", color=COLOUR["corrected"], ms=9, mec="white", zorder=7)
    ax.plot(*cg, "o", color=COLOUR["truth"], ms=6, zorder=7)
    says(ax, JOINT + 0.95 * ahead(ALPHA / 2) - [0.28, 0.0], "trim angle", COLOUR["corrected"])
    says(ax, JOINT + 1.2 * ahead(ALPHA) + [0.02, -0.14], "velocity", COLOUR["estimate"])
    named(ax, cg, (1.15, -0.72), "c.g. of the vehicle,\noff the axis of the shell")
    named(ax, cg + 0.5 * (centre - cg), (1.62, 0.42), "the force passes through the c.g.")
    named(ax, centre, (2.3, -0.42), "centre of pressure")
    says(ax, (2.52, 0.12), "axis of the shell", COLOUR["fused"])
    return figure


@in_style
def agreement():
    """Three methods and their fusion, of the paper's flight and of the demo, whose truth is known."""
    stored = json.loads((ROOT / "benchmarks/golden/irve2_reference.json").read_text())["run/summary"]["columns"]
    _, published = PUBLISHED_DEG["irve2_reference"]
    figure = Figure(figsize=(7.0, 2.9), layout="constrained")
    ax = figure.subplots()
    methods = ("camera", "misalignment", "trim", "fused")
    truth = float(re.search(r"│ fused +│[^│]*│[^│]*│ +([\d.]+)", (ROOT / "README.md").read_text())[1])
    for row, method in enumerate(methods):
        value, sd = (stored[f"methods.{method}.{name}"][0] for name in ("deflection_deg", "sd_deg"))
        ax.errorbar(value, row, xerr=sd, fmt="o", color=COLOUR[method], ms=6, capsize=4, lw=1.8)
        if method in published:
            ax.plot(published[method], row, "D", color=COLOUR["paper"], ms=6, mfc="white")
    ax.plot([truth, truth], [-0.5, 3.5], color=COLOUR["truth"], lw=1.0, ls="--")
    ax.text(truth, -0.72, "truth of the demo", ha="center", va="center", fontsize=8.5)
    ax.plot([], [], "D", color=COLOUR["paper"], mfc="white", label="IRVE-II, as published (no error bars)")
    ax.errorbar([], [], xerr=[], fmt="o", color=COLOUR["limit"], capsize=4, label="the demo's synthetic flight, ± 1 sd")
    ax.set(yticks=range(4), yticklabels=methods, xlim=(0.0, 6.0), ylim=(3.5, -1.0), xlabel="deflection at peak q (deg)")
    ax.legend(loc="center left", bbox_to_anchor=(0.01, 0.5))
    return figure


def main():
    folder = ROOT / "docs/images/idea"
    folder.mkdir(parents=True, exist_ok=True)
    for draw in (words, plane, camera, misalignment, trim, agreement):
        save(draw(), folder / f"{draw.__name__}.svg")


if __name__ == "__main__":
    main()
