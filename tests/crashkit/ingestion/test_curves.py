"""Time histories on their way into the dataset."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import crashkit
from crashkit.errors import CrashkitError
from crashkit.readers.base import Part, distinct_parts

DATA = Path(__file__).parents[2] / "data"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two OpenRadioss runs of which the second has a time history."""
    for name in ("one", "two"):
        shutil.copytree(DATA / "radioss" / "run_b", tmp_path / "runs" / name)
    shutil.copy(DATA / "histories" / "bumperT01", tmp_path / "runs" / "two" / "kartT01")
    return tmp_path / "runs"


def test_curves_stand_beside_their_run_and_are_missing_where_a_run_has_none(runs: Path, tmp_path: Path) -> None:
    crashkit.ingest(runs, tmp_path / "out.zarr", allow_incomplete=True)
    data = crashkit.open_dataset(tmp_path / "out.zarr", chunks=None)
    assert data["sim"].values.tolist() == ["one", "two"]
    assert np.isnan(data["history"].sel(sim="one")).all()
    energy = data["history"].sel(sim="two", channel="kinetic_energy")
    assert float(energy[0]) == pytest.approx(558.58 * 7.0**2 / 2, rel=1e-4)
    assert str(data["channel_unit"].sel(channel="kinetic_energy").values) == "J"
    assert "impulse" in str(data["channel_note"].sel(channel="pole_normal_force_x").values)
    assert float(data["history_time"].sel(sim="two")[1]) == pytest.approx(1.008e-4, rel=1e-3)
    assert "kartT01" in [e["file"] for e in json.loads(data.attrs["source_files"]) if e["run"] == "two"]


def test_appended_runs_keep_the_curves_that_are_there(runs: Path, tmp_path: Path) -> None:
    for name in ("two", "one"):
        crashkit.ingest(runs / name, tmp_path / "out.nc", allow_incomplete=True)
    data = crashkit.open_dataset(tmp_path / "out.nc", chunks=None)
    assert data["sim"].values.tolist() == ["two", "one"]
    assert float(data["history"].sel(sim="two", channel="mass")[0]) == pytest.approx(558.58, rel=1e-4)
    assert np.isnan(data["history_time"].sel(sim="one")).all()


def test_a_damaged_history_is_named_and_nothing_is_written(runs: Path, tmp_path: Path) -> None:
    (runs / "two" / "kartT01").write_bytes(b"\0" * 100)
    with pytest.raises(CrashkitError, match=r"kartT01.*move the file away"):
        crashkit.ingest(runs, tmp_path / "out.zarr", allow_incomplete=True)
    assert not (tmp_path / "out.zarr").exists()


def test_parts_of_different_kinds_with_one_number_are_told_apart() -> None:
    parts = distinct_parts([Part(1, "beam"), Part(2, "box"), Part(1, "sled"), Part(2, "spring")])
    assert [(p.id, p.name) for p in parts] == [(1, "beam"), (2, "box"), (3, "sled"), (4, "spring")]
