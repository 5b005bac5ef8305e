"""What are the errors of a reconciliation made of, and is each part as large as it is taken to be?

Run: ``python benchmarks/reconciliation_budget.py [FLIGHTS] [--first SEED] [--fit]`` (40 flights, some 10 s of processor
time each, with ``--fit`` 40 s). Flights are those of ``reconciliation.py``. With ``u`` the true parameters less what is
known of them, ``r`` the residuals at the truth and ``J`` their derivatives there, the error of the fit is in the linear
problem

    P (J^T W r - P_0^-1 u),    P = (J^T W J + P_0^-1)^-1

and a sum: one term for measurements and joins together, one for each group of parameters with an a priori law of its
own. The variances that the fit takes them to have add up to P. Printed are, over the flights whose joint the windows
resolve, the rms of the whole over its sd, and of every part its rms over its own sd, and its share of the whole (a
share squared is a part of the variance). A part with an rms above one is where model or a priori law are wrong. No fit
is needed for it; with ``--fit`` each flight is fitted, too, and the rms is printed by which the fit's errors over their
sd differ from those of the linear problem: where they do, the fit is not linear, or not converged.

Measurements and joins are one part, since a twist of the joint that is stiffer than stated errs in both and cancels.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from reconciliation import errors, option

sys.path.insert(0, str(Path(__file__).parents[1]))
from flightmodel import rotations
from flightmodel.atmosphere import profile_from_sounding
from postflight.flight import Flight
from postflight.reconciliation.fit import estimate_turbulence_share, problem_of, reconcile, resolved
from postflight.reconciliation.forward_model import (
    DAMPING_LOG_SD,
    OFFSET_SD_M,
    STIFFNESS_LOG_SD,
    WINDOW_S,
    resolved_stiffness_nmprad,
    select_measurements,
)
from postflight.reconciliation.gauss_newton import INSTRUMENTS, Parameters
from postflight.reconciliation.posterior import SURELY_RESOLVED
from postflight.reconstruction import reconstruct
from recon.atmosphere import cg_accelerations
from tests.wide_flights import flown, wide_flight

QUANTITIES = "log stiffness", "log damping ratio", "offset y", "offset z", "static stability"
DATA, VEHICLE, SENSORS = "measurements and joins", "vehicle", "instruments"
PRIORS = (SENSORS, "density", "wind north", "wind east", "temperature", *["first motion"] * 3)


def true_vehicle(one, parameters):
    """Parameters (v,) of the vehicle that flew, in a priori standard deviations."""
    stated, made, known = one.stated, one.flown, one.stated.uncertainty
    x = {
        "C_A": (one.factors["ca"] - 1.0) / known.ca,
        "C_N": (one.factors["cn"] - 1.0) / known.cn,
        "static stability": (one.factors["cm"] - 1.0) / known.cm,
        "C_mq": one.factors["cmq_shift"] / known.cmq,
    }
    for part, name in (("aeroshell", "shell"), ("centerbody", "centerbody")):
        old, new = getattr(stated, part), getattr(made, part)
        x[f"mass of the {name}"] = (new.mass_kg / old.mass_kg - 1.0) / known.mass
        x[f"station of the {name}'s c.g."] = (new.cg_m[0] - old.cg_m[0]) / known.cg_station_m
        x[f"axial inertia of the {name}"] = (new.inertia[0, 0] / old.inertia[0, 0] - 1.0) / known.inertia
        x[f"inertia of the {name}"] = (new.inertia[1, 1] / old.inertia[1, 1] - 1.0) / known.inertia
    body, shell = (getattr(made, p).cg_m[1:] - getattr(stated, p).cg_m[1:] for p in ("centerbody", "aeroshell"))
    offset = (body * stated.centerbody.mass_kg + shell * stated.aeroshell.mass_kg) / stated.mass_kg
    size = known.inertia_products * stated.centerbody.inertia[1, 1]
    for row, axis in enumerate("yz"):
        x[f"shell's c.g. {axis}"], x[f"offset {axis}"] = shell[row] / known.cg_lateral_m, offset[row] / OFFSET_SD_M
        x[f"centerbody's product x{axis}"] = made.centerbody.inertia[0, 1 + row] / size
    x["centerbody's product yz"] = made.centerbody.inertia[1, 2] / size
    ratio = made.joint.bending_stiffness_nmprad / stated.joint.bending_stiffness_nmprad
    x["stiffness"], x["damping"] = np.log(ratio) / STIFFNESS_LOG_SD, 0.0
    x["damping"] = log_ratio(made, parameters.vehicle(np.array([x[n] for n in parameters.names])))
    return np.array([x[n] for n in parameters.names])


def log_ratio(made, without):
    """Damping's parameter, from a vehicle with all others."""
    return np.log(made.joint.bending_damping_nmsprad / without.joint.bending_damping_nmsprad) / DAMPING_LOG_SD


