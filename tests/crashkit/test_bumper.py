"""The embedded bumper through the whole way: parts that share nodes, failing elements, plastic strain, histories."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import crashkit
from crashkit.cli import app
from crashkit.cli.coarsen import show
from crashkit.mesh.store import summarize_hierarchy
from crashkit.writers.paraview import read_state
from evaluation.comparison.result import Evaluation
from evaluation.figures import drawings, sheet_of
from evaluation.figures.kind import drawn
from evaluation.measures.rigid import fit_rigid

PARTS = ("bumper_beam", "crash_box_left", "crash_box_right", "flange_plates", "rail_left", "rail_right", "rear_plate")
# Places of training runs, several of which lose elements, and of two test runs that do.
TRAIN, TEST = [*range(0, 16, 2), 21, 22], [26, 28]


pytestmark = pytest.mark.filterwarnings("ignore:.*outside the trained range:UserWarning")


@pytest.fixture(scope="module")
def bumper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The embedded campaign as a dataset with two coarser meshes; not to be changed."""
    output = tmp_path_factory.mktemp("bumper") / "bumper.zarr"
    crashkit.ingest(crashkit.bumper_data(), output, fields=["plastic_strain"])
    crashkit.coarsen(output, [200, 50])
    return output


@pytest.fixture(scope="module")
def few(bumper: Path) -> xr.Dataset:
    """Ten training and two test runs at every second state."""
    return crashkit.open_dataset(bumper).isel(sim=[*TRAIN, *TEST], time=slice(None, None, 2))


@pytest.fixture(scope="module")
def models(few: xr.Dataset) -> tuple[crashkit.Model, crashkit.Model]:
    """Both kinds of model, as they come: no setting says anything of elements that fail."""
    test = [str(name) for name in few["sim"].values[-2:]]
    targets = ("displacement", "plastic_strain")
    return (
        crashkit.train(few, model="pod-gpr", test=test, settings={"targets": targets}),
        crashkit.train(few, model="mh", test=test, epochs=2),
    )


@pytest.fixture(scope="module")
def evaluation(few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model]) -> Evaluation:
    return crashkit.evaluate(few, models)


def test_it_is_small_enough_for_the_package() -> None:
    assert crashkit.bumper_data().stat().st_size < 6 << 20


def test_parts_numbers_and_life_come_in_as_they_are(bumper: Path) -> None:
    dataset = crashkit.open_dataset(bumper, chunks=None)
    with h5py.File(crashkit.bumper_data()) as file:
        numbers, alive, part = file["run"][:], file["bumper/alive"][:] != 0, file["bumper/part"][:]
        strain, force = file["bumper/plastic_strain"][:], file["history/wall_force_x"][:]
        node_id, element_id = file["bumper/node_id"][:], file["bumper/element_id"][:]
    assert tuple(dataset["part_name"].values) == PARTS
    assert list(dataset["sim"].values) == [f"run_{number:03d}" for number in numbers]
    np.testing.assert_array_equal(dataset["part_id"].values[dataset["face_part"].values], part)
    np.testing.assert_array_equal(dataset["node_id"].values, node_id)
    np.testing.assert_array_equal(dataset["face_id"].values, element_id)
    np.testing.assert_array_equal(dataset["alive"].values, alive)
    np.testing.assert_allclose(dataset["plastic_strain"].values, strain, atol=1e-6)
    np.testing.assert_allclose(dataset["history"].sel(channel="wall_force_x").values, force, rtol=1e-6)
    assert (~alive[:, -1]).any(axis=1).sum() >= 15


def test_displacements_are_missing_exactly_where_no_living_element_holds_a_node(bumper: Path) -> None:
    dataset = crashkit.open_dataset(bumper, chunks=None)
    faces = dataset["face_nodes"].values
    for run in (15, 24):
        alive, u = dataset["alive"].values[run], dataset["displacement"].values[run]
        for state in (0, 15):
            held = np.unique(faces[alive[state]])
            there = np.zeros(len(u[state]), bool)
            there[held[held >= 0]] = True
            np.testing.assert_array_equal(np.isfinite(u[state]).all(axis=1), there)


