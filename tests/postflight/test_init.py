"""`postflight init` and `postflight schema`: forms with every key and its default, and what they leave to fill in."""

import json
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import jsonschema
import pytest
from click.testing import CliRunner

from flightmodel import aerodynamics, entry_state, flightfolder, geometry, instruments, vehicle
from flightmodel.tables import Source
from postflight.cli import cli
from postflight.flight import PULSE_RATE_HZ
from postflight.intake.flight_form import KINDS, model, schema, template, template_keys
from recon.settings import Settings

ROOT = Path(__file__).parents[2]
TABLES = {
    "flight": {
        "": flightfolder.FlightFile,
        "attitude_prior": flightfolder.AttitudeEntry,
        "start": flightfolder.StartEntry,
        "start.state": entry_state.StateEntry,
        "drag": entry_state.DragEntry,
        "motion": flightfolder.MotionEntry,
        "motion.disturbed": flightfolder.UnmodelledEntry,
        "sensors.accelerometer": instruments.TriadEntry,
        "sensors.rates": instruments.RatesEntry,
        "sensors.magnetometer": instruments.MagnetometerEntry,
        "sensors.sun": instruments.SunEntry,
        "radars.NAME": instruments.RadarEntry,
        "sites": instruments.SitesEntry,
        "places": flightfolder.PlaceEntry,
        "gnss.NAME": instruments.GnssEntry,
        "barometers.NAME": instruments.BarometerEntry,
        "atmosphere": instruments.AtmosphereEntry,
        "loads": instruments.LoadsEntry,
        "frames": instruments.FramesEntry,
        "events": flightfolder.EventEntry,
    },
    "vehicle": {
        "": vehicle.VehicleFile,
        "reference": vehicle.Reference,
        "joint": vehicle.CompliantJoint,
        "aeroshell": vehicle.MassProperties,
        "centerbody": vehicle.MassProperties,
        "mass": vehicle.MassStep,
        "mass.aeroshell": vehicle.MassProperties,
        "mass.centerbody": vehicle.MassProperties,
        "uncertainty": vehicle.Uncertainty,
        "aerodynamics": aerodynamics.Aerodynamics,
        "aerodynamics.sphere_cone": aerodynamics.SphereCone,
        "aerodynamics.free_molecular": aerodynamics.FreeMolecular,
        "aerodynamic_terms": vehicle.AeroTerms,
        "geometry": vehicle.ShellGeometry,
        "meshes": geometry.MeshFiles,
        "meshes.aeroshell": geometry.MeshFile,
        "meshes.centerbody": geometry.MeshFile,
        "sensors.suba": vehicle.SensorMount,
        "cameras.camera5": vehicle.CameraMount,
        "cameras.camera5.uncertainty": vehicle.CameraUncertainty,
    },
}
EVERY_TABLE = {"time", "columns", "use_s"}  # said once, above the sensors
CASES = [(kind, table) for kind, tables in TABLES.items() for table in tables]


def test_template_speaks_of_several_cameras():
    assert "[cameras.NAME]" in template("flight")


def run(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments])


@pytest.mark.parametrize(("kind", "table"), CASES)
def test_template_names_every_key_with_its_default(kind, table):
    model = TABLES[kind][table]
    lines = {key: (value, comment) for where, key, value, comment in template_keys(kind) if where == table}
    below = {
        t.split(".")[len(table.split(".")) if table else 0] for t in TABLES[kind] if t != table and t.startswith(table)
    }
    shared = EVERY_TABLE | {"position_from_datum_body_m", "axes"} if issubclass(model, Source) else set()
    # settings are tested below: no model of pydantic; cameras have the keys of [frames]
    settings = {"reconstruction", "cameras"} if not table else set()
    missing = set(model.model_fields) - set(lines) - below - shared - settings
    assert not missing
    assert set(lines) <= set(model.model_fields)
    for key, (value, comment) in lines.items():
        field = model.model_fields[key]
        if comment.endswith("e.g.") or value == '"FILL IN"' or key == "cmq" or field.default is None:
            continue
        stated = tomllib.loads(f"v = {value}")["v"]
        default = field.default
        if isinstance(stated, list):
            assert tuple(stated) == tuple(default), key
        elif key == "sd_deg":
            assert default == (stated,) * 3
        else:
            assert stated == default, key


