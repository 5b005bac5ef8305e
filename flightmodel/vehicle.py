"""What flies: two rigid bodies, the joint between them, their coefficients, sensors and cameras, from a TOML file.

Body axes lie in the centerbody: x out of the nose, y and z as POST2's (y clocked at 180 deg, z at 90 deg in the
launch-vehicle frame). The datum is the nose. *Shell* axes equal body axes when the joint is not bent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from flightmodel.aerodynamics import Aerodynamics, AeroTable, Coefficient, Shape, aerodynamics_from
from flightmodel.checks import ConfigError, FloatArray, Issue, check_positive_definite, check_type, nearest_name
from flightmodel.config import (
    Angle,
    ErrorAngle,
    Fraction,
    KeyFault,
    Label,
    Length,
    Name,
    Place,
    Section,
    Time,
    one_of,
    read_section,
)
from flightmodel.deflection import lv_direction
from flightmodel.files import leads_outside
from flightmodel.geometry import BodyMesh, MeshFiles, ShellGeometry, body_meshes
from flightmodel.instruments import dcm_body_from_clocking
from flightmodel.shell_features import read_features

DATA = Path(__file__).parent / "data"
SAME_SHAPE = 0.1  # the cone of the coefficients may be an effective one, but not another vehicle's
Stiffness = Annotated[float, Field(ge=0.0, le=1e15)]
Damping = Annotated[float, Field(ge=0.0, le=1e12)]
Metres = Annotated[float, Field(ge=0.0, le=10.0)]
Inertia = Annotated[float, Field(ge=-1e15, le=1e15)]
Pixels = Annotated[float, Field(ge=-1e5, le=1e5)]
Focal = Annotated[float, Field(ge=1e-3, le=1e5)]
Distortion = Annotated[float, Field(ge=-100.0, le=100.0)]
Vector = tuple[Place, Place, Place]
InertiaRow = tuple[Inertia, Inertia, Inertia]
InertiaRows = tuple[InertiaRow, InertiaRow, InertiaRow]


class Reference(Section):
    """Reference area and length of the coefficients."""

    area_m2: Annotated[float, Field(ge=1e-6, le=1e4)]
    length_m: Length


class MassProperties(Section):
    """Mass, c.g. from the datum in body axes, inertia tensor about the body's own c.g. in body axes."""

    mass_kg: Annotated[float, Field(ge=1e-6, le=1e12)]
    cg_from_datum_body_m: Vector
    inertia_kgm2: InertiaRows

    @field_validator("inertia_kgm2", mode="before", json_schema_input_type=InertiaRow | InertiaRows)
    @classmethod
    def _rows(cls, value: Any) -> Any:
        """Three numbers are the diagonal."""
        if isinstance(value, str):
            return value
        of_three = isinstance(value, (list, tuple)) and len(value) == 3
        if of_three and not any(isinstance(v, (list, tuple, str, bool)) for v in value):
            return [[value[i] if i == k else 0.0 for i in range(3)] for k in range(3)]
        if not of_three or not all(isinstance(row, (list, tuple)) and len(row) == 3 for row in value):
            raise ValueError("three numbers (about body x, y, z) or three rows of three are wanted, kg m2")
        return value

    @field_validator("inertia_kgm2")
    @classmethod
    def _physical(cls, value: tuple[InertiaRow, ...]) -> tuple[InertiaRow, ...]:
        tensor = np.array(value)
        check_positive_definite("inertia", tensor)
        principal = np.linalg.eigvalsh(tensor)
        if principal[2] > principal[0] + principal[1] + 1e-9:
            raise ValueError(f"principal moments {np.round(principal, 4).tolist()} break the triangle inequality")
        return value

    @property
    def cg_m(self) -> FloatArray:
        """C.g. from the datum, body axes, (3,), m."""
        return np.array(self.cg_from_datum_body_m)

    @property
    def inertia(self) -> FloatArray:
        """Inertia tensor about the c.g., (3, 3), kg m^2."""
        return np.array(self.inertia_kgm2)


class MassStep(Section):
    """Mass properties of the stated bodies from a time of flight, or a named event, until the next step."""

    from_s: Time | None = None
    event: Label | None = None
    aeroshell: MassProperties | None = None
    centerbody: MassProperties | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        yield from one_of(self, "from_s", "event")
        if self.aeroshell is None and self.centerbody is None:
            yield "", None, "the body that changes is wanted: aeroshell, centerbody or both"


