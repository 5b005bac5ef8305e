"""The paper's studies of the joint: damping at 2.5 Hz (Figure 3.1), stiffness at 0.5 % (Figures 3.2 and 3.3).

The scenario is flown on one day with the joints of the paper's Table 3.1, side by side, and once with the joint locked,
the paper's "No CFE". The paper's curves are pictures; what it says of them in words is put beside what is found here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from flightmodel.airdata import peak_pressure, pressure_pulse
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from postflight.studies import table_3_1
from synthetic_flight import packing
from synthetic_flight.day_air import day_atmosphere
from synthetic_flight.dispersed_ensemble import legs
from synthetic_flight.dispersions import Window
from synthetic_flight.ensemble import Start, fly_legs
from synthetic_flight.outputs import Records, records_of
from synthetic_flight.scenarios import Scenario, child_rng, initial_state
from synthetic_flight.step_size import check_step

BEFORE_S, AFTER_S, RECORD_S = 20.0, 20.0, 0.02
MEAN_HALF_WINDOW_S = 1.5  # two periods of the aerodynamic mode to both sides of the peak
LATER_S = (10.0, 20.0)  # after the peak: supersonic, where the bare airframe is unstable at small angles
LOCKED = "locked (No CFE)"


@dataclass(frozen=True)
class JointFlight:
    """One flight of a study: angle of attack and normal acceleration of the centerbody, deflection, ``(n,)``."""

    label: str
    time_s: FloatArray
    alpha_total_deg: FloatArray
    normal_g: FloatArray
    deflection_deg: FloatArray
    pressure_pa: FloatArray
    diverged: bool


@dataclass(frozen=True)
class JointStudy:
    """Flights of a study; the first has its joint locked. ``table`` has one row a flight, ``paper`` one a claim."""

    flights: tuple[JointFlight, ...]
    table: pd.DataFrame
    paper: pd.DataFrame
    peak_s: float


def damping_study(scenario: Scenario, seed: int) -> JointStudy:
    """Fly the damping of Figure 3.1: 0.5 to 20 % of critical at 2.5 Hz, on the day that ``seed`` draws."""
    stiffness = float({hz: k for hz, k, _ in table_3_1.PAPER_STIFFNESS}[table_3_1.STUDY_HZ])
    joints = [(f"{100 * ratio:g} %", stiffness, float(c)) for ratio, c in table_3_1.PAPER_DAMPING]
    flights, peak_s = _fly(scenario, seed, joints)
    table = _table(flights, peak_s)
    later = dict(zip(table["joint"], table["alpha_later_mean_deg"], strict=True))
    rises = {name: later[name] - mean for name, mean in zip(table["joint"], table["alpha_mean_deg"], strict=True)}
    above = [f"{100 * r:g} %" for r, _ in table_3_1.PAPER_DAMPING if r > 0.01]
    words = f"mean angle of attack {LATER_S[0]:g} to {LATER_S[1]:g} s after peak pressure less that at the peak, deg"
    claims = [
        ("locked joint: the angle rises after 440 s", "rises", rises[LOCKED], rises[LOCKED] > 0.0, words),
        (
            "damping above 1 %: the angle at the peak has grown against the locked joint",
            "grows",
            min(table.set_index("joint")["alpha_mean_deg"][above]) - table["alpha_mean_deg"][0],
            bool(min(table.set_index("joint")["alpha_mean_deg"][above]) > table["alpha_mean_deg"][0]),
            "smallest difference of the means at the peak, deg",
        ),
        (
            "damping above 1 %: the angle does not rise after 440 s",
            "does not rise",
            max(rises[name] for name in above),
            max(rises[name] for name in above) <= 0.0,
            f"largest of: {words}",
        ),
    ]
    return JointStudy(flights, table, _claims(claims), peak_s)


def stiffness_study(scenario: Scenario, seed: int) -> JointStudy:
    """Fly the stiffness of Figures 3.2 and 3.3: 2 to 4 Hz at 0.5 % of critical, on the day that ``seed`` draws."""
    joints = [(f"{hz:g} Hz", float(k), float(c)) for hz, k, c in table_3_1.PAPER_STIFFNESS]
    flights, peak_s = _fly(scenario, seed, joints)
    table = _table(flights, peak_s)
    by = table.set_index("joint")
    tuned, locked = by.loc["2.5 Hz"], by.loc[LOCKED]
    excursion = float(tuned["alpha_mean_deg"] - locked["alpha_mean_deg"])
    ratio = float(tuned["normal_peak_g"] / locked["normal_peak_g"])
    claims = [
        ("2.5 Hz: deflection near 4 deg", "4", tuned["deflection_mean_deg"],
         bool(3.5 <= tuned["deflection_mean_deg"] <= 4.5), "mean at the peak, deg; 3.5 to 4.5 is taken as near"),
        ("2.5 Hz: excursion of the angle of attack as in flight", "4 to 5", excursion, bool(4.0 <= excursion <= 5.0),
         "mean at the peak less the locked joint's, deg; the paper's is over the median of a Monte Carlo"),
        ("2.5 Hz: normal acceleration as in flight, more than twice the rigid bound", "> 2", ratio, ratio > 2.0,
         "peak over the locked joint's own; the paper's is over the 97.7 % of a Monte Carlo"),
    ]  # fmt: skip
    return JointStudy(flights, table, _claims(claims), peak_s)


def _claims(rows: list[tuple[Any, ...]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["claim", "paper", "ours", "agrees", "measured_as"])


def _with_joint(vehicle: Vehicle, stiffness: float, damping: float) -> Vehicle:
    # the paper's damper is isotropic
    joint = {
        "bending_stiffness_nmprad": stiffness,
        "bending_damping_nmsprad": damping,
        "torsion_damping_nmsprad": damping,
    }
    return replace(vehicle, joint=vehicle.joint.model_copy(update=joint))


def _fly(
    scenario: Scenario, seed: int, joints: list[tuple[str, float, float]]
) -> tuple[tuple[JointFlight, ...], float]:
    """Fly a locked joint, then the given ones, through the pulse of the locked flight."""
    time = scenario.spec.time
    table = packing.atmosphere_table(day_atmosphere(scenario.spec.atmosphere, child_rng(seed, "atmosphere")))
    state = initial_state(scenario)
    first = max(time.start_s, time.inflated_s or time.start_s)
    peak_s = _pressure_peak(scenario, Start(state, packing.parameter_vector(scenario.vehicle), table), first)
    window = Window(
        from_s=max(first, peak_s - BEFORE_S), to_s=min(time.stop_s, peak_s + AFTER_S + 5.0), record_s=RECORD_S
    )
    vehicles = [_with_joint(scenario.vehicle, k, c) for _, k, c in joints]
    out = []
    for locked, names, flown in ((True, [LOCKED], [scenario.vehicle]), (False, [j[0] for j in joints], vehicles)):
        plan = legs(time, window, locked)
        for vehicle in () if locked else flown:
            check_step(vehicle, plan[-1].step_s)
        starts = [Start(state, packing.parameter_vector(v), table) for v in flown]
        for name, vehicle, one in zip(
            names, flown, fly_legs(scenario.vehicle, list(range(len(flown))), starts, plan), strict=True
        ):
            out.append(_kept(name, window, records_of(one, vehicle, table), one.diverged))
    return tuple(out), peak_s


def _pressure_peak(scenario: Scenario, start: Start, from_s: float) -> float:
    window = Window(from_s=from_s, to_s=scenario.spec.time.stop_s, record_s=0.1)
    (flown,) = fly_legs(scenario.vehicle, [0], [start], legs(scenario.spec.time, window, True))
    return peak_pressure(
        window.from_s + window.record_s * np.arange(len(flown.aux), dtype=np.float64), flown.aux[:, 3]
    )[0]


def _kept(label: str, window: Window, records: Records, diverged: bool) -> JointFlight:
    time_s = window.from_s + window.record_s * np.arange(len(records.aux), dtype=np.float64)
    bent, pressure = np.rad2deg(records.aux[:, 5]), records.aux[:, 3]
    return JointFlight(label, time_s, records.alpha_total_deg, records.normal_g, bent, pressure, diverged)


def _table(flights: tuple[JointFlight, ...], peak_s: float) -> pd.DataFrame:
    """Means around the locked flight's peak pressure, largest values in its pulse, means after it, one row a flight."""
    pulse = flights[0].time_s[pressure_pulse(flights[0].pressure_pa)]
    rows = []
    for f in flights:
        near = np.abs(f.time_s - peak_s) <= MEAN_HALF_WINDOW_S
        inside = (f.time_s >= pulse[0]) & (f.time_s <= pulse[-1])
        later = (f.time_s >= peak_s + LATER_S[0]) & (f.time_s <= peak_s + LATER_S[1])
        whole = f.time_s[-1] >= peak_s + LATER_S[1]
        rows.append(
            {
                "joint": f.label,
                "alpha_mean_deg": _mean(f.alpha_total_deg[near]),
                "alpha_peak_deg": float(f.alpha_total_deg[inside].max()),
                "alpha_later_mean_deg": _mean(f.alpha_total_deg[later]) if whole else np.nan,
                "normal_mean_g": _mean(f.normal_g[near]),
                "normal_peak_g": float(f.normal_g[inside].max()),
                "deflection_mean_deg": _mean(f.deflection_deg[near]),
                "deflection_peak_deg": float(f.deflection_deg[inside].max()),
                "tumbled_s": float(f.time_s[np.argmax(f.alpha_total_deg > 90.0)])
                if f.alpha_total_deg.max() > 90.0
                else np.nan,
                "ended_s": float(f.time_s[-1]) if f.diverged else np.nan,
            }
        )
    return pd.DataFrame(rows)


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else np.nan


def histories(study: JointStudy) -> pd.DataFrame:
    """Angle of attack, normal acceleration and deflection of every flight over time, for a file."""
    parts = [
        pd.DataFrame(
            {
                "joint": f.label,
                "time_s": np.round(f.time_s, 6),
                "alpha_total_deg": f.alpha_total_deg,
                "normal_g": f.normal_g,
                "deflection_deg": f.deflection_deg,
            }
        )
        for f in study.flights
    ]
    return pd.concat(parts, ignore_index=True)
