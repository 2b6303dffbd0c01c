"""Encoder and decoder of a level: stacks of graph convolutions and one dense layer at the latent vector.

How a level is assembled::

    operator = GraphOperator(edges, n_nodes)                       # kind="cheb" | "gcn" | "gcn2"
    encoder = GraphEncoder(operator, latent=4, channels=(3, 6, 12, 24), order=3)
    decoder = GraphDecoder(operator, latent=4, channels=(24, 12, 6, 3), order=3)
    z = encoder(x)                                                  # (n, b, 3) -> (b, 4)
    both = decoder(torch.cat([z, mlp(inputs)]))                     # (2b, 4) -> (n, 2b, 3): one pass for both losses
    reconstruction, approximation = both.chunk(2, dim=1)

Source: Kneifl et al. 2024, section 3.3.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from surrogates.errors import SurrogateError
from surrogates.operators.convolutions import ChebConv, GCN2Conv, GCNConv
from surrogates.operators.graph import WIDE_UP_TO, GraphOperator, applied


class _Encode(torch.autograd.Function):
    """z = h^T W^T + b for h (m, batch), W (latent, m): -> (batch, latent).

    Every product has the latent size in front: with it behind, the same product takes up to ten times as long.
    """

    @staticmethod
    def forward(ctx: Any, h: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(h, weight)
        return torch.addmm(bias[:, None], weight, h).t()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        h, weight = ctx.saved_tensors
        gradient = gradients[0].t()
        gradient_h = weight.t() @ gradient if ctx.needs_input_grad[0] else None
        return gradient_h, gradient @ h.t(), gradient.sum(dim=1)


class _Decode(torch.autograd.Function):
    """h = ELU(W z^T + b) for z (batch, latent), W (m, latent): -> (m, batch), and its gradient as in `_Encode`."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        h = functional.elu(torch.addmm(bias[:, None], weight, z.t()), inplace=True)
        ctx.save_for_backward(z, weight, h)
        return h

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        z, weight, h = ctx.saved_tensors
        gradient = torch.ops.aten.elu_backward(gradients[0], 1.0, 1.0, 1.0, True, h)
        gradient_z = (weight.t() @ gradient).t() if ctx.needs_input_grad[0] else None
        return gradient_z, (z.t() @ gradient.t()).t(), gradient.sum(dim=1)


