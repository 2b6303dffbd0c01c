"""Groups of nodes by part and by boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.errors import EvaluationError
from evaluation.measures.regions import by_grid, by_part, named

FACES = np.array([[0, 1, 2, -1], [1, 2, 3, 4], [4, 5, 6, -1]])


@given(seed=st.integers(0, 50), counts=st.tuples(*[st.integers(1, 4)] * 3))
def test_boxes_of_a_grid_hold_every_node_once(seed, counts):
    x = np.random.default_rng(seed).normal(size=(30, 3))
    groups = by_grid(x, counts)
    assert sorted(np.concatenate(groups.nodes)) == list(range(30))
    assert len(set(groups.names)) == len(groups.names)
    assert all(len(nodes) for nodes in groups.nodes)


def test_a_node_between_two_parts_belongs_to_both_and_empty_parts_to_none():
    groups = by_part(FACES, [0, 2, 2], ["bumper", "unused", "rail"])
    assert groups.names == ("bumper", "rail")
    assert [nodes.tolist() for nodes in groups.nodes] == [[0, 1, 2], [1, 2, 3, 4, 5, 6]]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: named({"seat": [1, 12]}, 12), "node set 'seat' names nodes 1 to 12: expected 0 to 11"),
        (lambda: by_grid(np.zeros((2, 3)), (2, 0, 1)), r"grid of \(2, 0, 1\) boxes asked for"),
    ],
)
def test_what_cannot_be_grouped_is_refused(call, message):
    with pytest.raises(EvaluationError, match=message):
        call()