def true_parameters(problem, one, truth):
    """Parameters of the flight as it was; the instruments' are the most probable of readings less true motion."""
    measured, air, path = problem.measured, problem.air, truth.trajectory
    sounded = profile_from_sounding(air.sounding)
    at, sounding = truth.profile.at(air.knots_m), sounded.at(air.knots_m)
    difference = [np.log(at.density_kgpm3 / sounding.density_kgpm3), *(at.wind_ned_mps - sounding.wind_ned_mps).T[:2]]
    warm = air.temperature_knots_m
    warmer = truth.profile.at(warm).temperature_k - sounded.at(warm).temperature_k
    rows = np.searchsorted(truth.time_s, measured.start.time_s[:-1] - 1e-6)
    state = truth.state_eci[rows]
    bent = rotations.multiply(rotations.conjugate(state[:, 6:10]), state[:, 10:14])
    motion = np.column_stack(
        [
            rotations.boxminus(path.q_ecef_body[rows], measured.start.q_ecef_body[:-1]),
            state[:, 14:17],
            rotations.log(bent),
            state[:, 17:20] - rotations.rotate(rotations.conjugate(bent), state[:, 14:17]),
            path.velocity_ecef_mps[rows] - measured.start.velocity_ecef_mps[:-1],
        ]
    )
    vehicle = true_vehicle(one, problem.vehicle_parameters)
    u = Parameters(vehicle, np.zeros(INSTRUMENTS), np.array(difference), warmer, motion)
    response = problem.instrument_response(problem.predict(u)) * problem.weight[..., None]
    response = response.reshape(-1, INSTRUMENTS)
    off = ((problem.data - true_windows(measured, truth)) * problem.weight).ravel()
    found = np.linalg.solve(response.T @ response + np.eye(INSTRUMENTS), response.T @ off)
    return replace(u, instruments=found)


def true_windows(measured, truth):
    """Windows (s, WINDOWS, 6) of instruments without errors."""
    ideal = SimpleNamespace(
        imu_time_s=truth.time_s,
        specific_force_body_mps2=truth.specific_force_body(measured.accelerometer_m),
        rate_body_radps=truth.trajectory.omega_body_eci_body_radps,
    )
    means = cg_accelerations(ideal, measured.time_s.ravel(), np.zeros(3), 0.5 * WINDOW_S)
    both = np.concatenate([means.rate_radps, means.specific_force_sensor_mps2], axis=1)
    return both.reshape(*measured.time_s.shape, 6)


def parts_of(problem, u):
    """Errors (5,) that each part makes of the sought quantities' parameters, their expected variances, and the whole's.

    By the linear problem at the truth ``u``.
    """
    linear = problem.linearize(u)
    matrix = problem.normal_equations(u, linear).dense
    whole = np.linalg.inv(matrix)
    sought = whole[: len(QUANTITIES)]
    residuals = linear.residuals
    made = {DATA: sought @ linear.transpose_times(residuals.sensors, residuals.joins)}
    expected, data = {}, matrix.copy()
    for name, (part, precision, value) in zip(PRIORS, problem._priors(u), strict=True):
        data[part, part] -= precision
        pieces = [(name, part)]
        if name == SENSORS:
            v = problem.first_instrument
            pieces = [(VEHICLE, slice(0, v)), (SENSORS, slice(v, part.stop))]
        for kind, columns in pieces:
            own = slice(columns.start - part.start, columns.stop - part.start)
            response = sought[:, columns] @ precision[own, own]
            made[kind] = made.get(kind, 0.0) - response @ value[own]
            expected[kind] = expected.get(kind, 0.0) + np.diag(response @ sought[:, columns].T)
    expected[DATA] = np.diag(sought @ data @ sought.T)
    return made, expected, np.diag(whole)[: len(QUANTITIES)]


def budget(seed, fitted):
    """Errors over sd (5,) of one flight by the linear problem and by the fit (NaN without), its parts and their
    expected variances over the whole's; None: not scored.
    """
    one = wide_flight(seed)
    if one.flown.joint.bending_stiffness_nmprad >= SURELY_RESOLVED * resolved_stiffness_nmprad(one.flown):
        return print(f"{seed}: the stiffness is bounded; left out", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        telemetry, truth = flown(one, Path(temporary) / "flight")
    if truth.remark:
        return print(f"{seed}: {truth.remark}; left out", flush=True)
    flight = reconstruct(Flight(telemetry))
    problem = problem_of(flight, select_measurements(flight), ())
    problem = resolved(problem, true_vehicle(one, problem.vehicle_parameters))
    u = true_parameters(problem, one, truth)
    share = estimate_turbulence_share(problem, u)
    problem = replace(problem, air=replace(problem.air, turbulence_share=share))
    made, expected, whole = parts_of(problem, u)
    total, words = sum(made.values()) / np.sqrt(whole), ""
    z = np.full(len(QUANTITIES), np.nan)
    if fitted:
        z = np.divide(*np.reshape(errors(reconcile(flight), one.flown, one.factors), (-1, 2)).T)
        words = f", of the fit {np.round(z, 2).tolist()}"
    print(f"{seed}: errors over sd {np.round(total, 2).tolist()}{words}", flush=True)
    return total, z, {k: v / np.sqrt(whole) for k, v in made.items()}, {k: v / whole for k, v in expected.items()}


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 and sys.argv[1].isdigit() else 40
    first, fitted = int(option("--first") or 0), "--fit" in sys.argv
    flights = [found for seed in range(first, first + count) if (found := budget(seed, fitted)) is not None]
    if not flights:
        return
    for j, name in enumerate(QUANTITIES):
        total, z = (np.array([f[k][j] for f in flights]) for k in (0, 1))
        inside = ", ".join(f"{100 * np.mean(np.abs(total) < s):.0f} % inside {s} sd" for s in (1, 2))
        print(f"{name}: {len(flights)} flights, rms of z {rms(total):.2f}, {inside}", end="")
        print(f"; the fit's is {rms(z):.2f}, off by {rms(z - total):.2f}" if fitted else "")
        for part in flights[0][3]:
            made, share = (np.array([f[k][part][j] for f in flights]) for k in (2, 3))
            print(f"    {part:24} rms of z {rms(made / np.sqrt(share)):.2f}, share of the sd {rms(np.sqrt(share)):.2f}")


if __name__ == "__main__":
    main()
