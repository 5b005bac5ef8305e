"""Kernels once without the compiler: an index out of bounds, or a name that only it forgives, fails here."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SMALL = (
    "flightmodel/test_kernel_primitives.py",
    "flightmodel/test_rotations.py",
    "flightmodel/test_earth.py",
    "recon/test_small_kernels.py",
    "recon/test_measurements.py",
    "synthetic_flight/test_small_kernels.py",
    "estimators/test_plain_twins.py",
)


@pytest.mark.parametrize("name", SMALL)
def test_small_problems_pass_interpreted(name):
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow and not long", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, f"tests/{name}"],
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
