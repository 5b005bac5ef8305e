"""The trajectory as a product: columns as documented, sds as drawn errors scatter, the frames as they are named."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flightmodel import airdata, earth, rotations
from flightmodel.atmosphere import standard_atmosphere
from flightmodel.trajectory import Trajectory
from postflight import run_folder
from postflight.deflections import Deflections
from postflight.flight import read_flight
from postflight.reconstruction import bet_table, reconstruct

DOCS = Path(__file__).parents[2] / "docs" / "bet-product.md"


@pytest.fixture(scope="module")
def short(clean_flight):
    """The hand-made flight: ten seconds, no physics asked."""
    flight = reconstruct(read_flight(clean_flight.root))
    return flight, bet_table(flight)


def documented() -> list[str]:
    """Columns of the table under ``## `bet.csv` `` in order."""
    section = DOCS.read_text().split("## `bet.csv`")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


def test_page_names_exactly_the_columns(short) -> None:
    names = documented()
    assert len(names) == len(set(names))
    columns = set(short[1].columns)
    assert set(names) == {name for name in columns if "_sd" not in name or name.replace("_sd", "") not in columns}
    # as the page says: an sd each
    known = {name.replace("_sd", "") for name in columns if "_sd" in name}
    without = {"t_s", "wind_n_mps", "wind_e_mps", *(f"q{axis}_ecef_body" for axis in "wxyz")}
    assert {name for name in names if "_sd" not in name} - known == without


def test_columns_agree_with_each_other(short) -> None:
    table = short[1]
    r = table[["rx_ecef_m", "ry_ecef_m", "rz_ecef_m"]].to_numpy()
    eci = table[["rx_eci_m", "ry_eci_m", "rz_eci_m"]].to_numpy()
    assert np.allclose(np.linalg.norm(r, axis=1), np.linalg.norm(eci, axis=1))
    v = table[["vx_eci_mps", "vy_eci_mps", "vz_eci_mps"]].to_numpy()
    assert np.allclose(np.linalg.norm(v, axis=1), table.speed_inertial_mps)
    # the derivative of position in inertial axes is the velocity there
    t = table.t_s.to_numpy()
    k = np.arange(5, 15)
    slope = (eci[k + 1] - eci[k - 1]) / (t[k + 1] - t[k - 1])[:, None]
    assert np.abs(slope - v[k]).max() < 2.0
    assert np.allclose(table.mach * np.sqrt(1.4 * 287.0529 * table.t_k), table.airspeed_mps, rtol=1e-5)
    assert np.allclose(0.5 * table.rho_kgpm3 * table.airspeed_mps**2, table.dynamic_pressure_pa)


def test_euler_angles_turn_ned_into_body() -> None:
    yaw, pitch, roll = 0.4, -1.2, 2.5
    one, zero = np.array([1.0, 0.0, 0.0]), np.zeros
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        turn = zero(3)
        turn[axis] = angle
        q = rotations.multiply(q, rotations.exp(turn))
    assert one @ rotations.dcm_from_q(q) @ one == pytest.approx(np.cos(pitch) * np.cos(yaw))
    found = airdata.euler_321(rotations.dcm_from_q(q)[None])
    assert [x[0] for x in found] == pytest.approx([roll, pitch, yaw])


def test_standard_deviations_are_the_scatter_of_drawn_errors() -> None:
    """Four thousand draws of one state and its air: every sd within 8 % of the scatter (its own four sd)."""
    rng = np.random.default_rng(0)
    n = 4000
    position = earth.ecef_from_geodetic(0.65, -1.3, 45e3)
    velocity = earth.ecef_from_ned(np.array([300.0, 500.0, 900.0]), position)
    nose = np.array([0.25, 0.55, 0.8])
    x = earth.ecef_from_ned(nose / np.linalg.norm(nose), position)
    y = np.cross(x, [0.3, 0.1, 0.9])
    y /= np.linalg.norm(y)
    q = rotations.q_from_dcm(np.column_stack([x, y, np.cross(x, y)])[None])[0]
    random = rng.standard_normal((9, 9)) * np.repeat([3.0, 0.2, 2e-3], 3)[:, None]
    covariance = random @ random.T
    error = rng.multivariate_normal(np.zeros(9), covariance, n)
    omega = np.tile([0.6, 0.02, -0.03], (n, 1))
    time = np.arange(n, dtype=float)

    def path(e):
        return Trajectory(
            "2009-08-17T12:52:00Z", time, "datum", position + e[:, :3], velocity + e[:, 3:6],
            rotations.continuous(rotations.boxplus(np.tile(q, (n, 1)), e[:, 6:9])), omega,
            np.tile(covariance, (n, 1, 1)),
        )  # fmt: skip

    profile, arm = standard_atmosphere(), np.array([-0.5, 0.0, 0.0])
    value, sd = airdata.derived_with_sd(path(np.zeros((n, 9))), profile, arm)
    air = profile.at(value["altitude"])
    drawn = airdata.Inputs(
        path(error),
        air.wind_sd_mps[:, None] * rng.standard_normal((n, 2)),
        air.density_sd * rng.standard_normal(n),
        profile.temperature_sd(value["altitude"]) * rng.standard_normal(n),
    )
    scattered = airdata.derived(drawn, profile, arm)
    for name, numbers in scattered.items():
        gap = numbers - value[name]
        if airdata.is_angle(name):
            gap = np.mod(gap + np.pi, 2.0 * np.pi) - np.pi
        assert np.std(gap) == pytest.approx(sd[name][0], rel=0.08), name


