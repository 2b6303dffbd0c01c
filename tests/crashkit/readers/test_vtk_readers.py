"""VTK files with time, written by VTK, PyVista and this package, and legacy files as OpenRadioss's converter has them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
import pyvista as pv
from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline
from vtkmodules.vtkIOHDF import vtkHDFWriter
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from crashkit.errors import ReadError
from crashkit.readers import reader_for
from crashkit.readers._vtk_legacy import read_legacy
from crashkit.readers._vtk_process import read_xml
from crashkit.writers.paraview import write_paraview


class _Transient(VTKPythonAlgorithmBase):
    """The sample as a VTK source with time steps."""

    def __init__(self, sample):
        super().__init__(nInputPorts=0, nOutputPorts=1, outputType="vtkUnstructuredGrid")
        self.sample = sample

    def RequestInformation(self, request, inputs, outputs):
        info = outputs.GetInformationObject(0)
        times = self.sample.time.tolist()
        info.Set(Pipeline.TIME_STEPS(), times, len(times))
        info.Set(Pipeline.TIME_RANGE(), [times[0], times[-1]], 2)
        return 1

    def RequestData(self, request, inputs, outputs):
        info = outputs.GetInformationObject(0)
        time = info.Get(Pipeline.UPDATE_TIME_STEP()) or 0.0
        state = int(np.argmin(np.abs(self.sample.time - time)))
        grid = mesh_at(self.sample, state, moving=True).cast_to_unstructured_grid()
        grid.clear_field_data()
        vtkUnstructuredGrid.GetData(info).ShallowCopy(grid)
        return 1


def mesh_at(sample, state: int, *, moving: bool) -> pv.PolyData:
    mesh = pv.PolyData.from_regular_faces(sample.points, sample.faces)
    if moving:
        mesh.points = sample.points + sample.displacement[state]
    else:
        mesh.point_data["displacement"] = sample.displacement[state]
    mesh.field_data["TimeValue"] = [float(sample.time[state])]
    return mesh


def assert_is_sample(run, sample, atol=0.0):
    np.testing.assert_array_equal(run.time, sample.time)
    np.testing.assert_allclose(run.mesh.position, sample.points, rtol=0, atol=atol)
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, rtol=0, atol=atol)
    np.testing.assert_allclose(run.displacement(2, 3), sample.displacement[2:], rtol=0, atol=atol)


@pytest.mark.parametrize("deform", [False, True])
@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_what_this_package_writes_is_read_back(tmp_path, only_run, sample, suffix, deform):
    strain = np.arange(3 * 120, dtype=np.float32).reshape(3, 120)
    alive = np.ones((3, 120), bool)
    alive[2, 11] = False
    write_paraview(
        tmp_path / f"run{suffix}", sample.points, sample.faces, sample.time, {"displacement": sample.displacement},
        {"plastic_strain": strain}, alive=alive, units={"displacement": "m"}, deform=deform,
    )  # fmt: skip
    run = only_run(tmp_path / f"run{suffix}")
    assert run.name == "run"
    assert_is_sample(run, sample, atol=1e-7 if deform else 0.0)  # deformed points are written in single precision
    np.testing.assert_array_equal(run.field("plastic_strain", 1, 3), strain[1:])
    np.testing.assert_array_equal(run.alive(0, 3), alive)
    assert set(run.fields) == {"plastic_strain"}
    assert run.units == "SI"
    assert run.problems == ()


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("suffix", [".vtp", ".vtu", ".vtk"])
def test_numbered_files_are_a_run(tmp_path, only_run, sample, suffix, moving):
    for state in range(3):
        mesh = mesh_at(sample, state, moving=moving)
        mesh = mesh if suffix == ".vtp" else mesh.cast_to_unstructured_grid()
        mesh.save(tmp_path / f"kart_{10 * state:04d}{suffix}")
    run = only_run(tmp_path)
    assert run.name == tmp_path.name
    assert_is_sample(run, sample, atol=1e-8 if moving else 0.0)
    assert_is_sample(only_run(tmp_path / f"kart_0010{suffix}"), sample, atol=1e-8 if moving else 0.0)


@pytest.mark.parametrize("binary", [True, False])
def test_legacy_files_equal_vtks_reader(tmp_path, sample, binary):
    file = tmp_path / "mesh.vtk"
    mesh = mesh_at(sample, 1, moving=False).cast_to_unstructured_grid()
    mesh.cell_data["thickness"] = np.linspace(1, 2, 120)
    mesh.save(file, binary=binary)
    ours, theirs = read_legacy(file), pv.read(file)
    np.testing.assert_array_equal(ours.points, theirs.points)
    np.testing.assert_array_equal(ours.connectivity, theirs.cell_connectivity)
    np.testing.assert_array_equal(ours.offsets, theirs.cell_offsets)
    np.testing.assert_array_equal(ours.types, theirs.celltypes)
    np.testing.assert_array_equal(ours.point_data["displacement"], theirs.point_data["displacement"])
    np.testing.assert_array_equal(ours.cell_data["thickness"], theirs.cell_data["thickness"])


OPENRADIOSS = """# vtk DataFile Version 3.0
vtk output
ASCII
DATASET UNSTRUCTURED_GRID
FIELD FieldData 2
TIME 1 1 double
{time}
CYCLE 1 1 int
0
POINTS 8 float
0 0 {z}
1 0 {z}
1 1 {z}
0 1 {z}
2 0 {z}
5 0 0
5 1 0
5 1 1

