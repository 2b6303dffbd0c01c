"""`train --coarse` and `predict --coarse-run`: two meshes of one structure matched, or refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import crashkit
from crashkit.api.coarse_runs import _ranges
from crashkit.api.model import Model
from crashkit.api.predict_runs import predict_runs
from crashkit.api.run_study import study_steps
from crashkit.cli import app
from crashkit.errors import CrashkitError, DataError
from crashkit.writers.d3plot import write_d3plot
from data_schema.mirror import MirrorPlane
from surrogates.data.campaign import Campaign
from surrogates.errors import SurrogateError

TIME = np.linspace(0.0, 0.02, 6)
OFF = {"physics": {"clock": "off", "symmetry": "off"}, "inputs": {"derived": "off"}, "pod": {"modes": [12]}}


def dataset(side: int, runs: range, **changes: object) -> xr.Dataset:
    """A box's lid and floor, `side` nodes along an edge, that dent the more the faster they are hit; runs of a fixed table."""
    axis = np.linspace(0, 1, side)
    x, y = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    number = np.arange(side * side).reshape(side, side)
    faces = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    table = np.random.default_rng(1).uniform([8, 1], [16, 3], (200, 2))[list(runs)]
    speed, thickness = table.T[:, :, None, None]
    at = np.concatenate([np.stack([x, y, np.full(side**2, z)], axis=1) for z in (0.0, 0.1)])
    dent = np.exp(-6 * ((at[:, 0] - 0.5) ** 2 + (at[:, 1] - 0.5) ** 2)) * np.where(at[:, 2] > 0, 1.0, 0.4)
    wave = 1 + 0.8 * np.sin(3 * thickness)
    depth = 0.3 * speed * TIME[:, None] * wave * dent * (0.9 if side < 7 else 1.0)
    u = np.stack([0.1 * depth, np.zeros_like(depth), -depth], axis=-1)
    given: dict[str, object] = {
        "names": [f"run_{k:02d}" for k in runs],
        "face_part": np.repeat([0, 1], len(faces)),
        "part_id": [7, 9],
        "part_names": ["floor", "lid"],
    }
    parameters = changes.pop("parameters", {"speed (m/s)": speed.ravel(), "thickness (mm)": thickness.ravel()})
    moved = np.asarray(changes.pop("moved", 0.0))
    every = changes.pop("time", TIME)
    return crashkit.from_arrays(
        u, every, parameters, at + moved, np.concatenate([faces, faces + side**2]), **{**given, **changes}  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.fixture(scope="module")
def coarse() -> xr.Dataset:
    return dataset(5, range(60))


@pytest.fixture(scope="module")
def model(coarse: xr.Dataset) -> Model:
    return crashkit.train(dataset(9, range(12)), model="pod-gpr", settings=OFF, test="10:", coarse=coarse)


def trained_with(coarse: xr.Dataset) -> Model:
    return crashkit.train(dataset(9, range(6)), model="pod-gpr", settings=OFF, coarse=coarse)


def at(run: int) -> dict[str, float]:
    one = dataset(5, range(run, run + 1))
    return {name: float(one[name][0]) for name in ("speed", "thickness")}


def test_coarse_runs_are_used_without_those_of_test_runs(model: Model) -> None:
    assert model.record.coarse["runs"] == 58
    assert model.record.coarse["twins"] == 10
    assert model.record.coarse["way"] != "fine runs alone"


def test_parts_are_matched_by_number_where_names_differ(coarse: xr.Dataset) -> None:
    renamed = coarse.assign(part_name=("part", np.array(["a", "b"])))
    assert trained_with(renamed).record.coarse["runs"] == 60


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"part_names": ["floor", "roof"], "part_id": [7, 8]}, "has no part lid"),
        ({"moved": [0.0, 0.0, 4.0]}, "another mesh of the same structure"),
        ({"parameters": {"speed (m/s)": np.arange(9.0)}}, "has no parameter thickness"),
        ({"parameters": {"speed (m/s)": np.arange(9.0), "thickness (s)": np.arange(9.0)}}, "thickness is in s"),
        ({"time": 0.5 * TIME}, "compute coarse runs as long"),
    ],
)
def test_what_does_not_match_is_refused_in_one_line(changes: dict[str, object], said: str) -> None:
    with pytest.raises(DataError, match=said) as refused:
        trained_with(dataset(5, range(9), **changes))
    assert "\n" not in str(refused.value)


