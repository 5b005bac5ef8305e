"""Does it matter that a real shell creeps? Flights whose joint does, through every estimate that is made of a flight.

Run: ``python benchmarks/joint_memory.py [FLIGHTS] [--first SEED] [--joints FIRST:LAST[:STEP]] [--out FILE]`` (3
flights of each joint). The joints are standard linear solids: a tenth, three tenths and half of the compliance come
late, with 1, 10 and 60 s; the stiffness against loads that stay is drawn as that of `benchmarks/reconciliation.py`'s
joints, so that no vehicle diverges. All else is dispersed as there. Printed are, joint by joint, rms errors and the
rms of error over the stated sd: of misalignment, trim and their fusion at peak pressure (both lateral axes), of the
benchmark frame's deflection (`estimators.benchmark`, `DRAWS` films' readings drawn from the true deflection), and of
the reconciliation's stiffness (against fast motion), damping ratio, offset, stability and deflection at peak
pressure, with one stiffness and with what the evidence selects; and which of its checks are red. ``--kept FOLDER``
keeps what the benchmark frame's deflection is made of, and ``--frames FOLDER`` scores that alone again;
``--estimators`` leaves the reconciliation out. A flight takes about two minutes of processor time, 20 s without it.

Dry friction is not flown: the simulator's joint has none. The estimators of a flight do not use the joint's law; the
benchmark frame's deflection does, and is also drawn with a play operator (Prandtl) on the flight's own moment, of the
size of the shell that was loaded on the ground (14 mm of 76 between the way up and the way down): half of the
compliance, slipping at 0.18 of the largest load.
"""

import json
import pickle
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.reconciliation import STATED, flown_vehicle
from estimators.benchmark import RelativeDeflections, benchmark_deflection, joint_moment
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from flightmodel.statistics import correlation_root
from postflight.deflections import estimate
from postflight.flight import Flight
from postflight.reconciliation.command import credibility
from postflight.reconciliation.fit import select_laws
from postflight.reconciliation.posterior import deflection_of, joint_table
from postflight.reconstruction import reconstruct
from synthetic_flight.folder import simulate_to_folder
from tests.recon import dispersed

JOINTS = [(0.0, 10.0), *((share, time_s) for share in (0.1, 0.3, 0.5) for time_s in (1.0, 10.0, 60.0))]
DRAWS, FRAMES, PRIOR_RAD, READ_SD_RAD = 8, 25, np.deg2rad(0.12), np.deg2rad(0.05)
FRICTION_SHARE, FRICTION_AT = 0.5, 0.18


def creeping(seed, share, time_s):
    """Vehicle whose held stiffness is that of the seed's plain joint, and its coefficients' factors."""
    vehicle, factors = flown_vehicle(seed)
    joint = vehicle.joint
    changed = {
        "bending_stiffness_nmprad": joint.bending_stiffness_nmprad / (1.0 - share),
        "bending_damping_nmsprad": joint.bending_damping_nmsprad / np.sqrt(1.0 - share),
        "creep_share": share,
        "creep_time_s": time_s,
    }
    return replace(vehicle, joint=joint.model_copy(update=changed)), factors


def reconstructed(seed, vehicle):
    """Flight as its analyst has it, who knows the c.g.'s offset as well as the vehicle file says, and the truth."""
    scenario = replace(dispersed.dispersed_scenario("irve2_reference", seed), vehicle=vehicle)
    with tempfile.TemporaryDirectory() as temporary:
        truth = simulate_to_folder(scenario, seed, Path(temporary) / "flight")
        telemetry = read_flight(Path(temporary) / "flight")
    rng, stated = np.random.default_rng([seed, 41, 2009]), telemetry.vehicle
    body = stated.centerbody
    offset = vehicle.cg_m[1:] + stated.uncertainty.cg_lateral_m * rng.standard_normal(2)
    lateral = (offset * stated.mass_kg / body.mass_kg).tolist()
    body = body.model_copy(update={"cg_from_datum_body_m": (body.cg_from_datum_body_m[0], *lateral)})
    return reconstruct(Flight(replace(telemetry, vehicle=replace(stated, centerbody=body)))), truth


def at_times(time_s, at_s, columns):
    return np.stack([np.interp(at_s, time_s, c) for c in columns.T], axis=-1)


