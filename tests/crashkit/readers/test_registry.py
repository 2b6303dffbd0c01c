"""The registry knows no format by name, tells formats by content, and takes readers of other packages."""

from __future__ import annotations

import shutil
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from crashkit import readers
from crashkit.errors import CrashkitError, ReadError
from crashkit.readers import reader_for
from crashkit.readers.base import Runs
from crashkit.writers.paraview import write_paraview

OURS = {"d3plot", "exodus", "kart-hdf5", "meshio", "openradioss", "physicsnemo", "vtk-series", "vtkhdf"}


class Foreign:
    """A reader as another package would bring it."""

    name = "foreign"
    description = "files that begin with FOREIGN"

    def sniff(self, path: Path) -> bool:
        return path.is_file() and path.read_bytes().startswith(b"FOREIGN")

    def runs(self, path: Path, **options: object) -> Runs:
        return Runs({})


@pytest.fixture
def fresh_registry(monkeypatch):
    monkeypatch.setattr(readers, "_READERS", dict(readers.readers()))
    monkeypatch.setattr(readers, "_loaded", False)


def test_own_readers_are_there():
    assert set(readers.readers()) >= OURS


def test_a_reader_of_another_package_comes_by_entry_point(fresh_registry, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "foreign_package", type(sys)("foreign_package"))
    sys.modules["foreign_package"].Foreign = Foreign
    entry = EntryPoint("foreign", "foreign_package:Foreign", readers.ENTRY_POINT_GROUP)
    monkeypatch.setattr(readers, "entry_points", lambda group: [entry] if group == entry.group else [])
    (tmp_path / "results.abc").write_bytes(b"FOREIGN 1.0")
    assert reader_for(tmp_path / "results.abc").name == "foreign"


def test_a_broken_reader_of_another_package_leaves_ours_alone(fresh_registry, monkeypatch, caplog):
    entry = EntryPoint("broken", "no_such_package:Reader", readers.ENTRY_POINT_GROUP)
    monkeypatch.setattr(readers, "entry_points", lambda group: [entry])
    assert set(readers.readers()) >= OURS
    assert "reader broken (no_such_package:Reader) cannot be loaded" in caplog.text


@pytest.mark.parametrize(
    ("folder", "file", "expected"),
    [
        ("d3plot/solid_int", "d3plot", "d3plot"),
        ("d3plot/beamip", "d3plot", "d3plot"),
        ("radioss/run_b", "kartA002.gz", "openradioss"),
    ],
)
def test_solver_files_are_told_by_content_and_by_folder(data, folder, file, expected):
    place = data(folder)
    assert reader_for(place).name == expected
    assert reader_for(place / file).name == expected


def test_a_wrong_suffix_does_not_mislead(data, sample, tmp_path):
    disguised = tmp_path / "mesh.vtu"
    shutil.copy(data("d3plot/beamip") / "d3plot", disguised)
    assert reader_for(disguised).name == "d3plot"
    write_paraview(
        tmp_path / "run.vtkhdf", sample.points, sample.faces, sample.time, {"displacement": sample.displacement}
    )
    (tmp_path / "run.vtkhdf").rename(tmp_path / "run.h5")
    assert reader_for(tmp_path / "run.h5").name == "vtkhdf"


@pytest.mark.parametrize("content", [b"", b"\x00" * 4096, b"<VTKFile", b"\x89HDF\r\n\x1a\n", bytes(range(256)) * 64])
def test_unknown_content_is_refused_by_every_reader(tmp_path, content):
    file = tmp_path / "d3plot"
    file.write_bytes(content)
    with pytest.raises(ReadError, match="none of the known formats"):
        reader_for(file)


def test_a_missing_path_is_named(tmp_path):
    with pytest.raises(ReadError, match="nothing_here: no such file or folder"):
        reader_for(tmp_path / "nothing_here")


def test_an_unknown_reader_is_answered_with_the_known_ones(tmp_path):
    with pytest.raises(CrashkitError, match=r"'nastran' is not known; known are .*d3plot"):
        reader_for(tmp_path, "nastran")


@pytest.mark.parametrize("name", sorted(OURS))
def test_an_option_nobody_knows_is_refused(name, tmp_path):
    with pytest.raises(CrashkitError, match="no option 'colour'"):
        reader_for(tmp_path, name).runs(tmp_path, colour="red")


@pytest.mark.parametrize("name", sorted(OURS))
def test_a_reader_asked_for_by_name_refuses_what_it_cannot_read(name, tmp_path):
    (tmp_path / "notes.txt").write_text("nothing to see")
    with pytest.raises(CrashkitError):
        list(reader_for(tmp_path / "notes.txt", name).runs(tmp_path / "notes.txt"))


def test_one_bad_run_does_not_hide_those_behind_it():
    def bad():
        raise ReadError("x: damaged")

    runs = Runs({"a": bad, "b": lambda: "run b"})
    with pytest.raises(ReadError):
        next(runs)
    assert next(runs) == "run b"
    assert runs.names == ("a", "b")
    assert runs.open("b") == "run b"
