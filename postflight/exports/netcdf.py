"""NetCDF after the CF conventions 1.8 (classic format, by scipy): a trajectory, and deflections at their own times."""

from __future__ import annotations

import io

import numpy as np
import pandas as pd

from postflight.exports.source import Source, unit_of

STANDARD = {
    "lat_deg": "latitude",
    "lon_deg": "longitude",
    "alt_m": "height_above_reference_ellipsoid",
    "p_pa": "air_pressure",
    "t_k": "air_temperature",
    "rho_kgpm3": "air_density",
    "wind_n_mps": "northward_wind",
    "wind_e_mps": "eastward_wind",
    "speed_ground_mps": "platform_speed_wrt_ground",
}
COORDINATES = "time lat_deg lon_deg alt_m"


def netcdf_bytes(source: Source) -> bytes:
    """Return one .nc file."""
    from scipy.io import netcdf_file

    out = io.BytesIO()
    file = netcdf_file(out, "w", version=2)
    file.Conventions = "CF-1.8"
    file.title = source.title
    file.featureType = "trajectory"
    file.source = "postflight: trajectory estimated from flight telemetry"
    file.history = f"{source.finished_utc} run {source.run}"
    file.comment = f"point: {source.header['point']}; columns: {source.header['frames']['flow']}"
    label = source.name.encode()
    file.createDimension("name_length", max(1, len(label)))
    identity = file.createVariable("trajectory_id", "c", ("name_length",))
    identity[:] = np.frombuffer(label, dtype="S1") if label else b" "
    identity.cf_role = "trajectory_id"
    _table(file, source, source.trajectory, "time", "", COORDINATES)
    for method, table in source.deflections.items():
        if len(table):
            _table(file, source, table, f"time_{method}", f"_{method}", f"time_{method}")
    file.flush()
    content = out.getvalue()
    file.close()
    return content


def _table(file: object, source: Source, table: pd.DataFrame, time: str, ending: str, coordinates: str) -> None:
    create = file.createVariable  # type: ignore[attr-defined]
    file.createDimension(time, len(table))  # type: ignore[attr-defined]
    axis = create(time, "d", (time,))
    axis[:] = table["t_s"].to_numpy(dtype=float)
    axis.standard_name, axis.axis, axis.calendar = "time", "T", "standard"
    axis.units = f"seconds since {source.epoch:%Y-%m-%d %H:%M:%S.%f}"
    for column in table.columns:
        if column == "t_s":
            continue
        variable = create(column + ending, "d", (time,))
        variable[:] = table[column].to_numpy(dtype=float)
        variable.units = unit_of(column)
        variable.long_name = column.replace("_", " ")
        variable._FillValue = np.nan
        if column in STANDARD:
            variable.standard_name = STANDARD[column]
        if column not in coordinates.split():
            variable.coordinates = coordinates
