"""Errors of the virtual camera over many films, and how often its standard deviations cover them.

    python benchmarks/video_coverage.py [clean | unbent | degraded] [flights]

Every flight has a camera, a light and bendings of its own; its benchmark frame is bent by 0.12 deg an axis that nobody
is told. ``clean``: a lens known to a data sheet's tolerances. ``unbent``: the same with a benchmark frame that is truly
not bent, which shows what pictures alone leave. ``degraded``: a lens nobody calibrated, the Earth behind
the rim, interlace, noise, compression, a shell out of shape (tests/estimators/test_degraded_video.py).
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

from estimators.camera_deflection import deflection_from_frames
from flightmodel.checks import GateError
from synthetic_flight.video import Imaging, Scene, film
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, sun
from tests.estimators.test_degraded_video import TIMES, UNCALIBRATED, degraded


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
        history = deflection_from_frames(TIMES, frames, GEOMETRY, mount, JOINT_M, plane_lv_rad=None)
    except GateError as fault:
        return seed, [], str(fault)
    rows = []
    for k in (1, 2):
        off = np.angle(np.exp(1j * (history.plane_lv_rad[k] - plane[k])))
        sd = np.sqrt(np.diag(history.covariance[k]))
        rows.append(tuple(np.rad2deg([history.theta_rad[k] - theta[k], off, *sd]).tolist()))
    return seed, rows, ""


def main() -> None:
    """Fly, estimate, count."""
    kind = sys.argv[1] if len(sys.argv) > 1 else "clean"
    flights = int(sys.argv[2]) if len(sys.argv) > 2 else 100
    rows: list[tuple[float, ...]] = []
    with ProcessPoolExecutor(2) as pool:
        jobs = pool.map(one_flight, [(kind, 5000 + k) for k in range(flights)])
        for seed, answers, refused in track(jobs, total=flights, description=kind):
            if refused or not np.isfinite(answers).all():
                print(f"flight {seed}: {refused or 'a frame was refused'}")
            rows += [row for row in answers if np.isfinite(row).all()]
    table = np.array(rows)
    print(f"{kind}: {len(rows)} frames of {flights} flights")
    for name, error, sd in (("angle", table[:, 0], table[:, 2]), ("plane", table[:, 1], table[:, 3])):
        cover = [100.0 * np.mean(np.abs(error) < k * sd) for k in (1, 2)]
        print(f"  {name}: rms {np.sqrt(np.mean(error**2)):.3f} deg, bias {error.mean():+.3f}, largest "
              f"{np.abs(error).max():.2f}; 1 sd covers {cover[0]:.0f} %, 2 sd {cover[1]:.0f} %")  # fmt: skip


if __name__ == "__main__":
    main()