CELLS 4 18
2 0 4
4 0 1 2 3
4 1 4 2 2
4 5 6 7 7

CELL_TYPES 4
3
9
5
5

POINT_DATA 8
SCALARS NODE_ID int 1
LOOKUP_TABLE default
11
12
13
14
15
0
0
0

VECTORS Velocity float
0 0 {v}
0 0 {v}
0 0 {v}
0 0 {v}
0 0 {v}
0 0 0
0 0 0
0 0 0

CELL_DATA 4
SCALARS ELEMENT_ID int 1
LOOKUP_TABLE default
7
8
9
0

SCALARS PART_ID int 1
LOOKUP_TABLE default
3
2
2
2

SCALARS EROSION_STATUS int 1
LOOKUP_TABLE default
1
1
{status}
1

SCALARS 1DELEM_Force float 1
LOOKUP_TABLE default
4.5
0
0
0

SCALARS 2DELEM_Plastic_Strain float 1
LOOKUP_TABLE default
0
0.25
0.5
0

"""


@pytest.fixture
def converted(tmp_path) -> Path:
    """Two states as OpenRadioss's converter writes them: a beam, two shells, a rigid wall."""
    for state, (time, z, status) in enumerate([(0, 0, 1), (0.5, 0.125, 0)], 1):
        text = OPENRADIOSS.format(time=time, z=z, v=10 * z, status=status)
        (tmp_path / f"runA00{state}.vtk").write_text(text)
    return tmp_path


def test_files_made_from_openradioss_keep_what_the_solver_said(converted, only_run):
    run = only_run(converted)
    assert run.solver == "OpenRadioss"
    assert run.time.tolist() == [0, 0.5]
    assert [(p.id, p.rigid_wall) for p in run.mesh.parts] == [(2, False), (3, False), (0, True)]
    assert run.mesh.node_id.tolist() == [11, 12, 13, 14, 15, 0, 0, 0]
    assert run.mesh.face_nodes.tolist() == [[0, 1, 2, 3], [1, 4, 2, -1], [5, 6, 7, -1]]
    assert run.mesh.face_part.tolist() == [0, 0, 2]
    assert run.mesh.face_id.tolist() == [8, 9, 0]
    assert (run.mesh.cell_nodes.tolist(), run.mesh.cell_type.tolist()) == ([[0, 4]], [3])
    assert run.alive(0, 2).tolist() == [[True, True, True], [True, False, True]]
    np.testing.assert_array_equal(run.displacement(1, 2)[0, :5, 2], np.full(5, 0.125))
    np.testing.assert_array_equal(run.field("velocity", 1, 2)[0, :, 2], [1.25] * 5 + [0] * 3)
    np.testing.assert_array_equal(run.field("plastic_strain", 0, 1), [[0.25, 0.5, 0]])
    np.testing.assert_array_equal(run.field("beam_force", 0, 1), [[4.5]])


