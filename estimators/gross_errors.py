"""What a gross error of each thing the methods lean on would look like: of known size, to an unknown side.

Sizes are of errors that happen and that stated uncertainties do not mean: a coefficient table of another
configuration, a package bolted on askew, a c.g. measured before the last change, a camera clocked by another drawing.
Each is a matrix of columns in the inputs' unit normals; the error is these times a standard normal vector.
"""

from __future__ import annotations

import numpy as np

from estimators.evidence import ACCELEROMETER, CAMERA_PLANE, offset_sd_m
from estimators.normal_equations import Learnt
from estimators.pulse import PulseData
from flightmodel.checks import FloatArray

COEFFICIENTS, MOUNT = "aerodynamic coefficients", "accelerometer's mounting or bias"
OFFSET, CAMERA_TURNED = "initial c.g. offset", "camera's orientation, benchmark or plane"
GROSS_COEFFICIENT = 0.15  # of C_m and C_N, each by itself
GROSS_MOUNT_RAD = np.deg2rad(0.5)  # across the long axis; about it the drag hardly turns
GROSS_OFFSET_M = 0.005  # of the centerbody's c.g.
GROSS_PLANE_RAD = np.deg2rad(25.0)


def gross_errors(pulse: PulseData, learnt: Learnt, plane_sd_rad: float) -> dict[str, FloatArray]:
    """Columns ``(inputs, directions)`` of each gross error, by the name of the suspect.

    A mount that is turned turns the attitude with it: the reconstruction found both from one measurement.

    Parameters
    ----------
    pulse : PulseData
    learnt : Learnt
        Says where each input's unit normals stand.
    plane_sd_rad : float
        What one unit normal of the camera's plane is.
    """
    known, size = pulse.vehicle.uncertainty, len(learnt.mean)
    offset = GROSS_OFFSET_M / np.sqrt(2.0)
    single = {
        COEFFICIENTS: {"C_m": (GROSS_COEFFICIENT, known.cm), "C_N": (GROSS_COEFFICIENT, known.cn)},
        OFFSET: {f"initial offset {axis}": (offset, offset_sd_m(pulse.vehicle)) for axis in "yz"},
        CAMERA_TURNED: {CAMERA_PLANE: (GROSS_PLANE_RAD, plane_sd_rad)},
    }
    out = {}
    for suspect, inputs in single.items():
        there = {name: wrong / sd for name, (wrong, sd) in inputs.items() if name in learnt.place and sd > 0.0}
        out[suspect] = np.zeros((size, len(there)))
        for k, (name, normals) in enumerate(there.items()):
            out[suspect][learnt.place[name].start, k] = normals
    if ACCELEROMETER in learnt.place:
        use = pulse.through_pulse
        force, root = pulse.specific_force_body_mps2[use], pulse.force_root_mps2[use].reshape(-1, 9)
        axes = GROSS_MOUNT_RAD / np.sqrt(2.0) * np.eye(3)[1:]
        turned = np.column_stack([np.cross(axis, force).ravel() for axis in axes])
        out[MOUNT] = np.zeros((size, 2))
        out[MOUNT][learnt.place[ACCELEROMETER]] = np.linalg.lstsq(root, turned, rcond=1e-6)[0]
    return {suspect: columns for suspect, columns in out.items() if columns.any()}
