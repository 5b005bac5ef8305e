"""How is a run handed to another program? `postflight export`: a run as one file in the program's format.

=========  ==========================================================================================================
csv        trajectory with UTC, deflections interpolated to its times
parquet    the same, with the unit of each column in its metadata
mat        MATLAB 5: structures ``trajectory``, ``deflection.<method>``, ``covariance`` and ``about``
nc         NetCDF classic, CF conventions 1.8: a trajectory, and deflections at their own times
kml        KML 2.2: the track with its times (gx:Track), the same as a line, events as points
oem        CCSDS Orbit Ephemeris Message 2.0 (KVN): Earth-fixed states, covariances once a second
aem        CCSDS Attitude Ephemeris Message 1.0 (KVN): quaternions from the Earth-fixed to the body frame
msopck     input of NAIF's msopck (attitude and rates for a SPICE C-kernel), and its setup file beside it
=========  ==========================================================================================================

A file is written whole or not at all, with the same bytes for the same run. Deflections have times of their own; in the
tables their two components are interpolated separately (a clock angle jumps at 360 deg), and left empty outside and
in gaps. KML heights are above mean sea level: EGM96, as the format has it.

References
----------
CCSDS 502.0-B-2, Orbit Data Messages, 2009. WGS-84 (G1150 and later) and ITRF2000 agree to centimetres.
CCSDS 504.0-B-1, Attitude Data Messages, 2008, annex on conventions: with ATTITUDE_DIR = A2B the matrix of the
quaternion takes components in A to those in B and its element (1, 2) is ``2 (q1 q2 + q3 qc)``: q is our ``q_A_B``.
NAIF, MSOPCK User's Guide: a SPICE quaternion is that of the C-matrix, which takes the reference frame's components to
the instrument's: our ``q_body_ecef``, scalar first.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import pandas as pd
from rich import markup

from flightmodel import earth, rotations
from flightmodel.checks import ConfigError, FloatArray, GateError
from flightmodel.config import parse_utc
from flightmodel.earth import undulation_m
from flightmodel.files import open_file, write_file, writing
from postflight.intake.stored_tables import missing_library
from postflight.run_folder import DIGITS
from postflight.runs import read_run
from postflight.terminal import terminal

_UNITS = {
    "m": "m", "mps": "m s-1", "mps2": "m s-2", "deg": "degree", "degps": "degree s-1", "pa": "Pa", "kgpm3": "kg m-3",
    "k": "K", "s": "s", "lat_deg": "degrees_north", "lon_deg": "degrees_east",
}  # fmt: skip
_STANDARD = {  # names of the CF conventions
    "lat_deg": "latitude", "lon_deg": "longitude", "alt_m": "height_above_reference_ellipsoid",
    "p_pa": "air_pressure", "t_k": "air_temperature", "rho_kgpm3": "air_density",
    "wind_n_mps": "northward_wind", "wind_e_mps": "eastward_wind", "speed_ground_mps": "platform_speed_wrt_ground",
}  # fmt: skip
_OEM_STATE = ["rx_ecef_m", "ry_ecef_m", "rz_ecef_m", "vx_ecef_mps", "vy_ecef_mps", "vz_ecef_mps"]


@dataclass(frozen=True)
class Source:
    """A run as read for export.

    Parameters
    ----------
    name : str
        Of the flight.
    run : str
        Of the run folder.
    epoch : datetime
        Time zero, UTC.
    finished_utc : str
        When the run ended: the only date that files may carry, so that one run gives one file.
    synthetic : bool
    header : dict
        ``bet_header.json``.
    trajectory, events : DataFrame
        ``bet.csv`` and ``events.csv``.
    deflections : dict of str to DataFrame
        By method.
    covariance_time_s : (k,) float
    covariance : (k, 9, 9) float
        Position and velocity ECEF (m, m/s), rotation body (rad).
    """

    name: str
    run: str
    epoch: datetime
    finished_utc: str
    synthetic: bool
    header: dict[str, Any]
    trajectory: pd.DataFrame
    events: pd.DataFrame
    deflections: dict[str, pd.DataFrame]
    covariance_time_s: FloatArray
    covariance: FloatArray

    def utc(self, t_s: float) -> str:
        """ISO 8601 UTC, microseconds, of a time of the flight."""
        return (self.epoch + timedelta(seconds=float(t_s))).strftime("%Y-%m-%dT%H:%M:%S.%f")

    @property
    def title(self) -> str:
        """Title of the file, in one line."""
        kind = "SYNTHETIC flight" if self.synthetic else "flight"
        return f"Best-estimated trajectory and deflections of the {kind} {self.name}{self.what_if}"

    @property
    def what_if(self) -> str:
        """Assumptions that differ from the run's flight folder, to follow a title; empty if there are none."""
        changes = self.header.get("changes")  # runs of before have none there
        return f"; what-if: {'; '.join(changes)}" if changes else ""


