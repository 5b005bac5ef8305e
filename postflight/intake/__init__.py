"""How an analyst's own data come in: a folder to start from, columns proposed, and what is odd about the sensors."""

from __future__ import annotations
