"""Errors of the virtual camera over many films, and how often its standard deviations cover them.

    python benchmarks/video_coverage.py [KIND] [flights] [first seed]

Every flight has a camera, a light and deflections of its own; its benchmark frame is deflected by 0.12 deg an axis,
which is not stated. Kinds: ``clean``: a lens known to a data sheet's tolerances. ``unbent``: the same with a benchmark
truly undeflected, which shows what pictures alone leave. ``degraded``: a lens nobody calibrated, the Earth behind the
rim, interlace, noise, compression, a shell out of shape (tests/estimators/test_degraded_video.py).

Nothing moved the shell in these. ``flown``: films, a frame a second from 421 to 448 s, of the dispersed flights of
``estimator_coverage.py`` (kept in its folder, or flown now), as clean. ``flown-degraded``: as degraded, out of shape in
proportion to the pressure, moving between two fields as it flew. Scored is the frame nearest to peak pressure, with the
benchmark taken as undeflected, and with its deflection estimated from the joint's moment.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rich.progress import track

sys.path.insert(0, str(Path(__file__).parents[1]))

import estimator_coverage as dispersed

from estimators.benchmark import benchmark_deflection
from estimators.camera import read_film
from estimators.loads import FlightLoads
from flightmodel.checks import GateError
from flightmodel.deflection import lv_direction
from synthetic_flight.film import Imaging, Scene, film
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, sun
from tests.estimators.test_degraded_video import BAD, TIMES, UNCALIBRATED, degraded

FLOWN = {"flown": Imaging(), "flown-degraded": BAD}
FLOWN_S = np.arange(421.0, 448.01, 1.0)


def clean(seed: int, at_rest_deg: float = 0.12) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Three frames with their truth (theta, plane)."""
    rng = np.random.default_rng(seed)
    rest = D(at_rest_deg) * rng.standard_normal(2)
    theta = np.array([np.hypot(*rest), D(rng.uniform(3.0, 4.8)), D(rng.uniform(3.0, 4.8))])
    plane = np.array([np.arctan2(rest[1], -rest[0]), D(rng.uniform(0.0, 360.0)), D(rng.uniform(153.0, 240.0))])
    light = np.stack([sun(rng.uniform(0.0, 360.0), rng.uniform(50.0, 70.0)) for _ in TIMES])
    return list(film(GEOMETRY, MOUNT, JOINT_M, Scene(theta, plane, light), rng, Imaging())), theta, plane


def one_flight(job: tuple[str, int]) -> tuple[int, list[tuple[float, ...]], str]:
    """Error of angle and plane with their sd, deg, of both bent frames of a flight; a reason where it was refused."""
    kind, seed = job
    cv2.setNumThreads(1)
    makers = {"clean": clean, "unbent": partial(clean, at_rest_deg=0.0), "degraded": degraded}
    frames, theta, plane = makers[kind](seed)
    mount = UNCALIBRATED if kind == "degraded" else MOUNT
    try:
        history = read_film(TIMES, frames, GEOMETRY, mount, JOINT_M, plane_lv_rad=None).history()
    except GateError as fault:
        return seed, [], str(fault)
    rows = []
    for k in (1, 2):
        off = np.angle(np.exp(1j * (history.plane_lv_rad[k] - plane[k])))
        sd = np.sqrt(np.diag(history.covariance[k]))
        rows.append(tuple(np.rad2deg([history.theta_rad[k] - theta[k], off, *sd]).tolist()))
    return seed, rows, ""


def flown_scene(pulse: FlightLoads, bent: np.ndarray, rng: np.random.Generator, kind: str) -> Scene:
    """What a kept flight's camera sees; light and Earth at random sides, and they turn with the roll."""
    t = pulse.time_s
    seen = dispersed.columns(FLOWN_S, t, bent)
    moving = dispersed.columns(FLOWN_S, t, np.gradient(bent, t, axis=0))
    roll = np.interp(FLOWN_S, t, np.concatenate([[0.0], np.cumsum(np.diff(t) * pulse.rate_body_radps[1:, 0])]))
    first, from_aft = rng.uniform(0.0, 360.0), rng.uniform(50.0, 70.0)
    light = np.stack([sun(first + np.rad2deg(turn), from_aft) for turn in roll])
    theta, plane = np.hypot(*seen.T), np.arctan2(seen[:, 1], -seen[:, 0])
    load = np.interp(FLOWN_S, t, pulse.dynamic_pressure_pa / pulse.dynamic_pressure_pa.max())
    nadir, altitude = None, None
    if kind == "flown-degraded":
        lean, side = D(20.0), rng.uniform(0.0, 2.0 * np.pi)
        nadir = np.array([np.cos(lean), 0.0, 0.0]) + np.sin(lean) * np.stack([lv_direction(side + r) for r in roll])
        altitude = np.interp(FLOWN_S, t, pulse.altitude_m)
    return Scene(theta, plane, light, nadir, altitude, load, moving)


