"""Published answers to linear problems, through the flight's own filter and smoothers.

A local level is the wandering bias of a barometer on a flight that is known to a picometre: what it reads beside the
predicted height is the series. A trend has a slope and takes the first two kinematic errors (`linear`). The answers
start exactly diffuse; ours start after the first points that determine the state, conditioned by hand, or are the
limit of wide priors. The files' sumPtt is not the covariance after a point (of a level it is half of it): at the last
point, where it must, it does not equal the smoothed one, which ours does.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flightmodel import earth
from recon.kalman import forward, smooth
from recon.linearise import Steps
from recon.measurements import HEIGHT, SLOTS, Instrument
from recon.problem import Observed, Problem, observe
from recon.propagation import propagate, strapdown_motion
from recon.settings import ENGINES
from recon.state import Block, ErrorModel, States, Wander, unpacked
from tests.oracles import bryson_frazier

from . import linear
from .one_node import height

DATA = Path(__file__).parents[1] / "data" / "kalman"
KNOWN_SD = 1e-12
BIAS = 18


def known_flight(count):
    """Motion of a free fall with a node each second, its start and its heights."""
    t = np.arange(float(count))
    still = np.zeros((count, 3))
    motion = strapdown_motion(t, still, still, still, still, np.eye(3), np.eye(3))
    place = earth.ecef_from_geodetic(-0.5, 0.3, 2e5)
    start = States(place, place / np.linalg.norm(place) * 400.0, np.array([1.0, 0, 0, 0]), np.zeros(BIAS + 1))
    heights, state = [], start
    for k in range(count):
        heights.append(height(state))
        if k < count - 1:
            state = propagate(motion, k, k + 1, state).state
    return motion, start, np.array(heights)


def level_problem(series, noise_var, walk_var, mean, variance):
    """Local level as a barometer's bias that walks; NaN is missing."""
    count = len(series)
    motion, start, heights = known_flight(count)
    model = ErrorModel(
        (
            Block("all", tuple("abcdefghijklmnopqr"), "1", KNOWN_SD),
            Block("barometer", ("bias",), "m", np.sqrt(variance), walk_var_per_s=walk_var),
        )
    )
    there = np.isfinite(series)
    value = np.column_stack([heights + series, np.zeros((count, 2))])[there]
    sd2 = np.tile([noise_var, np.inf, np.inf], (there.sum(), 1))
    barometer = Instrument(
        "barometer", HEIGHT, "barometer", np.zeros(3), np.zeros(3), np.eye(3), motion.time_s[there], value, sd2,
        np.zeros_like(value), np.zeros(len(value), dtype=int), np.zeros(len(value)),
    )  # fmt: skip
    observed, row = observe(motion.time_s, (barometer,))
    start.sensor_errors[BIAS] = mean
    covariance = np.diag(np.r_[np.full(9 + BIAS, KNOWN_SD**2), variance])
    gate = np.full(4, np.inf)
    nodes = np.arange(count)
    return Problem(
        motion.time_s, nodes, motion, model, (barometer,), row, observed, start, covariance, gate, nodes >= 0
    )


def answers(problem, engine, method):
    """Predicted, filtered and smoothed level with the variances of the first and last, and innovations."""
    run = forward(problem, engine=engine)
    smoothed = bryson_frazier.smooth(problem, run) if method == "bryson-frazier" else smooth(problem, run)
    predicted = run.charts.sensor_errors[:, BIAS] + run.filtered.x_minus[:, 9 + BIAS]
    return {
        "a": predicted,
        "P": unpacked(run.filtered.p_minus)[:, 9 + BIAS, 9 + BIAS],
        "att": run.states().sensor_errors[:, BIAS],
        "last": run.filtered.p_last[9 + BIAS, 9 + BIAS],
        "alphahat": smoothed.states(run.charts).sensor_errors[:, BIAS],
        "V": smoothed.variance[:, 9 + BIAS],
        "v": run.innovations.residual[:, 0],
        "F": run.innovations.covariance[:, 0, 0],
    }


WAYS = [(engine, method) for engine in ENGINES for method in ("rauch-tung-striebel", "bryson-frazier")]


