"""Do the deflection estimates err as they say? Dispersed flights with every error alive, scored at peak pressure.

Run: ``python benchmarks/estimator_coverage.py [FLIGHTS [FIRST SEED]] [FOLDER] [--rigid | --planted]`` (100 flights from
seed 0). Drawn anew for each seed: side and size of the offset that the analyst is told, and what the analyst is not
told: masses, c.g.s, inertias, joint, coefficients (C_A 5 %, C_N 10 %, C_m 15 %, C_mq 0.15 between Mach 1.2 and 5),
start, spin, air, the sounding's and every instrument's errors. No video. Some 5 s a flight on each of two cores; what
the estimators see and the truth are kept in FOLDER, so that the estimators can be scored again without flying. The
camera's history is drawn, not rendered. ``--rigid`` flies a stiff joint; ``--planted`` spoils one assumption at a time,
with uncertainties as the reference vehicle's file states them; ``suspects_bound.py`` says how well the same errors
could be told at all.
"""

import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from flightmodel.statistics import correlation_root

sys.path.insert(0, str(Path(__file__).parents[1]))
from estimators.agreement import CAMERA_MISALIGNED, COEFFICIENTS, HYPOTHESES, MOUNT, OFFSET
from estimators.evidence import LIGHT_TIME_S
from estimators.loads import FlightLoads
from estimators.misalignment import estimate_misalignment
from estimators.trim import estimate_trim
from flightmodel import rotations
from flightmodel.airdata import air_data, lateral_angles
from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import DivergenceError, GateError
from flightmodel.deflection import history_from_lateral
from flightmodel.events import find_peak
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import resample
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.fusing import fuse_flight
from postflight.loads import loads_from_solution
from recon.reconstruct import reconstruct
from recon.settings import Settings
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import ACCELEROMETER_MOUNT, read_scenario
from tests.recon import dispersed

KEPT = "/tmp/estimator_coverage"
COEFFICIENT_SD = {"ca": 0.05, "cn": 0.10, "cm": 0.15}
CMQ_SD = 0.15
RATE_HZ = 20.0
STATED = (
    "vehicle",
    "accelerometer_time_bias_sd_s",
    "gyro_time_bias_sd_s",
    "cg_from_sensor_m",
)  # the same in every flight
ARRAYS = [f.name for f in fields(FlightLoads) if f.name not in STATED]
CAMERA_SD = {"clean": np.deg2rad(0.15), "degraded": np.deg2rad(0.40)}
CAMERA_CLOCK = np.deg2rad(153.0)
FORCE_ALONE = "accelerometer's mounting, the attitude right"
PLANTED = {  # and the right suspect
    "nothing": "",
    COEFFICIENTS: COEFFICIENTS,
    MOUNT: MOUNT,
    FORCE_ALONE: MOUNT,
    OFFSET: OFFSET,
    CAMERA_MISALIGNED: CAMERA_MISALIGNED,
}
TURN_YZ_RAD = np.deg2rad(0.5) * np.array([0.6, 0.8])


def told_vehicle(seed):
    """Vehicle as the analyst knows it: the reference one with an offset of random side and size."""
    rng = np.random.default_rng([seed, 1, 2009])
    nominal = vehicle_from_toml(vehicle_path("irve2_reference"))
    clock, size = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0015, 0.0050)
    body = nominal.centerbody
    lateral = size * nominal.mass_kg / body.mass_kg * np.array([-np.cos(clock), np.sin(clock)])
    moved = body.model_copy(update={"cg_from_datum_body_m": (body.cg_from_datum_body_m[0], *map(float, lateral))})
    known = nominal.uncertainty.model_copy(update=COEFFICIENT_SD)
    return replace(nominal, centerbody=moved, uncertainty=known)


def flown_vehicle(told, seed, rigid=False):
    """Vehicle as it is: every number drawn around what is told, in the sizes that are told; and the drawn factors."""
    rng = np.random.default_rng([seed, 2, 2009])
    flown = dispersed.dispersed_vehicle(told, rng)
    known = told.uncertainty
    factors = {k: 1.0 + getattr(known, k) * rng.standard_normal() for k in ("ca", "cn", "cm")}
    joint = flown.joint.model_copy(
        update={
            "bending_stiffness_nmprad": told.joint.bending_stiffness_nmprad * (300.0 if rigid else rng.uniform(1, 1.3)),
            "bending_damping_nmsprad": flown.joint.bending_damping_nmsprad * (100.0 if rigid else 1.0),
        }
    )
    aero = flown.aero.scaled(**factors, cmq_shift=CMQ_SD * rng.standard_normal())
    return replace(flown, joint=joint, aero=aero), factors


