"""Common times: which grid, what interpolation gives, and whether the estimate of its error can be believed."""

from __future__ import annotations

from importlib.resources import files

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from crashkit.errors import DataError
from crashkit.ingestion.alignment import (
    common_time,
    flags_at,
    interpolate,
    interpolation_error,
    reach,
    same_time,
)


def uneven(count: int, seed: int) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).uniform(0.2, 1.0, count))


@given(st.integers(3, 12), st.integers(1, 40), st.integers(0, 1000))
def test_parabolas_come_back_exactly(count: int, wanted: int, seed: int) -> None:
    own = uneven(count, seed)
    common = np.linspace(own[0], own[-1], wanted)
    values = np.stack([own**2, 3 * own - 1, np.ones_like(own)], axis=-1)[:, None]
    exact = np.stack([common**2, 3 * common - 1, np.ones_like(common)], axis=-1)[:, None]
    np.testing.assert_allclose(interpolate(values, own, common), exact, rtol=1e-9, atol=1e-9)


def test_agrees_with_scipy_on_the_same_slopes() -> None:
    own, common = uneven(9, 1), np.linspace(0.9, 4.0, 33)
    values = np.random.default_rng(2).normal(size=(9, 5, 3))
    slopes = np.gradient(values, own, axis=0, edge_order=2)
    np.testing.assert_allclose(
        interpolate(values, own, common), CubicHermiteSpline(own, values, slopes)(common), atol=1e-12
    )


def test_own_states_come_back_bit_for_bit() -> None:
    own = uneven(6, 3)
    values = np.random.default_rng(4).normal(size=(6, 4, 3)).astype(np.float32)
    assert interpolate(values, own, own).tobytes() == values.tobytes()
    assert interpolation_error(values, own, own) == 0


def test_straight_lines_stay_between_their_ends() -> None:
    own, common = uneven(8, 5), uneven(8, 5)[:-1] + 0.05
    values = np.random.default_rng(6).normal(size=(8, 20))
    found = interpolate(values, own, common, cubic=False)
    low, high = np.minimum(values[:-1], values[1:]), np.maximum(values[:-1], values[1:])
    assert ((found >= low - 1e-12) & (found <= high + 1e-12)).all()


def test_nothing_stands_behind_the_last_state() -> None:
    own, common = np.array([0.0, 1.0, 2.0]), np.array([0.5, 1.5, 2.5])
    found = interpolate(np.ones((3, 2)), own, common)
    assert np.isfinite(found[:2]).all()
    assert np.isnan(found[2]).all()


def test_missing_values_spoil_only_their_own_neighbourhood() -> None:
    own = np.arange(6.0)
    values = own[:, None] * np.ones((6, 2))
    values[5, 0] = np.nan
    found = interpolate(values, own, np.array([3.5, 4.5]))
    np.testing.assert_allclose(found, [[3.5, 3.5], [np.nan, 4.5]])


def test_flags_hold_only_between_two_states_that_hold() -> None:
    own = np.arange(4.0)
    flags = np.array([[True, True], [True, True], [False, True], [False, True]])
    found = flags_at(flags, own, np.array([1.0, 1.5, 2.0]))
    assert found.tolist() == [[True, True], [False, True], [False, True]]


def test_error_estimate_is_near_the_true_error_on_a_real_run() -> None:
    with h5py.File(str(files("crashkit") / "data" / "kart_demo.h5")) as file:
        time, moved = file["time"][:].astype(float), file["kart/displacements"][22, :, :400]
    few, between = slice(0, None, 2), slice(1, -1, 2)
    found = interpolate(moved[few], time[few], time[between])
    true = float(np.linalg.norm(found - moved[between], axis=-1).max())
    estimate = interpolation_error(moved[few], time[few], time[between])
    assert 0.5 * true < estimate < 8 * true


def test_coarsest_run_gives_the_grid_and_the_shortest_its_end() -> None:
    fine, coarse = np.linspace(0, 0.1, 21), np.linspace(0, 0.1, 11)
    np.testing.assert_array_equal(common_time([fine, coarse]), coarse)
    np.testing.assert_allclose(common_time([fine[:14], coarse]), [*coarse[:7]], atol=1e-12)


def test_ends_a_little_apart_are_brought_together() -> None:
    """Solvers write a state at the first time step behind the output time."""
    one, other = np.array([0, 1.001, 2.002, 3.0004]), np.array([0, 1.0003, 2.0001, 2.9998, 3.5])
    assert common_time([one, other[:4]])[-1] == 2.9998
    assert same_time(np.array([0, 1, 2.0]), np.array([0, 1, 2.0000001]))
    assert not same_time(np.array([0, 1, 2.0]), np.array([0, 1, 2.001]))


def test_last_state_stands_for_a_hair_behind_it_and_is_counted() -> None:
    own = np.array([0.0, 1, 2, 3])
    values = np.zeros((4, 2, 3))
    values[3, 1] = [0.3, 0.4, 0.0]  # 0.5 in the last step
    grid = np.array([0, 1, 2, 3.04])
    np.testing.assert_array_equal(interpolate(values, own, grid), values)
    assert interpolation_error(values, own, grid) == pytest.approx(0.04 * 0.5)
    np.testing.assert_array_equal(common_time([own], grid), grid)


