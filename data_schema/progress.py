"""The one shape in which long work says how far it is: what is being done, steps done, steps in all, and a note."""

from __future__ import annotations

from collections.abc import Callable

# (what, done, total, note): total is 0 where it is not known; note may be empty.
Progress = Callable[[str, int, int, str], None]


def silent(what: str, done: int, total: int, note: str) -> None:
    """Nobody listens."""
