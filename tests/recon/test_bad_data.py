"""Telemetry as an unlucky range delivers it: is each fault found and named, and survived with honest uncertainty?

One flight of the flexible simulator through the pulse, its telemetry files spoilt in one way at a time: sensors that
freeze or stop at their range, radars on a side lobe, losses, clocks that are off or jump, blocks of rows that come
twice, swapped or stale. Only the scores know the truth. Three questions to each fault:

- Is it named? A finding of the source covers the time of the fault, or, where the fault lasts throughout, a fault
  hypothesis names the source; or the flight is refused in words that do.
- Is it survived? At epochs half a second apart no component is further from the truth than `FARTHEST_SD`, and NEES of
  position, velocity and attitude stay below its chi-square quantile, over all epochs together (Bonferroni).
- What does it cost? Behind the fault and beside it standard deviations are near those of the unspoilt flight.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from flightmodel.checks import GateError, Issue
from flightmodel.flightfolder import read_flight
from recon.fault_isolation import isolate_faults
from recon.reconstruct import reconstruct
from recon.settings import Settings
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

from .dispersed import scored

SEED = 11
FROM_S, TO_S, STEP_S = 390.0, 468.0, 0.5
COAST_S, LATER_S = 300.0, 474.0  # where the scenario's own record begins; a longer record's end
PEAK_S, QUIET_S = 440.5, 400.0  # of dynamic pressure; before the pulse
SETTINGS = Settings(output_rate_hz=10.0)
GROUPS = (slice(0, 3), slice(3, 6), slice(6, 9))
EPOCHS = int((TO_S - FROM_S) / STEP_S)
# of one flight in a thousand by chance, were all epochs and components independent (they are not, so it is rarer)
FARTHEST_SD = float(norm.isf(0.5e-3 / (9 * EPOCHS)))
MOST_NEES = float(chi2.isf(1e-3 / (3 * EPOCHS), 3))
SETTLED_S = 5.0  # after a fault, until its cost is asked for
ISLAND, MAINLAND = "wallops_island", "wallops_mainland"
FILES = {"accelerometer": "accelerometer.csv", "rates": "rates.csv"}
FILES |= {radar: f"radar_{radar}.csv" for radar in (ISLAND, MAINLAND)}


@dataclass(frozen=True)
class Fault:
    """One way to spoil the tables.

    ``source`` is who should be named, ``share`` how much of the span its findings should cover; a fault without a span
    lasts throughout. ``during`` and ``after`` bound the growth of standard deviations (position; anything after).
    ``record`` is from when to when there is telemetry.
    """

    name: str
    spoil: Callable[[dict[str, pd.DataFrame]], None]
    span_s: tuple[float, float] | None = None
    source: str = ""
    share: float = 0.5
    without: str = ""
    during: float = 3.0
    after: float = 1.5
    often: bool = False  # looked at by every `make test`
    record: tuple[float, float] = (FROM_S, TO_S)


# ------------------------------------------------------------------------------------------------- ways to spoil


def rows(table: pd.DataFrame, start: float, end: float) -> np.ndarray:
    t = table["t_s"].to_numpy()
    return np.flatnonzero((t >= start) & (t < end))


def frozen(source, columns, start, end):
    def spoil(tables):
        table = tables[source]
        k = rows(table, start, end)
        for c in columns:
            table.iloc[k, 1 + c] = table.iat[k[0], 1 + c]

    return spoil


def clipped(source, column, part):
    def spoil(tables):
        values = tables[source].iloc[:, 1 + column]
        most = part * values.abs().max()
        tables[source].iloc[:, 1 + column] = values.clip(-most, most)

    return spoil


def moved(source, column, by, start=-np.inf, end=np.inf, blind=""):
    """Values of a span are off; another radar sees nothing meanwhile."""

    def spoil(tables):
        table = tables[source]
        table.iloc[rows(table, start, end), 1 + column] += by
        if blind:
            lost([blind], start, end)(tables)

    return spoil


def lost(sources, start, end):
    def spoil(tables):
        for s in sources:
            tables[s] = tables[s].drop(index=rows(tables[s], start, end)).reset_index(drop=True)

    return spoil


def late(sources, by, after=-np.inf):
    def spoil(tables):
        for s in [sources] if isinstance(sources, str) else sources:
            t = tables[s]["t_s"]
            tables[s]["t_s"] = (t + by * (t >= after)).round(6)

    return spoil


def reordered(source, order):
    """Rows of two seconds from the peak in another order, or some of them twice."""

    def spoil(tables):
        table = tables[source]
        k = rows(table, PEAK_S, PEAK_S + 2.0)
        before, after = np.arange(k[0]), np.arange(k[-1] + 1, len(table))
        tables[source] = table.iloc[np.concatenate([before, ORDERS[order](k), after])].reset_index(drop=True)

    return spoil


ORDERS = {
    "first again": lambda k: np.concatenate([k[: len(k) // 2], k]),
    "swapped": lambda k: np.concatenate([k[len(k) // 2 :], k[: len(k) // 2]]),
    # where time tags are those of delivery: one second twice, the next one never
    "stale": lambda k: np.concatenate([k[: len(k) // 2], k[: len(k) - len(k) // 2]]),
    "shuffled": np.random.default_rng(0).permutation,
}


def tagged_on_delivery(source, order):
    """As `reordered`, but the tags stay in order."""

    def spoil(tables):
        t = tables[source]["t_s"].to_numpy()
        reordered(source, order)(tables)
        tables[source]["t_s"] = t

    return spoil


def turned(axis, degrees):
    """The accelerometer is mounted otherwise than flight.toml says."""

    def spoil(tables):
        turn = Rotation.from_rotvec(np.deg2rad(degrees) * np.eye(3)[axis])
        tables["accelerometer"].iloc[:, 1:4] = turn.apply(tables["accelerometer"].iloc[:, 1:4].to_numpy(copy=True))

    return spoil


def at(middle, length):
    return middle - 0.5 * length, middle + 0.5 * length


SHORT, PEAK_2, PEAK_3, PEAK_5, PEAK_10, PEAK_30 = (at(PEAK_S, s) for s in (0.5, 2.0, 3.0, 5.0, 10.0, 30.0))
JUMP = PEAK_S, PEAK_S + 0.02
QUIET_5, QUIET_10, BEHIND_5, END_5 = at(QUIET_S, 5.0), at(QUIET_S, 10.0), at(445.0, 5.0), at(460.0, 5.0)
FIRST_10, REST = (FROM_S, FROM_S + 10.0), (PEAK_S, TO_S + 1.0)
NEXT_1, SECOND_1, NEXT_2 = (PEAK_S, PEAK_S + 1.0), (PEAK_S + 1.0, PEAK_S + 2.0), (PEAK_S, PEAK_S + 2.0)
ALONE = {"during": 40.0, "after": 5.0}  # where inertial sensors alone carry the flight through
BOTH, ALL = ["accelerometer", "rates"], list(FILES)
P, Q, R, X, Z, RANGE, AZ, EL = 0, 1, 2, 0, 2, 0, 1, 2

# what inertial sensors lost is learnt anew from the radars
gyros, forces = (partial(Fault, source=name, after=5.0) for name in BOTH[::-1])
island, mainland = (partial(Fault, source=name) for name in (ISLAND, MAINLAND))
FAULTS = [
    Fault("nothing", lambda _: None, often=True),
    gyros("q frozen 0.05 s", frozen("rates", [Q], *at(PEAK_S, 0.05)), at(PEAK_S, 0.05)),
    gyros("q frozen 0.5 s", frozen("rates", [Q], *SHORT), SHORT),
    gyros("q frozen 2 s", frozen("rates", [Q], *PEAK_2), PEAK_2, often=True),
    gyros("gyros frozen 10 s", frozen("rates", [P, Q, R], *PEAK_10), PEAK_10),
    gyros("gyros frozen 10 s in the quiet", frozen("rates", [P, Q, R], *QUIET_10), QUIET_10),
    gyros("p at its stop throughout", clipped("rates", P, 0.6), (FROM_S, TO_S)),
    gyros("q clipped at 60 %", clipped("rates", Q, 0.6), (457.0, 466.0), share=0.1),
    gyros("q off by 1 deg/s for 2 s", moved("rates", Q, 1.0, *PEAK_2), PEAK_2),
    forces("all axes frozen 2 s", frozen("accelerometer", [0, 1, 2], *PEAK_2), PEAK_2),
    forces("z clipped at 60 %", clipped("accelerometer", Z, 0.6), (432.3, 449.2)),
    forces("z clipped at 95 %", clipped("accelerometer", Z, 0.95), (437.8, 442.9), often=True),
    forces("x clipped at 60 %", clipped("accelerometer", X, 0.6), (436.8, 445.0), share=0.2),
    forces("z off by 1 m/s2 for 2 s", moved("accelerometer", Z, 1.0, *PEAK_2), PEAK_2),
    island("lobe 3 s, other blind", moved(ISLAND, EL, 1.0, *PEAK_3, MAINLAND), PEAK_3, often=True),
    island("lobe 10 s, other sees", moved(ISLAND, EL, 1.0, *PEAK_10), PEAK_10, often=True),
    island("lobe at the start, other sees", moved(ISLAND, EL, 1.0, *FIRST_10), FIRST_10),
    mainland("lobe from the peak on, other sees", moved(MAINLAND, EL, 1.0, *REST), REST),
    island("5 km off for 30 s, other sees", moved(ISLAND, RANGE, 5e3, *PEAK_30), PEAK_30),
    island("lobe 10 s, other blind", moved(ISLAND, EL, 1.0, *PEAK_10, MAINLAND), PEAK_10, **ALONE),
    island("lobe 30 s, other blind", moved(ISLAND, EL, 1.0, *PEAK_30, MAINLAND), PEAK_30, **ALONE),
    mainland("lobe 30 s, no other", moved(MAINLAND, EL, 1.0, *PEAK_30), PEAK_30, without=ISLAND, **ALONE),
    island("1 km off 10 s, no other", moved(ISLAND, RANGE, 1e3, *PEAK_10), PEAK_10, without=MAINLAND, **ALONE),
    gyros("all lost in the quiet", lost(ALL, *QUIET_5), QUIET_5),
    gyros("all lost at the peak", lost(ALL, *PEAK_5), PEAK_5, often=True),
    gyros("all lost behind the peak", lost(ALL, *BEHIND_5), BEHIND_5),
    forces("accelerometer lost", lost(["accelerometer"], *PEAK_5), PEAK_5),
    gyros("gyros lost 10 s", lost(["rates"], *PEAK_10), PEAK_10),
    # 5 s behind such a gap trackers have not brought back what was lost: cost can be asked where 12 are left
    forces("both triads lost near the end", lost(BOTH, *END_5), END_5, record=(FROM_S, LATER_S)),
    # two clocks contradict each other and nothing tells which is wrong: the answer covers both
    island("radar 20 ms late", late(ISLAND, 0.02), often=True, during=6.0),
    # 78 s tell a lone radar's clock against the accelerometer's to 6 ms, with the coast before them to 3
    island("lone radar 20 ms late", late(ISLAND, 0.02), without=MAINLAND, record=(COAST_S, TO_S), **ALONE),
    forces("accelerometer 20 ms late", late("accelerometer", 0.02)),
    gyros("gyros 20 ms early", late("rates", -0.02), often=True),
    forces("force clock jumps 20 ms ahead", late("accelerometer", 0.02, PEAK_S), JUMP, often=True),
    gyros("gyro clock jumps 20 ms ahead", late("rates", 0.02, PEAK_S), JUMP),
    gyros("one clock of both jumps 20 ms ahead", late(BOTH, 0.02, PEAK_S), JUMP),
    forces("20 ms lost", lost(["accelerometer"], *JUMP), JUMP),
    forces("force clock jumps back 0.1 s", late("accelerometer", -0.1, PEAK_S), (PEAK_S - 0.1, PEAK_S), often=True),
    gyros("gyro clock jumps back 5 s", late("rates", -5.0, PEAK_S), (PEAK_S - 5.0, PEAK_S), often=True),
    forces("block twice", reordered("accelerometer", "first again"), NEXT_1, after=1.01),
    gyros("blocks swapped", reordered("rates", "swapped"), NEXT_1, after=1.01, often=True),
    island("rows shuffled", reordered(ISLAND, "shuffled"), NEXT_2, after=1.01),
    island("stale block of a radar", tagged_on_delivery(ISLAND, "stale"), SECOND_1),
    gyros("swapped, tagged on delivery", tagged_on_delivery("rates", "swapped"), NEXT_2),
    forces("stale, tagged on delivery", tagged_on_delivery("accelerometer", "stale"), SECOND_1),
    forces("mount wrong by 1.5 deg about x", turned(0, 1.5)),
    forces("mount wrong by 3 deg about y", turned(1, 3.0)),
]

# ------------------------------------------------------------------------------------------------- what came of it


class Outcome(NamedTuple):
    """A reconstruction with its errors, NED and body axes, over their standard deviations."""

    hypotheses: tuple[Issue, ...]
    findings: tuple[Issue, ...]
    time_s: np.ndarray
    normalised: np.ndarray
    sd: np.ndarray
    nees: np.ndarray


class Flight:
    """The unspoilt flight, its truth, and what came of it spoilt, each flown once."""

    def __init__(self, folder: Path, from_s: float = FROM_S, to_s: float = TO_S) -> None:
        scenario = read_scenario("irve2_reference")
        time = scenario.spec.time.model_copy(update={"telemetry_from_s": from_s, "stop_s": to_s})
        prior = scenario.spec.attitude_prior.model_copy(update={"t_s": from_s})
        spec = scenario.spec.model_copy(update={"time": time, "attitude_prior": prior, "video": None})
        self.truth = simulate_to_folder(replace(scenario, spec=spec), SEED, folder / "clean")
        pressure = self.truth.dynamic_pressure_pa
        assert abs(self.truth.time_s[np.argmax(pressure)] - PEAK_S) < 0.5, "faults are to lie at the peak"
        self.folder, self.done = folder, {}
        self.tables = {s: pd.read_csv(folder / "clean" / "telemetry" / file) for s, file in FILES.items()}

    def outcome(self, fault: Fault) -> Outcome | None:
        """What came of it; None where it was refused in words that name the source."""
        if fault.name not in self.done:
            self.done[fault.name] = self.fly(fault)
        found = self.done[fault.name]
        assert not isinstance(found, str) or fault.source in found
        return None if isinstance(found, str) else found

    def fly(self, fault: Fault) -> Outcome | str:
        tables = {s: table.copy() for s, table in self.tables.items()}
        fault.spoil(tables)
        folder = self.folder / re.sub(r"\W+", "_", fault.name)
        shutil.copytree(self.folder / "clean", folder, ignore=shutil.ignore_patterns("truth"))
        if fault.without:
            toml = folder / "flight.toml"
            toml.write_text(re.sub(rf"\[radars\.{fault.without}\][^\[]*", "", toml.read_text()))
        for source, table in tables.items():
            if not table.equals(self.tables[source]):
                table.to_csv(folder / "telemetry" / FILES[source], index=False, float_format="%.10g")
        try:
            telemetry = read_flight(folder)
            bet = reconstruct(telemetry, SETTINGS)
        except GateError as refusal:
            return str(refusal).replace(str(folder), "")
        t = bet.smoothed.time_s
        epochs = t[(t > t[0] + 3.0) & (t < t[-1] - 0.2)][:: int(STEP_S * SETTINGS.output_rate_hz)]
        error, covariance = scored(bet.smoothed, self.truth.trajectory, epochs - 1e-6)
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        parts = [(error[:, g], covariance[:, g, g]) for g in GROUPS]
        nees = [np.einsum("ni,ni->n", e, np.linalg.solve(p, e[..., None])[..., 0]) for e, p in parts]
        words, findings = isolate_faults(bet.consistency_checks, bet.left_out), (*telemetry.findings, *bet.findings)
        return Outcome(words, findings, epochs, error / sd, sd, np.column_stack(nees))


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Flight whose record begins and ends at a time."""
    return cache(lambda from_s, to_s: Flight(tmp_path_factory.mktemp("bad_data"), from_s, to_s))