@pytest.mark.parametrize(("engine", "method"), WAYS)
def test_local_level_of_kfas(engine, method):
    """Start after the first point: level 10.2394 with its noise 1.993. Heights of 2e5 m round at 1e-9 m."""
    r = pd.read_csv(DATA / "local_level.csv")
    series = np.r_[np.nan, np.ones(9)]
    ours = answers(level_problem(series, 1.993, 8.253, 10.2394, 1.993), engine, method)
    close = {"rtol": 0.0, "atol": 2e-8}
    assert np.allclose(ours["a"][1:], r["a_1"][1:10], **close)
    assert np.allclose(ours["P"][1:], r["sumP"][1:10], **close)
    assert np.allclose(ours["v"], r["v_1"][1:10], **close)
    assert np.allclose(ours["F"], r["F_1"][1:10], **close)
    assert np.allclose(ours["att"], r["att_1"][:10], **close)
    assert np.isclose(ours["last"], r["sumV"][9], **close)
    assert np.allclose(ours["alphahat"], r["alphahat_1"][:10], **close)
    assert np.allclose(ours["V"], r["sumV"][:10], **close)
    # the point that the diffuse start takes adds nothing to it
    likelihood = -0.5 * (9 * np.log(2.0 * np.pi) + (np.log(ours["F"]) + ours["v"] ** 2 / ours["F"]).sum())
    assert np.isclose(likelihood, r["llf"][0], rtol=1e-9)


@pytest.mark.parametrize(("engine", "method"), WAYS)
def test_nile(engine, method):
    """A hundred years from a prior of 1e7, as in Durbin and Koopman and in statsmodels: 798.370 with 4032.158."""
    series = pd.read_csv(DATA / "nile.csv")["volume"].to_numpy(dtype=float)
    ours = answers(level_problem(series, 15099.0, 1469.1, 0.0, 1e7), engine, method)
    assert np.isclose(ours["att"][-1], 798.370, atol=5e-4)
    assert np.isclose(ours["last"], 4032.158, atol=5e-4)
    # a scalar filter and its smoother, by hand
    a, p, table = 0.0, 1e7, []
    for y in series:
        f = p + 15099.0
        table.append([a, p, a + p / f * (y - a), p * 15099.0 / f])
        a, p = table[-1][2], table[-1][3] + 1469.1
    table = np.array(table)
    smoothed, variance = table[-1, 2], table[-1, 3]
    back = [[smoothed, variance]]
    for k in reversed(range(len(series) - 1)):
        c = table[k, 3] / table[k + 1, 1]
        smoothed = table[k, 2] + c * (smoothed - table[k + 1, 0])
        variance = table[k, 3] + c**2 * (variance - table[k + 1, 1])
        back.append([smoothed, variance])
    back = np.array(back[::-1])
    assert np.allclose(ours["a"], table[:, 0], rtol=1e-10, atol=1e-8)
    assert np.allclose(ours["P"], table[:, 1], rtol=1e-10)
    assert np.allclose(ours["alphahat"], back[:, 0], rtol=1e-10, atol=1e-8)
    assert np.allclose(ours["V"], back[:, 1], rtol=1e-9)


NOISE, LEVEL, SLOPE = 1.993, 8.253, 2.334
SERIES = np.r_[10.2394, np.nan, 6.123123, np.ones(7)]


def trend_problem(series, mean, covariance):
    """Local linear trend in the first two kinematic errors; the others stand by."""
    count, size = len(series), 15
    transition = np.zeros((count - 1, 9, size))
    transition[:, range(9), range(9)] = 1.0
    transition[:, 0, 1] = 1.0
    noise = np.zeros((count - 1, 9, 9))
    noise[:, 0, 0], noise[:, 1, 1] = LEVEL, SLOPE
    flat = np.ones((count - 1, 6))
    there = np.flatnonzero(np.isfinite(series))
    by_state = np.zeros((len(there), 3, 9))
    by_state[:, 0, 0] = 1.0
    value = np.column_stack([series[there], np.zeros((len(there), 2))])
    observed = Observed(
        np.searchsorted(there, np.arange(count + 1)).astype(np.int64), np.zeros(len(there), dtype=np.int64), value,
        np.tile([NOISE, np.inf, np.inf], (len(there), 1)), np.zeros((len(there), 3)), np.ones(len(there), dtype=bool),
    )  # fmt: skip
    start, p = np.zeros(size), np.eye(size)
    start[:2], p[:2, :2] = mean, covariance
    forever = np.full(6, np.inf)
    wander = Wander(forever, forever, np.ones(6), np.zeros(6), np.zeros(6, dtype=bool))
    steps = Steps(transition, noise, flat, 0.0 * flat, np.zeros((count - 1, size)))
    by_error = np.zeros((len(there), 3, SLOTS))
    slots = np.full((1, SLOTS), -1, dtype=np.int64)
    return linear.Linear(steps, wander, observed, slots, by_state, by_error, start, p, np.zeros((count, size)))


