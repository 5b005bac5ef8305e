"""A stale kernel cannot run: numba does not see an edit of a callee in another file, so the cache folder must."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FLY = """
import numpy as np
from flightmodel import _kernels
from synthetic_flight import _kernels as flight
print(_kernels.CACHE.path)
print(flight.beyond_freeplay(0.2, 0.1, 0.01, 25.0))
"""


def run(tree, cache):
    environment = {**os.environ, "PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", FLY], env=environment, cwd=tree, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    folder, value = done.stdout.split()
    return Path(folder), float(value)


def test_an_edit_of_any_kernel_file_leaves_the_old_cache_behind(tmp_path):
    tree, cache = tmp_path / "tree", tmp_path / "cache"
    for package in ("flightmodel", "synthetic_flight", "recon", "estimators"):
        shutil.copytree(ROOT / package, tree / package, ignore=shutil.ignore_patterns("__pycache__"))
    before, value = run(tree, cache)
    assert run(tree, cache) == (before, value)
    assert value == 0.2 - 0.1 - 0.01 + 0.02 * 0.02 * 25.0
    source = tree / "synthetic_flight" / "_kernels.py"
    source.write_text(
        source.read_text().replace("theta - freeplay - half, 0.0)", "theta - freeplay - half, 0.0) + 1.0")
    )
    after, changed = run(tree, cache)
    assert after != before
    assert changed == value + 1.0
    # any file of kernels counts, as its constants may be frozen into the machine code of others
    layout = tree / "flightmodel" / "_csv_kernels.py"
    layout.write_text(layout.read_text() + "\n# moved\n")
    assert run(tree, cache)[0] not in (before, after)
