"""`postflight export`: each file opened again by another program's reader, with the numbers of the run."""

import builtins
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from flightmodel.checks import ConfigError, GateError
from flightmodel.earth import undulation_m
from postflight import exports, run_folder
from postflight.cli import cli
from postflight.deflections import Deflections
from postflight.exports import read_source
from postflight.flight import read_flight
from postflight.reconstruction import reconstruct
from tests.refusing import refuses

FLIGHT = Path(__file__).parents[1] / "data" / "real_flights" / "rocketpy_prometheus"
KML = "{http://www.opengis.net/kml/2.2}"
GX = "{http://www.google.com/kml/ext/2.2}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recorded rocket's run, with deflections beside it as a run of an entry vehicle has them."""
    folder = tmp_path_factory.mktemp("exports") / "flight"
    shutil.copytree(FLIGHT, folder)
    flight = reconstruct(read_flight(folder))
    with run_folder.RunFolder(folder, flight.telemetry, {}) as out:
        event_rows = run_folder.write_reconstruction(out, flight)
        out.write_json("summary.json", run_folder.summary(flight, Deflections(), event_rows))
    (run,) = (folder / "runs").iterdir()
    t = np.arange(20.0, 26.0, 0.11)
    t = t[(t < 22.0) | (t > 24.0)]
    for method, size in (("camera", 3.0), ("fused", 4.0)):
        pd.DataFrame(
            {"t_s": t, "theta_deg": size + 0.01 * t, "theta_sd_deg": 0.2,
             "plane_lv_deg": (355.0 + 2.0 * (t - 20.0)) % 360.0, "plane_sd_deg": 5.0}
        ).to_csv(run / f"deflection_{method}.csv", index=False)  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def run_table(folder):
    (run,) = (folder / "runs").iterdir()
    return pd.read_csv(run / "bet.csv")


@pytest.fixture
def written(folder, tmp_path):
    def one(form):
        result = CliRunner().invoke(cli, ["export", str(folder), "--to", form, "--out", str(tmp_path / f"x.{form}")])
        assert result.exit_code == 0, result.output
        return tmp_path / f"x.{form}"

    return one


def check_merged(table, run_table):
    np.testing.assert_allclose(table["alt_m"], run_table["alt_m"], rtol=1e-9)
    at = (table.t_s > 20.5) & (table.t_s < 21.5)
    np.testing.assert_allclose(table.theta_fused_deg[at], 4.0 + 0.01 * table.t_s[at], atol=0.001)
    # the clock angle passes 360 without a detour
    off = (table.plane_lv_camera_deg[at] - (355.0 + 2.0 * (table.t_s[at] - 20.0)) + 180) % 360 - 180
    assert np.abs(off).max() < 0.01
    gap = (table.t_s > 22.1) & (table.t_s < 23.9)
    assert table.theta_fused_deg[gap].isna().all()
    assert table.theta_fused_deg[table.t_s > 26.0].isna().all()


def test_csv_by_pandas(written, run_table):
    table = pd.read_csv(written("csv"), parse_dates=["utc"])
    check_merged(table, run_table)
    assert (table.utc.iloc[-1] - table.utc.iloc[0]).total_seconds() == pytest.approx(np.ptp(run_table.t_s), abs=1e-5)


def test_parquet_by_pyarrow_and_pandas(written, run_table):
    pq = pytest.importorskip("pyarrow.parquet")
    path = written("parquet")
    check_merged(pd.read_parquet(path), run_table)
    schema = pq.read_schema(path)
    assert schema.field("vx_ecef_mps").metadata[b"unit"] == b"m s-1"
    assert str(schema.field("utc").type) == "timestamp[us, tz=UTC]"
    assert b"Prometheus" in schema.metadata[b"title"]


def test_mat_by_scipy(written, run_table):
    from scipy.io import loadmat

    content = loadmat(written("mat"), simplify_cells=True)
    np.testing.assert_array_equal(content["trajectory"]["alt_m"], run_table["alt_m"])
    assert set(content["deflection"]) == {"camera", "fused"}
    assert content["deflection"]["fused"]["theta_deg"][0] == pytest.approx(4.2)
    assert content["covariance"]["position_velocity_rotation"].shape[1:] == (9, 9)
    assert content["about"]["epoch_utc"].endswith("Z")


@pytest.mark.parametrize("engine", ["netcdf4", "scipy"])
def test_netcdf_by_xarray(written, run_table, engine):
    xr = pytest.importorskip("xarray")
    if engine == "netcdf4":
        pytest.importorskip("netCDF4")
    with xr.open_dataset(written("nc"), engine=engine) as data:
        assert data.attrs["Conventions"] == "CF-1.8"
        assert data.attrs["featureType"] == "trajectory"
        np.testing.assert_array_equal(data["alt_m"], run_table["alt_m"])
        assert data["lat_deg"].attrs["standard_name"] == "latitude"
        assert data["lat_deg"].attrs["units"] == "degrees_north"
        assert {"lat_deg", "lon_deg", "alt_m"} <= set(data["mach"].coords)
        span = (data.time[-1] - data.time[0]).values / np.timedelta64(1, "us") * 1e-6
        assert span == pytest.approx(np.ptp(run_table.t_s), abs=1e-5)
        assert data["theta_deg_fused"].dims == ("time_fused",)
        name = data["trajectory_id"].values
        assert b"".join(np.atleast_1d(name)).decode().startswith("Project Prometheus") or "Prometheus" in str(name)
        assert all("units" in data[v].attrs for v in data.data_vars if v != "trajectory_id")


