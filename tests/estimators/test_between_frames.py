"""Between frames the camera's own answer is a smooth process: right within its sd, also where frames are few."""

import numpy as np
import pytest

from estimators.fusion import smoothed
from flightmodel.deflection import history_from_lateral

JOINT_HZ, PITCH_HZ = 3.4, 1.0
SD_RAD = np.deg2rad(0.04)


def motion(t):
    """Three degrees that grow and fall, and turn, with a swing of 40 % of them by the vehicle's pitching."""
    level = np.deg2rad(3.0) * np.exp(-(((t - 14.0) / 7.0) ** 2))
    clock = 0.3 * t + 0.4 * np.sin(0.5 * t)
    swing = 0.4 * level * np.sin(2.0 * np.pi * PITCH_HZ * t)
    return (level + swing)[:, None] * np.stack([np.cos(clock), np.sin(clock)], axis=-1)


def z_between(rate_hz, swing_hz, refused_s=(0.0, 0.0)):
    """Errors over their sd over the pulse, or among the frames refused, and the sd, rad, of eight films."""
    z, sd = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 28.0, 1.0 / rate_hz) + rng.uniform(0.0, 1.0)
        t = t[(t < refused_s[0]) | (t > refused_s[1])]
        read = motion(t) + SD_RAD * rng.standard_normal((len(t), 2))
        film = history_from_lateral(t, read, np.tile(SD_RAD**2 * np.eye(2), (len(t), 1, 1)), "camera", "")
        got = smoothed(film, swing_hz=swing_hz)
        low, high = refused_s if refused_s[1] else (6.0, 22.0)
        inside = (got.time_s > low) & (got.time_s < high)
        error = got.theta_rad - np.linalg.norm(motion(got.time_s), axis=1)
        z.append((error / got.theta_sd_rad)[inside])
        sd.append(got.theta_sd_rad[inside])
    return np.concatenate(z), np.concatenate(sd)


@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 1.7, 4.0, 8.0])
def test_the_sd_holds_at_any_rate_of_frames(rate_hz):
    """1 Hz frames see the pitching at 1 Hz in one phase alone, and yet it is in the sd."""
    z, _ = z_between(rate_hz, JOINT_HZ)
    assert np.sqrt(np.mean(z**2)) < 1.3
    assert np.mean(np.abs(z) > 3.0) < 0.015


def test_the_sd_holds_among_frames_refused_in_a_row():
    """A second is a whole swing: frames around it say nothing of that one. A row of frames is one draw of its phase."""
    z = np.concatenate([z_between(4.0, JOINT_HZ, (first, first + 1.0))[0] for first in np.arange(8.0, 20.0, 2.6)])
    assert np.sqrt(np.mean(z**2)) < 1.3
    assert np.mean(np.abs(z) > 3.0) < 0.015


def test_frames_that_follow_the_swing_are_not_doubted():
    z, sd = z_between(8.0, JOINT_HZ)
    assert np.median(sd) < np.deg2rad(0.06)
    assert np.sqrt(np.mean(z**2)) > 0.5


def test_without_the_joints_frequency_sparse_frames_would_be_believed():
    """What the swing's part of the sd is there for."""
    z, _ = z_between(1.0, None)
    assert np.sqrt(np.mean(z**2)) > 3.0


def test_sparse_frames_are_bridged_and_holes_are_not():
    t = np.concatenate([np.arange(0.0, 14.0, 2.0), np.arange(28.0, 42.0, 2.0)])
    film = history_from_lateral(t, 0.5 * motion(t), np.tile(SD_RAD**2 * np.eye(2), (len(t), 1, 1)), "camera", "")
    got = smoothed(film, swing_hz=JOINT_HZ).time_s
    assert np.diff(got[got < 12.0]).max() < 0.03
    assert not np.any((got > 15.1) & (got < 24.9))
