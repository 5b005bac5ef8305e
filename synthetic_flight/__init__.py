"""Synthetic flight with known truth: two bodies on a compliant joint, and the instruments that observe them."""

from __future__ import annotations
