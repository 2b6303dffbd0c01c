"""Stacks of Chebyshev convolutions on a CPU in compiled code: `_convolution.c`, where it could be compiled.

States come in blocks of 16, laid out as (block, node, channel, lane): what a node's convolution needs then lies together,
and a lane is a lane of the processor's vectors. Blocks are shared out among threads, and each goes through all layers
while it is in cache. The library is built when the package is installed; where no compiler was found, or for anything
but Chebyshev convolutions in float32 or float64 on a CPU, `surrogates.operators.graph` does the same in torch.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from surrogates.errors import SurrogateError
from surrogates.operators.chebyshev import of_powers, of_terms

if TYPE_CHECKING:
    from surrogates.operators.graph import GraphOperator

LANES = 16
# Below this many entries at the widest place one thread is done sooner than a second one is woken: 73 nodes at batch 32
# stay with one, 292 are shared.
SHARED_FROM = 1 << 17

_SUFFIX = {torch.float32: "_f32", torch.float64: "_f64"}
_INTEGER, _POINTER = ctypes.c_int64, ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "stack_forward": (_POINTER, _INTEGER, _POINTER, _INTEGER, _INTEGER),
    "stack_backward": (_POINTER, _INTEGER, _POINTER, _INTEGER, _INTEGER, *(_POINTER,) * 5, _INTEGER),
    "shrink": (*(_INTEGER,) * 5, _POINTER, *(_INTEGER,) * 2, *(_POINTER,) * 2),
    "shrink_gradient": (*(_INTEGER,) * 5, _POINTER, *(_INTEGER,) * 2, *(_POINTER,) * 4),
    "expand": (*(_INTEGER,) * 5, _POINTER, *(_INTEGER,) * 2, *(_POINTER,) * 3),
    "expand_gradient": (*(_INTEGER,) * 5, _POINTER, *(_INTEGER,) * 2, *(_POINTER,) * 6),
}


class _Graph(ctypes.Structure):
    """`struct graph` of the C file."""

    _fields_ = (("nodes", _INTEGER), ("start", _POINTER), ("column", _POINTER), ("value", _POINTER))


class _Layer(ctypes.Structure):
    """`struct layer` of the C file."""

    _fields_ = (
        *((name, _INTEGER) for name in ("order", "width_in", "width_out", "narrow_in", "elu")),
        *((name, _POINTER) for name in ("forward", "backward", "bias", "x", "y", "moved")),
    )


@cache
def library() -> ctypes.CDLL | None:
    """The compiled functions with their argument types, or None where they were not built."""
    spec = find_spec("surrogates._convolution")
    if spec is None or spec.origin is None:
        return None
    try:
        found = ctypes.CDLL(spec.origin)
        for name, arguments in _SIGNATURES.items():
            for suffix in _SUFFIX.values():
                function = getattr(found, name + suffix)
                function.argtypes, function.restype = arguments, None
    except (OSError, AttributeError):  # built for another machine, or by another version
        return None
    return found


def _function(name: str, dtype: torch.dtype) -> Callable[..., None]:
    found = library()
    if found is None:
        raise SurrogateError("compiled convolutions were called for, but there are none; install with a C compiler")
    return getattr(found, name + _SUFFIX[dtype])


def usable(x: Tensor, operator: GraphOperator) -> bool:
    """Whether `x` on `operator` is a case for the compiled functions."""
    return (
        operator.kind == "cheb"
        and operator.form == "auto"
        and x.device.type == "cpu"
        and x.dtype in _SUFFIX
        and library() is not None
        and not torch.compiler.is_compiling()
    )


def encode(
    x: Tensor,
    operator: GraphOperator,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    elus: Sequence[bool],
    dense: tuple[Tensor, Tensor],
) -> Tensor:
    """Convolutions, then W h + b: (node, batch, in) -> (batch, latent).

    weights  (order, in, out) of each convolution's Chebyshev terms; biases (out); elus: whether ELU follows
    dense    W (latent, node * channel) and b (latent)
    """
    return _Encode.apply(x, operator, tuple(elus), *dense, *weights, *biases)


def decode(
    z: Tensor,
    operator: GraphOperator,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    elus: Sequence[bool],
    dense: tuple[Tensor, Tensor],
) -> Tensor:
    """ELU(W z + b), then convolutions: (batch, latent) -> (node, batch, out).

    In memory channel by channel, as gradients want it; in predictions node by node, so that what follows moves whole
    rows.

    dense    W (node * channel, latent) and b (node * channel); the others as in `encode`
    """
    if not torch.is_grad_enabled():
        return _predict(z, operator, tuple(elus), *dense, *weights, *biases)
    return _Decode.apply(z, operator, tuple(elus), *dense, *weights, *biases)


def _predict(
    z: Tensor, operator: GraphOperator, elus: tuple[bool, ...], weight: Tensor, bias: Tensor, *parameters: Tensor
) -> Tensor:
    """`decode` without a gradient: each thread takes one block after the other through the same room.

    What lies between the layers is then never the size of a whole run; getting that memory cost more than computing.
    """
    batch, blocks = len(z), _latent_blocks(z)
    size, latent = weight.shape
    weight, bias = weight.contiguous(), bias.contiguous()
    n, channels = operator.n_nodes, parameters[len(elus) - 1].shape[2]
    out = z.new_empty(len(blocks), n, channels, LANES)
    expand = _function("expand", z.dtype)

    def share(first: int, last: int) -> None:
        h = z.new_empty(1, size, LANES)
        stack = _Stack(operator, h.unflatten(1, (n, -1)), elus, parameters)
        addresses = (weight.data_ptr(), latent, 1, bias.data_ptr())
        for block in range(first, last):
            expand(0, size, 1, size, latent, *addresses, blocks[block].data_ptr(), h.data_ptr())
            stack.forward_into(out[block])

    _share(len(blocks), LANES * max(size, n * channels), share)
    return out.permute(1, 2, 0, 3).reshape(n, channels, -1)[..., :batch].contiguous().transpose(1, 2)


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        operator: GraphOperator,
        elus: tuple[bool, ...],
        weight: Tensor,
        bias: Tensor,
        *parameters: Tensor,
    ) -> Tensor:
        stack = _Stack(operator, _to_blocks(x.detach()), elus, parameters)
        h = stack.forward()
        ctx.stack, ctx.batch, ctx.weight = stack, x.shape[1], weight.detach().contiguous()
        z = _shrink(h, ctx.weight)
        return z.transpose(1, 2).reshape(-1, len(weight))[: ctx.batch].add_(bias)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        stack: _Stack = ctx.stack
        by_z = _latent_blocks(gradients[0])
        by_h, by_weight = _shrink_gradient(stack.y, ctx.weight, by_z)
        by_x, by_parameters = stack.backward(by_h, ctx.needs_input_grad[0])
        given = None if by_x is None else _from_blocks(by_x, ctx.batch)
        return given, None, None, by_weight, gradients[0].sum(dim=0), *by_parameters


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        z: Tensor,
        operator: GraphOperator,
        elus: tuple[bool, ...],
        weight: Tensor,
        bias: Tensor,
        *parameters: Tensor,
    ) -> Tensor:
        ctx.batch, ctx.z, ctx.weight = len(z), _latent_blocks(z.detach()), weight.detach().contiguous()
        h = _expand(ctx.z, ctx.weight, bias.detach().contiguous())
        ctx.stack = _Stack(operator, h.unflatten(1, (operator.n_nodes, -1)), elus, parameters)
        return _from_blocks(ctx.stack.forward(), ctx.batch)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        by_h, by_parameters = ctx.stack.backward(_to_blocks(gradients[0]), True)
        by_z, by_weight, by_bias = _expand_gradient(ctx.z, ctx.weight, ctx.stack.x, by_h)
        given = by_z.transpose(1, 2).reshape(-1, ctx.z.shape[1])[: ctx.batch]
        return given, None, None, by_weight, by_bias, *by_parameters


def _to_blocks(x: Tensor) -> Tensor:
    """(node, batch, channel) -> (block, node, channel, 16), the last block filled up with zeros."""
    n, batch, channels = x.shape
    if batch % LANES:
        x = torch.nn.functional.pad(x, (0, 0, 0, -batch % LANES))
    return x.reshape(n, -1, LANES, channels).permute(1, 0, 3, 2).contiguous()


def _from_blocks(blocks: Tensor, batch: int) -> Tensor:
    """(block, node, channel, 16) -> (node, batch, channel), in memory channel by channel."""
    _, n, channels, _ = blocks.shape
    return blocks.permute(2, 1, 0, 3).reshape(channels, n, -1)[..., :batch].permute(1, 2, 0)


def _latent_blocks(z: Tensor) -> Tensor:
    """(batch, latent) -> (block, latent, 16), the last block filled up with zeros."""
    if len(z) % LANES:
        z = torch.nn.functional.pad(z, (0, 0, 0, -len(z) % LANES))
    return z.reshape(-1, LANES, z.shape[1]).transpose(1, 2).contiguous()


# V (order, in, out) -> as `forward` and `backward` of `struct layer`, if narrow_in and if not
_AXES = {True: ((2, 0, 1), (0, 1, 2)), False: ((0, 2, 1), (1, 0, 2))}


class _Stack:
    """The convolutions behind each other on given blocks. Holds what their gradient needs: the states between the
    layers and their powers.

    parameters  the weights (order, in, out) of all layers by Chebyshev terms, then their biases (out)
    """

    def __init__(
        self, operator: GraphOperator, x: Tensor, elus: tuple[bool, ...], parameters: tuple[Tensor, ...]
    ) -> None:
        self.graph, arrays = _graph(operator, x.dtype)
        self.layers = (_Layer * len(elus))()
        self.shapes = [weight.shape for weight in parameters[: len(elus)]]
        self.x = self.y = x
        self.widest = operator.n_nodes * LANES * max(max(shape[1:]) for shape in self.shapes)
        self.kept: list[Any] = [arrays, x]
        for layer, weight, bias, elu in zip(self.layers, parameters, parameters[len(elus) :], elus):
            order, a, b = weight.shape
            narrow = a <= b or order == 1
            powers = of_powers(weight.detach())
            forward, backward = (powers.permute(axes).contiguous() for axes in _AXES[narrow])
            y = x.new_empty(len(x), operator.n_nodes, b, LANES)
            moved = x.new_empty(len(x), order - 1, operator.n_nodes, a if narrow else b, LANES)
            bias = bias.detach().contiguous()
            layer.order, layer.width_in, layer.width_out, layer.narrow_in, layer.elu = order, a, b, narrow, elu
            layer.forward, layer.backward, layer.bias = forward.data_ptr(), backward.data_ptr(), bias.data_ptr()
            layer.x, layer.y, layer.moved = self.y.data_ptr(), y.data_ptr(), moved.data_ptr()
            self.kept += [forward, backward, bias, y, moved]
            self.y = y

    def forward(self) -> Tensor:
        """(block, node, in, 16) -> (block, node, out, 16)"""
        run, ends = _function("stack_forward", self.x.dtype), (ctypes.byref(self.graph), len(self.layers), self.layers)
        _share(len(self.x), self.widest, lambda first, last: run(*ends, first, last))
        return self.y

    def forward_into(self, y: Tensor) -> None:
        """The result for the only block, put into y (node, out, 16)."""
        self.layers[-1].y = y.data_ptr()
        _function("stack_forward", self.x.dtype)(ctypes.byref(self.graph), len(self.layers), self.layers, 0, 1)

    def backward(self, by_y: Tensor, need_x: bool) -> tuple[Tensor | None, list[Tensor]]:
        """The gradients by x, if needed, and by the parameters."""
        by_y, nodes = by_y.contiguous(), self.graph.nodes
        by_x = torch.empty_like(self.x) if need_x else None
        sizes, widths = [shape.numel() for shape in self.shapes], [shape[2] for shape in self.shapes]
        widest = max(max(shape[1:]) for shape in self.shapes)
        run, ends = _function("stack_backward", by_y.dtype), (ctypes.byref(self.graph), len(sizes), self.layers)

        def share(first: int, last: int) -> Tensor:
            total = by_y.new_zeros(sum(sizes) + sum(widths) * LANES)
            room = by_y.new_empty(1 + max(shape[0] for shape in self.shapes), nodes, widest, LANES)
            by_bias = total.data_ptr() + sum(sizes) * total.itemsize
            addresses = (by_y.data_ptr(), _address(by_x), total.data_ptr(), by_bias, room.data_ptr())
            run(*ends, first, last, *addresses, widest)
            return total

        total = _total(_share(len(by_y), self.widest, share))
        by_weights, by_biases = total.split((sum(sizes), sum(widths) * LANES))
        weights = [of_terms(_by_weight(*each)) for each in zip(by_weights.split(sizes), self.shapes)]
        return by_x, [*weights, *by_biases.view(-1, LANES).sum(dim=1).split(widths)]


def _by_weight(flat: Tensor, shape: torch.Size) -> Tensor:
    """The gradient by V (order, in, out) from that by `forward`."""
    order, a, b = shape
    return flat.view(b, order, a).permute(1, 2, 0) if a <= b or order == 1 else flat.view(order, b, a).transpose(1, 2)


def _expand(z: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """ELU(W z + b): (block, latent, 16) -> (block, m, 16) with W (m, latent)."""
    size, latent = weight.shape
    h = z.new_empty(len(z), size, LANES)
    run, ends = _function("expand", z.dtype), (len(z), size, latent, weight.data_ptr(), latent, 1)
    addresses = (bias.data_ptr(), z.data_ptr(), h.data_ptr())
    _share(size, len(z) * LANES, lambda first, last: run(first, last, *ends, *addresses))
    return h


def _expand_gradient(z: Tensor, weight: Tensor, h: Tensor, by_h: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The gradients of `_expand` by z, W and b; h and by_h (block, node, channel, 16)."""
    size, latent = weight.shape
    by_weight, by_bias = torch.empty_like(weight), weight.new_empty(size)
    run = _function("expand_gradient", z.dtype)

    def share(first: int, last: int) -> Tensor:
        by_z = torch.zeros_like(z)
        addresses = (_address(t) for t in (z, h, by_h, by_z, by_weight, by_bias))
        run(first, last, len(z), size, latent, weight.data_ptr(), latent, 1, *addresses)
        return by_z

    return _total(_share(size, len(z) * LANES, share)), by_weight, by_bias


