"""The fit of one frame in plain numpy, step by step: what the compiled one is held to."""

import numpy as np

from estimators.camera_fit import GROSS_PX, JOINT, LAST_STEP_RAD, STEPS, edge_seen, huber_gain, joined, marks_seen
from estimators.virtual_camera import BENDING, FLATTENING


def plain_fit(oriented, horizon, place, start):
    """Bending (3,) from edge points and marks found, plane free."""
    bending, lines = np.array(start, dtype=float), len(oriented.lines.origin_px)
    before, held = oriented.left_over, oriented.held
    prior = np.array(
        [held.flattening_rad, held.joint_station_m, *[held.ovality_rad] * 2, *[np.sqrt(2.0) * held.edge_px] * 3]
    )
    for _ in range(STEPS):
        seen = edge_seen(oriented.view, horizon, bending)
        if place is not None:
            seen = joined(seen, marks_seen(oriented.view, oriented.marks, place, bending, lines))
        both = np.flatnonzero(np.isin(seen.index, before.index) & np.isfinite(seen.residual_px))
        at = np.searchsorted(before.index, seen.index[both])
        residual = seen.residual_px[both] - before.residual_px[at]
        sd = np.hypot(seen.sd_px[both], before.sd_px[at])
        used = (seen.index[both] < lines) | (np.abs(residual) < GROSS_PX)
        rows, shape = seen.rows[both][used], seen.shape[both][used]
        moved = type(seen)(residual[used], rows, shape, sd[used], seen.index[both][used])
        design = np.column_stack([rows[:, BENDING], rows[:, FLATTENING], rows[:, JOINT], shape])
        gain, formal, _ = huber_gain(moved, design, np.diag(np.concatenate([np.zeros(2), prior**-2.0])), lines)
        pull = np.zeros(len(formal))
        pull[2] = bending[2] / prior[0] ** 2
        step = gain @ moved.residual_px - formal @ pull
        bending += step[:3]
        if np.abs(step[:3]).max() < LAST_STEP_RAD:
            break
    return bending
