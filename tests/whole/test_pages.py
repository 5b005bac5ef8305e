"""Every command that a page shows is run, in the page's order, in a folder that holds what the page's reader has.

A page's folder is its own, so that pages lean on nothing but what they say. Flights in it are copies of one: quick
commands meet the pulse of a flight, those of ``LONG`` a whole one.
"""

from __future__ import annotations

import glob
import json
import re
import shutil
import socket
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from tests.documents import COMMAND, PAGES, ROOT, command_lines, shell_lines
from tests.in_process import runner
from tests.refusing import printed_codes

# what a page says that its reader has
READER_HAS = {
    "another-planet.md": ("examples",),
    "README.md": ("delivered", "corners.csv", "my-scenario.toml"),
    "camera.md": ("examples",),
    "check.md": ("my-flight",),
    "deflection.md": ("examples",),
    "exports.md": ("my-flight",),
    "how-to.md": ("demo-flight", "examples", "tests"),
    "monte-carlo.md": (),
    "own-data.md": ("delivered",),
    "reconciliation.md": ("demo-flight",),
    "studies.md": ("demo-flight",),
    "tutorial-demo.md": ("demo-flight",),  # which its first command makes, or replaces
}
# parts of commands that take long, and what is run for them
SMALLER = {
    "--flights 100000": "--flights 192",
    "--flights 4000": "--flights 32",
    "study --flights 1000": "study --flights 16",
    "demo-flight --flights 1000": "demo-flight --flights 50",
    "--nworkers 16": "--nworkers 1",
}
# commands of `make long`, on a whole flight; with a page's name where others run the same in `make test`
LONG = {
    "own-data.md: postflight run my-flight",
    "own-data.md: postflight export my-flight --to kml",
    "postflight demo demo-flight",
    "postflight reconcile my-flight",
    "postflight reconstruct my-flight",
    "postflight reconstruct my-flight --sensitivity",
    "postflight reconstruct demo-flight --sensitivity",
    "postflight deflection my-flight --method camera --film",
    "postflight simulate examples/own_vehicle/scenario.toml own-flight --seed 3",
    "postflight run own-flight",
    "postflight run demo-flight --set c_n=1.1 --name more-lift",
    "postflight run demo-flight --set mass_kg=158 --without wallops_mainland --name heavy",
    "postflight compare demo-flight/plain demo-flight/more-lift demo-flight/heavy",
    "postflight export demo-flight --to csv --run more-lift",
    "postflight export demo-flight --to oem --out team.oem",
    "postflight compare demo-flight team.oem",
    "postflight simulate irve2_reference other-flight --seed 7",
    "postflight run other-flight",
    "postflight score other-flight --json",
    "postflight reconcile demo-flight",
    "postflight reconcile demo-flight --freeplay --creep --hardening",
    "postflight reconcile demo-flight --posterior",
    "dask scheduler --host 127.0.0.1 --port 8786 --no-dashboard",
    "export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False",
    "dask worker tcp://127.0.0.1:8786 --host 127.0.0.1 --no-dashboard --nworkers 16 --nthreads 1",
    "postflight montecarlo run irve2_reference study --flights 100000 --scheduler tcp://127.0.0.1:8786",
}
NOT_RUN = {
    "make demo": "makes an environment from a package registry; `postflight demo` is run",
    "make test": "is this suite",
    "postflight camera my-flight": "serves until it is interrupted; tests/postflight/test_camera_bench.py",
    "make docs": "makes an environment likewise; tests/postflight/test_site.py builds the site",
    "postflight study shell-test load-test.csv": "wants a test of one's own; tests/postflight/test_shell_test.py",
    "postflight study shell-test tub.csv --time min:min --load load_kn --displacement left_mm --arm-m 1.4": "likewise",
    "python -m pytest tests/synthetic_flight tests/recon --junitxml=proofs.xml": "is a part of this suite",
}
_WITH_CERTIFICATES = "needs certificates; tests/postflight/test_montecarlo_cluster.py runs a cluster with some"
NOT_RUN |= dict.fromkeys(
    (
        "export DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION=True",
        "export DASK_DISTRIBUTED__COMM__TLS__CA_FILE=ca.pem",
        "dask scheduler --protocol tls --port 8786 --no-dashboard",
        "dask worker tls://host:8786 --no-dashboard --nworkers 16 --nthreads 1",
        "postflight montecarlo run irve2_reference study --flights 100000 --scheduler tls://host:8786",
    ),
    _WITH_CERTIFICATES,
)
# blocks that are no commands, or not those alone, by their first line
SHOWN = (
    "Deflection at peak q", "my-flight/",
    "export DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION", "docker build",
)  # fmt: skip
# what a command leaves, beside its exit code
WRITES = {
    "postflight demo demo-flight": "demo-flight/demo.png demo-flight/runs/*/report.html",
    "postflight init my-flight --vehicle form": "my-flight/flight.toml my-flight/vehicle/vehicle.toml",
    "postflight import delivered/* --into my-flight": "my-flight/telemetry/*.csv my-flight/telemetry/*/*.png",
    "postflight run my-flight": "my-flight/runs/*/deflection_fused.csv my-flight/runs/*/figures/*.png",
    "postflight export my-flight --to nc": "my-flight/exports/*.nc",
    "postflight export my-flight --to kml": "my-flight/exports/*.kml",
    "postflight export my-flight --to csv": "my-flight/exports/*.csv",
    "postflight export my-flight --to nc --out trajectory.nc": "trajectory.nc",
    "postflight report my-flight --run plain": "my-flight/runs/*/report.html",
    "postflight run my-flight --set c_n=1.1 --set wind=none --name calm": "my-flight/runs/*-calm/inputs/flight.toml",
    "postflight compare my-flight/plain my-flight/calm": "my-flight/comparisons/*-and-calm/compare.html",
    "postflight compare demo-flight/plain demo-flight/more-lift demo-flight/heavy": "demo-flight/comparisons/*/*",
    "postflight export demo-flight --to csv --run more-lift": "demo-flight/exports/*-more-lift.csv",
    "postflight export demo-flight --to oem --out team.oem": "team.oem",
    "postflight compare demo-flight team.oem": "demo-flight/comparisons/*-and-team/systematic_differences.csv",
    "postflight report my-flight --notebook": "my-flight/runs/*/*.ipynb",
    "postflight report demo-flight --output demo.html": "demo.html",
    "postflight report demo-flight --notebook --output demo.ipynb": "demo.ipynb",
    "postflight reconstruct my-flight": "my-flight/runs/*/bet.csv",
    "postflight reconstruct my-flight --sensitivity": "my-flight/runs/*/sensitivity.csv",
    "postflight reconstruct demo-flight --sensitivity": "demo-flight/runs/*/sensitivity.csv",
    "postflight deflection my-flight --method camera --film": "my-flight/runs/*/figures/overlay.webm",
    "postflight deflection --loads examples/loads_table/bet.csv --vehicle examples/loads_table/vehicle.toml": (
        "examples/loads_table/bet-deflection/*.csv examples/loads_table/bet-deflection/figures/summary.png"
    ),
    "postflight deflection --film examples/film_alone/pictures --times examples/film_alone/frames.csv "
    "--vehicle examples/film_alone/vehicle.toml": "examples/film_alone/pictures-deflection/figures/overlay.png",
    "postflight simulate my-scenario.toml": "my-scenario-flight/flight.toml my-scenario-flight/truth/truth.csv",
    "postflight init flight-b --vehicle irve2_reference": "flight-b/flight.toml",
    "postflight init flight-c --vehicle flight-a/vehicle/vehicle.toml": "flight-c/vehicle/vehicle.toml",
    "postflight montecarlo run irve2_reference my-study --flights 1000": "my-study/percentiles.csv my-study/bands.png",
    "postflight study stiffness": "study-stiffness/*.csv study-stiffness/*.png",
    "postflight study table-3.1": "study-table-3.1/*.csv",
    "postflight study damping --seed 0": "study-damping/*.csv study-damping/figure_3_1.png",
    "postflight study preflight demo-flight --flights 1000": "study-preflight/*.csv study-preflight/*.png",
    "postflight reconcile demo-flight": "demo-flight/runs/*/joint.csv demo-flight/runs/*/joint.toml",
    "postflight reconcile demo-flight --posterior": "demo-flight/runs/*/posterior.csv",
}


