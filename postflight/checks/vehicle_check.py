"""Does a vehicle file describe the intended vehicle, and can that vehicle fly as stated?

Numbers that an engineer knows by heart and a wrong sign or unit spoils: mass and c.g., ballistic coefficient ``m / (C_A
S)``, centre of pressure and static margin at small angles, free-free frequency of the joint, and from the static model
of `flightmodel.linear` the dynamic pressure at which the joint diverges and the trim at a stated one::

    x_cp = -C_ma l / C_Na,   static margin = x_cp - x_cg,   q_crit = K / (S C_A xbar (1 + xbar / margin))

Stations are aft of the nose. Trim is that of a c.g. offset carried by the centerbody, without spin; ``q -> 0`` gives
the rigid vehicle's. Coefficients are those of one Mach number, by default the largest of the table, above which they no
longer change; static stability is asked at every Mach number of the table.

The centre of mass of a body lies in its convex hull, as no part of it has a negative mass: a c.g. outside the hull of
the whole vehicle is wrong, whatever is inside.

References
----------
Bose et al., AIAA 2011-2571, eq. [7] and Figure 2.9; docs/derivations.md.
"""

from __future__ import annotations

import json
import sys
from base64 import b64encode
from dataclasses import dataclass, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray, Issue, check_type
from flightmodel.geometry import aft_profile, forward_profile
from flightmodel.linear import Slopes, critical_stiffness_nmprad, levers, slopes_at, static_trim
from flightmodel.tabular import Tabular
from flightmodel.vehicle import Vehicle, shipped
from flightmodel.vehicle import read_vehicle as read_file
from postflight.streams import write_out
from postflight.terminal import EXIT_CHECK_FAILED, terminal

console = terminal()


@dataclass(frozen=True, repr=False)
class VehicleCheck(Tabular):
    """Numbers and drawing of a vehicle file; made by `check_vehicle`.

    Parameters
    ----------
    vehicle : Vehicle
    mach, pressure_pa : float
        Of coefficients and trim; 0 Pa is the rigid vehicle's trim.
    table : DataFrame
        ``quantity, unit`` and one column a state of the mass properties, the first from the start.
    issues : tuple of Issue
        What cannot be meant, each with its remedy.
    """

    vehicle: Vehicle
    mach: float
    pressure_pa: float
    table: pd.DataFrame
    issues: tuple[Issue, ...]

    def to_frame(self) -> pd.DataFrame:
        """Return ``quantity, unit`` and a column of values for each state of the mass properties."""
        return self.table

    def as_json(self) -> dict[str, Any]:
        """Return one object for machines; a number that does not exist is null."""
        table = self.table.astype(object)
        rows = table.where(table.notna(), None).to_dict("records")
        issues = [{"code": issue.code, "source": issue.source, "what": str(issue)} for issue in self.issues]
        about = {"vehicle": self.vehicle.name, "mach": self.mach, "pressure_pa": self.pressure_pa}
        return about | {"quantities": rows, "issues": issues, "passed": not self.issues}

    def _about(self) -> str:
        found = "; ".join(self.issues) or "no issues"
        return f"{self.vehicle.name} at Mach {self.mach:g}, {found}"

    def _repr_html_(self) -> str:
        """Return drawing, table and issues for a notebook."""
        from postflight.plots.style import save
        from postflight.plots.vehicle import figure_vehicle

        picture = BytesIO()
        save(figure_vehicle(self.vehicle, self.mach), picture)
        return f'<img src="data:image/png;base64,{b64encode(picture.getvalue()).decode()}">{super()._repr_html_()}'


class ShownVehicle(Vehicle):
    """A vehicle that a notebook shows as `check_vehicle` does."""

    def __repr__(self) -> str:
        """Name, mass and issues in one line."""
        return f"<Vehicle: {check_vehicle(self)._about()}>"

    def _repr_html_(self) -> str:
        """Return drawing, numbers and issues."""
        return check_vehicle(self)._repr_html_()


def read_vehicle(name: str | Path) -> ShownVehicle:
    """Read a vehicle: a path to a TOML file, or the name of a vehicle that ships with the toolkit.

    In a notebook it shows itself from the side, with the numbers and issues of `check_vehicle`.

    Raises
    ------
    ConfigError
        With every fault of the file, unknown keys with the nearest known one.
    """
    read = read_file(name)
    return ShownVehicle(**{part.name: getattr(read, part.name) for part in fields(read)})


