"""Do the deflection estimates err as they say? Flights far from the reference vehicle, scored at peak pressure.

Run: ``python benchmarks/estimator_coverage.py [FLIGHTS [FIRST SEED]] [FOLDER] [--bent] [--planted] [--packages DIR]``
(100 flights from seed 0). Drawn anew for each seed, as `tests.wide_flights` says: spin, joint, damping, offset, size
and mass of the vehicle, and what is unknown of it. No video. Some 4 s a flight on each of two cores; what the
estimators see and the truth are kept in FOLDER, so that the estimators can be scored again without flying. The
camera's history is drawn, not rendered. Beside errors over their sd the quantiles are scored: the share of truths below
each, for little, some and much deflection. ``--planted`` spoils one assumption at a time, with uncertainties as the
reference vehicle's file states them; ``suspects_bound.py`` says how well the same errors could be found at all.
``--bent`` flies soft joints and no small offsets: deflections of some degrees, kept in a folder of their own.
``--packages`` scores flights of another simulator: folders with flight.toml and truth/truth.csv.
"""

import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import chi2

from flightmodel.statistics import correlation

sys.path.insert(0, str(Path(__file__).parents[1]))
from estimators.agreement import CAMERA_MISALIGNED, COEFFICIENTS, HYPOTHESES, MOUNT, OFFSET
from estimators.evidence import LIGHT_TIME_S
from estimators.fusing import fuse_flight
from estimators.loads import FlightLoads
from estimators.misalignment import estimate_misalignment
from estimators.trim import estimate_trim
from flightmodel import rotations
from flightmodel.airdata import air_data, lateral_angles
from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import DivergenceError, GateError
from flightmodel.deflection import QUANTILES, history_from_lateral, polar_from_lateral, standard_normals
from flightmodel.events import find_peak
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import resample
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.reconstruction import loads_from_solution
from recon.reconstruct import reconstruct
from recon.settings import Settings
from tests import wide_flights

KEPT = "/tmp/wide_estimator_coverage"
COEFFICIENT_SD = wide_flights.COEFFICIENT_SD
RATE_HZ = 20.0
STATED = (
    "vehicle",
    "point_from_datum_m",
    "accelerometer_time_bias_sd_s",
    "gyro_time_bias_sd_s",
    "cg_from_sensor_m",
)  # follow from what the vehicle file states
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
BINS_DEG = (0.0, 0.5, 2.0, 90.0)  # of the true deflection: a locked joint's, about 1 deg, more
TURN_YZ_RAD = np.deg2rad(0.5) * np.array([0.6, 0.8])


def loads_of(telemetry):
    """What the estimators see of a flight (`FlightLoads`)."""
    bet = reconstruct(telemetry, Settings(output_rate_hz=RATE_HZ))
    profile = profile_from_sounding(telemetry.sounding)
    return loads_from_solution(telemetry, bet, air_data(bet.smoothed, profile, telemetry.vehicle.cg_m))


def flown_pulse(seed, bent=False):
    """One flight: what the estimators see, and the truth at the same times."""
    one = wide_flights.wide_flight(seed, bent=bent)
    with tempfile.TemporaryDirectory() as temporary:
        telemetry, truth = wide_flights.flown(one, Path(temporary) / "flight")
        pulse = loads_of(telemetry)
    t = pulse.time_s
    path = resample(truth.trajectory, t)
    air = air_data(path, truth.profile, one.stated.cg_m)
    known = {
        "theta_yz": columns(t, truth.time_s, truth.deflection.theta_yz_rad),
        "flow_yz": lateral_angles(air.velocity_air_body_mps),
        "pressure": air.dynamic_pressure_pa,
        "factors": np.array([one.factors[k] for k in ("ca", "cn", "cm")]),
        "peak": np.array(find_peak(truth.time_s, truth.dynamic_pressure_pa)[0]),
        "locked": np.array(one.locked),
        "bent": np.array(bent),
        "spin": np.array(one.scenario.spec.initial.spin_rpm),
        "words": np.array(truth.remark),
    }
    return pulse, known


