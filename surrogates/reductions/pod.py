"""Proper orthogonal decomposition of fields that come run by run, so that none of them is held twice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Rows of the tall matrices handled at once: bounds what stands in float64 beside the basis.
_BLOCK = 1 << 14


@dataclass(frozen=True)
class Pod:
    """Orthonormal modes (3 * node, mode) float32 and singular values (mode,), m, largest first."""

    modes: NDArray[np.float32]
    singular_values: NDArray[np.float64]

    def coefficients(self, run: NDArray[np.float32]) -> NDArray[np.float32]:
        """(state, node, 3) -> (state, mode)"""
        return run.reshape(len(run), -1) @ self.modes

    def first(self, count: int) -> Pod:
        """The first `count` modes."""
        return Pod(np.ascontiguousarray(self.modes[:, :count]), self.singular_values[:count])


def pod(runs: Iterable[NDArray[np.float32]], count: int) -> Pod:
    """The first `count` modes of all states of `runs`, each (state, node, 3); fewer where the states span less.

    What was seen so far is held as U S; with the next run X the pair [U S, X] is decomposed by the method of snapshots
    (its small Gram matrix) and cut off again behind 2 * count + 16 modes, so memory stays at one run and that many
    fields. Exact while nothing is cut off; else squared singular values lie below the exact ones by at most the sum of
    the largest squares cut off (Himpe, Leibner, Rave 2018, doi 10.1137/16M1085413).
    """
    keep = 2 * count + 16
    factor: NDArray[np.float32] | None = None
    for run in runs:
        new = np.ascontiguousarray(run, np.float32).reshape(len(run), -1).T
        old = factor if factor is not None else np.empty((len(new), 0), np.float32)
        gram = sum(pair.T @ pair for pair in _pairs(old, new))
        energy, vectors = np.linalg.eigh(gram)
        energy, vectors = energy[::-1], vectors[:, ::-1]
        kept = min(keep, max(1, int((energy > energy[0] * 1e-13).sum())))
        factor = np.concatenate([(pair @ vectors[:, :kept]).astype(np.float32) for pair in _pairs(old, new)])
    if factor is None:
        raise ValueError("no runs to decompose")
    factor = factor[:, :count]
    values = np.linalg.norm(factor.astype(np.float64), axis=0)
    good = values > 0
    if not good.any():  # nothing moves: one mode of zeros, so that everything projects to zero
        return Pod(np.zeros((len(factor), 1), np.float32), np.zeros(1))
    modes = factor[:, good] / values[good]
    sign = np.sign(modes[np.abs(modes).argmax(axis=0), np.arange(modes.shape[1])])  # the same sign on every machine
    return Pod((modes * sign).astype(np.float32), values[good])


def _pairs(old: NDArray[np.float32], new: NDArray[np.float32]) -> Iterator[NDArray[np.float64]]:
    for k in range(0, len(new), _BLOCK):
        yield np.hstack([old[k : k + _BLOCK].astype(np.float64), new[k : k + _BLOCK].astype(np.float64)])
