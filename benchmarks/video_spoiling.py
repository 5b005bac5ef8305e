"""Spoilt films: is a film that cannot be read refused, or answered wrongly with a small standard deviation?

    python benchmarks/video_spoiling.py [films] [--seed S] [--only KIND ...] [--kinds shaped|held-back|all|none|two]
                                        [--footage FOLDER ...] [--first NUMBER] [--listed]

Every film is spoilt at random (`spoilings.py`), laid into a flight folder and read as ``postflight deflection FLIGHT
--method camera`` reads it. Its own footage is the synthetic film's: 12 frames, one a second, drawn features or the edge
alone, with or without the Earth, clean or degraded. ``--footage``: folders of another renderer with ``film.avi`` or
``film.mp4``, ``frames.csv`` (t_s, frame) and ``truth.csv`` (t_s, theta_deg, plane_lv_deg), filmed by the reference
vehicle's camera 5, whose paint is not what the vehicle file states.

Counted is a film as **confidently wrong** when more than a twentieth of its answered frames err by more than 4 stated
sd (two components, of the probability of 4 sd of one), and no check of the deflection is red.
"""

from __future__ import annotations

import argparse
import json
import pickle
import re
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))

import spoilings
from spoilings import Footage

from flightmodel.checks import GateError
from flightmodel.deflection import lv_direction
from flightmodel.film import film_frames
from flightmodel.vehicle import vehicle_path
from postflight.filming import camera_answer, camera_film
from postflight.flight import read_flight
from synthetic_flight.film import Imaging, Scene, film
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, sun
from tests.estimators.test_degraded_video import BAD

TIMES = np.append(421.0, 430.0 + np.arange(11))
STOCK = 24  # own films, each spoilt many times
BEYOND = 19.3  # chi-square of two components with the probability of 4 sd of one
FEW = 0.05  # of the answered frames
FLIGHT = """
name = "spoilt"
t0_utc = "2009-08-17T12:52:00Z"
vehicle = "vehicle.toml"

[frames]
file = "frames.csv"
folder = "film"
camera = "camera5"
benchmark_s = {benchmark_s:.6f}
"""


