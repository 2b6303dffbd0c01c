"""What training reads of a campaign: checks, validation runs, missing values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plate
import pytest
import torch

from surrogates.data.campaign import Campaign
from surrogates.data.samples import LevelRuns, Notes, check, everything, scale_of, split
from surrogates.errors import SurrogateError
from surrogates.settings import settings


def changed(where: tuple, value: float) -> Campaign:
    u = plate.displacement(plate.parameters(6))
    u[where] = value
    return plate.campaign(6, displacement=lambda level: u)


def test_validation_runs_are_drawn_by_the_seed_alone() -> None:
    campaign = plate.campaign(32)
    draws = [split(campaign, settings("mh", overrides=[f"seed={s}"]), Notes()) for s in (0, 0, 1)]
    np.testing.assert_array_equal(draws[0].validation, draws[1].validation)
    assert not np.array_equal(draws[0].validation, draws[2].validation)
    assert len(draws[0].validation) == 4
    np.testing.assert_array_equal(np.sort(np.concatenate([draws[0].training, draws[0].validation])), np.arange(32))


def test_validation_runs_are_no_stride() -> None:
    """Every eighth run of a Halton campaign lies in one eighth of the first parameter's range."""
    gaps = np.diff(split(plate.campaign(96), settings("mh"), Notes()).validation)
    assert len(set(gaps.tolist())) > 3


def test_validation_runs_can_be_named() -> None:
    chosen = split(plate.campaign(6), settings("mh", overrides=["validation.runs=[run_004, run_001]"]), Notes())
    np.testing.assert_array_equal(chosen.validation, [1, 4])


def test_a_test_run_cannot_be_a_validation_run() -> None:
    with pytest.raises(SurrogateError, match="'run_900', which is no training run"):
        split(plate.campaign(6), settings("mh", overrides=["validation.runs=[run_900]"]), Notes())


def test_paper_keeps_all_runs_for_training() -> None:
    chosen = split(plate.campaign(8), settings("mh", overrides=["validation.measure=paper"]), Notes())
    assert len(chosen.training) == 8
    assert len(chosen.validation) == 0


def test_too_few_runs_are_told() -> None:
    notes = Notes()
    assert len(split(plate.campaign(2), settings("mh"), notes).validation) == 0
    assert "no run can be held out of 2" in notes.lines[0]


def test_a_missing_value_is_named_by_run_state_and_node() -> None:
    runs = LevelRuns(changed((4, 3, 17, 1), np.nan), 0, settings("mh"), Notes())
    with pytest.raises(SurrogateError, match=r"run run_004, state 3, node 17: .*missing=hold"):
        runs.read(4)


def test_held_nodes_keep_their_last_displacement() -> None:
    campaign = changed((4, slice(3, None), 17), np.nan)
    notes = Notes()
    run = LevelRuns(campaign, 0, settings("mh", overrides=["missing=hold"]), notes).read(4)
    before = plate.displacement(plate.parameters(6))[4]
    np.testing.assert_array_equal(run[3:, 17], np.broadcast_to(before[2, 17], (4, 3)))
    np.testing.assert_array_equal(run[:3], before[:3])
    assert "keep their last displacement" in notes.lines[0]


def test_where_elements_erode_nodes_are_held_without_being_asked() -> None:
    campaign = replace(changed((4, slice(3, None), 17), np.nan), erodes=True)
    run = LevelRuns(campaign, 0, settings("mh"), Notes()).read(4)
    before = plate.displacement(plate.parameters(6))[4]
    np.testing.assert_array_equal(run[3:, 17], np.broadcast_to(before[2, 17], (4, 3)))
    with pytest.raises(SurrogateError, match="run run_004, state 3, node 17"):
        LevelRuns(campaign, 0, settings("mh", overrides=["missing=refuse"]), Notes()).read(4)


def test_infinite_values_are_never_held() -> None:
    runs = LevelRuns(changed((4, 3, 17), np.inf), 0, settings("mh", overrides=["missing=hold"]), Notes())
    with pytest.raises(SurrogateError, match="run run_004, state 3, node 17"):
        runs.read(4)


def test_a_parameter_that_is_no_number_is_named() -> None:
    mu = plate.parameters(6)
    mu[2, 1] = np.nan
    with pytest.raises(SurrogateError, match="run run_002: parameter impact_angle is nan"):
        check(plate.campaign(6, parameters=mu), settings("mh"), Notes())


def test_a_constant_parameter_is_noted() -> None:
    mu = plate.parameters(6)
    mu[:, 2] = 3e8
    notes = Notes()
    check(plate.campaign(6, parameters=mu), settings("mh"), notes)
    assert notes.lines == [
        "parameter yield_stress has the same value in all training runs; its influence cannot be learnt"
    ]


