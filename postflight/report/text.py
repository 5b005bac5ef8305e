"""What does the report say? Title, lead, a card for each method, events, tables: everything that is text.

A ± is one standard deviation; a card's intervals are quantiles: 16 to 84 and 5 to 95 %.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import timedelta
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from flightmodel.config import parse_utc
from flightmodel.deflection import QUANTILES, interpolation_error, lateral_axes, lv_clock, lv_direction
from flightmodel.statistics import decimals, pair
from flightmodel.tables import column_about
from postflight.deflections import METHODS, headline, said
from postflight.plots.style import COLOUR, LABEL
from postflight.report.view_3d import best_method, hole_s
from postflight.run_folder import answer_table
from postflight.runs import Run
from postflight.scoring import Score
from postflight.sensitivity import largest_of_groups
from recon.consistency import doubt

_HOW = {
    "camera": "Edge and features, or texture, of the aeroshell in the onboard video.",
    "misalignment": "The deflection that reconciles the accelerometers with the trajectory's angle of attack.",
    "trim": "The offset of the aeroshell's force that balances the moments at the flown angle of attack.",
    "fused": "All methods, weighted, with the inputs they share.",
}
_BY = {"camera": "video alone", "misalignment": "the accelerometers alone", "trim": "the trim angle alone"}
_ALONE = {"state": "alone", "mark": "○", "remark": "no independent measurement to compare with"}
NOT_ASKED = "not asked for in this run"
SHOWN_ROWS = 200
LISTS = ("camera_frames", "shell_shape")  # tables that are not printed: their CSV is for them
_UNITS = {"deg": "deg", "m": "m", "mps": "m/s"}
_NEAR_PEAK_S = 1.0  # window about the peak


def date(utc: str) -> str:
    """Day of a UTC time as it is read: ``17 August 2009``; empty where none is known."""
    if not utc:
        return ""
    day = parse_utc(utc)
    return f"{day.day} {day:%B %Y}"


def _utc(run: Run, time_s: float) -> str:
    """Clock time of a mission time, ``12:59:20.62``."""
    stamp = parse_utc(run.telemetry.t0_utc) + timedelta(seconds=float(time_s), milliseconds=5)
    return stamp.strftime("%H:%M:%S.") + f"{stamp.microsecond // 10000:02d}"


def title(run: Run) -> str:
    """Return the answer in one line, which begins with its doubt where checks fail."""
    words = f"In doubt: {_answer(run)}" if _doubt(run) else _answer(run)
    return re.sub(r" (?=[±\d]|mean|q\b)", "\u00a0", words)  # no line ends between a name and its number


def _doubt(run: Run) -> str:
    """Consequences of failed checks for the answers; empty if all pass."""
    return doubt([str(name) for name in run.checks.loc[~run.checks["passed"].astype(bool), "name"]], len(run.checks))


def _answer(run: Run) -> str:
    best = best_method(run)
    if best is not None:
        answer = run.summary["methods"][best]
        return headline(answer, at=f"at {_peak_name(run)}") + ("" if best == "fused" else f", by {_BY[best]}")
    asked = run.facts["settings"]["methods"]
    end = "no method gave a deflection" if asked else "no deflection was asked for"
    highest = run.peak("altitude")
    if highest is not None and bool(highest["inside"]):
        return f"{run.telemetry.name}: apogee {pair(highest['value'] / 1e3, highest['sd'] / 1e3)}\u00a0km; {end}"
    return f"{run.telemetry.name}: {'trajectory reconstructed; ' if 'residuals' in run.tables else ''}{end}"


def _peak_name(run: Run) -> str:
    """Name of the peak: peak q, or the largest q if the data end before it; for a film alone, its answer's time."""
    if "peak_dynamic_pressure_pa" not in run.summary:
        return f"{run.peak_s:.2f} s"
    row = run.peak("dynamic pressure")
    return "peak q" if row is None or bool(row["inside"]) else "the largest q in the data"


def lead(run: Run) -> list[str]:
    """Sentences below the title."""
    s = run.summary
    out = [s["agreement"][0].upper() + s["agreement"][1:] + "."] if s["agreement"] else []
    if "peak_dynamic_pressure_pa" in s:
        out.append(_peak(run))
    out[0:0] = [words for words in (_oscillation(run), _outside_its_inputs(run)) if words]
    out.append(f"{s['verdicts_passed']} of {len(run.checks)} consistency checks pass.")
    if run.changes:
        out.insert(0, f"A what-if, not the flight as its folder states it: {'; '.join(run.changes)}.")
    return [f"{doubtful}.", *out] if (doubtful := _doubt(run)) else out


