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
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

if TYPE_CHECKING:
    pass

# Fewer validation runs than this leave no other run to estimate the scale on.
FEWEST_RUNS = 2
# Shares for which the ratios' quantiles are kept; between them they are interpolated.
SHARES = np.round(np.arange(0.50, 0.995, 0.01), 2)
# Nodes whose ratios are pooled; more change no quantile.
_POOLED = 2000


@dataclass(frozen=True)
class Band:
    """Half-widths: at node i and state t the true node lies within `factor * node[i] * state[t]` of the predicted one.

    Attributes
    ----------
    node
        (node,) m; state (state,) 1, at `time` (state,) s.
    factor
        (share,) for the shares SHARES.
    runs
        Validation runs behind it.
    """

    node: NDArray[np.float32]
    state: NDArray[np.float32]
    time: NDArray[np.float64]
    factor: NDArray[np.float64]
    runs: int

    def half_width(self, coverage: float, time: NDArray[np.float64]) -> NDArray[np.float32]:
        """(state, node), m, for the share `coverage` of nodes and states; between states it is interpolated.

        Raises
        ------
        SurrogateError
            For a share it has no quantile for.
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


def _scale(
    by_node: NDArray[np.float64], by_state: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Node (m) and state (1) factors from mean distances (run, node) and (run, state); never quite zero."""
    node, state = by_node.mean(axis=0), by_state.mean(axis=0)
    mean = max(float(state.mean()), 1e-9)
    return np.maximum(node, 1e-3 * mean), np.maximum(state / mean, 1e-3)
