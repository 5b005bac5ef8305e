"""Density and winds of a dozen synthetic days against their truth, and faults that must be seen and named.

Every day has its own air, sounding and instruments, and coefficients as far from the vehicle's as stated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from flightmodel.atmosphere import profile_from_sounding
from flightmodel.flightfolder import read_flight
from flightmodel.telemetry import Telemetry, TriadRecord
from postflight.flight import Flight
from postflight.reconstruction import Reconstruction, reconstruct
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
from tests.refusing import numbers_in

pytestmark = pytest.mark.long
DAYS = 12
HEIGHTS_KM = (80, 75, 70, 65, 60, 55, 50, 45, 42, 40, 38, 35, 32, 30, 28)
CA_SD, CN_SD = 0.03, 0.07


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory):
    """Flights from 395 s on with the truth's profile and the C_A that the analyst is wrong by."""
    scenario = read_scenario("irve2_reference")
    spec = scenario.spec.model_copy(
        update={
            "video": None,
            "time": scenario.spec.time.model_copy(update={"telemetry_from_s": 395.0}),
            "attitude_prior": scenario.spec.attitude_prior.model_copy(update={"t_s": 395.0}),
        }
    )
    scenario = replace(scenario, spec=spec)
    root, out = tmp_path_factory.mktemp("days"), []
    for seed in range(DAYS):
        folder = root / str(seed)
        truth = simulate_to_folder(scenario, seed, folder)
        wrong = np.random.default_rng(seed).standard_normal(2) * [CA_SD, CN_SD]
        flight = reconstruct(Flight(with_coefficients(read_flight(folder), *np.exp(wrong))))
        out.append((flight, truth.profile, wrong))
    return out


def with_coefficients(telemetry: Telemetry, ca: float, cn: float) -> Telemetry:
    vehicle = telemetry.required_vehicle()
    return replace(telemetry, vehicle=replace(vehicle, aero=vehicle.aero.scaled(ca, cn)))


def errors(flight: Reconstruction, truth, height_m: float):
    """Error over sd of density ratio and both winds at one height, sd over prior of density and of winds."""
    assert flight.as_flown is not None
    p = flight.as_flown.profile
    row = p.iloc[int(np.argmin(np.abs(p.altitude_m - height_m)))]
    assert row.altitude_m == pytest.approx(height_m)
    sounded, true = profile_from_sounding(flight.telemetry.sounding).at(height_m), truth.at(height_m)
    wind = true.wind_ned_mps - sounded.wind_ned_mps
    z = [
        (row.density_ratio - true.density_kgpm3 / sounded.density_kgpm3) / row.density_ratio_sd,
        (row.wind_north_change_mps - wind[0]) / row.wind_north_sd_mps,
        (row.wind_east_change_mps - wind[1]) / row.wind_east_sd_mps,
    ]
    return np.array(z), row.density_ratio_sd / row.density_ratio_prior_sd, row.wind_north_sd_mps / row.wind_prior_sd_mps


@pytest.mark.long
@pytest.mark.parametrize("height_km", HEIGHTS_KM)
def test_density_and_winds_are_as_uncertain_as_claimed(days, height_km: int) -> None:
    values = [errors(flight, truth, 1000.0 * height_km) for flight, truth, _ in days]
    nees = np.mean([z**2 for z, _, _ in values], axis=0)
    low, high = chi2.ppf([0.0005, 0.9995], DAYS) / DAYS
    assert (nees > low).all(), nees
    assert (nees < high).all(), nees
    assert np.mean([d for _, d, _ in values]) < (0.75 if height_km > 35 else 0.85)  # C_A is not known better
    assert np.mean([w for _, _, w in values]) < (0.9 if height_km > 35 else 0.8)


@pytest.mark.long
def test_density_is_nearer_to_the_truth_than_the_sounding(days) -> None:
    before, after = [], []
    for flight, truth, _ in days:
        p = flight.as_flown.profile
        ratio = truth.at(p.altitude_m.to_numpy()).density_kgpm3
        ratio = ratio / profile_from_sounding(flight.telemetry.sounding).at(p.altitude_m.to_numpy()).density_kgpm3
        before.append(np.mean((ratio - 1.0) ** 2))
        after.append(np.mean((p.density_ratio - ratio) ** 2))
    assert np.sqrt(np.mean(after)) < 0.6 * np.sqrt(np.mean(before))


