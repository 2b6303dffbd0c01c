"""The layout of PhysicsNeMo Curator, written and read again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_d3plot import struck

from crashkit.errors import CrashkitError
from crashkit.readers import reader_for
from crashkit.writers.physicsnemo import write_physicsnemo


@pytest.mark.parametrize(("name", "options"), [("run.zarr", {"time_step": 0.005}), ("run.vtp", {})])
def test_what_is_written_is_read_again(name: str, options: dict, tmp_path: Path) -> None:
    run = struck()
    run["face_nodes"].values[5, 3] = -1  # a triangle among them
    path = tmp_path / name
    assert write_physicsnemo(run, path) == [path]
    reader = reader_for(path)
    assert reader.name == "physicsnemo"
    back = next(iter(reader.runs(path, **options)))
    assert np.allclose(back.time, run["time"], atol=1e-9)
    assert np.abs(back.displacement(0, 7) - run["displacement"].values).max() < 1e-6
    assert np.array_equal(back.mesh.face_nodes, run["face_nodes"])
    write_physicsnemo(run, path)  # again, over its own


def test_what_has_no_place_in_it_is_refused(tmp_path: Path) -> None:
    run = struck()
    with pytest.raises(CrashkitError, match=r"expected \.zarr or \.vtp"):
        write_physicsnemo(run, tmp_path / "run.vtu")
    run["displacement"].values[4:, 7] = np.nan
    with pytest.raises(CrashkitError, match="nodes are gone"):
        write_physicsnemo(run, tmp_path / "run.zarr")
    other = tmp_path / "crash.zarr"
    (other / "displacement").mkdir(parents=True)
    with pytest.raises(CrashkitError, match="holds something else"):
        write_physicsnemo(struck(), other)
