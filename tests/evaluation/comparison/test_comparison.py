"""Which comparisons are honest, and which are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.comparison.result import compare
from evaluation.comparison.split import agree_on_split, entries
from evaluation.errors import EvaluationError
from evaluation.figures.coverage import select


def test_the_runs_all_models_hold_out_are_the_test_runs(reference, models):
    split = agree_on_split(reference, models)
    assert split.test == (9, 10, 11)
    assert split.train == tuple(range(9))


def test_test_runs_may_be_named(reference, models):
    assert agree_on_split(reference, models, ["run_11", "run_09"]).test == (11, 9)


def test_training_runs_are_those_that_a_model_has_seen(reference, models):
    small = replace(models[0], fitted_runs=("run_02", "run_04"), tuned_runs=("run_05",))
    smaller = replace(models[1], fitted_runs=("run_02", "run_06"), tuned_runs=())
    assert agree_on_split(reference, (small, smaller)).train == (2, 4, 5, 6)


def test_a_model_that_does_not_say_may_have_seen_all_but_the_test_runs(reference, models):
    silent = replace(models[1], fitted_runs=(), tuned_runs=())
    assert agree_on_split(reference, (silent, replace(models[0], fitted_runs=("run_02",)))).train == tuple(range(9))


def test_a_test_run_is_outside_where_only_runs_that_no_model_saw_reach_further(reference, models):
    order = np.argsort(reference.parameters[:, 0])
    tested, beyond = reference.runs[order[-2]], reference.runs[order[-1]]
    seen = tuple(reference.runs[k] for k in order[:-2])
    model = replace(models[2], fitted_runs=seen, tuned_runs=(), held_out_runs=(tested, beyond))
    split = agree_on_split(reference, (model,), [tested])
    figure = select(compare(reference, (model,), split, timed=False))
    assert dict(zip(figure.runs, figure.numbers()["role"], strict=True))[beyond] == "not used"
    assert "1 test runs lie outside the range of the training runs" in figure.caption()


def test_a_model_trained_on_a_test_run_is_refused_by_name(reference, models):
    with pytest.raises(EvaluationError, match=r"mh was trained on 1 of the 2 test runs \(run_03\)"):
        agree_on_split(reference, models, ["run_09", "run_03"])


def test_a_model_tuned_on_a_test_run_is_refused_too(reference, models):
    with pytest.raises(EvaluationError, match=r"mh was tuned on 1 of the 1 test runs \(run_08\)"):
        agree_on_split(reference, models, ["run_08"])


def test_different_splits_are_refused(reference, models):
    other = replace(models[1], held_out_runs=("run_09",))
    with pytest.raises(EvaluationError, match=r"mh holds out 3 runs .* podnn 1 runs"):
        agree_on_split(reference, (models[0], other))


def test_models_of_another_dataset_are_refused(reference, models):
    other = replace(models[0], checksum="deadbeef")
    with pytest.raises(EvaluationError, match="trained on another dataset"):
        agree_on_split(reference, (other,))


def test_no_test_runs_at_all_is_an_error(reference, models):
    with pytest.raises(EvaluationError, match="no test runs"):
        agree_on_split(reference, [replace(models[0], held_out_runs=())])


def test_a_run_that_does_not_exist_is_named(reference, models):
    with pytest.raises(EvaluationError, match="run 'run_99' is not in the dataset"):
        agree_on_split(reference, models, ["run_99"])


def test_each_level_is_a_row(models):
    assert [e.label for e in entries(models)] == ["MH1", "MH2", "MH3", "PODNN", "POD-GPR"]


def test_seeds_of_one_configuration_make_one_row(models):
    seeds = (models[1], replace(models[1], name="podnn-1", seed=1))
    (row,) = entries(seeds)
    assert row.keys == ((0, 0), (1, 0))


def test_seeds_can_be_kept_apart(models):
    seeds = (models[1], replace(models[1], name="podnn-1", seed=1))
    assert [e.label for e in entries(seeds, seeds_as_spread=False)] == ["PODNN (podnn)", "PODNN (podnn-1)"]


def test_rows_of_several_seeds_are_told_apart_by_their_folders_without_the_seed(models):
    wide = {"model": "podnn", "width": 9}
    seeds = [
        replace(models[1], name=f"{name}-seed-{k}", seed=k, configuration=settings)
        for name, settings in (("kart", models[1].configuration), ("wide", wide))
        for k in range(2)
    ]
    assert [e.label for e in entries(seeds)] == ["PODNN (kart)", "PODNN (wide)"]


def test_different_settings_are_no_seeds(models):
    other = replace(models[1], name="wide", seed=1, configuration={"model": "podnn", "width": 9})
    assert [e.label for e in entries((models[1], other))] == ["PODNN (podnn)", "PODNN (wide)"]


def test_models_on_different_coarse_runs_are_no_seeds(models):
    other = replace(models[1], name="beneath", seed=1, beneath="3f2a")
    assert [e.label for e in entries((models[1], other))] == ["PODNN (podnn)", "PODNN (beneath)"]


def test_one_model_given_twice_is_refused(models):
    with pytest.raises(EvaluationError, match="one model given twice"):
        entries((models[1], replace(models[1], name="copy")))


def test_means_that_share_a_training_are_no_seeds_of_one(models):
    mean = replace(models[1], name="mean", seed=0, averaged=5)
    with pytest.raises(EvaluationError, match=r"seeds 0 to 4 and mean3 of 3 to 7, so they share 3, 4 .* with --seed 8"):
        entries((mean, replace(mean, name="mean3", seed=3)))
    with pytest.raises(EvaluationError, match=r"seeds 0 to 4 and single of 3, so they share 3"):
        entries((mean, replace(mean, name="single", seed=3, averaged=1)))
    assert len(entries((mean, replace(mean, name="mean5", seed=5)))[0].keys) == 2


def test_no_model_is_an_error():
    with pytest.raises(EvaluationError, match="no model"):
        entries(())


def test_an_evaluation_says_its_errors_and_worst_runs(evaluation) -> None:
    rows = [line.split() for line in repr(evaluation).splitlines()[-len(evaluation.entries) :]]
    for row, entry in zip(rows, evaluation.entries, strict=True):
        of_runs = evaluation.scores[entry.label].of_runs
        worst = evaluation.test_names[int(of_runs.argmax())]
        assert row[-3:] == [f"{100 * of_runs.mean():.2f}", f"{100 * of_runs.max():.2f}", worst]
        assert f"<td>{worst}</td>" in evaluation._repr_html_()