class CompliantJoint(Section):
    """Spherical joint on the axis with bending and torsion springs, damping, freeplay, hardening and creep.

    The bending moment is ``F = K1 d + K2 |d| d + K3 d^3`` of the spring's angle ``d`` beyond the freeplay, the damping
    moment ``(C1 + C3 theta^2)`` times the relative angular rate. The deflection is the spring's angle and the creep
    ``b`` (standard linear solid, a spring and a Kelvin element in series; docs/derivations.md)::

        creep_time_s b' + b = creep_share / (1 - creep_share) F / K1

    so that ``K1`` holds for fast motion, ``K1 (1 - creep_share)`` for a load that stays, and ``creep_share`` is the
    part of the compliance that comes late.
    """

    station_m: Place
    bending_stiffness_nmprad: Stiffness
    bending_damping_nmsprad: Damping = 0.0
    torsion_stiffness_nmprad: Stiffness
    torsion_damping_nmsprad: Damping = 0.0
    freeplay_deg: ErrorAngle = 0.0
    freeplay_corner: Annotated[float, Field(gt=0.0, le=0.5)] = 0.02
    quadratic_nmprad2: Annotated[float, Field(ge=-1e15, le=1e15)] = 0.0
    hardening_nmprad3: Stiffness = 0.0
    damping_hardening_nmsprad3: Damping = 0.0
    creep_share: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0
    creep_time_s: Annotated[float, Field(ge=0.1, le=1e4)] = 10.0

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.creep_share > 0.0 and self.bending_stiffness_nmprad == 0.0:
            yield "creep_share", self.creep_share, "a joint without bending stiffness has none; 0"
        least = -np.sqrt(3.0 * self.bending_stiffness_nmprad * self.hardening_nmprad3)
        if self.quadratic_nmprad2 < min(least, 0.0):
            words = f"the moment would fall with the angle; at least -sqrt(3 K1 K3) = {least:.4g} is wanted"
            yield "quadratic_nmprad2", self.quadratic_nmprad2, words

    @property
    def delayed_compliance_radpnm(self) -> float:
        """Compliance that comes late, rad/(N m)."""
        if self.creep_share == 0.0:
            return 0.0
        return self.creep_share / (1.0 - self.creep_share) / self.bending_stiffness_nmprad

    @property
    def held_stiffness_nmprad(self) -> float:
        """Bending stiffness under a sustained load, N m/rad; without creep, under any load."""
        return self.bending_stiffness_nmprad * (1.0 - self.creep_share)


class Uncertainty(Section):
    """What is known of the vehicle before flight, one standard deviation; fractions where no unit is named.

    Mass, c.g. and inertia are each body's own; products of inertia are the centerbody's, of its transverse moment;
    C_mq's is absolute. ``ca_shape_part`` is the part of the variance of C_A that changes with Mach number; the rest is
    one factor at all of them; ``cn_shape_part`` and so on alike.
    """

    mass: Fraction = 0.01
    cg_station_m: Metres = 0.01
    cg_lateral_m: Metres = 0.001
    inertia: Fraction = 0.03
    inertia_products: Fraction = 0.002
    ca: Fraction = 0.03
    ca_shape_part: Fraction = 0.5
    cn: Fraction = 0.07
    cn_shape_part: Fraction = 0.5
    cm: Fraction = 0.10
    cm_shape_part: Fraction = 0.5
    cmq: Annotated[float, Field(ge=0.0, le=10.0)] = 0.15
    cmq_shape_part: Fraction = 0.5


