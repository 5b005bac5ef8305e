"""One table for spreadsheets and data frames: the trajectory's rows with UTC, and deflections at their times.

Deflections stand at their own times in the run; here they are interpolated between neighbours, their two components
apart (a clock angle has a jump), and left empty outside and in gaps.
"""

from __future__ import annotations

import io

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray
from postflight.exports.source import Source, unit_of
from postflight.results import DIGITS

GAP_FACTOR = 5.0


def merged(source: Source) -> pd.DataFrame:
    """Trajectory, UTC and deflections, one row a time."""
    t = source.trajectory["t_s"].to_numpy()
    parts = {"t_s": t, "utc": [source.utc(x) + "Z" for x in t]}
    parts |= {name: source.trajectory[name].to_numpy() for name in source.trajectory.columns if name != "t_s"}
    for method, table in source.deflections.items():
        parts |= {f"{key}_{method}_{unit}": v for (key, unit), v in _at(table, t).items()}
    return pd.DataFrame(parts)


def _at(table: pd.DataFrame, t: FloatArray) -> dict[tuple[str, str], FloatArray]:
    nothing = np.full(len(t), np.nan)
    keys = [("theta", "deg"), ("theta_sd", "deg"), ("plane_lv", "deg"), ("plane_sd", "deg")]
    if len(table) < 2:
        return dict.fromkeys(keys, nothing)
    at, plane = table["t_s"].to_numpy(), np.deg2rad(table["plane_lv_deg"].to_numpy())
    theta = table["theta_deg"].to_numpy()
    after = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    step = np.diff(at)
    outside = (t < at[0]) | (t > at[-1]) | (step[after - 1] > GAP_FACTOR * np.median(step))
    y, z = (np.interp(t, at, theta * f(plane)) for f in (np.cos, np.sin))
    values = (
        np.hypot(y, z),
        np.interp(t, at, table["theta_sd_deg"]),
        np.mod(np.rad2deg(np.arctan2(z, y)), 360.0),
        np.interp(t, at, table["plane_sd_deg"]),
    )
    return {key: np.where(outside, np.nan, value) for key, value in zip(keys, values, strict=True)}


def csv_bytes(source: Source) -> bytes:
    """One CSV."""
    out = io.StringIO()
    merged(source).to_csv(out, index=False, float_format=DIGITS, lineterminator="\n")
    return out.getvalue().encode()


def parquet_bytes(source: Source) -> bytes:
    """Parquet with the unit of each column in its field's metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = merged(source)
    utc = pd.to_datetime(table["utc"], format="ISO8601").astype("datetime64[us, UTC]")
    table = table.assign(utc=utc)
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    fields = [f.with_metadata({"unit": unit_of(f.name)}) for f in arrow.schema]
    about = {"title": source.title, "run": source.run, "point": source.header["point"]}
    arrow = arrow.cast(pa.schema(fields, metadata={**(arrow.schema.metadata or {}), **about}))
    out = io.BytesIO()
    pq.write_table(arrow, out)
    return out.getvalue()
