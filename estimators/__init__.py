"""How far was the aeroshell deflected? Each estimator answers with one `DeflectionHistory`; none sees the truth."""

from __future__ import annotations
