"""`crashkit predict` for other programs: LS-DYNA families, PhysicsNeMo's layout, a table of runs in parallel."""

from __future__ import annotations

import json
import subprocess
import sys
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


def test_a_run_is_predicted_and_written_without_the_libraries_that_only_other_work_needs(
    model: Path, tmp_path: Path
) -> None:
    arguments = ["crashkit", "predict", str(model), *ASKED, "-o", str(tmp_path / "run.vtkhdf"), "--json"]
    unneeded = ("dask.base", "pint", "torch", "sklearn", "numba", "vtkmodules", "matplotlib")
    code = (
        f"import sys, crashkit.cli as c; sys.argv = {arguments!r}; c.app(standalone_mode=False); "
        f"print([m for m in {unneeded!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert (tmp_path / "run.vtkhdf").exists()


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


TABLE = "run,impact_speed,impact_angle,yield_stress [MPa]\na,15,0,300\nb,20,5,400\nc,18,2,350\n"


@pytest.mark.parametrize("output", ["out", "out.npz"])
def test_a_series_that_was_interrupted_goes_on(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    from crashkit.api import predict as api

    table = tmp_path / "runs.csv"
    table.write_text(TABLE)
    asked = ("predict", model, "--params", table, "-o", tmp_path / output)
    write, written = api.write_prediction, []

    def interrupted(*given, **options):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(given[1])
        return write(*given, **options)

    monkeypatch.setattr(api, "write_prediction", interrupted)
    code, _, err = run(*asked)
    assert (code, "go on with --resume" in err) == (130, True)
    first = written[0].read_bytes()
    assert not list(tmp_path.rglob("*.part"))
    code, _, err = run(*asked)
    assert (code, f"{output}: holds runs of a series; go on with it with --resume" in err) == (1, True)
    code, _, err = run(*asked, "--resume", "--level", 0)
    assert (code, "begun without --level" in err) == (1, True)

    written = ["none is interrupted"] * 2
    code, out, err = run(*asked, "--resume", "--json")
    assert code == 0, err
    assert [(row["run"], row.get("resumed", False)) for row in json.loads(out)] == [
        ("a", True),
        ("b", False),
        ("c", False),
    ]
    assert [path.stem[-1] for path in written[2:]] == ["b", "c"]
    assert Path(json.loads(out)[0]["files"][0]).read_bytes() == first


def test_rows_that_were_added_or_changed_or_lost_are_computed(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "runs.csv"
    table.write_text(TABLE)
    asked = ("predict", model, "--params", table, "-o", tmp_path / "p.npz", "--json")
    assert run(*asked, "--resume")[0] == 0
    (tmp_path / "p_a.npz").unlink()
    table.write_text(TABLE.replace("b,20", "b,21") + "d,17,1,320\n")
    code, out, err = run(*asked, "--resume")
    assert code == 0, err
    assert [row["run"] for row in json.loads(out) if row.get("resumed")] == ["c"]
    assert float(np.load(tmp_path / "p_b.npz")["impact_speed"]) == 21


def test_a_series_never_mixes_two_models_or_takes_files_of_others(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / "runs.csv"
    table.write_text(TABLE)
    other = tmp_path / "other"
    crashkit.train(
        dataset(9), other, "pod-gpr", settings=["physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]
    )
    assert run("predict", model, "--params", table, "-o", tmp_path / "out")[0] == 0
    code, _, err = run("predict", other, "--params", table, "-o", tmp_path / "out", "--resume")
    assert (code, "begun by another model, or the model was trained again" in err) == (1, True)
    (tmp_path / "q_b.npz").write_text("mine")
    code, _, err = run("predict", model, "--params", table, "-o", tmp_path / "q.npz", "--resume")
    assert (code, "q_b.npz: is there already" in err) == (1, True)
    assert (tmp_path / "q_b.npz").read_text() == "mine"
    note = next((tmp_path / "out").glob(".*.jsonl"))
    note.write_text(note.read_text()[:-30])  # killed while it wrote
    code, out, err = run("predict", model, "--params", table, "-o", tmp_path / "out", "--resume", "--json")
    assert (code, [row.get("resumed") for row in json.loads(out)]) == (0, [True, True, None]), err


@pytest.mark.parametrize("time", ["0:30ms:4", "0:0.03:4", "0ms:30:4", "0,10ms,20ms,30ms"])
def test_times_from_start_to_stop(model: Path, tmp_path: Path, time: str) -> None:
    code, _, err = run("predict", model, *ASKED, "--time", time, "-o", tmp_path / "run.npz")
    assert code == 0, err
    assert np.load(tmp_path / "run.npz")["time"] == pytest.approx([0, 0.01, 0.02, 0.03])


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (
            "run,impact_speed (parsec/h),impact_angle,yield_stress",
            "'parsec_h' behind impact_speed is no unit that is known",
        ),
        ("run,impact_speed [parsec/h],impact_angle,yield_stress", "'parsec/h'"),
        ("run,impact_speed,impact_angle", "parameter yield_stress is missing"),
    ],
)
def test_a_unit_that_is_not_known_is_named(model: Path, tmp_path: Path, head: str, message: str) -> None:
    table = tmp_path / "runs.csv"
    table.write_text(f"{head}\na{',20' * head.count(',')}\n")
    code, _, err = run("predict", model, "--params", table, "-o", tmp_path / "out.npz", "--extrapolate")
    assert code == 1
    assert message in err
    assert "runs.csv" in err


def test_titles_may_have_capitals(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "runs.csv"
    table.write_text("Run,Impact speed (km/h),IMPACT ANGLE,Yield stress [MPa]\na,72,5,400\n")
    code, _, err = run("predict", model, "--params", table, "-o", tmp_path / "p.npz")
    assert code == 0, err
    assert float(np.load(tmp_path / "p_a.npz")["impact_speed"]) == pytest.approx(20)


@pytest.mark.parametrize("output", ["out", "Prüf.vtkhdf", "Prüf.zarr", "d3plot"])
def test_runs_keep_their_letters_in_file_names_that_readers_open(model: Path, tmp_path: Path, output: str) -> None:
    table = tmp_path / "runs.csv"
    table.write_text("run,impact_speed,impact_angle,yield_stress [MPa]\nLängsträger,15,0,300\n", "utf-8")
    code, out, err = run("predict", model, "--params", table, "-o", tmp_path / output, "--json")
    assert code == 0, err
    file = Path(json.loads(out)[0]["files"][0])
    assert "Längsträger" in str(file.relative_to(tmp_path))
    options = {"time_step": 0.005} if output.endswith(".zarr") else {}
    place = file.parent if output == "d3plot" else file
    back = next(iter(reader_for(place).runs(place, **options)))
    assert np.abs(back.displacement(0, 7)).max() > 0.1


def test_shares_in_per_cent_and_times_in_the_wrong_unit(model: Path, tmp_path: Path) -> None:
    code, out, err = run("predict", model, *ASKED, "--band", "90%", "-o", tmp_path / "run.npz", "--json")
    assert code == 0, err
    assert json.loads(out)["band"]["share"] == 0.9
    code, _, err = run("predict", model, *ASKED, "--time", "20", "-o", tmp_path / "late.npz")
    assert (code, "times are in s, so for 20 ms write '20ms'" in err) == (1, True), err
