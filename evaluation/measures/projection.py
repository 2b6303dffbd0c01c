"""What projecting displacements on modes costs, and numbers for nodes that are gone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_schema.pod import Pod
from evaluation.errors import EvaluationError
from evaluation.measures.distance import gone, mean_node_error
from evaluation.measures.tally import state_blocks


def last_seen(displacement: NDArray[np.floating]) -> NDArray[np.floating]:
    """`displacement` (state, node, 3) with every node that is gone (NaN) left where it was seen last.

    A decomposition needs a number everywhere; a jump to zero would put modes of its own into the data. The nodes
    that are gone take no part in any error. A node never seen stays at zero.
    """
    missing = gone(displacement)
    if not missing.any():
        return displacement
    last = np.maximum.accumulate(np.where(missing, 0, np.arange(len(displacement))[:, None]), axis=0)
    return np.asarray(np.nan_to_num(np.take_along_axis(displacement, last[..., None], axis=0)))


def moving(pod: Pod) -> Pod:
    """`pod` as it is; raises EvaluationError if it is that of states in which nothing moves."""
    if not pod.singular_values[0] > 0:
        raise EvaluationError("nothing moves in any run; expected displacements to decompose")
    return pod


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
    whole, there = last_seen(displacement), ~gone(displacement)
    out = np.empty((modes.shape[1], states))
    for block in state_blocks(*displacement.shape[:2]):
        rest = np.array(whole[block], dtype=np.float32).reshape(block.stop - block.start, -1)
        coefficients = rest @ modes
        for r in range(modes.shape[1]):
            rest -= np.outer(coefficients[:, r], modes[:, r])
            distance = np.sqrt(np.square(rest.reshape(whole[block].shape)).sum(axis=-1, dtype=np.float64))
            out[r, block] = mean_node_error(np.where(there[block], distance, np.nan))
    return out
