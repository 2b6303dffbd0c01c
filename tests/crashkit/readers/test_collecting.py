"""Files become runs: none takes another's place, what is no run is said, and only regular files are looked at."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from crashkit.errors import ReadError
from crashkit.readers import passed_over, reader_for, readers
from crashkit.readers._folders import Collected, named, runs_in


def plate(move: float) -> pv.UnstructuredGrid:
    """Two triangles; the displacement along x tells whose file it is."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    grid = pv.PolyData.from_regular_faces(points, np.array([[0, 1, 2], [0, 2, 3]])).cast_to_unstructured_grid()
    grid.point_data["displacement"] = np.tile([move, 0.0, 0.0], (4, 1))
    return grid


def states(folder: Path, move: float, stem: str = "out", count: int = 3, **time: bool) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for k in range(count):
        grid = plate(move * k)
        if time.get("time"):
            grid.field_data["TimeValue"] = [0.1 * k]
        files.append(folder / f"{stem}_{k}.vtu")
        grid.save(files[-1])
    return files


def pvd(path: Path, entries: list[tuple[float | str, str, str]]) -> Path:
    rows = "".join(f'<DataSet timestep="{t}" {part} file="{file}"/>' for t, part, file in entries)
    path.write_text(f'<?xml version="1.0"?><VTKFile type="Collection"><Collection>{rows}</Collection></VTKFile>')
    return path


def listed(folder: Path, name: str, move: float) -> Path:
    """A PVD with its states in a folder beside it."""
    files = states(folder / f"data of {name}", move)
    return pvd(
        folder / f"{name}.pvd", [(0.1 * k, 'part="0"', f"{f.parent.name}/{f.name}") for k, f in enumerate(files)]
    )


def last_moves(path: Path) -> dict[str, float]:
    """Run -> largest displacement at the end, through the reader that knows the path."""
    return {run.name: float(run.displacement(2, 3).max()) for run in reader_for(path).runs(path)}


def test_names_with_points_are_kept_whole(tmp_path):
    for k, name in enumerate(("v10.0_t1.2", "v10.5_t1.2", "v11.0_t1.2"), 1):
        listed(tmp_path, name, k)
    assert last_moves(tmp_path) == {"v10.0_t1.2": 2, "v10.5_t1.2": 4, "v11.0_t1.2": 6}


def test_a_list_above_does_not_hide_runs_in_folders(tmp_path):
    listed(tmp_path, "summary", 1)
    listed(tmp_path / "run_1", "out", 2)
    states(tmp_path / "run_2", 3, time=True)
    assert last_moves(tmp_path) == {"summary": 2, "run_1": 4, "run_2": 6}


def test_numbered_files_beside_a_list_are_a_run_unless_it_names_them(tmp_path):
    listed(tmp_path, "one", 1)
    states(tmp_path, 2, "two", time=True)
    own = states(tmp_path, 3, "three")
    pvd(tmp_path / "three.pvd", [(0.1 * k, "", f.name) for k, f in enumerate(own)])
    assert last_moves(tmp_path) == {"one": 2, "two": 4, "three": 6}


def test_two_families_of_one_stem_have_names_of_their_own(tmp_path):
    states(tmp_path, 1, "run", time=True)
    for file in states(tmp_path / "x", 2, "run", time=True):
        pv.read(file).extract_surface(algorithm="dataset_surface").save(tmp_path / f"{file.stem}.vtp")
        file.unlink()
    assert last_moves(tmp_path) == {"run_.vtu": 2, "run_.vtp": 4}


def test_one_number_twice_is_refused_with_both_names(tmp_path):
    states(tmp_path, 1, time=True)
    plate(1).save(tmp_path / "out_01.vtu")
    with pytest.raises(ReadError, match=r"out_01.vtu and out_1.vtu have the same number"):
        reader_for(tmp_path).runs(tmp_path)


