"""Graph convolutions on states laid out as [node, batch, channel], and the encoder and decoder stacks made of them.

On a CPU, stacks of Chebyshev convolutions run in compiled code (`surrogates.operators.compiled`) where it could be built. What
follows is the same in torch, for everything else.

Inside, a state is held as [channel, node, batch]. Then, without a copy, each channel is a matrix (n, b) for the sparse
operator, all channels are one matrix (c, n*b) whose channels one wide product mixes, the powers of the operator stand
below each other as further channels, and the dense layer at the latent reads the state as (c*n, b). A state whose
memory already has that order (`buffer.permute(1, 2, 0)`) passes through without being copied. The graph is the same
for every sample, so its operator is normalised once, when it is made, and never again.

How a level is assembled::

    operator = GraphOperator(edges, n_nodes)                       # kind="cheb" | "gcn" | "gcn2"
    encoder = GraphEncoder(operator, latent=4, channels=(3, 6, 12, 24), order=3)
    decoder = GraphDecoder(operator, latent=4, channels=(24, 12, 6, 3), order=3)
    z = encoder(x)                                                  # (n, b, 3) -> (b, 4)
    both = decoder(torch.cat([z, mlp(inputs)]))                     # (2b, 4) -> (n, 2b, 3): one pass for both losses
    reconstruction, approximation = both.chunk(2, dim=1)

`with exportable(model): torch.export.export(...)` swaps every operator for its dense form while it lasts, which
torch.export and ONNX accept.

Sources: Defferrard, Bresson, Vandergheynst 2016 (ChebConv); Kipf and Welling 2017 (GCNConv); Chen et al. 2020
(GCN2Conv, GCNII); Kneifl et al. 2024, section 3.3 (the stacks).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import eigsh
from torch import Tensor, nn
from torch.nn import functional

from surrogates.errors import SurrogateError
from surrogates.operators import compiled
from surrogates.operators.chebyshev import of_powers, of_terms

Kind = Literal["cheb", "gcn", "gcn2"]
Form = Literal["auto", "sparse", "dense"]

# Up to this many nodes one small dense product beats the sparse one; measured with `benchmarks/train_step.py --forms`.
DENSE_UP_TO = {"cpu": 32, "cuda": 512, "mps": 4096}
# Up to this many nodes all channels move in one sparse product.
WIDE_UP_TO = 2048


class GraphOperator:
    """The symmetric n x n matrix that moves a state along the edges of one graph.

    kind "cheb"           2 L / lambda_max - I with L = I - D^-1/2 A D^-1/2; lambda_max is L's largest eigenvalue
    kind "gcn" or "gcn2"  (D + I)^-1/2 (A + I) (D + I)^-1/2

    edges    (e, 2) int, undirected; both directions, repeated edges and loops are allowed and count once (loops not)
    n_nodes  number of nodes; a node without an edge has D^-1/2 = 0, so its row of L is that of I
    form     "sparse", "dense", or "auto": dense up to `DENSE_UP_TO` nodes of the device in use

    Raises SurrogateError where an edge names a node that is not there, or the graph has no node.
    """

    def __init__(self, edges: ArrayLike, n_nodes: int, kind: Kind = "cheb", form: Form = "auto") -> None:
        if kind not in ("cheb", "gcn", "gcn2"):
            raise SurrogateError(f"convolution {kind!r} is unknown; choose cheb, gcn or gcn2")
        self.n_nodes = int(n_nodes)
        self.kind = kind
        self.form: Form = form
        adjacency = _adjacency(np.asarray(edges), self.n_nodes)
        if kind == "cheb":
            laplacian = normalised_laplacian(adjacency)
            self.lambda_max = largest_eigenvalue(laplacian)
            matrix = 2.0 / self.lambda_max * laplacian - sparse.identity(self.n_nodes)
        else:
            self.lambda_max = math.nan
            matrix = _scaled_by_degree(adjacency + sparse.identity(self.n_nodes))
        self.matrix: sparse.csr_matrix = sparse.csr_matrix(matrix)
        self.matrix.sort_indices()
        self._tensors: dict[tuple[torch.device, torch.dtype, int], Tensor] = {}
        self.compiled: dict[torch.dtype, Any] = {}  # what `surrogates.operators.compiled` made of it

    def dense_form(self) -> GraphOperator:
        """The same operator held as a dense matrix (n, n), as torch.export and ONNX need it."""
        return self.with_form("dense")

    def with_form(self, form: Form) -> GraphOperator:
        """The same operator in another form; the graph is not normalised again."""
        other = object.__new__(GraphOperator)
        other.__dict__.update(self.__dict__)
        other.form = form
        other._tensors = {}
        return other

    def is_dense(self, device: torch.device) -> bool:
        """Whether the dense form is used on `device`."""
        if self.form == "auto":
            return self.n_nodes <= DENSE_UP_TO.get(device.type, DENSE_UP_TO["cpu"])
        return self.form == "dense"

    def propagate(self, x: Tensor) -> Tensor:
        """The operator times every channel: (channel, n, batch) -> same. Differentiable any number of times."""
        return self.times(x) if self.is_dense(x.device) else _Propagate.apply(x, self)

    def times(self, x: Tensor, out: Tensor | None = None, *, add: bool = False) -> Tensor:
        """`propagate` without a gradient of its own; into `out`, and added to what stands there if `add`."""
        channels, n, batch = x.shape
        x = x.contiguous()
        if self.is_dense(x.device):
            moved = torch.matmul(self.tensor(x.device, x.dtype), x)
            if out is None:
                return moved
            return out.add_(moved) if add else out.copy_(moved)
        out = torch.empty_like(x) if out is None else out
        if n <= WIDE_UP_TO:  # one call for all channels costs least
            matrix = self.tensor(x.device, x.dtype, channels)
            _sparse_product(matrix, x.view(-1, batch), out.view(-1, batch), add)
        else:  # one call for each keeps a channel in cache
            matrix = self.tensor(x.device, x.dtype)
            for source, target in zip(x, out):
                _sparse_product(matrix, source, target, add)
        return out

    def tensor(self, device: torch.device, dtype: torch.dtype, repeats: int = 1) -> Tensor:
        """The matrix (n, n) on `device`, CSR or dense as the form says; `repeats` times along the diagonal of a CSR.

        Made once for each device, type and number of repeats.
        """
        key = (device, dtype, repeats)
        if key not in self._tensors:
            self._tensors[key] = self._make(device, dtype, repeats)
        return self._tensors[key]

    def _make(self, device: torch.device, dtype: torch.dtype, repeats: int) -> Tensor:
        if self.is_dense(device):
            return torch.from_numpy(self.matrix.toarray()).to(device, dtype)
        matrix = sparse.csr_matrix(sparse.block_diag([self.matrix] * repeats))
        rows, columns = (torch.from_numpy(part.astype(np.int32)) for part in (matrix.indptr, matrix.indices))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
            csr = torch.sparse_csr_tensor(
                rows, columns, torch.from_numpy(matrix.data), size=matrix.shape, check_invariants=True
            )
            return csr.to(device=device, dtype=dtype)

    def __repr__(self) -> str:
        return f"GraphOperator({self.n_nodes} nodes, {self.matrix.nnz} entries, {self.kind}, {self.form})"


def _sparse_product(matrix: Tensor, x: Tensor, out: Tensor, add: bool) -> None:
    """out = matrix x, added to `out` if `add`."""
    if add:
        torch.addmm(out, matrix, x, out=out)
    else:
        torch.mm(matrix, x, out=out)


def normalised_laplacian(adjacency: sparse.spmatrix) -> sparse.csr_matrix:
    """L = I - D^-1/2 A D^-1/2 (n, n) of a symmetric 0/1 adjacency (n, n); D^-1/2 is 0 where a node has no edge."""
    return sparse.csr_matrix(sparse.identity(adjacency.shape[0]) - _scaled_by_degree(adjacency))


def largest_eigenvalue(laplacian: sparse.spmatrix) -> float:
    """lambda_max of a symmetric positive semi-definite matrix (n, n), to machine precision."""
    n = laplacian.shape[0]
    if n <= 64:
        return float(np.linalg.eigvalsh(laplacian.toarray())[-1])
    start = np.random.default_rng(0).standard_normal(n)
    return float(eigsh(laplacian, k=1, which="LA", v0=start, return_eigenvectors=False)[0])


def _adjacency(edges: NDArray[Any], n_nodes: int) -> sparse.csr_matrix:
    """Symmetric 0/1 adjacency (n, n) without loops."""
    if n_nodes < 1:
        raise SurrogateError(f"a graph of {n_nodes} nodes was asked for; it needs at least one")
    edges = edges.reshape(0, 2) if edges.size == 0 else edges
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise SurrogateError(f"edges have the shape {edges.shape}; expected (edge, 2)")
    edges = edges.astype(np.int64)
    if edges.size and (edges.min() < 0 or edges.max() >= n_nodes):
        raise SurrogateError(f"edges name the nodes {edges.min()} to {edges.max()}; the graph has 0 to {n_nodes - 1}")
    i, j = edges[edges[:, 0] != edges[:, 1]].T
    one = sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(n_nodes, n_nodes))
    return sparse.csr_matrix(((one + one.T) > 0).astype(np.float64))


def _scaled_by_degree(adjacency: sparse.spmatrix) -> sparse.csr_matrix:
    """D^-1/2 A D^-1/2 with D the row sums of A."""
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    root = np.divide(1.0, np.sqrt(degree), out=np.zeros_like(degree), where=degree > 0)
    return sparse.csr_matrix(sparse.diags(root) @ adjacency @ sparse.diags(root))


class _Propagate(torch.autograd.Function):
    """Sparse product with a symmetric matrix: its own transpose, so its derivative is itself."""

    @staticmethod
    def forward(x: Tensor, operator: GraphOperator) -> Tensor:
        return operator.times(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.operator = inputs[1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _Propagate.apply(gradients[0], ctx.operator), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _Propagate.apply(tangents[0], ctx.operator)


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
    return torch.tensordot(weight.t(), x, dims=1)


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


class ChebConv(nn.Module):
    """y = sum_k T_k(L) x W_k + b, then ELU if asked: (node, batch, in) -> (node, batch, out).

    order     number of Chebyshev terms; 3 means T_0, T_1, T_2 (Defferrard et al. 2016, equation 4)
    operator  a GraphOperator of kind "cheb"
    elu       apply ELU to the result, in place

    Parameters: weight (order, in, out), Glorot-uniform for each term; bias (out), zero.
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
        _check_state(x, self.operator, self.weight.shape[1])
        inside = x.permute(2, 0, 1)
        if self.operator.form == "dense":
            out = _plain_cheb(inside, self.weight, self.bias, self.operator)
            out = functional.elu(out) if self.elu else out
        else:
            out = _Cheb.apply(inside, self.weight, self.bias, self.operator, self.elu)
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
        _check_state(x, self.operator, channels)
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
        _check_state(x, self.operator, self.weight.shape[0])
        h = (1.0 - self.alpha) * self.operator.propagate(x.permute(2, 0, 1)) + self.alpha * x0.permute(2, 0, 1)
        out = (1.0 - self.beta) * h + self.beta * _mix(h, self.weight)
        return (functional.elu(out) if self.elu else out).permute(1, 2, 0)


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

    def of_chebyshev(self) -> tuple[GraphOperator, list[Tensor], list[Tensor], list[bool]]:
        """Operator, weights, biases and whether ELU follows, of a stack of Chebyshev convolutions."""
        layers = [layer for layer in self.layers if isinstance(layer, ChebConv)]
        biases = [
            layer.weight.new_zeros(layer.weight.shape[2]) if layer.bias is None else layer.bias for layer in layers
        ]
        return self.operator, [layer.weight for layer in layers], biases, [layer.elu for layer in layers]

    def forward(self, x: Tensor) -> Tensor:
        x = self.before(x)
        x0 = x
        for layer in self.layers:
            x = layer(x, x0) if isinstance(layer, GCN2Conv) else layer(x)
        return self.after(x)