def flown_pulse(seed, rigid=False):
    """One flight: what the estimators see (`FlightLoads`), and the truth at the same times."""
    told = told_vehicle(seed)
    flown, factors = flown_vehicle(told, seed, rigid)
    scenario = replace(dispersed.dispersed_scenario("irve2_reference", seed), vehicle=flown)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        truth = simulate_to_folder(scenario, seed, folder)
        telemetry = replace(read_flight(folder), vehicle=told)
    bet = reconstruct(telemetry, Settings(output_rate_hz=RATE_HZ))
    pulse = loads_from_solution(
        telemetry, bet, air_data(bet.smoothed, profile_from_sounding(telemetry.sounding), told.cg_m)
    )
    t = pulse.time_s
    path = resample(truth.trajectory, t)
    air = air_data(path, truth.profile, flown.cg_m)
    bent = truth.deflection.theta_yz_rad
    turned = np.gradient(np.gradient(bent, truth.time_s, axis=0), truth.time_s, axis=0)
    force = truth.specific_force_body(told.cg_m)
    known = {
        "theta_yz": columns(t, truth.time_s, bent),
        "theta_yz_second": columns(t, truth.time_s, turned),
        "flow_yz": lateral_angles(air.velocity_air_body_mps),
        "pressure": air.dynamic_pressure_pa,
        "mach": air.mach,
        "force": columns(t, truth.time_s, force),
        "turn": columns(t, truth.time_s, truth.angular_acceleration_body_radps2),
        "factors": np.array([factors[k] for k in ("ca", "cn", "cm")]),
        "offset": flown.cg_m - told.cg_m,
        "peak": np.array(find_peak(truth.time_s, truth.dynamic_pressure_pa)[0]),
        "words": np.array(truth.remark),
    }
    return pulse, known


def columns(at, time_s, values):
    return np.stack([np.interp(at, time_s, c) for c in values.T], axis=-1)


def kept_path(folder, seed, rigid):
    return Path(folder) / f"{'rigid' if rigid else 'flight'}_{seed:04d}.npz"


def fly_and_keep(seed, folder, rigid):
    pulse, truth = flown_pulse(seed, rigid)
    data = {f"pulse_{k}": getattr(pulse, k) for k in ARRAYS} | {f"true_{k}": v for k, v in truth.items()}
    np.savez(kept_path(folder, seed, rigid), **data)
    return seed, str(truth["words"])


def kept_flight(folder, seed, rigid=False):
    """Return `FlightLoads` and truth of a flight that was kept."""
    with np.load(kept_path(folder, seed, rigid)) as data:
        arrays = {k: data[f"pulse_{k}"] for k in ARRAYS}
        arrays["angular_acceleration_sd_radps2"] = float(arrays["angular_acceleration_sd_radps2"])
        truth = {k.removeprefix("true_"): data[k] for k in data.files if k.startswith("true_")}
    spec, vehicle = read_scenario("irve2_reference").spec, told_vehicle(seed)
    arm = vehicle.cg_m - vehicle.sensors[ACCELEROMETER_MOUNT].position_from_datum_body_m
    stated = (vehicle, spec.accelerometer.time_bias_s, spec.rates.time_bias_s, arm)
    return FlightLoads(**arrays, **dict(zip(STATED, stated, strict=True))), truth


