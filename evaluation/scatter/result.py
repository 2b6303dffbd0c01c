"""What became of a scatter, as plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.scatter.differences import Differences
from evaluation.scatter.draws import Indices, Scatter
from evaluation.scatter.folding import FoldingModes
from evaluation.scatter.probability import Probability

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Number:
    """One number over all draws.

    Attributes
    ----------
    name, text, unit
        What it is called, its formula, its SI unit.
    nominal
        Its value without scatter.
    values
        (draw,).
    """

    name: str
    text: str
    unit: str
    nominal: float
    values: Floats

    def quantiles(self, shares: Sequence[float] | Floats) -> Floats:
        """Values below which these shares of the draws lie."""
        return np.asarray(np.nanquantile(self.values, shares))


@dataclass(frozen=True)
class LimitKept:
    """A limit and the probability that it is broken.

    Attributes
    ----------
    text, number
        As written, and the name of the number or formula on its left.
    bound
        In SI units.
    probability
        Of breaking it.
    ever, by_state
        (node,) and (state, node) for a limit on every node: the probability that it is broken there; else None.
    outside
        Share of the draws that break it and lie outside the trained range.
    """

    text: str
    number: str
    bound: float
    probability: Probability
    ever: NDArray[np.float32] | None = None
    by_state: NDArray[np.float32] | None = None
    outside: float = 0.0


@dataclass(frozen=True)
class ScatterResult:
    """Distributions of fields and numbers over draws of the parameters.

    Attributes
    ----------
    scatter
        The parameters that scatter, `nominal` the value of every parameter of the model by name.
    ranges
        Name -> trained range (low, high).
    draws
        (draw, parameter that scatters), in the order of `scatter`.
    inside
        (draw,): within the trained range of all of them.
    numbers, limits, indices
        The distributions, the probabilities, and which parameter is behind each number.
    differences, folding
        Where runs begin to differ, and groups of shapes.
    time, position, faces
        Of the mesh: (state,) s, (node, 3) m, (face, corner).
    mean, deviation
        (state, node, 3) and (state, node), m.
    doubt
        Where the model's own uncertainty was taken from; empty where it has none.
    warnings
        Sentences about too few draws, and draws outside the trained range.
    about
        Further facts: model, seed, plan of the draws.
    """

    scatter: tuple[Scatter, ...]
    nominal: Mapping[str, float]
    ranges: Mapping[str, tuple[float, float]]
    draws: Floats
    inside: NDArray[np.bool_]
    numbers: tuple[Number, ...]
    limits: tuple[LimitKept, ...]
    indices: Indices
    differences: Differences
    folding: FoldingModes
    time: Floats
    position: Floats
    faces: NDArray[np.int32]
    mean: NDArray[np.float32]
    deviation: NDArray[np.float32]
    doubt: str
    warnings: tuple[str, ...]
    about: Mapping[str, str]

    def __repr__(self) -> str:
        said = ", ".join(f"{n.name} {n.nominal:.4g} {n.unit}" for n in self.numbers)
        return f"ScatterResult of {len(self.draws)} draws of {', '.join(s.name for s in self.scatter)}: {said}"
