"""Adding a reduction: a quadratic manifold, x = D z + Q (z * z) + b with z = E x, in under 60 lines.

Run it with `python examples/add_reduction.py DATASET MODEL TEST_RUNS`: it trains a cascade of such levels, stores it and
asks it for a run. Where the reduction is registered, `surrogates.storage.folder.load` reads the model again.
Source: Geelen, Wright, Willcox 2023, doi 10.1016/j.cma.2022.115717 (there the maps are computed, here they are trained).
"""

import sys
from pathlib import Path

from torch import Tensor, nn

from crashkit.api.train import train
from surrogates.reductions.reduction import Reduction, flat, register, unflat
from surrogates.settings import LevelSettings


class QuadraticReduction(Reduction):
    def __init__(self, n_nodes: int, latent: int, decoded: int) -> None:
        super().__init__()
        self.n_nodes = n_nodes
        self.project = nn.Linear(3 * n_nodes, latent, bias=False)
        self.linear = nn.Linear(decoded, 3 * n_nodes)
        self.quadratic = nn.Linear(decoded, 3 * n_nodes, bias=False)

    def encode(self, x: Tensor) -> Tensor:
        return self.project(flat(x))

    def decode(self, z: Tensor) -> Tensor:
        return unflat(self.linear(z) + self.quadratic(z * z), self.n_nodes)

    def end_at_zero(self) -> None:
        """Needed for `level.start=pod` alone: nothing is added to POD until training moves these."""
        for layer in (self.project, self.linear, self.quadratic):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)


def make(settings: LevelSettings, edges: object, n_nodes: int, decoded: int) -> Reduction:
    return QuadraticReduction(n_nodes, settings.latent, decoded)


register("quadratic", make)

if __name__ == "__main__":
    data, output, test = sys.argv[1:4]
    surrogate = train(
        data, Path(output), "mh", settings=["level.reduction=quadratic", "level.epochs=20"], test=test
    ).surrogate
    ranges = surrogate.record.ranges
    run = surrogate.predict_full((ranges.low + ranges.high) / 2)
    for level, error in surrogate.record.errors.items():
        print(f"{level}: {100 * error:.1f} cm on validation runs")
    print(f"{len(run)} states of {run.shape[1]} nodes, up to {100 * abs(run).max():.0f} cm in one direction")