def check_vehicle(vehicle: Vehicle, pressure_pa: float = 0.0, mach: float | None = None) -> VehicleCheck:
    """Compute a vehicle's numbers and name implausible ones.

    Parameters
    ----------
    vehicle : Vehicle
        From `read_vehicle`.
    pressure_pa : float
        Dynamic pressure, Pa, at which it trims, such as the flight's peak; at 0 the trim is that of the rigid vehicle.
    mach : float, optional
        Of the coefficients; by default the largest of the table.

    Returns
    -------
    VehicleCheck
        Its issues have the codes ``cg-outside-vehicle``, ``joint-behind-cg``, ``statically-unstable`` and
        ``pressure-above-critical``.

    Raises
    ------
    GateError
        ``argument-type`` where the first argument is no vehicle.
    """
    check_type("check_vehicle", vehicle, Vehicle, "pf.read_vehicle(name)")
    at = float(vehicle.aero.mach[-1]) if mach is None else mach
    (slopes,) = slopes_at(vehicle, np.array([at]))
    states = mass_states(vehicle)
    found = {name: numbers_of(state, slopes, pressure_pa) for name, state in states.items()}
    table = pd.DataFrame(found).rename_axis(["quantity", "unit"]).reset_index()
    issues = (*vehicle_issues(vehicle), *_too_soft(found, pressure_pa))
    return VehicleCheck(vehicle, at, pressure_pa, table, issues)


def mass_states(vehicle: Vehicle) -> dict[str, Vehicle]:
    """The initial vehicle, and the vehicle after each step of its mass properties, in the file's order."""
    now = replace(vehicle, mass_steps=())
    out = {"at start": now}
    for step in vehicle.mass_steps:
        now = replace(now, aeroshell=step.aeroshell or now.aeroshell, centerbody=step.centerbody or now.centerbody)
        out[f"after {step.event or f'{step.from_s:g} s'}"] = now
    return out


def numbers_of(vehicle: Vehicle, slopes: Slopes, pressure_pa: float) -> dict[tuple[str, str], float]:
    """Numbers of a vehicle by name and unit; NaN if the static model does not define one."""
    margin, offset = static_margin_m(vehicle, slopes), float(np.hypot(*vehicle.cg_m[1:]))
    critical, trim = np.nan, (np.nan, np.nan)
    if margin > 0.0 and levers(vehicle, slopes)[0] > 0.0:
        critical = vehicle.joint.held_stiffness_nmprad / critical_stiffness_nmprad(vehicle, slopes, 1.0)
        if pressure_pa < critical:
            trim = static_trim(vehicle, slopes, pressure_pa, offset)
    at = f"at q = {pressure_pa:g} Pa" if pressure_pa else "at q -> 0 (rigid)"
    return {
        ("mass", "kg"): vehicle.mass_kg,
        ("c.g. aft of the nose", "m"): -float(vehicle.cg_m[0]),
        ("c.g. off the axis", "m"): offset,
        ("ballistic coefficient", "kg/m2"): vehicle.mass_kg / (slopes.ca * vehicle.reference.area_m2),
        ("centre of pressure aft of the nose", "m"): margin - float(vehicle.cg_m[0]),
        ("static margin", "m"): margin,
        ("free-free frequency", "Hz"): vehicle.free_free_frequency_hz(),
        ("critical dynamic pressure", "Pa"): critical,
        (f"trim of the shell {at}", "deg"): float(np.rad2deg(trim[0])),
        (f"deflection {at}", "deg"): float(np.rad2deg(trim[1])),
    }


def static_margin_m(vehicle: Vehicle, slopes: Slopes) -> float:
    """Distance of the centre of pressure behind the c.g., m; NaN where C_N does not rise with the angle."""
    return levers(vehicle, slopes)[1] if slopes.cn_alpha > 0.0 else np.nan


def vehicle_issues(vehicle: Vehicle) -> list[Issue]:
    """Name what is implausible in any mass state: c.g. outside, joint behind the centerbody's c.g., no stability."""
    issues = [issue for state in mass_states(vehicle).values() for issue in (*_outside(state), *_unstable(state))]
    return list({str(issue): issue for issue in issues}.values())


