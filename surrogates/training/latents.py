"""The encoded training runs of one level, which its regression is chosen on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class CoarseLatents:
    """Coarse runs, encoded as those of a level are: runs as computed, then their images in the same order.

    inputs   (run and image, parameter) scaled as those of the fine runs
    values   (run and image, state, latent)
    own      how many runs were computed
    twin     (fine run,) the coarse run of the same parameters; -1 without one
    """

    inputs: NDArray[np.float64]
    values: NDArray[np.float32]
    own: int
    twin: NDArray[np.int64]


@dataclass(frozen=True)
class Latents:
    """Encoded training runs of one level; the first `own` are runs as computed, the others their images.

    inputs   (run, state, input) scaled, `time_column` the place of the time
    values   (run, state, latent)
    known    (run, state) states that count
    sizes    (latent,) RMS movement of the nodes for a latent number that moves by one, in the level's unit
    lost     mean square of what decoding does not give back, in the level's unit
    part     (run,) the fold that leaves a run out, the same for a run and its image; folds count from 0
    below    (fold + 1, run, state, coarse latent) what the coarse level's regressions say, those of all runs last
    coarse   runs on a coarser mesh, which may help; `coarse_below` whether they did on the level below
    """

    inputs: Tensor
    values: Tensor
    known: Tensor
    sizes: Tensor
    lost: float
    part: Tensor
    own: int
    time_column: int
    below: Tensor | None = None
    coarse: CoarseLatents | None = None
    coarse_below: bool = False

    @property
    def folds(self) -> int:
        return int(self.part.max()) + 1

    @property
    def differ(self) -> bool:
        """Whether the runs differ in any parameter, without which a process has nothing to go by."""
        parameters = self.inputs[:, 0, : self.time_column]
        return bool((parameters != parameters[:1]).any())

    @property
    def time(self) -> Tensor:
        """(state,) scaled."""
        return self.inputs[0, :, self.time_column]

    def wrong(self, z: Tensor) -> Tensor:
        """(run, state) mean square error of displacements for latent vectors `z` of the own runs."""
        return (z - self.values[: self.own]).square() @ self.sizes.square()
