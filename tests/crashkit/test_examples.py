"""The scripts in examples/ run as they stand, on the embedded runs."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
import pyvista as pv

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


def test_worst_moment(
    demo_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "worst_moment.py", demo_dataset, tmp_path / "worst.vtp")
    assert "940 mm: run run_022, 30.0 ms, node 1616" in capsys.readouterr().out
    assert pv.read(tmp_path / "worst.vtp").point_data["displacement"].shape == (2400, 3)
