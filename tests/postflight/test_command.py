"""The command as a user or a script meets it: exit codes, messages, nothing half-written, nothing deleted."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from flightmodel.checks import GateError
from flightmodel.files import writing
from postflight import cli, commands
from postflight.deflections import METHODS
from postflight.flight import read_flight
from postflight.plots import run_figures
from tests.postflight.killing import kill_run, run_again, start_command
from tests.refusing import printed_codes, refuses

HEAVY = {"numpy", "scipy", "numba", "matplotlib", "cv2", "trimesh", "filterpy", "pandas", "ppigrf", "erfa"}
COMMANDS = ("demo", "simulate", "reconstruct", "deflection", "run", "score", "report", "warmup")


def tree(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


# ---------------------------------------------------------------------------------------------------------------- help


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["report", "--help"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    """Help in under half a second needs that; the import list does not depend on the machine's load."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "postflight.cli", *arguments], capture_output=True, text=True
    )
    assert done.returncode == 0
    imported = {line.rsplit("|", 1)[-1].strip().split(".")[0] for line in done.stderr.splitlines() if "|" in line}
    assert "click" in imported, "the list of imports was not read"
    assert not imported & HEAVY


def test_help_answers_soon(postflight) -> None:
    """Half a second is wanted (0.2 s alone on the machine); three times that allows for neighbours at work."""
    took = []
    for _ in range(5):
        start = time.perf_counter()
        assert postflight("--help").returncode == 0
        took.append(time.perf_counter() - start)
    assert min(took) < 1.5


def test_help_names_every_command(postflight) -> None:
    text = postflight("--help").stdout
    assert all(f"  {command} " in text for command in COMMANDS)


def test_version(postflight) -> None:
    from importlib.metadata import version

    assert version("postflight") in postflight("--version").stdout


# --------------------------------------------------------------------------------------------------------------- usage


@pytest.mark.parametrize(
    "arguments",
    [
        ["rnu", "x"],
        ["--colour"],
        ["run"],
        ["run", "x", "--rte", "3"],
        ["run", "x", "--rate", "0"],
        ["run", "x", "--rate", "nan"],
        ["deflection", "x", "--method", "horizon"],
        ["deflection", "x", "--method", "camera", "--joint", "-5"],
        ["deflection", "x", "--method", "camera", "--joint", "nan"],
        ["deflection", "x", "--method", "camera", "--plane", "nan"],
        ["simulate", "irve2_reference", "x", "--seed", "-1"],
        ["simulate", "irve2_reference", "x", "--seed", "two"],
    ],
)
def test_wrong_usage_exits_2(command, tmp_path: Path, arguments: list[str]) -> None:
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Error" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_reconciliation_has_the_settings_that_the_flight_states(command, flight, monkeypatch) -> None:
    flight.append('[reconstruction]\nwithout = ["south"]\nstart_s = 421.0')
    given = []

    def seen(of, *_, **__):
        given.append(of.settings)
        raise GateError("enough", "seen")

    monkeypatch.setattr("postflight.reconciliation.command.reconstruct", seen)
    assert command("reconcile", flight.root).returncode == 3
    assert given[0].without == ("south",)
    assert given[0].start_s == 421.0
    assert given[0].pulse_rate_hz == read_flight(flight.root).settings.pulse_rate_hz > 0.0


@pytest.mark.parametrize("options", [["--without", "nort"], ["--set", "without=nort"]])
def test_unknown_source_exits_2_before_anything_is_compiled(command, flight, monkeypatch, options: list[str]) -> None:
    monkeypatch.setattr(commands, "compile_kernels", lambda *_: pytest.fail("compiled first"))
    done = command("reconstruct", flight.root, *options)
    assert done.returncode == 2, done.stderr
    assert printed_codes(done.stderr) == ["name-unknown"]
    assert "'north'" in done.stderr
    assert not (flight.root / "runs").exists()


def test_wrong_command_names_the_nearest_or_the_way_to_help(command) -> None:
    text = command("rnu").stderr
    assert "run" in text or "--help" in text


@pytest.mark.parametrize("verb", ["reconstruct", "deflection", "run", "score"])
def test_missing_folder(command, tmp_path: Path, verb: str) -> None:
    done = command(verb, "no-such-flight", cwd=tmp_path)
    assert done.returncode in (2, 3)
    assert "no-such-flight" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_the_folder(command, tmp_path: Path) -> None:
    (tmp_path / "flight.csv").write_text("t_s\n1\n")
    done = command("run", "flight.csv", cwd=tmp_path)
    assert done.returncode in (2, 3)
    assert "flight.csv" in done.stderr
    assert "Traceback" not in done.stderr