def faster(coarse: xr.Dataset, times: float) -> xr.Dataset:
    """Speeds of 8 to 16 m/s as so many times as much, still in m/s."""
    return coarse.assign(speed=coarse["speed"] * times)


def test_coarse_runs_at_other_values_altogether_are_refused_with_both_ranges(coarse: xr.Dataset) -> None:
    said = r": speed is 29\.94 to \S+ m/s in the coarse runs and \S+ to 1\d\.\d+ m/s in the fine ones; check the value and its unit"
    with pytest.raises(DataError, match=said):
        trained_with(faster(coarse, 3.6))


def test_coarse_runs_whose_range_holds_hardly_a_fine_run_are_noted(coarse: xr.Dataset) -> None:
    table = dataset(9, range(12))["speed"].values
    rows = np.flatnonzero(coarse["speed"].values >= table.max())
    fast = faster(coarse, 1.0).isel(sim=rows)
    noted = crashkit.train(dataset(9, range(12)), model="pod-gpr", settings=OFF, coarse=fast)
    (line,) = [n for n in noted.record.notes if "check the value and its unit" in n]
    assert "speed is" in line
    assert "\n" not in line


def test_coarse_runs_that_hold_the_fine_ones_are_not_noted(model: Model) -> None:
    assert not [n for n in model.record.notes if "check the value and its unit" in n]


def test_a_mirrored_range_is_enough_where_the_structure_has_a_mirror_plane() -> None:
    plane = MirrorPlane.__new__(MirrorPlane)
    fine = Campaign(
        np.array([[-2.0], [-1.0]]), ("offset",), ("m",), TIME, lambda level: np.zeros(0), 0, mirrors=(plane,)
    )
    assert _ranges(np.array([[1.0], [2.0]]), fine, "coarse.zarr") == ()
    with pytest.raises(DataError, match="offset is 1 to 2 m in the coarse runs and -2 to -1 m in the fine ones"):
        _ranges(np.array([[1.0], [2.0]]), replace(fine, mirrors=()), "coarse.zarr")


def test_too_few_coarse_runs_are_refused_by_name_before_the_fine_ones_are_read(tmp_path: Path) -> None:
    dataset(5, range(2), output=tmp_path / "two.zarr")
    with pytest.raises(DataError, match=r"two\.zarr: has 2 coarse runs; expected at least 4"):
        crashkit.train(
            dataset(9, range(6)), model="pod-gpr", settings=OFF, test="never:read", coarse=tmp_path / "two.zarr"
        )


def test_coarse_runs_that_are_too_few_without_those_of_test_runs_are_refused() -> None:
    with pytest.raises(DataError, match="has 2 coarse runs without those of the test runs; expected at least 4"):
        crashkit.train(dataset(9, range(6)), model="pod-gpr", settings=OFF, test="2:", coarse=dataset(5, range(6)))


def test_the_fine_runs_themselves_are_no_coarse_runs() -> None:
    fine = dataset(9, range(6))
    with pytest.raises(DataError, match=r"is .* itself; expected further runs"):
        crashkit.train(fine, model="pod-gpr", settings=OFF, coarse=fine)


def test_other_models_refuse_coarse_runs_before_they_are_read() -> None:
    with pytest.raises(SurrogateError, match="beneath mh and pod-gpr"):
        crashkit.train(dataset(9, range(6)), model="pod-rbf", coarse="no_such.zarr")


def test_a_prediction_starts_from_a_run_of_a_dataset(model: Model, tmp_path: Path) -> None:
    stored = tmp_path / "coarse.zarr"
    dataset(5, range(70, 73), output=stored)
    said = model.predict(at(71), coarse_run=f"{stored}:run_71", band=0.9)
    true = dataset(9, range(71, 72))["displacement"].values[0]
    alone = model.predict(at(71))["displacement"].values
    error = np.linalg.norm(said["displacement"].values - true, axis=-1).mean()
    assert error < 0.01 * np.linalg.norm(true, axis=-1).mean()
    assert np.abs(alone - said["displacement"].values).max() > 0  # another way to say it
    assert (said["half_width"].values >= 0).all()


