"""How far was the shell bent in the benchmark frame? Told by the joint: it bends by the moment that it carries.

The moment in the joint is what the centerbody needs to move as it does. Nothing else holds the centerbody (no air
force, as everywhere here), so that its accelerometer and gyros measure it, its swinging included::

    tau = I w' + w x I w - r x m f,      theta = kappa (tau_z, -tau_y)

``f`` is the specific force at the centerbody's c.g., ``r`` the joint from there, ``kappa`` the joint's compliance, of
which next to nothing is known before. The film reads what the bending is beyond the benchmark frame's::

    read_i = theta(t_i) - R_i theta(t_b) + camera's error,     theta(t) = kappa (m(t) + A(t) x) + slack(t)

Unknown are kappa, the ``x ~ N(0, 1)`` of the moment (the accelerometer's constant errors, the centerbody's c.g. and
inertia) and the slack, what does not follow the law: freeplay, a spring that hardens, friction. Its size is found
too, by the evidence of the readings over `SLACKS_RAD`: slack of a size that the film cannot rule out stays in the error
bar. All is Gaussian, and the bending of the benchmark, held as before by what it was taken to be, is one conditional
mean and covariance, a mixture over sizes of the slack.

The same film tells it and is mended by it, and the two errors are not independent: what errs alike in all frames looks
like a bending of the benchmark, and is taken out with it. With ``theta(t_b) = K read``, the error ``e`` of a frame and
that of the benchmark's bending have the covariance ``cov(e, readings' errors) K'``.

Source: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, chapters 2 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from estimators.pulse import PulseData
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.deflection import lv_clock

LEAST_FRAMES, MOST_FRAMES = 12, 150
LONGEST_HOLE_S = 0.11
LOADED = 3.0  # largest moment over the benchmark's
WORST_CLOCK_S = 0.03  # half a radian of swinging at 2.5 Hz
LEFT_OUT = 0.05  # of the bending: damping, swings that the sensors' windows smooth
SLACK_TIME_S = 2.5
SLACKS_DEG, FREEPLAYS_DEG = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64), (0.0, 0.05, 0.1, 0.2, 0.4, 0.8)
SIZES_RAD = np.deg2rad(list(product(SLACKS_DEG, FREEPLAYS_DEG)))
USUAL_RAD = np.deg2rad([0.04, 0.1])  # sizes at which the compliance is found that the law's errors go by
PASSES = 2
VAGUE = 30.0  # prior sd of the compliance, in the values found


@dataclass(frozen=True)
class BenchmarkBending:
    """Bending of the benchmark frame as a lateral vector (2,), rad, body y and z, and its covariance (2, 2).

    ``with_readings`` (n, 2, 2): covariance of every reading's error (rows) with this one's; None: they are independent.
    """

    theta_yz_rad: FloatArray
    covariance: FloatArray
    with_readings: FloatArray | None = None

    @property
    def words(self) -> str:
        """In a sentence's middle."""
        size = np.rad2deg(np.hypot(*self.theta_yz_rad))
        sd = np.rad2deg(np.sqrt(0.5 * np.trace(self.covariance)))
        clock = np.rad2deg(lv_clock(self.theta_yz_rad))
        return (
            f"bent by {size:.2f} deg towards {clock:.0f} deg LV there within {sd:.2f} deg an axis, by the moment that "
            "the sensors measured in the joint"
        )


@dataclass(frozen=True)
class ReadFrames:
    """What a film read of the bending beyond its benchmark frame's; lateral vectors, body y and z.

    Parameters
    ----------
    time_s : (n,) float
    theta_yz_rad : (n, 2) float
    covariance : (n, 2, 2) float
        Without the benchmark's bending.
    per_benchmark : (n, 2, 2) float
        ``R``: what is missing of a reading per unit bending of the benchmark.
    benchmark_s : float
    clock_sd_s : float
        How well the frames' times are known against the gyros'.
    """

    time_s: FloatArray
    theta_yz_rad: FloatArray
    covariance: FloatArray
    per_benchmark: FloatArray
    benchmark_s: float
    clock_sd_s: float = 0.0


@dataclass(frozen=True)
class _Moment:
    """At times (n,): moment as a lateral vector (n, 2), N m, what it is uncertain by (n, 2, k), its noise's sd."""

    value_nm: FloatArray
    by_input_nm: FloatArray
    noise_nm: float

    def at(self, time_s: FloatArray, at_s: FloatArray) -> _Moment:
        """Linear interpolation."""
        flat = np.concatenate([self.value_nm[:, :, None], self.by_input_nm], axis=2).reshape(len(time_s), -1)
        here = np.stack([np.interp(at_s, time_s, column) for column in flat.T], axis=-1).reshape(len(at_s), 2, -1)
        return _Moment(here[:, :, 0], here[:, :, 1:], self.noise_nm)


