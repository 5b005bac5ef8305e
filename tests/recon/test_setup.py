"""From telemetry to a problem, and every refusal: all faults at once, with the nearest known names."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest

from flightmodel import instruments
from flightmodel.checks import GateError
from flightmodel.instruments import TriadSpec
from flightmodel.telemetry import GnssRecord, RadarRecord, TriadRecord
from recon.estimate import bridge_inertial_sensors
from recon.measurements import RADAR, RANGE_RATE, VELOCITY
from recon.propagation import inertial_motion
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.state import ErrorModel, instrument_blocks

from .ballistic_flight import fly, watch
from .conftest import ACCELEROMETER, FULL_SITES
from .problems import build


def faults(call, *arguments, **options):
    with pytest.raises(GateError) as caught:
        call(*arguments, **options)
    return caught.value.faults


def test_settings_name_all_faults_at_once():
    said = faults(
        Settings, output_rate_hz=0.0, passes=-1, gate_probability=1.0, check_confidence=0.1, angle_noise="axes",
        engine="complied", hold_out_every=1, hold_out_spans_s=[(2.0, 1.0)], without="north", start_s="now",
        attitude_sensors=1,
    )  # fmt: skip
    assert [s.code for s in said] == 11 * ["value-range"]
    nearest = [found[1] for s in said if (found := re.search("'(axis|compiled)'", s))]
    assert nearest == ["axis", "compiled"]


def test_settings_come_from_a_mapping_of_the_same_names():
    found = Settings.from_mapping(
        {"output_rate_hz": 5, "hold_out_spans_s": [[1, 2.5]], "consider": ["accelerometer mount"], "engine": "filterpy"}
    )
    assert found == Settings(
        output_rate_hz=5.0, hold_out_spans_s=((1.0, 2.5),), consider=("accelerometer mount",), engine="filterpy"
    )
    assert Settings.from_mapping({}) == Settings()
    assert Settings.from_mapping({"engine": "readable"}).engine == "filterpy"
    for setting in fields(Settings):
        assert Settings.from_mapping({setting.name: setting.default}) == Settings()
        assert setting.metadata["allowed"]
    said = faults(Settings.from_mapping, {"outputrate_hz": 3.0, "smoother": "x", "passes": 1.5, "engine": []})
    assert [s.code for s in said] == ["name-unknown", "name-unknown", "value-range", "value-range"]
    assert "'output_rate_hz'" in said[0]


def test_names_in_consider_and_without_are_refused_together(mini_everything):
    said = faults(
        build, mini_everything(1), without=("nort", "reciever", "west"), attitude_sensors=False,
        consider=("accelerometer mont", "north time bias", "gyro bias"),
    )  # fmt: skip
    assert len(said) == 4
    assert [s.code for s in said] == ["name-unknown"] * 2 + ["name-unknown"] * 2
    words = "\n".join(said)
    for hint in ("'north'", "'receiver'", "'accelerometer mount'"):
        assert hint in words
    assert "'west'" not in words


def test_attitude_sensors_are_sources_only_where_they_measure(mini_everything):
    telemetry = mini_everything(1)
    assert len(faults(build, telemetry, without=("magnetometer", "sun2"))) == 2
    problem = build(telemetry, without=("magnetometer", "sun2"), attitude_sensors=True)
    names = [i.name for i in problem.instruments]
    unused = {names[s] for s in problem.observed.source[~problem.observed.usable]}
    assert unused == {"magnetometer", "sun2"}
    assert len(faults(build, telemetry, consider=("magnetometer bias",))) == 1


def test_ballistic_flight_has_no_attitude_to_measure():
    t, states = fly(1, end_s=40.0)
    telemetry = watch(t, states, 1)
    said = faults(reconstruct, telemetry, Settings(attitude_sensors=True, without=("naer",)))
    assert len(said) == 2
    assert {s.code for s in said} == {"keys-conflict", "name-unknown"}
    assert any("'near'" in s for s in said if s.code == "name-unknown")


@pytest.mark.parametrize("everything", [("north", "west"), ("north", "west", "receiver", "barometer")])
def test_no_tracker_is_refused_in_words(mini_sense, mini_everything, everything):
    telemetry = mini_sense(1)[0] if len(everything) == 2 else mini_everything(1)
    assert faults(build, telemetry, without=everything)[0].code == "too-few-data"
    blind = {
        name: RadarRecord(r.spec, r.time_s, np.full_like(r.range_az_el, np.nan)) for name, r in telemetry.radars.items()
    }
    assert faults(build, replace(telemetry, radars=blind, gnss={}))[0].code == "too-few-data"
    assert faults(build, replace(telemetry, radars={}, gnss={}))[0].code == "too-few-data"


def test_a_receiver_alone_tracks(mini_everything):
    telemetry = replace(mini_everything(1), radars={})
    problem = build(telemetry)
    assert [i.name for i in problem.instruments] == ["receiver", "receiver velocity", "barometer"]
    empty = np.full((3, 3), np.nan)
    spec = telemetry.gnss["receiver"].spec
    both = replace(telemetry, gnss=telemetry.gnss | {"dead": GnssRecord(spec, np.arange(3.0) + 101.0, empty, empty)})
    assert len(build(both).instruments) == 3


@pytest.mark.parametrize("span", [{"start_s": 159.5, "end_s": None}, {"end_s": 100.9}, {"start_s": 300.0}])
def test_no_common_span_is_refused_in_words(mini_sense, span):
    assert faults(build, mini_sense(1)[0], **span)[0].code == "time-not-covered"


def test_sensors_that_end_before_the_trackers_begin(mini_sense):
    telemetry, _ = mini_sense(1)
    early = telemetry.rates.time_s < 99.5
    rates = TriadRecord(telemetry.rates.spec, telemetry.rates.time_s[early], telemetry.rates.measured_sensor[early])
    assert faults(build, replace(telemetry, rates=rates))[0].code == "time-not-covered"
    assert faults(build, replace(telemetry, attitude_prior=None))[0].code == "attitude-missing"
    far = replace(telemetry, attitude_prior=replace(telemetry.attitude_prior, time_s=50.0))
    (fault,) = faults(build, far)
    assert fault.code == "time-not-covered"
    assert "50.000 s" in fault
    few = TriadRecord(telemetry.rates.spec, telemetry.rates.time_s[:5], telemetry.rates.measured_sensor[:5])
    assert faults(bridge_inertial_sensors, replace(telemetry, rates=few))[0].code == "sensor-axis-unusable"


def test_a_source_that_is_left_out_chooses_nothing(mini_sense, mini_truth):
    """A radar left out because it is 100 km wrong may not choose span or start, and is still predicted."""
    telemetry, _ = mini_sense(2)
    west = telemetry.radars["west"]
    track = west.range_az_el.copy()
    track[:, 0] += 100e3
    earlier = RadarRecord(west.spec, west.time_s - 2.0, track)
    wrong = replace(telemetry, radars={"west": earlier, "north": telemetry.radars["north"]})
    problem = build(wrong, without=("west",))
    clean = build(replace(telemetry, radars={"north": telemetry.radars["north"]}))
    assert np.isclose(problem.time_s[0], clean.time_s[0], rtol=0.0, atol=1e-9)
    assert np.allclose(problem.start.position_ecef_m, clean.start.position_ecef_m, rtol=0.0, atol=1e-6)
    r = reconstruct(wrong, Settings(output_rate_hz=2.0, without=("west",)))
    only = reconstruct(
        replace(telemetry, radars={"north": telemetry.radars["north"]}), Settings(output_rate_hz=2.0)
    )  # fmt: skip
    # nodes differ, so the motion's steps do: far below what is known
    off = np.abs(r.smoothed.position_ecef_m - only.smoothed.position_ecef_m) / only.smoothed.sd()[:, :3]
    assert off.max() < 0.05
    residuals = r.residuals[(r.residuals.source == "west") & (r.residuals.component == "range")]
    assert residuals.residual.mean() == pytest.approx(100e3, rel=0.1)
    assert not residuals.accepted.any()
    assert not any(v.source == "west" for v in r.consistency_checks if v.code == "nis")


def test_only_stated_errors_become_states(mini_sense, mini_everything):
    plain, full = build(mini_sense(1)[0]), build(mini_everything(1), attitude_sensors=True)
    assert plain.model.size == 18 + 8
    # four that all sites share stand by where receiver or barometer can contradict them
    assert full.model.size == 18 + 2 + 2 * 13 + 4 + 4 + 4 + 12 + 4 * 5
    assert full.model.names[:20] == [*plain.model.names[:18], "accelerometer time bias", "rates time bias"]
    for instrument in full.instruments:
        slots = instrument.slots(full.model)
        used = slots[slots >= 0]
        assert len(set(used)) == len(used) > 0
        # a radar has what all sites share, a velocity of a point beside the accelerometer the gyros' errors
        shared = {RADAR: ("sites ",), VELOCITY: ("rates ",), RANGE_RATE: ("rates ",)}.get(instrument.kind, ())
        owners = (f"{instrument.owner} ", *shared)
        assert all(full.model.names[s].startswith(owners) for s in used)
    everywhere = np.concatenate([i.slots(full.model) for i in full.instruments])
    # no measurement of a point depends on the accelerometer's clock; on the gyros' an antenna's velocity does
    assert set(everywhere[everywhere >= 0]) == {*range(9, 18), *range(19, full.model.size)}


def test_considering_takes_components_groups_and_whole_kinds(mini_everything):
    model = build(mini_everything(1)).model
    flags = {
        name: model.considering([name]).wander.considered.sum()
        for name in ("accelerometer mount", "accelerometer mount x", "north tilt", "north wander", "receiver wander")
        if name != "north wander"
    }
    assert flags == {"accelerometer mount": 3, "accelerometer mount x": 3, "north tilt": 2, "receiver wander": 3}
    wander = model.considering(["receiver wander"]).wander
    rows = [i for i, n in enumerate(model.names) if n.startswith("receiver wander")]
    assert np.isinf(wander.time_constant_s[rows]).all()
    assert np.isfinite(model.wander.time_constant_s[rows]).all()


def test_a_wandering_bias_walks():
    spec = TriadSpec("t", np.zeros(3), np.eye(3), 0.1, 0.03, 0.0, 0.0, bias_wander_sd=0.04, bias_time_constant_s=50.0)
    model = ErrorModel(tuple(instrument_blocks(instruments.ACCELEROMETER, spec)))
    assert np.allclose(model.prior_sd[:3], 0.05)
    assert np.allclose(model.wander.walk_var_per_s[:3], 2.0 * 0.04**2 / 50.0)
    assert list(model.wandering) == [0, 1, 2]
    still = ErrorModel(tuple(instrument_blocks(instruments.ACCELEROMETER, ACCELEROMETER)))
    assert len(still.wandering) == 0
    assert [b.components[0] for b in instrument_blocks(instruments.RADAR, FULL_SITES[0])][-1] == "range scale"


def test_the_motion_holds_both_triads_at_nodes_and_samples(mini_sense):
    telemetry, _ = mini_sense(1)
    sensors = bridge_inertial_sensors(telemetry)
    nodes = np.array([101.0, 101.3333, 104.0])
    motion, index = inertial_motion(sensors.force, sensors.rate, nodes)
    assert np.array_equal(motion.time_s[index], nodes)
    assert motion.time_s[0] == 101.0
    assert motion.time_s[-1] == 104.0
    inner = sensors.force.time_s[(sensors.force.time_s > 101.0) & (sensors.force.time_s < 104.0)]
    assert np.isin(inner, motion.time_s).all()
    assert (motion.force_density > 0.0).all()
