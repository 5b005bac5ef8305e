"""What does the air do to the aeroshell, and where do the coefficients come from?

Coefficients refer to ``q S`` and ``q S l`` and act at the nose (datum) of the shell, in the plane of the total angle
of attack: ``C_A`` along -x, ``C_N`` against the lateral velocity, ``C_m`` nose-up positive (so a stable shape has
C_m < 0), ``C_mq`` per ``omega l / (2 V)`` on the transverse rates. Between the table's knots they are linear, which is
the seed paper's blend from Mach 5.7 to 3.5 where the table has no knot in between. Where molecules seldom meet, they
pass to the free-molecular coefficients, if the table has them (`flightmodel.sphere_cone`).

They come from a table with its sidecar, or from the shape of a sphere-cone alone. A table (CSV, or DAVE-ML) has beside
it a TOML file of the same stem with what its numbers refer to; they are converted to what `AeroTable` holds: axial and
normal force in body axes, moments about the nose, damping per ``omega l / (2 V)``, all on the vehicle's own reference
area and length:

    C_m,nose = C_m,ref - C_N x_ref / l

with ``x_ref`` the station, aft of the nose, that the table's moments are about. Damping is taken over as it is: moving
it would need the force due to pitch rate, which such tables do not hold.

Of DAVE-ML are read ``variableDef``, ``breakpointDef``, ``griddedTableDef`` (alone, or inside a ``functionDefn``) and
``function`` of one dependent and one or two independent variables, Mach number and total angle of attack. The last
breakpoint set of a table varies fastest, as the standard has it. Anything else a coefficient depends on is refused by
name: this is a reader of tables, not of models. Entities and document type subsets are refused before anything is
expanded, and nothing outside the file is ever opened.

References
----------
ANSI/AIAA S-119-2011 (R2016), "Flight Dynamics Model Exchange Standard"; DAVE-ML 2.0 reference.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal
from xml.parsers import expat

import numpy as np
from pydantic import Field

from flightmodel.checks import ConfigError, FloatArray, GateError, Issue, TableRangeError
from flightmodel.config import (
    FileBeside,
    Fraction,
    KeyFault,
    Length,
    Place,
    Section,
    one_of,
    read_section,
)
from flightmodel.files import file_bytes, nothing_at
from flightmodel.sphere_cone import (
    bridge,
    sphere_cone_closed_form,
    sphere_cone_free_molecular,
    sphere_cone_quadrature,
    stagnation_cp,
    wall_speed_ratio,
)
from flightmodel.tables import plain_number

MOST_FAULTS = 10
AXIAL_TOLERANCE = 1e-6
AXIAL_RULE = "0 is wanted there, as the shell is a body of revolution; put an asymmetry into the c.g."
COLUMNS = ("mach", "alpha_deg", "ca", "cn", "cm", "cmq")
# as others write them: all of a column's name, or its first word before words that only say about or in what
SPELLINGS = {
    "mach": {"mach", "ma", "machnumber", "machno", "machzahl"},
    "alpha_deg": {"alpha", "alphadeg", "aoa", "aoadeg", "anstellwinkel"},
    "ca": {"ca", "caxial"},
    "cn": {"cn", "cnormal"},
    "cd": {"cd", "cdrag"},
    "cl": {"cl", "clift"},
    "cm": {"cm", "cmy", "cpitch"},
    "cmq": {"cmq", "cmqcmadot"},
}
SAID_BESIDE = {"deg", "total", "t", "nose", "nase", "cg", "ref", "mrc", "mrp", "body", "wind", "number", "no"}
# above the cone's half-angle part of it lies in shadow; no entry vehicle of the class flies there, so look-ups stop
INVERSE_LIMIT_RAD = np.deg2rad(60.0)
_ROWS = 512  # that are looked up inversely at a time


@dataclass(frozen=True)
class AeroTable:
    """Coefficients on a grid of Mach number and total angle of attack.

    Parameters
    ----------
    mach : (m,) float
        Strictly increasing knots. Below the first and above the last the end values hold (Mach-number independence
        above; subsonic coefficients are flat below Mach 0.6).
    alpha_rad : (a,) float
        Uniform from 0 to pi.
    coefficients : (m, a, 4) float
        C_A, C_N, C_m at the nose, C_mq.
    free_molecular : (a, 4) float or None
        The same on the same angles in free-molecular flow; None keeps the continuum's at any Knudsen number.
    """

    mach: FloatArray
    alpha_rad: FloatArray
    coefficients: FloatArray
    free_molecular: FloatArray | None = None

    def at(
        self, mach: FloatArray | float, alpha_rad: FloatArray | float, knudsen: FloatArray | float | None = None
    ) -> FloatArray:
        """C_A, C_N, C_m, C_mq ``(..., 4)`` at Mach numbers and total angles of attack.

        Given Knudsen numbers too, they are bridged to the table's free-molecular coefficients (`rarefied.bridge`).

        Raises
        ------
        TableRangeError
            For angles outside 0 to pi, or where an argument is not a number.
        """
        m, a = np.broadcast_arrays(np.asarray(mach, dtype=float), np.asarray(alpha_rad, dtype=float))
        inside = (a >= 0.0) & (a <= self.alpha_rad[-1]) & (m >= 0.0)
        if not inside.all():
            bad = int(np.argmin(inside))
            raise TableRangeError(
                f"aerodynamic table: Mach {m.flat[bad]:.3f}, angle {np.rad2deg(a.flat[bad]):.2f} deg "
                f"lies outside Mach >= 0, 0 to {np.rad2deg(self.alpha_rad[-1]):.0f} deg",
                code="table-range",
            )
        from scipy.interpolate import RegularGridInterpolator  # half a second to import

        grid = RegularGridInterpolator((self.mach, self.alpha_rad), self.coefficients)
        points = np.stack([np.clip(m, self.mach[0], self.mach[-1]), a], axis=-1)
        continuum = grid(points).reshape(*m.shape, 4)
        if knudsen is None or self.free_molecular is None:
            return continuum
        free = RegularGridInterpolator((self.alpha_rad,), self.free_molecular)(a[..., None])
        return continuum + bridge(knudsen)[..., None] * (free.reshape(continuum.shape) - continuum)

    def ratio(self, mach: FloatArray | float, alpha_rad: FloatArray | float) -> FloatArray:
        """C_N/C_A (seed paper eq. [2])."""
        c = self.at(mach, alpha_rad)
        return c[..., 1] / c[..., 0]

    def alpha_from_ratio(self, mach: FloatArray, ratio: FloatArray) -> FloatArray:
        """Total angle of attack, rad, whose C_N/C_A is ``ratio`` (seed paper eq. [3]); NaN outside 0 to 60 deg."""
        mach, ratio = np.broadcast_arrays(np.asarray(mach, dtype=float), np.asarray(ratio, dtype=float))
        knots = self.alpha_rad[self.alpha_rad <= INVERSE_LIMIT_RAD + 1e-9]
        flat, table = ratio.ravel(), np.empty((ratio.size, len(knots)))
        for first in range(0, len(table), _ROWS):  # each point has dozens of knots
            part = slice(first, first + _ROWS)
            table[part] = self.ratio(mach.ravel()[part, None], knots[None, :])
        k = np.clip(np.sum(table <= flat[:, None], axis=1) - 1, 0, len(knots) - 2)
        row = np.arange(len(flat))
        fraction = (flat - table[row, k]) / (table[row, k + 1] - table[row, k])
        alpha = knots[k] + fraction * (knots[1] - knots[0])
        outside = (flat < 0.0) | (flat > table[:, -1])
        return np.where(outside, np.nan, alpha).reshape(ratio.shape)

    def scaled(self, ca: float = 1.0, cn: float = 1.0, cm: float = 1.0, cmq_shift: float = 0.0) -> AeroTable:
        """Dispersed copy: factors on C_A, C_N, C_m, and a shift of C_mq."""
        factor, shift = np.array([ca, cn, cm, 1.0]), np.array([0.0, 0.0, 0.0, cmq_shift])
        free = None if self.free_molecular is None else self.free_molecular * factor + shift
        return replace(self, coefficients=self.coefficients * factor + shift, free_molecular=free)


def check_axial_flow(path: Path, table: AeroTable) -> None:
    """Raise `GateError` if normal force or pitching moment is not zero at zero angle of attack."""
    faults = [
        f"{path}: Mach {mach:g}, angle 0: {name} = {value:g}; {AXIAL_RULE}"
        for mach, row in zip(table.mach, table.coefficients[:, 0], strict=True)
        for name, value in (("normal force (lift)", row[1]), ("pitching moment", row[2]))
        if abs(value) > AXIAL_TOLERANCE
    ]
    if faults:
        raise GateError(faults[:MOST_FAULTS], code="aero-grid")


def _row_faults(row: list[float], names: tuple[str, ...]) -> list[Issue]:
    """Say what no row of a coefficient table may hold; ``row`` is finite, in the order of ``names``."""
    mach, alpha = row[:2]
    faults = (
        [] if mach >= 0.0 else [Issue(f"column '{names[0]}': {mach:g}; a Mach number is not negative", "value-range")]
    )
    if not 0.0 <= alpha <= 180.0:
        faults.append(Issue(f"column '{names[1]}': {alpha:g}; an angle from 0 to 180 deg is wanted", "value-range"))
    if alpha == 0.0:
        off = [k for k in (3, 4) if abs(row[k]) > AXIAL_TOLERANCE]
        faults += [Issue(f"column '{names[k]}': {row[k]:g} at angle 0; {AXIAL_RULE}", "aero-grid") for k in off]
    return faults


def named_columns(wanted: tuple[str, ...], header: list[str]) -> dict[str, str]:
    """Map each of the ``wanted`` columns to the one header name that matches it, however it is written."""
    words = {column: re.findall("[a-z]+", column.lower()) for column in header}
    found: dict[str, str] = {}
    for name in wanted:
        same = [c for c in header if c.lower() == name] or [c for c in header if "".join(words[c]) in SPELLINGS[name]]
        near = same or [
            c for c in header if words[c] and words[c][0] in SPELLINGS[name] and set(words[c][1:]) <= SAID_BESIDE
        ]
        if len(near) == 1 and near[0] not in found.values():
            found[name] = near[0]
    return found


def read_aero_table(path: Path, names: tuple[str, ...] = COLUMNS) -> AeroTable:
    """Read a coefficient table: columns mach, alpha_deg, ca, cn, cm, cmq, one row a grid point, ``#`` comments.

    What the columns refer to is in the sidecar; ``names`` are the columns' in that order.

    Raises
    ------
    GateError
        With every fault: missing columns, numbers that are not finite, a grid with holes or uneven angles.
    """
    try:
        text = file_bytes(path, LARGEST_BYTES).decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: {nothing_at(path)}", code="file-missing") from None
    except (OSError, UnicodeDecodeError) as fault:
        code = getattr(fault, "code", "file-unreadable")
        raise GateError(f"{path}: cannot be read as a table: {getattr(fault, 'strerror', fault)}", code) from None
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip()]
    columns = _columns(path, names, lines[0] if lines else (1, ""))
    rows, faults = [], []
    for k, line in lines[1:]:
        row, wrong = _grid_point(line, names, columns)
        rows.append(row)
        faults += [Issue(f"{path}, line {k}: {fault}", fault.code) for fault in wrong]
    if faults:
        more = Issue(f"{path}: {len(faults)} faults in all", "more-faults")
        raise GateError([*faults[:MOST_FAULTS], *[more] * (len(faults) > MOST_FAULTS)])
    return _on_grid(path, np.array(rows, dtype=float).reshape(-1, len(names)))


def _columns(path: Path, names: tuple[str, ...], head: tuple[int, str]) -> list[str]:
    """Find a table's columns in its first line; `GateError` if a wanted one is missing or repeated."""
    header = [cell.strip() for cell in head[1].split("#")[0].split(",")] if head[1] else []
    header = [c.lower() if c.lower() in names else c for c in header]
    missing = [c for c in names if c not in header]
    if missing:
        near = named_columns(names, header)
        meant = [f"'{near[c]}' looks like {c}: name it so" for c in missing if c in near]
        words = f"columns {', '.join(missing)} are missing; wanted {', '.join(names)}; found {', '.join(header)}"
        raise GateError("; ".join([f"{path}: {words}", *meant]), code="column-missing")
    twice = [c for c in names if header.count(c) > 1]
    if twice:
        words = f"columns {', '.join(twice)} stand twice; keep one of each"
        raise GateError(f"{path}, line {head[0]}: {words}", code="given-twice")
    return header


