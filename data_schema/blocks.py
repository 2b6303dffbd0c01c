"""Ranges of states that are small enough to be in memory at once."""

from __future__ import annotations


def split_states(count: int, nodes: int, budget: int = 64 << 20) -> list[tuple[int, int]]:
    """Ranges (first, end) of `count` states whose float32 xyz values stay below `budget` bytes each; at least one state."""
    step = max(1, budget // max(1, nodes * 12))
    return [(k, min(k + step, count)) for k in range(0, count, step)]