def own_film(number: int) -> Footage:
    """A film of a pressure pulse: deflection that rises and swings, a vehicle that rolls."""
    rng = np.random.default_rng([number, 1907])
    pulse = np.exp(-(((TIMES - 437.0) / 6.0) ** 2))
    size = D(rng.uniform(1.5, 4.5)) * pulse * (1.0 + 0.2 * np.sin(2.0 * np.pi * 0.8 * TIMES))
    plane = D(rng.uniform(0.0, 360.0)) + D(15.0) * np.sin(0.3 * (TIMES - 430.0))
    yz = size[:, None] * np.column_stack([-np.cos(plane), np.sin(plane)])
    yz[0] = D(0.12) * rng.standard_normal(2)
    roll = np.rad2deg(rng.uniform(-4.0, 4.0)) * (TIMES - 421.0)
    light = np.stack([sun(rng.uniform(0, 360) * 0.0 + angle, 60.0) for angle in rng.uniform(0.0, 360.0) + roll])
    nadir = altitude = None
    if number % 2:
        side = D(rng.uniform(0.0, 360.0) + roll)
        nadir = np.array([np.cos(0.35), 0.0, 0.0]) + np.sin(0.35) * np.stack([lv_direction(a) for a in side])
        altitude = np.interp(TIMES, [421.0, 445.0], [76e3, 48e3])
    features = ("drawn", "drawn", "texture", "none")[number // 2 % 4]
    imaging = BAD if number % 3 == 2 else Imaging(painted=features != "none")
    seen = Scene(np.hypot(*yz.T), np.arctan2(yz[:, 1], -yz[:, 0]), light, nadir, altitude, pulse)
    frames = list(film(GEOMETRY, MOUNT, JOINT_M, seen, rng, imaging))
    camera = {} if imaging is not BAD else {"uncertainty": {"focal": 0.2, "centre_px": 15.0, "k1": 0.05, "k2": 0.03}}
    return Footage(TIMES, frames, yz, {"features": features}, camera)


def others_film(folder: Path) -> Footage:
    """The frames of another renderer's film that are nearest to `TIMES`."""
    rows, truth = (pd.read_csv(folder / name) for name in ("frames.csv", "truth.csv"))
    chosen = np.unique([int(np.argmin(np.abs(rows.t_s - t))) for t in TIMES])
    path = next(p for p in sorted(folder.glob("film.*")) if p.suffix in (".avi", ".mp4"))
    frames = list(film_frames(path, [int(k) for k in rows.frame.iloc[chosen]]))
    at = rows.t_s.to_numpy(dtype=float)[chosen]
    plane, theta = np.deg2rad(truth.plane_lv_deg), np.deg2rad(truth.theta_deg)
    yz = np.column_stack([np.interp(at, truth.t_s, c) for c in (-theta * np.cos(plane), theta * np.sin(plane))])
    return Footage(at, frames, yz, {"features": "drawn"}, {})


@cache
def stock(path: Path) -> list[Footage]:
    """Films to spoil."""
    with path.open("rb") as file:
        return list(pickle.load(file))


@dataclass(frozen=True)
class Outcome:
    """What became of a spoilt film: code of its refusal, frames answered, beyond 4 sd, largest error, its sd, red."""

    number: int
    kinds: tuple[str, ...]
    source: int
    code: str
    answered: int = 0
    beyond: int = 0
    error_deg: float = 0.0
    sd_deg: float = 0.0
    is_red: bool = False

    @property
    def is_confidently_wrong(self) -> bool:
        """Whether more answers are wrong than may be, and nothing says so."""
        return not self.is_red and self.beyond > FEW * self.answered


def laid_out(footage: Footage, folder: Path) -> None:
    """Write a flight folder with the film and nothing else."""
    text = _changed(vehicle_path("irve2_reference").read_text(), "geometry", footage.geometry)
    (folder / "vehicle.toml").write_text(_changed(text, "cameras.camera5", footage.camera))
    (folder / "flight.toml").write_text(FLIGHT.format(benchmark_s=footage.benchmark_s))
    (folder / "film").mkdir()
    rows = ["t_s,frame"]
    for k, (t, frame) in enumerate(zip(footage.time_s, footage.frames, strict=True)):
        cv2.imwrite(str(folder / "film" / f"{k:03d}.png"), frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        rows.append(f"{t:.6f},{k:03d}.png")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")


def _changed(toml: str, section: str, values: Mapping[str, Any]) -> str:
    """A TOML file with other values in a section."""
    start = toml.index(f"\n[{section}]\n") + len(section) + 4
    end = toml.find("\n[", start)
    head, body, rest = toml[:start], toml[start:end], toml[end:]
    for name, value in values.items():
        text = json.dumps(value)
        if isinstance(value, Mapping):
            text = "{ " + ", ".join(f"{key} = {json.dumps(v)}" for key, v in value.items()) + " }"
        body = re.sub(rf"^{name} = .*\n?", "", body, flags=re.MULTILINE)
        body = f"{name} = {text}\n{body}"
    return head + body + rest


def read_as_a_user(footage: Footage) -> tuple[int, int, float, float, bool]:
    """Frames answered, of them beyond 4 sd, the largest error, deg, the sd there, deg, and whether a check is red.

    `GateError` where the film is refused.
    """
    with tempfile.TemporaryDirectory() as root:
        laid_out(footage, Path(root))
        flight = read_flight(root, needs_path=False)
        film = camera_film(flight)
        is_red = not all(check.passed for check in camera_answer(flight, film).consistency_checks)
    off_benchmark = np.abs(footage.time_s - footage.benchmark_s) > 1e-3
    answered, beyond, worst = 0, 0, (0.0, 0.0)
    for fit, yz, other in zip(film.fits, footage.theta_yz_rad, off_benchmark, strict=True):
        if fit.refused or not other:
            continue
        # the lateral vector of a rotation about body y and z
        error = fit.rotation_yz_rad - np.array([-yz[1], yz[0]])
        answered += 1
        beyond += bool(error @ np.linalg.solve(fit.covariance, error) > BEYOND)
        size = float(np.rad2deg(np.linalg.norm(error)))
        if size > worst[0]:
            worst = (size, float(np.rad2deg(np.sqrt(0.5 * np.trace(fit.covariance)))))
    return answered, beyond, *worst, is_red


def trial(job: tuple[Path, int, int, str, tuple[str, ...]]) -> Outcome:
    """Spoil a film, read it, compare."""
    path, seed, number, kinds, only = job
    cv2.setNumThreads(1)
    films, rng = stock(path), np.random.default_rng([seed, number, 419])
    known = {"shaped": spoilings.SHAPED, "held-back": spoilings.HELD_BACK, "none": {}}.get(
        kinds, spoilings.SHAPED | spoilings.HELD_BACK
    )
    names = [name for name in known if not only or name in only]
    source, other = (int(k) for k in rng.choice(len(films), 2, replace=False))
    footage = films[source]
    chosen = [names[number % len(names)]] if names else []
    if kinds == "two":
        chosen = [str(name) for name in rng.choice(names, 2, replace=False)]
    for name in chosen:
        footage = known[name](footage, films[other], rng)
    try:
        return Outcome(number, tuple(chosen), source, "", *read_as_a_user(footage))
    except GateError as fault:
        return Outcome(number, tuple(chosen), source, fault.codes[0])
    except Exception as fault:
        return Outcome(number, tuple(chosen), source, f"crashed: {type(fault).__name__}: {fault}")


def report(outcomes: list[Outcome]) -> int:
    """Print a line a kind and all in all; the number of crashes and of wrong answers that a picture gives away."""
    by_kind = defaultdict(list)
    for one in outcomes:
        by_kind[" + ".join(one.kinds) if len(one.kinds) == 1 else "several"].append(one)
    print(f"{'spoiling':16s} films refused  no answer  red  answered frames  beyond 4 sd  confidently wrong")
    for kind, some in by_kind.items():
        answered, beyond = sum(o.answered for o in some), sum(o.beyond for o in some)
        refused, empty = sum(bool(o.code) for o in some), sum(not o.code and not o.answered for o in some)
        wrong, red = sum(o.is_confidently_wrong for o in some), sum(o.is_red for o in some)
        print(f"{kind:16s} {len(some):5d} {refused:7d} {empty:10d} {red:4d} {answered:16d} {beyond:12d} {wrong:18d}")
    codes = Counter(o.code for o in outcomes if o.code)
    print(f"refused with: {dict(codes.most_common())}")
    wrong = [o for o in outcomes if o.is_confidently_wrong]
    shown = [o for o in wrong if not set(o.kinds) & set(spoilings.NOT_IN_PICTURES)]
    print(f"{len(outcomes)} films: {len(wrong)} confidently wrong, {len(shown)} of them by what a picture shows")
    return len(shown) + sum(o.code.startswith("crashed") for o in outcomes)


def main() -> int:
    """Film, spoil, read, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("films", type=int, nargs="?", default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--kinds", default="all", choices=["shaped", "held-back", "all", "none", "two"])
    parser.add_argument("--footage", nargs="*", type=Path, default=[])
    parser.add_argument("--first", type=int, default=0, help="number of the first own film")
    parser.add_argument("--stock", type=Path, default=None, help="where the films to spoil are kept between calls")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--listed", action="store_true", help="a line for every film confidently wrong or crashed")
    chosen = parser.parse_args()
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as root, ProcessPoolExecutor(chosen.processes) as pool:
        path = chosen.stock or Path(root) / "stock"
        if not path.exists():
            films = [*pool.map(own_film, range(chosen.first, chosen.first + STOCK)), *map(others_film, chosen.footage)]
            path.write_bytes(pickle.dumps(films))
            print(f"{len(films)} films in {time.perf_counter() - begun:.0f} s", flush=True)
        jobs = [(path, chosen.seed, k, chosen.kinds, tuple(chosen.only)) for k in range(chosen.films)]
        outcomes = []
        for one in pool.map(trial, jobs):
            outcomes.append(one)
            if chosen.listed and one.is_confidently_wrong:
                print(f"  film {one.number} of {one.source}, {', '.join(one.kinds)}: {one.beyond} of {one.answered} "
                      f"frames, up to {one.error_deg:.2f} deg off with {one.sd_deg:.2f}", flush=True)  # fmt: skip
            if chosen.listed and one.code.startswith("crashed"):
                print(f"  film {one.number} of {one.source}, {', '.join(one.kinds)}: {one.code}", flush=True)
    shown = report(outcomes)
    print(f"{time.perf_counter() - begun:.0f} s")
    return int(shown > 0)


if __name__ == "__main__":
    sys.exit(main())