def _grid_point(line: str, names: tuple[str, ...], columns: list[str]) -> tuple[list[float], list[Issue]]:
    """Numbers of a line in the order of ``names``, and what is wrong with them."""
    cells = [cell.strip() for cell in line.split("#")[0].split(",")]
    if len(cells) != len(columns):
        words = f"{len(cells)} cells where {len(columns)} are wanted; got '{line.strip()}'"
        return [], [Issue(words, "row-ragged")]
    there = {c: cells[columns.index(c)] for c in names}
    row = [plain_number(cell) for cell in there.values()]
    bad = [c for c, value in zip(names, row, strict=True) if not np.isfinite(value)]
    faults = [Issue(f"column '{c}': '{there[c]}' is no finite number", "not-a-number") for c in bad]
    return row, faults or _row_faults(row, names)


def _on_grid(path: Path, values: FloatArray) -> AeroTable:
    """Table of points (n, 6) that lie on a whole grid; `GateError` where they do not."""
    values = values[np.lexsort((values[:, 1], values[:, 0]))]
    mach, alpha_deg = np.unique(values[:, 0]), np.unique(values[:, 1])
    faults = []
    if len(values) != len(mach) * len(alpha_deg) or len(np.unique(values[:, :2], axis=0)) != len(values):
        wanted = f"{len(mach)} Mach x {len(alpha_deg)} angles, each once, are wanted"
        faults.append(Issue(f"{path}: {len(values)} rows where {wanted}", "aero-grid"))
    if len(alpha_deg) < 2 or len(mach) < 2 or np.ptp(np.diff(alpha_deg)) > 1e-9 or alpha_deg[0] != 0.0:
        words = "angles must be evenly spaced from 0, and at least two, as Mach numbers"
        faults.append(Issue(f"{path}: {words}", "aero-grid"))
    elif abs(alpha_deg[-1] - 180.0) > 1e-9:
        words = f"angles end at {alpha_deg[-1]:g} deg; give rows to 180: above the air all are met"
        faults.append(Issue(f"{path}: {words}", "aero-grid"))
    if faults:
        raise GateError(faults)
    grid = values[:, 2:].reshape(len(mach), len(alpha_deg), 4)
    return AeroTable(mach, np.deg2rad(alpha_deg), np.ascontiguousarray(grid))


