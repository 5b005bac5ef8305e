"""Which part of the flight's data or models is most likely wrong? Red verdicts turned into sentences.

Evidence comes in this order. Where leaving one tracker out makes everything else agree, it is the tracker; where
leaving out any of several does, they contradict each other and nothing tells which is wrong; where no tracker can be
left out to that effect, it is what all of them meet: the inertial sensors or the motion. An error that the flight
found larger than its data sheet comes next, then the noise of the motion, then what magnetometer and Sun sensors say of
the attitude, and last the air, which takes no part in the trajectory and can only be as wrong as the trajectory is
right.
"""

from __future__ import annotations

import numpy as np

from recon.consistency import Verdict
from recon.disagreement import LeftOut, is_about

INERTIAL = ("accelerometer", "rates")
ATTITUDE = "attitude check"
CLOCKS = "clocks of "
AIR = ("sounding", "pre-flight", "air residuals")


def suspects(verdicts: tuple[Verdict, ...], left_out: tuple[LeftOut, ...]) -> tuple[str, ...]:
    """Sentences, the most likely suspect first; none where every verdict passes."""
    red = [v for v in verdicts if not v.passed]
    sheets = [v for v in red if v.name.startswith("data sheet ")]
    inertial = [v for v in sheets if v.name.removeprefix("data sheet ") in INERTIAL]
    inertial += [v for v in red if v.name.startswith(CLOCKS)]
    out = _trackers(red, left_out, inertial) if any(is_about(v, s.source) for v in red for s in left_out) else []
    if not out and not left_out:
        out += _lone_trackers(red)
    cured = any(s.cures for s in left_out)
    if inertial and not cured and not any("inertial" in words for words in out):
        out.append(_inertial(inertial))
    if any(v.name.startswith("filter-smoother") for v in red) and not out:
        out.append("the motion: filter and smoother differ more than the sensors' noise and errors explain")
    attitude = dict.fromkeys(f"the attitude: {v.words}" for v in red if v.name.startswith(ATTITUDE))
    return (*out, *attitude, *(f"the air: {v.words}" for v in red if v.name.startswith(AIR)))


def _trackers(red: list[Verdict], left_out: tuple[LeftOut, ...], inertial: list[Verdict]) -> list[str]:
    cured = [s for s in left_out if s.cures]
    if len(cured) == 1:
        s = cured[0]
        mine = "; ".join(dict.fromkeys(_short(v) for v in red if is_about(v, s.source)))
        away = f", and the trajectory moves by up to {s.apart_m:.0f} m" if s.apart else ""
        own = f" ({mine})" if mine else ""
        return [f"{s.source}{own}: without it all else agrees{away}"]
    if len(cured) > 1:
        names = " and ".join(s.source for s in cured)
        apart = max(s.apart_m for s in cured)
        return [
            f"{names} contradict each other by up to {apart:.0f} m: without either the rest agrees, and nothing in the "
            "flight tells which is wrong; check their sites, calibration and time tags"
        ]
    most = _inertial(inertial) if inertial else "no data sheet's error stands out"
    touched = [s for s in left_out if any(is_about(v, s.source) for v in red)]
    if len(touched) == 1 and not inertial:
        s = touched[0]
        mine = "; ".join(dict.fromkeys(_short(v) for v in red if is_about(v, s.source)))
        return [f"{s.source} ({mine}): its residuals alone are red, though leaving it out does not mend the rest"]
    return [f"inertial sensors or motion: no tracker can be left out so that the rest agrees; {most}"]


def _lone_trackers(red: list[Verdict]) -> list[str]:
    """What can be said where no tracker could be left out."""
    inertial = tuple(f"data sheet {name}" for name in INERTIAL)
    about = ("NIS ", "whiteness ", "edited ", "data sheet ")
    kinds = [v for v in red if v.name.startswith(about) and v.name not in inertial]
    if not kinds:
        return []
    words = "; ".join(dict.fromkeys(_short(v) for v in kinds))
    return [f"the tracker or the motion ({words}): a second tracker would tell which"]


def _inertial(sheets: list[Verdict]) -> str:
    worst = max(sheets, key=lambda v: abs(v.value) / max(v.high, np.finfo(float).tiny))
    if " mount " in worst.words:
        names = " or ".join(v.words.split(" is larger")[0] for v in sheets if " mount " in v.words)
        return f"inertial sensors: {names}; the mounts of accelerometer and gyros are seen only against each other"
    return f"inertial sensors: {worst.words}"


def _short(verdict: Verdict) -> str:
    """Words of a verdict up to the explanation."""
    return verdict.words.split(":")[0]