def test_unknown_scenario_names_the_nearest(command, tmp_path: Path) -> None:
    done = command("simulate", "irve2_refrence", "out", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "irve2_reference" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["name = ", 'nmae = "x"\n', ""])
def test_bad_scenario_file_exits_2_and_writes_nothing(command, tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.toml").write_text(text)
    done = command("simulate", "mine.toml", "out", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "mine.toml" in done.stderr
    assert "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["mine.toml"]


def test_simulate_without_a_scenario_flies_the_reference(command, tmp_path: Path) -> None:
    """The usage line says ``[SCENARIO] FOLDER``: a folder alone is enough (here a file, so that nothing is flown)."""
    (tmp_path / "out").write_text("a file, not a folder")
    before = tree(tmp_path)
    done = command("simulate", "out", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert printed_codes(done.stderr) == ["file-exists"]
    assert "out" in done.stderr
    assert tree(tmp_path) == before


# --------------------------------------------------------------------------------------------- places to write, or not


def test_runs_that_cannot_be_written(command, flight) -> None:
    (flight.root / "runs").write_text("a file where the results should go")
    before = tree(flight.root)
    done = command("reconstruct", flight.root)
    assert done.returncode in (2, 3)
    assert "runs" in done.stderr
    assert "Traceback" not in done.stderr
    assert tree(flight.root) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to a read-only folder")
def test_read_only_folder(command, flight) -> None:
    flight.root.chmod(0o555)
    try:
        done = command("reconstruct", flight.root)
    finally:
        flight.root.chmod(0o755)
    assert done.returncode == 3
    assert printed_codes(done.stderr) == ["cannot-write"]
    assert "runs" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """A folder that is no flight at all."""
    folder = tmp_path / "thesis"
    (folder / "chapters").mkdir(parents=True)
    (folder / "chapters" / "one.txt").write_text("three years of work")
    return folder


@pytest.mark.parametrize("more", [[], ["--force"]])
def test_simulate_leaves_a_foreign_folder_alone(command, precious: Path, more: list[str]) -> None:
    before = tree(precious)
    done = command("simulate", "irve2_reference", precious, *more)
    assert done.returncode in (2, 3), done.stdout
    assert "thesis" in done.stderr
    assert tree(precious) == before
    assert [p.name for p in precious.parent.iterdir()] == ["thesis"]


def test_demo_leaves_a_foreign_folder_alone(command, precious: Path) -> None:
    before = tree(precious)
    done = command("demo", precious)
    assert done.returncode in (2, 3), done.stdout
    assert tree(precious) == before


def test_simulate_does_not_overwrite_without_force(command, flight) -> None:
    flight.replace("flight.toml", 'vehicle = "irve2_reference"', 'vehicle = "irve2_reference"\nsynthetic = true')
    (flight.root / "truth").mkdir()
    (flight.root / "truth" / "truth.csv").write_text("t_s\n420.0\n")
    before = tree(flight.root)
    done = command("simulate", "irve2_reference", flight.root)
    assert done.returncode in (2, 3)
    assert "--force" in done.stderr
    assert tree(flight.root) == before


@pytest.mark.parametrize(
    "disguise", ["", '\ndescription = "no synthetic = true flight"', "\n# synthetic = true", "\nsynthetic = false"]
)
@pytest.mark.parametrize("verb", ["simulate", "demo"])
def test_force_never_deletes_a_real_flight(command, flight, verb: str, disguise: str) -> None:
    flight.replace("flight.toml", 'vehicle = "irve2_reference"', 'vehicle = "irve2_reference"' + disguise)
    before = tree(flight.root)
    arguments = ["irve2_reference", flight.root, "--force"] if verb == "simulate" else [flight.root]
    done = command(verb, *arguments)
    assert done.returncode in (2, 3), done.stdout
    assert tree(flight.root) == before


@pytest.mark.parametrize("verb", ["simulate", "demo"])
def test_force_never_deletes_a_delivery_that_another_simulator_made(command, flight, verb: str) -> None:
    """``synthetic = true`` and no truth: somebody else's files, which no seed can bring back."""
    flight.replace("flight.toml", 'vehicle = "irve2_reference"', 'vehicle = "irve2_reference"\nsynthetic = true')
    before = tree(flight.root)
    arguments = ["irve2_reference", flight.root, "--force"] if verb == "simulate" else [flight.root]
    done = command(verb, *arguments)
    assert done.returncode in (2, 3), done.stdout
    assert tree(flight.root) == before


def test_parent_of_the_destination_is_missing(command, tmp_path: Path) -> None:
    """Made on the way, or refused before the flight is flown; never a traceback."""
    (tmp_path / "file").write_text("x")
    done = command("simulate", "irve2_reference", tmp_path / "file" / "deeper" / "out")
    assert done.returncode in (2, 3)
    assert "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


# ---------------------------------------------------------------------------------------------------------- interrupted


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    return start_command(*arguments, stdout=subprocess.PIPE, text=True)


def wait_for_new(parent: Path, known: set[str], process: subprocess.Popen[str], limit_s: float = 60.0) -> bool:
    """Wait until something is being written; False where the process ended first."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end and process.poll() is None:
        if parent.is_dir() and {p.name for p in parent.iterdir()} - known:
            return True
        time.sleep(0.01)
    return False


def test_interrupt_during_run_leaves_nothing(flight) -> None:
    before = flight.contents()
    process = start("run", flight.root)
    written = wait_for_new(flight.root / "runs", set(), process)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert written, errors
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert flight.contents() - {"runs"} == before


@pytest.mark.slow
def test_terminated_run_leaves_no_run_that_looks_whole(flight, postflight) -> None:
    process = start("run", flight.root)
    assert wait_for_new(flight.root / "runs", set(), process)
    process.kill()
    process.communicate(timeout=30)
    assert [p for p in (flight.root / "runs").iterdir() if not p.name.startswith(".")] == []
    (flight.root / "truth").mkdir()
    (flight.root / "truth" / "truth.csv").write_text("t_s\n420.0\n")
    done = postflight("score", flight.root)
    assert done.returncode == 3
    assert printed_codes(done.stderr) == ["run-missing"]


@pytest.mark.slow
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupt_during_simulate_leaves_nothing(tmp_path: Path, sent: signal.Signals, code: int) -> None:
    process = start("simulate", "irve2_reference", tmp_path / "out")
    written = wait_for_new(tmp_path, set(), process)
    time.sleep(0.5)
    process.send_signal(sent)
    _, errors = process.communicate(timeout=60)
    assert written
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(params=["as a terminal has it", "ignored by the parent"])
def inherited_sigint(request):
    """What a shell's background job hands down is ignored SIGINT."""
    if request.param == "as a terminal has it":
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("deflection", "x", "--metod", "camera"), "--method"),
        (("deflection", "x", "--method", "camra"), "'camera'"),
        (("recncile", "x"), "'reconcile'"),
        (("schema", "fligt"), "'flight'"),
        (("export", "x", "--to", "cvs"), "'csv'"),
    ],
)
def test_a_misspelt_command_option_or_choice_names_what_may_be_meant(command, arguments, meant) -> None:
    done = command(*arguments)
    assert done.returncode == 2
    assert re.search(f"(?i)did you mean (one of: )?.?{meant}", done.stderr), done.stderr


