"""Upsampling between neighbouring levels: x_finer = W x + b over nodes, shared by the three coordinates (equation 12)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from scipy import sparse
from torch import Tensor, nn

UpsamplingKind = Literal["static", "sparse", "linear"]


class Upsampling(nn.Module):
    """States (coarse node, batch, 3) -> (finer node, batch, 3), starting at the barycentric map U with b = 0.

    static  U, nothing trains
    sparse  U's non-zeros and b train
    linear  all of W and b train (the paper's)

    matrix  U as csr (finer node, coarse node), rows sum to 1
    """

    columns: Tensor

    def __init__(self, matrix: sparse.spmatrix, kind: UpsamplingKind) -> None:
        super().__init__()
        csr = sparse.csr_matrix(matrix)
        self.kind = kind
        self.shape = csr.shape
        trains = kind != "static"
        if kind == "linear":
            weight = csr.toarray()
        else:  # each row's few entries side by side: gathered, which is differentiable and exportable as it stands
            columns, weight = _padded(csr)
            self.register_buffer("columns", torch.from_numpy(columns), persistent=False)
        self.weight = nn.Parameter(torch.from_numpy(weight.astype(np.float32)), requires_grad=trains)
        self.bias = nn.Parameter(torch.zeros(csr.shape[0]), requires_grad=trains)

    def forward(self, x: Tensor) -> Tensor:
        by_channel = x.transpose(1, 2)
        if not torch.is_grad_enabled() and by_channel.is_contiguous():  # spares predictions a copy
            return self._of_rows(by_channel.flatten(1)).view(-1, *by_channel.shape[1:]).transpose(1, 2)
        return self._of_rows(x.flatten(1)).view(-1, *x.shape[1:])

    def _of_rows(self, rows: Tensor) -> Tensor:
        """W x + b for x (coarse node, any)."""
        if self.kind == "linear":
            out = torch.addmm(self.bias[:, None], self.weight, rows)
        else:
            out = self.weight[:, :1] * rows[self.columns[:, 0]]
            for k in range(1, self.columns.shape[1]):
                out = torch.addcmul(out, self.weight[:, k : k + 1], rows[self.columns[:, k]])
            if self.kind == "sparse":
                out = out + self.bias[:, None]
        return out

    def as_matrix(self) -> Tensor:
        """W (finer node, coarse node), dense."""
        if self.kind == "linear":
            return self.weight.detach()
        row = torch.arange(len(self.columns), device=self.columns.device)[:, None].expand_as(self.columns)
        return self.weight.new_zeros(self.shape).index_put((row, self.columns), self.weight.detach(), accumulate=True)


def _padded(csr: sparse.csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Columns (row, k) int64 and weights (row, k); rows with fewer entries repeat their first column with weight 0.

    So what trains beside an entry of U adds to that entry, and to nothing else.
    """
    counts = np.diff(csr.indptr)
    width = max(1, int(counts.max(initial=0)))
    filled = np.arange(width) < counts[:, None]
    columns = np.zeros((csr.shape[0], width), np.int64)
    some = counts > 0
    columns[some] = csr.indices[csr.indptr[:-1][some], None]
    weights = np.zeros((csr.shape[0], width))
    columns[filled], weights[filled] = csr.indices, csr.data
    return columns, weights