def test_interpolation_errors_come_by_part_and_average_over_its_nodes(bumper: Path) -> None:
    dataset = crashkit.open_dataset(bumper, chunks=None)
    levels = summarize_hierarchy(bumper)
    assert tuple(levels[0]["lifting_error_of_parts"]) == PARTS
    u = dataset["displacement"].values
    for row, level in zip(levels, crashkit.open_hierarchy(bumper).levels, strict=True):
        lifted = np.stack([[level.to_full @ state for state in run] for run in u[:, :, level.kept]])
        error = np.linalg.norm(lifted - u, axis=-1)
        for k, name in enumerate(PARTS):
            nodes = np.unique(dataset["face_nodes"].values[dataset["face_part"].values == k])
            expected = np.nanmean(error[:, :, nodes[nodes >= 0]])
            assert row["lifting_error_of_parts"][name] == pytest.approx(expected, rel=1e-4, abs=1e-7)


def test_coarsen_prints_them(bumper: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show(bumper, summarize_hierarchy(bumper), "all runs")
    printed = capsys.readouterr().out
    assert "Interpolation error by part" in printed
    assert all(name in printed for name in PARTS)


def test_models_learn_from_what_is_left_without_a_setting(models: tuple[crashkit.Model, crashkit.Model]) -> None:
    for model in models:
        assert model.settings.missing == "auto"
        errors = model.record.errors
        assert errors
        assert all(np.isfinite(error) for error in errors.values())


def test_errors_count_what_is_there(
    few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model], evaluation: Evaluation
) -> None:
    parameters = models[0].parameters
    for place, run in enumerate((-2, -1)):
        one = few.isel(sim=run).compute()
        said = models[0].predict({name: float(one[name]) for name in parameters}, extrapolate=True)
        error = np.linalg.norm(said["displacement"].values - one["displacement"].values, axis=-1)
        assert np.isnan(error).any()
        assert evaluation.scores["POD-GPR"].of_runs[place] == pytest.approx(np.nanmean(error, axis=1).mean(), rel=1e-4)
    for scores in evaluation.scores.values():
        for values in (scores.e2, scores.reconstruction, scores.largest, scores.relative, scores.groups["part"]):
            assert np.isfinite(values).all()


def test_errors_come_by_part(
    few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model], evaluation: Evaluation
) -> None:
    assert evaluation.group_names["part"] == PARTS
    one = few.isel(sim=-1).compute()
    said = models[0].predict({name: float(one[name]) for name in models[0].parameters}, extrapolate=True)
    error = np.linalg.norm(said["displacement"].values - one["displacement"].values, axis=-1)
    for k in range(len(PARTS)):
        nodes = np.unique(one["face_nodes"].values[one["face_part"].values == k])
        expected = np.nanmean(error[:, nodes[nodes >= 0]], axis=1).mean()
        assert evaluation.scores["POD-GPR"].groups["part"][0, 1, k] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_the_evaluation_scores_what_is_said_of_elements(
    few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model], evaluation: Evaluation
) -> None:
    entry = next(e for e in evaluation.entries if e.label == "POD-GPR")
    one = few.isel(sim=-1).compute()
    values = {name: float(one[name]) for name in models[0].parameters}
    said = models[0].predict(values, extrapolate=True)
    scores = evaluation.runs[-1].elements[entry.keys[0]]
    alive, part = one["alive"].values, one["face_part"].values
    called = said["removal_probability"].values > 0.5
    assert scores.removal is not None
    assert (scores.removal.right, scores.removal.called, scores.removal.gone) == (
        int((called & ~alive).sum()), int(called.sum()), int((~alive).sum()),
    )  # fmt: skip
    off = np.abs(said["plastic_strain"].values - one["plastic_strain"].values)
    for k in range(len(PARTS)):
        expected = off[:, part == k][alive[:, part == k]].mean()
        assert scores.fields["plastic_strain"].error[k] == pytest.approx(expected, rel=1e-4)


