"""Soundings as stations and ranges write them become as-flown air: winds as velocities, each change noted."""

import os
import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from flightmodel.config import parse_utc
from flightmodel.gate import Gate
from flightmodel.instruments import AtmosphereEntry
from flightmodel.sensor_tables import read_sounding
from postflight.cli import cli

REAL = os.environ.get("POSTFLIGHT_REALDATA")
PACKAGE = Path(__file__).parents[2] / "examples" / "range_package_01" / "telemetry"
LEVELS = [  # hPa, m, C, dew point C, from deg, knots
    (1012.0, 13, 12.2, 12.2, 30, 14), (1000.0, 116, 11.2, 11.0, 30, 21), (925.0, 764, 8.0, 8.0, 30, 32),
    (850.0, 1461, 9.0, 8.7, 35, 17), (812.7, 1828, None, None, 35, 16), (700.0, 3040, 2.0, -4.0, 255, 37),
    (500.0, 5660, -14.0, None, 260, 45), (300.0, 9320, -42.0, None, 350, 60), (280.0, 9800, -45.0, None, None, None),
    (250.0, 10530, -50.0, None, 10, 60), (100.0, 16340, -60.1, None, 285, 15),
]  # fmt: skip
WIDE = "   PRES   HGHT   TEMP   DWPT   RELH   MIXR   DRCT   SKNT   THTA   THTE   THTV"
UNITS = "    hPa     m      C      C      %    g/kg    deg   knot     K      K      K "


@pytest.fixture
def folder(tmp_path):
    CliRunner().invoke(cli, ["init", str(tmp_path / "flight")])
    return tmp_path / "flight"


def brought_in(folder, path):
    """Sounding and codes of findings as the reader has them after import, and what import printed."""
    result = CliRunner().invoke(cli, ["import", str(path), "--into", str(folder)])
    assert result.exit_code == 0, result.exception
    entry = AtmosphereEntry.model_validate(tomllib.loads((folder / "flight.toml").read_text())["atmosphere"])
    gate = Gate(folder, parse_utc("2009-08-17T12:52:00Z"))
    sounding = read_sounding(gate, entry)
    gate.close()
    return sounding, {f.code for f in gate.findings}, result.output


def wyoming(path):
    rule = "-" * 77

    def cell(value, digits):
        return " " * 7 if value is None else f"{value:7.{digits}f}"

    lines = ["72402 WAL Wallops Island Observations at 00Z 04 May 1999", "", rule, WIDE, UNITS, rule]
    for p, h, t, td, dd, ff in LEVELS:
        cells = [cell(p, 1), cell(h, 0), cell(t, 1), cell(td, 1), " " * 14, cell(dd, 0), cell(ff, 0)]
        lines.append("".join(cells) + cell(290.0 if t is not None else None, 1))
    lines += ["Station information and sounding indices", "", "                         Station identifier: WAL"]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_wyoming_list(folder, tmp_path):
    s, codes, output = brought_in(folder, wyoming(tmp_path / "wal.txt"))
    assert "values-converted" in codes
    assert re.search(r"\b0 levels\b", output)  # none is left out
    # a knot is 0.5144 m/s; from 30 deg the air goes to 210 deg
    assert s.wind_north_mps[0] == pytest.approx(-14 * 0.514444 * np.cos(np.deg2rad(30)), rel=1e-5)
    assert s.wind_east_mps[0] == pytest.approx(-14 * 0.514444 * np.sin(np.deg2rad(30)), rel=1e-5)
    # moist air by hand: e = 14.2 hPa at a dew point of 12.2 C, T_v = 287.0 K
    e = 6.112 * np.exp(17.67 * 12.2 / (12.2 + 243.5))
    density = (1012.0 - 0.378 * e) * 100.0 / (287.053 * (273.15 + 12.2))
    assert s.density_kgpm3[0] == pytest.approx(density, rel=1e-4)
    # geometric: 16340 m of geopotential are 42 m more
    assert s.altitude_m[-1] == pytest.approx(16340.0 + 16340.0**2 / 6356766.0, abs=0.2)
    # the wind of 280 hPa lies between 350 and 10 deg, not at 180
    k = int(np.argmin(np.abs(s.altitude_m - 9800.0)))
    assert s.wind_north_mps[k] < -25.0
    # the temperature of 812.7 hPa lies between its neighbours'
    k = int(np.argmin(np.abs(s.altitude_m - 1828.0)))
    assert 275.15 < s.temperature_k[k] < 282.15
    assert len(s.altitude_m) == len(LEVELS)


def test_wind_by_components_of_where_it_goes(folder, tmp_path):
    table = pd.DataFrame({"alt_km": np.arange(0.0, 60.0, 5.0)})
    table = table.assign(density_kgpm3=1.2 * np.exp(-table.alt_km / 7.2), temp_K=250.0, u_mps=5.0, v_mps=-3.0)
    table.to_csv(tmp_path / "rocketsonde.csv", index=False)
    s, codes, _ = brought_in(folder, tmp_path / "rocketsonde.csv")
    assert "values-converted" not in codes
    assert (s.wind_east_mps == 5.0).all()
    assert (s.wind_north_mps == -3.0).all()


