"""Lifting errors on a level small enough to do the sums by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from crashkit.mesh import lifting
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.lifting import LiftingMeter
from data_schema.levels import Level, lift


def level(index: int, kept: list[int], to_full: list[list[float]]) -> Level:
    u = sparse.csr_matrix(np.array(to_full))
    none = np.empty((0, 2), np.int32)
    return Level(index, np.array(kept), np.empty((0, 3), np.int32), none, np.array(kept), u, u, np.zeros(len(to_full)))


# Five nodes; level 1 keeps 0 and 4 and puts the others between them, level 2 keeps 0 alone.
FINE = level(1, [0, 4], [[1, 0], [0.75, 0.25], [0.5, 0.5], [0.25, 0.75], [0, 1]])
COARSE = level(2, [0], [[1], [1], [1], [1], [1]])
HIERARCHY = Hierarchy(5, (FINE, COARSE), {})


def moved(states: int = 1) -> np.ndarray:
    """All nodes move by 1 along x; in state k node 2 is off by 3 + k along y and 4 + k along z."""
    u = np.zeros((states, 5, 3), np.float32)
    u[..., 0] = 1.0
    u[:, 2, 1] = 3.0 + np.arange(states)
    u[:, 2, 2] = 4.0 + np.arange(states)
    return u


def test_lifting_weights_the_kept_nodes_in_every_direction_and_state() -> None:
    coarse = np.array([[[0, 0, 0], [4, 8, -4]], [[1, 1, 1], [1, 1, 1]]], np.float32)
    found = lift(FINE.to_full, coarse)
    assert found.shape == (2, 5, 3)
    np.testing.assert_array_equal(found[0], np.arange(5)[:, None] * np.array([1, 2, -1]))
    np.testing.assert_array_equal(found[1], np.ones((5, 3)))


def test_the_error_is_a_length_its_mean_over_all_nodes_and_its_largest_over_all() -> None:
    meter = LiftingMeter(HIERARCHY)
    meter.add(moved())
    for error in meter.errors:
        assert (error.mean, error.largest) == (pytest.approx(5.0 / 5), pytest.approx(5.0))


def test_nodes_that_are_gone_count_neither_in_the_sum_nor_in_the_mean() -> None:
    u = moved()
    u[0, 1] = np.nan
    meter = LiftingMeter(HIERARCHY)
    meter.add(u)
    assert meter.errors[0].mean == pytest.approx(5.0 / 4)
    assert meter.errors[0].largest == pytest.approx(5.0)


def test_nodes_lifted_from_one_that_is_gone_do_not_count_either() -> None:
    u = moved()
    u[0, 4] = np.nan
    meter = LiftingMeter(HIERARCHY)
    meter.add(u)
    # Level 1: nodes 1 to 4 hang on node 4; node 0 is left. Level 2: nodes 0 to 3 hang on node 0.
    assert meter.errors[0].mean == 0.0
    assert meter.errors[1].mean == pytest.approx(5.0 / 4)


def test_runs_and_states_add_up_and_the_largest_stays() -> None:
    meter = LiftingMeter(HIERARCHY)
    meter.add(moved(3))
    meter.add(np.zeros((2, 5, 3), np.float32))
    sizes = np.hypot(3.0 + np.arange(3), 4.0 + np.arange(3))
    for error in meter.errors:
        assert error.mean == pytest.approx(sizes.sum() / (5 * 5), rel=1e-6)
        assert error.largest == pytest.approx(sizes.max(), rel=1e-6)


@pytest.mark.parametrize("states_at_once", [1, 2])
def test_how_many_states_are_lifted_at_once_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, states_at_once: int
) -> None:
    whole, pieces = LiftingMeter(HIERARCHY), LiftingMeter(HIERARCHY)
    whole.add(moved(5))
    lifted: list[int] = []
    original = lift
    monkeypatch.setattr(lifting, "lift", lambda to_full, u: lifted.append(len(u)) or original(to_full, u))
    monkeypatch.setattr(lifting, "_BUDGET", states_at_once * 5 * 12)
    pieces.add(moved(5))
    assert max(lifted) == states_at_once
    assert pieces.errors == whole.errors


def test_without_anything_added_nothing_is_known() -> None:
    for error in LiftingMeter(HIERARCHY).errors:
        assert np.isnan(error.mean)
        assert np.isnan(error.largest)


def test_a_mesh_that_is_gone_altogether_leaves_nothing_known() -> None:
    meter = LiftingMeter(HIERARCHY)
    meter.add(np.full((2, 5, 3), np.nan, np.float32))
    assert np.isnan(meter.errors[0].mean)


def test_sums_run_in_double_precision() -> None:
    u = np.zeros((4, 5, 3), np.float32)
    u[0, 2, 1] = 1e8
    u[1:, 2, 1] = 1.0
    meter = LiftingMeter(HIERARCHY)
    meter.add(u)
    assert meter.errors[1].mean * 20 == 1e8 + 3.0
