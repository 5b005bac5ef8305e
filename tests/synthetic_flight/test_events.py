"""The events of a whole flight, separation to splashdown: where they must be, and alike at other record steps."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth
from flightmodel.events import splashdown_index
from synthetic_flight.folder import event_table, flight_events, heat_flux
from synthetic_flight.scenarios import fly_scenario, read_scenario

NAMES = (
    "separation", "apogee", "inflation", "80 km", "peak heating", "Mach 3.5", "peak dynamic pressure", "40 km",
    "Mach 1", "splashdown",
)  # fmt: skip


@pytest.fixture(scope="module")
def whole():
    scenario = read_scenario("irve2_splashdown")
    return fly_scenario(scenario, 0), scenario


@pytest.fixture(scope="module")
def events(whole):
    truth, scenario = whole
    return {e.name: e for e in flight_events(truth, scenario.spec.time.inflated_s)}


def test_all_are_there_in_order(events):
    assert tuple(events) == NAMES
    times = [e.time_s for e in events.values()]
    assert times == sorted(times)


def test_each_is_where_it_says(events):
    for name, value, want in (
        ("80 km", events["80 km"].altitude_m, 80e3),
        ("40 km", events["40 km"].altitude_m, 40e3),
        ("splashdown", events["splashdown"].altitude_m, 0.0),
    ):
        assert value == pytest.approx(want, abs=1e-3), name
    assert events["Mach 3.5"].mach == pytest.approx(3.5, abs=1e-5)
    assert events["Mach 1"].mach == pytest.approx(1.0, abs=1e-5)
    assert events["inflation"].time_s == 300.0
    # level flight at apogee: the nose's height peaks there, the datum moves by the body's turning alone
    assert np.rad2deg(events["apogee"].flight_path_rad) == pytest.approx(0.0, abs=0.01)
    assert events["apogee"].altitude_m == pytest.approx(218e3, abs=300.0)


def test_published_times_of_the_descent(events):
    # 40 km to splashdown 720 s (published) to 744 s (derived with this class of drag); terminal speed 19 m/s; impact
    # feels one g; Sutton-Graves on a derived trajectory gives 2.56 W/cm2 near 432 s
    assert 715.0 < events["splashdown"].time_s - events["40 km"].time_s < 750.0
    assert events["splashdown"].speed_mps == pytest.approx(19.0, rel=0.05)
    assert events["splashdown"].sensed_g == pytest.approx(1.0, abs=0.03)
    assert events["peak heating"].heat_flux_wpm2 == pytest.approx(2.56e4, rel=0.05)
    assert events["peak heating"].time_s == pytest.approx(432.0, abs=2.0)
    # in balance: weight over drag area
    s = events["splashdown"]
    assert 140 < s.dynamic_pressure_pa * 7.0686 * 0.97 / 9.8 < 165


def test_heating_and_pressure_are_the_largest_of_all_records(whole, events):
    truth, _ = whole
    for name, values, got in (
        ("q", truth.dynamic_pressure_pa, events["peak dynamic pressure"].dynamic_pressure_pa),
        (
            "heat",
            heat_flux(
                truth.density_kgpm3, np.sqrt(2 * truth.dynamic_pressure_pa / truth.density_kgpm3),
                truth.vehicle.geometry.nose_radius_m,
            ),
            events["peak heating"].heat_flux_wpm2,
        ),
    ):  # fmt: skip
        # between records a peak may be higher by what the neighbours lie lower; the day's air is linear between knots
        # 250 m apart, so a peak on a knot is sharp and a smooth curve through its neighbours passes 1e-5 below
        k = int(np.argmax(values))
        assert values[k] * (1 - 3e-5) <= got <= 2 * values[k] - min(values[k - 1], values[k + 1]), name
    # the formula itself, in Sutton and Graves' own numbers: 1 kg/m^3 gives 1.7415e-4 V^3 on a nose of 1 m
    assert heat_flux(np.array(4.0), np.array(1000.0), 1.0) == pytest.approx(2 * 1.7415e5)


def test_place_is_the_trajectorys(whole, events):
    truth, _ = whole
    e = events["Mach 1"]
    k = int(np.argmin(np.abs(truth.time_s - e.time_s)))
    lat, lon, _ = earth.geodetic_from_ecef(truth.trajectory.position_ecef_m[k])
    # within one record, 0.02 s at 310 m/s: 1e-6 rad
    np.testing.assert_allclose([e.latitude_rad, e.longitude_rad], [lat, lon], atol=1e-6)


def test_finer_records_give_the_same_events():
    # the same integration, recorded at 0.004 and at 0.02 s
    scenario = read_scenario("irve2_splashdown")
    found = []
    for record in (0.004, 0.02):
        time = scenario.spec.time.model_copy(update={"record_s": record, "stop_s": 460.0})
        truth = fly_scenario(replace(scenario, spec=scenario.spec.model_copy(update={"time": time})), 1)
        found.append({e.name: e for e in flight_events(truth, 300.0)})
    fine, coarse = found
    assert tuple(fine) == NAMES[:-1]  # absent: the splashdown, which was not flown
    for name, e in fine.items():
        other = coarse[name]
        if name.startswith("peak"):
            # the top is flat and, where it meets a knot of the air's structure, sharp: one record in time, and in size
            # 2e-4 (beside the knot at most 100 Pa/s, so 1 Pa in half a record, of which a parabola leaves a quarter)
            assert other.time_s == pytest.approx(e.time_s, abs=0.03), name
            size = "heat_flux_wpm2" if name == "peak heating" else "dynamic_pressure_pa"
            assert getattr(other, size) == pytest.approx(getattr(e, size), rel=2e-4), name
            continue
        assert other.time_s == pytest.approx(e.time_s, abs=2e-4 if name != "apogee" else 2e-2), name
        assert other.altitude_m == pytest.approx(e.altitude_m, abs=0.2), name
        assert other.dynamic_pressure_pa == pytest.approx(e.dynamic_pressure_pa, rel=1e-3), name
        assert other.speed_mps == pytest.approx(e.speed_mps, rel=1e-4), name


def test_a_flight_below_the_sea_ends_at_it(whole):
    altitude = np.array([100.0, 60.0, 20.0, -20.0, -60.0])
    assert splashdown_index(altitude) == 4
    assert splashdown_index(altitude[:3]) is None
    assert splashdown_index(np.array([0.0, 50.0, 0.0])) == 3  # from the ground and back
    truth, _ = whole
    end = splashdown_index(truth.altitude_m)
    assert truth.altitude_m[end - 2] > 0.0 >= truth.altitude_m[end - 1] > -1.0


def test_table_is_in_files_units(events):
    table = event_table(list(events.values()))
    assert list(table["event"]) == list(NAMES)
    row = table[table["event"] == "80 km"].iloc[0]
    assert row["flight_path_deg"] == pytest.approx(-77.0, abs=0.5)
    assert row["lat_deg"] == pytest.approx(37.2, abs=0.5)