def is_long(page: Path, line: str) -> bool:
    return line in LONG or f"{page.name}: {line}" in LONG


QUICK = [p for p in PAGES if any(not is_long(p, line) and line not in NOT_RUN for line in command_lines(p))]
SLOW = [p for p in PAGES if any(is_long(p, line) for line in command_lines(p))]


# ---------------------------------------------------------------------------------------------- what the reader does


def fill_in(form: Path, known: dict) -> None:
    """Fill in a proposal of `postflight import` from what is known of the flight, section by section."""
    written, there, section = [], {""}, ""
    for line in form.read_text().splitlines():
        header, value = re.match(r"\[([\w.]+)\]", line), re.match(r'(\w+) = "FILL IN"', line)
        if header:
            section = header[1]
            there.add(section)
            written += [line, *missing(section, known, form)]
        elif not value:
            written.append(line)
        elif value[1] in of(known, section):
            written.append(f"{value[1]} = {json.dumps(of(known, section)[value[1]])}")
    form.write_text("\n".join(written) + "\n")


def of(known: dict, section: str) -> dict:
    for key in filter(None, section.split(".")):
        known = known.get(key, {})
    return known


def missing(section: str, known: dict, form: Path) -> list[str]:
    """Lines for keys that the flight has and the form does not ask for, such as figures of data sheets."""
    asked = of(tomllib.loads(form.read_text()), section)
    given = {key: value for key, value in of(known, section).items() if key not in asked}
    return [f"{key} = {json.dumps(value)}" for key, value in given.items() if not isinstance(value, dict)]


