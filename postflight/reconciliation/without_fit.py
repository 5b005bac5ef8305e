"""What of a reconciliation does not need the fit? The second process does it, and loads nothing else for it."""

from __future__ import annotations

from flightmodel.deflection import DeflectionHistory
from postflight.deflections import estimate
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds, rigid_bounds

ENTRIES = 300


def without_fit(flight: Reconstruction) -> tuple[DeflectionHistory | None, Bounds]:
    """Fused deflection, and bands of entries with the joint locked."""
    return estimate(flight, ("fused",)).histories.get("fused"), rigid_bounds(flight, ENTRIES)
