"""Many dispersed flights: flown in chunks on one machine or many, resumed after a kill; bands and intervals."""

from __future__ import annotations
