"""A run as the dataset keeps it: what faces take from shells and from the solids behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_runs import MemoryRun, plate
from test_structure import block

from crashkit.errors import ReadError
from crashkit.ingestion.run_view import RunView, gone_nodes
from crashkit.ingestion.structure import structure_of
from crashkit.ingestion.survey import Field
from crashkit.readers.base import FieldInfo, RunMesh
from data_schema import unit_system


def both() -> RunMesh:
    """The block of solids, with one shell on the side of its first hexahedron."""
    return replace(
        block(),
        face_nodes=np.array([[0, 1, 3, 2]], np.int32),
        face_part=np.array([1], np.int32),
        face_id=np.array([77], np.int64),
    )


def view(run: MemoryRun, units: str = "mm-ms-kg") -> RunView:
    return RunView(run, structure_of(run.mesh), unit_system(units))


def test_skin_takes_the_values_of_its_solid_from_whichever_field_has_them() -> None:
    """Solids and thick shells are written as fields of their own, each missing where the other is there."""
    mesh = both()
    solid = np.array([[1.0, 2.0, np.nan, np.nan], [3.0, 4.0, np.nan, np.nan]], np.float32)
    thick = np.array([[np.nan, np.nan, 5.0, np.nan], [np.nan, np.nan, 6.0, np.nan]], np.float32)
    shell = np.array([[8.0], [9.0]], np.float32)
    fields = {
        "strain": (FieldInfo("strain", "face"), shell),
        "solid_strain": (FieldInfo("solid_strain", "cell"), solid),
        "tshell_strain": (FieldInfo("tshell_strain", "cell"), thick),
    }
    for order in (["strain", "solid_strain", "tshell_strain"], ["tshell_strain", "solid_strain", "strain"]):
        run = MemoryRun(mesh=mesh, time=[0, 1], fields={n: fields[n] for n in order})
        found = view(run)
        values = found.field(Field(FieldInfo("strain", "face"), "1"), 0, 2)
        cells = np.where(np.isnan(solid), thick, solid)
        source = found.structure.face_source
        expected = np.where(source >= 0, shell, cells[:, np.where(source < 0, -1 - source, 0)])
        np.testing.assert_array_equal(values, expected)
        assert np.isfinite(values).all()


def test_without_a_field_of_shells_they_have_none() -> None:
    fields = {"solid_strain": (FieldInfo("solid_strain", "cell"), np.ones((2, 4), np.float32))}
    found = view(MemoryRun(mesh=both(), time=[0, 1], fields=fields))
    values = found.field(Field(FieldInfo("strain", "face"), "1"), 0, 2)
    np.testing.assert_array_equal(np.isnan(values), np.broadcast_to(found.structure.face_source >= 0, values.shape))


def test_a_field_is_changed_to_si_by_its_quantity() -> None:
    stress = np.ones((2, 1), np.float32)
    run = MemoryRun(mesh=both(), time=[0, 1], fields={"pressure": (FieldInfo("pressure", "face", 1, "stress"), stress)})
    values = view(run).field(Field(FieldInfo("pressure", "face", 1, "stress"), "Pa"), 1, 2)
    assert np.nanmax(values) == pytest.approx(1e9)
    assert values.shape == (1, len(view(run).structure.face_nodes))


def test_skin_lives_as_long_as_its_solid_and_shells_as_long_as_themselves() -> None:
    mesh = both()
    shells = np.array([[True], [False]])
    cells = np.array([[True, True, True, True], [True, False, True, True]])
    for alive, alive_cells in ((shells, cells), (shells, None), (None, cells)):
        found = view(MemoryRun(mesh=mesh, time=[0, 1], alive=alive, alive_cells=alive_cells))
        faces, solids = found.alive(0, 2)
        assert faces is not None
        source = found.structure.face_source
        for k, s in enumerate(source):
            of_shell = True if alive is None else bool(alive[1, s]) if s >= 0 else True
            of_cell = True if alive_cells is None else bool(alive_cells[1, -1 - s]) if s < 0 else True
            assert faces[1, k] == (of_shell and of_cell)
        assert faces[0].all()
        assert (solids is None) == (alive_cells is None)


def test_displacements_are_of_the_chosen_nodes_in_metres() -> None:
    run = MemoryRun(mesh=plate())
    values = view(run).displacement(1, 3)
    np.testing.assert_allclose(values, run.moved[1:3, :13] * 1e-3, rtol=1e-6)


def test_what_is_read_at_once_is_the_larger_of_mesh_and_faces() -> None:
    run = MemoryRun(mesh=both(), fields={"strain": (FieldInfo("strain", "face"), np.ones((5, 1), np.float32))})
    found = view(run)
    assert found.field_rows(Field(FieldInfo("strain", "face"), "1")) == len(found.structure.face_nodes)
    assert found.field_rows(Field(FieldInfo("x", "node"), "1")) == max(16, len(found.structure.face_nodes))


def test_values_of_another_shape_are_the_readers_fault() -> None:
    run = MemoryRun(mesh=plate(), fields={"strain": (FieldInfo("strain", "face"), np.ones((5, 3), np.float32))})
    with pytest.raises(ReadError, match=r"gave strain of shape \(1, 3\), expected \(1, 8\)"):
        view(run).field(Field(FieldInfo("strain", "face"), "1"), 0, 1)


def test_a_node_is_gone_when_the_last_of_its_elements_is() -> None:
    structure = structure_of(both())
    faces = np.ones((3, len(structure.face_nodes)), bool)
    cells = np.ones((3, 4), bool)
    assert gone_nodes(structure, faces, cells, 3) is None
    assert gone_nodes(structure, None, None, 3) is None
    cells[1:, 3] = False  # the beam: its far node is of nothing else
    found = gone_nodes(structure, None, cells, 3)
    assert found is not None
    assert [np.flatnonzero(row).tolist() for row in found] == [[], [14], [14]]
