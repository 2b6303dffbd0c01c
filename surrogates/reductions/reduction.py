"""Reductions: states (node, batch, 3) to latent vectors (batch, latent) and back.

Each is a module with `encode` and `decode`; a level does not care which one it holds. Adding a reduction is one class and
one call of `register`, here or in a package of your own (`examples/add_reduction.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.errors import SurrogateError
from surrogates.operators.graph import GraphOperator
from surrogates.operators.stacks import GraphDecoder, GraphEncoder
from surrogates.regression.network import fully_connected
from surrogates.settings import REDUCTIONS, LevelSettings

Part: TypeAlias = Literal["encoder", "decoder"]


class Reduction(nn.Module):
    """What a level needs of a reduction."""

    def encode(self, x: Tensor) -> Tensor:
        """(node, batch, 3) -> (batch, latent)"""
        raise SurrogateError(f"{type(self).__name__} cannot encode")

    def decode(self, z: Tensor) -> Tensor:
        """(batch, latent) -> (node, batch, 3)"""
        raise SurrogateError(f"{type(self).__name__} cannot decode")

    def decode_only(self) -> None:
        """Give up the encoder, where another level encodes (only `unified` needs it)."""
        raise SurrogateError(f"{type(self).__name__} cannot do without its encoder; set unified=false")

    def end_at_zero(self) -> None:
        """Give zero in both directions until training moves it, beside a linear part (only `level.start=pod` needs it)."""
        raise SurrogateError(f"{type(self).__name__} cannot stand beside a linear part; set level.start=plain")

    def last_layer(self, part: Part) -> nn.Module | None:
        """The layer that `end_at_zero` sets to zero, without which this part gives zero; None where there is no such one."""
        return None


@dataclass(frozen=True)
class LinearStart:
    """Where a linear reduction starts: z = encode^T x, x = decode z + offset.

    Attributes
    ----------
    encode
        (3 * node, latent), decode (3 * node, latent), offset (3 * node,).
    """

    encode: Tensor
    decode: Tensor
    offset: Tensor


class GraphReduction(Reduction):
    """Graph convolutions, then one dense linear layer; the decoder in reverse order (section 3.3, table 1)."""

    def __init__(self, operator: GraphOperator, latent: int, decoded: int, channels: Sequence[int], order: int) -> None:
        super().__init__()
        widths = (3, *channels)
        self.encoder = GraphEncoder(operator, latent, widths, order)
        self.decoder = GraphDecoder(operator, decoded, widths[::-1], order)

    def encode(self, x: Tensor) -> Tensor:
        with _full_precision(x):
            result: Tensor = self.encoder(x.float())
            return result

    def decode(self, z: Tensor) -> Tensor:
        with _full_precision(z):
            result: Tensor = self.decoder(z.float())
            return result

    def end_at_zero(self) -> None:
        """Both ends at zero: what stands beside this reduction is all there is, until training moves it."""
        for layer in (self.last_layer("encoder"), self.last_layer("decoder")):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)

    def last_layer(self, part: Part) -> nn.Module:
        return self.encoder.dense if part == "encoder" else _last_layer(self.decoder)

    def decode_only(self) -> None:
        del self.encoder


class DenseReduction(Reduction):
    """Fully connected autoencoder 3n -> hidden -> latent with ELU, the decoder in reverse order (table 1)."""

    def __init__(self, n_nodes: int, latent: int, decoded: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.n_nodes = n_nodes
        self.encoder = fully_connected((3 * n_nodes, *hidden, latent))
        self.decoder = fully_connected((decoded, *hidden[::-1], 3 * n_nodes))

    def encode(self, x: Tensor) -> Tensor:
        result: Tensor = self.encoder(flat(x))
        return result

    def decode(self, z: Tensor) -> Tensor:
        return unflat(self.decoder(z), self.n_nodes)

    def end_at_zero(self) -> None:
        for layer in (self.last_layer("encoder"), self.last_layer("decoder")):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)

    def last_layer(self, part: Part) -> nn.Module:
        return (self.encoder if part == "encoder" else self.decoder)[-1]

    def decode_only(self) -> None:
        del self.encoder


class LinearReduction(Reduction):
    """z = E^T x and x = D z + offset: POD, fixed or as a trainable start."""

    def __init__(self, n_nodes: int, latent: int, decoded: int, *, trainable: bool) -> None:
        super().__init__()
        self.n_nodes = n_nodes
        self.encode_matrix = nn.Parameter(torch.zeros(3 * n_nodes, latent), requires_grad=trainable)
        self.decode_matrix = nn.Parameter(torch.zeros(3 * n_nodes, decoded), requires_grad=trainable)
        self.offset = nn.Parameter(torch.zeros(3 * n_nodes), requires_grad=trainable)

    def start_at(self, start: LinearStart) -> None:
        """Take over the matrices of `start`."""
        with torch.no_grad():
            for mine, given in ((self.encode_matrix, start.encode), (self.decode_matrix, start.decode)):
                if mine.shape != given.shape:
                    raise SurrogateError(f"a linear start of shape {tuple(given.shape)}; expected {tuple(mine.shape)}")
                mine.copy_(given)
            self.offset.copy_(start.offset)

    def encode(self, x: Tensor) -> Tensor:
        return flat(x) @ self.encode_matrix

    def decode(self, z: Tensor) -> Tensor:
        return unflat(torch.addmm(self.offset, z, self.decode_matrix.t()), self.n_nodes)

    def added(self, x: Tensor, z: Tensor) -> Tensor:
        """x + decode(z), in place where x lies node by node in memory, channel by channel within a node."""
        by_channel = x.transpose(1, 2)
        if not by_channel.is_contiguous():
            return x + self.decode(z)
        by_channel.flatten(0, 1).addmm_(self.decode_matrix, z.t()).add_(self.offset[:, None])
        return x

    def decode_only(self) -> None:
        del self.encode_matrix


class SumReduction(Reduction):
    """A linear reduction and a nonlinear one, added in both directions."""

    def __init__(self, linear: LinearReduction, remainder: Reduction) -> None:
        super().__init__()
        self.linear = linear
        self.remainder = remainder
        remainder.end_at_zero()

    def encode(self, x: Tensor) -> Tensor:
        linear = self.linear.encode(x)
        return linear if self._untrained("encoder") else linear + self.remainder.encode(x)

    def decode(self, z: Tensor) -> Tensor:
        if self._untrained("decoder"):
            nonlinear = z.new_zeros(self.linear.n_nodes, 3, len(z)).transpose(1, 2)
        else:
            nonlinear = self.remainder.decode(z)
        return self.linear.decode(z) + nonlinear if torch.is_grad_enabled() else self.linear.added(nonlinear, z)

    def _untrained(self, part: Part) -> bool:
        """Whether this part of the remainder still gives zero, so that it need not be computed.

        Only without gradients and on a CPU, where weights can be looked at; what is exported has everything.
        """
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or torch.compiler.is_exporting():
            return False
        last = self.remainder.last_layer(part)
        if last is None or self.linear.offset.device.type != "cpu":
            return False
        # The first number of a trained layer tells already; all are looked at only where it is zero.
        return all(not bool(p.flatten()[0]) and not bool(p.any()) for p in last.parameters())

    def decode_only(self) -> None:
        self.linear.decode_only()
        self.remainder.decode_only()


# Settings, edges (e, 2) where the mesh has them, number of nodes, and the length of the latent vector that is decoded.
Maker = Callable[[LevelSettings, NDArray[np.int32] | None, int, int], Reduction]


def _graph(settings: LevelSettings, edges: NDArray[np.int32] | None, n_nodes: int, decoded: int) -> Reduction:
    if edges is None:
        raise SurrogateError(
            "graph convolutions need the edges of the mesh, and it has none; choose level.reduction=ae"
        )
    operator = GraphOperator(edges, n_nodes, kind=settings.convolution)
    return GraphReduction(operator, settings.latent, decoded, settings.channels, settings.order)


def _dense(settings: LevelSettings, edges: NDArray[np.int32] | None, n_nodes: int, decoded: int) -> Reduction:
    return DenseReduction(n_nodes, settings.latent, decoded, settings.hidden)


def _pod(settings: LevelSettings, edges: NDArray[np.int32] | None, n_nodes: int, decoded: int) -> Reduction:
    return LinearReduction(n_nodes, settings.latent, decoded, trainable=False)


_MAKERS: dict[str, Maker] = {"gcn": _graph, "ae": _dense, "pod": _pod}


def register(name: str, make: Maker) -> None:
    """Let settings say `level.reduction=name`. Models stored with it load where it is registered, too.

    Parameters
    ----------
    make
        (settings, edges, n_nodes, decoded) -> Reduction; `decoded` is longer than `settings.latent` where the
        latent vectors of several levels stand side by side.
    """
    if name not in REDUCTIONS:
        REDUCTIONS.append(name)
    _MAKERS[name] = make


def make_reduction(
    settings: LevelSettings, edges: NDArray[np.int32] | None, n_nodes: int, decoded: int | None = None
) -> Reduction:
    """The reduction that `settings` describe, on `n_nodes` nodes with graph edges (e, 2).

    `decoded` is the length of the latent vector that the decoder reads; default: the encoder's.

    Raises
    ------
    SurrogateError
        For a latent vector longer than the state.
    """
    latent, decoded = settings.latent, decoded or settings.latent
    if latent > 3 * n_nodes:
        raise SurrogateError(
            f"latent size {latent} exceeds the {3 * n_nodes} displacements of {n_nodes} nodes; choose a smaller level.latent"
        )
    made = _MAKERS[settings.reduction](settings, edges, n_nodes, decoded)
    if settings.start == "plain" or isinstance(made, LinearReduction):
        return made
    return SumReduction(LinearReduction(n_nodes, latent, decoded, trainable=True), made)


def linear_part(reduction: Reduction) -> LinearReduction | None:
    """The linear reduction in it, if there is one."""
    if isinstance(reduction, SumReduction):
        return reduction.linear
    return reduction if isinstance(reduction, LinearReduction) else None


def flat(x: Tensor) -> Tensor:
    """(node, batch, 3) -> (batch, 3 * node), the coordinates of a node side by side."""
    return x.transpose(0, 1).reshape(x.shape[1], -1)


def unflat(rows: Tensor, n_nodes: int) -> Tensor:
    """(batch, 3 * node) -> (node, batch, 3)"""
    return rows.view(rows.shape[0], n_nodes, 3).transpose(0, 1)


def _full_precision(x: Tensor) -> torch.autocast:
    """Convolutions are bound by memory, and their gradient is written by hand: mixed precision leaves them alone."""
    return torch.autocast(x.device.type, enabled=False)


def _last_layer(decoder: GraphDecoder) -> nn.Module:
    after = decoder.convolutions.after
    return after if isinstance(after, nn.Linear) else decoder.convolutions.layers[-1]
