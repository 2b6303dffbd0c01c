"""Maps from coarse to fine: closest points, own parts, own sheets, chains, and what they reproduce."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv
from mesh_shapes import domes, joined, kart, plate, tube

from crashkit.mesh.hierarchy import build_hierarchy
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.probe import closest_cells, coarse_cells
from crashkit.mesh.surface import surface


@pytest.fixture(scope="module")
def kart_levels() -> Hierarchy:
    position, faces, _ = kart()
    return build_hierarchy(position, faces, [300, 75, 19])


def test_rows_sum_to_one_and_are_not_negative(kart_levels: Hierarchy) -> None:
    for level in kart_levels.levels:
        for u in (level.to_full, level.to_finer):
            assert np.abs(u.sum(axis=1) - 1).max() <= 4 * np.finfo(float).eps
            assert u.data.min() > 0
            assert np.diff(u.indptr).max() <= 3


def test_kept_nodes_are_exactly_themselves(kart_levels: Hierarchy) -> None:
    for level in kart_levels.levels:
        unit = np.eye(level.n_nodes)
        assert (level.to_full[level.kept].toarray() == unit).all()
        assert (level.to_finer[level.in_finer].toarray() == unit).all()


def test_the_level_to_level_maps_are_what_the_full_maps_say_on_kept_nodes(kart_levels: Hierarchy) -> None:
    one, two, _ = kart_levels.levels
    assert one.to_finer.shape == (2400, 300)
    assert two.to_finer.shape == (300, 75)
    assert (two.to_finer != two.to_full[one.kept]).nnz == 0
    assert (one.kept[two.in_finer] == two.kept).all()


def test_distances_agree_with_pyvista_where_there_is_one_sheet() -> None:
    position, faces = plate(25, 25)
    position[:, 2] = 0.1 * np.sin(6 * position[:, 0]) * np.cos(5 * position[:, 1])
    level = build_hierarchy(position, faces, [60])[1]
    coarse = pv.PolyData.from_regular_faces(position[level.kept], level.faces)
    _, closest = coarse.find_closest_cell(position, return_closest_point=True)
    assert level.distance == pytest.approx(np.linalg.norm(closest - position, axis=1), abs=1e-12)


@pytest.mark.parametrize("as_parts", [True, False])
def test_two_close_sheets_that_move_apart_stay_apart(as_parts: bool) -> None:
    position, faces, sheet = joined(*domes(gap=0.002))
    upper = np.arange(len(position)) >= len(position) // 2
    part = sheet if as_parts else np.zeros_like(sheet)
    hierarchy = build_hierarchy(position, faces, [80, 24, 10], face_part=part)
    away = np.where(upper, 1.0, -1.0)
    for level in hierarchy.levels:
        assert np.abs(level.to_full @ away[level.kept] - away).max() <= 4 * np.finfo(float).eps


def test_the_closest_triangle_alone_would_mix_up_those_sheets() -> None:
    position, faces, _ = joined(*domes(gap=0.002))
    mesh = surface(position, faces)
    level = build_hierarchy(position, faces, [24])[1]
    parts = mesh.node_parts
    cells = coarse_cells(level.faces, np.zeros(len(level.faces), int), level.edges, parts[level.kept], 1)
    closest = closest_cells(position, parts, position[level.kept], cells)
    upper = np.arange(len(position)) >= len(position) // 2
    wrong = upper[level.kept[cells.nodes[closest, 0]]] != upper
    assert wrong.mean() > 0.1


def test_a_node_is_mapped_from_nodes_of_its_own_parts() -> None:
    position, faces = plate(24, 24)
    position[:, 2] = 0.2 * np.abs(position[:, 0] - 0.5)
    part = (position[faces, 0].mean(axis=1) > 0.5).astype(int)
    mesh = surface(position, faces, part)
    for level in build_hierarchy(position, faces, [80, 20], face_part=part).levels:
        rows, columns = level.to_full.nonzero()
        shared = mesh.node_parts[rows] & mesh.node_parts[level.kept[columns]]
        assert shared.any(axis=1).all()


def test_a_chain_without_faces_lifts_along_its_segments() -> None:
    position, faces = tube(around=6, along=80, radius=0.005)
    level = build_hierarchy(position, faces, [60, 6])[2]
    assert len(level.faces) == 0
    assert np.diff(level.to_full.indptr).max() == 2
    along = position[:, 0]
    assert np.abs(level.to_full @ along[level.kept] - along).max() < 0.05 * np.ptp(along)


def test_nodes_without_faces_take_the_nearest_kept_node() -> None:
    position, faces = plate(10, 10)
    position = np.concatenate([position, [[1.0, 1.0, 0.5], [0.0, 0.0, -0.5]]])
    level = build_hierarchy(position, faces, [20])[1]
    for loose in (100, 101):
        row = level.to_full[loose]
        assert row.data.tolist() == [1.0]
        nearest = np.argmin(np.linalg.norm(position[level.kept] - position[loose], axis=1))
        assert row.indices.tolist() == [nearest]
    assert not np.isin([100, 101], level.kept).any()


def test_doubled_nodes_and_slivers_leave_no_nan() -> None:
    position, faces = plate(8, 8)
    position[9] = position[10]
    position[20:24] = position[20]
    for level in build_hierarchy(position, faces, [20, 5]).levels:
        assert np.isfinite(level.to_full.data).all()
        assert np.isfinite(level.distance).all()