LARGEST_BYTES = 50_000_000
# exact names (varID or name); C_n is yawing moment in this field, so letter case counts
MACH_NAMES = {"mach", "Mach", "MACH", "machNumber", "mach_number"}
ALPHA_NAMES = {"alpha", "ALPHA", "alphaTotal", "alpha_total", "angleOfAttack", "totalAngleOfAttack", "alphat"}
COEFFICIENT_NAMES = {
    "CA": {"CA", "Ca", "axialForceCoefficient"},
    "CN": {"CN", "normalForceCoefficient"},
    "CD": {"CD", "dragCoefficient"},
    "CL": {"CL", "liftCoefficient"},
    "CM": {"CM", "Cm", "pitchMomentCoefficient", "pitchingMomentCoefficient"},
    "CMQ": {"CMQ", "CMq", "Cmq", "pitchDampingCoefficient", "pitchMomentCoefficientDueToPitchRate"},
}
ANGLE_UNITS = {"deg": np.pi / 180.0, "d": np.pi / 180.0, "degrees": np.pi / 180.0, "rad": 1.0, "r": 1.0, "radians": 1.0}
NO_UNITS = {"", "nd", "ND", "1", "nondimensional"}


def read_daveml(path: Path, force_names: tuple[str, str] = ("CA", "CN")) -> AeroTable:
    """Read C_A, C_N (or C_D, C_L), C_m and, if it is there, C_mq over Mach and total angle of attack.

    Parameters
    ----------
    path : Path
    force_names : tuple of str
        ``("CA", "CN")``, or ``("CD", "CL")`` for wind axes, which then stand in their places.

    Returns
    -------
    AeroTable
        On the union of all breakpoints, angles evenly spaced; C_mq is zero where the file has none.

    Raises
    ------
    GateError
        With every fault: what is missing, not understood, or not safe to read.
    """
    root = _parse(path)
    faults: list[str] = []
    variables = {v.get("varID", ""): v for v in root.findall("variableDef")}
    points = {b.get("bpID", ""): _numbers(path, b.find("bpVals"), b.get("bpID", ""), faults) for b in
              root.findall("breakpointDef")}  # fmt: skip
    tables = {t.get("gtID", ""): t for t in root.findall("griddedTableDef")}
    functions = {}
    for function in root.findall("function"):
        reference = function.find("dependentVarRef")
        functions[reference.get("varID", "") if reference is not None else ""] = function
    found: dict[str, tuple[list[str], list[FloatArray], FloatArray]] = {}
    for coefficient in (*force_names, "CM", "CMQ"):
        names = COEFFICIENT_NAMES[coefficient]
        match = [i for i, v in variables.items() if i in names or v.get("name", "") in names]
        if not match:
            if coefficient != "CMQ":
                faults.append(
                    Issue(
                        f"{path}: no variable for {coefficient}: name it one of {', '.join(sorted(names))}",
                        "daveml-unsupported",
                    )
                )
        elif match[0] not in functions:
            faults.append(
                Issue(
                    f"{path}: variable '{match[0]}' has no gridded function; tabulate it (calculations are not read)",
                    "daveml-unsupported",
                )
            )
        else:
            grid = _grid(path, functions[match[0]], match[0], variables, points, tables, faults)
            if grid is not None:
                found[coefficient] = grid
    if faults:
        raise GateError(faults)
    return _on_one_grid(path, [found.get(c) for c in (*force_names, "CM", "CMQ")])


