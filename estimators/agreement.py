"""Do the methods agree, and if not, what is most likely wrong?

The difference of two methods' readings holds no deflection, only what they lean on::

    d(t) = read_a - read_b = -(J_a - J_b) x + e,      x ~ N(0, 1)

averaged over spans long against the joint's swinging. Its chi-square against that covariance is the test of a pair.
Which input is to blame is asked of each: how much likelier are all differences together if this one is `WIDER` times
less well known than stated? With their covariance ``C``, ``V = J' C^-1 J`` and ``s = J' C^-1 d`` the log of that is

    gain = s' (1/(WIDER^2 - 1) + V)^-1 s / 2 - log det(1 + (WIDER^2 - 1) V) / 2

An input that hardly bears on the differences gains nothing however far it is moved.

What the differences cannot tell apart is in the singular values of the whitened ``J``: a direction of the inputs with
the singular value ``s`` keeps ``1 / (1 + s^2)`` of its variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from estimators.evidence import ACCELEROMETER, ATTITUDE, FILM_CLOCK, PRESSURE, VEHICLE_INPUTS, WIND, Evidence
from flightmodel.checks import FloatArray

SPAN_S = 2.0
LEFT_OUT_RAD = np.deg2rad(0.05)  # of the methods' own equations, in each mean: up to 0.05 deg where the pulse ends
CONFIDENCE = 0.99
WIDER = 4.0
CAMERA, PLANE_SD_RAD = "camera", np.deg2rad(15.0)
LARGEST_SD_RAD = np.deg2rad(1.0)  # of a reading that is held against another
LARGEST_GAIN = np.log(100.0)  # odds at which one input is taken as wrong though every pair passes
BLAME = {
    "aerodynamic coefficients": ("C_A", "C_N", "C_m", "C_mq"),
    "accelerometer's mounting or bias": (ACCELEROMETER,),
    "initial c.g. offset": ("initial offset y", "initial offset z"),
    "mass properties": tuple(n for n in VEHICLE_INPUTS if n.startswith(("aeroshell", "centerbody"))),
    "attitude of the trajectory": (ATTITUDE,),
    "sounded wind": (WIND,),
    "sounded density": (PRESSURE,),
    "camera's orientation, benchmark or plane": (CAMERA,),
    "film's clock": (FILM_CLOCK,),
}


@dataclass(frozen=True)
class Pair:
    """Test of two methods: ``chi_square`` of ``degrees`` and the chance of a larger one."""

    methods: tuple[str, str]
    chi_square: float
    degrees: int
    chance: float

    @property
    def passed(self) -> bool:
        """Whether the difference is what the error bars allow."""
        return self.chance > 1.0 - CONFIDENCE


@dataclass(frozen=True)
class Agreement:
    """Every pair's test, the gain of each possible culprit, and the singular values of what tells them apart."""

    pairs: tuple[Pair, ...]
    gains: dict[str, float]
    singular_values: FloatArray

    @property
    def suspects(self) -> tuple[str, ...]:
        """Possible culprits, the likeliest first; none where every pair agrees."""
        if all(p.passed for p in self.pairs) and not max(self.gains.values(), default=0.0) > LARGEST_GAIN:
            return ()
        return tuple(sorted(self.gains, key=lambda name: -self.gains[name]))

    @property
    def words(self) -> str:
        """One sentence."""
        if not self.pairs:
            return "only one method answers: nothing to hold it against"
        if not self.suspects:
            return "the methods agree within their error bars"
        failed = [f"{a} and {b}" for a, b in (p.methods for p in self.pairs if not p.passed)]
        return (
            f"{', '.join(failed) or 'the methods'} disagree beyond their error bars: "
            f"the {self.suspects[0]} would explain it best"
        )


def agreement(evidence: list[Evidence]) -> Agreement:
    """Test all pairs of methods over the spans in which both answer, and score what they lean on."""
    told = [_means(e) for e in evidence]
    pairs: list[Pair] = []
    rows: list[_Difference] = []
    for a, b in combinations(told, 2):
        difference = _difference(a, b)
        if len(difference.time_s):
            rows.append(difference)
            d, cov = _flat(difference)
            square = float(d @ cho_solve(cho_factor(cov), d))
            pairs.append(Pair((a.method, b.method), square, len(d), float(chi2.sf(square, len(d)))))
    if not rows:
        return Agreement((), {}, np.empty(0))
    # the differences against the first method hold everything that all pairs do
    base = rows[: len(told) - 1]
    names = list(dict.fromkeys(n for r in base for n in r.by_input))
    jacobian, d, noise = _stacked(base, names)
    columns = np.concatenate(list(jacobian.values()), axis=1)
    factor = cho_factor(columns @ columns.T + noise)
    gains = {}
    for culprit, inputs in BLAME.items():
        more = WIDER**2 - 1.0
        mine = [_lasting(jacobian[n]) if n == CAMERA else jacobian[n] for n in inputs if n in jacobian]
        if CAMERA in inputs and mine:
            mine.append(_plane_turned(base, len(d)) / np.sqrt(more))
        if mine:
            j = np.concatenate(mine, axis=1)
            v, s = j.T @ cho_solve(factor, j), j.T @ cho_solve(factor, d)
            eye = np.eye(len(s))
            gains[culprit] = float(
                0.5 * s @ np.linalg.solve(eye / more + v, s) - 0.5 * np.linalg.slogdet(eye + more * v)[1]
            )
    white = np.linalg.solve(np.linalg.cholesky(noise), columns)
    return Agreement(tuple(pairs), gains, np.linalg.svd(white, compute_uv=False))


