"""All groups of a NetCDF file go through one handle."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from crashkit import netcdf
from crashkit.netcdf import open_netcdf


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.nc"
    xr.Dataset({"name": ("run", np.array(["a", "bc"], object)), "x": ("run", [1.0, 2.0])}).to_netcdf(path)
    xr.Dataset({"y": ("node", [3, 4])}).to_netcdf(path, group="level", mode="a")
    return path


def held(file: Path) -> list[object]:
    return [handle for key, handle in netcdf._OPEN.items() if key[0] == str(file)]


def test_one_handle_is_shared_and_closed_by_the_last(file: Path) -> None:
    whole, group = open_netcdf(file), open_netcdf(file, "level")
    assert len(held(file)) == 1
    group.close()
    assert whole["name"].values.tolist() == ["a", "bc"]
    whole.close()
    assert not held(file)


def test_a_replaced_file_is_another_one(file: Path, tmp_path: Path) -> None:
    with open_netcdf(file) as before:
        xr.Dataset({"x": ("run", [9.0])}).to_netcdf(tmp_path / "new.nc")
        (tmp_path / "new.nc").replace(file)
        with open_netcdf(file) as after:
            assert (before["x"].values.tolist(), after["x"].values.tolist()) == ([1.0, 2.0], [9.0])


def test_a_dataset_can_be_sent_to_another_process(file: Path) -> None:
    with open_netcdf(file, chunks={}) as dataset:
        sent = pickle.loads(pickle.dumps(dataset))
        assert sent["x"].values.tolist() == [1.0, 2.0]


def test_three_levels_beside_the_open_dataset_do_not_crash(demo_dataset: Path, tmp_path: Path) -> None:
    """The main dataset is open and read while groups are opened and closed: NetCDF's library used to crash."""
    code = (
        "import sys; from pathlib import Path\n"
        "from crashkit.dataset import demo_data, open_dataset\n"
        "from crashkit.ingestion.ingest import ingest\n"
        "from crashkit.api.coarsen import coarsen\n"
        "from crashkit.mesh.store import summarize_hierarchy\n"
        "path = Path(sys.argv[1]); ingest([demo_data()], path); coarsen(path, [60, 20, 8])\n"
        "for _ in range(10):\n"
        "    with open_dataset(path, chunks=None) as dataset:\n"
        "        rows = summarize_hierarchy(path); assert str(dataset['part_name'].values[0]) == 'kart'\n"
        "        dataset['displacement'].isel(sim=3).values\n"
        "print(len(rows))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "kart.nc")], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "3"), done.stderr