def test_delivered_composite_is_declared_as_it_stands(folder):
    s, codes, _ = brought_in(folder, PACKAGE / "met_composite.csv")
    delivered = pd.read_csv(PACKAGE / "met_composite.csv")
    np.testing.assert_array_equal(s.density_kgpm3, delivered["DENSITY (kg/m3)"])
    assert "values-converted" in codes
    assert (folder / "telemetry" / "met_composite.csv").read_bytes() == (PACKAGE / "met_composite.csv").read_bytes()


def test_rocketsonde_with_german_names_and_a_time_column(folder, tmp_path):
    z = np.arange(25.0, 65.0, 1.0)
    pd.DataFrame(
        {"Zeit [s]": np.arange(len(z)) * 10.0, "Höhe [km]": z[::-1], "Temperatur [K]": 240.0,
         "Dichte [g/m3]": 40.0 * np.exp(-z[::-1] / 7 + 25 / 7),
         "Windgeschwindigkeit [m/s]": 20.0, "Windrichtung [°]": 90.0}
    ).to_csv(tmp_path / "sonde.csv", index=False, sep=";", encoding="latin-1")  # fmt: skip
    s, _, _ = brought_in(folder, tmp_path / "sonde.csv")
    assert s.altitude_m[0] == 25000.0
    assert s.density_kgpm3[0] == pytest.approx(0.04)
    np.testing.assert_allclose(s.wind_east_mps, -20.0)


@pytest.mark.realdata
@pytest.mark.skipif(REAL is None, reason="POSTFLIGHT_REALDATA names no folder of recorded flights")
@pytest.mark.parametrize("name", ["KWAL_19990504_00Z", "KEPZ_19990504_00Z"])
def test_radiosondes(name, folder):
    path = Path(str(REAL)) / "soundings" / f"{name}.csv"
    s, codes, _ = brought_in(folder, path)
    assert "values-converted" in codes
    table = pd.read_csv(path)
    # the station's own components say where the air goes
    wind = table[table.from_deg.notna() & table.h_m.between(500, 16000)]
    at = 6356766.0 * wind.h_m / (6356766.0 - wind.h_m)
    np.testing.assert_allclose(np.interp(at, s.altitude_m, s.wind_east_mps), wind.u_east_mps, atol=0.02)
    np.testing.assert_allclose(np.interp(at, s.altitude_m, s.wind_north_mps), wind.v_north_mps, atol=0.02)
    # hydrostatic: the pressures' fall and the densities agree to the layers' thickness
    thick = np.diff(s.altitude_m) > 300.0
    fall = -np.diff(np.log(s.pressure_pa)) / np.diff(s.altitude_m)
    weight = 9.80665 / (1.0 + s.altitude_m / 6356766.0) ** 2 * s.density_kgpm3 / s.pressure_pa
    ratio = fall / (0.5 * (weight[1:] + weight[:-1]))
    assert np.median(ratio[thick]) == pytest.approx(1.0, abs=0.005)
    # the dew point's vapour is in it, as far as the virtual temperature tells: some tenths of a percent near the ground
    wet = table[table.T_C.notna() & table.Td_C.notna() & table.p_hpa.notna() & table.h_m.notna()].iloc[0]
    dry = 100.0 * wet.p_hpa / (287.053 * (wet.T_C + 273.15))
    vapour = 0.378 * 611.2 * np.exp(17.67 * wet.Td_C / (wet.Td_C + 243.5)) / (100.0 * wet.p_hpa)
    there = 6356766.0 * wet.h_m / (6356766.0 - wet.h_m)
    assert vapour > 5e-4
    assert np.interp(there, s.altitude_m, s.density_kgpm3) / dry == pytest.approx(1.0 - vapour, abs=0.1 * vapour)


@pytest.mark.parametrize(
    "names",
    [("Wind north", "Wind east"), ("wind_n", "wind_e"), ("V wind", "U wind"), ("Northward wind", "Eastward wind")],
)
def test_components_of_the_wind_are_not_taken_for_its_speed(folder, tmp_path, names):
    height = np.arange(0.0, 40e3, 1000.0)
    columns = {"Height (m)": height, "Density (kg/m3)": 1.2 * np.exp(-height / 7e3)}
    columns |= {"Temperature (K)": 250.0 + 0.0 * height}
    columns |= {
        f"{name} (m/s)": shift + 9.0 * np.sin(height / 9e3) for name, shift in zip(names, (0.0, 5.0), strict=True)
    }
    pd.DataFrame(columns).to_csv(tmp_path / "air.csv", index=False)
    assert CliRunner().invoke(cli, ["import", str(tmp_path / "air.csv"), "--into", str(folder)]).exit_code == 0
    proposed = tomllib.loads((folder / "flight.toml").read_text())["atmosphere"]["columns"]
    assert [proposed[q]["column"] for q in ("wind_north", "wind_east")] == [f"{name} (m/s)" for name in names]
    assert "wind_speed" not in proposed
