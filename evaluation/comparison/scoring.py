"""How wrong every model is on every test run, gathered one run at a time.

`score_run` reads one run, asks every predictor for it, lifts the answers to the full mesh with the static
upsampling and keeps the small numbers alone. Runs are independent, so they may be scored anywhere; `gather` puts
them together in the order of the test runs, which makes the result independent of who computed what, and when.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data_schema.levels import Level, lift
from evaluation.comparison.elements import ElementScores, score_elements
from evaluation.comparison.predictor import NOMINAL, Banded, Predictor
from evaluation.comparison.reference import Reference
from evaluation.comparison.sensors import Parted, Sensors, Watched, joined, largest_of_parts, part_error, watch
from evaluation.errors import EvaluationError
from evaluation.measures.distance import Peak, masked_mean, mean_node_error, node_distance
from evaluation.measures.projection import last_seen, projection_error
from evaluation.measures.rigid import RigidMotion, fit_both, fit_rigid
from evaluation.measures.tally import Gathering, Groups, Tally, state_blocks

Key = tuple[int, int]  # number of the model, number of its predictor


@dataclass(frozen=True)
class RunScore:
    """What one predictor got wrong on one run; lengths in metres, everything lifted to level 0 but `on_level`.

    Attributes
    ----------
    e2
        (state,) mean node error of the prediction.
    reconstruction
        (state,) the same of encoding and decoding the truth: what reduction alone costs.
    q95, largest
        (state,) 95 % quantile and maximum over the nodes.
    on_level
        (level 0 .., ) mean over time of the error on the nodes of each level; nodes are nested, so every model can
        be measured on the nodes of every level.
    on_level_reconstruction
        The same for encoding and decoding.
    relative
        Of displacements, over all nodes and states (measures.relative_error).
    peak
        Where and when it is worst.
    node_sum, node_count
        (node,) sum over the states in which the node is there, and how many these are.
    groups
        Name of a grouping ("part", "region") -> (group,) error.
    parted
        Errors of rigid motion and of deformation.
    watched
        What the sensors would see of the prediction; None without sensors.
    covered
        Share of nodes and states within the predictor's own band of `NOMINAL`; NaN where it gives none.
    lifting
        (state,) error of lifting the truth itself by the predictor's own map; None where it has none.
    """

    e2: NDArray[np.float64]
    reconstruction: NDArray[np.float64]
    q95: NDArray[np.float64]
    largest: NDArray[np.float64]
    on_level: NDArray[np.float64]
    on_level_reconstruction: NDArray[np.float64]
    relative: float
    peak: Peak
    node_sum: NDArray[np.float64]
    node_count: NDArray[np.int64]
    groups: Mapping[str, NDArray[np.float64]]
    parted: Parted
    watched: Watched | None = None
    covered: float = float("nan")
    lifting: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class RunScores:
    """Every predictor on one run, and what the run itself is.

    Attributes
    ----------
    size
        (state,) mean displacement of the truth, m.
    group_size
        Grouping -> (group,) its mean over time.
    floor
        Level -> (mode, state) projection error on the nodes of the level, m.
    lifting
        Level >= 1 -> (state,) error of lifting the truth itself from that level: what the mesh costs.
    watched
        What the sensors see of the truth.
    elements
        What predictors say of elements, of those that do.
    """

    run: int
    scores: Mapping[Key, RunScore]
    size: NDArray[np.float64]
    group_size: Mapping[str, NDArray[np.float64]]
    floor: Mapping[int, NDArray[np.float64]]
    lifting: Mapping[int, NDArray[np.float64]]
    watched: Watched | None = None
    elements: Mapping[Key, ElementScores] = field(default_factory=dict)


def score_run(
    reference: Reference,
    predictors: Mapping[Key, Predictor],
    run: int,
    modes: Mapping[int, NDArray[np.float32]] | None = None,
    groups: Groups | None = None,
    sensors: Sensors | None = None,
) -> RunScores:
    """Score every predictor on run number `run`. Memory: the run, and some of its states at a time.

    sensors where histories are taken and intrusion is watched

    Parameters
    ----------
    modes
        Level -> (3 * node of the level, mode) from training runs, for the projection floor.
    groups
        Grouping -> node numbers of each group, such as {"part": reference.part_nodes()}.

    Raises
    ------
    EvaluationError
        Naming model and run where a prediction does not fit the data or is not finite.
    """
    truth = reference.displacement(run)
    states = (len(reference.time), reference.n_nodes, 3)
    if truth.shape != states:
        raise EvaluationError(f"run {reference.runs[run]} has shape {truth.shape}; expected {states}")
    if not np.isfinite(truth).any():
        raise EvaluationError(
            f"run {reference.runs[run]} has no displacement that is a number, so there is no reference to compare "
            f"with; leave it out of the test runs or ingest it again"
        )
    gathering = Gathering.of({**(groups or {}), _LEVELS: _level_nodes(reference)}, reference.n_nodes)
    motion = fit_rigid(reference.position_of(run), truth) if reference.n_nodes > 2 else None
    scores: dict[Key, RunScore] = {}
    for key, predictor in predictors.items():
        try:
            scores[key] = _score(reference, predictor, run, truth, motion, gathering, sensors)
        except EvaluationError as error:
            raise EvaluationError(f"{predictor.name} on run {reference.runs[run]}: {error}") from error
    elements = {key: found for key, p in predictors.items() if (found := score_elements(reference, p, run)) is not None}
    floor = {
        level: projection_error(truth if level == 0 else truth[:, reference.level(level).kept], basis)
        for level, basis in (modes or {}).items()
    }
    return RunScores(
        run,
        scores,
        *_sizes(reference, truth, gathering),
        floor,
        _lifting(reference, truth),
        None
        if sensors is None
        else joined(
            [watch(reference, sensors, run, truth[s], _part(motion, s)) for s in state_blocks(*truth.shape[:2])]
        ),
        elements,
    )


_LEVELS = "level"  # the grouping by which errors on the nodes of every level are found


def _level_nodes(reference: Reference) -> list[NDArray[np.int64]]:
    return [np.arange(reference.n_nodes), *(level.kept for level in reference.levels)]


def _score(
    reference: Reference,
    predictor: Predictor,
    run: int,
    truth: NDArray[np.float32],
    motion: RigidMotion | None,
    gathering: Gathering,
    sensors: Sensors | None,
) -> RunScore:
    mesh = mesh_of(reference, predictor)
    # A reduction is asked about whole states; what is gone there stays where it was.
    own = last_seen(truth) if mesh is None else last_seen(truth[:, mesh.kept])
    asked = Tally(gathering, reference.n_nodes)
    again = Tally(gathering.only(_LEVELS), reference.n_nodes, brief=True)
    parted, watched, within, lifting = [], [], np.zeros(2, np.int64), []
    position = reference.position_of(run)
    for states in state_blocks(*truth.shape[:2]):
        count = states.stop - states.start
        field = predictor.predict(reference.parameters[run], reference.time[states])
        prediction = full_field(reference, predictor, field, count)
        distance = asked.add(truth[states], prediction)
        within += _within(predictor, reference.parameters[run], reference.time[states], distance)
        motions = fit_both(position, truth[states], prediction, _part(motion, states))
        parted.append(part_error(reference, run, truth[states], prediction, motions))
        if sensors is not None:
            whole = len(distance) > 0 and not bool(np.isnan(distance.sum()))
            watched.append(watch(reference, sensors, run, prediction, motions[1] if whole else None))
        again.add(truth[states], full_field(reference, predictor, predictor.reconstruct(own[states]), count))
        if predictor.mesh is not None:
            lifted = full_field(reference, predictor, own[states], count)
            lifting.append(mean_node_error(node_distance(truth[states], lifted)))
    return RunScore(
        e2=asked.over_time("e2"),
        reconstruction=again.over_time("e2"),
        q95=asked.over_time("q95"),
        largest=asked.over_time("largest"),
        on_level=asked.of_groups(_LEVELS),
        on_level_reconstruction=again.of_groups(_LEVELS),
        relative=asked.relative,
        peak=asked.peak,
        node_sum=asked.node_sum,
        node_count=asked.node_count,
        groups={name: asked.of_groups(name) for name in gathering.groups if name != _LEVELS},
        parted=joined(parted),
        watched=joined(watched) if watched else None,
        covered=within[0] / within[1] if within[1] else float("nan"),
        lifting=np.concatenate(lifting) if lifting else None,
    )


def _part(motion: RigidMotion | None, states: slice) -> RigidMotion | None:
    """The motion of some states."""
    return None if motion is None else RigidMotion(motion.rotation[states], motion.translation[states], motion.centre)


def _within(
    predictor: Predictor,
    parameters: NDArray[np.float64],
    time: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> NDArray[np.int64]:
    """(2,): how many nodes and states lie within the predictor's band, and how many are there; zeros where it gives none."""
    width = predictor.half_width(NOMINAL, time, parameters) if isinstance(predictor, Banded) else None
    if width is None:
        return np.zeros(2, np.int64)
    return np.array([np.count_nonzero(distance <= width), np.count_nonzero(np.isfinite(distance))])