def columns(at, time_s, values):
    return np.stack([np.interp(at, time_s, c) for c in values.T], axis=-1)


def kept_path(folder, seed):
    return Path(folder) / f"flight_{seed:04d}.npz"


def fly_and_keep(seed, folder, bent):
    pulse, truth = flown_pulse(seed, bent)
    data = {f"pulse_{k}": getattr(pulse, k) for k in ARRAYS} | {f"true_{k}": v for k, v in truth.items()}
    np.savez(kept_path(folder, seed), **data)
    return seed, str(truth["words"])


def kept_flight(folder, seed):
    """Return `FlightLoads` and truth of a flight that was kept."""
    with np.load(kept_path(folder, seed)) as data:
        arrays = {k: data[f"pulse_{k}"] for k in ARRAYS}
        for name in ("angular_acceleration_sd_radps2", "force_noise_sd_mps2", "half_window_s", "swing_radps"):
            arrays[name] = float(arrays[name])
        truth = {k.removeprefix("true_"): data[k] for k in data.files if k.startswith("true_")}
    one = wide_flights.wide_flight(seed, bent=bool(truth.get("bent", False)))
    spec, vehicle = one.scenario.spec, one.stated
    arm = vehicle.cg_m - vehicle.sensors[spec.accelerometer.mount].position_from_datum_body_m
    stated = (vehicle, vehicle.cg_m, spec.accelerometer.time_bias_s, spec.rates.time_bias_s, arm)
    return FlightLoads(**arrays, **dict(zip(STATED, stated, strict=True))), truth


