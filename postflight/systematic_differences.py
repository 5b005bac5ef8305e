"""How do two trajectories of one flight differ: by a clock, a datum, a frame, or within their covariances?

Another source's states are compared with the run at the other's own times; only the run is interpolated. Difference
is other minus run, position and velocity in north, east, down at the run's place, rotation in body axes. It is
explained by as few of these effects as its likelihood bears, each one constant of the flight:

====================  =================================================================================================
time-offset           other(t) = run(t - tau): its tags are late by tau
shift                 of position, along north, east, down at the middle of the track
height-datum          its heights are above the geoid and were taken above the ellipsoid: -N (EGM96) upwards
track-rotation        of positions and velocities about the first common place, about its north, east, down
inertial-velocity     its velocity is v + W x r, relative to inertial space
attitude-body         of the body axes (mounting, definition of the axes)
attitude-earth        of the axes that the attitude refers to (north, heading)
other-point           another point fixed in the body is followed
====================  =================================================================================================

Gauss-Newton on the exact effects, chosen one by one (and dropped again) by a likelihood in which each component has the
variance of its own residuals, and ``n / g`` independent ones of ``n``, ``g = 1 + 2 sum rho_k`` up to the first
correlation that is not positive. An effect of p parameters is named where it gains ``ln 1000`` over ``p/2 ln (n/g)``,
or where it is beyond the covariances. Its sd follows from the same residuals: how well the difference itself shows it.

What the two covariances allow is another number. Errors of covariance ``P_k`` (their sum, independent between the two)
at epoch k, with whatever correlation in time, are asked for the effects, ``d_k = H_k x``, by least squares with weights
``w_k`` that sum to one:

    x = M^-1 sum_k w_k H_k' P_k^-1 d_k,   M = sum_k w_k H_k' P_k^-1 H_k,   cov(x) <= M^-1

For ``c'x`` is a sum of terms with sds ``w_k s_k``: its own is ``sum w_k s_k`` at most, whose square is at most
``sum w_k s_k^2 = c'M^-1 c``. Likewise ``x' M x`` is at most a chi-square with as many degrees of freedom as ``x``: the
covariance of all whitened errors has blocks of one on its diagonal, hence with the weights no eigenvalue above one.
This holds for all weights that do not depend on the difference. They are those in which an effect is seen best, the
others being unknown too: the D_s-optimal design, by multiplication. ``stated_sd`` are the roots of the diagonal of its
``M^-1``, ``stated_size`` is the effect's size in it.

An effect is ``beyond`` the covariances where this size exceeds the root of chi-square's 99.9 % quantile (3.3 for one
component, 4.0 for three): then it is a fault of one of the two. Effects within are there all the same, and faults where
the two share data or solution. Where the other states no covariance, the residuals' variance stands for it.

Two effects have a known size. Inertial velocity is named where its estimated factor is 1 within 3 sd and 1 %. The datum
is taken as it is or not at all: whichever needs fewer effects, and leaves the likelier shift.

Chi-square per degree of freedom is averaged over epochs; however errors are correlated in time its mean is 1, and above
its 99.9 % quantile for one epoch the covariances do not explain the difference.

References
----------
Wolff, "Monte Carlo errors with less errors", Comput. Phys. Commun. 156 (2004) 143 (the inefficiency g).
Schwarz, "Estimating the dimension of a model", Ann. Statist. 6 (1978) 461.
Silvey, Titterington, Torsney, "An algorithm for optimal designs on a finite design space", Commun. Statist. A 7 (1978)
1379 (the multiplication). Atwood, "Optimal and efficient designs of experiments", Ann. Math. Statist. 40 (1969) 1570.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pandas as pd
from scipy.special import logsumexp

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.earth import undulation_m
from flightmodel.statistics import ACCEPTED_ODDS, chi_square_quantile, decimals, pair
from flightmodel.tabular import Tabular
from flightmodel.trajectory import Trajectory, interpolate_rows, resample
from postflight.intake.other_trajectory import OtherTrajectory

_LEAST_EPOCHS = 20  # fewer decide nothing among so many effects
_CONFIDENCE = 0.999  # one false alarm in a thousand comparisons
_FAR_S, _FAR_STEP_S = 40.0, 0.25  # of time offsets that are looked for: leap seconds, a second's slip
_MARGIN_S = 2.0 * _FAR_STEP_S  # about each of them
# resolution of files: below it nothing is claimed (m, m/s, rad)
_RESOLUTION = np.repeat([1e-3, 1e-3, np.deg2rad(1e-4)], 3)
_NED, _BODY = ("north", "east", "down"), ("x", "y", "z")
# part of the difference: unit in a column's name and in words, scale from SI, axes
_GROUPS = {
    "position": ("m", "m", 1.0, _NED),
    "velocity": ("mps", "m/s", 1.0, _NED),
    "attitude": ("deg", "deg", 180.0 / np.pi, _BODY),
}
GROUPS = tuple(_GROUPS)
# effect: components, unit, scale from SI, step of the numerical derivative, parts of the difference that show it
_EFFECTS: dict[str, tuple[tuple[str, ...], str, float, float, tuple[str, ...]]] = {
    "time-offset": (("",), "ms", 1e3, 1e-3, GROUPS),
    "inertial-velocity": (("",), "of W x r", 1.0, 0.1, ("velocity",)),
    "shift": (_NED, "m", 1.0, 1.0, ("position",)),
    "track-rotation": (_NED, "deg", 180.0 / np.pi, 1e-5, ("position", "velocity")),
    "attitude-body": (_BODY, "deg", 180.0 / np.pi, 1e-5, ("attitude",)),
    "attitude-earth": (_NED, "deg", 180.0 / np.pi, 1e-5, ("attitude",)),
    "other-point": (_BODY, "m", 1.0, 0.1, ("position", "velocity")),
}
_WORDS = {
    "time-offset": "its time tags are late by",
    "height-datum": "its heights are above the geoid and were taken above the ellipsoid, so that they lie higher by",
    "inertial-velocity": "its velocity is inertial, not relative to the Earth: factor",
    "shift": "its positions are shifted by",
    "track-rotation": "its track is turned about the first common place by",
    "attitude-body": "its body axes are turned by",
    "attitude-earth": "its attitude is turned in Earth axes by",
    "other-point": "it follows another point of the body, in body axes at",
}


@dataclass(frozen=True)
class FoundEffect:
    """One systematic difference, other minus run.

    Parameters
    ----------
    name : str
        Key of the module's table.
    components : tuple of str
    value, sd, stated_sd : (p,) float
        In ``unit``; ``stated_sd`` is what both covariances allow, NaN for a datum.
    unit : str
    stated_size : float
        Size, over its components, in what both covariances allow; infinite for a datum.
    """

    name: str
    components: tuple[str, ...]
    value: FloatArray
    sd: FloatArray
    stated_sd: FloatArray
    unit: str
    stated_size: float = np.inf

    @property
    def words(self) -> str:
        """What differs and by how much, with the sd that the difference shows and the one that is stated."""
        parts = [
            f"{name} {pair(v, s)}".strip() for name, v, s in zip(self.components, self.value, self.sd, strict=True)
        ]
        size = [f"together {np.linalg.norm(self.value):.{decimals(self.sd.max())}f}"] if len(parts) > 1 else []
        size += [f"{self.stated_size:.1f} sd by the covariances"] if np.isfinite(self.stated_size) else []
        return f"{_WORDS[self.name]} {', '.join(parts)} {self.unit}" + (f" ({'; '.join(size)})" if size else "")

    @property
    def beyond(self) -> bool:
        """Whether it is larger than both covariances allow."""
        if self.name in ("height-datum", "inertial-velocity"):
            return True
        return self.stated_size > _most_size(len(self.value))


@dataclass(frozen=True, repr=False)
class SystematicDifferences(Tabular):
    """Another source's trajectory against a run's.

    Parameters
    ----------
    label : str
        The other's name.
    time_s : (n,) float
        The other's times, after the run's time zero.
    given, left : (n, m) float
        Difference as it is, and less the effects; ``m`` is 3 for each of ``groups``: m, m/s, rad.
    sd : (n, m) float
        By both covariances.
    groups : tuple of str
    effects : tuple of FoundEffect
        In the order in which they explain most.
    chi_square : dict of str to (float, float, float)
        By group, and ``all``: mean per degree of freedom as given, less the effects, and the limit.
    both_stated : bool
        Whether the other states covariances.
    notes : tuple of str
    """

    label: str
    time_s: FloatArray
    given: FloatArray
    left: FloatArray
    sd: FloatArray
    groups: tuple[str, ...]
    effects: tuple[FoundEffect, ...]
    chi_square: dict[str, tuple[float, float, float]]
    both_stated: bool
    notes: tuple[str, ...] = field(default=())

    def to_frame(self) -> pd.DataFrame:
        """One row a component of an effect: ``effect, component, value, sd, stated_sd, unit, stated_size, beyond``."""
        rows = [
            (effect.name, *row, effect.unit, effect.stated_size, effect.beyond)
            for effect in self.effects
            for row in zip(effect.components, effect.value, effect.sd, effect.stated_sd, strict=True)
        ]
        names = ["effect", "component", "value", "sd", "stated_sd", "unit", "stated_size", "beyond"]
        return pd.DataFrame(rows, columns=names)

    def histories(self) -> pd.DataFrame:
        """Differences over time, as given and ``left``, with their sd; units in the columns' names."""
        columns = {"t_s": self.time_s}
        for at, group in enumerate(self.groups):
            unit, _, scale, axes = _GROUPS[group]
            for k, axis in enumerate(axes, 3 * at):
                for what, values in (("", self.given), ("_left", self.left), ("_sd", self.sd)):
                    columns[f"{group}_{axis}{what}_{unit}"] = scale * values[:, k]
        return pd.DataFrame(columns)

    def rms(self, group: str) -> tuple[float, float]:
        """Root mean square of the difference's size as given and less the effects, in m, m/s, deg."""
        at, scale = 3 * self.groups.index(group), _GROUPS[group][2]
        given, left = (
            scale * float(np.sqrt((d[:, at : at + 3] ** 2).sum(axis=1).mean())) for d in (self.given, self.left)
        )
        return given, left

    @cached_property
    def paragraph(self) -> str:
        """What was found, in one paragraph."""
        span = f"{len(self.time_s)} epochs from {self.time_s[0]:.2f} to {self.time_s[-1]:.2f} s"
        words, found = f"{self.label} against the run, {span}. ", bool(self.effects)
        for beyond, head in ((True, "Beyond"), (False, "Within")):
            parts = [effect.words for effect in self.effects if effect.beyond == beyond]
            words += f"{head} what the covariances allow, {'; '.join(parts)}. " if parts else ""
        words += "" if found else "No systematic difference is found. "
        changes = []
        for group in self.groups:
            given, left = self.rms(group)
            change = f"{group} {given:.3g}" + (f" to {left:.3g}" if found else "")
            changes.append(f"{change} {_GROUPS[group][1]}")
        words += f"Rms of the difference: {', '.join(changes)}. "
        given, left, limit = self.chi_square["all"]
        whose = "both covariances" if self.both_stated else "the run's covariance alone (the other states none)"
        words += f"Chi-square per degree of freedom with {whose}: {given:.3g}"
        words += f", {left:.3g} less these. " if found else ". "
        if (left if found else given) > limit:
            words += f"Above {limit:.1f} the covariances do not explain the difference, however correlated in time. "
        words += "Errors of the two are taken as independent; where they share data less is allowed."
        return words

    def _about(self) -> str:
        return f"{self.label}: {', '.join(e.name for e in self.effects) or 'no systematic difference'}"