def describe_flight(folder: Path, short: Path) -> None:
    """What was left to the reader by `import`: flight.toml's values, and the vehicle file."""
    known = tomllib.loads((short / "flight.toml").read_text())
    known["radars"] = {f"radar_{name}": radar for name, radar in known["radars"].items()}  # as import names their files
    fill_in(folder / "my-flight" / "flight.toml", known)
    describe_vehicle(folder / "my-flight" / "vehicle")


def describe_vehicle(folder: Path) -> None:
    shipped = vehicle_path("irve2_reference")
    shutil.copy(shipped, folder / "vehicle.toml")
    for name in vehicle_from_toml(shipped).files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(shipped.parent / name, folder / name)


# commands that say what is left to do (exit code 2), and the reader doing it
MENDED: dict[tuple[str, str], Callable[[Path, Path], None]] = {
    ("README.md", "postflight check my-flight"): describe_flight,
    ("own-data.md", "postflight check my-flight"): describe_flight,
    ("own-data.md", "postflight check flight-a"): lambda folder, _: describe_vehicle(folder / "flight-a" / "vehicle"),
}


def give(folder: Path, flight: Path, scenario: Path, names: tuple[str, ...]) -> None:
    """Put into a page's folder what its reader has."""
    for name in names:
        if name.endswith("-flight"):
            shutil.copytree(flight, folder / name)
        elif name == "delivered":
            shutil.copytree(flight / "telemetry", folder / name)
        elif name == "corners.csv":
            shutil.copy(ROOT / "tests" / "data" / "fisheye" / "corners_even.csv", folder / name)
        elif name == "my-scenario.toml":
            shutil.copy(scenario, folder / name)
        elif name == "examples":  # in which commands write
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("runs"))
        else:
            (folder / name).symlink_to(ROOT / name, target_is_directory=True)


# -------------------------------------------------------------------------------------------------------- the runs


def made_smaller(line: str) -> str:
    for old, new in SMALLER.items():
        line = line.replace(old, new)
    return line


def words_of(line: str, folder: Path) -> list[str]:
    """The words that the shell would hand over, patterns of file names filled in."""
    found = []
    for word in line.split():
        names = sorted(glob.glob(word, root_dir=folder)) if "*" in word else [word]
        assert names, f"{word} matches nothing"
        found += names
    return found


def ages(folder: Path, pattern: str) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.glob(pattern)}


