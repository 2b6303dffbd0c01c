"""Where errors are: parts, regions of the structure, and the worst run, node and time.

A set of node groups is a `NodeGroups`: parts, boxes of a grid, thirds along the driving direction, or named sets of
nodes. Errors are distances (state, node) in metres as `evaluation.measures.distance.node_distance` gives them, NaN where a
node is gone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.distance import masked_mean, mean_node_error, peak_error

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


def by_thirds(position: ArrayLike, axis: int = 0, names: Sequence[str] = ("rear", "middle", "front")) -> NodeGroups:
    """Slices of equal length along `axis` (0 x, 1 y, 2 z), named from the lowest coordinate to the highest.

    position (n, 3), m. A structure that drives towards -x is cut with names ("front", "middle", "rear"). As many
    slices as names. Slices without a node are left out.
    """
    cuts = [1, 1, 1]
    cuts[axis] = len(names)
    groups = _boxes(np.asarray(position, np.float64), cuts)
    return NodeGroups(tuple(names[box[axis]] for box, _ in groups), tuple(nodes for _, nodes in groups))


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


@dataclass(frozen=True)
class GroupError:
    """The error of one run in one group of nodes; lengths in m, NaN where every node is gone throughout.

    Attributes
    ----------
    mean
        Over time of the mean over the group's nodes, as in the paper's measure.
    last
        Mean over the nodes in the last state.
    largest
        The largest node error, in `state` at `node`.
    size
        Mean over time of the mean true displacement, if that was given: what to hold the mean against.
    """

    name: str
    nodes: int
    mean: float
    last: float
    largest: float
    state: int
    node: int
    size: float = float("nan")

    @property
    def relative(self) -> float:
        """Mean error over mean displacement of the group."""
        return self.mean / self.size if self.size > 0 else float("nan")


def error_by_group(
    distance: NDArray[np.floating], groups: NodeGroups, size: NDArray[np.floating] | None = None
) -> list[GroupError]:
    """The error in each group, from node errors `distance` (t, n), m, and true node displacements `size` (t, n), m."""
    out = []
    for name, nodes in zip(groups.names, groups.nodes, strict=True):
        inside = np.asarray(distance[:, nodes], np.float64)
        over_time = mean_node_error(inside)
        if np.isnan(inside).all():
            out.append(GroupError(name, len(nodes), *(float("nan"),) * 3, state=-1, node=-1))
            continue
        peak = peak_error(inside)
        moved = float("nan")
        if size is not None:
            there = np.where(np.isnan(inside), np.nan, size[:, nodes])
            moved = float(masked_mean(mean_node_error(there)))
        mean = float(masked_mean(over_time))
        worst = int(nodes[peak.node])
        out.append(GroupError(name, len(nodes), mean, float(over_time[-1]), peak.value, peak.state, worst, moved))
    return out


@dataclass(frozen=True)
class Worst:
    """The largest node error of several runs: `value` (m) in run number `run`, in `state`, at `node`."""

    value: float
    run: int
    state: int
    node: int


def worst_of(distances: Iterable[NDArray[np.floating]]) -> Worst:
    """Worst run, state and node of node errors (t, n), m, one array a run; only one is looked at a time.

    Raises
    ------
    EvaluationError
        Where there is no run, or no node left in any.
    """
    worst = None
    for run, distance in enumerate(distances):
        if np.isnan(distance).all():
            continue
        peak = peak_error(np.asarray(distance, np.float64))
        if worst is None or peak.value > worst.value:
            worst = Worst(peak.value, run, peak.state, peak.node)
    if worst is None:
        raise EvaluationError("no run with a living node: expected at least one error to find the worst of")
    return worst


def living_nodes(faces: ArrayLike, alive: ArrayLike, n_nodes: int) -> NDArray[np.bool_]:
    """(t, n) False from where on every face of a node has eroded; nodes without faces stay.

    faces (m, 3 or 4), -1 in the last corner of a triangle; alive (t, m) bool.
    """
    corners, life = np.asarray(faces), np.asarray(alive, bool)
    if life.ndim != 2 or life.shape[1] != len(corners):
        raise EvaluationError(f"alive has shape {life.shape}: expected (state, {len(corners)} faces)")
    bare = np.ones(n_nodes, bool)
    bare[corners[corners >= 0]] = False
    living = np.repeat(bare[None], len(life), axis=0)
    for state, faces_left in enumerate(life):
        left = corners[faces_left]
        living[state, left[left >= 0]] = True
    return living


def masked(field: NDArray[np.floating], faces: ArrayLike, alive: ArrayLike) -> NDArray[np.floating]:
    """`field` (t, n, ...) with NaN where no face of the node is left, for data whose source kept moving dead nodes."""
    living = living_nodes(faces, alive, field.shape[1])
    return np.where(living.reshape(living.shape + (1,) * (field.ndim - 2)), field, np.nan)
