"""Single nodes that leap away in one state of a run and are back in the next: a fault of the file, or of the solver.

Nothing real does so between two states: a node that swings, or turns with a wheel, takes the nodes of its elements along.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crashkit.ingestion.structure import Structure

# A leap is longer than this share of the structure's diagonal, there and back.
_LONG = 0.1
# Back: this close to where it was, as a share of the way. Alone: no node of its elements moves by this share of it.
_BACK, _ALONE = 0.25, 0.5
# More nodes than this share are no single ones.
_FEW = 0.01


class Leaps:
    """What was found in the states so far; they come one after the other.

    Attributes
    ----------
    told
        The longest leap in words; empty without any.
    """

    def __init__(self, structure: Structure, time: NDArray[np.float64], size: float) -> None:
        self._structure, self._time, self._least = structure, time, _LONG * size
        self._step: NDArray[np.float32] | None = None
        self._longest_step = self._longest = 0.0
        self.told = ""

    def add(self, state: int, moved: NDArray[np.float32], longest: float) -> None:
        """Take in how nodes `moved` (node, 3), m, from the state before to `state`, and how far the fastest one did."""
        if self._step is not None and min(longest, self._longest_step) > self._least:
            self._look(state - 1, self._step, moved)
        self._step, self._longest_step = moved, longest

    def _look(self, state: int, there: NDArray[np.float32], back: NDArray[np.float32]) -> None:
        """Look for nodes that went `there` in `state`, and `back` in the next."""
        way = np.minimum(np.linalg.norm(there, axis=1), np.linalg.norm(back, axis=1))
        returned = np.linalg.norm(there + back, axis=1) < _BACK * way
        nodes = np.flatnonzero((way > self._least) & returned)
        if not 0 < len(nodes) <= max(1, _FEW * len(way)):
            return
        beside = self._beside(nodes, way)
        alone = nodes[beside < _ALONE * way[nodes]]
        if not len(alone):
            return
        node = int(alone[way[alone].argmax()])
        if way[node] > self._longest:
            self._longest = float(way[node])
            more = f", as do {len(alone) - 1} more nodes" if len(alone) > 1 else ""
            self.told = (
                f"node {self._structure.node_id[node]} leaps by {way[node]:.3g} m in state {state} (time "
                f"{self._time[state]:g} s) and is back in the next one, without its neighbours{more}"
            )

    def _beside(self, nodes: NDArray[np.int64], way: NDArray[np.float32]) -> NDArray[np.float32]:
        """(node,): the longest way of any other node of the elements of each of `nodes`."""
        out = np.zeros(len(nodes), np.float32)
        place = np.full(len(way), -1)
        place[nodes] = np.arange(len(nodes))
        for corners in (self._structure.face_nodes, self._structure.cell_nodes):
            if not len(corners):
                continue
            mine = np.where(corners >= 0, place[corners], -1)
            touched = np.flatnonzero((mine >= 0).any(axis=1))
            for row in touched:
                around = corners[row][corners[row] >= 0]
                for node in around[place[around] >= 0]:
                    others = around[around != node]
                    if len(others):
                        out[place[node]] = max(out[place[node]], float(way[others].max()))
        return out
