"""Inertial sensors that do not carry the track are refused after a bounded number of passes."""

from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.checks import DivergenceError
from recon.fault_detection import (
    LEAST_REJECTED_POINTS,
    MOST_SPANS,
    UnmodelledAcceleration,
    carried_check,
    with_one_more,
)

TIME_S = np.arange(0.0, 300.0)


def lost_from(start_s, ballistic):
    """A track that is accepted up to a time, and never again."""
    problem = SimpleNamespace(
        time_s=TIME_S,
        node=np.arange(len(TIME_S)),
        observed=SimpleNamespace(usable=np.ones(len(TIME_S), dtype=bool)),
        motion=SimpleNamespace(ballistic=ballistic),
    )
    return problem, SimpleNamespace(innovations=SimpleNamespace(accepted=start_s > TIME_S))


def follow(ballistic):
    known = ()
    for start_s in np.arange(10.0, TIME_S[-1] - LEAST_REJECTED_POINTS, 10.0):
        known = with_one_more(known, *lost_from(start_s, ballistic))
    return known


def test_more_spans_than_a_vehicle_is_disturbed_in_are_refused():
    with pytest.raises(DivergenceError) as refusal:
        follow(ballistic=False)
    assert refusal.value.codes == ("track-not-followed",)
    assert all(key in str(refusal.value) for key in ("attitude_prior", "postflight check", "t0_utc"))


def test_few_spans_and_any_number_in_ballistic_flight_are_followed():
    known = tuple(UnmodelledAcceleration(30.0 * k, 30.0 * k + 2.0, 0.1) for k in range(MOST_SPANS - 1))
    assert len(with_one_more(known, *lost_from(295.0 - LEAST_REJECTED_POINTS, ballistic=False))) == MOST_SPANS
    assert len(follow(ballistic=True)) > MOST_SPANS


def test_inertial_sensors_that_need_a_span_do_not_carry_the_track():
    assert carried_check(()).passed
    check = carried_check((UnmodelledAcceleration(30.0, 32.0, 0.1),))
    assert (check.code, check.passed) == ("unmodelled-acceleration", False)
    assert "30.0 to 32.0 s" in check.remark
