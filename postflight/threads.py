"""How many threads does linear algebra take? One: sums of several threads round otherwise than sums of one.

A run's bytes would depend on the number of cores, under one hash. The matrices are small, so nothing is slower for it.
"""

from __future__ import annotations

import os

# read by the libraries behind numpy and scipy when they are loaded
VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def pin_threads() -> None:
    """Limit linear algebra of this process and its children to one thread; before numpy is imported."""
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
