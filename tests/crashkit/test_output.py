"""Folders that are complete or not there."""

from __future__ import annotations

import pytest

from crashkit.errors import OutputError
from crashkit.output import complete_folder, file_name, refuse_there


def test_an_earlier_result_is_replaced_as_a_whole(tmp_path):
    for text in ("old", "new"):
        with complete_folder(tmp_path / "out", "mark.json") as folder:
            (folder / "mark.json").write_text(text)
            (folder / text).write_text("")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["mark.json", "new"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


def test_a_failure_leaves_the_earlier_result(tmp_path):
    with complete_folder(tmp_path / "out", "mark.json") as folder:
        (folder / "mark.json").write_text("old")
    with pytest.raises(ValueError, match="broken"), complete_folder(tmp_path / "out", "mark.json"):
        raise ValueError("broken")
    assert (tmp_path / "out" / "mark.json").read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


def test_what_is_no_earlier_result_is_left_alone(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with (
        pytest.raises(OutputError, match=r"exists and holds no mark\.json"),
        complete_folder(tmp_path / "mine", "mark.json"),
    ):
        pass
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "out").mkdir()
    with complete_folder(tmp_path / "out", "mark.json") as folder:
        (folder / "mark.json").write_text("")
    assert (tmp_path / "out" / "mark.json").exists()


def test_a_full_disk_is_told_with_the_folder_named(tmp_path):
    with pytest.raises(OutputError, match="out: cannot be written"), complete_folder(tmp_path / "out", "mark.json"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_below_a_file_nothing_can_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="no folder can be made"),
        complete_folder(tmp_path / "file" / "out", "mark.json"),
    ):
        pass


def test_what_is_there_is_replaced_only_when_asked_for(tmp_path):
    (tmp_path / "a.pvd").write_text("")
    (tmp_path / "b.pvd").write_text("")
    (tmp_path / "empty").mkdir()
    both = [tmp_path / name for name in ("a.pvd", "b.pvd", "new.pvd", "empty")]
    with pytest.raises(OutputError, match=r"a\.pvd: is there already, as are 1 more .*--overwrite"):
        refuse_there(both, False)
    refuse_there(both, True)
    refuse_there(both[2:], False)


def test_names_become_file_names():
    assert file_name("run 1/2 <x>_MH1") == "run-1-2-x-_MH1"
    assert file_name("../..") == "run"
    assert file_name("Längsträger vorn") == file_name("La\u0308ngstra\u0308ger vorn") == "Längsträger-vorn"
    assert file_name("衝突 1") == "衝突-1"
