import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flightmodel import _kernels, rotations

component = st.floats(-3.0, 3.0, allow_subnormal=False)
vector = st.tuples(component, component, component).map(np.array)


@given(vector, vector)
@settings(max_examples=200, deadline=None)
def test_boxplus_and_boxminus_are_inverse(a, d):
    d = d * min(1.0, 3.0 / (np.linalg.norm(d) + 1e-12))
    q = rotations.exp(a)
    np.testing.assert_allclose(rotations.boxminus(rotations.boxplus(q, d), q), d, atol=1e-9)


@given(vector, vector)
@settings(max_examples=200, deadline=None)
def test_composition_and_matrices_agree_with_scipy(a, b):
    p, q = rotations.exp(a), rotations.exp(b)
    want = (Rotation.from_rotvec(a) * Rotation.from_rotvec(b)).as_matrix()
    np.testing.assert_allclose(rotations.dcm_from_q(rotations.multiply(p, q)), want, atol=1e-13)
    np.testing.assert_allclose(rotations.dcm_from_q(rotations.q_from_dcm(want[None])[0]), want, atol=1e-13)


def test_names_touch():
    rng = np.random.default_rng(3)
    q_ned_ecef, q_ecef_body = rotations.exp(rng.normal(size=(2, 3)))
    v_body = rng.normal(size=3)
    chained = rotations.rotate(q_ned_ecef, rotations.rotate(q_ecef_body, v_body))
    np.testing.assert_allclose(rotations.rotate(rotations.multiply(q_ned_ecef, q_ecef_body), v_body), chained)


def test_slerp_is_the_shortest_arc_at_uneven_times():
    t = np.array([0.0, 0.7, 1.9])
    q = rotations.exp(np.array([[0.0, 0, 0], [0.4, -0.2, 0.9], [-0.3, 1.1, 0.5]]))
    q[2] *= -1.0  # the same attitude with the other sign
    at = np.array([0.0, 0.31, 0.7, 1.2, 1.9])
    got = Rotation.from_quat(np.roll(rotations.slerp(t, q, at), -1, axis=1))
    from scipy.spatial.transform import Slerp

    want = Slerp(t, Rotation.from_quat(np.roll(q, -1, axis=1)))(at)
    np.testing.assert_allclose((got.inv() * want).magnitude(), 0.0, atol=1e-12)


def test_small_rotations_keep_their_size():
    for size in (0.0, 1e-300, 1e-12, 1e-8, 1e-4):
        d = size * np.array([0.6, -0.48, 0.64])
        np.testing.assert_allclose(rotations.log(rotations.exp(d)), d, rtol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-10, 1e-5, 0.3, 2.0])
def test_kernel_boxplus_equals_the_readable_form(size):
    q = rotations.exp(np.array([0.3, -1.2, 0.8]))
    d = size * np.array([0.6, -0.48, 0.64])
    got = q.copy()
    _kernels.boxplus(got, *d)
    np.testing.assert_allclose(got, rotations.boxplus(q, d), atol=1e-15)
    out = np.empty((3, 3))
    _kernels.dcm_from_quaternion(*got, out)
    np.testing.assert_allclose(out, rotations.dcm_from_q(got), atol=1e-15)


def test_skew_is_the_cross_product():
    a, b = np.array([0.3, -1.0, 2.0]), np.array([-0.7, 0.2, 0.5])
    np.testing.assert_allclose(rotations.skew(a) @ b, np.cross(a, b))