@pytest.mark.parametrize("part", ['part="0"', ""])
@pytest.mark.parametrize("first", [0, 2])
def test_states_listed_twice_are_one_state_and_said(tmp_path, part, first):
    """A solver started again appends to its list; the later files, here with other displacements, count."""
    old, new = states(tmp_path / "a", 1), states(tmp_path / "b", 5)
    entries = [(0.1 * k, part, f"a/{f.name}") for k, f in enumerate(old)]
    entries += [(0.1 * k, part, f"b/{f.name}") for k, f in enumerate(new) if k >= first]
    if not part and first == 0:  # nothing says that these are no pieces, but the mesh is the same twice
        path = pvd(tmp_path / "run.pvd", entries)
        with pytest.raises(ReadError, match="names the same mesh 2 times at one time"):
            list(reader_for(path).runs(path))
        return
    path = pvd(tmp_path / "run.pvd", entries)
    (run,) = reader_for(path).runs(path)
    assert len(run.mesh.position) == 4
    assert run.time.tolist() == [0.0, 0.1, 0.2]
    assert float(run.displacement(2, 3).max()) == 10
    assert f"{3 - first} state" in run.notes[0]
    assert "listed more than once" in run.notes[0]


def test_times_of_a_list_may_have_a_decimal_comma(tmp_path):
    files = states(tmp_path, 1)
    path = pvd(tmp_path / "run.pvd", [(f"0,{k}", "", f.name) for k, f in enumerate(files)])
    (run,) = reader_for(path).runs(path)
    assert run.time.tolist() == [0.0, 0.1, 0.2]


def test_the_same_file_listed_twice_is_one_state(tmp_path):
    files = states(tmp_path, 1)
    entries = [(0.1 * k, "", f.name) for k, f in enumerate(files)]
    path = pvd(tmp_path / "run.pvd", entries + entries)
    (run,) = reader_for(path).runs(path)
    assert len(run.mesh.position) == 4
    assert "3 states are listed more than once, from time 0 on" in run.notes[0]


def test_a_file_series_listed_twice_is_one_state_a_time(tmp_path):
    files = [{"name": f.name, "time": 0.1 * k} for k, f in enumerate(states(tmp_path, 1))]
    path = tmp_path / "run.vtu.series"
    path.write_text(json.dumps({"file-series-version": "1.0", "files": files + files[1:]}))
    (run,) = reader_for(path).runs(path)
    assert (run.name, len(run.time)) == ("run", 3)
    assert "2 states are listed more than once" in run.notes[0]


def test_times_come_from_the_option_where_files_hold_none(tmp_path):
    states(tmp_path, 1)
    (run,) = reader_for(tmp_path).runs(tmp_path, time_step=0.002)
    assert run.time.tolist() == [0.0, 0.002, 0.004]
    with pytest.raises(ReadError, match="give the time between two states"):
        list(reader_for(tmp_path).runs(tmp_path))


def test_own_times_go_before_the_option_and_it_is_said(tmp_path):
    states(tmp_path, 1, time=True)
    (run,) = reader_for(tmp_path).runs(tmp_path, time_step=0.002)
    np.testing.assert_allclose(run.time, [0.0, 0.1, 0.2])
    assert "--time-step is not used" in run.notes[0]


def pieces(folder: Path, state: int, *, ids: bool, ghosts: bool = False) -> str:
    """The plate in two pieces, one triangle each, as two processors write it; returns the name of the PVTU."""
    whole = plate(float(state))
    arrays = '<PDataArray type="Float64" Name="displacement" NumberOfComponents="3"/>'
    for k, nodes in enumerate(([0, 1, 2], [0, 2, 3])):
        piece = pv.PolyData.from_regular_faces(whole.points[nodes], np.array([[0, 1, 2]])).cast_to_unstructured_grid()
        piece.point_data["displacement"] = whole.point_data["displacement"][nodes] * np.array(nodes)[:, None]
        if ids:
            piece.point_data["GlobalNodeIds"] = np.array(nodes) + 11
        if ghosts:
            piece.cell_data["vtkGhostType"] = np.array([k], np.uint8)
        piece.save(folder / f"s{state}_{k}.vtu")
    listed = "".join(f'<Piece Source="s{state}_{k}.vtu"/>' for k in range(2))
    points = '<PPoints><PDataArray type="Float32" NumberOfComponents="3"/></PPoints>'
    (folder / f"s{state}.pvtu").write_text(
        f'<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid GhostLevel="0"><PPointData>{arrays}</PPointData>'
        f"{points}{listed}</PUnstructuredGrid></VTKFile>"
    )
    return f"s{state}.pvtu"


