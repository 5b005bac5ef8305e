"""`postflight report`: one self-contained HTML file, identical bytes for the same run.

Which error sizes did flight.toml leave to the defaults, and which does the flight itself show? To paste there.

Noise is the stated one times the root mean square of a tracker's normalised residuals; biases and time tags are the
estimates of the trajectory's solution with their sd, as comments: one flight's bias is no standard deviation.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import DictLoader, Environment, StrictUndefined
from markupsafe import Markup

from flightmodel.airdata import pressure_pulse
from flightmodel.config import parse_utc
from flightmodel.events import has_peak
from flightmodel.files import write_file, writing
from postflight.deflections import Deflections
from postflight.flight import Flight
from postflight.plots.style import COLOUR, PAGE
from postflight.report import text, view_3d
from postflight.report.panels import (
    NO_DEFLECTION,
    Panel,
    deflection_panel,
    flow_panels,
    residual_panels,
    rigid_panels,
    study_panels,
    trajectory_panels,
    trajectory_rows,
)
from postflight.report.source import rounded
from postflight.run_folder import method_summary, read_csv
from postflight.runs import Run, read_run
from postflight.scoring import Score, score_run

_NAME = "report.html"
SCRIPTS = ("time.js", "uPlot.iife.min.js", "charts.js", "vehicle.js", "film.js", "start.js")
STYLES = ("uPlot.min.css", "page.css")
SHARED = ("head.html", "parts.html", "foot.html")  # what the pages share: how they begin and end, and macros
# what a script element must not hold literally: its own end, a comment's start, and line ends of JavaScript alone
_ESCAPED = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}
# kind of tracker in flight.toml: its keys, each from which components, and the stated size in that key's unit
_Stated = Callable[[dict[str, Any]], float | None]
_KEYS: dict[str, tuple[tuple[str, tuple[str, ...], _Stated], ...]] = {
    "radars": (
        ("range_sd_m", ("range",), lambda s: s["range_sd_m"]),
        ("azimuth_sd_deg", ("azimuth",), lambda s: _degrees(s["azimuth_sd_rad"] or s["angle_sd_rad"])),
        ("elevation_sd_deg", ("elevation",), lambda s: _degrees(s["elevation_sd_rad"] or s["angle_sd_rad"])),
    ),
    "gnss": (
        ("horizontal_sd_m", ("north", "east"), lambda s: s["horizontal_sd_m"]),
        ("vertical_sd_m", ("down",), lambda s: s["vertical_sd_m"]),
    ),
    "barometers": (("sd_m", ("height",), lambda s: s["sd_m"]),),
}


def write_report(
    flight_folder: Path,
    path: Path | None = None,
    flight: Flight | None = None,
    target: Path | None = None,
    studies: tuple[Path, ...] = (),
) -> Path:
    """Write the report of a run (`read_run`) to ``target`` or into the run's folder; return where it lies.

    ``studies`` are folders or files with bands that the flight is held against (`postflight.report.panels`). The truth
    of a synthetic flight stands beside the finished estimates, by `postflight.scoring`.

    Raises
    ------
    GateError
        Where the run cannot be read, or the file not be written.
    """
    run = read_run(flight_folder, path, flight)
    target = run.path / _NAME if target is None else target
    has_truth = (flight_folder / "truth" / "truth.csv").is_file()
    write_whole(target, page(run, studies, score_run(flight_folder, run.path) if has_truth else None))
    return target


def write_deflection_report(answers: Deflections, flight: Flight, folder: Path, settings: dict[str, Any]) -> None:
    """Write the report of answers that no run holds into the folder of their tables.

    Raises
    ------
    GateError
        Where the file cannot be written.
    """
    run = _as_run(answers, flight, folder, settings)
    frames, (findings, checks, extra) = _film(run)[0], _listed(run)
    panels = [panel for panel in (deflection_panel(run), *flow_panels(answers)) if panel is not None]
    span = [round(float(t), 3) for t in (run.table["t_s"].iloc[0], run.table["t_s"].iloc[-1])]
    table, read, notes = flight.telemetry.loads, flight.read_loads, []
    if table is not None and read is not None:
        unused = ", ".join(read.unused)
        notes = [f"Loads are those of {table.path.name}. Columns that are not used: {unused or 'none'}."]
    found = {
        "title": text.title(run),
        "lead": text.lead(run),
        "cards": [card for card in text.with_whiskers(text.cards(run)) if card["method"] in run.summary["methods"]],
        "clock": text.clock_drawing(run),
        "answers": text.table_rows(_answer_columns(answers)),
        "assumed": assumed(run),
        "date": text.date(run.telemetry.t0_utc),
        "frames": frames,
        "notes": notes,
        "findings": findings,
        "checks": checks,
        "extra": extra,
    }
    shown = [{k: v for k, v in frame.items() if k != "jpeg"} for frame in frames]
    data = charts(run, span, pulse_window(run.table), panels, frames=shown)
    write_whole(folder / _NAME, rendered("deflection.html", data, run=run, **found))


def _answer_columns(answers: Deflections) -> pd.DataFrame:
    """One row per method, without columns that only its card shows."""
    table = answers.to_frame().drop(columns=["reason", "theta_p16_deg", "theta_p50_deg", "theta_p84_deg"])
    names = {str(name): str(name).replace("theta_", "deflection_").replace("_t_s", "_at_s") for name in table}
    return table.rename(columns=names).dropna(axis=1, how="all")


def _as_run(answers: Deflections, flight: Flight, folder: Path, settings: dict[str, Any]) -> Run:
    """Answers with the tables of their folder, in the form that the parts of the report read."""
    telemetry, checks = flight.telemetry, answers.consistency_checks
    tables = {path.stem: read_csv(path) for path in sorted(folder.glob("*.csv"))}
    times = [*(h.time_s for h in answers.histories.values()), *(film.time_s for film in telemetry.films.values())]
    tables["bet"] = pd.DataFrame({"t_s": np.unique(np.concatenate(times or [np.zeros(1)]))})
    at_s = answers.reference_s if np.isfinite(answers.reference_s) else float(tables["bet"]["t_s"][0])
    tables["peaks"] = pd.DataFrame({"peak": [], "value": [], "sd": [], "inside": []})
    tables["events"] = pd.DataFrame({"t_s": [], "event": []})
    tables["findings"] = pd.DataFrame([f.as_row() for f in telemetry.findings], columns=["source", "what", "code"])
    summary: dict[str, Any] = {
        "methods": method_summary(answers),
        "agreement": None if answers.fused is None else answers.fused.remark,
        "peak_dynamic_pressure_s": at_s,
        "verdicts_passed": sum(check.passed for check in checks),
        "verdicts_failed": [f"{check.name}: {check.remark}" for check in checks if not check.passed],
    }
    if answers.knows_peak:
        air = answers.loads if answers.bet is None else answers.bet.air
        assert air is not None
        columns = {"t_s": air.time_s, "alt_m": air.altitude_m, "mach": air.mach}
        tables["bet"] = pd.DataFrame(columns | {"dynamic_pressure_pa": air.dynamic_pressure_pa})
        columns |= {"value": air.dynamic_pressure_pa, "sd": air.dynamic_pressure_sd_pa}
        at = {name: float(np.interp(at_s, air.time_s, column)) for name, column in columns.items()}
        summary["peak_dynamic_pressure_pa"] = at["value"]
        tables["events"] = pd.DataFrame([{"event": "peak dynamic pressure"} | at])
        tables["peaks"] = pd.DataFrame([{"peak": "dynamic pressure", "inside": has_peak(air.dynamic_pressure_pa)} | at])
    facts = {"settings": settings, "version": version("postflight"), "inputs_sha256": telemetry.hashes}
    header = {"epoch_utc": telemetry.t0_utc, "assumed": flight.assumed}
    return Run(folder, summary, facts, header, tables, flight)


def write_whole(target: Path, content: str) -> None:
    """Write a file atomically, or raise `GateError` with its name."""
    with writing(target, "name another place with --output"):
        write_file(target, content)


def page(run: Run, studies: tuple[Path, ...] = (), score: Score | None = None) -> str:
    """Return the whole page, with the errors of a run that was scored."""
    frames, worst = _film(run)
    data, absent = _numbers(run, frames, studies)
    return rendered(
        "page.html",
        data,
        run=run,
        frames=frames,
        worst=worst,
        absent=absent,
        studies=[path.resolve().name for path in studies],
        against_truth=None if score is None else text.against_truth(score),
        **_texts(run),
    )


def _film(run: Run) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Film strip and worst frames; the estimators are loaded for them alone."""
    if not {"deflection_camera", "camera_frames"} & set(run.tables):
        return [], []
    from postflight.report import pictures

    return pictures.film_strip(run), pictures.worst_frames(run)


