"""How a proposal stands in flight.toml: tables to correct, with why each column was taken for what, and questions."""

from __future__ import annotations

import re
from typing import Any

from flightmodel.columns import UNITS
from postflight.intake.proposal import ASKED, Mapped, SourceProposal, TimeMapped
from postflight.intake.propose import quoted

WIDTH = 62  # of a line's value, before its comment


def section_text(source: SourceProposal, file: str, notes: list[str], taken: bool) -> str:
    """Return the TOML of one table; as comments below a question where flight.toml has that table already."""
    lines = [f"[{source.section}]"]
    lines += [f"# {note}" for note in notes]
    lines.append(f"file = {quoted(file)}")
    if source.time is not None:
        lines += _time_lines(source.time)
    lines += [_line(f"{key} = {value}", comment) for key, value, comment in source.keys]
    declared = [m for m in source.columns if not m.canonical]
    if declared:
        lines += ["", f"[{source.section}.columns]"]
        lines += [_column_line(m) for m in declared]
    if taken:
        first = f"# QUESTION: [{source.section}] is there already. Which is right? Take one out."
        lines = [first, *(f"# {line}".rstrip() for line in lines)]
    return "\n".join(lines) + "\n"


def start_text(sections: set[str], tables: dict[str, Any], doubtful: list[str]) -> str:
    """Return what the tables ask for besides: how the vehicle was turned, or how it moves without inertial sensors.

    ``doubtful`` names files with columns that were recognised as nothing and may be an accelerometer's or gyros'.
    """
    inertial = {"sensors.accelerometer", "sensors.rates"} <= sections
    if inertial:
        return _ballistic_doubt(tables) + _attitude_text(tables)
    tracked = any(s.startswith(("radars.", "gnss.")) for s in sections)
    if not tracked or "motion" in tables:
        return ""
    text = (
        "[motion]                          # no accelerometer with gyros yet: gravitation and drag carry the flight\n"
        'model = "ballistic"               # take [motion] out once both are there\n'
        'drag_area_per_mass_m2pkg = "FILL IN"  # m2/kg: C_D S / m, to a factor of 2.7\n'
    )
    if not doubtful:
        return text
    first = (
        f"# QUESTION: {one_line(', '.join(doubtful))} may hold an accelerometer or gyros: declare the columns above.\n"
        "# Only a flight without both moves like this:\n"
    )
    return first + "".join(f"# {line}\n" for line in text.replace("FILL IN", "...").splitlines())


def _ballistic_doubt(tables: dict[str, Any]) -> str:
    """Return the question that an earlier ``[motion]`` is, once inertial sensors are there."""
    motion = tables.get("motion")
    if not isinstance(motion, dict) or motion.get("model") != "ballistic":
        return ""
    return (
        '# QUESTION: [motion] above says model = "ballistic", so accelerometer and gyros would not carry the flight:\n'
        "# take [motion] out, unless that is meant.\n"
    )


def _attitude_text(tables: dict[str, Any]) -> str:
    if "attitude_prior" in tables:
        return ""
    return (
        "[attitude_prior]                  # how the vehicle was turned at one time; or q_ecef_body, scalar first\n"
        't_s = "FILL IN"                   # s after t0\n'
        'azimuth_deg = "FILL IN"           # deg from true north: where the nose points\n'
        'elevation_deg = "FILL IN"         # deg above the horizon\n'
        'roll_deg = "FILL IN"              # deg; at 0 body y is level and points right of one who looks along x\n'
        "# q_ecef_body = [1.0, 0.0, 0.0, 0.0]  # instead of these three: body to ECEF, scalar FIRST, e.g.\n"
        "sd_deg = 3.0                      # deg, one number or one for body x, y, z\n"
    )


def _line(text: str, comment: str) -> str:
    return f"{text:<{WIDTH}} # {comment}" if comment else text


def _time_lines(time: TimeMapped) -> list[str]:
    parts = []
    if time.format == "utc_hms":
        parts.append(f"columns = [{', '.join(quoted(c) for c in time.columns)}]")
    elif time.columns[0] != "t_s":
        parts.append(f"column = {quoted(time.columns[0])}")
    if time.format != "seconds":
        parts.append(f'format = "{time.format}"')
    elif time.unit != "s":
        parts.append(f'unit = "{time.unit or "FILL IN"}"')
    if time.offset_asked:
        parts.append('offset_s = "FILL IN"')
    why = time.why
    if time.format == "seconds" and not time.unit:
        why = f"which unit? s, ms, us, min; {why}"
    if time.offset_asked:
        why += "; these seconds do not start at t0: what is added to each (0 where they do)?"
    if time.others:
        why += f"; {', '.join(time.others)} would be another time"
    return [_line(f"time = {{ {', '.join(parts)} }}", why)] if parts else ([f"# time: {why}"] if time.others else [])


def _column_line(mapped: Mapped) -> str:
    text = f'{mapped.short} = {{ column = {quoted(mapped.column)}, unit = "{mapped.unit or "FILL IN"}" }}'
    if mapped.how == ASKED:
        return _line(text, f"which unit? {', '.join(units_of(mapped.short))}; {one_line(mapped.why)}")
    return _line(text, one_line(mapped.why) if mapped.how == "stated" else f"by its numbers: {one_line(mapped.why)}")


def units_of(short: str) -> list[str]:
    """Units that a quantity may have, the usual ones first."""
    from flightmodel import columns

    every = (*columns.ACCELEROMETER, *columns.RATES, *columns.MAGNETOMETER, *columns.RADAR, *columns.GNSS)
    known = next((q for q in (*every, *columns.BAROMETER, *columns.ATMOSPHERE) if q.short == short), None)
    return [u for u, (kind, _, _) in UNITS.items() if known is not None and kind == known.kind]


def one_line(text: str) -> str:
    """Text that is safe in a comment."""
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)
