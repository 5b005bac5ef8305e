"""Is the joint found, and do its intervals hold? Dispersed flights of a joint that the fit does not know.

Run: ``python benchmarks/reconciliation.py [FLIGHTS] [--first SEED] [--bent]`` (30 flights), or with ``--hardening
SHARE`` or ``--freeplay DEG``. Plain joints fly the wide flights of `tests.wide_flights`: spin to 60 rpm, joints of 1 to
50 kN m/rad (every eighth locked, of which a true lower bound is wanted), vehicles of 60 to 400 kg; with ``--bent``
joints that give way by 4 to 25 deg. Stated is the reference vehicle's joint whatever flies. Printed are errors, their
rms over the stated standard deviation, and the shares inside one and two; fits with a failed consistency check are
counted, and scored with the others.

With ``--hardening`` the spring's slope is by that share steeper at 4 deg, with ``--freeplay`` the joint has so much of
it; 0 flies plain joints. These flights are nearer to the reference vehicle: stiffness up to half above the stated one,
damping ratio, size and side of the c.g.'s offset, masses, stations, inertias, coefficients, start, spin, air, the
sounding's and every instrument's errors in the sizes that vehicle file and data sheets state. Then each flight is asked
for the law (`postflight.reconciliation.fit`), and printed are the odds and the law's effect: the flight is flown once
more with a plain joint and all else equal, and the difference of the two histories of deflection, over the standard
deviation of the plain fit's, is largest so much in the pulse. A slight hardening is mostly another stiffness, so what
the plain *fit* of the same flight misses is counted as well.

The stiffness by the joint's frequency alone is scored beside the fit's. No video. Some 20 s of processor time a flight.
"""

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.flight import Flight
from postflight.reconciliation.command import Reconciliation, credibility
from postflight.reconciliation.fit import select_laws
from postflight.reconciliation.posterior import deflection_of, joint_table, stiffness_bound
from postflight.reconstruction import reconstruct
from synthetic_flight.folder import simulate_to_folder
from tests.recon import dispersed
from tests.wide_flights import flown, wide_flight

STATED = vehicle_from_toml(vehicle_path("irve2_reference"))
AT_RAD = np.deg2rad(4.0)
SURE, FELT_SD = 3.0, 3.0  # odds of twenty to one; an effect that must be recognised


def flown_vehicle(seed, hardening=0.0, freeplay_deg=0.0):
    """Vehicle as it is."""
    rng = np.random.default_rng([seed, 7, 2009])
    vehicle = dispersed.dispersed_vehicle(STATED, rng)
    body, known = vehicle.centerbody, STATED.uncertainty
    clock, size = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.002, 0.005)
    lateral = size * vehicle.mass_kg / body.mass_kg * np.array([-np.cos(clock), np.sin(clock)])
    moved = body.model_copy(update={"cg_from_datum_body_m": (body.cg_from_datum_body_m[0], *map(float, lateral))})
    factors = {k: 1.0 + getattr(known, k) * rng.standard_normal() for k in ("ca", "cn", "cm")}
    aero = vehicle.aero.scaled(**factors, cmq_shift=known.cmq * rng.standard_normal())
    stiffness = STATED.joint.bending_stiffness_nmprad * rng.uniform(1.0, 1.5)
    ratio = 0.005 * np.exp(0.5 * rng.standard_normal())
    changed = {
        "bending_stiffness_nmprad": float(stiffness),
        "hardening_nmprad3": hardening * stiffness / 3.0 / AT_RAD**2,
        "freeplay_deg": freeplay_deg,
    }
    vehicle = replace(vehicle, centerbody=moved, aero=aero, joint=vehicle.joint.model_copy(update=changed))
    damping = {"bending_damping_nmsprad": float(ratio * vehicle.critical_damping_nmsprad())}
    return replace(vehicle, joint=vehicle.joint.model_copy(update=damping)), factors


def reconstructed(seed, vehicle):
    """Flight as its analyst has it, and the truth."""
    scenario = replace(dispersed.dispersed_scenario("irve2_reference", seed), vehicle=vehicle)
    with tempfile.TemporaryDirectory() as temporary:
        truth = simulate_to_folder(scenario, seed, Path(temporary) / "flight")
        telemetry = read_flight(Path(temporary) / "flight")
    return reconstruct(Flight(telemetry)), truth


def wide(seed):
    """Flight as its analyst has it, and the truth; vehicle as it is and its coefficients' factors."""
    one = wide_flight(seed, bent="--bent" in sys.argv)
    with tempfile.TemporaryDirectory() as temporary:
        telemetry, truth = flown(one, Path(temporary) / "flight")
    return reconstruct(Flight(telemetry)), truth, one.flown, one.factors


def errors(found, vehicle, factors):
    """Error and sd of log stiffness, log damping ratio, offset y and z in cm, static stability."""
    table = joint_table(found).set_index("quantity")
    ratio = vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()
    out = []
    for name, true in (("bending stiffness", vehicle.joint.bending_stiffness_nmprad), ("damping ratio", ratio)):
        out += [np.log(table.found[name] / true), table.sd[name] / table.found[name]]
    for axis, name in enumerate(("c.g. offset y", "c.g. offset z")):
        out += [table.found[name] - 100.0 * vehicle.cg_m[1 + axis], table.sd[name]]
    return [*out, table.found["static stability"] - factors["cm"], table.sd["static stability"]]