def test_a_prediction_starts_from_the_folder_of_a_solver(model: Model, tmp_path: Path) -> None:
    run = dataset(5, range(71, 72))
    write_d3plot(run.isel(sim=0), tmp_path / "d3plot", None, "coarse 71")
    one, other = (model.predict(at(71), coarse_run=r)["displacement"].values for r in (run, tmp_path / "d3plot"))
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_nodes_of_the_run_are_matched_by_number(model: Model) -> None:
    run = dataset(5, range(71, 72))
    turned = run.isel(node=slice(None, None, -1))
    one, other = (model.predict(at(71), coarse_run=r)["displacement"].values for r in (run, turned))
    np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    ("run", "said"),
    [
        (dataset(6, range(71, 72)), "a node lies"),
        (dataset(4, range(71, 72)), "and not node 33"),
        (dataset(5, range(71, 72), moved=[0.0, 0.0, 0.01]), "a node lies 10 mm from its place"),
        (dataset(5, range(72, 73)), "was computed with speed"),
        (dataset(5, range(71, 73)), "holds 2 runs"),
    ],
)
def test_a_run_of_another_mesh_or_of_other_parameters_is_refused(model: Model, run: xr.Dataset, said: str) -> None:
    with pytest.raises(DataError, match=said):
        model.predict(at(71), coarse_run=run)


def test_a_model_of_fine_runs_alone_refuses_a_coarse_run() -> None:
    plain = crashkit.train(dataset(9, range(6)), model="pod-gpr", settings=OFF)
    with pytest.raises(DataError, match="train mh or pod-gpr with --coarse"):
        plain.predict(at(71), coarse_run=dataset(5, range(71, 72)))


def test_the_commands(coarse: xr.Dataset, tmp_path: Path) -> None:
    below, fine = tmp_path / "coarse.zarr", tmp_path / "fine.zarr"
    dataset(5, range(40), output=below)
    dataset(9, range(10), output=fine)
    off = [x for s in ("physics.clock=off", "physics.symmetry=off", "inputs.derived=off") for x in ("--set", s)]
    trained = CliRunner().invoke(
        app,
        ["train", str(fine), "-o", str(tmp_path / "m"), "--model", "pod-gpr", "--coarse", str(below), *off],
    )
    assert trained.exit_code == 0, trained.output
    assert "coarse runs: 40 runs of coarse.zarr" in " ".join(trained.output.split())
    below.rename(tmp_path / "elsewhere.zarr")
    said = CliRunner().invoke(
        app,
        ["predict", str(tmp_path / "m"), "--coarse-run", f"{tmp_path / 'elsewhere.zarr'}:run_20", "-o", str(tmp_path / "p.npz")],
    )  # fmt: skip
    assert said.exit_code == 0, said.output
    assert "POD-GPR from a coarse run, " in " ".join(said.output.split())
    true = dataset(9, range(20, 21))["displacement"].values[0]
    found = np.load(tmp_path / "p.npz")["displacement"]
    assert np.linalg.norm(found - true, axis=-1).mean() < 0.1 * np.linalg.norm(true, axis=-1).mean()


def test_rows_of_a_table_start_from_the_runs_of_their_names(model: Model, tmp_path: Path) -> None:
    stored, table = tmp_path / "coarse.zarr", tmp_path / "table.csv"
    dataset(5, range(70, 72), output=stored)
    rows = [f"run_{k},{at(k)['speed']!r},{1e3 * at(k)['thickness']!r}" for k in (71, 70)]
    table.write_text("run,speed (m/s),thickness (mm)\n" + "\n".join(rows) + "\n")
    predict_runs(model, tmp_path / "p.npz", table=table, coarse_run=stored)
    for k in (70, 71):
        true = dataset(9, range(k, k + 1))["displacement"].values[0]
        found = np.load(tmp_path / f"p_run_{k}.npz")["displacement"]
        assert np.linalg.norm(found - true, axis=-1).mean() < 0.01 * np.linalg.norm(true, axis=-1).mean()