class AeroTerms(Section):
    """What a table over Mach number and total angle of attack cannot say of a shell; all zero of a body of revolution.

    In shell axes, with ``n`` the unit vector of the flow's lateral velocity at the nose, ``phi`` its clock angle, ``e``
    the lateral part of the centerbody's x axis (as long as the sine of the deflection), ``p``, ``w`` the shell's own
    rates about x and across it, ``k`` and ``g`` order and share of the dependence on roll::

        lateral force  = -q S ((1 + g cos k (phi - phi_0)) C_N n + cn_deflection e)
        axial force    = -q S (C_A + ca_deflection |e|^2)
        moment, x      = q S l (cl + clp p l / 2V)
        moment, across = q S l (((1 + g cos k (phi - phi_0)) C_m n + cm_deflection e) x x_hat
                                + l / 2V (C_mq w + cnr_less_cmq sin(alpha)^2 (w n) n))

    ``e`` points to where the flow would have to come from for a flow angle of that size: the increments by deflection
    are those of that much more incidence, of a shell that its load has deformed. ``w n`` is the rate in the plane of
    the angle of attack, of coning; at no angle a body of revolution damps it as it damps pitching. A side force by the
    dependence on roll is neglected.

    References
    ----------
    M. Tobak, L. B. Schiff, "Generalized formulation of nonlinear pitch-yaw-roll coupling", AIAA J. 13 (1975) 323, 327
    (coning). C. H. Murphy, "Free flight motion of symmetric missiles", BRL Report 1216 (1963) (roll, asymmetries).
    """

    cl: Coefficient = 0.0
    clp: Coefficient = 0.0
    cnr_less_cmq: Coefficient = 0.0
    ca_deflection: Coefficient = 0.0
    cn_deflection: Coefficient = 0.0
    cm_deflection: Coefficient = 0.0
    roll_order: Annotated[int, Field(ge=0, le=12)] = 0
    roll_share: Annotated[float, Field(ge=-0.9, le=0.9)] = 0.0
    roll_clock_lv_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if (self.roll_order == 0) != (self.roll_share == 0.0):
            yield "", None, "roll_order (1 or more) and roll_share are wanted together"

    @property
    def numbers(self) -> FloatArray:
        """As the kernels have them (9,), the clock in rad from body y towards z."""
        way = lv_direction(float(np.deg2rad(self.roll_clock_lv_deg)))
        by_roll = float(self.roll_order), self.roll_share, float(np.arctan2(way[2], way[1]))
        by_deflection = self.ca_deflection, self.cn_deflection, self.cm_deflection
        return np.array([self.cl, self.clp, self.cnr_less_cmq, *by_deflection, *by_roll])


NO_TERMS = AeroTerms()


class SensorMount(Section):
    """Where a sensor package sits and how its axes are clocked."""

    position_from_datum_body_m: Vector
    x_axis_lv_deg: Angle
    y_axis_lv_deg: Angle

    @field_validator("y_axis_lv_deg")
    @classmethod
    def _right_angle(cls, value: float, info: object) -> float:
        x_axis = getattr(info, "data", {}).get("x_axis_lv_deg", value + 90.0)
        if abs(np.cos(np.deg2rad(value - x_axis))) > 1e-9:
            raise ValueError("x and y axes of a package must be clocked 90 deg apart")
        return value

    @property
    def dcm_body_sensor(self) -> FloatArray:
        """Nominal mounting, ``v_body = dcm_body_sensor @ v_sensor``, (3, 3)."""
        return dcm_body_from_clocking(np.deg2rad(self.x_axis_lv_deg), np.deg2rad(self.y_axis_lv_deg))


class CameraUncertainty(Section):
    """How well a camera is known before the flight: one standard deviation of each.

    The defaults are those of a lens from a catalogue in a mount from a drawing. A calibrated lens has smaller ones; for
    a lens that nobody calibrated ``focal = 0.2``, ``centre_px = 15``, ``k1 = 0.05``, ``k2 = 0.03`` let the benchmark
    frame tell.
    """

    pointing_deg: ErrorAngle = 3.0
    focal: Fraction = 0.05
    centre_px: Annotated[float, Field(ge=0.0, le=1e4)] = 1.5
    k1: Annotated[float, Field(ge=0.0, le=1.0)] = 0.004
    k2: Annotated[float, Field(ge=0.0, le=1.0)] = 0.001
    position_m: Metres = 0.003


