"""Which law does a shell's joint follow in a load test on the ground?

A test gives moment (or load) and angle (or displacement) over time. The law is the vehicle file's: a spring ``F = K d +
K3 d^3``, and creep ``b`` behind it (standard linear solid)::

    angle = zero + d(F) + b,      tau b' + b = s / (1 - s) F / K

``zero`` is the angle that the instruments read without load, and the test may begin loaded, ``b`` at its start unknown.
Between rows the moment is straight, which makes the creep's step exact. Least squares; four laws are fitted (a straight
spring, with hardening, with creep, with both), and selected is the one of the lowest Bayesian information criterion
among those whose time constant lies inside the test: one as long as the test itself is drift, not creep.

What a law leaves is no noise but the shell's own ways, and lasts for many rows. So the error bars are those of
errors correlated as ``exp(-rows / L)``, with ``L`` by restricted likelihood, and the criterion counts independent rows.

Assumed: the joint's moment is known (quasi-static: no inertia), one axis, damping too small to be seen.

References
----------
W. N. Findley, J. S. Lai, K. Onaran, "Creep and Relaxation of Nonlinear Viscoelastic Materials", 1976, ch. 5.
G. Schwarz, "Estimating the dimension of a model", 1978. H. D. Patterson, R. Thompson, "Recovery of inter-block
information when block sizes are unequal", 1971 (restricted likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from flightmodel.checks import FloatArray, GateError, Issue, nearest_name
from flightmodel.tables import line_of, numbers, read_table
from flightmodel.units import read_unit

LABEL = "load test"
LAWS: tuple[tuple[str, ...], ...] = ((), ("hardening",), ("creep",), ("creep", "hardening"))
_LOADS = {"n": ("force", 1.0), "kn": ("force", 1e3), "lbf": ("force", 4.4482216152605)} | {
    "nm": ("moment", 1.0), "knm": ("moment", 1e3), "lbfft": ("moment", 1.3558179483314),
}  # fmt: skip
LEAST_ROWS, MOST_ROWS = 20, 2000  # more rows than that are thinned: their residuals are no more independent
MOST_SHARE = 0.9  # as the vehicle file
AT_BOUND = 0.02  # of a logarithm


@dataclass(frozen=True)
class LoadTest:
    """Time, s, moment in the joint, N m, and its angle, rad, each ``(n,)``."""

    name: str
    time_s: FloatArray
    moment_nm: FloatArray
    angle_rad: FloatArray

    @property
    def largest_rad(self) -> float:
        """Range of the angle."""
        return float(np.ptp(self.angle_rad))


def read_load_test(
    path: Path,
    time: str = "t_s",
    load: str = "moment_nm",
    displacements: tuple[str, ...] = ("angle_deg",),
    arm_m: float | None = None,
) -> LoadTest:
    """Read a table of a load test.

    Parameters
    ----------
    path : Path
        CSV with a header.
    time, load : str
        Columns, with their unit behind the last ``_`` (``load_kn``), or stated as ``COLUMN:UNIT``. A load is a force
        (n, kn, lbf) or a moment (nm, knm, lbfft).
    displacements : tuple of str
        Columns of displacement (any length) or angle; the mean of several is taken.
    arm_m : float, optional
        Lever arm about the joint of a force and of a displacement.

    Raises
    ------
    GateError
        With every fault of the table.
    """
    frame, faults = read_table(path, LABEL, LEAST_ROWS - 1), list[Issue]()
    t = _column(frame, time, ("time",), None, path, faults)
    moment = _column(frame, load, ("force", "moment"), arm_m, path, faults)
    angles = [_column(frame, name, ("length", "angle"), arm_m, path, faults) for name in displacements]
    if t is not None and not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        faults.append(Issue(f"{LABEL}: {path}: line {line_of(frame, row)}: no time", "column-missing"))
    elif t is not None and np.any(np.diff(t) <= 0.0):
        row = int(np.argmax(np.diff(t) <= 0.0)) + 1
        words = f"{LABEL}: {path}: line {line_of(frame, row)}: time {t[row]:g} s is not after {t[row - 1]:g} s"
        faults.append(Issue(words, "time-backwards"))
    if faults:
        raise GateError(faults)
    assert t is not None
    assert moment is not None
    angle = np.mean([a for a in angles if a is not None], axis=0)
    known = np.isfinite(moment) & np.isfinite(angle)
    every = -(-int(known.sum()) // MOST_ROWS) or 1
    test = LoadTest(path.stem, *(column[known][::every] for column in (t, moment, angle)))
    if len(test.time_s) < LEAST_ROWS:
        words = f"{LABEL}: {path}: {len(test.time_s)} rows with load and displacement; {LEAST_ROWS} are needed"
        raise GateError(words, code="too-few-rows")
    if not (np.ptp(test.moment_nm) > 0.0 and test.largest_rad > 0.0):
        raise GateError(f"{LABEL}: {path}: load and displacement must both change", code="too-few-data")
    if np.polyfit(test.moment_nm, test.angle_rad, 1)[0] <= 0.0:
        words = f"{LABEL}: {path}: displacement falls as the load grows; change the sign of one of them"
        raise GateError(words, code="load-sign")
    return test


def _column(
    frame: pd.DataFrame, asked: str, kinds: tuple[str, ...], arm_m: float | None, path: Path, faults: list[Issue]
) -> FloatArray | None:
    """Column in SI; a force or a length with the arm as moment or angle."""
    name, _, unit = asked.partition(":")
    unit = unit or name.rsplit("_", 1)[-1]
    if name not in frame.columns:
        columns = ", ".join(frame.columns)
        hint = nearest_name(name, list(frame.columns))
        faults.append(Issue(f"{LABEL}: {path}: no column '{name}'{hint}; columns: {columns}", "column-missing"))
        return None
    read = read_unit(unit)
    kind, factor = _LOADS.get(unit.lower()) or ((read.kind, read.factor) if read else ("unknown", 1.0))
    if kind not in kinds:
        words = f"{LABEL}: {path}: column '{name}': unit '{unit}' is not one of {' or '.join(kinds)}; write"
        faults.append(
            Issue(f"{words} {name}:UNIT (n, kn, lbf, nm, knm, lbfft; m, mm, deg, rad; s, min)", "unit-unknown")
        )
        return None
    values = numbers(frame, name, path, LABEL, faults) * factor
    if kind not in ("force", "length"):
        return values
    if arm_m is None:
        words = f"{LABEL}: {path}: column '{name}' is a {kind}: state its lever arm about the joint with --arm-m"
        faults.append(Issue(words, "input-missing"))
        return None
    return values * arm_m if kind == "force" else values / arm_m


@dataclass(frozen=True)
class LawFit:
    """A law fitted to a load test.

    Parameters
    ----------
    test : LoadTest
    laws : tuple of str
        ``"hardening"``, ``"creep"``, both or none.
    x : (p,) float
        Logarithm of the stiffness, zero angle, then of the laws in the order ``creep`` (delayed compliance over the
        spring's, logarithm of the time constant, creep at the start), ``hardening`` (growth of the spring's slope at
        the largest angle). Angles count in the test's range, moments in its largest.
    covariance : (p, p) float
    residual_rad : (n,) float
    together : float
        How many rows err together.
    """

    test: LoadTest
    laws: tuple[str, ...]
    x: FloatArray
    covariance: FloatArray
    residual_rad: FloatArray
    together: float

    @property
    def rms_share(self) -> float:
        """Rms residual as a fraction of the largest displacement."""
        return float(np.sqrt(np.mean(self.residual_rad**2))) / self.test.largest_rad

    @property
    def time_is_inside(self) -> bool:
        """Whether the time constant lies inside its bounds."""
        low, high = np.log(_time_bounds(self.test))
        return "creep" not in self.laws or bool(low + AT_BOUND < self.x[3] < high - AT_BOUND)

    def criterion(self, independent: float) -> float:
        """Bayesian information criterion with so many independent rows."""
        return float(2.0 * independent * np.log(self.rms_share) + len(self.x) * np.log(independent))

    def table(self) -> pd.DataFrame:
        """One row a quantity of the vehicle file: ``quantity, value, sd``."""
        sd, test = np.sqrt(np.diag(self.covariance)), self.test
        stiffness = float(np.exp(self.x[0])) * _moment_scale(test) / test.largest_rad
        rows = [("bending_stiffness_nmprad", stiffness, stiffness * sd[0])]
        if "hardening" in self.laws:
            # the slope grows by x at the largest angle: 3 K3 d^2 = x K
            per = stiffness / (3.0 * test.largest_rad**2)
            rows.append(("hardening_nmprad3", per * self.x[-1], per * float(np.hypot(sd[-1], self.x[-1] * sd[0]))))
        if "creep" in self.laws:
            delayed, time_s = self.x[2], float(np.exp(self.x[3]))
            rows.append(("creep_share", delayed / (1.0 + delayed), sd[2] / (1.0 + delayed) ** 2))
            rows.append(("creep_time_s", time_s, time_s * sd[3]))
        return pd.DataFrame(rows, columns=["quantity", "value", "sd"])

    def vehicle_file_lines(self) -> str:
        """Lines of a vehicle file, the error bars behind them."""
        head = f"# load test {self.test.name}: rms {100.0 * self.rms_share:.1f} % of the largest displacement"
        rows = [f"{r.quantity} = {r.value:.6g}  # +/- {r.sd:.2g}" for r in self.table().itertuples(index=False)]
        return "\n".join([head, "[joint]", *rows]) + "\n"


@dataclass(frozen=True)
class ShellTest:
    """All laws fitted to one test."""

    fits: tuple[LawFit, ...]

    @cached_property
    def selected(self) -> LawFit:
        """Law with the lowest criterion and its time constant inside the test; independent rows as in the best fit."""
        usable = [fit for fit in self.fits if fit.time_is_inside]
        best = min(usable, key=lambda fit: fit.rms_share)
        independent = max(len(best.residual_rad) / best.together, 2.0)
        return min(usable, key=lambda fit: fit.criterion(independent))

    def table(self) -> pd.DataFrame:
        """One row a law: ``law, rms_percent, largest_percent, selected``, then each quantity and its sd."""
        rows = []
        for fit in self.fits:
            largest = float(np.abs(fit.residual_rad).max()) / fit.test.largest_rad
            about = {"law": " and ".join(fit.laws) or "straight", "rms_percent": 100.0 * fit.rms_share}
            about |= {"largest_percent": 100.0 * largest, "selected": fit is self.selected}
            for r in fit.table().itertuples(index=False):
                about |= {r.quantity: r.value, f"{r.quantity}_sd": r.sd}
            rows.append(about)
        return pd.DataFrame(rows)


def fit_laws(test: LoadTest) -> ShellTest:
    """Fit every law to a test."""
    return ShellTest(tuple(_fitted(test, laws) for laws in LAWS))


def _fitted(test: LoadTest, laws: tuple[str, ...]) -> LawFit:
    low, high = np.log(_time_bounds(test))
    lower, upper = [-np.inf, -np.inf], [np.inf, np.inf]
    starts = [
        [-float(np.log(np.polyfit(test.moment_nm, test.angle_rad, 1)[0] * _moment_scale(test) / test.largest_rad)), 0.0]
    ]
    if "creep" in laws:
        lower, upper = [*lower, 0.0, low, -np.inf], [*upper, MOST_SHARE / (1.0 - MOST_SHARE), high, np.inf]
        length = float(np.ptp(test.time_s))
        # first time constants, of the length of the test: a few percent, and a third
        starts = [[*starts[0], 0.3, float(np.clip(np.log(part * length), low, high)), 0.0] for part in (0.03, 0.3)]
    if "hardening" in laws:
        lower, upper, starts = [*lower, 0.0], [*upper, np.inf], [[*start, 0.1] for start in starts]

    def off(x: FloatArray) -> FloatArray:
        return (predicted(test, laws, x) - test.angle_rad) / test.largest_rad

    found = min(
        (least_squares(off, start, bounds=(lower, upper), x_scale="jac") for start in starts), key=lambda one: one.cost
    )
    residual = -np.asarray(found.fun) * test.largest_rad
    keep, variance = _persistence(found.jac, found.fun)
    covariance = _covariance(found.jac, keep, variance)
    return LawFit(test, laws, np.asarray(found.x), covariance, residual, (1.0 + keep) / (1.0 - keep))


def _persistence(slope: FloatArray, off: FloatArray) -> tuple[float, float]:
    """Correlation of a row's error with the next one's and variance of the errors, by restricted likelihood.

    The parameters have taken part of the slow errors away: residuals seem shorter and smaller than the errors were.
    """
    n, p = slope.shape

    def whitened(values: FloatArray, keep: float) -> FloatArray:
        return np.concatenate([values[:1], (values[1:] - keep * values[:-1]) / np.sqrt(1.0 - keep**2)])

    best = -np.inf, 0.0, 0.0
    # errors may last from a fifth of a row, which is white, to the length of the test
    for keep in np.exp(-1.0 / np.geomspace(0.2, n, 40)).tolist():
        q, r = np.linalg.qr(whitened(slope, keep))
        left = whitened(off, keep)
        square = float(left @ left - np.sum((q.T @ left) ** 2))
        determinant = float(np.log(np.abs(np.diag(r))).sum())
        likelihood = -0.5 * (n - p) * np.log(square) - determinant - 0.5 * (n - 1) * np.log(1.0 - keep**2)
        best = max(best, (likelihood, keep, square / (n - p)))
    return best[1], best[2]


def _covariance(slope: FloatArray, keep: float, variance: float) -> FloatArray:
    """Covariance (p, p) of least squares whose errors are correlated from row to row."""
    inverse = np.linalg.pinv(slope.T @ slope)
    rows = np.arange(len(slope))
    correlated = keep ** np.abs(rows[:, None] - rows)
    return np.asarray(variance * inverse @ slope.T @ correlated @ slope @ inverse)


def _time_bounds(test: LoadTest) -> tuple[float, float]:
    """Bounds of a time constant that a test can resolve: from two rows to its length, s."""
    return 2.0 * float(np.median(np.diff(test.time_s))), float(np.ptp(test.time_s))


def _moment_scale(test: LoadTest) -> float:
    return float(np.abs(test.moment_nm).max())


def predicted(test: LoadTest, laws: tuple[str, ...], x: FloatArray) -> FloatArray:
    """Angle (n,), rad, of a law with parameters as in `LawFit`."""
    linear = test.moment_nm / _moment_scale(test) / np.exp(x[0])
    spring = _cubic(linear, x[-1] / 3.0) if "hardening" in laws else linear
    creep = lagged(test.time_s, x[2] * linear, float(np.exp(x[3])), float(x[4])) if "creep" in laws else 0.0
    return np.asarray(test.largest_rad * (spring + x[1] + creep))


def _cubic(load: FloatArray, cubic: float) -> FloatArray:
    """Root (n,) of ``d + cubic d^3 = load`` by Newton's steps, for a cubic term of no negative sign."""
    d = load.copy()
    for _ in range(60):
        step = (d + cubic * d**3 - load) / (1.0 + 3.0 * cubic * d * d)
        d -= step
        if np.abs(step).max() < 1e-12 * max(1.0, np.abs(d).max()):
            break
    return d


def lagged(time_s: FloatArray, load: FloatArray, lag_s: float, first: FloatArray | float = 0.0) -> FloatArray:
    """``b`` of ``lag b' + b = load``, ``(n, ...)``, from ``first`` on: creep under a load.

    Exact where the load is straight between its times (n,), s.
    """
    step = np.diff(time_s).reshape(-1, *[1] * (load.ndim - 1))
    keep, slope = np.exp(-step / lag_s), np.diff(load, axis=0) / step * lag_s
    ahead = load[1:] - slope - keep * (load[:-1] - slope)
    out = np.empty_like(load)
    out[0] = first
    for k in range(len(step)):
        out[k + 1] = keep[k] * out[k] + ahead[k]
    return out
