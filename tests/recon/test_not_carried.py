"""Inertial sensors that carry a track nowhere are refused in words, after a bounded number of passes."""

from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.checks import DivergenceError
from recon.unmodelled import LOST_POINTS, MOST, Disturbance, widened

TIME_S = np.arange(0.0, 300.0)


def lost_from(start_s, ballistic):
    """A track that is believed up to a time, and never again."""
    problem = SimpleNamespace(
        time_s=TIME_S,
        node=np.arange(len(TIME_S)),
        observed=SimpleNamespace(usable=np.ones(len(TIME_S), dtype=bool)),
        motion=SimpleNamespace(ballistic=ballistic),
    )
    return problem, SimpleNamespace(innovations=SimpleNamespace(accepted=start_s > TIME_S))


def follow(ballistic):
    known = ()
    for start_s in np.arange(10.0, TIME_S[-1] - LOST_POINTS, 10.0):
        known = widened(known, *lost_from(start_s, ballistic))
    return known


def test_more_spans_than_a_vehicle_is_shaken_in_are_refused():
    with pytest.raises(DivergenceError, match=r"more than 10 spans between 7\.\d and 1\d\d\.\d s") as caught:
        follow(ballistic=False)
    assert all(words in str(caught.value) for words in ("attitude_prior", "scalar first", "postflight check", "t0_utc"))


def test_few_spans_and_any_number_in_ballistic_flight_are_followed():
    known = tuple(Disturbance(30.0 * k, 30.0 * k + 2.0, 0.1) for k in range(MOST - 1))
    assert len(widened(known, *lost_from(295.0 - LOST_POINTS, ballistic=False))) == MOST
    assert len(follow(ballistic=True)) > MOST