def systematic_differences(
    run: Trajectory, covariance_time_s: FloatArray, covariance: FloatArray, other: OtherTrajectory
) -> SystematicDifferences:
    """Find what separates another source's trajectory from the run's.

    Parameters
    ----------
    run : Trajectory
        Its attitude may be missing. Rates missing in a gap are interpolated, since only a lever arm needs them.
    covariance_time_s : (k,) float
    covariance : (k, 9, 9) float
        Of the run, in the coordinates of `flightmodel.trajectory.difference`.
    other : OtherTrajectory

    Raises
    ------
    GateError
        ``time-not-covered`` where fewer than 20 of the other's epochs lie in the run.
    """
    run = _with_rates(run)
    stated = covariance_time_s, covariance
    starts = [s for s in (0.0, *_far_offset(run, other)) if _covered(run, other.time_s, s).sum() >= _LEAST_EPOCHS]
    found = [_Fit(run, stated, other, start_s).explained() for start_s in starts or [0.0]]
    best = max(found, key=lambda explained: explained.score)
    # where the geoid is so far from the ellipsoid, a datum can be separated from a shift
    if np.abs(best.fit.undulation_m).min() > 5.0:
        best = _with_datum(best, _Fit(run, stated, other, best.fit.start_s, datum=True))
    return _result(best)


