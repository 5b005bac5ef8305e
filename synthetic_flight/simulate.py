"""What is the true motion of a given vehicle in a given atmosphere from a given state?

``y' = f(y, t)`` of two rigid bodies on a compliant joint (`synthetic_flight.dynamics`), integrated by fourth-order
Runge-Kutta with a fixed step; the joint may be locked until the aeroshell is inflated. A flight that tumbles is
flagged, one whose deflection passes 90 deg ends there; neither is an error.

The kernels take a vehicle as a vector of 69 parameters (`parameter_vector`) and the atmosphere as a table with a row
every 50 m (`atmosphere_table`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flightmodel import airdata, earth, rotations, sphere_cone
from flightmodel.atmosphere import AtmosphereProfile, StandardAir, earths_standard_air, gas_constant, mean_free_path
from flightmodel.checks import ConfigError, FloatArray, check_finite
from flightmodel.deflection import DeflectionHistory, lv_clock
from flightmodel.events import splashdown_index
from flightmodel.tabular import Tabular
from flightmodel.trajectory import Trajectory
from flightmodel.vehicle import Vehicle
from synthetic_flight import dynamics
from synthetic_flight.dynamics import AUX, CREEP_STATES, STATES, added_twist_inertia, check_step

if TYPE_CHECKING:
    import pandas as pd

DEFLECTION_LIMIT_RAD = 0.5 * np.pi
TUMBLE_RAD = 0.5 * np.pi
MOST_TURN_RAD = 1.0  # in a step; fourth-order steps are unstable from 2.8 on
AIR_PA = 1.0  # of dynamic pressure, from which on a vehicle tumbles in the air

ATMOSPHERE_START_M, ATMOSPHERE_STEP_M, ATMOSPHERE_ROWS = -1000.0, 50.0, 8001


@dataclass(frozen=True, repr=False)
class Truth(Tabular):
    """True motion of the synthetic vehicle; every array has one row a record. Estimators never see it.

    Parameters
    ----------
    trajectory : Trajectory
        Of the structural datum on the centerbody's axis, body attitude.
    state_eci : (n, 20) float
        As integrated (`synthetic_flight.dynamics`); (n, 22) where the joint creeps.
    q_body_shell : (n, 4) float
    deflection : DeflectionHistory
        Method ``"truth"``.
    twist_rad, altitude_m, density_kgpm3, mach, dynamic_pressure_pa : (n,) float
        Air data at the shell's nose.
    alpha_shell_rad, alpha_body_rad : (n,) float
        Total angles of attack of the aeroshell and of the centerbody, wind-relative.
    joint_force_body_n, joint_moment_body_nm : (n, 3) float
        On the centerbody, body axes.
    angular_acceleration_body_radps2 : (n, 3) float
    tumbled_s : float or None
        When the shell's total angle of attack first passed 90 deg with dynamic pressure above 1 Pa.
    diverged_s : float or None
        When the deflection passed 90 deg, or the vehicle turned by a radian a step; the flight ends there.
    remark : str
        What happened out of the ordinary.
    """

    trajectory: Trajectory
    state_eci: FloatArray
    q_body_shell: FloatArray
    deflection: DeflectionHistory
    twist_rad: FloatArray
    altitude_m: FloatArray
    density_kgpm3: FloatArray
    mach: FloatArray
    dynamic_pressure_pa: FloatArray
    alpha_shell_rad: FloatArray
    alpha_body_rad: FloatArray
    joint_force_body_n: FloatArray
    joint_moment_body_nm: FloatArray
    angular_acceleration_body_radps2: FloatArray
    vehicle: Vehicle
    profile: AtmosphereProfile
    tumbled_s: float | None
    diverged_s: float | None
    remark: str = ""

    @property
    def time_s(self) -> FloatArray:
        """Times of the records, s."""
        return self.trajectory.time_s

    def to_frame(self) -> pd.DataFrame:
        """Flight, deflection and invariants, one row a record.

        Returns
        -------
        DataFrame
            ``t_s, altitude_m, density_kgpm3, mach, dynamic_pressure_pa, alpha_shell_deg, alpha_body_deg, theta_deg,
            plane_lv_deg, twist_deg, energy_j`` (kinetic, gravitational and in the joint), ``angular_momentum_nms``
            (magnitude, about the c.g., inertial) and ``sensed_power_w`` (of the non-gravitational force at the c.g.).
        """
        import pandas as pd

        state, vehicle = self.state_eci, self.vehicle
        velocity_body = rotations.rotate(rotations.conjugate(state[:, 6:10]), state[:, 3:6])
        force = vehicle.mass_at(self.time_s)[:, None] * self.specific_force_body(vehicle.cg_m)
        return pd.DataFrame(
            {
                "t_s": self.time_s,
                "altitude_m": self.altitude_m,
                "density_kgpm3": self.density_kgpm3,
                "mach": self.mach,
                "dynamic_pressure_pa": self.dynamic_pressure_pa,
                "alpha_shell_deg": np.rad2deg(self.alpha_shell_rad),
                "alpha_body_deg": np.rad2deg(self.alpha_body_rad),
                "theta_deg": np.rad2deg(self.deflection.theta_rad),
                "plane_lv_deg": np.rad2deg(self.deflection.plane_lv_rad),
                "twist_deg": np.rad2deg(self.twist_rad),
                "energy_j": self._by_phase(dynamics.energy),
                "angular_momentum_nms": np.linalg.norm(self._by_phase(dynamics.angular_momentum), axis=1),
                "sensed_power_w": np.sum(force * velocity_body, axis=1),
            }
        )

    def _by_phase(self, of: Callable[[FloatArray, Vehicle], FloatArray]) -> FloatArray:
        """Evaluate a function of states and vehicle at every record, with the mass properties of its time."""
        rows = _phase_rows(self.vehicle, self.time_s)
        return np.concatenate([of(self.state_eci[part], vehicle) for part, vehicle in rows])

    def _about(self) -> str:
        k = int(np.argmax(self.dynamic_pressure_pa))
        peak = f"peak q {self.dynamic_pressure_pa[k]:.0f} Pa at {self.time_s[k]:.2f} s"
        return f"synthetic flight of {self.vehicle.name}, {len(self.time_s)} records, {peak}"

    def specific_force_body(self, position_from_datum_body_m: FloatArray) -> FloatArray:
        """Specific force ``(n, 3)``, body axes, m/s^2, of an ideal accelerometer at a point of the centerbody.

        Joint force over mass, moved from the body's c.g. by lever-arm terms, plus the difference of gravitation
        between the two points.
        """
        parts = []
        for rows, vehicle in _phase_rows(self.vehicle, self.time_s):
            body, state = vehicle.centerbody, self.state_eci[rows]
            arm = position_from_datum_body_m - body.cg_m
            w, e = state[:, 14:17], self.angular_acceleration_body_radps2[rows]
            q = state[:, 6:10]
            at_cg = dynamics.points(state, vehicle)["body"][0]
            at_point = at_cg + rotations.rotate(q, np.broadcast_to(arm, at_cg.shape))
            tide = rotations.rotate(rotations.conjugate(q), earth.gravitation(at_cg) - earth.gravitation(at_point))
            force = self.joint_force_body_n[rows] / body.mass_kg
            parts.append(force + np.cross(e, arm) + np.cross(w, np.cross(w, arm)) + tide)
        return np.concatenate(parts)


def _phase_rows(vehicle: Vehicle, time_s: FloatArray) -> list[tuple[slice, Vehicle]]:
    """Records of each span with constant mass properties; a record at a change has the new ones."""
    phases = vehicle.phases(float(time_s[0]), np.inf)
    edges = np.searchsorted(time_s, [begins - 1e-9 for begins, _, _ in phases]).tolist()
    ends = [*edges[1:], len(time_s)]
    return [(slice(a, b), flown) for a, b, (_, _, flown) in zip(edges, ends, phases, strict=True) if b > a]


@dataclass(frozen=True)
class Schedule:
    """Steps and records shared by flights integrated together: ``records`` of them, ``per_record`` steps apart."""

    step_s: float
    per_record: int
    records: int
    lock_records: int = 0

    @property
    def frees_joint(self) -> bool:
        """Whether the joint deflects in any of the steps."""
        return self.lock_records < self.records


def state_from_ecef(
    time_s: float,
    position_ecef_m: FloatArray,
    velocity_ecef_mps: FloatArray,
    q_ecef_body: FloatArray,
    omega_body_radps: FloatArray,
    q_body_shell: FloatArray | None = None,
) -> FloatArray:
    """Initial state (20,) with the composite c.g. at a place and velocity (relative to the Earth), both rates equal."""
    to_eci = rotations.conjugate(earth.q_ecef_eci(time_s))
    r = rotations.rotate(to_eci, position_ecef_m)
    v = rotations.rotate(to_eci, velocity_ecef_mps + np.cross(earth.OMEGA_ECEF_RADPS, position_ecef_m))
    q_b = rotations.multiply(to_eci, q_ecef_body)
    q_body_shell = np.array([1.0, 0.0, 0.0, 0.0]) if q_body_shell is None else q_body_shell
    omega_shell = rotations.rotate(rotations.conjugate(q_body_shell), omega_body_radps)
    return np.concatenate([r, v, q_b, rotations.multiply(q_b, q_body_shell), omega_body_radps, omega_shell])


def integrate(
    vehicle: Vehicle,
    atmosphere: FloatArray,
    state: FloatArray,
    step_s: float,
    per_record: int,
    records: int,
    lock_records: int = 0,
    planet: earth.Planet = earth.WGS84,
) -> tuple[FloatArray, FloatArray]:
    """States ``(n, 20)`` and auxiliaries ``(n, 18)`` of a flight; fewer than ``records`` where the joint diverged.

    A joint that creeps has two states more; it starts without creep where ``state`` is (20,).

    Raises
    ------
    ConfigError
        Where the state's shape, the step or a count is impossible.
    """
    state = with_creep(state, vehicle)
    if state.shape not in ((STATES,), (STATES + CREEP_STATES,)) or records < 1 or per_record < 1 or not step_s > 0.0:
        raise ConfigError(
            f"integrate: a state (20,), step_s > 0, per_record and records >= 1 are wanted; got state {state.shape}, "
            f"step_s {step_s:g}, per_record {per_record}, records {records}",
            code="argument-value",
        )
    parameters = parameter_vector(vehicle)[None]
    schedule = Schedule(step_s, per_record, records, lock_records)
    return integrate_lanes(vehicle, atmosphere, state[None], parameters, schedule, planet)[0][:2]


def integrate_lanes(
    vehicle: Vehicle,
    atmosphere: FloatArray,
    states: FloatArray,
    parameters: FloatArray,
    schedule: Schedule,
    planet: earth.Planet = earth.WGS84,
) -> list[tuple[FloatArray, FloatArray, bool]]:
    """States, auxiliaries and whether the joint diverged of flights side by side.

    ``states`` ``(lanes, 20)``, or ``(lanes, 22)`` of joints that creep, ``parameters`` ``(lanes, 79)``; ``atmosphere``
    is one table, or ``(lanes, rows, 6)``.
    """
    lanes, width = states.shape
    out, aux = np.empty((lanes, schedule.records, width)), np.empty((lanes, schedule.records, AUX))
    written = integrate_into(out, aux, vehicle, atmosphere, states, parameters, schedule, planet)
    counts = np.abs(written)
    return [(*_finite_records(out[k, :n], aux[k, :n]), bool(written[k] < 0)) for k, n in enumerate(counts.tolist())]


def integrate_into(
    out: FloatArray,
    aux: FloatArray,
    vehicle: Vehicle,
    atmosphere: FloatArray,
    states: FloatArray,
    parameters: FloatArray,
    schedule: Schedule,
    planet: earth.Planet = earth.WGS84,
    air_from_m: float = ATMOSPHERE_START_M,
    lanes: int = 0,
) -> NDArray[np.int64]:
    """`integrate_lanes` of m flights into ``out`` (m, records, 20 or 22) and ``aux`` (m, records, 18).

    The first row of the atmosphere's table is at ``air_from_m``. So many ``lanes`` fly side by side, a divisor of m;
    all by default.

    Returns
    -------
    (m,) int
        Records that are written, negative where the joint diverged; what follows them is left as it was.
    """
    flights, _, width = out.shape
    lanes = lanes or flights
    written = np.zeros(flights, dtype=np.int64)
    kinds = (0,) * lanes, (0,) * (width - STATES), (0,) * int(parameters[:, dynamics.TERMS :].any())
    air, *tables = kernel_tables(vehicle, atmosphere, air_from_m)
    spaces = workspace(states, parameters, schedule.step_s).reshape(dynamics.ROWS, -1, lanes).transpose(1, 0, 2)
    for number, space in enumerate(np.ascontiguousarray(spaces)):
        block = slice(number * lanes, (number + 1) * lanes)
        dynamics.integrate(
            *kinds,
            space.ravel(),
            (air[block] if len(air) > 1 else air, *tables),
            planet,
            schedule.step_s,
            schedule.per_record,
            schedule.records,
            schedule.lock_records,
            DEFLECTION_LIMIT_RAD,
            out[block],
            aux[block],
            written[block],
        )
    return written


def fly(
    vehicle: Vehicle,
    profile: AtmosphereProfile,
    state: FloatArray,
    start_s: float,
    stop_s: float,
    epoch_utc: str,
    step_s: float = 0.002,
    record_s: float = 0.004,
    inflated_s: float | None = None,
) -> Truth:
    """Fly from a state at ``start_s`` to ``stop_s``.

    Parameters
    ----------
    state : (20,) float
        In ECI, which equals ECEF at time zero (`state_from_ecef`).
    step_s, record_s : float
        Integration step, and a whole multiple of it between records; the last record is the last at or before
        ``stop_s``.
    inflated_s : float or None
        The joint is locked before this time.

    Raises
    ------
    ConfigError
        Where times do not fit each other.
    """
    check_finite("fly: times", np.array([start_s, stop_s, step_s, record_s]))
    if not (0.0 < step_s <= record_s <= stop_s - start_s):
        raise ConfigError(
            f"fly: 0 < step <= record <= stop - start is wanted; got step {step_s:g} s, record {record_s:g} s, "
            f"start {start_s:g} s, stop {stop_s:g} s",
            code="argument-value",
        )
    per_record = round(record_s / step_s)
    if abs(per_record * step_s - record_s) > 1e-9:
        raise ConfigError(
            f"fly: record {record_s:g} s must be a whole multiple of step {step_s:g} s", code="argument-value"
        )
    check_finite("fly: state at the start", state)
    if inflated_s is None or inflated_s < stop_s:
        check_step(vehicle, step_s)
    records = int(np.floor((stop_s - start_s) / record_s + 1e-6)) + 1
    lock = 0 if inflated_s is None else max(0, int(np.ceil((inflated_s - start_s) / record_s - 1e-9)))
    time_s = start_s + record_s * np.arange(records, dtype=np.float64)
    states, aux = _fly_phases(vehicle, atmosphere_table(profile), state, step_s, per_record, time_s, lock)
    ended = "deflection beyond 90 deg" if len(states) < records else ""
    # what tumbles with a C_mq above zero turns ever faster, until steps can no longer follow it
    fast = ~(step_s * np.linalg.norm(states[:, 14:17], axis=1) < MOST_TURN_RAD)
    if fast.any():
        count = max(1, int(np.argmax(fast)))
        states, aux, ended = states[:count], aux[:count], "more than a radian a step"
    at_sea = splashdown_index(aux[:, 0])
    states, aux = states[:at_sea], aux[:at_sea]
    return _truth(
        vehicle,
        profile,
        epoch_utc,
        time_s[: len(states)],
        states,
        aux,
        ended,
    )


def _fly_phases(
    vehicle: Vehicle,
    atmosphere: FloatArray,
    state: FloatArray,
    step_s: float,
    per_record: int,
    time_s: FloatArray,
    lock_records: int,
) -> tuple[FloatArray, FloatArray]:
    """States and auxiliaries of a flight through its mass steps, each taken at the next record.

    At a step hardware keeps its place, attitude and motion: what leaves takes its own momentum along, and the composite
    c.g. moves to where the new masses have it.
    """
    rows = _phase_rows(vehicle, time_s)
    states, auxiliaries, before = [], [], rows[0][1]
    for part, flown in rows:
        state = _handed_over(state, before, flown)
        last = part.stop == len(time_s)
        # one record more: the state at which the next phase begins
        count = part.stop - part.start + (not last)
        lock = max(0, lock_records - part.start)
        path, aux = integrate(flown, atmosphere, state, step_s, per_record, count, min(lock, count))
        whole = len(path) == count
        states.append(path if last or not whole else path[:-1])
        auxiliaries.append(aux if last or not whole else aux[:-1])
        if not whole:
            break
        state, before = path[-1], flown
    return np.concatenate(states), np.concatenate(auxiliaries)


def _handed_over(state: FloatArray, before: Vehicle, after: Vehicle) -> FloatArray:
    """State (20,) of the same motion after a change of mass properties."""
    if after is before:
        return state
    (old, old_v), (new, new_v) = (dynamics.offsets(state, vehicle)["joint"] for vehicle in (before, after))
    moved = state.copy()
    moved[0:3] += old - new
    moved[3:6] += old_v - new_v
    return moved


def _truth(
    vehicle: Vehicle,
    profile: AtmosphereProfile,
    epoch_utc: str,
    time_s: FloatArray,
    states: FloatArray,
    aux: FloatArray,
    ended: str,
) -> Truth:
    q_b, q_a = states[:, 6:10], states[:, 10:14]
    to_ecef = earth.q_ecef_eci(time_s)
    parts = [(dynamics.points(states[rows], flown)["body"], flown) for rows, flown in _phase_rows(vehicle, time_s)]
    cg, cg_v = (np.concatenate([point[k] for point, _ in parts]) for k in (0, 1))
    arms = [np.broadcast_to(-flown.centerbody.cg_m, point[0].shape) for point, flown in parts]
    arm = rotations.rotate(q_b, np.concatenate(arms))
    rate = rotations.rotate(q_b, states[:, 14:17])
    r_ecef = rotations.rotate(to_ecef, cg + arm)
    v_ecef = rotations.rotate(to_ecef, cg_v + np.cross(rate, arm)) - np.cross(earth.OMEGA_ECEF_RADPS, r_ecef)
    q_ecef_body = rotations.continuous(rotations.multiply(to_ecef, q_b))
    trajectory = Trajectory(epoch_utc, time_s, "datum", r_ecef, v_ecef, q_ecef_body, states[:, 14:17].copy())
    theta, nose = dynamics.deflection_angle(q_b, q_a)
    to_body = rotations.conjugate(q_b)
    air = airdata.air_data(trajectory, profile, vehicle.cg_m)
    tumbling = (aux[:, 4] > TUMBLE_RAD) & (aux[:, 3] > AIR_PA)
    tumbled_s = float(time_s[np.argmax(tumbling)]) if tumbling.any() else None
    diverged_s = float(time_s[-1]) if ended else None
    remarks = []
    if tumbled_s is not None:
        remarks.append(f"tumbled at {tumbled_s:.2f} s")
    if diverged_s is not None:
        remarks.append(f"{ended} at {diverged_s:.2f} s; the flight ends there")
    return Truth(
        trajectory=trajectory,
        state_eci=states,
        q_body_shell=rotations.continuous(rotations.multiply(to_body, q_a)),
        deflection=DeflectionHistory(time_s, theta, lv_clock(nose[:, 1:]), None, "truth"),
        twist_rad=dynamics.twist(q_b, q_a),
        altitude_m=aux[:, 0],
        density_kgpm3=aux[:, 1],
        mach=aux[:, 2],
        dynamic_pressure_pa=aux[:, 3],
        alpha_shell_rad=aux[:, 4],
        alpha_body_rad=air.alpha_total_wind_rad,
        joint_force_body_n=rotations.rotate(to_body, aux[:, 6:9]),
        joint_moment_body_nm=rotations.rotate(to_body, aux[:, 9:12]),
        angular_acceleration_body_radps2=aux[:, 15:18],
        vehicle=vehicle,
        profile=profile,
        tumbled_s=tumbled_s,
        diverged_s=diverged_s,
        remark="; ".join(remarks),
    )


def freeplay_corner(freeplay_rad: float, corner: float) -> tuple[float, float, float]:
    """Arguments of `dynamics.beyond_freeplay` after the angle: freeplay, half width of its corner, 1 / (4 half)."""
    half = corner * freeplay_rad
    return freeplay_rad, half, 0.25 / half if half > 0.0 else 0.0


def parameter_vector(
    vehicle: Vehicle, ca: float = 1.0, cn: float = 1.0, cm: float = 1.0, cmq_shift: float = 0.0
) -> FloatArray:
    """Pack a vehicle for the kernels, (79,), with factors on its C_A, C_N and C_m and a shift of its C_mq."""
    p = np.zeros(dynamics.PARAMETERS)
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    upper = np.triu_indices(3)
    mb, ma = body.mass_kg, shell.mass_kg
    p[: dynamics.I_B] = mb, ma, 1.0 / mb, 1.0 / ma, ma / (mb + ma), -mb / (mb + ma), 1.0 / (mb + ma)
    for inertia_at, inverse_at, mobility_at, arm_at, part in (
        (dynamics.I_B, dynamics.W_B, dynamics.N_B, dynamics.P_B, body),
        (dynamics.I_A, dynamics.W_A, dynamics.N_A, dynamics.P_A, shell),
    ):
        arm = vehicle.joint_m - part.cg_m
        lever, inverse = rotations.skew(arm), np.linalg.inv(part.inertia)
        p[inertia_at : inertia_at + 6] = part.inertia[upper]
        p[inverse_at : inverse_at + 6] = inverse[upper]
        p[mobility_at : mobility_at + 6] = (-lever @ inverse @ lever)[upper]
        p[arm_at : arm_at + 3] = arm
    p[dynamics.NOSE_A : dynamics.NOSE_A + 3] = -shell.cg_m
    freeplay = np.deg2rad(joint.freeplay_deg)
    p[dynamics.JOINT : dynamics.JOINT + 9] = (
        joint.bending_stiffness_nmprad,
        joint.hardening_nmprad3,
        joint.torsion_stiffness_nmprad,
        joint.bending_damping_nmsprad,
        joint.damping_hardening_nmsprad3,
        joint.torsion_damping_nmsprad,
        *freeplay_corner(freeplay, joint.freeplay_corner),
    )
    p[dynamics.REFERENCE : dynamics.REFERENCE + 2] = vehicle.reference.area_m2, vehicle.reference.length_m
    p[dynamics.FACTOR : dynamics.FACTOR + 4] = ca, cn, cm, cmq_shift
    p[dynamics.DELAYED : dynamics.DELAYED + 2] = joint.delayed_compliance_radpnm, 1.0 / joint.creep_time_s
    p[dynamics.QUADRATIC] = joint.quadratic_nmprad2
    p[dynamics.TERMS :] = vehicle.aero_terms.numbers
    return p


def air_altitudes_m(rows: int = ATMOSPHERE_ROWS, from_m: float = ATMOSPHERE_START_M) -> FloatArray:
    """Altitudes (rows,) of a kernel table of air."""
    return from_m + ATMOSPHERE_STEP_M * np.arange(rows, dtype=np.float64)


@cache
def _standard() -> StandardAir:
    return earths_standard_air(air_altitudes_m())


def atmosphere_table(profile: AtmosphereProfile) -> FloatArray:
    """Air every 50 m from -1 to 399 km, ``(rows, 6)``, for the kernels.

    Density, the change of its logarithm up to the next row, speed of sound, north and east wind, and room for the
    fraction of free-molecular flow, which depends on the vehicle (`kernel_tables`).
    """
    z = air_altitudes_m()
    air = profile.at(z, _standard())
    change = np.diff(np.log(air.density_kgpm3), append=np.log(air.density_kgpm3[-1]))
    columns = [air.density_kgpm3, change, air.sound_speed_mps, air.wind_ned_mps[:, :2], np.zeros(len(z))]
    return np.column_stack(columns)


def vacuum_table() -> FloatArray:
    """Kernel table of a vacuum, for flights under gravity and springs alone."""
    return np.tile(np.array([0.0, 0.0, 300.0, 0.0, 0.0, 0.0]), (ATMOSPHERE_ROWS, 1))


@cache
def _gas_constants(air_from_m: float, rows: int) -> FloatArray:
    return gas_constant(air_altitudes_m(rows, air_from_m))


def kernel_tables(
    vehicle: Vehicle, atmosphere: FloatArray, air_from_m: float = ATMOSPHERE_START_M
) -> tuple[FloatArray, ...]:
    """Return the tables of the kernels: atmosphere of every lane, grid, Mach knots, coefficients, free-molecular."""
    grid = np.array([air_from_m, 1.0 / ATMOSPHERE_STEP_M, 1.0 / vehicle.aero.alpha_rad[1]])
    coefficients = np.ascontiguousarray(vehicle.aero.coefficients)
    air = atmosphere if atmosphere.ndim == 3 else atmosphere[None]
    free = np.zeros(coefficients.shape[1:])
    if vehicle.aero.free_molecular is not None:
        gas = _gas_constants(air_from_m, air.shape[1])
        with np.errstate(divide="ignore"):  # no air: infinite mean free path
            longest = mean_free_path(air[..., 0].min(), gas.min()) / vehicle.reference.length_m
            if longest > sphere_cone.KN_CONTINUUM:  # in thicker air the room for the share stays zero
                free, air = np.ascontiguousarray(vehicle.aero.free_molecular), air.copy()
                air[..., 5] = sphere_cone.bridge(mean_free_path(air[..., 0], gas) / vehicle.reference.length_m)
    return np.ascontiguousarray(air), grid, np.ascontiguousarray(vehicle.aero.mach), coefficients, free


def workspace(states: FloatArray, parameters: FloatArray, step_s: float = 0.0) -> FloatArray:
    """Flat workspace of the kernels of states ``(lanes, 20 or 22)`` and parameter vectors ``(lanes, 79)``.

    ``step_s`` is the integration's: the twist of a joint for which it is too long is slowed.
    """
    s = np.zeros((dynamics.ROWS, len(states)))
    s[dynamics.Y : dynamics.Y + STATES] = states[:, :STATES].T
    s[dynamics.P : dynamics.ADDED] = parameters.T
    if step_s > 0.0:
        inertia = 1.0 / (1.0 / parameters[:, dynamics.I_A] + 1.0 / parameters[:, dynamics.I_B])
        stiffness, damping = parameters[:, dynamics.JOINT + 2], parameters[:, dynamics.JOINT + 5]
        s[dynamics.ADDED] = added_twist_inertia(inertia, damping, stiffness, step_s)
    s[dynamics.CREEP : dynamics.CREEP + states.shape[1] - STATES] = states[:, STATES:].T
    return s.ravel()


def with_creep(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """State (20,), or (22,) with zero creep added if the joint creeps and the state has none."""
    if vehicle.joint.creep_share == 0.0 or len(state) != STATES:
        return state
    return np.append(state, np.zeros(CREEP_STATES))


def _finite_records(states: FloatArray, aux: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Number of records before the first one that is not finite."""
    finite = np.isfinite(states).all(axis=-1)
    n = len(states) if finite.all() else int(np.argmin(finite))
    return states[:n], aux[:n]
