"""The hierarchy in a dataset on disk: complete or not there, and never one of another mesh."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from mesh_shapes import kart

from crashkit.dataset import open_dataset
from crashkit.errors import DataError, OutputError, ReadError
from crashkit.mesh import (
    build_hierarchy,
    level_displacement,
    open_hierarchy,
    store,
    summarize_hierarchy,
    write_hierarchy,
)
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.refine import refine
from crashkit.mesh.surface import surface


def campaign(runs: int = 3) -> xr.Dataset:
    """A small crash dataset on the kart: 3 runs, 4 states."""
    position, faces, displacement = kart()
    u = displacement[: runs * 4].reshape(runs, 4, -1, 3).copy()
    u[:, 0] = 0
    return xr.Dataset(
        {
            "displacement": (("sim", "time", "node", "xyz"), u, {"units": "m"}),
            "reference_position": (("node", "xyz"), position, {"units": "m"}),
            "node_id": ("node", np.arange(1, len(position) + 1)),
            "face_nodes": (("face", "corner"), faces),
            "face_part": ("face", np.zeros(len(faces), np.int32)),
            "part_id": ("part", [7]),
            "part_name": ("part", np.array(["frame"], "O")),
        },
        coords={"sim": [f"run_{k}" for k in range(runs)], "time": ("time", np.arange(4.0), {"units": "s"})},
        attrs={"checksum": "abc"},
    )


@pytest.fixture(scope="module")
def hierarchy() -> Hierarchy:
    position, faces, _ = kart()
    return build_hierarchy(position, faces, [120, 30])


@pytest.fixture(params=["crash.zarr", "crash.nc"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    target: Path = tmp_path / request.param
    write(campaign(), target)
    return target


@pytest.fixture
def zarr_path(tmp_path: Path) -> Path:
    write(campaign(), tmp_path / "crash.zarr")
    return tmp_path / "crash.zarr"


def write(dataset: xr.Dataset, path: Path) -> None:
    """`dataset` on disk; with the consolidated metadata that xarray puts into Zarr stores, of which Zarr warns."""
    if path.suffix == ".zarr":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            dataset.drop_encoding().assign_coords(sim=dataset["sim"].astype("O")).to_zarr(path)
    else:
        dataset.to_netcdf(path)


def test_what_was_written_is_read_back(path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(path, hierarchy)
    back = open_hierarchy(path)
    assert back.n_nodes == hierarchy.n_nodes
    assert back.settings == hierarchy.settings
    for a, b in zip(hierarchy.levels, back.levels, strict=True):
        for name in ("kept", "faces", "edges", "in_finer", "distance", "face_part"):
            assert (getattr(a, name) == getattr(b, name)).all()
        assert (a.to_full != b.to_full).nnz == 0
        assert (a.to_finer != b.to_finer).nnz == 0
        assert (a.adjacency != b.adjacency).nnz == 0


def test_displacements_of_every_level_are_those_of_its_kept_nodes(path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(path, hierarchy)
    u = campaign()["displacement"].values
    for level in hierarchy.levels:
        assert (level_displacement(path, level.index) == u[:, :, level.kept]).all()
    assert (level_displacement(path, 2, runs=[2, 0]) == u[[2, 0]][:, :, hierarchy[2].kept]).all()


def test_the_dataset_itself_is_untouched(path: Path, hierarchy: Hierarchy) -> None:
    with xr.open_dataset(path) as before:
        before.load()
    write_hierarchy(path, hierarchy)
    write_hierarchy(path, hierarchy)
    with xr.open_dataset(path) as after:
        xr.testing.assert_identical(before, after.load())


def test_xarray_reads_the_groups_as_a_tree(path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(path, hierarchy)
    with xr.open_datatree(path) as tree:
        one = tree["hierarchy/level_1"]
        assert one["displacement"].dims == ("sim", "time", "level_node", "xyz")
        assert one["displacement"].attrs["units"] == "m"
        assert (one["kept"].values == hierarchy[1].kept).all()


def test_lifting_errors_are_reported_and_kept(path: Path, hierarchy: Hierarchy) -> None:
    errors = write_hierarchy(path, hierarchy)
    rows = summarize_hierarchy(path)
    assert [row["nodes"] for row in rows] == [120, 30]
    assert [row["lifting_error_mean"] for row in rows] == [e.mean for e in errors]
    assert errors[0].mean < errors[1].mean < errors[1].largest


def test_a_new_hierarchy_replaces_the_old_one(path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(path, hierarchy)
    position, faces, _ = kart()
    write_hierarchy(path, build_hierarchy(position, faces, [50]))
    assert [level.n_nodes for level in open_hierarchy(path).levels] == [50]
    with pytest.raises(DataError, match="level 2 was asked for; the hierarchy has levels 1 to 1"):
        level_displacement(path, 2)


def test_nothing_but_the_dataset_is_left_in_its_folder(path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(path, hierarchy)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_failure_in_the_middle_leaves_the_old_hierarchy(path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(path, hierarchy)
    position, faces, _ = kart()

    def stop(what: str, done: int, total: int, note: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_hierarchy(path, build_hierarchy(position, faces, [50]), report=stop)
    assert [level.n_nodes for level in open_hierarchy(path).levels] == [120, 30]
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_killed_process_leaves_the_dataset_and_the_next_one_succeeds(path: Path, hierarchy: Hierarchy) -> None:
    script = (
        "import os, sys\n"
        "from crashkit.mesh import build_hierarchy, write_hierarchy\n"
        "from crashkit.mesh.store import open_mesh\n"
        "from pathlib import Path\n"
        "mesh = open_mesh(Path(sys.argv[1]))\n"
        "hierarchy = build_hierarchy(mesh.position, mesh.face_nodes, [50])\n"
        "write_hierarchy(sys.argv[1], hierarchy, report=lambda what, done, total, note: os._exit(9) if done == 2 else None)\n"
    )
    assert subprocess.run([sys.executable, "-c", script, str(path)], check=False).returncode == 9
    with pytest.raises(DataError, match="has no mesh hierarchy"):
        open_hierarchy(path)
    write_hierarchy(path, hierarchy)
    assert [level.n_nodes for level in open_hierarchy(path).levels] == [120, 30]
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_missing_displacements_stay_missing(zarr_path: Path, tmp_path: Path, hierarchy: Hierarchy) -> None:
    dataset = campaign()
    dataset["displacement"][0, 3, hierarchy[1].kept[5]] = np.nan
    write(dataset, tmp_path / "eroded.zarr")
    errors = write_hierarchy(tmp_path / "eroded.zarr", hierarchy)
    u = level_displacement(tmp_path / "eroded.zarr", 1)
    assert np.isnan(u[0, 3, 5]).all()
    assert np.isnan(u).sum() == 3
    assert np.isfinite(errors[0].mean)


def test_a_dataset_without_a_hierarchy_says_what_to_do(path: Path) -> None:
    for read in (open_hierarchy, summarize_hierarchy, lambda p: level_displacement(p, 1)):
        with pytest.raises(DataError, match=f"{path.name}: has no mesh hierarchy; run crashkit coarsen"):
            read(path)


def test_a_hierarchy_of_another_mesh_is_refused(zarr_path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(zarr_path, hierarchy)
    moved = campaign()
    moved["reference_position"] = moved["reference_position"] + 1
    other = zarr_path.with_name("other.zarr")
    write(moved, other)
    (zarr_path / "hierarchy").rename(other / "hierarchy")
    with pytest.raises(DataError, match="belongs to another mesh; run crashkit coarsen"):
        open_hierarchy(other)


def test_a_hierarchy_made_before_runs_were_added_is_refused(zarr_path: Path, hierarchy: Hierarchy) -> None:
    write_hierarchy(zarr_path, hierarchy)
    other = zarr_path.with_name("other.zarr")
    write(campaign(runs=4), other)
    (zarr_path / "hierarchy").rename(other / "hierarchy")
    with pytest.raises(DataError, match="was made with other runs; run crashkit coarsen"):
        level_displacement(other, 1)


def test_a_hierarchy_with_other_nodes_is_not_written(path: Path) -> None:
    with pytest.raises(DataError, match="has 2400 nodes, but the hierarchy was made for a mesh of 3"):
        write_hierarchy(path, build_hierarchy(np.eye(3), [[0, 1, 2]], [2]))


def test_a_damaged_map_is_noticed(zarr_path: Path, hierarchy: Hierarchy) -> None:
    import zarr

    write_hierarchy(zarr_path, hierarchy)
    group = zarr.open_group(zarr_path / "hierarchy" / "level_1", mode="a")
    indices = group["to_full_indices"]
    assert isinstance(indices, zarr.Array)
    indices[5] = 10_000
    with pytest.raises(ReadError, match=r"/hierarchy/level_1 is damaged .*; run crashkit coarsen again"):
        open_hierarchy(zarr_path)


def test_a_full_disk_is_told_in_one_line_and_leaves_nothing(
    path: Path, hierarchy: Hierarchy, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    def full_of_hdf5(*_: object) -> None:
        raise RuntimeError("NetCDF: HDF error")

    for fault, told in (
        (full, r"the hierarchy cannot be written \(No space left on device\)"),
        (full_of_hdf5, "HDF error"),
    ):
        if fault is full_of_hdf5 and path.suffix != ".nc":
            continue
        monkeypatch.setattr(store, "_write_level", fault)
        with pytest.raises(OutputError, match=told) as caught:
            write_hierarchy(path, hierarchy)
        assert "\n" not in str(caught.value)
        assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_the_mesh_of_the_first_run_is_taken_where_runs_differ_in_shape(tmp_path: Path) -> None:
    dataset = campaign()
    shifts = xr.DataArray(np.arange(3.0), dims="sim")
    dataset["reference_position"] = (dataset["reference_position"] + shifts).transpose("sim", "node", "xyz")
    write(dataset, tmp_path / "shapes.zarr")
    assert (store.open_mesh(tmp_path / "shapes.zarr").position == kart()[0]).all()


def test_a_dataset_without_faces_is_refused(tmp_path: Path) -> None:
    write(campaign().drop_vars("face_nodes"), tmp_path / "points.nc")
    with pytest.raises(ReadError, match="holds no variable face_nodes"):
        store.open_mesh(tmp_path / "points.nc")


def test_a_refined_hierarchy_is_stored_as_any_other(zarr_path: Path, hierarchy: Hierarchy) -> None:
    position, faces, _ = kart()
    error = np.linalg.norm(position - position[0], axis=1)
    refined = refine(surface(position, faces), hierarchy, 2, error, nodes=60)
    write_hierarchy(zarr_path, refined)
    again = open_hierarchy(zarr_path)
    assert [level.n_nodes for level in again.levels] == [60, hierarchy[2].n_nodes]
    with xr.open_dataset(zarr_path, engine="zarr", consolidated=False) as dataset:
        fine = dataset["displacement"].values
    for level in again.levels:
        assert (level_displacement(zarr_path, level.index) == fine[:, :, level.kept]).all()
        assert np.abs(level.to_finer.sum(axis=1) - 1).max() <= 4 * np.finfo(float).eps


def test_three_levels_of_one_netcdf_file_are_read_beside_the_open_dataset(tmp_path: Path) -> None:
    """Groups that were opened and closed under an open dataset once ended the interpreter."""
    path = tmp_path / "f.nc"
    write(campaign(), path)
    position, faces, _ = kart()
    write_hierarchy(path, build_hierarchy(position, faces, [60, 30, 12]))
    with open_dataset(path) as whole:
        for _ in range(5):
            assert len(open_hierarchy(path).levels) == 3
            shown = [row["nodes"] for row in summarize_hierarchy(path)]
            read = [level_displacement(path, level).shape[2] for level in (1, 2, 3)]
            assert shown == read == [60, 30, 12]
            assert np.isfinite(whole["displacement"].values).all()