def test_pieces_of_a_parallel_file_are_joined_by_global_ids(tmp_path):
    pvd(tmp_path / "run.pvd", [(0.1 * k, 'part="0"', pieces(tmp_path, k, ids=True)) for k in range(3)])
    (run,) = reader_for(tmp_path).runs(tmp_path)
    assert run.mesh.node_id.tolist() == [11, 12, 13, 14]
    assert run.mesh.face_nodes.tolist() == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_array_equal(run.displacement(2, 3)[0, :, 0], [0, 2, 4, 6])
    assert len(run.mesh.parts) == 1, "processors are no parts"
    assert len(run.files) == 1 + 3 + 6


def test_numbered_parallel_files_are_a_run_and_their_pieces_none(tmp_path):
    for k in range(3):
        pieces(tmp_path, k, ids=True)
    (run,) = reader_for(tmp_path).runs(tmp_path, time_step=0.1)
    assert (len(run.time), len(run.mesh.position)) == (3, 4)


def test_cells_that_another_piece_has_as_well_are_there_once(tmp_path):
    pvd(tmp_path / "run.pvd", [(0.1 * k, "", pieces(tmp_path, k, ids=True, ghosts=True)) for k in range(2)])
    (run,) = reader_for(tmp_path).runs(tmp_path)
    assert run.mesh.face_nodes.tolist() == [[0, 1, 2]]


def test_pieces_without_global_ids_are_refused_by_the_formats_name(tmp_path):
    pvd(tmp_path / "run.pvd", [(0.1 * k, "", pieces(tmp_path, k, ids=False)) for k in range(3)])
    with pytest.raises(ReadError, match=r"s0.pvtu: its 2 pieces \(PVTU\) have no global node numbers"):
        list(reader_for(tmp_path).runs(tmp_path))


def test_blocks_of_a_vtm_become_parts(tmp_path):
    for k in range(2):
        for shift, name in enumerate(("rail", "beam")):
            grid = plate(k * (shift + 1))
            grid.points[:, 2] += shift
            grid.save(tmp_path / f"{name}{k}.vtu")
        blocks = "".join(f'<DataSet index="{i}" name="{n}" file="{n}{k}.vtu"/>' for i, n in enumerate(("rail", "beam")))
        (tmp_path / f"s{k}.vtm").write_text(
            f'<VTKFile type="vtkMultiBlockDataSet"><vtkMultiBlockDataSet>{blocks}</vtkMultiBlockDataSet></VTKFile>'
        )
    pvd(tmp_path / "run.pvd", [(0.1 * k, "", f"s{k}.vtm") for k in range(2)])
    (run,) = reader_for(tmp_path).runs(tmp_path)
    assert [p.name for p in run.mesh.parts] == ["rail", "beam"]
    assert run.displacement(1, 2)[0, :, 0].tolist() == [1] * 4 + [2] * 4


@pytest.mark.parametrize("titles", [("UX", "UY", "UZ"), ("disp_x", "disp_y", "disp_z"), ("U1", "U2", "U3"),
                                    ("displacement:0", "displacement:1", "displacement:2")])  # fmt: skip
def test_a_displacement_in_three_scalars_is_joined(tmp_path, titles):
    for k in range(3):
        grid = plate(0)
        grid.point_data.clear()
        for axis, title in enumerate(titles):
            grid.point_data[title] = np.full(4, k * (axis + 1.0))
        grid.field_data["TimeValue"] = [0.1 * k]
        grid.save(tmp_path / f"s_{k}.vtu")
    (run,) = reader_for(tmp_path).runs(tmp_path)
    assert run.displacement(2, 3)[0, 0].tolist() == [2, 4, 6]
    assert not run.fields


