"""Which features that a camera can find does an aeroshell carry?

``features`` in ``[geometry]`` of a vehicle file says it: ``"none"`` (the shell's edge alone), ``"texture"`` (whatever
the benchmark frame shows on the shell), ``"drawn"`` (dark seams and dots where `flightmodel.geometry` draws them), or a
CSV beside the vehicle file, a row a point on the shell::

    station_m, radius_m, clock_lv_deg, kind, shade, width_m

``kind``: ``dot``, a spot, measured in both directions; ``seam``, a point of a line along a meridian, measured across
it; ``hoop``, a point of a line round the shell. ``shade``: ``darker`` or ``paler`` than the cloth beside it.
``width_m`` is the spot's diameter or the line's width.

Assumed: the undeflected shell, station aft of the nose; a point lies on the aft side of a torus, or of the mesh.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import ConfigError, FloatArray, GateError, Issue, nearest_name
from flightmodel.geometry import FEATURE_KINDS, ListedFeatures, ShellGeometry, revolved, torus_circles
from flightmodel.mesh_sections import nearest_on_sections
from flightmodel.tables import line_of, numbers, read_table

if TYPE_CHECKING:
    import pandas as pd

SHADES = ("darker", "paler")
NUMBERS = ("station_m", "radius_m", "clock_lv_deg", "width_m")
COLUMNS = ("station_m", "radius_m", "clock_lv_deg", "kind", "shade", "width_m")
_OFF_SURFACE_M = 0.02  # of drawing and inflated shell; beyond it the point is another shell's
_WIDEST_M = 0.2


def read_features(path: Path, geometry: ShellGeometry) -> ListedFeatures:
    """Read a list of features.

    Raises
    ------
    ConfigError
        With every fault of the list: columns, numbers, words, points off the shell.
    """
    try:
        return _listed(read_table(path, "geometry.features"), path, geometry)
    except GateError as fault:
        raise ConfigError(list(fault.faults)) from None


def _listed(frame: pd.DataFrame, path: Path, geometry: ShellGeometry) -> ListedFeatures:
    label = "geometry.features"
    missing = [name for name in COLUMNS if name not in frame]
    if missing:
        hints = "; ".join(f"no column '{name}'{nearest_name(name, list(frame.columns))}" for name in missing)
        raise GateError(f"{label}: {path}: {hints}; wanted are {', '.join(COLUMNS)}", code="column-missing")
    faults: list[Issue] = []
    station, radius, clock, width = (numbers(frame, name, path, label, faults) for name in NUMBERS)
    kind = _words(frame, "kind", FEATURE_KINDS, path, faults)
    shade = _words(frame, "shade", SHADES, path, faults)
    if not faults:
        off_m, normal = _off_surface(geometry, station, radius, np.deg2rad(clock))
        surface = "a torus's surface" if geometry.mesh is None else "the mesh of the aeroshell"
        checks = (
            (np.isfinite(clock) & (np.abs(clock) <= 360.0), "clock_lv_deg", "an angle within 360 deg is wanted"),
            ((width > 0.0) & (width <= _WIDEST_M), "width_m", f"0 to {_WIDEST_M} m is wanted"),
            (off_m <= _OFF_SURFACE_M, "radius_m", f"within {_OFF_SURFACE_M} m of {surface} is wanted"),
        )
        for good, column, wanted in checks:
            if not good.all():
                row = int(np.argmin(good))
                where = f"{label}: {path}: line {line_of(frame, row)}, column '{column}'"
                count = int((~good).sum())
                faults.append(Issue(f"{where}: {frame[column].iloc[row]}: {wanted} ({count} in all)", "edit-unusable"))
    if faults:
        raise GateError(faults)
    at = np.deg2rad(clock)
    points, normals = (_at_clocks(place, at) for place in (np.column_stack([station, radius]), normal))
    return ListedFeatures(points, normals, kind, width, shade == 1)


def _words(
    frame: pd.DataFrame, column: str, known: tuple[str, ...], path: Path, faults: list[Issue]
) -> NDArray[np.int64]:
    """Index of each cell's word among the known ones."""
    cells = frame[column].str.strip()
    strange = ~cells.isin(known).to_numpy()
    if strange.any():
        row = int(np.argmax(strange))
        words = f"geometry.features: {path}: line {line_of(frame, row)}, column '{column}': '{cells.iloc[row]}'"
        faults.append(Issue(f"{words}: {' or '.join(known)} is wanted ({int(strange.sum())} in all)", "not-a-number"))
        return np.zeros(len(cells), dtype=np.int64)
    return cells.map({word: k for k, word in enumerate(known)}).to_numpy(dtype=np.int64)


def _off_surface(
    geometry: ShellGeometry, station: FloatArray, radius: FloatArray, clock_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far places lie off the shell's surface (n,), m, and its normals there (n, 2), station and radius."""
    place = np.column_stack([station, radius])
    if geometry.mesh is not None:
        return nearest_on_sections(geometry.mesh.vertices_m, geometry.mesh.faces, place, clock_rad)
    away = place[:, None] - np.column_stack(torus_circles(geometry))
    nearest = np.argmin(np.hypot(away[:, :, 0], away[:, :, 1]), axis=1)
    away = away[np.arange(len(away)), nearest]
    distance = np.hypot(away[:, 0], away[:, 1])
    return np.abs(distance - geometry.torus_minor_radius_m), away / distance[:, None]


def _at_clocks(station_radius: FloatArray, clock_rad: FloatArray) -> FloatArray:
    """Vectors (n, 3) in shell axes of stations and radii (n, 2), each at its own clocking angle (n,)."""
    return np.asarray(revolved(station_radius[:, None], clock_rad)[:, 0])
