"""Where the trajectory is given more often: through the pulse that the accelerometers feel, and nowhere else."""

import numpy as np
import pytest

from flightmodel.checks import ConfigError
from recon.reconstruct import reconstruct
from recon.settings import Settings


def test_pulse_is_given_at_its_own_rate(mini_sense):
    """A pulse of 80 exp(-((t - 130) / 7)^2 / 2) m/s^2 exceeds its half for 8.2 s to both sides."""
    telemetry, _ = mini_sense(50)
    t = reconstruct(telemetry, Settings(output_rate_hz=5.0, pulse_rate_hz=50.0)).smoothed.time_s
    step = np.diff(t)
    fine = step < 0.03
    assert np.allclose(step[fine], 0.02, atol=1e-9)
    assert t[:-1][fine][0] == pytest.approx(121.8, abs=0.6)
    assert t[1:][fine][-1] == pytest.approx(138.2, abs=0.6)
    assert (np.abs(step[~fine] - 0.2) < 1e-6).sum() > 150


@pytest.mark.parametrize("rate", [0.0, 5.0])
def test_no_other_rate_where_none_is_asked_for(mini_sense, rate):
    telemetry, _ = mini_sense(51)
    t = reconstruct(telemetry, Settings(output_rate_hz=5.0, pulse_rate_hz=rate)).smoothed.time_s
    assert np.diff(t).min() > 0.1


def test_pulse_rate_is_checked():
    with pytest.raises(ConfigError) as refusal:
        Settings(pulse_rate_hz=-1.0)
    assert refusal.value.codes == ("value-range",)
