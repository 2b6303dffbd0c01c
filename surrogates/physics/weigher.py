"""How much each training run and image counts for a query: what predicts everything that is no displacement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogates.data.inputs import over_range
from surrogates.regression.gaussian import Gaussian, RadialBasis

Machine = Gaussian | RadialBasis


@dataclass
class Weigher:
    """A fitted regression, and the ranges that scale its inputs.

    Attributes
    ----------
    low, high
        (input,) of the registered inputs it was fitted to; a constant one is left out.
    """

    machine: Machine
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, machine: Machine, inputs: NDArray[np.float64]) -> Weigher:
        """Of a regression that was fitted to inputs (run and image, input)."""
        return cls(machine, inputs.min(axis=0), inputs.max(axis=0))

    def weights(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """(query, run and image) at registered inputs (query, input)."""
        return self.machine.weights(self._scaled(inputs))

    def deviation(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """(query,): what the regression believes its error to be, up to a factor; ones where it believes nothing."""
        if isinstance(self.machine, Gaussian):
            return self.machine.deviation(self._scaled(inputs))
        return np.ones(len(inputs))

    def nearest(self, inputs: NDArray[np.float64], among: int | None = None) -> NDArray[np.int64]:
        """(query,): the run or image that is nearest, as the regression measures; among the first so many alone."""
        x, known = self._scaled(inputs), self.machine.x[:among]
        if isinstance(self.machine, Gaussian):
            x, known = x @ self.machine.kernel.mix.T, known @ self.machine.kernel.mix.T
        return np.asarray(np.square(x[:, None] - known[None]).sum(axis=2).argmin(axis=1))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be kept."""
        return {"x": self.machine.x, "low": self.low, "high": self.high, **self.machine.numbers()}

    @classmethod
    def load(cls, arrays: Mapping[str, NDArray[Any]]) -> Weigher:
        """From what `arrays` gave."""
        machine: Machine = Gaussian.load(arrays["x"], arrays) if "kernel" in arrays else RadialBasis(arrays["x"])
        return cls(machine, arrays["low"], arrays["high"])

    def _scaled(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        return over_range(inputs, np.stack([self.low, self.high]))
