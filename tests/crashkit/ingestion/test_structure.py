"""What of a solver's mesh stays, and the order in which further runs are brought."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_runs import plate, shuffled

from crashkit.errors import DataError
from crashkit.ingestion.structure import matched, structure_of
from crashkit.readers.base import Part, RunMesh


def block(nx: int = 2) -> RunMesh:
    """Hexahedra in a row, one wedge at the end, a beam hanging on, and a loose node."""
    grid = np.array([(i, j, k) for i in range(nx + 1) for j in range(2) for k in range(2)], float)

    def at(i: int, j: int, k: int) -> int:
        return i * 4 + j * 2 + k

    hexahedra = [
        [at(i, 0, 0), at(i + 1, 0, 0), at(i + 1, 1, 0), at(i, 1, 0), at(i, 0, 1), at(i + 1, 0, 1), at(i + 1, 1, 1), at(i, 1, 1)]
        for i in range(nx)
    ]  # fmt: skip
    apex = len(grid)
    wedge = [at(nx, 0, 0), at(nx, 1, 0), apex, at(nx, 0, 1), at(nx, 1, 1), apex + 1, -1, -1]
    beam = [apex, apex + 2, -1, -1, -1, -1, -1, -1]
    position = np.vstack([grid, [[nx + 1, 0.5, 0], [nx + 1, 0.5, 1], [nx + 2, 0, 0], [50, 50, 50]]])
    return RunMesh(
        position=position,
        node_id=np.arange(1, len(position) + 1),
        face_nodes=np.empty((0, 4), np.int32),
        face_part=np.empty(0, np.int32),
        face_id=np.empty(0, np.int64),
        parts=(Part(1, "block"), Part(2, "beam")),
        cell_nodes=np.array([*hexahedra, wedge, beam], np.int32),
        cell_type=np.array([12] * nx + [13, 3], np.uint8),
        cell_part=np.array([0] * nx + [0, 1], np.int32),
        cell_id=np.arange(10, 12 + nx),
    )


def test_rigid_wall_and_its_nodes_are_left_out_and_said_so() -> None:
    found = structure_of(plate())
    assert found.n_nodes == 13
    assert [p.id for p in found.parts] == [7, 8]
    assert found.notes == ("rigid walls left out: wall", "4 of 17 nodes left out: no element that stays uses them")
    assert structure_of(plate(), keep_rigid_walls=True).n_nodes == 17


@pytest.mark.parametrize(
    ("parts", "exclude", "ids"),
    [
        (["8"], [], [8]),
        (["rail left"], [], [7]),
        (["rail*"], [], [7, 8]),
        (["*"], [], [7, 8]),
        (["wall"], [], [99]),
        ([], ["*right"], [7]),
        (["rail*"], ["7"], [8]),
    ],
)
def test_parts_by_number_title_and_pattern(parts: list[str], exclude: list[str], ids: list[int]) -> None:
    found = structure_of(plate(), parts=parts, exclude_parts=exclude)
    assert [p.id for p in found.parts] == ids
    assert set(found.face_part) == set(range(len(ids)))


def test_unknown_part_is_told_with_those_there_are() -> None:
    with pytest.raises(DataError, match=r"no part is called 'door'; the runs have 7 \(rail left\), 8 \(rail right\)"):
        structure_of(plate(), parts=["door"])


@pytest.mark.parametrize("count", [11, 12, 13])
def test_of_many_parts_the_first_twelve_are_named_and_only_then_are_there_more(count: int) -> None:
    mesh = replace(plate(), parts=tuple(Part(100 + k, "") for k in range(count)))
    with pytest.raises(DataError) as caught:
        structure_of(mesh, parts=["hood"])
    listing = str(caught.value).partition("the runs have ")[2].partition(";")[0]
    assert listing == ", ".join(str(100 + k) for k in range(min(count, 12))) + (" ..." if count > 12 else "")


def test_nothing_left_is_an_error() -> None:
    with pytest.raises(DataError, match="nothing is left of the mesh"):
        structure_of(plate(), parts=["rail*"], exclude_parts=["rail*"])


def test_doubled_node_number_is_an_error() -> None:
    mesh = plate()
    ids = mesh.node_id.copy()
    ids[3] = ids[5]
    with pytest.raises(DataError, match="node number 105 stands for several nodes"):
        structure_of(replace(mesh, node_id=ids))


def test_solids_give_their_outer_skin_and_keep_their_cells() -> None:
    found = structure_of(block())
    assert len(found.cell_nodes) == 4
    assert found.n_nodes == 15, "the loose node is left out, the beam's node stays"
    # 5 + 4 quadrilaterals of the hexahedra, 2 of the wedge and its 2 triangles
    assert (found.face_nodes[:, 3] >= 0).sum() == 11
    assert (found.face_nodes[:, 3] < 0).sum() == 2
    assert (found.face_source < 0).all()
    assert set(found.face_id) == {10, 11, 12}


def test_skin_is_closed_and_looks_outwards() -> None:
    found = structure_of(block(), parts=["block"])
    sides: dict[tuple[int, int], int] = {}
    volume = 0.0
    for face in found.face_nodes:
        corners = face[face >= 0]
        p = found.position[corners]
        for k in range(1, len(p) - 1):
            volume += float(np.dot(p[0], np.cross(p[k], p[k + 1]))) / 6
        for a, b in zip(corners, np.roll(corners, -1)):
            sides[(int(a), int(b))] = sides.get((int(a), int(b)), 0) + 1
    assert all(sides.get((b, a)) == n == 1 for (a, b), n in sides.items())
    assert volume == pytest.approx(2.5)


def test_run_in_another_order_is_brought_to_that_of_the_first() -> None:
    reference = structure_of(plate())
    mesh, _ = shuffled(plate())
    found = matched(reference, structure_of(mesh))
    np.testing.assert_array_equal(found.node_id, reference.node_id)
    np.testing.assert_array_equal(found.position, reference.position)
    np.testing.assert_array_equal(mesh.node_id[found.node], reference.node_id)
    np.testing.assert_array_equal(mesh.face_id[found.face_source], reference.face_id)


def renumbered(mesh: RunMesh) -> RunMesh:
    return replace(mesh, node_id=mesh.node_id + np.where(np.arange(len(mesh.node_id)) == 2, 1000, 0))


def rejoined(mesh: RunMesh) -> RunMesh:
    faces = mesh.face_nodes.copy()
    faces[0, 2] = 7
    return replace(mesh, face_nodes=faces)


def moved_to_other_part(mesh: RunMesh) -> RunMesh:
    part = mesh.face_part.copy()
    part[0] = 1
    return replace(mesh, face_part=part)


def without_a_face(mesh: RunMesh) -> RunMesh:
    keep = np.arange(len(mesh.face_nodes)) != 4
    return replace(
        mesh, face_nodes=mesh.face_nodes[keep], face_part=mesh.face_part[keep], face_id=mesh.face_id[keep]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (renumbered, r"13 nodes, that of the first run 13 \(number 102 is missing\)"),
        (rejoined, "1 of 7 faces .around element 500, part 7"),
        (moved_to_other_part, "1 of 7 faces"),
        (without_a_face, "6 faces, that of the first run 7"),
    ],
)
def test_another_mesh_is_refused_with_the_place(change, told: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DataError, match=told):
        matched(structure_of(plate()), structure_of(change(plate())))


def test_a_mesh_whose_cells_are_all_left_out_is_as_one_without_cells() -> None:
    shells, beam = plate(), block()
    both = replace(
        shells,
        cell_nodes=np.array([[0, 1]], np.int32),
        cell_type=np.array([3], np.uint8),
        cell_part=np.array([len(shells.parts)], np.int32),
        cell_id=np.array([99]),
        parts=(*shells.parts, Part(50, "sled")),
    )
    found = structure_of(both, exclude_parts=["sled"])
    assert found.cell_nodes.shape == structure_of(shells).cell_nodes.shape
    assert matched(structure_of(shells), found).n_nodes == found.n_nodes
    assert len(structure_of(beam).cell_nodes) == 4
