"""Everything an evaluation found, for figures, tables and words; and the function that finds it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crashkit.display import Described, Facts, Rows, listed
from data_schema.pod import Pod, StreamedPod
from evaluation.comparison.beside import Beside
from evaluation.comparison.predictor import ComparedModel, Predictor
from evaluation.comparison.reference import Reference
from evaluation.comparison.scoring import Key, RunScores, Scores, full_field, gather, mesh_of, score_run
from evaluation.comparison.sensors import Sensors, choose_sensors
from evaluation.comparison.split import Entry, Split, entries
from evaluation.comparison.timing import Timing, time_predictions
from evaluation.errors import EvaluationError
from evaluation.measures.distance import masked_mean
from evaluation.measures.projection import last_seen, moving
from evaluation.measures.regions import by_grid, by_part
from evaluation.measures.tally import Groups

if TYPE_CHECKING:
    from evaluation.measures.curves import Ratings

N_MODES = 50  # as many singular values as the paper shows


@dataclass(frozen=True, repr=False)
class Evaluation(Described):
    """The comparison of `entries` on the test runs of `split`.

    Attributes
    ----------
    scores
        Label of an entry -> its scores.
    runs
        One RunScores a test run: sizes of the truth, floors, costs of lifting.
    pods
        Level -> decomposition of the training runs on its nodes.
    timings
        Label -> milliseconds of a prediction; empty where not timed.
    context
        Name -> text for the methods section: data, split, versions, machine.
    group_names
        Grouping -> name of each group.
    sensors
        Where histories were taken; None without.
    files
        ParaView files written of it (evaluation.report.files.write_run).
    beside
        Histories and numbers by formula; None where no model has any.
    last_states
        Number of a training run -> its displacements (node, 3), m, at the end, of those that are shown.
    """

    reference: Reference
    models: tuple[ComparedModel, ...]
    entries: tuple[Entry, ...]
    split: Split
    scores: Mapping[str, Scores]
    runs: tuple[RunScores, ...]
    pods: Mapping[int, Pod]
    timings: Mapping[str, Timing]
    group_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    context: Mapping[str, str] = field(default_factory=dict)
    sensors: Sensors | None = None
    files: tuple[Path, ...] = ()
    beside: Beside | None = None
    last_states: Mapping[int, NDArray[np.floating]] = field(default_factory=dict)

    def _facts(self) -> tuple[str, Facts, Sequence[str], Rows]:
        rows = []
        for entry in self.entries:
            scores = self.scores[entry.label]
            worst = int(np.argmax(scores.of_runs))
            errors = (f"{100 * scores.mean:.2f}", f"{100 * scores.of_runs[worst]:.2f}")
            rows.append((entry.label, entry.level, self.nodes(entry), *errors, self.test_names[worst]))
        facts = {"test runs": listed(self.test_names), "mesh": f"{self.reference.n_nodes} nodes"}
        columns = ("model", "level", "nodes", "mean node error (cm)", "worst run (cm)", "which")
        return "evaluation on the full mesh", facts, columns, rows

    @property
    def test_names(self) -> tuple[str, ...]:
        return tuple(self.reference.runs[k] for k in self.split.test)

    def predictor(self, entry: Entry, seed: int = 0) -> Predictor:
        """The predictor of one seed of `entry`."""
        model, number = entry.keys[seed]
        return self.models[model].predictors[number]

    @property
    def first_seeds(self) -> list[ComparedModel]:
        """One model a row: further seeds are not drawn or written."""
        return [self.models[m] for m in sorted({entry.keys[0][0] for entry in self.entries})]

    def model(self, entry: Entry, seed: int = 0) -> ComparedModel:
        """The model that one seed of `entry` belongs to."""
        return self.models[entry.keys[seed][0]]

    def floor(self, level: int = 0) -> NDArray[np.float64]:
        """(mode,) m: mean over time and test runs of the projection error on 1, 2, ... modes."""
        return masked_mean(masked_mean(np.array([r.floor[level] for r in self.runs]), axis=2), axis=0)

    def floor_at(self, modes: int) -> float:
        """The floor on the full mesh for as many modes, m; NaN where so many were not computed."""
        floor = self.floor()
        return float(floor[modes - 1]) if 1 <= modes <= len(floor) else float("nan")

    def lifting(self, level: int) -> float:
        """Mean error of lifting the truth itself from `level`, m; 0 on the full mesh."""
        return 0.0 if level == 0 else float(masked_mean(np.array([r.lifting[level] for r in self.runs])))

    def lifting_of(self, entry: Entry) -> float:
        """The same by the map of `entry`, which may have learnt a better one."""
        own = [run.scores[key].lifting for key in entry.keys for run in self.runs]
        learnt = [each for each in own if each is not None]
        return float(masked_mean(np.array(learnt))) if learnt else self.lifting(entry.level)

    def nodes(self, entry: Entry) -> int:
        """Number of nodes that `entry` predicts on."""
        mesh = mesh_of(self.reference, self.predictor(entry))
        return self.reference.n_nodes if mesh is None else len(mesh.kept)

    def lifted(self, entry: Entry, run: int, states: slice | Sequence[int] = slice(None)) -> NDArray[np.float32]:
        """Prediction of the first seed of `entry` for run number `run`, on the full mesh: (state, node, 3), m."""
        predictor = self.predictor(entry)
        times = self.reference.time[states]
        field = predictor.predict(self.reference.parameters[run], times)
        return full_field(self.reference, predictor, field, len(times))

    @property
    def size(self) -> float:
        """Mean displacement over nodes, time and test runs, m: what errors are to be held against."""
        return float(masked_mean(np.array([r.size for r in self.runs])))

    @functools.cached_property
    def ratings(self) -> Ratings | None:
        """ISO/TS 18571 ratings at the probes; None where there are no sensors or the runs are too short."""
        from evaluation.measures.curves import rate_curves

        if self.sensors is None:
            return None
        truths = [r.watched.probes for r in self.runs if r.watched is not None]
        return rate_curves(self.reference.time, truths, {e.label: self.scores[e.label].probes[0] for e in self.entries})

    @property
    def ranked(self) -> tuple[Entry, ...]:
        """Entries by mean error, best first."""
        return tuple(sorted(self.entries, key=lambda e: self.scores[e.label].mean))

    @property
    def leaders(self) -> tuple[Entry, ...]:
        """The most accurate row of each model, best first: of the levels of a cascade one alone."""
        best: dict[int, Entry] = {}
        for entry in self.ranked:
            best.setdefault(entry.keys[0][0], entry)
        return tuple(best.values())


def predictors_of(models: Sequence[ComparedModel]) -> dict[Key, Predictor]:
    """Every predictor of every model under its two numbers."""
    return {(m, p): predictor for m, model in enumerate(models) for p, predictor in enumerate(model.predictors)}


def decompose(
    reference: Reference,
    runs: Sequence[int],
    count: int = N_MODES,
    done: Callable[[int], None] | None = None,
    watch: Callable[[int, NDArray[np.floating]], None] | None = None,
) -> dict[int, Pod]:
    """POD of `runs` on the full mesh and on every coarse level, reading each run once: level -> Pod.

    watch  shown each run as it passes: its number and (state, node, 3), m

    Raises
    ------
    EvaluationError
        Where nothing moves.
    """
    if not runs:
        raise EvaluationError("there is no training run to decompose; expected at least one")
    streams = {level: StreamedPod(count) for level in range(len(reference.levels) + 1)}
    for run in runs:
        truth = reference.displacement(run)
        for level, stream in streams.items():
            stream.add(last_seen(truth if level == 0 else truth[:, reference.level(level).kept]))
        if watch:
            watch(run, truth)
        if done:
            done(run)
    return {level: moving(stream.result()) for level, stream in streams.items()}


def default_groups(reference: Reference) -> tuple[Groups, dict[str, tuple[str, ...]]]:
    """The node groups errors are split into, and their names: parts, and boxes that cut the longest side in three and
    the second longest in two."""
    parts = by_part(reference.faces, reference.face_part, reference.part_names)
    counts = [1, 1, 1]
    longest = np.argsort(-np.ptp(reference.position, axis=0), kind="stable")
    counts[longest[0]], counts[longest[1]] = 3, 2
    regions = by_grid(reference.position, counts)
    return {"part": parts.nodes, "region": regions.nodes}, {"part": parts.names, "region": regions.names}


def compare(
    reference: Reference,
    models: Sequence[ComparedModel],
    split: Split,
    *,
    seeds_as_spread: bool = True,
    pods: Mapping[int, Pod] | None = None,
    scored: Sequence[RunScores] | None = None,
    timed: bool = True,
    context: Mapping[str, str] | None = None,
    sensors: Sensors | None = None,
) -> Evaluation:
    """Compare `models` on the test runs of `split`; everything in this process unless given.

    Parameters
    ----------
    pods
        Decomposition of the training runs, where it is there already.
    scored
        One RunScores a test run, in the order of `split.test`, where they were computed elsewhere.
    timed
        Whether predictions are timed here.
    sensors
        Where histories are taken; default: sensors.choose_sensors.

    Raises
    ------
    EvaluationError
        Where the models cannot be compared (see comparison.entries) or do not fit the data.
    """
    rows = entries(models, seeds_as_spread)
    predictors = predictors_of(models)
    groups, names = default_groups(reference)
    sensors = sensors or choose_sensors(reference)
    if pods is None:
        pods = decompose(reference, split.train)
    if scored is None:
        modes = {level: pod.modes for level, pod in pods.items()}
        scored = [score_run(reference, predictors, run, modes, groups, sensors) for run in split.test]
    if tuple(s.run for s in scored) != split.test:
        raise EvaluationError("the scored runs are not the test runs in their order; expected one score for each")
    timings = {row.label: time_predictions(reference, predictors[row.keys[0]], split.test[0]) for row in rows if timed}
    return Evaluation(
        reference=reference,
        models=tuple(models),
        entries=rows,
        split=split,
        scores={row.label: gather(scored, row.keys) for row in rows},
        runs=tuple(scored),
        pods=pods,
        timings=timings,
        group_names=names,
        context=dict(context or {}),
        sensors=sensors,
    )