def test_an_ascii_file_cut_short_anywhere_is_refused(converted, only_run):
    file = converted / "runA002.vtk"
    whole = file.read_bytes()
    for length in range(0, len(whole.rstrip()) - 1, 3):
        file.write_bytes(whole[:length])
        with pytest.raises(ReadError, match=r"runA002\.vtk"):
            only_run(converted).displacement(0, 2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("POINTS 8 float", "POINTS 9 float", "no number of type float32"),
        ("POINTS 8 float", "POINTS -8 float", "'-8' stands where a number of values should"),
        ("CELLS 4 18", "CELLS 4 17", "4 cells take"),
        ("4 1 4 2 2", "4 1 9 2 2", "names node 9; expected 0 to 7"),
        ("SCALARS PART_ID", "SKALARS PART_ID", "the word 'SKALARS' is not known"),
        ("UNSTRUCTURED_GRID", "STRUCTURED_POINTS", "expected DATASET UNSTRUCTURED_GRID or POLYDATA"),
    ],
)
def test_a_damaged_ascii_file_is_refused_with_the_place(converted, only_run, old, new, message):
    file = converted / "runA002.vtk"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ReadError, match=message):
        only_run(converted).displacement(0, 2)


def test_a_missing_file_of_a_collection_is_a_problem(tmp_path, only_run, sample):
    write_paraview(
        tmp_path / "run.pvd", sample.points, sample.faces, sample.time, {"displacement": sample.displacement}
    )
    (tmp_path / "run_states/run_001.vtu").unlink()
    run = only_run(tmp_path / "run.pvd")
    assert run.problems == (f"{tmp_path / 'run.pvd'}: 1 of the files it lists are missing: run_001.vtu",)
    np.testing.assert_array_equal(run.displacement(0, 2), sample.displacement[[0, 2]])
    assert [run.file_of(state).name for state in (0, 1)] == ["run_000.vtu", "run_002.vtu"]


def test_a_missing_number_is_a_problem(tmp_path, only_run, sample):
    for state, number in enumerate((0, 1, 3)):
        mesh_at(sample, state, moving=True).save(tmp_path / f"s_{number}.vtp")
    assert "s_1.vtp is followed by s_3.vtp" in only_run(tmp_path).problems[0]


def test_a_file_series_lists_times(tmp_path, only_run, sample):
    listed = []
    for state in range(3):
        mesh = mesh_at(sample, state, moving=True)
        mesh.clear_field_data()
        mesh.save(tmp_path / f"s_{state}.vtp")
        listed.append({"name": f"s_{state}.vtp", "time": float(sample.time[state])})
    (tmp_path / "s.vtp.series").write_text(json.dumps({"file-series-version": "1.0", "files": listed}))
    assert_is_sample(only_run(tmp_path), sample, atol=1e-8)


def test_numbered_files_without_time_are_refused(tmp_path, only_run, sample):
    for state in range(2):
        mesh = mesh_at(sample, state, moving=True)
        mesh.clear_field_data()
        mesh.save(tmp_path / f"s_{state}.vtp")
    with pytest.raises(ReadError, match=r"s_0\.vtp: has no time in its field data .*\.pvd"):
        only_run(tmp_path)