class CameraMount(Section):
    """A camera on the centerbody, its nominal pointing and its lens, OpenCV's fisheye (Kannala-Brandt) or pinhole."""

    clock_lv_deg: Angle
    station_m: Place
    radius_m: Metres
    axis_from_forward_deg: Angle
    roll_deg: Angle = 0.0
    width_px: Annotated[int, Field(ge=16, le=8192)]
    height_px: Annotated[int, Field(ge=16, le=8192)]
    focal_px: tuple[Focal, Focal]
    centre_px: tuple[Pixels, Pixels]
    lens: Literal["fisheye", "pinhole"] = "fisheye"
    distortion: tuple[Distortion, ...]
    uncertainty: CameraUncertainty = CameraUncertainty()

    @property
    def position_m(self) -> FloatArray:
        """Nominal place of the lens from the datum, body axes, (3,), m."""
        radial = lv_direction(float(np.deg2rad(self.clock_lv_deg)))
        return np.asarray(self.radius_m * radial - np.array([self.station_m, 0.0, 0.0]))

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of its pictures."""
        return self.width_px, self.height_px

    def resized(self, size_px: tuple[int, int]) -> CameraMount:
        """The same camera with pictures of another size, whose middle and border are where they were."""
        along = [new / old for new, old in zip(size_px, self.size_px, strict=True)]
        known = self.uncertainty.model_copy(update={"centre_px": self.uncertainty.centre_px * max(along)})
        return self.model_copy(
            update={
                "width_px": size_px[0],
                "height_px": size_px[1],
                "focal_px": tuple(k * f for k, f in zip(along, self.focal_px, strict=True)),
                "centre_px": tuple(k * (c + 0.5) - 0.5 for k, c in zip(along, self.centre_px, strict=True)),
                "uncertainty": known,
            }
        )

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        count, lens = len(self.distortion), self.lens
        wanted = "k1, k2, k3, k4" if lens == "fisheye" else "k1, k2, p1, p2 or k1, k2, p1, p2, k3"
        if count != 4 and not (lens == "pinhole" and count == 5):
            words = f"the coefficients of a {lens} lens, {wanted}, are wanted; write 0 for those that it has not"
            yield "distortion", list(self.distortion), words


class VehicleFile(Section):
    """The whole of a vehicle file."""

    name: Label
    description: str = ""
    reference: Reference
    joint: CompliantJoint
    aeroshell: MassProperties
    centerbody: MassProperties
    mass: tuple[MassStep, ...] = ()
    uncertainty: Uncertainty = Uncertainty()
    aerodynamics: Aerodynamics
    aerodynamic_terms: AeroTerms = AeroTerms()
    geometry: ShellGeometry
    meshes: MeshFiles = MeshFiles()
    sensors: dict[Name, SensorMount] = {}
    cameras: dict[Name, CameraMount] = {}

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        cone, shell = self.aerodynamics.sphere_cone, self.geometry
        for key in ("half_angle_deg", "nose_radius_m", "base_radius_m") if cone is not None else ():
            flown, drawn = getattr(cone, key), getattr(shell, key)
            if abs(flown - drawn) > SAME_SHAPE * drawn:
                words = f"geometry.{key} = {drawn:g} of the same shell; within {100 * SAME_SHAPE:.0f} % is wanted"
                yield f"aerodynamics.sphere_cone.{key}", flown, words


@dataclass(frozen=True, eq=False)  # as `flightmodel.film.Frames`
class Vehicle:
    """A vehicle as flown or as assumed; every part frozen. See `vehicle_from_toml`."""

    name: str
    reference: Reference
    joint: CompliantJoint
    aeroshell: MassProperties
    centerbody: MassProperties
    uncertainty: Uncertainty
    aero: AeroTable
    geometry: ShellGeometry
    sensors: dict[str, SensorMount]
    cameras: dict[str, CameraMount]
    source: Path
    files: tuple[str, ...] = ()  # coefficient table, sidecar and meshes beside the vehicle file, relative to it
    meshes: dict[str, BodyMesh] = field(default_factory=dict)  # of the user's own, by body
    mass_steps: tuple[MassStep, ...] = ()  # later mass properties; `at` has those of a time
    aero_terms: AeroTerms = NO_TERMS

    @property
    def mass_kg(self) -> float:
        """Total mass, kg."""
        return self.aeroshell.mass_kg + self.centerbody.mass_kg

    @cached_property
    def cg_m(self) -> FloatArray:
        """C.g. of the unbent vehicle from the datum, body axes, (3,), m."""
        parts = (self.aeroshell, self.centerbody)
        return sum((b.mass_kg * b.cg_m for b in parts), np.zeros(3)) / self.mass_kg

    @cached_property
    def inertia(self) -> FloatArray:
        """Inertia tensor of the unbent vehicle about its c.g., body axes, (3, 3), kg m^2."""
        total = np.zeros((3, 3))
        for body in (self.aeroshell, self.centerbody):
            d = body.cg_m - self.cg_m
            total += body.inertia + body.mass_kg * (d @ d * np.eye(3) - np.outer(d, d))
        return total

    @property
    def joint_m(self) -> FloatArray:
        """Joint from the datum, body axes, (3,), m."""
        return np.array([-self.joint.station_m, 0.0, 0.0])

    def with_events(self, events: Iterable[tuple[str, float]]) -> Vehicle:
        """Return the vehicle with the times (s) of the events that its mass steps name, in order of time.

        Raises
        ------
        ConfigError
            ``name-unknown``: a step names an event that is not among ``events``.
        """
        times, faults, steps = dict(events), list[Issue](), list[MassStep]()
        for step in self.mass_steps:
            if step.event is not None and step.event not in times:
                hint = f"{nearest_name(step.event, list(times))}; known: {', '.join(times) or 'none'}"
                words = f"{self.source}: key 'mass.event' = '{step.event}': the flight has no such event{hint}"
                faults.append(Issue(words, "name-unknown"))
            else:
                at_s = step.from_s if step.event is None else times[step.event]
                steps.append(step.model_copy(update={"from_s": at_s, "event": None}))
        if faults:
            raise ConfigError(faults)
        return replace(self, mass_steps=tuple(sorted(steps, key=lambda step: step.from_s or 0.0)))

    def phases(self, start_s: float, stop_s: float) -> list[tuple[float, float, Vehicle]]:
        """Spans within ``start_s`` to ``stop_s`` in which mass properties hold, each with its vehicle without steps."""
        now, out, begins = replace(self, mass_steps=()), list[tuple[float, float, Vehicle]](), start_s
        for step in self.mass_steps:
            assert step.from_s is not None, "events have their times (`with_events`)"
            if step.from_s >= stop_s:
                break
            if step.from_s > begins:
                out.append((begins, step.from_s, now))
                begins = step.from_s
            now = replace(now, aeroshell=step.aeroshell or now.aeroshell, centerbody=step.centerbody or now.centerbody)
        return [*out, (begins, stop_s, now)]

    def at(self, time_s: float) -> Vehicle:
        """Return the vehicle as it is at a time, s, without mass steps."""
        return self.phases(time_s, np.inf)[0][2] if self.mass_steps else self

    def mass_at(self, time_s: FloatArray) -> FloatArray:
        """Total mass (n,), kg, at times (n,), s."""
        out = np.full(len(time_s), self.mass_kg)
        for begins, _, vehicle in self.phases(-np.inf, np.inf):
            out[time_s >= begins] = vehicle.mass_kg
        return out

    def with_bodies(self, changed: Callable[[str, MassProperties], MassProperties]) -> Vehicle:
        """Return the vehicle with every body, those of the mass steps too, changed by ``changed(name, body)``."""

        def of(name: str, part: MassProperties | None) -> MassProperties | None:
            return None if part is None else changed(name, part)

        steps = tuple(
            step.model_copy(update={name: of(name, getattr(step, name)) for name in ("aeroshell", "centerbody")})
            for step in self.mass_steps
        )
        shell, body = changed("aeroshell", self.aeroshell), changed("centerbody", self.centerbody)
        return replace(self, aeroshell=shell, centerbody=body, mass_steps=steps)

    def transverse_inertia_about_joint(self) -> tuple[float, float]:
        """Aeroshell's and centerbody's mean transverse inertia about the joint, kg m^2 (seed paper eq. [7])."""
        about = []
        for body in (self.aeroshell, self.centerbody):
            arm = body.cg_m[0] - self.joint_m[0]
            about.append(0.5 * (body.inertia[1, 1] + body.inertia[2, 2]) + body.mass_kg * arm**2)
        return about[0], about[1]

    def free_free_frequency_hz(self) -> float:
        """Free-free bending frequency (seed paper eq. [7]), Hz."""
        ia, icb = self.transverse_inertia_about_joint()
        return float(np.sqrt(self.joint.bending_stiffness_nmprad * (ia + icb) / (ia * icb)) / (2.0 * np.pi))

    def critical_damping_nmsprad(self) -> float:
        """Critical damping of the joint (seed paper eq. [8]), N m s/rad."""
        ia, icb = self.transverse_inertia_about_joint()
        return float(2.0 * np.sqrt(self.joint.bending_stiffness_nmprad * ia * icb / (ia + icb)))


def vehicle_path(name: str, beside: Path | None = None) -> Path:
    """Find a vehicle file: a path (relative to ``beside``), or the name of a vehicle that ships with the toolkit."""
    return path_of("vehicle", name, "name-unknown", beside)


def shipped(kind: str) -> list[str]:
    """Names of the vehicles or scenarios that ship with the toolkit."""
    return sorted(path.stem for path in (DATA / f"{kind}s").glob("*.toml"))


def path_of(kind: str, name: str, code: str, beside: Path | None = None) -> Path:
    """Find a file of a kind (vehicle, scenario): its path, or the name of a shipped one; refuse others with a code."""
    if "\0" in name:
        raise ConfigError(f"{kind} {name!r}: a path holds no NUL character", code="path-refused")
    if name.endswith(".toml"):
        return (beside or Path()) / name
    if name not in shipped(kind):
        hint = f"{nearest_name(name, shipped(kind))}; shipped: {', '.join(shipped(kind))}; a path ends in .toml"
        raise ConfigError(f"no {kind} '{name}'{hint}", code=code)
    return DATA / f"{kind}s" / f"{name}.toml"


def read_vehicle(name: str | Path) -> Vehicle:
    """Read a vehicle: a path to a TOML file, or the name of a vehicle that ships with the toolkit.

    Raises
    ------
    ConfigError
        With every fault of the file, unknown keys with the nearest known one.
    """
    check_type("vehicle", name, (str, Path), "a shipped name or the path of a TOML file")
    return vehicle_from_toml(vehicle_path(str(name)))


def vehicle_from_toml(path: Path) -> Vehicle:
    """Read a vehicle file.

    Raises
    ------
    ConfigError
        With every fault of the file, unknown keys with the nearest known one.
    """
    spec = read_section(VehicleFile, path)
    shell, reference = spec.geometry, spec.reference
    shape = Shape(
        float(np.deg2rad(shell.half_angle_deg)),
        shell.nose_radius_m,
        shell.base_radius_m,
        reference.area_m2,
        reference.length_m,
    )
    table = spec.aerodynamics.table
    listed = [shell.features] if shell.features.lower().endswith(".csv") else []
    drawn = [mesh.file for mesh in (spec.meshes.aeroshell, spec.meshes.centerbody) if mesh is not None]
    beside = [*listed, *drawn, *((table, str(Path(table).with_suffix(".toml"))) if table is not None else ())]
    if out := [name for name in beside if leads_outside(path.parent, name)]:
        words = "leads out of the vehicle file's folder; copy the file there"
        raise ConfigError([f"{path.parent / name}: {words}" for name in out], code="path-refused")
    own = table is not None and (path.parent / table).exists()
    if own and table is not None and (path.parent / table).with_suffix(".toml").resolve() == path.resolve():
        words = f"key 'aerodynamics.table' = '{table}': its sidecar would be this vehicle file; rename the table"
        raise ConfigError(f"{path}: {words}", code="keys-conflict")
    aero, table_sd = aerodynamics_from(spec.aerodynamics, shape, (path.parent, DATA / "aerodynamics"))
    lenses = {name: camera.position_m for name, camera in spec.cameras.items()}
    meshes = body_meshes(spec.meshes, path.parent, shell, lenses)
    if "aeroshell" in meshes:
        shell = shell.with_mesh(meshes["aeroshell"])
    if listed:
        shell = shell.with_listed(read_features(path.parent / listed[0], shell))
    # the vehicle file's own word first, then the table's
    stated = {k: v for k, v in table_sd if v is not None and k not in spec.uncertainty.model_fields_set}
    return Vehicle(
        name=spec.name,
        reference=spec.reference,
        joint=spec.joint,
        aeroshell=spec.aeroshell,
        centerbody=spec.centerbody,
        uncertainty=spec.uncertainty.model_copy(update=stated),
        aero=aero,
        geometry=shell,
        sensors=dict(spec.sensors),
        cameras=dict(spec.cameras),
        source=path,
        files=(*((table, str(Path(table).with_suffix(".toml"))) if own and table is not None else ()), *drawn, *listed),
        meshes=meshes,
        mass_steps=spec.mass,
        aero_terms=spec.aerodynamic_terms,
    )
