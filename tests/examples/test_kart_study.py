"""The study's driver: everything is made, in order, and nothing twice; at night on the embedded campaign with two epochs."""

from __future__ import annotations

import importlib
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from crashkit.dataset import demo_data
from evaluation.figures import Sheet, styles

HOME = Path(__file__).parents[2] / "examples" / "kart_study"
MODULES = ("plan", "study", "results", "rigid")
SMALL = """
short = ("level.epochs=2", "level.regression=network", "levels=[3, 2]")
MH, POD_GPR = Kind("mh", "mh", short), Kind("pod-gpr", "pod-gpr", ("pod.modes=[4, 8]", "pod.inputs=trajectory"))
TABLE, CURVES = (MH, POD_GPR), (POD_GPR,)
"""


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """The study's modules from a copy whose plan fits the embedded campaign: 36 runs, 27 of which train."""
    copy = tmp_path / "kart_study"
    shutil.copytree(HOME, copy, ignore=shutil.ignore_patterns("__pycache__"))
    text = (copy / "plan.py").read_text(encoding="utf-8")
    for full, small in (
        ("RUNS, TRAIN = 120, 96", "RUNS, TRAIN = 36, 27"),
        ('NODES = "1165,292,73"', 'NODES = "300,75,19"'),
        ("SIZES = (12, 24, 48)", "SIZES = (6,)"),
        ("\n# What else was tried", SMALL + "\n# What else was tried"),
    ):
        assert full in text
        text = text.replace(full, small)
    (copy / "plan.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(copy))
    for name in MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield {name: importlib.import_module(name) for name in MODULES}
    for name in MODULES:
        sys.modules.pop(name, None)


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


def test_a_quick_study_ingests_coarsens_trains_every_job_and_reports_once_each(modules, tmp_path, monkeypatch):
    study, plan, commands, written = modules["study"], modules["plan"], [], []
    monkeypatch.setattr(study, "crashkit", done_by(commands))
    monkeypatch.setattr(modules["results"], "write_results", lambda *given: written.append(given) or [])
    home = tmp_path / "s"
    monkeypatch.setattr(sys, "argv", ["study.py", "kart.h5", "-o", str(home), "--quick"])
    study.main()
    assert [c[0] for c in commands[:2]] == ["ingest", "coarsen"]
    assert commands[0] == ("ingest", "kart.h5", "-o", str(home / "kart.zarr"))
    trained = [Path(c[c.index("-o") + 1]) for c in commands if c[0] == "train"]
    alone = [plan.Job(plan.alone(kind)) for kind in plan.TABLE if kind.model in plan.NETWORKS]
    assert sorted(trained) == sorted(home / job.folder for job in [*plan.jobs(1, True), *alone])
    assert trained[-len(alone) :] == [home / job.folder for job in alone], "timed when nothing else runs"
    last = commands[-1]
    assert last[:2] == ("evaluate", str(home / "kart.zarr"))
    assert last[2 : last.index("-o")] == tuple(str(home / plan.Job(kind, 0).folder) for kind in plan.TABLE)
    assert last[last.index("--test") + 1] == "27:36"
    assert written == [(home / "kart.zarr", home, 1, True)]

    commands.clear()
    study.main()
    assert commands == [], "what is finished is kept"


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_a_quick_study_leaves_report_tables_and_curves_and_does_nothing_twice(modules, tmp_path, monkeypatch):
    study = modules["study"]
    monkeypatch.setattr(sys, "argv", ["study.py", str(demo_data()), "-o", str(tmp_path / "s"), "--quick"])
    study.main()
    results = tmp_path / "s" / "results"
    assert {p.stem for p in results.glob("*.md")} == {"table", "coarse", "paper", "averaged", "goals"}
    curves = (results / "learning_curves.csv").read_text().splitlines()
    assert [line.rsplit(",", 1)[0] for line in curves[1:]] == ["POD-GPR,6", "POD-GPR,27"]
    assert (tmp_path / "s" / "report" / "report.html").stat().st_size > 100_000

    called = []
    monkeypatch.setattr(study, "crashkit", lambda *arguments, **_: called.append(arguments))
    study.main()
    assert called == []


def test_an_interrupted_training_is_resumed(modules, tmp_path, monkeypatch):
    study, job = modules["study"], modules["plan"].Job(modules["plan"].MH)
    called = []
    monkeypatch.setattr(study, "crashkit", lambda *arguments, **_: called.append(arguments))
    study.train(job, tmp_path / "kart.zarr", tmp_path, 1)
    assert "--resume" not in called[0]
    (tmp_path / "models" / ".mh-seed-0.training").mkdir()
    study.train(job, tmp_path / "kart.zarr", tmp_path, 1)
    assert "--resume" in called[1]


def test_every_training_has_a_folder_of_its_own_and_leaves_the_test_runs_alone(modules):
    plan = modules["plan"]
    for short in (False, True):
        todo = plan.jobs(3, short)
        assert len({job.folder for job in todo}) == len(todo)
        for job in todo:
            command = job.command(Path("data"), Path("home"))
            first = int(command[command.index("--test") + 1].split(":")[0])
            assert first == job.runs <= plan.TRAIN


def test_learning_curves_are_drawn_from_their_numbers(modules):
    curves = modules["results"].LearningCurves((6, 27), {"A": [0.03, 0.02], "B": [0.05, 0.04]})
    figure = curves.draw(Sheet(styles=styles(["A", "B"])))
    drawn = [line.get_ydata() for line in figure.axes[0].get_lines()]
    np.testing.assert_allclose(drawn, [[3.0, 2.0], [5.0, 4.0]])
    assert curves.numbers()["mean_node_error_cm"] == pytest.approx([3.0, 2.0, 5.0, 4.0])


def test_ratios_are_taken_between_models_that_are_there(modules):
    found = modules["results"].goals({"MH1": 1.0, "MH2": 1.25, "PODNN": 4.0})
    assert found["ratio"] == ["MH1 / PODNN", "MH1 / MH2"]
    assert found["found"] == [0.25, 0.8]