@pytest.mark.long
def test_axial_coefficient_is_as_uncertain_as_claimed(days) -> None:
    z = [(f.as_flown.parameters.estimate[0] + wrong[0]) / f.as_flown.parameters.sd[0] for f, _, wrong in days]
    low, high = chi2.ppf([0.0005, 0.9995], DAYS) / DAYS
    assert low < np.mean(np.square(z)) < high


@pytest.mark.long
def test_nominal_days_turn_no_verdict_on_the_air_red(days) -> None:
    """Five verdicts at 99.9 % in a dozen flights: one red in seventeen such ensembles; the seeds are fixed."""
    assert not [v.name for flight, _, _ in days for v in flight.as_flown.consistency_checks if not v.passed]
    # the mean level, which deceleration gives as a product with C_A and mass alone
    assert all(flight.rests_on[-1].startswith("density") for flight, _, _ in days)


# --------------------------------------------------------------------------------------------------------------- teeth


def red(flight: Reconstruction) -> dict[tuple[str, str], str]:
    """What failed: the component that moved most, by code and source."""
    return {(v.code, v.source): v.component for v in flight.consistency_checks if not v.passed}


@pytest.fixture(scope="module", params=[0, pytest.param(7, marks=pytest.mark.long)])
def good(days, request) -> Telemetry:
    flight, _, wrong = days[request.param]
    return with_coefficients(flight.telemetry, *np.exp(-wrong))


def test_denser_air_between_45_and_55_km_is_named(good: Telemetry) -> None:
    s = good.sounding
    layer = (s.altitude_m >= 45e3) & (s.altitude_m <= 55e3)
    wrong = replace(s, density_kgpm3=np.where(layer, s.density_kgpm3 / 1.15, s.density_kgpm3))
    found = red(reconstruct(Flight(replace(good, sounding=wrong))))
    assert set(found) == {("sounding-density", "")}
    (height_km,) = numbers_in(found["sounding-density", ""])
    assert 44.0 <= height_km <= 56.0


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_shear_that_was_not_sounded_is_named(good: Telemetry, sign: float) -> None:
    s = good.sounding
    wrong = replace(s, wind_east_mps=s.wind_east_mps + np.where(s.altitude_m < 40e3, sign * 40.0, 0.0))
    found = red(reconstruct(Flight(replace(good, sounding=wrong))))
    worst = found["sounding-wind", ""]
    assert worst.startswith("wind east")
    assert numbers_in(worst)[0] < 40.0


@pytest.mark.parametrize("axis", ["y", pytest.param("z", marks=pytest.mark.long)])
def test_accelerometer_mounted_two_degrees_wrong_is_named(good: Telemetry, axis: str) -> None:
    record = good.accelerometer
    c = record.spec.dcm_body_sensor
    turned = record.measured_sensor @ c.T @ Rotation.from_euler(axis, 2.0, degrees=True).as_matrix() @ c
    found = red(reconstruct(Flight(replace(good, accelerometer=replace(record, measured_sensor=turned)))))
    assert found["data-sheet", "accelerometer"].startswith("mount")


@pytest.mark.parametrize("axis", [pytest.param(0, marks=pytest.mark.long), 1])
def test_gyro_scale_wrong_by_three_percent_is_named(good: Telemetry, axis: int) -> None:
    record = good.rates
    scale = np.ones(3)
    scale[axis] = 1.03
    wrong = replace(good, rates=TriadRecord(record.spec, record.time_s, record.measured_sensor * scale))
    found = red(reconstruct(Flight(wrong)))
    assert ("data-sheet", "rates") in found


def test_flight_without_a_vehicle_still_has_a_trajectory(good: Telemetry) -> None:
    flight = reconstruct(Flight(replace(good, vehicle=None)))
    assert flight.as_flown is None
    assert flight.loads is None
    assert [reason.code for reason in flight.missing] == ["vehicle-missing"]
    assert flight.air.mach.max() > 3.0
