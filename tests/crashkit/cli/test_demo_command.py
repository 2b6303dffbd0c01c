"""The demo's bookkeeping; the demo itself is run by `make demo`."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest

from crashkit.cli.demo import Step, run_steps, steps


def _step(folder: Path, name: str) -> Step:
    """A step whose command does nothing; its result is there already, as if the command had made it."""
    return Step(name, ("--version",), folder / name)


def test_a_step_done_before_is_not_run_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    result = tmp_path / "result"
    done = tmp_path / "done.json"
    run_steps([_step(tmp_path, "result")], done)
    result.write_text("made")
    capfd.readouterr()
    run_steps([_step(tmp_path, "result")], done)
    assert "done before" in capfd.readouterr().err
    assert result.read_text() == "made"


def test_what_stands_behind_a_renewed_step_is_renewed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    todo = [_step(tmp_path, "first"), _step(tmp_path, "second")]
    done = tmp_path / "done.json"
    run_steps(todo, done)
    (tmp_path / "second").write_text("stale")  # the first result is missing, so both are made again
    capfd.readouterr()
    run_steps(todo, done)
    assert "done before" not in capfd.readouterr().err
    assert not (tmp_path / "second").exists()


def test_a_failing_step_ends_the_demo_and_is_not_noted(tmp_path: Path) -> None:
    done = tmp_path / "done.json"
    with pytest.raises((click.exceptions.Exit, SystemExit, Exception)) as caught:
        run_steps([_step(tmp_path, "good"), Step("bad", ("no-such-command",), tmp_path / "bad")], done)
    assert getattr(caught.value, "exit_code", None) == 2
    assert len(json.loads(done.read_text())) == 1


def test_every_command_of_the_demo_is_public(tmp_path: Path) -> None:
    from crashkit.cli import COMMANDS

    used = {step.arguments[0] for step in steps(tmp_path, tmp_path / "source.h5")}
    assert used <= set(COMMANDS)
    assert {"ingest", "coarsen", "train", "evaluate", "predict"} <= used
