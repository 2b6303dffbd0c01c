"""A stand-in for a crash solver: a frame of masses and springs runs against a wall, and OpenRadioss animation files come out.

usage: frame_solver.py DECK        the deck holds lines "name value": speed (m/s), stiffness (N/m), offset (m)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

NX, NY, STATES, END, STEP = 9, 5, 21, 0.02, 2e-5


def text(words: str, width: int) -> bytes:
    return words.encode().ljust(width, b"\0")


def write_state(path: Path, time: float, x: np.ndarray, faces: np.ndarray) -> None:
    """One animation file: big-endian, nodes and shells, and their numbers (flag 1)."""
    n, m = len(x), len(faces)
    integers = lambda *v: np.array(v, ">i4").tobytes()  # noqa: E731
    parts = [b"\x00\x00\x54\x2c", np.array([time], ">f4").tobytes(), text("frame", 81) * 3]
    parts += [integers(0, 1, *[0] * 8), integers(n, m, 1, 0, 0, 0, 0, 0), x.astype(">f4").tobytes()]
    parts += [faces.astype(">i4").tobytes(), b"\x01" * m, integers(m), text("1:frame", 50), bytes(6 * n)]
    parts += [np.arange(1, n + 1, dtype=">i4").tobytes(), np.arange(1, m + 1, dtype=">i4").tobytes()]
    path.write_bytes(b"".join(parts))


def main(deck: Path) -> None:
    value = {k: float(v) for k, v in (row.split() for row in deck.read_text().splitlines() if row.strip())}
    i, j = (a.ravel() for a in np.meshgrid(np.arange(NX), np.arange(NY), indexing="ij"))
    x0 = np.column_stack([0.1 * i, 0.1 * (j - (NY - 1) / 2), 0.02 * (i % 2)]).astype(float)
    number = np.arange(NX * NY).reshape(NX, NY)
    faces = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    pairs = np.unique(np.sort(np.concatenate([faces[:, [a, b]] for a in range(4) for b in range(a)]), axis=1), axis=0)
    length = np.linalg.norm(x0[pairs[:, 0]] - x0[pairs[:, 1]], axis=1)
    x, v = x0.copy(), np.zeros_like(x0)
    v[:, 0] = value["speed"]
    wall = x0[:, 0].max() + 0.5 * np.abs(x0[:, 1] - value["offset"])  # a wedge whose edge is at the offset
    every = round(END / STEP / (STATES - 1))
    for step in range(every * (STATES - 1) + 1):
        if step % every == 0:
            write_state(deck.with_name(f"frameA{step // every + 1:03d}"), step * STEP, x, faces)
        way = x[pairs[:, 1]] - x[pairs[:, 0]]
        now = np.linalg.norm(way, axis=1)
        pull = (value["stiffness"] * np.tanh((now - length) / 0.02) * 0.02 / now)[:, None] * way
        force = np.zeros_like(x)
        np.add.at(force, pairs[:, 0], pull)
        np.add.at(force, pairs[:, 1], -pull)
        force[:, 0] -= 2e6 * np.maximum(x[:, 0] - wall, 0)
        v += STEP * (force / 0.2 - 20 * (v - v.mean(axis=0)))
        x += STEP * v
    deck.with_name("frame_0001.out").write_text("\n     NORMAL TERMINATION\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
