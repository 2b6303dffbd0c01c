"""Runs of a campaign with the stand-in solver: what is computed, what is refused, and that nothing is lost."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crashkit.campaign import job
from crashkit.campaign.box import CampaignError
from crashkit.campaign.campaign import Campaign
from crashkit.campaign.deck import arguments, program_of
from crashkit.campaign.plan import length_of
from crashkit.campaign.table import Table
from crashkit.errors import CrashkitError

EXAMPLES = Path(__file__).parents[3] / "examples" / "campaign"
POINTS = np.array([[8.0, 40.0, 50.0], [6.0, 30.0, -100.0]])
STUDY = """
parameters:
  speed: {low: 4, high: 12, unit: m/s}
  stiffness: {low: 20, high: 60, unit: kN/m}
  offset: {low: -150, high: 150, unit: mm, odd: true}
template: [frame.deck]
command: COMMAND
at_a_time: 2
"""


@pytest.fixture
def study(tmp_path: Path) -> Callable[..., Path]:
    """Writes a campaign file whose command is a Python script with the given text (default: the stand-in solver)."""

    def write(script: str = "", extra: str = "", deck: str = "") -> Path:
        home = tmp_path / "study"
        home.mkdir(exist_ok=True)
        (home / "solver.py").write_text(script or (EXAMPLES / "frame_solver.py").read_text())
        (home / "frame.deck").write_text(deck or (EXAMPLES / "frame.deck").read_text())
        file = home / "frame.yaml"
        file.write_text(STUDY.replace("COMMAND", f"{sys.executable} {{study}}/solver.py frame.deck") + extra)
        return file

    return write


def states(campaign: Campaign) -> dict[str, str]:
    return {r.name: r.state for r in campaign.table.runs()}


def test_runs_are_computed_from_a_template(study: Callable[..., Path], tmp_path: Path) -> None:
    with Campaign(study(), tmp_path / "out") as campaign:
        campaign.add(POINTS, "start")
        campaign.compute()
        assert states(campaign) == {"run_000": "done", "run_001": "done"}
        deck = (campaign.folder / "runs/run_001/frame.deck").read_text()
        assert deck == "speed 6.0\nstiffness 30000\noffset -0.1\n"
        heads, first, _ = campaign.write_parameters().read_text().splitlines()
        assert heads == "run,speed (m/s),stiffness (kN/m),offset (mm)"
        assert first == "run_000,8.0,40.0,50.0"


def test_what_ran_is_not_run_again(study: Callable[..., Path], tmp_path: Path) -> None:
    for _ in range(2):
        with Campaign(study(), tmp_path / "out") as campaign:
            campaign.add(POINTS, "start")
            campaign.compute()
            ended = {r.name: r.ended for r in campaign.table.runs()}
    with Campaign(study(), tmp_path / "out") as campaign:
        campaign.compute()
        assert {r.name: r.ended for r in campaign.table.runs()} == ended
        assert len(ended) == 2


@pytest.mark.parametrize(
    ("script", "state", "words"),
    [
        ("import sys; print('matrix is singular'); sys.exit(3)", "failed", "ended with 3: matrix is singular"),
        ("print('all well')", "failed", "wrote no results"),
        ("import time; time.sleep(60)", "failed", "stopped after 0.5 s"),
    ],
)
def test_a_run_that_goes_wrong_says_why(
    study: Callable[..., Path], tmp_path: Path, script: str, state: str, words: str
) -> None:
    extra = "timeout: 0.5\n" if "sleep" in script else ""
    with Campaign(study(script, extra), tmp_path / "out") as campaign:
        campaign.add(POINTS[:1], "start")
        campaign.compute()
        (run,) = campaign.table.runs()
        assert run.state == state
        assert words in run.reason


def test_a_solver_that_does_not_end_normally_has_failed(study: Callable[..., Path], tmp_path: Path) -> None:
    solver = (EXAMPLES / "frame_solver.py").read_text().replace("NORMAL TERMINATION", "ERROR TERMINATION")
    with Campaign(study(solver), tmp_path / "out") as campaign:
        campaign.add(POINTS[:1], "start")
        campaign.compute()
        assert campaign.table.runs()[0].state == "failed"


@pytest.mark.parametrize(
    ("line", "state"),
    [
        ("2.0%  0.1E+05  0.2E+05  1.0  -1.0  0.02  1.0  0.1", "done"),
        ("-21.0%  0.1E+05  0.2E+05  1.0  -1.0  0.02  1.0  0.1", "refused"),
        ("2.0%  0.1E+05  0.2E+05  1.0  -1.0  0.3  1.0  0.1", "refused"),
        ("0.0%  0.000  0.000  0.000  0.000  0.000  1.0  0.1", "refused"),
    ],
)
def test_quality_decides_on_a_run_that_ended_well(
    study: Callable[..., Path], tmp_path: Path, line: str, state: str
) -> None:
    solver = (EXAMPLES / "frame_solver.py").read_text()
    cycle = f"    4000  0.2E-01  0.7E-05 NODE        1650  {line}"
    solver = solver.replace('"\\n     NORMAL', f'"{cycle}\\n     NORMAL')
    with Campaign(study(solver), tmp_path / "out") as campaign:
        campaign.add(POINTS[:1], "start")
        campaign.compute()
        assert campaign.table.runs()[0].state == state


def test_a_killed_campaign_goes_on_with_the_runs_that_went_on_without_it(
    study: Callable[..., Path], tmp_path: Path
) -> None:
    solver = (
        (EXAMPLES / "frame_solver.py")
        .read_text()
        .replace("    main(Path", "    import time; time.sleep(1.5)\n    main(Path")
    )
    file = study(solver)
    with Campaign(file, tmp_path / "out") as campaign:
        campaign.add(POINTS, "start")
    code = (
        "import sys; from crashkit.campaign.campaign import Campaign\n"
        "with Campaign(sys.argv[1], sys.argv[2]) as c: c.compute()"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(file), str(tmp_path / "out")])
    folder = tmp_path / "out" / "runs"
    deadline = time.monotonic() + 60
    while len(list(folder.glob("*/job.lock"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    started = {r.name: r.started for r in _runs(tmp_path / "out")}
    with Campaign(file, tmp_path / "out") as campaign:
        campaign.compute()
        assert set(states(campaign).values()) == {"done"}
        adopted = [r for r in campaign.table.runs() if started[r.name] is not None]
        assert all(r.started == started[r.name] and r.attempts == 1 for r in adopted)


def _runs(folder: Path) -> list:  # type: ignore[type-arg]
    table = Table(folder)
    try:
        return table.runs()
    finally:
        table.close()


def test_a_process_that_vanished_is_a_failed_run_that_can_be_tried_again(
    study: Callable[..., Path], tmp_path: Path
) -> None:
    with Campaign(study(), tmp_path / "out") as campaign:
        campaign.add(POINTS[:1], "start")
        campaign.table.change("run_000", "running", handle={"pid": 999999, "began": 1.0}, attempts=1)
        campaign.compute()
        assert campaign.table.runs()[0].state == "failed"
        assert "gone" in campaign.table.runs()[0].reason
        assert campaign.retry() == ["run_000"]
        campaign.compute()
        assert campaign.table.runs()[0].state == "done"


def test_two_processes_cannot_run_one_campaign(study: Callable[..., Path], tmp_path: Path) -> None:
    file = study()
    with Campaign(file, tmp_path / "out"), pytest.raises(CampaignError, match="another process"):
        Campaign(file, tmp_path / "out")


def test_a_campaign_that_cannot_begin_leaves_its_folder_free(
    study: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_cluster(*_: object) -> None:
        raise CampaignError("no cluster")

    monkeypatch.setattr("crashkit.campaign.campaign.Slurm", no_cluster)
    with pytest.raises(CampaignError, match="no cluster"):
        Campaign(study(extra="executor: slurm\n"), tmp_path / "out")
    with Campaign(study(), tmp_path / "out") as campaign:
        assert campaign.table.runs() == []


def test_windows_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from crashkit.api import run_campaign

    monkeypatch.setattr(run_campaign, "os", SimpleNamespace(name="nt"))
    with pytest.raises(CampaignError, match=r"Linux or macOS.*WSL"):
        run_campaign.run_campaign(tmp_path / "study.yaml")


def test_another_deck_in_the_same_folder_is_refused(study: Callable[..., Path], tmp_path: Path) -> None:
    with Campaign(study(), tmp_path / "out") as campaign:
        campaign.add(POINTS[:1], "start")
    file = study(deck="speed {{ speed }}\nstiffness 1\noffset 0\n")
    with pytest.raises(CampaignError, match="computed with another template"):
        Campaign(file, tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("{{ speed }}", "{{ sped }}"), r"frame.deck, line 1: 'sped' is no parameter; the box has speed"),
        (("{{ speed }}", "{{ speed "), r"frame.deck, line"),
    ],
)
def test_a_template_that_cannot_be_filled_is_refused_before_anything_runs(
    study: Callable[..., Path], tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    deck = (EXAMPLES / "frame.deck").read_text().replace(*change)
    with pytest.raises(CampaignError, match=words):
        Campaign(study(deck=deck), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("high: 12", "high: 4", "parameters.speed: low 4 and high 4 make no range"),
        ("high: 12", "hihg: 12", "parameters.speed"),
        ("at_a_time: 2", "at_once: 2", "at_once is not known"),
        ("at_a_time: 2", "at_a_tim: 2", "did you mean at_a_time"),
        ("at_a_time: 2", "timeout: 10 minutes", "timeout: expected a duration such as 90 s.*found '10 minutes'"),
        ("command: ", "command: no_such_solver_", "not on the PATH|no such program"),
        ("at_a_time: 2", "constraints: ['speed < velocity']", "names 'velocity'"),
        ("template: [frame.deck]", "template: [nothing.deck]", "no such file"),
        ("solver.py frame.deck", "solver.py {sped}", "'?{sped}'? in a command is no parameter"),
    ],
)
def test_a_campaign_file_that_does_not_fit_is_refused_in_one_line(
    study: Callable[..., Path], tmp_path: Path, old: str, new: str, words: str
) -> None:
    file = study()
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new).replace(sys.executable, sys.executable if "no_such" not in new else "x"))
    with pytest.raises(CrashkitError, match=words) as caught:
        Campaign(file, tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_a_template_cannot_reach_into_the_interpreter(study: Callable[..., Path], tmp_path: Path) -> None:
    deck = "speed {{ speed.__class__.__mro__ }}\n"
    with Campaign(study(deck=deck), tmp_path / "out") as campaign:
        campaign.add(POINTS[:1], "start")
        with pytest.raises(CampaignError, match="cannot be filled"):
            campaign.compute()


def test_the_table_survives_a_full_disk(
    study: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Campaign(study(), tmp_path / "out") as campaign:
        campaign.add(POINTS, "start")

        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patched:
            patched.setattr(job, "give_order", full)
            with pytest.raises(CampaignError, match="No space left on device"):
                campaign.compute()
        campaign.compute()
        assert set(states(campaign).values()) == {"done"}
    assert sqlite3.connect(tmp_path / "out" / "campaign.sqlite").execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_braces_in_commands_are_values_and_nothing_else() -> None:
    assert arguments(["-i", "{a}", "x={b:.2f}", "{{c}}"], {"a": 1 / 3, "b": 2.0}) == [
        "-i",
        "0.3333333333",
        "x=2.00",
        "{c}",
    ]
    with pytest.raises(CampaignError, match=r"\{a.__class__\}"):
        arguments(["{a.__class__}"], {"a": 1.0})


@pytest.mark.parametrize(("text", "metres"), [("8 mm", 0.008), ("0.5cm", 0.005), ("1 m", 1.0)])
def test_a_target_is_a_length(text: str, metres: float) -> None:
    assert length_of(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["8", "8 kg", "-1 mm", "mm", "eight mm"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(CampaignError):
        length_of(text)


def test_a_program_that_is_a_link_is_started_by_that_name(tmp_path: Path) -> None:
    """The python of a virtual environment is a link to one that lacks the environment's packages."""
    link = tmp_path / "env" / "python"
    link.parent.mkdir()
    link.symlink_to(sys.executable)
    assert program_of([str(link), "solver.py"], tmp_path) == str(link)
    assert program_of(["{study}/env/python"], tmp_path) == str(link)
    assert program_of(["env/python"], tmp_path) == str(link)
