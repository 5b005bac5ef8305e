"""The day's air and its sounding: structures where they are asked for, nothing else moved, errors of declared size."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel.atmosphere import nrlmsis_profile, us76
from flightmodel.checks import ConfigError
from flightmodel.config import parse_section
from synthetic_flight import simulate
from synthetic_flight.weather import (
    DayOfFlightAtmosphere,
    RangeSounding,
    day_of_flight_atmosphere,
    dryden_transverse,
    mean_air,
    range_sounding_sd,
    seasonal_wind,
    sense_atmosphere,
)
from tests.refusing import refuses

STILL = {"winds": False, "density_sd": 0.0, "wind_sd_mps": 0.0}
Z = np.arange(500.0, 129e3, 37.0)
HERE = Path(__file__).parent
WALLOPS_IN_AUGUST = ("2009-08-17T12:52:00Z", *np.deg2rad([37.8, -75.5]))


def day(seed=3, **keys):
    spec = parse_section(DayOfFlightAtmosphere, keys, "test")
    mean = mean_air(spec, HERE, *WALLOPS_IN_AUGUST)
    return day_of_flight_atmosphere(spec, np.random.default_rng(seed), mean)


def test_every_structure_leaves_the_random_day_as_it_is():
    plain = day().at(Z)
    pocket = {"altitude_m": 45e3, "depth": 0.1, "thickness_m": 2000.0}
    shear = {"altitude_m": 50e3, "north_mps": 10.0, "east_mps": -5.0, "thickness_m": 1000.0}
    gust = {"altitude_m": 40e3, "north_mps": 4.0, "east_mps": 3.0, "thickness_m": 500.0}
    band = {"sd_mps": 3.0, "length_m": 400.0, "from_m": 60e3, "to_m": 70e3}
    rich = day(pockets=[pocket], shears=[shear], discrete_gusts=[gust], gusts=[band]).at(Z)
    # a raised cosine on knots a tenth of its half-width apart, read linearly between: (pi/10)^2/8/2 = 0.6 %
    shape = np.where(np.abs(Z - 45e3) < 2e3, 0.5 * (1 + np.cos(np.pi * (Z - 45e3) / 2e3)), 0.0)
    np.testing.assert_allclose(rich.density_kgpm3 / plain.density_kgpm3, 1.0 - 0.1 * shape, atol=0.1 * 0.0065)
    np.testing.assert_allclose(rich.pressure_pa, plain.pressure_pa, rtol=1e-4)  # a pocket at unchanged pressure
    change = rich.wind_ned_mps - plain.wind_ned_mps
    here = (Z > 52e3) & (Z < 59e3)
    np.testing.assert_allclose(change[here, :2], np.tile([10.0, -5.0], (here.sum(), 1)), atol=1e-9)
    assert np.abs(change[(Z < 39e3) | ((Z > 41e3) & (Z < 49e3))]).max() < 1e-12
    near = (Z > 39e3) & (Z < 41e3)
    assert np.abs(change[near, 0]).max() == pytest.approx(4.0, rel=0.01)
    assert np.abs(change[near, 1]).max() == pytest.approx(3.0, rel=0.01)
    assert 1.0 < np.std(change[(Z > 61e3) & (Z < 69e3), 0]) < 5.0
    # the truth as it is flown: rows of the dynamics' own table resolve the smallest structure allowed
    thin = day(**STILL, pockets=[{"altitude_m": 45020.0, "depth": 0.1, "thickness_m": 200.0}])
    rows = simulate.atmosphere_table(thin)[:, 0]
    z = simulate.ATMOSPHERE_START_M + simulate.ATMOSPHERE_STEP_M * np.arange(len(rows))
    low = z < 120e3
    assert (rows[low] / us76(z[low])[0]).min() == pytest.approx(0.9, abs=0.01)


def test_adding_a_band_of_turbulence_does_not_change_another():
    bands = [
        {"sd_mps": 2.0, "length_m": 500.0, "from_m": 30e3, "to_m": 40e3},
        {"sd_mps": 2.0, "length_m": 500.0, "from_m": 60e3, "to_m": 70e3},
    ]
    one, two = day(gusts=bands[:1]).at(Z), day(gusts=bands).at(Z)
    low = Z < 50e3
    np.testing.assert_allclose(one.wind_ned_mps[low], two.wind_ned_mps[low], atol=1e-9)


def test_turbulence_has_drydens_spectrum():
    length, step, count = 400.0, 40.0, 4000
    rng = np.random.default_rng(1)
    drawn = np.array([dryden_transverse(count, step, length, rng) for _ in range(60)])
    # 60 x 4000 points, about 4 to an independent one: variance to sqrt(2/60000) = 0.6 %, 4 sd
    assert drawn.var() == pytest.approx(1.0, abs=0.025)
    for lag in (1, 5, 10, 20, 30):
        d = lag * step / length
        assert np.mean(drawn[:, lag:] * drawn[:, :-lag]) == pytest.approx((1 - 0.5 * d) * np.exp(-d), abs=0.025)
    # the spectrum itself, in bands well inside the sampling: (1 + 3 x^2)/(1 + x^2)^2 L/pi per rad/m, one-sided
    power = np.mean(np.abs(np.fft.rfft(drawn * np.hanning(count))) ** 2, axis=0) * step / (np.pi * 0.375 * count)
    x = 2.0 * np.pi * np.fft.rfftfreq(count, step) * length
    for low, high in ((0.3, 0.6), (0.8, 1.2), (2.0, 3.0)):
        inside = (x > low) & (x < high)
        theory = length / np.pi * (1 + 3 * x[inside] ** 2) / (1 + x[inside] ** 2) ** 2
        # at least 8 bins x 60 draws: sqrt(1/480) = 5 %, 3 sd; folding adds below 2 % at x = 3
        assert power[inside].mean() == pytest.approx(theory.mean(), rel=0.15)


def test_modelled_base_is_flown_and_carries_the_days_structure():
    bare = day(base="nrlmsis_2009_08_17", **STILL).at(Z)
    model = nrlmsis_profile().at(Z)
    np.testing.assert_allclose(bare.density_kgpm3, model.density_kgpm3, rtol=1e-12)
    np.testing.assert_allclose(bare.temperature_k, model.temperature_k, rtol=1e-12)
    high = np.array([200e3, 300e3])
    np.testing.assert_allclose(
        day(base="nrlmsis_2009_08_17").at(high).density_kgpm3, nrlmsis_profile().at(high).density_kgpm3, rtol=1e-3
    )
    ratio = day(base="nrlmsis_2009_08_17").at(Z).density_kgpm3 / model.density_kgpm3
    np.testing.assert_allclose(ratio, day().at(Z).density_kgpm3 / us76(Z)[0], rtol=1e-9)


def errors_of_range(age_h, seeds=200):
    spec = DayOfFlightAtmosphere(**STILL, sounding=RangeSounding(age_h=age_h))
    truth = day(**STILL)
    found = []
    for seed in range(seeds):
        z, air, wind = sense_atmosphere(truth, spec, np.random.default_rng(seed))
        real = truth.at(z)
        found.append(
            np.column_stack(
                [
                    np.log(air[:, 0] / real.density_kgpm3),
                    air[:, 1] - real.temperature_k,
                    wind - real.wind_ned_mps[:, :2],
                ]
            )
        )
    return z, real, np.array(found)


def test_range_sounding_errs_as_its_instruments_do():
    z, real, fresh = errors_of_range(0.0)
    want = range_sounding_sd(z, real.pressure_pa, real.temperature_k)[:, [0, 1, 2, 2]]
    low, high = chi2.ppf([1e-5, 1 - 1e-5], fresh.shape[0]) / fresh.shape[0]
    # smoothing rounds the corners of US76's own temperature by up to 0.35 K at its layer bases
    bias = np.array([0.0, 0.35, 0.0, 0.0])
    square = np.mean(fresh**2, axis=0)
    checked = [int(np.searchsorted(z, at)) for at in (1e3, 10e3, 20e3, 29e3, 40e3, 55e3, 65e3, 75e3, 85e3)]
    for k in checked:
        assert (square[k] > low * want[k] ** 2).all(), z[k]
        assert (square[k] < high * (want[k] ** 2 + bias**2)).all(), z[k]
    # what facts say of the instruments, at their own altitudes
    at = [int(np.searchsorted(z, a)) for a in (10e3, 40e3, 60e3, 80e3)]
    np.testing.assert_allclose(want[at, 2], [1.0, 1.0, 3.0, 7.0])
    np.testing.assert_allclose(want[at[1:], 0], 0.03)
    np.testing.assert_allclose(want[at, 1], [0.5, 1.5, 2.5, 5.0])


def test_an_old_sounding_errs_by_what_the_air_changed():
    z, real, old = errors_of_range(6.0)
    want = range_sounding_sd(z, real.pressure_pa, real.temperature_k)[:, [0, 2]]
    low, high = chi2.ppf([1e-5, 1 - 1e-5], old.shape[0]) / old.shape[0]
    for altitude in (10e3, 40e3, 60e3):
        k = int(np.searchsorted(z, altitude))
        square = np.mean(old[:, k][:, [0, 2]] ** 2, axis=0) / (want[k] ** 2 + np.array([0.03, 6.0]) ** 2)
        assert ((square > low) & (square < high)).all(), (altitude, square)


@pytest.mark.parametrize(("wavelength_m", "gain"), [(2000.0, 0.5), (1000.0, 0.0625), (8000.0, 0.9576)])
def test_range_sounding_resolves_two_kilometres(wavelength_m, gain):
    # a Gaussian's gain is 2^-((2 km / wavelength)^2)
    from dataclasses import replace

    truth = day(**STILL)
    z = np.arange(0.0, 130001.0, 25.0)
    wavy = replace(
        truth,
        altitude_m=z,
        log_density_ratio=0.02 * np.sin(2 * np.pi * z / wavelength_m),
        temperature_offset_k=np.zeros(len(z)),
        wind_ned_mps=np.zeros((len(z), 3)),
        density_sd=np.ones(len(z)),
        wind_sd_mps=np.ones(len(z)),
    )
    spec = DayOfFlightAtmosphere(sounding=RangeSounding(), sounding_scale=0.0)
    got, air, _ = sense_atmosphere(wavy, spec, np.random.default_rng(0))
    inside = (got > 40e3) & (got < 80e3)
    wave = np.log(air[:, 0] / us76(got)[0])[inside]
    phase = 2 * np.pi * got[inside] / wavelength_m
    basis = np.column_stack([np.sin(phase), np.cos(phase)])
    if wavelength_m == 1000.0:  # its samples 500 m apart fall on the nodes: only the size can be bounded
        assert np.abs(wave).max() < 0.02 * 0.0625 + 1e-6
        return
    size = np.hypot(*np.linalg.lstsq(basis, wave, rcond=None)[0]) / 0.02
    assert size == pytest.approx(gain, abs=0.01)


def test_top_and_faults_of_the_tables():
    spec = DayOfFlightAtmosphere(sounding=RangeSounding(top_m=72e3))
    z, _, _ = sense_atmosphere(day(), spec, np.random.default_rng(0))
    assert z[-1] == 72e3
    names = ["'depth'", r"thickness_m", r"gusts\.0", "length_m", "nrlmsis_2009_08_17"]
    with refuses("key-missing", "key-unknown", "key-value", "keys-conflict", names=names, kind=ConfigError):
        day(
            pockets=[{"altitude_m": 45e3, "depht": 0.1, "thickness_m": 100.0}],
            gusts=[{"sd_mps": 1.0, "length_m": 500.0, "from_m": 50e3, "to_m": 50.5e3}],
            base="nrlmsis_1999",
        )


# ---- winds of the place and month, measured soundings, NRLMSIS


def test_mean_winds_are_those_of_the_published_climatology():
    """CIRA-86's jets (Fleming et al. 1990, zonal means), whose own spread between years is 10 m/s and more."""
    for month, latitude_deg, altitude_km, east_mps in (
        (1, 35.0, 10.0, 35.0),  # subtropical jet
        (1, 40.0, 60.0, 50.0),  # winter mesosphere
        (7, 40.0, 65.0, -60.0),  # summer mesosphere
        (7, -45.0, 50.0, 85.0),  # southern winter stratopause
        (1, -40.0, 60.0, -65.0),  # southern summer
    ):
        wind = seasonal_wind(month, np.deg2rad(latitude_deg))
        assert np.interp(altitude_km, wind[:, 0], wind[:, 2]) == pytest.approx(east_mps, abs=20.0)