@pytest.mark.usefixtures("inherited_sigint")
def test_interrupt_before_anything_is_written(tmp_path: Path) -> None:
    process = start("simulate", "irve2_reference", tmp_path / "out")
    time.sleep(1.5)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    # an interrupt that met compiled code on its way lets Python end itself by the signal: 130 to a shell as well
    assert process.returncode in (130, -signal.SIGINT), errors
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("amid", ["<frozen importlib._bootstrap>", "/site-packages/llvmlite/binding/ffi.py"])
@pytest.mark.parametrize(
    ("sent", "handler", "raised"),
    [(signal.SIGINT, cli.interrupt, KeyboardInterrupt), (signal.SIGTERM, cli.terminate, SystemExit)],
)
def test_signals_amid_an_import_or_bindings_wait_for_its_end(amid, sent, handler, raised) -> None:
    """Compiled libraries turn a KeyboardInterrupt there into an ImportError, or print its traceback themselves."""
    inside = compile("handler(sent, sys._getframe())", amid, "exec")
    with pytest.raises(raised):
        handler(sent, sys._getframe())
    before = signal.signal(sent, handler)
    try:
        exec(inside, {"handler": handler, "sent": sent, "sys": sys})
        begun = time.monotonic()
        with pytest.raises(raised):
            time.sleep(10.0)
        assert time.monotonic() - begun < 5.0  # a wait is cut short
    finally:
        signal.signal(sent, before)


