"""Which rows of an oversampled track are used, by component and span?

``every_s`` of a tracker in flight.toml is a number for all that it measures, a table by component, or a list of spans:

    every_s = 4.0
    every_s = { az = 4.0, el = 4.0 }
    every_s = [{ every_s = 4.0 }, { from_s = 600.0, to_s = 640.0, components = ["range"], every_s = 0.0 }]

A component that no entry names keeps all its rows; of several entries about one instant the last one holds.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.config import KeyFaults, Section, Time

Component = Literal["range", "az", "el", "range_rate", "position", "velocity", "height"]
Spacing = Annotated[float, Field(ge=0.0, le=1e4)]


class ThinnedSpan(Section):
    """From ``from_s`` to before ``to_s``, rows of ``components`` closer than ``every_s`` are predicted, not used.

    Without ends it holds throughout, without components for all.
    """

    every_s: Spacing
    from_s: Time | None = None
    to_s: Time | None = None
    components: tuple[Component, ...] = ()

    @model_validator(mode="after")
    def _in_order(self) -> ThinnedSpan:
        if self.from_s is not None and self.to_s is not None and self.to_s <= self.from_s:
            raise KeyFaults([("to_s", self.to_s, f"is not after from_s = {self.from_s:g}; swap the two")])
        return self

    def holds(self, time_s: FloatArray, component: str) -> BoolArray:
        """Which rows (n,) of a component it is about."""
        inside: BoolArray = np.full(len(time_s), not self.components or component in self.components)
        if self.from_s is not None:
            inside &= time_s >= self.from_s
        if self.to_s is not None:
            inside &= time_s < self.to_s
        return inside


def _as_spans(value: Any) -> Any:
    """Every form of ``every_s`` as a list of spans."""
    if isinstance(value, dict):
        return [{"components": [component], "every_s": spacing} for component, spacing in value.items()]
    return value if isinstance(value, (list, tuple)) else [{"every_s": value}]


Thinning = Annotated[
    tuple[ThinnedSpan, ...],
    BeforeValidator(_as_spans, json_schema_input_type=Spacing | dict[Component, Spacing] | tuple[ThinnedSpan, ...]),
    Field(max_length=100, validate_default=True),
]


def spacing_s(thinning: tuple[ThinnedSpan, ...], time_s: FloatArray, component: str) -> FloatArray:
    """Least time (n,) from each row to the one used before it; 0 where all are used."""
    out: FloatArray = np.zeros(len(time_s))
    for span in thinning:
        out[span.holds(time_s, component)] = span.every_s
    return out


def spaced(time_s: FloatArray, spacing: FloatArray) -> BoolArray:
    """Rows (n,) that keep at least their ``spacing`` (n,) from the one kept before, the first among them."""
    keep: BoolArray = np.ones(len(time_s), dtype=bool)
    if not spacing.any():
        return keep
    last = -np.inf
    for k, (t, least) in enumerate(zip(time_s.tolist(), spacing.tolist(), strict=True)):
        keep[k] = least <= 0.0 or t >= last + least - 1e-6
        last = t if keep[k] else last
    return keep
