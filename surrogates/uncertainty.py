"""How far a prediction may be wrong, and how it moves with the parameters.

The band is conformal: its width comes from what the validation runs showed, not from a belief. The distance between
true and predicted node is divided by a scale, a product of one number for the node and one for the state, estimated on
the other validation runs; the band is the scale times the quantile of these ratios, all runs pooled (Dunn, Wasserman,
Ramdas 2022, doi 10.1080/01621459.2022.2060112, "pooling CDFs": the nominal share of nodes and states of a new run lies
inside, on average, as the number of validation runs grows).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from surrogates.errors import SurrogateError
from surrogates.models.base import Network
from surrogates.operators.graph import exportable

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate

# Fewer validation runs than this leave no other run to estimate the scale on.
FEWEST_RUNS = 2
# Shares for which the ratios' quantiles are kept; between them they are interpolated.
SHARES = np.round(np.arange(0.50, 0.995, 0.01), 2)
# Nodes whose ratios are pooled; more change no quantile.
_POOLED = 2000


@dataclass(frozen=True)
class Band:
    """Half-widths: at node i and state t the true node lies within `factor * node[i] * state[t]` of the predicted one.

    node    (node,) m; state (state,) 1, at `time` (state,) s
    factor  (share,) for the shares SHARES
    runs    validation runs behind it
    """

    node: NDArray[np.float32]
    state: NDArray[np.float32]
    time: NDArray[np.float64]
    factor: NDArray[np.float64]
    runs: int

    def half_width(self, coverage: float, time: NDArray[np.float64]) -> NDArray[np.float32]:
        """(state, node), m, for the share `coverage` of nodes and states; between states it is interpolated.

        Raises SurrogateError for a share it has no quantile for.
        """
        if not SHARES[0] <= coverage <= SHARES[-1]:
            raise SurrogateError(f"coverage {coverage} was asked for; expected {SHARES[0]:g} to {SHARES[-1]:g}")
        factor = np.interp(coverage, SHARES, self.factor)
        state = np.interp(time, self.time, self.state)
        return (factor * state[:, None] * self.node[None]).astype(np.float32)


def calibrate(distances: Sequence[NDArray[np.float32]], time: NDArray[np.float64]) -> Band:
    """The band of distances (state, node), m, between truth and prediction, one array for each validation run."""
    if len(distances) < FEWEST_RUNS:
        raise SurrogateError(f"a band needs at least {FEWEST_RUNS} validation runs; found {len(distances)}")
    by_node = np.stack([d.mean(axis=0, dtype=np.float64) for d in distances])
    by_state = np.stack([d.mean(axis=1, dtype=np.float64) for d in distances])
    some = np.unique(np.linspace(0, by_node.shape[1] - 1, _POOLED).astype(int))
    ratios = []
    for k, distance in enumerate(distances):
        others = np.arange(len(distances)) != k
        node, state = _scale(by_node[others], by_state[others])
        ratios.append((distance[:, some] / (state[:, None] * node[some])).ravel())
    factor = np.quantile(np.concatenate(ratios), SHARES)
    node, state = _scale(by_node, by_state)
    return Band(node.astype(np.float32), state.astype(np.float32), np.asarray(time, np.float64), factor, len(distances))


def coverage(distances: NDArray[np.float32], half_width: NDArray[np.float32]) -> float:
    """The share of nodes and states (..., state, node) whose distance is at most the half-width (state, node)."""
    return float((distances <= half_width).mean())


def sensitivity(
    surrogate: Surrogate,
    parameters: ArrayLike,
    time: ArrayLike | None = None,
    level: int | None = None,
    nodes: ArrayLike | None = None,
) -> NDArray[np.float32]:
    """Derivatives of displacements by the parameters, m per unit of the parameter: (state, node, 3, parameter).

    parameters  (parameter,), time (state,) s and level as in `Surrogate.predict`
    nodes       node numbers on the level; default: all

    Networks are differentiated automatically, in forward mode; Gaussian processes and radial basis functions by central
    differences over a thousandth of the trained range.
    """
    number = surrogate.number(level)
    values, times = surrogate.checked(parameters, time)
    if len(values) != 1:
        raise SurrogateError(f"sensitivities are those of one run; found parameters of {len(values)}")
    chosen = slice(None) if nodes is None else np.atleast_1d(np.asarray(nodes))
    columns = []
    for k in range(values.shape[1]):
        core = surrogate.core
        moved = (
            _forward_mode(core, values[0], times, number, k)
            if isinstance(core, Network)
            else _central(surrogate, values[0], times, number, k)
        )
        columns.append(moved[:, chosen])
    return np.stack(columns, axis=-1).astype(np.float32)


def _forward_mode(
    network: Network, values: NDArray[np.float64], times: NDArray[np.float64], number: int, k: int
) -> NDArray[np.floating]:
    at = torch.from_numpy(values).expand(len(times), -1)
    direction = torch.zeros_like(at)
    direction[:, k] = 1.0
    when = torch.from_numpy(times)

    def states(parameters: Tensor) -> Tensor:
        return network(parameters, when, number)

    with exportable(network), torch.no_grad():
        moved = torch.func.jvp(states, (at.contiguous(),), (direction,))[1]
    return moved.transpose(0, 1).numpy()


def _central(
    surrogate: Surrogate, values: NDArray[np.float64], times: NDArray[np.float64], number: int, k: int
) -> NDArray[np.floating]:
    ranges = surrogate.record.ranges
    step = 1e-3 * (ranges.high[k] - ranges.low[k])
    if step == 0:
        return np.zeros((len(times), surrogate.graphs.n_nodes(number), 3))
    there = np.repeat(values[None], 2, axis=0)
    there[:, k] += (-step, step)
    states = surrogate.predict(there, times, number).astype(np.float64)
    return (states[1] - states[0]) / (2 * step)


def _scale(
    by_node: NDArray[np.float64], by_state: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Node (m) and state (1) factors from mean distances (run, node) and (run, state); never quite zero."""
    node, state = by_node.mean(axis=0), by_state.mean(axis=0)
    mean = max(float(state.mean()), 1e-9)
    return np.maximum(node, 1e-3 * mean), np.maximum(state / mean, 1e-3)
