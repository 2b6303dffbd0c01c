"""From parameters and time to what a regression network reads: each number in [-1, 1] over the training runs."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.data.inputs import Ranges


class InputScaling(nn.Module):
    """Parameters (b, p) and time (b,) -> (b, size) float32, each column in [-1, 1] over the training runs.

    Columns: the parameters, the time, then if asked the products parameter * time and sine and cosine of parameters in
    degree. A constant parameter becomes 0. Differentiable, so a prediction's derivatives by the parameters follow.
    Source: Kneifl et al. 2024, section 3.3 (inputs mu and t).
    """

    low: Tensor
    high: Tensor

    def __init__(self, ranges: Ranges, *, products: bool = False, angles: bool = False) -> None:
        super().__init__()
        self.products = products
        self.ranges = ranges
        self.angles = tuple(k for k, u in enumerate(ranges.units) if angles and u in ("degree", "deg", "°"))
        corners = np.stack([np.append(ranges.low, ranges.time[0]), np.append(ranges.high, ranges.time[1])])
        features = self._features(torch.from_numpy(_grid(corners[0], corners[1])))
        self.register_buffer("low", features.amin(dim=0), persistent=False)
        self.register_buffer("high", features.amax(dim=0), persistent=False)

    @property
    def size(self) -> int:
        return len(self.low)

    @property
    def time_column(self) -> int:
        """Place of the time among the columns: behind the parameters."""
        return len(self.ranges.names)

    def forward(self, parameters: Tensor, time: Tensor) -> Tensor:
        raw = torch.cat([parameters, time[:, None]], dim=1).to(self.low.dtype)
        return self._scaled(self._features(raw)).float()

    def _features(self, raw: Tensor) -> Tensor:
        """(b, p + 1) -> (b, size), unscaled."""
        columns = [raw]
        if self.products:
            columns.append(raw[:, :-1] * raw[:, -1:])
        if self.angles:
            radian = torch.deg2rad(raw[:, list(self.angles)])
            columns += [torch.sin(radian), torch.cos(radian)]
        return torch.cat(columns, dim=1)

    def _scaled(self, features: Tensor) -> Tensor:
        span = self.high - self.low
        flat = span == 0
        scaled = 2.0 * (features - self.low) / torch.where(flat, torch.ones_like(span), span) - 1.0
        return torch.where(flat, torch.zeros_like(scaled), scaled)


def _grid(low: NDArray[np.float64], high: NDArray[np.float64], steps: int = 9) -> NDArray[np.float64]:
    """Points along the edges of the box [low, high] and through its middle: where products and sines have extremes."""
    share = np.linspace(0.0, 1.0, steps)[:, None]
    middle = low + (high - low) * share
    edges = [middle]
    for k in range(len(low)):
        for t in (low[-1], high[-1]):
            line = np.repeat(((low + high) / 2)[None], steps, axis=0)
            line[:, k] = middle[:, k]
            line[:, -1] = t if k < len(low) - 1 else line[:, -1]
            edges.append(line)
    return np.concatenate(edges)
