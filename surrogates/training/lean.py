"""Adam for levels of so many nodes that its two moments would be half of what training holds.

Of a large matrix of weights the mean gradient is kept in bfloat16, and of the mean square of the gradient its means over
rows and over columns alone, whose product over their mean stands for it (Shazeer and Stern 2018, equation 4,
arXiv:1804.04235). So a weight takes two bytes beside its own four and not eight. What is small is kept as Adam has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

# Bytes of trained weights above which a training on a CPU takes this optimiser: levels of some 24 000 nodes as the fast
# preset has them.
LARGE = 256 << 20
# Numbers of a matrix below which it is small.
_SMALL = 1 << 16
# Numbers handled at once: they and what is made of them stay in cache.
_BLOCK = 1 << 17
_FIRST, _SECOND, _EPS = 0.9, 0.999, 1e-8  # those of torch


class LeanAdam(torch.optim.Optimizer):
    """AdamW (or Adam, unless `decoupled`) with less memory for large matrices.

    Parameters
    ----------
    groups
        As torch has them; every one may have its own `lr`.
    decoupled
        Weight decay as in AdamW (Loshchilov and Hutter 2019); else it is a part of the gradient.
    """

    def __init__(self, groups: Any, lr: float, weight_decay: float, *, decoupled: bool) -> None:
        super().__init__(groups, {"lr": lr, "weight_decay": weight_decay})
        self.decoupled = decoupled

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Move what has a gradient."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is not None:
                    self._move(weight, weight.grad, float(group["lr"]), group["weight_decay"])

    def _move(self, weight: nn.Parameter, gradient: Tensor, rate: float, decay: float) -> None:
        state = self.state[weight]
        large = weight.ndim == 2 and weight.numel() >= _SMALL
        if ("rows" if large else "square") not in state:
            state.clear()
            state |= _fresh(weight, large)
        state["step"] += 1
        taken = float(state["step"])
        if decay and not self.decoupled:
            gradient = gradient.add(weight, alpha=decay)
        kept = 1 - rate * decay if self.decoupled else 1.0
        along, first, second = rate / (1 - _FIRST**taken), state["mean"], 1 - _SECOND**taken
        if not large:
            first.lerp_(gradient, 1 - _FIRST)
            state["square"].mul_(_SECOND).addcmul_(gradient, gradient, value=1 - _SECOND)
            size = (state["square"] / second).sqrt_().add_(_EPS)
            weight.mul_(kept).addcdiv_(first, size, value=-along)
            return
        rows, columns = state["rows"], state["columns"]
        _note_squares(gradient, rows, columns)
        by_row = (rows / (rows.mean() * second).clamp_min(1e-38)).sqrt_()
        by_column = columns.sqrt()
        for some in _blocks(weight.shape):
            mean = first[some].float().lerp_(gradient[some], 1 - _FIRST)
            first[some] = mean
            size = torch.outer(by_row[some[0]], by_column[some[1]]).add_(_EPS)
            weight[some].mul_(kept).addcdiv_(mean, size, value=-along)


def _fresh(weight: Tensor, large: bool) -> dict[str, Tensor]:
    step = torch.zeros(())
    if not large:
        return {"step": step, "mean": torch.zeros_like(weight), "square": torch.zeros_like(weight)}
    mean = torch.zeros_like(weight, dtype=torch.bfloat16)
    rows, columns = (weight.new_zeros(n) for n in weight.shape)
    return {"step": step, "mean": mean, "rows": rows, "columns": columns}


def _note_squares(gradient: Tensor, rows: Tensor, columns: Tensor) -> None:
    """Take the mean squares of a gradient's rows and columns into the running ones."""
    of_rows, of_columns = torch.zeros_like(rows), torch.zeros_like(columns)
    for some in _blocks(gradient.shape):
        squares = gradient[some].square()
        of_rows[some[0]] += squares.sum(dim=1)
        of_columns[some[1]] += squares.sum(dim=0)
    rows.lerp_(of_rows.div_(len(columns)), 1 - _SECOND)
    columns.lerp_(of_columns.div_(len(rows)), 1 - _SECOND)


def _blocks(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    """A matrix in pieces along its longer side."""
    height, width = shape
    every = slice(None)
    step = max(1, _BLOCK // min(height, width))
    for k in range(0, max(height, width), step):
        some = slice(k, k + step)
        yield (some, every) if height >= width else (every, some)
