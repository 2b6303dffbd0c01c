"""`crashkit run`: what a study may say, the commands it becomes, and what is done again after a change."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from crashkit.api.run_study import steps
from crashkit.api.study import read_study
from crashkit.cli import app
from crashkit.errors import CrashkitError

STUDY = """
output: results
ingest: {sources: [runs], params: table.csv, units: mm-ms-kg, parts: [floor, 7], allow_incomplete: true}
coarsen: {nodes: [60, 16]}
train:
  test: "5:8"
  models:
    mh: {epochs: 2, set: {level.channels: [3, 6]}}
    small: {model: podnn, preset: paper}
evaluate: {write_vtu: true, probes: [12, 340]}
"""


def test_a_study_becomes_the_commands_one_would_type(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text(STUDY)
    result = CliRunner().invoke(app, ["run", str(tmp_path / "study.yaml"), "--dry-run"])
    told = [line.replace(f"{tmp_path}/", "") for line in result.stdout.splitlines()]
    assert told == [
        "crashkit ingest runs -o results/crash.zarr --params table.csv --units mm-ms-kg --parts floor,7 --allow-incomplete",
        "crashkit coarsen results/crash.zarr --nodes 60,16 --test 5:8 --picture results/levels.png",
        "crashkit train results/crash.zarr -o results/mh --model mh --test 5:8 --epochs 2 --set 'level.channels=[3, 6]'",
        "crashkit train results/crash.zarr -o results/small --model podnn --test 5:8 --preset paper",
        "crashkit evaluate results/crash.zarr results/mh results/small -o results/report --write-vtu --probes 12,340",
    ]
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ingest: {sources: [a], unitz: SI}", "ingest.unitz is not known; did you mean units?"),
        ("inges: {sources: [a]}", "inges is not known; did you mean ingest?"),
        ("ingest: {sources: []}", "ingest.sources"),
        ("output: x", "expected either ingest (with its sources) or dataset"),
        ("dataset: a.zarr\ningest: {sources: [a]}", "expected either ingest"),
        ("dataset: a.zarr\ntrain: {models: {fancy: }}", "model 'fancy' needs a kind"),
        ("dataset: a.zarr\ntrain: {models: {../mh: {model: mh}}}", "cannot be the name of a model folder"),
        ("dataset: a.zarr\ntrain: {models: {mh: {epochs: many}}}", "train.models.mh.epochs"),
        (
            "dataset: a.zarr\ntrain: {models: {mh: {epoch: 3}}}",
            "train.models.mh.epoch is not known; did you mean epochs?",
        ),
        ("a: [", "cannot be read as YAML"),
        ("- a", "holds no names with values"),
        ("!!python/object/apply:os.abort []", "cannot be read as YAML"),
    ],
)
def test_what_is_wrong_in_a_study_is_named_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(CrashkitError) as caught:
        read_study(tmp_path / "study.yaml")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def study(demo_dataset: Path, tmp_path: Path) -> Path:
    shutil.copytree(demo_dataset, tmp_path / "results" / "crash.zarr")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "kart_demo.h5").write_bytes(b"as if")
    (tmp_path / "study.yaml").write_text("ingest: {sources: [runs]}\ntrain: {test: 9, models: {mh: , pod-gpr: }}\n")
    return tmp_path / "study.yaml"


def test_another_source_changes_what_ingest_depends_on_alone(study: Path) -> None:
    ingest, coarsen, mh, gpr, evaluate = steps(read_study(study), study.parent)
    others = [step for step in (coarsen, mh, gpr, evaluate) if step.depends is not None]
    assert ingest.depends is not None
    before = ingest.depends(), [step.depends() for step in others if step.depends is not None]
    (study.parent / "runs" / "more.h5").write_bytes(b"more")
    assert ingest.depends() != before[0]
    assert [step.depends() for step in others if step.depends is not None] == before[1]


def test_runs_are_added_only_while_all_that_was_read_is_there(study: Path, demo_dataset: Path) -> None:
    from crashkit.dataset import demo_data

    (ingest, *_) = steps(read_study(study), study.parent)
    assert ingest.extends is not None
    assert not ingest.extends()  # a file of that name, of another size
    shutil.copy(demo_data(), study.parent / "runs" / "kart_demo.h5")
    (study.parent / "runs" / "more.h5").write_bytes(b"more")
    assert ingest.extends()
