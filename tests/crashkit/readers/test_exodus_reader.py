"""Exodus files of both kinds: equal to VTK's reader, cut-off files refused instead of read as zeros."""

from __future__ import annotations

from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOExodus import vtkExodusIIReader

from crashkit.errors import ReadError
from crashkit.readers import reader_for

KINDS = {"classic": "NETCDF3_64BIT_OFFSET", "hdf5": "NETCDF4"}


def write_exodus(path: Path, sample, kind: str) -> Path:
    """The sample in two blocks, with displacements, plastic strain in the first block and the status of elements."""
    blocks = np.split(sample.faces + 1, [100])
    with netCDF4.Dataset(path, "w", format=KINDS[kind]) as file:
        file.api_version, file.version, file.floating_point_word_size = np.float32(8), np.float32(8), np.int32(8)
        file.title, file.file_size = "kart", np.int32(1)  # 1: coordinates and variables stand one by one
        sizes = {"time_step": None, "num_dim": 3, "num_nodes": 162, "num_elem": 120, "num_el_blk": 2, "len_string": 33}
        sizes |= {"len_name": 33, "four": 4, "len_line": 81, "num_nod_var": 3, "num_elem_var": 2}
        for name, size in sizes.items():
            file.createDimension(name, size)
        file.createVariable("time_whole", "f8", ("time_step",))[:] = sample.time
        file.createVariable("eb_prop1", "i4", ("num_el_blk",))[:] = [10, 20]
        file["eb_prop1"].setncattr("name", "ID")
        file.createVariable("eb_status", "i4", ("num_el_blk",))[:] = 1
        file.createVariable("elem_num_map", "i4", ("num_elem",))[:] = np.arange(1001, 1121)
        for k, axis in enumerate("xyz"):
            file.createVariable(f"coord{axis}", "f8", ("num_nodes",))[:] = sample.points[:, k]
        for variable, names in {
            "eb_names": ["frame", "RWALL_1"],
            "name_nod_var": ["DISPLX", "DISPLY", "DISPLZ"],
            "name_elem_var": ["EQPS", "STATUS"],
        }.items():
            size = {"eb_names": "num_el_blk", "name_nod_var": "num_nod_var", "name_elem_var": "num_elem_var"}[variable]
            rows = np.array([[c.encode() for c in name.ljust(33, "\0")] for name in names], "S1")
            file.createVariable(variable, "S1", (size, "len_name"))[:] = rows
        for k, faces in enumerate(blocks, 1):
            file.createDimension(f"num_el_in_blk{k}", len(faces))
            file.createDimension(f"num_nod_per_el{k}", 3)
            joined = file.createVariable(f"connect{k}", "i4", (f"num_el_in_blk{k}", f"num_nod_per_el{k}"))
            joined.elem_type = "TRI3"
            joined[:] = faces
        for k in range(3):
            values = file.createVariable(f"vals_nod_var{k + 1}", "f8", ("time_step", "num_nodes"))
            values[:] = sample.displacement[:, :, k]
        strain = file.createVariable("vals_elem_var1eb1", "f8", ("time_step", "num_el_in_blk1"))
        strain[:] = np.arange(300).reshape(3, 100)
        for k, size in ((1, 100), (2, 20)):
            status = np.ones((3, size))
            status[2, 0] = k == 2
            file.createVariable(f"vals_elem_var2eb{k}", "f8", ("time_step", f"num_el_in_blk{k}"))[:] = status
    return path


@pytest.fixture(params=sorted(KINDS))
def written(request, tmp_path, sample) -> Path:
    return write_exodus(tmp_path / "run.exo", sample, request.param)


def read_everything(path: Path) -> None:
    run = next(reader_for(path, "exodus").runs(path))
    run.displacement(0, 3)
    run.field("plastic_strain", 0, 3)
    run.alive(0, 3)


def test_what_was_written_is_read(written, only_run, sample):
    run = only_run(written)
    np.testing.assert_array_equal(run.time, sample.time)
    np.testing.assert_array_equal(run.mesh.position, sample.points)
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)
    np.testing.assert_array_equal(run.displacement(1, 3), sample.displacement[1:])
    assert run.mesh.face_id.tolist() == list(range(1001, 1121))
    assert [(p.id, p.name, p.rigid_wall) for p in run.mesh.parts] == [(10, "frame", False), (20, "RWALL_1", True)]
    assert run.mesh.face_part.tolist() == [0] * 100 + [1] * 20