def read_source(folder: Path, wanted: str | None = None) -> Source:
    """Read a run (`read_run`); `GateError` where there is none or its files are incomplete."""
    run = read_run(folder, wanted)
    try:
        with open_file(run.path / "covariance.npz") as file, np.load(file, allow_pickle=False) as stored:
            times, covariance = stored["t_s"], stored["covariance"]
    except (ValueError, KeyError, OSError) as fault:
        raise GateError(f"{run.path}: cannot be read back ({fault}); run it again", "run-incomplete") from None
    stems = (stem for stem in run.tables if stem.startswith("deflection_"))
    deflections = {stem.removeprefix("deflection_"): run.tables[stem] for stem in stems}
    header, finished = run.header, run.facts["finished_utc"]
    return Source(
        header["flight"], run.path.name, parse_utc(header["epoch_utc"]), finished, bool(header["synthetic"]),
        header, run.table, run.tables["events"], deflections, times, covariance,
    )  # fmt: skip


def _unit(column: str) -> str:
    """UDUNITS name of a column's unit, by its suffix; ``1`` for none."""
    return _UNITS.get(column) or _UNITS.get(column.removesuffix("_sd").rsplit("_", 1)[-1], "1")


def _merged(source: Source) -> pd.DataFrame:
    """Trajectory, UTC and deflections, one row a time."""
    t = source.trajectory["t_s"].to_numpy()
    parts = {"t_s": t, "utc": [source.utc(x) + "Z" for x in t]}
    parts |= {name: column.to_numpy() for name, column in source.trajectory.drop(columns="t_s").items()}
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
    outside = (t < at[0]) | (t > at[-1]) | (step[after - 1] > 5.0 * np.median(step))  # a longer step is a gap
    y, z = (np.interp(t, at, theta * f(plane)) for f in (np.cos, np.sin))
    theta_sd, plane_sd = (np.interp(t, at, table[name]) for name in ("theta_sd_deg", "plane_sd_deg"))
    values = np.hypot(y, z), theta_sd, np.mod(np.rad2deg(np.arctan2(z, y)), 360.0), plane_sd
    return {key: np.where(outside, np.nan, value) for key, value in zip(keys, values, strict=True)}


def _csv(source: Source) -> bytes:
    """One CSV."""
    out = io.StringIO()
    _merged(source).to_csv(out, index=False, float_format=DIGITS, lineterminator="\n")
    return out.getvalue().encode()


def _parquet(source: Source) -> bytes:
    """Parquet with the unit of each column in its field's metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = _merged(source)
    utc = pd.to_datetime(table["utc"], format="ISO8601").astype("datetime64[us, UTC]")
    table = table.assign(utc=utc)
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    fields = [f.with_metadata({"unit": _unit(f.name)}) for f in arrow.schema]
    about = {"title": source.title, "run": source.run, "point": source.header["point"]}
    arrow = arrow.cast(pa.schema(fields, metadata={**(arrow.schema.metadata or {}), **about}))
    out = io.BytesIO()
    pq.write_table(arrow, out)
    return out.getvalue()


def _mat(source: Source) -> bytes:
    """MATLAB 5; names longer than MATLAB's 63 letters do not occur."""
    from scipy.io import savemat

    content = {
        "trajectory": _struct(source.trajectory),
        "deflection": {method: _struct(table) for method, table in source.deflections.items()},
        "covariance": {"t_s": source.covariance_time_s[:, None], "position_velocity_rotation": source.covariance},
        "about": {
            "title": source.title, "run": source.run, "epoch_utc": source.utc(0.0) + "Z",
            "point": source.header["point"], "synthetic": source.synthetic,
        },
    }  # fmt: skip
    if not source.deflections:
        del content["deflection"]
    out = io.BytesIO()
    savemat(out, content, long_field_names=True, oned_as="column", do_compression=True)
    # scipy writes the time of writing there
    return b"MATLAB 5.0 MAT-file, postflight export".ljust(116) + out.getvalue()[116:]


