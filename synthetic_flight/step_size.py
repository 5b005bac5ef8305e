"""Whether a step is short enough for a joint: Runge-Kutta's stability for its bending and its torsion.

A free joint's modes obey ``I'' s^2 + C s + K = 0``; a step h multiplies a mode by ``R(h s)``, with ``R(z) = 1 + z +
z^2/2 + z^3/6 + z^4/24``, and must not amplify it. A joint much stiffer than its flight needs is better locked.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import ConfigError, FloatArray
from flightmodel.vehicle import Vehicle

# steps of a mode times its fastest root's size: below this all damped modes are stable
SURELY_STABLE = 2.0


def joint_modes(vehicle: Vehicle) -> dict[str, tuple[float, float, float]]:
    """Effective inertia kg m^2, damping N m s/rad, stiffness N m/rad of bending and torsion of the free vehicle.

    Bending's inertia is that of the two bodies recoiling about their joint, with c.g.s taken on the axis.
    """
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    inertia = vehicle.transverse_inertia_about_joint()
    unbalance = [part.mass_kg * (part.cg_m[0] - vehicle.joint_m[0]) for part in (shell, body)]
    mass = np.diag(inertia) - np.outer(unbalance, unbalance) / vehicle.mass_kg
    apart = np.array([1.0, -1.0])
    bending = 1.0 / float(apart @ np.linalg.solve(mass, apart))
    torsion = 1.0 / float(1.0 / shell.inertia[0, 0] + 1.0 / body.inertia[0, 0])
    return {
        "bending": (bending, joint.bending_damping_nmsprad, joint.bending_stiffness_nmprad),
        "torsion": (torsion, joint.torsion_damping_nmsprad, joint.torsion_stiffness_nmprad),
    }


def largest_step_s(inertia: float, damping: float, stiffness: float) -> float:
    """Longest stable step of one mode, s; infinite where nothing moves."""
    roots = np.roots([inertia, damping, stiffness]).astype(complex)
    fastest = float(np.abs(roots).max())
    if fastest == 0.0:
        return np.inf
    # stability on the imaginary axis ends at 2.828, on the real axis at 2.785
    steps = np.linspace(SURELY_STABLE, 3.0, 2001) / fastest
    amplified = np.array([np.abs(_growth(roots * step)).max() > 1.0 + 1e-9 for step in steps])
    return float(steps[np.argmax(amplified)]) if amplified.any() else float(steps[-1])


def _growth(z: FloatArray) -> FloatArray:
    return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))


def check_step(vehicle: Vehicle, step_s: float) -> None:
    """Refuse a step that would blow up the joint; `ConfigError` says which mode, and the longest step.

    Springs harden with the bending angle; what is checked is their stiffness at rest.
    """
    for name, (inertia, damping, stiffness) in joint_modes(vehicle).items():
        if step_s * float(np.abs(np.roots([inertia, damping, stiffness])).max(initial=0.0)) < SURELY_STABLE:
            continue
        longest = largest_step_s(inertia, damping, stiffness)
        if step_s > longest:
            frequency = np.sqrt(stiffness / inertia) / (2.0 * np.pi)
            raise ConfigError(
                f"step of {1e3 * step_s:g} ms is too long for the joint's {name} at {frequency:.1f} Hz: at most "
                f"{1e3 * longest:.2g} ms is stable (better half of it); shorten time.step_s, or soften the joint"
            )
