"""A plane that is assumed: does the film bear it out?"""

import re
from dataclasses import replace

import numpy as np
import pytest

from estimators.assumed_plane import plane_check
from estimators.camera import read_film
from estimators.edge import no_horizon
from estimators.frame_solution import refused_fit
from flightmodel.checks import Issue
from flightmodel.deflection import DeflectionHistory
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, film

TIMES = np.array([421.0, 438.0, 441.0])
TRUE_DEG, THETA_DEG = 180.0, 3.8


@pytest.fixture(scope="module")
def frames():
    return film(5, [0.0, 3.6, 4.0], [0.0, 188.0, 172.0])


def in_plane(frames, plane_deg):
    return read_film(TIMES, frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=D(plane_deg))


def left_open(test):
    """Deflection and plane, deg, with the plane left open."""
    return tuple(map(float, re.search(r"left open by (\S+) deg towards (\S+) deg LV", test.remark).groups()))


@pytest.mark.parametrize("off_deg", [-20.0, 0.0, 20.0])
def test_a_plane_within_its_sd_passes(frames, off_deg):
    test = plane_check(in_plane(frames, TRUE_DEG + off_deg))
    assert test.passed, test.remark
    assert left_open(test)[0] == pytest.approx(THETA_DEG, abs=0.3)
    assert left_open(test)[1] == pytest.approx(TRUE_DEG, abs=8.0)


@pytest.mark.parametrize("off_deg", [90.0, -100.0, 170.0])
def test_a_plane_across_or_opposite_fails(frames, off_deg):
    """The answer in it is degrees off, and its error bar, which the plane's own sd makes, does not hold that."""
    film_fit = in_plane(frames, TRUE_DEG + off_deg)
    test = plane_check(film_fit)
    assert not test.passed
    assert left_open(test)[1] == pytest.approx(TRUE_DEG, abs=8.0)
    history = film_fit.history()
    assert (np.abs(history.theta_rad[1:] - D(THETA_DEG)) > 4.0 * history.theta_sd_rad[1:]).all()


def test_without_a_plane_or_an_answer_there_is_nothing_to_test(frames):
    read = in_plane(frames, TRUE_DEG)
    assert plane_check(replace(read, plane_lv_rad=None)) is None
    nothing = refused_fit(no_horizon(Issue("dark", "frame-exposure")), Issue("dark", "frame-exposure"))
    assert plane_check(replace(read, fits=(nothing,) * 3)) is None


def test_the_largest_deflection_in_a_plane_may_lie_on_its_other_side():
    times, theta = np.arange(4.0), D(np.array([0.2, -4.0, -1.0, np.nan]))
    history = DeflectionHistory(times, theta, np.zeros(4), None, "camera")
    assert history.largest() == 1
    assert history.largest((1.5, 3.0)) == 2
    assert "-4.00 deg at 1.00 s" in repr(history)
