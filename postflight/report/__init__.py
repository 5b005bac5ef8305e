"""HTML report of one flight, made from a finished run and its telemetry."""

from __future__ import annotations
