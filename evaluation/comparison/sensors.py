"""Where histories are taken and what is watched for intrusion: chosen by the user, or by stated rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.reference import Reference
from evaluation.errors import EvaluationError
from evaluation.measures.probes import intrusion
from evaluation.measures.rigid import RigidMotion, fit_both, fit_rigid, split_by_motions

AXES = {"x": 0, "y": 1, "z": 2}
N_PROBES = 4


@dataclass(frozen=True)
class Sensors:
    """probes (probe,) and intruding (k,) node numbers; direction (3,) unit vector; watching (w,) or None (ground).

    `about` says how the intrusion was defined.
    """

    probes: NDArray[np.int64]
    intruding: NDArray[np.int64]
    direction: NDArray[np.float64]
    watching: NDArray[np.int64] | None
    about: str


@dataclass(frozen=True)
class Watched:
    """What the sensors saw of one field; NaN where nodes are gone.

    Attributes
    ----------
    probes
        (state, probe, 3) m, displacement.
    intrusion
        (state,) m, of the node furthest in.
    parts
        (state, part) m, of the node of each part that is furthest in, along the same direction and seen by the same observer.
    """

    probes: NDArray[np.float64]
    intrusion: NDArray[np.float64]
    parts: NDArray[np.float64]


@dataclass(frozen=True)
class Parted:
    """Errors (state,), m, of rigid motion and of deformation, and the true sizes of both (see evaluation.measures.rigid)."""

    rigid: NDArray[np.float64]
    deformation: NDArray[np.float64]
    true_rigid: NDArray[np.float64]
    true_deformation: NDArray[np.float64]


Piece = TypeVar("Piece", Watched, Parted)


def choose_sensors(
    reference: Reference, probes: Sequence[int] | None = None, intrusion: tuple[str, str] | None = None
) -> Sensors:
    """Sensors on the structure.

    Parameters
    ----------
    probes
        The solver's node numbers; by default four nodes: the one nearest to the middle, then always the one
        furthest from those chosen.
    intrusion
        Name of a part and a direction (x, -x, y, -y, z, -z), seen from the nodes of all other parts; by default any
        node of the structure, against the direction in which the structure moves in the first run, seen from the
        structure's own rigid motion.

    Raises
    ------
    EvaluationError
        For node numbers and parts that do not exist.
    """
    chosen = _spread(reference.position) if probes is None else _numbers(reference, probes)
    everything = np.arange(reference.n_nodes)
    if intrusion is not None:
        part, along = intrusion
        inside = _part(reference, part)
        outside = np.setdiff1d(everything, inside)
        if len(outside) < 3:
            raise EvaluationError(
                f"part {part!r} is all there is, so nothing is left to watch it from; name another part"
            )
        about = f"nodes of {part} along {along}, as seen from the rigid motion of all other nodes"
        return Sensors(chosen, inside, _direction(along), outside, about)
    moved = reference.displacement(0)
    mean = np.nanmean(moved[-1].astype(np.float64), axis=0)
    axis = int(np.argmax(np.abs(mean)))
    direction = np.zeros(3)
    direction[axis] = -np.sign(mean[axis]) or -1.0
    along = f"{'-' if direction[axis] < 0 else '+'}{'xyz'[axis]}"
    if _on_a_line(reference.position):  # beams in a row: their rotation about the line cannot be seen
        about = f"any node along {along}, against the motion, as seen from the ground, since all nodes lie on one line"
        return Sensors(chosen, everything, direction, None, about)
    about = f"any node along {along}, against the motion, as seen from the rigid motion of the whole structure"
    return Sensors(chosen, everything, direction, everything, about)


def watch(
    reference: Reference, sensors: Sensors, run: int, field: NDArray[np.floating], motion: RigidMotion | None = None
) -> Watched:
    """What `sensors` see of `field` (state, node, 3), m, some states of run number `run`.

    Parameters
    ----------
    motion
        The rigid motion of all nodes of `field`, where it is known.
    """
    intruding = sensors.intruding
    parts = np.full((len(field), len(reference.part_names)), np.nan)
    if np.isfinite(field[:, intruding[0]]).any() or np.isfinite(field[:, intruding]).any():
        position = reference.position_of(run)
        whole = sensors.watching is not None and len(sensors.watching) == reference.n_nodes
        known = motion if whole else None
        seen = intrusion(position, field, intruding, sensors.direction, sensors.watching, known).history
        if known is None and sensors.watching is not None:
            known = fit_rigid(position, field, sensors.watching)
        for k, nodes in enumerate(reference.part_nodes() if len(reference.part_names) > 1 else ()):
            if len(nodes) and np.isfinite(field[:, nodes]).any():
                of_part = intrusion(position, field, nodes, sensors.direction, sensors.watching, known)
                parts[:, k] = of_part.history
    else:
        seen = np.full(len(field), np.nan)
    return Watched(field[:, sensors.probes].astype(np.float64), seen, parts)


def largest_of_parts(parts: NDArray[np.float64]) -> NDArray[np.float64]:
    """(part,) the largest intrusion of (state, part); NaN where a part is gone throughout."""
    largest = np.where(np.isfinite(parts), parts, -np.inf).max(axis=0)
    return np.where(np.isfinite(largest), largest, np.nan)


def part_error(
    reference: Reference,
    run: int,
    truth: NDArray[np.floating],
    prediction: NDArray[np.floating],
    motions: tuple[RigidMotion, RigidMotion] | None = None,
) -> Parted:
    """Errors of `prediction` (state, node, 3) by kind, for some states of run number `run`.

    Parameters
    ----------
    motions
        The rigid motions of truth and prediction over the nodes that are there, where they are known.
    """
    position = reference.position_of(run)
    true, predicted = motions or fit_both(position, truth, prediction)
    split = split_by_motions(position, truth, prediction, true, predicted)
    return Parted(split.rigid, split.deformation, split.true_rigid, split.true_deformation)


def joined(pieces: Sequence[Piece]) -> Piece:
    """Pieces of a run, one behind the other."""
    kind = type(pieces[0])
    return kind(*(np.concatenate([getattr(piece, f.name) for piece in pieces]) for f in fields(kind)))


def _on_a_line(position: NDArray[np.float64]) -> bool:
    """Whether nodes (node, 3), m, are too few or too much in line to show a rotation."""
    return len(position) < 3 or int(np.linalg.matrix_rank(position - position.mean(axis=0), tol=1e-9)) < 2


def _spread(position: NDArray[np.float64]) -> NDArray[np.int64]:
    """Greedy farthest points, starting nearest to the middle."""
    chosen = [int(np.argmin(np.linalg.norm(position - position.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(position - position[chosen[0]], axis=1)
    while len(chosen) < min(N_PROBES, len(position)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(position - position[chosen[-1]], axis=1))
    return np.array(chosen)


def _numbers(reference: Reference, probes: Sequence[int]) -> NDArray[np.int64]:
    where = {int(n): k for k, n in enumerate(reference.node_id)}
    for probe in probes:
        if int(probe) not in where:
            raise EvaluationError(
                f"probe at node {probe}: the dataset has no such node; expected the solver's node numbers, "
                f"{reference.node_id.min()} to {reference.node_id.max()}"
            )
    return np.array([where[int(n)] for n in probes], dtype=np.int64)


def _part(reference: Reference, name: str) -> NDArray[np.int64]:
    if name not in reference.part_names:
        raise EvaluationError(f"part {name!r} does not exist; the dataset has {', '.join(reference.part_names)}")
    nodes = reference.part_nodes()[reference.part_names.index(name)]
    if not nodes.size:
        raise EvaluationError(f"part {name!r} has no node; name another part")
    return nodes


def _direction(text: str) -> NDArray[np.float64]:
    sign, axis = (-1.0, text[1:]) if text.startswith("-") else (1.0, text.removeprefix("+"))
    if axis not in AXES:
        raise EvaluationError(f"direction {text!r} not understood; expected x, y or z, with - for the other way")
    out = np.zeros(3)
    out[AXES[axis]] = sign
    return out
