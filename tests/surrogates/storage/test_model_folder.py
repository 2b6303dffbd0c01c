"""The folder a surrogate is stored in: complete or not there, and refused once it was altered."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import plate
import pytest

from surrogates.errors import ModelFolderError
from surrogates.settings import settings
from surrogates.storage.card import card
from surrogates.storage.folder import _canonical, _sha256, load, save
from surrogates.storage.outline import Outline, outline
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate


@pytest.fixture(scope="module")
def surrogate() -> Surrogate:
    return train_surrogate(plate.campaign(8), settings("mh", overrides=["level.epochs=2"]))


@pytest.fixture
def folder(surrogate: Surrogate, tmp_path: Path) -> Path:
    return save(surrogate, tmp_path / "model")


def test_the_folder_says_what_the_surrogate_is_and_has_seen(folder: Path, surrogate: Surrogate) -> None:
    about = json.loads((folder / "model.json").read_text())
    record = about["record"]
    assert about["settings"]["model"] == "mh"
    assert record["ranges"]["names"] == ["impact_speed", "impact_angle", "yield_stress"]
    assert record["ranges"]["units"] == ["m s-1", "degree", "Pa"]
    assert record["checksum"] == "c0ffee"
    assert record["held_out_runs"] == ["run_900", "run_901"]
    assert len(record["fitted_runs"]) + len(record["validation_runs"]) == 8
    assert record["versions"]["torch"]
    assert set(about["files"]) == {p.name for p in folder.iterdir()} - {"model.json"}


@pytest.mark.parametrize("model", ["pod-gpr", "pod-rbf"])
def test_pod_regressions_come_back_bit_by_bit(model: str, tmp_path: Path) -> None:
    made = train_surrogate(plate.campaign(8), settings(model, overrides=["pod.modes=[3]"]))
    again = load(save(made, tmp_path / "model"))
    mu = plate.parameters(2, seed=3)
    np.testing.assert_array_equal(again.predict(mu), made.predict(mu))


def test_history_ranges_and_card_come_back(folder: Path, surrogate: Surrogate) -> None:
    again = load(folder)
    np.testing.assert_array_equal(again.history(1)["total"], surrogate.history(1)["total"])
    assert again.training_seconds(1) == surrogate.training_seconds(1)
    assert again.record.ranges.names == surrogate.record.ranges.names
    text = (folder / "card.md").read_text()
    assert "| MH1 | 1 | 25 |" in text
    assert "2 runs kept away: run_900, run_901" in text


def test_the_card_says_which_runs_its_errors_are_of(folder: Path) -> None:
    by_folds = (folder / "card.md").read_text()
    assert "## Errors in cross-validation" in by_folds
    assert "Chosen by cross-validation:\n\n- MH2: " in by_folds
    assert "validation runs chose" not in by_folds.lower()
    held = train_surrogate(
        plate.campaign(8), settings("mh", overrides=["level.epochs=1", "level.regression=network", "levels=[2]"])
    )
    assert "## Errors on validation runs" in card(held)
    assert "Validation runs chose the weights kept" in card(held)


def test_an_outline_says_what_the_loaded_model_would(folder: Path) -> None:
    assert outline(folder).levels == Outline.of(load(folder)).levels
    assert (outline(folder).nodes, outline(folder).seeds) == (81, (0,))
    assert str(outline(folder).record) == str(load(folder).record)


def test_an_outline_is_read_without_torch_and_refused_once_a_file_was_altered(folder: Path) -> None:
    code = f"import sys; from surrogates.storage.outline import outline; outline({str(folder)!r}); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
    (folder / "level_1.safetensors").write_bytes(b"other weights")
    with pytest.raises(ModelFolderError, match=r"level_1\.safetensors: was altered"):
        outline(folder)


def test_a_folder_that_says_less_of_itself_is_loaded(folder: Path) -> None:
    about = json.loads((folder / "model.json").read_text())
    del about["nodes"], about["sha256"]
    about["sha256"] = _sha256(_canonical(about))
    (folder / "model.json").write_text(json.dumps(about))
    assert outline(folder).levels == Outline.of(load(folder)).levels


def test_nothing_in_the_folder_is_a_pickle(folder: Path) -> None:
    assert {p.suffix for p in folder.iterdir()} == {".safetensors", ".json", ".md"}


def test_the_mesh_comes_along(folder: Path) -> None:
    again = load(folder)
    np.testing.assert_array_equal(again.points, plate.grid(9))
    np.testing.assert_array_equal(again.faces, plate.quads(9))
    np.testing.assert_array_equal(again.graphs[2].faces, plate.levels()[1].faces)


@pytest.mark.parametrize("name", ["level_1.safetensors", "graphs.safetensors", "history.json", "card.md", "model.json"])
def test_an_altered_file_is_named(folder: Path, name: str) -> None:
    path = folder / name
    content = bytearray(path.read_bytes())
    place = content.rindex(b"0") if name.endswith("json") else len(content) // 2
    content[place] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(ModelFolderError, match=name):
        load(folder)


def test_a_missing_file_is_named(folder: Path) -> None:
    (folder / "level_2.safetensors").unlink()
    with pytest.raises(ModelFolderError, match=r"level_2\.safetensors: is missing"):
        load(folder)


def test_a_folder_of_another_format_is_refused(folder: Path) -> None:
    path = folder / "model.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    with pytest.raises(ModelFolderError, match="has format 99, this crashkit reads"):
        load(folder)


@pytest.mark.parametrize(
    ("made", "message"), [(lambda p: None, "no such model folder"), (lambda p: p.mkdir(), r"holds no model\.json")]
)
def test_what_is_no_model_folder_is_refused(tmp_path: Path, made, message: str) -> None:  # type: ignore[no-untyped-def]
    made(tmp_path / "other")
    with pytest.raises(ModelFolderError, match=message):
        load(tmp_path / "other")


def test_another_folder_is_never_overwritten(surrogate: Surrogate, tmp_path: Path) -> None:
    target = tmp_path / "results"
    target.mkdir()
    (target / "thesis.tex").write_text("years of work")
    with pytest.raises(ModelFolderError, match="results: "):
        save(surrogate, target, overwrite=True)
    assert (target / "thesis.tex").read_text() == "years of work"


def test_an_older_model_is_replaced_only_when_asked(folder: Path, surrogate: Surrogate) -> None:
    with pytest.raises(ModelFolderError, match="holds a model already"):
        save(surrogate, folder)
    save(surrogate, folder, overwrite=True)
    assert load(folder).level_names == surrogate.level_names
    assert [p.name for p in folder.parent.iterdir()] == ["model"]


def test_a_save_that_fails_leaves_nothing_behind(
    surrogate: Surrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("surrogates.storage.folder.save_file", full)
    with pytest.raises(ModelFolderError, match="No space left on device"):
        save(surrogate, tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_names_of_strangers_break_no_table_of_the_card(surrogate: Surrogate) -> None:
    from dataclasses import replace

    record = surrogate.record
    before = record.fitted_runs, record.ranges, record.left_out
    try:
        record.left_out = {}
        record.fitted_runs = ("a|b", "<img src=x>", "line\nbreak")
        record.ranges = replace(record.ranges, names=("x|y", *record.ranges.names[1:]))
        text = card(surrogate)
    finally:
        record.fitted_runs, record.ranges, record.left_out = before
    assert "a\\|b, &lt;img src=x>, line break" in text
    assert "| x\\|y |" in text
