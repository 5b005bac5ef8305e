"""Noise levels by the likelihood of innovations: those of the flight are proposed whatever is stated."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.checks import GateError
from recon.noise_levels import noise_levels
from recon.settings import Settings
from tests.recon import pad_flight
from tests.refusing import refuses

TRUE = {"horizontal_sd_m": 3.0, "vertical_sd_m": 5.0, "speed_sd_mps": 0.2, "vertical_speed_sd_mps": 0.3}


def stated(telemetry, **levels):
    record = telemetry.gnss["gps"]
    return replace(telemetry, gnss={"gps": replace(record, spec=replace(record.spec, **levels))})


@pytest.mark.parametrize(("seed", "factor"), [(3, 5.0), pytest.param(4, 0.3, marks=pytest.mark.slow)])
def test_levels_of_a_receiver_are_found_from_stated_ones_far_off(seed, factor):
    """33 fixes: a level by 1 / sqrt(2 n k) of itself, k components, so that 4 of these are 0.35 (k = 2) and 0.5."""
    telemetry = stated(pad_flight.sense(seed), **{name: factor * level for name, level in TRUE.items()})
    found = noise_levels(telemetry)
    table = found.to_frame().set_index("key")
    assert found.gain > 20.0
    for name, level in TRUE.items():
        most = 0.5 if name.startswith("vertical") else 0.35
        assert abs(np.log(table.proposed[name] / level)) < most, name
        assert table.low[name] < table.proposed[name] < table.high[name]
        assert getattr(found.telemetry.gnss["gps"].spec, name) == pytest.approx(table.proposed[name])
    # half a minute of straight flight hardly bears on the gyros' noise: a level whose range is tenfold stays about
    gyros = table.loc["noise_sd_degps"]
    assert gyros.low < 0.1 * gyros.high
    assert 1.0 / 1.5 < gyros.proposed / gyros.stated < 1.5
    assert table.stated["horizontal_sd_m"] == pytest.approx(3.0 * factor)


def test_what_is_not_used_has_no_level_and_levels_that_agree_stay():
    telemetry = pad_flight.sense(5, radar_from_s=-5.0)
    found = noise_levels(telemetry, Settings(without=("radar",)))
    assert not any(level.table == "radars.radar" for level in found.levels)
    assert {level.table for level in found.levels} == {"gnss.gps", "sensors.accelerometer", "sensors.rates"}
    again = noise_levels(found.telemetry, Settings(without=("radar",)))
    assert again.gain == 0.0
    assert all(level.proposed == level.stated for level in again.levels)


def test_nothing_stated_is_refused():
    telemetry = pad_flight.sense(6)
    silent = stated(telemetry, **dict.fromkeys(TRUE, 0.0), wander_sd_m=0.0)
    triads = {name: getattr(silent, name) for name in ("accelerometer", "rates")}
    silent = replace(silent, **{n: replace(r, spec=replace(r.spec, noise_sd=0.0)) for n, r in triads.items()})
    with refuses("input-missing", kind=GateError):
        noise_levels(silent)
