"""Did the shell rock as one body, or did it change its shape under load too?

The seed paper read a rocking of its shell and could not say whether a local deformation was among it. A frame's fit
(`estimators.frame_solution`) finds, beside the deflection ``w``, the shell's flattening and its lobes of two to five
waves round the shell, ``s`` (13), each with a wide a priori sd about zero. Half of the shell is in view: one frame
separates lobes from rocking poorly. A film does better, as a shape that yields to the load grows with the dynamic
pressure ``q``::

    s_i = a l_i + f_i - f_b,    l_i = (q_i - q_b) / q_max,    f ~ Gauss-Markov with sd sigma

relative to the benchmark frame ``b``. The amplitudes ``a`` are the shell's, common to all its cameras. The part ``f``
is a shape that does not follow the load, and what the light on the shell makes look like one; each camera has its own.
That of the benchmark frame stands in all frames of its film, unloaded ones as well: as a constant beside the growth it
is estimated with the amplitudes. What a frame found is linear in its true shape, in the errors ``c`` of its camera's
pose and in the deflection ``d`` of the benchmark frame,

    found_i = G_i s_i + C_i c + B_i d + e_i,    G_i = 1 - P_i / P_prior,    cov(e_i) = P_i G_i'

with ``P_i`` the formal covariance of the shape, which takes the errors of points as independent. They are ``kappa``
times as large, as neighbours err alike, and new in every frame; to these come errors ``lambda`` times as large again
that change with the light (`LIGHT_TIME_S`) or not at all.
``w`` is free in every frame: nothing is assumed of the deflection. All is Gaussian, and the evidence of the films
decides between rocking alone and lobes of two waves, of three, of more, and of each combination; the shell may flatten
in each. Rocking alone has a prior probability of one half, the others share the rest. ``sigma``, ``kappa`` and
``lambda`` have a few sizes of equal probability.

The posterior of amplitudes and ``f_b``, a mixture over the hypotheses, is then the prior of every frame's shape: in the
frame's own posterior of ``(w, s)`` the wide prior about zero is replaced by the normal of ``s_i`` given ``a`` and
``f_b``, with ``r`` the correlation of ``f`` between frame and benchmark,

    N(a l_i - (1 - r) f_b, sigma^2 (1 - r^2)).

What is left of the error of ``a`` and ``f_b`` is common to all frames (`FrameFit.by_shape`): a shape that follows the
load must not pass for compliance of the joint.

Assumed: shapes of more than five waves, and of one torus alone, are in the residuals; the amplitudes' error is
independent of the cameras'.

References
----------
Seed paper, conclusions of the CAD-based estimate. D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4
(1992) 415, for the evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain, combinations, product

import numpy as np
import pandas as pd
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.special import softmax

from estimators.camera import FilmFit
from estimators.camera_fit import OrientedCamera
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from estimators.frame_residuals import ROUND_WAVES, WAVES
from estimators.frame_solution import AprioriSd, FrameFit
from flightmodel.checks import BoolArray, FloatArray, GateError, IntArray
from flightmodel.statistics import correlation, mixture_moments, paired_covariance, symmetric_root

_PARTS = [(w, f"{w} waves across the shell") for w in WAVES] + [(w, f"{w} waves of its radius") for w in ROUND_WAVES]
MODES = ("flattening", *(f"{what}, {wave}" for _, what in _PARTS for wave in ("cosine", "sine")))
"""Flattening and lobes, in the order of `estimators.frame_residuals.lobe_columns`."""
_WAVES_OF_MODE = np.array([0, *(w for w, _ in _PARTS for _ in range(2))])
LOBES = {"two waves": (2,), "three waves": (3,), "more waves": (4, 5)}
HYPOTHESES = tuple(chain.from_iterable(combinations(LOBES, k) for k in range(len(LOBES) + 1)))
"""Lobes that there are; the first: rocking alone."""
_PRIOR = np.array([0.5, *[0.5 / (len(HYPOTHESES) - 1)] * (len(HYPOTHESES) - 1)])
_FRAME_SDS_RAD = np.deg2rad([0.003, 0.01, 0.03, 0.1])  # of lobes that come and go, from none to a tenth of a degree
# over the formal errors, which take points as independent: those new in every frame, and those that last beside them
_NEW, _LASTING = (1.0, 1.5, 2.2, 3.3), (0.2, 0.7, 2.0)
_SIZES = tuple((new, lasting * new, size) for new, lasting, size in product(_NEW, _LASTING, _FRAME_SDS_RAD))
CALLED = 0.9  # probability from which an answer is called
_DETERMINED = 0.5  # of the a priori sd
LEAST_FRAMES, _MOST_FRAMES = 12, 60  # more frames of a film lie closer than their errors change
_LEAST_LOAD = 0.3  # of the film's largest, between frames: less shows no growth
_LEAST_OWN = 1e-4  # of the variance of a frame's own part: next to the benchmark frame none of it is its own
_UNSEEN = 1e-10  # of the largest information: a shape that the points do not show
_JITTER_RAD2 = float(np.deg2rad(1e-4) ** 2)  # where a frame shows nothing of a shape, what it found is exactly zero


def _alike(film: FilmFit) -> FloatArray:
    """Correlation (n,) of a frame's own part with the benchmark frame's."""
    return np.asarray(np.exp(-np.abs(film.time_s - film.benchmark_s) / LIGHT_TIME_S))


def load_shares(film: FilmFit, largest_pa: float) -> FloatArray:
    """Loads ``l`` (n,) relative to the benchmark frame's, over the largest of all films."""
    at = int(np.argmin(np.abs(film.time_s - film.benchmark_s)))
    return np.asarray((film.pressure_pa - film.pressure_pa[at]) / largest_pa)


