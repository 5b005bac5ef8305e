"""How gridded coefficient tables come out of DAVE-ML files (ANSI/AIAA S-119).

Read are ``variableDef``, ``breakpointDef``, ``griddedTableDef`` (alone, or inside a ``functionDefn``) and ``function``
of one dependent and one or two independent variables, Mach number and total angle of attack. The last breakpoint set
of a table varies fastest, as the standard says. Anything else a coefficient depends on is refused by name: this is a
reader of tables, not of models. Entities and document type subsets are refused before anything is expanded, and
nothing outside the file is ever opened.

References
----------
ANSI/AIAA S-119-2011 (R2016), "Flight Dynamics Model Exchange Standard"; DAVE-ML 2.0 reference.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import FloatArray, GateError

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
                faults.append(f"{path}: no variable for {coefficient}: name it one of {', '.join(sorted(names))}")
        elif match[0] not in functions:
            faults.append(
                f"{path}: variable '{match[0]}' has no gridded function; tabulate it (calculations are not read)"
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
        data = path.read_bytes()
    except OSError as fault:
        raise GateError(f"{path}: cannot be read: {fault.strerror or fault}") from None
    if len(data) > LARGEST_BYTES:
        raise GateError(f"{path}: {len(data)} bytes; DAVE-ML files above {LARGEST_BYTES} are not read")
    scout = expat.ParserCreate()

    def refuse(*_: Any) -> None:
        raise GateError(f"{path}: declares XML entities or its own document type; remove the DOCTYPE's [...] part")

    def doctype(_name: str, _system: str | None, _public: str | None, has_subset: int) -> None:
        if has_subset:
            refuse()

    scout.StartDoctypeDeclHandler = doctype
    scout.EntityDeclHandler = refuse
    try:
        scout.Parse(data, True)
        root = ET.fromstring(data)
    except (expat.ExpatError, ET.ParseError) as fault:
        raise GateError(f"{path}: not valid XML: {fault}") from None
    for element in root.iter():
        element.tag = str(element.tag).rsplit("}", 1)[-1]
    if root.tag != "DAVEfunc":
        raise GateError(f"{path}: its root is '{root.tag}', not DAVEfunc")
    return root


def _numbers(path: Path, element: ET.Element | None, where: str, faults: list[str]) -> FloatArray:
    text = re.sub(r"[,\s]+", " ", (element.text or "") if element is not None else "").strip()
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([])
    if len(values) == 0 or not np.isfinite(values).all():
        faults.append(f"{path}: '{where}' holds no list of finite numbers")
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
            faults.append(f"{path}: '{output}' depends on '{name}'; only Mach number and angle of attack are read")
    definition = function.find("functionDefn")
    table = definition.find("griddedTableDef") if definition is not None else None
    if definition is not None and table is None:
        link = definition.find("griddedTableRef")
        table = tables.get(link.get("gtID", "")) if link is not None else None
    if table is None:
        faults.append(f"{path}: the function of '{output}' has no griddedTableDef; ungridded tables are not read")
        return None
    units = table.get("units") or (variables[output].get("units") or "")
    if units not in NO_UNITS:
        faults.append(f"{path}: '{output}' is in '{units}'; coefficients without unit are read")
    grids = []
    for reference, name, axis in zip(table.findall("breakpointRefs/bpRef"), inputs, axes, strict=False):
        knots = points.get(reference.get("bpID", ""), np.array([]))
        unit = (variables[name].get("units") or "") if name in variables else ""
        if axis == "alpha" and unit not in ANGLE_UNITS:
            faults.append(f"{path}: '{name}' is in '{unit}'; deg or rad is read")
        if len(knots) < 2 or (np.diff(knots) <= 0).any():
            faults.append(f"{path}: breakpoints '{reference.get('bpID')}' do not increase or are not defined")
        grids.append(knots * ANGLE_UNITS.get(unit, 1.0) if axis == "alpha" else knots)
    values = _numbers(path, table.find("dataTable"), output, faults)
    if len(grids) != len(inputs) or not inputs or values.size != np.prod([len(g) for g in grids]):
        faults.append(f"{path}: '{output}' has {values.size} values where its breakpoints want another number")
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
        raise GateError(f"{path}: angles must run from 0 to 180 deg in multiples of their smallest step")
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