class GraphEncoder(nn.Module):
    """Convolutions, then one dense linear layer: x (node, batch, channels[0]) -> z (batch, latent).

    The dense layer's inputs are ordered node by node, channel by channel within a node.
    Source: Kneifl et al. 2024, section 3.3 and table 1.
    """

    def __init__(
        self, operator: GraphOperator, latent: int, channels: Sequence[int] = (3, 6, 12, 24), order: int = 3
    ) -> None:
        super().__init__()
        self.channels = channels[0]
        self.convolutions = Convolutions(operator, channels, order, linear_end=False)
        self.dense = nn.Linear(operator.n_nodes * channels[-1], latent)

    def forward(self, x: Tensor) -> Tensor:
        operator = self.convolutions.operator
        if compiled.usable(x, operator):
            _check_state(x, operator, self.channels)
            return compiled.encode(x, *self.convolutions.of_chebyshev(), (self.dense.weight, self.dense.bias))
        h = self.convolutions(x)
        if operator.form == "dense":
            return functional.linear(h.transpose(0, 1).flatten(1), self.dense.weight, self.dense.bias)
        weight = self.dense.weight.unflatten(1, (operator.n_nodes, -1)).transpose(1, 2).flatten(1)
        return _Encode.apply(h.permute(2, 0, 1).reshape(-1, h.shape[1]), weight, self.dense.bias)


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
        if compiled.usable(z, operator):
            return compiled.decode(z, *self.convolutions.of_chebyshev(), (weight, bias))
        if operator.form == "dense":
            h = functional.elu(functional.linear(z, weight, bias))
            return self.convolutions(h.unflatten(1, (self.n_nodes, self.channels)).transpose(0, 1))
        weight = weight.unflatten(0, (self.n_nodes, self.channels)).transpose(0, 1).flatten(0, 1)
        bias = bias.unflatten(0, (self.n_nodes, self.channels)).t().flatten()
        h = _Decode.apply(z, weight, bias)
        return self.convolutions(h.reshape(self.channels, self.n_nodes, -1).permute(1, 2, 0))


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


def _check_state(x: Tensor, operator: GraphOperator, channels: int) -> None:
    if x.ndim != 3 or x.shape[0] != operator.n_nodes or x.shape[2] != channels:
        raise SurrogateError(
            f"a state has the shape {tuple(x.shape)}; expected ({operator.n_nodes} nodes, batch, {channels} channels)"
        )