def _with_rates(run: Trajectory) -> Trajectory:
    """Trajectory with missing rates interpolated between those that were measured; as it is where none was."""
    known = np.isfinite(run.omega_body_eci_body_radps).all(axis=1)
    if known.all() or not known.any():
        return run
    rates = interpolate_rows(run.time_s, run.time_s[known], run.omega_body_eci_body_radps[known])
    return replace(run, omega_body_eci_body_radps=rates)


def _with_datum(best: _Explained, datum: _Fit) -> _Explained:
    """Return the likelier set: the effects found, or those with heights above the geoid."""
    # one by one from the start, and those found without it: neither way of choosing must speak for or against the datum
    with_shift, no_shift = (*best.names, "shift"), tuple(name for name in best.names if name != "shift")
    sets = (datum.explained(), *(datum.solved(tuple(dict.fromkeys(names))) for names in (with_shift, no_shift)))
    by_datum = max(sets, key=lambda found: found.odds_over(sets[0]) + _shift_odds(found, sets[0]))
    # the same effects with a shift in the datum's place: what else differs must not speak for the datum
    without = best.fit.solved(tuple(dict.fromkeys((*by_datum.names, "shift"))))
    gains = [by_datum.odds_over(rival) + _shift_odds(by_datum, rival) for rival in (best, without)]
    return by_datum if min(gains) > ACCEPTED_ODDS else best


