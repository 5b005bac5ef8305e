"""A body on our joint moves as ADAMS says: free, as a planar hinge would, and with spring and damper.

Authority: ADAMS solutions kept by Project Chrono as the reference of its own joints (5 s): spherical joint, revolute
joint (planar motion, so the same), revolute with a torsion spring and damper -(200 theta + 10 theta'). Proved: motion
of one body about the joint, the joint's force, its spring and its damper. The ground is the second body, of 1e9 kg.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from flightmodel import rotations
from synthetic_flight import dynamics
from tests.oracles import two_body

from .rigid import on_the_ground

DATA = Path(__file__).parents[1] / "data" / "adams_joints"
WEIGHT_N = np.array([0.0, 0.0, -9.80665])  # of 1 kg
LOADS = two_body.Loads(np.zeros(3), WEIGHT_N, np.zeros(3))


def swing(body, q_ground, q_pendulum, time_s):
    """Everything that ADAMS prints, at its times, in ground axes."""
    state = np.concatenate([np.zeros(6), q_ground, q_pendulum, np.zeros(6)])
    # the joint is the origin: place the composite c.g. accordingly
    state[0:3] = -dynamics.offsets(state, body)["joint"][0]
    run = solve_ivp(
        lambda _, y: two_body.rates(y, body, LOADS),
        (0.0, time_s[-1]),
        state,
        method="DOP853",
        t_eval=time_s,
        rtol=1e-11,
        atol=1e-12,
    )
    states = run.y.T
    where = dynamics.points(states, body)
    origin, drift = where["joint"]
    solved = [two_body.accelerations(s, body, LOADS) for s in states]
    q = states[:, 10:14] / np.linalg.norm(states[:, 10:14], axis=1, keepdims=True)
    rate = rotations.rotate(q, states[:, 17:20])
    moments = [
        two_body.joint_moment(body, s[6:10], s[10:14], -w + rotations.rotate(s[6:10], s[14:17]))
        for s, w in zip(states, rate, strict=True)
    ]
    assert np.abs(origin).max() < 1e-6
    assert np.abs(drift).max() < 1e-6
    return {
        "position": where["shell"][0],
        "velocity": where["shell"][1],
        "acceleration": np.array([s[2] for s in solved]),
        "attitude": q,
        "rate": rate,
        "angular acceleration": np.array([s[3] for s in solved]),
        "joint force": np.array([s[4] for s in solved]),
        "spring moment": np.array(moments),
    }


COLUMNS = {
    "position": ("x_m", "y_m", "z_m"),
    "velocity": ("vx_mps", "vy_mps", "vz_mps"),
    "acceleration": ("ax_mps2", "ay_mps2", "az_mps2"),
    "rate": ("wx_radps", "wy_radps", "wz_radps"),
    "angular acceleration": ("alx_radps2", "aly_radps2", "alz_radps2"),
    "joint force": ("Fx_N", "Fy_N", "Fz_N"),
}


@pytest.mark.parametrize(
    ("case", "stiffness", "damping"), [("spherical", 0.0, 0.0), ("revolute", 0.0, 0.0), ("rotspring", 200.0, 10.0)]
)
def test_motion_and_reactions(vehicle, measured, case, stiffness, damping):
    adams = pd.read_csv(DATA / f"{case}_case01.csv")
    q_adams = adams[["q0", "q1", "q2", "q3"]].to_numpy()
    q_start = q_adams[0] / np.linalg.norm(q_adams[0])
    # a free joint has no zero; the pendulum swings over 180 deg, so let the ground's x axis point down
    down = rotations.exp(np.array([0.0, 0.5 * np.pi, 0.0]))
    q_ground = q_start if stiffness else rotations.multiply(down, q_start)
    body = on_the_ground(vehicle, 1.0, (2.0, 0.0, 0.0), np.diag([0.04, 0.1, 0.1]), stiffness, damping)
    ours = swing(body, q_ground, q_start, adams.t_s.to_numpy())
    # of the largest value of a quantity in the run. The revolute and the spherical pendulum move alike; ADAMS' own two
    # solutions part by 5e-4 (its spherical one is integrated the coarser), its planar ones carry six digits
    limit = 1e-3 if case == "spherical" else 2e-4
    for quantity, columns in COLUMNS.items():
        theirs = adams[list(columns)].to_numpy()
        scale = np.linalg.norm(theirs, axis=1).max()
        worst = np.linalg.norm(ours[quantity] - theirs, axis=1).max() / scale
        measured(f"{case}: {quantity}, of {scale:.3g}", worst, limit)
    q_adams /= np.linalg.norm(q_adams, axis=1, keepdims=True)
    angle = np.linalg.norm(rotations.boxminus(ours["attitude"], q_adams), axis=1).max()
    measured(f"{case}: attitude", angle, limit, "rad")
    if stiffness:
        theirs = adams[["Tx_Nm", "Ty_Nm", "Tz_Nm"]].to_numpy()
        scale = np.linalg.norm(theirs, axis=1).max()
        worst = np.linalg.norm(ours["spring moment"] - theirs, axis=1).max() / scale
        measured(f"{case}: spring and damper moment, of {scale:.3g}", worst, limit)