def fly_missing(folder, seeds, workers=2, bent=False):
    """Fly what is not kept yet, and say how far it is."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    missing = [s for s in seeds if not kept_path(folder, s).exists()]
    begun = time.perf_counter()
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("fork")) as pool:
        jobs = [pool.submit(fly_and_keep, s, folder, bent) for s in missing]
        for k, job in enumerate(as_completed(jobs), 1):
            seed, words = job.result()
            left = (time.perf_counter() - begun) / k * (len(jobs) - k)
            print(f"flight {seed} kept, {k} of {len(jobs)}, {left:.0f} s left {words}", flush=True)


def camera_history(rng, truth_yz, time_s, sd_rad):
    """Camera's history drawn with the error that the fusion states: half of its variance lasts, half forgets.

    The latter is Gauss-Markov from frame to frame, whatever knots the fusion has for it. Towards the camera's side
    ``sd_rad``, across twice that. No frames are rendered: what real frames do is measured by
    ``benchmarks/recovery.py --video``.
    """
    frames = np.arange(0, len(time_s), 5)
    t, bent = time_s[frames], truth_yz[frames]
    towards = np.array([-np.cos(CAMERA_CLOCK), np.sin(CAMERA_CLOCK)])
    axes = np.stack([towards, [-towards[1], towards[0]]], axis=-1) * [sd_rad, 2.0 * sd_rad]
    lasting, light = rng.standard_normal(2), np.linalg.cholesky(correlation(t, LIGHT_TIME_S))
    drawn = np.sqrt(0.5) * (lasting + light @ rng.standard_normal((light.shape[1], 2)))
    cov = np.tile(axes @ axes.T, (len(t), 1, 1))
    return history_from_lateral(t, bent + drawn @ axes.T, cov, "camera", "drawn, not rendered")


def planted(pulse, camera, what):
    """Pulse and camera with one assumption wrong, as the analyst would have it."""
    if what == COEFFICIENTS:
        wrong = replace(pulse.vehicle, aero=pulse.vehicle.aero.scaled(cm=1.15, cn=1.15))
        return replace(pulse, vehicle=wrong), camera
    if what in (MOUNT, FORCE_ALONE):
        # a reconstruction takes the force's direction for the attitude's: the flow turns by the same angle
        turned = rotations.exp(np.array([0.0, *TURN_YZ_RAD]))
        force = rotations.rotate(turned, pulse.specific_force_body_mps2)
        along = np.array([TURN_YZ_RAD[1], -TURN_YZ_RAD[0]]) if what == MOUNT else 0.0
        return replace(pulse, specific_force_body_mps2=force, flow_yz_rad=pulse.flow_yz_rad + along), camera
    if what == OFFSET:
        body = pulse.vehicle.centerbody
        x, y, z = body.cg_from_datum_body_m
        wrong = replace(
            pulse.vehicle, centerbody=body.model_copy(update={"cg_from_datum_body_m": (x, y + 0.004, z - 0.003)})
        )
        return replace(pulse, vehicle=wrong), camera
    if what == CAMERA_MISALIGNED:
        return pulse, replace(camera, plane_lv_rad=camera.plane_lv_rad + np.deg2rad(25.0))
    return pulse, camera


def scored(seed, folder, what):
    """Errors and error bars at peak pressure of every method; what the agreement test says."""
    pulse, truth = kept_flight(folder, seed)
    use = pulse.through_pulse
    if what is not None:  # errors stated as in the vehicle file, not at the sizes of the ensemble
        known = vehicle_from_toml(vehicle_path("irve2_reference")).uncertainty
        pulse = replace(pulse, vehicle=replace(flown_aero(pulse.vehicle, truth, known), uncertainty=known))
    out = {"seed": seed, "words": str(truth["words"]), "spin": float(truth["spin"]), "locked": bool(truth["locked"])}
    cameras = {}
    for k, (name, sd) in enumerate(CAMERA_SD.items()):
        rng = np.random.default_rng([seed, 3 + k, 2009])
        cameras[name] = camera_history(rng, truth["theta_yz"][use], pulse.time_s[use], sd)
    pulse, cameras["clean"] = planted(pulse, cameras["clean"], what)
    if what is not None:
        found = safely(out, lambda: fuse_flight(pulse, cameras["clean"]))
        return out | of_planted(found, pulse, truth)
    answers = {"misalignment": estimate_misalignment(pulse), "trim": estimate_trim(pulse)}
    for name, camera in {"no video": None, **cameras}.items():
        found = safely(out, lambda c=camera: fuse_flight(pulse, c))
        if found is not None:
            answers[f"fused, {name}"] = found.history
            out.setdefault("disagree", {})[name] = found.agreement.likeliest
            out["size"] = found.solution.process_size_radps2
    out["rows"] = {name: row_of(h, pulse, truth) for name, h in answers.items()}
    out["rows"]["angle of attack"] = angle_row(pulse, truth)
    return out


def of_planted(found, pulse, truth):
    """What the agreement test names, whether it alarms, and the fused error over its sd."""
    if found is None:
        return {"named": None, "red": True}
    row = row_of(found.history, pulse, truth)
    return {
        "named": found.agreement.likeliest, "red": bool(found.agreement.hypotheses), "z": row[0] / row[1], "e": row[0],
    }  # fmt: skip


def flown_aero(vehicle, truth, stated):
    """Vehicle whose coefficients are off by draws of the stated sizes: the drawn ones of the ensemble, scaled down."""
    z = (truth["factors"] - 1.0) / [COEFFICIENT_SD[k] for k in ("ca", "cn", "cm")]
    wrong = truth["factors"] / (1.0 + z * [stated.ca, stated.cn, stated.cm])
    return replace(vehicle, aero=vehicle.aero.scaled(*wrong))


def safely(out, work):
    try:
        return work()
    except (DivergenceError, GateError) as fault:
        out.setdefault("refused", []).append(str(fault))
        return None


def row_of(history, pulse, truth):
    """Angle error, its sd, plane error, its sd, true angle, lateral normalised square; the angle's expected square over
    its variance; below which quantiles the truth is.
    """
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
        expected_square(true, cov), *(size < history.theta_quantiles_rad[k]),
    )  # fmt: skip


def expected_square(true_yz, cov):
    """Mean square of an angle's error over its variance if readings scatter about the true vector as stated.

    Above one for a vector near zero: its angle cannot err downwards.
    """
    if not np.isfinite(cov).all():  # no answer
        return np.nan
    drawn = true_yz + standard_normals(2) @ np.linalg.cholesky(cov).T
    size, _, polar = polar_from_lateral(drawn, np.tile(cov, (len(drawn), 1, 1)))
    return float(np.mean((size - np.hypot(*true_yz)) ** 2 / polar[:, 0, 0]))


def angle_row(pulse, truth):
    """Error of the total angle of attack, as `row_of`; the plane's columns are its clock's."""
    k = int(np.argmin(np.abs(pulse.time_s - truth["peak"])))
    true, cov = truth["flow_yz"][k], pulse.flow_cov[k]
    size, plane, polar = polar_from_lateral(pulse.flow_yz_rad[[k]], cov[None])
    d = pulse.flow_yz_rad[k] - true
    turn = plane[0] - np.arctan2(true[1], -true[0])
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    sd = np.sqrt(np.diag(polar[0]))
    square = float(d @ np.linalg.solve(cov, d))
    return size[0] - np.hypot(*true), sd[0], turn, sd[1], np.hypot(*true), square, expected_square(true, cov)


def report(results):
    rows = [r for r in results if not r["words"]]
    print(f"\n{len(results)} flights, {len(results) - len(rows)} of them tumbled and left out; at peak pressure, deg")
    head = "rms   bias  rms of z, as stated, of the vector's  1 sd %  2 sd %  refused  lateral 68, 95 %"
    head += "   plane (bent > 1 deg): rms  1 sd %  2 sd %"
    print(f"{'':18}  {head}")
    for name in dict.fromkeys(n for r in rows for n in r["rows"]):
        a = np.array([r["rows"][name] for r in rows if name in r["rows"]])
        a = a[np.isfinite(a[:, 0])]
        z, bent = a[:, 0] / a[:, 1], a[:, 4] > np.deg2rad(1.0)
        rms = np.sqrt(np.mean(a[:, 0] ** 2))
        share = [100.0 * np.mean(np.abs(z) < k) for k in (1, 2)]
        words = f"{name:18}{np.rad2deg(rms):6.3f}{np.rad2deg(a[:, 0].mean()):+7.3f}{np.sqrt(np.mean(z**2)):9.2f}"
        words += f"{np.sqrt(a[:, 6].mean()):11.2f}{np.sqrt(0.5 * np.mean(a[:, 5])):13.2f}"
        words += f"{share[0]:14.0f}{share[1]:8.0f}{len(rows) - len(a):9d}"
        inside = [100.0 * np.mean(a[:, 5] < chi2.ppf(p, 2)) for p in (0.6827, 0.9545)]
        words += f"{inside[0]:9.0f}{inside[1]:5.0f}"
        if bent.any():
            zp = a[bent, 2] / a[bent, 3]
            plane = np.rad2deg(np.sqrt(np.mean(a[bent, 2] ** 2)))
            words += f"{plane:28.1f}{100 * np.mean(np.abs(zp) < 1):8.0f}{100 * np.mean(np.abs(zp) < 2):8.0f}"
        print(words)
    report_quantiles(rows)
    for video in ("no video", *CAMERA_SD):
        said = [r["seed"] for r in rows if r.get("disagree", {}).get(video)]
        print(f"said to disagree, {video}: {len(said)} of {len(rows)} {said}")


def report_quantiles(rows):
    """Share of the truths below each quantile, by the size of the true deflection."""
    stated = ", ".join(f"{100.0 * p:.0f}" for p in QUANTILES)
    print(f"share of the truths below the quantiles {stated} %, by the true deflection")
    for name in dict.fromkeys(n for r in rows for n in r["rows"] if n != "angle of attack"):
        a = np.array([r["rows"][name] for r in rows if name in r["rows"]])
        a = a[np.isfinite(a[:, 0])]
        for low, high in pairwise(BINS_DEG):
            below = a[(np.rad2deg(a[:, 4]) >= low) & (np.rad2deg(a[:, 4]) < high), 7:]
            if len(below):
                shares = ", ".join(f"{100.0 * x:.0f}" for x in below.mean(axis=0))
                print(f"{name:18}{low:4.1f} to {high:4.1f} deg, {len(below):3d} flights: {shares} %")


def score_packages(folder):
    """Flights of another simulator, with the truth beside them: errors at peak pressure, deg, and over their sd."""
    for package in sorted(p.parent for p in Path(folder).glob("*/flight.toml")):
        table = pd.read_csv(package / "truth" / "truth.csv")
        pulse = loads_of(read_flight(package))
        bent = np.deg2rad(table[["theta_y_deg", "theta_z_deg"]].to_numpy())
        truth = {"theta_yz": columns(pulse.time_s, table.t_s.to_numpy(), bent)}
        truth["peak"] = find_peak(table.t_s.to_numpy(), table.dynamic_pressure_pa.to_numpy())[0]
        found = fuse_flight(pulse, None)
        answers = {"misalignment": estimate_misalignment(pulse), "trim": estimate_trim(pulse)}
        rows = {name: row_of(h, pulse, truth) for name, h in {**answers, "fused": found.history}.items()}
        words = "; ".join(
            f"{n} {np.rad2deg(r[0]):+.3f} +/- {np.rad2deg(r[1]):.3f} ({r[0] / r[1]:+.2f} sd)" for n, r in rows.items()
        )
        said = ", ".join(found.agreement.likeliest) or "agree"
        size = found.solution.process_size_radps2
        print(
            f"{package.name:14} bent {np.rad2deg(rows['trim'][4]):.2f}: {words}; {said}; process {size:.1f} rad/s2",
            flush=True,
        )


def report_planted(results, what):
    rows = [r for r in results if not r["words"]]
    red = sum(r["red"] for r in rows)
    # a refusal names its fault hypotheses in its message
    named = [r["named"] if r["named"] is not None else named_in(r["refused"][0]) for r in rows]
    refused = sum(r["named"] is None for r in rows)
    right = PLANTED[what]
    first, any_of = sum(n[:1] == (right,) for n in named), sum(right in n for n in named)
    words = f"red {red} of {len(rows)} ({refused} no common answer), named {any_of}, first or alone {first}"
    print(f"{what} wrong: {words}; {dict(Counter(' or '.join(n) for n in named if n))}", flush=True)


def named_in(words):
    """Fault hypotheses that a refusal names, the likeliest first."""
    return tuple(
        sorted((s for s in HYPOTHESES if f"the {s} explains" in words or f"the {s} or" in words), key=words.index)
    )


def seeds_and_folder():
    """Return seeds, from a count and the first one, and the folder of kept flights, as the command line has them."""
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    count, first = numbers + [100, 0][len(numbers) :]
    kept = f"{KEPT}_bent" if "--bent" in sys.argv else KEPT
    return range(first, first + count), next((a for a in sys.argv[1:] if not a.isdigit() and a[0] != "-"), kept)


def main():
    if "--packages" in sys.argv:
        return score_packages(sys.argv[sys.argv.index("--packages") + 1])
    seeds, folder = seeds_and_folder()
    fly_missing(folder, seeds, bent="--bent" in sys.argv)
    whats = PLANTED if "--planted" in sys.argv else (None,)
    begun = time.perf_counter()
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
        for what in whats:
            work = partial(scored, folder=folder, what=what)
            results = []
            for k, result in enumerate(pool.map(work, seeds), 1):
                results.append(result)
                if k % 20 == 0:
                    print(f"scored {k} of {len(seeds)}, {time.perf_counter() - begun:.0f} s", flush=True)
            report(results) if what is None else report_planted(results, what)


if __name__ == "__main__":
    main()
