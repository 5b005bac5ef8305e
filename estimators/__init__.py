"""How far the aeroshell bent: one question an estimator, one `DeflectionHistory` as its answer; none sees the truth."""

from __future__ import annotations
