"""Errors of the virtual camera on another renderer's films, over the pressure pulse, and whether its sd cover them.

    python benchmarks/video_footage.py FLIGHT FILM [FILM ...] [--features drawn|texture|none]

FLIGHT: a synthetic flight of the reference vehicle (`postflight simulate irve2_reference`), whose motion was filmed.
FILM: a folder with ``film.avi`` or ``film.mp4``, ``frames.csv`` (t_s, frame) and ``truth.csv`` (t_s, theta_deg,
plane_lv_deg), by the vehicle's camera 5. Every film is laid into a flight folder and read as ``postflight deflection
FOLDER --method camera`` does: by itself, and with the flight's telemetry, whose inertial sensors tell the benchmark
frame's deflection. ``--features``: what the vehicle file states of the shell's paint.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
from rich.progress import track

from flightmodel.vehicle import vehicle_path

PULSE_S = (433.0, 447.0)


def laid_out(flight: Path, film: Path, folder: Path, features: str, with_telemetry: bool) -> None:
    """Write a flight folder with another film, with or without the flight's telemetry."""
    shutil.copytree(flight / "telemetry", folder / "telemetry", ignore=shutil.ignore_patterns("*.png"))
    video = next(path for path in sorted(film.glob("film.*")) if path.suffix in (".avi", ".mp4"))
    for source in (video, film / "frames.csv"):
        shutil.copy(source, folder / "telemetry" / source.name)
    text = (flight / "flight.toml").read_text()
    stated = tomllib.loads(text)["vehicle"]
    source = flight / stated if (flight / stated).exists() else vehicle_path(stated)
    if source.parent != vehicle_path("irve2_reference").parent:
        shutil.copytree(source.parent, folder, dirs_exist_ok=True)
    vehicle = source.read_text().replace('features = "drawn"', f'features = "{features}"')
    (folder / "vehicle.toml").write_text(vehicle)
    text = text.replace(f'vehicle = "{stated}"', 'vehicle = "vehicle.toml"')
    text = text.replace('folder = "telemetry/camera5"', f'film = "telemetry/{video.name}"')
    if not with_telemetry:
        head, film_table = text[: text.index("\n[")], text[text.index("[frames]") :]
        text = head + "\n" + film_table[: film_table.index("\n[")]
    (folder / "flight.toml").write_text(text)


def read_film(flight: Path, film: Path, features: str, with_telemetry: bool) -> pd.DataFrame | str:
    """What became of every frame, or the refusal of the film."""
    with tempfile.TemporaryDirectory() as root:
        laid_out(flight, film, Path(root), features, with_telemetry)
        command = [sys.executable, "-m", "postflight", "deflection", root, "--method", "camera"]
        done = subprocess.run(command, capture_output=True, text=True)
        tables = sorted(Path(root).glob("runs/*/camera_frames.csv"))
        return pd.read_csv(tables[-1]) if tables else done.stderr[-300:]


def errors(frames: pd.DataFrame, film: Path) -> np.ndarray:
    """Error and sd (n, 2) of the angle, deg, of the pulse's answered frames."""
    truth = pd.read_csv(film / "truth.csv")
    used = frames[(frames.flag == "used") & frames.t_s.between(*PULSE_S)]
    error = used.theta_deg - np.interp(used.t_s, truth.t_s, truth.theta_deg)
    return np.column_stack([error, used.theta_sd_deg])


def report(name: str, table: np.ndarray) -> None:
    """Print rms error and sd, and how the sd cover the errors."""
    error, sd = table.T
    z = error / sd
    print(f"{name}: {len(error)} frames, rms {np.sqrt(np.mean(error**2)):.3f} deg, stated "
          f"{np.sqrt(np.mean(sd**2)):.3f}; error over sd: rms {np.sqrt(np.mean(z**2)):.2f}, largest "
          f"{np.abs(z).max():.1f}, {np.sum(np.abs(z) > 3.0)} beyond 3")  # fmt: skip


def main() -> None:
    """Read every film twice, print a line a film and the whole."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flight", type=Path)
    parser.add_argument("films", type=Path, nargs="+")
    parser.add_argument("--features", choices=["drawn", "texture", "none"], default="texture")
    chosen = parser.parse_args()
    for with_telemetry in (False, True):
        kept, kind = [], "with inertial sensors" if with_telemetry else "film alone"
        for film in track(chosen.films, description=kind):
            frames = read_film(chosen.flight, film, chosen.features, with_telemetry)
            if isinstance(frames, str):
                print(f"{film.name}, {kind}: refused: {frames}")
                continue
            refused = frames.code[frames.flag != "used"].value_counts().to_dict()
            answered = errors(frames, film)
            if not len(answered):
                print(f"{film.name}, {kind}: no frame of the pulse answered, refused {refused}")
                continue
            kept.append(answered)
            report(f"{film.name}, {kind}, refused {refused}", answered)
        if kept:
            report(f"all, {kind}", np.concatenate(kept))


if __name__ == "__main__":
    main()
