"""What evaluation needs to know of a surrogate: its name, where it lives, and how to ask it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Predictor(Protocol):
    """One row of every table. The command line wraps each level of a stored model into one of these.

    name          "MH1", "PODNN", "POD-GPR r=12", ...
    level         the mesh level it predicts on; 0 is the full mesh
    n_parameters  trained numbers, the budget shown beside the errors
    seconds_per_epoch, training_seconds  as recorded during training (NaN where it makes no sense)
    history       epoch curves by name: "total", "approximation", "reconstruction"; empty where not iterative
    """

    name: str
    level: int
    n_parameters: int
    seconds_per_epoch: float
    training_seconds: float
    history: Mapping[str, NDArray[np.float64]]

    def predict(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        """Displacement (state, node of its level, 3), m, of one run with `parameters` (parameter,) at `time`."""

    def reconstruct(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        """Encode and decode (state, node of its level, 3): what reduction alone costs."""