def _parse(path: Path) -> ET.Element:
    try:
        data = file_bytes(path, LARGEST_BYTES)
    except OSError as fault:
        code = getattr(fault, "code", "file-unreadable")
        raise GateError(f"{path}: cannot be read: {fault.strerror or fault}", code) from None
    scout = expat.ParserCreate()

    def refuse(*_: Any) -> None:
        raise GateError(
            f"{path}: declares XML entities or its own document type; remove the DOCTYPE's [...] part",
            code="file-unreadable",
        )

    def doctype(_name: str, _system: str | None, _public: str | None, has_subset: int) -> None:
        if has_subset:
            refuse()

    scout.StartDoctypeDeclHandler = doctype
    scout.EntityDeclHandler = refuse
    try:
        scout.Parse(data, True)
        root = ET.fromstring(data)
    except (expat.ExpatError, ET.ParseError) as fault:
        raise GateError(f"{path}: not valid XML: {fault}", code="file-unreadable") from None
    for element in root.iter():
        element.tag = str(element.tag).rsplit("}", 1)[-1]
    if root.tag != "DAVEfunc":
        raise GateError(f"{path}: its root is '{root.tag}', not DAVEfunc", code="file-unreadable")
    return root


def _numbers(path: Path, element: ET.Element | None, where: str, faults: list[str]) -> FloatArray:
    text = re.sub(r"[,\s]+", " ", (element.text or "") if element is not None else "").strip()
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([])
    if len(values) == 0 or not np.isfinite(values).all():
        faults.append(Issue(f"{path}: '{where}' holds no list of finite numbers", "file-unreadable"))
    return values


