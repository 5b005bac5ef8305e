"""Does an accelerometer without gyros read what a drag does? Checks of its readings themselves.

The drag follows each reading, so that no innovation tests it. What is left: the mean before the air is felt against the
stated bias, steps that neither air nor trim make, and forces across the axis that a trimmed vehicle does not have.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from flightmodel import earth
from flightmodel.checks import Check, FloatArray
from flightmodel.statistics import NORMAL_MAD
from flightmodel.telemetry import Telemetry
from recon.kalman import ForwardPass
from recon.measurements import DECELERATION
from recon.problem import Problem
from recon.state import States

_LEAST_QUIET = 20  # readings: a second of them
_MOST_FELT = 3.0  # beyond it the drag hides a bias that the check should show
_CLEARLY_FELT = 50.0  # times its noise: steps of a twentieth are then clear
_NEIGHBOURS = 5  # readings before and after a step: a quarter of a second at the rate of block means
_OVERTURNING = 2.0 / 7.0  # (gamma - 1) / gamma of a gas of two atoms; carbon dioxide has 0.25


def deceleration_checks(telemetry: Telemetry, problem: Problem, run: ForwardPass, confidence: float) -> list[Check]:
    """Every check of an accelerometer that the drag follows; none of another flight."""
    trim_sd_rad = telemetry.motion.trim_sd_rad
    return [
        *vacuum_checks(problem, run, confidence),
        *reading_jump_checks(problem, run, trim_sd_rad, confidence),
        *lateral_checks(telemetry, confidence),
    ]


def lateral_checks(telemetry: Telemetry, confidence: float) -> list[Check]:
    """Check whether measured normal forces are within the limits of the stated trim.

    Their rms over the strongest readings, over the axial mean, is the tangent of the angle between body x and the
    force: of a trimmed blunt body about its angle of attack, of a lifting one ``side_sd``; mount and bias add theirs.
    An axis that is off by 10 deg takes 1.5 % from the deceleration, which nothing else shows.
    """
    record, motion = telemetry.drag_accelerometer, telemetry.motion
    if record is None or not np.isfinite(record.measured_sensor).all(axis=1).any():
        return []
    spec = record.spec
    force = record.measured_sensor[np.isfinite(record.measured_sensor).all(axis=1)] @ spec.dcm_body_sensor.T
    axial = np.abs(force[:, 0])
    strong = axial > 0.5 * np.quantile(axial, 0.95)  # which is a peak, beside wild readings
    mean = float(axial[strong].mean())
    if strong.sum() < _LEAST_QUIET or mean < _CLEARLY_FELT * max(spec.noise_sd, spec.bias_sd):
        return []
    across = np.sqrt(max(float(np.mean(np.sum(force[strong, 1:] ** 2, axis=1))) - 2.0 * spec.noise_sd**2, 0.0)) / mean
    sd = float(np.linalg.norm([max(motion.trim_sd_rad, motion.side_sd), spec.mount_sd_rad, spec.bias_sd / mean]))
    degrees = np.rad2deg(np.arctan(across))
    found = f"the force lies {degrees:.2g} deg from body x where it is strongest"
    # normal in both directions across: Rayleigh's distribution
    most = float(np.sqrt(-2.0 * np.log(1.0 - confidence)))
    return [
        Check.of(
            "lateral-reading", f"lateral reading {spec.name}", across / sd, 0.0, most,
            f"{found}, as trim allows", found,
            advice="its axes are not the body's (state axes), or the vehicle trims at an angle: state trim_sd_deg, and "
            "side_sd of a lifting vehicle",
            source=spec.name,
        )
    ]  # fmt: skip


def vacuum_checks(problem: Problem, run: ForwardPass, confidence: float) -> list[Check]:
    """Whether an accelerometer that the drag follows reads its bias, as stated, before the air is felt.

    Of a bias that is only considered, without a tracker, nothing else shows that it is larger: the drag takes it. Air
    may be denser than stated by twice its sd; what is beyond that drag is the bias. None where the data begin in air
    whose drag is larger than `_MOST_FELT` of the bias's sd.
    """
    out = []
    for number, instrument in enumerate(problem.instruments):
        rows = np.flatnonzero((problem.observed.source == number) & problem.observed.usable)
        bias = problem.model.column(instrument.owner, "bias")
        if instrument.kind != DECELERATION or not problem.model.wander.considered[bias] or len(rows) < _LEAST_QUIET:
            continue
        bias_sd, most = float(problem.model.prior_sd[bias]), _most_drag(problem, run.states()[problem.node[rows]])
        quiet = rows[: max(_LEAST_QUIET, int(np.argmax(np.append(most > bias_sd, True))))]
        drag = float(most[: len(quiet)].mean())
        if drag > _MOST_FELT * bias_sd:
            continue
        mean = float(run.innovations.residual[quiet, 0].mean())
        sd = float(np.hypot(bias_sd, np.sqrt(problem.observed.variance[quiet, 0].mean() / len(quiet))))
        beyond = max(mean - drag, -mean, 0.0) / sd
        found = f"before the air is felt it reads {-mean:+.2g} m/s2, {beyond:.1f} sd of its bias beyond the drag there"
        out.append(
            Check.of(
                "vacuum-reading", f"vacuum reading {instrument.owner}", beyond, 0.0,
                float(-ndtri(0.5 * (1.0 - confidence))), found, found,
                advice="take this mean from all readings, state a larger bias_sd, or check t_s and the unit",
                source=instrument.owner, component="bias",
            )
        )  # fmt: skip
    return out


def reading_jump_checks(problem: Problem, run: ForwardPass, trim_sd_rad: float, confidence: float) -> list[Check]:
    """Check for jumps between consecutive decelerations, as after deleted rows whose times were closed up.

    From reading to reading density follows the height, and what that may differ from the neighbours' course is limited:
    a layer cools upwards by ``g / c_p`` at most before it overturns, so that ``d ln rho`` differs by `_OVERTURNING` of
    its usual self. A swing of the vehicle takes its sine's square from an axial force; one of as many sd of the trim as
    the limit has is as rare as the limit. A true step stays in
    the median of the readings that follow: a single wild one does not, and is edited.
    """
    out = []
    for number, instrument in enumerate(problem.instruments):
        rows = np.flatnonzero((problem.observed.source == number) & problem.observed.usable)
        if instrument.kind != DECELERATION:
            continue
        node, reading = problem.node[rows], problem.observed.value[rows, 0]
        noise = np.sqrt(problem.observed.variance[rows, 0])
        felt = reading > _CLEARLY_FELT * noise
        node, reading, noise = node[felt], reading[felt], noise[felt] / reading[felt]
        if len(reading) <= 2 * _NEIGHBOURS:
            continue
        time_s, air = problem.time_s[node], problem.motion.air_at(_height(problem, run.states()[node]))[0]
        step, level = np.diff(np.log(reading)), np.log(reading)
        beside = np.lib.stride_tricks.sliding_window_view(step, 2 * _NEIGHBOURS - 1)
        k = np.arange(_NEIGHBOURS - 1, len(step) - _NEIGHBOURS + 1)  # of a step, with as many beside it
        usual = np.median(beside, axis=1)
        medians = np.median(np.lib.stride_tricks.sliding_window_view(level, _NEIGHBOURS), axis=1)
        lasting = medians[k + 1] - medians[k + 1 - _NEIGHBOURS] - _NEIGHBOURS * usual
        own = step[k] - usual
        jump = np.where(own * lasting > 0.0, np.minimum(np.abs(own), np.abs(lasting)), 0.0)
        scatter = NORMAL_MAD * np.median(np.abs(beside - usual[:, None]), axis=1)
        most = float(-ndtri(0.5 * (1.0 - confidence) / len(k)))
        swing = np.sin(min(most * trim_sd_rad, 0.5 * np.pi)) ** 2 / most
        sd = np.sqrt((_OVERTURNING * np.diff(air)[k]) ** 2 + swing**2 + 2.0 * noise[k] ** 2 + scatter**2)
        gap = np.lib.stride_tricks.sliding_window_view(np.diff(time_s), 2 * _NEIGHBOURS - 1).max(axis=1)
        whole = gap < 2.5 * np.median(np.diff(time_s))
        away = np.where(whole, jump / sd, 0.0)
        worst = int(np.argmax(away))
        when = f"from {time_s[k[worst]]:.2f} to {time_s[k[worst] + 1]:.2f} s"
        percent = 100.0 * np.expm1(own[worst])
        found = f"the deceleration changes by {percent:+.0f} % {when} beside its neighbours' course"
        out.append(
            Check.of(
                "reading-jump", f"reading jump {instrument.owner}", float(away[worst]), 0.0,
                most, f"{found}, as air may", found,
                advice="rows are missing and their times were closed up, a clock was set, the range was switched, or a "
                "parachute opened or a part separated: correct the times, or leave out what follows by use_s",
                source=instrument.owner, component=when,
            )
        )  # fmt: skip
    return out


def _height(problem: Problem, at: States) -> FloatArray:
    return np.asarray(earth.geodetic_from_ecef(at.position_ecef_m, problem.motion.planet)[2])


def _most_drag(problem: Problem, at: States) -> FloatArray:
    """Deceleration (n,), m/s^2, of air that is denser than stated by twice its sd."""
    motion = problem.motion
    log_density, _, _, density_sd, _ = motion.air_at(_height(problem, at))
    density = np.exp(log_density + 2.0 * density_sd)
    return np.asarray(0.5 * density * motion.drag_m2pkg * np.sum(at.velocity_ecef_mps**2, axis=1))
