"""Graph convolutions on states laid out as [node, batch, channel].

Inside, a state is held as [channel, node, batch]. Then, without a copy, each channel is a matrix (n, b) for the sparse
operator, all channels are one matrix (c, n*b) whose channels one wide product mixes, the powers of the operator stand
below each other as further channels, and the dense layer at the latent reads the state as (c*n, b). A state whose
memory already has that order (`buffer.permute(1, 2, 0)`) passes through without being copied.

`with exportable(model): torch.export.export(...)` swaps every operator for its dense form while it lasts, which
torch.export and ONNX accept.

Sources: Defferrard, Bresson, Vandergheynst 2016 (ChebConv); Kipf and Welling 2017 (GCNConv); Chen et al. 2020
(GCN2Conv, GCNII).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from surrogates.errors import SurrogateError
from surrogates.operators.chebyshev import of_powers, of_terms
from surrogates.operators.graph import GraphOperator, applied, check_state


def _powers(operator: GraphOperator, powers: Tensor) -> Tensor:
    """(order, c, n, b) holding x in its first place -> (order*c, n, b) with x, L x, .. L^(order-1) x, in place."""
    for k in range(1, len(powers)):
        operator.times(powers[k - 1], powers[k])
    return powers.flatten(0, 1)


def _horner(operator: GraphOperator, coefficients: Tensor) -> Tensor:
    """sum_k L^k c_k for c (order, c, n, b), in place: -> (c, n, b), the memory of c_0."""
    for k in range(len(coefficients) - 1, 0, -1):
        operator.times(coefficients[k], coefficients[k - 1], add=True)
    return coefficients[0]


class _Cheb(torch.autograd.Function):
    """One Chebyshev convolution with its ELU on (channel, n, batch), and its gradient by hand.

    The side with fewer channels moves along the graph: x before its channels are mixed, or the mixed channels
    afterwards; and in the gradient the same side. The operator is symmetric, so the gradient moves with it as it is.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None, operator: GraphOperator, elu: bool) -> Tensor:
        order, channels, width = weight.shape
        _, n, batch = x.shape
        by_powers = of_powers(weight)
        if channels <= width:
            powers = x.new_empty(order, channels, n, batch)
            powers[0] = x
            kept = _powers(operator, powers)
            mix = by_powers.reshape(order * channels, width).t()
            flat = kept.view(order * channels, -1)
            out = mix @ flat if bias is None else torch.addmm(bias[:, None], mix, flat)
            out = out.view(width, n, batch)
        else:
            kept = x.contiguous()
            mix = by_powers.transpose(1, 2).reshape(order * width, channels)
            parts = (mix @ kept.view(channels, -1)).view(order, width, n, batch)
            out = _horner(operator, parts)
            if bias is not None:
                out.view(width, -1).add_(bias[:, None])
        if elu:
            functional.elu(out, inplace=True)
        ctx.operator, ctx.elu, ctx.has_bias = operator, elu, bias is not None
        ctx.save_for_backward(kept, weight, mix, out if elu else None)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        kept, weight, mix, out = ctx.saved_tensors
        order, channels, width = weight.shape
        _, n, batch = kept.shape
        # The gradient behind the ELU goes where its powers are wanted, if they are.
        powers = gradients[0].new_empty(1 if channels <= width else order, width, n, batch)
        gradient = powers[0]
        if ctx.elu:
            torch.ops.aten.elu_backward.grad_input(gradients[0], 1.0, 1.0, 1.0, True, out, grad_input=gradient)
        else:
            gradient.copy_(gradients[0])
        gradient_bias = gradient.view(width, -1).sum(dim=1) if ctx.has_bias else None
        gradient_x: Tensor | None = None
        if channels <= width:
            flat = gradient.view(width, -1)
            by_powers = (flat @ kept.view(order * channels, -1).t()).t().reshape(order, channels, width)
            if ctx.needs_input_grad[0]:
                gradient_x = _horner(ctx.operator, (mix.t() @ flat).view(order, channels, n, batch))
        else:
            flat = _powers(ctx.operator, powers).view(order * width, -1)
            by_powers = (flat @ kept.view(channels, -1).t()).view(order, width, channels).transpose(1, 2)
            if ctx.needs_input_grad[0]:
                gradient_x = (mix.t() @ flat).view(channels, n, batch)
        return gradient_x, of_terms(by_powers), gradient_bias, None, None


def _plain_cheb(x: Tensor, weight: Tensor, bias: Tensor | None, operator: GraphOperator) -> Tensor:
    """The convolution of `_Cheb`, without ELU, by the textbook recurrence in plain operations."""
    terms = [x]
    for k in range(1, len(weight)):
        moved = operator.propagate(terms[-1])
        terms.append(moved if k == 1 else 2.0 * moved - terms[-2])
    out = torch.stack([_mix(term, mix) for term, mix in zip(terms, weight)]).sum(dim=0)
    return out if bias is None else out + bias[:, None, None]


def _mix(x: Tensor, weight: Tensor) -> Tensor:
    """The channels of x (in, n, b) mixed by weight (in, out): -> (out, n, b)."""
    result: Tensor = torch.tensordot(weight.t(), x, dims=1)
    return result