def _grid(
    path: Path, function: ET.Element, output: str, variables: dict[str, ET.Element], points: dict[str, FloatArray],
    tables: dict[str, ET.Element], faults: list[str],
) -> tuple[list[str], list[FloatArray], FloatArray] | None:  # fmt: skip
    """Axes ("mach", "alpha"), their breakpoints (alpha in rad) and values of one function; None with faults."""
    before = len(faults)
    inputs = [reference.get("varID", "") for reference in function.findall("independentVarRef")]
    axes = []
    for name in inputs:
        alias = {name, variables[name].get("name", "")} if name in variables else {name}
        axes.append("mach" if alias & MACH_NAMES else "alpha" if alias & ALPHA_NAMES else "")
        if not axes[-1]:
            faults.append(
                Issue(
                    f"{path}: '{output}' depends on '{name}'; only Mach number and angle of attack are read",
                    "daveml-unsupported",
                )
            )
    definition = function.find("functionDefn")
    table = definition.find("griddedTableDef") if definition is not None else None
    if definition is not None and table is None:
        link = definition.find("griddedTableRef")
        table = tables.get(link.get("gtID", "")) if link is not None else None
    if table is None:
        faults.append(
            Issue(
                f"{path}: the function of '{output}' has no griddedTableDef; ungridded tables are not read",
                "daveml-unsupported",
            )
        )
        return None
    units = table.get("units") or (variables[output].get("units") or "")
    if units not in NO_UNITS:
        faults.append(
            Issue(f"{path}: '{output}' is in '{units}'; coefficients without unit are read", "daveml-unsupported")
        )
    grids = []
    for reference, name, axis in zip(table.findall("breakpointRefs/bpRef"), inputs, axes, strict=False):
        knots = points.get(reference.get("bpID", ""), np.array([]))
        unit = (variables[name].get("units") or "") if name in variables else ""
        if axis == "alpha" and unit not in ANGLE_UNITS:
            faults.append(Issue(f"{path}: '{name}' is in '{unit}'; deg or rad is read", "daveml-unsupported"))
        if len(knots) < 2 or (np.diff(knots) <= 0).any():
            faults.append(
                Issue(
                    f"{path}: breakpoints '{reference.get('bpID')}' do not increase or are not defined",
                    "file-unreadable",
                )
            )
        grids.append(knots * ANGLE_UNITS.get(unit, 1.0) if axis == "alpha" else knots)
    values = _numbers(path, table.find("dataTable"), output, faults)
    if len(grids) != len(inputs) or not inputs or values.size != np.prod([len(g) for g in grids]):
        faults.append(
            Issue(
                f"{path}: '{output}' has {values.size} values where its breakpoints want another number",
                "file-unreadable",
            )
        )
    return None if len(faults) > before else (axes, grids, values.reshape([len(g) for g in grids]))


