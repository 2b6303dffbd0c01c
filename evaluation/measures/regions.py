"""Where errors are: groups of nodes by part, by boxes of a grid, or named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evaluation.errors import EvaluationError

AXES = "xyz"


@dataclass(frozen=True)
class NodeGroups:
    """Named groups of nodes: for each name its node numbers, increasing. Groups may share nodes; none is empty."""

    names: tuple[str, ...]
    nodes: tuple[NDArray[np.int64], ...]


def by_part(faces: ArrayLike, face_part: ArrayLike, part_names: Sequence[str]) -> NodeGroups:
    """The nodes of each part; one that two parts share belongs to both. Parts without a face are left out.

    faces (m, 3 or 4), -1 in the last corner of a triangle; face_part (m,) index into `part_names`.
    """
    corners, parts = np.asarray(faces), np.asarray(face_part)
    groups = {}
    for k, name in enumerate(part_names):
        nodes = np.unique(corners[parts == k])
        groups[name] = nodes[nodes >= 0]
    return named(groups, int(corners.max(initial=-1)) + 1)


def by_grid(position: ArrayLike, counts: Sequence[int] = (3, 2, 1)) -> NodeGroups:
    """Boxes of equal size, `counts` of them along x, y and z, named like `x1 y2` from the lowest coordinates.

    position (n, 3), m. Directions that are not cut are left out of the names, boxes without a node altogether.
    """
    if len(counts) != 3 or any(int(c) != c or c < 1 for c in counts):
        raise EvaluationError(f"grid of {tuple(counts)} boxes asked for: expected three whole numbers of at least 1")
    groups = _boxes(np.asarray(position, np.float64), counts)
    names = [" ".join(f"{AXES[k]}{box[k] + 1}" for k in range(3) if counts[k] > 1) or "all" for box, _ in groups]
    return NodeGroups(tuple(names), tuple(nodes for _, nodes in groups))


def _boxes(x: NDArray[np.float64], counts: Sequence[int]) -> list[tuple[tuple[int, ...], NDArray[np.int64]]]:
    low, size = x.min(axis=0), np.maximum(np.ptp(x, axis=0), 1e-300)
    # The highest node belongs to the last box, not to one behind it.
    box = np.minimum((x - low) / size * counts, np.array(counts) - 1).astype(int)
    found = ((b, np.flatnonzero((box == b).all(axis=1))) for b in product(*map(range, counts)))
    return [(b, nodes) for b, nodes in found if len(nodes)]


def named(sets: Mapping[str, ArrayLike], n_nodes: int) -> NodeGroups:
    """NodeGroups from node numbers by name; empty ones are left out.

    Raises
    ------
    EvaluationError
        For numbers that are no nodes of a mesh with `n_nodes` nodes.
    """
    names, nodes = [], []
    for name, numbers in sets.items():
        array = np.unique(np.asarray(numbers, np.int64))
        if array.size and (array[0] < 0 or array[-1] >= n_nodes):
            raise EvaluationError(
                f"node set {name!r} names nodes {array[0]} to {array[-1]}: expected 0 to {n_nodes - 1}, "
                "positions in the node dimension and not the solver's numbers"
            )
        if array.size:
            names.append(name)
            nodes.append(array)
    return NodeGroups(tuple(names), tuple(nodes))
