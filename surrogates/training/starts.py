"""Linear parts of a reduction, computed from the training states instead of trained from nothing.

On the coarsest level they are POD modes, each divided by its coefficients' RMS, so that latent vectors are of order
one. On a finer level with `add` the latent vectors become those of the level's own POD, turned within the modes so that
they agree with the coarse ones as far as they can (orthogonal Procrustes problem: Schoenemann 1966,
doi 10.1007/BF02289451); with `concat`, modes of the detail x - U D x stand beside the coarse latent vector. The decoder
makes up what the upsampled coarse reconstruction leaves, by regression on the latent vector.
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
from surrogates.reductions.reduction import LinearReduction, LinearStart, flat, linear_part

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
    else:
        modes = pod_start(batches(), own, level.n_nodes)
        turned = _turned(modes.encode, batches(), level)
        linear.encode_matrix.copy_(turned - _below(level, own))
    linear.decode_matrix.zero_()
    linear.offset.zero_()

    def remainders() -> Iterator[tuple[Tensor, Tensor]]:
        for x in batches():
            z = level.encode(x)
            yield z, x - level.lifted(z)

    _regress(linear, remainders(), at_rest=level.at_rest)


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


def _regress(linear: LinearReduction, pairs: Iterable[tuple[Tensor, Tensor]], *, at_rest: bool = False) -> None:
    """Set the decoder to the least-squares map from z (b, latent) to states (node, b, 3); zero from zero with `at_rest`."""
    size = linear.decode_matrix.shape[1] + 1
    moments = torch.zeros(size, size, dtype=torch.float64)
    product = torch.zeros(size, len(linear.offset), dtype=torch.float64)
    for z, left in pairs:
        constant = torch.full_like(z[:, :1], 0.0 if at_rest else 1.0)
        with_one = torch.cat([z, constant], dim=1).double()
        moments += with_one.T @ with_one
        product += with_one.T @ flat(left).double()
    ridge = torch.diag((_RIDGE * moments.diagonal()).clamp_min(_RIDGE * 1e-12))
    solved = torch.linalg.solve(moments + ridge, product).float()
    linear.decode_matrix.copy_(solved[:-1].T)
    linear.offset.copy_(solved[-1])


def _turned(encode: Tensor, batches: Iterator[Tensor], level: LevelNetwork) -> Tensor:
    """The encoder (3 * node, r) of POD, its latent numbers turned towards those of the coarse level."""
    agreement = torch.zeros(encode.shape[1], encode.shape[1], dtype=torch.float64)
    for x in batches:
        below = level.coarse.encode(level.restrict(x))  # type: ignore[union-attr]
        agreement[:, : below.shape[1]] += ((flat(x) @ encode).T @ below).double()
    left, _, right = torch.linalg.svd(agreement)
    turned: Tensor = encode @ (left @ right).float()
    return turned


def _below(level: LevelNetwork, latent: int) -> Tensor:
    """(3 * node, latent): what the coarse levels' linear parts encode, as columns over this level's nodes."""
    out = torch.zeros(level.n_nodes, 3, latent)
    coarse = level.coarse
    if coarse is None:
        return out.flatten(0, 1)
    linear = linear_part(coarse.reduction)
    if linear is not None:
        own = linear.encode_matrix
        whole = _below(coarse, own.shape[1]) + own
        out[level.in_finer, :, : own.shape[1]] = whole.unflatten(0, (coarse.n_nodes, 3)) / level.ratio
    return out.flatten(0, 1)


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