def test_intrusion_comes_by_part(few: xr.Dataset, evaluation: Evaluation) -> None:
    sensors = evaluation.sensors
    assert sensors is not None
    one = few.isel(sim=-1).compute()
    position, u = one["reference_position"].values, one["displacement"].values
    motion = fit_rigid(position, u)
    along = motion.deformation(position, u) @ sensors.direction
    watched = evaluation.runs[-1].watched
    assert watched is not None
    for k in range(len(PARTS)):
        nodes = np.unique(one["face_nodes"].values[one["face_part"].values == k])
        expected = np.nanmax(along[:, nodes[nodes >= 0]], axis=1)
        np.testing.assert_allclose(watched.parts[:, k], expected, atol=1e-6)


def test_the_report_shows_elements_and_parts(evaluation: Evaluation) -> None:
    found = {
        kind.name: drawing for kind, drawing in drawings(evaluation, ["part_intrusion", "removal", "element_fields"])
    }
    assert set(found) == {"part_intrusion", "removal", "element_fields"}
    sheet = sheet_of(evaluation)
    for drawing in found.values():
        assert len(next(iter(drawing.numbers().values()))) in (2, len(PARTS))
        drawn(drawing, sheet)
    assert "precision" in found["removal"].caption()
    assert "Plastic strain" in found["element_fields"].caption()


def test_a_run_beside_its_truth_in_paraview_hides_what_has_failed(
    bumper: Path, models: tuple[crashkit.Model, crashkit.Model], tmp_path: Path
) -> None:
    models[0].save(tmp_path / "gpr")
    arguments = ["predict", str(tmp_path / "gpr"), "--run", "run_106", "--dataset", str(bumper)]
    told = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "run.pvd"), "--extrapolate", "--json"])
    assert told.exit_code == 0, told.output
    said = json.loads(told.output)
    assert np.isfinite([said["mean_error_m"], said["largest_error_m"], said["relative_error"]]).all()
    _, grid = read_state(tmp_path / "run.pvd")
    dead = ~crashkit.open_dataset(bumper)["alive"].sel(sim="run_106").isel(time=-1).values
    assert dead.sum() > 10
    np.testing.assert_array_equal(np.asarray(grid.cell_data["vtkGhostType"]) != 0, dead)
    assert np.isfinite(np.asarray(grid.points)).all()
    assert {"plastic_strain", "predicted_plastic_strain", "removal_probability"} <= set(grid.cell_data)


def test_a_prediction_says_how_likely_each_element_is_gone(
    few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model]
) -> None:
    ever = (~few["alive"].isel(sim=slice(-2))).any(("sim", "time")).values
    for model in models:
        assert model.surrogate.removal is not None
        scores = model.surrogate.removal.scores
        assert scores["chosen"].loss < scores["rate of the element"].loss
        values = {name: float(few[name][-1]) for name in model.parameters}
        said = model.predict(values, extrapolate=True)["removal_probability"]
        assert said.dims == ("time", "face")
        assert float(said.min()) >= 0
        assert 0.2 < float(said.max()) <= 1
        assert (np.diff(said.values, axis=0) >= 0).all()
        assert not said.values[:, ~ever & ~_mirrored(few, ever)].any()
        dead = ~few["alive"].isel(sim=-1).values
        assert said.values[dead].mean() > 10 * said.values[~dead].mean()


def _mirrored(few: xr.Dataset, faces: np.ndarray) -> np.ndarray:
    """Whether a face is the image at y = 0 of one of `faces` (face,)."""
    corners = few["face_nodes"].values
    at = np.where((corners >= 0)[..., None], few["reference_position"].values[corners], np.nan)
    centre = np.nanmean(at, axis=1)
    image = np.array([np.linalg.norm(centre - one, axis=1).argmin() for one in centre * [1, -1, 1]])
    return faces[image]


