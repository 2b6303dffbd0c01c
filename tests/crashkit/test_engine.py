"""`xarray.open_dataset(..., engine="crashkit")`: what ingest would give, read only where it is asked for."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from memory_runs import MemoryRun, RunsInMemory

from crashkit.dataset import demo_data, open_dataset
from crashkit.errors import CrashkitError, DataError
from crashkit.ingestion.ingest import ingest
from crashkit.readers.base import FieldInfo
from data_schema import validate

D3PLOT = Path(__file__).parents[1] / "data" / "d3plot" / "solid_int" / "d3plot"


def test_d3plot_opens_by_its_path_alone() -> None:
    with xr.open_dataset(D3PLOT, engine="crashkit") as ds:
        assert ds.sizes["sim"] == 1
        assert {"plastic_strain", "velocity", "alive"} <= set(ds.data_vars)
        assert "units" not in ds["displacement"].attrs, "nobody said what they are"
        assert ds.crash.magnitude("displacement").max() > 1


def test_d3plot_with_units_is_what_ingest_makes_of_it(tmp_path: Path) -> None:
    fields = ["velocity", "plastic_strain"]
    ingest(D3PLOT, tmp_path / "crash.nc", units="mm-ms-kg", fields=fields)
    expected = open_dataset(tmp_path / "crash.nc").load()
    with xr.open_dataset(D3PLOT, engine="crashkit", units="mm-ms-kg") as ds:
        for name in ("displacement", "reference_position", "face_nodes", "cell_nodes", "part_name", *fields):
            np.testing.assert_array_equal(ds[name], expected[name], err_msg=name)
            assert ds[name].attrs.get("units") == expected[name].attrs.get("units")
        assert validate(ds) == []


def test_only_states_asked_for_are_read(tmp_path: Path, memory: RunsInMemory) -> None:
    run = MemoryRun()
    source = memory.put(tmp_path / "run.txt", run)
    with xr.open_dataset(source, engine="crashkit") as ds:
        assert run.read_states == []
        ds["displacement"].isel(time=3, node=5).load()
        assert run.read_states == [(3, 4)]
    assert run.closed


_index = st.one_of(
    st.integers(-3, 2),
    st.slices(3).filter(lambda s: (s.step or 1) > 0 or len(range(3)[s])),  # xarray trips over empty ones backwards
    st.lists(st.integers(-3, 2), max_size=4).map(lambda places: np.array(places, int)),
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(time=_index, node=_index, xyz=_index)
def test_every_index_gives_what_numpy_gives(  # type: ignore[no-untyped-def]
    tmp_path: Path, memory: RunsInMemory, time, node, xyz
) -> None:
    source = memory.put(tmp_path / "run.txt", MemoryRun(time=[0.0, 1.0, 2.0]))
    with xr.open_dataset(source, engine="crashkit") as ds:
        lazy = ds["displacement"].isel(node=slice(3))
        found = lazy.isel(time=time, node=node, xyz=xyz).values
        np.testing.assert_array_equal(found, lazy.load().isel(time=time, node=node, xyz=xyz).values)


def test_gone_nodes_are_nan_and_fields_in_si(tmp_path: Path, memory: RunsInMemory) -> None:
    alive = np.ones((5, 8), bool)
    alive[3:, 6] = False
    stress = (FieldInfo("stress", "node", 6, "stress"), np.ones((5, 17, 6), np.float32))
    source = memory.put(tmp_path / "run.txt", MemoryRun(alive=alive, fields={"stress": stress}))
    with xr.open_dataset(source, engine="crashkit") as ds:
        assert np.isnan(ds["displacement"][0, 3:, 12]).all()
        assert np.isfinite(ds["displacement"][0, :3]).all()
        assert ds["stress"].dims == ("sim", "time", "node", "tensor")
        assert (ds["stress"] == 1e9).all()
        assert ds["alive"].dtype == bool


def test_one_run_of_many_by_name_or_place() -> None:
    with h5py.File(demo_data()) as file:
        expected = file["kart/displacements"][7]
    for run in ("run_007", 7):
        with xr.open_dataset(demo_data(), engine="crashkit", run=run) as ds:
            np.testing.assert_array_equal(ds["displacement"][0], expected)
            assert float(ds["yield_stress"][0]) > 1e8
            assert ds["impact_speed"].attrs == {"units": "m s-1", "role": "parameter"}


def test_dataset_opens_with_the_same_engine(demo_dataset: Path) -> None:
    with xr.open_dataset(demo_dataset, engine="crashkit", drop_variables=["complete"]) as ds:
        assert ds.sizes["sim"] == 36
        assert "complete" not in ds


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({}, r"holds 36 runs \(run_000, .*\); name one with run="),
        ({"run": "run_99"}, "holds no run 'run_99'; it has run_000"),
        ({"run": 40}, "holds no run 40"),
    ],
)
def test_which_run_must_be_clear(options: dict[str, object], told: str) -> None:
    with pytest.raises(DataError, match=told):
        xr.open_dataset(demo_data(), engine="crashkit", **options)


def test_unknown_format_and_missing_file_are_told(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no solver wrote this")
    with pytest.raises(CrashkitError, match="the content is none of the known formats"):
        xr.open_dataset(tmp_path / "notes.txt", engine="crashkit")
    with pytest.raises(CrashkitError, match="no such file"):
        xr.open_dataset(tmp_path / "nothing", engine="crashkit")


def test_other_files_are_left_to_other_engines(tmp_path: Path) -> None:
    xr.Dataset({"x": ("a", [1, 2])}).to_netcdf(tmp_path / "other.nc")
    with xr.open_dataset(tmp_path / "other.nc") as ds:
        assert ds["x"].values.tolist() == [1, 2]