@pytest.mark.parametrize(
    ("table", "given", "message"),
    [
        (False, "nope.zarr:run_70", "nope.zarr:run_70: no such file or folder; expected a coarse run"),
        (False, "coarse.zarr", r"coarse.zarr: holds 2 runs; name one, such as .*coarse.zarr:run_70"),
        (False, "coarse.zarr:run_99", "there is no run 'run_99'"),
        (False, "d3plot", "a solver's files do not say with which parameters; give them with --param"),
        (
            True,
            "coarse.zarr:run_70",
            r"names one coarse run, and a table asks for several; give the dataset, .*coarse.zarr, in",
        ),
        (True, "nope", "nope: no such file or folder"),
        (
            True,
            "coarse.zarr",
            "coarse.zarr: has no run c; expected a coarse run for each row, .* it has run_70, run_71",
        ),
        (True, "d3plot", "d3plot: has no run run_70, nor 1 more of the table's"),
    ],
)
def test_what_goes_together_with_a_coarse_run(
    model: Model, tmp_path: Path, table: bool, given: str, message: str
) -> None:
    dataset(5, range(70, 72), output=tmp_path / "coarse.zarr")
    (tmp_path / "d3plot").mkdir()
    rows = [f"{name},{at(70)['speed']!r},{1e3 * at(70)['thickness']!r}" for name in ("run_70", "c")]
    (tmp_path / "table.csv").write_text("run,speed (m/s),thickness (mm)\n" + "\n".join(rows) + "\n")
    asked = {"table": tmp_path / "table.csv"} if table else {}
    with pytest.raises(CrashkitError, match=message):
        predict_runs(model, tmp_path / "p.npz", coarse_run=f"{tmp_path / given}", **asked)
    assert not list(tmp_path.glob("p*"))


def test_a_study_names_its_coarse_runs(tmp_path: Path) -> None:
    study = tmp_path / "study.yaml"
    study.write_text("dataset: fine.zarr\ntrain: {models: {pod-gpr: {coarse: coarse.zarr}}}\n")
    trained = next(step for step in study_steps(study) if "train" in step.line)
    assert f"--coarse {tmp_path / 'coarse.zarr'}" in trained.line


def test_the_commands_of_a_cascade(tmp_path: Path) -> None:
    below, fine, model = tmp_path / "coarse.zarr", tmp_path / "fine.zarr", tmp_path / "m"
    dataset(5, range(30), output=below)
    dataset(9, range(8), output=fine)
    settings = (
        "physics.clock=off", "physics.symmetry=off", "inputs.derived=off", "level.regression=process", "level.latent=6",
    )  # fmt: skip
    for command in (
        ["coarsen", str(fine), "--nodes", "80,30"],
        ["train", str(fine), "-o", str(model), "--coarse", str(below), *(x for s in settings for x in ("--set", s))],
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
    assert "coarse runs on MH1: process" in " ".join(done.output.split())
    below.rename(tmp_path / "elsewhere.zarr")
    told = CliRunner().invoke(app, ["info", str(model)])
    assert "on MH2: process" in " ".join(told.output.split()), told.output
    truth = dataset(9, range(20, 21))["displacement"].values[0]
    for level, name in ((1, "one.npz"), (None, "full.npz")):
        said = CliRunner().invoke(
            app,
            ["predict", str(model), "--coarse-run", f"{tmp_path / 'elsewhere.zarr'}:run_20", "-o", str(tmp_path / name),
             "--band", "0.9", *(["--level", str(level)] if level else [])],
        )  # fmt: skip
        assert said.exit_code == 0, said.output
        found = np.load(tmp_path / name)
        wanted = truth if level is None else truth[:, found["node"]]
        assert (
            np.linalg.norm(found["displacement"] - wanted, axis=-1).mean() < 0.1 * np.linalg.norm(truth, axis=-1).mean()
        )
