"""What is compiled before first use is what the commands then use: nothing is compiled a second time."""

import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest

from postflight import warmup
from tests.refusing import printed_codes

COUNT = """
import sys
import numba.core.event as event
from pathlib import Path

compiled = []

class Listener(event.Listener):
    def on_start(self, happened):
        compiled.append(happened.data["dispatcher"].py_func.__name__)

    def on_end(self, happened):
        pass

event.register("numba:compile", Listener())
from dataclasses import replace
from postflight.reconstruction import reconstruct
from postflight.flight import read_flight
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

scenario = read_scenario("irve2_reference")
scenario = replace(scenario, spec=scenario.spec.model_copy(update={"video": None}))
simulate_to_folder(scenario, 0, Path(sys.argv[1]))
reconstruct(read_flight(Path(sys.argv[1])))
reconstruct(read_flight(Path(sys.argv[2])))
print(compiled)
"""
MARS = Path(__file__).parents[2] / "examples" / "mars_entry"


@pytest.mark.slow
def test_after_warmup_a_flight_and_its_reconstruction_compile_nothing(tmp_path):
    run = [sys.executable, "-m", "postflight.cli", "warmup"]
    first = subprocess.run(run, capture_output=True, text=True)
    assert first.returncode == 0, first.stderr
    again = subprocess.run(run, capture_output=True, text=True)
    assert not again.stderr
    count = [sys.executable, "-c", COUNT, str(tmp_path / "flight"), str(MARS)]
    flown = subprocess.run(count, capture_output=True, text=True)
    assert flown.stdout.strip() == "[]", flown.stderr


def in_fresh_cache(tmp_path, code):
    """Run code as a program, whose worker processes import it."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    (tmp_path / "program.py").write_text(f"if __name__ == '__main__':\n    {code}\n")
    run = [sys.executable, str(tmp_path / "program.py")]
    return subprocess.run(run, env=environment, capture_output=True, text=True)


def test_what_is_missing_is_compiled_once_and_reported(tmp_path):
    code = "from postflight.commands import compile_kernels; compile_kernels('creep', 'spans')"
    first, again = (in_fresh_cache(tmp_path, code) for _ in range(2))
    assert first.returncode == 0, first.stderr
    announced = first.stderr.splitlines()[0]
    assert "creep" in announced
    assert "spans" in announced
    assert sorted(p.name.split("-")[0] for p in (tmp_path / "cache").rglob("*.compiled")) == ["creep", "spans"]
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")


def test_progress_names_what_is_compiled_and_never_stands_still(tmp_path):
    code = "from postflight.warmup import prepare; print(prepare(['spans', 'creep'], lambda f, what: print(f, what)))"
    done = in_fresh_cache(tmp_path, code)
    *looks, failed = done.stdout.splitlines()
    assert failed == "{}", done.stderr
    fractions = [float(line.split()[0]) for line in looks]
    assert all(0.0 <= one < two <= 1.0 for one, two in itertools.pairwise([f for f in fractions if f < 1.0]))
    assert fractions[-1] == 1.0
    assert "group 1 of 2: " in looks[0]
    assert {"creep", "spans"} <= set(looks[0].replace(",", " ").replace(";", " ").split())
    assert any(line.endswith(" s remain") for line in looks)


def test_every_group_is_compiled_by_one_process_with_what_shares_its_parts():
    shares = warmup._shares(list(warmup.GROUPS))
    assert sorted(group for share in shares for group in share) == sorted(warmup.GROUPS)
    assert ["ensembles", "creep"] in shares
    assert warmup._shares(["creep"]) == [["creep"]]
    assert warmup._shares([]) == []


def test_a_group_that_fails_is_reported_with_its_reason(tmp_path):
    code = "from postflight import warmup; print(warmup.prepare(['missing_group'], lambda *_: None))"
    done = in_fresh_cache(tmp_path, code)
    assert done.returncode == 0, done.stderr
    assert "missing_group" in done.stdout
    assert "KeyError" in done.stdout
    assert not list((tmp_path / "cache").rglob("*.compiled"))


def test_a_process_that_is_killed_leaves_its_groups_to_their_first_use(tmp_path):
    code = (
        "import os, threading; from postflight import warmup; from postflight.beside import multiprocessing as m; "
        "kill = lambda: [os.kill(p.pid, 9) for p in m.active_children()]; "
        "threading.Timer(1.0, kill).start(); print(warmup.prepare(['camera'], lambda *_: None))"
    )
    done = in_fresh_cache(tmp_path, code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("{'camera': "), done.stdout


def test_warmup_without_a_folder_to_keep_kernels_in_is_refused(tmp_path):
    (tmp_path / "file").touch()
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "file"), "MPLCONFIGDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    run = [sys.executable, "-m", "postflight.cli", "warmup"]
    done = subprocess.run(run, env=environment, capture_output=True, text=True)
    assert done.returncode == 3
    assert printed_codes(done.stderr) == ["cannot-write"]
    assert all(name in done.stderr for name in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"))


def test_a_scenario_is_read_without_the_libraries_that_only_tables_and_filters_need():
    # each takes a quarter of a second or more to import, which a first flight would wait for
    heavy = ("pandas", "scipy.interpolate", "scipy.signal", "scipy.stats", "cv2", "matplotlib", "ppigrf")
    code = (
        "import sys; from synthetic_flight.scenarios import fly_scenario, read_scenario; "
        f"read_scenario('irve2_reference'); print([m for m in {heavy} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