def _on_one_grid(path: Path, found: list[tuple[list[str], list[FloatArray], FloatArray] | None]) -> AeroTable:
    every = {"mach": np.array([0.0]), "alpha": np.array([0.0, np.pi])}
    for axis in every:
        knots = [g for part in found if part is not None for a, g in zip(part[0], part[1], strict=True) if a == axis]
        if knots:
            every[axis] = np.unique(np.round(np.concatenate(knots), 9))
    mach, alpha = every["mach"], every["alpha"]
    step = np.diff(alpha).min()
    even = np.linspace(0.0, np.pi, round(np.pi / step) + 1)
    if (
        abs(alpha[0]) > 1e-8
        or abs(alpha[-1] - np.pi) > 1e-8
        or np.abs(alpha / step - np.round(alpha / step)).max() > 1e-5
    ):
        raise GateError(
            f"{path}: angles must run from 0 to 180 deg in multiples of their smallest step", code="aero-grid"
        )
    mach = mach if len(mach) > 1 else np.array([mach[0], mach[0] + 1.0])
    at = {"mach": mach[:, None], "alpha": even[None, :]}
    c = np.zeros((len(mach), len(even), 4))
    from scipy.interpolate import RegularGridInterpolator  # half a second to import

    for k, part in enumerate(found):
        if part is not None:
            axes, grids, values = part
            held = [
                np.clip(at[a], g[0], g[-1]) + 0.0 * at["mach"] * at["alpha"] for a, g in zip(axes, grids, strict=True)
            ]
            c[..., k] = RegularGridInterpolator(grids, values)(np.stack(held, axis=-1))
    return AeroTable(mach, even, c)


MachNumber = Annotated[float, Field(ge=0.0, le=1000.0)]
Degrees = Annotated[float, Field(ge=0.0, le=180.0)]
Factor = Annotated[float, Field(ge=0.0, le=100.0)]
Coefficient = Annotated[float, Field(ge=-1000.0, le=1000.0)]
MACH = (0.0, 0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.7, 6.5, 8.0, 10.0, 15.0, 20.0)
ALPHA_RAD = np.deg2rad(np.arange(0.0, 181.0))


class TableUncertainty(Section):
    """One standard deviation of the coefficients, as fractions; used where the vehicle file gives none."""

    ca: Fraction | None = None
    cn: Fraction | None = None
    cm: Fraction | None = None


class Sidecar(Section):
    """Reference data and origin of a coefficient table."""

    source: Annotated[str, Field(min_length=1)]
    licence: Annotated[str, Field(min_length=1)]
    area_m2: Annotated[float, Field(ge=1e-6, le=1e4)]
    length_m: Length
    moment_reference_station_m: Place
    axes: Literal["body", "wind"] = "body"
    damping_per: Literal["ql/2V", "ql/V"] = "ql/2V"
    uncertainty: TableUncertainty = TableUncertainty()


class Knots(Section):
    """A factor over Mach, linear between knots, constant beyond them."""

    mach: tuple[MachNumber, ...]
    value: tuple[Factor, ...]

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if not self.mach or len(self.mach) != len(self.value) or not _increase(self.mach):
            yield "", None, "as many values as Mach numbers, which increase, are wanted"


class DampingTable(Section):
    """C_mq over Mach (rows) and total angle of attack (columns), linear between, constant beyond."""

    mach: Annotated[tuple[MachNumber, ...], Field(min_length=1)]
    alpha_deg: Annotated[tuple[Degrees, ...], Field(min_length=1)]
    value: tuple[tuple[Coefficient, ...], ...]

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        sizes = {len(row) for row in self.value}
        if len(self.value) != len(self.mach) or sizes != {len(self.alpha_deg)}:
            yield "", None, "one row a Mach number and one value an angle are wanted"
        if not _increase(self.mach) or not _increase(self.alpha_deg):
            yield "", None, "Mach numbers and angles must increase"


