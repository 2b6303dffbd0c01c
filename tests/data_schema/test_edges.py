"""Edges of faces and graphs."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from data_schema.edges import adjacency, face_edges, unique_pairs, without_sides


def test_a_triangle_among_quadrilaterals_has_three_sides() -> None:
    assert face_edges([[0, 1, 2, -1], [2, 1, 3, 4]]).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 4], [3, 4]]


def test_pairs_are_kept_once_whatever_their_direction_and_loops_not():
    assert unique_pairs(np.array([[3, 1], [1, 3], [2, 2], [0, 1]])).tolist() == [[0, 1], [1, 3]]


def test_an_adjacency_is_symmetric_and_counts_an_edge_once():
    assert adjacency(3, np.array([[0, 1], [1, 2]])).toarray().tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0]]


def test_lone_edges_are_those_of_no_face():
    faces = np.array([[0, 1, 2]])
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [3, 4]])
    assert without_sides(edges, faces).tolist() == [[2, 3], [3, 4]]
    assert without_sides(edges[:3], faces).shape == (0, 2)


def test_the_ground_floor_loads_neither_xarray_nor_torch():
    code = "import sys, data_schema.levels, surrogates.data.campaign; print([m for m in ('xarray', 'torch') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