def rendered(template: str, data: dict[str, Any], **texts: Any) -> str:
    """Return a page with its scripts and styles inside, and a policy that allows these alone; all text is escaped."""
    here = files("postflight.report").joinpath("page")
    read = lambda name: here.joinpath(name).read_text(encoding="utf-8")  # noqa: E731
    script = "\n".join(read(name) for name in SCRIPTS)
    variables = " ".join(f"--{name}: {value};" for name, value in PAGE.items())
    style = "\n".join([f":root {{ {variables} }}", *(read(name) for name in STYLES)])
    environment = Environment(
        loader=DictLoader({name: read(name) for name in (template, *SHARED)}),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(
        script=Markup(script),
        style=Markup(style),
        script_hash=_content_hash(script),
        style_hash=_content_hash(style),
        licence=read("uPlot.LICENSE"),
        data=Markup(safe_json(data)),
        drawn=data,
        **texts,
    )


def _listed(run: Run) -> tuple[dict[str, Any], dict[str, Any], list[tuple[str, str, dict[str, Any]]]]:
    """Findings, checks and further tables, each with title and, where it is a list, the file that holds it."""
    more = {
        "cameras": "Cameras: frames, and how far each one's own errors were found",
        "shell_shape": "Rocking or local deformation: the shell's shape under load, by video",
        "camera_frames": "Frames of the film",
        "camera_sensitivity": "Deflection by video under assumed joints and planes, beside Table 2.1 of AIAA 2011-2571",
        "fusion_inputs": "Inputs of the methods, estimated with the deflection",
        "fusion_agreement": "Chi-square test of every pair of methods",
        "aero_increments": "Coefficients in flight against the preflight table, along Mach number",
        "air_parameters": "Coefficient scales and flexure, estimated with the as-flown atmosphere",
        "residual_statistics": "Residuals by source and component",
        "sensor_errors": "Estimated sensor errors",
        "peaks": "Peak values",
    }
    checks = run.checks
    return (
        text.table_rows(run.tables["findings"].astype({"source": str, "what": str})),
        text.table_rows(checks.assign(passed=checks["passed"].map({True: "✓ pass", False: "✕ fail"}))),
        [
            (title, f"{name}.csv" if name in text.LISTS else "", text.table_rows(text.main_columns(run.tables[name])))
            for name, title in more.items()
            if name in run.tables and len(run.tables[name])
        ],
    )


def _texts(run: Run) -> dict[str, Any]:
    """Everything on the page that is text or tables."""
    findings, checks, extra = _listed(run)
    again = run.tables.get("sensitivity")
    return {
        "title": text.title(run),
        "lead": text.lead(run),
        "cards": text.with_whiskers(text.cards(run)),
        "clock": text.clock_drawing(run),
        "rests_on": text.rests_on(run.summary.get("rests_on") or []),  # runs of before have none
        "events": text.events(run),
        "findings": findings,
        "checks": checks,
        "extra": extra,
        "sensitivity": text.sensitivity_rows(again) if again is not None else None,
        "vehicle": [(k, text.cell(v)) for k, v in (run.header["vehicle"] or {}).items()],
        "settings": [(k, text.cell(v)) for k, v in (run.header["settings"] | run.facts["settings"]).items()],
        "assumed": assumed(run),
        "measured": measured(run),
        "date": text.date(run.telemetry.t0_utc),
    }


def _numbers(
    run: Run, frames: list[dict[str, Any]], studies: tuple[Path, ...]
) -> tuple[dict[str, Any], list[tuple[str, str, str]]]:
    """Everything that the scripts draw, and id, title and reason of the panels that the flight has no data for."""
    bet = run.tables["bet"]
    rows = trajectory_rows(run)
    panels, absent = trajectory_panels(run, rows)
    deflection = deflection_panel(run)
    if deflection is not None:
        panels.insert(0, deflection)
    else:
        absent.insert(0, ("deflection", "Deflection", NO_DEFLECTION))
    vehicle = run.telemetry.vehicle
    span = [float(bet["t_s"].iloc[0]), float(bet["t_s"].iloc[-1])]
    data = charts(
        run,
        span,
        span if deflection is None else pulse_window(bet),
        panels,
        bet=rounded(bet["t_s"].to_numpy()[rows], 4),
        rows=[len(rows), len(bet)],
        rigid=rigid_panels(run),
        studies=study_panels(run, studies),
        residuals=residual_panels(run),
        solid=None if vehicle is None else view_3d.solid(vehicle),
        poses=view_3d.poses(run, rows),
        frames=[{k: v for k, v in frame.items() if k != "jpeg"} for frame in frames],
    )
    return data, absent


def charts(run: Run, span: list[float], first: list[float], panels: list[Panel], **more: Any) -> dict[str, Any]:
    """What a page's scripts draw: whole time and the part shown first, events of a run, panels, and ``more``.

    Only the report itself has columns of the trajectory (``bet``, ``rows``) and ``poses``.
    """
    data = {
        "t0_ms": round(1e3 * parse_utc(run.header["epoch_utc"]).timestamp()) if run.header["epoch_utc"] else None,
        "span": span,
        "colours": PAGE | {"residual": COLOUR["estimate"]},
        "pulse": pulse_window(run.tables["bet"]),
        "first": first,
        "peak": round(run.peak_s, 3),
        "bet": None, "rows": None,
        "events": [{"t": round(float(e.t_s), 3), "name": str(e.event)} for e in run.tables["events"].itertuples()],
        "panels": panels,
        "rigid": [], "studies": [], "residuals": [], "solid": None, "poses": None, "frames": [],
    } | more  # fmt: skip
    return {key: value for key, value in data.items() if key in more or key not in ("bet", "rows", "poses")}


def pulse_window(bet: pd.DataFrame) -> list[float]:
    """From well before the pressure pulse to well after it, s; all that there is where no pressure is known."""
    t = bet["t_s"].to_numpy()
    if "dynamic_pressure_pa" not in bet:
        return [round(float(t[0]), 3), round(float(t[-1]), 3)]
    inside = t[pressure_pulse(bet["dynamic_pressure_pa"].to_numpy())]
    width = inside[-1] - inside[0]
    first, last = max(inside[0] - 0.75 * width, t[0]), min(inside[-1] + 0.5 * width, t[-1])
    return [round(float(first), 3), round(float(last), 3)]


def safe_json(value: Any) -> str:
    """JSON that may stand in a script element."""
    out = json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    for sign, code in _ESCAPED.items():
        out = out.replace(sign, code)
    return out


def _content_hash(inline: str) -> str:
    """Source expression of a content security policy that allows this inline text and nothing else."""
    return "sha256-" + base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()


def _degrees(angle_rad: float) -> float:
    return float(np.rad2deg(angle_rad))


def assumed(run: Run) -> list[tuple[str, str]]:
    """Tables of flight.toml with the default sizes that the run used for unstated ones; none for older runs."""
    tables = run.header.get("assumed") or {}
    return [(name, ", ".join(f"{key} = {size:g}" for key, size in keys.items())) for name, keys in tables.items()]


def measured(run: Run) -> str:
    """Lines for flight.toml with tracker noise and sensor biases estimated from the flight; empty if there are none."""
    out = []
    for group, records in (
        ("radars", run.telemetry.radars), ("gnss", run.telemetry.gnss), ("barometers", run.telemetry.barometers)
    ):  # fmt: skip
        for name in records:
            in_rows = getattr(records[name], "sd", None) is not None
            lines = ([] if in_rows else _noise(run, group, name)) + _estimated(run, name)
            out += [f"[{group}.{name}]", *lines, ""] if lines else []
    for name in ("accelerometer", "rates", "magnetometer"):
        lines = _estimated(run, name)
        out += [f"# [sensors.{name}]", *lines, ""] if lines else []
    return "\n".join(out).rstrip()


def _noise(run: Run, group: str, name: str) -> list[str]:
    residuals = run.tables.get("residual_statistics")
    stated = next((s for s in run.header["sensors"] if s.get("name") == name), None)
    if residuals is None or stated is None:
        return []
    # the noise is found to an eighth from so many residuals
    mine = residuals[(residuals["source"] == name) & (residuals["count"] - residuals["edited"] >= 30)]
    out = []
    for key, components, size in _KEYS[group]:
        times = mine.loc[mine["component"].isin(components), "rms_normalised"].to_numpy(float)
        known = size(stated)
        if len(times) == len(components) and np.isfinite(times).all() and known:
            found = known * float(np.sqrt(np.mean(times**2)))
            out.append(f"{f'{key} = {found:.3g}':<30}# measured; stated {known:.3g}")
    return out


def _estimated(run: Run, name: str) -> list[str]:
    """Biases of a source as estimated, a comment each."""
    table = run.tables.get("sensor_errors")
    if table is None:
        return []
    out = []
    for row in table.itertuples(index=False):
        error = str(row.name).removeprefix(f"{name} ")
        if error == row.name or "bias" not in error or pd.isna(row.estimate) or row.treated != "estimated":
            continue
        angle = str(row.unit).startswith("rad")
        scale, unit = (180.0 / np.pi, str(row.unit).replace("rad", "deg")) if angle else (1.0, str(row.unit))
        value, sd, prior = (scale * float(x) for x in (row.estimate, row.sd, row.prior_sd))
        out.append(f"# {error}: {value:+.3g} +/- {sd:.3g} {unit} in this flight; a priori sd {prior:.3g}")
    return out
