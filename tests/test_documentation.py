"""The pages of scenario, vehicle and flight files name every key that these files may hold, with their defaults."""

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest
from pydantic import BaseModel

from flightmodel import aeroinput, flightfile, instrument_entries, meshes, sources, vehicle
from postflight.cli import cli
from postflight.montecarlo import study
from synthetic_flight import day_air, dispersions, instrument_sections, outputs, scenarios
from tests.documents import PAGES, ROOT, blocks, commands

DOCS = Path(__file__).parents[1] / "docs"
INSTRUMENTS = [
    instrument_sections.Accelerometer,
    instrument_sections.Rates,
    instrument_sections.Magnetometer,
    instrument_sections.SunSensors,
    instrument_sections.Radar,
    instrument_sections.AirRefraction,
    instrument_sections.Dropouts,
    instrument_sections.Video,
    instrument_sections.Attitude,
]
MODELS = [
    scenarios.TimeSpan,
    scenarios.Initial,
    day_air.DayAtmosphere,
    day_air.Pocket,
    day_air.Shear,
    day_air.Turbulence,
    day_air.DiscreteGust,
    day_air.RangeSounding,
    vehicle.Reference,
    vehicle.CompliantJoint,
    vehicle.MassProperties,
    vehicle.ShellGeometry,
    vehicle.Uncertainty,
    vehicle.SensorMount,
    vehicle.CameraMount,
    meshes.MeshFiles,
    meshes.MeshFile,
    aeroinput.Aerodynamics,
    aeroinput.SphereCone,
    aeroinput.FreeMolecular,
    aeroinput.Sidecar,
    aeroinput.TableUncertainty,
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
    flightfile.FlightFile,
    flightfile.AttitudeEntry,
    flightfile.MotionEntry,
    instrument_entries.Mounted,
    instrument_entries.MagnetometerEntry,
    instrument_entries.GnssEntry,
    instrument_entries.BarometerEntry,
    sources.TimeEntry,
    sources.Source,
]


def missing_keys(page: str, model: type[BaseModel]) -> list[str]:
    quoted = (DOCS / page).read_text().replace(".", "`").replace("[", "`").replace("]", "`")
    return [key for key in model.model_fields if f"`{key}`" not in quoted]


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
    assert not [name for name in outputs.QUANTITIES if f"`{name}`" not in page]


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
            instrument_entries.GnssEntry,
            {"file", "height_is", "geoid_undulation_m", "min_satellites", "min_fix_mode"},
        ),
        ("barometers", instrument_entries.BarometerEntry, {"file", "height_is", "geoid_undulation_m", "use_s"}),
        ("motion", flightfile.MotionEntry, {"model", "drag_area_per_mass_m2pkg", "powered_s"}),
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


@pytest.mark.slow
@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("material", "mkdocstrings", "latex2mathml")),
    reason="the extra 'docs' is not installed",
)
def test_site_builds_without_a_warning_and_asks_for_nothing(tmp_path: Path):
    site = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(site)],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    pages = {page.relative_to(site).as_posix(): page.read_text() for page in site.rglob("*.html")}
    for name, text in pages.items():
        asked = re.findall(r"<(?:script|img|iframe|source)[^>]* src=\"?(?:https?:)?//", text)
        asked += re.findall(r"<link[^>]* href=\"?(?:https?:)?//[^>]*(?:stylesheet|preconnect|icon)", text)
        assert not asked, f"{name} loads something from elsewhere"
        assert not re.search(r'class="arithmatex"', text), f"{name} has a formula that is not drawn"
    assert "<math" in pages["derivations.html"]
    assert "estimate_misalignment" in pages["reference/estimators.html"]
