"""Rocking or local deformation: how often lobes of the shell are called, and what they leave of the deflection's error.

    python benchmarks/shell_shape.py [--cameras 2] [--lobes 0.3] [--paint drawn|none] [FIRST LAST]

Films, a frame a second from 421 to 448 s, of the dispersed flights of ``estimator_coverage.py`` (kept in its folder, or
flown now). Every flight has its own lights, cameras (evenly round the centerbody from a random clocking angle, each
built with errors of its own) and shell: out of shape as built (0.1 deg), flattened in proportion to the pressure (sd
0.15 deg) and, with ``--lobes``, with lobes of so many degrees at peak pressure, of two or three waves, in a random
direction. ``--paint none``: no seams or dots, the edge and the valleys between tori alone.

Printed are the calls, how often the right number of waves is among lobes called, and for the deflection over the
pressure pulse the rms of its error, of its stated sd and of their ratio: each frame by itself, with the film's shape,
both with the benchmark frame's deflection by the moment in the joint, and of several cameras together. About 8 s a
camera and flight.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rich.progress import track

sys.path.insert(0, str(Path(__file__).parents[1]))

import estimator_coverage as dispersed
from video_coverage import FLOWN_S, flown_scene

from estimators.benchmark import benchmark_deflection
from estimators.camera import FilmFit, read_film
from estimators.cameras import CameraReadings, join_cameras
from estimators.loads import FlightLoads
from estimators.shell_shape import ShellShape, shell_shape, with_shape
from flightmodel.checks import GateError
from synthetic_flight.film import Imaging, Warp, film
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D

PULSE_SHARE = 0.25  # of the largest dynamic pressure
PLANE_SD_RAD = float(D(1.0))


def loaded_shape(rng: np.random.Generator, lobes_deg: float) -> tuple[Warp, int]:
    """Shape at the largest load, and the lobes' number of waves."""
    waves, direction = int(rng.integers(2, 4)), rng.uniform(0.0, 2.0 * np.pi)
    lobes = np.zeros((2, 2))
    lobes[waves - 2] = D(lobes_deg) * np.array([np.cos(direction), np.sin(direction)])
    return Warp(float(D(0.15) * rng.standard_normal()), *lobes.ravel().tolist()), waves


def filmed(seed: int, pulse: FlightLoads, theta_yz: np.ndarray, options: argparse.Namespace) -> tuple:
    """Films of all cameras with the pressure at their frames, the true deflections (n, 2) and the number of waves."""
    rng = np.random.default_rng([seed, 13, 2009])
    shape, waves = loaded_shape(rng, options.lobes)
    scene = flown_scene(pulse, theta_yz, rng, "flown")
    pressure = np.interp(FLOWN_S, pulse.time_s, pulse.dynamic_pressure_pa)
    scene = replace(scene, load=pressure / pulse.dynamic_pressure_pa.max())
    imaging = Imaging(built_sd_rad=float(D(0.1)), loaded=shape, painted=options.paint == "drawn")
    shell = GEOMETRY.model_copy(update={"features": options.paint})
    first, films = rng.uniform(0.0, 360.0), []
    for k in range(options.cameras):
        clock = (first + 360.0 * k / options.cameras + 180.0) % 360.0 - 180.0
        mount = MOUNT.model_copy(update={"clock_lv_deg": clock})
        own = np.random.default_rng([seed, 17, k])
        frames = list(film(shell, mount, JOINT_M, scene, own, imaging, np.random.default_rng([seed, 19])))
        read = read_film(FLOWN_S, frames, shell, mount, JOINT_M, plane_lv_rad=None)
        films.append(replace(read, pressure_pa=pressure))
    return films, dispersed.columns(FLOWN_S, pulse.time_s, theta_yz), waves


def answers(films: list[FilmFit], pulse: FlightLoads) -> np.ndarray:
    """Size of the deflection and its sd (2, n), rad: of one camera, or of all together."""
    read_by = []
    for one in films:
        read = one.relative_to_benchmark()
        try:
            start = benchmark_deflection(read, pulse, one.oriented.apriori.benchmark_rad)
        except GateError:
            start = one.undeflected_benchmark
        read_by.append((read, start))
    if len(films) == 1:
        history = films[0].history(read_by[0][1])
        return np.array([history.theta_rad, history.theta_sd_rad])
    cameras = [CameraReadings(f"{k}", read, start, PLANE_SD_RAD) for k, (read, start) in enumerate(read_by)]
    history = join_cameras(cameras).at_frames
    out = np.full((2, len(FLOWN_S)), np.nan)
    out[:, np.searchsorted(FLOWN_S, history.time_s)] = history.theta_rad, history.theta_sd_rad
    return out


def one_flight(seed: int, options: argparse.Namespace) -> tuple[ShellShape, int, list[np.ndarray]] | str:
    """Shape found, true number of waves, errors and sd (2, n) of each frame by itself and with the film's shape."""
    cv2.setNumThreads(1)
    pulse, truth = dispersed.kept_flight(dispersed.KEPT, seed)
    if str(truth["words"]):
        return str(truth["words"])
    try:
        films, true, waves = filmed(seed, pulse, truth["theta_yz"], options)
        shape = shell_shape(films)
        size = np.linalg.norm(true, axis=1)
        inside = films[0].pressure_pa > PULSE_SHARE * films[0].pressure_pa.max()
        rows = []
        for some in (films, with_shape(films, shape)):
            theta, sd = answers(some, pulse)
            rows.append(np.rad2deg(np.array([theta - size, sd])[:, inside]))
    except GateError as fault:
        return str(fault)
    return shape, waves, rows


def main() -> None:
    """Film, estimate, count."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--cameras", type=int, default=2)
    asked.add_argument("--lobes", type=float, default=0.3)
    asked.add_argument("--paint", choices=["drawn", "none"], default="drawn")
    asked.add_argument("--processes", type=int, default=2)
    asked.add_argument("seeds", type=int, nargs="*", default=[600, 620])
    options = asked.parse_args()
    seeds = range(*options.seeds)
    dispersed.fly_missing(dispersed.KEPT, seeds)
    found, calls, right = [], Counter(), 0
    with ProcessPoolExecutor(options.processes) as pool:
        rows = pool.map(partial(one_flight, options=options), seeds)
        for seed, row in zip(seeds, track(rows, total=len(seeds)), strict=True):
            if isinstance(row, str):
                print(f"flight {seed}: {row}")
                continue
            shape, waves, errors = row
            calls["lobes" if shape.call.startswith("lobes") else shape.call] += 1
            right += shape.call.startswith("lobes of") and ("two" if waves == 2 else "three") in shape.call
            found.append(errors)
    print(f"{options.cameras} cameras, lobes of {options.lobes:g} deg, paint {options.paint}: {len(found)} flights")
    print(f"  called: {dict(calls)}; the right number of waves among them: {right}")
    for k, name in enumerate(("each frame by itself", "with the film's shape")):
        error, sd = np.concatenate([one[k] for one in found], axis=1)
        known = np.isfinite(error)
        error, sd = error[known], sd[known]
        print(
            f"  {name}: rms {np.sqrt(np.mean(error**2)):.3f} deg, stated {np.sqrt(np.mean(sd**2)):.3f}, ratio "
            f"{np.sqrt(np.mean((error / sd) ** 2)):.2f}, beyond 3 sd {100.0 * np.mean(np.abs(error) > 3.0 * sd):.1f} %"
        )


if __name__ == "__main__":
    main()