def _loaded(film: FilmFit) -> IntArray:
    """Frames with an answer whose load is known, `_MOST_FRAMES` at the most."""
    known = [k for k, fit in enumerate(film.fits) if fit.shape is not None and np.isfinite(film.pressure_pa[k])]
    return np.array(known[:: max(1, -(-len(known) // _MOST_FRAMES))], dtype=int)


@dataclass(frozen=True)
class ShellShape:
    """How the shell's shape followed the load.

    Parameters
    ----------
    found_rad : (13 (1 + c),) float
        Amplitudes of `MODES` at the largest dynamic pressure, angles about the innermost ring, then minus the benchmark
        frame's own shape of each of the ``c`` films, over all hypotheses.
    found_covariance : (13 (1 + c), 13 (1 + c)) float
    if_any_rad, if_any_sd_rad : (13,) float
        With all lobes.
    probability : (8,) float
        Of `HYPOTHESES`.
    frame_sd_rad : float
        Of a frame's own shape.
    points_scale : float
        Errors of a frame's points, of both parts, over their formal ones.
    determined : (13,) bool
        Whether the films determined an amplitude better than half its a priori sd.
    largest_pa : float
        Largest dynamic pressure of the films.
    """

    found_rad: FloatArray
    found_covariance: FloatArray
    if_any_rad: FloatArray
    if_any_sd_rad: FloatArray
    probability: FloatArray
    frame_sd_rad: float
    points_scale: float
    determined: BoolArray
    largest_pa: float

    @property
    def amplitude_rad(self) -> FloatArray:
        """Amplitudes (13,)."""
        return self.found_rad[: len(MODES)]

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the amplitudes (13, 13)."""
        return self.found_covariance[: len(MODES), : len(MODES)]

    @property
    def rocking_alone(self) -> float:
        """Probability that the shell has no lobes under load."""
        return float(self.probability[0])

    @property
    def lobes(self) -> dict[str, float]:
        """Probability of lobes of each number of waves."""
        return {
            name: float(sum(p for p, there in zip(self.probability, HYPOTHESES, strict=True) if name in there))
            for name in LOBES
        }

    @property
    def call(self) -> str:
        """``rocking alone``, or the lobes, where beyond doubt (`CALLED`); else ``undecided``."""
        if self.rocking_alone >= CALLED:
            return "rocking alone"
        if self.rocking_alone > 1.0 - CALLED:
            return "undecided"
        sure = [name for name, probability in self.lobes.items() if probability >= CALLED]
        return f"lobes of {' and '.join(sure)}" if sure else "lobes"

    @property
    def verdict(self) -> str:
        """The call and its probability, for the end of a sentence."""
        return f"{self.call} ({100.0 * self.rocking_alone:.0f} % that the shell rocks without lobes)"

    def summary(self) -> dict[str, object]:
        """The call and the probabilities, for ``summary.json``."""
        return {"call": self.call, "rocking_alone": self.rocking_alone, "lobes": self.lobes}

    @property
    def remark(self) -> str:
        """One sentence."""
        sizes = []
        for name, waves in LOBES.items():
            here = np.isin(_WAVES_OF_MODE, waves)
            size = np.rad2deg(np.sqrt(np.sum(self.if_any_rad[here] ** 2)))
            sizes.append(f"{name} {size:.2f} deg ({100.0 * self.lobes[name]:.0f} %)")
        words = f"{self.verdict}; lobes at the largest load, if there are any: {', '.join(sizes)}"
        return f"{words}; the films determined {int(self.determined.sum())} of {len(MODES)} modes"

    def to_frame(self) -> pd.DataFrame:
        """One row a mode.

        Returns
        -------
        DataFrame
            ``mode, amplitude_deg, sd_deg`` (over all hypotheses, at the largest dynamic pressure, angles about the
            innermost ring), ``if_any_deg, if_any_sd_deg`` (with all lobes), ``probability`` (that the mode is there),
            ``determined``.
        """
        found = [1.0, *(p for w in _WAVES_OF_MODE[1:] for name, p in self.lobes.items() if w in LOBES[name])]
        degrees = {
            "amplitude_deg": self.amplitude_rad, "sd_deg": np.sqrt(np.diag(self.covariance)),
            "if_any_deg": self.if_any_rad, "if_any_sd_deg": self.if_any_sd_rad,
        }  # fmt: skip
        columns = {name: np.rad2deg(value) for name, value in degrees.items()}
        return pd.DataFrame({"mode": MODES, **columns, "probability": found, "determined": self.determined})


def shell_shape(films: list[FilmFit]) -> ShellShape:
    """Amplitudes of the shell's shape under load and the odds of the hypotheses.

    Parameters
    ----------
    films : list of FilmFit
        Of one shell, with their dynamic pressure; the planes estimated.

    Raises
    ------
    GateError
        Where frames are too few, or their loads too equal.
    """
    frames = sum(len(_loaded(one)) for one in films)
    if frames < LEAST_FRAMES:
        raise GateError(f"{frames} frames with a load where {LEAST_FRAMES} are needed", code="too-few-data")
    largest = max(float(np.nanmax(one.pressure_pa)) for one in films)
    loads = np.concatenate([load_shares(one, largest)[_loaded(one)] for one in films])
    if np.ptp(loads) < _LEAST_LOAD:
        raise GateError(
            f"the dynamic pressure of the frames varies by {100.0 * np.ptp(loads):.0f} % of the largest where "
            f"{100.0 * _LEAST_LOAD:.0f} % are needed",
            code="loads-alike",
        )
    prior = mode_sd_rad(films[0].oriented.apriori)
    stacked = {number: _Stacked.of(one, largest) for number, one in enumerate(films) if len(_loaded(one))}
    answers = []
    for sizes in _SIZES:
        prior_sd = np.append(prior, np.full(len(films) * len(MODES), sizes[-1]))
        log, information, right = _information(stacked, len(prior_sd), sizes)
        for number in range(len(HYPOTHESES)):
            answers.append(_Amplitudes.given(number, sizes, prior_sd, log, information, right))
    return _mixed(answers, prior, largest)


def mode_sd_rad(apriori: AprioriSd) -> FloatArray:
    """A priori sd of `MODES`, (13,)."""
    return np.array([apriori.flattening_rad, *apriori.lobe_sd_rad])


@dataclass(frozen=True)
class _Stacked:
    """Shape readings of a film (13 n,), their responses (13 n, 13), and covariances (13 n, 13 n) of their parts."""

    found: FloatArray
    to_load: FloatArray
    to_benchmark: FloatArray
    new: FloatArray
    lasting: FloatArray
    camera: FloatArray
    own: FloatArray

    @staticmethod
    def of(film: FilmFit, largest_pa: float) -> _Stacked:
        """``new``, ``lasting``: of the formal size; ``own``: of unit own shapes given the benchmark frame's."""
        rows, oriented = _loaded(film), film.oriented
        fits = [film.fits[k].shape for k in rows]
        formal = np.array([fit.formal[2:, 2:] for fit in fits])
        share = _share_found(formal, oriented.apriori)
        noise, time_s, alike = share @ formal, film.time_s[rows], _alike(film)[rows]
        root = symmetric_root(0.5 * (noise + noise.transpose(0, 2, 1)))
        camera = np.concatenate([fit.by_camera[2:] for fit in fits])
        start = np.concatenate([fit.by_benchmark[2:] for fit in fits]) * oriented.apriori.benchmark_rad
        light, together = np.array([fit.by_light[2:] for fit in fits]), correlation(time_s, LIGHT_TIME_S, CONSTANT_PART)
        return _Stacked(
            np.array([fit.found_rad[2:] for fit in fits]).ravel(),
            (share * load_shares(film, largest_pa)[rows, None, None]).reshape(-1, len(MODES)),
            (share * (1.0 - alike)[:, None, None]).reshape(-1, len(MODES)),
            block_diag(*noise),
            paired_covariance(root, together, root),
            camera @ oriented.posed_covariance @ camera.T + start @ start.T + paired_covariance(light, together, light),
            paired_covariance(share, correlation(time_s, LIGHT_TIME_S) - np.outer(alike, alike), share),
        )


def _information(
    films: dict[int, _Stacked], k: int, sizes: tuple[float, float, float]
) -> tuple[float, FloatArray, FloatArray]:
    """Logarithm of the evidence without amplitudes, and the information (k, k) on them and the benchmarks' shapes.

    ``films``: by their number, those with an answer.
    """
    m, log, information, right = len(MODES), 0.0, np.zeros((k, k)), np.zeros(k)
    new, lasting, own = sizes
    for number, one in films.items():
        covariance = new**2 * one.new + lasting**2 * one.lasting + one.camera + own**2 * one.own
        covariance[np.diag_indices_from(covariance)] += _JITTER_RAD2
        factor = cho_factor(covariance, lower=True, overwrite_a=True)
        respond = np.hstack([one.to_load, one.to_benchmark])
        solved = cho_solve(factor, np.column_stack([respond, one.found]))
        at = np.r_[0:m, m * (1 + number) : m * (2 + number)]
        information[np.ix_(at, at)] += respond.T @ solved[:, :-1]
        right[at] += respond.T @ solved[:, -1]
        log += -0.5 * float(one.found @ solved[:, -1]) - float(np.log(np.diag(factor[0])).sum())
    return log, information, right


@dataclass(frozen=True)
class _Amplitudes:
    """Posterior of amplitudes and benchmarks' shapes under a hypothesis and a size of the frames' own shapes."""

    number: int
    sizes: tuple[float, float, float]
    mean: FloatArray
    covariance: FloatArray
    log_evidence: float

    @staticmethod
    def given(
        number: int, sizes: tuple[float, float, float], prior_sd: FloatArray, log: float, information: FloatArray,
        right: FloatArray,
    ) -> _Amplitudes:  # fmt: skip
        """Of the information (k, k) and its mean's product (k,) that the films have on all modes."""
        waves = [w for name in HYPOTHESES[number] for w in LOBES[name]]
        there = np.flatnonzero(np.append(np.isin(_WAVES_OF_MODE, [0, *waves]), np.ones(len(prior_sd) - len(MODES))))
        within = np.linalg.inv(information[np.ix_(there, there)] + np.diag(prior_sd[there] ** -2.0))
        mean, covariance = np.zeros(len(prior_sd)), np.zeros((len(prior_sd), len(prior_sd)))
        mean[there] = within @ right[there]
        covariance[np.ix_(there, there)] = within
        gained = 0.5 * float(right[there] @ mean[there]) + 0.5 * float(np.linalg.slogdet(within)[1])
        return _Amplitudes(number, sizes, mean, covariance, log + gained - float(np.log(prior_sd[there]).sum()))


def _mixed(answers: list[_Amplitudes], prior_sd: FloatArray, largest_pa: float) -> ShellShape:
    """Mean and covariance over hypotheses and sizes."""
    log = np.array([one.log_evidence + np.log(_PRIOR[one.number]) for one in answers])
    weight = softmax(log)
    means, covariances = (np.array(x) for x in zip(*((one.mean, one.covariance) for one in answers), strict=True))
    mean, covariance = mixture_moments(weight, means, covariances)
    number = np.array([one.number for one in answers])
    with_all = weight * (number == len(HYPOTHESES) - 1)
    if_any, if_any_cov = mixture_moments(with_all / max(with_all.sum(), 1e-300), means, covariances)
    if_any, sd = if_any[: len(MODES)], np.sqrt(np.diag(if_any_cov))[: len(MODES)]
    new, lasting, size = np.sqrt(weight @ np.array([one.sizes for one in answers]) ** 2).tolist()
    scale, determined = float(np.hypot(new, lasting)), sd < _DETERMINED * prior_sd
    probability = np.bincount(number, weight, len(HYPOTHESES)).astype(float)
    return ShellShape(mean, covariance, if_any, sd, probability, size, scale, determined, largest_pa)


def with_shape(films: list[FilmFit], shape: ShellShape) -> list[FilmFit]:
    """Films with the answers of all frames given the shell's shape under their load, in the order of `shell_shape`."""
    return [_with_shape(film, number, shape) for number, film in enumerate(films)]


def _with_shape(film: FilmFit, number: int, shape: ShellShape) -> FilmFit:
    # of amplitudes and benchmarks' own shapes: what each frame shows of them
    parts, alike = np.zeros((len(film.fits), len(shape.found_rad) // len(MODES))), _alike(film)
    parts[:, 0], parts[:, 1 + number] = load_shares(film, shape.largest_pa), 1.0 - alike
    own = shape.frame_sd_rad**2 * np.maximum(1.0 - alike**2, _LEAST_OWN)
    fits = tuple(
        fit
        if fit.shape is None or not np.isfinite(part[0])
        else _given_shape(fit, part, float(var), shape, film.oriented)
        for fit, part, var in zip(film.fits, parts, own, strict=True)
    )
    return replace(film, fits=fits, shape_covariance=shape.found_covariance)


def _given_shape(
    fit: FrameFit, parts: FloatArray, own_var: float, shape: ShellShape, oriented: OrientedCamera
) -> FrameFit:
    """A frame's answer with its shape's distribution given the film's in place of the a priori one."""
    assert fit.shape is not None
    own, modes = fit.shape, slice(2, None)
    information = np.linalg.inv(own.formal) / shape.points_scale**2
    points = information.copy()
    points[modes, modes] -= np.diag(mode_sd_rad(oriented.apriori) ** -2.0) / shape.points_scale**2
    # the light that shifts all features is no error of single points: it is eliminated
    light = information @ own.by_light
    back = np.linalg.pinv(points, rcond=_UNSEEN, hermitian=True) @ light
    out = np.eye(len(points)) - light @ np.linalg.solve(np.eye(light.shape[1]) + light.T @ back, back.T)
    informed = out @ points
    informed[modes, modes] += np.eye(len(MODES)) / own_var
    formal: FloatArray = np.linalg.inv(0.5 * (informed + informed.T))[:2].astype(float)
    by_shape: FloatArray = np.kron(parts, formal[:, modes] / own_var).astype(float)
    again = formal @ out @ information
    answer = again @ own.found_rad + by_shape @ shape.found_rad
    by_camera, by_benchmark = again @ own.by_camera, again @ own.by_benchmark
    covariance = oriented.covariance_of(formal[:, :2], by_camera, by_benchmark)
    covariance = covariance + by_shape @ shape.found_covariance @ by_shape.T + fit.moved_var * np.eye(2)
    return replace(fit, rotation_yz_rad=answer, covariance=covariance, per_benchmark=by_benchmark, by_shape=by_shape)


def _share_found(formal: FloatArray, apriori: AprioriSd) -> FloatArray:
    """Gain ``G`` of the shape estimate on the true shape, from formal covariances (..., 13, 13)."""
    return np.eye(formal.shape[-1]) - formal * mode_sd_rad(apriori) ** -2.0
