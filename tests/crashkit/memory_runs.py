"""Runs that live in memory, for what no small real file shows: erosion, unequal times, damaged values.

`RunsInMemory` puts them behind a path, so that they go the way of every other source.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from crashkit.errors import ReadError
from crashkit.readers.base import FieldInfo, Parameter, Part, Run, RunMesh


def plate(nx: int = 4, ny: int = 3) -> RunMesh:
    """A plate of quadrilaterals with a triangle at its end, mm, in two parts, and a rigid wall of its own."""
    x, y = np.meshgrid(np.arange(nx) * 10.0, np.arange(ny) * 10.0, indexing="ij")
    position = np.column_stack([x.ravel(), y.ravel(), np.zeros(nx * ny)])
    quads = [
        (i * ny + j, (i + 1) * ny + j, (i + 1) * ny + j + 1, i * ny + j + 1)
        for i in range(nx - 1)
        for j in range(ny - 1)
    ]
    tip = len(position)
    wall = tip + 1 + np.arange(4)
    position = np.vstack([position, [nx * 10.0, 0.0, 0.0], wall_corners(nx)])
    faces = np.array([*quads, ((nx - 1) * ny, tip, (nx - 1) * ny + 1, -1), wall], np.int32)
    part = np.array([0] * (len(quads) // 2) + [1] * (len(quads) - len(quads) // 2 + 1) + [2], np.int32)
    return RunMesh(
        position=position.astype(np.float64),
        node_id=100 + np.arange(len(position)),
        face_nodes=faces,
        face_part=part,
        face_id=500 + np.arange(len(faces)),
        parts=(Part(7, "rail left"), Part(8, "rail right"), Part(99, "wall", rigid_wall=True)),
    )


def wall_corners(nx: int) -> np.ndarray:
    at = (nx + 1) * 10.0
    return np.array([[at, 0, -5], [at, 20, -5], [at, 20, 5], [at, 0, 5]], float)


class MemoryRun(Run):
    """A run whose nodes move by speed * t along x and bend along z, in mm and ms."""

    solver = "memory"

    def __init__(
        self,
        name: str = "one",
        *,
        mesh: RunMesh | None = None,
        time: Sequence[float] = (0.0, 1.0, 2.0, 3.0, 4.0),
        speed: float = 2.0,
        units: str | None = "mm-ms-kg",
        parameters: dict[str, tuple[float, str]] | None = None,
        end_time: float | None = None,
        problems: tuple[str, ...] = (),
        fields: dict[str, tuple[FieldInfo, np.ndarray]] | None = None,
        alive: np.ndarray | None = None,
        alive_cells: np.ndarray | None = None,
        files: tuple[Path, ...] = (),
    ) -> None:
        self.name, self.units, self.end_time, self.problems, self.files = name, units, end_time, problems, files
        self.mesh = plate() if mesh is None else mesh
        self.time = np.asarray(time, np.float64)
        self.parameters = {n: Parameter(*p) for n, p in (parameters or {}).items()}
        self.fields = {n: info for n, (info, _) in (fields or {}).items()}
        self._fields = {n: values for n, (_, values) in (fields or {}).items()}
        self._alive, self._alive_cells = alive, alive_cells
        x = self.mesh.position[:, 0]
        self.moved = np.zeros((len(self.time), len(x), 3), np.float32)
        self.moved[..., 0] = speed * self.time[:, None]
        self.moved[..., 2] = 0.01 * x * self.time[:, None] ** 2
        self.read_states: list[tuple[int, int]] = []
        self.closed = False

    def displacement(self, first: int, last: int) -> np.ndarray:
        self.read_states.append((first, last))
        return self.moved[first:last]

    def field(self, name: str, first: int, last: int) -> np.ndarray:
        return self._fields[name][first:last]

    def alive(self, first: int, last: int) -> np.ndarray | None:
        return None if self._alive is None else self._alive[first:last]

    def alive_cells(self, first: int, last: int) -> np.ndarray | None:
        return None if self._alive_cells is None else self._alive_cells[first:last]

    def close(self) -> None:
        self.closed = True


class RunsInMemory:
    """A reader that gives the runs it was told of for a path; an error among them is raised in its place."""

    name = "memory"
    description = "runs of a test"

    def __init__(self) -> None:
        self.sources: dict[Path, list[Any]] = {}

    def put(self, path: Path, *runs: Run | ReadError) -> Path:
        """Make `path` a source of `runs`."""
        path.write_text("runs in memory")
        self.sources[path] = list(runs)
        return path

    def sniff(self, path: Path) -> bool:
        return path in self.sources

    def runs(self, path: Path, **options: object) -> Iterator[Run]:
        return _Each(self.sources[path])


class _Each(Iterator[Run]):
    def __init__(self, runs: Sequence[Any]) -> None:
        self._left = list(runs)

    def __next__(self) -> Run:
        if not self._left:
            raise StopIteration
        run = self._left.pop(0)
        if isinstance(run, Exception):
            raise run
        return run


def shuffled(mesh: RunMesh, seed: int = 0) -> tuple[RunMesh, np.ndarray]:
    """The same mesh with nodes and faces in another order, and the new node order."""
    rng = np.random.default_rng(seed)
    nodes, faces = rng.permutation(len(mesh.position)), rng.permutation(len(mesh.face_nodes))
    place = np.append(np.argsort(nodes), -1).astype(np.int32)
    return (
        replace(
            mesh,
            position=mesh.position[nodes],
            node_id=mesh.node_id[nodes],
            face_nodes=place[mesh.face_nodes[faces]],
            face_part=mesh.face_part[faces],
            face_id=mesh.face_id[faces],
        ),
        nodes,
    )
