"""A stale kernel cannot run: numba does not see an edit of a callee in another file, so the cache folder must."""

import ast
import os
import shutil
import subprocess
import sys
import time
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
    layout = tree / "flightmodel" / "_raster_kernels.py"
    layout.write_text(layout.read_text() + "\n# moved\n")
    assert run(tree, cache)[0] not in (before, after)


SIGNATURES = """
import sys, time
from numba import types
from flightmodel import _kernels
sys.path.insert(0, str(_kernels.CACHE.path))
path = _kernels.CACHE.path / "shared.py"
path.write_text("def add(x, y):\\n    return x + y\\n") if not path.exists() else None
import shared
add = _kernels.kernel(shared.add)
numbers = (types.int8, types.int16, types.int32, types.int64, types.float32, types.float64)
pairs = [(x, y) for x in numbers for y in numbers]
"""
COMPILE = (
    SIGNATURES
    + """
first = int(sys.argv[1])
while time.time() < float(sys.argv[2]):
    pass
for k in range(len(pairs)):
    add.compile(pairs[(k * (2 * first + 1) + 9 * first) % len(pairs)])
"""
)
READ = (
    SIGNATURES
    + """
for pair in pairs:
    add.compile(pair)
    assert add.stats.cache_hits[pair] == 1, pair
assert [s for s in add.signatures] == pairs
"""
)


def test_processes_that_save_at_once_keep_every_signature_s_own(tmp_path):
    """What is loaded for a signature was compiled for it, and none is lost."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path)}

    def started(code, *arguments):
        return subprocess.Popen([sys.executable, "-c", code, *arguments], env=environment, stderr=subprocess.PIPE)

    subprocess.run([sys.executable, "-c", SIGNATURES], env=environment, check=True)
    at_once = str(time.time() + 4.0)
    several = [started(COMPILE, str(k), at_once) for k in (0, 2, 3)]
    for one in several:
        assert one.wait() == 0, one.stderr.read().decode()
    reader = started(READ)
    assert reader.wait() == 0, reader.stderr.read().decode()


def test_no_kernel_calls_another():
    """What is called by kernels is a part, which is one function with its caller: it has one set of bits."""
    decorated, called = {}, set()
    for source in sorted(ROOT.glob("*/**/_*kernels.py")):
        for node in ast.parse(source.read_text()).body:
            if isinstance(node, ast.FunctionDef) and node.decorator_list:
                decorated[node.name] = ast.unparse(node.decorator_list[0])
                calls = (each.func for each in ast.walk(node) if isinstance(each, ast.Call))
                called |= {ast.unparse(function).rsplit(".")[-1] for function in calls}
    assert {"kernel", "inlined"} <= set(decorated.values())
    assert not [name for name in called if decorated.get(name) == "kernel"]