def trend_answers(problem, engine, method):
    """States (n, 2) and sums of their covariances, predicted and smoothed, and filtered states."""
    out, innovations = linear.run(problem, engine)
    x, triangles, _ = linear.smooth(problem, out, innovations, method)
    return {
        "a": out.x_minus[:, :2],
        "sumP": unpacked(out.p_minus)[:, :2, :2].sum(axis=(1, 2)),
        "att": out.x_plus[:, :2],
        "last": unpacked(out.p_plus)[-1, :2, :2].sum(),
        "alphahat": x[:, :2],
        "sumV": unpacked(triangles)[:, :2, :2].sum(axis=(1, 2)),
        "F": np.append(innovations.covariance[:, 0, 0], np.nan),
    }


@pytest.mark.parametrize(("engine", "method"), [*WAYS, ("compiled", "two-filter")])
def test_local_linear_trend_with_a_missing_point_of_kfas(engine, method):
    """Start at the third point, conditioned by hand on the first and the third; the second is missing.

    There level = y3 + e3 and slope = (y3 - y1) / 2 with error (e3 - e) / 2, where e holds the noise of the first
    point, two level noises and 1 + 4 slope noises.
    """
    r = pd.read_csv(DATA / "local_linear_trend_missing.csv")
    mean = [SERIES[2], 0.5 * (SERIES[2] - SERIES[0])]
    spread = NOISE + 2.0 * LEVEL + 5.0 * SLOPE
    covariance = np.array([[NOISE, 0.5 * NOISE], [0.5 * NOISE, 0.25 * (NOISE + spread)]])
    ours = trend_answers(trend_problem(np.r_[np.nan, SERIES[3:]], mean, covariance), engine, method)
    close = {"rtol": 0.0, "atol": 1e-8}
    for name, first in (("a", 3), ("att", 2), ("alphahat", 2)):
        assert np.allclose(ours[name][first - 2 :], r[[f"{name}_1", f"{name}_2"]][first:10], **close), name
    for name, first in (("sumP", 3), ("sumV", 2)):
        assert np.allclose(ours[name][first - 2 :], r[name][first:10], **close), name
    assert np.isclose(ours["last"], r["sumV"][9], **close)
    assert np.allclose(ours["F"][:7], r["F_1"][3:10], **close)


LIMITS = {"rauch-tung-striebel": (1e6, 1e7, 3e-7), "two-filter": (1e6, 1e7, 3e-7), "bryson-frazier": (1e4, 1e5, 5e-6)}


@pytest.mark.parametrize(("engine", "method"), [*WAYS, ("compiled", "two-filter")])
def test_the_diffuse_start_is_the_limit_of_wide_priors(engine, method):
    """Smoothed trend at all ten points. A prior P leaves c / P: two priors and the limit, and 1e7 * 1e-16 of rounding.

    Bryson and Frazier's P - P L P loses 1e-16 P^2 instead: their limit is taken from narrower priors.
    """
    r = pd.read_csv(DATA / "local_linear_trend_missing.csv")
    one, other, close = LIMITS[method]
    ours = [trend_answers(trend_problem(SERIES, [0.0, 0.0], p * np.eye(2)), engine, method) for p in (one, other)]
    for name, columns in (("alphahat", ["alphahat_1", "alphahat_2"]), ("sumV", ["sumV"])):
        limit = (other * ours[1][name] - one * ours[0][name]) / (other - one)
        assert np.allclose(limit.reshape(10, -1), r[columns][:10], rtol=0.0, atol=close), name
        assert not np.allclose(ours[0][name].reshape(10, -1), r[columns][:10], rtol=0.0, atol=close), name


@pytest.mark.parametrize("engine", ENGINES)
def test_a_considered_level_is_no_estimate(engine):
    """Schmidt on the Nile: the level stays at its mean, its variance too, and innovations are as wide as ever."""
    series = pd.read_csv(DATA / "nile.csv")["volume"].to_numpy(dtype=float)
    problem = level_problem(series, 15099.0, 0.0, 900.0, 1e4)
    considered = replace(problem, model=problem.model.considering(["barometer bias"]))
    run = forward(considered, engine=engine)
    assert (run.states().sensor_errors[:, BIAS] == 900.0).all()
    assert np.allclose(run.innovations.covariance[:, 0, 0], 25099.0, rtol=1e-12)
    assert np.allclose(run.innovations.residual[:, 0], series - 900.0, atol=1e-8)
