"""The reconstruction's filter and smoother against filterpy with a numpy strapdown, and against plain C++.

Run: ``python benchmarks/filter_and_smoother.py [ROUNDS [SECONDS]]``. 500 s of inertial data at 400 Hz and one radar at
10 Hz. Ours carries 31 errors (27 and four of the radar), filterpy 24 (no mountings, three of the radar), every sample
predicted and kept for its smoother, as its interface asks. C++ (`plain_cpp/filter.cpp`, needs g++) does what ours does
and must agree before it is timed. A flight's first pass is node by node, about the filter's own estimate, as C++ and
filterpy are; all others are about a reference, and these are what is compared. Times are the processor's, all in one
thread. Memory is the peak of a process of its own.
"""

import os

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import ctypes
import math
import shutil
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from problem import minima

from flightmodel import earth, rotations
from flightmodel.instruments import RADAR, RadarSite, TriadSpec
from flightmodel.telemetry import RadarRecord
from recon import kalman
from recon.measurements import radar_instrument
from recon.problem import Problem, observe
from recon.propagation import strapdown_motion
from recon.state import ErrorModel, States, imu_blocks, instrument_blocks
from tests.oracles.plain_rotations import matrix, skew

DEG = np.pi / 180.0
IMU_HZ, RADAR_HZ = 400.0, 10.0
FORCE = TriadSpec("accelerometer", np.zeros(3), np.eye(3), 0.04, 0.05, 0.003, 0.15 * DEG)
RATES = TriadSpec("rates", np.zeros(3), np.eye(3), 0.05 * DEG, 0.04 * DEG, 0.003, 0.15 * DEG)
SITE = RadarSite("radar", 37.84 * DEG, -75.48 * DEG, 12.0, 5.0, 0.006 * DEG, 5.0, 0.005 * DEG, 0.002)
SOURCE = Path(__file__).parent / "plain_cpp" / "filter.cpp"


