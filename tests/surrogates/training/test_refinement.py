"""Adaptive refinement keeps the coarse nodes, adds the neighbours of the faulty ones, and still maps rigidly."""

from __future__ import annotations

import numpy as np
import plate
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogates.data.graphs import Graphs
from surrogates.errors import SurrogateError
from surrogates.settings import settings as choose
from surrogates.training.refinement import Refined
from surrogates.training.train import train_surrogate


def hierarchy() -> Graphs:
    return Graphs.of(plate.campaign(2))


def refined(errors: np.ndarray, share: float = 0.3, rings: int = 1) -> Refined:
    return Refined.start(hierarchy(), 2).finer(errors, share, rings)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), share=st.floats(0.05, 1.0), rings=st.integers(1, 3))
def test_maps_stay_maps(seed: int, share: float, rings: int) -> None:
    errors = np.random.default_rng(seed).random(9)
    graphs = refined(errors, share, rings).graphs
    fine, coarse = graphs[1], graphs[2]
    for matrix in (fine.to_full, fine.to_finer, coarse.to_finer):
        np.testing.assert_allclose(np.asarray(matrix.sum(axis=1)).ravel(), 1.0)
        assert matrix.data.min() >= 0
    assert (fine.kept[coarse.in_finer] == coarse.kept).all()
    identity = coarse.to_finer[coarse.in_finer].toarray()
    np.testing.assert_array_equal(identity, np.eye(9))
    np.testing.assert_array_equal(fine.to_full[fine.kept].toarray(), np.eye(fine.n_nodes))
    assert fine.edges.min() >= 0
    assert fine.edges.max() < fine.n_nodes


def test_neighbours_of_the_worst_node_come_in_and_no_others() -> None:
    errors = np.zeros(9)
    errors[4] = 1.0  # the middle of the coarse plate
    fine = refined(errors, share=0.1).graphs[1]
    middle = plate.SIDES[1] ** 2 // 2
    around = {middle, middle - 1, middle + 1, middle - plate.SIDES[1], middle + plate.SIDES[1]}
    coarse = set(plate.levels()[1].in_finer.tolist())
    expected = sorted(plate.levels()[0].kept[sorted(around | coarse)].tolist())
    assert fine.kept.tolist() == expected


def test_refining_everywhere_gives_the_finer_level() -> None:
    fine = refined(np.ones(9), share=1.0, rings=2).graphs[1]
    whole = plate.levels()[0]
    assert (fine.kept == whole.kept).all()
    np.testing.assert_allclose(fine.to_full.toarray(), whole.to_full.toarray())


def test_a_refined_graph_hangs_together() -> None:
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    errors = np.zeros(9)
    errors[0] = 1.0
    fine = refined(errors, share=0.1).graphs[1]
    i, j = fine.edges.T
    assert connected_components(csr_matrix((np.ones(len(i)), (i, j)), shape=(fine.n_nodes,) * 2))[0] == 1


def test_a_cascade_refines_between_coarse_and_fine() -> None:
    chosen = choose("mh", overrides=("level.epochs=3", "level.latent=3", "refinement.adaptive=true"))
    fitted = train_surrogate(plate.campaign(8), chosen)
    coarse, fine = (fitted.graphs.n_nodes(k) for k in (2, 1))
    assert coarse == plate.SIDES[2] ** 2
    assert coarse < fine < plate.SIDES[1] ** 2
    assert fitted.predict_full([20.0, 0.0, 3e8]).shape == (len(plate.TIME), plate.SIDES[0] ** 2, 3)


def test_levels_may_not_be_left_out() -> None:
    chosen = choose("mh", overrides=("refinement.adaptive=true", "levels=[2, 0]"))
    with pytest.raises(SurrogateError, match=r"goes level by level; found levels \[2, 0\]"):
        train_surrogate(plate.campaign(8), chosen)


def test_the_full_mesh_is_no_refined_level() -> None:
    chosen = choose("mh", overrides=("refinement.adaptive=true", "levels=[1, 0]", "level.epochs=1"))
    with pytest.raises(SurrogateError, match="ends on level 1"):
        train_surrogate(plate.campaign(8), chosen)
