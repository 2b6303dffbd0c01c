"""How far a prediction may be wrong.

The band is conformal: its width comes from the errors on runs that a model had not seen, not from a belief. These are
validation runs, or all training runs, each predicted by the folds it was left out of (CV+: Barber, Candes, Ramdas,
Tibshirani 2021, doi 10.1214/20-AOS1965; here the prediction is that of the model fitted to all runs). The distance
between true and predicted node is divided by a scale, a product of one number for the node, one for the state and one
for the run, the first two estimated on the other runs; the band is the scale times the quantile of these ratios, all
runs pooled (Dunn, Wasserman, Ramdas 2022, doi 10.1080/01621459.2022.2060112, "pooling CDFs": the nominal share of nodes
and states of a new run lies inside, on average, as the number of runs grows). The number for the run is what the model
itself says of a query before it is computed: its size against the reference's, what the process believes its own
error to be, and how wrong the model was about runs near the query when they were left out (`surrogates.local_errors`).
The belief enters with its root: whole, it makes the band too narrow for fast runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from data_schema.finite import all_finite
from surrogates.errors import SurrogateError
from surrogates.local_errors import LocalErrors

# Fewer validation runs than this leave no other run to estimate the scale on.
FEWEST_RUNS = 2
# Fewer training runs than this give no band by cross-validation: a tenth of them is less than one run.
FEWEST_BY_FOLDS = 8
# Fewer runs than this lie too far apart to say anything of their neighbours.
FEWEST_LOCAL = 16
# Shares for which the ratios' quantiles are kept; between them they are interpolated.
SHARES = np.round(np.arange(0.50, 0.995, 0.01), 2)
# Nodes whose ratios are pooled; more change no quantile.
_POOLED = 2000
# The share by which kinds of spread are compared.
_COMPARED = 0.9

Spread = Literal["constant", "size", "deviation", "local"]
# Means (run, node) and (run, state), and the distances (state, some nodes) of each run.
Gathered = tuple[NDArray[np.float64], NDArray[np.float64], list[NDArray[np.float32]]]
_SPREADS: tuple[Spread, ...] = ("constant", "size", "deviation", "local")


@dataclass(frozen=True)
class Beliefs:
    """What a model says of runs before they are computed.

    Attributes
    ----------
    size, deviation
        (run,) up to a factor.
    points, images
        Where the runs and their mirror images lie: (run, parameter) in [-1, 1] over the trained range; None where that
        says nothing.
    """

    size: NDArray[np.float64]
    deviation: NDArray[np.float64]
    points: NDArray[np.float64] | None = None
    images: NDArray[np.float64] | None = None

    def spread(
        self, kind: Spread, local: LocalErrors | None = None, runs: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """(run,): how wide the band of each run is, up to a factor.

        local  of the kind "local"; runs: which run each is of, where they are those behind `local`
        """
        if kind == "constant":
            return np.ones(len(self.size))
        if kind == "size":
            return self.size
        expected = self.size * np.sqrt(self.deviation)
        if kind == "local":
            if local is None or self.points is None:
                raise SurrogateError("a band that follows local errors needs them, and the place of the run")
            return expected * local.at(self.points, runs)
        return expected

    def local(self, errors: NDArray[np.float64], runs: NDArray[np.int64]) -> LocalErrors | None:
        """Where these runs were predicted worse than expected, from errors (run,), m; None for too few runs."""
        if self.points is None or not self.points.shape[1] or len(np.unique(runs)) < FEWEST_LOCAL:
            return None
        return LocalErrors.of(self.points, errors / self.spread("deviation"), runs, self.images)


@dataclass(frozen=True)
class Band:
    """Half-widths: at node i and state t the true node lies within `factor * node[i] * state[t] * run` of the predicted one.

    Attributes
    ----------
    node
        (node,) m; state (state,) 1, at `time` (state,) s.
    factor
        (share,) for the shares SHARES.
    runs
        Runs behind it.
    spread, unit
        What the width of a run follows: nothing, its size, size and deviation, or these and the errors of runs near
        it; and the value for which `run` is 1.
    local
        Errors of left-out runs, of the kind "local".
    """

    node: NDArray[np.float32]
    state: NDArray[np.float32]
    time: NDArray[np.float64]
    factor: NDArray[np.float64]
    runs: int
    spread: Spread = "constant"
    unit: float = 1.0
    local: LocalErrors | None = None

    def of_runs(self, beliefs: Beliefs) -> NDArray[np.float64]:
        """(run,): the width for each run against that for a typical one."""
        return np.asarray(beliefs.spread(self.spread, self.local) / self.unit)

    def half_width(
        self, coverage: float, time: NDArray[np.float64], beliefs: Beliefs | None = None
    ) -> NDArray[np.float32]:
        """(state, node), m, for the share `coverage` of nodes and states; between states it is interpolated.

        beliefs  of one run; without, the band of a typical run

        Raises
        ------
        SurrogateError
            For a share it has no quantile for.
        """
        if not SHARES[0] <= coverage <= SHARES[-1]:
            raise SurrogateError(f"coverage {coverage} was asked for; expected {SHARES[0]:g} to {SHARES[-1]:g}")
        factor = np.interp(coverage, SHARES, self.factor)
        if beliefs is not None:
            factor = factor * float(self.of_runs(beliefs)[0])
        state = np.interp(time, self.time, self.state)
        return (factor * state[:, None] * self.node[None]).astype(np.float32)


def calibrate(
    distances: Iterable[NDArray[np.float32]],
    time: NDArray[np.float64],
    beliefs: Beliefs | None = None,
    runs: NDArray[np.int64] | None = None,
) -> Band:
    """The band of distances (state, node), m, between truth and prediction, one array for each run that was not seen.

    beliefs  of each array; the kind of spread that makes the band of nine tenths narrowest is taken
    runs     which run each array is of, where some come more than once; a run never judges itself
    """
    return calibrate_gathered(gather(distances), time, beliefs, runs)


def calibrate_gathered(
    gathered: Gathered,
    time: NDArray[np.float64],
    beliefs: Beliefs | None = None,
    runs: NDArray[np.int64] | None = None,
) -> Band:
    """As `calibrate`, of what is left of the distances."""
    by_node, by_state, pooled = gathered
    count = len(pooled)
    which = np.arange(count) if runs is None else runs
    if len(np.unique(which)) < FEWEST_RUNS:
        raise SurrogateError(f"a band needs at least {FEWEST_RUNS} validation runs; found {len(np.unique(which))}")
    local = None if beliefs is None else beliefs.local(np.nanmean(by_state, axis=1), which)
    kinds = _SPREADS[:1] if beliefs is None else _SPREADS if local is not None else _SPREADS[:-1]
    found = []
    for kind in kinds:
        spread = np.ones(count) if beliefs is None else beliefs.spread(kind, local, which)
        unit = float(np.sqrt(np.square(spread).mean()))
        share = spread / unit
        node, state, factor = _product(by_node / share[:, None], by_state / share[:, None], pooled, share, which)
        band = Band(
            node.astype(np.float32), state.astype(np.float32), np.asarray(time, np.float64), factor,
            len(np.unique(which)), kind, unit, local if kind == "local" else None,
        )  # fmt: skip
        width = np.interp(_COMPARED, SHARES, factor) * float(node.mean() * state.mean() * share.mean())
        found.append((width, band))
    return min(found, key=lambda pair: pair[0])[1]


def gather(distances: Iterable[NDArray[np.float32]]) -> Gathered:
    """Means (run, node) and (run, state), and the distances (state, some nodes) of each run; NaN where a node is gone."""
    by_node, by_state, pooled = [], [], []
    for distance in distances:
        by_node.append(living_mean(distance, 0, np.float64))
        by_state.append(living_mean(distance, 1, np.float64))
        some = np.unique(np.linspace(0, distance.shape[1] - 1, _POOLED).astype(int))
        pooled.append(distance[:, some])
    if not pooled:
        return np.zeros((0, 1)), np.zeros((0, 1)), []
    return np.stack(by_node), np.stack(by_state), pooled


def living_mean(
    distance: NDArray[np.float32], axis: int, dtype: type[np.floating[Any]] | None = None
) -> NDArray[np.floating[Any]]:
    """The mean over what is there; where that is everything, without the copy that `nanmean` makes."""
    mean = np.mean if all_finite(distance) else np.nanmean
    return np.asarray(mean(distance, axis=axis, dtype=dtype))


def _product(
    by_node: NDArray[np.float64],
    by_state: NDArray[np.float64],
    pooled: list[NDArray[np.float32]],
    share: NDArray[np.float64],
    which: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Factors of node and state, and the quantiles of the ratios to them; each run is judged by the others."""
    some = np.unique(np.linspace(0, by_node.shape[1] - 1, _POOLED).astype(int))
    of_some, ratios = by_node[:, some], []
    for k, distance in enumerate(pooled):
        others = which != which[k]
        node, state = _scale(of_some[others], by_state[others])
        ratio = (distance / (share[k] * state[:, None] * node)).ravel()
        ratios.append(ratio[np.isfinite(ratio)])
    factor = np.quantile(np.concatenate(ratios), SHARES)
    return (*_scale(by_node, by_state), factor)


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
