"""Moments between records against closed forms: far closer than the step."""

import numpy as np
import pytest

from flightmodel.events import descent_events, find_peak, first_fall, has_peak, values_at

T = np.arange(0.0, 40.0, 0.5)


def test_crossing_of_an_exponential():
    # error of a cubic through four points: fourth derivative h^4 9/384, over the slope: 2e-6 s at 0.5 s steps
    fall = first_fall(T, 1.2 * np.exp(-T / 9.0), 0.37)
    assert fall == pytest.approx(9.0 * np.log(1.2 / 0.37), abs=2e-6)


@pytest.mark.parametrize("at", [0.1, 0.77, 39.2])
def test_crossings_in_the_first_and_the_last_step(at):
    assert first_fall(T, np.sin((at - T) / 30.0), 0.0) == pytest.approx(at, abs=1e-7)


def test_a_sample_on_the_level_and_a_level_never_met():
    assert first_fall(T, 10.0 - T, 5.0) == 5.0
    assert first_fall(T, 10.0 - T, -50.0) is None
    # falls twice: the first that is allowed
    wave = np.cos(2 * np.pi * T / 20.0)
    assert first_fall(T, wave, 0.0) == pytest.approx(5.0, abs=1e-5)
    assert first_fall(T, wave, 0.0, T > 12.0) == pytest.approx(25.0, abs=1e-5)


def test_peak_of_a_parabola_is_exact_and_ends_are_none():
    at, value = find_peak(T, 7.0 - 0.3 * (T - 13.21) ** 2)
    assert (at, value) == pytest.approx((13.21, 7.0))
    assert has_peak(np.array([1.0, 3.0, 2.0]))
    assert not has_peak(np.array([1.0, 2.0, 3.0]))
    assert not has_peak(np.array([3.0, 2.0, 1.0]))


def test_values_between_records_are_cubic():
    columns = np.column_stack([T**3 - 4 * T, 2.0 - T**2])
    for at in (0.0, 0.2, 17.33, 39.5):
        np.testing.assert_allclose(values_at(T, columns, at), [at**3 - 4 * at, 2.0 - at**2], rtol=1e-9, atol=1e-9)


def test_a_descent_from_a_parabola():
    g, top = 9.0, 200e3
    t = np.arange(0.0, 258.0, 0.25)
    altitude = top - 0.5 * g * (t - 50.0) ** 2
    # a Mach number that falls with height: 7 above 70 km, 0 at the ground
    mach = np.minimum(altitude / 1e4, 7.0)
    found = dict(descent_events(t, altitude, mach))
    for name, level in (("80 km", 80e3), ("40 km", 40e3), ("Mach 3.5", 35e3), ("Mach 1", 10e3)):
        assert found[name] == pytest.approx(50.0 + np.sqrt(2 * (top - level) / g), abs=1e-7)
    assert found["apogee"] == pytest.approx(50.0, abs=1e-9)
    # begun on the way down and ended above 40 km: what lies outside is absent
    part = (altitude > 50e3) & (altitude < 70e3) & (t > 50.0)
    assert dict(descent_events(t[part], altitude[part], mach[part] + 2.0)) == {}