def test_header_says_what_the_numbers_refer_to(short) -> None:
    head = json.loads(json.dumps(run_folder.header(short[0])))
    assert head["epoch_utc"] == "2009-08-17T12:52:00Z"
    assert head["vehicle"]["reference_area_m2"] == pytest.approx(7.0686)
    assert head["vehicle"]["mass_kg"] == pytest.approx(155.0)
    assert {s["name"] for s in head["sensors"]} == {"accelerometer", "rates", "north", "south"}
    assert head["settings"]["output_rate_hz"] == 20.0
    assert "telemetry/atmosphere.csv" in head["inputs_sha256"]
    assert head["atmosphere"]["file"] == "telemetry/atmosphere.csv"


def test_events_carry_three_standard_deviations(short) -> None:
    flight, table = short
    events = run_folder.event_table(flight, table)
    row = events.iloc[0]
    k = int((table.t_s - row.t_s).abs().argmin())
    assert row.alt_3sd_m == pytest.approx(3.0 * table.alt_sd_m[k], rel=0.05)
    assert "mach_3sd" in events.columns


def test_peak_is_one_number_in_events_peaks_and_summary(short) -> None:
    flight, table = short
    rows = run_folder.event_table(flight, table)
    event = rows[rows["event"].str.contains("dynamic pressure")].iloc[0]
    peak = run_folder.peak_table(flight, table).set_index("peak").loc["dynamic pressure"]
    summary = run_folder.summary(flight, Deflections(), rows)
    assert event.t_s == peak.t_s == summary["peak_dynamic_pressure_s"] == flight.peak_s
    assert event.dynamic_pressure_pa == peak.value == summary["peak_dynamic_pressure_pa"]
    assert event.dynamic_pressure_3sd_pa == pytest.approx(3.0 * peak.sd, rel=1e-12)
    assert event.alpha_total_wind_deg == summary["alpha_total_wind_deg"]
    # between the records, so that a sample instead of the interpolated value would show
    assert (table.t_s - flight.peak_s).abs().min() > 1e-4
    assert event.dynamic_pressure_pa >= table.dynamic_pressure_pa.max() * (1.0 - 1e-9)


def test_residual_statistics_count_every_point(short) -> None:
    flight, _ = short
    stats = run_folder.residual_statistics(flight)
    assert stats["count"].sum() == len(flight.solution.residuals)
    assert stats.edited.sum() == (~flight.solution.residuals.accepted).sum()


def test_statistics_of_white_residuals_are_one_and_none() -> None:
    rng = np.random.default_rng(2)
    n = 2000
    part = pd.DataFrame(
        {
            "time_s": np.arange(n), "source": "north", "component": "range", "residual": 5.0 * rng.standard_normal(n),
            "predicted_sd": 5.0, "accepted": np.arange(n) % 100 != 0,
        }
    )  # fmt: skip
    bet = type("Bet", (), {"residuals": part, "consistency_checks": ()})()
    row = run_folder.residual_statistics(type("Flight", (), {"solution": bet})()).iloc[0]
    assert (row["count"], row.edited, row.unit) == (n, 20, "m")
    assert row.rms_normalised == pytest.approx(1.0, abs=0.06)
    assert abs(row.lag1) < 0.09
    assert row.sd == pytest.approx(5.0, abs=0.3)


def test_covariance_is_whole_once_a_second(short) -> None:
    slow = run_folder.slow_covariance(short[0])
    assert slow["covariance"].shape[1:] == (9, 9)
    assert 9 <= len(slow["t_s"]) <= 11
