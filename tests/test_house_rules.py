"""The plan of the code, kept true by force: doors, file lengths, docstrings, no prints, no paths of a machine."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
SOURCES = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
CODE = [p for p in SOURCES if "data" not in p.relative_to(ROOT).parts]
# a library, and the only files that may import it
DOORS = {
    "filterpy": {"recon/ekf.py"},
    "ppigrf": {"flightmodel/geomagnetism_and_sun.py"},
    "erfa": {"flightmodel/geomagnetism_and_sun.py"},
    "numba": "_kernels.py",
    "matplotlib": "figures.py",
}
UNITS = ("deg", "km", "ft", "degps")


def name(path):
    return str(path.relative_to(ROOT))


def imports(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


@pytest.mark.parametrize("path", CODE, ids=name)
def test_file_is_short_and_keeps_to_the_doors(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 400, "files stay below 400 lines"
    for module in imports(ast.parse(text)):
        door = DOORS.get(module.split(".")[0])
        if isinstance(door, set):
            assert name(path) in door, f"{module} has one door"
        elif door:
            assert path.name == door, f"{module} is imported in files named {door} alone"


@pytest.mark.parametrize("path", CODE, ids=name)
def test_functions_fit_a_screen(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            doc = ast.get_docstring(node, clean=False) or ""
            length = node.end_lineno - node.lineno + 1 - len(doc.splitlines())
            assert length <= 75, f"{node.name} has {length} lines"


@pytest.mark.parametrize("path", CODE, ids=name)
def test_modules_open_with_their_question(path):
    doc = ast.get_docstring(ast.parse(path.read_text()))
    assert doc
    assert len(doc) > 40


@pytest.mark.parametrize("path", CODE, ids=name)
def test_degrees_stay_in_files_command_and_figures(path):
    allowed = (
        "config",
        "columns",
        "flightf",
        "vehicle",
        "scenarios",
        "instrument_sections",
        "sensing",
        "folder",
        "cli",
        "commands",
        "results",
    )
    if any(word in path.stem for word in (*allowed, "scoring", "figures", "preflight", "drawing", "atmosphere")):
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.arg):
            assert node.arg.rsplit("_", 1)[-1] not in UNITS or node.arg in UNITS, (
                f"{node.arg}: SI and radians in memory"
            )


def test_no_utils():
    assert not [p for p in SOURCES if p.stem in ("utils", "helpers", "misc", "common")]


def test_nothing_in_the_tree_knows_this_machine():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split(
        "\n"
    )
    if not listed[0]:
        pytest.skip("not a git checkout")
    absolute = re.compile(r"(?<![\w.:/])/(home|root|work|Users)/\w")
    for entry in listed:
        path = ROOT / entry
        if path.suffix in (".py", ".md", ".toml", ".cff", ".yml") and path.is_file():
            assert not absolute.search(path.read_text()), f"{entry} holds a path of one machine"
