"""Several cameras, one history: no step at a switch beyond the sd, contradictions named, time biases found."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.benchmark import BenchmarkDeflection, RelativeDeflections
from estimators.cameras import STATIC_PART, CameraReadings, join_cameras
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from flightmodel.checks import DivergenceError

READING_SD, BENCHMARK_SD, PLANE_SD = np.deg2rad([0.05, 0.1, 0.8])
RATE_HZ = 5.0


def motion(t):
    """Four degrees that grow and fall, pitching at 0.8 Hz, seen from a body that rolls at 9 rpm."""
    size = np.deg2rad(4.0) * np.exp(-(((t - 18.0) / 7.0) ** 2)) * (1.0 + 0.25 * np.sin(2.0 * np.pi * 0.8 * t))
    clock = 2.0 * np.pi * 9.0 / 60.0 * t
    return size[:, None] * np.stack([np.cos(clock), np.sin(clock)], axis=-1)


def filmed(names, spans_s, seed, late_sd_s=0.0, off_deg=None):
    """Readings of cameras whose errors are drawn as the model states them; the first one's clock is right.

    All were on for a moment before the load, for their benchmark frames.
    """
    rng = np.random.default_rng(seed)
    static, out, late = rng.standard_normal(2), [], {}
    for k, (name, (start, stop)) in enumerate(zip(names, spans_s, strict=True)):
        t = np.arange(start, stop, 1.0 / RATE_HZ) + 0.03 * k
        late[name] = late_sd_s * rng.standard_normal() if k else 0.0
        true = motion(t - late[name])
        shared = CONSTANT_PART + (1.0 - CONSTANT_PART) * np.exp(-np.abs(t[:, None] - t) / LIGHT_TIME_S)
        read = np.linalg.cholesky(shared + 1e-9 * np.eye(len(t))) @ rng.standard_normal((len(t), 2)) * READING_SD
        benchmark = BENCHMARK_SD * (np.sqrt(STATIC_PART) * static + np.sqrt(1.0 - STATIC_PART) * rng.standard_normal(2))
        read += true - benchmark + PLANE_SD * rng.standard_normal() * np.stack([-true[:, 1], true[:, 0]], axis=-1)
        read += np.deg2rad((off_deg or {}).get(name, 0.0)) * np.array([1.0, 0.0])
        each = np.tile(np.eye(2), (len(t), 1, 1))
        relative = RelativeDeflections(t, read, READING_SD**2 * each, each, 3.0 + 0.3 * k, late_sd_s if k else 0.0)
        nothing = BenchmarkDeflection(np.zeros(2), BENCHMARK_SD**2 * np.eye(2))
        out.append(CameraReadings(name, relative, nothing, float(PLANE_SD)))
    return out, late


def errors_over_sd(joined, low=6.0, high=26.0):
    inside = (joined.smooth.time_s > low) & (joined.smooth.time_s < high)
    error = joined.smooth.theta_rad - np.linalg.norm(motion(joined.smooth.time_s), axis=1)
    return (error / joined.smooth.theta_sd_rad)[inside]


SWITCHED = [(4.0, 17.0), (17.1, 28.0)]
AT_ONCE = [(4.0, 28.0), (4.0, 28.0)]


@pytest.mark.parametrize(
    "spans_s",
    [SWITCHED, AT_ONCE, pytest.param([(4.0, 14.0), (12.0, 20.0), (20.1, 28.0)], marks=pytest.mark.long)],
)
def test_one_history_as_right_as_it_says(spans_s):
    z = []
    for seed in range(10):
        joined = join_cameras(filmed("abc"[: len(spans_s)], spans_s, seed)[0])
        assert joined.agree, joined.remark
        z.append(errors_over_sd(joined))
    # a film's errors go together: ten films are some twenty independent ones; forty films have 0.97 to 1.01
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.35
    assert np.mean(np.abs(z) > 3.0) < 0.03


@pytest.mark.parametrize(("spans_s", "most"), [(SWITCHED, 1.3), ([(4.0, 18.0), (16.0, 28.0)], 0.5)])
def test_a_switch_steps_by_no_more_than_the_sd(spans_s, most):
    """Each axis of the error's change over a switch, rms over sd; where both look for a while, hardly at all."""
    steps, at = [], spans_s[0][1]
    for seed in range(6):
        joined = join_cameras(filmed("ab", spans_s, seed)[0])
        t, error = joined.smooth.time_s, joined.smooth.theta_yz_rad - motion(joined.smooth.time_s)
        before, after = (np.array([np.interp(s, t, c) for c in error.T]) for s in (at - 0.1, at + 0.2))
        steps += ((after - before) / np.interp(at, t, joined.smooth.theta_sd_rad)).tolist()
    assert np.sqrt(np.mean(np.square(steps))) < most


