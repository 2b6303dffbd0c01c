"""Proper orthogonal decomposition of fields too large for memory, and what a projection on its modes costs.

Runs come one at a time. What was seen so far is held as a truncated factor U S; with the next run X the pair
[U S, X] is decomposed through its small Gram matrix and truncated again. The truncation only ever takes away, so
every squared singular value is at most `StreamedPod.defect` below its exact value, and never above it: an
incremental form of the hierarchical approximate POD (Himpe, Leibner, Rave 2018, doi 10.1137/16M1085413).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.distance import gone, mean_node_error
from evaluation.measures.tally import state_blocks

# Rows of the tall matrices handled at once: bounds what is held in float64 beside the basis.
_BLOCK = 1 << 14


@dataclass(frozen=True)
class Pod:
    """Modes (3 * node, mode), orthonormal float32, and singular values (mode,), m, largest first.

    `defect` (m^2) bounds from above how far each squared singular value lies below the exact one.
    """

    modes: NDArray[np.float32]
    singular_values: NDArray[np.float64]
    defect: float

    @property
    def normalised(self) -> NDArray[np.float64]:
        """Singular values divided by the first."""
        return self.singular_values / self.singular_values[0]


class StreamedPod:
    """Feed runs with `add`, then ask for the `result`.

    `count` modes are wanted; `keep` (default 2 * count) are carried along, so that what is cut off early can
    hardly have grown into the first `count`. Memory: `keep` fields in float32 and one run.
    """

    def __init__(self, count: int = 50, keep: int | None = None) -> None:
        if count < 1:
            raise EvaluationError(f"{count} modes asked for; expected at least 1")
        self.count = count
        self.keep = max(count, keep if keep is not None else 2 * count)
        self.defect = 0.0
        self._factor: NDArray[np.float32] | None = None  # U S, (3 * node, <= keep)

    def add(self, displacement: NDArray[np.floating]) -> None:
        """One run (state, node, 3), m. Nodes that are gone (NaN) stay where they were seen last."""
        new = held(displacement).reshape(len(displacement), -1).T
        old = self._factor if self._factor is not None else np.empty((len(new), 0), np.float32)
        if len(old) != len(new):
            raise EvaluationError(
                f"a run of {len(new) // 3} nodes follows runs of {len(old) // 3}; expected the same nodes in all"
            )
        blocks = [slice(k, k + _BLOCK) for k in range(0, len(new), _BLOCK)]

        def pair(rows: slice) -> NDArray[np.float64]:
            return np.hstack([old[rows].astype(np.float64), new[rows].astype(np.float64)])

        gram = np.zeros((old.shape[1] + new.shape[1],) * 2)
        for rows in blocks:
            gram += (both := pair(rows)).T @ both
        energy, vectors = np.linalg.eigh(gram)
        energy, vectors = energy[::-1].clip(0), vectors[:, ::-1]
        # Below this the Gram matrix holds rounding only.
        kept = min(self.keep, max(1, int((energy > energy[0] * 1e-13).sum())))
        self.defect += float(energy[kept]) if kept < len(energy) else 0.0
        factor = np.empty((len(new), kept), np.float32)
        for rows in blocks:
            factor[rows] = pair(rows) @ vectors[:, :kept]
        self._factor = factor

    def result(self) -> Pod:
        """The decomposition of everything added.

        Raises
        ------
        EvaluationError
            Where nothing moved or nothing came.
        """
        if self._factor is None:
            raise EvaluationError("no run was given to the decomposition; expected at least one training run")
        values = np.sqrt(np.square(self._factor, dtype=np.float64).sum(axis=0))[: self.count]
        if not values[0] > 0:
            raise EvaluationError("nothing moves in any run; expected displacements to decompose")
        count = int((values > values[0] * 1e-6).sum())
        modes = self._factor[:, :count] / values[:count]
        return Pod(modes.astype(np.float32), values[:count], self.defect)


def held(displacement: NDArray[np.floating]) -> NDArray[np.floating]:
    """`displacement` (state, node, 3) with every node that is gone (NaN) left where it was seen last.

    A decomposition needs a number everywhere; a jump to zero would put modes of its own into the data. The nodes
    that are gone take no part in any error. A node never seen stays at zero.
    """
    missing = gone(displacement)
    if not missing.any():
        return displacement
    last = np.maximum.accumulate(np.where(missing, 0, np.arange(len(displacement))[:, None]), axis=0)
    return np.nan_to_num(np.take_along_axis(displacement, last[..., None], axis=0))


def projection_error(displacement: NDArray[np.floating], modes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean node error (mode, state), m, of projecting a run (state, node, 3) on the first 1, 2, ... modes.

    Row r - 1 is |q - V_r V_r^T q| averaged over the living nodes: what a linear reduction to r numbers costs
    before any regression. Modes (3 * node, mode) must be orthonormal.
    """
    states = len(displacement)
    if modes.shape[0] != displacement[0].size:
        raise EvaluationError(
            f"the modes have {modes.shape[0] // 3} nodes and the run {displacement.shape[1]}; expected the same"
        )
    whole, there = held(displacement), ~gone(displacement)
    out = np.empty((modes.shape[1], states))
    for block in state_blocks(*displacement.shape[:2]):
        rest = np.array(whole[block], dtype=np.float32).reshape(block.stop - block.start, -1)
        coefficients = rest @ modes
        for r in range(modes.shape[1]):
            rest -= np.outer(coefficients[:, r], modes[:, r])
            distance = np.sqrt(np.square(rest.reshape(whole[block].shape)).sum(axis=-1, dtype=np.float64))
            out[r, block] = mean_node_error(np.where(there[block], distance, np.nan))
    return out