def test_kml_by_an_xml_parser(written, folder, run_table):
    etree = pytest.importorskip("lxml.etree")
    root = etree.parse(written("kml")).getroot()
    assert root.tag == f"{KML}kml"
    track = root.find(f".//{GX}Track")
    whens = [e.text for e in track.findall(f"{KML}when")]
    coords = np.array([[float(v) for v in e.text.split()] for e in track.findall(f"{GX}coord")])
    assert len(whens) == len(coords) > 100
    assert track.find(f"{KML}altitudeMode").text == "absolute"
    assert (np.diff(pd.to_datetime(whens).astype("int64")) > 0).all()
    source = read_source(folder)
    t = (pd.to_datetime(whens, utc=True) - source.epoch).total_seconds()
    above = np.interp(t, run_table.t_s, run_table.alt_m) - coords[:, 2]  # the ellipsoid
    np.testing.assert_allclose(above, undulation_m(*np.deg2rad(coords[:, 1::-1].T)), atol=0.01)
    assert abs(above).min() > 1.0
    np.testing.assert_allclose(coords[:, 0], np.interp(t, run_table.t_s, run_table.lon_deg), atol=1e-7)
    line = root.find(f".//{KML}LineString/{KML}coordinates").text.split()
    assert len(line) == len(coords)
    assert len(root.findall(f".//{KML}Point")) == len(source.events)


def test_names_stay_text_in_kml(folder, tmp_path):
    etree = pytest.importorskip("lxml.etree")
    from dataclasses import replace

    source = replace(read_source(folder), name="<script>alert(1)</script> & \x00")
    root = etree.fromstring(exports.FORMS["kml"](source))
    assert not root.findall(".//script")
    assert root.find(f".//{KML}name").text.startswith("‹script›")


def test_oem_by_another_reader(written, run_table):
    oem = pytest.importorskip("oem")
    message = oem.OrbitEphemerisMessage.open(written("oem"))
    (segment,) = message.segments
    assert segment.metadata["REF_FRAME"] == "ITRF2000"
    states = list(segment.states)
    assert len(states) == len(run_table)
    place = np.array([s.position for s in states])
    np.testing.assert_allclose(place, run_table[["rx_ecef_m", "ry_ecef_m", "rz_ecef_m"]] / 1000.0, rtol=0.0, atol=1e-9)
    speed = np.array([s.velocity for s in states])
    np.testing.assert_allclose(
        speed, run_table[["vx_ecef_mps", "vy_ecef_mps", "vz_ecef_mps"]] / 1000.0, rtol=0.0, atol=1e-9
    )
    first = next(iter(segment.covariances)).matrix
    sd = np.sqrt(np.diag(first)) * 1000.0
    wanted = run_table[["rx_ecef_sd_m", "ry_ecef_sd_m", "rz_ecef_sd_m"]].iloc[0]
    np.testing.assert_allclose(sd[:3], wanted, rtol=1e-6)
    assert (np.linalg.eigvalsh(first) > 0.0).all()


def test_attitude_that_is_not_known_is_refused(folder):
    """The recorded rocket has no gyros."""
    for form in ("aem", "msopck"):
        with refuses("attitude-missing"):
            exports.FORMS[form](read_source(folder))


@pytest.mark.parametrize("form", ["csv", "parquet", "mat", "nc", "kml", "oem"])
def test_the_same_run_gives_the_same_bytes(form, folder):
    source = read_source(folder)
    write = exports.FORMS[form]
    assert write(source) == write(read_source(folder))


def test_missing_extra_is_said_with_the_command(folder, monkeypatch):
    imported = builtins.__import__

    def without(name, own=None, *rest):
        if name.startswith("pyarrow") and (own or {}).get("__name__", "").startswith("postflight"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        return imported(name, own, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError) as fault:
        exports.export(folder, "parquet", None)
    assert fault.value.codes == ("package-missing",)
    assert "postflight[parquet]" in str(fault.value)
    assert fault.value.exit_code == 2
    assert not (folder / "exports").exists()


def test_flight_without_a_run_is_refused(tmp_path):
    with pytest.raises(GateError) as fault:
        exports.export(tmp_path, "csv", None)
    assert fault.value.codes == ("run-missing",)


def test_run_folders_stay_as_they_are(folder):
    with pytest.raises(ConfigError) as fault:
        exports.export(folder, "csv", folder / "runs" / "x.csv")
    assert fault.value.codes == ("file-exists",)


def test_summary_says_on_what_the_position_rests(folder):
    (run,) = (folder / "runs").iterdir()
    (line,) = json.loads((run / "summary.json").read_text())["rests_on"]
    assert "receiver" in line