def test_one_state_of_moved_points_is_refused(tmp_path):
    grid = plate(0)
    grid.point_data.clear()
    grid.save(tmp_path / "s.vtu")
    pvd(tmp_path / "run.pvd", [(0.03, "", "s.vtu")])
    with pytest.raises(ReadError, match="is the only state of the run and has no point array called displacement"):
        list(reader_for(tmp_path).runs(tmp_path))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize(
    "name", ["x.pvd", "x.e", "x.xdmf", "x.vtkhdf", "d3plot", "kartA001", "x_1.vtu", "x.vtp", "k_0000.rad"]
)
def test_a_pipe_in_the_folder_is_not_opened(tmp_path, name):
    os.mkfifo(tmp_path / name)
    for reader in readers().values():
        assert not reader.sniff(tmp_path)
        assert not reader.sniff(tmp_path / name)
    with pytest.raises(ReadError, match="the content is none of the known formats"):
        reader_for(tmp_path)


def test_the_helper_never_loses_a_family():
    assert named([("a", "a.e", 1), ("b", "b.e", 2)]) == {"a": 1, "b": 2}
    assert named([("a", "a.e", 1), ("a", "a.exo", 2)]) == {"a.e": 1, "a.exo": 2}
    with pytest.raises(ReadError, match="x and x would both be run 'x'"):
        named([("x", "x", 1), ("x", "x", 2)])


def test_runs_of_one_name_in_two_places_are_refused(tmp_path):
    (tmp_path / "a").mkdir()
    found = {tmp_path: {"a/x": 1, "y": 2}, tmp_path / "a": {"x": 3, "z": 4}}
    with pytest.raises(ReadError, match=r"another run of .* is called 'a/x' as well"):
        runs_in(tmp_path, lambda folder: Collected(found[folder]))


def test_what_another_reader_would_find_is_said(tmp_path, data):
    folder = data("radioss/run_b")
    listed(folder, "out", 1)
    (told,) = passed_over(folder, reader_for(folder))
    other = {"openradioss": "vtk-series", "vtk-series": "openradioss"}[reader_for(folder).name]
    assert f"what it also holds for {other} (" in told
    assert f"--reader {other}" in told


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("d3plot.fz", b"packed", "FEMZIP"),
        ("s.pvtu", b'<VTKFile type="PUnstructuredGrid"/>', "is a PVTU file, one state without time"),
        ("s.vtm", b'<VTKFile type="vtkMultiBlockDataSet"/>', "is a VTM file of several blocks"),
        ("s.vtu", b'<VTKFile type="UnstructuredGrid"/>', "is a VTK file with one state without time"),
        ("s.vti", b'<VTKFile type="ImageData"/>', "is a VTK file of type ImageData"),
        ("s.nc", b"CDF\x01" + bytes(60), "is a classic NetCDF file and no Exodus file"),
        ("s.odb", b"?", "is an Abaqus output database"),
        ("runs.zip", b"PK\x03\x04" + bytes(30), "is packed with ZIP; unpack it first"),
        ("d3plot.gz", b"\x1f\x8b\x08" + bytes(30), "is packed with gzip; unpack it first"),
        ("runs.tar", bytes(257) + b"ustar", "is packed with tar; unpack it first"),
        ("main.k", b"*KEYWORD", "is an LS-DYNA deck"),
    ],
)  # fmt: skip
def test_known_formats_that_are_not_read_are_called_by_their_names(tmp_path, name, content, told):
    (tmp_path / name).write_bytes(content)
    for path in (tmp_path / name, tmp_path):
        with pytest.raises(ReadError, match=told) as caught:
            reader_for(path)
        assert "damaged" not in str(caught.value)
        assert "cut short" not in str(caught.value)