def test_mean_winds_obey_the_thermal_wind_equation():
    """Other way to them: their growth with height is the model's temperature gradient along latitude."""
    pymsis = pytest.importorskip("pymsis", reason="pymsis comes with the msis extra")
    month, lat = 1, 45.0
    z = 1000.0 * np.arange(30.0, 71.0, 5.0)
    longitude = np.arange(0.0, 360.0, 15.0)

    def temperature(latitude_deg, height_m):
        at = np.datetime64(f"2009-{month:02d}-15T12:00")
        out = pymsis.calculate(at, longitude, latitude_deg, height_m / 1e3, [120.0], [120.0], [[9.0] * 7], version=2.1)
        return np.asarray(out).reshape(len(longitude), len(height_m), 11)[..., 10].mean(axis=0)

    wind = seasonal_wind(month, np.deg2rad(lat))
    u = np.interp(z / 1e3, wind[:, 0], wind[:, 2])
    slope = (temperature(lat + 5.0, z) - temperature(lat - 5.0, z)) / (np.deg2rad(10.0) * (6.371e6 + z))
    middle = 0.5 * (temperature(lat, z)[1:] + temperature(lat, z)[:-1])
    f = 2.0 * 7.292e-5 * np.sin(np.deg2rad(lat)) + u * np.tan(np.deg2rad(lat)) / 6.4e6
    growth = -9.6 * 0.5 * (slope[1:] + slope[:-1]) / middle / (0.5 * (f[1:] + f[:-1])) * np.diff(z)
    # of 40 m/s in all; the table is rounded to 1 m/s
    np.testing.assert_allclose(np.cumsum(growth), np.diff(u).cumsum(), atol=6.0)


