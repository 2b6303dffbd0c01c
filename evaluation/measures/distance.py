"""Error measures on plain arrays.

Everywhere: `truth` and `prediction` are displacements (state, node, 3) in metres; a node that is gone is NaN in
`truth` from its death on and takes no part in any mean. Sums run in float64 whatever the fields' type is.

The paper's measures (section 4): e2_s(t) is the mean over nodes of |q - q~|_2 in run s at time t, its mean over
time is the error of the run, and the mean of those over the test runs is the number in the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.passes import distances


def node_distance(truth: NDArray[np.floating], prediction: NDArray[np.floating]) -> NDArray[np.float64]:
    """|q - q~|_2 of every node in every state: (state, node), m; NaN where the node is gone in `truth`.

    Raises
    ------
    EvaluationError
        Where the shapes differ or the prediction is not finite at a node that is there.
    """
    return compared(truth, prediction)[0]


def compared(truth: NDArray[np.floating], prediction: NDArray[np.floating]) -> tuple[NDArray[np.float64], float, float]:
    """`node_distance`, and the sums of squares of distance and of displacement over the nodes that are there."""
    if truth.shape != prediction.shape or truth.ndim != 3 or truth.shape[-1] != 3:
        raise EvaluationError(
            f"truth has shape {truth.shape} and the prediction {prediction.shape}; expected the same (state, node, 3)"
        )
    out = np.empty(truth.shape[:2])
    wrong, size, bad = distances(truth, prediction, out)
    if bad:
        state, node = np.argwhere(~np.isfinite(out) & ~gone(truth))[0]
        raise EvaluationError(
            f"the prediction is not finite in state {state} at node {node} ({bad} such values), where the "
            f"reference has a displacement; expected numbers wherever the node exists"
        )
    return out, wrong, size


def gone(truth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(state, node): whether the node has no displacement any more, since all its elements have failed."""
    return np.asarray(~np.isfinite(truth).all(axis=-1))


def mean_node_error(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """e2_s(t), (state,) m: the mean of `distance` (state, node) over the nodes that are there; NaN without any."""
    return masked_mean(distance, axis=-1)


def masked_mean(values: NDArray[np.floating], axis: int | tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Mean over what is not NaN, in float64; NaN where nothing is left (numpy would warn there)."""
    there = ~np.isnan(values)
    count = there.sum(axis=axis)
    total = np.where(there, values, 0).sum(axis=axis, dtype=np.float64)
    return np.asarray(np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0))


def quantile_node_error(distance: NDArray[np.float64], q: float) -> NDArray[np.float64]:
    """(state,) m: the node error that the fraction `q` of the living nodes stays below."""
    out = np.full(len(distance), np.nan)
    for state, row in enumerate(distance):
        there = row[~np.isnan(row)]
        if there.size:
            out[state] = np.quantile(there, q)
    return out


def largest_node_error(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(state,) m: the largest node error of each state; NaN without living nodes."""
    largest = np.where(np.isnan(distance), -np.inf, distance).max(axis=-1, initial=-np.inf)
    return np.where(np.isfinite(largest), largest, np.nan)


def relative_error(truth: NDArray[np.floating], distance: NDArray[np.float64]) -> float:
    """sqrt(sum |q - q~|^2 / sum |q|^2) over the nodes and states of a run; of displacements, never positions.

    Does not depend on the origin of the coordinates. NaN for a run in which nothing moves.
    """
    there = ~np.isnan(distance)
    size = sum(float(np.square(truth[..., axis], dtype=np.float64)[there].sum()) for axis in range(3))
    return float(np.sqrt(np.square(distance[there]).sum() / size)) if size > 0 else float("nan")


@dataclass(frozen=True)
class Peak:
    """The largest node error of a run: its value (m), and the state and node where it stands."""

    value: float
    state: int
    node: int


def peak_error(distance: NDArray[np.float64]) -> Peak:
    """Where and when `distance` (state, node) is largest.

    Raises
    ------
    EvaluationError
        Where every node is gone.
    """
    if np.isnan(distance).all():
        raise EvaluationError("every node is gone in every state; expected at least one living node to measure")
    state, node = np.unravel_index(int(np.nanargmax(distance)), distance.shape)
    return Peak(float(distance[state, node]), int(state), int(node))


def group_means(distance: NDArray[np.float64], groups: Sequence[NDArray[np.integer]]) -> NDArray[np.float64]:
    """(state, group) m: mean of `distance` (state, node) within each group of node numbers; NaN for an empty one."""
    if not groups:
        return np.empty((len(distance), 0))
    return np.stack([mean_node_error(distance[:, nodes]) for nodes in groups], axis=1)


def group_error(distance: NDArray[np.float64], groups: Sequence[NDArray[np.integer]]) -> NDArray[np.float64]:
    """(group,) m: mean over time of the mean node error within each group of node numbers (a part, a region).

    Every state counts the same, as in e2; a group that is empty or gone throughout gives NaN.
    """
    return masked_mean(group_means(distance, groups), axis=0)
