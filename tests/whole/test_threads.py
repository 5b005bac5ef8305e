"""The same bytes under one hash, whatever number of threads and cores a machine gives to linear algebra; and memory."""

import os
import platform
import shutil
import subprocess
import sys

import pytest

from postflight.streams import THREAD_VARIABLES
from tests.postflight.killing import assert_same, contents

MAIN = """
import os
import sys
from postflight import cli
assert "numpy" not in sys.modules, "then it is too late"
def command(**_):
    import numpy as np
    np.linalg.svd(np.random.default_rng(0).standard_normal((700, 700)))
    print(len(os.listdir("/proc/self/task")))
cli.cli.main = command
cli.main()
"""


def environment(threads):
    return os.environ | dict.fromkeys(THREAD_VARIABLES, str(threads)) | {"NO_COLOR": "1"}


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted in /proc")
def test_a_command_has_one_thread_for_linear_algebra():
    """A decomposition that OpenBLAS shares out: it starts its threads when it is loaded, where they are not pinned."""
    done = subprocess.run([sys.executable, "-c", MAIN], env=environment(4), capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "1"), done.stderr


@pytest.mark.long
def test_runs_with_one_two_and_four_threads_are_the_same_bytes(short, tmp_path):
    written = []
    for threads in (1, 2, 4):
        flight = tmp_path / str(threads) / "flight"
        shutil.copytree(short, flight, ignore=shutil.ignore_patterns("runs"))
        run = [sys.executable, "-m", "postflight.cli", "run", str(flight)]
        done = subprocess.run(run, env=environment(threads), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        written.append(contents(flight / "runs"))
    assert len(written[0]) > 30
    for other in written[1:]:
        assert_same(other, written[0])


HOLES = """
import resource, sys
from pathlib import Path
from postflight.streams import return_large_arrays
if sys.argv[1] == "returned":
    return_large_arrays()
import numpy as np

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6

large = np.ones(3_000_000)  # 24 MB: freed, it raises the size from which the C library takes maps
del large
arrays, small = [], []
for _ in range(50):
    arrays.append(np.ones(600_000))
    small.append(np.ones(500))  # what is left between them
before = resident_mb()
del arrays
print(before - resident_mb())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are asked for nothing")
def test_freed_arrays_go_back_to_the_system():
    # Dask's workers, started by a test before this one, leave the C library's own settings in the environment
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}

    def freed_mb(how):
        done = subprocess.run([sys.executable, "-c", HOLES, how], env=plain, capture_output=True, text=True, check=True)
        return float(done.stdout)

    assert freed_mb("returned") > 230.0  # of 240
    assert freed_mb("as it is") < 100.0  # else there is nothing to ask for
