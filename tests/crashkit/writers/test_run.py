"""One run of a dataset as a file for ParaView: numbers, parts, parameters and fields come back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import xarray as xr

from crashkit.api.export import export_run
from crashkit.dataset import open_dataset
from crashkit.errors import DataError
from crashkit.writers.paraview import read_state
from crashkit.writers.run import write_run


def _run(**more) -> xr.Dataset:
    """Two triangles in two parts and a beam, two states."""
    return xr.Dataset(
        {
            "displacement": (("time", "node", "xyz"), np.arange(24.0).reshape(2, 4, 3)),
            "reference_position": (("node", "xyz"), np.eye(4, 3)),
            "node_id": ("node", [11, 12, 13, 14]),
            "face_nodes": (("face", "corner"), [[0, 1, 2], [1, 2, 3]]),
            "face_id": ("face", [101, 102]),
            "face_part": ("face", [1, 0]),
            "part_id": ("part", [7, 9]),
            "part_name": ("part", np.array(["pillar", "floor"])),
            "cell_nodes": (("cell", "cell_corner"), [[0, 1, 2, 3], [0, 3, -1, -1]]),
            "cell_type": ("cell", [10, 3]),
            "cell_part": ("cell", [0, 0]),
            "cell_id": ("cell", [500, 501]),
            "plastic_strain": (("time", "face"), [[0.0, 0.0], [0.1, 0.2]], {"role": "field", "units": "1"}),
            "yield_stress": ((), 350e6, {"role": "parameter", "units": "Pa", "table_units": "MPa"}),
            **more,
        },
        coords={"time": ("time", [0.0, 0.01])},
    )


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_numbers_parts_parameters_and_fields_come_back(tmp_path: Path, suffix: str) -> None:
    file = write_run(_run(), tmp_path / f"run{suffix}", {"run": "run_008"})[0]
    _, mesh = read_state(file, 1)
    assert mesh["node_id"].tolist() == [11, 12, 13, 14]
    assert mesh["element_id"].tolist() == [101, 102, 501]
    assert mesh["part_id"].tolist() == [9, 7, 7]
    np.testing.assert_allclose(mesh["plastic_strain"], [0.1, 0.2, np.nan])
    assert list(mesh.field_data["part_name"]) == ["pillar", "floor"]
    assert mesh.field_data["yield_stress"].tolist() == [350.0]
    assert list(mesh.field_data["yield_stress_unit"]) == ["MPa"]
    assert list(mesh.field_data["run"]) == ["run_008"]


def test_a_run_without_mesh_or_with_too_many_states_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has no mesh"):
        write_run(_run().drop_vars("face_nodes"), tmp_path / "run.pvd")
    with pytest.raises(DataError, match="holds one state, and there are 2"):
        write_run(_run(), tmp_path / "run.vtu")


def test_a_run_of_a_dataset_is_exported(demo_dataset: Path, tmp_path: Path) -> None:
    export_run(demo_dataset, "run_008", tmp_path / "run.vtkhdf")
    with open_dataset(demo_dataset, chunks=None) as data:
        run = data.sel(sim="run_008")
        _, mesh = read_state(tmp_path / "run.vtkhdf", -1)
        np.testing.assert_array_equal(mesh["displacement"], run["displacement"].values[-1])
        assert mesh.field_data["yield_stress"][0] == pytest.approx(float(run["yield_stress"]) / 1e6)
    assert isinstance(mesh, pv.UnstructuredGrid)