def joint_moment(pulse: PulseData) -> _Moment:
    """Moment in the joint, positive where it bends the shell towards the vector, at all samples of the pulse."""
    vehicle, body = pulse.vehicle, pulse.vehicle.centerbody
    known, rate, turn = vehicle.uncertainty, pulse.rate_body_radps, pulse.angular_acceleration_body_radps2
    from_cg = body.cg_m - vehicle.cg_m
    force = pulse.specific_force_body_mps2 + np.cross(turn, from_cg) + np.cross(rate, np.cross(rate, from_cg))
    arm = vehicle.joint_m - body.cg_m
    spin = turn @ body.inertia.T + np.cross(rate, rate @ body.inertia.T)
    shifts = np.diag([known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m])
    parts = [known.inertia * spin, *(np.cross(shift, body.mass_kg * force) for shift in shifts)]
    parts += [-np.cross(arm, body.mass_kg * column) for column in np.moveaxis(pulse.force_root_mps2, 2, 0)]
    noise = np.hypot(
        body.inertia[1, 1] * pulse.angular_acceleration_sd_radps2,
        abs(arm[0]) * body.mass_kg * pulse.force_noise_sd_mps2,
    )
    value = spin - np.cross(arm, body.mass_kg * force)
    return _Moment(_lateral(value), np.stack([_lateral(part) for part in parts], axis=-1), float(noise))


def _lateral(moment: FloatArray) -> FloatArray:
    return np.stack([moment[:, 2], -moment[:, 1]], axis=-1)