def _peak(run: Run) -> str:
    """Sentence on the peak of dynamic pressure."""
    s, at, row = run.summary, run.peak_s, run.peak("dynamic pressure")
    pressure = f"{s['peak_dynamic_pressure_pa']:.0f}"
    if row is not None and np.isfinite(row["sd"]):
        pressure = pair(s["peak_dynamic_pressure_pa"], row["sd"])
    events = run.tables["events"]
    there = events.iloc[int((events["t_s"] - at).abs().argmin())]
    utc = f" ({_utc(run, at)} UTC)" if run.telemetry.t0_utc else ""
    return (
        f"{_peak_name(run).capitalize()}, the dynamic pressure: {pressure} Pa at {at:.2f} s{utc}, "
        f"Mach {there['mach']:.2f}, {there['alt_m'] / 1e3:.1f} km."
    )


def rests_on(lines: Iterable[str]) -> list[list[str]]:
    """Rows of a table from ``rests_on``: absolute values and the assumptions that residuals cannot test."""
    return [re.split(r" rests? on (?:the )?", line, maxsplit=1) for line in lines]


def against_truth(score: Score) -> dict[str, Any]:
    """Every quantity that is scored: estimate, truth, error, sd, and the error over the sd."""
    rows = []
    for of in score.scored:
        places = decimals(of.sd)
        answered, trajectory = np.isfinite(of.error), not np.isfinite(of.truth)
        name = f"{of.name.replace('_', ' ')}, rms over the pulse" if trajectory else f"deflection at peak q, {of.name}"
        truth = "" if trajectory else f"{of.truth:.2f}"
        estimate = f"{of.truth + of.error:.{places}f}" if answered and not trajectory else ""
        numbers = (f"{of.error:+.{places}f}", f"{of.sd:.{places}f}", f"{of.error / of.sd:+.1f}")
        rows.append([name, _UNITS[of.unit], estimate, truth, *(numbers if answered else ("no answer", "", ""))])
    return {"names": ["quantity", "unit", "estimate", "truth", "error", "1 sd", "error / sd"], "rows": rows, "more": 0}


def _oscillation(run: Run) -> str:
    """Sentence on the cycle of a deflection that oscillates around the peak; empty where one number describes it."""
    best = best_method(run)
    if best is None:
        return ""
    answer, table = run.summary["methods"][best], run.tables[answer_table(best, run.tables)]
    if answer.get("mean_deg") is not None:
        first, last = answer["mean_over_s"]
        return (
            f"The deflection oscillates. Its cycle around {_peak_name(run)} lasts from {first:.2f} to {last:.2f} s, "
            f"and it is largest at {answer['largest_at_s']:.2f} s."
        )
    near = table["theta_deg"][(table["t_s"] - run.summary["peak_dynamic_pressure_s"]).abs() < _NEAR_PEAK_S]
    # a range that one number describes
    if len(near) < 2 or near.max() - near.min() < 4.0 * answer["sd_deg"]:
        return ""
    places = decimals(answer["sd_deg"])
    return (
        f"The deflection oscillates between {near.min():.{places}f} and {near.max():.{places}f}° within "
        f"{_NEAR_PEAK_S:.0f} s of {_peak_name(run)}, and it is largest at {answer['largest_at_s']:.2f} s."
    )


def _outside_its_inputs(run: Run) -> str:
    """Sentence on a fused angle more than its sd beyond those of all methods, and why; else empty."""
    methods = run.summary["methods"]
    answers = {name: angle for name, m in methods.items() if (angle := m["deflection_deg"]) is not None}
    fused = answers.pop("fused", None)
    if fused is None or len(answers) < 2:
        return ""
    if min(answers.values()) - fused <= (sd := methods["fused"]["sd_deg"]) and fused - max(answers.values()) <= sd:
        return ""
    side = "above" if fused > max(answers.values()) else "below"
    words = f"The fused angle is {side} that of every method: it is no mean at one instant, but what explains all "
    words += "readings of the pulse with the inputs that the methods share"
    table = run.tables.get("fusion_inputs")
    if table is None or not len(table):
        return f"{words}."
    most = table.loc[table["moved_sd"].abs().idxmax()]
    return f"{words}, of which {most['input']} moved most, by {most['moved_sd']:+.1f} sd."


def cards(run: Run) -> list[dict[str, Any]]:
    """One card a method, estimators first and the fusion last."""
    return [_card(run, method) for method in METHODS]


