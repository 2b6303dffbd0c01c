"""`crashkit evaluate` on a small dataset with two stored models: the whole way, and everything that stops it."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr
from matplotlib.figure import Figure
from typer.testing import CliRunner

from crashkit.dataset import demo_data, open_dataset

RUNS, STATES = 8, slice(0, 21, 4)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    """A folder with a dataset of eight real runs and two trained models that hold the last three runs out."""
    from crashkit.api.coarsen import coarsen
    from crashkit.api.train import train
    from crashkit.ingestion.ingest import ingest

    folder = tmp_path_factory.mktemp("campaign")
    with h5py.File(demo_data()) as source, h5py.File(folder / "kart.h5", "w") as file:
        for name in ("kart/displacements", "kart/reference_configuration", "kart/faces", "parameter", "time"):
            values = source[name][:]
            if name not in ("kart/faces", "time"):
                values = values[:RUNS]
            values = values[:, STATES] if name == "kart/displacements" else values
            values = values[STATES] if name == "time" else values
            file.create_dataset(name, data=values)
            file[name].attrs.update(source[name].attrs)
        for name in source["kart"].attrs:
            file["kart"].attrs[name] = source["kart"].attrs[name]
    ingest([folder / "kart.h5"], folder / "kart.zarr")
    coarsen(folder / "kart.zarr", [60, 16])
    few = ("level.epochs=2", "level.channels=[3,6]")
    for seed in (0, 1):
        train(folder / "kart.zarr", folder / f"mh{seed}", "mh", settings=(*few, f"seed={seed}"), test="5:8")
    train(folder / "kart.zarr", folder / "podnn", "podnn", settings=("level.epochs=2",), test="5:8")
    return folder


@pytest.fixture
def small(monkeypatch):
    """The report with two figures only: what it looks like is tested elsewhere."""
    monkeypatch.setattr("evaluation.figures.ORDER", ("error_over_time", "floors"))
    monkeypatch.setattr("evaluation.report.report._views", lambda evaluation: ([], ""))


def run(*arguments: object):
    from crashkit.cli import app

    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


def test_the_whole_way(campaign, small, tmp_path):
    out = tmp_path / "report"
    result = run(
        campaign / "kart.zarr",
        campaign / "mh0",
        campaign / "podnn",
        "-o",
        out,
        "--write-vtu",
        "--write-vtkhdf",
        "--vtk-runs",
        "6",
    )
    assert result.exit_code == 0, result.output
    assert "MH1" in result.stdout
    assert "PODNN" in result.stdout
    numbers = json.loads((out / "report.json").read_text())
    assert [r["model"] for r in numbers["performance"]] == ["MH1", "MH2", "PODNN"]
    names = [str(n) for n in open_dataset(campaign / "kart.zarr")["sim"].values]
    assert numbers["test_runs"] == names[5:]
    assert (out / "vtk" / f"{names[6]}.vtkhdf").exists()
    assert (out / "vtk" / f"{names[6]}_mh0_level2.pvd").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report"]
    assert "kart.zarr" in (out / "report.html").read_text(encoding="utf-8")


def test_numbers_are_those_of_asking_the_model(campaign, small, tmp_path):
    from crashkit.api.evaluate import evaluate
    from crashkit.api.predict import load_model

    result = evaluate(campaign / "kart.zarr", [campaign / "podnn"], tmp_path / "report")
    model, data = load_model(campaign / "podnn").surrogate, open_dataset(campaign / "kart.zarr")
    errors = []
    for sim in (5, 6, 7):
        one = data.isel(sim=sim)
        parameters = [float(one[name]) for name in model.record.ranges.names]
        u = model.predict_full(parameters, one["time"].values)
        errors.append(np.linalg.norm(one["displacement"].values - u, axis=-1).mean())
    assert result.scores["PODNN"].mean == pytest.approx(np.mean(errors), rel=1e-5)


def test_two_workers_find_exactly_the_same(campaign, small, tmp_path):
    from crashkit.api.evaluate import evaluate

    both = [evaluate(campaign / "kart.zarr", [campaign / "mh0"], tmp_path / f"by-{n}", workers=n) for n in (1, 2)]
    for label in ("MH1", "MH2"):
        np.testing.assert_array_equal(both[0].scores[label].e2, both[1].scores[label].e2)
        np.testing.assert_array_equal(both[0].scores[label].node_mean, both[1].scores[label].node_mean)
    np.testing.assert_array_equal(both[0].floor(), both[1].floor())


def test_seeds_become_a_spread(campaign, small, tmp_path):
    result = run(campaign / "kart.zarr", campaign / "mh0", campaign / "mh1", "-o", tmp_path / "report", "--json")
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["performance"]
    assert [(r["model"], r["seeds"]) for r in rows] == [("MH1", 2), ("MH2", 2)]
    assert all(r["spread_cm"] > 0 for r in rows)


def test_named_test_runs_are_taken(campaign, small, tmp_path):
    result = run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report", "--test", "7:8", "--json")
    assert result.exit_code == 0, result.output
    assert "All numbers come from a single test run" in (tmp_path / "report" / "report.html").read_text(
        encoding="utf-8"
    )


def test_probes_and_intrusion_can_be_chosen(campaign, small, tmp_path):
    node = int(open_dataset(campaign / "kart.zarr")["node_id"].values[7])
    out = tmp_path / "report"
    result = run(campaign / "kart.zarr", campaign / "podnn", "-o", out, "--probes", node, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads((out / "report.json").read_text())["tables"]["ratings"]["probe_node"][0] == node


def _fails(result, *words: str, code: int = 1) -> None:
    assert result.exit_code == code, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1
    for word in words:
        assert word in lines[0]


def test_a_test_run_that_was_trained_on_is_refused(campaign, tmp_path):
    result = run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report", "--test", "0:8")
    _fails(result, "podnn was trained on", "says nothing")
    assert list(tmp_path.iterdir()) == []


def test_a_model_of_another_dataset_is_refused(campaign, tmp_path):
    from crashkit.ingestion.ingest import ingest

    with h5py.File(campaign / "kart.h5") as source, h5py.File(tmp_path / "other.h5", "w") as file:
        for name in ("kart/displacements", "kart/reference_configuration", "kart/faces", "parameter", "time"):
            file.create_dataset(name, data=source[name][:])
            file[name].attrs.update(source[name].attrs)
        file["kart/displacements"][:, 1:] *= 0.5
    ingest([tmp_path / "other.h5"], tmp_path / "other.zarr")
    result = run(tmp_path / "other.zarr", campaign / "podnn", "-o", tmp_path / "report")
    _fails(result, "podnn was trained on another dataset")


def test_a_run_with_lost_values_is_named(campaign, tmp_path):
    shutil.copytree(campaign / "kart.zarr", tmp_path / "kart.zarr")
    name = str(open_dataset(campaign / "kart.zarr")["sim"].values[6])
    zarr.open_group(tmp_path / "kart.zarr")["displacement"][6, 2:] = np.nan
    result = run(tmp_path / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report")
    _fails(result, name, "missing though nothing erodes")
    assert not (tmp_path / "report").exists()


def test_a_hierarchy_made_anew_is_noticed(campaign, tmp_path):
    from crashkit.api.coarsen import coarsen

    shutil.copytree(campaign / "kart.zarr", tmp_path / "kart.zarr")
    coarsen(tmp_path / "kart.zarr", [61, 17])
    result = run(tmp_path / "kart.zarr", campaign / "mh0", "-o", tmp_path / "report")
    _fails(result, "trained on 60 other nodes than level 1 of the dataset has (61)", "train the model again")


def test_a_dataset_without_hierarchy_is_an_error_for_a_cascade(campaign, tmp_path):
    from crashkit.ingestion.ingest import ingest

    ingest([campaign / "kart.h5"], tmp_path / "kart.zarr")
    _fails(run(tmp_path / "kart.zarr", campaign / "mh0", "-o", tmp_path / "report"), "hierarchy", "coarsen")


def test_a_full_mesh_model_needs_no_hierarchy(campaign, small, tmp_path):
    from crashkit.ingestion.ingest import ingest

    ingest([campaign / "kart.h5"], tmp_path / "kart.zarr")
    result = run(tmp_path / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report", "--json")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--vtk-runs", "nobody", "--write-vtu"], ["nobody"]),
        (["--test", "nobody"], ["nobody"]),
        (["--probes", "99999999"], ["probe at node 99999999"]),
        (["--intrusion", "floor:-x"], ["part 'floor' does not exist"]),
    ],
)
def test_what_does_not_exist_is_named(campaign, tmp_path, arguments, words):
    result = run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report", *arguments)
    _fails(result, *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["--probes", "x"], ["--intrusion", "floor"], ["--workers", "0"]])
def test_what_cannot_be_understood_is_bad_usage(campaign, tmp_path, arguments):
    result = run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report", *arguments)
    assert result.exit_code == 2


def test_missing_inputs_are_named(campaign, tmp_path):
    _fails(run(tmp_path / "no.zarr", campaign / "podnn", "-o", tmp_path / "report"), "no.zarr")
    _fails(run(campaign / "kart.zarr", tmp_path / "no-model", "-o", tmp_path / "report"), "no-model")


def test_a_folder_that_is_no_report_is_left_alone(campaign, tmp_path):
    (tmp_path / "notes.txt").write_text("keep")
    _fails(run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path), "report.json")
    assert (tmp_path / "notes.txt").read_text() == "keep"


def test_an_output_below_a_file_is_an_error(campaign, tmp_path):
    (tmp_path / "file").write_text("x")
    _fails(run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "file" / "report"), "file")


def test_an_evaluation_that_breaks_off_leaves_nothing(campaign, tmp_path, monkeypatch):
    def broken(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("evaluation.report.report.render_page", broken)
    monkeypatch.setattr("evaluation.figures.ORDER", ("floors",))
    _fails(run(campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report"), "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_info_writes_the_data_card(campaign, tmp_path):
    from crashkit.cli import app

    result = CliRunner().invoke(
        app, ["info", str(campaign / "kart.zarr"), "--report", str(tmp_path / "card"), "--json"]
    )
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["report"] == str(tmp_path / "card" / "card.html")
    page = (tmp_path / "card" / "card.html").read_text(encoding="utf-8")
    assert "figure-coverage" in page
    with open_dataset(campaign / "kart.zarr") as dataset:
        assert dataset.attrs["checksum"] in page


@pytest.fixture
def forgetful(monkeypatch):
    """A registry of figures that forgets what a test adds."""
    monkeypatch.setattr("evaluation.figures._FURTHER", {})


def test_a_figure_of_somebody_else_stands_in_the_report(campaign, small, forgetful, tmp_path, monkeypatch):
    out = tmp_path / "report"
    monkeypatch.setattr(sys, "argv", ["add_figure.py", *map(str, (campaign / "kart.zarr", out, campaign / "podnn"))])
    script = Path(__file__).parents[3] / "examples" / "add_figure.py"
    runpy.run_path(str(script), run_name="__main__")
    assert len(script.read_text(encoding="utf-8").splitlines()) < 60
    assert "Error over motion" in (out / "report.html").read_text(encoding="utf-8")
    lines = (out / "figures" / "error_over_motion.csv").read_text().splitlines()
    assert lines[0] == "mean_displacement_cm,PODNN (cm)"
    assert len(lines) == 1 + 3 * 6  # test runs and states
    assert (out / "figures" / "error_over_motion.svg").exists()


def test_a_figure_cannot_take_the_name_of_ours(forgetful):
    from evaluation.errors import EvaluationError
    from evaluation.figures import Kind, register

    with pytest.raises(EvaluationError, match="has a figure 'floors' already"):
        register(Kind("floors", "Mine", lambda evaluation: None))


def test_a_figure_that_cannot_be_loaded_does_not_stop_the_others(forgetful, monkeypatch, caplog):
    from importlib.metadata import EntryPoint

    from evaluation import figures

    broken = EntryPoint("broken", "no.such:module", figures.ENTRY_POINT_GROUP)
    monkeypatch.setattr(figures, "entry_points", lambda group: [broken])
    figures._load_entry_points.cache_clear()
    assert [kind.name for kind in figures.kinds()] == list(figures.ORDER)
    assert "figure broken (no.such:module) cannot be loaded" in caplog.text


def test_a_report_is_replaced_only_when_asked(campaign, small, tmp_path):
    wanted = (campaign / "kart.zarr", campaign / "podnn", "-o", tmp_path / "report")
    assert run(*wanted).exit_code == 0
    (tmp_path / "report" / "mine.txt").write_text("a remark")
    _fails(run(*wanted), "holds a report already", "--overwrite")
    assert (tmp_path / "report" / "mine.txt").exists()
    result = run(*wanted, "--overwrite")
    assert result.exit_code == 0, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("warning: ")]
    assert any("Few test runs" in line for line in lines)


def test_training_runs_are_read_once_and_test_runs_three_times_at_most(campaign, monkeypatch, tmp_path):
    from crashkit.api.train import train

    settings = {
        "kpi": {f"most_{axis}": f"max(displacement(along={axis}))" for axis in "xyz"},
        "physics.clock": "off", "physics.symmetry": "off", "inputs.derived": "off", "pod.modes": [4],
    }  # fmt: skip
    train(campaign / "kart.zarr", tmp_path / "gpr", "pod-gpr", settings=settings, test="5:8")
    # What the page shows of single runs: the worst one, and two training runs that contradict each other.
    monkeypatch.setattr(
        "surrogates.surrogate.Surrogate.hard_runs", lambda model: {model.record.fitted_runs[1]: (0.02, 3.0)}
    )
    monkeypatch.setattr("evaluation.figures.ORDER", ("worst", "folds"))
    reads, get = Counter(), zarr.storage.LocalStore.get

    async def counted(store, key, *arguments, **named):
        if key.startswith("displacement/c."):
            reads[int(key.split(".")[1])] += 1
        return await get(store, key, *arguments, **named)

    monkeypatch.setattr(zarr.storage.LocalStore, "get", counted)
    monkeypatch.setattr("evaluation.drawing.rendering.rendering_problem", lambda: None)
    monkeypatch.setattr("evaluation.drawing.pictures.comparison_picture", lambda *_, **__: Figure())
    monkeypatch.setattr("evaluation.drawing.interactive.interactive_view", lambda *_, **__: "")
    models = (campaign / "mh0", tmp_path / "gpr")
    done = run(campaign / "kart.zarr", *models, "-o", tmp_path / "report", "--write-vtkhdf")
    assert done.exit_code == 0, done.output
    assert "fold" in (tmp_path / "report" / "report.html").read_text()
    assert [reads[k] for k in range(5)] == [1] * 5
    assert sum(reads[k] for k in range(5, 8)) <= 9, reads
