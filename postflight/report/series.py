"""Numbers behind the page's time panels: what is drawn over time, with three standard deviations, gaps left as gaps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import earth
from flightmodel.checks import FloatArray
from flightmodel.deflection import HOLE_FACTOR
from postflight.figures import COLOUR, LABEL, residual_unit
from postflight.pipeline import METHODS
from postflight.report.source import Run
from postflight.report.thinning import Rows, kept_rows, rounded

TRAJECTORY_ROWS, RAW_POINTS, TRACK_POINTS, RESIDUAL_POINTS = 6000, 8000, 6000, 16000
BLUE, ORANGE, GREEN, GREY, DARK = "#0072B2", "#D55E00", "#009E73", "#8a929a", "#3a4149"
DASH: dict[str, list[int]] = {"camera": [], "misalignment": [8, 4], "trim": [10, 3, 2, 3], "fused": []}
NO_ACCELEROMETER = "The flight has no accelerometer."
NO_ATTITUDE = "Nothing on board carried the attitude, so the angle of attack is not known."
NO_DEFLECTION = "No method gave a deflection; the reasons stand with the verdicts above."

Panel = dict[str, Any]
# id, title, unit, scale of the column, decimals, and its lines: label, column, its sd, colour, dash
TRAJECTORY: list[tuple[str, str, str, float, int, list[tuple[str, str, str | None, str, list[int]]]]] = [
    ("altitude", "Altitude", "km", 1e-3, 4, [("reconstructed", "alt_m", "alt_sd_m", BLUE, [])]),
    ("speed", "Speed", "m/s", 1.0, 2, [
        ("against the air", "airspeed_mps", "airspeed_sd_mps", BLUE, []),
        ("against the ground", "speed_ground_mps", None, DARK, [6, 4])]),
    ("mach", "Mach number", "", 1.0, 4, [("against the air", "mach", "mach_sd", BLUE, [])]),
    ("pressure", "Dynamic pressure", "Pa", 1.0, 3,
     [("with the sounding's density", "dynamic_pressure_pa", "dynamic_pressure_sd_pa", BLUE, [])]),
    ("alpha", "Total angle of attack of the centerbody", "deg", 1.0, 3, [
        ("against the air", "alpha_total_wind_deg", "alpha_total_wind_sd_deg", BLUE, []),
        ("without wind", "alpha_total_ground_deg", None, DARK, [6, 4])]),
    ("axial", "Acceleration along the axis (body x)", "m/s²", 1.0, 4,
     [("x, corrected, mean of 0.1 s", "ax_imu_mps2", "ax_imu_sd_mps2", BLUE, [])]),
    ("lateral", "Accelerations across the axis (body y, z)", "m/s²", 1.0, 4, [
        ("y, corrected", "ay_imu_mps2", "ay_imu_sd_mps2", ORANGE, []),
        ("z, corrected", "az_imu_mps2", "az_imu_sd_mps2", GREEN, [6, 3])]),
]  # fmt: skip
WHY_ABSENT = {"alpha": NO_ATTITUDE, "axial": NO_ACCELEROMETER, "lateral": NO_ACCELEROMETER}
FLOOR = {"speed", "mach", "pressure", "alpha", "deflection"}


def line(
    label: str, values: FloatArray, sd: FloatArray | None, colour: str, dash: list[int], decimals: int
) -> dict[str, Any]:
    """One line of a panel; ``sd`` becomes a band of three."""
    out: dict[str, Any] = {"label": label, "y": rounded(values, decimals), "colour": colour, "dash": dash, "width": 1.6}
    if sd is not None and np.isfinite(sd).any():
        out["sd3"] = rounded(3.0 * sd, decimals)
    return out


def trajectory_rows(run: Run) -> Rows:
    """Rows of ``bet.csv`` that are drawn."""
    bet = run.tables["bet"]
    shown = [column for *_, lines in TRAJECTORY for _, column, *_ in lines]
    return kept_rows([bet[c].to_numpy(float) for c in shown], TRAJECTORY_ROWS)


def trajectory_panels(run: Run, rows: Rows) -> tuple[list[Panel], list[tuple[str, str]]]:
    """Panels of the trajectory, and title and reason of those that the flight has no data for."""
    bet = run.tables["bet"].iloc[rows]
    raw = {"altitude": heights(run)} | samples(run)
    panels, absent = [], []
    for name, title, unit, scale, decimals, told in TRAJECTORY:
        lines = []
        for label, column, sd_column, colour, dash in told:
            if bet[column].notna().any():
                sd = None if sd_column is None else scale * bet[sd_column].to_numpy(float)
                lines.append(line(label, scale * bet[column].to_numpy(float), sd, colour, dash, decimals))
        if lines:
            panels.append(panel(name, title, unit, "bet", lines, raw.get(name, [])))
        else:
            absent.append((title, WHY_ABSENT.get(name, "The run's table holds no value of it.")))
    return panels, absent


def panel(
    name: str, title: str, unit: str, time: str | None, lines: list[dict[str, Any]], raw: list[dict[str, Any]]
) -> Panel:
    """One panel; lines hold times of their own where ``time`` is None."""
    out: Panel = {"id": name, "title": title, "unit": unit, "time": time, "lines": lines, "raw": raw}
    return out | {"floor": 0} if name in FLOOR else out


def heights(run: Run) -> list[dict[str, Any]]:
    """Heights by each tracker's own points, as measured."""
    tracks: list[tuple[str, FloatArray, FloatArray]] = []
    for name, radar in run.telemetry.radars.items():
        s = radar.site
        places = earth.ecef_from_radar(radar.range_az_el, s.latitude_rad, s.longitude_rad, s.height_m)
        tracks.append((name, radar.time_s, places))
    tracks += [(name, fixes.time_s, fixes.position_ecef_m) for name, fixes in run.telemetry.gnss.items()]
    known = [(name, t, earth.geodetic_from_ecef(places)[2]) for name, t, places in tracks]
    known += [(name, b.time_s, b.height_m) for name, b in run.telemetry.barometers.items()]
    return [points(name, t, h / 1e3, GREY, 4, TRACK_POINTS // len(known)) for name, t, h in known]


def samples(run: Run) -> dict[str, list[dict[str, Any]]]:
    """Accelerometer's samples, turned into body axes and not corrected, by panel."""
    record = run.telemetry.accelerometer
    if record is None:
        return {}
    body = record.measured_sensor @ record.spec.dcm_body_sensor.T
    x, y, z = (points(f"raw {a}", record.time_s, body[:, k], GREY, 3, RAW_POINTS) for k, a in enumerate("xyz"))
    return {"axial": [x], "lateral": [y | {"colour": "#e5a06b"}, z | {"colour": "#7fc4ad"}]}


def points(label: str, time_s: FloatArray, values: FloatArray, colour: str, decimals: int, limit: int) -> Panel:
    """Dots at times of their own, thinned to ``limit`` with every extreme kept; NaN left out."""
    known = np.isfinite(values)
    time_s, values = time_s[known], values[known]
    rows = kept_rows([values], limit) if len(values) else np.empty(0, dtype=int)
    return {
        "label": label,
        "t": rounded(time_s[rows], 4),
        "y": rounded(values[rows], decimals),
        "colour": colour,
        "of": len(values),
    }


def with_holes(time_s: FloatArray, columns: Iterable[FloatArray]) -> tuple[FloatArray, list[FloatArray]]:
    """Put a NaN into every hole of a history, so that no line is drawn across; what a hole is: `DeflectionHistory`."""
    columns = list(columns)
    if len(time_s) < 2:
        return time_s, columns
    step = np.diff(time_s)
    # by the steps around: a history may have two rates
    usual = pd.Series(step).rolling(9, center=True, min_periods=1).median().to_numpy()
    at = np.flatnonzero(step > HOLE_FACTOR * usual) + 1
    middle = 0.5 * (time_s[at - 1] + time_s[at])
    return np.insert(time_s, at, middle), [np.insert(c, at, np.nan) for c in columns]


def deflection_panel(run: Run) -> Panel | None:
    """Deflection by every method that answered, each at its own times; None where none did."""
    lines = []
    for method in METHODS[::-1]:  # the fusion first and so below the others, which are thinner
        table = run.tables.get(f"deflection_{method}")
        if table is None or not len(table):
            continue
        t, (theta, sd) = with_holes(
            table["t_s"].to_numpy(), [table[c].to_numpy(float) for c in ("theta_deg", "theta_sd_deg")]
        )
        rows = kept_rows([theta], TRAJECTORY_ROWS // 2)
        one = line(LABEL[method], theta[rows], sd[rows], COLOUR[method], DASH[method], 4)
        # pictures are few: each is a dot, which also tells the line apart without colours
        one["dots"] = method == "camera"
        lines.append(one | {"t": rounded(t[rows], 4), "width": 3.4 if method == "fused" else 1.4})
    if not lines:
        return None
    out = panel("deflection", "Deflection of the aeroshell against the centerbody", "deg", None, lines, [])
    return out | {"ceiling": round(1.3 * max(max(x for x in one["y"] if x is not None) for one in lines), 2)}


def residual_panels(run: Run) -> list[Panel]:
    """Residuals before each update, with three predicted sd and the gate; one panel a source and component."""
    from scipy.stats import chi2

    table = run.tables["residuals"]
    table = table[table["used"].astype(bool)]
    together = table.groupby(["source", "time_s"])["component"].transform("size")
    chance = run.header["settings"]["gate_probability"]
    pairs = list(table.assign(together=together).groupby(["source", "component"], sort=False))
    out: list[Panel] = []
    for (source, component), rows in pairs:
        scale, unit = residual_unit(component)
        r, sd = (scale * rows[c].to_numpy(float) for c in ("residual", "predicted_sd"))
        good = rows["accepted"].to_numpy(bool)
        kept = kept_rows([r, np.where(good, np.nan, r)], RESIDUAL_POINTS // len(pairs))
        gate = float(np.sqrt(chi2.ppf(chance, int(rows["together"].max()))))
        out.append(
            {"id": f"residual_{len(out)}", "title": f"{source}: {component}", "unit": unit, "gate": round(gate, 3),
             "edited": int(np.count_nonzero(~good)), "of": len(rows),
             "t": rounded(rows["time_s"].to_numpy()[kept], 3), "y": rounded(r[kept], 4), "sd": rounded(sd[kept], 4),
             "bad": np.flatnonzero(~good[kept]).tolist(), "limit": float(f"{1.6 * gate * np.median(sd):.3g}")}
        )  # fmt: skip
    return out
