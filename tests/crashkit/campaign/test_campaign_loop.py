"""The whole loop with the stand-in solver: from a box to a judged error, from the command line."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

import crashkit
from crashkit.api.propose import propose
from crashkit.api.run_campaign import run_campaign
from crashkit.campaign.box import CampaignError
from crashkit.campaign.status import _curve
from crashkit.campaign.table import Table
from crashkit.cli import app

EXAMPLES = Path(__file__).parents[3] / "examples" / "campaign"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("campaign")
    for name in ("frame_solver.py", "frame.deck"):
        shutil.copy(EXAMPLES / name, home)
    text = (EXAMPLES / "frame.yaml").read_text().replace("command: python", f"command: {sys.executable}")
    (home / "frame.yaml").write_text(text)
    return home / "frame.yaml"


@pytest.fixture(scope="module")
def finished(study: Path) -> Path:
    """A campaign whose target is out of reach, ended by its limit of 12 runs."""
    said: list[str] = []
    summary = run_campaign(study, until="0.001 mm", most_runs=12, say=said.append)
    assert "12 runs are computed, the most that were allowed" in summary.why
    assert summary.done == 12
    assert summary.judgement is not None
    assert summary.judgement.low < summary.judgement.error < summary.judgement.high
    assert any("the next batch is expected to bring" in line for line in said)
    return summary.folder


def test_rounds_go_from_the_first_runs_to_the_limit_and_the_error_falls(finished: Path) -> None:
    table = Table(finished)
    rounds, runs = table.rounds(), table.runs()
    table.close()
    assert [r["runs"] for r in rounds] == [8, 12]
    assert rounds[1]["error_m"] < rounds[0]["error_m"]
    assert {r.origin for r in runs} == {"start", "proposed"}
    assert crashkit.open_dataset(finished / "crash.zarr").sizes["sim"] == 12


@pytest.mark.parametrize("size", [1e-4, 1e-3, 0.1, 5.0])
def test_labels_of_the_error_have_room_beside_the_axis(size: float) -> None:
    rounds = [{"runs": 8, "error_m": size, "low_m": 0.8 * size, "high_m": 1.3 * size}]
    curve = _curve(rounds, None)
    assert curve is not None
    longest = max(len(text) for text, _ in curve["ticks"])
    # In a wide font a digit is 0.64 of 11 pixels, " mm" 25 pixels; labels end 6 pixels before the axis.
    assert 0.64 * 11 * longest + 25 <= curve["left"] - 6


def test_the_status_is_told_in_the_terminal_and_on_a_page(finished: Path) -> None:
    result = CliRunner().invoke(app, ["campaign", "status", str(finished)])
    assert result.exit_code == 0
    assert "12 done" in result.stderr
    page = (finished / "status.html").read_text()
    assert page.count("<circle") >= 3 * 12
    assert "Error over the box" in page


def test_a_target_that_is_met_ends_the_campaign_without_another_run(study: Path, finished: Path) -> None:
    result = CliRunner().invoke(app, ["campaign", str(study), "--until", "1 m"])
    assert result.exit_code == 0, result.output
    assert "the error is below 1000 mm with a confidence of 90 %" in result.stderr
    table = Table(finished)
    assert len(table.runs()) == 12
    table.close()


def test_proposals_keep_to_the_box_and_avoid_what_is_known(study: Path, finished: Path) -> None:
    table = propose(finished / "crash.zarr", 3, box=study, seed=5)
    assert list(table.columns) == ["speed", "stiffness", "offset"]
    assert table["speed"].between(4, 12).all()
    assert table["stiffness"].between(20, 60).all()
    assert table.attrs["units"] == {"speed": "m/s", "stiffness": "kN/m", "offset": "mm"}
    assert table.attrs["expected_error_after_m"] < table.attrs["expected_error_m"]
    pd.testing.assert_frame_equal(table, propose(finished / "crash.zarr", 3, box=study, seed=5))


def test_without_runs_proposals_fill_the_box(study: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["propose", "--box", str(study), "-n", "6", "-o", str(tmp_path / "first.csv")])
    assert result.exit_code == 0, result.output
    table = pd.read_csv(tmp_path / "first.csv")
    assert list(table.columns) == ["run", "speed (m/s)", "stiffness (kN/m)", "offset (mm)"]
    assert (table["speed (m/s)"].min(), table["speed (m/s)"].max()) == (4, 12)


def test_a_box_of_other_parameters_is_refused(finished: Path, tmp_path: Path) -> None:
    box = tmp_path / "box.yaml"
    box.write_text("parameters: {velocity: {low: 1, high: 2, unit: m/s}}\n")
    with pytest.raises(CampaignError, match="differ in"):
        propose(finished / "crash.zarr", 2, box=box)


def test_a_confidence_that_is_none_is_refused_before_a_run_is_computed(study: Path, tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"confidence of 90 .* between 0\.5 and 1"):
        run_campaign(study, tmp_path / "new", until="1 mm", confidence=90)
    assert not (tmp_path / "new").exists()
