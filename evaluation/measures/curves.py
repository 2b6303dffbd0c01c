"""Curves at the probes: resultants, filtered as sensors are, and their ratings."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.distance import masked_mean
from evaluation.measures.probes import GRADES, cfc_filter, possible_classes, probe_histories, rate

HIGHEST_CLASS = 180  # structural velocities and displacements; crush and occupant channels go higher than states do
_ENDS = 2
QUANTITIES = ("displacement", "velocity", "acceleration")
_TO_SHOWN = {"displacement": (100.0, "cm"), "velocity": (1.0, "m/s"), "acceleration": (1 / 9.80665, "g")}


@dataclass(frozen=True)
class ProbeCurve:
    """Resultants (state, probe) of one run: m, m/s and m/s2, at `time` (state,), s.

    Where the states allow no filter class, `cfc` is None, velocity is as it comes out of the differences, and there is
    no acceleration. The first and the last two accelerations lean on one-sided differences of one-sided differences:
    they are left out before the filter can spread them.
    """

    time: NDArray[np.float64]
    displacement: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64] | None
    cfc: int | None

    def of(self, quantity: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times (k,) and values (k, probe) of `quantity`.

        Raises
        ------
        EvaluationError
            Where there are none.
        """
        values = getattr(self, quantity)
        if values is None:
            raise EvaluationError(f"no {quantity}: the states are too far apart, or too uneven, for a filter")
        return (self.time[_ENDS:-_ENDS] if quantity == "acceleration" else self.time), values

    @property
    def quantities(self) -> tuple[str, ...]:
        """What there is of displacement, velocity and acceleration."""
        return QUANTITIES if self.acceleration is not None else QUANTITIES[:2]


def curves(time: NDArray[np.float64], displacement: NDArray[np.floating]) -> ProbeCurve:
    """Resultant curves of probes: time (state,) s, displacement (state, probe, 3) m; at least four states."""
    cfc = filter_class(time)
    seen = probe_histories(time, displacement, np.arange(displacement.shape[1]))

    def resultant(values: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
        filtered = values if cfc is None else cfc_filter(at, values, cfc)
        return np.asarray(np.linalg.norm(filtered, axis=-1))

    inner = slice(_ENDS, len(time) - _ENDS)
    enough = cfc is not None and len(time) >= 2 * _ENDS + 4
    return ProbeCurve(
        time,
        np.linalg.norm(seen.displacement, axis=-1),
        resultant(seen.velocity, time),
        resultant(seen.acceleration[inner], time[inner]) if enough else None,
        cfc,
    )


def filter_class(time: NDArray[np.float64]) -> int | None:
    """The highest class up to CFC 180 that the states are dense and even enough for; None where there is none."""
    try:
        return max((c for c in possible_classes(time) if c <= HIGHEST_CLASS), default=None)
    except EvaluationError:  # uneven times
        return None


def shown(quantity: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """`values` in the unit in which engineers read them: cm, m/s, g."""
    return values * _TO_SHOWN[quantity][0]


def unit(quantity: str) -> str:
    """That unit."""
    return _TO_SHOWN[quantity][1]


@dataclass(frozen=True)
class Ratings:
    """ISO/TS 18571 ratings, 0 to 1: model -> (run, probe, quantity), NaN where a curve cannot be rated."""

    quantities: tuple[str, ...]
    cfc: int | None
    models: Mapping[str, NDArray[np.float64]]


def rate_curves(
    time: NDArray[np.float64],
    truths: Sequence[NDArray[np.floating]],
    predictions: Mapping[str, Sequence[NDArray[np.floating]]],
) -> Ratings | None:
    """Rate the resultant curves of every model at every probe of every run.

    time (state,) s; truths and each model's predictions: one (state, probe, 3) displacement, m, a run. None where
    the runs are too short, or no curve ever changes.
    """
    if len(time) < 4:
        return None
    keep_compiled()
    true_curves = [curves(time, u) for u in truths]
    quantities = true_curves[0].quantities if true_curves else ()
    out = {}
    for model, fields in predictions.items():
        pairs = [(truth, curves(time, u)) for truth, u in zip(true_curves, fields, strict=True)]
        out[model] = np.array(
            [
                [[_rating(truth, mine, q, p) for q in quantities] for p in range(truth.displacement.shape[1])]
                for truth, mine in pairs
            ]
        )
    if not out or all(np.isnan(v).all() for v in out.values()):
        return None
    return Ratings(quantities, true_curves[0].cfc, out)


def keep_compiled() -> None:
    """Let numba keep on disk the two loops of the ratings' time warping, which every process would else compile anew
    for longer than it takes to rate a campaign. Where there is no place for it, they are compiled as before."""
    for module, name in (("dtwalign.cost", "_calc_cumsum_matrix_jit"), ("dtwalign.backtrack", "_backtrack_jit")):
        with contextlib.suppress(ImportError, AttributeError, RuntimeError):
            getattr(importlib.import_module(module), name).enable_caching()


def _rating(truth: ProbeCurve, mine: ProbeCurve, quantity: str, probe: int) -> float:
    times, expected = truth.of(quantity)
    try:
        return rate(times, expected[:, probe], mine.of(quantity)[1][:, probe]).overall
    except EvaluationError:  # a curve that never changes, or one too short once its node is gone
        return float("nan")


def grade(rating: float) -> str:
    """The word of the standard for a rating."""
    return next((name for bound, name in GRADES if rating > bound), "poor") if rating == rating else "not rated"


def rating_table(found: Ratings, nodes: Sequence[int]) -> dict[str, list[object]]:
    """Model, quantity, probe -> mean and lowest rating over the runs, and the grade of the mean.

    Parameters
    ----------
    nodes
        The solver's number of each probe.
    """
    table: dict[str, list[object]] = {
        name: [] for name in ("model", "quantity", "probe_node", "mean_rating", "lowest_rating", "grade")
    }
    for model, values in found.models.items():
        for q, quantity in enumerate(found.quantities):
            for p, node in enumerate(nodes):
                of_runs = values[:, p, q]
                mean = float(masked_mean(of_runs))
                lowest = float(np.nanmin(of_runs)) if np.isfinite(of_runs).any() else float("nan")
                for name, value in zip(table, (model, quantity, node, mean, lowest, grade(mean)), strict=True):
                    table[name].append(value)
    return table
