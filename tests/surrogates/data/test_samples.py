"""What training reads of a campaign: checks, validation runs, missing values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plate
import pytest

from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes, Runs, check, split
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
    runs = Runs(changed((4, 3, 17, 1), np.nan), 0, settings("mh"), Notes())
    with pytest.raises(SurrogateError, match=r"run run_004, state 3, node 17: .*missing=hold"):
        runs.read(4)


def test_held_nodes_keep_their_last_displacement() -> None:
    campaign = changed((4, slice(3, None), 17), np.nan)
    notes = Notes()
    run = Runs(campaign, 0, settings("mh", overrides=["missing=hold"]), notes).read(4)
    before = plate.displacement(plate.parameters(6))[4]
    np.testing.assert_array_equal(run[3:, 17], np.broadcast_to(before[2, 17], (4, 3)))
    np.testing.assert_array_equal(run[:3], before[:3])
    assert "keep their last displacement" in notes.lines[0]


def test_where_elements_erode_nodes_are_held_without_being_asked() -> None:
    campaign = replace(changed((4, slice(3, None), 17), np.nan), erodes=True)
    run = Runs(campaign, 0, settings("mh"), Notes()).read(4)
    before = plate.displacement(plate.parameters(6))[4]
    np.testing.assert_array_equal(run[3:, 17], np.broadcast_to(before[2, 17], (4, 3)))
    with pytest.raises(SurrogateError, match="run run_004, state 3, node 17"):
        Runs(campaign, 0, settings("mh", overrides=["missing=refuse"]), Notes()).read(4)


def test_infinite_values_are_never_held() -> None:
    runs = Runs(changed((4, 3, 17), np.inf), 0, settings("mh", overrides=["missing=hold"]), Notes())
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
