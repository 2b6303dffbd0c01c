"""Rigid-body motion apart from deformation, so that a good rigid motion cannot hide a bad crush.

Every state is fitted by the rotation R and the translation that bring the undeformed nodes x closest to their
present positions y in the sense of least squares (Kabsch 1976, Acta Crystallographica A32; by singular values and
with the sign of Umeyama 1991, so that R never mirrors):

    y_i = R (x_i - c) + c + T + R d_i

with c the centroid of x. What is left, d_i, is the deformation as somebody sees it who moves with the body. Nodes
that are gone (NaN) take no part in the fit of their state. Lengths are metres everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.passes import moments, parted

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RigidMotion:
    """The best-fitting rigid motion of each state; NaN where fewer than three nodes are left.

    Attributes
    ----------
    rotation
        (t, 3, 3) proper rotations R.
    translation
        (t, 3) T, m: how far the centroid of the undeformed nodes is carried.
    centre
        (3,) c, m.
    """

    rotation: Floats
    translation: Floats
    centre: Floats

    def displacement(self, position: ArrayLike) -> Floats:
        """Displacements (t, n, 3), m, of nodes at `position` (n, 3), m, if they only moved with the body."""
        arm = np.asarray(position, np.float64) - self.centre
        return np.asarray(np.einsum("tij,nj->tni", self.rotation, arm) + self.translation[:, None] - arm)

    def deformation(self, position: ArrayLike, displacement: ArrayLike) -> Floats:
        """What is left of `displacement` (t, n, 3), m, seen by somebody who moves with the body: d, (t, n, 3), m."""
        rest = np.asarray(displacement, np.float64) - self.displacement(position)
        return np.asarray(np.einsum("tji,tnj->tni", self.rotation, rest))

    @property
    def angle(self) -> Floats:
        """(t,) angle of rotation in degrees, 0 to 180."""
        return _angle(self.rotation)


def fit_rigid(position: ArrayLike, displacement: ArrayLike, nodes: ArrayLike | None = None) -> RigidMotion:
    """The rigid motion of `displacement` (t, n, 3), m, of nodes at `position` (n, 3), m.

    `nodes` are the numbers of those nodes that count (a seat, a cross member); all of them by default.

    Raises
    ------
    EvaluationError
        For arrays that do not fit or fewer than three nodes.
    """
    x, u = _checked(position, displacement)
    if nodes is not None and not _everything(np.asarray(nodes), len(x)):
        x, u = x[np.asarray(nodes)], u[:, np.asarray(nodes)]
    return _fitted(x, u, u)


def _everything(nodes: NDArray[np.integer], count: int) -> bool:
    """Whether `nodes` are all `count` nodes in their order."""
    return len(nodes) == count and np.array_equal(nodes, np.arange(count))


def _fitted(x: Floats, u: NDArray[np.floating], there: NDArray[np.floating]) -> RigidMotion:
    """The motion of the nodes that are finite in `u` and in `there`, both (t, n, 3)."""
    if len(x) < 3:
        raise EvaluationError(f"a rigid motion asked for of {len(x)} nodes: expected at least three")
    centre = x.mean(axis=0)
    count = np.zeros(len(u), np.int64)
    sums, products = np.zeros((len(u), 2, 3)), np.zeros((len(u), 3, 3))
    moments(x - centre, u, there, count, sums, products)
    rotation = np.full((len(u), 3, 3), np.nan)
    translation = np.full((len(u), 3), np.nan)
    for k in np.flatnonzero(count >= 3):
        middle, moved = sums[k] / count[k]
        rotation[k] = _rotation(products[k] - count[k] * np.outer(moved, middle))
        translation[k] = moved - rotation[k] @ middle
    return RigidMotion(rotation, translation, centre)


def _rotation(products: Floats) -> Floats:
    """The proper rotation R (3, 3) with the least sum of squares of y - R x, from the sum of y x^T about the centroids."""
    left, _, right = np.linalg.svd(products)
    sign = np.array([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)])
    return np.asarray((left * np.sign(sign)) @ right)


@dataclass(frozen=True)
class SplitError:
    """Errors of a prediction by kind, one value a state (t,); all but `rotation` in m.

    Attributes
    ----------
    translation
        Distance between the predicted and the true translation of the body.
    rotation
        Angle between the predicted and the true rotation, degrees.
    rigid
        Mean over nodes of the distance between predicted and true rigid displacement.
    deformation
        Mean over nodes of the distance between predicted and true deformation: the crush alone.
    total
        Mean node error; not the sum of the two, since they may point in opposite directions.
    true_rigid, true_deformation
        Mean sizes of what is predicted.
    """

    translation: Floats
    rotation: Floats
    rigid: Floats
    deformation: Floats
    total: Floats
    true_rigid: Floats
    true_deformation: Floats


def split_error(
    position: ArrayLike, truth: ArrayLike, prediction: ArrayLike, nodes: ArrayLike | None = None
) -> SplitError:
    """Errors of `prediction` against `truth` (t, n, 3), m, in rigid motion and in deformation.

    Nodes that are gone in `truth` (NaN) are left out on both sides.

    Parameters
    ----------
    position
        (n, 3) undeformed, m.
    nodes
        The nodes whose motion is the body's; all by default.

    Raises
    ------
    EvaluationError
        Where arrays do not fit or the prediction is not finite at a node that is there.
    """
    x, u = _checked(position, truth)
    _, p = _checked(position, prediction)
    if u.shape != p.shape:
        raise EvaluationError(f"truth has shape {u.shape} and the prediction {p.shape}: expected the same (t, n, 3)")
    if nodes is None or _everything(np.asarray(nodes), len(x)):
        true, predicted = _fitted(x, u, u), _fitted(x, p, u)
    else:
        some = np.asarray(nodes)
        true, predicted = _fitted(x[some], u[:, some], u[:, some]), _fitted(x[some], p[:, some], u[:, some])
    return split_by_motions(x, u, p, true, predicted)


def fit_both(
    position: ArrayLike, truth: ArrayLike, prediction: ArrayLike, true: RigidMotion | None = None
) -> tuple[RigidMotion, RigidMotion]:
    """The rigid motions of `truth` and of `prediction` (t, n, 3), m, over the nodes that are there in the truth.

    Parameters
    ----------
    true
        That of the truth, where it is known.
    """
    x, u = _checked(position, truth)
    return true or _fitted(x, u, u), _fitted(x, np.asarray(prediction), u)


def split_by_motions(
    position: ArrayLike, truth: ArrayLike, prediction: ArrayLike, true: RigidMotion, predicted: RigidMotion
) -> SplitError:
    """`split_error` by rigid motions that are known, both about the same centre.

    Raises
    ------
    EvaluationError
        Where the prediction is not finite at a node that is there.
    """
    x, u = _checked(position, truth)
    p = np.asarray(prediction)
    count, sums = np.zeros(len(u), np.int64), np.zeros((len(u), 5))
    parted(
        x - true.centre, u, p, true.rotation, true.translation, predicted.rotation, predicted.translation, count, sums
    )
    if not np.isfinite(sums[:, 2]).all():
        bad = np.isfinite(u).all(axis=-1) & ~np.isfinite(p).all(axis=-1)
        state, node = np.argwhere(bad)[0]
        raise EvaluationError(f"the prediction is not finite in state {state} at node {node}: expected numbers there")
    mean = np.divide(sums, count[:, None], out=np.full_like(sums, np.nan), where=count[:, None] > 0)
    rigid, deformation, total, true_rigid, true_deformation = mean.T
    return SplitError(
        translation=np.linalg.norm(predicted.translation - true.translation, axis=-1),
        rotation=_angle(np.einsum("tij,tkj->tik", predicted.rotation, true.rotation)),
        rigid=rigid,
        deformation=deformation,
        total=total,
        true_rigid=true_rigid,
        true_deformation=true_deformation,
    )


def _angle(rotation: Floats) -> Floats:
    """Degrees; by the arc tangent of sine and cosine, which is exact for small angles too."""
    twice_sine = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=-1,
    )
    twice_cosine = np.trace(rotation, axis1=1, axis2=2) - 1
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(twice_sine, axis=-1), twice_cosine)))


def _checked(position: ArrayLike, displacement: ArrayLike) -> tuple[Floats, NDArray[np.floating]]:
    x, u = np.asarray(position, np.float64), np.asarray(displacement)
    if x.ndim != 2 or x.shape[1] != 3 or u.ndim != 3 or u.shape[1:] != x.shape:
        raise EvaluationError(
            f"positions have shape {x.shape} and displacements {u.shape}: expected (n, 3) and (t, n, 3) on one mesh"
        )
    return x, u
