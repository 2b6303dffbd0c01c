"""Public functions take a path or the object in hand, and give labelled objects that say what they are."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import crashkit
from crashkit.dataset import demo_data
from surrogates.storage.tested import BandCheck, held_on_tests

FEW = {"level": {"epochs": 2, "channels": [3]}}
ASKED = {"impact_speed": 22.0, "impact_angle": "10 deg", "yield_stress": "350MPa"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight of the embedded runs with a hierarchy of two levels."""
    folder = tmp_path_factory.mktemp("objects")
    crashkit.ingest(demo_data(), folder / "all.zarr", time=np.linspace(0, 0.028, 5))
    whole = crashkit.open_dataset(folder / "all.zarr", chunks=None)
    few = whole.isel(sim=slice(8)).load()
    del few.attrs["checksum"]
    few.drop_encoding().to_netcdf(folder / "few.nc")
    crashkit.coarsen(folder / "few.nc", nodes=[60, 16])
    return folder / "few.nc"


@pytest.fixture(scope="module")
def runs(data: Path) -> xr.Dataset:
    return crashkit.open_dataset(data)


@pytest.fixture(scope="module")
def model(runs: xr.Dataset) -> crashkit.Model:
    return crashkit.train(runs, model="mh", settings=FEW, seed=1, test="6:8", device="cpu")


def test_training_on_the_dataset_in_hand_is_training_on_its_path(
    data: Path, model: crashkit.Model, tmp_path: Path
) -> None:
    by_path = crashkit.train(data, tmp_path / "mh", "mh", settings=FEW, seed=1, test="6:8", device="cpu")
    asked = [by_path.predict(ASKED), model.predict(ASKED), crashkit.predict(tmp_path / "mh", ASKED)]
    np.testing.assert_array_equal(asked[0]["displacement"], asked[1]["displacement"])
    np.testing.assert_array_equal(asked[0]["displacement"], asked[2]["displacement"])
    assert model.record.held_out_runs == by_path.record.held_out_runs
    assert (model.folder, by_path.folder) == (None, tmp_path / "mh")


def test_a_selection_of_runs_trains_and_is_evaluated(runs: xr.Dataset, data: Path) -> None:
    known = runs.isel(sim=slice(6))
    podnn = crashkit.train(known, model="podnn", settings=FEW, device="cpu")
    assert set(podnn.record.fitted_runs) | set(podnn.record.validation_runs) == {str(n) for n in known["sim"].values}
    result = crashkit.evaluate(runs, podnn)
    assert result.test_names == tuple(str(n) for n in runs["sim"].values[6:])
    by_path = crashkit.evaluate(data, podnn, test="6:8")
    np.testing.assert_array_equal(result.scores["PODNN"].e2, by_path.scores["PODNN"].e2)
    with pytest.raises(crashkit.EvaluationError, match="holds test runs alone; give the training runs, too"):
        crashkit.evaluate(runs.isel(sim=slice(6, 8)), podnn)
    few = crashkit.train(runs.isel(sim=slice(5)), model="podnn", settings=FEW, device="cpu")
    with pytest.raises(crashkit.EvaluationError, match="holds none of the runs the models have seen"):
        crashkit.evaluate(runs.isel(sim=slice(5, 8)), few, test="1:3")


def test_several_models_in_hand_or_stored_are_compared(runs: xr.Dataset, model: crashkit.Model, tmp_path: Path) -> None:
    two = {"validation": {"runs": ["run_004", "run_005"]}}
    other = crashkit.train(runs, tmp_path / "podnn", "podnn", settings={**FEW, **two}, test="6:8", device="cpu")
    result = crashkit.evaluate(runs, [model, tmp_path / "podnn"], tmp_path / "report")
    assert sorted(result.scores) == ["MH1", "MH2", "PODNN"]
    assert (tmp_path / "report" / "report.html").exists()
    held = held_on_tests(tmp_path / "podnn")
    assert held == {"PODNN": BandCheck(float(result.scores["PODNN"].covered.mean()), 2)}
    again = crashkit.evaluate(runs, [model, other])
    np.testing.assert_array_equal(result.scores["PODNN"].e2, again.scores["PODNN"].e2)


def test_models_and_datasets_in_hand_travel_to_other_processes(runs: xr.Dataset, model: crashkit.Model) -> None:
    there = pickle.loads(pickle.dumps((runs, model)))
    np.testing.assert_array_equal(there[1].predict(ASKED)["displacement"], model.predict(ASKED)["displacement"])
    np.testing.assert_array_equal(there[0]["displacement"][2], runs["displacement"][2])


def test_coarsening_a_dataset_in_hand_gives_its_hierarchy(data: Path, runs: xr.Dataset) -> None:
    stored, made = crashkit.open_hierarchy(data), crashkit.coarsen(runs, nodes=[60, 16])
    for level in (1, 2):
        np.testing.assert_array_equal(made[level].kept, stored[level].kept)
    alone = runs.load().drop_encoding()
    with pytest.raises(crashkit.SurrogateError, match="hierarchy"):
        crashkit.train(alone, model="mh", settings=FEW, device="cpu")
    model = crashkit.train(alone, model="mh", settings=FEW, device="cpu", hierarchy=made)
    assert model.levels == {"MH2": 2, "MH1": 1}
    with pytest.raises(crashkit.DataError, match="the hierarchy was made for a mesh of"):
        crashkit.train(alone.isel(node=slice(5)), model="mh", hierarchy=made)


