"""Writes the inputs of examples/loads_table and examples/film_alone, from synthetic flights of examples/own_vehicle.

The table is a trajectory of one flight in the layout of another program; the pictures are rendered frames of the same
vehicle with a known deflection. The examples' README files are written by hand.
"""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pandas as pd

import postflight as pf
from synthetic_flight.film import Imaging, render_video

EXAMPLES = Path(__file__).parents[1] / "examples"
FOOT, PSF, G = 0.3048, 47.88026, 9.80665
# more deflection than examples/own_vehicle has: a softer joint, and a c.g. farther off the axis
SOFTER = (
    ("bending_stiffness_nmprad = 2500.0", "bending_stiffness_nmprad = 1200.0"),
    ("cg_from_datum_body_m = [-0.32, 0.002, -0.001]", "cg_from_datum_body_m = [-0.32, 0.012, -0.006]"),
)
CAMERA = """
[cameras.aft]
clock_lv_deg = 153.0
station_m = 0.95                  # on the axis, aft of the nose
radius_m = 0.15
axis_from_forward_deg = 42.0      # optical axis from body +x, tilted outward in the clocking plane
width_px = 360
height_px = 240
focal_px = [155.0, 155.0]
centre_px = [180.4, 119.3]
distortion = [-0.012, 0.004, -0.0015, 0.0002]
"""
FRAMES = {  # file: time s, deflection deg, its plane LV deg
    "frame_0.png": (40.0, 0.0, 0.0),
    "frame_1.png": (44.0, 1.5, 150.0),
    "frame_2.png": (46.0, 3.0, 170.0),
    "frame_3.png": (48.0, 2.0, 190.0),
}


def main():
    write_table(EXAMPLES / "loads_table")
    write_film(EXAMPLES / "film_alone")


def vehicle_text():
    """Vehicle of examples/own_vehicle with a softer joint and its c.g. farther off the axis."""
    text = (EXAMPLES / "own_vehicle" / "vehicle.toml").read_text()
    for old, new in SOFTER:
        assert old in text
        text = text.replace(old, new)
    return text


def write_table(folder):
    """Every second row of one flight's pressure pulse, as another trajectory program would write it."""
    (folder / "vehicle.toml").write_text(vehicle_text())
    with TemporaryDirectory() as place:
        shutil.copy(folder / "vehicle.toml", place)
        shutil.copy(EXAMPLES / "own_vehicle" / "scenario.toml", place)
        pf.simulate(Path(place) / "scenario.toml", Path(place) / "flight", seed=3)
        bet = pf.reconstruct(pf.read_flight(Path(place) / "flight"))
        table = bet.to_frame()
        truth = pd.read_csv(Path(place) / "flight" / "truth" / "deflection.csv")
    print("true deflection at peak q:", np.interp(bet.peak_s, truth.t_s, truth.theta_deg), "deg at", bet.peak_s, "s")
    pulse = table[table.dynamic_pressure_pa > 0.2 * table.dynamic_pressure_pa.max()].iloc[::2]
    out = {"TIME (s)": pulse.t_s.round(3)}
    out |= {f"A{axis.upper()} (g)": (pulse[f"a{axis}_cg_mps2"] / G).round(5) for axis in "xyz"}
    out |= {f"{axis.upper()} (deg/s)": pulse[f"{axis}_body_degps"].round(3) for axis in "pqr"}
    out |= {"MACH": pulse.mach.round(4), "QBAR (psf)": (pulse.dynamic_pressure_pa / PSF).round(4)}
    out |= {"ALPHA (deg)": pulse.alpha_deg.round(3), "BETA (deg)": pulse.beta_deg.round(3)}
    out |= {"ALT (kft)": (pulse.alt_m / (1e3 * FOOT)).round(4), "VTAS (ft/s)": (pulse.airspeed_mps / FOOT).round(2)}
    pd.DataFrame(out).to_csv(folder / "bet.csv", index=False, lineterminator="\n")


def write_film(folder):
    """Some frames with a known deflection, their times, and the vehicle with a camera."""
    text = vehicle_text()
    text = text.replace(
        "gore_count = 12\n", 'gore_count = 12\nfeatures = "drawn"               # dark seams and dots\n'
    )
    (folder / "vehicle.toml").write_text(text + CAMERA)
    vehicle = pf.read_vehicle(folder / "vehicle.toml")
    times, theta, plane = np.array(list(FRAMES.values())).T
    sun = np.tile([-0.5, 0.6, 0.62], (len(times), 1)) / np.linalg.norm([-0.5, 0.6, 0.62])
    geometry, mount, joint_m = vehicle.geometry, vehicle.cameras["aft"], vehicle.joint.station_m
    turns, rng = (np.deg2rad(theta), np.deg2rad(plane)), np.random.default_rng(4)
    (folder / "pictures").mkdir(exist_ok=True)
    film = render_video(geometry, mount, joint_m, *turns, sun, rng, Imaging(noise_sd=1.0))
    for name, picture in zip(FRAMES, film, strict=True):
        cv2.imwrite(str(folder / "pictures" / name), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    lines = [f"{time_s:.1f},{name}" for name, time_s in zip(FRAMES, times, strict=True)]
    (folder / "frames.csv").write_text("\n".join(["t_s,frame", *lines, ""]))


if __name__ == "__main__":
    main()