def _sizes(
    reference: Reference, truth: NDArray[np.float32], gathering: Gathering
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Mean displacement (state,) of all nodes, and over time of each group (group,), m."""
    still = Tally(gathering, reference.n_nodes, brief=True)
    for states in state_blocks(*truth.shape[:2]):
        still.add(truth[states], np.zeros_like(truth[states]))
    return still.over_time("e2"), {name: still.of_groups(name) for name in gathering.groups if name != _LEVELS}


def _lifting(reference: Reference, truth: NDArray[np.float32]) -> dict[int, NDArray[np.float64]]:
    """Level -> (state,) error of lifting the truth itself from it, m."""
    out = {}
    for level in reference.levels:
        kept = last_seen(truth[:, level.kept])
        blocks = state_blocks(*truth.shape[:2])
        out[level.index] = np.concatenate(
            [mean_node_error(node_distance(truth[s], lift(level.to_full, kept[s]))) for s in blocks]
        )
    return out


def full_field(
    reference: Reference, predictor: Predictor, field: NDArray[np.floating], states: int | None = None
) -> NDArray[np.float32]:
    """`field` (state, node of the predictor's level, 3) on the full mesh: (state, node, 3).

    `states` are expected, by default all of the reference.

    Raises
    ------
    EvaluationError
        Where the predictor gave another shape than its level has.
    """
    mesh = mesh_of(reference, predictor)
    nodes = reference.n_nodes if mesh is None else len(mesh.kept)
    expected = (len(reference.time) if states is None else states, nodes, 3)
    if field.shape != expected:
        raise EvaluationError(
            f"gave an array of shape {field.shape}; expected {expected} on level {predictor.level} of this dataset; "
            f"evaluate it with the dataset it was trained on"
        )
    own = np.asarray(field, dtype=np.float32)
    return own if mesh is None else np.asarray(lift(mesh.to_full, own))


def mesh_of(reference: Reference, predictor: Predictor) -> Level | None:
    """The coarse mesh `predictor` works on: its own, or the dataset's level; None for the full mesh."""
    if predictor.level == 0:
        return None
    return predictor.mesh if predictor.mesh is not None else reference.level(predictor.level)


@dataclass(frozen=True)
class Scores:
    """One row of the comparison over all seeds and test runs; lengths in metres, as in RunScore.

    Attributes
    ----------
    e2, reconstruction, q95, largest
        (seed, run, state).
    on_level, on_level_reconstruction
        (seed, run, level).
    relative, covered, peak_value, peak_state, peak_node
        (seed, run).
    node_mean
        (node,) over seeds, runs and states.
    groups
        Grouping -> (seed, run, group).
    rigid, deformation
        (seed, run, state); true_rigid, true_deformation (run, state) their sizes.
    probes
        (seed, run, state, probe, 3) displacements; empty without sensors.
    intrusion
        (seed, run, state).
    part_intrusion
        (seed, run, part) largest of each run.
    """

    e2: NDArray[np.float64]
    reconstruction: NDArray[np.float64]
    q95: NDArray[np.float64]
    largest: NDArray[np.float64]
    on_level: NDArray[np.float64]
    on_level_reconstruction: NDArray[np.float64]
    relative: NDArray[np.float64]
    covered: NDArray[np.float64]
    peak_value: NDArray[np.float64]
    peak_state: NDArray[np.int64]
    peak_node: NDArray[np.int64]
    node_mean: NDArray[np.float64]
    groups: Mapping[str, NDArray[np.float64]]
    rigid: NDArray[np.float64]
    deformation: NDArray[np.float64]
    true_rigid: NDArray[np.float64]
    true_deformation: NDArray[np.float64]
    probes: NDArray[np.float64]
    intrusion: NDArray[np.float64]
    part_intrusion: NDArray[np.float64]

    @property
    def of_runs(self) -> NDArray[np.float64]:
        """(run,) m: mean over time and seeds, the error by which runs are ranked."""
        return masked_mean(self.e2, axis=(0, 2))

    @property
    def of_seeds(self) -> NDArray[np.float64]:
        """(seed,) m: mean over time and test runs for each seed."""
        return masked_mean(masked_mean(self.e2, axis=2), axis=1)

    @property
    def mean(self) -> float:
        """The number in the table, m: mean over time, test runs and seeds."""
        return float(self.of_seeds.mean())

    @property
    def spread(self) -> float:
        """Standard deviation over the seeds, m; NaN for a single seed."""
        return float(self.of_seeds.std(ddof=1)) if len(self.of_seeds) > 1 else float("nan")

    @property
    def reduction(self) -> float:
        """Mean over time, runs and seeds of the reconstruction error, m."""
        return float(masked_mean(self.reconstruction))


def gather(runs: Iterable[RunScores], keys: Sequence[Key]) -> Scores:
    """Put the scores of the predictors `keys` (the seeds of one row) together, in the order of `runs`."""
    table = [[r.scores[key] for r in runs] for key in keys] if (runs := list(runs)) else []
    if not table:
        raise EvaluationError("there are no scored runs; expected at least one test run")

    def stack(name: str) -> NDArray[np.float64]:
        return np.array([[getattr(s, name) for s in row] for row in table])

    flat = [s for row in table for s in row]
    count = np.sum([s.node_count for s in flat], axis=0)
    total = np.sum([s.node_sum for s in flat], axis=0)
    return Scores(
        **{
            name: stack(name)
            for name in (
                "e2", "reconstruction", "q95", "largest", "on_level", "on_level_reconstruction", "relative", "covered",
            )
        },
        peak_value=np.array([[s.peak.value for s in row] for row in table]),
        peak_state=np.array([[s.peak.state for s in row] for row in table]),
        peak_node=np.array([[s.peak.node for s in row] for row in table]),
        node_mean=np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0),
        groups={name: np.array([[s.groups[name] for s in row] for row in table]) for name in flat[0].groups},
        rigid=np.array([[s.parted.rigid for s in row] for row in table]),
        deformation=np.array([[s.parted.deformation for s in row] for row in table]),
        true_rigid=np.array([s.parted.true_rigid for s in table[0]]),
        true_deformation=np.array([s.parted.true_deformation for s in table[0]]),
        probes=np.array([[s.watched.probes for s in row if s.watched] for row in table]),
        intrusion=np.array([[s.watched.intrusion for s in row if s.watched] for row in table]),
        part_intrusion=np.array([[largest_of_parts(s.watched.parts) for s in row if s.watched] for row in table]),
    )  # fmt: skip


def contributions(lifted: Mapping[str, NDArray[np.floating]]) -> dict[str, NDArray[np.floating]]:
    """What each level adds to the coarser one (paper, section 4.2): fields on the full mesh, coarsest first.

    Parameters
    ----------
    lifted
        Predictor -> field of any one shape, coarsest level first. The sum of all is the finest prediction.
    """
    out: dict[str, NDArray[np.floating]] = {}
    before: NDArray[np.floating] | None = None
    for name, one in lifted.items():
        out[name] = one if before is None else one - before
        before = one
    return out
