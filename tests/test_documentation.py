"""Pages name every key of scenarios, sidecars, dispersions; forms the others (tests/postflight/test_init.py)."""

import ast
import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import click
import pytest
from pydantic import BaseModel

import postflight
from flightmodel import aerodynamics, tables
from postflight import plots
from postflight.cli import cli
from postflight.deflections import headline, said
from postflight.intake.flight_form import template_keys
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
    aerodynamics.Sidecar,
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


def missing_keys(page: str, model: type[BaseModel]) -> list[str]:
    quoted = (DOCS / page).read_text().replace(".", "`").replace("[", "`").replace("]", "`")
    keys = [field.alias or name for name, field in model.model_fields.items()]
    return [key for key in keys if f"`{key}`" not in quoted]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.__name__)
def test_every_key_is_on_the_page(model: type[BaseModel]):
    assert not missing_keys("scenario-and-vehicle-files.md", model)


@pytest.mark.parametrize("model", INSTRUMENTS, ids=lambda m: m.__name__)
def test_every_key_of_an_instrument_is_on_its_page_or_the_flight_form_s(model: type[BaseModel]):
    page = {key.replace("_U", f"_{unit}") for unit in ("mps2", "degps", "ut") for key in named_keys("instruments.md")}
    flight = {key for _, key, _, _ in template_keys("flight")}
    flight |= {key.replace("_sd", "") for key in flight}
    keys = {field.alias or name for name, field in model.model_fields.items()}
    assert not keys - page - flight


def named_keys(page: str) -> set[str]:
    return set(re.findall(r"\b\w+\b", (DOCS / page).read_text()))


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


@pytest.mark.parametrize("model", [tables.TimeEntry, tables.Source], ids=lambda m: m.__name__)
def test_keys_of_every_table_are_on_the_page(model: type[BaseModel]):
    page = (DOCS / "flight-folder.md").read_text()
    assert not [key for key in model.model_fields if not re.search(rf"\b{key}\b", page)]


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


def test_the_gallery_has_every_figure_and_no_other_picture():
    """tests/whole/test_examples.py executes its calls, tools/gallery.py draws its pictures."""
    page = (DOCS / "figures.md").read_text()
    assert [name for name in plots.__all__ if name.startswith("figure_") and name not in page] == []
    shown = set(re.findall(r"\]\(images/gallery/(\S+)\)", page))
    assert shown == {path.name for path in (DOCS / "images" / "gallery").iterdir()}


def test_the_page_of_the_interface_has_every_public_name_once():
    """docs/site_hooks.py puts the docstrings of these names in place of the lines."""
    lines = re.findall(r"^Names: (.*)\.$", (DOCS / "interface.md").read_text(), re.MULTILINE)
    assert sorted(name for line in lines for name in re.findall(r"`(\w+)`", line)) == sorted(postflight.__all__)


def message_codes() -> ModuleType:
    spec = importlib.util.spec_from_file_location("message_codes", DOCS / "message_codes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_page_of_codes_has_every_code_that_a_call_states():
    listed = message_codes().message_codes()
    stated = set()
    for path in (path for package in message_codes().PACKAGES for path in (ROOT / package).rglob("*.py")):
        words = [word for node in ast.walk(ast.parse(path.read_text())) for word in getattr(node, "keywords", [])]
        stated |= {w.value.value for w in words if w.arg == "code" and isinstance(w.value, ast.Constant)}
    assert len(stated) > 60
    assert not stated - set(listed)


def test_every_code_has_a_remedy_from_one_place():
    """From the program's own words, or else from the list: which can hold no code whose message has come to say it."""
    module = message_codes()
    codes, program, listed = set(module.message_codes()), set(module.said_by_the_program()), module.unsaid()
    assert set(listed) == codes - program
    assert all(text.endswith(".") for text in listed.values())
    assert len(program) > 100
    assert module.remedies()["time-backwards"] == "sort the rows or remove the duplicates"


A_CODE_OF_WORDS = re.compile(r'"([a-z][a-z0-9]*(?:-[a-z0-9]+)+)"')


def test_page_of_codes_has_every_text_that_looks_like_one():
    """A code that comes by way of a variable, too: what has a hyphen is listed, or named as none."""
    module = message_codes()
    sources = [path.read_text() for package in module.PACKAGES for path in (ROOT / package).rglob("*.py")]
    written = {word for source in sources for word in A_CODE_OF_WORDS.findall(source)}
    assert len(written) > 200
    in_examples = {"my-flight"}
    assert written - set(module.message_codes()) == module.NO_CODES | in_examples


def test_page_of_codes_has_every_code_that_tests_expect():
    listed, expected = message_codes().message_codes(), set()
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "refuses":
                expected |= {arg.value for arg in node.args if isinstance(arg, ast.Constant)}
            elif isinstance(node, ast.keyword) and node.arg == "codes" and isinstance(node.value, ast.Set):
                expected |= {each.value for each in node.value.elts if isinstance(each, ast.Constant)}
    assert len(expected) > 40
    assert not expected - set(listed)


@pytest.mark.parametrize(
    ("code", "words"),
    [("time-far", "or choose a span with use_s"), ("toml-syntax", "not valid TOML"), ("rest-found", "at_rest")],
)
def test_page_of_codes_says_what_the_message_says(code: str, words: str):
    assert words in message_codes().message_codes()[code]


def demo_answers() -> dict[str, dict[str, float]]:
    """Answers of the demo's flight by method, as the golden numbers keep them (`benchmarks/golden.py`)."""
    stored = json.loads((ROOT / "benchmarks" / "golden" / "irve2_reference.json").read_text())
    answers: dict[str, dict[str, float]] = {}
    for column, (value,) in stored["run/summary"]["columns"].items():
        first, _, rest = column.partition(".")
        method, _, name = rest.partition(".")
        if first == "methods":
            answers.setdefault(method, {})[name] = value
    return answers


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial-demo.md"])
def test_the_demo_s_numbers_are_those_of_its_run(page: str) -> None:
    """What documents show of the demo are the golden numbers of the same flight."""
    text, answers = (ROOT / page).read_text(), demo_answers()
    assert list(answers) == ["camera", "misalignment", "trim", "fused"]
    for method, answer in answers.items():
        cells = [cell.strip() for cell in re.search(rf"[│|] {method} +[│|](.*)", text)[1].replace("│", "|").split("|")]
        assert " ± ".join(cells[:2]) == said(answer)["at peak q"]
    if page == "README.md":
        assert headline(answers["fused"]) in text
