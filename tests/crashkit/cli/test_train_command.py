"""`crashkit train`, `predict` and `export` on a small dataset: what they write, say, and refuse."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import netCDF4
import numpy as np
import plate
import pytest
import torch
import xarray as xr
from typer.testing import CliRunner

import crashkit
from crashkit.api.campaign import open_campaign
from crashkit.api.predict import predict
from crashkit.api.source import source_of
from crashkit.cli import app
from crashkit.errors import DataError
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.store import write_hierarchy
from crashkit.writers.paraview import read_state
from data_schema.levels import Level
from surrogates.settings import settings
from surrogates.storage.folder import load
from surrogates.storage.tested import BandCheck, note_held
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

UNITS = {"impact_speed": "m s-1", "impact_angle": "degree", "yield_stress": "Pa"}
ASKED = {"impact_speed": 20.0, "impact_angle": "5deg", "yield_stress": "400 MPa"}


def dataset(runs: int = 10) -> xr.Dataset:
    mu = plate.parameters(runs)
    return xr.Dataset(
        {
            "displacement": (("sim", "time", "node", "xyz"), plate.displacement(mu), {"units": "m"}),
            "reference_position": (("node", "xyz"), plate.grid(9), {"units": "m"}),
            "node_id": ("node", np.arange(1, 82)),
            "face_nodes": (("face", "corner"), plate.quads(9)),
            "face_part": ("face", np.zeros(64, np.int32)),
            "part_id": ("part", [7]),
            "part_name": ("part", np.array(["plate"], "O")),
            **{n: ("sim", mu[:, k], {"units": u, "role": "parameter"}) for k, (n, u) in enumerate(UNITS.items())},
        },
        coords={"sim": [f"run_{k:03d}" for k in range(runs)], "time": ("time", plate.TIME, {"units": "s"})},
        attrs={"checksum": "abc", "solver": "plate"},
    )


def hierarchy() -> Hierarchy:
    levels = tuple(
        Level(k.index, k.kept, k.faces, k.edges, k.in_finer, k.to_finer, k.to_full, np.zeros(81))
        for k in plate.levels()
    )
    return Hierarchy(81, levels, {})


@pytest.fixture(scope="module")
def crash(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "crash.nc"
    dataset().to_netcdf(path)
    write_hierarchy(path, hierarchy())
    return path


@pytest.fixture(scope="module")
def model(crash: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models") / "mh"
    crashkit.train(crash, folder, "mh", settings=["level.epochs=2"], test="8:10", device="cpu")
    return folder


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [*map(str, arguments)])
    return result.exit_code, result.stdout, result.stderr


def test_training_stores_a_model_that_has_not_seen_the_test_runs(crash: Path, tmp_path: Path) -> None:
    code, out, _ = run(
        "train",
        crash,
        "-o",
        tmp_path / "m",
        "--epochs",
        2,
        "--seed",
        3,
        "--test",
        "8:10",
        "--set",
        "level.latent=3",
        "--json",
    )
    assert code == 0
    told = json.loads(out)
    assert told["held_out_runs"] == ["run_008", "run_009"]
    assert set(told["training_runs"]) | set(told["validation_runs"]) == {f"run_{k:03d}" for k in range(8)}
    stored = load(tmp_path / "m")
    assert stored.level_names == {"MH2": 2, "MH1": 1}
    assert (stored.record.seed, stored.n_latent(1), stored.record.fits[1].epochs) == (3, 3, 2)
    assert [p.name for p in tmp_path.iterdir()] == ["m"]


def test_levels_trained_together_are_shown_with_their_common_training(crash: Path, tmp_path: Path) -> None:
    code, out, said = run(
        "train", crash, "-o", tmp_path / "mh", "--epochs", 2, "--set", "unified=true", "--device", "cpu", "--json"
    )
    assert code == 0, said
    levels = json.loads(out)["levels"]
    assert len(levels) > 1
    assert {(row["epochs"], row["seconds"]) for row in levels} == {(2, levels[0]["seconds"])}


def test_what_is_trained_from_disk_is_what_is_trained_from_arrays(crash: Path, model: Path) -> None:
    stored = load(model)
    opened = open_campaign(source_of(crash), "8:10", symmetry=True)
    campaign = plate.campaign(
        8, parameters=plate.parameters(10)[:8], displacement=of_level(plate.displacement(plate.parameters(10))[:8]),
        dimensions=opened.dimensions, mirrors=opened.mirrors,
    )  # fmt: skip
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the command trains small networks: the order of sums decides the last bits
    try:
        expected = train_surrogate(campaign, settings("mh", overrides=["level.epochs=2"]))
    finally:
        torch.set_num_threads(threads)
    mu = plate.parameters(1, seed=2)[0]
    np.testing.assert_array_equal(stored.predict(mu), expected.predict(mu))


def test_mirror_planes_are_looked_for_where_a_parameter_may_say_the_side() -> None:
    both = dataset(4)
    assert open_campaign(source_of(both), symmetry=True).mirrors
    assert not open_campaign(source_of(both)).mirrors
    one = both.assign(impact_angle=both["impact_angle"] - both["impact_angle"].min())
    assert not open_campaign(source_of(one), symmetry=True).mirrors
    assert open_campaign(source_of(one), symmetry=True, odd=("impact_angle",)).mirrors


def of_level(u: np.ndarray):  # type: ignore[no-untyped-def]
    return lambda level: u if level == 0 else u[:, :, plate.levels()[level - 1].kept]


def test_progress_is_in_centimetres_and_fits_eighty_columns(crash: Path, tmp_path: Path) -> None:
    code, _, err = run("train", crash, "-o", tmp_path / "m", "--model", "podnn", "--epochs", 2, "--test", "8:10")
    assert code == 0
    line = next(line for line in err.splitlines() if line.startswith("PODNN 2/2"))
    assert re.fullmatch(r"PODNN 2/2 \| validation \d+\.\d\d cm \(best \d+\.\d\d, epoch [12]\)", line)
    assert len(line) <= 80


def test_losses_are_shown_when_asked(crash: Path, tmp_path: Path) -> None:
    _, _, err = run("train", crash, "-o", tmp_path / "m", "--model", "podnn", "--epochs", 2, "--test", "8:10", "-v")
    line = next(line for line in err.splitlines() if line.startswith("PODNN 2/2"))
    for word in ("total", "approximation", "reconstruction", "validation", "rate", "epochs/s"):
        assert word in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--model", "mhh"), "model 'mhh' is not known"),
        (("--set", "level.epoch=3"), "level.epoch is not a setting"),
        (("--test", "0:10"), "all 10 runs would be test runs"),
        (("--test", "run_777"), "there is no run 'run_777'"),
        (("--device", "tpu"), "device 'tpu' is not known"),
        (("--resume",), "holds no training to go on from"),
        (("--config", "nothing.yaml"), "nothing.yaml"),
    ],
)
def test_a_wrong_wish_is_one_line_and_leaves_nothing(
    crash: Path, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    code, _, err = run("train", crash, "-o", tmp_path / "m", *arguments)
    assert code == 1
    assert len(err.strip().splitlines()) == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_without_hierarchy_is_refused(tmp_path: Path) -> None:
    dataset().to_netcdf(tmp_path / "bare.nc")
    code, _, err = run("train", tmp_path / "bare.nc", "-o", tmp_path / "m")
    assert code == 1
    assert "no mesh hierarchy" in err
    assert "crashkit coarsen" in err
    assert not (tmp_path / "m").exists()


def test_a_missing_or_foreign_dataset_is_refused(tmp_path: Path) -> None:
    assert "no such dataset" in run("train", tmp_path / "none.zarr", "-o", tmp_path / "m")[2]
    (tmp_path / "text.nc").write_text("hello")
    code, _, err = run("train", tmp_path / "text.nc", "-o", tmp_path / "m")
    assert code == 1
    assert "cannot be opened as a dataset" in err


def test_a_model_that_is_there_stays_unless_asked(crash: Path, model: Path) -> None:
    before = (model / "model.json").read_bytes()
    code, _, err = run("train", crash, "-o", model, "--epochs", 1)
    assert code == 1
    assert "holds a model already" in err
    assert (model / "model.json").read_bytes() == before


def test_another_folder_is_not_written_over(crash: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")
    code, _, err = run("train", crash, "-o", tmp_path, "--overwrite")
    assert code == 1
    assert "is no model folder" in err


@pytest.mark.parametrize("name", ["run.pvd", "run.vtkhdf"])
def test_a_prediction_is_written_for_paraview(model: Path, tmp_path: Path, name: str) -> None:
    code, _, err = run(*asked(model), "--full", "-o", tmp_path / name)
    assert code == 0, err
    time, mesh = read_state(tmp_path / name, -1)
    assert time == pytest.approx(0.03)
    surrogate = load(model)
    expected = surrogate.predict_full([20.0, 5.0, 4e8], [0.03])[0]
    np.testing.assert_allclose(mesh.point_data["displacement"], expected, atol=1e-6)
    assert mesh.n_cells == 64


def asked(model: Path) -> tuple[object, ...]:
    return ("predict", model, *(part for n, v in ASKED.items() for part in ("--param", f"{n}={v}")))


def test_a_coarse_state_becomes_one_file(model: Path, tmp_path: Path) -> None:
    assert run(*asked(model), "--level", 2, "--time", 0.015, "-o", tmp_path / "state.vtu")[0] == 0
    assert [p.name for p in tmp_path.iterdir()] == ["state.vtu"]


def test_arrays_carry_nodes_and_times(model: Path, tmp_path: Path) -> None:
    assert run(*asked(model), "--level", 2, "-o", tmp_path / "run.npz")[0] == 0
    with np.load(tmp_path / "run.npz") as stored:
        assert stored["displacement"].shape == (7, 9, 3)
        np.testing.assert_array_equal(stored["node"], plate.levels()[1].kept)
        np.testing.assert_array_equal(stored["reference_position"], plate.grid(9)[plate.levels()[1].kept])


def test_bands_and_sensitivities_are_written_beside_the_prediction(crash: Path, tmp_path: Path) -> None:
    overrides = ["level.epochs=1", "validation.share=0.5"]
    surrogate = crashkit.train(crash, tmp_path / "m", "mh", settings=overrides, device="cpu").surrogate
    told = tmp_path / "run.npz"
    code, out, err = run(*asked(tmp_path / "m"), "--full", "--band", 0.8, "--sensitivity", "--json", "-o", told)
    assert code == 0, err
    names = [f"displacement_by_{name}" for name in UNITS]
    told_band = json.loads(out)
    assert told_band["arrays"] == ["displacement", "half_width", *names]
    widths = surrogate.band(0.8, full=True, parameters=np.array([20.0, 5.0, 4e8]))
    assert told_band["band"]["mean_half_width_m"] == pytest.approx(float(widths.mean()), rel=1e-4)
    assert told_band["band"]["runs_behind"] == surrogate.bands[1, True].runs
    note_held(tmp_path / "m", {"MH1": BandCheck(0.5, 3)})
    err = run(*asked(tmp_path / "m"), "--full", "--band", 0.8, "-o", tmp_path / "again.npz")[2]
    assert "band: 80 % of nodes and states within" in err
    assert "on 3 test runs the 90 % band held 50 % of nodes and states: it is too narrow" in err
    mu, step = np.array([20.0, 5.0, 4e8]), np.array([0.01, 0.0, 0.0])
    slope = (surrogate.predict_full(mu + step) - surrogate.predict_full(mu - step)) / 0.02
    with np.load(told) as stored:
        assert stored["half_width"].shape == (7, 81)
        np.testing.assert_allclose(stored["half_width"], surrogate.band(0.8, full=True, parameters=mu), rtol=1e-6)
        np.testing.assert_allclose(stored[names[0]], slope, atol=2e-2 * np.abs(slope).max())


def test_parameters_in_other_units_are_the_same(model: Path) -> None:
    plain = predict(model, {"impact_speed": 20, "impact_angle": 5, "yield_stress": 4e8})
    units = predict(model, {"impact_speed": "72 km/h", "impact_angle": "5deg", "yield_stress": "0.4GPa"})
    np.testing.assert_allclose(units["displacement"], plain["displacement"], rtol=1e-6, atol=1e-9)
    assert plain["displacement"].dims == ("time", "node", "xyz")
    assert plain["displacement"].attrs["units"] == "m"


def test_outside_the_trained_range_there_is_a_warning_with_the_range(model: Path, tmp_path: Path) -> None:
    speed = load(model).record.ranges.high[0] + 1
    with pytest.warns(UserWarning, match=rf"impact_speed = {speed:g} m s-1 is outside the trained range 1\d"):
        predict(model, {**ASKED, "impact_speed": speed})
    rest = asked(model)[4:]
    code, _, err = run("predict", model, "--param", f"impact_speed={speed}", *rest, "-o", tmp_path / "run.npz")
    assert code == 0
    assert f"warning: impact_speed = {speed:g} m s-1 is outside the trained range" in err


def test_a_warning_with_a_semicolon_is_one_warning(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = ["near a fold: wrong about run_003; compute a run", "and another"]
    monkeypatch.setattr("surrogates.surrogate.Surrogate.hard", lambda *_: said)
    code, out, _ = run(*asked(model), "-o", tmp_path / "run.npz", "--json")
    assert code == 0
    assert json.loads(out)["warnings"] == said


def test_far_outside_nothing_is_predicted_unless_asked(model: Path, tmp_path: Path) -> None:
    rest = asked(model)[4:]
    far = ("predict", model, "--param", "impact_speed=99", *rest, "-o", tmp_path / "run.npz")
    code, _, err = run(*far)
    assert code == 1
    assert "impact_speed = 99 m s-1 is outside the trained range" in err
    assert "--extrapolate" in err
    assert list(tmp_path.iterdir()) == []
    assert run(*far, "--extrapolate")[0] == 0
    with pytest.raises(DataError, match=r"time = 0\.1 s is outside"):
        predict(model, ASKED, time=[0.1])


def test_bare_numbers_are_in_the_unit_of_the_table(crash: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(crash, tmp_path / "table.nc"))
    with netCDF4.Dataset(path, "a") as file:
        file["yield_stress"].table_units = "MPa"
    crashkit.train(path, tmp_path / "m", "podnn", settings=["level.epochs=1"], device="cpu")
    plain = {"impact_speed": "20", "impact_angle": "5"}
    np.testing.assert_array_equal(
        predict(tmp_path / "m", {**plain, "yield_stress": "400"})["displacement"],
        predict(tmp_path / "m", {**plain, "yield_stress": 4e8})["displacement"],
    )
    with pytest.raises(DataError, match="as a number yield_stress is in Pa, so for 400 MPa write '400 MPa'"):
        predict(tmp_path / "m", {**plain, "yield_stress": 400})
    with pytest.raises(DataError, match="without a unit yield_stress is in MPa, so for 4e\\+08 Pa write '4e\\+08 Pa'"):
        predict(tmp_path / "m", {**plain, "yield_stress": "4e8"})
    predict(tmp_path / "m", {**plain, "yield_stress": "4e+08 Pa"})  # as it says
    with pytest.raises(DataError, match=r"the model takes .*yield_stress \(\d\d\d(\.\d+)? to \d\d\d(\.\d+)? MPa\)"):
        predict(tmp_path / "m", {})
    assert "| yield_stress | MPa |" in (tmp_path / "m" / "card.md").read_text()
    code, told, err = run("info", tmp_path / "m")
    assert code == 0, err
    assert re.search(r"yield_stress.*MPa", told)
    assert "levels" in told


def test_a_table_of_runs_is_predicted(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text("run,impact_speed [km/h],impact_angle,yield_stress [MPa],note\na,72,5,400,1\nb,60,5,400,2\n")
    code, out, err = run("predict", model, "--params", table, "-o", tmp_path / "many", "--json")
    assert code == 0, err
    assert [(r["run"], r["nodes"]) for r in json.loads(out)] == [("a", 81), ("b", 81)]
    _, mesh = read_state(tmp_path / "many" / "a.pvd", -1)
    expected = load(model).predict_full([20.0, 5.0, 4e8])[-1]
    np.testing.assert_allclose(mesh["displacement"], expected, atol=1e-6)
    assert mesh.field_data["impact_speed"].tolist() == [20.0]
    assert list(mesh.field_data["model_name"]) == ["MH1 of mh"]


@pytest.mark.parametrize("level", [None, 2])
def test_a_run_of_the_dataset_stands_beside_its_prediction(
    crash: Path, model: Path, tmp_path: Path, level: int | None
) -> None:
    at = () if level is None else ("--level", level)
    wanted = ("predict", model, "--run", "run_008", "--dataset", crash, *at, "-o", tmp_path / "run.vtkhdf")
    code, out, err = run(*wanted, "--json")
    assert code == 0, err
    _, mesh = read_state(tmp_path / "run.vtkhdf", -1)
    nodes = slice(None) if level is None else plate.levels()[1].kept
    with xr.open_dataset(crash) as data:
        np.testing.assert_array_equal(mesh["displacement"], data["displacement"].sel(sim="run_008").values[-1, nodes])
        np.testing.assert_array_equal(mesh["node_id"], data["node_id"].values[nodes])
    np.testing.assert_allclose(
        mesh["error"], np.linalg.norm(mesh["predicted"] - mesh["displacement"], axis=1), rtol=1e-5
    )
    assert not any("says nothing about new runs" in said for said in json.loads(out)["warnings"])
    assert 0 < json.loads(out)["mean_error_m"] < json.loads(out)["largest_error_m"]
    seen = run("predict", model, "--run", "run_000", "--dataset", crash, "-o", tmp_path / "seen.npz")[2]
    assert re.search(r"the model was (trained|tuned) on run_000", seen)


@pytest.mark.parametrize("spoiled", [float("nan"), float("inf")])
def test_a_model_that_gives_no_finite_numbers_is_refused(model: Path, spoiled: float) -> None:
    broken = load(model)
    broken.predict_full = lambda *_: np.full((1, 7, 81, 3), spoiled, np.float32)  # type: ignore[method-assign]
    with pytest.raises(DataError, match="numbers that are not finite"):
        predict(broken, ASKED)


def test_a_parameter_beyond_all_measure_is_refused_or_said(model: Path, tmp_path: Path) -> None:
    rest = asked(model)[4:]
    for more in ((), ("--extrapolate",)):
        arguments = (
            "predict",
            model,
            "--param",
            "impact_speed=1e300",
            *rest,
            *more,
            "--json",
            "-o",
            tmp_path / "x.npz",
        )
        code, out, err = run(*arguments)
        assert code == 1
        assert out == ""
        assert err.startswith("error: ")
        assert not (tmp_path / "x.npz").exists()


def test_a_full_disk_leaves_the_earlier_arrays(model: Path, tmp_path: Path) -> None:
    (tmp_path / "keep.npz").write_bytes(b"earlier")
    script = (
        "import sys\n"
        "from crashkit.errors import OutputError\n"
        "from crashkit.api.predict import predict, write_prediction\n"
        "said = predict(sys.argv[1], {'impact_speed': 20.0, 'impact_angle': 5.0, 'yield_stress': 4e8})\n"
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n"
        "    write_prediction(said, sys.argv[2])\n"
        "except OutputError as error:\n"
        "    print(error)\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", script, str(model), str(tmp_path / "keep.npz")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert told.stdout.count("\n") == 1, told.stderr
    assert "keep.npz: cannot be written" in told.stdout
    assert [p.name for p in tmp_path.iterdir()] == ["keep.npz"]
    assert (tmp_path / "keep.npz").read_bytes() == b"earlier"


def test_inside_the_trained_range_there_is_none(model: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert predict(model, ASKED).attrs["warnings"] == ""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speed": 3}, r"'speed' is not known; the model takes impact_speed \(.* m s-1\), impact_angle"),
        ({"impact_speed": None}, r"impact_speed is missing; the model takes"),
        ({"impact_speed": "fast"}, "expected a number"),
        ({"impact_speed": "20,5"}, "the decimal sign is a point"),
        ({"impact_speed": "20 MPa"}, "'MPa' is not one of impact_speed, which is in m s-1"),
        ({"impact_speed": float("nan")}, "expected a finite number"),
    ],
)
def test_wrong_parameters_are_named(model: Path, change: dict[str, object], message: str) -> None:
    given = {k: v for k, v in {**ASKED, **change}.items() if v is not None}
    with pytest.raises(DataError, match=message):
        predict(load(model), given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("-o", "run.stl"), 1, "expected one of .pvd, .vtkhdf"),
        (("-o", "run.vtu"), 1, "holds one state, and 7 were asked for"),
        (("-o", "run.npz", "--level", "7"), 1, "level 7 was asked for"),
        (("-o", "run.npz", "--time", "soon"), 2, "'soon' is no time; expected times in s or with a unit, such as 15ms"),
        (("-o", "run.npz", "--time", "0:0.03"), 2, "or start:stop:number, such as 0:30ms:4"),
        (("-o", "run.npz", "--time", "0:0.03:0.01"), 2, "'0.01' is no number of times from 2 to"),
        (("-o", "run.npz", "--time", "0:30kg:4"), 2, "is no time"),
        (("-o", "run.npz", "--time", "0.02,0.01"), 2, "expected increasing times"),
        (("-o", "run.npz", "--run", "run_001"), 2, "give one of --param, --params and --run"),
        (("-o", "run.npz", "--param", "impact_speed"), 2, "expected name=value"),
    ],
)
def test_a_wrong_question_is_answered_and_writes_nothing(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], code: int, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    found, _, err = run(*asked(model), *arguments)
    assert found == code
    assert message in " ".join(err.split())
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_model_is_refused(tmp_path: Path) -> None:
    code, _, err = run("predict", tmp_path / "none", "--param", "a=1")
    assert code == 1
    assert "no such model folder" in err


def test_export_writes_a_checked_file(model: Path, tmp_path: Path) -> None:
    code, out, err = run("export", model, "-o", tmp_path / "mh2.pt2", "--level", 2, "--json")
    assert code == 0, err
    assert json.loads(out)["relative_difference"] <= 1e-4
    assert (tmp_path / "mh2.pt2").stat().st_size > 0


def test_the_loaded_model_is_a_surrogate(model: Path) -> None:
    assert isinstance(crashkit.load_model(model).surrogate, Surrogate)


def test_what_a_killed_training_left_is_named(crash: Path, tmp_path: Path) -> None:
    left = tmp_path / ".old.training"
    left.mkdir()
    (left / "training.json").write_text("{}")
    wanted = ("train", crash, "-o", tmp_path / "m", "--model", "podnn", "--epochs", 1, "--test", "8:10")
    assert ".old.training" not in run(*wanted)[2]  # written just now: it may be alive
    os.utime(left / "training.json", (0, 0))
    _, _, err = run(*wanted, "--overwrite")
    assert re.search(
        r"note: \.old\.training .* is left of a training that was killed: it goes on with -o .*old --resume", err
    )
    assert f"next     crashkit evaluate {crash} {tmp_path / 'm'} -o report" in err


def test_several_trainings_are_one_model(crash: Path, tmp_path: Path) -> None:
    few = ("--set", "level.regression=network", "--set", "levels=[2]", "--epochs", 1, "--test", "8:10")
    code, out, err = run("train", crash, "-o", tmp_path / "mean", "--seeds", 2, *few)
    assert code == 0, err
    said = " ".join((out + err).split())
    assert "2 trainings, one after the other: 2 times the time of one" in said
    assert "MH2: the mean of 2 trainings has" in said
    assert load(tmp_path / "mean").seeds == (0, 1)
    code, out, _ = run("info", tmp_path / "mean")
    assert "seeds 0 to 1, the mean of 2 trainings" in out
    code, out, _ = run("train", crash, "-o", tmp_path / "mean", "--seeds", 2, *few, "--overwrite", "--json")
    told = json.loads(out)
    assert told["seeds"] == [0, 1]
    assert set(told["errors_of_each_seed_m"]) == {"0", "1"}