def test_a_field_is_missing_where_its_block_does_not_have_it(written, only_run):
    strain = only_run(written).field("plastic_strain", 0, 3)
    np.testing.assert_array_equal(strain[:, :100], np.arange(300).reshape(3, 100))
    assert np.isnan(strain[:, 100:]).all()


def test_the_status_tells_which_elements_live(written, only_run):
    assert np.argwhere(~only_run(written).alive(0, 3)).tolist() == [[2, 0]]


def test_it_equals_vtks_reader(written, only_run):
    reader = vtkExodusIIReader()
    reader.SetFileName(str(written))
    reader.UpdateInformation()
    reader.SetAllArrayStatus(vtkExodusIIReader.NODAL, 1)
    reader.SetApplyDisplacements(0)
    reader.SetSqueezePoints(0)
    run = only_run(written)
    for state in range(3):
        reader.SetTimeStep(state)
        reader.Update()
        blocks = reader.GetOutput().GetBlock(0)
        mesh = blocks.GetBlock(0)
        np.testing.assert_array_equal(vtk_to_numpy(mesh.GetPoints().GetData()), run.mesh.position)
        theirs = vtk_to_numpy(mesh.GetPointData().GetArray("DISPL"))
        np.testing.assert_allclose(run.displacement(state, state + 1)[0], theirs, rtol=1e-6)


def test_a_file_cut_short_is_refused(written):
    whole = written.read_bytes()
    for share in np.linspace(0.01, 0.99, 25):
        written.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ReadError, match=r"run\.exo"):
            read_everything(written)


def test_states_behind_the_announced_ones_are_a_problem(tmp_path, sample, only_run):
    file = write_exodus(tmp_path / "run.exo", sample, "classic")
    content = bytearray(file.read_bytes())
    content[7] = 2  # the number of states of a classic file
    file.write_bytes(content)
    run = only_run(file)
    assert len(run.time) == 2
    assert "bytes behind its last variable" in run.problems[0]


def test_elements_that_are_not_known_are_named(written):
    with netCDF4.Dataset(written, "a") as file:
        file["connect2"].elem_type = "NSIDED"
    with pytest.raises(ReadError, match="block 20 holds elements 'NSIDED'"):
        next(reader_for(written).runs(written))


def test_a_file_without_displacements_is_refused(written):
    with netCDF4.Dataset(written, "a") as file:
        file["name_nod_var"][:] = np.array([[c.encode() for c in f"TEMP_{k}".ljust(33, "\0")] for k in range(3)], "S1")
    with pytest.raises(ReadError, match="no point array called displacement"):
        next(reader_for(written).runs(written))


def mesh_alone(path: Path, sample) -> Path:
    """A mesh without states, as mesh generators write it beside the results."""
    write_exodus(path, sample, "classic")
    with netCDF4.Dataset(path) as file, netCDF4.Dataset(path.with_suffix(".new"), "w", format="NETCDF3_CLASSIC") as out:
        for name, size in file.dimensions.items():
            out.createDimension(name, None if name == "time_step" else len(size))
        for name, variable in file.variables.items():
            if not name.startswith(("vals", "name_", "time")):
                copy = out.createVariable(name, variable.dtype, variable.dimensions)
                copy.setncatts(variable.__dict__)
                copy[:] = variable[:]
    return path.with_suffix(".new").rename(path)


def test_a_mesh_beside_results_is_left_aside(tmp_path, sample):
    write_exodus(tmp_path / "kart.e", sample, "classic")
    mesh_alone(tmp_path / "kart.g", sample)
    runs = reader_for(tmp_path).runs(tmp_path)
    assert runs.names == ("kart",)
    assert "kart.g is left aside, it is a mesh without states" in runs.passed_over[0]
    np.testing.assert_array_equal(next(runs).displacement(0, 3), sample.displacement)


def test_two_results_of_one_stem_are_two_runs(tmp_path, sample):
    for name in ("kart.e", "kart.exo", "kart.v2.e"):
        write_exodus(tmp_path / name, sample, "hdf5")
    assert reader_for(tmp_path).runs(tmp_path).names == ("kart.e", "kart.exo", "kart.v2")


def test_a_mesh_that_was_refined_is_refused_with_both_names(tmp_path, sample):
    for name in ("out.e", "out.e-s002"):
        write_exodus(tmp_path / name, sample, "classic")
    for path in (tmp_path, tmp_path / "out.e"):
        with pytest.raises(ReadError, match=r"out\.e: goes on in out\.e-s002, so the mesh changes"):
            list(reader_for(path).runs(path))


