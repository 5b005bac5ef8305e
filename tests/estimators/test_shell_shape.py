"""Rocking or local deformation: lobes found in films of another renderer, odds and error bars that hold."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from estimators.camera import FilmFit, read_film
from estimators.camera_fit import OrientedCamera
from estimators.edge import no_horizon
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from estimators.frame_residuals import FrameShape
from estimators.frame_solution import AprioriSd, FrameFit
from estimators.shell_shape import HYPOTHESES, LOBES, MODES, load_shares, mode_sd_rad, shell_shape, with_shape
from flightmodel.checks import NO_FAULT, GateError
from flightmodel.statistics import correlation
from synthetic_flight.film import Imaging, Scene, Warp
from synthetic_flight.film import film as rendered
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, sun

TIME_S = np.arange(421.0, 446.0, 1.0)
# of a frame's own shape, of its points' new errors over what they say, of lasting ones over these: as probable each
OWN_DEG, NEW, LASTING = (0.003, 0.01, 0.03, 0.1), (1.0, 1.5, 2.2, 3.3), (0.2, 0.7, 2.0)
PRESSURE_PA = 1200.0 * np.exp(-(((TIME_S - 438.0) / 7.0) ** 2))


@pytest.mark.parametrize("shape_deg", [(0.0, 0.3, 0.0, 0.0, -0.3), (0.2, 0.0, -0.3, 0.3, 0.0)])
def test_lobes_of_another_renderer_are_found_and_are_no_rocking(shape_deg):
    theta, plane = D(np.array([0.0, 3.5])), D(np.array([0.0, 190.0]))
    scene = Scene(theta, plane, np.stack([sun(40.0), sun(55.0)]), load=np.array([0.0, 1.0]))
    imaging = Imaging(loaded=Warp(*D(np.array(shape_deg)).tolist()))
    frames = list(rendered(GEOMETRY, MOUNT, JOINT_M, scene, np.random.default_rng(3), imaging))
    read = read_film(np.array([421.0, 440.0]), frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None)
    fit = read.fits[1]
    own, true = fit.shape, D(np.array([*shape_deg, *np.zeros(8)]))
    covariance = own.formal + own.by_camera @ read.oriented.posed_covariance @ own.by_camera.T
    # thirteen modes, of which half of the shell shows some only together: chi-square, 0.1 %
    off = own.found_rad[2:] - true
    assert off @ np.linalg.solve(covariance[2:, 2:], off) < 34.5
    assert own.found_rad[2:] @ np.linalg.solve(covariance[2:, 2:], own.found_rad[2:]) > 200.0
    assert abs(read.history().theta_rad[1] - theta[1]) < D(0.06)


def drawn(rng, there, formal_deg=0.02):
    """A film whose errors are drawn as the model states them, its true deflections and amplitudes.

    A frame's points determine deflection and shape, random directions of them poorly, and err by more than they say; a
    camera has twelve errors. What is no growth stands in the benchmark frame too.
    """
    n, apriori, m = len(TIME_S), AprioriSd(), len(MODES) + 2
    prior, mixed = mode_sd_rad(apriori), rng.standard_normal((m, m))
    points = np.linalg.inv(mixed @ np.diag(D(formal_deg) ** 2 * np.geomspace(0.1, 300.0, m)) @ mixed.T)
    whole = points.copy()
    whole[2:, 2:] += np.diag(prior**-2.0)
    formal = np.linalg.inv(whole)
    by_camera = rng.standard_normal((n, m, 12)) * D(0.01) * np.linspace(0.2, 1.0, n)[:, None, None]
    by_benchmark = np.tile(np.eye(m)[:, :2], (n, 1, 1)) + 0.1 * rng.standard_normal((n, m, 2))
    load = (PRESSURE_PA - PRESSURE_PA[0]) / PRESSURE_PA.max()
    waves = [mode.split()[0] for mode in MODES]
    has = np.isin(waves, ["flattening", *(str(w) for name in there for w in LOBES[name])])
    amplitude = has * prior * rng.standard_normal(len(MODES))
    size, new, lasting = D(rng.choice(OWN_DEG)), rng.choice(NEW), rng.choice(LASTING)
    own = np.linalg.cholesky(correlation(TIME_S, LIGHT_TIME_S)) @ rng.standard_normal((n, len(MODES))) * size
    shape = amplitude * load[:, None] + own - own[0]
    true = np.column_stack([D(4.0) * rng.standard_normal((n, 2)), shape])
    together = np.eye(n) + lasting**2 * correlation(TIME_S, LIGHT_TIME_S, CONSTANT_PART)
    noise = new * np.linalg.cholesky(together) @ rng.standard_normal((n, m)) @ np.linalg.cholesky(points).T
    camera, start = rng.standard_normal(12), apriori.benchmark_rad * rng.standard_normal(2)
    # the frame's own estimate, pulled towards a shape of zero
    found = np.einsum("ij,nj->ni", formal, true @ points + noise) + by_camera @ camera + by_benchmark @ start
    oriented = SimpleNamespace(apriori=apriori, posed_covariance=np.eye(12))
    oriented.covariance_of = partial(OrientedCamera.covariance_of, oriented)
    fits = tuple(
        FrameFit(
            found[k, :2], formal[:2, :2], by_benchmark[k, :2], 0.0, 0.0, 0.3, 100, no_horizon(NO_FAULT),
            shape=FrameShape(found[k], formal, by_camera[k], by_benchmark[k], np.zeros((m, 3))),
        )
        for k in range(n)
    )  # fmt: skip
    return FilmFit(TIME_S, fits, oriented, float(TIME_S[0]), None, 0.0, PRESSURE_PA), true, amplitude


@pytest.fixture(scope="module")
def many():
    """Hypotheses drawn from their prior; what was true, and the answers."""
    rng, rows = np.random.default_rng(8), []
    for _ in range(100):
        there = HYPOTHESES[rng.choice(8, p=[0.5, *[0.5 / 7.0] * 7])]
        film, true, amplitude = drawn(rng, there)
        shape = shell_shape([film])
        rows.append((there, shape, amplitude, true, film, with_shape([film], shape)[0]))
    return rows


def test_the_probabilities_are_those_of_being_right(many):
    """Of flights drawn from the prior, so many rock alone as the probabilities' sum says, and they tell them apart."""
    said = np.array([shape.rocking_alone for _, shape, *_ in many])
    alone = np.array([not there for there, *_ in many])
    # the number of those that do has the binomial variance of what was said
    assert abs(alone.sum() - said.sum()) < 3.0 * np.sqrt(np.sum(said * (1.0 - said)))
    assert said[alone].mean() > 0.7
    assert said[~alone].mean() < 0.3
    for _, shape, *_ in many:
        assert shape.probability.sum() == pytest.approx(1.0)


