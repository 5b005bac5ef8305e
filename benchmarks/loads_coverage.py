"""Do estimates from another team's table err as they say? Dispersed flights, errors as the defaults assume them.

Run: ``python benchmarks/loads_coverage.py [FLIGHTS [FIRST SEED]]`` (40 flights from seed 0; a second a flight).
Vehicles, joints, c.g. offsets, spins and coefficients are drawn as `tests.wide_flights` says, soft joints alone:
deflections of 2 to 20 deg. The table has what flew with the errors of `flightmodel.instruments.LoadsErrors`, drawn once
a flight: accelerometer and gyros by bias, scale and mounting, the air by a wind and a factor of dynamic pressure, the
flow angle half fixed in the body and half in inertial space, as an attitude errs. The estimators get the table and the
stated vehicle alone.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))
import postflight as pf
from flightmodel import rotations
from flightmodel.airdata import air_data
from flightmodel.checks import GateError
from flightmodel.instruments import LoadsErrors
from flightmodel.trajectory import resample
from synthetic_flight.scenarios import fly_scenario
from tests import wide_flights

RATE_HZ, SPAN_S = 50.0, 12.0
NOISE_MPS2, NOISE_DEGPS = 0.02, 0.03
STATED = LoadsErrors()


def table_of(truth, cg_m, rng):
    """What another team's program would write of a flight, SI units, and the time of the true peak."""
    peak_s = float(truth.time_s[np.argmax(truth.dynamic_pressure_pa)])
    t = np.arange(peak_s - SPAN_S, min(peak_s + SPAN_S, truth.time_s[-1]), 1.0 / RATE_HZ)
    path = resample(truth.trajectory, t)
    normal = rng.standard_normal
    tilt_body, tilt_inertial = np.deg2rad(STATED.flow_angle_sd_deg / np.sqrt(2.0)) * normal((2, 3))
    believed = rotations.boxplus(path.q_ecef_body, np.tile(tilt_body, (len(t), 1)))
    believed = rotations.multiply(rotations.exp(tilt_inertial), believed)
    wind = STATED.wind_sd_mps * normal(3)
    seen = replace(path, q_ecef_body=believed, velocity_ecef_mps=path.velocity_ecef_mps + wind)
    air = air_data(seen, truth.profile, cg_m)
    velocity = air.velocity_air_body_mps
    force = _at(t, truth.time_s, truth.specific_force_body(cg_m))
    force = force * (1.0 + STATED.accelerometer_scale_sd * normal(3)) + STATED.accelerometer_bias_sd_mps2 * normal(3)
    force = force + np.cross(np.deg2rad(STATED.accelerometer_mount_sd_deg) * normal(3), force)
    rate = np.rad2deg(_at(t, truth.time_s, truth.state_eci[:, 14:17]))
    rate = rate * (1.0 + STATED.rate_scale_sd * normal(3)) + STATED.rate_bias_sd_degps * normal(3)
    pressure = air.dynamic_pressure_pa * (1.0 + 0.01 * STATED.dynamic_pressure_sd_percent * normal())
    columns = {"t_s": t, "mach": air.mach, "dynamic_pressure_pa": pressure, "airspeed_mps": air.airspeed_mps}
    columns |= {"altitude_m": air.altitude_m, "alpha_rad": np.arctan2(velocity[:, 2], velocity[:, 0])}
    columns["beta_rad"] = np.arcsin(velocity[:, 1] / np.linalg.norm(velocity, axis=1))
    for k, axis in enumerate("xyz"):
        columns[f"a{axis}_mps2"] = force[:, k] + NOISE_MPS2 * normal(len(t))
    for k, axis in enumerate("pqr"):
        columns[f"{axis}_degps"] = rate[:, k] + NOISE_DEGPS * normal(len(t))
    return pd.DataFrame(columns), peak_s


def _at(t, time_s, values):
    return np.stack([np.interp(t, time_s, column) for column in values.T], axis=-1)


def scored(seed):
    """Error and sd of each method at the true peak, deg, and the truth; NaN for none."""
    one = wide_flights.wide_flight(seed, bent=True)
    truth = fly_scenario(one.scenario, seed)
    table, peak_s = table_of(truth, one.stated.cg_m, np.random.default_rng([seed, 58]))
    true = float(np.rad2deg(np.hypot(*_at(np.array([peak_s]), truth.time_s, truth.deflection.theta_yz_rad)[0])))
    row = {"seed": seed, "truth": true}
    try:
        loads = pf.read_loads(table, one.stated)
        fused = pf.fuse(loads)
    except GateError as fault:
        return row | {"refused": str(fault)[:150]}
    for name in ("misalignment", "trim"):
        history = getattr(pf, f"estimate_{name}")(loads)
        theta, sd = np.rad2deg(history.angle_at(peak_s))
        row |= {f"{name}_error": theta - true, f"{name}_sd": sd}
    answer = fused.to_frame().set_index("method").loc["fused"]
    at = float(np.rad2deg(np.hypot(*_at(np.array([answer.t_s]), truth.time_s, truth.deflection.theta_yz_rad)[0])))
    return row | {"fused_error": answer.theta_deg - at, "fused_sd": answer.theta_sd_deg}


def main():
    count, first = ([int(a) for a in sys.argv[1:]] + [40, 0][len(sys.argv) - 1 :])[:2]
    with ProcessPoolExecutor(2) as pool:
        rows = pd.DataFrame(pool.map(scored, range(first, first + count)))
    with pd.option_context("display.width", 200, "display.max_rows", None):
        print(rows.round(2).to_string(index=False))
    for name in ("misalignment", "trim", "fused"):
        z = (rows[f"{name}_error"] / rows[f"{name}_sd"]).dropna()
        print(f"{name:13s} {len(z)} answers, rms z {np.sqrt((z**2).mean()):.2f}, largest {z.abs().max():.1f}, "
              f"rms error {np.sqrt((rows[f'{name}_error']**2).mean()):.2f} deg")  # fmt: skip


if __name__ == "__main__":
    main()