def _card(run: Run, method: str) -> dict[str, Any]:
    answer = run.summary["methods"].get(method)
    card: dict[str, Any] = {"method": method, "label": LABEL[method], "how": _HOW[method], "colour": COLOUR[method]}
    if answer is None or answer["deflection_deg"] is None:
        reason = NOT_ASKED if answer is None else answer["reason"]
        return card | {"state": "none", "mark": "–", "remark": "no answer", "reason": reason}
    value, sd = answer["deflection_deg"], answer["sd_deg"]
    # runs of before the quantiles have a sd alone
    quantiles = answer.get("quantiles_deg") or [max(value + k * sd, 0.0) for k in ndtri(QUANTILES)]
    (at, here), *others = said(answer, f"at {_peak_name(run)}").items()
    places = decimals(sd)
    card |= {
        "at": at, "value": here.split(" ± ")[0], "sd": here.split(" ± ")[1], "others": others, "number": value,
        "low": f"{quantiles[0]:.{places}f}", "high": f"{quantiles[-1]:.{places}f}", "quantiles": quantiles,
        "plane": plane_at(run, method), "largest_s": answer["largest_at_s"],
        "assumptions": answer["assumptions"],
    }  # fmt: skip
    card |= _agreement(run, method)
    if method == "fused" and (doubtful := _doubt(run)):
        card |= {"state": "differs", "mark": "✕", "remark": f"in doubt; {card['remark']}", "detail": doubtful}
    return card


def _agreement(run: Run, method: str) -> dict[str, str]:
    """Agreement of a method with the others, from the pairwise tests; for the fusion, from all tests."""
    table = run.tables.get("fusion_agreement")
    if table is None or not len(table):
        return dict(_ALONE)
    mine = table if method == "fused" else table[[method in m.split(" and ") for m in table["methods"]]]
    if not len(mine):
        return dict(_ALONE)
    from estimators.agreement import CONFIDENCE

    failed = mine[~mine["passed"].astype(bool)]
    least = f"smallest probability of a pair {mine['chance'].min():.2g}; limit {1 - CONFIDENCE:.2g}"
    if not len(failed):
        compared = {o for m in mine["methods"] for o in m.split(" and ")} - {method}
        silent = all(run.summary["methods"].get(o, {}).get("deflection_deg") is None for o in compared)
        who = "all pairs agree" if method == "fused" else "agrees with the others"
        who += " where they answer: not here" if silent else ""
        return {"state": "agrees", "mark": "✓", "remark": who, "detail": least}
    if method == "fused":
        return {"state": "differs", "mark": "✕", "remark": "pairs disagree", "detail": "; ".join(failed["methods"])}
    others = [o for m in failed["methods"] for o in m.split(" and ") if o != method]
    return {"state": "differs", "mark": "✕", "remark": f"disagrees with {', '.join(others)}", "detail": least}


def plane_at(run: Run, method: str) -> str:
    """Plane of the deflection at peak dynamic pressure, deg LV clocking, with its sd; empty where it is not known."""
    table, at = run.tables[answer_table(method, run.tables)], run.summary["peak_dynamic_pressure_s"]
    t = table["t_s"].to_numpy()
    k = int(np.abs(t - at).argmin())
    sd = table["plane_sd_deg"].iloc[k]
    if abs(t[k] - at) > max(hole_s(t), 1e-3) or not sd < 90.0:
        return ""
    known = np.isfinite(table["theta_deg"]).to_numpy()
    answers, t = table[known], t[known]
    yz = np.array(answers["theta_deg"])[:, None] * lv_direction(np.deg2rad(np.array(answers["plane_lv_deg"])))[:, 1:]
    here = np.array([np.interp(at, t, c) for c in yz.T])
    clock = lv_clock(here)
    missed = interpolation_error(t, yz @ lateral_axes(clock)[1], at) / np.linalg.norm(here)
    clock, sd = np.rad2deg(clock), float(np.hypot(sd, np.rad2deg(missed)))
    return pair(float(clock), sd)


