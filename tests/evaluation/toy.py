"""Small surrogates for the tests of evaluation: POD with the nearest training run, on any level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray


class NearestPod:
    """Predicts the POD coefficients of the nearest training run; the runs' own time grid only, interpolated."""

    def __init__(
        self,
        name: str,
        level: int,
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        runs: Sequence[NDArray[np.float32]],
        modes: int = 4,
        history: Mapping[str, NDArray[np.float64]] | None = None,
    ) -> None:
        self.name, self.level, self.n_latent, self.mesh = name, level, modes, None
        data = np.concatenate([r.reshape(len(r), -1) for r in runs]).astype(np.float64)
        _, _, vt = np.linalg.svd(data, full_matrices=False)
        self._modes = vt[:modes]
        self._coefficients = np.array([r.reshape(len(r), -1) @ self._modes.T for r in runs])
        self._low, self._high = parameters.min(axis=0), parameters.max(axis=0)
        self._seen, self._time = self._scale(parameters), time
        self.n_parameters = int(self._modes.size)
        self.seconds_per_epoch, self.training_seconds = 0.5 * (4 - level), 10.0 * (4 - level)
        self.history = dict(history or {})

    def _scale(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        return (parameters - self._low) / np.where(self._high > self._low, self._high - self._low, 1)

    def predict(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        nearest = int(np.argmin(np.linalg.norm(self._seen - self._scale(parameters), axis=1)))
        z = np.stack([np.interp(time, self._time, c) for c in self._coefficients[nearest].T], axis=1)
        return (z @ self._modes).reshape(len(time), -1, 3).astype(np.float32)

    def reconstruct(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        flat = displacement.reshape(len(displacement), -1)
        return ((flat @ self._modes.T) @ self._modes).reshape(displacement.shape).astype(np.float32)
