"""Scores of real runs against plain formulas."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from evaluation.comparison.reference import Reference
from evaluation.comparison.result import compare, decompose, predictors_of
from evaluation.comparison.scoring import (
    RunScore,
    RunScores,
    contributions,
    full_field,
    gather,
    mesh_of,
    score_run,
)
from evaluation.comparison.sensors import Parted, Watched, choose_sensors, watch
from evaluation.comparison.split import Split
from evaluation.errors import EvaluationError
from evaluation.measures.distance import Peak


def test_the_number_in_the_table_is_the_mean_of_means(reference, models, evaluation):
    predictor = models[0].predictors[2]
    expected = []
    for run in (9, 10, 11):
        coarse = predictor.predict(reference.parameters[run], reference.time)
        full = np.stack([reference.level(3).to_full @ state for state in coarse])
        expected.append(np.linalg.norm(reference.displacement(run) - full, axis=-1).mean(axis=1).mean())
    assert evaluation.scores["MH3"].mean == pytest.approx(np.mean(expected), rel=1e-5)
    np.testing.assert_allclose(evaluation.scores["MH3"].of_runs, expected, rtol=1e-5)


def test_the_error_on_its_own_level_needs_no_lifting(reference, models, evaluation):
    predictor, kept = models[0].predictors[1], reference.level(2).kept
    own = [
        np.linalg.norm(
            reference.displacement(run)[:, kept] - predictor.predict(reference.parameters[run], reference.time), axis=-1
        ).mean()
        for run in (9, 10, 11)
    ]
    np.testing.assert_allclose(evaluation.scores["MH2"].on_level[0, :, 2], own, rtol=1e-5)


def test_a_full_model_is_measured_on_the_same_coarse_nodes(reference, models, evaluation):
    predictor, kept = models[1].predictors[0], reference.level(3).kept
    field = predictor.predict(reference.parameters[10], reference.time)
    expected = np.linalg.norm((reference.displacement(10) - field)[:, kept], axis=-1).mean()
    assert evaluation.scores["PODNN"].on_level[0, 1, 3] == pytest.approx(expected, rel=1e-5)


def test_reconstruction_of_pod_is_its_projection(reference, models, evaluation):
    predictor = models[1].predictors[0]
    u = reference.displacement(9)
    expected = np.linalg.norm(u - predictor.reconstruct(u), axis=-1).mean(axis=1)
    np.testing.assert_allclose(evaluation.scores["PODNN"].reconstruction[0, 0], expected, rtol=1e-5)


def test_the_floor_is_that_of_the_training_runs_modes(reference, evaluation):
    x = np.concatenate([reference.displacement(k).reshape(6, -1) for k in range(9)]).astype(float)
    v = np.linalg.svd(x, full_matrices=False)[2][:4].T
    u = [reference.displacement(k).reshape(6, -1).astype(float) for k in (9, 10, 11)]
    rest = [(a - a @ v @ v.T).reshape(6, -1, 3) for a in u]
    assert evaluation.floor_at(4) == pytest.approx(np.mean([np.linalg.norm(r, axis=-1).mean() for r in rest]), rel=1e-3)


def test_the_cost_of_lifting_is_that_of_the_truth(reference, evaluation):
    level = reference.level(1)
    errors = []
    for run in (9, 10, 11):
        u = reference.displacement(run)
        lifted = np.stack([level.to_full @ state for state in u[:, level.kept]])
        errors.append(np.linalg.norm(u - lifted, axis=-1).mean())
    assert evaluation.lifting(1) == pytest.approx(np.mean(errors), rel=1e-4)
    assert evaluation.lifting(0) == 0
    for entry in evaluation.entries:
        assert evaluation.lifting_of(entry) == evaluation.lifting(entry.level)


def test_a_model_with_a_map_of_its_own_is_measured_with_it(reference, models):
    level = reference.level(3)
    heaviest = np.asarray(level.to_full.argmax(axis=1)).ravel()
    nearest = sparse.csr_matrix((np.ones(len(heaviest)), (np.arange(len(heaviest)), heaviest)), level.to_full.shape)
    mine = copy.copy(models[0].predictors[2])
    mine.mesh = replace(level, to_full=nearest)
    model = replace(models[0], predictors=(mine,))
    evaluation = compare(reference, [model], Split(tuple(range(9)), (10,)))
    truth = reference.displacement(10)
    said = mine.predict(reference.parameters[10], reference.time)
    (entry,) = evaluation.entries

    def off(states: np.ndarray) -> float:
        return float(np.linalg.norm(truth - states[:, heaviest], axis=-1).mean())

    assert evaluation.lifting_of(entry) == pytest.approx(off(truth[:, level.kept]), rel=1e-4)
    assert evaluation.scores[entry.label].mean == pytest.approx(off(said), rel=1e-4)
    assert evaluation.lifting(3) < evaluation.lifting_of(entry)


def test_the_mean_error_of_a_node_is_over_runs_and_states(reference, models, evaluation):
    predictor = models[2].predictors[0]
    distances = [
        np.linalg.norm(
            reference.displacement(run) - predictor.predict(reference.parameters[run], reference.time), axis=-1
        )
        for run in (9, 10, 11)
    ]
    np.testing.assert_allclose(evaluation.scores["POD-GPR"].node_mean, np.mean(distances, axis=(0, 1)), rtol=1e-5)


def test_deformation_and_rigid_motion_are_split(reference, evaluation):
    # A rigid shift of the truth is all rigid error and no deformation.
    from evaluation.comparison.sensors import part_error

    u = reference.displacement(9)
    parted = part_error(reference, 9, u, u + np.float32([0.1, 0, 0]))
    np.testing.assert_allclose(parted.rigid, 0.1, rtol=1e-3)
    np.testing.assert_allclose(parted.deformation, 0, atol=1e-6)
    assert evaluation.scores["MH1"].deformation.shape == (1, 3, 6)


def test_gone_nodes_do_not_count(reference, eroded, models):
    key, predictor = (1, 0), models[1].predictors[0]
    whole = score_run(reference, {key: predictor}, 9).scores[key]
    masked = score_run(eroded, {key: predictor}, 9).scores[key]
    assert (masked.node_count[:50] == 2).all()
    assert (masked.node_count[50:] == 6).all()
    prediction = predictor.predict(reference.parameters[9], reference.time)
    expected = np.linalg.norm((reference.displacement(9) - prediction)[:, 50:], axis=-1).mean(axis=1)
    np.testing.assert_allclose(masked.e2[2:], expected[2:], rtol=1e-6)
    np.testing.assert_allclose(masked.e2[:2], whole.e2[:2], rtol=1e-12)
    assert np.isfinite(masked.reconstruction).all()


def test_an_evaluation_of_eroded_runs_holds_numbers_only(eroded, models):
    result = compare(eroded, models[1:], Split(tuple(range(9)), (9, 10)), timed=False)
    scores = result.scores["PODNN"]
    assert np.isfinite(scores.e2).all()
    assert np.isfinite(scores.node_mean).all()
    assert np.isfinite(scores.deformation).all()


def test_a_run_without_reference_is_an_error(reference, models):
    empty = replace(reference, displacement=lambda k: np.full((6, reference.n_nodes, 3), np.nan, np.float32))
    with pytest.raises(EvaluationError, match="run run_09 has no displacement that is a number"):
        score_run(empty, predictors_of(models), 9)


def test_a_model_of_another_mesh_is_an_error_that_names_model_and_run(reference, models):
    fewer = replace(reference, levels=reference.levels[1:])
    with pytest.raises(EvaluationError, match=r"MH1 on run run_09: .*\(6, 150, 3\)"):
        score_run(replace(fewer, levels=tuple(replace(v, index=k + 1) for k, v in enumerate(fewer.levels))),
                  {(0, 0): models[0].predictors[0]}, 9)  # fmt: skip


def test_a_model_on_a_level_the_dataset_lacks_is_an_error(reference, models):
    with pytest.raises(EvaluationError, match="level 1 asked for; the dataset's hierarchy has 0"):
        score_run(replace(reference, levels=()), {(0, 0): models[0].predictors[0]}, 9)


def test_seeds_are_averaged_and_their_spread_is_kept(reference, models):
    predictors = {(0, 0): models[1].predictors[0], (1, 0): models[2].predictors[0]}
    runs = [score_run(reference, predictors, k) for k in (9, 10)]
    both = gather(runs, [(0, 0), (1, 0)])
    one, two = (gather(runs, [key]).mean for key in predictors)
    assert both.mean == pytest.approx((one + two) / 2)
    assert both.spread == pytest.approx(np.std([one, two], ddof=1))
    assert np.isnan(gather(runs, [(0, 0)]).spread)


def test_modes_of_each_level_come_from_one_pass(reference):
    reads = []
    counting = replace(reference, displacement=lambda k: (reads.append(k), reference.displacement(k))[1])
    pods = decompose(counting, range(4), 5)
    assert reads == [0, 1, 2, 3]
    assert {level: len(pod.modes) for level, pod in pods.items()} == {
        level: 3 * reference.level_nodes(level) for level in range(4)
    }


def test_how_many_states_are_handled_at_once_does_not_matter(reference, models, evaluation, monkeypatch):
    monkeypatch.setattr("evaluation.measures.tally._BLOCK", 1)  # one state at a time
    again = score_run(reference, predictors_of(models), 9, {0: evaluation.pods[0].modes}, sensors=evaluation.sensors)
    before = evaluation.runs[0]
    np.testing.assert_allclose(again.size, before.size, rtol=1e-6)
    np.testing.assert_allclose(again.floor[0], before.floor[0], rtol=1e-4)
    for key, score in again.scores.items():
        np.testing.assert_allclose(score.e2, before.scores[key].e2, rtol=1e-5)
        np.testing.assert_allclose(score.reconstruction, before.scores[key].reconstruction, rtol=1e-4)
        np.testing.assert_allclose(score.on_level, before.scores[key].on_level, rtol=1e-5)
        np.testing.assert_allclose(score.parted.deformation, before.scores[key].parted.deformation, atol=1e-6)
        np.testing.assert_allclose(score.watched.intrusion, before.scores[key].watched.intrusion, atol=1e-6)
        assert (score.peak.state, score.peak.node) == (before.scores[key].peak.state, before.scores[key].peak.node)
        assert score.relative == pytest.approx(before.scores[key].relative, rel=1e-6)


def test_scoring_holds_one_run_and_some_of_its_states(monkeypatch):
    import tracemalloc

    nodes, states = 4000, 60
    u = np.zeros((states, nodes, 3), np.float32)
    u[..., 0] = np.linspace(0, 1, states)[:, None]

    class Still:
        name, level, mesh, n_latent = "still", 0, None, 1

        def predict(self, parameters, time):
            return np.zeros((len(time), nodes, 3), np.float32)

        def reconstruct(self, displacement):
            return displacement

    position = np.random.default_rng(0).uniform(size=(nodes, 3))
    big = Reference(
        runs=("a",), parameters=np.zeros((1, 1)), parameter_names=("p",), parameter_units=("1",),
        time=np.linspace(0, 0.03, states), displacement=lambda k: u.copy(), position=position,
        faces=np.array([[0, 1, 2]]), face_part=np.array([0]), part_names=("all",), node_id=np.arange(nodes),
        part_id=np.array([1]),
    )  # fmt: skip
    monkeypatch.setattr("evaluation.measures.tally._BLOCK", 12 * nodes)
    sensors = choose_sensors(big)
    tracemalloc.start()
    score_run(big, {(0, 0): Still()}, 0, {0: np.eye(3 * nodes, 2, dtype=np.float32)}, sensors=sensors)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * u.nbytes


def test_contributions_add_up_to_the_finest():
    rng = np.random.default_rng(0)
    lifted = {name: rng.normal(size=(2, 5, 3)) for name in ("MH3", "MH2", "MH1")}
    parts = contributions(lifted)
    np.testing.assert_array_equal(parts["MH3"], lifted["MH3"])
    np.testing.assert_allclose(sum(parts.values()), lifted["MH1"])


# Gathering: seeds first, then runs, then what was measured


def one_score(rng: np.random.Generator, watched: bool = True) -> RunScore:
    """States 4, nodes 5, levels 3, groups 2, probes 2; numbers that nothing else has."""

    def draw(*shape: int) -> np.ndarray:
        return rng.uniform(1, 2, shape)

    return RunScore(
        e2=draw(4), reconstruction=draw(4), q95=draw(4), largest=draw(4), on_level=draw(3), on_level_reconstruction=draw(3),
        relative=float(draw()), peak=Peak(float(draw()), int(rng.integers(4)), int(rng.integers(5))), node_sum=draw(5),
        node_count=rng.integers(1, 5, 5), groups={"part": draw(2)}, parted=Parted(draw(4), draw(4), draw(4), draw(4)),
        watched=Watched(draw(4, 2, 3), draw(4), draw(4, 3)) if watched else None, covered=float(draw()),
    )  # fmt: skip


def table(seeds: int = 2, runs: int = 3, watched: bool = True) -> list[RunScores]:
    rng = np.random.default_rng(0)
    return [
        RunScores(k, {(seed, 0): one_score(rng, watched) for seed in range(seeds)}, rng.uniform(size=4), {}, {}, {})
        for k in range(runs)
    ]


def test_gathered_numbers_are_by_seed_then_run():
    runs = table()
    found = gather(iter(runs), [(0, 0), (1, 0)])
    named = {
        "e2": lambda s: s.e2, "reconstruction": lambda s: s.reconstruction, "q95": lambda s: s.q95, "largest": lambda s: s.largest,
        "on_level": lambda s: s.on_level, "on_level_reconstruction": lambda s: s.on_level_reconstruction,
        "relative": lambda s: s.relative, "covered": lambda s: s.covered, "peak_value": lambda s: s.peak.value,
        "peak_state": lambda s: s.peak.state, "peak_node": lambda s: s.peak.node, "rigid": lambda s: s.parted.rigid,
        "deformation": lambda s: s.parted.deformation, "probes": lambda s: s.watched.probes,
        "intrusion": lambda s: s.watched.intrusion,
    }  # fmt: skip
    for name, of in named.items():
        for seed in range(2):
            for k in range(3):
                np.testing.assert_array_equal(getattr(found, name)[seed, k], of(runs[k].scores[seed, 0]), err_msg=name)
    for k in range(3):
        np.testing.assert_array_equal(found.groups["part"][1, k], runs[k].scores[1, 0].groups["part"])
        np.testing.assert_array_equal(found.true_rigid[k], runs[k].scores[0, 0].parted.true_rigid)
        np.testing.assert_array_equal(found.true_deformation[k], runs[k].scores[0, 0].parted.true_deformation)


def test_seeds_are_in_the_order_asked_for():
    runs = table()
    np.testing.assert_array_equal(gather(runs, [(1, 0), (0, 0)]).e2, gather(runs, [(0, 0), (1, 0)]).e2[::-1])


def test_means_over_time_runs_and_seeds_count_each_the_same():
    found = gather(table(), [(0, 0), (1, 0)])
    np.testing.assert_allclose(found.of_runs, found.e2.mean(axis=(0, 2)))
    np.testing.assert_allclose(found.of_seeds, found.e2.mean(axis=(1, 2)))
    assert found.mean == pytest.approx(found.e2.mean())
    assert found.reduction == pytest.approx(found.reconstruction.mean())
    assert found.spread == pytest.approx(found.of_seeds.std(ddof=1))


def test_the_mean_of_a_node_is_over_the_states_in_which_it_is_there():
    runs = table()
    for r in runs:
        for score in r.scores.values():
            score.node_count[2] = 0
            score.node_sum[2] = 0
    scores = [s for r in runs for s in r.scores.values()]
    found = gather(runs, [(0, 0), (1, 0)]).node_mean
    total, count = sum(s.node_sum for s in scores), sum(s.node_count for s in scores)
    there = [0, 1, 3, 4]
    np.testing.assert_allclose(found[there], total[there] / count[there])
    assert np.isnan(found[2])


def test_states_in_which_everything_is_gone_count_in_no_mean():
    runs = table(seeds=1, runs=2)
    runs[0].scores[0, 0].e2[3] = np.nan
    found = gather(runs, [(0, 0)])
    np.testing.assert_allclose(found.of_runs, [np.mean(found.e2[0, 0, :3]), found.e2[0, 1].mean()])
    assert found.mean == pytest.approx(found.of_runs.mean()), "each run counts the same"


def test_without_sensors_there_are_no_probes():
    found = gather(table(watched=False), [(0, 0), (1, 0)])
    assert found.probes.size == found.intrusion.size == 0


@pytest.mark.parametrize(("runs", "keys"), [([], [(0, 0)]), (table(), [])])
def test_nothing_to_gather_is_an_error(runs, keys):
    with pytest.raises(EvaluationError, match="no scored runs"):
        gather(runs, keys)


# One run


def test_a_run_of_another_shape_is_an_error(reference, models):
    short = replace(reference, displacement=lambda k: np.zeros((5, reference.n_nodes, 3), np.float32))
    with pytest.raises(EvaluationError, match=r"run run_09 has shape \(5, 2400, 3\); expected \(6, 2400, 3\)"):
        score_run(short, predictors_of(models), 9)


def test_a_run_says_how_far_it_moves_itself(reference):
    parts = {"part": reference.part_nodes()}
    found = score_run(reference, {}, 10, groups=parts)
    size = np.linalg.norm(reference.displacement(10), axis=-1)
    assert (found.run, found.scores, found.floor, found.watched) == (10, {}, {}, None)
    np.testing.assert_allclose(found.size, size.mean(axis=1), rtol=1e-6)
    assert found.group_size.keys() == {"part"}
    np.testing.assert_allclose(found.group_size["part"], [size[:, n].mean() for n in parts["part"]], rtol=1e-6)
    assert found.lifting.keys() == {1, 2, 3}


def test_the_floor_is_taken_on_the_nodes_of_its_level(reference):
    kept = reference.level(2).kept
    random = np.random.default_rng(0)
    bases = {
        n: np.linalg.qr(random.normal(size=(3 * n, 3)))[0].astype(np.float32) for n in (len(kept), reference.n_nodes)
    }
    found = score_run(reference, {}, 9, modes={0: bases[reference.n_nodes], 2: bases[len(kept)]}).floor
    for level, u in ((0, reference.displacement(9)), (2, reference.displacement(9)[:, kept])):
        flat = u.reshape(6, -1).astype(float)
        basis = bases[u.shape[1]].astype(float)
        rest = (flat - flat @ basis @ basis.T).reshape(6, -1, 3)
        np.testing.assert_allclose(found[level][-1], np.linalg.norm(rest, axis=-1).mean(axis=1), rtol=1e-3)


def test_scores_of_a_run_are_those_of_the_plain_formulas(reference, models):
    predictor, key = models[0].predictors[0], (0, 0)
    parts = {"part": reference.part_nodes()}
    sensors = choose_sensors(reference, probes=[3, 700])
    score = score_run(reference, {key: predictor}, 9, groups=parts, sensors=sensors).scores[key]
    u, level = reference.displacement(9), reference.level(1)
    coarse = predictor.predict(reference.parameters[9], reference.time)
    full = np.stack([level.to_full @ state for state in coarse])
    distance = np.linalg.norm(full - u, axis=-1)
    again = np.stack([level.to_full @ state for state in predictor.reconstruct(u[:, level.kept])])
    reconstruction = np.linalg.norm(again - u, axis=-1)
    np.testing.assert_allclose(score.e2, distance.mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(score.reconstruction, reconstruction.mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(score.q95, np.quantile(distance, 0.95, axis=1), rtol=1e-4)
    np.testing.assert_allclose(score.largest, distance.max(axis=1), rtol=1e-4)
    nodes = [np.arange(reference.n_nodes), *(v.kept for v in reference.levels)]
    np.testing.assert_allclose(score.on_level, [distance[:, n].mean() for n in nodes], rtol=1e-4)
    np.testing.assert_allclose(score.on_level_reconstruction, [reconstruction[:, n].mean() for n in nodes], rtol=1e-4)
    assert score.relative == pytest.approx(np.sqrt((distance**2).sum() / (u.astype(float) ** 2).sum()), rel=1e-4)
    assert score.peak.value == pytest.approx(distance.max(), rel=1e-4)
    np.testing.assert_allclose(score.node_sum, distance.sum(axis=0), rtol=1e-4)
    assert (score.node_count == 6).all()
    assert score.groups.keys() == {"part"}
    np.testing.assert_allclose(score.groups["part"], [distance[:, n].mean() for n in parts["part"]], rtol=1e-4)
    np.testing.assert_allclose(score.watched.probes, full[:, [2, 699]], rtol=1e-4, atol=1e-6)
    assert np.isnan(score.covered)


def test_without_sensors_nothing_is_watched(reference, models):
    found = score_run(reference, {(0, 0): models[1].predictors[0]}, 9)
    assert found.watched is None
    assert found.scores[0, 0].watched is None


def test_a_field_of_the_full_mesh_stays_and_one_of_a_level_is_lifted(reference, models):
    full, coarse = models[1].predictors[0], models[0].predictors[1]
    field = np.random.default_rng(0).normal(size=(6, reference.n_nodes, 3))
    found = full_field(reference, full, field)
    np.testing.assert_array_equal(found, field.astype(np.float32))
    assert found.dtype == np.float32
    level = reference.level(2)
    on_level = field[:4, : level.n_nodes].astype(np.float32)
    lifted = full_field(reference, coarse, on_level, 4)
    np.testing.assert_allclose(lifted, np.stack([level.to_full @ state for state in on_level]), rtol=1e-5, atol=1e-6)
    with pytest.raises(EvaluationError, match=r"shape \(4, 50, 3\); expected \(6, 50, 3\) on level 2"):
        full_field(reference, coarse, on_level)
    with pytest.raises(EvaluationError, match=r"expected \(6, 2400, 3\) on level 0"):
        full_field(reference, full, field[:, :-1])


def test_a_model_works_on_its_own_mesh_where_it_has_one(reference, models):
    assert mesh_of(reference, models[1].predictors[0]) is None
    predictor = models[0].predictors[1]
    assert mesh_of(reference, predictor) is reference.level(2)
    own = replace(reference.level(2))
    predictor.mesh = own
    try:
        assert mesh_of(reference, predictor) is own
    finally:
        predictor.mesh = None


def test_what_a_level_adds_is_its_field_less_the_coarser_one():
    rng = np.random.default_rng(0)
    lifted = {name: rng.normal(size=(2, 5, 3)) for name in ("MH3", "MH2", "MH1")}
    parts = contributions(lifted)
    assert list(parts) == ["MH3", "MH2", "MH1"]
    np.testing.assert_array_equal(parts["MH2"], lifted["MH2"] - lifted["MH3"])
    np.testing.assert_array_equal(parts["MH1"], lifted["MH1"] - lifted["MH2"])


def test_nodes_on_one_line_are_watched_from_the_ground():
    """Beams in a row show no rotation about their line, so nothing can be seen from their own rigid motion."""
    line = np.column_stack([np.linspace(0, 1, 11), np.zeros(11), np.zeros(11)])
    moved = np.zeros((2, 11, 3), np.float32)
    moved[1, :, 2] = np.linspace(0, -0.1, 11)
    structure = SimpleNamespace(
        part_names=("line",), position=line, n_nodes=11, displacement=lambda run: moved, position_of=lambda run: line
    )
    sensors = choose_sensors(structure)
    assert sensors.watching is None
    assert "from the ground, since all nodes lie on one line" in sensors.about
    np.testing.assert_allclose(watch(structure, sensors, 0, moved).intrusion, [0.0, 0.0], atol=1e-9)
