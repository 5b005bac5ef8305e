"""Write ``fire2.csv``: coefficients of Project FIRE II's reentry package at Mach 35.

NASA TN D-4183 (Scallion and Lewis, 1967), figure 4, to 80 deg angle of attack, through ytakahashi3123/Tacode (MIT);
beyond, C_A and C_N are held and C_m goes to zero at 180 deg (no flight comes there). C_A is scaled by 1.5009 / 1.4766
to the drag that NASA TN D-3569's trajectory has. Moments are about a station 0.029 m behind the c.g. C_mq: none is
published; zero. Run: ``python tools/fire2.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

DRAG = 6.1493e-3 * 86.568 / 0.354657  # table V's C_D S / m
ALPHA_DEG = np.arange(0.0, 85.0, 5.0)
CX = [-1.476646, -1.468530, -1.443102, -1.400661, -1.344875, -1.275804, -1.186595, -1.088248, -0.979200, -0.861136,
      -0.737601, -0.604404, -0.466066, -0.340006, -0.230257, -0.135077, -0.053381]  # fmt: skip
CR = [0.000000, 0.026874, 0.045794, 0.061385, 0.072412, 0.096876, 0.128480, 0.155730, 0.180691, 0.208168, 0.235433,
      0.259626, 0.285988, 0.332701, 0.394719, 0.442119, 0.474873]  # fmt: skip
CM = [0.000000, -0.011258, -0.022180, -0.032752, -0.042400, -0.050430, -0.057218, -0.061807, -0.064030, -0.063107,
      -0.059502, -0.052888, -0.043613, -0.030220, -0.014172, 0.001867, 0.016271]  # fmt: skip


def rows() -> np.ndarray:
    """Alpha deg, C_A, C_N, C_m, every 5 deg to 180, ``(37, 4)``."""
    alpha = np.arange(0.0, 181.0, 5.0)
    ends = [180.0]
    ca = np.interp(alpha, [*ALPHA_DEG, *ends], [*(-np.array(CX) * DRAG / -CX[0]), 0.0])
    cn = np.interp(alpha, [*ALPHA_DEG, *ends], [*CR, 0.0])
    cm = np.interp(alpha, [*ALPHA_DEG, *ends], [*CM, 0.0])
    return np.column_stack([alpha, ca, cn, cm])


if __name__ == "__main__":
    lines = ["# Project FIRE II, NASA TN D-4183 figure 4; made by fire2.py", "mach,alpha_deg,ca,cn,cm,cmq"]
    lines += [f"{mach},{a:g},{ca:.6f},{cn:.6f},{cm:.6f},0.0" for mach in (0, 35) for a, ca, cn, cm in rows()]
    table = Path(__file__).parents[1] / "flightmodel" / "data" / "aerodynamics" / "fire2.csv"
    table.write_text("\n".join(lines) + "\n")
