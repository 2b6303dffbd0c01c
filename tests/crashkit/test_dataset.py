"""Opening a dataset, what is told of a damaged one, splitting, and what the accessor gives."""

from __future__ import annotations

import builtins
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import pyvista as pv
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from memory_runs import MemoryRun, RunsInMemory

import crashkit
from crashkit.dataset import dataset_checksum, demo_data, open_dataset, reading_dataset
from crashkit.errors import DataError, ReadError
from crashkit.ingestion.ingest import ingest
from crashkit.selection import runs_of

NAMES = [f"run_{k:03d}" for k in range(10)]


@pytest.fixture
def eroding(tmp_path: Path, memory: RunsInMemory) -> xr.Dataset:
    """Two runs in metres; the triangle at the tip of the first (face 6, node 12) dies at state 3."""
    alive = np.ones((5, 8), bool)
    alive[3:, 6] = False
    source = memory.put(tmp_path / "runs.txt", MemoryRun("a", alive=alive), MemoryRun("b", speed=5.0))
    ingest(source, tmp_path / "crash.nc")
    return open_dataset(tmp_path / "crash.nc").load()


# Opening


def test_opening_reads_nothing_large_and_needs_dask_only_if_there(
    demo_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_dataset(demo_dataset) as ds:
        assert ds["displacement"].chunks == ((1,) * 36, (21,), (2400,), (3,))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with open_dataset(demo_dataset) as ds:
        assert ds["displacement"].chunks is None
        assert not ds["displacement"].variable._in_memory


def test_public_names_lead_here(demo_dataset: Path) -> None:
    with crashkit.open_dataset(demo_dataset) as ds:
        assert ds.sizes["sim"] == 36
    assert demo_data().is_file()


def test_stored_checksum_is_that_of_the_content(demo_dataset: Path) -> None:
    with open_dataset(demo_dataset) as ds:
        assert dataset_checksum(demo_dataset) == ds.attrs["checksum"]


def damaged(demo_dataset: Path, folder: Path, kind: str) -> Path:
    path = folder / "crash.zarr"
    if kind == "missing":
        return path
    if kind == "empty folder":
        path.mkdir()
        return path
    if kind in ("text", "truncated"):
        path = folder / "crash.nc"
        if kind == "text":
            path.write_text("no data")
        else:
            with h5py.File(path, "w") as file:
                file["displacement"] = np.zeros(100_000)
            path.write_bytes(path.read_bytes()[:5000])
        return path
    shutil.copytree(demo_dataset, path)
    if kind == "no metadata":
        (path / "zarr.json").write_text("{")
    else:
        shutil.rmtree(path / "face_nodes")
    return path


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("missing", "no such dataset; make one with crashkit ingest"),
        ("empty folder", "is a folder, but no Zarr store"),
        ("text", "cannot be opened as a dataset"),
        ("truncated", "cannot be opened as a dataset"),
        ("no metadata", "cannot be opened as a dataset"),
        ("array missing", "holds no variable face_nodes; .* it is damaged"),
    ],
)
def test_what_cannot_be_opened_is_told_in_one_line(demo_dataset: Path, tmp_path: Path, kind: str, told: str) -> None:
    path = damaged(demo_dataset, tmp_path, kind)
    with pytest.raises(ReadError, match=told) as caught:
        open_dataset(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_solver_file_is_no_dataset_and_says_so() -> None:
    with pytest.raises(ReadError, match=r"kart_demo.h5: .*expected .* made by crashkit ingest"):
        open_dataset(demo_data())


def test_damaged_chunk_is_told_when_it_is_read(demo_dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "crash.zarr"
    shutil.copytree(demo_dataset, path)
    (path / "displacement" / "c.3.0.0.0").write_bytes(b"\2\1" + b"x" * 300)
    with (
        open_dataset(path) as ds,
        pytest.raises(ReadError, match=r"crash.zarr: chunk .* of run run_003 is damaged"),
        reading_dataset(path),
    ):
        ds["displacement"].isel(sim=3).load()


def test_missing_chunk_is_refused_and_no_zeros(demo_dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "crash.zarr"
    shutil.copytree(demo_dataset, path)
    (path / "displacement" / "c.3.0.0.0").unlink()
    with pytest.raises(ReadError, match=r"chunk displacement/c\.3\.0\.0\.0 of run run_003 is lost"):
        open_dataset(path)


# Splitting


@pytest.mark.parametrize(
    ("chosen", "places"),
    [
        (slice(7, 10), [7, 8, 9]),
        ("7:10", [7, 8, 9]),
        ("-2:", [8, 9]),
        (["run_004", "run_001"], [1, 4]),
        ("run_004,1", [1, 4]),
        ([9, -10], [0, 9]),
        ("run_002", [2]),
    ],
)
def test_test_runs_by_range_name_and_place(chosen: Any, places: list[int]) -> None:
    assert runs_of(NAMES, chosen) == places


@given(st.integers(1, 9), st.integers(0, 50))
def test_random_split_has_the_size_asked_for_and_repeats_with_its_seed(count: int, seed: int) -> None:
    chosen = runs_of(NAMES, count, seed=seed)
    assert len(chosen) == count
    assert chosen == sorted(set(chosen))
    assert chosen == runs_of(NAMES, count, seed=seed)
    assert len(runs_of(NAMES, count / 10, seed=seed)) == count


def test_other_seed_other_runs() -> None:
    assert len({tuple(runs_of(NAMES, 3, seed=s)) for s in range(20)}) > 10


@pytest.mark.parametrize("chosen", [0, 10, 1.5, ["nobody"], "20:30", "a:b", "run_001,nobody", [12]])
def test_impossible_split_is_told(chosen: Any) -> None:
    with pytest.raises(DataError):
        runs_of(NAMES, chosen)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("99:", "'99:' does not fit 10 runs, which are 0 to 9; .* such as 8:10, or 8: to the end"),
        ("8:12", "'8:12' does not fit 10 runs"),
        ("0:3,12:", "'12:' does not fit 10 runs"),
        ("a:b", "no range of runs; expected first:last, such as 27:36, or 27: to the end"),
        ("1:2:3:4", "no range of runs"),
        ("99", "99 of 10 runs were asked for; expected a fraction, or a whole number from 1 to 9"),
    ],
)
def test_runs_beyond_the_last_are_told_with_those_there_are(chosen: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        runs_of(NAMES, chosen)


@pytest.mark.parametrize(
    ("chosen", "places"), [("7:", [7, 8, 9]), ("0:2,run_005,-1:", [0, 1, 5, 9]), (slice(8, 99), [8, 9])]
)
def test_ranges_without_an_end_and_in_lists(chosen: Any, places: list[int]) -> None:
    assert runs_of(NAMES, chosen) == places


def test_per_cent_are_a_fraction() -> None:
    assert runs_of(NAMES, "30%") == runs_of(NAMES, 0.3)


def test_split_keeps_order_and_everything_else(demo_dataset: Path) -> None:
    with open_dataset(demo_dataset) as ds:
        train, test = ds.crash.split(test="27:36")
        assert train["sim"].values.tolist() == [f"run_{k:03d}" for k in range(27)]
        assert test["sim"].values.tolist() == [f"run_{k:03d}" for k in range(27, 36)]
        assert set(train.variables) == set(ds.variables)
        with pytest.raises(DataError, match="all 36 runs would be test runs"):
            ds.crash.split(test=":")


# Accessor


def test_magnitude_is_the_length_with_its_unit(eroding: xr.Dataset) -> None:
    found = eroding.crash.magnitude("displacement")
    np.testing.assert_allclose(found, np.linalg.norm(eroding["displacement"], axis=-1), rtol=1e-6)
    assert found.attrs == {"units": "m"}
    assert np.isnan(found[0, 3, 12])
    with pytest.raises(DataError, match="a magnitude needs xyz"):
        eroding.crash.magnitude("time")


def test_magnitude_of_dask_arrays_stays_lazy(demo_dataset: Path) -> None:
    with open_dataset(demo_dataset) as ds:
        assert ds.crash.magnitude().chunks is not None


def test_units_survive_arithmetic_with_pint(eroding: xr.Dataset) -> None:
    import pint_xarray  # noqa: F401

    measured = eroding.pint.quantify()
    size = measured.crash.magnitude("displacement").max()
    assert str(size.pint.units) == "meter"
    assert str((size**2).pint.units) == "meter ** 2"
    assert float(size.pint.to("mm").pint.magnitude) == pytest.approx(1e3 * float(eroding.crash.magnitude().max()))


def test_pint_is_not_needed(eroding: xr.Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_pint(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0].startswith("pint"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_pint)
    assert eroding.crash.magnitude().attrs["units"] == "m"


def test_surface_is_the_undeformed_mesh_with_numbers(eroding: xr.Dataset) -> None:
    mesh = eroding.crash.surface()
    np.testing.assert_allclose(mesh.points, eroding["reference_position"], rtol=1e-6)
    assert mesh.n_cells == 7
    assert mesh.cell_data["element_id"].tolist() == list(range(500, 507))
    assert mesh.cell_data["part_id"].tolist() == [7, 7, 7, 8, 8, 8, 8]
    assert mesh.point_data["node_id"].tolist() == list(range(100, 113))


def test_state_as_pyvista_is_deformed_and_without_dead_elements(eroding: xr.Dataset) -> None:
    whole, torn = (eroding.crash.to_pyvista("a", k) for k in (2, 3))
    assert isinstance(whole, pv.PolyData)
    moved = eroding["reference_position"] + eroding["displacement"].isel(sim=0, time=2)
    np.testing.assert_allclose(whole.points, moved, rtol=1e-6)
    assert (whole.n_cells, torn.n_cells) == (7, 6)
    assert torn.n_points == 13
    assert np.isnan(torn.point_data["displacement"][12]).all()
    assert np.isfinite(torn.points).all()
    assert torn.field_data["TimeValue"][0] == pytest.approx(0.003)


def test_states_by_seconds_and_runs_by_place(eroding: xr.Dataset) -> None:
    by_place, by_time = eroding.crash.to_pyvista(1, -1), eroding.crash.to_pyvista("b", 0.0039)
    np.testing.assert_array_equal(by_place.points, by_time.points)
    still = eroding.crash.to_pyvista("b", 0.0039, deform=False)
    np.testing.assert_allclose(still.points, eroding["reference_position"], rtol=1e-6)
    one = eroding.isel(sim=1)
    np.testing.assert_array_equal(one.crash.to_pyvista().points, by_place.points)


@pytest.mark.parametrize("sim", ["c", 2, -3])
def test_run_that_is_not_there_is_told(eroding: xr.Dataset, sim: str | int) -> None:
    with pytest.raises(DataError, match=f"there is no run {sim!r}"):
        eroding.crash.to_pyvista(sim, 0)


def test_edges_are_the_sides_of_faces(eroding: xr.Dataset) -> None:
    edges = eroding.crash.edges()
    drawn = eroding.crash.surface().extract_all_edges()
    theirs = {tuple(sorted(pair)) for pair in drawn.lines.reshape(-1, 3)[:, 1:].tolist()}
    assert {tuple(pair) for pair in edges.tolist()} == theirs


def test_nodes_of_a_part(eroding: xr.Dataset) -> None:
    assert eroding.crash.nodes(7).tolist() == eroding.crash.nodes("rail left").tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert len(eroding.crash.nodes("rail*")) == 13
    with pytest.raises(DataError, match=r"no part is called 'door'; the dataset has 7 \(rail left\)"):
        eroding.crash.nodes("door")
