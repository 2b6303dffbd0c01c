"""Time histories of a run: energies, forces and accelerations, many samples of few numbers, at times of their own."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Channel:
    """One curve. `quantity` names what it measures for the change to SI, as in `data_schema.units`.

    Attributes
    ----------
    derived
        Said of curves the solver wrote as something else: "derivative of the impulse the solver writes".
    """

    name: str
    quantity: str
    derived: str = ""


@dataclass(frozen=True)
class History:
    """The curves of one run, in the units of its source.

    Attributes
    ----------
    time
        (sample,) float64, increasing.
    values
        (sample, channel) float64.
    """

    time: NDArray[np.float64]
    channels: tuple[Channel, ...]
    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.values.shape != (len(self.time), len(self.channels)):
            raise ValueError(
                f"{self.values.shape} values for {len(self.time)} samples of {len(self.channels)} channels"
            )


def distinct(channels: list[Channel]) -> tuple[Channel, ...]:
    """Channels with names that occur once; those that occur several times are numbered in their order."""
    often = Counter(c.name for c in channels)
    seen: Counter[str] = Counter()
    out = []
    for c in channels:
        seen[c.name] += 1
        name = f"{c.name}_{seen[c.name]}" if often[c.name] > 1 else c.name
        out.append(Channel(name, c.quantity, c.derived))
    return tuple(out)


def rate_of(time: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (sample, ..) by time of what the solver sums up: a force from its impulse."""
    return np.gradient(values, time, axis=0) if len(time) > 1 else np.zeros_like(values)