def test_of_three_the_one_that_contradicts_is_left_out():
    spans_s = [(4.0, 28.0)] * 3
    for seed in range(2):
        joined = join_cameras(filmed("abc", spans_s, seed, off_deg={"b": 1.0})[0])
        assert not joined.agree
        assert joined.left_out == joined.suspect == "b"
        assert np.sqrt(np.mean(errors_over_sd(joined) ** 2)) < 2.5
        table = joined.to_frame().set_index("camera")
        assert table["used"].to_dict() == {"a": True, "b": False, "c": True}


def test_of_two_none_is_left_out_and_the_sd_holds_the_difference():
    z = []
    for seed in range(4):
        cameras, _ = filmed("ab", AT_ONCE, seed, off_deg={"b": 1.0})
        joined = join_cameras(cameras)
        assert not joined.agree
        assert joined.left_out is None
        assert {"a", "b"} >= set(joined.suspect.split(" and "))
        assert joined.wider > 3.0
        z.append(errors_over_sd(joined))
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_an_offset_at_a_switch_is_found_where_motion_does_not_explain_it():
    found = [not join_cameras(filmed("ab", SWITCHED, seed, off_deg={"b": 2.5})[0]).agree for seed in range(4)]
    assert sum(found) >= 3


def test_time_biases_between_cameras_are_found():
    for seed in range(2):
        cameras, late = filmed("abc", [(4.0, 28.0)] * 3, seed, late_sd_s=0.08)
        joined = join_cameras(cameras)
        assert joined.agree, joined.remark
        table = joined.to_frame().set_index("camera")
        for name in "bc":
            assert table["time_bias_s"][name] == pytest.approx(late[name], abs=0.02)
            assert 0.0 < table["time_bias_sd_s"][name] < 0.02
        assert np.sqrt(np.mean(errors_over_sd(joined) ** 2)) < 2.0


def test_a_benchmark_that_all_share_does_not_average_out():
    """Two cameras with the same benchmark time: its deflection is the same in both."""
    apart, _ = filmed("ab", AT_ONCE, 1)
    same = [replace(one, read=replace(one.read, benchmark_s=4.0)) for one in apart]
    sd = [np.median(join_cameras(one).smooth.theta_sd_rad) for one in (apart, same)]
    assert sd[1] > 1.1 * sd[0]
    assert sd[1] > 0.95 * BENCHMARK_SD


def test_a_camera_of_few_frames_is_not_used():
    cameras, _ = filmed("ab", [(4.0, 28.0), (10.0, 11.0)], 2)
    joined = join_cameras(cameras)
    assert [one.name for one in joined.readings] == ["a"]
    with pytest.raises(DivergenceError) as fault:
        join_cameras(cameras[1:])
    assert fault.value.codes == ("too-few-data",)


def test_a_camera_switched_on_under_load_is_held_by_the_others():
    """Its benchmark frame is deflected by 2 deg, of which its stated 0.1 deg know nothing."""
    z = []
    for seed in range(6):
        cameras, _ = filmed("ab", [(4.0, 17.0), (15.0, 28.0)], seed)
        late = replace(cameras[1].read, benchmark_s=15.4)
        lost = motion(np.array([late.benchmark_s]))
        loaded = replace(cameras[1], read=replace(late, theta_yz_rad=late.theta_yz_rad - lost))
        joined = join_cameras([cameras[0], loaded])
        assert joined.agree, joined.remark
        z.append(errors_over_sd(joined))
    assert np.rad2deg(np.linalg.norm(lost)) > 1.5
    assert np.sqrt(np.mean(np.square(z))) < 1.35
