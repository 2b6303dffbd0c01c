"""One level of the surrogate: reduction and regression, and what it takes over from a frozen coarser level.

States are (node, batch, 3), divided by the level's scale. Source: Kneifl et al. 2024, sections 3.3 and 3.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.errors import SurrogateError
from surrogates.models.base import take_over
from surrogates.operators.upsampling import Upsampling
from surrogates.reductions.reduction import LinearReduction, Reduction
from surrogates.regression.latent_process import LatentProcess
from surrogates.regression.network import Course, Regressor


@dataclass(frozen=True)
class Known:
    """What frozen coarser levels say of a batch, computed once before training: it never changes.

    encoded    (b, coarse latent): enc_l(D x)
    regressed  (b, coarse latent): mlp_l(mu, t)
    """

    encoded: Tensor | None = None
    regressed: Tensor | None = None


class LevelNetwork(nn.Module):
    """A level alone, or on top of the frozen `coarse` one:

        z     = enc_l(D x) + enc*(x)
        x_rec = Up(dec_l(z)) + dec*(z)
        z_mlp = mlp*(mu, t, mlp_l(mu, t))

    With `concat` the two encodings stand side by side, dec_l reads its own part and dec* the whole.

    reduction   enc* and dec*
    regressor   mlp*
    latent      length of z
    scale       m: the unit of the states
    coarse      the trained coarser level; frozen here, for good
    upsampling  Up, in the coarse level's unit
    in_finer    (coarse node,) places of the coarse nodes among this level's: D
    with_initial  the encoded first state z0 is a further input of the regression
    process     a Gaussian process whose answer is mixed into that of mlp*, once the level is trained
    course      what all runs go through; the regression adds to it
    at_rest     all training runs start undeformed, so zero is encoded as zero and decoded as zero
    time_column  place of the scaled time among the inputs
    """

    in_finer: Tensor
    rest: Tensor | None

    def __init__(
        self,
        reduction: Reduction,
        regressor: Regressor,
        *,
        n_nodes: int,
        latent: int,
        scale: float = 1.0,
        coarse: LevelNetwork | None = None,
        upsampling: Upsampling | None = None,
        in_finer: NDArray[np.int64] | None = None,
        concat: bool = False,
        with_initial: bool = False,
        time_column: int = -1,
    ) -> None:
        super().__init__()
        if (coarse is None) != (upsampling is None) or (coarse is None) != (in_finer is None):
            raise SurrogateError("a finer level needs the coarser one, its upsampling and its places; found only some")
        self.reduction = reduction
        self.regressor = regressor
        self.n_nodes = n_nodes
        self.latent = latent
        self.scale = float(scale)
        self.concat = concat
        self.with_initial = with_initial
        self.upsampling = upsampling
        self.time_column = time_column
        self.process: LatentProcess | None = None
        self.course: Course | None = None
        self.at_rest = False
        self.register_buffer("rest", None, persistent=False)
        self.coarse: LevelNetwork | None = coarse
        if coarse is not None and in_finer is not None:
            coarse.requires_grad_(False)
            self.register_buffer("in_finer", torch.from_numpy(np.asarray(in_finer, np.int64)), persistent=False)

    @property
    def ratio(self) -> float:
        """The coarse level's unit in this level's."""
        return 1.0 if self.coarse is None else self.coarse.scale / self.scale

    def encode(self, x: Tensor, known: Known | None = None) -> Tensor:
        """(node, b, 3) -> (b, latent)"""
        own = self._encoded(x)
        if self.coarse is None:
            return own
        if known is not None and known.encoded is not None:
            below = known.encoded
        else:
            below = self.coarse.encode(self.restrict(x))
        return torch.cat([below, own], dim=1) if self.concat else _padded(below, own.shape[1]) + own

    def decode(self, z: Tensor) -> Tensor:
        """(b, latent) -> (node, b, 3)"""
        if not self.at_rest:
            return self._decoded(z)
        if self.rest is not None and not torch.is_grad_enabled():
            moved = (z != 0).any(dim=1)  # a product of matrices rounds otherwise for another number of samples
            return self._decoded(z).sub_(self.rest).mul_(moved[:, None])
        both = self._decoded(nn.functional.pad(z, (0, 0, 0, 1)))
        return both[:, :-1] - both[:, -1:]

    @torch.no_grad()
    def settle(self) -> None:
        """Training is over: what zero is decoded as need not be computed each time."""
        if self.at_rest:
            self.rest = self._decoded(next(self.reduction.parameters()).new_zeros(1, self.latent))

    def _encoded(self, x: Tensor) -> Tensor:
        if not self.at_rest or isinstance(self.reduction, LinearReduction):
            return self.reduction.encode(x)
        both = self.reduction.encode(nn.functional.pad(x.permute(2, 0, 1), (0, 1)).permute(1, 2, 0))
        return both[:-1] - both[-1:]

    def _decoded(self, z: Tensor) -> Tensor:
        own = self.reduction.decode(z)
        if self.coarse is None or self.upsampling is None:
            return own
        lifted = self.lifted(z)
        return lifted + own if torch.is_grad_enabled() else lifted.add_(own)

    def lifted(self, z: Tensor) -> Tensor:
        """Up(dec_l(z)): what the coarser level makes of z, on this level's nodes."""
        if self.coarse is None or self.upsampling is None:
            raise SurrogateError("the coarsest level has nothing below it")
        result: Tensor = self.upsampling(self.coarse.decode(z[:, : self.coarse.latent]) * self.ratio)
        return result

    def regress(self, inputs: Tensor, known: Known | None = None, initial: Tensor | None = None) -> Tensor:
        """(b, inputs) -> z (b, latent); `initial` (node, b or 1, 3) are the first states, zero if not given."""
        below = None
        if self.coarse is not None:
            if known is not None and known.regressed is not None:
                below = known.regressed
            else:
                below = self.coarse.regress(inputs, None, None if initial is None else self.restrict(initial))
        known_inputs = inputs
        if self.with_initial:
            inputs = torch.cat([inputs, self.encoded_initial(inputs, initial)], dim=1)
        course = None if self.course is None else self.course(known_inputs[:, self.time_column])
        z = self.regressor(inputs, below, course)
        return z if self.process is None else torch.lerp(z, self.process(known_inputs), self.process.share)

    def from_query(self, inputs: Tensor, seen: Tensor) -> Tensor:
        """What a coarse run of the query, encoded as `seen` (b, latent), changes of `regress`: (b, latent)."""
        process = self.process
        if process is None or process.over is None:
            return torch.zeros_like(seen)
        changed: Tensor = process.share * process.over.from_query(inputs, seen)
        return changed

    def encoded_initial(self, inputs: Tensor, initial: Tensor | None) -> Tensor:
        """z0 (b, latent): the encoded first state of each sample's run."""
        encoded = self.encode(inputs.new_zeros(self.n_nodes, 1, 3) if initial is None else initial)
        return encoded.expand(len(inputs), -1) if len(encoded) == 1 else encoded

    def restrict(self, x: Tensor) -> Tensor:
        """D x in the coarse level's unit."""
        return x[self.in_finer] / self.ratio

    def own_state(self) -> dict[str, Tensor]:
        """The tensors of this level without those of the coarser ones."""
        return {k: v for k, v in self.state_dict().items() if not k.startswith("coarse.")}

    def load_own_state(self, tensors: dict[str, Tensor]) -> None:
        """Take over what `own_state` gave; raises SurrogateError naming what does not fit."""
        parts: dict[str, dict[str, Tensor]] = {"process": {}, "course": {}}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            if part in parts:
                parts[part][rest] = tensor
        if parts["process"]:
            self.process = LatentProcess.like(parts["process"])
        if parts["course"]:
            self.course = Course.like(parts["course"])
        take_over(self.own_state(), tensors)

    def parameter_counts(self) -> dict[str, int]:
        """Numbers that make up this level without the coarser ones: "reduction", "regression", "upsampling", "process".

        A linear reduction that is computed, not trained, counts its modes (table 1 of the paper does).
        """
        if isinstance(self.reduction, LinearReduction):
            reduction = self.reduction.decode_matrix.numel()
        else:
            reduction = _numbers(self.reduction)
        moves = self.upsampling is not None and self.upsampling.kind != "static"
        return {
            "reduction": reduction,
            "regression": _numbers(self.regressor),
            "upsampling": _numbers(self.upsampling) if moves and self.upsampling is not None else 0,
            "process": 0 if self.process is None else sum(b.numel() for b in self.process.buffers()),
        }


def _padded(z: Tensor, length: int) -> Tensor:
    return z if z.shape[1] == length else nn.functional.pad(z, (0, length - z.shape[1]))


def _numbers(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())