def _shrink(h: Tensor, weight: Tensor) -> Tensor:
    """W h: (block, node, channel, 16) -> (block, latent, 16) with W (latent, node * channel)."""
    latent, size = weight.shape
    run = _function("shrink", h.dtype)

    def share(first: int, last: int) -> Tensor:
        z = h.new_zeros(len(h), latent, LANES)
        run(first, last, len(h), size, latent, weight.data_ptr(), 1, size, h.data_ptr(), z.data_ptr())
        return z

    return _total(_share(size, len(h) * LANES, share))


def _shrink_gradient(h: Tensor, weight: Tensor, by_z: Tensor) -> tuple[Tensor, Tensor]:
    """The gradients of `_shrink` by h and W."""
    latent, size = weight.shape
    by_h, by_weight = torch.empty_like(h), torch.empty_like(weight)
    run, ends = _function("shrink_gradient", h.dtype), (len(h), size, latent, weight.data_ptr(), 1, size)
    addresses = (h.data_ptr(), by_z.data_ptr(), by_h.data_ptr(), by_weight.data_ptr())
    _share(size, len(h) * LANES, lambda first, last: run(first, last, *ends, *addresses))
    return by_h, by_weight


def _graph(operator: GraphOperator, dtype: torch.dtype) -> tuple[_Graph, tuple[Any, ...]]:
    """The operator as the C functions take it, and the arrays that must outlive it; made once for each type."""
    if dtype not in operator.compiled:
        matrix, real = operator.matrix, np.float32 if dtype == torch.float32 else np.float64
        parts = ((matrix.indptr, np.int32), (matrix.indices, np.int32), (matrix.data, real))
        arrays = tuple(np.ascontiguousarray(part, kind) for part, kind in parts)
        operator.compiled[dtype] = (_Graph(operator.n_nodes, *(array.ctypes.data for array in arrays)), arrays)
    return operator.compiled[dtype]


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


Result = TypeVar("Result")


def _share(items: int, size: int, run: Callable[[int, int], Result]) -> list[Result]:
    """`run(first, last)` over items 0 .. items - 1 of `size` numbers, shared among torch's threads where that pays.

    Results come in the order of the items, whichever thread is done first.
    """
    threads = min(items, torch.get_num_threads()) if items * size >= SHARED_FROM else 1
    if threads == 1:
        return [run(0, items)]
    bounds = [items * k // threads for k in range(threads + 1)]
    others = [_pool(os.getpid(), threads - 1).submit(run, *pair) for pair in pairwise(bounds[1:])]
    return [run(*bounds[:2]), *(other.result() for other in others)]


def _total(parts: list[Tensor]) -> Tensor:
    return sum(parts[1:], parts[0])


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Helpers of the calling thread; a forked process gets its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="convolution")
