"""Predicted runs as formulas ask for them (`evaluation.measures.formula.Runs`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.measures.formula import Value

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate

Floats = NDArray[np.float64]
# Adds an error to displacements on some nodes: (nodes,) -> (run, state, node, 3), m.
Error = Callable[[NDArray[np.int64]], NDArray[np.floating]]


class Structure:
    """The mesh that a model knows: nodes of each part, and numbers of nodes."""

    def __init__(self, surrogate: Surrogate) -> None:
        self.surrogate = surrogate

    @property
    def size(self) -> int:
        """Nodes of the full mesh."""
        return self.surrogate.graphs.n_nodes(0)

    @cached_property
    def parts(self) -> Mapping[str, NDArray[np.int64]]:
        """Nodes of each part by its name; none where the model was stored without."""
        from evaluation.measures.regions import by_part

        labels, faces = self.surrogate.labels, self.surrogate.faces
        if labels is None or faces is None:
            return {}
        groups = by_part(faces, labels.face_part, labels.part_name)
        return dict(zip(groups.names, groups.nodes, strict=True))

    def nodes(self, number: int) -> NDArray[np.int64]:
        """The place of the solver's node `number`; empty where there is none."""
        labels = self.surrogate.labels
        numbers = np.arange(1, self.size + 1) if labels is None else labels.node_id
        return np.asarray(np.flatnonzero(numbers == number))


class PredictedRuns:
    """Runs of a model at parameters (run, parameter), in its units.

    Parameters
    ----------
    states
        (run, state, node, 3), m, where they are predicted already.
    error
        What is added to the displacements.
    """

    def __init__(
        self,
        structure: Structure,
        parameters: Floats,
        time: Floats,
        level: int,
        states: NDArray[np.floating] | None = None,
        error: Error | None = None,
    ) -> None:
        self._structure, self._surrogate = structure, structure.surrogate
        self._parameters, self._time, self._level = parameters, time, level
        self._states, self._error = states, error
        self._known: dict[bytes, NDArray[np.floating]] = {}

    def with_error(self, error: Error) -> PredictedRuns:
        """The same runs, as they would be if the model were wrong by `error`; predictions are shared."""
        out = PredictedRuns(self._structure, self._parameters, self._time, self._level, self._states, error)
        out._known = self._known
        return out

    @property
    def parts(self) -> Mapping[str, NDArray[np.int64]]:
        return self._structure.parts

    def nodes(self, number: int) -> NDArray[np.int64]:
        return self._structure.nodes(number)

    def position(self, nodes: NDArray[np.int64] | None) -> Floats:
        from crashkit.errors import DataError

        if self._surrogate.points is None:
            raise DataError("the model was stored without its mesh; train it again from a dataset")
        return self._surrogate.points if nodes is None else self._surrogate.points[nodes]

    def displacement(self, nodes: NDArray[np.int64] | None) -> tuple[Floats, NDArray[np.floating]]:
        chosen = np.arange(self._structure.size) if nodes is None else nodes
        if self._states is not None:
            found = self._states if nodes is None else self._states[:, :, nodes]
        else:
            key = chosen.tobytes()
            if key not in self._known:
                self._known[key] = self._surrogate.predict_nodes(self._parameters, chosen, self._time, self._level)
            found = self._known[key]
        return self._time, found if self._error is None else found + self._error(chosen)

    def named(self, name: str) -> Value | None:
        ranges = self._surrogate.record.ranges
        if name in ranges.names:
            k = ranges.names.index(name)
            return Value(self._parameters[:, k], (), None, ranges.units[k])
        return None

    @property
    def names(self) -> Sequence[str]:
        return self._surrogate.record.ranges.names
