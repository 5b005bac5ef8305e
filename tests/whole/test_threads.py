"""The same bytes under one hash, whatever number of threads and cores a machine gives to linear algebra."""

import os
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