def test_winds_are_those_of_the_place_and_month_unless_stated():
    spec = parse_section(DayOfFlightAtmosphere, {}, "test")
    north, south = (mean_air(spec, HERE, "2012-01-20T00:00:00Z", np.deg2rad(x), 0.0).wind for x in (45.0, -45.0))
    assert np.interp(60.0, north[:, 0], north[:, 2]) > 30.0
    assert np.interp(60.0, south[:, 0], south[:, 2]) < -30.0
    stated = {"mean_wind": [[0.0, 1.0, 2.0], [100e3, 1.0, 2.0]], "wind_sd_mps": 0.0}
    np.testing.assert_allclose(day(**stated).at(np.array([50e3])).wind_ned_mps[0], [1.0, 2.0, 0.0], atol=1e-12)
    twice = {"mean_wind": [[5.0, 0.0, 0.0], [5.0, 0.0, 0.0]]}
    for keys in ({**stated, "winds": False}, twice, {"from": "a.csv", "base": "us76"}):
        with pytest.raises(ConfigError):
            parse_section(DayOfFlightAtmosphere, keys, "test")


def sounding(folder, z, air, columns="alt_m,rho_kgpm3,t_k,wind_n_mps,wind_e_mps"):
    rows = np.column_stack([z, air.density_kgpm3, air.temperature_k, air.wind_ned_mps[:, :2]])
    text = "\n".join(",".join(f"{x:.9g}" for x in row) for row in rows)
    (folder / "sounding.csv").write_text(f"{columns}\n{text}\n")


