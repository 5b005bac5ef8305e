"""Which one fault explains the flight best? Single hypotheses, each by the likelihood of all tracking data.

Where a consistency check fails, no error is freed before each source has been tried alone: another time bias, bias,
scale or mounting of each triad, biases, time bias or noise of each tracker, refraction, the attitude prior. A
hypothesis is the same flight with one kind of error that may be `WIDER` times its data sheet (or noise so much
larger), and what the oscillation of the vehicle shows (`recon.oscillation`) as a correction of the one or the other
triad. Its score is the filter's log likelihood over that of the flight as stated,

    log L = -1/2 sum (min(nis, gate) + log det S)

over the innovations of thinned data. The wide prior is part of ``S``, so that a hypothesis pays for its freedom (the
marginal likelihood of Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773), and all are equally likely beforehand. A
point that the gate rejects counts as one at the gate. A hypothesis under which the innovations still are larger than
predicted explains nothing, however much likelier it is. The best is named from a hundred to one on; others beside it
that are hardly less likely.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from flightmodel.instruments import RadarSite
from flightmodel.telemetry import Telemetry, TriadRecord
from recon.oscillation import MIRRORED, ROLL, Oscillation
from recon.problem import Problem
from recon.time_bias import Lag

WIDER = 30.0  # times the stated sd: a misaligned or mistimed sensor is some tens of them off
_NOISIER = 10.0  # times the stated noise: of a sensor of another grade, or a loose connector
_G, _DEGREE = earth.STANDARD_GRAVITY_MPS2, np.pi / 180.0
_UNIT_SLIPS = {"accelerometer": (_G, 1.0 / _G), "rates": (_DEGREE, 1.0 / _DEGREE)}
_SERVO_HZ, _SERVO_LAG_SD = 0.5, 3.0  # the lag goes with 1 / Hz^2: from none to that of a quarter of a hertz within 1 sd
_PRIOR_SD_RAD = np.deg2rad(30.0)  # a linear filter converges from so far; starts a quarter turn apart reach everything
_LEAST_GAIN = np.log(100.0)  # over the flight as stated, of which a check has failed already
_LARGEST_MISFIT = 1.3  # of the mean normalised innovation squared of some hundred points, 4 sd
_ALSO = np.log(20.0)  # odds below which the next source is named too
TRIADS = ("accelerometer", "rates")
_KINDS = {  # of a triad's errors, by the name that they have in the error model, and the code
    "time bias": "time-bias",
    "mount": "mounting",
    "scale": "scale",
    "bias": "bias",
}


@dataclass(frozen=True)
class Hypothesis:
    """One fault hypothesis: its words, and the telemetry with that fault corrected.

    Parameters
    ----------
    code, words : str
    sources : tuple of str
    telemetry : Telemetry
    inflated_sd : dict
        Standard deviations of errors, by name.
    noisier : dict
        Factors on the noise of instruments, by owner.
    """

    code: str
    words: str
    sources: tuple[str, ...]
    telemetry: Telemetry
    inflated_sd: dict[str, float] = field(default_factory=dict)
    noisier: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Explanation:
    """A hypothesis with its log likelihood over that of the flight as stated, and the innovations' mean square.

    ``late_s`` is by how much it sets tags of trackers back.
    """

    code: str
    words: str
    sources: tuple[str, ...]
    gain: float
    misfit: float = 1.0
    late_s: float = 0.0


def with_noise(problem: Problem, noisier: dict[str, float]) -> Problem:
    """Problem in which instruments of these owners are noisier."""
    variance = problem.observed.variance.copy()
    for number, instrument in enumerate(problem.instruments):
        if instrument.owner in noisier:
            variance[problem.observed.source == number] *= noisier[instrument.owner] ** 2
    return replace(problem, observed=problem.observed._replace(variance=variance))


def corrections(telemetry: Telemetry, found: Oscillation | None, lag: Lag | None) -> list[Hypothesis]:
    """Corrections of both triads according to the oscillation; empty if it shows no error."""
    force, rate = telemetry.accelerometer, telemetry.rates
    if force is None or rate is None:
        return []
    if lag is not None:
        size = f"{1e3 * abs(lag.lag_s):.0f} ± {1e3 * lag.sd_s:.1f} ms"
        ways = ("late", "early") if lag.lag_s > 0.0 else ("early", "late")
        words = [f"{name}: time tags {size} {way}" for name, way in zip(TRIADS, ways, strict=True)]
        pair = replace(force, time_s=force.time_s - lag.lag_s), replace(rate, time_s=rate.time_s + lag.lag_s)
        return _of_either("time-bias", words, telemetry, *pair)
    if found is None or found.kind not in (ROLL, MIRRORED):
        return []
    # roll: F = k i e^(i phase) W', mirrored: F = k i e^(i phase) conj(W)', so conj(F) = -k i e^(-i phase) W'
    turn = rotations.dcm_from_q(rotations.exp(np.array([found.roll_rad, 0.0, 0.0])))
    if found.kind == ROLL:
        words = [f"{name}: mounting about roll" for name in TRIADS]
        return _of_either("triads-axes", words, telemetry, _turned(force, turn.T), _turned(rate, turn))
    words = [f"{name}: order or sign of its axes" for name in TRIADS]
    flip = np.diag([1.0, 1.0, -1.0])
    opposite = np.diag([1.0, -1.0, -1.0])
    return _of_either(
        "triads-axes", words, telemetry, _turned(force, opposite @ turn @ flip), _turned(rate, turn @ flip)
    )


def _of_either(
    code: str, words: list[str], telemetry: Telemetry, force: TriadRecord, rate: TriadRecord
) -> list[Hypothesis]:
    """Hypotheses that the one or the other triad is to be corrected."""
    return [
        Hypothesis(code, words[0], (TRIADS[0],), replace(telemetry, accelerometer=force)),
        Hypothesis(code, words[1], (TRIADS[1],), replace(telemetry, rates=rate)),
    ]


def _turned(record: TriadRecord, matrix: FloatArray) -> TriadRecord:
    """Record whose readings, in body axes, are multiplied by a matrix."""
    sensor, measured = record.spec.dcm_body_sensor, record.measured_sensor
    turned = np.nan_to_num(measured) @ (sensor.T @ matrix @ sensor).T  # a channel that is missing leaves the others
    return replace(record, measured_sensor=np.where(np.isfinite(measured), turned, np.nan))


def hypotheses_of(telemetry: Telemetry, trackers: Iterable[str], prior_sd: dict[str, float]) -> list[Hypothesis]:
    """Every single hypothesis of a flight; ``prior_sd`` is of its errors by name, owner first."""
    out: list[Hypothesis] = []
    for triad in (telemetry.accelerometer, telemetry.rates):
        if triad is None:
            continue
        name = triad.spec.name
        for kind, code in _KINDS.items():
            wide = {k: WIDER * sd for k, sd in prior_sd.items() if k.startswith(f"{name} {kind}")}
            if wide:
                out.append(Hypothesis(code, f"{name}: {kind}", (name,), telemetry, wide))
    clocks = {f"{name} time bias": WIDER * prior_sd.get(f"{name} time bias", 0.0) for name in TRIADS}
    if any(clocks.values()):
        out.append(Hypothesis("time-bias", "clock of both inertial sensors", TRIADS, telemetry, clocks))
    for name in trackers:
        own = {k: WIDER * sd for k, sd in prior_sd.items() if k.startswith(f"{name} ") and sd > 0.0}
        late = {k: sd for k, sd in own.items() if k == f"{name} time bias"}
        rest = {k: sd for k, sd in own.items() if k not in late}
        # beside inertial sensors `recon.tracker_time` tries the tags of radars and receivers
        if late and (telemetry.motion.model == "ballistic" or name in telemetry.barometers):
            out.append(Hypothesis("time-bias", f"{name}: time bias", (name,), telemetry, late))
        if rest:
            out.append(Hypothesis("tracker", f"{name}: site or calibration", (name,), telemetry, rest))
        out.append(Hypothesis("tracker", f"{name}: noise", (name,), telemetry, noisier={name: _NOISIER}))
    if telemetry.radars:
        names = tuple(telemetry.radars)
        bent = _with_sites(telemetry, lambda site: replace(site, refraction_sd=1.0))
        slow = _with_sites(telemetry, _slower)
        out.append(Hypothesis("refraction", "refraction of the radars", names, bent))
        out.append(Hypothesis("servo-lag", "servo of the radars", names, slow))
    return out + _attitudes(telemetry) + _slips(telemetry)


def _with_sites(telemetry: Telemetry, changed: Callable[[RadarSite], RadarSite]) -> Telemetry:
    """Telemetry whose radars' sites state something else."""
    radars = {name: replace(r, spec=changed(r.spec)) for name, r in telemetry.radars.items()}
    return replace(telemetry, radars=radars)


