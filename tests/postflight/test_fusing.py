"""One method at fault: it is left out and named, or the answer's sd grows by what the methods disagree."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import fusing
from estimators.agreement import OFFSET
from estimators.evidence import moved_vehicle
from estimators.fusing import _mixed, fuse_flight
from estimators.fusion import fuse
from flightmodel.checks import Check, DivergenceError, Issue
from flightmodel.deflection import UNIFORM_VAR, DeflectionHistory, history_from_lateral
from postflight.deflections import Deflections, borne_out, quantiles_at
from tests.estimators.conftest import VEHICLE, pulse_of

N = 160
TIME_S = 430.0 + 0.05 * np.arange(N)
K = N // 2
SD = np.deg2rad(0.15)


def motion(time_s=TIME_S):
    x = (time_s - 434.0) / 4.0
    size = np.deg2rad(4.0) * np.exp(-(x**2)) + np.deg2rad(0.4) * np.sin(2 * np.pi * 0.6 * (time_s - 430.0))
    return size[:, None] * np.array([0.8, -0.6])


def film(yz, time_s=TIME_S, sd=SD):
    return history_from_lateral(time_s, yz, np.tile(sd**2 * np.eye(2), (len(time_s), 1, 1)), "camera", "")


def sound(vehicle=VEHICLE):
    return pulse_of(np.random.default_rng(2), N, motion(), vehicle)[0]


def error_sd(answer):
    """Error at the middle along the deflection, over its sd, and that sd, deg."""
    history = answer.history
    k = int(np.argmin(np.abs(history.time_s - TIME_S[K])))
    off = history.theta_rad[k] - np.linalg.norm(motion()[K])
    return off / history.theta_sd_rad[k], np.rad2deg(history.theta_sd_rad[k])


def test_sound_methods_are_all_used():
    answer = fuse_flight(sound(), film(motion()))
    assert answer.left_out is None
    assert answer.alternatives == ()
    assert all(check.passed for check in answer.consistency_checks)
    assert abs(error_sd(answer)[0]) < 1.0
    assert error_sd(answer)[1] < 0.15


SPOILT = {
    "mirrored": film(motion() * [1.0, -1.0]),
    "bent benchmark": film(motion() + np.deg2rad([2.0, 1.0])),
    "one end swings the other way": film(-motion()),
    "late": film(motion(TIME_S - 1.5)),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_bad_film_is_left_out_and_named(name):
    answer = fuse_flight(sound(), SPOILT[name])
    assert answer.left_out == "camera"
    red = [check for check in answer.consistency_checks if not check.passed]
    assert {check.code for check in red} <= {"deflection-methods", "camera-time-bias"}
    assert {check.source for check in red} == {"camera"}
    assert abs(error_sd(answer)[0]) < 1.5
    # the others' answer is not spoilt by it
    without = fuse_flight(sound(), None)
    assert error_sd(answer)[1] == pytest.approx(error_sd(without)[1])


def test_a_film_that_is_early_by_most_of_a_period_has_its_time_bias():
    bias = fuse_flight(sound(), film(motion(TIME_S + 1.5))).camera_time_bias
    assert bias.is_off
    assert bias.offset_s == pytest.approx(-1.5, abs=4.0 * bias.sd_s)


def test_a_time_bias_is_found_without_the_trim_where_all_methods_have_no_answer(monkeypatch):
    def diverging(read, **kwargs):
        if any(e.method == "trim" for e in read({}, None)):
            raise DivergenceError("it still moves", code="not-converged")
        return fuse(read, **kwargs)

    monkeypatch.setattr(fusing, "fuse", diverging)
    bias = fusing.time_bias_if_free(sound(), film(motion(TIME_S + 1.5)))
    assert bias.offset_s == pytest.approx(-1.5, abs=4.0 * bias.sd_s)


def test_a_film_carries_the_answer_through_a_gap_of_the_sensors():
    loads = sound()
    gap = TIME_S[K] + np.array([-1.5, 1.5])
    loads = loads.rows((loads.time_s < gap[0]) | (loads.time_s > gap[1]))
    filmed, without = (fuse_flight(loads, f).history for f in (film(motion()), None))
    inside = (filmed.time_s > gap[0]) & (filmed.time_s < gap[1])
    assert np.diff(filmed.time_s).max() < 0.06
    off = filmed.theta_rad[inside] - np.linalg.norm(motion(filmed.time_s[inside]), axis=1)
    assert np.abs(off / filmed.theta_sd_rad[inside]).max() < 3.0
    # a film alone knows it less well than all methods
    assert np.median(filmed.theta_sd_rad[inside]) > 1.2 * np.median(filmed.theta_sd_rad[~inside])
    # no answer is far from a reading
    assert np.diff(without.time_s).max() == pytest.approx(2.0, abs=0.11)


def test_a_turned_accelerometer_is_left_out():
    loads = sound()
    # the force alone is turned by 2 deg, far beyond what its bias and mounting are known to; the attitude is right
    turn = np.deg2rad(2.0) * loads.specific_force_body_mps2[:, :1] * [0.0, 1.0, 0.0]
    loads = replace(loads, specific_force_body_mps2=loads.specific_force_body_mps2 + turn)
    answer = fuse_flight(loads, film(motion()))
    assert answer.left_out == "misalignment"
    assert abs(error_sd(answer)[0]) < 2.0


def test_an_offset_of_the_wrong_sign_is_named_and_costs_accuracy_not_truth():
    x, y, z = VEHICLE.centerbody.cg_from_datum_body_m
    body = VEHICLE.centerbody.model_copy(update={"cg_from_datum_body_m": (x, -y, -z)})
    loads = sound(replace(VEHICLE, centerbody=body))
    answer = fuse_flight(loads, film(motion()))
    assert answer.left_out == "trim" or OFFSET in answer.agreement.likeliest
    assert not answer.consistency_checks[0].passed
    assert abs(error_sd(answer)[0]) < 2.0


def test_two_methods_that_disagree_answer_with_a_sd_of_their_difference():
    # no film: nothing can tell which of the two is right
    x, y, z = VEHICLE.centerbody.cg_from_datum_body_m
    body = VEHICLE.centerbody.model_copy(update={"cg_from_datum_body_m": (x, -y, -z)})
    agreeing, wrong = fuse_flight(sound(), None), fuse_flight(sound(replace(VEHICLE, centerbody=body)), None)
    assert wrong.alternatives
    assert wrong.left_out is None
    assert not wrong.consistency_checks[0].passed
    z_wrong, sd_wrong = error_sd(wrong)
    assert sd_wrong > 1.5 * error_sd(agreeing)[1]
    assert abs(z_wrong) < 2.0


def test_a_deflection_of_25_deg_is_fused_as_well_as_read():
    # twice the static stability keeps the shell's own angle below trim's 30 deg
    stable = replace(VEHICLE, aero=VEHICLE.aero.scaled(cm=2.0))
    bent = 6.0 * motion()
    loads = replace(pulse_of(np.random.default_rng(3), N, bent, stable)[0], vehicle=stable)
    answer = fuse_flight(loads, None)
    at = np.searchsorted(TIME_S, answer.history.time_s)
    off = np.linalg.norm(answer.history.theta_yz_rad - bent[at], axis=1)[10:-10]
    assert np.rad2deg(np.linalg.norm(bent, axis=1).max()) > 24.0
    # data in static trim of a deflection that moves: what the motion weighs is left
    assert np.rad2deg(off.max()) < 0.3
    assert all(check.passed for check in answer.consistency_checks)


def test_a_slight_fault_widens_the_answer():
    # three sd of C_m: odds name it, no pair fails
    answer = fuse_flight(sound(moved_vehicle(VEHICLE, {"C_m": 4.0})), film(motion()))
    assert abs(error_sd(answer)[0]) < 2.0


def test_quantiles_between_frames_are_as_wide_as_the_sd():
    # of a sparse film that swings, what a straight line misses widens both
    t = 430.0 + 0.25 * np.arange(20)
    swing = np.deg2rad(4.0 + 0.8 * np.sin(2.0 * np.pi * 1.6 * t))[:, None] * np.array([0.8, -0.6])
    sparse = film(swing, t, np.deg2rad(0.02))
    for at_s in (t[7], t[7] + 0.12):
        theta, sd = sparse.angle_at(at_s)
        low, inner_low, middle, inner_high, high = quantiles_at(sparse, at_s)
        assert middle == pytest.approx(theta, abs=0.1 * sd)
        assert 0.5 * (inner_high - inner_low) == pytest.approx(sd, rel=0.1)
        assert 0.5 * (high - low) == pytest.approx(1.645 * sd, rel=0.1)
    assert np.isnan(quantiles_at(sparse, 500.0)).all()


def test_a_refused_fusion_is_a_red_check():
    refused = Deflections(refused={"fused": Issue("no common answer", "not-converged")})
    (check,) = refused.consistency_checks
    assert not check.passed
    assert check.code == "deflection-methods"
    # one that has nothing to say is none
    assert Deflections(refused={"fused": Issue("no vehicle", "vehicle-missing")}).consistency_checks == ()
    assert Deflections().consistency_checks == ()


def test_features_that_a_film_lacks_are_no_fault_where_the_inertial_methods_bear_it_out():
    lacking = Check("camera-features", "stated features", 1.0, 0.0, 0.0, False, "not found", "camera")
    assert borne_out(lacking, fuse_flight(sound(), film(motion())).agreement).passed
    assert not borne_out(lacking, fuse_flight(sound(), None).agreement).passed
    for spoilt in SPOILT.values():
        assert not borne_out(lacking, fuse_flight(sound(), spoilt).agreement).passed
    moved = replace(lacking, code="camera-rest")
    assert not borne_out(moved, fuse_flight(sound(), film(motion())).agreement).passed


def test_two_methods_that_contradict_are_spanned_by_the_mixture_of_each_alone():
    # the force is turned by 2 deg, far beyond what its bias and mounting are known to, without a film
    loads = sound()
    turn = np.deg2rad(2.0) * loads.specific_force_body_mps2[:, :1] * [0.0, 1.0, 0.0]
    answer = fuse_flight(replace(loads, specific_force_body_mps2=loads.specific_force_body_mps2 + turn), None)
    assert answer.alternatives == ("misalignment alone", "trim alone")
    assert answer.left_out is None
    assert not answer.consistency_checks[0].passed
    off, sd = error_sd(answer)
    assert abs(off) < 2.0
    assert sd > 0.5


def test_a_mixture_of_histories_whose_planes_are_all_lost_is_as_well_known_across_as_along():
    answer = fuse_flight(sound(), None)
    times = answer.history.time_s
    unknown = np.zeros((len(times), 2, 2))
    unknown[:, 0, 0], unknown[:, 1, 1] = np.deg2rad(0.3) ** 2, UNIFORM_VAR
    lost = {
        name: DeflectionHistory(times, np.full(len(times), np.deg2rad(size)), np.zeros(len(times)), unknown, name, "")
        for name, size in (("one", 0.1), ("other", 0.5))
    }
    mixed = _mixed(answer, lost, np.ones(2)).history
    # same planes: 0.3 deg of each, and their sizes 0.2 deg on either side of the mean
    expected = np.deg2rad([[np.hypot(0.3, 0.2), 0.0], [0.0, 0.3]]) ** 2
    np.testing.assert_allclose(mixed.theta_rad, np.deg2rad(0.3))
    np.testing.assert_allclose(mixed.lateral_cov[K], expected, atol=1e-12)
