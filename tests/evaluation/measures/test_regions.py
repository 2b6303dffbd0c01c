"""Errors by part and region, the worst place, and what is masked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.errors import EvaluationError
from evaluation.measures.regions import (
    by_grid,
    by_part,
    by_thirds,
    error_by_group,
    living_nodes,
    masked,
    named,
    worst_of,
)

FACES = np.array([[0, 1, 2, -1], [1, 2, 3, 4], [4, 5, 6, -1]])


@given(seed=st.integers(0, 50), counts=st.tuples(*[st.integers(1, 4)] * 3))
def test_boxes_of_a_grid_hold_every_node_once(seed, counts):
    x = np.random.default_rng(seed).normal(size=(30, 3))
    groups = by_grid(x, counts)
    assert sorted(np.concatenate(groups.nodes)) == list(range(30))
    assert len(set(groups.names)) == len(groups.names)
    assert all(len(nodes) for nodes in groups.nodes)


def test_thirds_run_from_the_rear_to_the_front():
    x = np.array([[0.0, 0, 0], [3, 0, 0], [1.4, 0, 0], [0.9, 0, 0]])
    groups = by_thirds(x)
    assert groups.names == ("rear", "middle", "front")
    assert [nodes.tolist() for nodes in groups.nodes] == [[0, 3], [2], [1]]


def test_a_flat_structure_has_no_empty_thirds():
    groups = by_thirds(np.zeros((5, 3)), axis=2)
    assert groups.names == ("rear",)
    assert groups.nodes[0].tolist() == [0, 1, 2, 3, 4]


def test_a_node_between_two_parts_belongs_to_both_and_empty_parts_to_none():
    groups = by_part(FACES, [0, 2, 2], ["bumper", "unused", "rail"])
    assert groups.names == ("bumper", "rail")
    assert [nodes.tolist() for nodes in groups.nodes] == [[0, 1, 2], [1, 2, 3, 4, 5, 6]]


def test_errors_by_group_are_means_over_nodes_then_over_time():
    distance = np.array([[0.0, 2.0, 9.0], [np.nan, 6.0, 9.0]])
    size = np.array([[4.0, 4.0, 1.0], [100.0, 16.0, 1.0]])
    (first, second) = error_by_group(distance, named({"a": [0, 1], "b": [2]}, 3), size)
    assert (first.mean, first.last, first.largest, first.state, first.node) == (3.5, 6.0, 6.0, 1, 1)
    assert first.size == 10.0
    assert first.relative == 0.35
    assert (second.name, second.nodes, second.mean, second.node) == ("b", 1, 9.0, 2)


def test_a_group_that_is_gone_throughout_has_no_error():
    (error,) = error_by_group(np.full((2, 1), np.nan), named({"a": [0]}, 1))
    assert np.isnan([error.mean, error.last, error.largest]).all()
    assert error.node == -1


def test_the_worst_run_state_and_node_are_named():
    runs = [np.full((2, 3), np.nan), np.array([[0, 1, 2], [3, np.nan, 1]]), np.array([[0, 1, 2], [0, 1, 2.0]])]
    worst = worst_of(iter(runs))
    assert (worst.value, worst.run, worst.state, worst.node) == (3.0, 1, 1, 0)


def test_nodes_die_with_their_last_face():
    alive = np.array([[True, True, True], [False, True, True], [False, True, False]])
    living = living_nodes(FACES, alive, n_nodes=8)
    assert living[0].all()
    assert np.flatnonzero(~living[1]).tolist() == [0]
    assert np.flatnonzero(~living[2]).tolist() == [0, 5, 6]
    field = masked(np.ones((3, 8, 3)), FACES, alive)
    np.testing.assert_array_equal(np.isnan(field).all(axis=-1), ~living)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: named({"seat": [1, 12]}, 12), "node set 'seat' names nodes 1 to 12: expected 0 to 11"),
        (lambda: by_grid(np.zeros((2, 3)), (2, 0, 1)), r"grid of \(2, 0, 1\) boxes asked for"),
        (lambda: worst_of([np.full((2, 3), np.nan)]), "no run with a living node"),
        (
            lambda: living_nodes(FACES, np.ones((2, 5), bool), 8),
            r"alive has shape \(2, 5\): expected \(state, 3 faces\)",
        ),
    ],
)
def test_what_cannot_be_grouped_is_refused(call, message):
    with pytest.raises(EvaluationError, match=message):
        call()
