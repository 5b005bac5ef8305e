"""What does another tracker take? Its components, its slots, and one function with its partials: here they are.

A range difference is by how much a point is farther from one site than from another (time difference of arrival), with
a bias. Kernels run interpreted, in a process of their own: compiled ones hold the trackers they were compiled with.
"""

import os
import subprocess
import sys

import numpy as np

from flightmodel import earth
from recon import kalman, linearise, measurements, problem, propagation
from recon.state import Block, ErrorModel, States, boxminus, boxplus

from .test_published_answers import known_flight

PLACES = {"w": (-0.5, 0.27), "e": (-0.48, 0.32), "s": (-0.53, 0.31)}
SITES = {name: earth.ecef_from_geodetic(*at, 50.0) for name, at in PLACES.items()}
NEAR, NOISE, BIAS = earth.ecef_from_geodetic(-0.505, 0.3, 20.0), 0.5, 8.0
KIND = len(measurements.COMPONENTS)
measurements.COMPONENTS[KIND], measurements.SLOT_NAMES[KIND] = ("range difference",), ("bias",)
others = linearise.predict


def predict(kind, arm, site, dcm, known, e, position, *rest):
    h, by_state, by_error = rest[4:7]
    others(kind if kind != KIND else measurements.HEIGHT, arm, site, dcm, known, e, position, *rest)
    if kind == KIND:
        far, near = position - site, position - known
        h[0], by_state[0], by_error[0] = np.linalg.norm(far) - np.linalg.norm(near) + e[0], 0.0, 0.0
        by_state[0, :3], by_error[0, 0] = far / np.linalg.norm(far) - near / np.linalg.norm(near), 1.0


def flown(rng):
    """A free fall of eleven seconds with three range differences a second; the problem and its true states."""
    (motion, start, _), nodes = known_flight(12), np.arange(12)
    blocks = (
        Block("all", tuple("abcdefghijklmnopqr"), "1", 1e-9),
        *(Block(name, ("bias",), "m", BIAS) for name in SITES),
    )
    errors = np.r_[np.zeros(18), rng.normal(0.0, BIAS, 3)]
    first = States(start.position_ecef_m, start.velocity_ecef_mps, start.q_ecef_body, errors)
    states = [first, *(propagation.propagate(motion, 0, k, first).state for k in nodes[1:])]
    place, trackers = np.array([s.position_ecef_m for s in states]), []
    for (name, site), bias in zip(SITES.items(), errors[18:], strict=True):
        apart = np.linalg.norm(place - site, axis=1) - np.linalg.norm(place - NEAR, axis=1)
        value = np.column_stack([apart + bias + rng.normal(0.0, NOISE, 12), np.full((12, 2), np.nan)])
        axes, sd, known = (np.zeros(3), site, np.eye(3)), np.full(3, NOISE), np.tile(NEAR, (12, 1))
        trackers.append(measurements.instrument_of(name, KIND, name, *axes, motion.time_s, value, sd, known))
    sd = np.r_[np.full(3, 50.0), np.full(3, 5.0), np.full(21, 1e-9), np.full(3, BIAS)]
    begin = boxplus(first, np.r_[sd[:6] * rng.standard_normal(6), np.zeros(21), -errors[18:]])
    seen, made = (
        problem.observe(motion.time_s, tuple(trackers)),
        (begin, np.diag(sd**2), np.full(4, np.inf), nodes >= 0),
    )
    at = motion.time_s, nodes, motion, ErrorModel(blocks), tuple(trackers)
    return problem.Problem(*at, seen[1], seen[0], *made), states


def test_a_new_tracker_takes_slots_and_one_function():
    """Over 12 flights the normalised errors at the end and the innovations are as large as stated (4 sd)."""
    alone = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    out = subprocess.run([sys.executable, "-m", __name__], env=alone, check=True, capture_output=True)
    off, innovations = map(float, out.stdout.split())
    assert abs(off - 9.0) < 4.0 * np.sqrt(2.0 * 9.0 / 12)
    assert abs(innovations - 36.0) < 4.0 * np.sqrt(2.0 * 36.0 / 12)


if __name__ == "__main__":
    linearise.predict, sums = predict, []
    for seed in range(12):
        flight, true = flown(np.random.default_rng(seed))
        run, rows = kalman.forward(flight), np.r_[0:6, 27:30]
        error, covariance = boxminus(run.states()[11], true[11])[rows], run.filtered.p_last[np.ix_(rows, rows)]
        sums.append((error @ np.linalg.solve(covariance, error), run.innovations.nis.sum()))
    sys.stdout.write("{} {}".format(*np.mean(sums, axis=0)))