def run_line(run: Callable, page: Path, line: str, folder: Path, short: Path) -> str:
    """Run one command, see that it leaves what it should; return what it printed."""
    expected = 2 if (page.name, line) in MENDED else 0
    before = {pattern: ages(folder, pattern) for pattern in WRITES.get(line, "").split()}
    smaller = made_smaller(line)
    done = run(*words_of(smaller, folder)[1:], cwd=folder)
    assert done.returncode == expected, f"{page.name}: {smaller}\n{done.stdout}{done.stderr}"
    if expected:
        assert "placeholder" in printed_codes(done.stdout)
        MENDED[page.name, line](folder, short)
    for pattern, was in before.items():
        assert ages(folder, pattern) != was, f"{page.name}: {smaller} wrote no {pattern}"
    if "--json" in line.split():
        json.loads(done.stdout)
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", QUICK, ids=lambda p: p.name)
def test_commands_of_a_page_run(page: Path, short: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    run = runner(capsys, monkeypatch)
    give(tmp_path, short, short.parent / "pulse.toml", READER_HAS[page.name])
    for line in command_lines(page):
        if not is_long(page, line) and line not in NOT_RUN:
            run_line(run, page, line, tmp_path, short)


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.mark.long
@pytest.mark.parametrize("page", SLOW, ids=lambda p: p.name)
def test_long_commands_of_a_page_run(page: Path, flown: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    run, port, started = runner(capsys, monkeypatch), str(free_port()), []
    give(tmp_path, flown, flown, ("demo-flight", "my-flight", "examples"))
    monkeypatch.setitem(SMALLER, "tcp://127.0.0.1:8786", f"tcp://127.0.0.1:{port}")
    monkeypatch.setitem(SMALLER, "--port 8786", f"--port {port}")
    try:
        for line in command_lines(page):
            if not is_long(page, line):
                continue
            program, *words = line.split()
            if program == "export":
                monkeypatch.setenv(*words[0].split("=", 1))
            elif program == "dask":
                started.append(start(line, tmp_path))
            else:
                printed = run_line(run, page, line, tmp_path, flown)
                if line == "postflight demo demo-flight":
                    as_shown(printed)
        assert all(process.poll() is None for process in started)
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(30)


def start(line: str, folder: Path) -> subprocess.Popen:
    """Start what goes on until it is stopped."""
    return subprocess.Popen([sys.executable, "-m", *made_smaller(line).split()], cwd=folder)


def as_shown(printed: str) -> None:
    """What README and tutorial show of the demo is what it prints, to a unit of the last digit."""
    readme, tutorial = (ROOT / "README.md").read_text(), (ROOT / "docs" / "tutorial-demo.md").read_text()
    passed = re.search(r"\d+ of \d+ consistency checks of the trajectory pass", printed)
    assert passed
    assert f"`{passed[0]}`" in tutorial
    for method in ("camera", "misalignment", "trim", "fused"):
        ours, shown, told = (
            [float(x) for x in re.search(rf"[│|] {method} +[│|](.*)", text)[1].split("│" if "│" in text else "|")[:3]]
            for text in (printed, readme, tutorial)
        )
        assert shown == pytest.approx(ours, abs=0.011)
        assert told == pytest.approx(ours, abs=0.011)
    assert re.search(r"Deflection at peak q .* \(fused\)", printed)[0] in readme


# ------------------------------------------------------------------------------------------------------- the lists


@pytest.mark.slow
def test_what_the_readme_shows_is_printed(short: Path, capsys, monkeypatch) -> None:
    printed = runner(capsys, monkeypatch)("score", short, cwd=short.parent).stdout.splitlines()
    shown = (ROOT / "README.md").read_text().splitlines()
    for mark in ("┃ method", "Deflection at peak q ("):
        (ours,), (theirs,) = ([line for line in text if line.lstrip().startswith(mark)] for text in (printed, shown))
        assert re.sub(r"[\d.]+ s\)", "s)", ours.strip()) == re.sub(r"[\d.]+ s\)", "s)", theirs)


def test_every_block_is_known() -> None:
    """Nothing hides in a block in a form that is not taken for a command."""
    hidden = []
    for page in PAGES:
        lines = [line for line in shell_lines(page) if line.strip()]
        fences = re.findall(r"^```(?:console|bash|sh|text)?\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
        known = [line for block in fences if block.startswith(SHOWN) for line in block.splitlines()]
        hidden += [line for line in set(lines) - set(known) if not COMMAND.match(line)]
    assert not hidden


@pytest.mark.parametrize("listed", [LONG, NOT_RUN, WRITES, {line for _, line in MENDED}], ids=range(4))
def test_lists_hold_nothing_that_no_page_shows(listed) -> None:
    shown = {f"{page.name}: {line}" for page in PAGES for line in command_lines(page)}
    assert set(listed) <= shown | {line.partition(": ")[2] for line in shown}


def test_smaller_replaces_what_pages_show() -> None:
    lines = "\n".join(line for page in PAGES for line in command_lines(page))
    assert [old for old in SMALLER if old not in lines] == []


def test_benchmarks_that_pages_name_exist() -> None:
    pages = [*PAGES, ROOT / "benchmarks" / "README.md"]
    named = {
        name for page in pages for name in re.findall(r"python ((?:benchmarks|docs)/[\w/]+\.py)", page.read_text())
    }
    assert len(named) >= 5
    assert [name for name in named if not (ROOT / name).exists()] == []
