"""Telemetry as an unlucky range delivers it: is each fault found and named, and survived with honest uncertainty?

One flight of the flexible simulator from the quiet before the pulse to behind it, its telemetry spoilt in one way at a
time: sensors that freeze or stop at their range, radars on a side lobe, losses, clocks that are off or jump, blocks
of rows that come twice, swapped or stale. The truth is opened by the scores alone. Three questions to each fault:

- Is it named? A finding of the source covers the time of the fault, or, where the fault lasts throughout, a suspect's
  sentence names the source; or the flight is refused in words that do.
- Is it survived? At epochs half a second apart no component is further from the truth than `FARTHEST_SD`, and NEES of
  position, velocity and attitude stay below its chi-square quantile, over all epochs together (Bonferroni).
- What does it cost? Behind the fault and beside it standard deviations are near those of the unspoilt flight.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2, norm

from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from recon.bet import Reconstruction, Settings, reconstruct
from recon.suspects import suspects
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

from .dispersed import scored
from .spoilt import (
    FILES,
    FROM_S,
    ISLAND,
    LATE_S,
    MAINLAND,
    PEAK_S,
    QUIET_S,
    TO_S,
    Tables,
    clipped,
    first_again,
    frozen,
    late,
    lost,
    moved,
    reordered,
    shuffled,
    stale,
    swapped,
    tagged_on_delivery,
    turned,
)  # fmt: skip

SEED = 11
STEP_S = 0.5
SETTINGS = Settings(output_rate_hz=10.0)
GROUPS = (slice(0, 3), slice(3, 6), slice(6, 9))
EPOCHS = int((TO_S - FROM_S) / STEP_S)
# of one flight in a thousand by chance, were all epochs and components independent (they are not, so it is rarer)
FARTHEST_SD = float(norm.isf(0.5e-3 / (9 * EPOCHS)))
MOST_NEES = float(chi2.isf(1e-3 / (3 * EPOCHS), 3))
SETTLED_S = 5.0  # after a fault, until its cost is asked for

# why a fault is not yet named, survived or cheap
NO_SHOCK = "nothing looks for a jump of velocity or attitude at one time"
NO_CLOCK = "triads have no error of their time tags"
OWN_CLOCK = "one radar tells little of its own clock, so a sheet that is twenty times too good is believed"
RESET = "the rows after a clock that was set back are used with their wrong times"
ONE_SIDED = "a bridge over a clipped peak misses to one side, eight peaks in a row"
NO_AFTER = "behind the gap too little of the flight is left to bring the attitude back"


@dataclass(frozen=True)
class Fault:
    """One way to spoil the tables.

    ``source`` is who should be named, ``share`` how much of ``start_s`` to ``end_s`` its findings should cover; a fault
    without times lasts throughout. ``during`` and ``after`` bound the growth of standard deviations (position during,
    anything after). The last three hold the reason why a question is not yet answered with yes.
    """

    name: str
    spoil: Callable[[Tables], None]
    source: str
    span_s: tuple[float, float] | None = None
    share: float = 0.5
    without: str = ""
    during: float = 3.0
    after: float = 1.5
    slow: bool = True
    not_yet: dict[str, str] = field(default_factory=dict)


def at(middle, length):
    return middle - 0.5 * length, middle + 0.5 * length


PEAK_2, PEAK_5, PEAK_10, PEAK_30 = (at(PEAK_S, s) for s in (2.0, 5.0, 10.0, 30.0))
SHORT, QUIET_5, QUIET_10, LATE_5 = at(PEAK_S, 0.5), at(QUIET_S, 5.0), at(QUIET_S, 10.0), at(LATE_S, 5.0)
END_5 = at(460.0, 5.0)
DELIVERED = (PEAK_S, PEAK_S + 2.0)
BOTH, ALL = ["accelerometer", "rates"], list(FILES)
P, Q, R, X, Z, RANGE, AZ, EL = 0, 1, 2, 0, 2, 0, 1, 2


def yet(survived="", named="", cost=""):
    return {k: v for k, v in (("survived", survived), ("named", named), ("cost", cost)) if v}


def inertial(name, spoil, source, span_s=None, after=5.0, **more):
    return Fault(name, spoil, source, span_s, after=after, **more)


FAULTS = [
    Fault("nothing", lambda _: None, "", slow=False),
    # gyros
    inertial("q frozen 0.05 s", frozen("rates", [Q], *at(PEAK_S, 0.05)), "rates", at(PEAK_S, 0.05)),
    inertial("q frozen 0.5 s", frozen("rates", [Q], *SHORT), "rates", SHORT),
    inertial("p frozen 2 s", frozen("rates", [P], *PEAK_2), "rates", PEAK_2),
    inertial("q frozen 2 s", frozen("rates", [Q], *PEAK_2), "rates", PEAK_2, slow=False),
    inertial("gyros frozen 10 s", frozen("rates", [P, Q, R], *PEAK_10), "rates", PEAK_10),
    inertial("gyros frozen 10 s in the quiet", frozen("rates", [P, Q, R], *QUIET_10), "rates", QUIET_10),
    inertial("p at its stop throughout", clipped("rates", P, 0.6), "rates", (FROM_S, TO_S)),
    inertial("q clipped at 60 %", clipped("rates", Q, 0.6), "rates", (457.0, 466.0), share=0.1),
    inertial(
        "q off by 1 deg/s for 2 s",
        moved("rates", Q, 1.0, *PEAK_2),
        "rates",
        PEAK_2,
        not_yet=yet(NO_SHOCK, cost=NO_SHOCK),
    ),
    # accelerometer
    inertial("all axes frozen 0.5 s", frozen("accelerometer", [0, 1, 2], *SHORT), "accelerometer", SHORT),
    inertial("all axes frozen 2 s", frozen("accelerometer", [0, 1, 2], *PEAK_2), "accelerometer", PEAK_2),
    inertial("z clipped at 60 %", clipped("accelerometer", Z, 0.6), "accelerometer", (432.3, 449.2)),
    inertial("z clipped at 80 %", clipped("accelerometer", Z, 0.8), "accelerometer", (434.9, 446.1)),
    inertial("z clipped at 95 %", clipped("accelerometer", Z, 0.95), "accelerometer", (437.8, 442.9), slow=False),
    inertial(
        "x clipped at 60 %",
        clipped("accelerometer", X, 0.6),
        "accelerometer",
        (436.8, 445.0),
        share=0.2,
        not_yet=yet(ONE_SIDED),
    ),
    inertial(
        "z off by 1 m/s2 for 2 s",
        moved("accelerometer", Z, 1.0, *PEAK_2),
        "accelerometer",
        PEAK_2,
        not_yet=yet(NO_SHOCK, NO_SHOCK),
    ),
    # side lobes and range jumps
    Fault(
        "lobe 3 s, other blind", moved(ISLAND, EL, 1.0, *at(PEAK_S, 3.0), MAINLAND), ISLAND, at(PEAK_S, 3.0), slow=False
    ),
    Fault("lobe 10 s, other sees", moved(ISLAND, EL, 1.0, *PEAK_10), ISLAND, PEAK_10),
    Fault("lobe of 3 deg 10 s, other sees", moved(MAINLAND, EL, 3.0, *PEAK_10), MAINLAND, PEAK_10),
    Fault("lobe 30 s, other sees", moved(MAINLAND, AZ, 1.0, *PEAK_30), MAINLAND, PEAK_30),
    Fault("5 km off for 30 s, other sees", moved(ISLAND, RANGE, 5e3, *PEAK_30), ISLAND, PEAK_30),
    Fault("lobe 10 s, other blind", moved(ISLAND, EL, 1.0, *PEAK_10, MAINLAND), ISLAND, PEAK_10, slow=False),
    Fault(
        "lobe 30 s, no other",
        moved(MAINLAND, EL, 1.0, *PEAK_30),
        MAINLAND,
        PEAK_30,
        without=ISLAND,
        during=40.0,
        after=5.0,
    ),
    Fault(
        "1 km off for 10 s, no other",
        moved(ISLAND, RANGE, 1e3, *PEAK_10),
        ISLAND,
        PEAK_10,
        without=MAINLAND,
        during=20.0,
        after=3.0,
    ),
    # losses
    inertial("all lost in the quiet", lost(ALL, *QUIET_5), "rates", QUIET_5),
    inertial("all lost at the peak", lost(ALL, *PEAK_5), "rates", PEAK_5, slow=False),
    inertial("all lost behind the pulse", lost(ALL, *LATE_5), "rates", LATE_5),
    inertial("accelerometer lost", lost(["accelerometer"], *PEAK_5), "accelerometer", PEAK_5),
    inertial("gyros lost", lost(["rates"], *PEAK_5), "rates", PEAK_5),
    inertial("gyros lost 10 s", lost(["rates"], *PEAK_10), "rates", PEAK_10),
    inertial("both triads lost near the end", lost(BOTH, *END_5), "accelerometer", END_5, not_yet=yet(cost=NO_AFTER)),
    # clocks
    Fault("radar 20 ms late", late(ISLAND, 0.02), ISLAND, slow=False, during=6.0),  # either clock may be wrong
    Fault("lone radar 20 ms late", late(ISLAND, 0.02), ISLAND, without=MAINLAND, not_yet=yet(OWN_CLOCK, OWN_CLOCK)),
    inertial("accelerometer 20 ms late", late("accelerometer", 0.02), "accelerometer", not_yet=yet(NO_CLOCK, NO_CLOCK)),
    inertial("gyros 20 ms early", late("rates", -0.02), "rates", not_yet=yet(NO_CLOCK, NO_CLOCK)),
    inertial(
        "accelerometer's clock jumps 20 ms ahead",
        late("accelerometer", 0.02, PEAK_S),
        "accelerometer",
        at(PEAK_S + 0.01, 0.02),
        not_yet=yet(NO_CLOCK),
    ),
    inertial(
        "accelerometer's clock jumps back 0.1 s",
        late("accelerometer", -0.1, PEAK_S),
        "accelerometer",
        (PEAK_S - 0.1, PEAK_S),
        slow=False,
        not_yet=yet(RESET),
    ),
    inertial("gyros' clock jumps back 5 s", late("rates", -5.0, PEAK_S), "rates", (PEAK_S - 5.0, PEAK_S), slow=False),
    # rows
    inertial(
        "block twice", reordered("accelerometer", first_again), "accelerometer", (PEAK_S, PEAK_S + 1.0), after=1.01
    ),
    inertial("blocks swapped", reordered("rates", swapped), "rates", (PEAK_S, PEAK_S + 1.0), after=1.01, slow=False),
    Fault("rows shuffled", reordered(ISLAND, shuffled), ISLAND, DELIVERED, after=1.01),
    Fault("stale block of a radar", tagged_on_delivery(ISLAND, stale), ISLAND, (PEAK_S + 1.0, PEAK_S + 2.0)),
    inertial(
        "swapped, tagged on delivery",
        tagged_on_delivery("rates", swapped),
        "rates",
        DELIVERED,
        not_yet=yet(NO_SHOCK, NO_SHOCK, NO_SHOCK),
    ),
    inertial(
        "stale, tagged on delivery",
        tagged_on_delivery("accelerometer", stale),
        "accelerometer",
        (PEAK_S + 1.0, PEAK_S + 2.0),
        not_yet=yet(NO_SHOCK, NO_SHOCK),
    ),
    # a wrong mount
    inertial("mount wrong by 1.5 deg about x", turned(0, 1.5), "accelerometer"),
    inertial("mount wrong by 3 deg about y", turned(1, 3.0), "accelerometer"),
]


# ------------------------------------------------------------------------------------------------- what came of it


@dataclass(frozen=True)
class Outcome:
    """A reconstruction with its errors, NED and body axes, over their standard deviations; or the words of refusal."""

    refusal: str
    bet: Reconstruction | None = None
    findings: tuple = ()
    time_s: np.ndarray = field(default_factory=lambda: np.empty(0))
    normalised: np.ndarray = field(default_factory=lambda: np.empty((0, 9)))
    sd: np.ndarray = field(default_factory=lambda: np.empty((0, 9)))
    nees: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


class Flight:
    """The unspoilt flight, its truth, and what came of it spoilt; each fault is flown once."""

    def __init__(self, folder: Path) -> None:
        scenario = read_scenario("irve2_reference")
        time = scenario.spec.time.model_copy(update={"telemetry_from_s": FROM_S, "stop_s": TO_S})
        prior = scenario.spec.attitude_prior.model_copy(update={"t_s": FROM_S})
        spec = scenario.spec.model_copy(update={"time": time, "attitude_prior": prior, "video": None})
        self.truth = simulate_to_folder(replace(scenario, spec=spec), SEED, folder / "clean")
        self.folder, self.done = folder, {}
        self.toml = (folder / "clean" / "flight.toml").read_text()
        self.tables = {s: pd.read_csv(folder / "clean" / "telemetry" / file) for s, file in FILES.items()}

    def outcome(self, fault: Fault) -> Outcome:
        if fault.name not in self.done:
            self.done[fault.name] = self.fly(fault)
        return self.done[fault.name]

    def fly(self, fault: Fault) -> Outcome:
        tables = {s: table.copy() for s, table in self.tables.items()}
        fault.spoil(tables)
        folder = self.folder / re.sub(r"\W+", "_", fault.name)
        (folder / "telemetry").mkdir(parents=True)
        toml = re.sub(rf"\[radars\.{fault.without}\][^\[]*", "", self.toml) if fault.without else self.toml
        (folder / "flight.toml").write_text(toml)
        air = "telemetry/atmosphere.csv"
        (folder / air).write_bytes((self.folder / "clean" / air).read_bytes())
        for s, table in tables.items():
            table.round({"t_s": 6}).to_csv(folder / "telemetry" / FILES[s], index=False, float_format="%.10g")
        try:
            telemetry = read_flight(folder)
            bet = reconstruct(telemetry, SETTINGS)
        except GateError as refusal:
            return Outcome(str(refusal))
        t = bet.smoothed.time_s
        epochs = t[(t > t[0] + 3.0) & (t < t[-1] - 0.2)][:: int(STEP_S * SETTINGS.output_rate_hz)]
        error, covariance = scored(bet.smoothed, self.truth.trajectory, epochs - 1e-6)
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        parts = [(error[:, g], covariance[:, g, g]) for g in GROUPS]
        nees = [np.einsum("ni,ni->n", e, np.linalg.solve(p, e[..., None])[..., 0]) for e, p in parts]
        findings = (*telemetry.findings, *bet.findings)
        return Outcome("", bet, findings, epochs, error / sd, sd, np.column_stack(nees))


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return Flight(tmp_path_factory.mktemp("bad_data"))


def asked(question):
    """All faults, with the marks that this question puts on them."""
    out = []
    for fault in FAULTS:
        marks = [pytest.mark.slow] if fault.slow else []
        if question in fault.not_yet:
            marks.append(pytest.mark.xfail(strict=True, reason=fault.not_yet[question]))
        out.append(pytest.param(fault, marks=marks, id=fault.name))
    return out


@pytest.mark.parametrize("fault", asked("named"))
def test_named(flight, fault):
    outcome = flight.outcome(fault)
    if outcome.refusal:
        assert fault.source in outcome.refusal
        return
    words = suspects(outcome.bet.verdicts, outcome.bet.left_out)
    if not fault.source:
        assert not words
        assert not outcome.findings
    elif fault.span_s is None:
        assert any(fault.source in w for w in words)
    else:
        start, end = fault.span_s
        inside = np.zeros(1000, dtype=bool)
        instants = np.linspace(start, end, len(inside))
        for f in outcome.findings:
            if f.source == fault.source:
                inside |= (instants >= f.start_s - 0.1) & (instants <= f.end_s + 0.1)
        assert inside.mean() >= fault.share


@pytest.mark.parametrize("fault", asked("survived"))
def test_survived(flight, fault, record_property):
    outcome = flight.outcome(fault)
    if outcome.refusal:
        return
    worst = [float(np.abs(outcome.normalised[:, g]).max()) for g in GROUPS]
    record_property("position, velocity, attitude error over sd", " ".join(f"{z:.1f}" for z in worst))
    assert max(worst) < FARTHEST_SD
    assert outcome.nees.max() < MOST_NEES


@pytest.mark.parametrize("fault", asked("cost"))
def test_costs_no_more_than_it_must(flight, fault):
    outcome, clean = flight.outcome(fault), flight.outcome(FAULTS[0])
    if outcome.refusal:
        return
    start, end = fault.span_s or (FROM_S, TO_S)
    grown = outcome.sd / np.column_stack([np.interp(outcome.time_s, clean.time_s, sd) for sd in clean.sd.T])
    during = (outcome.time_s >= start) & (outcome.time_s <= end)
    if during.any():
        assert grown[during, :3].max() < fault.during
    after = outcome.time_s > end + SETTLED_S
    if after.any():
        assert np.median(grown[after], axis=0).max() < fault.after


def test_peak_is_where_the_faults_are(flight):
    assert flight.truth.time_s[np.argmax(flight.truth.dynamic_pressure_pa)] == pytest.approx(PEAK_S, abs=0.5)
