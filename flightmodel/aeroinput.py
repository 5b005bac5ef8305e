"""Where a vehicle's coefficients come from: a table with its sidecar, or the shape of a sphere-cone alone.

A table (CSV, or DAVE-ML) has beside it a TOML file of the same stem that says what its numbers refer to; they are
turned to what `AeroTable` holds: axial and normal force in body axes, moments about the nose, damping per
``omega l / (2 V)``, all on the vehicle's own reference area and length:

    C_m,nose = C_m,ref - C_N x_ref / l

with ``x_ref`` the station, aft of the nose, that the table's moments are about. Damping is taken over as it is: moving
it would need the force due to pitch rate, which such tables do not hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from flightmodel.aerodynamics import COLUMNS, AeroTable, check_axial_flow, read_aero_table
from flightmodel.checks import ConfigError, FloatArray, GateError
from flightmodel.config import FileBeside, Fraction, KeyFaults, Length, Place, Section, parse_section, read_toml
from flightmodel.daveml import read_daveml
from flightmodel.newtonian import sphere_cone_closed_form, sphere_cone_quadrature, stagnation_cp
from flightmodel.rarefied import sphere_cone_free_molecular, wall_speed_ratio

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
    """What a coefficient table's numbers refer to, and where they come from."""

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

    @model_validator(mode="after")
    def _matched(self) -> Knots:
        if not self.mach or len(self.mach) != len(self.value) or not _increase(self.mach):
            raise ValueError("as many values as Mach numbers, which increase, are wanted")
        return self


class DampingTable(Section):
    """C_mq over Mach (rows) and total angle of attack (columns), linear between, constant beyond."""

    mach: Annotated[tuple[MachNumber, ...], Field(min_length=1)]
    alpha_deg: Annotated[tuple[Degrees, ...], Field(min_length=1)]
    value: tuple[tuple[Coefficient, ...], ...]

    @model_validator(mode="after")
    def _matched(self) -> DampingTable:
        sizes = {len(row) for row in self.value}
        if len(self.value) != len(self.mach) or sizes != {len(self.alpha_deg)}:
            raise ValueError("one row a Mach number and one value an angle are wanted")
        if not _increase(self.mach) or not _increase(self.alpha_deg):
            raise ValueError("Mach numbers and angles must increase")
        return self


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

    @model_validator(mode="after")
    def _possible(self) -> SphereCone:
        faults: list[tuple[str, object, str]] = []
        widest = self.base_radius_m / float(np.cos(np.deg2rad(self.half_angle_deg)))
        if self.nose_radius_m >= widest:
            words = f"the nose cap is wider than the base; below {widest:.4g} m for this base and angle"
            faults.append(("nose_radius_m", self.nose_radius_m, words))
        if (self.cmq is None) == (self.cmq_table is None):
            faults.append(("cmq", self.cmq, "either cmq or cmq_table is wanted, and not both"))
        if not _increase(self.mach):
            faults.append(("mach", self.mach, "Mach numbers must increase"))
        if faults:
            raise KeyFaults(faults)
        return self


class FreeMolecular(Section):
    """Free-molecular coefficients from the vehicle's own shape, with a wall that re-emits at its temperature."""

    wall_temperature_k: Annotated[float, Field(ge=1.0, le=1e4)] = 300.0
    speed_mps: Annotated[float, Field(ge=1.0, le=2e4)] = 1500.0


class Aerodynamics(Section):
    """The ``[aerodynamics]`` of a vehicle file: a table, or a sphere-cone; free-molecular flow if asked for."""

    table: FileBeside | None = None
    sphere_cone: SphereCone | None = None
    free_molecular: FreeMolecular | None = None

    @model_validator(mode="after")
    def _one(self) -> Aerodynamics:
        if (self.table is None) == (self.sphere_cone is None):
            raise ValueError("either table or sphere_cone is wanted, and not both")
        return self


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
        sidecar = parse_section(Sidecar, read_toml(beside), str(beside))
    except ConfigError as fault:
        wanted = "; a table needs one beside it: source, licence, area_m2, length_m, moment_reference_station_m"
        faults += fault.faults if beside.exists() else [f"{beside}: no such file{wanted}"]
    wind = sidecar is not None and sidecar.axes == "wind"
    names = (*COLUMNS[:2], "cd", "cl", *COLUMNS[4:]) if wind else COLUMNS
    try:
        daveml = path.suffix.lower() in (".dml", ".xml")
        if not path.is_file():
            raise ConfigError(f"{path}: no such aerodynamic table; key 'aerodynamics.table' names it")
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