def with_whiskers(shown: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Cards with the places of their whiskers on a scale of 0 to 200; the fusion's 5 to 95 % as a band behind each.

    The scale, deg, is common: all intervals of 5 to 95 % with a margin.
    """
    ends = [end for c in shown if "number" in c for end in (*c["quantiles"], c["number"])] or [0.0, 1.0]
    margin = 0.06 * (max(ends) - min(ends)) + 0.01
    least, most = min(ends) - margin, max(ends) + margin
    place = lambda x: round(200.0 * (x - least) / (most - least), 1)  # noqa: E731
    fused = next((c for c in shown if c["method"] == "fused" and "number" in c), None)
    for c in shown:
        if "number" not in c:
            continue
        low, inner_low, _, inner_high, high = c["quantiles"]
        c["whisker"] = [place(x) for x in (low, inner_low, c["number"], inner_high, high)]
        if fused is not None:
            c["behind"] = [place(fused["quantiles"][k]) for k in (0, -1)]
    return shown


def clock_drawing(run: Run) -> dict[str, Any] | None:
    """Plane of the best answer, deg LV, and its end in a circle of 36 about (0, 0) seen from behind (y to the right).

    Clocking direction ``phi`` is ``(0, -cos phi, sin phi)`` in body axes; None where no plane is known.
    """
    best = best_method(run)
    plane = "" if best is None else plane_at(run, best)
    if best is None or not plane:
        return None
    phi = np.deg2rad(float(plane.split()[0]))
    end = [round(36.0 * float(x), 1) for x in (-np.cos(phi), np.sin(phi))]
    return {"plane": plane, "label": LABEL[best], "end": end, "colour": COLOUR[best]}


def events(run: Run) -> list[dict[str, Any]]:
    """Rows of the table of events; the numbers are those of the vertical lines."""
    rows = []
    for k, e in enumerate(run.tables["events"].itertuples(index=False), 1):
        shown = {
            "altitude": (e.alt_m / 1e3, e.alt_3sd_m / 1e3), "speed": (e.speed_ground_mps, e.speed_ground_3sd_mps),
            "mach": (e.mach, e.mach_3sd), "pressure": (e.dynamic_pressure_pa, e.dynamic_pressure_3sd_pa),
            "alpha": (e.alpha_total_wind_deg, e.alpha_total_wind_3sd_deg),
        }  # fmt: skip
        cells = {k: pair(x, three_sd / 3.0) if np.isfinite(x) else "not known" for k, (x, three_sd) in shown.items()}
        rows.append({"number": k, "name": e.event, "t": f"{e.t_s:.2f}", "utc": _utc(run, e.t_s)} | cells)
    return rows


def main_columns(table: pd.DataFrame) -> pd.DataFrame:
    """Table for the page, without preflight values, correlations, and times beside Mach numbers, which the CSV has."""
    aside = r"correlation_c|.*_preflight$|alpha_shell_deg$" + ("|t_s$" if "mach" in table else "")
    return table[[name for name in table if not re.match(aside, str(name))]]


def table_rows(table: pd.DataFrame) -> dict[str, Any]:
    """Column names and cells of a small table, and how many rows are left out; a value stands with its sd."""
    shown = table.head(SHOWN_ROWS)
    sds = {name: sd for name in table for sd in (_sd_column(str(name)),) if sd in table}
    columns = {
        str(name).replace("_", " "): [
            pair(x, sd) if np.isfinite(x) and np.isfinite(sd) else cell(x)
            for x, sd in zip(shown[name], shown[sds[name]], strict=True)
        ]
        if name in sds
        else [cell(x) for x in shown[name]]
        for name in table
        if name not in sds.values()
    }
    return {
        "names": list(columns),
        "rows": list(map(list, zip(*columns.values(), strict=True))),
        "more": len(table) - len(shown),
    }


def _sd_column(name: str) -> str:
    """Column that would hold the standard deviation of another one."""
    return "sd" if name in ("estimate", "value") else column_about(name)


def sensitivity_rows(table: pd.DataFrame) -> dict[str, Any]:
    """Largest change of each group of quantities, rerun by rerun, in reported standard deviations; reasons below."""
    largest = largest_of_groups(table)
    shown = largest.pivot(index="rerun", columns="group", values="change_over_sd")
    groups = list(dict.fromkeys(largest["group"]))
    rows = []
    for rerun in dict.fromkeys(table["rerun"]):
        if rerun in shown.index:
            values = shown.loc[rerun, groups]
            rows.append([rerun, *("" if np.isnan(x) else "–" if x == 0.0 else f"{x:+.2f}" for x in values)])
        else:
            reasons = table.loc[table["rerun"] == rerun, "reason"].dropna()
            rows.append([rerun, f"no rerun: {'; '.join(map(str, reasons))}", *[""] * (len(groups) - 1)])
    return {"names": ["rerun", *(groups or ["reason"])], "rows": rows, "more": 0}


def cell(value: Any) -> str:
    """One cell: numbers short, nothing where there is none."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.5g}" if np.isfinite(value) else ""
    if isinstance(value, list):
        inner = [f"({cell(x)})" if isinstance(x, list) else cell(x) for x in value]
        return ", ".join(inner) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {cell(x)}" for name, x in value.items())
    return "not stated" if value is None else str(value)
