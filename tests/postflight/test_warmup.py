"""What is compiled before first use is what the commands then use: nothing is compiled a second time."""

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


def test_what_is_missing_is_compiled_once_and_reported(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    run = [sys.executable, "-c", "from postflight.warmup import prepare; prepare(['tables'], print)"]
    first, again = (subprocess.run(run, env=environment, capture_output=True, text=True) for _ in range(2))
    assert len(first.stdout.splitlines()) == 1
    assert "tables" in first.stdout
    assert [p.name.split("-")[0] for p in (tmp_path / "cache").rglob("*.compiled")] == ["tables"]
    assert (again.returncode, again.stdout) == (0, ""), again.stderr


def test_every_group_is_dealt_once_whatever_the_processors():
    for processors in (1, 2, 3, 16):
        shares = warmup._shares(list(warmup.GROUPS), processors)
        assert sorted(group for share in shares for group in share) == sorted(warmup.GROUPS)
        assert len(shares) <= processors
    with_parts = next(share for share in shares if "ensembles" in share)
    assert {"simulator", "creep"} <= set(with_parts)  # which has the same parts


def test_a_group_that_fails_is_reported_with_its_reason(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    code = "from postflight import warmup; warmup.prepare(['missing_group'], print)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    compiling, failed = done.stdout.splitlines()
    assert "missing_group" in compiling
    assert "KeyError" in failed
    assert not list((tmp_path / "cache").rglob("*.compiled"))


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
