"""The operator of a graph: the matrix that moves a state along its edges.

The graph is the same for every sample, so its operator is normalised once, when it is made, and never again.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import eigsh
from torch import Tensor

from data_schema.edges import adjacency, unique_pairs
from surrogates.errors import SurrogateError

ConvolutionKind = Literal["cheb", "gcn", "gcn2"]
Form = Literal["auto", "sparse", "dense"]

# Up to this many nodes one dense product beats the sparse one: on a CPU at no size (`benchmarks/train_step.py --forms`).
DENSE_UP_TO = {"cpu": 0, "cuda": 512, "mps": 4096}
# Up to this many nodes all channels move in one sparse product.
WIDE_UP_TO = 2048


class GraphOperator:
    """The symmetric n x n matrix that moves a state along the edges of one graph.

    kind "cheb"           2 L / lambda_max - I with L = I - D^-1/2 A D^-1/2; lambda_max is L's largest eigenvalue
    kind "gcn" or "gcn2"  (D + I)^-1/2 (A + I) (D + I)^-1/2

    edges    (e, 2) int, undirected; both directions, repeated edges and loops are allowed and count once (loops not)

    Raises SurrogateError where an edge names a node that is not there, or the graph has no node.

    Attributes
    ----------
    n_nodes
        Number of nodes; a node without an edge has D^-1/2 = 0, so its row of L is that of I.
    form
        "sparse", "dense", or "auto": dense up to `DENSE_UP_TO` nodes of the device in use.
    """

    def __init__(self, edges: ArrayLike, n_nodes: int, kind: ConvolutionKind = "cheb", form: Form = "auto") -> None:
        if kind not in ("cheb", "gcn", "gcn2"):
            raise SurrogateError(f"convolution {kind!r} is unknown; choose cheb, gcn or gcn2")
        self.n_nodes = int(n_nodes)
        self.kind = kind
        self.form: Form = form
        neighbours = _checked_adjacency(np.asarray(edges), self.n_nodes)
        if kind == "cheb":
            laplacian = normalised_laplacian(neighbours)
            self.lambda_max = largest_eigenvalue(laplacian)
            matrix = 2.0 / self.lambda_max * laplacian - sparse.identity(self.n_nodes)
        else:
            self.lambda_max = math.nan
            matrix = _scaled_by_degree(neighbours + sparse.identity(self.n_nodes))
        self.matrix: sparse.csr_matrix = sparse.csr_matrix(matrix)
        self.matrix.sort_indices()
        self._tensors: dict[tuple[torch.device, torch.dtype, int], Tensor] = {}

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
        return self.times(x) if self.is_dense(x.device) else applied(_Propagate, x, self)

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


def normalised_laplacian(neighbours: sparse.spmatrix) -> sparse.csr_matrix:
    """L = I - D^-1/2 A D^-1/2 (n, n) of a symmetric 0/1 adjacency (n, n); D^-1/2 is 0 where a node has no edge."""
    return sparse.csr_matrix(sparse.identity(neighbours.shape[0]) - _scaled_by_degree(neighbours))


def largest_eigenvalue(laplacian: sparse.spmatrix) -> float:
    """lambda_max of a symmetric positive semi-definite matrix (n, n), to machine precision."""
    n = laplacian.shape[0]
    if n <= 64:
        return float(np.linalg.eigvalsh(laplacian.toarray())[-1])
    start = np.random.default_rng(0).standard_normal(n)
    return float(eigsh(laplacian, k=1, which="LA", v0=start, return_eigenvectors=False)[0])


def _checked_adjacency(edges: NDArray[Any], n_nodes: int) -> sparse.csr_matrix:
    """Symmetric 0/1 adjacency (n, n) without loops."""
    if n_nodes < 1:
        raise SurrogateError(f"a graph of {n_nodes} nodes was asked for; it needs at least one")
    edges = edges.reshape(0, 2) if edges.size == 0 else edges
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise SurrogateError(f"edges have the shape {edges.shape}; expected (edge, 2)")
    edges = edges.astype(np.int64)
    if edges.size and (edges.min() < 0 or edges.max() >= n_nodes):
        raise SurrogateError(f"edges name the nodes {edges.min()} to {edges.max()}; the graph has 0 to {n_nodes - 1}")
    return adjacency(n_nodes, unique_pairs(edges))


def _scaled_by_degree(neighbours: sparse.spmatrix) -> sparse.csr_matrix:
    """D^-1/2 A D^-1/2 with D the row sums of A."""
    degree = np.asarray(neighbours.sum(axis=1)).ravel()
    root = np.divide(1.0, np.sqrt(degree), out=np.zeros_like(degree), where=degree > 0)
    return sparse.csr_matrix(sparse.diags(root) @ neighbours @ sparse.diags(root))


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
        return applied(_Propagate, gradients[0], ctx.operator), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return applied(_Propagate, tangents[0], ctx.operator)


def applied(function: type[torch.autograd.Function], *values: Any) -> Tensor:
    """What the autograd function makes of `values`; torch gives its `apply` no types."""
    out: Tensor = function.apply(*values)
    return out


def check_state(x: Tensor, operator: GraphOperator, channels: int) -> None:
    if x.ndim != 3 or x.shape[0] != operator.n_nodes or x.shape[2] != channels:
        raise SurrogateError(
            f"a state has the shape {tuple(x.shape)}; expected ({operator.n_nodes} nodes, batch, {channels} channels)"
        )
