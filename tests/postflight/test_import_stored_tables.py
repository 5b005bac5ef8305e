"""Odd shapes of delivery come in with the right numbers, computed here by hand, or are refused by name."""

from __future__ import annotations

import builtins
import sys
import tomllib
import zipfile

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from scipy.io import netcdf_file, savemat

from flightmodel.checks import ConfigError, GateError
from flightmodel.config import parse_utc
from flightmodel.gate import Gate
from flightmodel.instruments import AtmosphereEntry, RadarEntry
from flightmodel.sensor_tables import read_radar, read_sounding
from postflight.cli import cli
from postflight.intake import stored_tables
from tests.refusing import printed_codes, refuses

# a range's radar, in feet and mils of an older plotting board, and in SI
T = np.arange(50) * 0.1
RANGE_FT = 310_000.0 - 2_900.0 * T
AZ_DEG, EL_DEG = 131.0 + 0.02 * T, 41.0 - 0.3 * T
RANGE_M = RANGE_FT * 0.3048
GYRO_DEGPS = np.stack([40.0 + 0.1 * T, 0.2 * np.sin(T), -0.1 * np.cos(T)])
FORCE_G = np.stack([-2.0 + 0.1 * T, 0.01 * T, 0.02 + 0.0 * T])
ANSWERS = {"latitude_deg": 37.8, "longitude_deg": -75.5, "height_m": 10.0}


@pytest.fixture
def folder(tmp_path):
    CliRunner().invoke(cli, ["init", str(tmp_path / "flight")])
    return tmp_path / "flight"


def brought_in(folder, *paths, code=0):
    """Tables of flight.toml after import, and what import printed."""
    result = CliRunner().invoke(cli, ["import", *map(str, paths), "--into", str(folder)])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return tomllib.loads((folder / "flight.toml").read_text()), result.output


def radar_of(folder, entry):
    """Range, azimuth and elevation in SI as the reader of flights has them."""
    gate = Gate(folder, parse_utc("2009-08-17T12:52:00Z"))
    record = read_radar(gate, "radar", RadarEntry.model_validate(entry | ANSWERS))
    gate.close()
    return record.time_s, record.range_az_el


def sounding_of(folder, tables):
    """Sounding as the reader of flights has it, and the pressures that were written."""
    gate = Gate(folder, parse_utc("2009-08-17T12:52:00Z"))
    sounding = read_sounding(gate, AtmosphereEntry.model_validate(tables["atmosphere"]))
    gate.close()
    return sounding, pd.read_csv(folder / tables["atmosphere"]["file"])["p_pa"]


def check_radar(folder, tables, name, starts_s=0.0):
    time_s, measured = radar_of(folder, tables["radars"][name])
    np.testing.assert_allclose(time_s - time_s[0], T, atol=1e-9)
    assert time_s[0] == pytest.approx(starts_s, abs=1e-6)
    wanted = np.column_stack([RANGE_M, np.deg2rad(AZ_DEG), np.deg2rad(EL_DEG)])
    np.testing.assert_allclose(measured, wanted, rtol=1e-12)


# ------------------------------------------------------------------------------------------------------ spreadsheets