def test_template_names_every_setting_of_the_reconstruction_with_its_default():
    lines = {
        key: (value, comment) for where, key, value, comment in template_keys("flight") if where == "reconstruction"
    }
    assert set(lines) == {setting.name for setting in fields(Settings)}
    stated = {key: tomllib.loads(f"v = {value}")["v"] for key, (value, _) in lines.items()}
    Settings.from_mapping(stated)  # examples are allowed values
    usual = Settings(pulse_rate_hz=PULSE_RATE_HZ)  # as a flight has them without the section
    assert not [
        k for k, (_, comment) in lines.items() if not comment.endswith("e.g.") and stated[k] != getattr(usual, k)
    ]


def test_new_folder_says_what_is_still_to_fill_in(tmp_path):
    made = run("init", tmp_path / "flight", "--vehicle", "form")
    assert made.exit_code == 0, made.output
    found = json.loads(run("check", tmp_path / "flight", "--json").stdout)
    assert found["exit_code"] == 2
    left = template("vehicle").count('"FILL IN"')
    assert [w.split("'")[1] for w in found["fill_in"] if "flight.toml" in w] == ["name", "t0_utc"]
    assert len(found["fill_in"]) == 2 + left
    assert not found["refused"]
    text = (tmp_path / "flight" / "flight.toml").read_text()
    text = text.replace('name = "FILL IN" ', 'name = "x" ').replace(
        't0_utc = "FILL IN" ', 't0_utc = "2020-01-01T00:00:00Z" '
    )
    (tmp_path / "flight" / "flight.toml").write_text(text)
    found = json.loads(run("check", tmp_path / "flight", "--json").stdout)
    assert len(found["fill_in"]) == left
    assert sum("[radars.NAME]" in words for words in found["refused"]) == 1


def test_a_folder_for_the_trajectory_alone_has_no_vehicle(tmp_path):
    made = run("init", tmp_path / "flight")
    assert made.exit_code == 0, made.output
    assert not (tmp_path / "flight" / "vehicle").exists()
    found = json.loads(run("check", tmp_path / "flight", "--json").stdout)
    assert [w.split("'")[1] for w in found["fill_in"]] == ["name", "t0_utc"]


def test_filled_in_vehicle_form_is_a_vehicle(tmp_path):
    run("init", tmp_path / "flight", "--vehicle", "form")
    path = tmp_path / "flight" / "vehicle" / "vehicle.toml"
    given = tomllib.loads((ROOT / "examples" / "own_vehicle" / "vehicle.toml").read_text())
    table, out = given, []
    for line in path.read_text().splitlines():
        if header := re.match(r"\[([\w.]+)\]", line):
            table = given
            for part in header[1].split("."):
                table = table[part]
        if key := re.match(r'(\w+) = "FILL IN"', line):
            line = line.replace('"FILL IN"', json.dumps(table[key[1]]))
        out.append(line)
    path.write_text("\n".join(out))
    own = vehicle.vehicle_from_toml(path)
    assert own.mass_kg == 55.0


def test_shipped_vehicle_is_named_and_own_one_is_copied(tmp_path):
    assert run("init", tmp_path / "a", "--vehicle", "irve2_reference").exit_code == 0
    assert tomllib.loads((tmp_path / "a" / "flight.toml").read_text())["vehicle"] == "irve2_reference"
    assert run("init", tmp_path / "b", "--vehicle", ROOT / "examples" / "own_vehicle" / "vehicle.toml").exit_code == 0
    assert vehicle.vehicle_from_toml(tmp_path / "b" / "vehicle" / "vehicle.toml").name == "own_vehicle"


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "flight.toml").write_text("mine")
    made = run("init", tmp_path)
    assert made.exception.codes == ("file-exists",)
    assert (tmp_path / "flight.toml").read_text() == "mine"
    assert {p.name for p in tmp_path.iterdir()} == {"flight.toml"}


