"""Chebyshev polynomials in plain powers: weights and gradients from one basis to the other."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor


def of_powers(weight: Tensor) -> Tensor:
    """The weights V_j (order, in, out) with sum_k T_k(L) x W_k = sum_j L^j x V_j.

    Powers save an addition in every step of the recurrence. Their coefficients grow like 2^(order - 1), which costs a
    digit of accuracy every three or four orders; the orders in use are small.
    """
    table = _coefficients(len(weight), weight.device, weight.dtype)
    return torch.mm(table.t(), weight.reshape(len(weight), -1)).view(weight.shape)


def of_terms(gradient: Tensor) -> Tensor:
    """The gradient by W_k (order, in, out) from that by V_j: the adjoint of `of_powers`."""
    table = _coefficients(len(gradient), gradient.device, gradient.dtype)
    return torch.mm(table, gradient.reshape(len(gradient), -1)).view(gradient.shape)


@cache
def _coefficients(order: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """(order, order), row k: the coefficients of T_k, from T_k = 2 x T_{k-1} - T_{k-2}."""
    rows = np.zeros((order, order))
    for k in range(order):
        rows[k, : k + 1] = np.polynomial.chebyshev.cheb2poly(np.eye(k + 1)[k])
    return torch.from_numpy(rows).to(device, dtype)