def _lasting(camera: FloatArray) -> FloatArray:
    """Columns of the camera's error that last: the first of each axis (`evidence.evidence_of_history`)."""
    return camera[:, [0, camera.shape[1] // 2]]


def _plane_turned(rows: list[_Difference], length: int) -> FloatArray:
    """Change ``(length, 1)`` of the differences by a camera whose plane is turned by `PLANE_SD_RAD`."""
    out, at = np.zeros((length, 1)), 0
    for row in rows:
        bent = row.reading_yz_rad
        assert bent is not None
        across = np.stack([-bent[:, 1], bent[:, 0]], axis=-1)
        if CAMERA in row.by_input:
            out[at : at + across.size, 0] = PLANE_SD_RAD * across.ravel()
        at += across.size
    return out


def _means(one: Evidence) -> Evidence:
    """Evidence averaged over spans of `SPAN_S`, counted from time zero so that methods' spans are the same."""
    known = np.trace(one.covariance, axis1=1, axis2=2) < LARGEST_SD_RAD**2
    keep = np.isfinite(one.theta_yz_rad).all(axis=1) & known
    span, which, count = np.unique(np.floor(one.time_s[keep] / SPAN_S), return_inverse=True, return_counts=True)
    share = np.zeros((len(span), int(keep.sum())))
    share[which, np.arange(share.shape[1])] = 1.0 / count[which]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.tensordot(share, values[keep], axes=1))

    return replace(
        one,
        time_s=(span + 0.5) * SPAN_S,
        theta_yz_rad=mean(one.theta_yz_rad),
        by_acceleration_s2=mean(one.by_acceleration_s2),
        by_input={name: mean(j) for name, j in one.by_input.items()},
        independent_cov=np.einsum("bn,nij->bij", share**2, one.independent_cov[keep]) + LEFT_OUT_RAD**2 * np.eye(2),
        bend=None,
    )


@dataclass(frozen=True)
class _Difference(Evidence):
    """Difference of two methods' readings, and the second's reading itself."""

    reading_yz_rad: FloatArray | None = None


def _difference(a: Evidence, b: Evidence) -> _Difference:
    """Readings of one less the other's in spans that both have."""
    time_s, i, j = np.intersect1d(a.time_s, b.time_s, return_indices=True)
    inputs = {name: response[i] for name, response in a.by_input.items()}
    for name, response in b.by_input.items():
        inputs[name] = inputs[name] - response[j] if name in inputs else -response[j]
    return _Difference(
        method=f"{a.method} less {b.method}",
        time_s=time_s,
        theta_yz_rad=a.theta_yz_rad[i] - b.theta_yz_rad[j],
        by_acceleration_s2=a.by_acceleration_s2[i] - b.by_acceleration_s2[j],
        by_input=inputs,
        reading_yz_rad=b.theta_yz_rad[j],
        independent_cov=a.independent_cov[i] + b.independent_cov[j],
        averaged_s=SPAN_S,
    )


def _flat(one: Evidence) -> tuple[FloatArray, FloatArray]:
    """Differences (2 n,) and their covariance."""
    jacobian, d, noise = _stacked([one], list(one.by_input))
    return d, sum((j @ j.T for j in jacobian.values()), noise)


def _stacked(rows: Sequence[Evidence], names: list[str]) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
    """Jacobians by input, differences and the covariance of what is independent, all spans of all rows in one.

    Rows that share a method share its independent part too; it is small beside the rest and taken as each row's own.
    """
    d = np.concatenate([r.theta_yz_rad.ravel() for r in rows])
    width = {n: next(r.by_input[n].shape[2] for r in rows if n in r.by_input) for n in names}
    jacobian = {
        n: np.concatenate(
            [
                r.by_input[n].reshape(-1, width[n]) if n in r.by_input else np.zeros((2 * len(r.time_s), width[n]))
                for r in rows
            ]
        )
        for n in names
    }
    noise = np.zeros((len(d), len(d)))
    at = 0
    for cov in (c for r in rows for c in r.independent_cov):
        noise[at : at + 2, at : at + 2] = cov
        at += 2
    return {n: -j for n, j in jacobian.items()}, d, noise
