"""A flight that everything is known about: two bodies on a compliant joint, and the instruments that watched them."""

from __future__ import annotations
