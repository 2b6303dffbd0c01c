"""LS-DYNA families that are written: read back by our reader, by lasso-python and by VTK in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import plate
import pytest
import xarray as xr

from crashkit.errors import CrashkitError
from crashkit.readers import reader_for
from crashkit.readers.base import Run
from crashkit.readers.lasso import d3plot_class
from crashkit.writers.d3plot import write_d3plot

DATA = Path(__file__).parents[2] / "data" / "d3plot"
VTK = """
import json, sys
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOLSDyna import vtkLSDynaReader
r = vtkLSDynaReader(); r.SetFileName(sys.argv[1]); r.SetDeformedMesh(0); r.UpdateInformation()
r.SetTimeStep(r.GetNumberOfTimeSteps() - 1); r.Update()
it = r.GetOutput().NewIterator(); it.InitTraversal(); cells = 0; largest = 0.0
while not it.IsDoneWithTraversal():
    grid = it.GetCurrentDataObject(); cells += grid.GetNumberOfCells()
    largest = max(largest, float(abs(vtk_to_numpy(grid.GetPointData().GetArray("Deflection"))).max())); it.GoToNextItem()
parts = [r.GetPartArrayName(k) for k in range(r.GetNumberOfPartArrays())]
print(json.dumps({"states": r.GetNumberOfTimeSteps(), "cells": cells, "parts": parts, "largest": largest}))
"""


def struck() -> xr.Dataset:
    """The plate in two parts, of which one element fails in the fourth state."""
    u = plate.displacement(np.array([[20.0, 5.0, 3e8]]))[0]
    alive = np.ones((7, 64), bool)
    alive[3:, 10] = False
    return xr.Dataset(
        {
            "displacement": (("time", "node", "xyz"), u),
            "reference_position": (("node", "xyz"), plate.grid(9)),
            "node_id": ("node", np.arange(81) * 3 + 5),
            "face_nodes": (("face", "corner"), plate.quads(9)),
            "face_id": ("face", np.arange(64) + 1000),
            "face_part": ("face", (np.arange(64) > 31).astype(np.int32)),
            "part_id": ("part", [7, 12]),
            "part_name": ("part", np.array(["front plate", "rear plate"])),
            "alive": (("time", "face"), alive),
        },
        coords={"time": plate.TIME},
    )


def read(folder: Path) -> Run:
    return next(iter(reader_for(folder, "d3plot").runs(folder)))


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    run = struck()
    assert [p.name for p in write_d3plot(run, tmp_path / "d3plot")] == ["d3plot", "d3plot01"]
    back = read(tmp_path / "d3plot")
    assert not back.problems
    assert np.allclose(back.time, plate.TIME)
    assert np.abs(back.displacement(0, 7) - run["displacement"].values).max() < 1e-6
    assert np.array_equal(back.mesh.node_id, run["node_id"])
    assert np.array_equal(back.mesh.face_id, run["face_id"])
    assert np.array_equal(back.mesh.face_part, run["face_part"])
    assert [(p.id, p.name) for p in back.mesh.parts] == [(7, "front plate"), (12, "rear plate")]
    assert np.array_equal(back.alive(0, 7), run["alive"])


def test_lasso_python_and_vtk_read_the_same(tmp_path: Path) -> None:
    run = struck()
    write_d3plot(run, tmp_path / "d3plot")
    lasso = d3plot_class()(str(tmp_path / "d3plot" / "d3plot"))
    moved = lasso.arrays["node_displacement"] - lasso.arrays["node_coordinates"]
    assert np.abs(moved - run["displacement"].values).max() < 1e-6
    told = subprocess.run(
        [sys.executable, "-c", VTK, str(tmp_path / "d3plot" / "d3plot")], capture_output=True, text=True, check=False
    )
    found = json.loads(told.stdout)
    assert (found["states"], found["parts"]) == (7, ["front plate", "rear plate"])
    assert found["cells"] in (63, 64)  # VTK may leave out what is deleted
    assert found["largest"] == pytest.approx(float(np.abs(run["displacement"].values[-1]).max()), rel=1e-4)


@pytest.mark.parametrize("name", ["solid_int", "beamip"])
def test_a_template_gives_everything_but_the_states(name: str, tmp_path: Path) -> None:
    known = read(DATA / name)
    mesh, end = known.mesh, float(known.time[-1])
    chosen = np.arange(len(mesh.node_id))[: max(2, len(mesh.node_id) // 2)] if name != "solid_int" else slice(None)
    x = 1e-3 * mesh.position[chosen]  # the template is in mm and ms
    u = np.stack([0 * x, 0.02 * x]).astype(np.float32)
    run = xr.Dataset(
        {"displacement": (("time", "node", "xyz"), u), "reference_position": (("node", "xyz"), x),
         "node_id": ("node", mesh.node_id[chosen])},
        coords={"time": [0.0, 1e-3 * end]},
    )  # fmt: skip
    write_d3plot(run, tmp_path / "d3plot", DATA / name)
    back = read(tmp_path / "d3plot")
    assert back.mesh.parts == mesh.parts
    for array in ("node_id", "face_nodes", "face_id", "cell_nodes", "cell_id"):
        assert np.array_equal(getattr(back.mesh, array), getattr(mesh, array)), array
    assert back.time[-1] == pytest.approx(end, rel=1e-5)
    assert np.abs(back.displacement(0, 2)[:, chosen] - 1e3 * u).max() < 1e-4 * max(
        1.0, float(np.abs(mesh.position).max())
    )


def test_a_template_of_another_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CrashkitError, match="the template is of another"):
        write_d3plot(struck(), tmp_path / "d3plot", DATA / "solid_int")
    assert not (tmp_path / "d3plot").exists()


def test_a_folder_of_something_else_stays(tmp_path: Path) -> None:
    (tmp_path / "d3plot").mkdir()
    (tmp_path / "d3plot" / "thesis.txt").write_text("years of work")
    with pytest.raises(CrashkitError, match="is there and not empty"):
        write_d3plot(struck(), tmp_path / "d3plot")
    assert (tmp_path / "d3plot" / "thesis.txt").exists()
    (tmp_path / "d3plot" / "thesis.txt").unlink()
    write_d3plot(struck(), tmp_path / "d3plot")
    before = {p.name: p.read_bytes() for p in (tmp_path / "d3plot").iterdir()}
    for template in (None, tmp_path / "d3plot"):  # what a solver wrote looks the same
        with pytest.raises(CrashkitError, match="not empty; a d3plot is written into a new folder"):
            write_d3plot(struck(), tmp_path / "d3plot", template)
    assert {p.name: p.read_bytes() for p in (tmp_path / "d3plot").iterdir()} == before


def test_a_node_that_is_gone_stays_where_it_was(tmp_path: Path) -> None:
    run = struck()
    expected = run["displacement"].values.copy()
    run["displacement"].values[4:, 7] = np.nan
    expected[4:, 7] = expected[3, 7]
    write_d3plot(run, tmp_path / "d3plot")
    assert np.abs(read(tmp_path / "d3plot").displacement(0, 7) - expected).max() < 1e-6
