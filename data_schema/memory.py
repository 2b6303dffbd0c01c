"""Memory that Python has freed, given back to the system."""

from __future__ import annotations

import ctypes
import functools
import sys
from typing import Any

# What `mallopt` calls the number of heaps.
_ARENA_MAX = -8


def give_back() -> None:
    """Have the C library return what was freed between blocks still in use; nothing where it cannot.

    Arrays below 32 MB lie side by side in a heap that shrinks only from its end. After a phase of work with many of them, a
    third of what a process holds may be free and still be its own.
    """
    trim = _of_glibc("malloc_trim")
    if trim is not None:
        trim(0)


def one_heap() -> None:
    """Have all threads of this process share one heap, from now on; nothing where the C library cannot.

    Else each thread gets a heap of its own, whose end is never given back: some 30 MB for each of the threads that read
    arrays, and copies of what they last held.
    """
    set_option = _of_glibc("mallopt")
    if set_option is not None:
        set_option(_ARENA_MAX, 1)


@functools.cache
def _of_glibc(name: str) -> Any:
    """A function of the GNU C library, or None."""
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), name, None)