every_fault = pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=[pytest.mark.long] if not f.often else [], id=f.name) for f in FAULTS]
)


@every_fault
def test_named(record, fault):
    outcome = record(*fault.record).outcome(fault)
    if outcome is None:
        return
    if not fault.source:
        assert not outcome.hypotheses
        assert not outcome.findings
    elif fault.span_s is None:
        assert any(fault.source in h.sources for h in outcome.hypotheses)
    else:
        instants, inside = np.linspace(*fault.span_s, 1000), np.zeros(1000, dtype=bool)
        for f in (f for f in outcome.findings if f.source == fault.source):
            inside |= (instants >= f.start_s - 0.1) & (instants <= f.end_s + 0.1)
        assert inside.mean() >= fault.share


@every_fault
def test_survived(record, fault, record_property):
    outcome = record(*fault.record).outcome(fault)
    if outcome is None:
        return
    worst = [float(np.abs(outcome.normalised[:, g]).max()) for g in GROUPS]
    record_property("position, velocity, attitude error over sd", " ".join(f"{z:.1f}" for z in worst))
    assert max(worst) < FARTHEST_SD
    assert outcome.nees.max() < MOST_NEES


@every_fault
def test_costs_no_more_than_it_must(record, fault):
    outcome, clean = (record(*fault.record).outcome(f) for f in (fault, FAULTS[0]))
    if outcome is None:
        return
    start, end = fault.span_s or fault.record
    grown = outcome.sd / np.column_stack([np.interp(outcome.time_s, clean.time_s, sd) for sd in clean.sd.T])
    during = (outcome.time_s >= start) & (outcome.time_s <= end)
    if during.any():
        assert grown[during, :3].max() < fault.during
    after = outcome.time_s > end + SETTLED_S
    if after.any():
        assert np.median(grown[after], axis=0).max() < fault.after