def test_elements_that_are_likely_gone_are_hidden(
    few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model], tmp_path: Path
) -> None:
    models[0].save(tmp_path / "gpr")
    values = [
        x for name in models[0].parameters for x in ("--param", f"{name}={float(few[name][-1])!r}{_unit(few, name)}")
    ]
    hidden = {}
    for share in ("0.1", "0.5", "1"):
        arguments = ["predict", str(tmp_path / "gpr"), *values, "-o", str(tmp_path / "new.pvd"), "--extrapolate"]
        told = CliRunner().invoke(app, [*arguments, "--hide-above", share, "--overwrite"])
        assert told.exit_code == 0, told.output
        assert "elements gone at the end" in told.output
        _, grid = read_state(tmp_path / "new.pvd")
        ghost, said = np.asarray(grid.cell_data["vtkGhostType"]) != 0, np.asarray(grid.cell_data["removal_probability"])
        np.testing.assert_array_equal(ghost, said > float(share))
        hidden[share] = ghost.sum()
    assert hidden["0.1"] > hidden["0.5"] >= hidden["1"] == 0


def _unit(few: xr.Dataset, name: str) -> str:
    return "" if few[name].attrs["units"] == "1" else few[name].attrs["units"].replace(" ", "*").replace("s-1", "s**-1")


def test_plastic_strain_is_learnt_beside_the_displacements(
    few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model]
) -> None:
    model = models[0]
    errors = model.surrogate.fields["plastic_strain"].errors
    assert errors["chosen"] < min(errors["mean of the runs"], errors["nearest run"])
    one = few.isel(sim=-1).compute()
    said = model.predict({name: float(one[name]) for name in model.parameters}, extrapolate=True)["plastic_strain"]
    assert said.attrs["units"] == "1"
    there = one["alive"].values
    off = np.abs(said.values - one["plastic_strain"].values)[there].mean()
    mean = few["plastic_strain"].isel(sim=slice(-2)).mean("sim").values
    assert off < 0.8 * np.abs(mean - one["plastic_strain"].values)[there].mean()
    assert float(said.min()) >= 0


def test_a_result_on_elements_is_known_on_every_level(
    bumper: Path, few: xr.Dataset, models: tuple[crashkit.Model, crashkit.Model]
) -> None:
    surrogate = models[0].surrogate
    parameters = np.array([float(few[name][-1]) for name in surrogate.record.ranges.names])
    for level in crashkit.open_hierarchy(bumper).levels:
        coarse = surrogate.predict_field("plastic_strain", parameters, level=level.index)
        fine = surrogate.predict_field("plastic_strain", parameters)
        assert coarse.shape == (few.sizes["time"], len(level.faces))
        assert coarse.max() <= fine.max() + 1e-6
        assert coarse.mean() == pytest.approx(fine.mean(), rel=0.5)


def test_the_card_tells_how_well_elements_are_told(
    models: tuple[crashkit.Model, crashkit.Model], tmp_path: Path
) -> None:
    text = (models[0].save(tmp_path / "model") / "card.md").read_text()
    assert "## Removal of elements" in text
    assert "| rate of the element | - | 0 |" in text
    assert "## plastic_strain" in text


def test_a_training_says_that_runs_were_marked(few: xr.Dataset) -> None:
    notes = ["", "added mass 12 %, the limit is 10 %", *[""] * (few.sizes["sim"] - 2)]
    marked = few.assign(quality_note=("sim", notes))
    model = crashkit.train(marked.isel(sim=slice(4)), model="pod-gpr", settings={"removal": "off"})
    (note,) = [n for n in model.record.notes if "marked" in n]
    assert "ingest marked 1 of the training runs" in note
    assert "added mass 12 %" in note


def test_a_target_that_is_not_there_is_named(few: xr.Dataset) -> None:
    with pytest.raises(crashkit.SurrogateError, match=r"temperature.*plastic_strain.*--fields temperature"):
        crashkit.train(few, model="pod-gpr", settings={"targets": ["displacement", "temperature"]})
