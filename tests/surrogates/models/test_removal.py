"""Removal of elements: when, of which, and how well it is told."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from data_schema.mirror import MirrorPlane
from surrogates.models.removal import centres, judged, mirrored_faces, neighbours, removal_times

TIME = np.array([0.0, 1.0, 2.0, 4.0])


def test_an_element_goes_between_the_last_state_it_lives_in_and_the_next() -> None:
    alive = np.array([[[1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 0, 0], [1, 0, 0, 0]]], bool)
    assert removal_times(alive, TIME, [0])[0].tolist() == [np.inf, 3.0, 0.5, 0.0]


def test_an_element_that_comes_back_has_not_gone() -> None:
    alive = np.array([[[1], [0], [1], [1]]], bool)
    assert removal_times(alive, TIME, [0])[0].tolist() == [np.inf]


def test_triangles_have_their_centre_among_quadrilaterals() -> None:
    points = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    faces = np.array([[0, 1, 2, 3], [0, 1, 2, -1]])
    np.testing.assert_allclose(centres(points, faces), [[1, 1, 0], [4 / 3, 2 / 3, 0]])


def test_the_image_of_a_face_lies_on_the_other_side_and_in_the_part_that_is_the_image() -> None:
    # Two plates side by side, mirrored at x = 0, one part each; below the left one lies a third part.
    points = np.array(
        [
            [-2.0, 0, 0],
            [-1, 0, 0],
            [-1, 1, 0],
            [2, 0, 0],
            [1, 0, 0],
            [1, 1, 0],
            [-2, 0, -0.1],
            [-1, 0, -0.1],
            [-1, 1, -0.1],
        ]
    )
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    to_image = sparse.csr_matrix(np.eye(9)[[3, 4, 5, 0, 1, 2, 3, 4, 5]])
    mirror = MirrorPlane(np.array([1.0, 0, 0]), 0.0, to_image)
    assert mirrored_faces(mirror, points, faces, np.array([0, 1, 2])).tolist()[:2] == [1, 0]


def test_means_over_neighbours_take_faces_that_share_a_node() -> None:
    around = neighbours(np.array([[0, 1, 2], [2, 3, 4], [5, 6, 7]])).toarray()
    np.testing.assert_allclose(around, [[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 1]])


def test_precision_and_recall_are_those_of_the_definition() -> None:
    removed = np.array([1, 1, 1, 0, 0, 0], bool)
    score = judged(np.array([0.9, 0.8, 0.1, 0.7, 0.2, 0.1]), removed)
    assert score.precision == pytest.approx(2 / 3)
    assert score.recall == pytest.approx(2 / 3)
    expected = -np.log([0.9, 0.8, 0.1, 0.3, 0.8, 0.9]).mean()
    assert score.loss == pytest.approx(expected)
    assert np.isnan(judged(np.zeros(3), np.array([1, 0, 0], bool)).precision)
