"""Reruns with one input left out or changed: what must not move, what must, and how far data may move it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel.checks import GateError
from postflight import sensitivity as module
from postflight.flight import Flight, read_flight
from postflight.reconstruction import reconstruct, reconstruction_from
from postflight.sensitivity import COLUMNS, UNITS, largest_of_groups, reruns, sensitivity
from recon.estimate import estimate
from recon.fault_isolation import Adaptation
from recon.settings import Settings


@pytest.fixture(scope="module")
def short(clean_flight):
    return reconstruct(read_flight(clean_flight.root))


@pytest.fixture(scope="module")
def table(short):
    return sensitivity(short)


@pytest.fixture(scope="module")
def pulse(mini_flight):
    """Two radars and inertial sensors through a pulse of 8 g."""
    telemetry = replace(mini_flight(3), gnss={}, barometers={}, magnetometer=None, sun=None)
    return reconstruction_from(Flight(telemetry), estimate(telemetry, Settings(output_rate_hz=5.0)))


def rows(table, rerun):
    return table[table.rerun == rerun].set_index("quantity")


def test_every_source_and_assumption_has_its_rows(short, table):
    names = ["without north", "without south", "winds off", "density +1 sd", "density -1 sd", "mass +1 %", "mass -1 %"]
    assert list(dict.fromkeys(table.rerun)) == names
    assert tuple(table.columns) == COLUMNS
    assert set(rows(table, "winds off").index) <= set(UNITS)
    assert (table.reason == "").all()


def test_air_and_mass_move_what_is_derived_and_not_the_trajectory(pulse):
    """With inertial sensors; the sizes follow from q = rho V^2 / 2 and C_A = m a / (q S)."""
    table = sensitivity(pulse)
    inertial = [name for name in UNITS if name.startswith(("position", "velocity", "rotation", "altitude"))]
    for rerun in ("winds off", "density +1 sd", "mass -1 %"):
        assert np.abs(rows(table, rerun).loc[inertial, "largest_change"]).max() < 1e-9
    heavy = rows(table, "mass +1 %")
    assert heavy.loc["C_A", "change"] == pytest.approx(0.01 * heavy.loc["C_A", "base"], rel=1e-9)
    assert heavy.loc["dynamic pressure", "change"] == 0.0
    dense = rows(table, "density +1 sd")
    k = int(np.argmin(np.abs(pulse.air.time_s - dense.t_s.iloc[0])))
    grown = np.expm1(pulse.air.air.density_sd[k])
    # the sd is itself interpolated along altitude
    assert dense.loc["dynamic pressure", "change"] == pytest.approx(
        grown * dense.loc["dynamic pressure", "base"], rel=2e-2
    )
    assert rows(table, "winds off").loc["Mach number", "change"] != 0.0


def test_the_only_tracker_is_refused_and_the_rest_goes_on(short):
    telemetry = replace(short.telemetry, radars={"north": short.telemetry.radars["north"]})
    found = sensitivity(reconstruct(Flight(telemetry), Settings()))
    lone = found[found.rerun == "without north"]
    assert len(lone) == 1
    assert lone["quantity"].isna().all()
    with pytest.raises(GateError) as refusal:
        estimate(telemetry, Settings(without=("north",)))
    assert lone.reason.iloc[0] == str(refusal.value)
    assert "without north" not in set(largest_of_groups(found).rerun)
    assert len(rows(found, "winds off")) > 5


def test_a_rerun_that_diverges_is_a_row_with_its_reason(pulse, monkeypatch):
    def fails(telemetry, settings, adaptation):
        raise GateError("left the atmosphere")

    monkeypatch.setattr(module, "estimate", fails)
    found = sensitivity(pulse)
    assert list(found[found.quantity.isna()].rerun) == ["without north", "without west"]
    assert set(found[found.quantity.isna()].reason) == {"left the atmosphere"}


def test_attitude_sensors_are_used_where_they_were_not_and_left_out_where_they_were(mini_flight):
    telemetry = mini_flight(1)
    names = {r.name: r for r in reruns(telemetry, Settings())}
    assert names["with attitude sensors"].settings.attitude_sensors
    assert names["without attitude prior"].telemetry.attitude_prior is None
    assert {"without receiver", "without barometer", "without north"} <= set(names)
    used = {r.name: r for r in reruns(telemetry, Settings(attitude_sensors=True, without=("north",)))}
    assert used["without Sun sensors"].settings.without == ("north", "sun1", "sun2", "sun3", "sun4")
    assert used["without magnetometer"].data == -1
    assert "with attitude sensors" not in used
    assert "without north" not in used


@pytest.mark.long
def test_leaving_data_out_moves_the_answer_as_far_as_the_covariances_allow(mini_flight):
    """Change over ``sqrt(P_without - P_with)`` is standard normal: its mean square over flights is chi-square."""
    settings, count = Settings(output_rate_hz=5.0), 8
    squares: dict[tuple[str, str], list[float]] = {}
    for seed in range(count):
        telemetry = replace(mini_flight(seed), gnss={})
        flight = reconstruction_from(Flight(telemetry), estimate(telemetry, settings))
        found = sensitivity(flight)
        for row in found[found.change_over_expected_sd.notna()].itertuples():
            squares.setdefault((row.rerun, row.quantity), []).append(row.change_over_expected_sd**2)
    direct = {k: v for k, v in squares.items() if k[1] not in module.DERIVED or k[1] == "altitude"}
    kept = {k: v for k, v in direct.items() if len(v) == count}
    assert {r for r, _ in kept} == {"without north", "without west", "with attitude sensors"}
    # 25 quantities, many of them alike: 1e-4 each way
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], count) / count
    mean = {k: np.mean(v) for k, v in kept.items()}
    assert all(low < m < high for m in mean.values()), mean
    pooled = np.mean(list(mean.values()))
    # flights are independent, quantities of one are not: the mean scatters at most as that of one quantity
    assert low < pooled < high


@pytest.mark.slow
def test_command_writes_table_and_figure(command, flight):
    done = command("reconstruct", flight.root, "--sensitivity")
    assert done.returncode == 0, done.stderr
    (run,) = (flight.root / "runs").iterdir()
    assert (run / "sensitivity.csv").read_text().startswith("rerun,quantity,unit,t_s,base")
    assert (run / "figures" / "sensitivity.png").stat().st_size > 10_000
    assert "winds off" in done.stdout


def test_reruns_start_from_the_base_s_adaptation(pulse, monkeypatch):
    """A base with a wide prior less a rerun with a narrow one would be a difference of priors."""
    adaptation = Adaptation({"accelerometer scale x": 0.05}, ())
    base = replace(pulse, solution=replace(pulse.solution, adaptation=adaptation))
    seen = []

    def spy(telemetry, settings, adaptation):
        seen.append(adaptation)
        return estimate(telemetry, settings, adaptation=adaptation)

    monkeypatch.setattr(module, "estimate", spy)
    found = sensitivity(base)
    assert seen == [adaptation, adaptation]
    wide = rows(found, "without north")
    narrow = rows(sensitivity(pulse), "without north")
    assert wide.loc["velocity down", "change"] != narrow.loc["velocity down", "change"]