def test_a_path_a_dataset_and_a_selection_are_validated(data: Path, runs: xr.Dataset, tmp_path: Path) -> None:
    assert crashkit.validate(data) == []
    assert crashkit.validate(runs) == []
    crashkit.ingest(demo_data(), tmp_path / "all.zarr")
    some = crashkit.open_dataset(tmp_path / "all.zarr").isel(sim=[3, 5])
    assert crashkit.validate(some) == []
    wrong = some.load().copy(deep=True)
    wrong["displacement"].values[0, 3, 3] += 1e-3
    assert [v.where for v in crashkit.validate(wrong)] == ["results, run run_003"]


def test_what_is_no_crash_dataset_is_said_in_one_line() -> None:
    with pytest.raises(
        crashkit.DataError, match=r"holds no variable .*displacement.*crashkit\.from_arrays|holds no variable"
    ):
        crashkit.train(xr.Dataset({"a": 1.0}), model="podnn")
    with pytest.raises(crashkit.ReadError, match="no such dataset"):
        crashkit.train("nothing.zarr", model="podnn")


def test_a_prediction_is_drawn_with_its_displacement(model: crashkit.Model, runs: xr.Dataset) -> None:
    prediction = model.predict(ASKED, full=True)
    mesh = prediction.crash.to_pyvista(time=0.02)
    assert mesh.active_scalars_name == "displacement"
    moved = prediction["displacement"].sel(time=0.02, method="nearest").values
    np.testing.assert_allclose(mesh.points, runs["reference_position"].values + moved, atol=1e-6)
    assert mesh.n_cells == runs.sizes["face"]
    np.testing.assert_array_equal(mesh.point_data["node_id"], runs["node_id"].values)
    coarse = model.predict(ASKED, level=2).crash.to_pyvista(time=0.02, deform=False)
    kept = model.surrogate.graphs.kept(2)
    np.testing.assert_allclose(coarse.points, runs["reference_position"].values[kept], atol=1e-6)
    assert coarse.n_lines > 0


def test_a_list_of_values_asks_for_several_runs(model: crashkit.Model) -> None:
    several = model.predict({**ASKED, "impact_speed": [20.0, 22.0]})
    assert several["displacement"].dims == ("sim", "time", "node", "xyz")
    np.testing.assert_allclose(several["displacement"][1], model.predict(ASKED)["displacement"], atol=1e-6)
    assert several.crash.parameters == ["impact_speed", "impact_angle", "yield_stress"]
    with pytest.raises(crashkit.DataError, match="2 of impact_speed, 3 of impact_angle; expected as many values"):
        model.predict({**ASKED, "impact_speed": [20, 22], "impact_angle": [0, 1, 2]})


def last_bit(model: crashkit.Model, states: np.ndarray, level: int) -> float:
    """By how much latent numbers change with the last bit of the states."""
    change = np.random.default_rng(0).choice([-1.0, 1.0], states.shape) * np.finfo(np.float32).eps
    others = (states.astype(np.float64) * (1 + change)).astype(np.float32)
    return float(np.abs(model.encode(others, level) - model.encode(states, level)).max())


@pytest.mark.parametrize("level", [1, 2])
def test_states_are_encoded_with_their_labels(model: crashkit.Model, runs: xr.Dataset, level: int) -> None:
    latent = model.encode(runs.isel(sim=[0, 3]), level)
    assert latent.dims == ("sim", "time", "latent")
    assert list(latent["sim"].values) == list(runs["sim"].values[[0, 3]])
    kept = model.surrogate.graphs.kept(level)
    own = runs["displacement"].isel(sim=3, node=kept)
    # One run alone and among others: 32-bit products are summed in another order. Latent numbers of weak modes are small
    # displacements scaled up, so that the last bit of the states, and the order of sums, moves them by 1e-4 of their range.
    bit = last_bit(model, own.values, level)
    assert 0 < bit < 1e-3 < 0.01 * float(np.ptp(latent.values))
    np.testing.assert_allclose(model.encode(own.values, level), latent[1], rtol=0, atol=4 * bit)
    np.testing.assert_allclose(
        model.reconstruct(own, level), model.surrogate.reconstruct(own.values, level), rtol=0, atol=1e-6
    )
    assert latent.sizes["latent"] == model.surrogate.n_latent(level)


def test_a_prediction_is_the_dataset_that_xarray_makes_of_its_arrays(model: crashkit.Model) -> None:
    said = model.predict({**ASKED, "impact_speed": [20.0, 22.0]})
    again = xr.Dataset(
        {n: (v.dims, v.values, v.attrs) for n, v in said.data_vars.items()},
        {n: (v.dims, v.values, v.attrs) for n, v in said.coords.items()},
        said.attrs,
    )
    xr.testing.assert_identical(said, again)
    assert {n: type(index) for n, index in said.xindexes.items()} == {n: type(i) for n, i in again.xindexes.items()}
    assert said.sel(time=0.014, node=said["node"].values[3], sim="prediction_1")["displacement"].shape == (3,)


def test_a_model_is_stored_later(model: crashkit.Model, tmp_path: Path) -> None:
    alone = crashkit.Model(model.surrogate)
    alone.save(tmp_path / "later")
    np.testing.assert_array_equal(
        crashkit.load_model(tmp_path / "later").predict(ASKED)["displacement"], model.predict(ASKED)["displacement"]
    )
    with pytest.raises(crashkit.OutputError, match="holds a model already"):
        alone.save(tmp_path / "later")


def test_models_and_datasets_say_what_they_are(model: crashkit.Model, runs: xr.Dataset) -> None:
    said = repr(model)
    assert "impact_speed" in said
    assert "2 held out" in said
    assert "MH1" in said
    assert "<td>MH1</td>" in model._repr_html_()
    assert f"{runs.sizes['node']} nodes" in repr(runs.crash)
    assert "impact_speed (m s-1)" in runs.crash._repr_html_()