def _struct(table: pd.DataFrame) -> dict[str, np.ndarray]:
    return {name: table[name].to_numpy(dtype=float)[:, None] for name in table.columns}


def _netcdf(source: Source) -> bytes:
    """NetCDF after the CF conventions."""
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
    _table(file, source, source.trajectory, "time", "", "time lat_deg lon_deg alt_m")
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
    for column in table.columns.drop("t_s"):
        variable = create(column + ending, "d", (time,))
        variable[:] = table[column].to_numpy(dtype=float)
        variable.units = _unit(column)
        variable.long_name = column.replace("_", " ")
        variable._FillValue = np.nan
        if column in _STANDARD:
            variable.standard_name = _STANDARD[column]
        if column not in coordinates.split():
            variable.coordinates = coordinates


def _kml(source: Source) -> bytes:
    """KML: track, line and events."""
    table = source.trajectory
    t = table["t_s"].to_numpy()
    keep = np.flatnonzero(np.diff(np.floor((t - t[0]) / 0.5 + 1e-9), prepend=-1.0) > 0.0)  # a point every 0.5 s
    keep = np.unique(np.append(keep, len(t) - 1))
    latitude, longitude = np.deg2rad(table[["lat_deg", "lon_deg"]].to_numpy().T)
    above_sea_m = table["alt_m"].to_numpy() - undulation_m(latitude, longitude)
    place = np.column_stack([table[["lon_deg", "lat_deg"]].to_numpy(), above_sea_m])
    description = f"{source.title}; {source.header['point']}. Heights are above mean sea level (EGM96)."
    track = [(source.utc(t[k]), _place(place[k])) for k in keep]
    events = [
        (_label(str(e.event)), source.utc(e.t_s), _place([np.interp(e.t_s, t, c) for c in place.T]))
        for e in source.events.itertuples(index=False)
    ]
    about = escape(escape(_printable(description))).replace("$[", "$ [")
    return _filled("flight.kml", name=_label(source.name), description=about, track=track, events=events)


def _place(coordinates: Iterable[float]) -> list[str]:
    return [f"{v:.9g}" for v in coordinates]


def _label(text: str) -> str:
    """Name of a place: a globe lists it as text, and shows it in a balloon as HTML in which ``$[...]`` is filled in."""
    return escape(_printable(text).translate({ord("<"): "‹", ord(">"): "›"}).replace("$[", "$ ["))


def _oem(source: Source) -> bytes:
    """CCSDS OEM: km, km/s, km^2."""
    t = source.trajectory["t_s"].to_numpy()
    rows = _timed_rows(source, t, source.trajectory[_OEM_STATE].to_numpy() / 1000.0, 9)
    triangles = [
        "\n".join(" ".join(f"{v:.9e}" for v in covariance[k, : k + 1]) for k in range(6))
        for covariance in source.covariance[:, :6, :6] / 1e6
    ]
    covariances = zip(source.covariance_time_s, triangles, strict=True)
    return _message("flight.oem", source, t=t, rows="\n".join(rows), covariances=covariances)


def _message(template: str, source: Source, **values: Any) -> bytes:
    """CCSDS message from a template."""
    name = "".join(c if c.isalnum() and c.isascii() else "_" for c in source.name) or "flight"
    return _filled(template, source=source, name=name, **values)


