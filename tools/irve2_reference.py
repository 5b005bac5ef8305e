"""Write ``irve2_reference.csv``: the synthetic coefficients of the IRVE-II-class reference vehicle.

C_A at zero angle: for Mach >= 2.5, 1.094 times modified Newtonian plus base drag of 64 % of the vacuum limit, within
0.3 % of published 60 deg sphere-cone values; below, own rounding of blunt-cone data. Its shape with angle, C_N and
C_m: modified Newtonian (`flightmodel.sphere_cone`), C_N and C_m times k_N, which falls from 1.00 at Mach 5.7 to 0.45 at
3.5 and below: the value that reconciles the seed paper with itself. C_mq: a family-shaped table for 60 to 70 deg
capsules, unstable at small angles below Mach 3. None of it is IRVE-II's own data.

Run: ``python tools/irve2_reference.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flightmodel.sphere_cone import sphere_cone_closed_form, sphere_cone_quadrature, stagnation_cp

HALF_ANGLE = np.deg2rad(60.0)
SHAPE = (HALF_ANGLE, 0.38, 1.5, 3.0)
MACH = np.array([0.0, 0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 5.7, 8.0, 10.0])
ALPHA_DEG = np.arange(0.0, 181.0)
LOW_CA = {0.0: 0.97, 0.6: 0.97, 0.8: 1.03, 0.9: 1.08, 1.0: 1.17, 1.1: 1.30, 1.2: 1.39, 1.5: 1.46, 2.0: 1.54}
CMQ_MACH = np.array([0.6, 0.9, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 5.7])
CMQ_ALPHA_DEG = np.array([0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0])
CMQ = np.array(
    [
        [0.00, -0.02, -0.05, -0.10, -0.15, -0.20, -0.25],
        [0.30, 0.22, 0.08, -0.05, -0.15, -0.20, -0.25],
        [0.70, 0.52, 0.20, -0.06, -0.26, -0.36, -0.40],
        [0.60, 0.46, 0.18, -0.06, -0.24, -0.34, -0.40],
        [0.40, 0.31, 0.12, -0.07, -0.20, -0.29, -0.35],
        [0.25, 0.19, 0.06, -0.08, -0.18, -0.25, -0.30],
        [0.15, 0.11, 0.02, -0.08, -0.16, -0.21, -0.25],
        [0.05, 0.03, -0.02, -0.08, -0.13, -0.17, -0.20],
        [-0.15, -0.15, -0.15, -0.15, -0.15, -0.15, -0.15],
    ]
)


def axial_at_zero(mach: float) -> float:
    """C_A at zero angle of attack."""
    if mach in LOW_CA:
        return LOW_CA[mach]
    newtonian = sphere_cone_closed_form(np.array(0.0), *SHAPE)[0]
    return float(1.094 * stagnation_cp(mach) * newtonian + 0.64 * 2.0 / (1.4 * mach**2))


def shape_with_angle() -> np.ndarray:
    """C_A, C_N, C_m for Cp_max = 1 over ``ALPHA_DEG``, (a, 3)."""
    alpha = np.deg2rad(ALPHA_DEG)
    closed = np.stack(sphere_cone_closed_form(alpha, *SHAPE), axis=-1)
    beyond = np.array([sphere_cone_quadrature(a, *SHAPE) if a > HALF_ANGLE else (0.0, 0.0, 0.0) for a in alpha])
    return np.where((alpha <= HALF_ANGLE)[:, None], closed, beyond)


def rows() -> np.ndarray:
    """All rows of the table, (n, 6)."""
    shape = shape_with_angle()
    blocks = []
    for mach in MACH:
        k_n = float(np.interp(mach, [3.5, 5.7], [0.45, 1.0]))
        cpm = float(stagnation_cp(mach))
        ca = axial_at_zero(mach) * shape[:, 0] / shape[0, 0]
        by_alpha = [np.interp(np.clip(mach, 0.6, 5.7), CMQ_MACH, column) for column in CMQ.T]
        cmq = np.interp(ALPHA_DEG, CMQ_ALPHA_DEG, by_alpha)
        scaled = cpm * k_n * shape[:, 1:]
        blocks.append(np.column_stack([np.full_like(ALPHA_DEG, mach), ALPHA_DEG, ca, scaled, cmq]))
    return np.vstack(blocks)


if __name__ == "__main__":
    lines = ["# SYNTHETIC, made by tools/irve2_reference.py", "mach,alpha_deg,ca,cn,cm,cmq"]
    lines += [f"{m:g},{a:g},{ca:.6f},{cn:.6f},{cm:.6f},{cmq:.4f}" for m, a, ca, cn, cm, cmq in rows() + 0.0]
    table = Path(__file__).parents[1] / "flightmodel" / "data" / "aerodynamics" / "irve2_reference.csv"
    table.write_text("\n".join(lines) + "\n")
