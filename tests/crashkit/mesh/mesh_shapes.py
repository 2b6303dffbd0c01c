"""Small meshes whose right answers are known."""

from __future__ import annotations

import functools

import h5py
import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]


def plate(nx: int, ny: int, width: float = 1.0, height: float = 1.0, quads: bool = False) -> Mesh:
    """A flat plate of nx x ny nodes in the plane z = 0; node (i, j) has the number i * ny + j."""
    x, y = np.meshgrid(np.linspace(0, width, nx), np.linspace(0, height, ny), indexing="ij")
    number = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    corners = np.stack([a, b, c, d], axis=1)
    faces = corners if quads else np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return np.stack([x.ravel(), y.ravel(), np.zeros(nx * ny)], axis=1), faces


def tube(around: int = 8, along: int = 60, radius: float = 0.02, length: float = 2.0) -> Mesh:
    """An open tube along x."""
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    x = np.repeat(np.linspace(0, length, along), around)
    position = np.stack([x, radius * np.tile(np.cos(turn), along), radius * np.tile(np.sin(turn), along)], axis=1)
    number = np.arange(around * along).reshape(along, around)
    right = np.roll(number, -1, axis=1)
    a, b, c, d = (n.ravel() for n in (number[:-1], number[1:], right[1:], right[:-1]))
    return position, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def joined(*meshes: Mesh) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Several triangle meshes side by side: positions, faces, and which mesh each face is from."""
    offsets = np.cumsum([0] + [len(position) for position, _ in meshes])
    position = np.concatenate([position for position, _ in meshes])
    faces = np.concatenate([faces + offset for (_, faces), offset in zip(meshes, offsets, strict=False)])
    return position, faces, np.repeat(np.arange(len(meshes)), [len(faces) for _, faces in meshes])


def domes(gap: float, n: int = 21, sag: float = 0.2) -> tuple[Mesh, Mesh]:
    """Two sheets of the same curved shape, one `gap` above the other and far closer than a coarse mesh sags."""
    position, faces = plate(n, n)
    position[:, 2] = sag * (1 - 4 * (position[:, 0] - 0.5) ** 2) * (1 - 4 * (position[:, 1] - 0.5) ** 2)
    return (position, faces), (position + np.array([0, 0, gap]), faces)


def tee(n: int = 9) -> Mesh:
    """Three plates of n x n nodes that meet in the line x = 0, z = 0: a T-joint, not manifold."""
    line = np.stack([np.zeros(n), np.linspace(0, 1, n), np.zeros(n)], axis=1)
    sheets = []
    for direction in ([1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0]):
        steps = np.linspace(0, 1, n)[1:]
        sheets.append(line[None] + steps[:, None, None] * np.array(direction))
    position = np.concatenate([line] + [sheet.reshape(-1, 3) for sheet in sheets])
    faces = []
    for k in range(3):
        number = np.concatenate([np.arange(n)[None], n + k * (n - 1) * n + np.arange((n - 1) * n).reshape(n - 1, n)])
        a, b, c, d = (m.ravel() for m in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    return position, np.concatenate(faces)


@functools.cache
def kart() -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float32]]:
    """The embedded kart: positions, faces, and displacements (state, node, 3) of a few late states of training runs."""
    from crashkit.dataset import demo_data

    with h5py.File(demo_data()) as file:
        position = file["kart/reference_configuration"][0].astype(np.float64)
        displacement = file["kart/displacements"][0:27:3, 5::5]
        return position, file["kart/faces"][:].astype(np.int64), displacement.reshape(-1, *displacement.shape[2:])


def random_surface(
    seed: int, n_parts: int = 1, twins: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """A crumpled plate with holes, branches, degenerate and doubled faces, doubled and loose nodes; all corners count.

    Positions, faces (quadrilaterals and triangles), parts of the faces, in stripes. Without `twins` no two nodes lie at
    the same place.
    """
    rng = np.random.default_rng(seed)
    nx, ny = rng.integers(4, 10, size=2)
    position, faces = plate(int(nx), int(ny), quads=True)
    position[:, 2] = 0.3 * rng.normal(size=len(position)) * rng.integers(0, 2)
    position[:, :2] += 0.2 / nx * rng.uniform(-1, 1, size=(len(position), 2))
    faces = faces[rng.random(len(faces)) > 0.1]
    cut = rng.random(len(faces)) < 0.5
    faces[cut, 3] = -1
    branches = np.column_stack([rng.integers(0, len(position), size=(3, 3)), [-1, -1, -1]])
    degenerate = np.column_stack([faces[:2, [0, 0, 1]], [-1, -1]])
    loose = rng.uniform(-1, 1, size=(2, 3))
    copies = position[rng.integers(0, len(position), size=2)] + (0.0 if twins else 1e-3)
    spike = np.array([[len(position), len(position) + 1, 0, -1]])
    faces = np.concatenate([faces, branches, degenerate, faces[:1], spike])
    position = np.concatenate([position, copies, loose])
    valid = faces[:, :3]
    part = (position[valid, 0].mean(axis=1).clip(0, 0.999) * n_parts).astype(np.int64)
    return position, faces, part
