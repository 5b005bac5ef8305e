"""Which error sizes did flight.toml leave to the defaults, and which does the flight itself show? To paste there.

Noise is the stated one times the root mean square of a tracker's normalised residuals; biases and time tags are the
estimates of the trajectory's solution with their sd, as comments: one flight's bias is no standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from postflight.report.source import Run

_LEAST_POINTS = 30  # of residuals: the noise to an eighth
_DEG = "deg"
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


def _degrees(angle_rad: float) -> float:
    return float(np.rad2deg(angle_rad))


def assumed(run: Run) -> list[tuple[str, str]]:
    """Tables of flight.toml with the sizes that they do not state, as the run took them; none of runs of before."""
    tables = run.header.get("assumed") or {}
    return [(name, ", ".join(f"{key} = {size:g}" for key, size in keys.items())) for name, keys in tables.items()]


def measured(run: Run) -> str:
    """Lines for flight.toml with what the flight shows of its trackers and sensors; empty where it shows nothing."""
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
    mine = residuals[(residuals["source"] == name) & (residuals["count"] - residuals["edited"] >= _LEAST_POINTS)]
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
        scale, unit = (180.0 / np.pi, str(row.unit).replace("rad", _DEG)) if angle else (1.0, str(row.unit))
        value, sd, prior = (scale * float(x) for x in (row.estimate, row.sd, row.prior_sd))
        out.append(f"# {error}: {value:+.3g} +/- {sd:.3g} {unit} in this flight; a priori sd {prior:.3g}")
    return out
