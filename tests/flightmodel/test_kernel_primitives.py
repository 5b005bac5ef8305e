"""Compiled vector algebra against numpy's, on drawn numbers: quick with interpreted kernels too."""

import numpy as np
import pytest

from flightmodel import _kernels as la


@pytest.mark.parametrize("seed", range(5))
def test_products_are_numpy_s(seed):
    rng = np.random.default_rng(seed)
    w, r = rng.normal(size=(2, 3))
    root = rng.normal(size=(3, 3))
    tensor = root @ root.T + np.eye(3)
    six = tuple(tensor[np.triu_indices(3)])
    np.testing.assert_allclose(la.cross(*w, *r), np.cross(w, r), atol=1e-14)
    np.testing.assert_allclose(la.centripetal(*w, *r), np.cross(w, np.cross(w, r)), atol=1e-13)
    np.testing.assert_allclose(la.gyroscopic(six, *w), np.cross(w, tensor @ w), atol=1e-12)
    np.testing.assert_allclose(la.symmetric(six, *r), tensor @ r, atol=1e-13)
    np.testing.assert_allclose(la.solved(six, *r), np.linalg.solve(tensor, r), rtol=1e-11, atol=1e-13)
    c = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    nine = tuple(c.ravel())
    np.testing.assert_allclose(la.times(nine, *r), c @ r, atol=1e-14)
    np.testing.assert_allclose(la.back(nine, *r), c.T @ r, atol=1e-14)
    np.testing.assert_allclose(la.turned(nine, six), (c @ tensor @ c.T)[np.triu_indices(3)], atol=1e-13)


def test_arctangent_is_right_in_every_quadrant():
    for angle in np.deg2rad(np.arange(-179.5, 180.0, 7.3)):
        for size in (1e-6, 3.0, 1e7):
            assert la.atan2(size * np.sin(angle), size * np.cos(angle)) == pytest.approx(angle, abs=5e-16 * np.pi)
