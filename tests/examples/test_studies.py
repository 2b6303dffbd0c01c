"""The studies' driver: everything is made, in order, and nothing twice; at night on the embedded campaign with two epochs."""

from __future__ import annotations

import importlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crashkit.dataset import demo_data
from evaluation.figures import Sheet

HOME = Path(__file__).parents[2] / "examples"
DRIVER = (
    "study_driver",
    "study_driver.jobs",
    "study_driver.driver",
    "study_driver.tables",
    "study_driver.curves",
)
OWN = ("plan", "study", "results", "rigid")
STUDIES = ("kart_study", "bumper_study")


def modules_of(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """The driver's modules and those of a study, by their last name; none stays imported for other tests."""
    monkeypatch.syspath_prepend(str(HOME))
    monkeypatch.syspath_prepend(str(HOME / name))
    for module in (*DRIVER, *OWN):
        monkeypatch.delitem(sys.modules, module, raising=False)
    own = [m for m in OWN if (HOME / name / f"{m}.py").exists()]
    found = {m.rpartition(".")[2]: importlib.import_module(m) for m in (*DRIVER[1:], *own)}
    for module in (*DRIVER, *OWN):  # noted, so that leaving the test takes them away
        if module in sys.modules:
            monkeypatch.setitem(sys.modules, module, sys.modules.pop(module))
    return found


@pytest.fixture(params=STUDIES)
def modules(request, monkeypatch):
    return modules_of(request.param, monkeypatch)


@pytest.fixture
def kart(monkeypatch):
    return modules_of("kart_study", monkeypatch)


@pytest.fixture
def small(kart):
    """A plan for the embedded campaign: 36 runs, 27 of which train."""
    jobs = kart["jobs"]
    mh = jobs.Kind("mh", "mh", ("level.epochs=2", "level.regression=network", "levels=[3, 2]"))
    gpr = jobs.Kind("pod-gpr", "pod-gpr", ("pod.modes=[4, 8]", "pod.inputs=trajectory"))
    return jobs.Plan("kart", 36, 27, "300,75,19", table=(mh, gpr), curves=(gpr,), sizes=(6,))


def done_by(commands: list[tuple[str, ...]]):
    """Stands in for `crashkit`: notes the command and leaves the file by which the driver knows that it is done."""

    def crashkit(*arguments, **_):
        words = tuple(map(str, arguments))
        commands.append(words)
        made = {
            "ingest": lambda: Path(words[words.index("-o") + 1]),
            "coarsen": lambda: Path(words[words.index("--picture") + 1]),
            "train": lambda: Path(words[words.index("-o") + 1]) / "model.json",
            "evaluate": lambda: Path(words[words.index("-o") + 1]) / "report.json",
        }[words[0]]()
        made.parent.mkdir(parents=True, exist_ok=True)
        made.write_text("{}")

    return crashkit


@pytest.fixture
def commands(kart, monkeypatch):
    """What the driver ran; nothing is really run."""
    out: list[tuple[str, ...]] = []
    monkeypatch.setattr(kart["driver"], "crashkit", done_by(out))
    return out


def folders(commands, what: str) -> list[Path]:
    return [Path(c[c.index("-o") + 1]) for c in commands if c[0] == what]


def test_a_study_ingests_coarsens_trains_every_job_and_reports_once_each(kart, small, commands, tmp_path):
    driver, written = kart["driver"], []

    def tables(study):
        written.append(study)
        return []

    given = ["kart.h5", "-o", str(tmp_path), "--seeds", "2", "--jobs", "1"]
    driver.main(small, tables, "", given)
    data = str(tmp_path / "kart.zarr")
    assert commands[0] == ("ingest", "kart.h5", "-o", data)
    assert commands[1][:2] == ("coarsen", data)
    assert folders(commands, "train") == [tmp_path / job.folder for job in [*small.jobs(2), *small.timed()]]
    last = commands[-1]
    assert last[:2] == ("evaluate", data)
    assert last[2 : last.index("-o")] == tuple(str(tmp_path / job.folder) for job in small.compared(2))
    assert last[last.index("--test") + 1] == "27:36"
    assert [(s.data, s.home, s.seeds, s.missing()) for s in written] == [(Path(data), tmp_path, 2, [])]

    commands.clear()
    driver.main(small, tables, "", given)
    assert commands == [], "what is finished is kept"


def test_a_quick_study_shares_the_dataset_and_keeps_its_models_apart(kart, small, commands, tmp_path):
    driver = kart["driver"]
    driver.main(small, lambda study: [], "", ["kart.h5", "-o", str(tmp_path), "--no-report"])
    commands.clear()
    driver.main(small, lambda study: [], "", ["kart.h5", "-o", str(tmp_path), "--quick"])
    assert {c[0] for c in commands} == {"train", "evaluate"}
    assert {folder.parents[1] for folder in folders(commands, "train")} == {tmp_path / "quick"}


def test_trained_is_only_what_was_asked_for_and_the_rest_is_named(kart, small, commands, tmp_path, capsys):
    seen = []
    given = ["kart.h5", "-o", str(tmp_path), "--seeds", "1", "--only", "pod-gpr*"]
    kart["driver"].main(small, lambda study: seen.append(study.compared()) or [], "", given)
    assert {f.name for f in folders(commands, "train")} == {"pod-gpr-seed-0", "pod-gpr-6-runs-seed-0"}  # side by side
    assert [job.folder.name for job in seen[0]] == ["pod-gpr-seed-0"]
    assert "not trained: mh-seed-0" in capsys.readouterr().out


def test_the_report_is_made_again_once_more_models_are_trained(kart, small, commands, tmp_path):
    given = ["kart.h5", "-o", str(tmp_path), "--seeds", "1"]
    kart["driver"].main(small, lambda study: [], "", [*given, "--only", "pod-gpr*"])
    commands.clear()
    (tmp_path / "report" / "report.json").touch()
    report = (tmp_path / "report" / "report.json").stat().st_mtime_ns
    kart["driver"].main(small, lambda study: [], "", [*given, "--no-report"])
    os.utime(tmp_path / "models" / "mh-seed-0" / "model.json", ns=(report + 10**9, report + 10**9))
    kart["driver"].main(small, lambda study: [], "", given)
    assert commands[-1][0] == "evaluate"
    assert "--overwrite" in commands[-1]


def test_coarse_runs_are_read_and_learnt_from_where_they_are_given(kart, small, commands, tmp_path):
    jobs = kart["jobs"]
    both = jobs.Kind("both", "pod-gpr", note="with coarse runs", coarse=True)
    plan = replace(small, table=(*small.table, both), coarse="coarse")
    kart["driver"].main(plan, lambda study: [], "", ["kart.h5", "-o", str(tmp_path), "--seeds", "1"])
    assert not any("--coarse" in command for command in commands)
    given = ["kart.h5", "--coarse", "coarse.h5", "-o", str(tmp_path), "--seeds", "1"]
    commands.clear()
    kart["driver"].main(plan, lambda study: [], "", given)
    coarse = str(tmp_path / "coarse.zarr")
    assert commands[0] == ("ingest", "coarse.h5", "-o", coarse)
    (trained,) = (command for command in commands if command[0] == "train")
    assert trained[2:4] == ("-o", str(tmp_path / "models" / "both-seed-0"))
    assert trained[-2:] == ("--coarse", coarse)


def test_an_interrupted_training_is_resumed(kart, small, commands, tmp_path):
    study = kart["driver"].Study(small, tmp_path / "kart.zarr", tmp_path, 1)
    first, second = small.jobs(1)[:2]
    (tmp_path / "models" / f".{first.folder.name}.training").mkdir(parents=True)
    kart["driver"].train(first, study, 1)
    kart["driver"].train(second, study, 1)
    assert ["--resume" in command for command in commands] == [True, False]


def test_every_training_has_a_folder_of_its_own_and_leaves_the_test_runs_alone(modules):
    plan = modules["plan"].PLAN
    for short in (False, True):
        todo = plan.jobs(3, short)
        assert len({job.folder for job in todo}) == len(todo)
        assert set(plan.compared(3, short)) <= set(todo)
        for job in todo:
            command = plan.command(job, Path("data"), Path("home"))
            held, runs = command[command.index("--test") + 1].split(":")
            assert int(held) == (job.runs or plan.train) <= plan.train
            assert int(runs) == plan.runs


def test_every_setting_of_the_plans_is_one(modules):
    from surrogates.settings import settings

    for job in modules["plan"].PLAN.jobs(1):
        assert settings(job.kind.model, overrides=job.kind.settings).model == job.kind.model


def test_learning_curves_are_drawn_from_their_numbers(kart):
    tables = kart["tables"]
    labels = ["POD-GPR", "POD-GPR without physics", "MH1"]
    curves = tables.LearningCurves((6, 27), dict(zip(labels, [[0.03, 0.02], [0.05, 0.04], [np.nan, 0.01]])), "mm")
    figure = curves.draw(Sheet(styles=tables.curve_styles(labels)))
    lines = figure.axes[0].get_lines()
    assert [line.get_ydata().tolist() for line in lines] == [[30.0, 20.0], [50.0, 40.0], [10.0]]
    assert lines[0].get_color() == lines[1].get_color() != lines[2].get_color()
    assert lines[0].get_linestyle() != lines[1].get_linestyle()
    assert curves.numbers()["mean_node_error_mm"][:4] == pytest.approx([30.0, 20.0, 50.0, 40.0])


def test_curves_of_two_structures_stand_side_by_side_in_their_own_units(kart, tmp_path):
    tables, side = kart["tables"], kart["curves"]
    of = {"a": ("cm", [0.03, np.nan]), "b": ("mm", [0.002, 0.001])}
    for name, (unit, errors) in of.items():
        written = tables.to_csv(tables.LearningCurves((6, 27), {"POD-GPR": errors, "MH1": [0.5, 0.5]}, unit).numbers())
        (tmp_path / f"{name}.csv").write_text(written)
    files = [f"{name}={tmp_path / name}.csv" for name in of]
    side.main([*files, "-o", str(tmp_path / "both"), "--models", "POD-GPR"])
    assert (tmp_path / "both.png").stat().st_size > 1000
    assert (tmp_path / "both.csv").read_text().splitlines()[1:] == [
        "a,POD-GPR,6,30", "a,POD-GPR,27,", "b,POD-GPR,6,2", "b,POD-GPR,27,1",
    ]  # fmt: skip


def test_goals_stand_beside_the_models_that_are_there(kart):
    curves = kart["tables"].LearningCurves((48, 96), {"MH1": [0.01, 0.009], "POD-GPR": [np.nan, 0.007]})
    found = kart["results"].reached({"MH1": 0.008}, curves, 96)
    assert found["MH1", 96] == 0.008, "the mean over seeds, where there are several"
    shown = kart["results"].goals(found)
    assert list(zip(*shown.values())) == [("MH1", 96, 0.8, 0.61), ("MH1", 48, 1.0, 0.8)]


@pytest.fixture
def finished(kart, small, tmp_path, monkeypatch):
    """A study with two kinds of PODNN, one of them with two seeds, whose models say their level alone."""
    jobs = kart["jobs"]
    wide = jobs.Kind("podnn-wide", "podnn", ("level.latent=48",), "with 48 modes")
    plan = replace(small, table=(jobs.Kind("podnn", "podnn"), wide, small.table[1]), unit="mm")
    study = kart["driver"].Study(plan, tmp_path / "kart.zarr", tmp_path, 2)
    compared = plan.compared(2)
    for job in (*compared[:3], compared[4]):  # of podnn two seeds, of the others one
        (tmp_path / job.folder).mkdir(parents=True)
        (tmp_path / job.folder / "model.json").write_text("{}")

    class Loaded:
        def __init__(self, folder):
            self.surrogate = self
            self.level_names = {"POD-GPR" if "gpr" in Path(folder).name else "PODNN": 0}

    monkeypatch.setattr(kart["tables"].crashkit, "load_model", Loaded)
    errors = {"PODNN (podnn)": (2.0, 4.0), "PODNN (podnn-wide-seed-0)": (1.0, 1.0), "POD-GPR": (1.0, 2.0)}
    row = dict.fromkeys(kart["tables"].SHOWN, 1.0) | {"training_s": 9.0}
    shown = [row | {"model": label, "error_cm": float(np.mean(of))} for label, of in errors.items()]
    (tmp_path / "report" / "tables").mkdir(parents=True)
    (tmp_path / "report" / "report.json").write_text(json.dumps({"performance": shown}))
    lines = [",".join(["run", *(f"{label} (cm)" for label in errors)])]
    lines += [",".join([f"run_{k}", *(str(of[k]) for of in errors.values())]) for k in range(2)]
    (tmp_path / "report" / "tables" / "runs.csv").write_text("\n".join(lines))
    return study


def test_kinds_of_one_model_are_told_apart_by_their_notes(kart, finished):
    tables = kart["tables"]
    found = tables.performance(finished, tables.rows(finished))
    assert found["model"] == ["PODNN", "PODNN with 48 modes", "POD-GPR"]
    assert found["error_mm"] == pytest.approx([30.0, 10.0, 15.0])
    assert found["training_s"] == [9.0] * 3


def test_intervals_hold_the_mean_and_compare_run_by_run(kart, finished):
    tables = kart["tables"]
    found = tables.intervals(finished, tables.rows(finished), "POD-GPR")
    assert found["error_mm"] == pytest.approx([30.0, 10.0, 15.0])
    assert found["from"] == pytest.approx([20.0, 10.0, 10.0])
    assert found["to"] == pytest.approx([40.0, 10.0, 20.0])
    assert found["more_than_POD-GPR"][:2] == pytest.approx([15.0, -5.0])
    assert found["better_on_runs"] == [0, 1, None]


def test_what_is_not_trained_is_listed_by_model_runs_and_seeds(kart, finished):
    found = kart["tables"].not_trained(finished)
    assert list(zip(*found.values())) == [("pod-gpr", 6, "0"), ("podnn-wide", 27, "1"), ("pod-gpr", 27, "1")]
    assert kart["tables"].markdown(found).splitlines()[0] == "| model | training runs | seeds |"


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_a_quick_study_leaves_report_tables_and_curves_and_does_nothing_twice(kart, small, tmp_path, monkeypatch):
    driver, results = kart["driver"], kart["results"]
    monkeypatch.setattr(results, "MH", small.table[0])
    monkeypatch.setattr(results, "POD_GPR", small.table[1])
    given = [str(demo_data()), "-o", str(tmp_path / "s"), "--quick"]
    driver.main(small, results.tables, "", given)
    folder = tmp_path / "s" / "quick" / "results"
    assert {p.stem for p in folder.glob("*.md")} == {
        "table",
        "intervals",
        "frontal",
        "averaged",
        "goals",
        "coarse",
        "worth",
        "regressions",
        "not_trained",
    }
    curves = (folder / "learning_curves.csv").read_text().splitlines()
    assert [line.rsplit(",", 1)[0] for line in curves[1:]] == ["POD-GPR,6", "POD-GPR,27"]
    assert (tmp_path / "s" / "quick" / "report" / "report.html").stat().st_size > 100_000

    called = []
    monkeypatch.setattr(driver, "crashkit", lambda *arguments, **_: called.append(arguments))
    driver.main(small, results.tables, "", given)
    assert called == []
