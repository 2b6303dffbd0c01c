"""Progress of long work: one live line on a terminal, lines in a log; never silent for more than five seconds.

All commands tell their progress in one shape, `step(what, done, total, note)`, shown as

    MH3 120/300 | validation 1.65 cm (best 1.65, epoch 21) | 38 s left

The packages below the command line say what they are doing through `logging` (level INFO), so that none of them needs to know
who listens; such a line becomes the `what` of the work that follows.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from crashkit.cli._console import LIVE, console, say

_ROOMS = ("crashkit", "surrogates", "evaluation")
SILENCE = 3.5  # seconds without a line, after which one says that the work goes on
FIRST = 2.0  # the same for the first line: starting took its time, too
_BETWEEN = 3.0  # seconds between two lines where there is no terminal


def line(what: str, done: int, total: int, note: str, left: float | None) -> str:
    """One line of progress."""
    count = f" {done}/{total}" if total else f" {done}" if done else ""
    pieces = [what + count, note, _left(left) if left is not None and done < total else ""]
    return " | ".join(piece for piece in pieces if piece)


def _left(seconds: float) -> str:
    return f"{seconds:.0f} s left" if seconds < 120 else f"{seconds / 60:.0f} min left"


@dataclass(frozen=True)
class _Told:
    """What is being done, and how many seconds it was expected to take when it was told; None where nobody knows."""

    text: str
    left: float | None = None

    def after(self, seconds: float) -> str:
        """The line `seconds` later; nothing is said of the time left once it is over."""
        left = None if self.left is None else self.left - seconds
        return self.text if left is None or (seconds and left <= 0) else f"{self.text} | {_left(left)}"


class Progress:
    """Shows what is being done; a context.

    quiet  show nothing, as with --json
    """

    def __init__(self, what: str, quiet: bool = False) -> None:
        self._quiet = quiet
        self._live = not quiet and sys.stderr.isatty()
        self._lock = threading.RLock()
        self._now = what
        self._text = _Told(what)
        self._begun: dict[str, tuple[float, int]] = {}
        self._said = ""
        self._last = self._since = self._told_at = time.monotonic()
        self._end = threading.Event()
        self._shown: Any = None
        self._levels: dict[str, int] = {}

    def __enter__(self) -> Progress:
        if self._quiet:
            return self
        self._handler = _Listener(self)
        for name in _ROOMS:
            logger = logging.getLogger(name)
            self._levels[name] = logger.level
            logger.addHandler(self._handler)
            if logger.getEffectiveLevel() > logging.INFO:
                logger.setLevel(logging.INFO)
        if self._live:
            from rich.status import Status

            self._shown = Status(self._now, console=console(stderr=True))
            self._shown.start()
            LIVE.append(self._shown.console)
        threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._quiet:
            return
        self._end.set()
        for name in _ROOMS:
            logging.getLogger(name).removeHandler(self._handler)
            logging.getLogger(name).setLevel(self._levels[name])
        if self._shown is not None:
            LIVE.remove(self._shown.console)
            self._shown.stop()

    def stage(self, what: str) -> None:
        """From now on `what` is being done, and nothing is counted."""
        self._tell(what, _Told(what), finished=False)

    def step(self, what: str, done: int = 0, total: int = 0, note: str = "", left: float | None = None) -> None:
        """`done` of `total` steps (0: unknown) of `what` are done; seconds left are estimated unless given."""
        begun, first = self._begun.setdefault(what, (time.monotonic(), done))
        if left is None and total and done > first:
            left = (time.monotonic() - begun) / (done - first) * (total - done)
        told = _Told(line(what, done, total, note, None), left if left is not None and done < total else None)
        self._tell(what, told, finished=bool(total) and done >= total)

    def say(self, text: str) -> None:
        """A line that stays."""
        if not self._quiet:
            with self._lock:
                self._print(text)

    def _tell(self, what: str, told: _Told, finished: bool) -> None:
        if self._quiet:
            return
        with self._lock:
            now = time.monotonic()
            if what != self._now:
                self._now, self._since = what, now
            text = told.after(0.0)
            self._text, self._told_at = (_Told(f"{text} done, going on") if finished else told), now
            if self._shown is not None:
                self._shown.update(_fitted(text))
            if (finished and text != self._said) or (not self._live and now - self._last >= _BETWEEN):
                self._print(text)

    def _print(self, text: str) -> None:
        self._said, self._last = text, time.monotonic()
        if self._shown is not None:
            self._shown.console.print(_fitted(text))
        else:
            say(text)

    def _watch(self) -> None:
        """Say that the work goes on where nothing else was said for a while."""
        while not self._end.wait(0.25):
            with self._lock:
                now = time.monotonic()
                seconds = now - self._since
                text = self._text.after(now - self._told_at)
                if self._shown is not None and seconds > 1:
                    self._shown.update(_fitted(f"{text} ({seconds:.0f} s)"))
                elif self._shown is None and now - self._last >= (SILENCE if self._said else FIRST):
                    self._print(f"{text} ... {seconds:.0f} s")


def _fitted(text: str) -> Any:
    """`text` for one line of a terminal: never wrapped, never read as markup."""
    from rich.text import Text

    return Text(text, no_wrap=True, overflow="ellipsis")


class _Listener(logging.Handler):
    """Turns what the packages log into stages (INFO) and lines (WARNING and above)."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(logging.INFO)
        self._progress = progress

    def emit(self, record: logging.LogRecord) -> None:
        text = " ".join(record.getMessage().split())
        if record.levelno >= logging.WARNING:
            self._progress.say(f"warning: {text}")
        else:
            self._progress.stage(text)
