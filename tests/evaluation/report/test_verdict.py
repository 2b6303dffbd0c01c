"""The words follow from the numbers: change the numbers and the words change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.comparison.result import compare
from evaluation.comparison.split import Split
from evaluation.report.verdict import BAND_HOLDS, clearly_better, difference, statements
from surrogates.storage import tested


def _with_errors(evaluation, **means):
    """`evaluation` with other errors: model -> m for each of the three runs."""
    scores = dict(evaluation.scores)
    for model, values in means.items():
        label = model.replace("_", "-")
        e2 = np.broadcast_to(np.asarray(values)[None, :, None], scores[label].e2.shape)
        scores[label] = replace(scores[label], e2=e2)
    return replace(evaluation, scores=scores)


def _said(evaluation, about):
    return [s for s in statements(evaluation) if s.about == about]


def test_the_most_accurate_model_is_the_one_with_the_lowest_error(evaluation):
    low = _with_errors(evaluation, PODNN=[0.001, 0.001, 0.002])
    (said,) = _said(low, "Highest accuracy")
    assert said.text.startswith("PODNN: mean node error 0.13 cm")
    assert "not significantly different" not in said.text


def test_models_that_cannot_be_told_apart_are_named(evaluation):
    near = _with_errors(
        evaluation, PODNN=[0.010, 0.012, 0.011], POD_GPR=[0.012, 0.010, 0.0115], MH1=[1] * 3, MH2=[1] * 3, MH3=[1] * 3
    )
    (said,) = _said(near, "Highest accuracy")
    assert "POD-GPR is not significantly different" in said.text


def test_a_multi_hierarchical_model_that_loses_is_named_as_the_loser(evaluation):
    lost = _with_errors(
        evaluation, MH1=[0.03, 0.04, 0.05], MH2=[0.04] * 3, MH3=[0.05] * 3, PODNN=[0.01] * 3, POD_GPR=[0.02] * 3
    )
    (said,) = _said(lost, "Multi-hierarchical against the best baseline")
    assert said.kind == "warning"
    assert "MH1, the best multi-hierarchical level, is worse than PODNN: 4.00 cm against 1.00 cm" in said.text
    assert "better on 0 of 3" in said.text


def test_a_multi_hierarchical_model_that_wins_is_no_warning(evaluation):
    won = _with_errors(evaluation, MH1=[0.01] * 3, MH2=[0.02] * 3, MH3=[0.03] * 3, PODNN=[0.05] * 3, POD_GPR=[0.06] * 3)
    (said,) = _said(won, "Multi-hierarchical against the best baseline")
    assert said.kind == "finding"
    assert "MH1 is better than PODNN" in said.text
    (levels,) = _said(won, "Levels")
    assert levels.kind == "finding"


def test_a_finer_level_that_is_worse_is_a_warning(evaluation):
    odd = _with_errors(evaluation, MH1=[0.03] * 3, MH2=[0.02] * 3, MH3=[0.04] * 3)
    (said,) = _said(odd, "Levels")
    assert said.kind == "warning"
    assert "MH1 is not better than MH2" in said.text
    assert "MH2 is not better" not in said.text


def test_the_lightest_of_the_good_coarse_models_is_for_visualisation(evaluation):
    good = _with_errors(evaluation, MH1=[0.010] * 3, MH2=[0.012] * 3, MH3=[0.03] * 3)
    assert _said(good, "Visualisation on weak hardware")[0].text.startswith("MH2: 50 of 2400 nodes")


def test_few_test_runs_and_single_seeds_are_warned_of(evaluation):
    assert "There are 3 test runs" in _said(evaluation, "Few test runs")[0].text
    assert _said(evaluation, "One seed each")


def test_a_single_test_run_ranks_nobody(reference, models):
    one = compare(reference, models, Split(tuple(range(9)), (9,)), timed=False)
    (said,) = _said(one, "One test run")
    assert said.kind == "warning"
    assert "not significantly different" in _said(one, "Highest accuracy")[0].text
    assert not _said(one, "Smallest worst case")


def test_a_model_that_misses_half_of_the_motion_is_good_for_nothing(evaluation):
    scores = {
        label: replace(of, relative=np.full(of.relative.shape, {"PODNN": 0.2, "POD-GPR": 1.02}.get(label, 0.1)))
        for label, of in evaluation.scores.items()
    }
    (said,) = _said(replace(evaluation, scores=scores), "Large relative error")
    assert (
        "error: PODNN 20 %. Good for trends, not for values at a node. POD-GPR 102 %. Wrong by more than half"
        in said.text
    )


def test_a_large_relative_error_is_called_out(evaluation):
    assert "Relative displacement error" in _said(evaluation, "Large relative error")[0].text


@pytest.mark.parametrize(("relative", "said"), [(0.16, "no model: even the best"), (0.14, "PODNN: ")])
def test_nothing_is_recommended_for_optimisation_above_fifteen_percent(evaluation, relative, said):
    best = _with_errors(evaluation, PODNN=[0.001] * 3)
    scores = {
        label: replace(s, relative=np.full_like(s.relative, relative if label == "PODNN" else 0.5))
        for label, s in best.scores.items()
    }
    (statement,) = _said(replace(best, scores=scores), "Many queries (optimisation, uncertainty)")
    assert statement.text.startswith(said)


def test_the_interval_is_that_of_paired_differences():
    rng = np.random.default_rng(0)
    hard = rng.uniform(1, 9, 40)  # runs differ much more than models
    mean, low, high = difference(hard + 0.1 + rng.normal(0, 0.02, 40), hard)
    assert mean == pytest.approx(0.1, abs=0.02)
    assert 0 < low < 0.1 < high < 0.2


def test_an_advantage_that_another_seed_would_undo_is_none():
    rng = np.random.default_rng(0)
    runs = rng.uniform(1, 9, 40)
    steady, lucky = np.stack([runs, runs]), np.stack([runs - 0.5, runs + 0.3])
    assert difference(runs - 0.1, runs)[2] < 0
    mean, low, high = difference(lucky, steady)
    assert mean == pytest.approx(-0.1)
    assert low < 0 < high


def test_levels_of_one_cascade_share_their_seeds(evaluation):
    keys = [((0, 0), (1, 0)), ((0, 1), (1, 1))]
    rows = [replace(e, keys=k) for e, k in zip(evaluation.entries[:2], keys, strict=True)]
    luck = np.array([[0.02], [0.05]])  # of the two seeds, the same on both levels
    for row, offset in zip(rows, (0.0, 0.001), strict=True):
        e2 = np.broadcast_to((luck + offset)[:, :, None], (2, 3, 5))
        evaluation = replace(
            evaluation, scores={**evaluation.scores, row.label: replace(evaluation.scores[row.label], e2=e2)}
        )
    assert clearly_better(evaluation, *rows)


def test_a_model_trained_once_beside_others_with_seeds_is_named(evaluation):
    rows = tuple(replace(e, keys=e.keys * 2) if e.level else e for e in evaluation.entries)
    assert (
        "without a spread: POD-GPR and PODNN."
        in _said(replace(evaluation, entries=rows), "Models with one seed")[0].text
    )


def test_one_run_says_nothing_about_a_difference():
    assert difference(np.array([2.0]), np.array([1.0]))[1:] == (-np.inf, np.inf)


def test_clearly_better_needs_more_than_a_lower_mean(evaluation):
    mh1, podnn = evaluation.entries[0], evaluation.entries[3]
    scattered = _with_errors(evaluation, MH1=[0.01, 0.05, 0.03], PODNN=[0.05, 0.02, 0.03])
    assert scattered.scores["MH1"].mean < scattered.scores["PODNN"].mean
    assert not clearly_better(scattered, mh1, podnn)
    assert clearly_better(_with_errors(evaluation, MH1=[0.01] * 3, PODNN=[0.02, 0.03, 0.02]), mh1, podnn)


def _with(evaluation, label, **changes):
    """`evaluation` with other scores of one row."""
    scores = evaluation.scores[label]
    filled = {name: np.full_like(getattr(scores, name), value) for name, value in changes.items()}
    return replace(evaluation, scores={**evaluation.scores, label: replace(scores, **filled)})


@pytest.mark.parametrize(("held", "warned"), [(0.84, True), (0.86, False), (np.nan, False)])
def test_a_band_that_misses_its_promise_is_a_warning(evaluation, held, warned):
    said = _said(_with(evaluation, "PODNN", covered=held), "Bands miss their promise")
    assert bool(said) == warned
    if warned:
        assert "PODNN 84 %" in said[0].text


def test_what_a_stored_model_says_of_its_band_follows_the_same_rule():
    assert BAND_HOLDS == tested.BAND_HOLDS


@pytest.mark.parametrize(
    ("reduction", "source"),
    [(0.0049, "Most of it is regression"), (0.0065, "both matter"), (0.0081, "Most of it is compression")],
)
def test_the_source_of_the_error_follows_from_what_compression_alone_costs(evaluation, reduction, source):
    best = _with(_with_errors(evaluation, PODNN=[0.01] * 3), "PODNN", reconstruction=reduction)
    (said,) = _said(best, "Where the error comes from")
    assert said.text.startswith("The error of PODNN is 1.00 cm; its compression error")
    assert source in said.text


@pytest.mark.parametrize(("worst", "warned"), [(0.0195, False), (0.0205, True)])
def test_a_run_of_more_than_twice_the_median_error_is_an_outlier(evaluation, worst, warned):
    odd = _with_errors(evaluation, PODNN=[0.01, 0.01, worst], POD_GPR=[1] * 3, MH1=[1] * 3, MH2=[1] * 3, MH3=[1] * 3)
    said = _said(odd, "An outlier")
    assert bool(said) == warned
    if warned:
        assert "the error of PODNN is 2.0 times the median" in said[0].text


def test_the_smallest_worst_case_is_not_that_of_the_best_mean(evaluation):
    others = {"POD_GPR": [1] * 3, "MH2": [1] * 3, "MH3": [1] * 3}
    two = _with_errors(evaluation, PODNN=[0.01, 0.01, 0.05], MH1=[0.03] * 3, **others)
    assert _said(two, "Highest accuracy")[0].text.startswith("PODNN")
    assert _said(two, "Smallest worst case")[0].text.startswith("MH1: on its worst test run, run_09, the mean")


def test_a_run_beyond_the_training_runs_does_not_choose_the_smallest_worst_case(evaluation):
    parameters = evaluation.reference.parameters.copy()
    parameters[9:] = parameters[list(evaluation.split.train)].mean(axis=0)
    others = {"POD_GPR": [1] * 3, "MH2": [1] * 3, "MH3": [1] * 3}

    def said(parameters):
        placed = replace(evaluation, reference=replace(evaluation.reference, parameters=parameters))
        two = _with_errors(placed, PODNN=[0.01, 0.01, 0.05], MH1=[0.03] * 3, **others)
        return [statement.text for statement in _said(two, "Smallest worst case")]

    assert said(parameters)[0].startswith("MH1: on its worst test run")
    parameters[11, 0] = parameters[:9, 0].max() + 0.1
    last = evaluation.test_names[2]
    (text,) = said(parameters)
    assert text.startswith(f"PODNN: on its worst test run, {evaluation.test_names[0]}, the mean node error is 1.00 cm")
    assert text.endswith(f"Left out, as outside the range of the training runs: {last}.")
    parameters[10, 0] = parameters[11, 0]
    assert said(parameters) == [], "one run is no worst case"


def test_test_runs_beyond_the_training_runs_are_named_and_left_out_once(evaluation):
    parameters = evaluation.reference.parameters.copy()
    inside = parameters[list(evaluation.split.train)].mean(axis=0)
    parameters[9:] = inside
    whole = replace(evaluation, reference=replace(evaluation.reference, parameters=parameters))
    assert not _said(whole, "Extrapolation")
    parameters = parameters.copy()
    parameters[10, 0] = parameters[:9, 0].max() + 0.1
    beyond = _with_errors(
        replace(evaluation, reference=replace(evaluation.reference, parameters=parameters)), PODNN=[0.001, 0.004, 0.003]
    )
    (said,) = _said(beyond, "Extrapolation")
    assert said.text == (
        "1 of 3 test runs lie outside the range of the training runs: run_10. Without them PODNN has 0.20 cm."
    )


@pytest.mark.parametrize(("start", "warned"), [(0.0008, False), (0.0009, True)])
def test_motion_in_the_first_state_is_a_warning_where_nothing_has_moved(evaluation, start, warned):
    """From a tenth of the mean error on, here 0.85 mm."""
    still = tuple(replace(run, size=np.concatenate([[0.0], run.size[1:]])) for run in evaluation.runs)
    scores = {}
    for label, of in evaluation.scores.items():
        e2 = np.full_like(of.e2, 0.01)
        e2[..., 0] = start if label == "PODNN" else 0.0
        scores[label] = replace(of, e2=e2)
    said = _said(replace(evaluation, runs=still, scores=scores), "Non-zero prediction at t = 0")
    assert bool(said) == warned
