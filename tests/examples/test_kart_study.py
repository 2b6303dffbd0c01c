"""The study's driver on the embedded campaign, with two epochs: everything is made, and nothing twice."""

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