def flown_from(folder, **keys):
    spec = parse_section(DayOfFlightAtmosphere, {"from": "sounding.csv", **keys}, "test")
    return day_of_flight_atmosphere(spec, np.random.default_rng(0), mean_air(spec, folder, *WALLOPS_IN_AUGUST))


def test_a_measured_sounding_is_flown_as_measured(tmp_path):
    z = np.arange(0.0, 80001.0, 500.0)
    air = day(seed=8).at(z)
    sounding(tmp_path, z, air)
    flown = flown_from(tmp_path).at(z)
    np.testing.assert_allclose(flown.density_kgpm3, air.density_kgpm3, rtol=1e-7)
    np.testing.assert_allclose(flown.temperature_k, air.temperature_k, atol=1e-3)
    np.testing.assert_allclose(flown.wind_ned_mps, air.wind_ned_mps, atol=1e-4)
    assert np.abs(flown_from(tmp_path, winds=False).at(z).wind_ned_mps).max() == 0.0
    # above its top it fades into the standard; structure comes only where its size is stated
    high = flown_from(tmp_path).at(np.array([140e3]))
    assert high.density_kgpm3[0] == pytest.approx(us76(140e3)[0], rel=1e-3)
    rough = np.log(flown_from(tmp_path, density_sd=0.02).at(z).density_kgpm3 / air.density_kgpm3)
    assert 0.005 < rough.std() < 0.06


