"""Scores of real runs against plain formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.comparison.reference import Reference
from evaluation.comparison.result import compare, decompose, predictors_of
from evaluation.comparison.scoring import contributions, gather, score_run
from evaluation.comparison.sensors import choose_sensors
from evaluation.comparison.split import Split
from evaluation.errors import EvaluationError


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
