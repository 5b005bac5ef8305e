"""How strong was the air's structure between the knots that may move? The flight tells.

A sounding's statistics carried on to a hundred metres are a guess, and a poor guess costs: gusts taken for stronger
than they were leave damping open and pull it down, gusts taken for weaker throw the offset off. So the share is taken
under which the readings are most probable, all unknowns integrated over by the linear problem.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from postflight.reconciliation.problem import Linear, Problem, Residuals, Unknowns
from postflight.reconciliation.steps import Normal

# shares of the structure between knots that the sounding's statistics would have
SHARES = np.geomspace(0.05, 2.0, 7)


def fine_air(problem: Problem, u: Unknowns) -> float:
    """Share of the air's structure between knots under which the readings are most probable, by the linear problem."""
    linear = problem.linear(u)
    tried = [replace(problem, air=replace(problem.air, fine=float(share))) for share in SHARES]
    evidence = np.array([_evidence(problem, other, u, linear) for other in tried])
    k = int(np.clip(evidence.argmax(), 1, len(SHARES) - 2))
    near = np.log(SHARES[k - 1 : k + 2])
    bend, slope, _ = np.polyfit(near, evidence[k - 1 : k + 2], 2)
    best = -0.5 * slope / bend if bend < 0.0 else np.log(SHARES[evidence.argmax()])
    return float(np.exp(np.clip(best, near[0], near[-1])))


def _evidence(problem: Problem, other: Problem, u: Unknowns, linear: Linear) -> float:
    """Logarithm of the readings' probability with other standard deviations, derivatives as in ``problem``."""
    sensors = np.divide(other.weight, problem.weight, out=np.zeros_like(other.weight), where=problem.weight > 0.0)
    joins = other.join_weight / problem.join_weight
    found = Residuals(linear.found.sensors * sensors, linear.found.joins * joins, 0.0)
    weighed = Linear(
        found,
        [(column, rows * by.ravel()[:, None]) for (column, rows), by in zip(linear.sensors, sensors, strict=True)],
        [(column, rows * by[:, None]) for (column, rows), by in zip(linear.joins, joins, strict=True)],
        linear.count,
    )
    normal = Normal(*other.normal(u, weighed))
    cost = (found.sensors**2).sum() + (found.joins**2).sum() + other.prior_cost(u)
    lowest = cost - normal.solve(normal.right) @ normal.right
    return float(other.log_weight - 0.5 * lowest - 0.5 * normal.log_det)