class SphereCone(Section):
    """A spherically blunted cone with a flat base, in modified Newtonian flow."""

    half_angle_deg: Annotated[float, Field(gt=0.0, lt=90.0)]
    nose_radius_m: Length
    base_radius_m: Length
    mach: Annotated[tuple[MachNumber, ...], Field(min_length=2)] = MACH
    k_a: Knots | None = None
    k_n: Knots | None = None
    cmq: Coefficient | None = None
    cmq_table: DampingTable | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        widest = self.base_radius_m / float(np.cos(np.deg2rad(self.half_angle_deg)))
        if self.nose_radius_m >= widest:
            words = f"the nose cap is wider than the base; below {widest:.4g} m for this base and angle"
            yield "nose_radius_m", self.nose_radius_m, words
        if (self.cmq is None) == (self.cmq_table is None):
            yield "cmq", self.cmq, "either cmq or cmq_table is wanted, and not both"
        if not _increase(self.mach):
            yield "mach", self.mach, "Mach numbers must increase"


class FreeMolecular(Section):
    """Free-molecular coefficients from the vehicle's own shape, with a wall that re-emits at its temperature."""

    wall_temperature_k: Annotated[float, Field(ge=1.0, le=1e4)] = 300.0
    speed_mps: Annotated[float, Field(ge=1.0, le=2e4)] = 1500.0


class Aerodynamics(Section):
    """The ``[aerodynamics]`` of a vehicle file: a table, or a sphere-cone; free-molecular flow if asked for."""

    table: FileBeside | None = None
    sphere_cone: SphereCone | None = None
    free_molecular: FreeMolecular | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        yield from one_of(self, "table", "sphere_cone")


@dataclass(frozen=True)
class Shape:
    """A sphere-cone and the vehicle's reference area and length."""

    half_angle_rad: float
    nose_radius_m: float
    base_radius_m: float
    area_m2: float
    length_m: float


def _increase(values: tuple[float, ...]) -> bool:
    return all(b > a for a, b in pairwise(values))


def aerodynamics_from(
    spec: Aerodynamics, shape: Shape, folders: tuple[Path, ...]
) -> tuple[AeroTable, TableUncertainty]:
    """Table of a vehicle and its stated uncertainty.

    Parameters
    ----------
    spec : Aerodynamics
    shape : Shape
        The vehicle's geometry and reference; free-molecular coefficients are those of this shape.
    folders : tuple of Path
        Where a table is looked for, in order.

    Raises
    ------
    GateError
        With every fault of table and sidecar.
    """
    known = TableUncertainty()
    if spec.sphere_cone is not None:
        table = table_from_sphere_cone(spec.sphere_cone, shape.area_m2, shape.length_m)
    else:
        assert spec.table is not None
        found = [folder / spec.table for folder in folders if (folder / spec.table).exists()]
        table, sidecar = read_with_sidecar(found[0] if found else folders[0] / spec.table)
        table, known = referred_to(table, sidecar, shape.area_m2, shape.length_m), sidecar.uncertainty
    if spec.free_molecular is not None:
        table = _with_free_molecular(table, spec.free_molecular, shape)
    return table, known


def read_with_sidecar(path: Path) -> tuple[AeroTable, Sidecar]:
    """Read a table, ``.csv`` or DAVE-ML (``.dml``, ``.xml``), and the sidecar of its stem, as they stand in the files.

    Raises
    ------
    ConfigError
        Where only the sidecar has faults, or the table does not exist.
    GateError
        Where the table has faults, with all of both.
    """
    faults: list[str] = []
    beside, sidecar, table = path.with_suffix(".toml"), None, None
    try:
        sidecar = read_section(Sidecar, beside)
    except ConfigError as fault:
        wanted = "; a table needs one beside it: source, licence, area_m2, length_m, moment_reference_station_m"
        faults += fault.faults if beside.exists() else [Issue(f"{beside}: no such file{wanted}", "file-missing")]
    wind = sidecar is not None and sidecar.axes == "wind"
    names = (*COLUMNS[:2], "cd", "cl", *COLUMNS[4:]) if wind else COLUMNS
    try:
        daveml = path.suffix.lower() in (".dml", ".xml")
        if not path.is_file():
            raise ConfigError(f"{path}: {nothing_at(path)}; key 'aerodynamics.table' names it", code="file-missing")
        table = read_daveml(path, ("CD", "CL") if wind else ("CA", "CN")) if daveml else read_aero_table(path, names)
        if daveml:
            check_axial_flow(path, table)
    except GateError as fault:
        raise type(fault)([*fault.faults, *faults]) from None
    if sidecar is None:
        raise ConfigError(faults)
    return table, sidecar


