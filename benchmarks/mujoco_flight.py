"""The vehicle in MuJoCo: two bodies, a free base, a ball joint with stiffness and damping; wrench held or at stages."""

import numpy as np
from wrench import compiled_wrench, constants, numpy_wrench

from flightmodel import rotations
from synthetic_flight import dynamics

MODEL = """
<mujoco>
  <option timestep="{step}" integrator="{integrator}" gravity="0 0 0" jacobian="dense">
    <flag constraint="disable" contact="disable" gravity="disable" sensor="disable" warmstart="disable"/>
  </option>
  <worldbody>
    <body name="shell">
      <freejoint/>
      <inertial pos="{cg_a}" mass="{m_a}" fullinertia="{i_a}"/>
      <body name="body" pos="{joint}">
        <joint type="ball" stiffness="{stiffness}" damping="{damping}"/>
        <inertial pos="{cg_b}" mass="{m_b}" fullinertia="{i_b}"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def _words(numbers):
    return " ".join(repr(float(x)) for x in numbers)


def _six(inertia):
    return _words(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])


def isotropic(vehicle):
    """MuJoCo's ball joint has one stiffness: the vehicle with that of bending in torsion too."""
    return vehicle.joint.model_copy(update={"torsion_stiffness_nmprad": vehicle.joint.bending_stiffness_nmprad})


class MujocoFlight:
    """A flight from a state of ours; ``wrench``: None, or ``"compiled"`` or ``"numpy"``, and ``", four stages"``."""

    def __init__(self, problem, rate_hz, wrench, integrator="RK4"):
        import mujoco

        self.mujoco, vehicle = mujoco, problem.vehicle
        body, shell = vehicle.centerbody, vehicle.aeroshell
        self.model = mujoco.MjModel.from_xml_string(
            MODEL.format(
                step=1.0 / rate_hz,
                integrator=integrator,
                cg_a=_words(shell.cg_m),
                m_a=shell.mass_kg,
                i_a=_six(shell.inertia),
                joint=_words(vehicle.joint_m),
                stiffness=vehicle.joint.bending_stiffness_nmprad,
                damping=vehicle.joint.bending_damping_nmsprad,
                cg_b=_words(body.cg_m - vehicle.joint_m),
                m_b=body.mass_kg,
                i_b=_six(body.inertia),
            )
        )
        self.data = mujoco.MjData(self.model)
        known = constants(vehicle, problem.atmosphere)
        kind, _, at_stages = (wrench or "none").partition(", ")
        self.stages = bool(at_stages)
        self.wrench = {"none": lambda _: None, "compiled": compiled_wrench, "numpy": numpy_wrench}[kind](known)
        nose, nose_v = dynamics.points(problem.entry, vehicle)["nose"]
        q_b, q_a, w_b, w_a = problem.entry[6:10], problem.entry[10:14], problem.entry[14:17], problem.entry[17:20]
        q_ab = rotations.multiply(rotations.conjugate(q_a), q_b)
        self.qpos = np.concatenate([nose, q_a, q_ab])
        self.qvel = np.concatenate([nose_v, w_a, w_b - rotations.rotate(rotations.conjugate(q_ab), w_a)])

    def fly(self, seconds, record_hz=10.0):
        """Records of nose position ``(n, 3)`` and bending angle ``(n,)``, that of the start first."""
        mujoco, model, data, wrench = self.mujoco, self.model, self.data, self.wrench
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = self.qpos, self.qvel
        qpos, qvel, out = data.qpos, data.qvel, data.xfrc_applied
        per_record = round(1.0 / (model.opt.timestep * record_hz))
        rows = [qpos.copy()]
        if self.stages:
            mujoco.set_mjcb_control(lambda _, at: wrench(at.qpos, at.qvel, at.xfrc_applied))
        try:
            for _ in range(round(seconds * record_hz)):
                if wrench is None or self.stages:
                    for _ in range(per_record):
                        mujoco.mj_step(model, data)
                else:
                    for _ in range(per_record):
                        wrench(qpos, qvel, out)
                        mujoco.mj_step(model, data)
                rows.append(qpos.copy())
        finally:
            mujoco.set_mjcb_control(None)
        table = np.array(rows)
        # of the ball joint's quaternion: swing of one x axis off the other
        sine, cosine = np.hypot(table[:, 9], table[:, 10]), np.hypot(table[:, 7], table[:, 8])
        return table[:, :3], 2.0 * np.arctan2(sine, cosine)
