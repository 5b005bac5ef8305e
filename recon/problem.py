"""What is given to the filter? Nodes, motion, instruments with their measurements, error model, start and gate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flightmodel.checks import FloatArray
from recon.error_model import ErrorModel
from recon.measurements import Instrument
from recon.propagation import Motion
from recon.state import KINEMATIC, BoolArray, IntArray, Observed, Sources, States

FIT_SPAN_S = 3.0  # of the track points that the start is fitted to


@dataclass(frozen=True)
class Problem:
    """Everything the filter needs.

    Parameters
    ----------
    time_s : (n,) float
        Nodes, the first is the start.
    node_index : (n,) int
        Where each node stands in the motion's grid.
    instruments : tuple of Instrument
    row : (M,) int
        Which of its instrument's measurements each observation is.
    observed : Observed
        All measurements by node.
    start, start_covariance : States, (9 + m, 9 + m) float
    gate : (4,) float
        Largest normalised innovation squared that is used, by number of components.
    kept : (n,) bool
        Nodes at which covariances are wanted.
    """

    time_s: FloatArray
    node_index: IntArray
    motion: Motion
    model: ErrorModel
    instruments: tuple[Instrument, ...]
    row: IntArray
    observed: Observed
    start: States
    start_covariance: FloatArray
    gate: FloatArray
    kept: BoolArray

    @property
    def size(self) -> int:
        """Number of errors in all."""
        return KINEMATIC + self.model.size

    @property
    def dense(self) -> int:
        """Kinematic errors and drivers."""
        return KINEMATIC + self.motion.drivers

    @property
    def node(self) -> IntArray:
        """Node of every measurement, (M,)."""
        return np.repeat(np.arange(len(self.time_s)), np.diff(self.observed.first))

    @property
    def moving(self) -> IntArray:
        """Errors that change: the nine kinematic ones and Gauss-Markov ones."""
        return np.concatenate([np.arange(KINEMATIC), KINEMATIC + self.model.wandering])

    def sources(self) -> Sources:
        """Instruments as arrays."""
        return Sources(
            np.array([i.kind for i in self.instruments], dtype=np.int64),
            np.array([i.arm_body_m for i in self.instruments]),
            np.array([i.site_ecef_m for i in self.instruments]),
            np.array([i.dcm for i in self.instruments]),
            np.array([i.slots(self.model) for i in self.instruments]),
        )

    def without(self, unusable: BoolArray) -> Problem:
        """Same problem in which some measurements (M,) are only predicted, never used."""
        return replace(self, observed=self.observed._replace(usable=self.observed.usable & ~unusable))

    def thinned(self, step_s: float) -> tuple[Problem, IntArray]:
        """Problem with at most one used measurement of an instrument every ``step_s``, and the nodes (k,) it keeps.

        A node of every step stays even where nothing is measured: after a long step a decorrelated error cannot be
        smoothed.
        """
        node, used = self.node, np.flatnonzero(self.observed.usable)
        cell = np.floor(self.time_s[node[used]] / step_s).astype(np.int64)
        _, first = np.unique(np.column_stack([self.observed.source[used], cell]), axis=0, return_index=True)
        chosen = np.sort(used[first])
        _, first_of_step = np.unique(np.floor(self.time_s / step_s), return_index=True)
        index = np.unique(np.concatenate([first_of_step, node[chosen]])).astype(np.int64)
        observed = self.observed
        thin = Observed(
            np.searchsorted(node[chosen], np.concatenate([index, [len(self.time_s)]])).astype(np.int64),
            observed.source[chosen],
            observed.value[chosen],
            observed.variance[chosen],
            observed.known[chosen],
            observed.usable[chosen],
        )
        return (
            replace(
                self,
                time_s=self.time_s[index],
                node_index=self.node_index[index],
                row=self.row[chosen],
                observed=thin,
                kept=np.zeros(len(index), dtype=bool),
            ),
            index,
        )


def observe(time_s: FloatArray, instruments: tuple[Instrument, ...], same_s: float) -> tuple[Observed, IntArray]:
    """All measurements of instruments that lie on nodes (within ``same_s``), by node, and their rows (M,)."""
    source, row, node = [], [], []
    for number, instrument in enumerate(instruments):
        nearest = nearest_index(time_s, instrument.time_s)
        on = np.flatnonzero(np.abs(time_s[nearest] - instrument.time_s) <= same_s)
        source.append(np.full(len(on), number, dtype=np.int64))
        row.append(on)
        node.append(nearest[on])
    sources, rows, nodes = (np.concatenate(part).astype(np.int64) for part in (source, row, node))
    order = np.lexsort((rows, sources, nodes))
    sources, rows, nodes = sources[order], rows[order], nodes[order]

    def gathered(name: str) -> FloatArray:
        out = np.empty((len(rows), 3))
        for number, instrument in enumerate(instruments):
            mine = sources == number
            out[mine] = getattr(instrument, name)[rows[mine]]
        return out

    first = np.searchsorted(nodes, np.arange(len(time_s) + 1)).astype(np.int64)
    usable = np.ones(len(rows), dtype=bool)
    return Observed(first, sources, gathered("value"), gathered("variance"), gathered("known"), usable), rows


def nearest_index(grid_s: FloatArray, at_s: FloatArray) -> IntArray:
    """Index of the grid time nearest to each of ``at_s``."""
    k = np.clip(np.searchsorted(grid_s, at_s), 1, len(grid_s) - 1)
    return np.asarray(k - (at_s - grid_s[k - 1] < grid_s[k] - at_s), dtype=np.int64)
