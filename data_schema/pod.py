"""Proper orthogonal decomposition of fields that come run by run: the one of the project.

Runs come one at a time. What was seen so far is held as a truncated factor U S; with the next run X the pair
[U S, X] is decomposed through its small Gram matrix (method of snapshots) and truncated again. The truncation only ever
takes away, so every squared singular value is at most `Pod.defect` below its exact value, and never above it: an
incremental form of the hierarchical approximate POD (Himpe, Leibner, Rave 2018, doi 10.1137/16M1085413).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Rows of the tall matrices handled at once: bounds what stands in float64 beside the basis.
_BLOCK = 1 << 14
# Below these shares of the largest, squared and singular values hold rounding only: states are in single precision.
_ROUNDING_SQUARED, _ROUNDING = 1e-13, 1e-6


@dataclass(frozen=True)
class Pod:
    """Orthonormal modes of a set of states; where nothing moves, one mode of zeros.

    Attributes
    ----------
    modes
        (3 * node, mode) float32; the largest entry of each is positive, on every machine.
    singular_values
        (mode,), m, largest first.
    defect
        m^2: how far each squared singular value lies below the exact one, at most.
    """

    modes: NDArray[np.float32]
    singular_values: NDArray[np.float64]
    defect: float = 0.0

    @property
    def normalised(self) -> NDArray[np.float64]:
        """Singular values divided by the first."""
        return np.asarray(self.singular_values / self.singular_values[0])

    def coefficients(self, run: NDArray[np.float32]) -> NDArray[np.float32]:
        """(state, node, 3) -> (state, mode)"""
        return run.reshape(len(run), -1) @ self.modes

    def first(self, count: int) -> Pod:
        """The first `count` modes."""
        return Pod(np.ascontiguousarray(self.modes[:, :count]), self.singular_values[:count], self.defect)


class StreamedPod:
    """Feed runs with `add`, then ask for the `result`.

    Memory: `keep` fields in float32 and one run.

    Parameters
    ----------
    count
        How many modes are wanted; fewer come where the states span less.
    keep
        How many are carried along, so that what is cut off early can hardly have grown into the first `count`;
        default 2 * count + 16.

    Raises
    ------
    ValueError
        For fewer than one mode.
    """

    def __init__(self, count: int = 50, keep: int | None = None) -> None:
        if count < 1:
            raise ValueError(f"{count} modes were asked for; expected at least 1")
        self.count = count
        self.keep = max(count, 2 * count + 16 if keep is None else keep)
        self.defect = 0.0
        self._factor: NDArray[np.float32] | None = None  # U S, (3 * node, <= keep)

    def add(self, run: NDArray[np.floating]) -> None:
        """One run (state, node, 3), m, finite.

        Raises
        ------
        ValueError
            For a run with other nodes than those before.
        """
        new = np.ascontiguousarray(run, np.float32).reshape(len(run), -1).T
        old = self._factor if self._factor is not None else np.empty((len(new), 0), np.float32)
        if len(old) != len(new):
            raise ValueError(
                f"a run of {len(new) // 3} nodes follows runs of {len(old) // 3}; expected the same nodes in all"
            )
        gram = sum(pair.T @ pair for pair in _pairs(old, new))
        energy, vectors = np.linalg.eigh(gram)
        energy, vectors = energy[::-1].clip(0), vectors[:, ::-1]
        kept = min(self.keep, max(1, int((energy > energy[0] * _ROUNDING_SQUARED).sum())))
        self.defect += float(energy[kept]) if kept < len(energy) else 0.0
        self._factor = np.concatenate([(pair @ vectors[:, :kept]).astype(np.float32) for pair in _pairs(old, new)])

    def result(self) -> Pod:
        """The decomposition of everything added.

        Raises
        ------
        ValueError
            Where nothing was.
        """
        if self._factor is None:
            raise ValueError("no runs to decompose; expected at least one")
        factor = self._factor[:, : self.count]
        values = np.sqrt(np.square(factor, dtype=np.float64).sum(axis=0))
        good = (values > 0) & (values > values[0] * _ROUNDING)
        if not good.any():  # nothing moves: one mode of zeros, so that everything projects to zero
            return Pod(np.zeros((len(factor), 1), np.float32), np.zeros(1), self.defect)
        modes = factor[:, good] / values[good]
        sign = np.sign(modes[np.abs(modes).argmax(axis=0), np.arange(modes.shape[1])])
        return Pod((modes * sign).astype(np.float32), values[good], self.defect)


def pod(runs: Iterable[NDArray[np.floating]], count: int) -> Pod:
    """The first `count` modes of all states of `runs`, each (state, node, 3); see `StreamedPod`."""
    stream = StreamedPod(count)
    for run in runs:
        stream.add(run)
    return stream.result()


def _pairs(old: NDArray[np.float32], new: NDArray[np.float32]) -> Iterator[NDArray[np.float64]]:
    for k in range(0, len(new), _BLOCK):
        yield np.hstack([old[k : k + _BLOCK].astype(np.float64), new[k : k + _BLOCK].astype(np.float64)])
