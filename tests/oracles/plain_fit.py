"""The fit of one frame in plain numpy, step by step: what the compiled one is held to."""

import numpy as np

from estimators.frame_residuals import edge_residuals, feature_residuals, huber_gain, joined
from estimators.frame_solution import LAST_STEP_RAD, OUTLIER_PX, STEPS
from estimators.virtual_camera import DEFLECTION, FLATTENING, JOINT


def plain_fit(oriented, horizon, place, start):
    """Bending (3,) from edge points and marks found, plane free."""
    deformation, lines = np.array(start, dtype=float), len(oriented.lines.origin_px)
    before, apriori = oriented.benchmark_residuals, oriented.apriori
    prior = np.array(
        [
            apriori.flattening_rad,
            apriori.joint_station_m,
            *apriori.lobe_sd_rad,
            *[np.sqrt(2.0) * apriori.edge_px] * 3,
        ]
    )
    form = np.zeros(16)
    for _ in range(STEPS):
        residuals = edge_residuals(oriented.view, horizon, deformation)
        if place is not None:
            residuals = joined(
                residuals, feature_residuals(oriented.view, oriented.features, place, deformation, lines)
            )
        both = np.flatnonzero(np.isin(residuals.index, before.index) & np.isfinite(residuals.residual_px))
        at = np.searchsorted(before.index, residuals.index[both])
        residual = residuals.residual_px[both] - before.residual_px[at]
        sd = np.hypot(residuals.sd_px[both], before.sd_px[at])
        used = (residuals.index[both] < lines) | (np.abs(residual) < OUTLIER_PX)
        rows, shape = residuals.rows[both][used], residuals.shape[both][used]
        # what joint, lobes and light explain is no scatter
        left = residual[used] - np.column_stack([rows[:, JOINT], shape]) @ form
        scattered = type(residuals)(left, rows, shape, sd[used], residuals.index[both][used])
        design = np.column_stack([rows[:, DEFLECTION], rows[:, FLATTENING], rows[:, JOINT], shape])
        gain, formal, _ = huber_gain(scattered, design, np.diag(np.concatenate([np.zeros(2), prior**-2.0])), lines)
        pull = np.zeros(len(formal))
        pull[2] = deformation[2] / prior[0] ** 2
        step = gain @ residual[used] - formal @ pull
        deformation += step[:3]
        form = step[3:]
        if np.abs(step[:3]).max() < LAST_STEP_RAD:
            break
    return deformation