class _EncodeLarge(torch.autograd.Function):
    """As `_Encode`, for fewer states than latent numbers: the gradient is added to that of `weight` by the product itself.

    So no second matrix of that size is made, and no time goes into adding it. `bias` has its gradient as usual.
    """

    @staticmethod
    def forward(ctx: Any, h: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(h)
        ctx.weight = weight
        return torch.addmm(bias[:, None], weight, h).t()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (h,), weight = ctx.saved_tensors, ctx.weight
        gradient = gradients[0].t()
        gradient_h = weight.t() @ gradient if ctx.needs_input_grad[0] else None
        _add_product(weight, gradient, h.t())
        return gradient_h, None, gradient.sum(dim=1)


class _DecodeLarge(torch.autograd.Function):
    """As `_Decode`, for fewer states than latent numbers; see `_EncodeLarge`."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        h = functional.elu(torch.addmm(bias[:, None], weight, z.t()), inplace=True)
        ctx.save_for_backward(z, h)
        ctx.weight = weight
        return h

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (z, h), weight = ctx.saved_tensors, ctx.weight
        gradient = torch.ops.aten.elu_backward(gradients[0], 1.0, 1.0, 1.0, True, h)
        gradient_z = gradient.t() @ weight if ctx.needs_input_grad[0] else None
        _add_product(weight, gradient, z)
        return gradient_z, None, gradient.sum(dim=1)


def _add_product(weight: Tensor, a: Tensor, b: Tensor) -> None:
    """Add a b to the gradient of `weight`."""
    if weight.grad is None:
        weight.grad = a @ b
    else:
        weight.grad.addmm_(a, b)


_in_place: ContextVar[bool] = ContextVar("gradients_in_place", default=False)


@contextmanager
def gradients_in_place() -> Iterator[None]:
    """What this thread computes inside adds the gradients of large dense layers to their weights' own as it goes back.

    Only for `backward`: what asks for gradients in another way finds none.
    """
    before = _in_place.set(True)
    try:
        yield
    finally:
        _in_place.reset(before)


class Convolutions(nn.Module):
    """The convolutions of one encoder or decoder: (node, batch, channels[0]) -> (node, batch, channels[-1]).

    The operator's kind chooses the layer. ELU follows every layer; `linear_end` leaves it out after the last one.
    "gcn2" needs one width throughout, so it works at the widest of `channels` between two linear maps at the nodes.
    """

    def __init__(self, operator: GraphOperator, channels: Sequence[int], order: int = 3, *, linear_end: bool) -> None:
        super().__init__()
        if len(channels) < 2:
            raise SurrogateError(f"channels are {tuple(channels)}; at least an input and an output width are needed")
        self.operator = operator
        steps = list(pairwise(channels))
        elu = [True] * (len(steps) - 1) + [not linear_end]
        self.before: nn.Module = nn.Identity()
        self.after: nn.Module = nn.Identity()
        if operator.kind == "cheb":
            layers: list[nn.Module] = [ChebConv(a, b, order, operator, elu=e) for (a, b), e in zip(steps, elu)]
        elif operator.kind == "gcn":
            layers = [GCNConv(a, b, operator, elu=e) for (a, b), e in zip(steps, elu)]
        else:
            width = max(channels)
            if channels[0] != width:
                self.before = nn.Linear(channels[0], width)
            if channels[-1] != width:
                self.after = nn.Linear(width, channels[-1])
            layers = [GCN2Conv(width, operator, layer=i + 1, elu=True) for i in range(len(steps))]
        self.layers = nn.ModuleList(layers)

    def forward(self, x: Tensor) -> Tensor:
        x = self.before(x)
        x0 = x
        for layer in self.layers:
            x = layer(x, x0) if isinstance(layer, GCN2Conv) else layer(x)
        result: Tensor = self.after(x)
        return result


class GraphEncoder(nn.Module):
    """Convolutions, then one dense linear layer: x (node, batch, channels[0]) -> z (batch, latent).

    The dense layer's inputs are ordered node by node, channel by channel within a node.
    Source: Kneifl et al. 2024, section 3.3 and table 1.
    """

    def __init__(
        self, operator: GraphOperator, latent: int, channels: Sequence[int] = (3, 6, 12, 24), order: int = 3
    ) -> None:
        super().__init__()
        self.convolutions = Convolutions(operator, channels, order, linear_end=False)
        self.dense = nn.Linear(operator.n_nodes * channels[-1], latent)

    def forward(self, x: Tensor) -> Tensor:
        operator = self.convolutions.operator
        h = self.convolutions(x)
        if operator.form == "dense":
            return functional.linear(h.transpose(0, 1).flatten(1), self.dense.weight, self.dense.bias)
        if _states_are_smaller(operator, self.dense.out_features, h.shape[1]):
            return applied(
                _EncodeLarge if _in_place.get() else _Encode,
                h.transpose(1, 2).reshape(-1, h.shape[1]),
                self.dense.weight,
                self.dense.bias,
            )
        weight = self.dense.weight.unflatten(1, (operator.n_nodes, -1)).transpose(1, 2).flatten(1)
        return applied(_Encode, h.permute(2, 0, 1).reshape(-1, h.shape[1]), weight, self.dense.bias)


class GraphDecoder(nn.Module):
    """One dense layer with ELU, then convolutions, the last linear: z (batch, latent) -> (node, batch, channels[-1]).

    The dense layer's results are ordered as the encoder's inputs to its own.
    Source: Kneifl et al. 2024, section 3.3 and table 1: the encoder in reverse order.
    """

    def __init__(
        self, operator: GraphOperator, latent: int, channels: Sequence[int] = (24, 12, 6, 3), order: int = 3
    ) -> None:
        super().__init__()
        self.n_nodes = operator.n_nodes
        self.channels = channels[0]
        self.dense = nn.Linear(latent, operator.n_nodes * channels[0])
        self.convolutions = Convolutions(operator, channels, order, linear_end=True)

    def forward(self, z: Tensor) -> Tensor:
        operator, (weight, bias) = self.convolutions.operator, (self.dense.weight, self.dense.bias)
        if operator.form == "dense":
            h = functional.elu(functional.linear(z, weight, bias))
            states: Tensor = self.convolutions(h.unflatten(1, (self.n_nodes, self.channels)).transpose(0, 1))
            return states
        if _states_are_smaller(operator, self.dense.in_features, len(z)):
            h = applied(_DecodeLarge if _in_place.get() else _Decode, z, weight, bias)
            x: Tensor = self.convolutions(h.view(self.n_nodes, self.channels, -1).transpose(1, 2))
            return _by_node(x)
        weight = weight.unflatten(0, (self.n_nodes, self.channels)).transpose(0, 1).flatten(0, 1)
        bias = bias.unflatten(0, (self.n_nodes, self.channels)).t().flatten()
        h = applied(_Decode, z, weight, bias)
        x = self.convolutions(h.reshape(self.channels, self.n_nodes, -1).permute(1, 2, 0))
        return _by_node(x)


def _states_are_smaller(operator: GraphOperator, latent: int, batch: int) -> bool:
    """Whether on a large graph a batch of states is put in the order of the dense layer's weights, and not these in its."""
    return operator.n_nodes > WIDE_UP_TO and batch < latent


def _by_node(x: Tensor) -> Tensor:
    """Gradients want the memory channel by channel; in a prediction, node by node, what follows moves whole rows."""
    return x if torch.is_grad_enabled() else x.transpose(1, 2).contiguous().transpose(1, 2)
