"""Loops compiled by numba, their machine code kept between starts where there is a place for it."""

from __future__ import annotations

from typing import Any

from numba import njit


def compiled(function: Any) -> Any:
    """`function` compiled; without a writable place for numba's cache (containers), it is compiled at every start."""
    try:
        return njit(cache=True)(function)
    except RuntimeError:  # numba: no locator available
        return njit(function)