def _slower(site: RadarSite) -> RadarSite:
    """Site whose servo may lag by as much as that of a slow one, whatever bandwidth is stated."""
    hz = site.angle_servo_hz or _SERVO_HZ
    return replace(site, angle_servo_hz=hz, servo_lag_sd=_SERVO_LAG_SD * (hz / _SERVO_HZ) ** 2)


def _slips(telemetry: Telemetry) -> list[Hypothesis]:
    """Readings of a wrong unit, or of wrong sign about the long axis, which the oscillation does not show."""
    out = []
    for name, record in (("accelerometer", telemetry.accelerometer), ("rates", telemetry.rates)):
        if record is None:
            continue
        slips = {f"unit of its readings, times {factor:.3g}": factor * np.eye(3) for factor in _UNIT_SLIPS[name]}
        if name == "rates":
            slips["sign of its roll rate"] = np.diag([-1.0, 1.0, 1.0])
        for words, matrix in slips.items():
            changed = _turned(record, matrix)
            flight = (
                replace(telemetry, accelerometer=changed) if name == TRIADS[0] else replace(telemetry, rates=changed)
            )
            out.append(Hypothesis("units-and-signs", f"{name}: {words}", (name,), flight))
    return out


def _attitudes(telemetry: Telemetry) -> list[Hypothesis]:
    """Another attitude prior, from four starts about roll."""
    prior = telemetry.attitude_prior
    if prior is None:
        return []
    out = []
    for quarter in range(4):
        half = 0.25 * np.pi * quarter
        q = rotations.multiply(prior.q_ecef_body, np.array([np.cos(half), np.sin(half), 0.0, 0.0]))
        wide = replace(prior, q_ecef_body=q, sd_rad=np.maximum(prior.sd_rad, _PRIOR_SD_RAD))
        words = "attitude prior"
        out.append(Hypothesis("attitude-prior", words, ("attitude_prior",), replace(telemetry, attitude_prior=wide)))
    return out


def ranked(found: list[Explanation], shown: bool = False) -> tuple[Explanation, ...]:
    """Hypotheses that explain the flight, the likeliest first, each source once.

    Where it is ``shown`` that one of them holds, none needs to be likelier than the flight as stated.
    """
    out: dict[tuple[str, ...], Explanation] = {}
    for one in sorted(found, key=lambda f: -f.gain):
        if shown or (one.gain > _LEAST_GAIN and one.misfit < _LARGEST_MISFIT):
            out.setdefault(one.sources, one)
    return tuple(out.values())


def likeliest(found: tuple[Explanation, ...]) -> tuple[Explanation, ...]:
    """The likeliest, and those that are hardly less likely."""
    return tuple(f for f in found if f.gain > found[0].gain - _ALSO)