def test_the_cascade_needs_a_hierarchy() -> None:
    with pytest.raises(SurrogateError, match=r"no mesh hierarchy.*crashkit coarsen"):
        check(plate.campaign(6, levels=()), settings("mh"), Notes())


def test_no_runs_are_refused() -> None:
    with pytest.raises(SurrogateError, match="no training runs"):
        check(replace(plate.campaign(6), parameters=np.empty((0, 3))), settings("podnn"), Notes())


def test_the_same_note_is_kept_once() -> None:
    notes = Notes()
    for line in ("one", "two", "one"):
        notes.add(line)
    assert notes.lines == ["one", "two"]


def test_parameters_must_fit_their_names() -> None:
    with pytest.raises(SurrogateError, match=r"shape \(6, 2\); expected \(6 runs, 3 names\)"):
        check(plate.campaign(6, parameters=plate.parameters(6)[:, :2]), settings("podnn"), Notes())


@pytest.mark.parametrize("time", [[], [0.0, 1.0, 1.0], [0.0, 2.0, 1.0]])
def test_time_must_increase(time: list[float]) -> None:
    with pytest.raises(SurrogateError, match="time must be strictly increasing"):
        check(plate.campaign(6, time=np.array(time)), settings("podnn"), Notes())


def test_a_good_campaign_has_nothing_to_note() -> None:
    notes = Notes()
    check(plate.campaign(6), settings("mh"), notes)
    check(plate.campaign(6, levels=()), settings("podnn"), notes)
    assert notes.lines == []


def test_one_run_is_noted_and_not_each_of_its_parameters() -> None:
    notes = Notes()
    check(plate.campaign(1), settings("mh"), notes)
    assert notes.lines == ["there is one training run; the model repeats it whatever the parameters"]


def test_without_names_runs_are_told_by_number() -> None:
    mu = plate.parameters(6)
    mu[2, 1] = np.inf
    with pytest.raises(SurrogateError, match="run 2: parameter impact_angle is inf"):
        check(replace(plate.campaign(6), parameters=mu, runs=()), settings("mh"), Notes())
    u = plate.displacement(plate.parameters(6))
    u[4, 3, 17] = np.nan
    with pytest.raises(SurrogateError, match="run 4, state 3, node 17"):
        LevelRuns(replace(plate.campaign(6), runs=(), displacement=lambda level: u), 0, settings("mh"), Notes()).read(4)


@pytest.mark.parametrize(
    ("runs", "share", "count"), [(4, 0.125, 1), (16, 0.125, 2), (12, 0.25, 3), (11, 0.5, 6), (4, 0.01, 1), (5, 0.99, 4), (3, 0.5, 0)]
)  # fmt: skip
def test_a_share_of_the_runs_is_held_out_but_never_all_and_none_of_three(runs: int, share: float, count: int) -> None:
    notes = Notes()
    chosen = split(plate.campaign(runs), settings("mh", overrides=[f"validation.share={share}"]), notes)
    assert len(chosen.validation) == count
    assert (np.diff(chosen.validation) > 0).all()
    assert sorted([*chosen.training, *chosen.validation]) == list(range(runs))
    assert len(notes.lines) == (count == 0)


def test_models_whose_size_is_chosen_on_validation_runs_hold_some_out_always() -> None:
    for model in ("pod-gpr", "pod-rbf"):
        chosen = split(plate.campaign(8), settings(model, overrides=["validation.measure=paper"]), Notes())
        assert len(chosen.validation) == 1


def test_named_validation_runs_do_not_train_and_may_be_few() -> None:
    chosen = split(plate.campaign(3), settings("mh", overrides=["validation.runs=[run_001]"]), Notes())
    assert (chosen.training.tolist(), chosen.validation.tolist()) == ([0, 2], [1])


def test_all_runs_cannot_be_validation_runs() -> None:
    with pytest.raises(SurrogateError, match="names all training runs"):
        split(plate.campaign(2), settings("mh", overrides=["validation.runs=[run_000, run_001]"]), Notes())


@pytest.mark.parametrize(
    ("runs", "told"), [(3, "run_000, run_001, run_002$"), (6, r"run_000, run_001, run_002 \.\. run_005$")]
)
def test_the_runs_there_are_are_listed_shortly(runs: int, told: str) -> None:
    with pytest.raises(SurrogateError, match=told):
        split(plate.campaign(runs), settings("mh", overrides=["validation.runs=[other]"]), Notes())