def test_a_spreadsheet_with_a_row_of_units(folder, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = "track"
    for row in (["Radar 7, run 3"], [], ["Time", "Range", "Azimuth", "Elev", None], ["sec", "ft", "deg", "deg"]):
        sheet.append(row)
    for row in zip(T, RANGE_FT, AZ_DEG, EL_DEG, strict=True):
        sheet.append([float(x) for x in row])
    book.create_sheet("remarks").append(["nothing but words"])
    book.save(tmp_path / "tracks.xlsx")
    tables, _ = brought_in(folder, tmp_path / "tracks.xlsx")
    ((name, entry),) = tables["radars"].items()
    assert entry["columns"]["range"] == {"column": "Range", "unit": "ft"}
    check_radar(folder, tables, name)
    assert "remarks" in (folder / "flight.toml").read_text()


def test_a_spreadsheet_with_two_tables_and_dates(folder, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    from datetime import datetime, timedelta

    book = openpyxl.Workbook()
    first, second = book.active, book.create_sheet("gyros")
    first.title = "radar"
    first.append(["UTC", "Range [ft]", "Az [deg]", "El [deg]"])
    start = datetime(2009, 8, 17, 12, 59)
    for t, *row in zip(T, RANGE_FT, AZ_DEG, EL_DEG, strict=True):
        first.append([start + timedelta(seconds=float(t)), *map(float, row)])
    second.append(["t_s", "roll rate (deg/hr)", "pitch rate (deg/hr)", "yaw rate (deg/hr)"])
    for row in zip(T, *GYRO_DEGPS * 3600.0, strict=True):
        second.append([float(x) for x in row])
    book.save(tmp_path / "all.xlsx")
    tables, _ = brought_in(folder, tmp_path / "all.xlsx")
    check_radar(folder, tables, next(iter(tables["radars"])), starts_s=420.0)
    assert {c["unit"] for c in tables["sensors"]["rates"]["columns"].values()} == {"degph"}
    kept = pd.read_csv(folder / tables["sensors"]["rates"]["file"])
    np.testing.assert_allclose(kept.iloc[:, 1:].to_numpy(), GYRO_DEGPS.T * 3600.0)


def workbook_by_hand(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return path


def test_a_spreadsheet_without_the_library_is_refused_with_the_extra(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(ConfigError) as refusal:
        brought_in(folder, workbook_by_hand(tmp_path / "a.xlsx"))
    assert refusal.value.codes == ("package-missing",)
    assert "postflight[excel]" in str(refusal.value)
    assert not list((folder / "telemetry").iterdir())


def test_damaged_and_old_files_are_refused_by_name(folder, tmp_path):
    files = {
        "old.xls": (b"\xd0\xcf\x11\xe0" + bytes(600), "file-unreadable"),
        "cut.parquet": (b"PAR1" + bytes(50), "file-unreadable"),
        "cut.nc": (b"CDF\x01" + bytes(5), "file-unreadable"),
        "new.nc": (b"CDF\x05" + bytes(50), "file-unreadable"),
        "cut.h5": (b"\x89HDF\r\n\x1a\n" + bytes(40), "file-unreadable"),
    }
    for name, (content, _) in files.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(GateError) as refusal:
        brought_in(folder, *(tmp_path / name for name in files))
    assert refusal.value.codes == tuple(code for _, code in files.values())
    assert all(name in str(refusal.value) for name in files)


# ----------------------------------------------------------------------------------------------------------- Parquet


def test_parquet_with_units_in_its_fields(folder, tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    stamps = np.datetime64("2009-08-17T12:59:00", "us") + np.round(T * 1e6).astype("timedelta64[us]")
    columns = {"time": pa.array(stamps), "range": pa.array(RANGE_FT), "azimuth": pa.array(AZ_DEG),
               "elevation": pa.array(EL_DEG), "good": pa.array([[1]] * len(T))}  # fmt: skip
    units = {"range": "ft", "azimuth": "deg", "elevation": "deg"}
    fields = [
        pa.field(name, column.type, metadata={"unit": units[name]} if name in units else None)
        for name, column in columns.items()
    ]
    pq.write_table(pa.Table.from_arrays(list(columns.values()), schema=pa.schema(fields)), tmp_path / "radar.parquet")
    tables, output = brought_in(folder, tmp_path / "radar.parquet")
    check_radar(folder, tables, "radar", starts_s=420.0)
    assert "good" in output  # left out, and named


def test_parquet_without_the_library_is_refused_with_the_extra(folder, tmp_path, monkeypatch):
    (tmp_path / "a.parquet").write_bytes(b"PAR1" + bytes(50))
    there = builtins.__import__

    def without(name, *arguments):
        if name.startswith("pyarrow"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return there(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError) as refusal:
        brought_in(folder, tmp_path / "a.parquet")
    assert refusal.value.codes == ("package-missing",)
    assert "postflight[parquet]" in str(refusal.value)


# ------------------------------------------------------------------------------------------------------------ NetCDF


def packed(metres):
    """16-bit numbers of 5 m above 50 km, the third of them missing."""
    stored = np.round((metres - 50e3) / 5.0).astype(np.int16)
    stored[2] = -32768
    return stored


def test_classic_netcdf_packed_and_since_an_epoch(folder, tmp_path):
    with netcdf_file(tmp_path / "radar.nc", "w") as file:
        file.createDimension("time", len(T))
        time = file.createVariable("time", "d", ("time",))
        time[:], time.units = T, "seconds since 2009-08-17 12:59:00 UTC"
        slant = file.createVariable("slant_range", "h", ("time",))
        slant[:], slant.units = packed(RANGE_M), "m"
        slant.scale_factor, slant.add_offset, slant._FillValue = 5.0, 50e3, np.int16(-32768)
        for name, values in (("azimuth", AZ_DEG), ("elevation", EL_DEG)):
            angle = file.createVariable(name, "d", ("time",))
            angle[:], angle.units = values, "degree"
    tables, _ = brought_in(folder, tmp_path / "radar.nc")
    time_s, measured = radar_of(folder, tables["radars"]["radar"])
    known = np.isfinite(measured[:, 0])
    assert not known[2]
    assert known.sum() == len(T) - 1
    np.testing.assert_allclose(time_s, 420.0 + T, atol=1e-6)
    np.testing.assert_allclose(measured[known, 0], RANGE_M[known], atol=2.5001)
    np.testing.assert_allclose(measured[:, 2], np.deg2rad(EL_DEG), rtol=1e-12)


def test_netcdf_4_with_two_dimensions_of_one_length(folder, tmp_path):
    netcdf = pytest.importorskip("netCDF4")
    pytest.importorskip("h5py")
    with netcdf.Dataset(tmp_path / "day.nc", "w") as file:
        for dimension in ("t_radar", "t_gyro"):
            file.createDimension(dimension, len(T))
            clock = file.createVariable(dimension, "f8", (dimension,))
            clock[:], clock.units = T, "s"
        for name, values in (("range", RANGE_FT), ("azimuth", AZ_DEG), ("elevation", EL_DEG)):
            column = file.createVariable(name, "f8", ("t_radar",))
            column[:], column.units = values, "ft" if name == "range" else "degrees"
        for axis, values in zip("xyz", GYRO_DEGPS, strict=True):
            column = file.createVariable(f"gyro_{axis}", "f8", ("t_gyro",))
            column[:], column.units = np.deg2rad(values), "rad s-1"
    tables, _ = brought_in(folder, tmp_path / "day.nc")
    check_radar(folder, tables, next(iter(tables["radars"])))
    rates = tables["sensors"]["rates"]
    assert {c["unit"] for c in rates["columns"].values()} == {"radps"}
    kept = pd.read_csv(folder / rates["file"])
    np.testing.assert_array_equal(kept[["gyro_x", "gyro_y", "gyro_z"]], np.deg2rad(GYRO_DEGPS.T))


# ------------------------------------------------------------------------------------------------------------ MATLAB


def channel(values, unit):
    return {"data": values, "units": unit}


MATLAB = {
    "units by name": {"track": {"t": T, "range": RANGE_FT, "az": AZ_DEG, "el": EL_DEG,
                                "units": {"t": "s", "range": "ft", "az": "deg", "el": "deg"}}},
    "units in a list": {"track": {"t": T, "range": RANGE_FT, "az": AZ_DEG, "el": EL_DEG,
                                  "units": np.array(["s", "ft", "deg", "deg"], dtype=object)}},
    "a matrix with names": {"track": {"data": np.column_stack([T, RANGE_FT, AZ_DEG, EL_DEG]),
                                      "names": np.array(["t", "range", "az", "el"], dtype=object),
                                      "units": np.array(["s", "ft", "deg", "deg"], dtype=object)}},
    "a structure a channel": {"track": {"t": channel(T, "s"), "range": channel(RANGE_FT, "ft"),
                                        "az": channel(AZ_DEG, "deg"), "el": channel(EL_DEG, "deg")}},
}  # fmt: skip


@pytest.mark.parametrize("shape", MATLAB)
def test_a_matlab_structure_with_units(shape, folder, tmp_path):
    savemat(tmp_path / "day.mat", MATLAB[shape])
    tables, _ = brought_in(folder, tmp_path / "day.mat")
    ((name, entry),) = tables["radars"].items()
    assert {key: c["unit"] for key, c in entry["columns"].items()} == {"range": "ft", "az": "deg", "el": "deg"}
    check_radar(folder, tables, name)


def test_channels_with_times_of_their_own(folder, tmp_path):
    """Three accelerometers on one clock and a radar's three channels on another, of one length."""
    accel = {f"acc_{a}": channel(v, "g") | {"time": T + 0.05} for a, v in zip("xyz", FORCE_G, strict=True)}
    radar = {n: channel(v, u) | {"time": T} for n, v, u in (
        ("range", RANGE_FT, "ft"), ("az", AZ_DEG, "deg"), ("el", EL_DEG, "deg"))}  # fmt: skip
    savemat(tmp_path / "day.mat", {"rec": accel | radar})
    tables, _ = brought_in(folder, tmp_path / "day.mat")
    check_radar(folder, tables, next(iter(tables["radars"])))
    sensor = tables["sensors"]["accelerometer"]
    assert {c["unit"] for c in sensor["columns"].values()} == {"g"}
    kept = pd.read_csv(folder / sensor["file"])
    np.testing.assert_allclose(kept["time"], T + 0.05)
    np.testing.assert_array_equal(kept[["acc_x", "acc_y", "acc_z"]], FORCE_G.T)


def test_units_that_fit_no_columns_are_named(folder, tmp_path):
    content = MATLAB["units in a list"]["track"] | {"units": np.array(["s", "ft"], dtype=object)}
    savemat(tmp_path / "day.mat", {"track": content})
    tables, output = brought_in(folder, tmp_path / "day.mat")
    (entry,) = tables["radars"].values()
    assert entry["columns"]["range"]["unit"] == "FILL IN"
    assert "left out, as no columns of numbers: units" in output


def test_matlab_73_with_units(folder, tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "day.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values, unit in (
            ("t", T, "s"),
            ("range", RANGE_FT, "ft"),
            ("az", AZ_DEG, "deg"),
            ("el", EL_DEG, "deg"),
        ):
            file[f"track/{name}"] = values[None, :]
            text = file.create_dataset(f"track/units/{name}", data=np.array([[ord(c)] for c in unit], dtype=np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes()[512:])
    tables, _ = brought_in(folder, path)
    check_radar(folder, tables, next(iter(tables["radars"])))


# --------------------------------------------------------------------------------------------------------- soundings

HPA = np.array([1010.0, 925.0, 850.0, 700.0, 500.0, 300.0])
HEIGHT_M = np.array([20.0, 780.0, 1500.0, 3060.0, 5700.0, 9300.0])
CELSIUS = np.array([18.0, 12.0, 8.0, 0.0, -17.0, -43.0])
DEW_C = np.array([15.0, 9.0, 2.0, -12.0, -30.0, -60.0])
FROM_DEG = np.array([200.0, 215.0, 230.0, 250.0, 260.0, 270.0])
SPEED = np.array([4.0, 7.0, 9.0, 14.0, 22.0, 35.0])


def check_sounding(read, geometric=False, dry=False):
    """Against the gas law with Bolton's vapour, winds of the air mass and geometric heights, computed here."""
    sounding, pressure_pa = read
    vapour = 0.0 if dry else 6.112 * np.exp(17.67 * DEW_C / (DEW_C + 243.5))
    density = 100.0 * (HPA - 0.378 * vapour) / (287.053 * (CELSIUS + 273.15))
    height = HEIGHT_M if geometric else HEIGHT_M * 6356766.0 / (6356766.0 - HEIGHT_M)
    np.testing.assert_allclose(sounding.altitude_m, height, atol=0.01)
    np.testing.assert_allclose(sounding.density_kgpm3, density, rtol=2e-5)
    np.testing.assert_allclose(sounding.temperature_k, CELSIUS + 273.15, atol=0.01)
    np.testing.assert_allclose(pressure_pa, 100.0 * HPA, rtol=1e-6)
    np.testing.assert_allclose(sounding.wind_north_mps, -SPEED * np.cos(np.deg2rad(FROM_DEG)), atol=1e-3)
    np.testing.assert_allclose(sounding.wind_east_mps, -SPEED * np.sin(np.deg2rad(FROM_DEG)), atol=1e-3)


def wyoming_csv(path):
    """As the University of Wyoming writes since 2024: with times, latitudes and longitudes."""
    names = "time,longitude,latitude,pressure_hPa,geopotential height_m,temperature_C,dew point temperature_C," \
            "ice point temperature_C,relative humidity_%,humidity wrt ice_%,mixing ratio_g/kg,wind direction_degree," \
            "wind speed_m/s"  # fmt: skip
    rows = [
        f"2009-08-17 11:0{k}:00,-75.4{k},37.9{k},{p},{h:.0f},{t},{d},{d},80,80,8.1,{a:.0f},{v}"
        for k, (p, h, t, d, a, v) in enumerate(zip(HPA, HEIGHT_M, CELSIUS, DEW_C, FROM_DEG, SPEED, strict=True))
    ]
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


def test_a_wyoming_csv_is_a_sounding_and_nothing_else(folder, tmp_path):
    tables, _ = brought_in(folder, wyoming_csv(tmp_path / "wal.csv"))
    assert not {"gnss", "barometers", "radars"} & set(tables)
    check_sounding(sounding_of(folder, tables))


PREFACE = ["Station name\tWallops", "Balloon release date and time\t2009-08-17T11:00:00", "Software\tMW41 2.17.0", ""]


@pytest.mark.parametrize(
    ("height", "geometric", "preface"),
    [("HeightMSL", False, []), ("GpsHeightMSL", True, []), ("HeightMSL", False, PREFACE)],
)
def test_a_vaisala_csv_with_a_row_of_units(folder, tmp_path, height, geometric, preface):
    """With commas, and with tabs below a preface, as the ground station writes it."""
    names = f"Elapsed time,P,Temp,RH,Dewp,Speed,Dir,Ecomp,Ncomp,Lat,Lon,AscRate,{height}"
    rows = [names, "s,hPa,°C,%,°C,m/s,°,m/s,m/s,°,°,m/s,m"]
    north, east = -SPEED * np.cos(np.deg2rad(FROM_DEG)), -SPEED * np.sin(np.deg2rad(FROM_DEG))
    for k in range(len(HPA)):
        wind = f"{SPEED[k]},{FROM_DEG[k]},{east[k]:.3f},{north[k]:.3f}"
        rows.append(f"{60.0 * k},{HPA[k]},{CELSIUS[k]},80,{DEW_C[k]},{wind},37.9{k},-75.4{k},5.0,{HEIGHT_M[k]}")
    rows = [*preface, *(row.replace(",", "\t") for row in rows)] if preface else rows
    (tmp_path / "sonde.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    tables, _ = brought_in(folder, tmp_path / "sonde.csv")
    assert not {"gnss", "barometers"} & set(tables)
    check_sounding(sounding_of(folder, tables), geometric)


def test_knots_feet_fahrenheit_and_inches_of_mercury(folder, tmp_path):
    table = pd.DataFrame({"Alt (ft)": HEIGHT_M / 0.3048, "Press (inHg)": HPA / 33.863886667,
                          "Temp (F)": CELSIUS * 1.8 + 32.0, "Dew Point (F)": DEW_C * 1.8 + 32.0,
                          "Wind Dir (deg)": FROM_DEG, "Wind Speed (kt)": SPEED / 0.514444444})  # fmt: skip
    table.to_csv(tmp_path / "met.csv", index=False)
    tables, _ = brought_in(folder, tmp_path / "met.csv")
    check_sounding(sounding_of(folder, tables))


def test_winds_by_components_with_pressure_and_temperature_are_a_sounding(folder, tmp_path):
    east, north = -SPEED * np.sin(np.deg2rad(FROM_DEG)), -SPEED * np.cos(np.deg2rad(FROM_DEG))
    table = pd.DataFrame(
        {"p [hPa]": HPA, "height [m]": HEIGHT_M, "T [degC]": CELSIUS, "u [m/s]": east, "v [m/s]": north}
    )
    table.to_csv(tmp_path / "met.csv", index=False)
    tables, _ = brought_in(folder, tmp_path / "met.csv")
    assert "barometers" not in tables
    check_sounding(sounding_of(folder, tables), dry=True)


def test_a_sounding_that_is_not_whole_is_named_and_never_a_barometer(folder, tmp_path):
    names = "pressure_furlong,height_m,temperature_C,wind direction_degree,wind speed_m/s"
    rows = [f"{p},{h},{t},{a},{v}" for p, h, t, a, v in zip(HPA, HEIGHT_M, CELSIUS, FROM_DEG, SPEED, strict=True)]
    (tmp_path / "met.csv").write_text("\n".join([names.replace("_furlong", " (zorks)"), *rows]) + "\n")
    tables, output = brought_in(folder, tmp_path / "met.csv", code=3)
    assert not {"gnss", "barometers", "atmosphere"} & set(tables)
    assert "column-missing" in printed_codes(output)
    assert "pressure (zorks)" in output


# ---------------------------------------------------------------------------------------------------- nothing vanishes


def test_what_is_not_used_is_named_and_the_exit_code_says_so(folder, tmp_path):
    pd.DataFrame({"t_s": T, "range_ft": RANGE_FT, "az_deg": AZ_DEG, "el_deg": EL_DEG}).to_csv(
        tmp_path / "good.csv", index=False
    )
    pd.DataFrame({"t_s": T, "foo": RANGE_FT, "bar": AZ_DEG}).to_csv(tmp_path / "odd.csv", index=False)
    wyoming_csv(tmp_path / "morning.csv")
    wyoming_csv(tmp_path / "noon.csv")
    (tmp_path / "README.txt").write_text("delivered on Monday\n")
    names = ("good.csv", "morning.csv", "noon.csv", "odd.csv", "README.txt")
    tables, output = brought_in(folder, *(tmp_path / name for name in names), code=3)
    assert list(tables["radars"]) == ["good"]
    assert tables["atmosphere"]["file"] == "telemetry/morning.csv"
    left_out = {code: line for line in output.splitlines() for code in printed_codes(line)}
    assert set(left_out) == {"file-unreadable", "column-missing", "given-twice"}
    for code, name in (
        ("file-unreadable", "README.txt"),
        ("column-missing", "odd.csv"),
        ("given-twice", "noon.csv"),
    ):
        assert name in left_out[code]


def test_check_names_a_table_that_no_section_reads(folder, tmp_path):
    test_what_is_not_used_is_named_and_the_exit_code_says_so(folder, tmp_path)
    result = CliRunner().invoke(cli, ["check", str(folder)])
    lines = [line for line in result.output.splitlines() if "[file-not-used]" in line]
    assert len(lines) == 2
    assert [name in line for name, line in zip(("noon.csv", "odd.csv"), lines, strict=True)] == [True, True]


@pytest.mark.parametrize("fate", ["import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "while True: pass"])
def test_a_file_that_kills_or_holds_its_library_is_refused(tmp_path, monkeypatch, fate):
    """A damaged MATLAB file crashed the process, a damaged HDF5 file kept it busy without end."""
    savemat(tmp_path / "track.mat", {"time": T, "range": RANGE_M})
    monkeypatch.setitem(stored_tables._READ_THROUGH, "MATLAB", fate)
    monkeypatch.setattr(stored_tables, "_READ_S", 0.5)
    with refuses("file-unreadable", names=["MATLAB", "checksum"]):
        stored_tables.read_tables(tmp_path / "track.mat")
