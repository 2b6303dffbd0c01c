"""Memory that Python has freed, given back to the system."""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable


def give_back() -> None:
    """Have the C library return what was freed between blocks still in use; nothing where it cannot.

    Arrays below 32 MB lie side by side in a heap that shrinks only from its end. After a phase of work with many of them, a
    third of what a process holds may be free and still be its own.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """`malloc_trim` of the GNU C library."""
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)
