"""Who is compared with whom, on which runs, and what forbids it.

A comparison is honest when every model is asked about the same runs and none of them, nor anything that was
chosen with them, has seen one. The names of the runs a model saw are kept in its folder; here they are held
against each other.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.comparison.predictor import ComparedModel, Predictor
from evaluation.comparison.reference import Reference
from evaluation.comparison.scoring import Key
from evaluation.errors import EvaluationError


@dataclass(frozen=True)
class Entry:
    """One row of the comparison: the same predictor of one model, or of its several seeds.

    Attributes
    ----------
    label
        As in tables, figures and files.
    level
        The mesh level it predicts on.
    keys
        (model, predictor) numbers of its seeds, at least one.
    """

    label: str
    level: int
    keys: tuple[Key, ...]


@dataclass(frozen=True)
class Split:
    """Run numbers: `test` for the comparison, `train` for what the models know (modes, ranges); the others are not used."""

    train: tuple[int, ...]
    test: tuple[int, ...]


def agree_on_split(reference: Reference, models: Sequence[ComparedModel], test: Sequence[str] | None = None) -> Split:
    """The test runs: those asked for, else those that all models hold out; and the training runs.

    Training runs are those of the dataset that a model was fitted or tuned on; where one does not say, all that are no
    test runs. A run that no model has seen tells nothing of where they extrapolate.

    Raises
    ------
    EvaluationError
        Where a model was fitted or tuned on a test run, where the models hold out different runs and none were
        asked for, where a model was trained on another dataset, and where no test run is left.
    """
    for model in models:
        if model.checksum and reference.checksum and model.checksum != reference.checksum:
            raise EvaluationError(
                f"{model.name} was trained on another dataset (checksum {model.checksum[:12]}, this one has "
                f"{reference.checksum[:12]}); expected one and the same: give the dataset it was trained on, or "
                f"train it again on this one"
            )
    names = tuple(test) if test is not None else _held_out(models)
    if not names:
        raise EvaluationError(
            "no test runs: the models hold none out and none were asked for; name them with --test, such as --test "
            "27:36, and train with the same runs held out"
        )
    numbers = reference.index(names)
    for model in models:
        for what, seen in (("trained", model.fitted_runs), ("tuned", model.tuned_runs)):
            common = sorted(set(seen) & set(names), key=names.index)
            if common:
                raise EvaluationError(
                    f"{model.name} was {what} on {len(common)} of the {len(names)} test runs ({_some(common)}); an "
                    f"error on them says nothing: choose other test runs, or train it again with these held out"
                )
    taken = set(numbers)
    seen_by = [{*model.fitted_runs, *model.tuned_runs} for model in models]
    known = set().union(*seen_by) if all(seen_by) else set(reference.runs)
    return Split(tuple(k for k, run in enumerate(reference.runs) if k not in taken and run in known), numbers)


def _held_out(models: Sequence[ComparedModel]) -> tuple[str, ...]:
    first = models[0]
    for model in models[1:]:
        if set(model.held_out_runs) != set(first.held_out_runs):
            raise EvaluationError(
                f"{first.name} holds out {_count(first)} and {model.name} {_count(model)}; expected one split for all: "
                f"train them with the same --test, or name test runs that none of them has seen with --test"
            )
    return first.held_out_runs


def _count(model: ComparedModel) -> str:
    runs = model.held_out_runs
    return f"{len(runs)} runs ({_some(runs)})" if runs else "no runs"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])}, ... {names[-1]}"


def _without_seed(name: str) -> str:
    """What a folder is called but for its seed: `kart-seed-0` is `kart`."""
    return re.sub(r"[-_. ]*(seed|s)?[-_. ]*\d+$", "", name) or name


def _check_seeds(models: Sequence[ComparedModel]) -> None:
    """Raise EvaluationError where two models of one row share a training: a spread over seeds would be too small."""
    for one, other in itertools.combinations(models, 2):
        common = sorted(set(one.seeds) & set(other.seeds))
        if one.seed == other.seed and one.averaged == other.averaged:
            raise EvaluationError(
                f"{one.name} and {other.name} have the same settings and the same seed ({one.seed}), so they are one model "
                "given twice; leave one out, or train it again with another --seed"
            )
        if common:
            after = max(*one.seeds, *other.seeds) + 1
            raise EvaluationError(
                f"{one.name} is made of the seeds {_seeds(one)} and {other.name} of {_seeds(other)}, so they share "
                f"{', '.join(map(str, common))} and are not independent; leave one out, or train it again with --seed {after}"
            )


def _seeds(model: ComparedModel) -> str:
    first, *more = model.seeds
    return f"{first} to {more[-1]}" if more else str(first)


def entries(models: Sequence[ComparedModel], seeds_as_spread: bool = True) -> tuple[Entry, ...]:
    """The rows of the comparison, in the order the models were given.

    Models of equal configuration that differ in nothing but the seed become one row with a spread; otherwise equal
    names are told apart by the model's own name, without the seed where there are several.

    Raises
    ------
    EvaluationError
        For no model, for a predictor on two rows of the same label and for one model given twice.
    """
    if not models:
        raise EvaluationError("no model to evaluate; give at least one model folder")
    rows: dict[tuple[str, str], list[tuple[Key, Predictor]]] = {}
    for m, model in enumerate(models):
        kind = model.kind if seeds_as_spread else f"model {m}"
        for p, predictor in enumerate(model.predictors):
            rows.setdefault((predictor.name, kind), []).append(((m, p), predictor))
    for members in rows.values():
        _check_seeds([models[key[0]] for key, _ in members])
    times = [name for name, _ in rows]
    out = []
    for (name, _), members in rows.items():
        folder = models[members[0][0][0]].name
        told_apart = f"{name} ({_without_seed(folder) if len(members) > 1 else folder})"
        label = name if times.count(name) == 1 else told_apart
        out.append(Entry(label, members[0][1].level, tuple(key for key, _ in members)))
    labels = [e.label for e in out]
    for label in labels:
        if labels.count(label) > 1:
            raise EvaluationError(f"two models are called {label}; expected different folder names to tell them apart")
    return tuple(out)
