"""The flight against bands of flights that were flown before it, or beside it: a rigid vehicle's, a study's, others.

A table of bands has a row a time, quantity and label: median and outer percentiles, and a nominal flight where there is
one. The run's own is the rigid vehicle's; `montecarlo` and `reconcile` write others (``bands.csv``).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import FloatArray, GateError
from postflight.preflight import inside
from postflight.report.series import BLUE, DARK, GREEN, GREY, ORANGE, TRAJECTORY_ROWS, Panel, line, panel
from postflight.report.source import Run
from postflight.report.thinning import kept_rows, rounded

G0_MPS2 = 9.80665
FILE = "bands.csv"
LOW, MIDDLE, HIGH = "p2.3", "p50", "p97.7"
COLOURS = (GREY, ORANGE, GREEN, DARK)
# quantity of a band: title, unit, and the flight's own from bet.csv
FLOWN: dict[str, tuple[str, str, Callable[[pd.DataFrame], Any]]] = {
    "alpha_total_deg": ("Total angle of attack", "deg", lambda bet: bet["alpha_total_wind_deg"]),
    "normal_g": (
        "Acceleration across the axis at the c.g.",
        "g",
        lambda bet: np.hypot(bet["ay_cg_mps2"], bet["az_cg_mps2"]) / G0_MPS2,
    ),
    "axial_g": ("Acceleration along the axis at the c.g.", "g", lambda bet: -bet["ax_cg_mps2"] / G0_MPS2),
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
