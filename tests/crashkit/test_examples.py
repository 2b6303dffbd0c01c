"""The scripts in examples/ run as they stand, on the embedded runs."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from typer.testing import CliRunner

import crashkit
from crashkit import readers
from crashkit.cli import app

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_deformation_over_time(
    demo_dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "deformation_over_time.py", demo_dataset)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "mean deformation of 36 runs"
    assert lines[1] == "  run_022:  288.8 mm at 30.0 ms"


def test_speed_and_strength(
    demo_dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "speed_and_strength.py", demo_dataset, "27:36")
    told = capsys.readouterr().out
    assert "impact_speed   +0.91" in told
    assert "impact_speed^1.22: 25 % off on 9 test runs" in told


def test_cross_validate(
    demo_dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "cross_validate.py", demo_dataset, "27:36")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" R²")[0].strip() for line in lines[:3]] == [
        "mean of the runs",
        "quadratic",
        "crashkit.Surrogate",
    ]
    assert "'model': 'pod-gpr'" in lines[3]


def test_worst_moment(
    demo_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "worst_moment.py", demo_dataset, tmp_path / "worst.vtp")
    assert "940 mm: run run_022, 30.0 ms, node 1616" in capsys.readouterr().out
    assert pv.read(tmp_path / "worst.vtp").point_data["displacement"].shape == (2400, 3)


@pytest.fixture
def npz_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one run as `examples/add_reader.py` reads it, and a registry that forgets it after the test."""
    monkeypatch.setattr(readers, "_READERS", dict(readers.readers()))
    monkeypatch.setattr(readers, "_loaded", False)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    moved = corners + np.array([0.0, 0.1, 0.3])[:, None, None]
    folder = tmp_path / "runs"
    folder.mkdir()
    np.savez(
        folder / "first.npz", position=corners, triangles=[[0, 1, 2], [0, 2, 3]], time=[0.0, 0.01, 0.02], points=moved
    )
    return folder


def test_add_reader_as_a_script(npz_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(monkeypatch, "add_reader.py", npz_runs, tmp_path / "runs.zarr")
    dataset = crashkit.open_dataset(tmp_path / "runs.zarr")
    np.testing.assert_allclose(dataset.displacement.isel(sim=0, node=2, xyz=0), [0, 0.1, 0.3], rtol=1e-6)


def test_add_reader_as_an_installed_package(npz_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = tmp_path / "site"
    described = site / "npz_format-1.0.dist-info"
    described.mkdir(parents=True)
    shutil.copy(EXAMPLES / "add_reader.py", site / "npz_format.py")
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: npz-format\nVersion: 1.0\n")
    (described / "entry_points.txt").write_text("[crashkit.readers]\nnpz = npz_format:NpzReader\n")
    monkeypatch.syspath_prepend(site)
    result = CliRunner().invoke(app, ["ingest", str(npz_runs), "-o", str(tmp_path / "runs.zarr"), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["runs"] == ["first"]


def test_add_reader_is_as_short_as_it_says() -> None:
    assert len((EXAMPLES / "add_reader.py").read_text().splitlines()) < 60
