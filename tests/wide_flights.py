"""Flights over the whole range of vehicles for which the estimators are made, drawn anew for each seed.

Spin 0 to 60 rpm, joints of 1 to 50 kN m/rad (every eighth flight's is locked), damping 0.2 to 3 %, c.g. offsets of 0 to
8 mm in any plane, vehicles of 60 to 400 kg: the reference vehicle's shape, with lengths as the cube root of the mass
and 10 % of their own. The analyst has the mass properties, the offset to a millimetre, the coefficients, and the
reference vehicle's joint whatever flies. Unknown are masses, c.g.s, the two inertias of each body (each by itself),
the centerbody's products, the joint, the coefficients (in the sizes that the stated vehicle states), start, air, and
every instrument's errors. The analyst knows what part of the variance of C_A's error changes with Mach number: none,
or ``ca_shape_part``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimators.trim import static_trim
from flightmodel.aerodynamics import AeroTable
from flightmodel.flightfolder import read_flight
from flightmodel.telemetry import Telemetry, TriadRecord
from flightmodel.vehicle import CompliantJoint, Vehicle, vehicle_from_toml, vehicle_path
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import Scenario
from synthetic_flight.simulate import Truth
from tests.recon import dispersed

BENT_RAD, BENT_OFFSET_M = tuple(np.deg2rad([3.0, 8.0])), (0.004, 0.008)  # asked for: static, at the largest load
SPIN_RPM, STIFFNESS_NMPRAD, DAMPING_RATIO = (0.0, 60.0), (1e3, 50e3), (0.002, 0.03)
OFFSET_M, MASS_KG, LOCKED_HZ = (0.0, 0.008), (60.0, 400.0), 40.0
LENGTH_SD, PRODUCT = 0.10, 0.002  # of the lengths; of a body's transverse inertia
COEFFICIENT_SD = {"ca": 0.05, "cn": 0.10, "cm": 0.15, "cmq": 0.15}
LAST_S = 462.0
SHAPE_MACH = np.geomspace(0.1, 10.0, 47)  # a tenth apart in the logarithm
PEAK_PA, LEAST_MARGIN = 1250.0, 1.3  # of the reference vehicle; of a joint's stiffness over that at which it diverges


@dataclass(frozen=True)
class WideFlight:
    """What the vehicle file states, and what flew; ``factors`` on C_A, C_N, C_m and the shift of C_mq.

    ``ca_shape`` is the log of another factor on C_A at the Mach numbers ``SHAPE_MACH``.
    """

    seed: int
    stated: Vehicle
    scenario: Scenario
    factors: dict[str, float]
    locked: bool
    ca_shape: np.ndarray

    @property
    def flown(self) -> Vehicle:
        """Vehicle as it is."""
        return self.scenario.vehicle

    def ca_factor(self, mach: np.ndarray) -> np.ndarray:
        """Flown over stated C_A at Mach numbers."""
        return self.factors["ca"] * np.exp(np.interp(mach, SHAPE_MACH, self.ca_shape))


def wide_flight(seed: int, ca_shape_part: float = 0.0, bent: bool = False) -> WideFlight:
    """Draw one flight; any ``ca_shape_part`` leaves all other draws as they are.

    ``bent``: the offset is no small one, and the joint so soft that it gives way by degrees.
    """
    rng = np.random.default_rng([seed, 18, 2009])
    stated = _stated(rng, BENT_OFFSET_M if bent else OFFSET_M)
    stated = replace(stated, uncertainty=stated.uncertainty.model_copy(update={"ca_shape_part": ca_shape_part}))
    flown, factors = _flown(stated, rng, np.sqrt(1.0 - ca_shape_part))
    shape = np.sqrt(ca_shape_part) * stated.uncertainty.ca * _unit_shape(np.random.default_rng([seed, 5, 18, 2009]))
    if ca_shape_part > 0.0:
        flown = replace(flown, aero=_reshaped(flown.aero, shape))
    locked = seed % 8 == 7 and not bent
    asked = np.random.default_rng([seed, 7, 18, 2009]).uniform(*BENT_RAD) if bent else 0.0
    flown = replace(flown, joint=_joint(flown, rng, locked, asked))
    scenario = dispersed.dispersed_scenario("irve2_reference", seed)
    spin = float(rng.uniform(*SPIN_RPM))
    initial = scenario.spec.initial.model_copy(update={"spin_rpm": spin})
    time = scenario.spec.time.model_copy(update={"stop_s": LAST_S})
    spec = scenario.spec.model_copy(update={"initial": initial, "time": time})
    return WideFlight(seed, stated, replace(scenario, spec=spec, vehicle=flown), factors, locked, shape)


def _stated(rng: np.random.Generator, offset_m: tuple[float, float]) -> Vehicle:
    """Reference vehicle of another size and mass, its offset anywhere."""
    nominal = vehicle_from_toml(vehicle_path("irve2_reference"))
    mass = _log_uniform(rng, MASS_KG) / nominal.mass_kg
    length = mass ** (1.0 / 3.0) * np.exp(LENGTH_SD * rng.standard_normal())
    clock, size = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*offset_m)
    lateral = size * nominal.mass_kg / nominal.centerbody.mass_kg * np.array([-np.cos(clock), np.sin(clock)])
    parts = {}
    for name in ("aeroshell", "centerbody"):
        part = getattr(nominal, name)
        side = lateral if name == "centerbody" else np.zeros(2)
        place = (float(part.cg_m[0] * length), *map(float, side))
        inertia = tuple(map(tuple, (part.inertia * mass * length**2).tolist()))
        changed = {"mass_kg": float(part.mass_kg * mass), "cg_from_datum_body_m": place, "inertia_kgm2": inertia}
        parts[name] = part.model_copy(update=changed)
    reference = nominal.reference.model_copy(
        update={"area_m2": nominal.reference.area_m2 * length**2, "length_m": nominal.reference.length_m * length}
    )
    joint = nominal.joint.model_copy(update={"station_m": nominal.joint.station_m * length})
    sensors = {
        name: mount.model_copy(
            update={"position_from_datum_body_m": tuple(x * length for x in mount.position_from_datum_body_m)}
        )
        for name, mount in nominal.sensors.items()
    }
    known = nominal.uncertainty.model_copy(update=COEFFICIENT_SD)
    return replace(nominal, reference=reference, joint=joint, sensors=sensors, uncertainty=known, **parts)


def _unit_shape(rng: np.random.Generator) -> np.ndarray:
    """Gauss-Markov error along the logarithm of the Mach number, which forgets over a factor of two."""
    apart = np.abs(np.subtract.outer(np.log(SHAPE_MACH), np.log(SHAPE_MACH)))
    return np.linalg.cholesky(np.exp(-apart / np.log(2.0))) @ rng.standard_normal(len(SHAPE_MACH))


def _reshaped(aero: AeroTable, shape: np.ndarray) -> AeroTable:
    """Table with a factor on C_A along Mach number, in rarefied flow as at the highest."""
    mach = np.union1d(aero.mach, SHAPE_MACH)
    coefficients = aero.at(mach[:, None], aero.alpha_rad)
    coefficients[..., 0] *= np.exp(np.interp(mach, SHAPE_MACH, shape))[:, None]
    free = None if aero.free_molecular is None else aero.free_molecular * [np.exp(shape[-1]), 1.0, 1.0, 1.0]
    return replace(aero, mach=mach, coefficients=coefficients, free_molecular=free)


def _flown(stated: Vehicle, rng: np.random.Generator, constant_ca: float) -> tuple[Vehicle, dict[str, float]]:
    """Vehicle as it is: every number drawn around what is stated, in the sizes that are stated.

    ``constant_ca`` is the part of the stated sd of C_A that is one factor.
    """
    known, parts = stated.uncertainty, {}
    for name in ("aeroshell", "centerbody"):
        part = getattr(stated, name)
        cg = part.cg_m + rng.standard_normal(3) * [known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m]
        along, across = 1.0 + known.inertia * rng.standard_normal(2)
        inertia = part.inertia * np.diag([along, across, across])
        if name == "centerbody":
            product = PRODUCT * inertia[1, 1] * rng.standard_normal((3, 3))
            inertia = inertia + np.triu(product, 1) + np.triu(product, 1).T
        changed = {
            "mass_kg": float(part.mass_kg * (1.0 + known.mass * rng.standard_normal())),
            "cg_from_datum_body_m": tuple(cg.tolist()),
            "inertia_kgm2": tuple(map(tuple, inertia.tolist())),
        }
        parts[name] = part.model_copy(update=changed)
    factors = {k: float(1.0 + getattr(known, k) * rng.standard_normal()) for k in ("ca", "cn", "cm")}
    factors["ca"] = 1.0 + constant_ca * (factors["ca"] - 1.0)
    shift = float(known.cmq * rng.standard_normal())
    aero = stated.aero.scaled(**factors, cmq_shift=shift)
    return replace(stated, aero=aero, **parts), {**factors, "cmq_shift": shift}


def _joint(flown: Vehicle, rng: np.random.Generator, locked: bool, bent_rad: float) -> CompliantJoint:
    """Joint that holds at the flight's largest load, where asked for with so much static deflection under it."""
    nominal = vehicle_from_toml(vehicle_path("irve2_reference"))
    loading = flown.mass_kg / flown.reference.area_m2 * nominal.reference.area_m2 / nominal.mass_kg
    trim = static_trim(flown, 3.0, PEAK_PA * loading)
    least = LEAST_MARGIN * trim.critical_stiffness_nmprad
    stiffness = _log_uniform(rng, (max(least, STIFFNESS_NMPRAD[0]), max(STIFFNESS_NMPRAD[1], 1.5 * least)))
    ratio = _log_uniform(rng, DAMPING_RATIO)
    if bent_rad:  # deflection = offset / xbar u / (1 - u), u the critical stiffness over the joint's
        share = float(np.hypot(*flown.cg_m[1:])) / trim.xbar_m
        stiffness = max(least, trim.critical_stiffness_nmprad * (bent_rad + share) / bent_rad)
    if locked:
        stiffness, ratio = flown.joint.bending_stiffness_nmprad * (LOCKED_HZ / flown.free_free_frequency_hz()) ** 2, 0.1
    size = flown.transverse_inertia_about_joint()[1] / nominal.transverse_inertia_about_joint()[1]
    changed = {
        "bending_stiffness_nmprad": float(stiffness),
        "torsion_stiffness_nmprad": float(nominal.joint.torsion_stiffness_nmprad * size),
    }
    joint = flown.joint.model_copy(update=changed)
    damping = float(ratio * replace(flown, joint=joint).critical_damping_nmsprad())
    return joint.model_copy(update={"bending_damping_nmsprad": damping})


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def flown(one: WideFlight, folder: Path) -> tuple[Telemetry, Truth]:
    """Fly, write the flight folder, and read it as its analyst has it: the stated vehicle, sensors where they sit."""
    truth = simulate_to_folder(one.scenario, one.seed, folder, replace=True)
    read = read_flight(folder)
    mounts = {"accelerometer": "suba", "rates": "suba", "magnetometer": "magnetometer"}
    placed = {}
    for name, mount in mounts.items():
        record: TriadRecord | None = getattr(read, name)
        if record is not None:
            place = np.array(one.stated.sensors[mount].position_from_datum_body_m)
            placed[name] = replace(record, spec=replace(record.spec, position_from_datum_body_m=place))
    return replace(read, vehicle=one.stated, **placed), truth
