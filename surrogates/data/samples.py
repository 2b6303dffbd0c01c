"""A campaign as training reads it: checked, split into training and validation runs, run by run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from data_schema.finite import all_finite
from surrogates.data.campaign import Campaign
from surrogates.data.inputs import Ranges
from surrogates.data.shelf import Shelf, States, StoredStates
from surrogates.errors import SurrogateError
from surrogates.settings import Settings

if TYPE_CHECKING:
    from torch import Tensor

# Fewer runs than this cannot spare any for validation.
FEWEST_TO_SPLIT = 4


@dataclass(frozen=True)
class ValidationSplit:
    """Places of the runs that train and of those that choose the best epoch; `notes` say what was unusual."""

    training: NDArray[np.int64]
    validation: NDArray[np.int64]
    notes: tuple[str, ...] = ()


@dataclass
class Notes:
    """Things worth telling that are no errors; they end up in the model card."""

    lines: list[str] = field(default_factory=list)

    def add(self, line: str) -> None:
        if line not in self.lines:
            self.lines.append(line)


def check(campaign: Campaign, settings: Settings, notes: Notes) -> None:
    """Raise SurrogateError for data nothing can be learnt from; note what is merely odd."""
    runs, names = len(campaign.parameters), campaign.parameter_names
    if runs == 0:
        raise SurrogateError("there are no training runs; leave some runs out of the test runs")
    if campaign.parameters.shape != (runs, len(names)):
        raise SurrogateError(
            f"parameters have the shape {campaign.parameters.shape}; expected ({runs} runs, {len(names)} names)"
        )
    bad = ~np.isfinite(campaign.parameters)
    if bad.any():
        run, k = np.argwhere(bad)[0]
        raise SurrogateError(
            f"run {_run(campaign, run)}: parameter {names[k]} is {campaign.parameters[run, k]}; expected a number"
        )
    if len(campaign.time) == 0 or (np.diff(campaign.time) <= 0).any():
        raise SurrogateError("time must be strictly increasing; crashkit validate names the states that are not")
    if settings.model == "mh" and not campaign.levels:
        raise SurrogateError("the dataset has no mesh hierarchy, which model mh needs; run crashkit coarsen first")
    if campaign.marked:
        told = "; ".join(f"{name}: {why}" for name, why in list(campaign.marked.items())[:3])
        more = f" and {len(campaign.marked) - 3} more" if len(campaign.marked) > 3 else ""
        notes.add(f"ingest marked {len(campaign.marked)} of the training runs ({told}{more})")
    ranges = Ranges.of(names, campaign.parameter_units, campaign.parameters, campaign.time)
    for name in ranges.constant:
        if runs > 1:
            notes.add(f"parameter {name} has the same value in all training runs; its influence cannot be learnt")
    first: dict[bytes, int] = {}
    for run, row in enumerate(campaign.parameters):
        same = first.setdefault(row.tobytes(), run)
        if same != run:
            notes.add(
                f"runs {_run(campaign, same)} and {_run(campaign, run)} have the same parameters; where their results "
                f"differ, the model gives something between"
            )
    if runs == 1:
        notes.add("there is one training run; the model repeats it whatever the parameters")


def split(campaign: Campaign, settings: Settings, notes: Notes) -> ValidationSplit:
    """Training and validation runs as the settings want them.

    A share is drawn at random with the seed: every eighth run of a Halton campaign would lie in one eighth of the
    first parameter's range.
    """
    runs = len(campaign.parameters)
    everything = np.arange(runs)
    wish = settings.validation
    if wish.measure == "paper" and settings.model not in ("pod-gpr", "pod-rbf"):
        return ValidationSplit(everything, np.empty(0, np.int64))
    if wish.runs:
        place = {name: k for k, name in enumerate(campaign.runs)}
        unknown = [name for name in wish.runs if name not in place]
        if unknown:
            raise SurrogateError(
                f"validation.runs names {unknown[0]!r}, which is no training run; there are {_some(campaign.runs)}"
            )
        chosen = np.array(sorted(place[name] for name in wish.runs))
        if len(chosen) == runs:
            raise SurrogateError("validation.runs names all training runs; leave some to train on")
    elif runs < FEWEST_TO_SPLIT:
        notes.add(f"no run can be held out of {runs}; weights are chosen on the training runs")
        return ValidationSplit(everything, np.empty(0, np.int64))
    else:
        count = min(max(1, round(wish.share * runs)), runs - 1)
        chosen = np.sort(np.random.default_rng(settings.seed).permutation(runs)[:count])
    return ValidationSplit(np.setdiff1d(everything, chosen), chosen)


def everything(campaign: Campaign, settings: Settings) -> ValidationSplit:
    """All runs to train on, for models that choose by folds; runs named for validation are left out while they choose."""
    runs = np.arange(len(campaign.parameters))
    named = split(campaign, settings, Notes()).validation if settings.validation.runs else runs[:0]
    return ValidationSplit(runs, named)


@dataclass(frozen=True)
class Seen:
    """What states are like: the largest displacement in the first states and in all, m; their mean square, m^2; and of
    each state the RMS over the runs, (state,), m, of all states whether known or not."""

    first: float
    largest: float
    mean_square: float
    course: NDArray[np.float64]


class LevelRuns:
    """The displacements of one level, or of some of its `nodes`, run by run: checked, and never all at once unless asked."""

    def __init__(
        self, campaign: Campaign, level: int, settings: Settings, notes: Notes, nodes: NDArray[np.int64] | None = None
    ) -> None:
        self._chosen = nodes
        self._field = campaign.displacement(level)
        self._campaign, self._settings, self._notes = campaign, settings, notes
        expected = (len(campaign.parameters), len(campaign.time))
        if tuple(self._field.shape[:2]) != expected:
            raise SurrogateError(
                f"displacements of level {level} are {tuple(self._field.shape)}; expected {expected[0]} runs and {expected[1]} states"
            )
        self.states = self._field.shape[1]
        self.nodes = self._field.shape[2] if nodes is None else len(nodes)

    def read(self, run: int) -> NDArray[np.float32]:
        """(state, node, 3), m, without missing values.

        Raises
        ------
        SurrogateError
            Naming run, state and node of a missing value, unless it is held (`settings.missing`).
        """
        values = np.asarray(self._field[int(run)], np.float32)
        if self._chosen is not None:
            values = values[:, self._chosen]
        bad = np.zeros(values.shape[:2], bool)
        for k, state in enumerate(values):
            if not all_finite(state):
                bad[k] = ~np.isfinite(state).all(axis=1)
        if not values.any():
            self._notes.add(f"run {self._name(run)} does not move in any state; it is learnt as it is")
        return self._held(values, bad, run) if bad.any() else np.ascontiguousarray(values)

    def there(self, run: int) -> NDArray[np.bool_] | None:
        """(state, node) whether a node has a displacement of its own, and not one that `read` holds; None: all have."""
        if not self._campaign.erodes and self._settings.missing != "hold":
            return None
        values = np.asarray(self._field[int(run)])
        known = np.isfinite(values if self._chosen is None else values[:, self._chosen]).all(axis=2)
        return None if known.all() else np.asarray(known)

    def samples(self, runs: NDArray[np.int64]) -> Tensor:
        """(sim * state, 3, node) of `runs`: rows are contiguous, so that a batch is gathered in whole states."""
        import torch

        out = torch.empty(len(runs) * self.states, 3, self.nodes)
        for k, run in enumerate(runs):
            out[k * self.states : (k + 1) * self.states] = torch.from_numpy(self.read(run)).transpose(1, 2)
        return out

    def gathered(self, runs: NDArray[np.int64], known: NDArray[np.bool_] | None = None) -> tuple[States, Seen]:
        """The states (sample, 3, node) of `runs` that are `known` (run, state), and what they are like as they pass.

        They are in memory, or in a temporary file where they are many.
        """
        import torch

        keep = np.ones((len(runs), self.states), bool) if known is None else known
        shelf = Shelf(int(keep.sum()), (3, self.nodes))
        squares, first, largest, row = np.zeros((len(runs), self.states)), 0.0, 0.0, 0
        for k, run in enumerate(runs):
            values = self.read(run)
            squares[k] = [np.mean(np.square(state, dtype=np.float64)) for state in values]
            first = max(first, float(np.abs(values[0]).max()))
            some = values[keep[k]]
            largest = max(largest, float(np.abs(some).max(initial=0.0)))
            shelf.put(row, some.transpose(0, 2, 1))
            row += len(some)
        states = StoredStates(shelf) if shelf.array is None else torch.from_numpy(shelf.array)
        mean = float(squares[keep].mean()) if row else 0.0
        course = np.sqrt(squares.mean(axis=0)) if len(runs) else np.zeros(self.states)
        return states, Seen(first, largest, mean, course)

    def _held(self, values: NDArray[np.float32], bad: NDArray[np.bool_], run: int) -> NDArray[np.float32]:
        state, node = np.argwhere(bad)[0]
        where = f"run {self._name(run)}, state {state}, node {node}"
        missing = self._settings.missing
        refused = missing == "refuse" or (missing == "auto" and not self._campaign.erodes)
        if refused or np.isinf(values).any():
            raise SurrogateError(
                f"{where}: the displacement is {values[state, node].tolist()}; expected numbers. "
                "Where elements erode, the setting missing=hold keeps a node's last displacement"
            )
        if bad[0].any():
            raise SurrogateError(f"{where}: has no displacement in the first state, so there is none to hold")
        last = np.where(bad, 0, np.arange(len(values))[:, None])
        np.maximum.accumulate(last, axis=0, out=last)
        self._notes.add("nodes that are gone keep their last displacement in training; predictions give them one too")
        return values[last, np.arange(values.shape[1])[None]]

    def _name(self, run: int) -> str:
        return self._campaign.runs[run] if self._campaign.runs else str(run)


def scale_of(mean_square: float) -> float:
    """The unit, m, that a level's states are divided by: their RMS; raises SurrogateError where nothing moves."""
    if not mean_square > 0:
        raise SurrogateError("no training run moves: all displacements are zero, so there is nothing to learn")
    return float(np.sqrt(mean_square))


def _run(campaign: Campaign, run: int) -> str:
    return campaign.runs[run] if campaign.runs else str(run)


def _some(names: tuple[str, ...]) -> str:
    return ", ".join(names[:3]) + (f" .. {names[-1]}" if len(names) > 3 else "")