@pytest.mark.parametrize(("level", "nodes"), [(0, 81), (1, 25), (2, 9)])
def test_a_level_is_read_as_it_is_in_single_precision(level: int, nodes: int) -> None:
    runs = LevelRuns(plate.campaign(6), level, settings("mh"), Notes())
    assert (runs.states, runs.nodes) == (7, nodes)
    found = runs.read(3)
    np.testing.assert_array_equal(found, plate.campaign(6).displacement(level)[3])
    assert (found.dtype, found.flags["C_CONTIGUOUS"]) == (np.float32, True)


def test_some_nodes_of_a_level_can_be_read() -> None:
    some = np.array([2, 0, 5])
    runs = LevelRuns(plate.campaign(6), 2, settings("mh"), Notes(), some)
    assert runs.nodes == 3
    np.testing.assert_array_equal(runs.read(1), plate.campaign(6).displacement(2)[1][:, some])
    assert runs.read(1).flags["C_CONTIGUOUS"]


def test_a_value_missing_in_a_node_that_is_not_read_does_no_harm() -> None:
    runs = LevelRuns(changed((4, 3, 17), np.nan), 0, settings("mh"), Notes(), np.array([16, 18]))
    assert np.isfinite(runs.read(4)).all()


def test_samples_are_all_states_run_by_run_directions_before_nodes() -> None:
    campaign = plate.campaign(6)
    found = LevelRuns(campaign, 2, settings("mh"), Notes()).samples(np.array([4, 1]))
    u = campaign.displacement(2)
    assert found.shape == (14, 3, 9)
    assert found.dtype == torch.float32
    for k, run in enumerate((4, 1)):
        for state in range(7):
            np.testing.assert_array_equal(found[7 * k + state], u[run, state].T)


@pytest.mark.parametrize("shape", [(5, 7), (6, 6)])
def test_displacements_must_have_all_runs_and_states(shape: tuple[int, int]) -> None:
    campaign = plate.campaign(6, displacement=lambda level: np.zeros((*shape, 81, 3), np.float32))
    with pytest.raises(SurrogateError, match="expected 6 runs and 7 states"):
        LevelRuns(campaign, 0, settings("mh"), Notes())


def test_a_run_that_does_not_move_is_noted() -> None:
    notes = Notes()
    runs = LevelRuns(changed((4,), 0.0), 0, settings("mh"), notes)
    runs.read(3)
    assert notes.lines == []
    runs.read(4)
    assert notes.lines == ["run run_004 does not move in any state; it is learnt as it is"]


def test_a_node_held_for_a_while_moves_on_when_it_is_there_again() -> None:
    u = plate.displacement(plate.parameters(6))
    before = u[4].copy()
    u[4, [2, 3, 5], 17] = np.nan
    u[4, 6, 20, 1] = np.nan  # one component missing is a node missing
    run = LevelRuns(
        plate.campaign(6, displacement=lambda level: u), 0, settings("mh", overrides=["missing=hold"]), Notes()
    ).read(4)
    np.testing.assert_array_equal(run[:, 17], before[[0, 1, 1, 1, 4, 4, 6], 17])
    np.testing.assert_array_equal(run[6, 20], before[5, 20])
    others = np.setdiff1d(np.arange(81), [17, 20])
    np.testing.assert_array_equal(run[:, others], before[:, others])


def test_a_node_missing_from_the_start_cannot_be_held() -> None:
    runs = LevelRuns(changed((4, 0, 17), np.nan), 0, settings("mh", overrides=["missing=hold"]), Notes())
    with pytest.raises(SurrogateError, match="run run_004, state 0, node 17: has no displacement in the first state"):
        runs.read(4)


def test_the_scale_of_a_level_is_its_rms() -> None:
    assert scale_of(0.25) == 0.5


@pytest.mark.parametrize("mean_square", [0.0, float("nan")])
def test_nothing_can_be_learnt_where_nothing_moves(mean_square: float) -> None:
    with pytest.raises(SurrogateError, match="no training run moves"):
        scale_of(mean_square)


def test_displacements_kept_in_double_precision_are_read_in_single() -> None:
    u = plate.displacement(plate.parameters(6)).astype(np.float64)
    found = LevelRuns(plate.campaign(6, displacement=lambda level: u), 0, settings("mh"), Notes()).read(2)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, u[2])


def test_models_that_choose_by_folds_train_on_all_runs_whatever_is_named_for_the_choice() -> None:
    chosen = everything(plate.campaign(6), settings("pod-gpr"))
    assert (chosen.training.tolist(), chosen.validation.tolist()) == (list(range(6)), [])
    named = everything(plate.campaign(6), settings("pod-gpr", overrides=["validation.runs=[run_004, run_001]"]))
    assert (named.training.tolist(), named.validation.tolist()) == (list(range(6)), [1, 4])