def _filled(template: str, **values: Any) -> bytes:
    """Text of a template, filled in."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("postflight", "export_templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
    )
    environment.filters["ascii"] = lambda text: _printable(text, "?", ascii_only=True)
    return environment.get_template(template).render(values).encode()


def _attitude(source: Source) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), ``q_ecef_body`` (n, 4) and rates of the body relative to the Earth in body axes (n, 3), rad/s."""
    q = source.trajectory[[f"q{a}_ecef_body" for a in "wxyz"]].to_numpy(dtype=float)
    known = np.isfinite(q).all(axis=1)
    if not known.any():
        words = "no attitude is known, as it has no gyros; --to oem has positions and velocities"
        raise GateError(f"{source.run}: {words}", "attitude-missing")
    q = rotations.continuous(q[known] / np.linalg.norm(q[known], axis=1, keepdims=True))
    rates = np.deg2rad(source.trajectory[[f"{a}_body_degps" for a in "pqr"]].to_numpy(dtype=float)[known])
    earth_rate = np.broadcast_to(earth.OMEGA_ECEF_RADPS, rates.shape)
    return source.trajectory["t_s"].to_numpy()[known], q, rates - rotations.rotate(rotations.conjugate(q), earth_rate)


def _aem(source: Source) -> bytes:
    """CCSDS AEM."""
    t, q, _ = _attitude(source)
    rows = _timed_rows(source, t, q[:, [1, 2, 3, 0]])
    return _message("flight.aem", source, t=t, rows="\n".join(rows))


def _msopck(source: Source) -> bytes:
    """Input of msopck: UTC, SPICE quaternion, rates in the instrument's frame, rad/s."""
    t, q, rates = _attitude(source)
    rows = np.column_stack([rotations.conjugate(q), rates])
    return ("\n".join(_timed_rows(source, t, rows)) + "\n").encode()


def _timed_rows(source: Source, t: FloatArray, rows: FloatArray, decimals: int = 12) -> list[str]:
    return [f"{source.utc(at)} {' '.join(f'{v:.{decimals}f}' for v in row)}" for at, row in zip(t, rows, strict=True)]


def _msopck_setup(source: Source, data: Path) -> bytes:
    """Setup of msopck for the input in a file, as a text kernel; lines are below its 132 characters."""
    longest = float(np.diff(_attitude(source)[0]).max(initial=0.0))
    return _filled(
        "msopck.setup",
        title=_printable(source.title, "?", ascii_only=True),
        command=f"    msopck {data.name}.setup {data.name} {data.stem}.bc",
        stem=data.stem,
        interval=f"{max(1.0, 1.01 * longest):.6g}",
    )


def _printable(text: str, instead: str = " ", *, ascii_only: bool = False) -> str:
    """Text with ``instead`` in place of every character that a format does not allow."""
    return "".join(c if c.isprintable() and (c.isascii() or not ascii_only) else instead for c in text)


# format, which is its file's suffix too: what writes it
FORMS: dict[str, Callable[[Source], bytes]] = {
    "csv": _csv, "parquet": _parquet, "mat": _mat, "nc": _netcdf, "kml": _kml, "oem": _oem, "aem": _aem,
    "msopck": _msopck,
}  # fmt: skip
_OF_THE_EARTH = ("oem", "aem", "kml", "msopck")  # by their frames
console = terminal()


def export(folder: Path, form: str, out: Path | None, run: str | None = None) -> None:
    """Write one file of a run (`find_run`) and say where.

    Raises
    ------
    ConfigError
        Where a library is missing, with the command that installs it; where the file would lie in a run folder.
    GateError
        Where the flight has no run with a trajectory.
    """
    source = read_source(folder, run)
    if form in _OF_THE_EARTH:
        earth.require_earth(source.header.get("planet", "earth"), f"--to {form}")
    path = out or folder / "exports" / f"{source.run}.{form}"
    if (folder / "runs").resolve() in path.resolve().parents:
        raise ConfigError(f"{path}: run folders stay as they were written; name another place", "file-exists")
    try:
        content = FORMS[form](source)
    except ImportError as fault:
        raise ConfigError(f"--to {form} {missing_library(fault)}", "package-missing") from None
    with writing(path, "name another place with --out"):
        write_file(path, content)
        if form == "msopck":
            write_file(path.with_name(f"{path.name}.setup"), _msopck_setup(source, path))
    console.print(
        f"{markup.escape(str(path))} ({len(content) / 1e6:.1f} MB) of run {markup.escape(source.run + source.what_if)}",
        highlight=False,
    )