def slipped(moment, width):
    """Play operator of a lateral vector: follows at a distance of at most ``width``."""
    out, at = np.zeros_like(moment), np.zeros(2)
    for k, m in enumerate(moment):
        off = m - at
        size = np.hypot(*off)
        at = m - off * min(1.0, width / size) if size > 0.0 else at
        out[k] = at
    return out


def benchmark_rows(loads, true_yz, times_s, seed):
    """Errors and sd, deg, of the benchmark frame's deflection by drawn films: two axes a film."""
    rng, rows = np.random.default_rng([seed, 23, 2009]), []
    peak_s = float(loads.time_s[np.argmax(loads.dynamic_pressure_pa)])
    frames_s = peak_s - 19.0 + 1.0 * np.arange(FRAMES)
    true = at_times(times_s, frames_s, true_yz)
    light = correlation_root(frames_s, LIGHT_TIME_S)
    for _ in range(DRAWS):
        camera = np.sqrt(CONSTANT_PART) * rng.standard_normal(2)
        camera = camera + np.sqrt(1.0 - CONSTANT_PART) * light @ rng.standard_normal((light.shape[1], 2))
        read, cov = true - true[0] + READ_SD_RAD * camera, np.tile(READ_SD_RAD**2 * np.eye(2), (FRAMES, 1, 1))
        frames = RelativeDeflections(frames_s, read, cov, np.tile(np.eye(2), (FRAMES, 1, 1)), frames_s[0])
        try:
            got = benchmark_deflection(frames, loads, PRIOR_RAD)
        except GateError:
            continue
        rows += np.rad2deg([got.theta_yz_rad - true[0], np.sqrt(np.diag(got.covariance))]).T.tolist()
    return rows


def friction_rows(loads, seed):
    """The same with dry friction of the article's size on the flight's own moment."""
    moment = joint_moment(loads).value_nm
    kept = slipped(moment, FRICTION_AT * np.linalg.norm(moment, axis=1).max())
    theta = ((1.0 - FRICTION_SHARE) * moment + FRICTION_SHARE * kept) / STATED.joint.bending_stiffness_nmprad
    return benchmark_rows(loads, theta, loads.time_s, seed)


def estimator_rows(flight, truth):
    """Errors and sd, deg, at peak pressure by method, both lateral axes."""
    answers, out = estimate(flight, ("misalignment", "trim", "fused")), {}
    for name, history in answers.histories.items():
        k = int(np.argmin(np.abs(history.time_s - flight.peak_s)))
        true = at_times(truth.time_s, history.time_s[[k]], truth.deflection.theta_yz_rad)[0]
        sd = np.sqrt(np.diag(history.lateral_cov[k]))
        out[name] = np.rad2deg([history.theta_yz_rad[k] - true, sd]).T.tolist()
    return out


def joint_rows(found, vehicle, factors, flight, truth):
    """Errors and sd of what the reconciliation estimates."""
    table = joint_table(found).set_index("quantity")
    ratio = vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()
    out = {}
    for name, true in (("bending stiffness", vehicle.joint.bending_stiffness_nmprad), ("damping ratio", ratio)):
        out[name] = [[float(np.log(table.found[name] / true)), float(table.sd[name] / table.found[name])]]
    offsets = [f"c.g. offset {axis}" for axis in "yz"]
    true = 100.0 * vehicle.cg_m[1:]
    out["offset, cm"] = [[float(table.found[n] - t), float(table.sd[n])] for n, t in zip(offsets, true, strict=True)]
    out["static stability"] = [
        [float(table.found["static stability"] - factors["cm"]), float(table.sd["static stability"])]
    ]
    if "creep share" in table.index:
        share = vehicle.joint.creep_share
        out["creep share"] = [[float(table.found["creep share"] - share), float(table.sd["creep share"])]]
        slower = 1.0 / table.found["creep time"]
        sd = float(slower**2 * table.sd["creep time"])
        out["creep settling, 1/s"] = [[float(slower - 1.0 / vehicle.joint.creep_time_s), sd]]
    history = deflection_of(found)
    k = int(np.argmin(np.abs(history.time_s - flight.peak_s)))
    true = at_times(truth.time_s, history.time_s[[k]], truth.deflection.theta_yz_rad)[0]
    sd = np.sqrt(np.diag(history.lateral_cov[k]))
    out["deflection, deg"] = np.rad2deg([history.theta_yz_rad[k] - true, sd]).T.tolist()
    return out


