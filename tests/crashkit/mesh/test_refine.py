"""Adaptive refinement: which nodes join, and that the result is a hierarchy like any other."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_shapes import kart, plate

from crashkit.errors import MeshError
from crashkit.mesh.hierarchy import build_hierarchy
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.lifting import LiftingMeter
from crashkit.mesh.refine import refine, selection_of
from crashkit.mesh.surface import Surface, surface


@pytest.fixture(scope="module")
def built() -> tuple[Surface, Hierarchy]:
    position, faces = plate(20, 20)
    return surface(position, faces), build_hierarchy(position, faces, [120, 30])


def near_corner(mesh: Surface) -> np.ndarray:
    """An error that is large near (0, 0) alone."""
    return np.exp(-np.linalg.norm(mesh.position, axis=1) / 0.1)


def test_faulty_nodes_and_their_neighbours_in_the_finer_graph_join(built: tuple[Surface, Hierarchy]) -> None:
    mesh, hierarchy = built
    error = near_corner(mesh)
    finer, coarse = hierarchy.levels
    faulty = error[finer.kept] > 0.3
    expected = faulty | ((finer.adjacency @ faulty) > 0) | np.isin(finer.kept, coarse.kept)
    refined = refine(mesh, hierarchy, 2, error, tolerance=0.3)
    assert refined[1].kept.tolist() == finer.kept[expected].tolist()
    assert 30 < refined[1].n_nodes < 120


def test_the_coarse_level_stays_and_sits_inside_the_refined_one(built: tuple[Surface, Hierarchy]) -> None:
    mesh, hierarchy = built
    refined = refine(mesh, hierarchy, 2, near_corner(mesh), tolerance=0.3)
    assert len(refined.levels) == 2
    assert (refined[2].kept == hierarchy[2].kept).all()
    assert (refined[1].kept[refined[2].in_finer] == refined[2].kept).all()
    assert refined[2].to_finer.shape == (refined[1].n_nodes, 30)
    assert np.abs(refined[1].to_full.sum(axis=1) - 1).max() < 1e-15 * 4
    assert refined[1].adjacency.shape == (refined[1].n_nodes,) * 2


def test_a_number_of_nodes_is_met_exactly_with_the_worst_first(built: tuple[Surface, Hierarchy]) -> None:
    mesh, hierarchy = built
    error = near_corner(mesh)
    refined = refine(mesh, hierarchy, 2, error, nodes=50)[1]
    assert refined.n_nodes == 50
    assert hierarchy[1].kept[np.argmax(error[hierarchy[1].kept])] in refined.kept


def test_level_one_is_refined_with_nodes_of_the_full_mesh(built: tuple[Surface, Hierarchy]) -> None:
    mesh, hierarchy = built
    refined = refine(mesh, hierarchy, 1, near_corner(mesh), nodes=150)
    assert [level.n_nodes for level in refined.levels] == [150, 120, 30]
    assert [level.index for level in refined.levels] == [1, 2, 3]


def test_lifting_is_better_where_it_was_refined() -> None:
    position, faces, displacement = kart()
    mesh, hierarchy = surface(position, faces), build_hierarchy(position, faces, [300, 75])
    coarse = hierarchy[2]
    error = np.linalg.norm(coarse.to_full @ displacement[-1][coarse.kept] - displacement[-1], axis=1)
    refined = refine(mesh, hierarchy, 2, error, nodes=120)
    before, after = LiftingMeter(hierarchy), LiftingMeter(refined)
    before.add(displacement)
    after.add(displacement)
    assert after.errors[0].mean < 0.8 * before.errors[1].mean


def test_a_stored_level_says_what_was_selected(built: tuple[Surface, Hierarchy]) -> None:
    mesh, hierarchy = built
    selection = selection_of(mesh, hierarchy[2])
    assert (selection.kept == hierarchy[2].kept).all()
    assert (selection.into[selection.kept] == selection.kept).all()
    assert (selection.parts == mesh.node_parts[selection.kept]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"error": np.zeros(30), "tolerance": 0.1}, r"the error has shape \(30,\); expected a finite number for each"),
        ({"error": np.full(400, np.nan), "tolerance": 0.1}, "expected a finite number for each of the 400 nodes"),
        ({"error": np.ones(400)}, "either a tolerance or a number of nodes"),
        ({"error": np.ones(400), "tolerance": 0.1, "nodes": 40}, "either a tolerance or a number of nodes"),
        ({"error": np.ones(400), "nodes": 30}, "30 nodes were asked for; level 2 has 30 and the next finer one 120"),
        ({"error": np.ones(400), "nodes": 121}, "121 nodes were asked for"),
        ({"error": np.ones(400), "tolerance": 2.0}, "no node has an error above 2.0 m .largest 1.; nothing to refine"),
    ],
)
def test_refinement_that_makes_no_sense_is_refused(
    built: tuple[Surface, Hierarchy], arguments: dict, message: str
) -> None:
    mesh, hierarchy = built
    with pytest.raises(MeshError, match=message):
        refine(mesh, hierarchy, 2, **arguments)