class ChebConv(nn.Module):
    """y = sum_k T_k(L) x W_k + b, then ELU if asked: (node, batch, in) -> (node, batch, out).

    order     number of Chebyshev terms; 3 means T_0, T_1, T_2 (Defferrard et al. 2016, equation 4)

    Parameters: weight (order, in, out), Glorot-uniform for each term; bias (out), zero.

    Attributes
    ----------
    operator
        A GraphOperator of kind "cheb".
    elu
        Apply ELU to the result, in place.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        order: int,
        operator: GraphOperator,
        *,
        bias: bool = True,
        elu: bool = False,
    ) -> None:
        super().__init__()
        if order < 1:
            raise SurrogateError(f"Chebyshev order is {order}; at least one term (order 1) is needed")
        _need_kind(operator, ("cheb",), "ChebConv")
        self.operator = operator
        self.elu = elu
        self.weight = nn.Parameter(torch.empty(order, in_channels, out_channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        bound = math.sqrt(6.0 / (in_channels + out_channels))
        nn.init.uniform_(self.weight, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        check_state(x, self.operator, self.weight.shape[1])
        inside = x.permute(2, 0, 1)
        if self.operator.form == "dense":
            out = _plain_cheb(inside, self.weight, self.bias, self.operator)
            out = functional.elu(out) if self.elu else out
        else:
            out = applied(_Cheb, inside, self.weight, self.bias, self.operator, self.elu)
        return out.permute(1, 2, 0)

    def extra_repr(self) -> str:
        order, channels, width = self.weight.shape
        return f"{channels}, {width}, order={order}, elu={self.elu}, {self.operator}"


class GCNConv(nn.Module):
    """y = P x W + b with P = (D + I)^-1/2 (A + I) (D + I)^-1/2 (Kipf and Welling 2017), then ELU if asked.

    (node, batch, in) -> (node, batch, out). Parameters: weight (in, out), Glorot-uniform; bias (out), zero.
    """

    def __init__(
        self, in_channels: int, out_channels: int, operator: GraphOperator, *, bias: bool = True, elu: bool = False
    ) -> None:
        super().__init__()
        _need_kind(operator, ("gcn", "gcn2"), "GCNConv")
        self.operator = operator
        self.elu = elu
        self.weight = nn.Parameter(torch.empty(in_channels, out_channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        nn.init.xavier_uniform_(self.weight)

    def forward(self, x: Tensor) -> Tensor:
        channels, width = self.weight.shape
        check_state(x, self.operator, channels)
        x = x.permute(2, 0, 1)
        if channels <= width:
            out = _mix(self.operator.propagate(x), self.weight)
        else:
            out = self.operator.propagate(_mix(x, self.weight))
        if self.bias is not None:
            out = out + self.bias[:, None, None]
        return (functional.elu(out) if self.elu else out).permute(1, 2, 0)


class GCN2Conv(nn.Module):
    """y = ((1 - alpha) P x + alpha x0) ((1 - beta) I + beta W), then ELU if asked (Chen et al. 2020, equation 5).

    x and x0 (node, batch, channels) -> (node, batch, channels). beta = log(theta / layer + 1), `layer` counted from 1.
    Parameter: weight (channels, channels), Glorot-uniform.
    """

    def __init__(
        self,
        channels: int,
        operator: GraphOperator,
        *,
        layer: int = 1,
        alpha: float = 0.1,
        theta: float = 0.5,
        elu: bool = False,
    ) -> None:
        super().__init__()
        _need_kind(operator, ("gcn", "gcn2"), "GCN2Conv")
        self.operator = operator
        self.elu = elu
        self.alpha = alpha
        self.beta = math.log(theta / layer + 1.0)
        self.weight = nn.Parameter(torch.empty(channels, channels))
        nn.init.xavier_uniform_(self.weight)

    def forward(self, x: Tensor, x0: Tensor) -> Tensor:
        check_state(x, self.operator, self.weight.shape[0])
        h = (1.0 - self.alpha) * self.operator.propagate(x.permute(2, 0, 1)) + self.alpha * x0.permute(2, 0, 1)
        out = (1.0 - self.beta) * h + self.beta * _mix(h, self.weight)
        return (functional.elu(out) if self.elu else out).permute(1, 2, 0)


@contextmanager
def exportable(model: nn.Module) -> Iterator[nn.Module]:
    """Inside, every operator of `model` is in its dense form and made for the model's weights: fit for torch.export."""
    dense: dict[int, GraphOperator] = {}
    before: list[tuple[nn.Module, GraphOperator]] = []
    like = next(model.parameters())
    for module in model.modules():
        operator = getattr(module, "operator", None)
        if isinstance(operator, GraphOperator):
            before.append((module, operator))
            form = dense.setdefault(id(operator), operator.dense_form())
            form.tensor(like.device, like.dtype)
            module.operator = form  # type: ignore[assignment]
    try:
        yield model
    finally:
        for module, operator in before:
            module.operator = operator  # type: ignore[assignment]


def _need_kind(operator: GraphOperator, kinds: tuple[str, ...], layer: str) -> None:
    if operator.kind not in kinds:
        raise SurrogateError(f"{layer} was given an operator of kind {operator.kind!r}; it needs {' or '.join(kinds)}")
