"""What is true of the world, the vehicle and the instruments; shared by truth and estimate. Imports none of ours.

Conventions (CONVENTIONS.md has them all): SI and radians in memory; frames ``eci`` (ECEF at epoch, then fixed),
``ecef``, ``ned``, ``body`` (centerbody, x out of the nose), ``shell`` (aeroshell), ``lv`` (clocking angles), ``suba``
(accelerometer package), ``cam`` (OpenCV). ``v_to = dcm_to_from @ v_from``; quaternions scalar first.
"""

from __future__ import annotations

import os
from pathlib import Path

try:
    Path.home()
except RuntimeError:  # no HOME, and a user without a name: libraries fail at import; container engines set this
    os.environ["HOME"] = "/"
