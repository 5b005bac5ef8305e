"""What a bent benchmark frame takes away from every later answer: stated, and seen in films that differ in it alone."""

import numpy as np

from estimators.camera import read_film
from flightmodel.deflection import rotation_vector_body_shell
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, film


def test_an_answer_misses_of_the_benchmark_s_bending_what_it_says():
    # one lens, one light, one later frame; the benchmark frame bent by 0.4 deg to one side or to the other
    fits, bent = [], []
    for plane in (150.0, 330.0):
        frames = film(5, [0.4, 4.5], [plane, 188.0])
        read = read_film(np.array([421.0, 440.0]), frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None)
        fits.append(read.fits[1])
        bent.append(rotation_vector_body_shell(np.array(D(0.4)), np.array(D(plane)))[1:])
    changed = fits[0].rotation_yz_rad - fits[1].rotation_yz_rad
    stated = -0.5 * (fits[0].per_benchmark + fits[1].per_benchmark) @ (bent[0] - bent[1])
    # 0.8 deg apart; four frames' noise of 0.02 deg each
    assert np.linalg.norm(changed - stated) < 0.05 * np.linalg.norm(stated)
