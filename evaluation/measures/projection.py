"""What projecting displacements on modes costs, and numbers for nodes that are gone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_schema.pod import Pod
from evaluation.errors import EvaluationError
from evaluation.measures.distance import gone

# Numbers worked on at once: each mode goes over all of them, so they should stay in the processor's cache.
_IN_CACHE = 1 << 17


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
    whole, missing = last_seen(displacement), gone(displacement)
    there = None if not missing.any() else ~missing
    coefficients = np.asarray(whole, np.float32).reshape(states, -1) @ modes
    by_node = modes.reshape(-1, 3, modes.shape[1])
    total = np.zeros((modes.shape[1], states))
    step = max(1, _IN_CACHE // (3 * states))
    for first in range(0, displacement.shape[1], step):
        nodes = slice(first, first + step)
        # One direction after the other: what is added up over directions then lies side by side.
        rest = np.ascontiguousarray(whole[:, nodes].transpose(2, 0, 1), np.float32)
        shape = np.ascontiguousarray(by_node[nodes].transpose(2, 1, 0))
        left = np.empty_like(rest)
        for r in range(len(total)):
            np.multiply(coefficients[None, :, r, None], shape[r][:, None], out=left)
            np.subtract(rest, left, out=rest)
            np.multiply(rest, rest, out=left)
            distance = left[0]
            distance += left[1]
            distance += left[2]
            np.sqrt(distance, out=distance)
            if there is not None:
                distance *= there[:, nodes]
            total[r] += distance.sum(axis=1)
    count = np.full(states, displacement.shape[1]) if there is None else there.sum(axis=1)
    return np.asarray(np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0))
