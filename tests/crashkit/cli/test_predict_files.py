"""`crashkit predict` for other programs: LS-DYNA families, PhysicsNeMo's layout, a table of runs in parallel."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_train_command import dataset, run

import crashkit
from crashkit.readers import reader_for

ASKED = ["-p", "impact_speed=20", "-p", "impact_angle=5deg", "-p", "yield_stress=400MPa"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models") / "gpr"
    quick = ["physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]
    crashkit.train(dataset(10), folder, "pod-gpr", settings=quick)
    return folder


@pytest.mark.parametrize(("name", "options"), [("d3plot", {}), ("run.zarr", {"time_step": 0.005}), ("run.vtp", {})])
def test_files_hold_the_prediction(model: Path, name: str, options: dict, tmp_path: Path) -> None:
    code, _, err = run("predict", model, *ASKED, "-o", tmp_path / name)
    assert code == 0, err
    back = next(iter(reader_for(tmp_path / name).runs(tmp_path / name, **options)))
    said = crashkit.load_model(model).predict({"impact_speed": 20, "impact_angle": 5, "yield_stress": 4e8})
    assert np.abs(back.displacement(0, 7) - said["displacement"].values).max() < 1e-6


def test_rows_of_a_table_in_parallel_are_those_one_by_one(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "runs.csv"
    table.write_text("run,impact_speed,impact_angle,yield_stress [MPa]\na,15,0,300\nb,20,5,400\n")
    for where, more in (("one", ()), ("many", ("--write-series",))):
        code, out, err = run("predict", model, "--params", table, "-o", tmp_path / f"{where}.npz", *more, "--json")
        assert code == 0, err
        assert [row["run"] for row in json.loads(out)] == ["a", "b"]
    for name in "ab":
        one, many = (np.load(tmp_path / f"{where}_{name}.npz") for where in ("one", "many"))
        assert np.array_equal(one["displacement"], many["displacement"])
    code, _, err = run("predict", model, "--params", table, "-o", tmp_path / "d3plot")
    assert code == 0, err
    assert reader_for(tmp_path / "d3plot").runs(tmp_path / "d3plot").names == ("a", "b")


def test_options_that_do_not_belong_together(model: Path, tmp_path: Path) -> None:
    code, _, err = run("predict", model, *ASKED, "--write-series", "-o", tmp_path / "x.npz")
    assert (code, "give it with --params" in err) == (2, True)
    code, _, err = run("predict", model, *ASKED, "--template", "d3plot", "-o", tmp_path / "x.npz")
    assert (code, "a template is for LS-DYNA" in err) == (1, True)


def test_files_that_are_there_are_replaced_only_when_asked_for(model: Path, tmp_path: Path) -> None:
    (tmp_path / "run.npz").write_text("mine")
    code, _, err = run("predict", model, *ASKED, "-o", tmp_path / "run.npz")
    assert (code, "run.npz: is there already; replace it with --overwrite" in err) == (1, True)
    assert (tmp_path / "run.npz").read_text() == "mine"
    assert run("predict", model, *ASKED, "--time", "15ms,0.03", "-o", tmp_path / "run.npz", "--overwrite")[0] == 0
    assert np.load(tmp_path / "run.npz")["time"].tolist() == [0.015, 0.03]


@pytest.mark.parametrize("output", ["out", "out.npz", "d3plot"])
def test_rows_that_would_share_a_file_are_named_before_any_is_predicted(
    model: Path, tmp_path: Path, output: str
) -> None:
    table = tmp_path / "runs.csv"
    table.write_text("run,impact_speed,impact_angle,yield_stress [MPa]\nx/y,15,0,300\nX-Y,20,5,400\n")
    code, _, err = run("predict", model, "--params", table, "-o", tmp_path / output)
    assert (code, "runs.csv: rows 'x/y' and 'X-Y' would both be written to" in err) == (1, True)
    assert not list(tmp_path.glob(f"{output.split('.')[0]}*"))


def test_a_row_that_cannot_be_predicted_is_named_before_any_is(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "runs.csv"
    table.write_text("run,impact_speed,impact_angle,yield_stress [MPa]\na,15,0,300\nb,20,5,40000\n")
    code, _, err = run("predict", model, "--params", table, "-o", tmp_path / "out")
    assert (code, "runs.csv: run b: yield_stress = " in err) == (1, True)
    assert not (tmp_path / "out").exists()
