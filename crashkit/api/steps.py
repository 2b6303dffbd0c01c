"""Commands one after the other, as one would type them; what is done and unchanged is not done again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shlex
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from crashkit import siblings
from crashkit.errors import CrashkitError, OutputError
from crashkit.version import __version__


class StepFailedError(CrashkitError):
    """A step ended with an error, about which its own output says more.

    Attributes
    ----------
    code
        Its exit code.
    """

    def __init__(self, number: int, code: int) -> None:
        super().__init__(f"step {number} ended with code {code}; its message is above")
        self.code = code


@dataclass(frozen=True)
class Step:
    """One command and why it is run.

    Attributes
    ----------
    why
        What it is for, in a line.
    arguments
        The command without `crashkit`.
    result
        The file or folder it leaves, if any; a step without is run every time.
    depends
        Gives a text that changes when what the command reads has changed, asked when its turn comes; without one, the
        step is run again when one before it was.
    again
        Further arguments where a result of its own is there already, such as --overwrite.
    extends
        Says whether the same command may add to the result that is there; otherwise the old one is set aside while the
        new one is made.
    """

    why: str
    arguments: tuple[str, ...]
    result: Path | None = None
    depends: Callable[[], str] | None = None
    again: tuple[str, ...] = ()
    extends: Callable[[], bool] | None = None

    @property
    def line(self) -> str:
        """The command as one would type it."""
        return "crashkit " + shlex.join(self.arguments)


def run_steps(
    todo: Sequence[Step], output: Path, *, fresh: bool = False, say: Callable[[str], None] | None = None
) -> None:
    """Run the steps in order. Those that ended well last time, unchanged and with the same version, are skipped.

    Results are noted by name in `done.json` in the folder `output`, which is made. Ctrl-C reaches the running step, too,
    which is given the time to keep what it has; the same call goes on from there.

    Parameters
    ----------
    fresh
        Make everything again.
    say
        Called with a sentence before each step; without it nothing is said.

    Raises
    ------
    OutputError
        For a result that is there and not noted: it was made by somebody else, and is not replaced. And where `output`
        cannot be written.
    StepFailedError
        Where a step ends with an error.
    """
    speak = say or (lambda sentence: None)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another output") from error
    done_file = output / "done.json"
    noted = {name: "" if fresh else mark for name, mark in _noted(done_file).items()}
    renewed = False
    for number, step in enumerate(todo, 1):
        heading = f"\n[{number}/{len(todo)}] {step.why}\n$ "
        if step.result is None:
            speak(f"{heading}{step.line}")
            _run(number, step.arguments)
            continue
        name = step.result.name
        mark = _mark(step)
        there = step.result.exists()
        if there and name not in noted:
            raise OutputError(
                f"{step.result}: is there, but was not made by this command; move it away, or choose another folder"
            )
        arguments = step.arguments + (step.again if there else ())
        interrupted = step.result.with_name(f".{name}.training").exists() and noted.get(name) == f"begun {mark}"
        if interrupted:
            arguments += ("--resume",) if "--overwrite" in arguments else ("--resume", "--overwrite")
        speak(f"{heading}{replace(step, arguments=arguments).line}")
        if there and noted.get(name) == mark and (step.depends is not None or not renewed):
            speak("  (unchanged, done before; --fresh makes it again)")
            continue
        renewed = True
        asked = f"{name}: command"
        adds = step.extends is None or (noted.get(asked) == _command(step) and there and step.extends())
        noted[asked] = _command(step)
        _note(done_file, noted, name, f"begun {mark}")
        with contextlib.nullcontext() if adds else _aside(step.result):
            _run(number, arguments)
        _note(done_file, noted, name, _mark(step))


def _mark(step: Step) -> str:
    """What a step's result depends on."""
    known = [__version__, _command(step), step.depends() if step.depends is not None else ""]
    return hashlib.sha256("\0".join(known).encode()).hexdigest()


def _command(step: Step) -> str:
    """The command without the folder its result lies in, and without names of this machine: a moved folder is as good."""
    home = str(step.result.parent) + os.sep if step.result is not None else ""
    return hashlib.sha256("\0".join(a.removeprefix(home) for a in step.arguments).encode()).hexdigest()


@contextlib.contextmanager
def _aside(result: Path) -> Iterator[None]:
    """Move what exists at `result` out of the way; it is put back unless a new one takes its place."""
    from data_schema.replace import remove

    old = result.with_name(f".{result.name}.before")
    if result.exists():
        remove(old)
        result.rename(old)
    try:
        yield
    finally:
        if old.exists() and not result.exists():
            old.rename(result)
        elif result.exists():
            remove(old)


def _noted(done_file: Path) -> dict[str, str]:
    try:
        found = json.loads(done_file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise OutputError(f"{done_file}: cannot be read ({error}); delete it and what lies beside it") from error
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}


def _note(done_file: Path, noted: dict[str, str], name: str, mark: str) -> None:
    from data_schema.replace import beside

    noted[name] = mark
    with beside(done_file) as new:
        new.write_text(json.dumps(noted, indent=1), encoding="utf-8")


def _run(number: int, arguments: Sequence[str]) -> None:
    """Run a command in a process of its own; after Ctrl-C, which it heard, too, wait until it has ended."""
    interrupted: KeyboardInterrupt | None = None
    with subprocess.Popen(siblings.command("crashkit", *arguments), env=siblings.environment()) as process:
        while True:
            try:
                code = process.wait()
                break
            except KeyboardInterrupt as heard:
                interrupted = heard
    if interrupted is not None:
        raise interrupted
    if code:
        raise StepFailedError(number, code)
