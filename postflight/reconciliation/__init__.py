"""Which joint makes the simulator fly like the flight?"""

from __future__ import annotations
