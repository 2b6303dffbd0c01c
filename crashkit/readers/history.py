"""Time histories of a run: energies, forces and accelerations, many samples of few numbers, at times of their own."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# What curves measure, by the words in their names.
_QUANTITIES = {
    "energy": "energy", "work": "energy", "momentum": "momentum", "force": "force", "moment": "moment",
    "displacement": "length", "coordinate": "length", "velocity": "velocity", "acceleration": "acceleration",
    "mass": "mass", "volume": "volume", "pressure": "stress", "time_step": "time", "ratio": "one",
}  # fmt: skip
# Of rotations the same words mean angles.
_TURNS = {"length": "one", "velocity": "one/time", "acceleration": "one/time2"}


def quantity_of(name: str) -> str:
    """What a curve measures, by the last word in its name that is known: "wall_force_x" is a force, "x_momentum" no moment.

    `rx_velocity` and the like are rotations. "unknown" where no word is known, and where something is given per
    something else ("energy_per_mass").
    """
    words = {(name.rfind(word) + len(word), len(word)): kind for word, kind in _QUANTITIES.items() if word in name}
    if not words or "_per_" in name:
        return "unknown"
    kind = words[max(words)]
    return _TURNS.get(kind, kind) if name[:2] in ("rx", "ry", "rz") else kind


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
    taken = {name for name, times in often.items() if times == 1}
    seen: Counter[str] = Counter()
    out = []
    for c in channels:
        name = c.name
        while often[c.name] > 1 and (name == c.name or name in taken):
            seen[c.name] += 1
            name = f"{c.name}_{seen[c.name]}"
        taken.add(name)
        out.append(Channel(name, c.quantity, c.derived))
    return tuple(out)


def rate_of(time: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (sample, ..) by time of what the solver sums up: a force from its impulse."""
    return np.gradient(values, time, axis=0) if len(time) > 1 else np.zeros_like(values)
