"""Half-edge contraction on meshes where one can see what must stay, and the selection through VTK."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_shapes import domes, joined, kart, plate, tee, tube
from scipy.sparse.csgraph import connected_components

from crashkit.errors import MeshError
from crashkit.mesh.selection import contract_onto, everything, select_quadric
from crashkit.mesh.selection_vtk import nearest_nodes, select_vtk
from crashkit.mesh.surface import Surface, surface
from data_schema.edges import adjacency


def components(mesh: Surface, edges: np.ndarray, kept: np.ndarray) -> int:
    own = np.full(mesh.n_nodes, -1)
    own[kept] = np.arange(len(kept))
    return int(connected_components(adjacency(len(kept), own[edges]), directed=False)[0])


@pytest.mark.parametrize("select", [select_quadric, select_vtk])
def test_counts_are_exact_and_levels_nested_on_the_kart(select) -> None:  # type: ignore[no-untyped-def]
    position, faces, _ = kart()
    mesh = surface(position, faces)
    finer = np.arange(mesh.n_nodes)
    for selection, count in zip(select(mesh, [300, 75, 19]), [300, 75, 19], strict=True):
        assert len(np.unique(selection.kept)) == count
        assert np.isin(selection.kept, finer).all()
        assert np.isin(selection.faces, selection.kept).all()
        assert (selection.into[selection.kept] == selection.kept).all()
        finer = selection.kept


def test_the_kart_stays_in_one_piece_down_to_nineteen_nodes() -> None:
    position, faces, _ = kart()
    mesh = surface(position, faces)
    coarsest = select_quadric(mesh, [300, 75, 19])[-1]
    before = components(mesh, mesh.edges, np.flatnonzero(mesh.used))
    assert components(mesh, coarsest.edges, coarsest.kept) == before


def test_contraction_keeps_the_corners_of_a_plate_and_moving_on_stays_beside_them() -> None:
    position, faces = plate(21, 21)
    corners = [0, 20, 420, 440]
    contracted, moved = (select_quadric(surface(position, faces), [24], rounds=s)[0].kept for s in (0, 3))
    assert np.isin(corners, contracted).all()
    away = np.linalg.norm(position[corners][:, None] - position[moved], axis=-1).min(axis=1)
    assert away.max() <= 1.5 * 0.05


def test_a_bent_plate_keeps_nodes_on_its_fold() -> None:
    position, faces = plate(21, 21)
    position[:, 2] = np.abs(position[:, 0] - 0.5)
    kept = select_quadric(surface(position, faces), [24], rounds=0)[0].kept
    on_fold = np.isclose(position[kept, 0], 0.5)
    assert on_fold.sum() >= 4
    assert {0.0, 1.0} <= set(position[kept][on_fold][:, 1].tolist())


def test_quadrilaterals_give_a_flat_plate_that_stays_flat_and_whole() -> None:
    position, faces = plate(15, 15, quads=True)
    selection = select_quadric(surface(position, faces), [30])[0]
    a, b, c = (position[selection.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(1.0, rel=1e-9)


def test_a_tee_keeps_its_joint() -> None:
    position, faces = tee()
    selection = select_quadric(surface(position, faces), [30])[0]
    joint = np.flatnonzero((position[:, 0] == 0) & (position[:, 2] == 0))
    assert np.isin([joint[0], joint[-1]], selection.kept).all()
    sides = np.sort(selection.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    on_joint = sides[np.isin(sides, joint).all(axis=1)]
    _, faces_at = np.unique(on_joint, axis=0, return_counts=True)
    assert faces_at.max() == 3


def test_a_thin_tube_becomes_a_chain_from_end_to_end() -> None:
    position, faces = tube()
    mesh = surface(position, faces)
    selection = select_quadric(mesh, [40, 8])[-1]
    assert components(mesh, selection.edges, selection.kept) == 1
    assert len(selection.faces) < len(selection.edges)
    assert np.ptp(position[selection.kept, 0]) > 1.8


def test_every_part_keeps_a_node_and_a_count_below_that_is_refused() -> None:
    position, faces, part = joined(plate(6, 6), plate(3, 3, 0.01, 0.01), plate(4, 4))
    position[36:45, 0] += 5
    position[45:, 0] += 10
    mesh = surface(position, faces, part)
    kept = select_quadric(mesh, [3])[0].kept
    assert sorted(np.searchsorted([36, 45], kept, side="right").tolist()) == [0, 1, 2]
    with pytest.raises(
        MeshError, match="2 nodes were asked for, but 3 parts or groups of parts have no node in common"
    ):
        select_quadric(mesh, [2])


def test_loose_pieces_of_one_part_may_vanish() -> None:
    pieces = [plate(3, 3, 0.1, 0.1) for _ in range(5)]
    position, faces, _ = joined(*pieces)
    position[:, 0] += np.repeat(np.arange(5.0), 9)
    selection = select_quadric(surface(position, faces), [2])[0]
    assert len(selection.kept) == 2
    assert np.isin(selection.into, selection.kept).all()


def test_a_face_keeps_to_nodes_of_its_own_part() -> None:
    position, faces = plate(20, 20)
    part = (position[faces, 0].mean(axis=1) > 0.5).astype(int)
    mesh = surface(position, faces, part)
    for selection in select_quadric(mesh, [100, 25]):
        for p in (0, 1):
            assert np.isin(selection.faces[selection.part == p], np.unique(faces[part == p])).all()


def test_parts_that_share_nodes_merge_when_nothing_else_is_left() -> None:
    position, faces = plate(20, 2)
    part = np.concatenate([np.arange(19), np.arange(19)])
    selection = select_quadric(surface(position, faces, part), [4])[0]
    assert len(selection.kept) == 4


def test_a_seam_of_doubled_nodes_closes_and_stays_open_without_close_pairs() -> None:
    left, right = plate(8, 8), plate(8, 8)
    position, faces, _ = joined(left, (right[0] + np.array([1, 0, 0]), right[1]))
    mesh = surface(position, faces)
    closed, open_ = (select_quadric(mesh, [40, 16], distance)[-1] for distance in (0.01, 0.0))
    assert components(mesh, closed.edges, closed.kept) == 1
    assert components(mesh, open_.edges, open_.kept) == 2


def test_the_walls_of_a_tube_may_pair_but_two_close_sheets_of_one_part_may_not() -> None:
    position, faces, _ = joined(*domes(gap=0.001))
    mesh = surface(position, faces)
    selection = select_quadric(mesh, [60, 12], 0.05)[-1]
    lower = selection.kept < 441
    assert 0 < lower.sum() < len(lower)
    assert components(mesh, selection.edges, selection.kept) == 2


def test_a_weld_between_parts_stays_in_the_graph() -> None:
    position, faces, part = joined(plate(8, 8), plate(8, 8))
    position[64:, 2] = 0.1
    mesh = surface(position, faces, part, extra_edges=[[27, 64 + 27]])
    selection = select_quadric(mesh, [24])[0]
    assert components(mesh, selection.edges, selection.kept) == 1


def test_the_unit_of_length_and_the_origin_do_not_matter() -> None:
    position, faces, _ = kart()
    one = select_quadric(surface(position, faces), [300, 75])
    other = select_quadric(surface(1024 * position, faces), [300, 75])
    for a, b in zip(one, other, strict=True):
        assert (a.kept == b.kept).all()


def test_the_order_of_nodes_and_faces_does_not_matter_on_the_kart() -> None:
    position, faces, _ = kart()
    rng = np.random.default_rng(1)
    order = rng.permutation(len(position))
    place = np.argsort(order)
    shuffled = np.roll(place[faces], 1, axis=1)[rng.permutation(len(faces))]
    one = select_quadric(surface(position, faces), [300, 75])
    other = select_quadric(surface(position[order], shuffled), [300, 75])
    for a, b in zip(one, other, strict=True):
        assert (a.kept == np.sort(order[b.kept])).all()


def test_contracting_onto_nodes_keeps_exactly_these() -> None:
    position, faces, _ = kart()
    mesh = surface(position, faces)
    keep = np.random.default_rng(0).choice(np.flatnonzero(mesh.used), 200, replace=False)
    selection = contract_onto(mesh, everything(mesh), keep)
    assert (selection.kept == np.sort(keep)).all()
    assert np.isin(selection.into[mesh.used], keep).all()


def test_no_node_is_tied_to_two_vertices_of_vtk() -> None:
    position, faces = plate(10, 10)
    mesh = surface(position, faces)
    points = np.repeat(position[[44]], 30, axis=0)
    chosen = nearest_nodes(points, mesh, np.arange(100))
    assert len(np.unique(chosen)) == 30
    assert np.linalg.norm(position[chosen] - position[44], axis=1).max() < 0.4


def test_the_selection_through_vtk_leaves_no_part_empty() -> None:
    position, faces, part = joined(plate(30, 30), plate(3, 3, 0.001, 0.001))
    position[900:, 2] = 0.5
    selection = select_vtk(surface(position, faces, part), [12])[0]
    assert (selection.kept >= 900).any()
    assert len(selection.kept) == 12