def test_pieces_of_one_time_are_one_mesh(tmp_path, only_run, sample):
    root = ElementTree.Element("VTKFile", type="Collection")
    listed = ElementTree.SubElement(root, "Collection")
    for state in range(2):
        for part, faces in enumerate(np.split(sample.faces, 2)):
            mesh = mesh_at(sample, state, moving=False)
            mesh.faces = np.insert(faces, 0, 3, axis=1).ravel()
            name = f"s{state}_{part}.vtp"
            mesh.save(tmp_path / name)
            entry = {"timestep": str(sample.time[state]), "part": str(part), "file": name}
            ElementTree.SubElement(listed, "DataSet", entry)
    ElementTree.ElementTree(root).write(tmp_path / "run.pvd")
    run = only_run(tmp_path / "run.pvd")
    assert run.displacement(0, 2).shape == (2, 2 * 162, 3)
    assert len(run.mesh.parts) == 2
    np.testing.assert_array_equal(run.mesh.face_nodes[60:], sample.faces[60:] + 162)


def test_a_mesh_that_changes_is_refused(tmp_path, only_run, sample):
    for state in range(2):
        mesh = mesh_at(sample, state, moving=True)
        if state:
            mesh.faces = np.insert(sample.faces[1:], 0, 3, axis=1).ravel()
        mesh.save(tmp_path / f"s_{state}.vtp")
    with pytest.raises(
        ReadError, match=r"s_1\.vtp, state 1: holds 162 points and 119 cells, the first state 162 and 120"
    ):
        only_run(tmp_path)


def test_neither_moving_points_nor_displacements_is_refused(tmp_path, only_run, sample):
    for state in range(2):
        mesh = mesh_at(sample, 0, moving=True)
        mesh.field_data["TimeValue"] = [float(state)]
        mesh.point_data["temperature"] = np.zeros(162)
        mesh.save(tmp_path / f"s_{state}.vtp")
    with pytest.raises(ReadError, match=r"no point array called displacement .*; found temperature"):
        only_run(tmp_path)


def test_a_displacement_array_that_holds_positions_is_read_as_positions(tmp_path, only_run, sample):
    positions = sample.points + sample.displacement
    write_paraview(tmp_path / "run.pvd", sample.points, sample.faces, sample.time, {"displacement": positions})
    np.testing.assert_allclose(only_run(tmp_path / "run.pvd").displacement(0, 3), sample.displacement, atol=1e-7)


def test_points_and_displacements_that_disagree_are_a_problem(tmp_path, only_run, sample):
    for state in range(3):
        mesh = mesh_at(sample, state, moving=True)
        mesh.point_data["displacement"] = 2 * sample.displacement[state]
        mesh.save(tmp_path / f"s_{state}.vtp")
    assert "moved otherwise than the array 'displacement' says" in only_run(tmp_path).problems[0]


def test_one_wrong_bit_in_a_block_size_kills_vtk_but_not_us(tmp_path, sample):
    """Such a bit makes VTK ask for memory without end, or divide by zero; both end the process it runs in."""
    file = tmp_path / "state.vtu"
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(mesh_at(sample, 1, moving=False).cast_to_unstructured_grid())
    writer.SetFileName(str(file))
    writer.SetHeaderTypeToUInt64()
    writer.EncodeAppendedDataOff()
    writer.Write()
    good = file.read_bytes()
    start = good.index(b"_", good.index(b"<AppendedData")) + 1
    refused = 0
    for byte in (5, 6, 7, 13, 14):
        damaged = bytearray(good)
        damaged[start + byte] ^= 0x10
        file.write_bytes(damaged)
        try:
            read_xml(file)
        except ReadError:
            refused += 1
    assert refused >= 3
    file.write_bytes(good)
    assert len(read_xml(file).points) == 162


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_truncated_state_is_refused(tmp_path, only_run, sample, share):
    write_paraview(
        tmp_path / "run.pvd", sample.points, sample.faces, sample.time, {"displacement": sample.displacement}
    )
    file = tmp_path / "run_states/run_001.vtu"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(ReadError, match=r"run_001\.vtu"):
        only_run(tmp_path / "run.pvd").displacement(0, 3)


