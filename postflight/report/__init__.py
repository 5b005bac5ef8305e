"""One flight's answer as a page: what a reader sees, from a finished run and the telemetry that it was made from."""

from __future__ import annotations