def benchmark_bending(frames: ReadFrames, pulse: PulseData, held_rad: float) -> BenchmarkBending:
    """Bending of the benchmark frame from the moment in the joint.

    Parameters
    ----------
    frames : ReadFrames
    pulse : PulseData
    held_rad : float
        Sd of each axis before, about zero.

    Raises
    ------
    GateError
        Where it cannot be told, with the reason.
    """
    if frames.clock_sd_s > WORST_CLOCK_S:
        raise GateError(f"the film's clock is known to {frames.clock_sd_s:.2f} s, where the joint swings in 0.4 s")
    known = np.isfinite(frames.theta_yz_rad).all(axis=1) & _measured(frames.time_s, pulse.time_s)
    if not _measured(np.array([frames.benchmark_s]), pulse.time_s)[0]:
        raise GateError("accelerometer and gyros have no data at the benchmark frame")
    rows = np.flatnonzero(known)
    rows = rows[:: max(1, -(-len(rows) // MOST_FRAMES))]
    if len(rows) < LEAST_FRAMES:
        raise GateError(f"{len(rows)} frames with sensor data where {LEAST_FRAMES} are wanted")
    times = np.append(frames.time_s[rows], frames.benchmark_s)
    whole = joint_moment(pulse)
    moment = whole.at(pulse.time_s, times)
    size = np.linalg.norm(moment.value_nm, axis=1)
    if size.max() < LOADED * size[-1]:
        raise GateError("the joint carries hardly more in any frame than in the benchmark frame")
    if frames.clock_sd_s > 0.0:
        late = whole.at(pulse.time_s, times + frames.clock_sd_s).value_nm - moment.value_nm
        moment = _Moment(
            moment.value_nm, np.concatenate([moment.by_input_nm, late[:, :, None]], axis=2), whole.noise_nm
        )
    return _mixture(frames, rows, times, moment, held_rad)


def _measured(at_s: FloatArray, time_s: FloatArray) -> BoolArray:
    """Whether there are samples close to both sides."""
    after = np.searchsorted(time_s, at_s).clip(1, len(time_s) - 1)
    inside = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    return np.asarray(inside & (time_s[after] - time_s[after - 1] < LONGEST_HOLE_S))


def _mixture(
    frames: ReadFrames, rows: NDArray[np.intp], times: FloatArray, moment: _Moment, held_rad: float
) -> BenchmarkBending:
    """Posterior of the benchmark's bending over all sizes of the slack."""
    n = len(rows)
    look = np.hstack([np.eye(2 * n), -frames.per_benchmark[rows].reshape(2 * n, 2)])
    held = np.hstack([np.zeros((2, 2 * n)), np.eye(2)])
    look = np.vstack([look, held])  # the benchmark is held at zero as well: a reading more
    read = np.append(frames.theta_yz_rad[rows].ravel(), np.zeros(2))
    camera = _camera_covariance(frames, rows, rows)
    apart = np.abs(times[:, None] - times[None, :])
    follows = np.asarray(np.kron(np.exp(-apart / SLACK_TIME_S), np.eye(2)), dtype=float)
    # freeplay is taken up towards the moment's side, as far as that is known
    sd_nm = np.sqrt(np.sum(moment.by_input_nm**2, axis=(1, 2)) + moment.noise_nm**2)
    length = np.hypot(np.linalg.norm(moment.value_nm, axis=1), sd_nm)
    side, loose = (moment.value_nm / length[:, None]).ravel(), np.repeat(sd_nm / length, 2)
    taken_up = np.outer(side, side) + np.outer(loose, loose) * follows
    load = (look @ moment.value_nm.ravel())[: 2 * n]
    compliance = float(load @ read[: 2 * n] / (load @ load))

    def posterior(slack_rad: float, freeplay_rad: float) -> _Posterior:
        error = block_diag(camera, (held_rad**2 + slack_rad**2 + freeplay_rad**2) * np.eye(2))
        law = _law_covariance(moment, compliance, follows)
        return _posterior(law + slack_rad**2 * follows + freeplay_rad**2 * taken_up, look, read, error, moment)

    for _ in range(PASSES):
        compliance = posterior(*USUAL_RAD).compliance
    found = [posterior(*sizes) for sizes in SIZES_RAD]
    evidence = np.array([one.log_evidence for one in found])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    gain = np.einsum("k,kij->ij", weight, [one.gain for one in found])
    mean = gain @ read
    off = np.array([one.gain @ read for one in found]) - mean
    spread = np.einsum("k,kij->ij", weight, [one.covariance for one in found]) + (weight * off.T) @ off
    # shapes of slack and freeplay are guesses: what there is of them here stays in the error bar
    slack_var, freeplay_var = weight @ SIZES_RAD**2
    stays = float(slack_var + freeplay_var * loose[-1] ** 2)
    seen = np.flatnonzero(np.isfinite(frames.theta_yz_rad).all(axis=1))
    together = np.full((len(frames.time_s), 2, 2), np.nan)
    together[seen] = (_camera_covariance(frames, seen, rows) @ gain[:, : 2 * n].T).reshape(-1, 2, 2)
    return BenchmarkBending(np.asarray(mean), np.asarray(spread + stays * np.eye(2)), together)


def _camera_covariance(frames: ReadFrames, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> FloatArray:
    """Of readings, (2 n, 2 m): a part lasts, the rest forgets with the light, as the fusion takes it."""
    ends = []
    for k in (rows, columns):
        value, axes = np.linalg.eigh(frames.covariance[k])
        ends.append((axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1))
    apart = np.abs(frames.time_s[rows][:, None] - frames.time_s[columns][None, :])
    shared = CONSTANT_PART + (1.0 - CONSTANT_PART) * np.exp(-apart / LIGHT_TIME_S)
    both = np.einsum("iab,ij,jcb->iajc", ends[0], shared, ends[1])
    return np.asarray(both.reshape(2 * len(rows), 2 * len(columns)))


def _law_covariance(moment: _Moment, compliance: float, follows: FloatArray) -> FloatArray:
    """Of the bending at all times, without slack: of a compliance that is vague, of the moment, of what is left out."""
    flat = compliance * moment.value_nm.ravel()
    inputs = compliance * moment.by_input_nm.reshape(len(flat), -1)
    size = LEFT_OUT * np.repeat(compliance * np.linalg.norm(moment.value_nm, axis=1), 2)
    noise = (compliance * moment.noise_nm) ** 2 * np.eye(len(flat))
    return VAGUE**2 * np.outer(flat, flat) + inputs @ inputs.T + np.outer(size, size) * follows + noise


@dataclass(frozen=True)
class _Posterior:
    """Of the benchmark's bending: gain (2, m) on the readings, covariance, compliance, logarithm of the evidence."""

    gain: FloatArray
    covariance: FloatArray
    compliance: float
    log_evidence: float


def _posterior(
    bending: FloatArray, look: FloatArray, read: FloatArray, error: FloatArray, moment: _Moment
) -> _Posterior:
    cross = bending @ look.T
    factor = cho_factor(look @ cross + error, lower=True)
    solved = cho_solve(factor, read)
    theta = cross @ solved
    last = slice(-2, None)
    gain = cho_solve(factor, cross[last].T).T
    covariance = bending[last, last] - gain @ cross[last].T
    flat = moment.value_nm.ravel()
    log = -0.5 * float(read @ solved) - float(np.log(np.diag(factor[0])).sum())
    return _Posterior(gain, covariance, float(flat @ theta / (flat @ flat)), log)