def _covered(run: Trajectory, time_s: FloatArray, offset_s: float) -> BoolArray:
    """Mask of times that, shifted by an offset, the run covers with a margin on both sides."""
    margin = _MARGIN_S + 2.0 * _EFFECTS["time-offset"][3]  # derivatives step beyond it
    return np.asarray(
        (time_s - offset_s >= run.time_s[0] + margin) & (time_s - offset_s <= run.time_s[-1] - margin), dtype=bool
    )


def _far_offset(run: Trajectory, other: OtherTrajectory) -> list[float]:
    """Time offset at which both tracks have the same shape, if it is far from zero and fits far better."""
    offsets = np.arange(-_FAR_S, _FAR_S + _FAR_STEP_S, _FAR_STEP_S)
    scatter = np.full(len(offsets), np.inf)
    few = np.unique(np.linspace(0, len(other.time_s) - 1, 300).astype(int))
    t, place = other.time_s[few], other.position_ecef_m[few]
    for k, offset in enumerate(offsets):
        use = _covered(run, t, float(offset))
        if use.sum() >= max(_LEAST_EPOCHS, len(few) // 3):
            apart = place[use] - interpolate_rows(t[use] - offset, run.time_s, run.position_ecef_m)
            scatter[k] = float(apart.std(axis=0).max())
    if not np.isfinite(scatter).any():
        return []
    best, none = int(scatter.argmin()), int(np.abs(offsets).argmin())
    far = abs(offsets[best]) >= 2.0 * _FAR_STEP_S and not scatter[none] < 2.0 * scatter[best]
    return [float(offsets[best])] if far else []


# the model


class _Fit:
    """Difference and effects at the other's epochs."""

    def __init__(
        self,
        run: Trajectory,
        stated: tuple[FloatArray, FloatArray],
        other: OtherTrajectory,
        start_s: float,
        datum: bool = False,
    ) -> None:
        use = np.flatnonzero(_covered(run, other.time_s, start_s))
        if len(use) < _LEAST_EPOCHS:
            spans = [f"{t[0]:.2f} to {t[-1]:.2f} s" for t in (run.time_s, other.time_s)]
            words = f"{len(use)} of its epochs lie in the run ({spans[0]}); its own are {spans[1]}"
            raise GateError(f"{other.label}: {words}; {_LEAST_EPOCHS} are wanted", "time-not-covered")
        # the effects are smooth; their covariance is a matrix of nine times as many rows
        use = use[np.unique(np.linspace(0, len(use) - 1, min(len(use), 800)).astype(int))]
        self.run, self.stated, self.other, self.use, self.start_s, self.datum = run, stated, other, use, start_s, datum
        self.time_s = other.time_s[use]
        has_attitude = bool(np.isfinite(run.q_ecef_body).all())
        known = True, other.velocity_ecef_mps is not None, has_attitude and other.q_ecef_body is not None
        self.groups = tuple(group for group, is_known in zip(GROUPS, known, strict=True) if is_known)
        self.parts = np.concatenate([np.arange(3) + 3 * GROUPS.index(group) for group in self.groups])
        self.known: dict[float, Trajectory] = {}
        whole = self._run_at(start_s)
        self.latitude, self.longitude, _ = earth.geodetic_from_ecef(whole.position_ecef_m, whole.planet)
        self.dcm_ned_ecef = earth.dcm_ned_ecef(self.latitude, self.longitude)
        self.middle = self.dcm_ned_ecef[len(use) // 2]
        self.undulation_m = undulation_m(self.latitude, self.longitude)
        first_s = np.clip(other.time_s[0] - start_s, run.time_s[0], None)
        self.centre_m = resample(run, np.array([first_s])).position_ecef_m[0]
        latitude, longitude, _ = earth.geodetic_from_ecef(self.centre_m, whole.planet)
        self.first = earth.dcm_ned_ecef(float(latitude), float(longitude))
        self.names = tuple(
            name
            for name, (*_, shown) in _EFFECTS.items()
            if set(shown) & set(self.groups) and (has_attitude or name != "other-point")
        )
        sizes = [len(_EFFECTS[name][0]) for name in self.names]
        ends = np.cumsum(sizes).tolist()
        self.slices = {name: slice(end - n, end) for name, n, end in zip(self.names, sizes, ends, strict=True)}
        self.count = sum(sizes)
        self.covariances = _stated(self)
        self.covariance = np.sum(self.covariances, axis=0) + np.diag(_RESOLUTION[self.parts] ** 2)
        self.root = np.linalg.cholesky(self.covariance)

    def _run_at(self, offset_s: float) -> Trajectory:
        """The run at the epochs less a time offset; the last few are kept, as derivatives ask for one again."""
        if offset_s not in self.known:
            if len(self.known) > 8:
                self.known.clear()
            self.known[offset_s] = resample(self.run, self.time_s - offset_s)
        return self.known[offset_s]

    def difference(self, x: FloatArray) -> FloatArray:
        """Other minus run with the effects ``x`` (count,) applied, (n, m)."""
        get = {name: x[at] for name, at in self.slices.items()}
        none = np.zeros(3)
        path = self._run_at(self.start_s + float(get["time-offset"][0]))
        turn = rotations.exp(self.first.T @ get.get("track-rotation", none))
        place = self.centre_m + rotations.rotate(turn, path.position_ecef_m - self.centre_m)
        place = place + self.middle.T @ get["shift"]
        if self.datum:
            place = place + self.undulation_m[:, None] * self.dcm_ned_ecef[:, 2]
        velocity = rotations.rotate(turn, path.velocity_ecef_mps)
        if "inertial-velocity" in get:
            carried = np.cross(path.planet.rate_ecef_radps, path.position_ecef_m)
            velocity = velocity + get["inertial-velocity"][0] * carried
        if "other-point" in get:
            arm = rotations.rotate(path.q_ecef_body, np.broadcast_to(get["other-point"], (len(self.time_s), 3)))
            rate = rotations.rotate(path.q_ecef_body, path.omega_body_eci_body_radps) - path.planet.rate_ecef_radps
            place, velocity = place + arm, velocity + np.cross(rate, arm)
        out = [np.einsum("nij,nj->ni", self.dcm_ned_ecef, self.other.position_ecef_m[self.use] - place)]
        if self.other.velocity_ecef_mps is not None:
            gap = self.other.velocity_ecef_mps[self.use] - velocity
            out.append(np.einsum("nij,nj->ni", self.dcm_ned_ecef, gap))
        if "attitude" in self.groups and self.other.q_ecef_body is not None:
            turned = rotations.multiply(rotations.exp(self.middle.T @ get["attitude-earth"]), path.q_ecef_body)
            turned = rotations.boxplus(turned, get["attitude-body"])
            out.append(rotations.boxminus(self.other.q_ecef_body[self.use], turned))
        return np.hstack(out)

    def jacobian(self, x: FloatArray, names: tuple[str, ...]) -> FloatArray:
        """Derivative of what some effects predict, (n, m, p), by central differences."""
        columns = []
        for name in (name for name in self.names if name in names):
            at, step = self.slices[name], _EFFECTS[name][3]
            for k in range(at.start, at.stop):
                away = np.zeros(self.count)
                away[k] = step
                columns.append((self.difference(x - away) - self.difference(x + away)) / (2.0 * step))
        return np.stack(columns, axis=-1)

    # which effects

    def explained(self) -> _Explained:
        """Effects selected one by one; an effect is dropped if others make it unnecessary."""
        current = self.solved(("time-offset",) if self.start_s else ())
        while len(current.names) < len(self.names):
            more = [(*current.names, name) for name in self.names if name not in current.names]
            trials = [trial for names in more if self._possible(trial := self.solved(names, current.x))]
            best = max(trials, key=lambda t: t.odds_over(current), default=None)
            if best is None or best.odds_over(current) < ACCEPTED_ODDS:
                # a lasting effect can look like one long correlated error, of a size that the covariances exclude
                best = max(trials, key=_size_of_last, default=None)
                if best is None or _size_of_last(best) < 1.0:
                    break
            current = best
            for name in current.names[:-1]:
                fewer = self.solved(tuple(n for n in current.names if n != name), current.x)
                needless = current.odds_over(fewer) < ACCEPTED_ODDS and _Allowed.of(current, name).size_in_limit < 1.0
                if self._possible(fewer) and needless:
                    current = fewer
        return current

    def _possible(self, fit: _Explained) -> bool:
        """Whether an inertial-velocity effect, if it is in the set, has a factor consistent with one."""
        if "inertial-velocity" not in fit.names:
            return True
        at = self.slices["inertial-velocity"]
        return bool(abs(float(fit.x[at][0]) - 1.0) < 3.0 * float(fit.sd()[at][0]) + 0.01)

    def solved(self, names: tuple[str, ...], x: FloatArray | None = None) -> _Explained:
        """Weighted least squares of some effects, weights by their own residuals; the other effects are none.

        It starts with the covariances' weights: what an effect that is not solved yet leaves must not set its weight.
        """
        x = np.zeros(self.count) if x is None else x
        used = np.zeros(self.count, dtype=bool)
        for name in names:
            used[self.slices[name]] = True
        x, late = np.where(used, x, 0.0), self.slices["time-offset"]
        left = self.difference(x)
        noise = _Noise.of(left, self.parts)
        slope = self.jacobian(x, names) if names else np.empty((*left.shape, 0))
        # a few steps of Gauss-Newton: the effects are nearly linear
        for step in range(5 if names else 0):
            if step:
                a, b = slope / noise.sd_effective[:, None], left / noise.sd_effective
            else:
                whole = np.linalg.solve(self.root, np.concatenate([slope, left[..., None]], axis=-1))
                a, b = whole[..., :-1], whole[..., -1]
            x = x.copy()
            x[used] += _least_squares(a.reshape(-1, int(used.sum())), b.ravel())
            x[late] = np.clip(x[late], -_MARGIN_S, _MARGIN_S)
            left = self.difference(x)
            noise = _Noise.of(left, self.parts)
        return _Explained(self, names, used, x, left, slope, noise)


def _least_squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """Normal equations with columns of length one: of nine components 800 times, ten times as fast as a QR."""
    length = np.sqrt((a**2).sum(axis=0))
    a = a / length
    return np.asarray(_pseudo_inverse(a.T @ a) @ (a.T @ b) / length)


@dataclass(frozen=True)
class _Noise:
    """Noise of residuals (n, m): variance of each component and number of independent ones among n."""

    variance: FloatArray
    inefficiency: FloatArray
    epochs: int

    @classmethod
    def of(cls, left: FloatArray, parts: FloatArray) -> _Noise:
        n = len(left)
        padded = np.fft.rfft(left, 2 * n, axis=0)
        lagged = np.fft.irfft(np.abs(padded) ** 2, axis=0)[:n]
        rho = lagged / np.maximum(lagged[0], 1e-300)
        first = np.argmax(rho <= 0.0, axis=0)
        upto = np.where((rho <= 0.0).any(axis=0), first, n)
        g = np.array([1.0 + 2.0 * rho[1:end, k].sum() for k, end in enumerate(upto)])
        return cls((left**2).mean(axis=0) + _RESOLUTION[parts] ** 2, np.clip(g, 1.0, n / 2.0), n)

    @property
    def sd_effective(self) -> FloatArray:
        """Sd (m,) that makes n correlated residuals weigh as much as their independent ones."""
        return np.sqrt(self.variance * self.inefficiency)


@dataclass(frozen=True)
class _Explained:
    """Solution for a set of effects."""

    fit: _Fit
    names: tuple[str, ...]
    used: BoolArray
    x: FloatArray
    left: FloatArray
    slope: FloatArray
    noise: _Noise

    @property
    def value(self) -> FloatArray:
        """The effects (count,), the time offset with that from which it was looked for."""
        value = self.x.copy()
        value[self.fit.slices["time-offset"]] += self.fit.start_s
        return value

    @property
    def score(self) -> float:
        """Larger is better: how small the residuals of position are."""
        return -float(np.log(self.noise.variance[:3]).sum())

    def odds_over(self, fewer: _Explained) -> float:
        """Log odds over another set; the better fit says how many residuals are independent."""
        closer = min(self.noise, fewer.noise, key=lambda noise: float(np.log(noise.variance).sum()))
        independent = closer.epochs / closer.inefficiency
        gain = float((independent * np.log(fewer.noise.variance / self.noise.variance)).sum())
        more = int(self.used.sum()) - int(fewer.used.sum())
        return 0.5 * gain - 0.5 * more * float(np.log(max(independent.mean(), 2.0)))

    def _gain(self) -> FloatArray:
        """Matrix (p, n, m) that takes differences to the effects."""
        root = 1.0 / self.noise.sd_effective
        a = (self.slope * root[:, None]).reshape(-1, int(self.used.sum()))
        inverse = np.linalg.pinv(a, rcond=1e-12)
        return inverse.reshape(-1, *self.left.shape) * root

    def sd(self) -> FloatArray:
        """Sd (count,) by the residuals; NaN of effects that are not in the set."""
        out = np.full(self.fit.count, np.nan)
        out[self.used] = np.sqrt((self._gain() ** 2 * self.noise.sd_effective**2).sum(axis=(1, 2)))
        return out


def _shift_odds(one: _Explained, other: _Explained) -> float:
    """Log odds of the shift's size in one set of effects over that in another; a set without one has size zero.

    What both covariances allow is the largest scale of a shift; two files of one solution differ by far less. So its
    scale is any from a thousandth of that on, evenly in its logarithm.
    """
    having = [found for found in (one, other) if "shift" in found.names]
    if not having:
        return 0.0
    at = one.fit.slices["shift"]
    scatter, allowed = np.diag(having[0].sd()[at] ** 2), _Allowed.of(having[0], "shift").covariance
    covariance = np.geomspace(1e-3, 1.0, 60)[:, None, None] ** 2 * allowed + scatter
    inverse, (_, log_det) = np.linalg.inv(covariance), np.linalg.slogdet(covariance)
    logs = [
        logsumexp(-0.5 * (np.einsum("i,nij,j->n", found.x[at], inverse, found.x[at]) + log_det))
        for found in (one, other)
    ]
    return float(logs[0] - logs[1])


# the covariances


def _stated(fit: _Fit) -> tuple[FloatArray, ...]:
    """Covariances (n, m, m) at the epochs, in the difference's axes: the run's, and the other's where it states one."""
    other = fit.other
    found = [_local(fit, _interpolated(*fit.stated, fit.time_s))]
    if len(other.covariance_time_s):
        theirs = _interpolated(other.covariance_time_s, other.covariance, fit.time_s)
        whole = np.zeros((len(theirs), 9, 9))
        size = theirs.shape[1]
        whole[:, :size, :size] = theirs
        found.append(_local(fit, whole))
    return tuple(found)


@dataclass(frozen=True)
class _Allowed:
    """Effect that errors with the stated covariances can produce: covariance (p, p), and the size of the one found."""

    covariance: FloatArray
    size: float

    @property
    def size_in_limit(self) -> float:
        """Size over the one exceeded in one flight in 1000."""
        return self.size / _most_size(len(self.covariance))

    @classmethod
    def of(cls, found: _Explained, name: str) -> _Allowed:
        """Bound with the epoch weights that determine this effect best, while the other effects are free."""
        fit, noise = found.fit, found.noise
        asked = np.concatenate([np.full(len(_EFFECTS[n][0]), n == name) for n in fit.names if n in found.names])
        unit = np.sqrt((found.slope**2 / noise.variance[:, None]).mean(axis=(0, 1)))  # brings all columns to one size
        slope = found.slope / unit
        # of another that states no covariance its scatter stands for it
        unstated = len(fit.covariances) == 1
        rows = np.linalg.solve(fit.covariance + unstated * np.diag(noise.variance), slope)
        information = np.einsum("nmp,nmq->npq", slope, rows)
        weight = _best_seen(information, asked)
        allowed = _pseudo_inverse(np.einsum("n,npq->pq", weight, information))
        x = allowed @ np.einsum("n,nmp,nm->p", weight, rows, found.left) + found.value[found.used] * unit
        x, allowed = x[asked], allowed[np.ix_(asked, asked)]
        size = float(np.sqrt(x @ _pseudo_inverse(allowed) @ x))
        return cls(allowed / np.outer(unit[asked], unit[asked]), size)


def _size_of_last(found: _Explained) -> float:
    """Size of the effect added last, over what the covariances allow."""
    return _Allowed.of(found, found.names[-1]).size_in_limit


def _most_size(count: int) -> float:
    """Size that an effect with so many components exceeds in one flight in 1000."""
    return float(np.sqrt(chi_square_quantile(_CONFIDENCE, count)))


def _best_seen(information: FloatArray, asked: BoolArray) -> FloatArray:
    """Weights (n,) of epochs near the D_s-optimal design of the parameters asked for; information is (n, p, p)."""
    weight = np.full(len(information), 1.0 / len(information))
    others = ~asked
    # towards the optimal weights; any weights give a bound, these are within percents of the least
    for _ in range(40):
        whole = np.einsum("n,npq->pq", weight, information)
        seen = np.einsum("pq,nqp->n", _pseudo_inverse(whole), information)
        inverse = _pseudo_inverse(whole[others][:, others])
        seen = np.maximum(seen - np.einsum("pq,nqp->n", inverse, information[:, others][:, :, others]), 0.0)
        if not (weight * seen).any():  # the others explain all that it does
            break
        weight = weight * seen / (weight @ seen)
    return weight


def _pseudo_inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a symmetric matrix; directions that nothing shows are left out."""
    return np.asarray(np.linalg.pinv(matrix, rcond=1e-12, hermitian=True))


def _interpolated(time_s: FloatArray, covariance: FloatArray, at_s: FloatArray) -> FloatArray:
    """Covariances at other times, linear between stated ones, kept beyond them."""
    rows = interpolate_rows(at_s, time_s, covariance.reshape(len(covariance), -1))
    return rows.reshape(-1, *covariance.shape[1:])


def _local(fit: _Fit, covariance: FloatArray) -> FloatArray:
    """Position and velocity turned to north, east, down; the groups that are compared."""
    turn = np.zeros((len(covariance), 9, 9))
    turn[:, :3, :3] = turn[:, 3:6, 3:6] = fit.dcm_ned_ecef
    turn[:, 6:, 6:] = np.eye(3)
    turned = turn @ np.nan_to_num(covariance) @ np.swapaxes(turn, 1, 2)
    return turned[:, fit.parts[:, None], fit.parts]


def _result(best: _Explained) -> SystematicDifferences:
    fit, other = best.fit, best.fit.other
    x, sd = best.value, best.sd() if best.names else best.x
    effects = []
    if fit.datum:
        higher = np.array([-float(fit.undulation_m.mean())])
        error = np.array([1.0])  # of EGM96 by the half degree, 1 sd
        effects.append(FoundEffect("height-datum", ("",), higher, error, np.full(1, np.nan), "m"))
    for name in best.names:
        components, unit, scale, *_ = _EFFECTS[name]
        at, allowed = fit.slices[name], _Allowed.of(best, name)
        values = scale * x[at], scale * sd[at], scale * np.sqrt(np.diag(allowed.covariance))
        effects.append(FoundEffect(name, components, *values, unit, allowed.size))
    none = np.zeros(fit.count)
    none[fit.slices["time-offset"]] = -fit.start_s
    plain = _Fit(fit.run, fit.stated, other, fit.start_s)
    given = plain.difference(none if _covered(fit.run, fit.time_s, 0.0).all() else np.zeros(fit.count))
    chi_square = {}
    for group in ("all", *fit.groups):
        rows = np.arange(len(fit.parts)) if group == "all" else np.arange(3) + 3 * fit.groups.index(group)
        inverse = np.linalg.inv(fit.covariance[:, rows[:, None], rows])
        both = (given[:, rows], best.left[:, rows])
        before, after = (float(np.einsum("ni,nij,nj->n", d, inverse, d).mean()) for d in both)
        degrees = len(rows)
        chi_square[group] = before / degrees, after / degrees, chi_square_quantile(_CONFIDENCE, degrees) / degrees
    by_both_sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
    both_stated = len(fit.covariances) > 1
    return SystematicDifferences(
        other.label, fit.time_s, given, best.left, by_both_sd, fit.groups, tuple(effects), chi_square, both_stated,
        other.notes,
    )  # fmt: skip
