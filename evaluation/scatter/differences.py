"""Where and when runs begin to differ: principal components of differences, by part and time.

Two runs whose parameters differ a little stay close, until something happens: a fold goes the other way, a contact is
missed. Afterwards everything behind it differs, too. So it is not where scatter is largest, but where scatter appears that
no earlier scatter explains. At each time the differences of a part from its mean over all draws are projected on the
principal components of all parts a little earlier; what is left is new (after the difference PCA of Thole,
Nikitina, Nikitin, Clees 2010, Advanced mode analysis for crash simulation results, LS-DYNA Forum).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Of the largest scatter of any part: from there on runs differ.
BEGIN = 0.05
# How far back scatter is compared, of all states; the energy that earlier components keep, and how many at most.
_BACK, _KEPT, _MOST = 0.1, 0.999, 24


@dataclass(frozen=True)
class Differences:
    """Scatter by part and time.

    Attributes
    ----------
    names
        Of the parts.
    time
        (state,) s.
    scatter
        (part, state) m: root of the mean squared distance from the mean over all draws.
    new
        (part, state) m: what no scatter a little earlier explains.
    begin
        (part,) s: when the scatter of a part exceeds BEGIN of the largest; NaN where it never does.
    share
        (part,): of the scatter at the end, what the first component holds: near 1 all draws differ in one way.
    """

    names: tuple[str, ...]
    time: Floats
    scatter: Floats
    new: Floats
    begin: Floats
    share: Floats

    @property
    def source(self) -> tuple[int, int]:
        """Part and state where most new scatter appears."""
        part, state = np.unravel_index(int(np.argmax(self.new)), self.new.shape)
        return int(part), int(state)


def differences(
    names: Sequence[str], time: Floats, states: NDArray[np.floating], groups: Sequence[NDArray[np.int64]]
) -> Differences:
    """Scatter of displacements `states` (draw, state, some nodes, 3), m; `groups`: places of each part's nodes among them."""
    away = np.asarray(states, np.float64) - np.mean(states, axis=0, dtype=np.float64)
    draws, count = away.shape[:2]
    back = max(1, round(_BACK * count))
    scatter, new = np.zeros((len(groups), count)), np.zeros((len(groups), count))
    for state in range(count):
        before = _components(away[:, max(0, state - back)].reshape(draws, -1))
        for part, nodes in enumerate(groups):
            mine = away[:, state][:, nodes].reshape(draws, -1)
            left = mine - before @ (before.T @ mine)
            scatter[part, state], new[part, state] = (
                np.sqrt(np.square(m).sum() / (draws * len(nodes))) for m in (mine, left)
            )
    largest = float(scatter.max(initial=0.0))
    differ = scatter > BEGIN * largest
    begin = np.where(differ.any(axis=1) & (largest > 0), time[np.argmax(differ, axis=1)], np.nan)
    share = np.array([_first_share(away[:, -1][:, nodes].reshape(draws, -1)) for nodes in groups])
    return Differences(tuple(names), np.asarray(time, np.float64), scatter, new, begin, share)


def _components(away: Floats) -> Floats:
    """(draw, component): orthonormal scores of the leading principal components; none where nothing differs."""
    left, size, _ = np.linalg.svd(away, full_matrices=False)
    energy = np.cumsum(size**2)
    if energy[-1] <= 1e-24 * away.size:
        return np.zeros((len(away), 0))
    keep = int(np.searchsorted(energy, _KEPT * energy[-1])) + 1
    return np.asarray(left[:, : min(keep, _MOST, max(1, len(away) // 4))])


def _first_share(away: Floats) -> float:
    size = np.linalg.svd(away, compute_uv=False) ** 2
    return float(size[0] / size.sum()) if size.sum() > 0 else 0.0