def _outside(vehicle: Vehicle) -> list[Issue]:
    """C.g.s outside the vehicle's convex hull, and a joint behind the centerbody's c.g."""
    from scipy.spatial import Delaunay  # not for those who only import the program

    outline = np.concatenate([outline_station_radius_m(vehicle), outline_station_radius_m(vehicle) * [1.0, -1.0]])
    hull, aft_m, out = Delaunay(outline), outline[:, 0].max(), []
    for name, body in (("aeroshell", vehicle.aeroshell), ("centerbody", vehicle.centerbody)):
        station, aside = -float(body.cg_m[0]), float(np.hypot(*body.cg_m[1:]))
        if hull.find_simplex([station, aside]) < 0:
            side = f"{-station:.3f} m ahead of the nose" if station < 0.0 else f"{station:.3f} m aft of the nose"
            words = (
                f"the c.g. of the {name}, {side} and {aside:.3f} m off the axis, lies outside the vehicle, which "
                f"reaches to {aft_m:.2f} m aft of the nose; x of cg_from_datum_body_m is negative there: check signs "
                "and units"
            )
            out.append(Issue(words, "cg-outside-vehicle", name))
    arm = vehicle.joint_m[0] - vehicle.centerbody.cg_m[0]
    if arm <= 0.0 and not out:  # else the c.g. is what is wrong
        words = (
            f"the joint, {vehicle.joint.station_m:.3f} m aft of the nose, lies {-arm:.3f} m behind the centerbody's "
            "c.g.: deceleration then straightens the joint instead of deflecting it; check joint.station_m and the c.g."
        )
        out.append(Issue(words, "joint-behind-cg", "joint"))
    return out


def outline_station_radius_m(vehicle: Vehicle) -> FloatArray:
    """Points of the outline, (n, 2): station aft of the nose and radius, m, of shell, centerbody and meshes."""
    shell = vehicle.geometry
    length, radius = shell.centerbody_length_m, shell.centerbody_radius_m
    meshes = [mesh.vertices_m for mesh in vehicle.meshes.values()]
    parts = [np.column_stack([-points[:, 0], np.hypot(*points[:, 1:].T)]) for points in meshes]
    return np.concatenate([forward_profile(shell), aft_profile(shell), [[0.0, radius], [length, radius]], *parts])


def _unstable(vehicle: Vehicle) -> list[Issue]:
    """Mach numbers at which the vehicle is statically unstable at small angles."""
    length, station = vehicle.reference.length_m, -float(vehicle.cg_m[0])
    slopes = slopes_at(vehicle, vehicle.aero.mach)
    # about the c.g. and per radian; a stable vehicle's is negative
    moment = np.array([s.cm_alpha * length + s.cn_alpha * station for s in slopes])
    if (moment < 0.0).all():
        return []
    worst, machs = int(np.argmax(moment)), vehicle.aero.mach[moment >= 0.0]
    span = f"Mach {machs[0]:g}" + (f" to {machs[-1]:g}" if len(machs) > 1 else "")
    words = (
        f"statically unstable at {span}: C_m,alpha about the c.g. is {moment[worst] / length:+.3g} per rad at Mach "
        f"{vehicle.aero.mach[worst]:g}: the centre of pressure lies ahead of the c.g., which is {station:.3f} m aft of "
        "the nose; check the c.g., the sign of C_m and the moment reference of the coefficients"
    )
    return [Issue(words, "statically-unstable", "aerodynamics")]


def _too_soft(found: dict[str, dict[tuple[str, str], float]], pressure_pa: float) -> list[Issue]:
    """Critical dynamic pressures below the stated one."""
    critical = {state: numbers["critical dynamic pressure", "Pa"] for state, numbers in found.items()}
    return [
        Issue(
            f"the joint diverges at {limit:.0f} Pa ({state}), below the stated {pressure_pa:.0f} Pa: check "
            "joint.bending_stiffness_nmprad and the pressure", "pressure-above-critical", "joint",
        )
        for state, limit in critical.items()
        if pressure_pa and limit <= pressure_pa
    ]  # fmt: skip


# the command


def is_vehicle(path: Path) -> bool:
    """Whether a command's argument names a vehicle: a TOML file, or a shipped vehicle if no folder has that name."""
    return not path.is_dir() and (path.suffix == ".toml" or str(path) in shipped("vehicle"))


def check(
    name: Path, as_json: bool, strict: bool, pressure: float | None, mach: float | None, drawing: Path | None
) -> None:
    """Print what a vehicle file states, draw it, and with ``strict`` leave with 5 where something cannot be meant."""
    from postflight.plots.style import draw
    from postflight.plots.vehicle import figure_vehicle

    found = check_vehicle(read_file(name), pressure or 0.0, mach)
    picture = drawing or Path(f"{name.stem}.png")
    draw(picture, figure_vehicle, found.vehicle, found.mach)
    if as_json:
        write_out(json.dumps(found.as_json(), indent=2, allow_nan=False) + "\n")
    else:
        rows = [[*row[:2], *("-" if np.isnan(x) else f"{x:.4g}" for x in row[2:])] for row in found.table.to_numpy()]
        console.table(f"{found.vehicle.name} at Mach {found.mach:g}", found.table.columns, rows, ("unit",))
        for issue in found.issues:
            console.coded("[red]suspicious[/]", issue, issue.code)
        console.print(f"drawing in {picture}", markup=False)
    if strict and found.issues:
        sys.exit(EXIT_CHECK_FAILED)
