"""Whose clock ticks when: order of instruments, a shift of all times, instants beside the grid of inertial samples."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel.telemetry import RadarRecord
from flightmodel.trajectory import difference, nearest_index
from recon.problem import observe
from recon.propagation import SAME_INSTANT_S
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.setup import _union

from .conftest import END, EPOCH, START, measure_radar
from .problems import build

SETTINGS = Settings(output_rate_hz=2.0, end_s=125.0, attitude_sensors=True)


def apart(one, other, relative=1e-6):
    """Largest difference of two reconstructions in standard deviations: trajectories and errors by name."""
    d = difference(one.smoothed, replace(other.smoothed, time_s=one.smoothed.time_s))
    by_state = np.abs(d / one.smoothed.sd()).max()
    a, b = (r.sensor_errors.set_index("name") for r in (one, other))
    assert set(a.index) == set(b.index)
    b = b.loc[a.index]
    assert np.allclose(a.sd, b.sd, rtol=relative)
    return max(by_state, (np.abs(a.estimate - b.estimate) / a.sd).max())


@pytest.mark.parametrize(
    ("attitude_sensors", "within"), [(False, 1e-6), pytest.param(True, 0.05, marks=pytest.mark.long)]
)
def test_order_of_instruments_does_not_matter(mini_everything, attitude_sensors, within):
    """Updates at one instant commute but for rounding, as all are linear about one state; measured 2e-9 sd.

    With attitude sensors the field is taken where the first of two radars at an instant puts the vehicle, which is
    some ten metres of the field's slope: 0.02 sd.
    """
    telemetry = mini_everything(3)
    turned = replace(
        telemetry, radars=dict(reversed(telemetry.radars.items())), gnss={"zulu": telemetry.gnss["receiver"]}
    )
    settings = replace(SETTINGS, attitude_sensors=attitude_sensors)
    one, other = reconstruct(telemetry, settings), reconstruct(turned, settings)
    assert apart(one, other, 1e-2 * within) < within
    assert len(one.residuals) == len(other.residuals)


def test_all_times_may_be_shifted(mini_everything):
    """The Earth turns with its axes, the Sun with the epoch: a flight 36 s later from an epoch 36 s earlier."""
    telemetry = mini_everything(3)
    epoch = (datetime.fromisoformat(EPOCH) - timedelta(seconds=36.0)).isoformat().replace("+00:00", "Z")

    def later(record):
        return replace(record, time_s=record.time_s + 36.0)

    shifted = replace(
        telemetry, t0_utc=epoch, accelerometer=later(telemetry.accelerometer), rates=later(telemetry.rates),
        radars={k: later(r) for k, r in telemetry.radars.items()},
        gnss={k: later(r) for k, r in telemetry.gnss.items()},
        barometers={k: later(r) for k, r in telemetry.barometers.items()}, magnetometer=later(telemetry.magnetometer),
        sun=later(telemetry.sun), attitude_prior=later(telemetry.attitude_prior),
    )  # fmt: skip
    one = reconstruct(telemetry, SETTINGS)
    other = reconstruct(shifted, replace(SETTINGS, end_s=161.0))
    assert np.allclose(other.smoothed.time_s - one.smoothed.time_s, 36.0, atol=1e-9)
    assert apart(one, other) < 1e-4  # times of 1e2 s round at 1e-14 s, at 2 km/s
    assert np.array_equal(one.residuals.accepted, other.residuals.accepted)


@pytest.fixture(scope="module")
def jittered(mini_truth, mini_sense):
    """Radars whose points come when they please, one of them for a part of the flight only."""

    def make(seed):
        telemetry, _ = mini_sense(seed)
        rng = np.random.default_rng(seed)
        radars = {}
        for radar, first in zip(telemetry.radars.values(), (START, START + 9.0), strict=True):
            t = np.sort(rng.uniform(first, END - 2.0, 300))
            t = t[np.diff(t, prepend=-1.0) > 1e-4]
            z, _ = measure_radar(mini_truth, radar.spec, t, rng)
            radars[radar.spec.name] = RadarRecord(radar.spec, t, z)
        return replace(telemetry, radars=radars)

    return make


def test_every_measurement_stands_at_its_own_instant(jittered):
    problem = build(jittered(1), end_s=150.0)
    counted = sum(
        ((i.time_s >= problem.time_s[0]) & (i.time_s <= problem.time_s[-1])).sum() for i in problem.instruments
    )
    assert len(problem.row) == counted
    for number, instrument in enumerate(problem.instruments):
        mine = problem.observed.source == number
        assert np.abs(problem.time_s[problem.node[mine]] - instrument.time_s[problem.row[mine]]).max() < SAME_INSTANT_S
        assert np.array_equal(problem.observed.value[mine], instrument.value[problem.row[mine]])
    # nodes lie between inertial samples, and the motion has them all
    assert np.array_equal(problem.motion.time_s[problem.node_index], problem.time_s)
    assert (np.diff(problem.motion.time_s) > 0.0).all()
    inside = np.diff(problem.node_index)
    assert (inside == 1).any()
    assert (inside > 3).any()


def test_instants_beside_the_grid_err_as_they_claim(jittered, mini_truth):
    values = []
    for seed in range(6):
        r = reconstruct(jittered(seed + 40), Settings(output_rate_hz=3.7))
        d = difference(r.smoothed, mini_truth.trajectory(r.smoothed.time_s))
        solved = np.linalg.solve(r.smoothed.covariance, d[..., None])[..., 0]
        values.append(np.einsum("ni,ni->n", d, solved)[[15, 90, 180, -1]])
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 9 * 6) / 6
    mean = np.mean(values, axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean


def test_near_instants_are_one_node_and_none_is_lost():
    """Instants in a chain, each near the next: the last is far from the first and must not vanish."""
    chain = 10.0 + 1.5e-6 * np.arange(7)
    nodes = _union([np.array([9.0, 10.0, 11.0]), chain, np.array([10.5, 10.5 + 1e-7])])
    assert np.diff(nodes).min() > SAME_INSTANT_S
    assert np.abs(nodes[nearest_index(nodes, chain)] - chain).max() <= SAME_INSTANT_S
    assert len(nodes) == 3 + 1 + 3


def test_measurements_off_the_nodes_are_left_out(mini_sense):
    problem = build(mini_sense(1)[0])
    some = problem.time_s[::3]
    observed, rows = observe(some, problem.instruments)
    assert 0 < len(rows) < len(problem.row)
    assert observed.first[-1] == len(rows)
    assert (np.diff(observed.first) >= 0).all()


def test_points_at_the_first_and_last_instant_are_used(mini_sense):
    telemetry, _ = mini_sense(1)
    problem = build(telemetry, end_s=112.0)
    assert problem.time_s[0] == START
    assert np.isclose(problem.time_s[-1], 112.0)
    per_node = np.diff(problem.observed.first)
    assert per_node[0] == 2
    assert per_node[-1] == 2


def test_thinning_keeps_a_point_of_each_source_and_a_node_of_every_step(mini_everything):
    telemetry = mini_everything(1)
    north = telemetry.radars["north"]
    keep = (north.time_s < 103.0) | (north.time_s > 108.0)
    gap = RadarRecord(north.spec, north.time_s[keep], north.range_az_el[keep])
    problem = build(replace(telemetry, radars={"north": gap}, gnss={}), output_rate_hz=20.0)
    thinned, kept = problem.thinned(0.5)
    assert kept[0] == 0
    assert np.array_equal(thinned.time_s, problem.time_s[kept])
    assert np.array_equal(thinned.node_index, problem.node_index[kept])
    for number, instrument in enumerate(thinned.instruments):
        mine = thinned.observed.source == number
        times = instrument.time_s[thinned.row[mine]]
        assert np.allclose(thinned.time_s[thinned.node[mine]], times, atol=SAME_INSTANT_S)
        whole = problem.time_s[problem.node[problem.observed.source == number]]
        assert len(times) == len(np.unique(np.floor(times / 0.5))) == len(np.unique(np.floor(whole / 0.5)))
    assert np.diff(thinned.time_s).max() <= 1.0
    assert not thinned.kept.any()
    assert thinned.motion is problem.motion
