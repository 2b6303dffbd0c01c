"""The cascade: levels from coarse to fine, each trained on top of the frozen ones below it (section 3.4).

PODNN, AENN and GAENN are cascades of one level on the full mesh with another reduction.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from surrogates.data.graphs import Graphs
from surrogates.data.scaling import InputScaling
from surrogates.models.base import Network, in_metres
from surrogates.models.level import LevelNetwork
from surrogates.operators.upsampling import Upsampling
from surrogates.reductions.reduction import make_reduction
from surrogates.regression.network import Regressor
from surrogates.settings import Settings


class Cascade(Network):
    """Trained levels by number. `add` puts a finer one on top, which freezes those below."""

    def __init__(self, inputs: InputScaling) -> None:
        super().__init__(inputs)
        self.levels: dict[int, LevelNetwork] = {}
        self.finest: LevelNetwork | None = None

    def add(self, number: int, level: LevelNetwork) -> None:
        """Put `level` on top; it was built on those that are here."""
        self.levels[number] = level
        self.finest = level

    def drop_finest(self) -> None:
        """Forget the finest level."""
        self.levels.popitem()
        self.finest = next(reversed(self.levels.values()), None)

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self.levels)

    @property
    def scales(self) -> dict[int, float]:
        return {k: v.scale for k, v in self.levels.items()}

    def latent(self, number: int) -> int:
        return self.levels[number].latent

    def forward(self, parameters: Tensor, time: Tensor, number: int) -> Tensor:
        level = self.levels[number]
        return in_metres(level.decode(level.regress(self.inputs(parameters, time))), level.scale)

    def from_coarse(self, parameters: Tensor, time: Tensor, number: int, seen: Tensor) -> Tensor:
        level, inputs = self.levels[number], self.inputs(parameters, time)
        return in_metres(level.decode(level.regress(inputs) + level.from_query(inputs, seen)), level.scale)

    def takes_coarse(self, number: int) -> bool:
        process = self.levels[number].process
        return process is not None and process.over is not None

    def encode_metres(self, x: Tensor, number: int) -> Tensor:
        level = self.levels[number]
        return level.encode(x / level.scale)

    def reconstruct(self, x: Tensor, number: int) -> Tensor:
        level = self.levels[number]
        return in_metres(level.decode(self.encode_metres(x, number)), level.scale)

    def n_parameters(self, number: int) -> int:
        return sum(sum(v.parameter_counts().values()) for k, v in self.levels.items() if k >= number)

    def tensors(self) -> dict[str, dict[str, Tensor]]:
        return {f"level_{k}": v.own_state() for k, v in self.levels.items()}


def build_level(number: int, settings: Settings, graphs: Graphs, cascade: Cascade) -> LevelNetwork:
    """An untrained level `number` on top of what `cascade` holds; coarser levels are frozen by it."""
    own = settings.for_level(number)
    coarse_number = cascade.numbers[-1] if cascade.numbers else None
    coarse = None if coarse_number is None else cascade.levels[coarse_number]
    concat = settings.transfer.encoder == "concat" and coarse is not None
    below = 0 if coarse is None else coarse.latent
    # A mesh of few nodes has fewer displacements than the latent vector may have numbers; a finer level adds the rest.
    own = own.model_copy(update={"latent": min(own.latent, 3 * graphs.n_nodes(number))})
    latent = own.latent + (below if concat else 0)
    reduction = make_reduction(own, graphs.edges(number), graphs.n_nodes(number), latent)
    extra = latent if settings.inputs.initial_state else 0
    regressor = Regressor(
        cascade.inputs.size + extra, latent, own.mlp.widths, own.mlp.activation,
        coarse=below, residual=settings.transfer.mlp == "residual", members=own.mlp.members,
    )  # fmt: skip
    more: dict[str, Any] = {}
    if coarse is not None and coarse_number is not None:
        more = {
            "coarse": coarse,
            "upsampling": Upsampling(graphs.upsampling(coarse_number, number), settings.transfer.upsampling),
            "in_finer": graphs.places(coarse_number, number),
        }
    return LevelNetwork(
        reduction, regressor, n_nodes=graphs.n_nodes(number), latent=latent, concat=concat,
        with_initial=settings.inputs.initial_state, time_column=cascade.inputs.time_column, **more,
    )  # fmt: skip