def test_behind_that_hair_nothing_is_made_up() -> None:
    own = np.array([0.0, 1, 2, 3])
    assert np.isnan(interpolate(np.ones((4, 1)), own, np.array([0, 3.06]))[1]).all()
    with pytest.raises(DataError, match="cover 0 to 3 s"):
        common_time([own], np.array([0, 3.06]))


def test_a_single_state_needs_no_grid() -> None:
    np.testing.assert_array_equal(common_time([np.array([0.0])]), [0.0])


@pytest.mark.parametrize(
    ("times", "wanted", "told"),
    [
        ([[0, 1, 2]], [0, 3], "all runs together cover 0 to 2 s"),
        ([[0, 1, 2]], [1, 1], "not increasing"),
        ([[0, 1], [2, 3]], None, "no time in common"),
    ],
)
def test_impossible_times_are_told(times: list[list[float]], wanted: list[float] | None, told: str) -> None:
    with pytest.raises(DataError, match=told):
        common_time([np.array(t, float) for t in times], None if wanted is None else np.array(wanted, float))


# Which grid


def seconds(*times: float) -> np.ndarray:
    return np.array(times, float)


def test_times_asked_for_are_taken_as_they_are() -> None:
    grid = common_time([seconds(0, 1, 2, 3), seconds(0, 2, 4)], [0, 0.5, 2.5])  # type: ignore[arg-type]
    assert grid.tolist() == [0, 0.5, 2.5]
    assert grid.dtype == np.float64


@pytest.mark.parametrize("wanted", [[], [[0, 1]], [0, np.nan], [1, 0], [0, np.inf]])
def test_times_asked_for_must_be_increasing_numbers(wanted: list) -> None:
    with pytest.raises(DataError, match="not increasing numbers"):
        common_time([seconds(0, 1, 2)], np.array(wanted, float))


def test_times_asked_for_must_lie_in_what_all_runs_cover() -> None:
    times = [seconds(0, 1, 2, 3), seconds(0.5, 1, 2)]
    np.testing.assert_array_equal(common_time(times, seconds(0.5, 2)), [0.5, 2])
    np.testing.assert_array_equal(common_time(times, seconds(0.5 - 1e-6, 2.05)), [0.5 - 1e-6, 2.05])
    for wanted in (seconds(0.49, 2), seconds(0.5, 2.06), seconds(0.5, 1, 1.5, 2.06), seconds(0.49)):
        with pytest.raises(DataError, match=r"all runs together cover 0.5 to 2 s"):
            common_time(times, wanted)


def test_the_grid_is_that_of_the_run_with_the_fewest_states() -> None:
    few, many = seconds(0, 1.3, 2.2, 4), seconds(0, 1, 2, 3, 4)
    for order in ([few, many], [many, few]):
        np.testing.assert_array_equal(common_time(order), few)


def test_nothing_is_extrapolated_at_either_end() -> None:
    whole = seconds(0, 1, 2, 3)
    np.testing.assert_array_equal(common_time([whole, seconds(0.7, 1, 1.5, 2, 2.2)]), [1, 2])
    # Within half a step the end is moved to where all runs are.
    np.testing.assert_array_equal(common_time([whole, seconds(0.4, 1, 1.5, 2, 2.6)]), [0.4, 1, 2, 2.6])
    np.testing.assert_array_equal(common_time([whole, seconds(-0.4, 1, 1.5, 2, 3.4)]), whole)


def test_ends_that_differ_by_rounding_are_left_as_the_solver_wrote_them() -> None:
    rounded = seconds(0, 1, 2, 3 + 2e-6)
    np.testing.assert_array_equal(common_time([rounded, seconds(0, 1, 2, 2.5, 3)]), rounded)


def test_the_grid_is_a_copy() -> None:
    own = seconds(0, 1, 2)
    common_time([own])[0] = 5
    assert own[0] == 0


def test_runs_that_share_one_moment_only_have_that() -> None:
    np.testing.assert_array_equal(common_time([seconds(0, 1), seconds(1, 2, 3)]), [1.0])


def test_runs_without_an_output_time_where_all_are_need_to_be_told_times() -> None:
    with pytest.raises(DataError, match=r"14.995 to 15.005 s; give --time"):
        common_time([seconds(0, 10, 20, 30), seconds(14.995, 14.998, 15, 15.002, 15.005)])


@pytest.mark.parametrize(
    ("own", "until"), [([0, 1, 2, 4], 4.1), ([0, 2], 2.1), ([5], 5 + 5e-6), ([0, 1, 1 + 1e-9], 1 + 1e-6)]
)
def test_a_last_state_stands_for_a_twentieth_of_its_step_and_for_rounding(own: list[float], until: float) -> None:
    assert reach(np.array(own, float)) == pytest.approx(until, rel=1e-8)


