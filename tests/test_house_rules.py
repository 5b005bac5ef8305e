"""The plan of the code, kept true by force: doors, file lengths, docstrings, no prints, no paths of a machine."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
SOURCES = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
CODE = [p for p in SOURCES if "data" not in p.relative_to(ROOT).parts]
# a library, and the only files that may import it
DOORS = {
    "filterpy": {"recon/kalman.py"},
    "ppigrf": {"flightmodel/geomagnetism_and_sun.py"},
    "erfa": {"flightmodel/earth.py", "flightmodel/geomagnetism_and_sun.py"},
    "numba": {"flightmodel/_kernels.py"},  # elsewhere by its decorators
    "matplotlib": "postflight/plots/",
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
    assert len(text.splitlines()) <= 1200, "files stay below 1,200 lines"
    for module in imports(ast.parse(text)):
        door = DOORS.get(module.split(".")[0])
        if isinstance(door, set):
            assert name(path) in door, f"{module} has one door"
        elif door:
            assert name(path).startswith(door), f"{module} is imported in {door} alone"


# a value of a colour: by digits, by matplotlib's cycle or grey level, or by name
A_COLOUR = re.compile(r"#[0-9a-fA-F]{3,8}|C\d|0\.\d+|black|white|gr[ae]y|red|green|blue|yellow|orange")
DRAWN = [p for p in (ROOT / "postflight").rglob("*") if p.suffix in (".css", ".html", ".js") and ".min." not in p.name]


@pytest.mark.parametrize("path", [p for p in CODE if name(p).startswith("postflight/")], ids=name)
def test_colours_are_asked_for_by_meaning(path):
    if name(path) == "postflight/plots/style.py":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            literal = A_COLOUR.fullmatch(node.value) if "plots/" in name(path) else None
            literal = literal or re.fullmatch("#[0-9a-fA-F]{6}", node.value)
            assert not literal, f"{node.value}: colours stand in postflight/plots/style.py"


@pytest.mark.parametrize("path", DRAWN, ids=name)
def test_page_takes_its_colours_from_the_figures_table(path):
    assert not re.findall(r"#[0-9a-fA-F]{6}\b|#[0-9a-fA-F]{3}\b(?=[;\" ])|rgba?\(\d+, ?\d+", path.read_text())


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


# where degrees and kilometres are read, written or shown
DEGREES = (
    "flightmodel/config.py", "flightmodel/tables.py", "flightmodel/flightf", "flightmodel/vehicle.py",
    "flightmodel/instruments.py", "flightmodel/atmosphere.py", "synthetic_flight/scenarios.py",
    "synthetic_flight/instrument_errors.py", "synthetic_flight/sensing.py", "synthetic_flight/folder.py",
    "postflight/cli.py", "postflight/commands.py", "postflight/run_folder.py", "postflight/scoring.py",
    "postflight/plots/", "postflight/studies/",
)  # fmt: skip


@pytest.mark.parametrize("path", CODE, ids=name)
def test_degrees_stay_in_files_command_and_figures(path):
    if name(path).startswith(DEGREES) or path.stem == "commands":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.arg):
            assert node.arg.rsplit("_", 1)[-1] not in UNITS or node.arg in UNITS, (
                f"{node.arg}: SI and radians in memory"
            )


def modules_imported(path, known):
    """Modules of this project that a file imports anywhere, also inside functions."""
    found = set()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            named = {f"{node.module}.{a.name}" for a in node.names}
            found |= named & known or {node.module}  # of a package either its modules or what it says itself
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
    return found & known


def test_no_module_imports_itself_by_a_detour():
    module = {p: ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in CODE}
    graph = {module[p]: modules_imported(p, set(module.values())) - {module[p]} for p in CODE}
    # the public door imports on demand, so a package above may name it
    while leaves := [m for m, needs in graph.items() if not needs & graph.keys()]:
        for m in leaves:
            del graph[m]
    assert not graph, f"circles among {sorted(graph)}"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_users_type_checker_reads_the_annotations(package):
    """PEP 561: of an installed package without the marker it sees no type."""
    assert (ROOT / package / "py.typed").is_file()


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


PYTHON_BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
# what a user reads and copies: it imports `postflight` alone of this project's packages
SHOWN = [
    *sorted((ROOT / "notebooks").glob("*.py")),
    *sorted((ROOT / "examples").rglob("*.py")),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "README.md",
]


@pytest.mark.parametrize("path", SHOWN, ids=name)
def test_what_users_read_goes_through_the_front_door(path):
    text = path.read_text()
    for code in [text] if path.suffix == ".py" else PYTHON_BLOCK.findall(text):
        for module in imports(ast.parse(code)):
            if module.split(".")[0] in PACKAGES:
                assert module == "postflight", f"{module} is internal: import postflight alone"


def test_every_planted_error_has_its_place():
    """An entry whose source was rewritten would end the whole list before it runs."""
    listed = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "mutants.py", "--list"], capture_output=True, text=True, check=False
    )
    assert listed.returncode == 0, listed.stderr


@pytest.mark.parametrize("path", [p for p in CODE if "@kernel\n" in p.read_text()], ids=name)
def test_beside_kernels_functions_state_their_types(path):
    """The type checker lets kernels go without, and cannot tell them from the rest."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef) and not {"kernel", "inlined"} & set(map(ast.unparse, node.decorator_list)):
            assert node.returns or path.name.endswith("_kernels.py"), f"{node.name} states no type"