def flown_film(seed: int, kind: str) -> tuple[list[np.ndarray], Scene]:
    """Frames of a kept flight and what there was to see."""
    pulse, truth = dispersed.kept_flight(dispersed.KEPT, seed)
    rng = np.random.default_rng([seed, 11, 2009])
    scene = flown_scene(pulse, truth["theta_yz"], rng, kind)
    return list(film(GEOMETRY, MOUNT, JOINT_M, scene, rng, FLOWN[kind])), scene


def one_flown(job: tuple[str, int]) -> tuple[int, list[tuple[float, ...]], str]:
    """Errors and sd of the frame nearest to peak pressure, benchmark undeflected and estimated; the benchmark's own."""
    kind, seed = job
    cv2.setNumThreads(1)
    pulse, truth = dispersed.kept_flight(dispersed.KEPT, seed)
    if str(truth["words"]):
        return seed, [], str(truth["words"])
    frames, scene = flown_film(seed, kind)
    mount = UNCALIBRATED if kind == "flown-degraded" else MOUNT
    k = int(np.argmin(np.abs(FLOWN_S - truth["peak"])))
    try:
        read = read_film(FLOWN_S, frames, GEOMETRY, mount, JOINT_M, plane_lv_rad=None)
        rest = benchmark_deflection(read.relative_to_benchmark(), pulse, read.oriented.apriori.benchmark_rad)
    except GateError as fault:
        return seed, [], str(fault)
    rows = []
    for history in (read.history(), read.history(rest)):
        off = np.angle(np.exp(1j * (history.plane_lv_rad[k] - scene.plane_lv_rad[k])))
        sd = np.sqrt(np.diag(history.covariance[k]))
        rows.append(tuple(np.rad2deg([history.theta_rad[k] - scene.theta_rad[k], off, *sd]).tolist()))
    there = dispersed.columns(FLOWN_S[:1], pulse.time_s, truth["theta_yz"])[0]
    own = np.rad2deg([*there, *(rest.theta_yz_rad - there), *np.sqrt(np.diag(rest.covariance))])
    return seed, [*rows, tuple(own.tolist())], ""


def report(name: str, table: np.ndarray) -> None:
    """Rms, bias and coverage of errors (n,) and sd (n,), deg: columns of ``table``."""
    error, sd = table.T
    cover = [100.0 * np.mean(np.abs(error) < k * sd) for k in (1, 2)]
    print(f"  {name}: rms {np.sqrt(np.mean(error**2)):.3f} deg, bias {error.mean():+.3f}, largest "
          f"{np.abs(error).max():.2f}; stated {np.sqrt(np.mean(sd**2)):.3f}; 1 sd covers {cover[0]:.0f} %, "
          f"2 sd {cover[1]:.0f} %")  # fmt: skip


def main_flown(kind: str, flights: int, first: int) -> None:
    """Film kept flights, estimate, count."""
    seeds = range(first, first + flights)
    dispersed.fly_missing(dispersed.KEPT, seeds)
    found = []
    with ProcessPoolExecutor(2) as pool:
        jobs = pool.map(one_flown, [(kind, seed) for seed in seeds])
        for seed, rows, refused in track(jobs, total=flights, description=kind):
            if refused or not np.isfinite(rows[0]).all():
                print(f"flight {seed}: {refused or 'the frame was refused'}")
            else:
                found.append(rows)
    print(f"{kind}: {len(found)} films")
    own = np.array([rows[2] for rows in found])
    print(f"  benchmark: deflected by {np.sqrt(np.mean(own[:, :2] ** 2)):.3f} deg rms an axis")
    report("benchmark, an axis", own[:, 2:].reshape(-1, 2, 2).transpose(0, 2, 1).reshape(-1, 2))
    for k, name in enumerate(("taken as undeflected", "by the joint's moment")):
        table = np.array([rows[k] for rows in found])
        report(f"angle, {name}", table[:, [0, 2]])
        report(f"plane, {name}", table[:, [1, 3]])


def main() -> None:
    """Fly, estimate, count."""
    kind = sys.argv[1] if len(sys.argv) > 1 else "clean"
    flights = int(sys.argv[2]) if len(sys.argv) > 2 else 100
    first = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    if kind in FLOWN:
        main_flown(kind, flights, first)
        return
    rows: list[tuple[float, ...]] = []
    with ProcessPoolExecutor(2) as pool:
        jobs = pool.map(one_flight, [(kind, 5000 + first + k) for k in range(flights)])
        for seed, answers, refused in track(jobs, total=flights, description=kind):
            if refused or not np.isfinite(answers).all():
                print(f"flight {seed}: {refused or 'a frame was refused'}")
            rows += [row for row in answers if np.isfinite(row).all()]
    table = np.array(rows)
    print(f"{kind}: {len(rows)} frames of {flights} flights")
    report("angle", table[:, [0, 2]])
    report("plane", table[:, [1, 3]])


if __name__ == "__main__":
    main()