def test_amplitudes_err_as_they_say(many):
    """Over all hypotheses an error's mean square is its mean variance, whatever the distribution."""
    error = np.array([shape.amplitude_rad - true for _, shape, true, *_ in many])
    variance = np.array([np.diag(shape.covariance) for _, shape, *_ in many])
    # 0.1 % on either side, by the scatter of the squares themselves
    off = np.sum(error**2 - variance, axis=1)
    assert abs(off.mean()) < 3.3 * off.std() / np.sqrt(len(off))


def test_a_film_that_knows_its_shell_reads_the_deflection_better_and_says_so(many):
    errors, before, square = [], [], []
    for *_, true, film, better in many:
        k = int(np.argmax(PRESSURE_PA))
        fit, first = better.fits[k], film.fits[k]
        errors.append(fit.rotation_yz_rad - true[k, :2])
        before.append(first.rotation_yz_rad - true[k, :2])
        square.append(errors[-1] @ np.linalg.solve(fit.covariance, errors[-1]))
    assert np.mean(np.square(errors)) < np.mean(np.square(before))
    assert abs(np.mean(square) - 2.0) < 3.3 * np.sqrt(4.0 / len(square))


def test_a_camera_whose_error_grows_with_the_load_tells_less_of_the_shape():
    film, *_ = drawn(np.random.default_rng(31), (next(iter(LOBES)),))
    load = (PRESSURE_PA - PRESSURE_PA[0]) / PRESSURE_PA.max()
    alike = np.zeros((len(MODES) + 2, 12))
    alike[2:] = np.eye(len(MODES))[:, :12] * D(0.2)
    fits = tuple(
        replace(fit, shape=replace(fit.shape, by_camera=share * alike))
        for fit, share in zip(film.fits, load, strict=True)
    )
    of_pose = []
    for sd in (0.01, 1.0):
        oriented = SimpleNamespace(apriori=AprioriSd(), posed_covariance=sd**2 * np.eye(12))
        shape = shell_shape([replace(film, fits=fits, oriented=oriented)])
        of_pose.append(np.sqrt(np.diag(shape.covariance)))
    assert (of_pose[1][:12] > 1.5 * of_pose[0][:12]).any()


