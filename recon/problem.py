"""What is a filter's problem made of? Nodes, instruments and their readings, motion, errors, and the start.

A `Problem` is all that a pass of the filter is given (`recon.setup` makes it from telemetry). Its readings lie at
nodes, in order; where one component has rows of its own, as an angle of a radar may, these are a *group*.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flightmodel.checks import BoolArray, FloatArray, IntArray
from flightmodel.trajectory import nearest_index
from recon.measurements import RADAR, SLOTS, Instrument, servo_lag
from recon.propagation import SAME_INSTANT_S, Motion
from recon.state import KINEMATIC, ErrorModel, States

FIT_SPAN_S = 3.0  # of the track points that the start is fitted to


class Sources(NamedTuple):
    """Instruments, one row each: kind, lever arm, place, axes, and which error (-1: none) fills each of its slots."""

    kind: IntArray
    arm_body_m: FloatArray
    site_ecef_m: FloatArray
    dcm: FloatArray
    slot: IntArray


class Observed(NamedTuple):
    """Measurements in order of nodes; those of node ``k`` are rows ``first[k]`` to ``first[k + 1]``.

    Parameters
    ----------
    first : (n + 1,) int
    source : (M,) int
    value, variance : (M, 3) float
        Variance is infinite where a component was not measured.
    known : (M, 3) float
        Field or direction to the Sun, Earth-fixed axes; of a radar, the refractivity at its site, and the lag of both
        angles behind the path about which the filter is linearised.
    usable : (M,) bool
        Whether the filter may use it at all.
    """

    first: IntArray
    source: IntArray
    value: FloatArray
    variance: FloatArray
    known: FloatArray
    usable: BoolArray


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
        return Sources(  # shaped where there is no instrument, too
            np.array([i.kind for i in self.instruments], dtype=np.int64),
            np.array([i.arm_body_m for i in self.instruments]).reshape(-1, 3),
            np.array([i.site_ecef_m for i in self.instruments]).reshape(-1, 3),
            np.array([i.dcm for i in self.instruments]).reshape(-1, 3, 3),
            np.array([i.slots(self.model) for i in self.instruments], dtype=np.int64).reshape(-1, SLOTS),
        )

    @property
    def group(self) -> IntArray:
        """Group of components (M,) that each measurement is of."""
        return np.array(
            [self.instruments[s].group[r] for s, r in zip(self.observed.source, self.row, strict=True)], dtype=np.int64
        )

    def without(self, unusable: BoolArray) -> Problem:
        """Same problem in which some measurements (M,) are only predicted, never used."""
        return replace(self, observed=self.observed._replace(usable=self.observed.usable & ~unusable))

    def thinned(self, step_s: float) -> tuple[Problem, IntArray]:
        """Problem with at most one used measurement of an instrument every ``step_s``, and the nodes (k,) it keeps.

        Components with rows of their own count as instruments.

        A node of every step stays even where nothing is measured: after a long step a decorrelated error cannot be
        smoothed.
        """
        node, used = self.node, np.flatnonzero(self.observed.usable)
        cell = np.floor(self.time_s[node[used]] / step_s).astype(np.int64)
        _, first = np.unique(
            np.column_stack([self.observed.source[used], self.group[used], cell]), axis=0, return_index=True
        )
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


def with_servo_lag(problem: Problem, states: States | None) -> Problem:
    """Problem whose radars lag behind a path through all its nodes; as it is without servos, or a path."""
    lagging = [k for k, one in enumerate(problem.instruments) if one.kind == RADAR and one.servo_hz > 0.0]
    if states is None or not lagging or len(problem.time_s) < 4:
        return problem
    known, at_s = problem.observed.known.copy(), problem.time_s[problem.node]
    for number in lagging:
        mine = problem.observed.source == number
        known[mine, 1:] = servo_lag(problem.instruments[number], problem.time_s, states, at_s[mine])
    return replace(problem, observed=problem.observed._replace(known=known))


def observe(time_s: FloatArray, instruments: tuple[Instrument, ...]) -> tuple[Observed, IntArray]:
    """All measurements of instruments that lie on nodes (within `SAME_INSTANT_S`), by node, and their rows (M,)."""
    none = np.empty(0, dtype=np.int64)  # an entry state and inertial sensors need no tracker
    source, row, node = [none], [none], [none]
    for number, instrument in enumerate(instruments):
        nearest = nearest_index(time_s, instrument.time_s)
        on = np.flatnonzero(np.abs(time_s[nearest] - instrument.time_s) <= SAME_INSTANT_S)
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
