"""The pages of scenario, vehicle and flight files name every key that these files may hold, with their defaults."""

import re
import tomllib
from pathlib import Path

import click
import pytest
from pydantic import BaseModel

from flightmodel import aerodynamics, flightfolder, geometry, instruments, tables, vehicle
from postflight.cli import cli
from postflight.montecarlo import study
from synthetic_flight import dispersions, ensemble, instrument_errors, scenarios, weather
from tests.documents import PAGES, ROOT, blocks, commands

DOCS = Path(__file__).parents[1] / "docs"
INSTRUMENTS = [
    instrument_errors.Accelerometer,
    instrument_errors.Rates,
    instrument_errors.Magnetometer,
    instrument_errors.SunSensors,
    instrument_errors.Radar,
    instrument_errors.AirRefraction,
    instrument_errors.Dropouts,
    instrument_errors.Video,
    instrument_errors.Attitude,
]
MODELS = [
    scenarios.TimeSpan,
    scenarios.Initial,
    weather.DayOfFlightAtmosphere,
    weather.Pocket,
    weather.Shear,
    weather.Turbulence,
    weather.DiscreteGust,
    weather.RangeSounding,
    vehicle.Reference,
    vehicle.CompliantJoint,
    vehicle.MassProperties,
    geometry.ShellGeometry,
    vehicle.Uncertainty,
    vehicle.SensorMount,
    vehicle.CameraMount,
    geometry.MeshFiles,
    geometry.MeshFile,
    aerodynamics.Aerodynamics,
    aerodynamics.SphereCone,
    aerodynamics.FreeMolecular,
    aerodynamics.Sidecar,
    aerodynamics.TableUncertainty,
]


DISPERSION_SECTIONS = [
    study.DispersionsFile,
    study.Outputs,
    study.Stop,
    dispersions.Window,
    dispersions.Factor,
    dispersions.InitialDispersions,
    dispersions.MassDispersions,
    dispersions.AeroDispersions,
    dispersions.JointDispersions,
    dispersions.AirDispersions,
]


FLIGHT_SECTIONS = [
    flightfolder.FlightFile,
    flightfolder.AttitudeEntry,
    flightfolder.MotionEntry,
    instruments.Mounted,
    instruments.MagnetometerEntry,
    instruments.GnssEntry,
    instruments.BarometerEntry,
    tables.TimeEntry,
    tables.Source,
]


def missing_keys(page: str, model: type[BaseModel]) -> list[str]:
    quoted = (DOCS / page).read_text().replace(".", "`").replace("[", "`").replace("]", "`")
    keys = [field.alias or name for name, field in model.model_fields.items()]
    return [key for key in keys if f"`{key}`" not in quoted]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.__name__)
def test_every_key_is_on_the_page(model: type[BaseModel]):
    assert not missing_keys("scenario-and-vehicle-files.md", model)


@pytest.mark.parametrize("model", INSTRUMENTS, ids=lambda m: m.__name__)
def test_every_key_of_an_instrument_is_on_its_page(model: type[BaseModel]):
    assert not missing_keys("instruments.md", model)


@pytest.mark.parametrize("model", DISPERSION_SECTIONS, ids=lambda m: m.__name__)
def test_every_key_of_a_dispersions_file_is_on_its_page(model: type[BaseModel]):
    page = (DOCS / "monte-carlo.md").read_text()
    assert not [key for key in model.model_fields if not re.search(rf"\b{key}\b", page)]


def test_every_output_is_on_the_page():
    page = (DOCS / "monte-carlo.md").read_text()
    assert not [name for name in ensemble.QUANTITIES if f"`{name}`" not in page]


@pytest.mark.parametrize("name", study.shipped_dispersions())
def test_shipped_dispersions_are_read(name: str):
    assert len(study.read_study(name).spec.factors()) > 20


@pytest.mark.parametrize("model", FLIGHT_SECTIONS, ids=lambda m: m.__name__)
def test_every_key_of_flight_toml_is_on_its_page(model: type[BaseModel]):
    page = (DOCS / "flight-folder.md").read_text()
    assert not [key for key in model.model_fields if not re.search(rf"\b{key}\b", page)]


@pytest.mark.parametrize(
    ("table", "model", "examples"),
    [
        (
            "gnss",
            instruments.GnssEntry,
            {"file", "height_is", "geoid_undulation_m", "min_satellites", "min_fix_mode"},
        ),
        ("barometers", instruments.BarometerEntry, {"file", "height_is", "geoid_undulation_m", "use_s"}),
        ("motion", flightfolder.MotionEntry, {"model", "drag_area_per_mass_m2pkg", "powered_s"}),
    ],
)
def test_values_on_the_page_are_the_defaults(table: str, model: type[BaseModel], examples: set[str]):
    blocks = re.findall(r"```toml\n(.*?)```", (DOCS / "flight-folder.md").read_text(), re.DOTALL)
    block = next(b for b in blocks if b.startswith(f"[{table}"))
    written = tomllib.loads(block)[table]
    section = model.model_validate(written if table == "motion" else next(iter(written.values())))
    for key in section.model_fields_set - examples:
        assert getattr(section, key) == model.model_fields[key].default, key


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_on_the_page_are_understood(page: Path, monkeypatch: pytest.MonkeyPatch):
    """Parsed, in a moment; tests/whole/test_pages.py runs them."""
    monkeypatch.chdir(ROOT)
    for words in commands(page):
        given = [w for w in words if w != "corners.csv"]
        given += ["tests/data/fisheye/corners_even.csv"] * (len(words) - len(given))
        command = cli.get_command(click.Context(cli), given[0])
        assert command is not None, f"{page.name}: postflight {' '.join(words)}"
        command.make_context(given[0], given[1:])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_python_on_the_page_compiles(page: Path):
    for text in blocks(page, "python"):
        compile(text, page.name, "exec")
