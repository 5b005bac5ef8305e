"""What does the report draw over time? Trajectory, deflection, residuals, and the flight against bands of others.

Lines carry their standard deviation ``sd``, which the page draws as a band of three and prints as one; gaps stay gaps.
A table of bands (``bands.csv``, which `montecarlo` and `reconcile` write, and the run's own rigid vehicle) has a row
for each time, quantity and label: median, 2.3 and 97.7 percentile, and a nominal flight where there is one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import earth
from flightmodel.airdata import pressure_pulse
from flightmodel.checks import FloatArray, GateError
from flightmodel.statistics import BAND_COLUMNS, chi_square_quantile, inside
from flightmodel.tables import column_about
from postflight.deflections import METHODS, Deflections
from postflight.plots.style import AXES, COLOUR, LABEL, RAW_AXES, drawn_unit, with_holes
from postflight.plots.subject import flow_of
from postflight.report.source import Rows, kept_rows, rounded
from postflight.run_folder import answer_table, read_csv
from postflight.runs import Run
from recon.measurements import component_unit

_TRAJECTORY_ROWS, _RAW_POINTS = 6000, 8000
_NO_ACCELEROMETER = "The flight has no accelerometer."
_NO_GYROS = "Its accelerometer serves as a deceleration along the path; without gyros no force has known axes."
_NO_ATTITUDE = "No inertial sensors carried the attitude, so the angle of attack is not known."
_BLUE, _GREY, _DARK = COLOUR["estimate"], COLOUR["prior"], COLOUR["limit"]
_DASH: dict[str, list[int]] = {"camera": [], "misalignment": [8, 4], "trim": [10, 3, 2, 3], "fused": []}
NO_DEFLECTION = "No method gave a deflection; the reasons stand on the cards above."

Panel = dict[str, Any]
# id, title, unit, scale of the column, decimals, and its lines: label, column, its sd, colour, dash
_TRAJECTORY: list[tuple[str, str, str, float, int, list[tuple[str, str, str | None, str, list[int]]]]] = [
    ("altitude", "Altitude", "km", 1e-3, 4, [("reconstructed", "alt_m", "alt_sd_m", _BLUE, [])]),
    ("speed", "Speed", "m/s", 1.0, 2, [
        ("airspeed", "airspeed_mps", "airspeed_sd_mps", _BLUE, []),
        ("ground speed", "speed_ground_mps", None, _DARK, [6, 4])]),
    ("mach", "Mach number", "", 1.0, 4,
     [("by airspeed and the atmosphere's temperature", "mach", "mach_sd", _BLUE, [])]),
    ("pressure", "Dynamic pressure", "Pa", 1.0, 3,
     [("with the atmosphere's density", "dynamic_pressure_pa", "dynamic_pressure_sd_pa", _BLUE, [])]),
    ("alpha", "Total angle of attack of the centerbody", "deg", 1.0, 3, [
        ("wind-relative", "alpha_total_wind_deg", "alpha_total_wind_sd_deg", _BLUE, []),
        ("without wind", "alpha_total_ground_deg", None, _DARK, [6, 4])]),
    ("axial", "Axial acceleration (body x)", "m/s²", 1.0, 4,
     [("x, corrected, mean of 0.1 s", "ax_imu_mps2", "ax_imu_sd_mps2", _BLUE, [])]),
    ("lateral", "Normal accelerations (body y, z)", "m/s²", 1.0, 4, [
        ("y, corrected", "ay_imu_mps2", "ay_imu_sd_mps2", AXES["y"], []),
        ("z, corrected", "az_imu_mps2", "az_imu_sd_mps2", AXES["z"], [6, 3])]),
]  # fmt: skip
_FLOOR = {"speed", "mach", "pressure", "alpha", "deflection"}


def line_of(
    label: str, values: FloatArray, sd: FloatArray | None, colour: str, dash: list[int], decimals: int
) -> dict[str, Any]:
    """One line of a panel with its standard deviation where it is known."""
    out: dict[str, Any] = {"label": label, "y": rounded(values, decimals), "colour": colour, "dash": dash, "width": 1.6}
    if sd is not None and np.isfinite(sd).any():
        out["sd"] = rounded(sd, decimals)
    return out


def quantities_drawn() -> list[tuple[str, str, str, float, str, str]]:
    """Every quantity with a sd: id, title, unit, scale, its column and the column of its sd."""
    return [
        (f"{name}_{k}", f"{title}: {label}" if len(lines) > 1 else title, unit, scale, column, sd_column)
        for name, title, unit, scale, _, lines in _TRAJECTORY
        for k, (label, column, sd_column, *_) in enumerate(lines)
        if sd_column is not None
    ]


def trajectory_rows(run: Run) -> Rows:
    """Rows of ``bet.csv`` that are drawn."""
    bet = run.tables["bet"]
    shown = [column for *_, lines in _TRAJECTORY for _, column, *_ in lines]
    return kept_rows([bet[c].to_numpy(float) for c in shown], _TRAJECTORY_ROWS)


def trajectory_panels(run: Run, rows: Rows) -> tuple[list[Panel], list[tuple[str, str, str]]]:
    """Panels of the trajectory, and id, title and reason of those that the flight has no data for."""
    bet = run.tables["bet"].iloc[rows]
    raw = {"altitude": _tracker_heights(run)} | _raw_accelerations(run)
    no_force = _NO_ACCELEROMETER if run.telemetry.accelerometer is None else _NO_GYROS
    why_absent = {"alpha": _NO_ATTITUDE, "axial": no_force, "lateral": no_force}
    panels, absent = [], []
    for name, title, unit, scale, decimals, drawn in _TRAJECTORY:
        lines = []
        for label, column, sd_column, colour, dash in drawn:
            if bet[column].notna().any():
                sd = None if sd_column is None else scale * bet[sd_column].to_numpy(float)
                lines.append(line_of(label, scale * bet[column].to_numpy(float), sd, colour, dash, decimals))
        if lines:
            panels.append(panel_of(name, title, unit, "bet", lines, raw.get(name, [])))
        else:
            absent.append((name, title, why_absent.get(name, "The run's table holds no value of it.")))
    return panels, absent


def panel_of(
    name: str, title: str, unit: str, time: str | None, lines: list[dict[str, Any]], raw: list[dict[str, Any]]
) -> Panel:
    """One panel; lines hold times of their own where ``time`` is None."""
    out: Panel = {"id": name, "title": title, "unit": unit, "time": time, "lines": lines, "raw": raw}
    return out | {"floor": 0} if name in _FLOOR else out


def _tracker_heights(run: Run) -> list[dict[str, Any]]:
    """Heights by each tracker's own points, as measured."""
    planet = run.telemetry.planet
    tracks = [
        (name, r.time_s, earth.ecef_from_radar(r.range_az_el, *r.spec.geodetic, planet))
        for name, r in run.telemetry.radars.items()
    ]
    tracks += [(name, r.time_s, r.position_ecef_m) for name, r in run.telemetry.gnss.items() if r.has_positions]
    known = [(name, t, earth.geodetic_from_ecef(places, planet)[2]) for name, t, places in tracks]
    known += [(name, b.time_s, b.height_m) for name, b in run.telemetry.barometers.items()]
    return [_points(name, t, h / 1e3, _GREY, 4, 6000 // len(known)) for name, t, h in known]


def _raw_accelerations(run: Run) -> dict[str, list[dict[str, Any]]]:
    """Accelerometer's samples in body axes, not corrected, by panel."""
    record = run.telemetry.accelerometer
    if record is None:
        return {}
    body = record.measured_sensor @ record.spec.dcm_body_sensor.T
    x, y, z = (
        _points(f"raw {axis}", record.time_s, body[:, k], colour, 3, _RAW_POINTS)
        for k, (axis, colour) in enumerate(RAW_AXES.items())
    )
    return {"axial": [x], "lateral": [y, z]}


def _points(label: str, time_s: FloatArray, values: FloatArray, colour: str, decimals: int, limit: int) -> Panel:
    """Points at their own times, thinned to ``limit`` with all extremes kept; NaN left out."""
    known = np.isfinite(values)
    time_s, values = time_s[known], values[known]
    rows = kept_rows([values], limit) if len(values) else np.empty(0, dtype=int)
    t, y = rounded(time_s[rows], 4), rounded(values[rows], decimals)
    return {"label": label, "t": t, "y": y, "colour": colour, "of": len(values)}


def deflection_panel(run: Run) -> Panel | None:
    """Deflection by every method that answered, each at its own times; None where none did.

    The camera's line is its smooth answer where there is one, with a dot for each frame.
    """
    lines, dots = [], []
    for method in METHODS[::-1]:  # the fusion first and so below the others, which are thinner
        frames, name = run.tables.get(f"deflection_{method}"), answer_table(method, run.tables)
        if frames is None or not len(frames):
            continue
        table = run.tables[name]
        if table is not frames:
            t, theta = (frames[c].to_numpy(float) for c in ("t_s", "theta_deg"))
            dots.append(_points("frames", t, theta, COLOUR[method], 4, _RAW_POINTS))
        t, theta, sd = drawn_answer(table)
        rows = kept_rows([theta], _TRAJECTORY_ROWS // 2)
        one = line_of(LABEL[method], theta[rows], sd[rows], COLOUR[method], _DASH[method], 4)
        # frames are few: each is a dot, which also sets the line apart without colours
        one["dots"] = method == "camera" and table is frames
        lines.append(one | {"t": rounded(t[rows], 4), "width": 3.4 if method == "fused" else 1.4})
    if not lines:
        return None
    out = panel_of("deflection", "Deflection of the aeroshell against the centerbody", "deg", None, lines, dots)
    return out | {"ceiling": round(1.3 * max(max(x for x in one["y"] if x is not None) for one in lines), 2)}


def flow_panels(answers: Deflections) -> list[Panel]:
    """Angle of attack and dynamic pressure of the loads or trajectory that gave answers; none of a film alone."""
    if not answers.knows_peak:
        return []
    flow = flow_of("report", answers)
    rows = kept_rows([flow.alpha_total_wind_rad, flow.dynamic_pressure_pa], _TRAJECTORY_ROWS // 2)
    t = rounded(flow.time_s[rows], 4)
    pressure = line_of("dynamic pressure", flow.dynamic_pressure_pa[rows], None, _BLUE, [], 3) | {"t": t}
    out = [panel_of("pressure", "Dynamic pressure", "Pa", None, [pressure], [])]
    alpha, sd = np.rad2deg([flow.alpha_total_wind_rad[rows], flow.alpha_total_wind_sd_rad[rows]])
    if np.isfinite(alpha).any():
        angle = line_of("wind-relative", alpha, sd, _BLUE, [], 3) | {"t": t}
        out.insert(0, panel_of("alpha", "Total angle of attack of the centerbody", "deg", None, [angle], []))
    return out


def drawn_answer(table: pd.DataFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, angles and their sd, (n,) s and deg, of a table of answers; NaN in its holes."""
    columns = [table[name].to_numpy(float) for name in ("theta_deg", "theta_sd_deg")]
    t, (theta, sd) = with_holes(table["t_s"].to_numpy(float), columns)
    return t, theta, sd


def residual_panels(run: Run) -> list[Panel]:
    """Residuals before each update, with three predicted sd and the gate; one panel a source and component."""

    table = run.tables["residuals"]
    table = table[table["used"].astype(bool)]
    together = table.groupby(["source", "time_s"])["component"].transform("size")
    chance = run.header["settings"]["gate_probability"]
    pairs = list(table.assign(together=together).groupby(["source", "component"], sort=False))
    out: list[Panel] = []
    for (source, component), rows in pairs:
        # a run of version 0.1 states no units, and wrote SI
        scale, unit = drawn_unit(str(rows["unit"].iloc[0]) if "unit" in rows else component_unit(component))
        r, sd = (scale * rows[c].to_numpy(float) for c in ("residual", "predicted_sd"))
        good = rows["accepted"].to_numpy(bool)
        kept = kept_rows([r, np.where(good, np.nan, r)], 16000 // len(pairs))
        gate = float(np.sqrt(chi_square_quantile(chance, int(rows["together"].max()))))
        out.append(
            {"id": f"residual_{len(out)}", "title": f"{source}: {component}", "unit": unit, "gate": round(gate, 3),
             "edited": int(np.count_nonzero(~good)), "of": len(rows),
             "t": rounded(rows["time_s"].to_numpy()[kept], 3), "y": rounded(r[kept], 4), "sd": rounded(sd[kept], 4),
             "bad": np.flatnonzero(~good[kept]).tolist(), "limit": float(f"{1.6 * gate * np.median(sd):.3g}")}
        )  # fmt: skip
    return out


_FILE = "bands.csv"
_LOW, _MIDDLE, _HIGH = BAND_COLUMNS
_COLOURS = (_GREY, COLOUR["second"], COLOUR["corrected"], _DARK)
# quantity of a band: title, unit, and the flight's own from bet.csv
_FLOWN: dict[str, tuple[str, str, Callable[[pd.DataFrame], Any]]] = {
    "alpha_total_deg": ("Total angle of attack", "deg", lambda bet: bet["alpha_total_wind_deg"]),
    "normal_g": (
        "Normal acceleration at the c.g.",
        "g",
        lambda bet: np.hypot(bet["ay_cg_mps2"], bet["az_cg_mps2"]) / earth.STANDARD_GRAVITY_MPS2,
    ),
    "axial_g": ("Axial deceleration at the c.g.", "g", lambda bet: -bet["ax_cg_mps2"] / earth.STANDARD_GRAVITY_MPS2),
    "rate_degps": ("Lateral rate", "deg/s", lambda bet: np.hypot(bet["q_body_degps"], bet["r_body_degps"])),
    "dynamic_pressure_pa": ("Dynamic pressure", "Pa", lambda bet: bet["dynamic_pressure_pa"]),
    "mach": ("Mach number", "", lambda bet: bet["mach"]),
    "altitude_m": ("Altitude", "m", lambda bet: bet["alt_m"]),
}


def rigid_panels(run: Run) -> list[Panel]:
    """Flight against the bands of a rigid vehicle; none where the run flew no rigid vehicle."""
    bounds = run.tables.get("rigid_bounds")
    if bounds is None:
        return []
    parts = []
    columns = {_LOW: "low", _MIDDLE: "median", _HIGH: "high", "nominal": "nominal"}
    for quantity in ("alpha_total_deg", "normal_g"):
        part = {new: bounds[column_about(quantity, old)] for new, old in columns.items()}
        parts.append(pd.DataFrame({"quantity": quantity, "time_s": bounds["t_s"], **part}))
    return _band_panels(run, pd.concat(parts).assign(label="rigid"), "rigid")


def study_panels(run: Run, paths: tuple[Path, ...]) -> list[Panel]:
    """Flight against the bands of Monte Carlo studies and reconciliations.

    Raises
    ------
    GateError
        Where a path holds no bands, or none of a quantity or time of this flight.
    """
    if not paths:
        return []
    return _band_panels(run, pd.concat([_read_bands(path) for path in paths]), "bands")


def _read_bands(path: Path) -> pd.DataFrame:
    """Read the bands of a folder, or of a file of its own: label, quantity, time, percentiles and nominal."""
    file = path / _FILE if path.is_dir() else path
    try:
        table = read_csv(file).rename(columns={"history": "quantity", "joint": "label"})
        numbers = table[["time_s", _LOW, _MIDDLE, _HIGH]].astype(float)
    except FileNotFoundError:
        where = "`postflight montecarlo run` and `postflight reconcile` write them"
        raise GateError(f"{path}: no bands ({_FILE}) here; {where}", "file-missing") from None
    except (ValueError, KeyError, OSError) as fault:
        raise GateError(f"{file}: no table of bands: {fault}", "file-unreadable") from None
    if "quantity" not in table or not len(table):
        words = "name histories in the dispersions file's [outputs] and merge the study again"
        raise GateError(f"{file}: holds no band of any quantity; {words}", "too-few-data")
    label = table["label"].astype(str) if "label" in table else path.resolve().name
    nominal = table["nominal"].astype(float) if "nominal" in table else np.nan
    return numbers.assign(label=label, quantity=table["quantity"].astype(str), nominal=nominal)


def _band_panels(run: Run, bands: pd.DataFrame, prefix: str) -> list[Panel]:
    """One panel for each quantity that the flight has too, with the bands of every label."""
    bet = run.tables["bet"]
    span = bands["time_s"].min(), bands["time_s"].max()
    pulse = np.asarray(pressure_pulse(bet["dynamic_pressure_pa"].to_numpy()))
    shown = bet["t_s"].between(span[0] - 5.0, span[1] + 5.0).to_numpy()
    out = []
    for quantity, of_quantity in bands.groupby("quantity", sort=False):
        if quantity == "deflection_deg" and "deflection_fused" in run.tables:
            fused = run.tables["deflection_fused"]
            title, unit = "Deflection of the aeroshell (fusion)", "deg"
            t, flown = fused["t_s"].to_numpy(), fused["theta_deg"].to_numpy()
            inner = np.interp(t, bet["t_s"], pulse) > 0.5
        elif quantity in _FLOWN:
            title, unit, own = _FLOWN[str(quantity)]
            t, flown, inner = bet["t_s"].to_numpy()[shown], np.asarray(own(bet[shown]), dtype=float), pulse[shown]
        else:
            continue
        if not np.isfinite(flown).any():
            continue
        lines, top = [], float(np.nanmax(flown))
        for k, (label, band) in enumerate(of_quantity.groupby("label", sort=False)):
            share = _share_inside(t[inner], flown[inner], band)
            if np.isfinite(share):
                lines += _band_lines(str(label), band, share, _COLOURS[k % len(_COLOURS)])
                top = max(top, float(np.nanmax(band[_MIDDLE])))
        if lines:
            kept = kept_rows([flown], _TRAJECTORY_ROWS)
            lines.append(line_of("this flight", flown[kept], None, _BLUE, [], 4) | {"t": rounded(t[kept], 3)})
            # a rigid vehicle may tumble late, out of what is of interest here
            one = panel_of(f"{prefix}_{quantity}", title, unit, None, lines, [])
            out.append(one | {"ceiling": round(1.5 * top, 2)} | ({"floor": 0} if unit in ("deg", "g") else {}))
    if not out:
        raise GateError(
            f"bands of {', '.join(sorted(set(bands['quantity'])))} from {span[0]:.0f} to {span[1]:.0f} s: no "
            f"quantity of this flight ({', '.join([*_FLOWN, 'deflection_deg'])}) during its pulse",
            "time-not-covered",
        )
    return out


def _share_inside(time_s: FloatArray, flown: FloatArray, band: pd.DataFrame) -> float:
    """Part of the flight's samples, of those at the band's times, that lie inside; NaN where there is none."""
    t = band["time_s"].to_numpy()
    known = np.isfinite(flown) & (time_s >= t[0]) & (time_s <= t[-1])
    if not known.any():
        return float("nan")
    low, high = band[_LOW].to_numpy(), band[_HIGH].to_numpy()
    return float(np.mean(inside(time_s[known], flown[known], t, low, high)))


def _band_lines(label: str, band: pd.DataFrame, share: float, colour: str) -> list[dict[str, Any]]:
    """Median with its band, and the nominal flight where there is one."""
    t = rounded(band["time_s"].to_numpy(), 3)
    low, middle, high = (rounded(band[c].to_numpy(), 4) for c in (_LOW, _MIDDLE, _HIGH))
    words = f"{label}, median; {100 * share:.0f} % of the pulse inside"
    one = {"label": words, "t": t, "y": middle, "low": low, "high": high, "colour": colour, "dash": [], "width": 1.2}
    if not band["nominal"].notna().any():
        return [one]
    y = rounded(band["nominal"].to_numpy(), 4)
    return [one, {"label": f"{label}, nominal", "t": t, "y": y, "colour": _DARK, "dash": [2, 3], "width": 1.2}]