def test_two_cameras_tell_more_than_one():
    rng = np.random.default_rng(2)
    one, _, _ = drawn(rng, ())
    two, _, _ = drawn(rng, ())
    alone, both = shell_shape([one]), shell_shape([one, two])
    assert (both.if_any_sd_rad < alone.if_any_sd_rad).all()


def test_the_call_waits_for_nine_in_ten(many):
    for _, shape, *_ in many:
        alone = shape.rocking_alone
        wanted = "rocking alone" if alone >= 0.9 else "undecided" if alone > 0.1 else None
        assert shape.call == wanted or (wanted is None and shape.call.startswith("lobes"))
        assert f"{100.0 * alone:.0f} %" in shape.remark


def test_the_table_has_a_row_a_mode_in_degrees(many):
    shape = many[0][1]
    table = shape.to_frame()
    np.testing.assert_allclose(table.amplitude_deg, np.rad2deg(shape.amplitude_rad))
    assert table.probability[0] == pytest.approx(1.0)  # a shell may always flatten
    assert list(table.columns) == [
        "mode", "amplitude_deg", "sd_deg", "if_any_deg", "if_any_sd_deg", "probability", "determined",
    ]  # fmt: skip


def test_frames_of_one_load_tell_nothing():
    film, _, _ = drawn(np.random.default_rng(1), ())
    with pytest.raises(GateError) as refusal:
        shell_shape([replace(film, pressure_pa=np.full(len(TIME_S), 1000.0))])
    assert refusal.value.codes == ("loads-alike",)
    with pytest.raises(GateError) as refusal:
        shell_shape([replace(film, pressure_pa=np.where(np.arange(len(TIME_S)) < 5, PRESSURE_PA, np.nan))])
    assert refusal.value.codes == ("too-few-data",)


def test_the_film_s_shape_takes_the_place_of_the_frame_s_prior():
    """As a fit of the frame's points alone, with the film's shape for its prior, would have it."""
    rng = np.random.default_rng(5)
    films = [drawn(rng, ("two waves",))[0] for _ in range(2)]
    shape = replace(shell_shape(films), frame_sd_rad=float(D(0.1)), points_scale=2.0)
    k, m = int(np.argmax(PRESSURE_PA)), len(MODES)
    for number, film in enumerate(films):
        own, load = film.fits[k].shape, load_shares(film, shape.largest_pa)[k]
        alike = np.exp(-(TIME_S[k] - TIME_S[0]) / LIGHT_TIME_S)
        points = np.linalg.inv(own.formal)
        seen = points @ own.found_rad / 4.0
        points[2:, 2:] -= np.diag(mode_sd_rad(AprioriSd()) ** -2.0)
        points /= 4.0
        # a sum of two: (1 - r) of the benchmark frame's, and what is independent of it
        var = D(0.1) ** 2 * (1.0 - alike**2)
        points[2:, 2:] += np.eye(m) / var
        benchmark = shape.found_rad[m * (1 + number) : m * (2 + number)]
        seen[2:] += (load * shape.amplitude_rad + (1.0 - alike) * benchmark) / var
        np.testing.assert_allclose(
            with_shape(films, shape)[number].fits[k].rotation_yz_rad, np.linalg.solve(points, seen)[:2], rtol=1e-8
        )


def test_a_motion_of_the_picture_stays_in_the_variance():
    """The film's shape explains lobes, not a lens that zoomed."""
    one, k = drawn(np.random.default_rng(5), ("two waves",))[0], int(np.argmax(PRESSURE_PA))
    shape = shell_shape([one])
    fits = tuple(replace(fit, moved_var=D(0.3) ** 2) if j == k else fit for j, fit in enumerate(one.fits))
    moved = replace(one, fits=fits)
    sound, wider = (with_shape([film], shape)[0].fits[k].covariance for film in (one, moved))
    np.testing.assert_allclose(wider, sound + D(0.3) ** 2 * np.eye(2), rtol=1e-9)


def test_a_film_without_answers_leaves_the_others_theirs():
    rng = np.random.default_rng(6)
    film, dark = (drawn(rng, ())[0] for _ in range(2))
    refused = tuple(replace(fit, shape=None) for fit in dark.fits)
    none = replace(dark, fits=refused)
    both, alone = shell_shape([film, none]), shell_shape([film])
    np.testing.assert_allclose(both.amplitude_rad, alone.amplitude_rad, rtol=1e-6, atol=1e-12)
    assert with_shape([film, none], both)[1].fits == refused
