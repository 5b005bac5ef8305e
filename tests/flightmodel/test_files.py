"""What is half-written goes when its writer is gone, in whatever container that was, and never before."""

import os
import shutil
import subprocess
import sys
import time

import pytest

from flightmodel.checks import ConfigError
from flightmodel.files import LEFT_ALONE_S, abandoned, machine, nothing_at, partial_path
from flightmodel.flightfolder import read_flight_file
from tests.refusing import refuses

DEAD = 2**22  # above the largest number that Linux gives a process
WAIT_S = 60.0
# a run that takes as long as its standard input is open
RUN = """
import sys
from pathlib import Path
from types import SimpleNamespace
from postflight.run_folder import RunFolder

with RunFolder(Path(sys.argv[1]), SimpleNamespace(hashes={"who": sys.argv[2]}), {}) as run:
    (run.path / "bet.csv").write_text(sys.argv[2])
    print("writing", flush=True)
    sys.stdin.read()
"""
WRITE = """
import sys
from pathlib import Path
from flightmodel.files import write_file

for _ in range(400):
    write_file(Path(sys.argv[1]), sys.argv[2] * 3000)
"""


def left(folder, number, name="run", where=None, kind="partial"):
    path = folder / f".{kind}-{where or machine()}-{number}-0123abcd-{name}"
    path.mkdir()
    (path / "bet.csv").write_text("half")
    return path


def age(path, by_s):
    at = time.time() - by_s
    for each in (*path.iterdir(), path):
        os.utime(each, (at, at))


def test_of_ended_processes_of_this_machine_at_once_and_of_others_by_age(tmp_path):
    gone = left(tmp_path, DEAD)
    left(tmp_path, os.getpid())
    elsewhere = [left(tmp_path, DEAD, where="01234567"), left(tmp_path, os.getpid(), where="01234567")]
    (tmp_path / ".partial-notes").mkdir()
    assert list(abandoned(tmp_path)) == [gone]
    age(elsewhere[1], LEFT_ALONE_S + 60.0)
    assert set(abandoned(tmp_path)) == {gone, elsewhere[1]}
    (elsewhere[1] / "bet.csv").touch()  # it still writes
    assert list(abandoned(tmp_path)) == [gone]


def test_of_one_target_only(tmp_path):
    a, b = left(tmp_path, DEAD, "a"), left(tmp_path, DEAD, "b-a")
    old = left(tmp_path, DEAD, "a", kind="old")
    assert list(abandoned(tmp_path, "a")) == [a]
    assert list(abandoned(tmp_path, "b-a")) == [b]
    assert list(abandoned(tmp_path, "a", "old")) == [old]


def test_own_names_are_found_and_differ(tmp_path):
    one, two = (partial_path(tmp_path / "report.html") for _ in range(2))
    assert one != two
    one.touch()
    assert list(abandoned(tmp_path)) == []


def namespaces():
    """Command before a command that gives it PID namespace of its own."""
    before = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--mount-proc"]
    if shutil.which("unshare") is None or subprocess.run([*before, "true"], capture_output=True).returncode:
        pytest.skip("PID namespaces are not permitted here")
    return before


def test_two_runs_in_separate_pid_namespaces(tmp_path):
    """Two containers on one volume: neither sees the other's process, and both runs are whole at the end."""
    before = namespaces()

    def start(who, number=2):
        # a number that runs in no other namespace, where the shell is 1 and Python 2
        others = "/bin/true; " * (number - 2)
        shell = ["sh", "-c", f'{others}"$@"; exit $?', "-", sys.executable, "-c", RUN, str(tmp_path), who]
        return subprocess.Popen([*before, *shell], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    first = start("first", 9)
    assert first.stdout.readline() == "writing\n"
    for who in ("second", "third"):  # each begins and ends within the first
        assert start(who).communicate("", timeout=WAIT_S) == ("writing\n", None)
    first.communicate("", timeout=WAIT_S)
    assert first.returncode == 0
    assert sorted(p.read_text() for p in (tmp_path / "runs").glob("*/bet.csv")) == ["first", "second", "third"]
    assert not list((tmp_path / "runs").glob(".*"))


def test_what_a_killed_run_left_goes_with_the_next(tmp_path):
    command = [sys.executable, "-c", RUN, str(tmp_path)]
    killed = subprocess.Popen([*command, "killed"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    killed.stdout.readline()
    killed.kill()
    killed.communicate()
    assert len(list((tmp_path / "runs").glob(".partial-*"))) == 1
    subprocess.run([*command, "next"], input="", text=True, check=True, capture_output=True)
    assert [p.read_text() for p in (tmp_path / "runs").glob("**/bet.csv")] == ["next"]
    assert not list((tmp_path / "runs").glob(".*"))


def test_two_writers_of_one_file(tmp_path):
    """800 writes, none fails, and what is there is at any time the whole of one."""
    path = tmp_path / "report.html"
    both = [subprocess.Popen([sys.executable, "-c", WRITE, str(path), who], stderr=subprocess.PIPE) for who in "ab"]
    while any(process.poll() is None for process in both):
        if path.exists():
            assert path.read_text() in ("a" * 3000, "b" * 3000)
    assert [process.communicate()[1] for process in both] == [b"", b""]
    assert [process.returncode for process in both] == [0, 0]
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_the_same_run_twice_in_one_second(tmp_path):
    """Equal runs have equal names."""
    command = [sys.executable, "-c", RUN.replace("sys.stdin.read()", "pass"), str(tmp_path), "same"]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    assert [process.communicate(timeout=WAIT_S)[1] for process in both] == [""] * 4
    assert not list((tmp_path / "runs").glob(".*"))


def test_a_file_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    for name in ("radar_b.csv", "rates.csv", ".radar_a.csv"):
        (tmp_path / name).touch()
    assert nothing_at(tmp_path / "radar_a.csv").endswith("there are: radar_b.csv, rates.csv")
    elsewhere = tmp_path / "tables" / "radar_a.csv"
    assert nothing_at(elsewhere).endswith(f"no folder {elsewhere.parent}")
    for number in range(20):
        (tmp_path / f"a{number:02d}.csv").touch()
    assert nothing_at(tmp_path / "radar_a.csv").endswith("a07.csv, ...")


def test_absent_files_are_named_with_the_faults_of_the_keys(tmp_path):
    (tmp_path / "flight.toml").write_text(
        'name = "x"\nt0_utc = "2009-08-17T12:52:00Z"\nvehicle = "mine.toml"\nspeed = 3\n'
        f'[radars.a]\nfile = "a.csv"\n[radars.b]\nfile = "{"b" * 300}.csv"\n'
    )
    with refuses("key-unknown", "file-missing", "key-missing", kind=ConfigError) as caught:
        read_flight_file(tmp_path)
    absent = [str(f) for f in caught.value.faults if f.code == "file-missing"]
    assert [f.split("'")[1] for f in absent] == ["vehicle", "radars.a.file", "radars.b.file"]
    with refuses("file-missing", names=(f"folder is wanted: {tmp_path}",), kind=ConfigError):
        read_flight_file(tmp_path / "flight.toml")