def write_pieces(folder: Path, sample, *, maps: bool = True) -> list[Path]:
    """The sample as two processors write it: faces 0 to 79 and 80 to 119, nodes on the border in both."""
    files = []
    for k, rows in enumerate((slice(0, 80), slice(80, 120))):
        nodes = np.unique(sample.faces[rows])
        files.append(folder / f"out.e.2.{k}")
        with netCDF4.Dataset(files[-1], "w", format="NETCDF3_64BIT_OFFSET") as file:
            sizes = {"time_step": None, "num_nodes": len(nodes), "num_el_blk": 1, "len_name": 33, "num_nod_var": 3}
            sizes |= {"num_el_in_blk1": 120 - 80 if k else 80, "num_nod_per_el1": 3, "num_elem": 40 if k else 80}
            for name, size in sizes.items():
                file.createDimension(name, size)
            file.createVariable("time_whole", "f8", ("time_step",))[:] = sample.time
            file.createVariable("eb_prop1", "i4", ("num_el_blk",))[:] = [10]
            if maps:
                file.createVariable("node_num_map", "i4", ("num_nodes",))[:] = nodes + 1
                file.createVariable("elem_num_map", "i4", ("num_elem",))[:] = np.arange(120)[rows] + 1
            for axis, name in enumerate("xyz"):
                file.createVariable(f"coord{name}", "f8", ("num_nodes",))[:] = sample.points[nodes, axis]
                values = file.createVariable(f"vals_nod_var{axis + 1}", "f8", ("time_step", "num_nodes"))
                values[:] = sample.displacement[:, nodes, axis]
            titles = np.array([[c.encode() for c in f"disp_{n}".ljust(33, "\0")] for n in "xyz"], "S1")
            file.createVariable("name_nod_var", "S1", ("num_nod_var", "len_name"))[:] = titles
            joined = file.createVariable("connect1", "i4", ("num_el_in_blk1", "num_nod_per_el1"))
            joined.elem_type = "TRI3"
            joined[:] = np.searchsorted(nodes, sample.faces[rows]) + 1
    return files


def test_pieces_of_processors_are_joined_by_their_maps(tmp_path, sample):
    files = write_pieces(tmp_path, sample)
    for path in (tmp_path, files[1]):
        (run,) = reader_for(path).runs(path)
        assert run.name == "out"
        np.testing.assert_array_equal(run.mesh.position, sample.points)
        np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)
        np.testing.assert_array_equal(run.displacement(0, 3), sample.displacement)
        assert set(run.files) == set(files)


def test_a_missing_piece_or_map_names_epu(tmp_path, sample):
    files = write_pieces(tmp_path, sample)
    files[0].unlink()
    with pytest.raises(ReadError, match="of its 2 pieces number 0 is missing; join the whole run with epu"):
        list(reader_for(tmp_path).runs(tmp_path))
    write_pieces(tmp_path, sample, maps=False)
    with pytest.raises(ReadError, match=r"has no node_num_map or elem_num_map; join the pieces with epu"):
        list(reader_for(tmp_path).runs(tmp_path))


def test_pieces_beside_the_joined_run_are_left_aside(tmp_path, sample):
    write_pieces(tmp_path, sample)
    write_exodus(tmp_path / "out.e", sample, "classic")
    runs = reader_for(tmp_path).runs(tmp_path)
    assert runs.names == ("out",)
    assert "the pieces out.e.2.* are left aside, since out.e is there" in runs.passed_over[0]


def test_zeros_behind_a_classic_file_are_no_damage(tmp_path, sample, only_run):
    path = write_exodus(tmp_path / "run.e", sample, "classic")
    path.write_bytes(path.read_bytes() + bytes(512))
    assert only_run(path).problems == ()
    path.write_bytes(path.read_bytes() + b"\1" * 8)
    assert "bytes behind its last variable" in only_run(path).problems[0]


@pytest.mark.parametrize("change", ["no displacement", "no times"])
def test_a_file_that_is_refused_is_closed_again(tmp_path, sample, change):
    path = write_exodus(tmp_path / "kart.e", sample, "hdf5")
    with netCDF4.Dataset(path, "a") as file:
        if change == "no times":
            file.renameVariable("time_whole", "other")
        else:
            file["name_nod_var"][:] = np.array(
                [[c.encode() for c in f"TEMP_{k}".ljust(33, "\0")] for k in range(3)], "S1"
            )
    before = h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE)
    with pytest.raises(ReadError) as caught:
        next(reader_for(path).runs(path))
    assert h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE) == before, caught.value