def modal_errors(flight, vehicle, fit):
    """Error and sd of the log stiffness by the joint's frequency; NaN where the mode is not seen."""
    try:
        found = Reconciliation(flight, fit).modal_stiffness()
    except GateError as fault:
        print(f"  {fault}")
        return [np.nan, np.nan]
    true = vehicle.joint.bending_stiffness_nmprad
    return [np.log(found.stiffness_nmprad / true), found.sd_nmprad / found.stiffness_nmprad]


def effects_sd(plain, truth, other):
    """Largest differences in the pulse, in sd of the plain fit's deflection: from a flight without the law, and of the
    plain fit from the flight.
    """
    bent = deflection_of(plain)
    with_law, without = (np.interp(bent.time_s, t.time_s, t.deflection.theta_rad) for t in (truth, other))
    return [float(np.nanmax(np.abs(with_law - x) / bent.theta_sd_rad)) for x in (without, bent.theta_rad)]


def option(name):
    return float(sys.argv[sys.argv.index(name) + 1]) if name in sys.argv else None


def print_laws(asked, odds, effects):
    """Count of the decisions, and of those where the law's effect must be recognised."""
    for name, of_law in zip(asked, np.array(odds).T, strict=False):
        sure = of_law > SURE
        print(f"{name}: log odds above {SURE:g} in {sure.sum()} of {len(sure)}")
        for words, effect in zip(("its effect", "what the plain fit misses"), np.array(effects).T, strict=True):
            felt = effect > FELT_SD
            print(f"  where {words} is above {FELT_SD:g} sd: in {(sure & felt).sum()} of {felt.sum()}")


def print_coverage(rows):
    """Errors and what the intervals hold; of locked joints only the bounds."""
    a = np.array(rows)
    names = "log stiffness", "log damping ratio", "offset y cm", "offset z cm", "static stability", "by the frequency"
    for k, name in enumerate(names):
        known = np.isfinite(a[:, 2 * k])
        if not known.any():
            print(f"{name:18} no flight")
            continue
        e, z = a[known, 2 * k], a[known, 2 * k] / a[known, 2 * k + 1]
        inside = ", ".join(f"{100 * np.mean(np.abs(z) < s):.0f} % inside {s} sd" for s in (1, 2))
        rms = f"rms {np.sqrt(np.mean(e**2)):.4f} bias {e.mean():+.4f}, rms of z {np.sqrt(np.mean(z**2)):.2f}"
        print(f"{name:18} {len(e)} flights, {rms}, {inside}")


def law_words(selection, asked, seed, truth, law, odds, effects):
    """Add one flight's odds and effects to the lists; return them in words."""
    odds.append([selection.log_odds[name] for name in asked])
    other = reconstructed(seed, flown_vehicle(seed)[0])[1] if any(law.values()) else truth
    effects.append(effects_sd(selection.compared[asked[0]][0], truth, other))
    listed = ", ".join(f"{name} {value:+.1f}" for name, value in selection.log_odds.items())
    equal, missed = effects[-1]
    words = f", log odds of {listed}, effect {equal:.1f} sd, missed by the plain fit {missed:.1f} sd"
    if "freeplay" in selection.fit.problem.vehicle_parameters.laws:
        got = joint_table(selection.fit).set_index("quantity").loc["freeplay"]
        words += f", freeplay {got.found:.4f} +/- {got.sd:.4f} deg"
    return words


def main():
    size = {law: option(f"--{law}") for law in ("hardening", "freeplay")}
    asked = tuple(law for law, value in size.items() if value is not None)
    law = {"hardening": size["hardening"] or 0.0, "freeplay_deg": size["freeplay"] or 0.0}
    count = int(sys.argv[1]) if len(sys.argv) > 1 and sys.argv[1].isdigit() else 30
    first = int(option("--first") or 0)
    rows, odds, effects, red = [], [], [], 0
    for seed in range(first, first + count):
        if asked:
            vehicle, factors = flown_vehicle(seed, **law)
            flight, truth = reconstructed(seed, vehicle)
        else:
            flight, truth, vehicle, factors = wide(seed)
        if truth.remark:
            print(f"{seed}: {truth.remark}; left out", flush=True)
            continue
        begun = time.process_time()
        selection = select_laws(flight, asked)
        took, found = time.process_time() - begun, selection.fit
        words = f"{seed}: {found.steps} steps{'' if found.converged else ' (not converged)'}, {took:.0f} s"
        failed = [each.code for each in credibility(found) if not each.passed]
        red += bool(failed)
        words += f", failed: {' '.join(failed)}" if failed else ""
        if asked:
            words += law_words(selection, asked, seed, truth, law, odds, effects)
        bound, true = stiffness_bound(found), vehicle.joint.bending_stiffness_nmprad
        if bound is not None:
            words += f", stiffness above {bound:.0f} N m/rad ({'true' if true > bound else 'FALSE'}: {true:.0f})"
        row = [*errors(found, vehicle, factors), *modal_errors(flight, vehicle, found)]
        if bound is not None:
            row[:4] = [np.nan] * 4
        rows.append(row)
        largest = np.rad2deg(np.nanmax(truth.deflection.theta_rad))
        ratios = np.round(np.array(rows[-1]).reshape(-1, 2), 3).tolist()
        print(f"{words}, deflection up to {largest:.1f} deg, errors / sd {ratios}", flush=True)
    print_coverage(rows)
    print(f"{red} of {len(rows)} fits fail a consistency check")
    print_laws(asked, odds, effects)


if __name__ == "__main__":
    main()
