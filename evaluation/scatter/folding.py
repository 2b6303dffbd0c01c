"""Folding modes: whether draws fall into groups that end in different shapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.measures.rigid import fit_rigid

Floats = NDArray[np.float64]

# Most groups that are tried, share of the smallest, draws that are judged, components.
_GROUPS, _SMALLEST, _JUDGED, _COMPONENTS = 6, 0.02, 2000, 8
# Groups are tighter than what a linear answer to the same draws gives by this much, or there is one.
_MARGIN = 0.08
_ENERGY = 0.98


@dataclass(frozen=True)
class FoldingModes:
    """Groups of draws by their shape at the end.

    Attributes
    ----------
    group
        (draw,): 0 the largest.
    scores
        (draw, component) m per node: principal components of the deformation at the end.
    typical
        (group,): the draw in the middle of each.
    tightness
        Silhouette by number of groups from 2 on, and `linear`: that of a linear answer to the same draws.
    """

    group: NDArray[np.int64]
    scores: Floats
    typical: NDArray[np.int64]
    tightness: Floats
    linear: Floats

    @property
    def count(self) -> int:
        return len(self.typical)


def folding_modes(position: Floats, ends: NDArray[np.floating], parameters: Floats, seed: int = 0) -> FoldingModes:
    """Groups of displacements at the end `ends` (draw, some nodes, 3), m, without rigid motion.

    k-means on principal components (scikit-learn) for two to six groups. Any cloud can be cut in two; groups count where
    their silhouette is clearly above that of a linear answer to the same draws, which has no modes of folding.

    Parameters
    ----------
    position
        (some nodes, 3) undeformed, m.
    parameters
        (draw, parameter) that made them.
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    shape = fit_rigid(position, ends).deformation(position, ends).reshape(len(ends), -1)
    most = min(_COMPONENTS, *shape.shape)
    pca = PCA(most, random_state=seed).fit(shape)
    energy = np.cumsum(pca.explained_variance_ratio_) if pca.explained_variance_.sum() > 1e-24 else np.ones(most)
    keep = int(np.searchsorted(energy, _ENERGY * energy[-1])) + 1
    scores = pca.transform(shape)[:, :keep] / np.sqrt(len(position))
    x = (parameters - parameters.mean(axis=0)) / np.maximum(parameters.std(axis=0), 1e-300)
    basis = np.column_stack([np.ones(len(x)), x])
    plain = basis @ np.linalg.lstsq(basis, scores, rcond=None)[0]
    one = np.zeros(len(ends), np.int64)
    tight: list[float] = []
    linear: list[float] = []
    found = [one]
    if np.ptp(scores, axis=0).max(initial=0.0) > 1e-9 and len(ends) >= 20:
        for count in range(2, min(_GROUPS, len(ends) // 10) + 1):
            labels = KMeans(count, n_init=4, random_state=seed).fit_predict(scores)
            small = np.bincount(labels, minlength=count).min() < _SMALLEST * len(ends)
            tight.append(-1.0 if small else _tightness(scores, labels, seed))
            other = KMeans(count, n_init=4, random_state=seed).fit_predict(plain)
            linear.append(_tightness(plain, other, seed))
            found.append(labels)
    gain = np.array(tight) - np.maximum(np.array(linear), 0.25) - _MARGIN
    best = found[int(np.argmax(gain)) + 1] if len(gain) and gain.max() > 0 else one
    order = np.argsort(-np.bincount(best), kind="stable")
    group = np.argsort(order)[best]
    typical = []
    for k in range(len(order)):
        mine = np.flatnonzero(group == k)
        middle = scores[mine].mean(axis=0)
        typical.append(int(mine[np.argmin(np.square(scores[mine] - middle).sum(axis=1))]))
    return FoldingModes(group, scores, np.array(typical), np.array(tight), np.array(linear))


def _tightness(scores: Floats, labels: NDArray[np.int64], seed: int) -> float:
    from sklearn.metrics import silhouette_score

    if len(np.unique(labels)) < 2:
        return -1.0
    some = np.random.default_rng(seed).permutation(len(scores))[:_JUDGED]
    if len(np.unique(labels[some])) < 2:
        return -1.0
    return float(silhouette_score(scores[some], labels[some]))
