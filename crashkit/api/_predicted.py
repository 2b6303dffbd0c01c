"""Runs as formulas ask for them (`evaluation.measures.formula.FormulaRuns`): predicted by a model, or given as arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evaluation.measures.formula import Value

if TYPE_CHECKING:
    from surrogates.data.campaign import Campaign, Labels
    from surrogates.surrogate import Surrogate

Floats = NDArray[np.float64]
# Adds an error to displacements on some nodes: (nodes,) -> (run, state, node, 3), m.
Error = Callable[[NDArray[np.int64]], NDArray[np.floating]]


@dataclass(frozen=True)
class FormulaMesh:
    """The mesh and the parameters that formulas may speak of.

    Attributes
    ----------
    size
        Nodes of the full mesh.
    labels, points, faces
        What is known of it.
    names, units
        Of the parameters.
    """

    size: int
    labels: Labels | None
    points: Floats | None
    faces: NDArray[np.int32] | None
    names: tuple[str, ...]
    units: tuple[str, ...]

    @classmethod
    def of(cls, surrogate: Surrogate) -> FormulaMesh:
        """Of a model."""
        ranges = surrogate.record.ranges
        size = surrogate.graphs.n_nodes(0)
        return cls(size, surrogate.labels, surrogate.points, surrogate.faces, ranges.names, ranges.units)

    @classmethod
    def of_campaign(cls, campaign: Campaign) -> FormulaMesh:
        """Of the runs a model is trained on."""
        names, units = campaign.parameter_names, campaign.parameter_units
        return cls(campaign.n_nodes, campaign.labels, campaign.points, campaign.faces, names, units)

    @cached_property
    def parts(self) -> Mapping[str, NDArray[np.int64]]:
        """Nodes of each part by its name; none where the model was stored without."""
        from evaluation.measures.regions import by_part

        if self.labels is None or self.faces is None:
            return {}
        groups = by_part(self.faces, self.labels.face_part, self.labels.part_name)
        return dict(zip(groups.names, groups.nodes, strict=True))

    def nodes(self, number: int) -> NDArray[np.int64]:
        """The place of the solver's node `number`; empty where there is none."""
        numbers = np.arange(1, self.size + 1) if self.labels is None else self.labels.node_id
        return np.asarray(np.flatnonzero(numbers == number))


class GivenRuns:
    """Runs that are there: parameters (run, parameter), displacements (run, state, node, 3), m, and histories by channel."""

    def __init__(
        self,
        structure: FormulaMesh,
        parameters: Floats,
        time: Floats,
        states: NDArray[np.floating] | None = None,
        curves: Mapping[str, Value] | None = None,
    ) -> None:
        self.structure, self.parameters, self.time = structure, parameters, time
        self.states, self.curves = states, dict(curves or {})

    @property
    def parts(self) -> Mapping[str, NDArray[np.int64]]:
        return self.structure.parts

    def nodes(self, number: int) -> NDArray[np.int64]:
        return self.structure.nodes(number)

    def position(self, nodes: NDArray[np.int64] | None) -> Floats:
        from crashkit.errors import DataError

        if self.structure.points is None:
            raise DataError("the model was stored without its mesh; train it again from a dataset")
        return self.structure.points if nodes is None else self.structure.points[nodes]

    def displacement(self, nodes: NDArray[np.int64] | None) -> tuple[Floats, NDArray[np.floating]]:
        assert self.states is not None
        return self.time, self.states if nodes is None else self.states[:, :, nodes]

    def named(self, name: str) -> Value | None:
        if name in self.structure.names:
            k = self.structure.names.index(name)
            return Value(self.parameters[:, k], (), None, self.structure.units[k])
        return self.curve(name)

    def curve(self, name: str) -> Value | None:
        """A history by its channel."""
        return self.curves.get(name)

    @property
    def names(self) -> Sequence[str]:
        return (*self.curves, *self.structure.names)


class PredictedRuns(GivenRuns):
    """Runs of a model at parameters (run, parameter), in its units.

    Parameters
    ----------
    states
        (run, state, node, 3), m, where they are predicted already.
    """

    def __init__(
        self,
        surrogate: Surrogate,
        structure: FormulaMesh,
        parameters: Floats,
        time: Floats,
        level: int,
        states: NDArray[np.floating] | None = None,
    ) -> None:
        super().__init__(structure, parameters, time, states)
        self._surrogate, self._level = surrogate, level
        self._error: Error | None = None
        self._share = 0.0
        self._known: dict[bytes, NDArray[np.floating]] = {}

    def wrong_by(self, error: Error | None, share: float) -> PredictedRuns:
        """The same runs, as they would be if the model were wrong; predictions are shared.

        Parameters
        ----------
        error
            Of displacements.
        share
            Of histories: from -1 to 1, the quantile of left-out errors by which all samples are off, with its sign.
        """
        out = PredictedRuns(self._surrogate, self.structure, self.parameters, self.time, self._level, self.states)
        out._known, out.curves, out._error, out._share = self._known, self.curves, error, share
        return out

    def displacement(self, nodes: NDArray[np.int64] | None) -> tuple[Floats, NDArray[np.floating]]:
        chosen = np.arange(self.structure.size) if nodes is None else nodes
        if self.states is not None:
            found = self.states if nodes is None else self.states[:, :, nodes]
        else:
            key = chosen.tobytes()
            if key not in self._known:
                self._known[key] = self._surrogate.predict_nodes(self.parameters, chosen, self.time, self._level)
            found = self._known[key]
        return self.time, found if self._error is None else found + self._error(chosen)

    def curve(self, name: str) -> Value | None:
        known = self._surrogate.curves.get(name)
        if known is None:
            return None
        if name not in self.curves:
            values = self._surrogate.predict_curve(name, self.parameters)
            self.curves[name] = Value(values, ("time",), known.time, known.unit or "1")
        found = self.curves[name]
        if not self._share or known.band is None:
            return found
        size = abs(self._share)
        width = known.half_width(max(size, 0.5), self._surrogate.registration, self.parameters)
        off = width * min(1.0, size / 0.5) * np.sign(self._share)
        return Value(found.array + off, found.axes, found.time, found.unit)

    @property
    def names(self) -> Sequence[str]:
        return (*self._surrogate.curves, *self.structure.names)


def true_runs(structure: FormulaMesh, campaign: Campaign, run: int) -> GivenRuns:
    """One training run as it was computed."""
    states = np.asarray(campaign.displacement(0)[run])[None]
    return GivenRuns(structure, campaign.parameters[run : run + 1], campaign.time, states, curves_of(campaign, run))


def curves_of(campaign: Campaign, run: int) -> dict[str, Value]:
    """The histories of a training run."""
    return {
        c.name: Value(c.values[run : run + 1], ("time",), campaign.curve_time, c.unit or "1") for c in campaign.curves
    }


def dry_runs(campaign: Campaign, channels: Sequence[str]) -> Any:
    """A run of zeros with everything that formulas may name, to try them on before a training."""
    states = np.zeros((1, len(campaign.time), campaign.n_nodes, 3), np.float32)
    assert campaign.curve_time is not None or not campaign.curves
    zeros = {
        c.name: Value(np.zeros((1, c.values.shape[1])), ("time",), campaign.curve_time, c.unit or "1")
        for c in campaign.curves
        if c.name in channels
    }
    return GivenRuns(FormulaMesh.of_campaign(campaign), campaign.parameters[:1], campaign.time, states, zeros)
