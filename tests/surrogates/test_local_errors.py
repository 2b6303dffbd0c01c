"""Where left-out runs were predicted worse than expected, a query near them is told so and gets a wider band."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogates.local_errors import HARD, LocalErrors
from surrogates.settings import settings as choose
from surrogates.storage.card import card
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate
from surrogates.uncertainty import FEWEST_LOCAL, Beliefs, calibrate, coverage

TIME = np.linspace(0.0, 0.02, 5)


def fold(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (run, 2) in the box, and errors that are five times as large near the line x = 0."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 2))
    return points, np.where(np.abs(points[:, 0]) < 0.25, 5.0, 1.0)


def test_near_the_fold_larger_errors_are_expected_than_elsewhere() -> None:
    points, errors = fold(120, seed=0)
    local = LocalErrors.of(points, errors, np.arange(120))
    at = local.at(np.array([[0.0, 0.1], [0.8, 0.1]]))
    assert at[0] > 3.0
    assert at[1] < 1.5  # the median run is 1; one average run stands beside those that are near


def test_a_run_and_its_image_say_nothing_of_themselves() -> None:
    """One bad run among good ones: without its own error, its place is as good as any."""
    points, _ = fold(40, seed=1)
    errors = np.ones(40)
    errors[7] = 50.0
    local = LocalErrors.of(points, errors, np.arange(40), images=points * [1.0, -1.0])
    own = local.at(points[7:8], np.array([7]))
    stranger = local.at(points[7:8])
    assert own[0] == pytest.approx(local.at(points[8:9], np.array([7]))[0], rel=0.5)
    assert stranger[0] > 5 * own[0]


@settings(max_examples=30)
@given(factor=st.floats(1e-6, 1e6), seed=st.integers(0, 1000))
def test_the_unit_of_the_errors_says_nothing(factor: float, seed: int) -> None:
    points, errors = fold(20, seed)
    query = np.zeros((1, 2))
    one = LocalErrors.of(points, errors, np.arange(20)).at(query)
    np.testing.assert_allclose(LocalErrors.of(points, factor * errors, np.arange(20)).at(query), one, rtol=1e-9)


def test_far_from_all_runs_the_mean_is_expected() -> None:
    points, errors = fold(30, seed=2)
    local = LocalErrors.of(points, errors, np.arange(30))
    np.testing.assert_allclose(local.at(np.full((1, 2), 50.0)), errors.mean() / np.median(errors))


def test_hard_runs_near_a_point_come_with_the_worst_first_and_once() -> None:
    points = np.array([[0.0, 0.0], [0.02, 0.0], [0.04, 0.0], [0.9, 0.9], [0.95, 0.9]])
    local = LocalErrors.of(points, np.array([1.0, 3.0, 9.0, 1.0, 9.0]), np.arange(5), images=points * [1.0, -1.0])
    assert HARD < 3.0
    assert local.hard_runs(np.zeros(2)).tolist() == [2]  # the median is 3: twice and more is the one of 9
    assert local.hard_runs(np.array([0.92, 0.9])).tolist() == [4]
    assert local.hard_runs(np.array([0.92, -0.9])).tolist() == [4]  # by its image


def test_runs_at_one_place_and_errors_of_zero_give_numbers() -> None:
    local = LocalErrors.of(np.zeros((4, 1)), np.zeros(4), np.arange(4))
    np.testing.assert_array_equal(local.at(np.zeros((1, 1))), 1.0)


def errors_of(points: np.ndarray, factor: np.ndarray, seed: int) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    return [(f * random.gamma(9.0, 1 / 9.0, (len(TIME), 30)) / 1000).astype(np.float32) for f in factor]


def beliefs(points: np.ndarray) -> Beliefs:
    return Beliefs(np.ones(len(points)), np.ones(len(points)), points)


def test_the_band_is_wide_at_the_fold_and_narrow_elsewhere() -> None:
    points, factor = fold(80, seed=3)
    band = calibrate(errors_of(points, factor, 4), TIME, beliefs(points))
    assert band.spread == "local"
    new, expected = fold(200, seed=5)
    held, width = [], []
    for point, distance in zip(new, errors_of(new, expected, 6), strict=True):
        half = band.half_width(0.9, TIME, beliefs(point[None]))
        held.append(coverage(distance, half))
        width.append(half.mean())
    at_fold = expected > 1
    assert np.mean(held) == pytest.approx(0.9, abs=0.05)
    assert np.mean(np.array(width)[at_fold]) > 2.0 * np.mean(np.array(width)[~at_fold])


def test_errors_without_a_pattern_or_of_few_runs_leave_the_band_as_it_was() -> None:
    points, factor = fold(FEWEST_LOCAL - 1, seed=7)
    assert calibrate(errors_of(points, factor, 8), TIME, beliefs(points)).local is None
    points, factor = fold(60, seed=9)
    mixed = np.random.default_rng(10).permutation(factor)
    assert calibrate(errors_of(points, mixed, 11), TIME, beliefs(points)).spread != "local"


@pytest.fixture(scope="module")
def folding() -> Surrogate:
    """A plate whose dent goes to one side or the other where the angle is small, as a rail folds."""
    return train_surrogate(plate.folding(), choose("pod-gpr", overrides=plate.PLAIN_PROCESS))


def test_a_query_at_the_fold_is_told_and_gets_the_wider_band(folding: Surrogate) -> None:
    (said,) = folding.hard([20.0, 0.5, 3e8])
    names = [name for name in folding.record.left_out if name in said]
    assert names
    assert all(abs(folding.record.parameters["impact_angle"][int(name[-3:])]) < 3.0 for name in names)
    assert folding.hard([20.0, 8.0, 3e8]) == []
    assert folding.bands[0, False].spread == "local"
    at, away = (folding.band(parameters=[20.0, angle, 3e8]).mean() for angle in (0.5, 8.0))
    assert at > 2.0 * away


def test_the_card_lists_runs_at_the_fold(folding: Surrogate) -> None:
    section = card(folding).split("## Near a fold")[1].split("##")[0]
    listed = [name for name in folding.record.fitted_runs if name in section]
    assert listed == sorted(folding.hard_runs())
    angles = np.abs(folding.record.parameters["impact_angle"])
    assert len(listed) > (angles < 3.0).sum() / 2
    at = angles[[int(name[-3:]) for name in listed]]
    assert (at < 4.0).mean() > 0.9  # those next to the fold suffer from it, too


def test_stored_and_loaded_it_says_the_same(folding: Surrogate, tmp_path: Path) -> None:
    save(folding, tmp_path / "model")
    again, query = load(tmp_path / "model"), [20.0, 0.5, 3e8]
    assert again.hard(query) == folding.hard(query)
    np.testing.assert_array_equal(again.band(parameters=query), folding.band(parameters=query))
