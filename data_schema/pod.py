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
_BLOCK = 1 << 13
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

    Some runs wait until they are worth the work of merging them, which goes over all that is kept. Memory: `keep`
    fields in float32, half as many that wait, and one run.

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
        self._defect = 0.0
        self._factor: NDArray[np.float32] | None = None  # (U S)^T, (keep, 3 * node), of which some rows are in use
        self._energy: NDArray[np.float64] = np.empty(0)  # squares of S
        self._waiting: list[NDArray[np.float32]] = []

    def add(self, run: NDArray[np.floating]) -> None:
        """One run (state, node, 3), m, finite.

        Raises
        ------
        ValueError
            For a run with other nodes than those before.
        """
        new = np.ascontiguousarray(run, np.float32).reshape(len(run), -1)
        before = self._waiting[0].shape[1] if self._waiting else new.shape[1]
        before = before if self._factor is None else self._factor.shape[1]
        if before != new.shape[1]:
            raise ValueError(
                f"a run of {new.shape[1] // 3} nodes follows runs of {before // 3}; expected the same nodes in all"
            )
        if len(new):
            self._waiting.append(new)
        if sum(map(len, self._waiting)) >= self.keep / 2:
            self._merge()

    def _merge(self) -> None:
        """Take what waits into what is kept."""
        if not self._waiting:
            return
        waiting, self._waiting = self._waiting, []
        length, count, known = waiting[0].shape[1], sum(map(len, waiting)), len(self._energy)
        factor = self._factor if self._factor is not None else np.empty((self.keep, length), np.float32)
        # What is kept is orthogonal, so only products with what is new have to be made.
        gram = np.zeros((known + count, known + count))
        for columns in _blocks(length):
            new = np.concatenate([run[:, columns] for run in waiting]).astype(np.float64)
            gram[known:, known:] += new @ new.T
            if known:
                gram[known:, :known] += new @ factor[:known, columns].astype(np.float64).T
        gram[:known, :known] = np.diag(self._energy)
        gram[:known, known:] = gram[known:, :known].T
        energy, vectors = np.linalg.eigh(gram)
        energy, vectors = energy[::-1].clip(0), vectors[:, ::-1]
        kept = min(self.keep, max(1, int((energy > energy[0] * _ROUNDING_SQUARED).sum())))
        self._defect += float(energy[kept]) if kept < len(energy) else 0.0
        turn, mix = vectors[:known, :kept].T, vectors[known:, :kept].T
        for columns in _blocks(length):  # in place, so that what is kept is in memory once
            new = np.concatenate([run[:, columns] for run in waiting]).astype(np.float64)
            out = mix @ new
            if known:
                out += turn @ factor[:known, columns].astype(np.float64)
            factor[:kept, columns] = out
        self._factor, self._energy = factor, energy[:kept]

    @property
    def defect(self) -> float:
        """m^2: how far each squared singular value lies below the exact one, at most."""
        self._merge()
        return self._defect

    def result(self) -> Pod:
        """The decomposition of everything added.

        Raises
        ------
        ValueError
            Where nothing was.
        """
        self._merge()
        if self._factor is None:
            raise ValueError("no runs to decompose; expected at least one")
        factor = self._factor[: min(self.count, len(self._energy))]
        squares = np.zeros(len(factor))
        for columns in _blocks(factor.shape[1]):
            squares += np.square(factor[:, columns], dtype=np.float64).sum(axis=1)
        values = np.sqrt(squares)
        good = (values > 0) & (values > values[0] * _ROUNDING)
        if not good.any():  # nothing moves: one mode of zeros, so that everything projects to zero
            return Pod(np.zeros((factor.shape[1], 1), np.float32), np.zeros(1), self._defect)
        largest = [int(np.abs(row).argmax()) for row in factor]
        sign = np.sign(factor[np.arange(len(factor)), largest])
        scaled = (sign / np.where(good, values, 1.0))[good]
        # In blocks: no further array is as large as all modes.
        modes = np.empty((factor.shape[1], len(scaled)), np.float32)
        for columns in _blocks(factor.shape[1]):
            modes[columns] = factor[good, columns].T * scaled
        return Pod(modes, values[good], self._defect)


def pod(runs: Iterable[NDArray[np.floating]], count: int, keep: int | None = None) -> Pod:
    """The first `count` modes of all states of `runs`, each (state, node, 3); see `StreamedPod`."""
    stream = StreamedPod(count, keep)
    for run in runs:
        stream.add(run)
        del run  # else it is there while the next one is read
    return stream.result()


def _blocks(length: int) -> Iterator[slice]:
    for first in range(0, length, _BLOCK):
        yield slice(first, first + _BLOCK)