def fly_missing(folder, seeds, rigid=False, workers=2):
    """Fly what is not kept yet, and say how far it is."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    missing = [s for s in seeds if not kept_path(folder, s, rigid).exists()]
    begun = time.perf_counter()
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("fork")) as pool:
        jobs = [pool.submit(fly_and_keep, s, folder, rigid) for s in missing]
        for k, job in enumerate(as_completed(jobs), 1):
            seed, words = job.result()
            left = (time.perf_counter() - begun) / k * (len(jobs) - k)
            print(f"flight {seed} kept, {k} of {len(jobs)}, {left:.0f} s left {words}", flush=True)


def camera_history(rng, truth_yz, time_s, sd_rad):
    """Camera's history drawn from the error that the fusion takes it to have; half of its variance lasts, half forgets.

    Towards the camera's side ``sd_rad``, across twice that. No frames are rendered: what real frames do is measured by
    ``benchmarks/recovery.py --video``.
    """
    frames = np.arange(0, len(time_s), 5)
    t, bent = time_s[frames], truth_yz[frames]
    towards = np.array([-np.cos(CAMERA_CLOCK), np.sin(CAMERA_CLOCK)])
    axes = np.stack([towards, [-towards[1], towards[0]]], axis=-1) * [sd_rad, 2.0 * sd_rad]
    lasting, light = rng.standard_normal(2), correlation_root(t, LIGHT_TIME_S)
    drawn = np.sqrt(0.5) * (lasting + light @ rng.standard_normal((light.shape[1], 2)))
    cov = np.tile(axes @ axes.T, (len(t), 1, 1))
    return history_from_lateral(t, bent + drawn @ axes.T, cov, "camera", "drawn, not rendered")


def planted(pulse, camera, what):
    """Pulse and camera with one assumption wrong, as the analyst would have it."""
    if what == COEFFICIENTS:
        told = replace(pulse.vehicle, aero=pulse.vehicle.aero.scaled(cm=1.15, cn=1.15))
        return replace(pulse, vehicle=told), camera
    if what in (MOUNT, FORCE_ALONE):
        # a reconstruction takes the force's direction for the attitude's: the flow turns by the same angle
        turned = rotations.exp(np.array([0.0, *TURN_YZ_RAD]))
        force = rotations.rotate(turned, pulse.specific_force_body_mps2)
        along = np.array([TURN_YZ_RAD[1], -TURN_YZ_RAD[0]]) if what == MOUNT else 0.0
        return replace(pulse, specific_force_body_mps2=force, flow_yz_rad=pulse.flow_yz_rad + along), camera
    if what == OFFSET:
        body = pulse.vehicle.centerbody
        x, y, z = body.cg_from_datum_body_m
        told = replace(
            pulse.vehicle, centerbody=body.model_copy(update={"cg_from_datum_body_m": (x, y + 0.004, z - 0.003)})
        )
        return replace(pulse, vehicle=told), camera
    if what == CAMERA_MISALIGNED:
        return pulse, replace(camera, plane_lv_rad=camera.plane_lv_rad + np.deg2rad(25.0))
    return pulse, camera


def scored(seed, folder, rigid, what):
    """Errors and error bars at peak pressure of every method; what the agreement test says."""
    pulse, truth = kept_flight(folder, seed, rigid)
    use = pulse.through_pulse
    if what is not None:  # errors told as the vehicle file has them, not at the sizes of the ensemble
        known = vehicle_from_toml(vehicle_path("irve2_reference")).uncertainty
        pulse = replace(pulse, vehicle=replace(flown_aero(pulse.vehicle, truth, known), uncertainty=known))
    out = {"seed": seed, "words": str(truth["words"])}
    cameras = {}
    for k, (name, sd) in enumerate(CAMERA_SD.items()):
        rng = np.random.default_rng([seed, 3 + k, 2009])
        cameras[name] = camera_history(rng, truth["theta_yz"][use], pulse.time_s[use], sd)
    pulse, cameras["clean"] = planted(pulse, cameras["clean"], what)
    answers = {} if what is not None else {"misalignment": estimate_misalignment(pulse), "trim": estimate_trim(pulse)}
    for name, camera in () if what is not None else (("no video", None), *cameras.items()):
        answers[f"fused, {name}"] = safely(out, lambda c=camera: fuse_flight(pulse, c).fused.history)
    if what is not None:
        found = safely(out, lambda: fuse_flight(pulse, cameras["clean"]).agreement)
        out["named"] = None if found is None else found.likeliest
        out["red"] = found is None or bool(found.hypotheses)
    out["rows"] = {name: row_of(h, pulse, truth) for name, h in answers.items() if h is not None}
    return out


def flown_aero(vehicle, truth, told):
    """Vehicle whose coefficients are off by draws of the told sizes: the drawn ones of the ensemble, scaled down."""
    z = (truth["factors"] - 1.0) / [COEFFICIENT_SD[k] for k in ("ca", "cn", "cm")]
    wrong = truth["factors"] / (1.0 + z * [told.ca, told.cn, told.cm])
    return replace(vehicle, aero=vehicle.aero.scaled(*wrong))


def safely(out, work):
    try:
        return work()
    except (DivergenceError, GateError) as fault:
        out.setdefault("refused", []).append(str(fault))
        return None


def row_of(history, pulse, truth):
    """Angle error, its sd, plane error, its sd, true angle, lateral normalised square; rad."""
    k = int(np.argmin(np.abs(history.time_s - truth["peak"])))
    true = truth["theta_yz"][int(np.argmin(np.abs(pulse.time_s - history.time_s[k])))]
    size, d, cov = float(np.hypot(*true)), history.theta_yz_rad[k] - true, history.lateral_cov[k]
    turn = history.plane_lv_rad[k] - np.arctan2(true[1], -true[0])
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    if not np.isfinite(cov).all():  # the plane is lost: as well known across as along
        cov = history.covariance[k, 0, 0] * np.eye(2)
    square = float(d @ np.linalg.solve(cov, d))
    return (
        history.theta_rad[k] - size, history.theta_sd_rad[k], turn, np.sqrt(history.covariance[k, 1, 1]), size, square,
    )  # fmt: skip


def report(results, rigid):
    rows = [r for r in results if not r["words"]]
    print(f"\n{len(results)} flights, {len(results) - len(rows)} of them tumbled and left out; at peak pressure, deg")
    print(f"{'':18}  rms   bias   rms/bound  1 sd %  2 sd %  refused   plane (bent > 1 deg): rms  1 sd %  2 sd %")
    for name in dict.fromkeys(n for r in rows for n in r["rows"]):
        a = np.array([r["rows"][name] for r in rows if name in r["rows"]])
        z, bent = a[:, 0] / a[:, 1], a[:, 4] > np.deg2rad(1.0)
        rms, bound = np.sqrt(np.mean(a[:, 0] ** 2)), np.sqrt(np.mean(a[:, 1] ** 2))
        share = [100.0 * np.mean(np.abs(z) < k) for k in (1, 2)]
        words = f"{name:18}{np.rad2deg(rms):6.3f}{np.rad2deg(a[:, 0].mean()):+7.3f}{rms / bound:9.2f}"
        words += f"{share[0]:10.0f}{share[1]:8.0f}{len(rows) - len(a):9d}"
        if bent.any():
            zp = a[bent, 2] / a[bent, 3]
            plane = np.rad2deg(np.sqrt(np.mean(a[bent, 2] ** 2)))
            words += f"{plane:28.1f}{100 * np.mean(np.abs(zp) < 1):8.0f}{100 * np.mean(np.abs(zp) < 2):8.0f}"
        print(words)
        if rigid:
            inside = [100.0 * np.mean(a[:, 5] < chi2.ppf(p, 2)) for p in (0.6827, 0.9545)]
            print(f"{'':18}lateral vector inside its 68.3 and 95.4 % ellipses: {inside[0]:.0f}, {inside[1]:.0f} %")


def report_planted(results, what):
    rows = [r for r in results if not r["words"]]
    red = sum(r["red"] for r in rows)
    # a refusal names its fault hypotheses in its message
    told = [r["named"] if r["named"] is not None else named_in(r["refused"][0]) for r in rows]
    refused = sum(r["named"] is None for r in rows)
    right = PLANTED[what]
    first, any_of = sum(n[:1] == (right,) for n in told), sum(right in n for n in told)
    words = f"red {red} of {len(rows)} ({refused} no common answer), named {any_of}, first or alone {first}"
    print(f"{what} wrong: {words}; {dict(Counter(' or '.join(n) for n in told if n))}", flush=True)


def named_in(words):
    """Fault hypotheses that a refusal names, the likeliest first."""
    return tuple(
        sorted((s for s in HYPOTHESES if f"the {s} explains" in words or f"the {s} or" in words), key=words.index)
    )


def seeds_and_folder():
    """Return seeds, from a count and the first one, and the folder of kept flights, as the command line has them."""
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    count, first = numbers + [100, 0][len(numbers) :]
    return range(first, first + count), next((a for a in sys.argv[1:] if not a.isdigit() and a[0] != "-"), KEPT)


def main():
    seeds, folder = seeds_and_folder()
    rigid = "--rigid" in sys.argv
    fly_missing(folder, seeds, rigid)
    whats = PLANTED if "--planted" in sys.argv else (None,)
    begun = time.perf_counter()
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
        for what in whats:
            work = partial(scored, folder=folder, rigid=rigid, what=what)
            results = []
            for k, result in enumerate(pool.map(work, seeds), 1):
                results.append(result)
                if k % 20 == 0:
                    print(f"scored {k} of {len(seeds)}, {time.perf_counter() - begun:.0f} s", flush=True)
            report(results, rigid) if what is None else report_planted(results, what)


if __name__ == "__main__":
    main()
