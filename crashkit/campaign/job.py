"""One run in its folder: `python -m crashkit.campaign.job FOLDER` does what `job.json` says and notes how it ended.

The job is a process of its own, so that it outlives a campaign that is killed; `exit.json` is the only thing that
counts afterwards. All executors, here or on a cluster, start this one command.
"""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from crashkit import siblings
from data_schema.replace import beside

LOG, ORDER, END, LOCK = "run.log", "job.json", "exit.json", "job.lock"


@dataclass(frozen=True)
class Ended:
    """How a job ended: the exit code of the first command that failed, or 0; seconds; what stopped it, if anything did."""

    code: int
    seconds: float
    reason: str = ""


def give_order(folder: Path, commands: Sequence[Sequence[str]], timeout: float) -> None:
    """Write what the job in `folder` has to do."""
    (folder / END).unlink(missing_ok=True)
    _write(folder / ORDER, {"commands": [list(c) for c in commands], "timeout": timeout})


def how_it_ended(folder: Path) -> Ended | None:
    """What `exit.json` says; None while there is none."""
    try:
        return Ended(**json.loads((folder / END).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def last_lines(folder: Path, count: int = 3) -> str:
    """The last lines of a run's log that say something."""
    try:
        with (folder / LOG).open("rb") as file:
            file.seek(max(0, (folder / LOG).stat().st_size - 4096))
            lines = [row.strip() for row in file.read().decode("utf-8", "replace").splitlines() if row.strip()]
    except OSError:
        return ""
    return " / ".join(lines[-count:])


def start_command(folder: Path) -> list[str]:
    """The command line that does the job in `folder`."""
    return siblings.command("crashkit.campaign.job", str(folder))


def is_running(folder: Path) -> bool:
    """Whether a job on this machine works in `folder` just now: it holds a lock while it does."""
    if not (folder / LOCK).exists():
        return False
    with (folder / LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def run(folder: Path) -> Ended:
    """Do the job in `folder` and note how it ended."""
    with (folder / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _run(folder)


def _run(folder: Path) -> Ended:
    order = json.loads((folder / ORDER).read_text(encoding="utf-8"))
    started = time.monotonic()
    ended = Ended(0, 0.0)
    with (folder / LOG).open("wb") as log:
        for command in order["commands"]:
            left = order["timeout"] - (time.monotonic() - started)
            code, reason = _one(command, folder, log, left, order["timeout"])
            ended = Ended(code, round(time.monotonic() - started, 3), reason)
            if code or reason:
                break
    _write(folder / END, asdict(ended))
    return ended


def _one(command: list[str], folder: Path, log: Any, left: float, timeout: float) -> tuple[int, str]:
    try:
        process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
    except OSError as error:
        return 127, f"{command[0]}: cannot be started ({error.strerror or error})"

    def stop(number: int, frame: FrameType | None) -> None:
        _kill(process)
        raise SystemExit(128 + number)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    try:
        return process.wait(timeout=max(left, 0.01)), ""
    except subprocess.TimeoutExpired:
        _kill(process)
        return -9, f"stopped after {timeout:g} s, the limit of one run"


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End the command and whatever it started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.kill()
    process.wait()


def _write(path: Path, value: Any) -> None:
    with beside(path) as new:
        new.write_text(json.dumps(value), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(1 if run(Path(sys.argv[1])).code else 0)
