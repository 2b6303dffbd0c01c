"""What the training runs covered: ranges of parameters and time, and numbers in [-1, 1] over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Ranges:
    """What the training runs covered, for scaling and for the warning outside.

    low, high  (parameter,) in the parameters' units
    time       first and last time, s
    table      for each parameter the unit people write it in, and its value in `units`: ("MPa", 1e6)
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    time: tuple[float, float]
    table: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        units: Sequence[str],
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        table: Sequence[tuple[str, float]] = (),
    ) -> Ranges:
        """The ranges of parameters (run, parameter) and time (state,)."""
        return cls(
            tuple(names),
            tuple(units),
            parameters.min(axis=0),
            parameters.max(axis=0),
            (float(time[0]), float(time[-1])),
            tuple(table),
        )

    @property
    def written(self) -> tuple[tuple[str, float], ...]:
        """`table`, or the parameters' own units where it says nothing."""
        return self.table or tuple((unit, 1.0) for unit in self.units)

    @property
    def constant(self) -> tuple[str, ...]:
        """Parameters that had one value in all training runs: nothing can be learnt about them."""
        return tuple(n for n, a, b in zip(self.names, self.low, self.high, strict=True) if a == b)

    def outside(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> list[str]:
        """One sentence for each parameter (and the time) beyond the trained range; parameters (..., parameter)."""
        return list(self.beyond(parameters, time).values())

    def beyond(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> dict[str, str]:
        """The same sentences by the name of the parameter, or "time"."""
        said = {}
        values = np.atleast_2d(parameters)
        for k, (name, (unit, factor)) in enumerate(zip(self.names, self.written, strict=True)):
            low, high = self.low[k], self.high[k]
            column = values[:, k]
            worst = column[np.argmax(np.maximum(low - column, column - high))]
            slack = 1e-9 * max(abs(low), abs(high))
            if worst < low - slack or worst > high + slack:
                span = f"{low / factor:g} to {high / factor:g}" if low < high else f"only {low / factor:g}"
                behind = "" if unit in ("", "1") else f" {unit}"
                said[name] = f"{name} = {worst / factor:g}{behind} is outside the trained range {span}{behind}"
        first, last = self.time
        beyond = [t for t in (time.min(), time.max()) if t < first - 1e-12 or t > last * (1 + 1e-9) + 1e-12]
        if beyond:
            said["time"] = f"time = {beyond[-1]:g} s is outside the trained range {first:g} to {last:g} s"
        return said


FAR = 0.25  # of the trained range: a value further outside is far outside


def far_outside(ranges: Ranges, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> list[str]:
    """Names of the parameters, and "time", that lie outside the trained range by more than a quarter of it.

    A parameter that had one value in training is far outside with any other value.
    """
    values = np.atleast_2d(parameters)
    span = ranges.high - ranges.low
    slack = FAR * span + 1e-9 * np.maximum(abs(ranges.low), abs(ranges.high))
    out = [
        name
        for k, name in enumerate(ranges.names)
        if ((values[:, k] < ranges.low[k] - slack[k]) | (values[:, k] > ranges.high[k] + slack[k])).any()
    ]
    first, last = ranges.time
    allowed = FAR * (last - first) + 1e-12
    return out + (["time"] if time.min() < first - allowed or time.max() > last + allowed else [])


def over_range(x: NDArray[np.float64], over: NDArray[np.float64]) -> NDArray[np.float64]:
    """(run, input) -> [-1, 1] over the range that `over` (run, input) spans, without the inputs that are constant there."""
    low, high = over.min(axis=0), over.max(axis=0)
    moves = high > low
    return np.asarray(2 * (np.atleast_2d(x)[:, moves] - low[moves]) / (high - low)[moves] - 1)
