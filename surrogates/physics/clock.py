"""Clock and size: a run of other speed and strength, played at another rate and drawn at another size.

With r = v / v0 and s = sigma / sigma0 against reference parameters, a run is put on the reference's clock by
    t0 = t r^a s^b,    u0(t0) = u(t) r^(a - 1) s^b.
Size times rate is the ratio of the speeds, so free flight u = v t becomes u0 = v0 t0 exactly, and a run stretched this
way is still a run. Ratios compose, so the reference is a change of variables of the whole campaign that can be undone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Exponents that are tried: of the speed, and of each further parameter.
OF_SPEED = (0.25, 0.5, 0.125, 0.375, 0.75)
OF_OTHERS = (0.0, 0.25, 0.5, -0.25)
# Largest stretch of the common time grid against that of the runs.
_LONGEST = 4.0


@dataclass(frozen=True)
class Clock:
    """The rate of a run against the reference's, a product of powers of parameters, and its size.

    Attributes
    ----------
    speed
        Place of the speed among the parameters, None where there is no clock.
    exponents
        (parameter,) of the rate; the speed's is a.
    reference
        (parameter,) values for which rate and size are 1.
    start
        s, when all clocks begin.
    """

    speed: int | None
    exponents: tuple[float, ...]
    reference: tuple[float, ...]
    start: float = 0.0

    @classmethod
    def identity(cls, parameters: int) -> Clock:
        """Every run on its own clock."""
        return cls(None, (0.0,) * parameters, (1.0,) * parameters)

    @classmethod
    def of(
        cls, parameters: NDArray[np.float64], speed: int, exponents: Mapping[int, float], start: float = 0.0
    ) -> Clock:
        """With the medians of parameters (run, parameter) as the reference."""
        powers = tuple(float(exponents.get(k, 0.0)) for k in range(parameters.shape[1]))
        return cls(speed, powers, tuple(float(v) for v in np.median(parameters, axis=0)), start)

    @property
    def is_identity(self) -> bool:
        return self.speed is None

    def rate(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run,): reference time that passes while one second passes in the run."""
        out = np.ones(len(parameters))
        for k, power in enumerate(self.exponents):
            if power:
                out *= (parameters[:, k] / self.reference[k]) ** power
        return out

    def size(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run,): the run's displacements for each metre of the reference's."""
        if self.speed is None:
            return np.ones(len(parameters))
        return np.asarray(parameters[:, self.speed] / self.reference[self.speed] / self.rate(parameters))

    def grid(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reference times (state,) that hold every run of the box around `parameters` (run, parameter) to its end.

        The steps are those of `time` at the reference's own rate. No run need lie where the box is fastest; a query may.
        """
        if self.speed is None or len(time) < 2:
            return time
        used = [k for k, power in enumerate(self.exponents) if power]
        fastest = math.prod(float(((parameters[:, k] / self.reference[k]) ** self.exponents[k]).max()) for k in used)
        span = (time[-1] - self.start) * min(fastest, _LONGEST)
        first = (time[0] - self.start) * float(self.rate(parameters).min())
        count = int(np.ceil((span - first) / np.median(np.diff(time)) - 1e-9))
        return np.asarray(self.start + np.linspace(first, span, max(count, 1) + 1))

    def apply(
        self,
        states: NDArray[Any],
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        grid: NDArray[np.float64],
    ) -> NDArray[Any]:
        """A run's states (state, ..) at `time` as those of the reference at `grid`; the last slope goes on at the end.

        Parameters
        ----------
        parameters
            (parameter,) of the run.
        """
        if self.speed is None:
            return states
        rate, size = float(self.rate(parameters[None])[0]), float(self.size(parameters[None])[0])
        return np.asarray(
            between(states, time, self.start + (grid - self.start) / rate) / np.asarray(size, states.dtype)
        )

    def times(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reference times of the times (state,) of a run with parameters (parameter,)."""
        if self.speed is None:
            return time
        return np.asarray(self.start + (time - self.start) * float(self.rate(parameters[None])[0]))

    def known(
        self, parameters: NDArray[np.float64], time: NDArray[np.float64], grid: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """(run, state of the grid): whether the run was computed that far."""
        ends = self.start + (time[-1] - self.start) * self.rate(parameters)
        return np.asarray(grid[None] <= ends[:, None] * (1 + 1e-9) + 1e-15)

    def told(self, names: tuple[str, ...]) -> str:
        """The clock in a line."""
        if self.speed is None:
            return "each run on its own clock"
        parts = [f"({n} / {self.reference[k]:.4g})^{p:g}" for k, (n, p) in enumerate(zip(names, self.exponents)) if p]
        return f"reference time = time x {' '.join(parts)}, sizes by {names[self.speed]} / rate"

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "speed": self.speed,
            "exponents": list(self.exponents),
            "reference": list(self.reference),
            "start": self.start,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Clock:
        """The way back."""
        speed = values["speed"]
        return cls(
            None if speed is None else int(speed),
            tuple(float(v) for v in values["exponents"]),
            tuple(float(v) for v in values["reference"]),
            float(values["start"]),
        )


def between(states: NDArray[Any], time: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[Any]:
    """States (state, ..) at `time`, linear between them and along the last piece beyond, at times `wanted`."""
    if len(time) == 1:
        return np.repeat(states, len(wanted), axis=0)
    place = np.clip(np.searchsorted(time, wanted, side="right") - 1, 0, len(time) - 2)
    share = ((wanted - time[place]) / (time[place + 1] - time[place])).astype(states.dtype)
    share = share.reshape(-1, *([1] * (states.ndim - 1)))
    return np.asarray(states[place] * (1 - share) + states[place + 1] * share)


def neighbours(exponents: Mapping[int, float], speed: int, others: tuple[int, ...]) -> Iterator[dict[int, float]]:
    """Exponents that differ from `exponents` in one parameter."""
    for k in (speed, *others):
        for value in OF_SPEED if k == speed else OF_OTHERS:
            if value != exponents.get(k, 0.0):
                yield {**exponents, k: value}
