"""Linear parts of a reduction, computed from the training states instead of trained from nothing.

On the coarsest level they are POD modes, each divided by its coefficients' RMS, so that latent vectors are of order
one. On a finer level they make up what the upsampled coarse reconstruction leaves: with `add`, the regression of that
remainder on the coarse latent vector; with `concat`, modes of the detail x - U D x beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import torch
from torch import Tensor

from data_schema.pod import pod
from surrogates.errors import SurrogateError
from surrogates.models.level import LevelNetwork
from surrogates.models.unified import Unified
from surrogates.reductions.reduction import LinearReduction, LinearStart, flat

# Gives the training states, some (node, b, 3) at a time, as often as it is called.
Batches = Callable[[], Iterator[Tensor]]

# Relative to the mean square of a latent number; keeps the regression well posed where two of them agree.
_RIDGE = 1e-5


def pod_start(batches: Iterator[Tensor], count: int, n_nodes: int) -> LinearStart:
    """POD modes of states (node, b, 3), scaled: decode = V s, encode = V / s with s the RMS of each coefficient.

    Where the states span fewer than `count` directions the other columns are zero.
    """
    samples = 0

    def runs() -> Iterator[np.ndarray]:
        nonlocal samples
        for x in batches:
            samples += x.shape[1]
            yield x.transpose(0, 1).cpu().numpy()

    found = pod(runs(), count)
    spread = found.singular_values / np.sqrt(samples)
    encode, decode = torch.zeros(3 * n_nodes, count), torch.zeros(3 * n_nodes, count)
    known = found.modes.shape[1]
    if spread[0] > 0:
        encode[:, :known] = torch.from_numpy(found.modes / spread.astype(np.float32))
        decode[:, :known] = torch.from_numpy(found.modes * spread.astype(np.float32))
    return LinearStart(encode, decode, torch.zeros(3 * n_nodes))


@torch.no_grad()
def start_level(level: LevelNetwork, linear: LinearReduction, batches: Batches) -> None:
    """Compute the linear part `linear` of an untrained `level`."""
    own = linear.encode_matrix.shape[1]
    if level.coarse is None:
        linear.start_at(pod_start(batches(), own, level.n_nodes))
        return
    if level.concat:
        detail = pod_start((x - _interpolated(level, x) for x in batches()), own, level.n_nodes)
        linear.encode_matrix.copy_(detail.encode - _back(level, detail.encode))
    linear.decode_matrix.zero_()
    linear.offset.zero_()

    def remainders() -> Iterator[tuple[Tensor, Tensor]]:
        for x in batches():
            z = level.encode(x)
            yield z, x - level.lifted(z)

    _regress(linear, remainders())


@torch.no_grad()
def start_unified(network: Unified, batches: Batches) -> None:
    """Compute the linear parts of all levels: POD encodes on the finest, each decoder takes what is left to it."""
    parts = network.linear_parts()
    finest = network.numbers[-1]
    if finest not in parts:
        return
    parts[finest].encode_matrix.copy_(pod_start(batches(), network.latent(finest), network.n_nodes).encode)
    for number, part in parts.items():
        part.decode_matrix.zero_()
        part.offset.zero_()

        def remainders(number: int = number) -> Iterator[tuple[Tensor, Tensor]]:
            for x in batches():
                z = network.encode(x)
                yield z, network.restrict(x, number) - network.decode_all(z, number)[number]

        _regress(part, remainders())


def _regress(linear: LinearReduction, pairs: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Set the decoder to the least-squares map from z (b, latent) to states (node, b, 3)."""
    size = linear.decode_matrix.shape[1] + 1
    moments = torch.zeros(size, size, dtype=torch.float64)
    product = torch.zeros(size, len(linear.offset), dtype=torch.float64)
    for z, left in pairs:
        with_one = torch.cat([z, torch.ones_like(z[:, :1])], dim=1).double()
        moments += with_one.T @ with_one
        product += with_one.T @ flat(left).double()
    ridge = torch.diag(_RIDGE * moments.diagonal().clamp_min(1e-12))
    solved = torch.linalg.solve(moments + ridge, product).float()
    linear.decode_matrix.copy_(solved[:-1].T)
    linear.offset.copy_(solved[-1])


def _interpolated(level: LevelNetwork, x: Tensor) -> Tensor:
    """U D x: what interpolation between the coarse nodes already gives."""
    if level.upsampling is None:
        raise SurrogateError("the coarsest level has nothing below it")
    lifted: Tensor = level.upsampling(x[level.in_finer])
    return lifted


def _back(level: LevelNetwork, matrix: Tensor) -> Tensor:
    """(U D)^T times the columns of `matrix` (3 * node, r): encode^T (x - U D x) = (encode - back)^T x."""
    up = level.upsampling.as_matrix()  # type: ignore[union-attr]
    fields = matrix.reshape(level.n_nodes, -1)
    out = torch.zeros_like(fields)
    out[level.in_finer] = up.T @ fields
    return out.reshape(matrix.shape)