def flight(seconds):
    """A spinning, coning, decelerated flight as inertial sensors and a radar would have measured it."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, seconds + 0.5 / IMU_HZ, 1.0 / IMU_HZ)
    w = np.stack([0.6 + 0.0 * t, 0.05 * np.sin(2.1 * t), 0.06 * np.cos(1.9 * t)], axis=1)
    pulse = 60.0 * np.exp(-0.5 * ((t - 0.7 * seconds) / 8.0) ** 2)
    f = np.stack([-pulse, 0.04 * pulse * np.sin(1.7 * t), 0.05 * pulse * np.cos(1.8 * t)], axis=1)
    motion = strapdown_motion(
        t,
        f,
        w,
        np.full_like(f, FORCE.noise_sd**2 / IMU_HZ),
        np.full_like(f, RATES.noise_sd**2 / IMU_HZ),
        np.eye(3),
        np.eye(3),
    )
    place = earth.ecef_from_geodetic(37.6 * DEG, -75.2 * DEG, 150e3)
    start = States(
        place,
        earth.ecef_from_ned(np.array([-300.0, 500.0, -900.0]), place),
        np.array([0.6, 0.5, -0.4, 0.48]),
        np.zeros(22),
    )
    start = States(
        start.position_ecef_m,
        start.velocity_ecef_mps,
        start.q_ecef_body / np.linalg.norm(start.q_ecef_body),
        start.sensor_errors,
    )
    node = np.arange(0, len(t), round(IMU_HZ / RADAR_HZ))
    track = [start.position_ecef_m]
    from recon.propagation import propagate

    state = start
    for a, b in pairwise(node):
        state = propagate(motion, a, b, state).state
        track.append(state.position_ecef_m)
    z = earth.radar_from_ecef(np.array(track), SITE.latitude_rad, SITE.longitude_rad, SITE.height_m)
    sd = np.array([SITE.range_sd_m, SITE.angle_sd_rad, SITE.angle_sd_rad])
    noise = rng.standard_normal(z.shape) * sd
    noise[:, 1] /= np.cos(z[:, 2])
    motion = motion._replace(
        force_sensor_mps2=f + FORCE.noise_sd * rng.standard_normal(f.shape),
        rate_sensor_radps=w + RATES.noise_sd * rng.standard_normal(w.shape),
    )
    return motion, node, start, z + noise


def problem_of(motion, node, start, z):
    """Our problem, 31 errors."""
    time_s = motion.time_s[node]
    instrument = radar_instrument("radar", RadarRecord(SITE, time_s, z), np.array([0.4, 0.0, 0.01]))
    model = ErrorModel(tuple(imu_blocks(FORCE, RATES) + instrument_blocks(RADAR, SITE)))
    observed, row = observe(time_s, (instrument,))
    sd = np.concatenate([np.full(3, 1000.0), np.full(3, 100.0), np.full(3, 3.0 * DEG), model.prior_sd])
    gate = np.array([0.0, 15.0, 18.0, 21.1])
    return Problem(
        time_s, node.astype(np.int64), motion, model, (instrument,), row, observed, start, np.diag(sd**2), gate,
        np.ones(len(node), dtype=bool),
    )  # fmt: skip


def ours(problem, reference=None):
    """Filter and smoother, moments at every radar point: about its own estimate, or about a reference."""
    run = kalman.forward(problem, reference)
    return run, kalman.smooth(problem, run)


class Plain:
    """The same in C++."""

    def __init__(self, library, problem):
        self.function, self.problem = library.filter_and_smooth, problem
        n = len(problem.node_index)
        self.out, self.variance = np.empty((n, 31)), np.empty((n, 31))

    def __call__(self):
        p, m = self.problem, self.problem.motion
        i = p.instruments[0]
        start = np.concatenate(
            [p.start.position_ecef_m, p.start.velocity_ecef_mps, p.start.q_ecef_body, p.start.sensor_errors]
        )
        arrays = [m.time_s, m.force_sensor_mps2, m.rate_sensor_radps]

        def at(a):
            return a.ctypes.data_as(ctypes.c_void_p)

        self.function(
            ctypes.c_long(len(p.node_index)), at(p.node_index), *(at(a) for a in arrays),
            ctypes.c_double(m.force_density[0, 0]), ctypes.c_double(m.rate_density[0, 0]),
            at(p.observed.value), at(p.observed.variance),
            at(i.site_ecef_m), at(np.ascontiguousarray(i.dcm)), at(i.arm_body_m),
            ctypes.c_double(p.gate[3]), at(start), at(p.start_covariance), at(self.out), at(self.variance),
        )  # fmt: skip
        return self.out, self.variance


def turned(q, d):
    """Quaternion turned by a rotation vector in body axes."""
    x, y, z = d.tolist()
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    c, s = math.cos(half), 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0)
    a, b, e, g = q
    x, y, z = s * x, s * y, s * z
    return (
        a * c - b * x - e * y - g * z,
        a * x + b * c + e * z - g * y,
        a * y - b * z + e * c + g * x,
        a * z + b * y - e * x + g * c,
    )


def gravity(p):
    """J2 gravitation and the central part of its gradient."""
    x, y, z = p.tolist()
    r2 = x * x + y * y + z * z
    m, k, s = earth.GM_M3PS2 / r2**1.5, 1.5 * earth.J2 * earth.SEMI_MAJOR_M**2 / r2, 5.0 * z * z / r2
    g = -m * np.array([(1 + k * (1 - s)) * x, (1 + k * (1 - s)) * y, (1 + k * (3 - s)) * z])
    return g, m * (3.0 / r2 * np.outer(p, p) - np.eye(3))


def with_filterpy(motion, node, start, z):
    """filterpy's EKF of 24 errors with a numpy strapdown, then its smoother's arithmetic; the smoothed covariances."""
    from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter

    size, radar = 24, set(node.tolist())
    site = earth.ecef_from_geodetic(SITE.latitude_rad, SITE.longitude_rad, SITE.height_m)
    ned = earth.dcm_ned_ecef(SITE.latitude_rad, SITE.longitude_rad)
    sd = [1000.0] * 3 + [100.0] * 3 + [3 * DEG] * 3 + [0.05] * 3 + [0.003] * 3 + [0.04 * DEG] * 3 + [0.003] * 3
    filt = ExtendedKalmanFilter(size, 3)
    filt.P = np.diag(np.array([*sd, 5.0, 0.005 * DEG, 0.005 * DEG]) ** 2)
    filt.x = np.zeros(size)
    noise = np.array([SITE.range_sd_m, SITE.angle_sd_rad, SITE.angle_sd_rad]) ** 2
    p, v, q = start.position_ecef_m.copy(), start.velocity_ecef_mps.copy(), start.q_ecef_body.tolist()
    errors = np.zeros(15)
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    kept = {"P": [], "F": [], "Q": [], "x": []}
    time_s, f_in, w_in = motion.time_s, motion.force_sensor_mps2, motion.rate_sensor_radps
    eye, idle = np.eye(size), np.zeros((size, size))
    idle[range(3, 6), range(3, 6)] = motion.force_density[0, 0] / IMU_HZ
    idle[range(6, 9), range(6, 9)] = motion.rate_density[0, 0] / IMU_HZ
    for k in range(len(time_s) - 1):
        dt = time_s[k + 1] - time_s[k]
        f = (0.5 * (f_in[k] + f_in[k + 1]) - errors[0:3]) / (1.0 + errors[3:6])
        w = (0.5 * (w_in[k] + w_in[k + 1]) - errors[6:9]) / (1.0 + errors[9:12])
        c = matrix(turned(q, 0.5 * dt * w))
        g, gradient = gravity(p)
        a = c @ f + g - spin @ (spin @ p + 2.0 * v)
        p, v = p + dt * v + 0.5 * dt**2 * a, v + dt * a
        q = turned(turned(q, dt * w), -dt * (c.T @ earth.OMEGA_ECEF_RADPS))
        full = eye.copy()
        full[0:3, 3:6] = dt * eye[:3, :3]
        full[3:6, 0:3] = dt * gradient
        full[3:6, 3:6] -= 2.0 * dt * spin
        full[3:6, 6:9] = -dt * c @ skew(f)
        full[3:6, 9:12], full[3:6, 12:15] = -dt * c, -dt * c * f
        full[6:9, 6:9] -= dt * skew(w)
        full[range(6, 9), range(15, 18)], full[range(6, 9), range(18, 21)] = -dt, -dt * w
        filt.F, filt.Q = full, idle
        filt.predict()
        if k + 1 in radar:
            x = ned @ (p - site)
            slant, level = np.linalg.norm(x), np.hypot(x[0], x[1])
            h = np.array([slant, np.arctan2(x[1], x[0]), np.arctan2(-x[2], level)]) + errors[12:15]
            m = np.zeros((3, size))
            m[0, :3], m[1, :2] = x / slant, [-x[1] / level**2, x[0] / level**2]
            m[2, :3] = x[2] * x[0] / (slant**2 * level), x[2] * x[1] / (slant**2 * level), -level / slant**2
            m[:, :3] = m[:, :3] @ ned
            m[:, 21:24] = np.eye(3)
            y = z[round((k + 1) * RADAR_HZ / IMU_HZ)] - h
            y[1] = np.mod(y[1] + np.pi, 2 * np.pi) - np.pi
            filt.update(y, lambda _x, m=m: m, lambda _x: np.zeros(3), R=np.diag(noise / [1.0, np.cos(h[2]) ** 2, 1.0]))
            d = filt.x
            p, v, q, errors = p + d[0:3], v + d[3:6], turned(q, d[6:9]), errors + d[9:24]
            filt.x = np.zeros(size)
        for name, value in (("P", filt.P), ("F", full), ("Q", filt.Q), ("x", filt.x)):
            kept[name].append(value.copy())
    xs, ps, fs, qs = (np.array(kept[name]) for name in ("x", "P", "F", "Q"))
    return KalmanFilter.rts_smoother(filt, xs, ps, fs, qs)[1]  # the extended filter has none of its own


def peak_mib(what, seconds):
    """Peak memory of a process of its own that runs one of them, MiB."""
    code = (
        "import filter_and_smoother as b\n"
        f"args = b.flight({seconds})\n"
        + ("b.ours(b.problem_of(*args))\n" if what == "ours" else "b.with_filterpy(*args)\n")
        # of this process alone: ru_maxrss would begin at the parent's
        + "print([float(l.split()[1]) / 1024 for l in open('/proc/self/status') if l.startswith('VmHWM')][0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, check=True, capture_output=True, text=True
    )
    return float(done.stdout.split()[-1])


def main():
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else 500.0
    motion, node, start, z = flight(seconds)
    problem = problem_of(motion, node, start, z)
    run, smoothed = ours(problem)
    reference = smoothed.states(run.charts)
    pieces = {
        "ours": lambda: ours(problem, reference),
        "our filter": lambda: kalman.forward(problem, reference),
        "node by node": lambda: ours(problem),
    }
    with tempfile.TemporaryDirectory() as folder:
        if shutil.which("g++"):
            target = str(Path(folder) / "filter.so")
            flags = ["-std=c++17", "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
            subprocess.run(["g++", *flags, str(SOURCE), "-o", target], check=True)
            plain = Plain(ctypes.CDLL(target), problem)
            out, variance = plain()
            sd = np.sqrt(smoothed.variance)
            off, off_sd = np.abs((out - smoothed.x) / sd).max(), np.abs(np.sqrt(variance) / sd - 1.0).max()
            print(f"C++ differs by {off:.1e} sd, its sds by {off_sd:.1e}")
            pieces["C++"] = plain
        else:
            print("g++ not installed: no C++ limit")
        shortest = minima(pieces, 5 * rounds, time.process_time)
        shortest |= minima({"filterpy": lambda: with_filterpy(motion, node, start, z)}, rounds, time.process_time)
    for name, t in shortest.items():
        print(f"{name:12s} {t:8.3f} s, {t / (seconds * IMU_HZ) * 1e6:7.2f} us a sample")
    print(f"filterpy / ours, time: {shortest['filterpy'] / shortest['ours']:.0f} (target 60 at least)")
    if "C++" in shortest:
        print(f"ours / C++, time: {shortest['ours'] / shortest['C++']:.2f} (target 1.75 at most)")
    mine, theirs = peak_mib("ours", seconds), peak_mib("filterpy", seconds)
    print(f"peak memory: ours {mine:.0f} MiB (target 400 at most), filterpy {theirs:.0f} MiB")
    print(f"ours / filterpy, memory: 1/{theirs / mine:.1f} (target 1/10 at most)")


if __name__ == "__main__":
    main()
