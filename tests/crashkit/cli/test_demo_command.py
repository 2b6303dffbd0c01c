"""The demo's bookkeeping; the demo itself is run by `make demo`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from crashkit import siblings
from crashkit.api.demo import demo_result, steps
from crashkit.api.steps import Step, StepFailedError, run_steps
from crashkit.cli.demo import show
from crashkit.errors import OutputError


def _step(folder: Path, name: str, **more) -> Step:
    """A step that makes a file, unless it is there."""
    return Step(name, ("export", "--help"), folder / name, **more)


def run(todo: list[Step], output: Path, monkeypatch: pytest.MonkeyPatch, **more) -> list[str]:
    """Run the steps, the commands replaced by writing the result; gives the names of those that were run."""
    made = []

    def write(number: int, arguments) -> None:
        result = todo[number - 1].result
        made.append(" ".join([todo[number - 1].why, *arguments[2:]]))
        if result is not None:
            result.write_text("made")

    monkeypatch.setattr("crashkit.api.steps._run", write)
    run_steps(todo, output, **more)
    return made


def test_a_step_done_before_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    todo = [_step(tmp_path, "a", again=("--overwrite",))]
    assert run(todo, tmp_path, monkeypatch) == ["a"]
    assert run(todo, tmp_path, monkeypatch) == []
    assert run(todo, tmp_path, monkeypatch, fresh=True) == ["a --overwrite"]


def test_what_stands_behind_a_renewed_step_is_renewed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    todo = [_step(tmp_path, "a"), _step(tmp_path, "b")]
    run(todo, tmp_path, monkeypatch)
    (tmp_path / "a").unlink()
    assert run(todo, tmp_path, monkeypatch) == ["a", "b"]


def test_only_what_depends_on_a_change_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = {"a": "1", "b": "1"}
    todo = [_step(tmp_path, n, depends=lambda n=n: known[n]) for n in known]
    run(todo, tmp_path, monkeypatch)
    known["b"] = "2"
    assert run(todo, tmp_path, monkeypatch) == ["b"]


def test_a_result_of_somebody_else_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_text("years of work")
    with pytest.raises(OutputError, match="was not made by this command"):
        run([_step(tmp_path, "a")], tmp_path, monkeypatch)
    assert (tmp_path / "a").read_text() == "years of work"


def test_an_interrupted_training_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    todo = [_step(tmp_path, "mh", again=("--overwrite",))]

    def interrupt(number: int, arguments) -> None:
        (tmp_path / ".mh.training").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr("crashkit.api.steps._run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_steps(todo, tmp_path)
    assert run(todo, tmp_path, monkeypatch) == ["mh --resume --overwrite"]


def test_a_moved_folder_is_as_good_as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "old").mkdir()
    step = Step("a", ("export", "--help", str(tmp_path / "old" / "in")), tmp_path / "old" / "a")
    run([step], tmp_path / "old", monkeypatch)
    assert "old" not in (tmp_path / "old" / "done.json").read_text()
    (tmp_path / "old").rename(tmp_path / "new")
    step = Step("a", ("export", "--help", str(tmp_path / "new" / "in")), tmp_path / "new" / "a")
    assert run([step], tmp_path / "new", monkeypatch) == []


def test_a_failing_step_ends_with_its_code_and_is_not_noted_as_done(tmp_path: Path) -> None:
    todo = [Step("bad", ("no-such-command",), tmp_path / "bad")]
    with pytest.raises(StepFailedError, match="step 1 ended with code 2") as caught:
        run_steps(todo, tmp_path)
    assert caught.value.code == 2
    assert json.loads((tmp_path / "done.json").read_text())["bad"].startswith("begun ")


def test_every_command_of_the_demo_is_public(tmp_path: Path) -> None:
    from crashkit.cli import COMMANDS

    used = {step.arguments[0] for step in steps(tmp_path, tmp_path / "source.h5")}
    assert used <= set(COMMANDS)
    assert {"ingest", "coarsen", "train", "evaluate", "predict"} <= used


def test_a_model_without_a_best_linear_compression_is_shown_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report").mkdir()
    rows = [{"model": "POD-GPR", "error_cm": 1.649, "worst_run_cm": 8.113, "pod_floor_cm": None}]
    (tmp_path / "report" / "report.json").write_text(json.dumps({"performance": rows}))
    (tmp_path / "mh").mkdir()
    choice = {"MH3": "75 % process (network 1.89 cm, process 1.67 cm); reduction as computed", "MH1": "network (..)"}
    (tmp_path / "mh" / "model.json").write_text(json.dumps({"record": {"choice": choice}}))
    show(demo_result(tmp_path))
    printed = capsys.readouterr()
    assert "From parameters to latent numbers: MH3 75 % process, MH1 network, as chosen" in printed.err
    (row,) = [line for line in printed.out.splitlines() if "POD-GPR" in line]
    assert row.replace("│", " ").replace("|", " ").split()[1:] == ["1.65", "8.11", "-"]


INTERRUPTED = """
import sys
from pathlib import Path
import typer
from crashkit import siblings
from crashkit.cli._console import say, steps_shown
from crashkit.api.steps import Step, run_steps

STEP = '''
import sys, time
try:
    print("ready", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    print("error: interrupted", file=sys.stderr)
    sys.exit(130)
'''
siblings.command = lambda *arguments: [sys.executable, "-c", STEP]
try:
    with steps_shown():
        run_steps([Step("a long one", ("train",)), Step("the next", ("info",))], Path(), say=say)
except typer.Exit as ended:
    sys.exit(ended.exit_code)
"""


def test_ctrl_c_is_told_once_and_ends_all_steps(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED], cwd=tmp_path, env=siblings.environment(), start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the command and to its step
        said = process.communicate(timeout=60)[1]
    assert said.count("interrupted") == 1, said
    assert said.splitlines()[-1] == "stopped; the same command goes on from there"
    assert "[2/2]" not in said
    assert process.returncode == 130