def test_faults_of_a_sounding_are_named(tmp_path):
    z = np.arange(0.0, 80001.0, 5000.0)
    sounding(tmp_path, z, day().at(z), "alt_m,rho_kgpm3,t_k,wind_n_mps,wind_x_mps")
    with refuses("column-missing", names=["wind"], kind=ConfigError):
        flown_from(tmp_path)
    (tmp_path / "sounding.csv").unlink()
    with refuses("file-missing", kind=ConfigError):
        flown_from(tmp_path)


def test_nrlmsis_of_any_day_and_place_is_the_models():
    pymsis = pytest.importorskip("pymsis", reason="pymsis comes with the msis extra")
    spec = parse_section(DayOfFlightAtmosphere, {"base": "nrlmsis", "f107": 75.0, "ap": 5.0, **STILL}, "test")
    at, z = ("2012-07-23T11:01:00Z", *np.deg2rad([-33.0, 151.0])), np.array([30e3, 60e3, 95e3])
    flown = day_of_flight_atmosphere(spec, np.random.default_rng(0), mean_air(spec, HERE, *at)).at(z)
    indices = [75.0], [75.0], [[5.0] * 7]
    model = pymsis.calculate(np.datetime64("2012-07-23T11:01"), 151.0, -33.0, z / 1e3, *indices, version=2.1)
    model = np.asarray(model).reshape(3, 11)
    np.testing.assert_allclose(flown.density_kgpm3, model[:, 0], rtol=1e-5)
    np.testing.assert_allclose(flown.temperature_k, model[:, 10], atol=1e-2)


def test_winds_of_hwm_are_refused_with_the_way_to_state_them():
    with refuses("key-value", names=["hwm14", "mean_wind"], kind=ConfigError):
        parse_section(DayOfFlightAtmosphere, {"winds": "hwm14"}, "test")


def test_nrlmsis_without_its_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymsis", None)
    spec = parse_section(DayOfFlightAtmosphere, {"base": "nrlmsis"}, "test")
    with refuses("package-missing", names=[r"postflight\[msis\]"], kind=ConfigError):
        mean_air(spec, HERE, "2001-01-01T00:00:00Z", 0.1, 0.1)
