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
from crashkit.ingestion.alignment import common_time, flags_at, interpolate, interpolation_error, same_time


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
