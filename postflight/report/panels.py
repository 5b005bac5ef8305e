"""Numbers behind the page's time panels: what is drawn over time, with three standard deviations, gaps left as gaps.

The flight against bands of flights that were flown before it, or beside it: a rigid vehicle's, a study's, others.

A table of bands has a row a time, quantity and label: median and outer percentiles, and a nominal flight where there is
one. The run's own is the rigid vehicle's; `montecarlo` and `reconcile` write others (``bands.csv``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import earth
from flightmodel.airdata import pressure_pulse
from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import HOLE_FACTOR
from postflight.deflections import METHODS
from postflight.plots.paper_figures import COLOUR, LABEL, residual_unit
from postflight.report.source import Rows, Run, kept_rows, rounded
from postflight.studies.preflight import inside

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


FILE = "bands.csv"
LOW, MIDDLE, HIGH = "p2.3", "p50", "p97.7"
COLOURS = (GREY, ORANGE, GREEN, DARK)
# quantity of a band: title, unit, and the flight's own from bet.csv
FLOWN: dict[str, tuple[str, str, Callable[[pd.DataFrame], Any]]] = {
    "alpha_total_deg": ("Total angle of attack", "deg", lambda bet: bet["alpha_total_wind_deg"]),
    "normal_g": (
        "Acceleration across the axis at the c.g.",
        "g",
        lambda bet: np.hypot(bet["ay_cg_mps2"], bet["az_cg_mps2"]) / earth.STANDARD_GRAVITY_MPS2,
    ),
    "axial_g": (
        "Acceleration along the axis at the c.g.",
        "g",
        lambda bet: -bet["ax_cg_mps2"] / earth.STANDARD_GRAVITY_MPS2,
    ),
    "rate_degps": ("Rate across the axis", "deg/s", lambda bet: np.hypot(bet["q_body_degps"], bet["r_body_degps"])),
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
    for quantity, unit in (("alpha_total", "deg"), ("normal", "g")):
        columns = {LOW: "low", MIDDLE: "median", HIGH: "high", "nominal": "nominal"}
        part = {new: bounds[f"{quantity}_{old}_{unit}"] for new, old in columns.items()}
        parts.append(pd.DataFrame({"quantity": f"{quantity}_{unit}", "time_s": bounds["t_s"], **part}))
    return panels(run, pd.concat(parts).assign(label="rigid"), "rigid")


def study_panels(run: Run, paths: tuple[Path, ...]) -> list[Panel]:
    """Flight against the bands of Monte Carlo studies and reconciliations.

    Raises
    ------
    GateError
        Where a path holds no bands, or none of a quantity or time of this flight.
    """
    if not paths:
        return []
    return panels(run, pd.concat([read_bands(path) for path in paths]), "bands")


def read_bands(path: Path) -> pd.DataFrame:
    """Read the bands of a folder, or of a file of its own: label, quantity, time, percentiles and nominal."""
    file = path / FILE if path.is_dir() else path
    try:
        table = pd.read_csv(file).rename(columns={"history": "quantity", "joint": "label"})
        numbers = table[["time_s", LOW, MIDDLE, HIGH]].astype(float)
    except FileNotFoundError:
        where = "`postflight montecarlo run` and `postflight reconcile` write them"
        raise GateError(f"{path}: no bands ({FILE}) here; {where}") from None
    except (ValueError, KeyError, OSError) as fault:
        raise GateError(f"{file}: no table of bands: {fault}") from None
    if "quantity" not in table or not len(table):
        words = "name histories in the dispersions file's [outputs] and merge the study again"
        raise GateError(f"{file}: holds no band of any quantity; {words}")
    label = table["label"].astype(str) if "label" in table else path.resolve().name
    nominal = table["nominal"].astype(float) if "nominal" in table else np.nan
    return numbers.assign(label=label, quantity=table["quantity"].astype(str), nominal=nominal)


def panels(run: Run, bands: pd.DataFrame, prefix: str) -> list[Panel]:
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
        elif quantity in FLOWN:
            title, unit, own = FLOWN[str(quantity)]
            t, flown, inner = bet["t_s"].to_numpy()[shown], np.asarray(own(bet[shown]), dtype=float), pulse[shown]
        else:
            continue
        if not np.isfinite(flown).any():
            continue
        lines, top = [], float(np.nanmax(flown))
        for k, (label, band) in enumerate(of_quantity.groupby("label", sort=False)):
            share = share_inside(t[inner], flown[inner], band)
            if np.isfinite(share):
                lines += band_lines(str(label), band, share, COLOURS[k % len(COLOURS)])
                top = max(top, float(np.nanmax(band[MIDDLE])))
        if lines:
            kept = kept_rows([flown], TRAJECTORY_ROWS)
            lines.append(line("this flight", flown[kept], None, BLUE, [], 4) | {"t": rounded(t[kept], 3)})
            # a rigid vehicle may tumble late, out of what is of interest here
            one = panel(f"{prefix}_{quantity}", title, unit, None, lines, [])
            out.append(one | {"ceiling": round(1.5 * top, 2)} | ({"floor": 0} if unit in ("deg", "g") else {}))
    if not out:
        raise GateError(
            f"bands of {', '.join(sorted(set(bands['quantity'])))} from {span[0]:.0f} to {span[1]:.0f} s: none of a "
            f"quantity ({', '.join([*FLOWN, 'deflection_deg'])}) and time of this flight's pulse"
        )
    return out


def share_inside(time_s: FloatArray, flown: FloatArray, band: pd.DataFrame) -> float:
    """Part of the flight's samples, of those at the band's times, that lie inside; NaN where there is none."""
    t = band["time_s"].to_numpy()
    known = np.isfinite(flown) & (time_s >= t[0]) & (time_s <= t[-1])
    if not known.any():
        return float("nan")
    low, high = band[LOW].to_numpy(), band[HIGH].to_numpy()
    return float(np.mean(inside(time_s[known], flown[known], t, low, high)))


def band_lines(label: str, band: pd.DataFrame, share: float, colour: str) -> list[dict[str, Any]]:
    """Median with its band, and the nominal flight where there is one."""
    t = rounded(band["time_s"].to_numpy(), 3)
    low, middle, high = (rounded(band[c].to_numpy(), 4) for c in (LOW, MIDDLE, HIGH))
    words = f"{label}, half above; {100 * share:.0f} % of the pulse inside"
    lines = [
        {"label": words, "t": t, "y": middle, "low": low, "high": high, "colour": colour, "dash": [], "width": 1.2}
    ]
    if band["nominal"].notna().any():
        nominal = rounded(band["nominal"].to_numpy(), 4)
        lines.append({"label": f"{label}, nominal", "t": t, "y": nominal, "colour": DARK, "dash": [2, 3], "width": 1.2})
    return lines
