"""What would the sensors have read in short spans of a flight, and how would each have ended?

Many spans at once: each starts from a motion of its own at the reconstruction's place and speed, and is flown by the
simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.observed import SPAN_S, WINDOWS, Observed
from synthetic_flight.ensemble import Schedule, Start, fly_ensemble

STEP_S = 0.004
PER_RECORD = 5  # two records a window: its mean is Simpson's of its ends and middle
RECORDS = 2 * WINDOWS + 1
# of a span's start: rotation against the reconstructed attitude, body's rate, shell's rotation vector against the body
# (x is its twist), shell's rate against the body, shell axes
MOTION = 12
ATTITUDE, RATE, BENDING, BENDING_RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Candidate:
    """A vehicle with its `packing.parameter_vector`."""

    vehicle: Vehicle
    parameters: FloatArray


@dataclass(frozen=True)
class Flights:
    """Spans to fly: which, with which candidate, from which motion, in which air.

    Parameters
    ----------
    span, candidate, table : (m,) int
    motion : (m, 12) float
    candidates : list of Candidate
    tables : list of (rows, 6) float
        Kernel tables of the air.
    """

    span: Index
    candidate: Index
    motion: FloatArray
    table: Index
    candidates: list[Candidate]
    tables: list[FloatArray]


@dataclass(frozen=True)
class Read:
    """What sensors read; NaN after a divergence.

    Parameters
    ----------
    windows, slope : (m, WINDOWS, 6) float
        Rates, rad/s, and specific force, m/s^2, means over windows, and how fast they change.
    bending : (m, WINDOWS, 3) float
        Shell's rotation vector against the body at the windows' middles, rad.
    end : (m, 12) float
        Motion at the end of the span, as the next one counts it.
    """

    windows: FloatArray
    slope: FloatArray
    bending: FloatArray
    end: FloatArray


def fly_spans(observed: Observed, told: Vehicle, flights: Flights) -> Read:
    """Fly spans and read the sensors."""
    starts = _start_states(observed, flights)

    def start_of(k: int) -> Start:
        return Start(starts[k], flights.candidates[flights.candidate[k]].parameters, flights.tables[flights.table[k]])

    states, aux = np.full((len(starts), RECORDS, 20), np.nan), np.full((len(starts), RECORDS, 18), np.nan)
    for flown in fly_ensemble(told, start_of, range(len(starts)), Schedule(STEP_S, PER_RECORD, RECORDS)):
        states[flown.run, : len(flown.states)], aux[flown.run, : len(flown.aux)] = flown.states, flown.aux
    windows, slope = _windows(observed, flights, states, aux)
    middle = states[:, 1::2]
    bent = rotations.log(rotations.multiply(rotations.conjugate(middle[..., 6:10]), middle[..., 10:14]))
    return Read(windows, slope, bent, _ends(observed, flights.span, states[:, -1]))


def _start_states(observed: Observed, flights: Flights) -> FloatArray:
    """States (m, 20) as `synthetic_flight.simulate.state_from_ecef` lays them out, of the bent vehicle's c.g."""
    at, span, motion = observed.start, flights.span, flights.motion
    vehicles = [c.vehicle for c in flights.candidates]
    cg = np.array([v.cg_m for v in vehicles])[flights.candidate]
    # of the shell's c.g., from the joint; its share in the vehicle's
    arm = np.array([v.aeroshell.cg_m - v.joint_m for v in vehicles])[flights.candidate]
    share = np.array([v.aeroshell.mass_kg / v.mass_kg for v in vehicles])[flights.candidate, None]
    q = rotations.boxplus(at.q_ecef_body[span], motion[:, ATTITUDE])
    omega, bent = motion[:, RATE], rotations.exp(motion[:, BENDING])
    shell_rate = rotations.rotate(rotations.conjugate(bent), omega) + motion[:, BENDING_RATE]
    place = cg + share * (rotations.rotate(bent, arm) - arm)
    swing = np.cross(omega, cg) + share * (rotations.rotate(bent, np.cross(shell_rate, arm)) - np.cross(omega, arm))
    r = at.position_ecef_m[span] + rotations.rotate(q, place)
    v = at.velocity_ecef_mps[span] + rotations.rotate(q, swing)
    to_eci = rotations.conjugate(earth.q_ecef_eci(at.time_s[span]))
    q_body = rotations.multiply(to_eci, q)
    return np.column_stack(
        [
            rotations.rotate(to_eci, r),
            rotations.rotate(to_eci, v + np.cross(earth.OMEGA_ECEF_RADPS, r)),
            q_body,
            rotations.multiply(q_body, bent),
            omega,
            shell_rate,
        ]
    )


def _windows(
    observed: Observed, flights: Flights, states: FloatArray, aux: FloatArray
) -> tuple[FloatArray, FloatArray]:
    bodies = [c.vehicle.centerbody for c in flights.candidates]
    arm = np.array([observed.accelerometer_m - body.cg_m for body in bodies])[flights.candidate][:, None]
    mass = np.array([body.mass_kg for body in bodies])[flights.candidate][:, None, None]
    omega, turn = states[..., 14:17], aux[..., 15:18]
    force = rotations.rotate(rotations.conjugate(states[..., 6:10]), aux[..., 6:9]) / mass
    force = force + np.cross(turn, arm) + np.cross(omega, np.cross(omega, arm))
    records = np.concatenate([omega, force], axis=2)
    before, middle, after = records[:, 0:-1:2], records[:, 1::2], records[:, 2::2]
    return (before + 4.0 * middle + after) / 6.0, (after - before) / (2.0 * PER_RECORD * STEP_S)


def _ends(observed: Observed, span: Index, state: FloatArray) -> FloatArray:
    """Motion as the next span counts it."""
    q_body, q_shell = state[:, 6:10], state[:, 10:14]
    q = rotations.multiply(earth.q_ecef_eci(observed.start.time_s[span] + SPAN_S), q_body)
    turned = rotations.boxminus(q, observed.start.q_ecef_body[span + 1])
    bent = rotations.multiply(rotations.conjugate(q_body), q_shell)
    across = state[:, 17:20] - rotations.rotate(rotations.conjugate(bent), state[:, 14:17])
    return np.column_stack([turned, state[:, 14:17], rotations.log(bent), across])
