"""One latent vector for all levels, trained together (section 3.5): the levels differ in their decoders alone.

z      = enc(x)                       x on the finest level
z_mlp  = mlp(mu, t)
x_l    = Up(x_{l+1}) + dec_l(z)       from coarse to fine
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from surrogates.data.graphs import Graphs
from surrogates.data.scaling import InputScaling
from surrogates.errors import SurrogateError
from surrogates.models.base import Network, in_metres
from surrogates.operators.upsampling import Upsampling
from surrogates.reductions.reduction import LinearReduction, Reduction, make_reduction
from surrogates.regression.network import Regressor
from surrogates.settings import Settings


class Unified(Network):
    """Decoders of several levels on one encoder and one regression.

    Built untrained for the levels `numbers`, coarsest first. `scale`, m, is shared by all levels.
    """

    def __init__(self, inputs: InputScaling, settings: Settings, graphs: Graphs, numbers: tuple[int, ...]) -> None:
        super().__init__(inputs)
        self._numbers = numbers
        self.scale = 1.0
        finest = numbers[-1]
        own = settings.for_level(finest)
        # No longer than the coarsest mesh has displacements.
        self.n_latent = min([own.latent, *(3 * graphs.n_nodes(number) for number in numbers)])
        self.with_initial = settings.inputs.initial_state
        self.reductions = nn.ModuleDict()
        self.upsamplings = nn.ModuleDict()
        for k, number in enumerate(numbers):
            reduction = make_reduction(
                settings.for_level(number).model_copy(update={"latent": self.n_latent}),
                graphs.edges(number),
                graphs.n_nodes(number),
                self.n_latent,
            )
            if number != finest:
                reduction.decode_only()
            self.reductions[str(number)] = reduction
            if k:
                up = graphs.upsampling(numbers[k - 1], number)
                self.upsamplings[str(number)] = Upsampling(up, settings.transfer.upsampling)
        extra = self.n_latent if self.with_initial else 0
        self.regressor = Regressor(inputs.size + extra, self.n_latent, own.mlp.widths, own.mlp.activation)
        self.n_nodes = graphs.n_nodes(finest)
        self.places = {k: torch.from_numpy(graphs.places(k, finest)) for k in numbers[:-1]}
        self.to_finest = {k: graphs.upsampling(k, finest) for k in numbers[:-1]}

    @property
    def numbers(self) -> tuple[int, ...]:
        return self._numbers

    @property
    def scales(self) -> dict[int, float]:
        return dict.fromkeys(self._numbers, self.scale)

    def latent(self, number: int) -> int:
        return self.n_latent

    def reduction(self, number: int) -> Reduction:
        """The decoder of level `number`, with the encoder on the finest one."""
        found = self.reductions[str(number)]
        if not isinstance(found, Reduction):
            raise SurrogateError(f"level {number} has no reduction")
        return found

    def encode(self, x: Tensor) -> Tensor:
        """States of the finest level (node, b, 3) in its unit -> z (b, latent)"""
        return self.reduction(self._numbers[-1]).encode(x)

    def decode_all(self, z: Tensor, down_to: int | None = None) -> dict[int, Tensor]:
        """States (node, b, 3) of every level, coarsest first, as far as level `down_to`."""
        out: dict[int, Tensor] = {}
        below: Tensor | None = None
        for number in self._numbers:
            state = self.reduction(number).decode(z)
            if below is not None:
                state = self.upsamplings[str(number)](below) + state
            below = out[number] = state
            if number == down_to:
                break
        return out

    def regress(self, inputs: Tensor, initial: Tensor | None = None) -> Tensor:
        """(b, inputs) -> z; `initial` (node, b or 1, 3) as in `LevelNetwork.regress`."""
        if self.with_initial:
            first = self.encode(inputs.new_zeros(self.n_nodes, 1, 3) if initial is None else initial)
            inputs = torch.cat([inputs, first.expand(len(inputs), -1) if len(first) == 1 else first], dim=1)
        result: Tensor = self.regressor(inputs)
        return result

    def restrict(self, x: Tensor, number: int) -> Tensor:
        """D x from the finest level to `number`."""
        return x if number == self._numbers[-1] else x[self.places[number].to(x.device)]

    def forward(self, parameters: Tensor, time: Tensor, number: int) -> Tensor:
        return in_metres(self.decode_all(self.regress(self.inputs(parameters, time)), number)[number], self.scale)

    def encode_metres(self, x: Tensor, number: int) -> Tensor:
        """A coarse state is lifted to the finest level by the static U first."""
        if number != self._numbers[-1]:
            up = self.to_finest[number].astype("float32")
            x = torch.from_numpy((up @ x.reshape(len(x), -1).numpy()).reshape(-1, *x.shape[1:]))
        return self.encode(x / self.scale)

    def reconstruct(self, x: Tensor, number: int) -> Tensor:
        return in_metres(self.decode_all(self.encode_metres(x, number), number)[number], self.scale)

    def n_parameters(self, number: int) -> int:
        needed = [k for k in self._numbers if k >= number]
        parts: list[nn.Module] = [self.regressor, self.reductions[str(self._numbers[-1])]]
        parts += [self.reductions[str(k)] for k in needed if k != self._numbers[-1]]
        moving = [self.upsamplings[str(k)] for k in needed[1:]]
        parts += [up for up in moving if isinstance(up, Upsampling) and up.kind != "static"]
        return sum(p.numel() for part in parts for p in part.parameters())

    def tensors(self) -> dict[str, dict[str, Tensor]]:
        return {"levels": dict(self.state_dict())}

    def linear_parts(self) -> dict[int, LinearReduction]:
        """Linear parts by level, where reductions have one."""
        from surrogates.reductions.reduction import linear_part

        found = {k: linear_part(self.reduction(k)) for k in self._numbers}
        return {k: part for k, part in found.items() if part is not None}
