"""PhysicsNeMo Curator's VTP and Zarr layouts, written as Curator writes them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import zarr

from crashkit.errors import CrashkitError, ReadError
from crashkit.readers import reader_for

STEP = 0.005


def write_vtp(path: Path, sample, values: np.ndarray, name: str = "t{time:.3f}") -> Path:
    mesh = pv.PolyData.from_regular_faces(sample.points, sample.faces)
    mesh.point_data["thickness"] = np.full(162, 2.0)
    for state, displacement in enumerate(values):
        mesh.point_data["displacement_" + name.format(time=state * STEP, state=state)] = displacement
        mesh.point_data["stress_vm_" + name.format(time=state * STEP, state=state)] = np.full(162, 10.0 * state)
    mesh.save(path)
    return path


def write_zarr(path: Path, sample, version: int, cells: bool = True) -> Path:
    store = zarr.open_group(str(path), mode="w", zarr_format=version)
    position = (sample.points + sample.displacement).astype(np.float32)
    arrays = {"mesh_pos": position, "edges": np.array([[0, 1]]), "thickness": np.full(162, 2, np.float32)}
    if cells:
        arrays |= {"mesh_connectivity_flat": sample.faces.ravel(), "mesh_connectivity_offsets": np.arange(0, 361, 3)}
    for name, values in arrays.items():
        store.create_array(name, data=values, chunks=tuple(min(s, 100) for s in values.shape))
    store.attrs["num_timesteps"] = 3
    return path


def test_a_vtp_file_is_a_run_with_its_times_in_names(tmp_path, only_run, sample):
    run = only_run(write_vtp(tmp_path / "Run100.vtp", sample, sample.displacement))
    assert run.name == "Run100"
    assert run.time.tolist() == [0, STEP, 2 * STEP]
    np.testing.assert_array_equal(run.mesh.position, sample.points)
    np.testing.assert_array_equal(run.displacement(0, 3), sample.displacement)
    np.testing.assert_array_equal(run.field("von_mises", 0, 3), np.outer([0, 10, 20], np.ones(162)))
    assert set(run.fields) == {"von_mises"}


def test_positions_called_displacements_are_read_as_positions(tmp_path, only_run, sample, caplog):
    file = write_vtp(tmp_path / "run.vtp", sample, sample.points + sample.displacement)
    with caplog.at_level(logging.WARNING, "crashkit"):
        run = only_run(file)
    assert "its displacement arrays hold positions" in caplog.text
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, atol=1e-7)


def test_numbered_states_need_a_time_step(tmp_path, only_run, sample):
    file = write_vtp(tmp_path / "run.vtp", sample, sample.displacement, "t{state:03d}")
    with pytest.raises(ReadError, match=r"tells no times of its 3 states.*--time-step"):
        only_run(file)
    assert only_run(file, time_step="0.01").time.tolist() == [0, 0.01, 0.02]


def test_a_state_without_displacement_is_a_problem(tmp_path, only_run, sample):
    file = write_vtp(tmp_path / "run.vtp", sample, sample.displacement)
    file.write_bytes(file.read_bytes().replace(b"displacement_t0.005", b"displecement_t0.005"))
    run = only_run(file)
    assert len(run.time) == 2
    assert "has arrays of time 0.005 but no displacement_t0.005" in run.problems[0]


def test_a_folder_of_vtp_files_is_a_folder_of_runs(tmp_path, sample):
    for number in (1, 2, 10):
        write_vtp(tmp_path / f"Run{number}.vtp", sample, sample.displacement)
    reader = reader_for(tmp_path)
    assert reader.name == "physicsnemo"
    assert set(reader.runs(tmp_path).names) == {"Run1", "Run2", "Run10"}


@pytest.mark.parametrize("version", [2, 3])
def test_a_zarr_store_is_a_run(tmp_path, only_run, sample, version):
    run = only_run(write_zarr(tmp_path / "run_001.zarr", sample, version), time_step=STEP)
    assert run.name == "run_001"
    assert run.time.tolist() == [0, STEP, 2 * STEP]
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, atol=1e-7)


def test_a_store_without_cells_needs_a_mesh(tmp_path, only_run, sample):
    store = write_zarr(tmp_path / "run.zarr", sample, 3, cells=False)
    with pytest.raises(ReadError, match=r"has no mesh_connectivity_flat.*--mesh FILE"):
        only_run(store, time_step=STEP)
    pv.PolyData.from_regular_faces(sample.points, sample.faces).save(tmp_path / "mesh.vtp")
    run = only_run(store, time_step=STEP, mesh=tmp_path / "mesh.vtp")
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)


def test_a_missing_chunk_is_refused_instead_of_read_as_zeros(tmp_path, only_run, sample):
    store = write_zarr(tmp_path / "run.zarr", sample, 3)
    (store / "mesh_pos/c/0/1/0").unlink()
    with pytest.raises(ReadError, match="1 of 2 chunks of mesh_pos are missing"):
        only_run(store, time_step=STEP)


@pytest.mark.parametrize("length", [0, 10, 500])
def test_a_truncated_chunk_is_refused(tmp_path, only_run, sample, length):
    store = write_zarr(tmp_path / "run.zarr", sample, 3)
    chunk = store / "mesh_pos/c/0/1/0"
    chunk.write_bytes(chunk.read_bytes()[:length])
    with pytest.raises(ReadError, match="mesh_pos"):
        only_run(store, time_step=STEP)


def test_a_truncated_vtp_is_refused(tmp_path, sample):
    file = write_vtp(tmp_path / "run.vtp", sample, sample.displacement)
    whole = file.read_bytes()
    for share in (0.3, 0.6, 0.95):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ReadError, match=r"run\.vtp"):
            next(reader_for(file, "physicsnemo").runs(file)).displacement(0, 3)


def test_a_time_step_must_be_a_number(tmp_path):
    with pytest.raises(CrashkitError, match="--time-step is 'soon'"):
        reader_for(tmp_path, "physicsnemo").runs(tmp_path, time_step="soon")