def referred_to(table: AeroTable, sidecar: Sidecar, area_m2: float, length_m: float) -> AeroTable:
    """Table in body axes, about the nose, per ``omega l / (2 V)``, on another reference area and length."""
    c = table.coefficients.copy()
    if sidecar.axes == "wind":
        drag, lift = c[..., 0].copy(), c[..., 1].copy()
        cosine, sine = np.cos(table.alpha_rad), np.sin(table.alpha_rad)
        c[..., 0] = drag * cosine - lift * sine
        c[..., 1] = drag * sine + lift * cosine
    if sidecar.moment_reference_station_m != 0.0:
        c[..., 2] -= c[..., 1] * (sidecar.moment_reference_station_m / sidecar.length_m)
    if sidecar.damping_per == "ql/V":
        c[..., 3] *= 2.0
    area, length = sidecar.area_m2 / area_m2, sidecar.length_m / length_m
    return AeroTable(table.mach, table.alpha_rad, c * (area * np.array([1.0, 1.0, length, length**2])))


@lru_cache(maxsize=8)
def _newtonian_shape(half_angle_rad: float, nose_radius_m: float, base_radius_m: float) -> FloatArray:
    """C_A, C_N, C_m (length 1 m) for ``Cp_max = 1`` on `ALPHA_RAD` ``(181, 3)``: closed form, then quadrature."""
    arguments = (half_angle_rad, nose_radius_m, base_radius_m, 1.0)
    closed = np.stack(sphere_cone_closed_form(ALPHA_RAD, *arguments), axis=-1)
    # 48 points: below 1e-6 from 400
    shadowed = [sphere_cone_quadrature(a, *arguments, 48) if a > half_angle_rad else (0.0,) * 3 for a in ALPHA_RAD]
    return np.where((half_angle_rad >= ALPHA_RAD)[:, None], closed, np.array(shadowed))


def table_from_sphere_cone(spec: SphereCone, area_m2: float, length_m: float) -> AeroTable:
    """Modified Newtonian table of a sphere-cone, 0 to 180 deg: C_A times ``k_a``, C_N and C_m times ``k_n``.

    Parameters
    ----------
    spec : SphereCone
    area_m2, length_m : float
        The vehicle's reference area and length.
    """
    mach = np.array(spec.mach)
    shape = _newtonian_shape(float(np.deg2rad(spec.half_angle_deg)), spec.nose_radius_m, spec.base_radius_m)
    area = np.pi * spec.base_radius_m**2 / area_m2
    k_a, k_n = (np.ones(len(mach)) if k is None else np.interp(mach, k.mach, k.value) for k in (spec.k_a, spec.k_n))
    scale = stagnation_cp(mach)[:, None] * area * np.column_stack([k_a, k_n, k_n / length_m])
    c = np.empty((len(mach), len(ALPHA_RAD), 4))
    c[..., :3] = scale[:, None, :] * shape
    if spec.cmq_table is None:
        c[..., 3] = spec.cmq
    else:
        d = spec.cmq_table
        by_alpha = np.array([np.interp(np.rad2deg(ALPHA_RAD), d.alpha_deg, row) for row in d.value])
        c[..., 3] = np.column_stack([np.interp(mach, d.mach, column) for column in by_alpha.T])
    return AeroTable(mach, ALPHA_RAD.copy(), c)


def _with_free_molecular(table: AeroTable, spec: FreeMolecular, shape: Shape) -> AeroTable:
    free = sphere_cone_free_molecular(
        table.alpha_rad,
        shape.half_angle_rad,
        shape.nose_radius_m,
        shape.base_radius_m,
        shape.length_m,
        wall_speed_ratio(spec.wall_temperature_k, spec.speed_mps),
    )
    area = np.pi * shape.base_radius_m**2 / shape.area_m2
    return AeroTable(table.mach, table.alpha_rad, table.coefficients, free * area)
