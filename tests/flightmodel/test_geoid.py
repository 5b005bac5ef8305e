"""Geoid against the values that its makers publish with it, where it closes, and in the files that use it."""

import numpy as np
import pytest

from flightmodel.earth import undulation_m

# latitude, longitude east (deg) and undulation (m): INPUT.DAT and OUTINTPT.DAT, which accompany WW15MGH.GRD
PUBLISHED = np.array(
    [
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ]
)


def test_published_values():
    """Half a degree and 0.1 m of rounding: 0.05 m rms, so 0.2 m is four of them."""
    found = undulation_m(*np.deg2rad(PUBLISHED[:, :2].T))
    np.testing.assert_allclose(found, PUBLISHED[:, 2], atol=0.2)


def test_extremes_lie_where_the_model_has_them():
    """South of India and in New Guinea; -106.99 and +85.39 m on the model's own grid."""
    latitude, longitude = np.deg2rad(np.meshgrid(np.arange(-90.0, 90.5, 0.5), np.arange(0.0, 360.0, 0.5)))
    n = undulation_m(latitude, longitude)
    assert n.min() == pytest.approx(-107.0, abs=0.15)
    assert n.max() == pytest.approx(85.39, abs=1.0)  # between nodes: the largest error of the coarser table
    low = np.unravel_index(n.argmin(), n.shape)
    assert np.rad2deg([latitude[low], longitude[low]]) == pytest.approx([4.5, 78.75], abs=1.0)


def test_it_closes_at_greenwich_and_the_poles():
    turn = 2.0 * np.pi
    for latitude in (-1.2, 0.1, 0.9):
        around = undulation_m(latitude, np.array([-1e-9, 0.0, 1e-9, turn - 1e-9, turn, 3.0 * turn]))
        np.testing.assert_allclose(around, around[1], atol=1e-6)
        assert undulation_m(latitude, -1.3) == pytest.approx(float(undulation_m(latitude, turn - 1.3)), abs=1e-9)
    for pole in (-0.5 * np.pi, 0.5 * np.pi):
        np.testing.assert_allclose(np.ptp(undulation_m(pole, np.linspace(0.0, turn, 50))), 0.0, atol=1e-9)


def test_a_place_that_is_missing_has_none():
    found = undulation_m(np.array([0.5, np.nan]), np.array([np.nan, 0.5]))
    assert np.isnan(found).all()