def test_times_are_the_same_within_a_millionth_of_the_latest() -> None:
    own = seconds(0, 1, 4)
    assert same_time(own, own + seconds(3e-6, -3e-6, 3e-6))
    assert not same_time(own, own + seconds(0, 0, 5e-6))
    assert not same_time(own, own - seconds(0, 5e-6, 0))
    assert not same_time(own, own[:2])


# Values at it


def test_straight_lines_are_straight_and_between_the_right_states() -> None:
    own = seconds(0, 1, 3)
    values = np.array([[0.0], [2.0], [10.0]], np.float32)
    found = interpolate(values, own, seconds(0.25, 1, 1.5, 2.5), cubic=False)
    np.testing.assert_array_equal(found, [[0.5], [2], [4], [8]])
    assert found.dtype == np.float32


def test_two_states_are_joined_by_a_line() -> None:
    found = interpolate(np.array([[0.0], [4.0]]), seconds(0, 2), seconds(0, 0.5, 2))
    np.testing.assert_array_equal(found, [[0], [1], [4]])


def test_times_within_rounding_of_a_state_give_that_state() -> None:
    values = np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32)
    found = interpolate(values, seconds(0, 1, 2, 3), seconds(2e-6, 1 - 2e-6, 2 + 2e-6, 3 - 2e-6))
    np.testing.assert_array_equal(found, values)


def test_until_its_reach_the_last_state_is_held() -> None:
    values = np.array([[0.0], [1.0], [5.0]])
    found = interpolate(values, seconds(0, 1, 3), seconds(2.999999, 3.05, 3.1, 3.11))
    np.testing.assert_array_equal(found[:, 0], [5, 5, 5, np.nan])


def test_a_single_state_is_held_at_every_time_it_stands_for() -> None:
    np.testing.assert_array_equal(interpolate(np.array([[7.0]]), seconds(2.0), seconds(2.0))[:, 0], [7.0])
    assert interpolation_error(np.ones((1, 2, 3)), seconds(2.0), seconds(2.0)) == 0
    assert flags_at(np.array([[True, False]]), seconds(2.0), seconds(2.0)).tolist() == [[True, False]]


@pytest.mark.parametrize("seed", range(6))
def test_the_error_is_that_of_leaving_out_a_state_weighted_by_the_place_between_states(seed: int) -> None:
    """Each state predicted by scipy from the others; the larger miss at the ends of an interval times 4 f (1 - f)."""
    own = uneven(9, seed)
    values = np.random.default_rng(seed).normal(size=(9, 4, 3))
    miss = np.zeros(9)
    for k in range(1, 8):
        others = np.arange(9) != k
        slopes = np.gradient(values[others], own[others], axis=0, edge_order=2)
        predicted = CubicHermiteSpline(own[others], values[others], slopes)(own[k])
        miss[k] = np.linalg.norm(predicted - values[k], axis=-1).max()
    for place, fraction in ((0, 0.3), (3, 0.5), (5, 0.1), (7, 0.8)):
        common = np.array([own[place] + fraction * (own[place + 1] - own[place])])
        expected = 4 * fraction * (1 - fraction) * max(miss[place], miss[place + 1])
        assert interpolation_error(values, own, common) == pytest.approx(expected, rel=1e-6)
    many = np.sort(np.random.default_rng(seed).uniform(own[0], own[-1], 12))
    each = [interpolation_error(values, own, t[None]) for t in many]
    assert interpolation_error(values, own, many) == pytest.approx(max(each))


def test_the_error_does_not_count_nodes_that_are_gone() -> None:
    own = np.arange(6.0)
    values = np.random.default_rng(1).normal(size=(6, 3, 3))
    gone = values.copy()
    gone[:, 1] = np.nan
    at = seconds(2.5)
    assert interpolation_error(gone, own, at) == pytest.approx(interpolation_error(values[:, [0, 2]], own, at))
    assert interpolation_error(np.full_like(values, np.nan), own, at) == 0


def test_a_held_end_counts_beside_what_interpolation_costs() -> None:
    own = seconds(0, 1, 2, 3)
    values = np.zeros((4, 1, 3))
    values[3, 0] = [2.0, 0, 0]
    assert interpolation_error(values, own, seconds(0, 1, 2, 3.05)) == pytest.approx(0.05 * 2.0)
    assert interpolation_error(values, own, seconds(0, 1, 2, 3.06)) == 0, "beyond its reach there is no value"
    values[2, 0, 1] = 8.0
    alone = interpolation_error(values, own, seconds(0, 1.5))
    assert alone > 1.0
    assert interpolation_error(values, own, seconds(0, 1.5, 3.05)) == pytest.approx(alone)


def test_flags_at_own_states_are_those_of_the_states() -> None:
    own = np.arange(5.0)
    flags = np.random.default_rng(0).random((5, 2, 3)) < 0.5
    np.testing.assert_array_equal(flags_at(flags, own, own), flags)
    between = flags_at(flags, own, own[:-1] + 0.5)
    np.testing.assert_array_equal(between, flags[:-1] & flags[1:])