def scored(seed, share, time_s, kept):
    """Everything of one flight."""
    vehicle, factors = creeping(seed, share, time_s)
    flight, truth = reconstructed(seed, vehicle)
    out = {"seed": seed, "share": share, "time_s": time_s, "words": truth.remark}
    if truth.remark:
        return out
    rows = estimator_rows(flight, truth)
    loads = flight.required_loads()
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        known = (loads, truth.deflection.theta_yz_rad, truth.time_s)
        (kept / f"{seed}_{share}_{time_s}.pickle").write_bytes(pickle.dumps(known))
    rows["benchmark frame"] = benchmark_rows(loads, truth.deflection.theta_yz_rad, truth.time_s, seed)
    if share == 0.0:
        rows["benchmark frame, dry friction"] = friction_rows(loads, seed)
    largest = float(np.rad2deg(np.nanmax(truth.deflection.theta_rad)))
    out |= {"rows": rows, "largest_deg": largest}
    if "--estimators" in sys.argv:
        return out
    begun = time.process_time()
    selection = select_laws(flight, ("creep",))
    out["took_s"], out["odds"] = time.process_time() - begun, selection.log_odds["creep"]
    for name, fit in (("one stiffness", selection.compared["creep"][0]), ("selected", selection.fit)):
        rows |= {f"{name}: {k}": v for k, v in joint_rows(fit, vehicle, factors, flight, truth).items()}
        out[f"red, {name}"] = [c.code for c in credibility(fit) if not c.passed]
    return out


def report(results):
    """Table: rms error, rms of error over sd, share inside one sd, joint by joint."""
    results = [r for r in results if "rows" in r]
    names = list(dict.fromkeys(n for r in results for n in r["rows"]))
    for name in names:
        print(f"\n{name}: share, time s: rms error, rms of error over sd, inside 1 sd (n)")
        for share, time_s in dict.fromkeys((r["share"], r["time_s"]) for r in results):
            picked = [
                r["rows"][name] for r in results if (r["share"], r["time_s"]) == (share, time_s) and name in r["rows"]
            ]
            if picked:
                e, sd = np.array([row for rows in picked for row in rows]).T
                z = e / sd
                print(
                    f"  {share:4.1f} {time_s:5.0f}   {np.sqrt(np.mean(e**2)):.4f}  {np.sqrt(np.mean(z**2)):6.2f}"
                    f"  {100 * np.mean(np.abs(z) < 1):3.0f} %  ({len(z)})"
                )
    print("\nred checks with one stiffness, with what is selected; odds of creep:")
    for r in (r for r in results if "odds" in r):
        words = [r["seed"], r["share"], r["time_s"], r["red, one stiffness"], r["red, selected"]]
        words += [f"e^{r['odds']:+.1f}", f"{r['took_s']:.0f} s"]
        print(" ", *words, f"{r['largest_deg']:.1f} deg")


def option(name, other):
    return type(other)(sys.argv[sys.argv.index(name) + 1]) if name in sys.argv else other


def frames_again(folder):
    """Score the benchmark frame's deflection of kept flights."""
    results = []
    for path in sorted(folder.glob("*.pickle")):
        seed, share, time_s = path.stem.split("_")
        loads, true, times = pickle.loads(path.read_bytes())
        rows = {"benchmark frame": benchmark_rows(loads, true, times, int(seed))}
        if float(share) == 0.0:
            rows["benchmark frame, dry friction"] = friction_rows(loads, int(seed))
        results.append({"share": float(share), "time_s": float(time_s), "rows": rows})
    report(results)


def main():
    if "--frames" in sys.argv:
        frames_again(Path(option("--frames", "")))
        return
    count = int(sys.argv[1]) if len(sys.argv) > 1 and sys.argv[1].isdigit() else 3
    first, out = option("--first", 0), Path(option("--out", "/tmp/joint_memory.jsonl"))
    joints = JOINTS[slice(*(int(k) for k in option("--joints", f"0:{len(JOINTS)}").split(":")))]
    kept = Path(option("--kept", "")) if "--kept" in sys.argv else None
    results = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    done = {(r["seed"], r["share"], r["time_s"]) for r in results}
    for seed in range(first, first + count):
        for share, time_s in joints:
            if (seed, share, time_s) in done:
                continue
            one = scored(seed, share, time_s, kept)
            results.append(one)
            with out.open("a") as file:
                file.write(json.dumps(one) + "\n")
            print(seed, share, time_s, one["words"], one.get("odds"), one.get("red, one stiffness"), flush=True)
    report(results)


if __name__ == "__main__":
    main()
