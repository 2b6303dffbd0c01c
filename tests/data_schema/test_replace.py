"""Files and folders that are complete or not there."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from data_schema import replace
from data_schema.replace import beside, put_in_place, set_aside


def folder(path, *names):
    path.mkdir()
    for name in names:
        (path / name).write_text(name)
    return path


def names(path):
    return sorted(p.name for p in path.iterdir())


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_replaces_the_one_before(tmp_path, durable):
    for text in ("old", "new"):
        with beside(tmp_path / "model.onnx", durable=durable) as new:
            assert new.name == "model.onnx"
            new.write_text(text)
    assert (tmp_path / "model.onnx").read_text() == "new"
    assert names(tmp_path) == ["model.onnx"]


@pytest.mark.parametrize("durable", [False, True])
@pytest.mark.parametrize("exchange", [False, True])
def test_a_folder_replaces_the_one_before_as_a_whole(tmp_path, monkeypatch, durable, exchange):
    if not exchange:
        monkeypatch.setattr(replace, "_exchange", lambda one, other: False)
    for name in ("old", "new"):
        with beside(tmp_path / "model", durable=durable) as new:
            folder(new, name)
    assert names(tmp_path / "model") == ["new"]
    assert names(tmp_path) == ["model"]


def test_while_it_is_written_nothing_has_its_name(tmp_path):
    with beside(tmp_path / "out") as new:
        new.write_text("half")
        assert not (tmp_path / "out").exists()


def test_a_failure_leaves_what_was_there_and_nothing_else(tmp_path):
    (tmp_path / "out").write_text("old")

    def write_half() -> None:
        with beside(tmp_path / "out") as new:
            new.write_text("half")
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        write_half()
    assert (tmp_path / "out").read_text() == "old"
    assert names(tmp_path) == ["out"]


def test_nothing_written_replaces_nothing(tmp_path):
    (tmp_path / "out").write_text("old")
    with beside(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "old"


def test_folders_above_are_made(tmp_path):
    with beside(tmp_path / "a" / "b" / "out") as new:
        new.write_text("")
    assert (tmp_path / "a" / "b" / "out").exists()


def test_a_folder_that_cannot_be_replaced_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr(replace, "_exchange", lambda one, other: False)
    old, new = folder(tmp_path / "out", "old"), tmp_path / "new"  # which is not there
    with pytest.raises(OSError, match="new"):
        put_in_place(new, old)
    assert names(old) == ["old"]
    assert not set_aside(new, old).exists()


def test_what_a_killed_process_left_is_gone_with_the_next_one(tmp_path):
    code = "import os, sys; from data_schema.replace import beside\nwith beside(sys.argv[1]) as new: new.write_text('half'); os._exit(9)"
    target = tmp_path / "out [1]"
    subprocess.run([sys.executable, "-c", code, target], check=False)
    assert len(names(tmp_path)) == 1
    with beside(target) as new:
        assert len(names(tmp_path)) == 1
        new.write_text("whole")
    assert names(tmp_path) == ["out [1]"]


def test_what_a_running_process_writes_is_left_alone(tmp_path):
    with beside(tmp_path / "out") as first, beside(tmp_path / "out") as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "out").read_text() == "first"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="a folder that root may not write to is hard to find")
def test_a_place_without_permission_is_an_error_of_the_system(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError), beside(tmp_path / "out"):
        pass