def test_unknown_vehicle_is_refused_with_the_nearest(tmp_path):
    made = run("init", tmp_path / "x", "--vehicle", "irve2_referenc")
    assert made.exception.codes == ("name-unknown",)
    assert "'irve2_reference'" in str(made.exception)
    assert not (tmp_path / "x").exists()


def test_init_import_and_check_load_no_simulator_filter_or_estimator():
    # they would take seconds to import on a machine at work
    heavy = {"synthetic_flight", "recon", "estimators", "matplotlib", "trimesh"}
    code = "import sys, postflight.intake.deliveries, postflight.checks.folder_check; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert "flightmodel" in loaded, done.stderr
    assert not loaded & heavy


# schemas


def plain(value):
    """TOML as JSON has it."""
    return json.loads(json.dumps(value, default=str))


FILES = {
    "flight": [*ROOT.glob("examples/*/flight.toml"), *ROOT.glob("tests/data/real_flights/*/flight.toml")],
    "vehicle": [*ROOT.glob("flightmodel/data/vehicles/*.toml"), ROOT / "examples/own_vehicle/vehicle.toml"],
    "scenario": [*ROOT.glob("flightmodel/data/scenarios/*.toml"), ROOT / "examples/own_vehicle/scenario.toml"],
    "coefficients": [*ROOT.glob("flightmodel/data/aerodynamics/*.toml")],
}


@pytest.mark.parametrize(
    ("kind", "path"), [(k, p) for k, paths in FILES.items() for p in paths], ids=lambda v: str(v)[-40:]
)
def test_schema_takes_every_shipped_file(kind, path):
    made = json.loads(run("schema", kind).stdout)
    jsonschema.Draft202012Validator.check_schema(made)
    jsonschema.validate(plain(tomllib.loads(path.read_text())), made)


@pytest.mark.parametrize(
    ("kind", "path", "change"),
    [
        ("flight", FILES["flight"][0], lambda t: t | {"vehicel": "x"}),
        ("flight", FILES["flight"][0], lambda t: t | {"name": 3}),
        ("flight", FILES["flight"][0], lambda t: t | {"motion": {"model": "flying"}}),
        ("vehicle", FILES["vehicle"][0], lambda t: t | {"joint": t["joint"] | {"station_m": "FILL IN"}}),
        ("vehicle", FILES["vehicle"][0], lambda t: {k: v for k, v in t.items() if k != "joint"}),
        ("scenario", FILES["scenario"][0], lambda t: t | {"time": t["time"] | {"step_s": -1.0}}),
    ],
)
def test_schema_refuses_what_the_reader_refuses(kind, path, change):
    tables = plain(tomllib.loads(path.read_text()))
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(change(tables), schema(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_schema_has_every_key(kind):
    assert set(schema(kind)["properties"]) == set(model(kind).model_fields)


def test_keys_of_flight_and_vehicle_are_described():
    for kind, table, model_name, key in (
        ("flight", "radars.NAME", "RadarEntry", "latitude_deg"),
        ("vehicle", "joint", "CompliantJoint", "station_m"),
    ):
        comments = {(where, name): comment for where, name, _, comment in template_keys(kind)}
        comment = comments[table, key].removesuffix(", e.g.").removesuffix("e.g.")
        assert len(comment) > 5
        assert schema(kind)["$defs"][model_name]["properties"][key]["description"] == comment


def test_quotes_in_a_file_name_stay_text(tmp_path):
    own = tmp_path / "a\"b'.toml"
    own.write_text((ROOT / "examples" / "own_vehicle" / "vehicle.toml").read_text())
    assert run("init", tmp_path / "flight", "--vehicle", own).exit_code == 0
    assert tomllib.loads((tmp_path / "flight" / "flight.toml").read_text())["vehicle"] == f"vehicle/{own.name}"