def test_the_child_process_ends_with_its_parent(tmp_path, sample):
    mesh_at(sample, 0, moving=False).save(tmp_path / "state.vtp")
    code = (
        "import sys; from pathlib import Path; from crashkit.readers import _vtk_process as v\n"
        "v.read_xml(Path(sys.argv[1])); print(v._child()._process.pid)"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path / "state.vtp")], capture_output=True, text=True)
    assert not Path(f"/proc/{int(ran.stdout)}").exists()


# VTKHDF


def test_vtkhdf_equals_what_vtks_writer_wrote(tmp_path, only_run, sample):
    """VTK's own writer repeats the mesh in every state; points move here."""
    file = tmp_path / "run.vtkhdf"
    source = _Transient(sample)
    writer = vtkHDFWriter()
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetFileName(str(file))
    writer.SetWriteAllTimeSteps(True)
    writer.Write()
    run = only_run(file)
    np.testing.assert_allclose(run.time, sample.time, rtol=1e-6)
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, atol=1e-7)
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)


def test_pieces_that_count_on_over_cells_that_are_stored_once(tmp_path, only_run, sample):
    """Points of every state, counted as pieces, and one list of cells."""
    file = tmp_path / "run.vtkhdf"
    write_paraview(file, sample.points, sample.faces, sample.time, {"displacement": sample.displacement}, deform=True)
    with h5py.File(file, "a") as opened:
        root = opened["VTKHDF"]
        del root["NumberOfPoints"]
        root["NumberOfPoints"] = [162] * 3
        root["Steps/PartOffsets"][:] = [0, 1, 2]
    run = only_run(file)
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, atol=1e-7)
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)


def test_the_parts_of_a_collection_become_parts(tmp_path, only_run, sample):
    halves = np.split(sample.faces, 2)
    names = ("bumper_beam_1", "RWALL_1")
    for name, faces in zip(names, halves, strict=True):
        strain = np.full((3, 60), 0.5, np.float32) if name == "bumper_beam_1" else None
        write_paraview(
            tmp_path / f"{name}.vtkhdf", sample.points, faces, sample.time, {"displacement": sample.displacement},
            {} if strain is None else {"Plastic Strain_2D": strain}, deform=True,
        )  # fmt: skip
    path = tmp_path / "sim" / "sim.vtkhdf"
    path.parent.mkdir()
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs.create("Type", "PartitionedDataSetCollection", dtype=h5py.string_dtype("ascii", 28))
        for name in names:
            with h5py.File(tmp_path / f"{name}.vtkhdf") as part:
                file.copy(part["VTKHDF"], root, name)
    run = only_run(path)
    assert [(p.name, p.rigid_wall) for p in run.mesh.parts] == [("bumper_beam_1", False), ("RWALL_1", True)]
    np.testing.assert_array_equal(run.mesh.face_nodes[60:], halves[1] + 162)
    np.testing.assert_allclose(run.displacement(0, 3)[:, 162:], sample.displacement, atol=1e-7)
    strain = run.field("plastic_strain", 0, 3)
    assert (strain[:, :60] == 0.5).all()
    assert np.isnan(strain[:, 60:]).all()


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_a_truncated_vtkhdf_is_refused(tmp_path, sample, share):
    file = tmp_path / "run.vtkhdf"
    write_paraview(file, sample.points, sample.faces, sample.time, {"displacement": sample.displacement})
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(ReadError, match=r"run\.vtkhdf"):
        list(reader_for(file, "vtkhdf").runs(file))


def test_an_offset_behind_the_end_is_refused(tmp_path, only_run, sample):
    file = tmp_path / "run.vtkhdf"
    write_paraview(file, sample.points, sample.faces, sample.time, {"displacement": sample.displacement})
    with h5py.File(file, "a") as opened:
        opened["VTKHDF/Steps/PointDataOffsets/displacement"][2] = 10**9
    with pytest.raises(
        ReadError, match="rows 1000000000 to 1000000162 of /VTKHDF/PointData/displacement are asked for"
    ):
        only_run(file).displacement(0, 3)