INTERRUPTED_AS_FREED = """
import os, signal, time
from postflight import cli

class Freed:
    def __del__(self):
        os.kill(os.getpid(), signal.{sent})
        time.sleep(1.0)

def work(**_):
    Freed()
    time.sleep(30.0)

signal.signal(signal.SIGINT, signal.default_int_handler)
cli.cli.main = work
cli.main()
"""


@pytest.mark.parametrize(("sent", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_whose_exception_python_drops_is_not_lost(sent, code) -> None:
    """What is raised while an object is freed goes no further; the command would carry on."""
    script = INTERRUPTED_AS_FREED.replace("{sent}", sent)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr


# ---------------------------------------------------------------------------------------------------------------- score


def test_score_without_truth_exits_3(command, flight) -> None:
    done = command("score", flight.root, "--json")
    assert done.returncode == 3
    assert printed_codes(done.stderr) == ["truth-missing"]
    assert done.stdout == ""


def test_score_with_broken_truth_exits_3_without_traceback(command, flight) -> None:
    (flight.root / "truth").mkdir()
    for name in ("truth.csv", "deflection.csv"):
        (flight.root / "truth" / name).write_text("")
    run = flight.root / "runs" / "20260101T000000Z-00000000"
    run.mkdir(parents=True)
    for name in ("run.json", "summary.json", "bet_header.json"):
        (run / name).write_text(json.dumps({"methods": {}}))
    (run / "bet.csv").write_text("t_s\n")
    done = command("score", flight.root)
    assert done.returncode == 3
    assert printed_codes(done.stderr) == ["file-unreadable"]
    assert "Traceback" not in done.stderr


# ----------------------------------------------------------------------------------------------- a flight, run twice


@pytest.fixture(scope="session")
def two_runs(clean_flight, postflight, tmp_path_factory: pytest.TempPathFactory):
    """The hand-made flight run twice, the second time by a link from another directory with spaces and accents."""
    home = tmp_path_factory.mktemp("vols d’été")
    shutil.copytree(clean_flight.root, home / "vol numéro 1")
    (home / "link").symlink_to(home / "vol numéro 1", target_is_directory=True)
    first = postflight("run", "vol numéro 1", cwd=home)
    one = sorted((home / "vol numéro 1" / "runs").iterdir())
    saved = tree(one[0]) if one else {}
    time.sleep(1.1)  # run folders are named to a second
    second = postflight("run", home / "link", cwd="/")
    two = [p for p in sorted((home / "vol numéro 1" / "runs").iterdir()) if p not in one]
    return first, second, saved, tree(two[0]) if two else {}


@pytest.mark.slow
def test_estimators_that_cannot_answer_exit_4_and_say_why(two_runs) -> None:
    """No physics in the hand-made numbers: no method can answer, and the trajectory is written all the same."""
    first, second, saved, _ = two_runs
    assert first.returncode == 4, first.stdout + first.stderr
    assert second.returncode == 4, second.stdout + second.stderr
    methods = json.loads(saved["summary.json"])["methods"]
    assert {name for name, row in methods.items() if row["deflection_deg"] is None} == set(METHODS)
    assert all(f"{name}: {row['reason']} [{row['code']}]" in first.stdout for name, row in methods.items())
    assert "Traceback" not in first.stderr + second.stderr
    assert {"bet.csv", "residuals.csv", "verdicts.csv", "findings.csv", "summary.json", "run.json"} <= set(saved)


@pytest.mark.slow
def test_nonsense_is_not_reported_as_a_good_trajectory(two_runs) -> None:
    first, _, saved, _ = two_runs
    table = pd.read_csv(io.BytesIO(saved["consistency_checks.csv"]))
    failed, passed = set(table.name[~table.passed]), set(table.name[table.passed])
    # two radars that see two places: most points of both are edited
    assert {"edited north", "edited south"} <= failed
    # what failed is named on the terminal, what passed is not
    assert {name for name in failed | passed if name in first.stdout} == failed


@pytest.mark.slow
def test_second_run_gives_the_same_bytes(two_runs) -> None:
    _, _, one, two = two_runs
    assert one
    assert sorted(one) == sorted(two)
    different = [name for name in one if one[name] != two[name]]
    assert different == ["run.json"]


@pytest.mark.slow
def test_run_json_says_what_was_run_on_what(two_runs) -> None:
    _, _, one, _ = two_runs
    facts = json.loads(one["run.json"])
    assert {"version", "settings", "inputs_sha256"} <= set(facts)
    assert all(len(digest) == 64 for digest in facts["inputs_sha256"].values())
    assert any("flight.toml" in name for name in facts["inputs_sha256"])


@pytest.mark.slow
def test_no_result_file_names_this_machine(two_runs, clean_flight) -> None:
    _, _, one, _ = two_runs
    text = b"".join(data for name, data in one.items() if not name.endswith(".png"))
    assert b"vol num" not in text
    assert str(Path.home()).encode() + b"/" not in text


# ------------------------------------------------------------------------------------------ killed, and no room on disk


@pytest.mark.long
def test_killed_runs_leave_nothing_half_written(two_runs, clean_flight, tmp_path: Path) -> None:
    """Three moments of what benchmarks/kill.py draws at random; the run after them gives the bytes of any other."""
    _, _, saved, _ = two_runs
    shutil.copytree(clean_flight.root, tmp_path / "flight")
    assert kill_run(tmp_path / "flight", 0.1, saved) == "before anything"
    kill_run(tmp_path / "flight", 1.5, saved)  # how far it is by then depends on the machine
    assert kill_run(tmp_path / "flight", None, saved) == "while writing"
    run_again(tmp_path / "flight", saved)


@pytest.mark.filterwarnings("default::RuntimeWarning")
def test_a_figure_that_fails_costs_itself_alone_and_says_so(flight, command, monkeypatch) -> None:
    def fails(*_: object) -> None:
        raise ValueError("two dollars: $x$ \\bad")

    for name in ("figure_residuals", "figure_2_5"):
        monkeypatch.setattr(run_figures, name, fails)
    done = command("run", flight.root)
    (run,) = (flight.root / "runs").iterdir()
    assert "Traceback" not in done.stderr
    assert printed_codes(done.stderr) == ["figure-failed"] * 2
    assert all(name in done.stderr for name in ("residuals.png", "figure_2_5.png"))
    drawn = {p.name for p in (run / "figures").iterdir()}
    assert "filter_and_smoother.png" in drawn
    assert not drawn & {"residuals.png", "figure_2_5.png"}
    assert {"summary.json", "report.html", "rigid_bounds.csv", "bet.csv"} <= {p.name for p in run.iterdir()}


def limited(*arguments: str | Path, largest_bytes: int) -> subprocess.CompletedProcess[str]:
    """Run the command where no file may grow beyond a size: what a full disk does, without one."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_bytes, largest_bytes))

    return subprocess.run(
        [sys.executable, "-m", "postflight.cli", *map(str, arguments)],
        capture_output=True, text=True, timeout=120, preexec_fn=limit,
    )  # fmt: skip


@pytest.mark.slow
def test_no_room_for_a_run(flight) -> None:
    before = flight.contents()
    done = limited("reconstruct", flight.root, largest_bytes=30_000)
    assert done.returncode == 3, done.stderr
    assert printed_codes(done.stderr) == ["disk-full"]
    assert str(flight.root / "runs") in done.stderr
    assert "Traceback" not in done.stderr
    assert flight.contents() - {"runs"} == before


@pytest.mark.slow
def test_no_room_for_a_flight(tmp_path: Path) -> None:
    done = limited("simulate", "irve2_reference", tmp_path / "out", largest_bytes=30_000)
    assert done.returncode == 3, done.stderr
    assert printed_codes(done.stderr) == ["disk-full"]
    assert str(tmp_path / "out") in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_or_read_only_is_told_with_its_place(tmp_path: Path) -> None:
    for number, code in ((errno.ENOSPC, "disk-full"), (errno.EROFS, "cannot-write")):
        with refuses(code, names=[re.escape(str(tmp_path)), os.strerror(number)]), writing(tmp_path, "write elsewhere"):
            raise OSError(number, os.strerror(number))
    with pytest.raises(FileNotFoundError), writing(tmp_path, "write elsewhere"):
        raise FileNotFoundError(errno.ENOENT, "no such file", "/elsewhere/input.csv")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_results_on_a_device_that_is_full(tmp_path: Path) -> None:
    with refuses("disk-full", names=[re.escape(str(tmp_path))]), writing(tmp_path, ""):
        Path("/dev/full").write_text("x")