def test_checkpoints_of_dolfinx_are_called_by_their_name(tmp_path):
    import h5py

    with h5py.File(tmp_path / "u.h5", "w") as file:
        file["mesh/coordinates"], file["function/cell_dofs"] = np.zeros((2, 3)), np.zeros(4)
    with pytest.raises(ReadError, match="is a checkpoint of FEniCS or dolfinx"):
        reader_for(tmp_path)
    (tmp_path / "u.bp").mkdir()
    with pytest.raises(ReadError, match="is an ADIOS2 checkpoint"):
        reader_for(tmp_path / "u.bp")


def test_suffixes_in_capitals_are_the_same_suffixes(tmp_path):
    for file in states(tmp_path / "numbered", 1, time=True):
        file.rename(file.with_suffix(".VTU"))
    assert last_moves(tmp_path / "numbered") == {"numbered": 2}
    listed(tmp_path / "lists", "one", 3).rename(tmp_path / "lists" / "ONE.PVD")
    assert last_moves(tmp_path / "lists") == {"ONE": 6}


def test_a_link_to_a_folder_is_called_by_its_own_name(tmp_path):
    states(tmp_path / "run_1", 1, time=True)
    (tmp_path / "run_2").symlink_to(tmp_path / "run_1")
    assert last_moves(tmp_path) == {"run_1": 2, "run_2": 2}


def test_nodes_in_another_order_in_a_later_state_are_refused(tmp_path):
    for k, file in enumerate(states(tmp_path, 1, time=True)):
        grid = pv.read(file)
        grid.point_data["node_id"] = np.roll(np.arange(4), k == 2)
        grid.save(file)
    with pytest.raises(ReadError, match=r"out_2.vtu.*numbers its nodes otherwise than the first state \(node_id\)"):
        last_moves(tmp_path)


def test_of_two_arrays_the_one_called_displacement_is_read_and_the_other_named(tmp_path):
    for k, file in enumerate(states(tmp_path, 1, time=True)):
        grid = pv.read(file)
        moved = grid.point_data.pop("displacement")
        grid.point_data["U"] = 9.0 * k + 0 * moved
        grid.point_data["Displacement"] = moved
        grid.save(file)
    (run,) = reader_for(tmp_path).runs(tmp_path)
    assert float(run.displacement(2, 3).max()) == 2
    assert "displacements are read from the array 'Displacement', not from 'U'" in run.notes[0]


def test_states_listed_in_no_order_are_taken_by_their_times(tmp_path):
    files = states(tmp_path, 0.1)
    pvd(tmp_path / "out.pvd", [(0.1 * k, "", files[k].name) for k in (2, 0, 1)])
    run = next(iter(reader_for(tmp_path).runs(tmp_path)))
    assert run.time.tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert run.displacement(0, 3)[:, 0, 0].tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert "not listed in the order of their times" in " ".join(run.notes)


@pytest.mark.parametrize(("time", "told"), [("0 s", "the timestep '0 s' is no number"), ("", "--time-step")])
def test_times_that_are_none_are_not_called_damage(tmp_path, time, told):
    files = states(tmp_path, 0.1)
    pvd(tmp_path / "out.pvd", [(time, "", file.name) for file in files])
    with pytest.raises(ReadError, match=told):
        next(iter(reader_for(tmp_path).runs(tmp_path)))


def test_hidden_folders_and_files_are_left_aside_and_said(tmp_path):
    for folder in ("r1", ".snapshot", "__MACOSX"):
        files = states(tmp_path / folder, 0.1)
        pvd(tmp_path / folder / "out.pvd", [(0.1 * k, "", file.name) for k, file in enumerate(files)])
    (tmp_path / "r1" / "._out.pvd").write_bytes(b"\x00\x05\x16\x07")
    found = reader_for(tmp_path).runs(tmp_path)
    assert found.names == ("r1",)
    assert [text.split(" is ")[0].rsplit("/", 1)[1] for text in found.passed_over] == [".snapshot", "__MACOSX"]
