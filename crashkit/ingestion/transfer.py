"""One run from its source into the staging folder: read by states, checked, changed to SI and to the common times,
written by blocks of nodes.

A reader gives some states of all nodes; a chunk holds all states of some nodes. Arrays are transposed
(state-major to node-major) in memory while a run stays below `MEMORY_BYTES`, and through a scratch file where it does not,
so memory does not grow with the run.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError
from crashkit.ingestion.alignment import flags_at, interpolate, interpolation_error, same_time
from crashkit.ingestion.curves import write_curves
from crashkit.ingestion.leaps import Leaps
from crashkit.ingestion.life import never_alive
from crashkit.ingestion.run_view import Flags, RunView, gone_nodes
from crashkit.ingestion.staging import StagedRun
from crashkit.ingestion.store import ArraySpec, create_arrays
from crashkit.ingestion.structure import Structure, matched
from crashkit.ingestion.survey import Choice, Field, Found, reopen
from crashkit.quality import Quality, look, measured
from crashkit.readers.base import Run
from data_schema import unit_system
from data_schema.blocks import split_states
from data_schema.checksum import BlockDigest, array_digest, block_digest
from data_schema.replace import put_in_place
from data_schema.validation import FIRST_STATE_TOLERANCE

# A run's states are turned in memory up to this size, and in a file above.
MEMORY_BYTES = 256 << 20
# What is read from the source at once: memory of this size is used again and again, where larger is mapped anew.
_PIECE_BYTES = 16 << 20
# A displacement this many times the structure, or the displacements before it, is none; nor is one of this many metres.
_LEAP, _FARTHEST = 1e3, 1e7
_DIVERGED = "the solution diverged, or the file is damaged"
# Blocks of nodes made, hashed, compressed and written at a time; each holds some 10 MB.
THREADS = 4

Block = NDArray[Any]


@dataclass(frozen=True)
class Layout:
    """What all runs of the dataset share.

    Attributes
    ----------
    structure
        In metres, its order of nodes, faces and cells is the dataset's.
    time
        (state,) s.
    one_shape
        Whether all runs have the structure's reference positions.
    """

    choice: Choice
    structure: Structure
    time: NDArray[np.float64]
    fields: dict[str, Field]
    one_shape: bool

    def specs(self, *, alive: bool = True, cell_alive: bool = True) -> list[ArraySpec]:
        """The result arrays of a run."""
        states, s = len(self.time), self.structure
        sizes = {"node": s.n_nodes, "face": len(s.face_nodes), "cell": len(s.cell_nodes)}
        out = [
            ArraySpec(
                "displacement", ("time", "node", "xyz"), (states, s.n_nodes, 3), "float32",
                {"units": "m", "long_name": "displacement from the reference position"},
            )
        ]  # fmt: skip
        if not self.one_shape:
            out.append(_reference_spec(s.n_nodes))
        if alive:
            out.append(ArraySpec("alive", ("time", "face"), (states, sizes["face"]), "bool"))
        if cell_alive and sizes["cell"]:
            out.append(ArraySpec("cell_alive", ("time", "cell"), (states, sizes["cell"]), "bool"))
        for name, wanted in self.fields.items():
            place, n = wanted.info.location, wanted.info.components
            dims: tuple[str, ...] = ("time", place)
            shape: tuple[int, ...] = (states, sizes[place])
            if n > 1:
                behind = {3: "xyz", 6: "tensor"}.get(n, f"{name}_component")
                dims, shape = (*dims, behind), (*shape, n)
            out.append(ArraySpec(name, dims, shape, "float32", {"units": wanted.unit, "role": "field"}))
        return out


def _reference_spec(nodes: int) -> ArraySpec:
    return ArraySpec(
        "reference_position", ("node", "xyz"), (nodes, 3), "float64", {"units": "m", "long_name": "undeformed position"}
    )


def transfer(found: Found, layout: Layout, key: str, place: Path) -> StagedRun:
    """Read the run `found` and write its arrays into a Zarr store at `place`, whole or not at all.

    Raises
    ------
    CrashkitError
        Naming file, state and node of what is wrong.
    OSError
        If the disk is full.
    """
    beside = place.with_name(f"{place.name}.{os.getpid()}")
    beside.parent.mkdir(exist_ok=True)
    try:
        run = reopen(found, layout.choice)
        try:
            with ThreadPoolExecutor(THREADS, thread_name_prefix="write") as pool:
                work = _Transfer(run, found, layout, beside, pool)
                digests, error = work.write()
            history = write_curves(run, found.units, beside / "arrays")
            printed = run.printed()
        finally:
            run.close()
        put_in_place(beside / "arrays", place)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    quality = measured(history, Quality() if printed is None else look(*printed))
    quality = replace(quality, leap=work.leaps.told)
    return StagedRun(key, found.name, digests, error, work.displacement, work.speed, asdict(quality))


def is_whole(staged: StagedRun, place: Path) -> bool:
    """Whether the arrays at `place` still are what was written; a power cut may have cost some of them."""
    import zarr

    try:
        for name, digest in staged.digests.items():
            array = zarr.open_array(str(place / name), mode="r")
            length, step = array.shape[2], array.chunks[2]
            found = (block_digest(np.asarray(array[0, :, k : k + step])) for k in range(0, length, step))
            if array_digest(found) != digest:
                return False
        position = place / "reference_position"
        return not position.is_dir() or bool(np.isfinite(zarr.open_array(str(position), mode="r")[...]).all())
    except Exception:  # a damaged file raises whatever its codec does; the run is then read again
        return False


class _Transfer:
    """The work on one run."""

    def __init__(self, run: Run, found: Found, layout: Layout, folder: Path, pool: ThreadPoolExecutor) -> None:
        self._found, self._layout, self._pool = found, layout, pool
        dead = never_alive(run)
        left_out = None if dead is None else dead.outside(layout.structure)
        structure = matched(layout.structure, layout.choice.structure(run, left_out))
        self._view = RunView(run, structure, unit_system(found.units))
        self._own, self._time = found.time, layout.time
        self._aligned = same_time(self._own, self._time)
        folder.mkdir()
        self._scratch = folder / "scratch"
        self._store = folder / "arrays"
        self._size = float(np.linalg.norm(np.ptp(layout.structure.position, axis=0)))
        self.displacement = self.speed = 0.0
        self.leaps = Leaps(layout.structure, self._own, self._size)
        self._before: Block | None = None

    def write(self) -> tuple[dict[str, str], float]:
        """Digests of the arrays that say something, and the estimated error of the change of times."""
        own = self._alive()
        self._gone = gone_nodes(self._view.structure, *own, len(self._own))
        if self._aligned:
            (faces, cells), gone = own, self._gone
        else:
            faces, cells = (None if f is None else flags_at(f, self._own, self._time) for f in own)
            gone = gone_nodes(self._view.structure, faces, cells, len(self._time))
        specs = {s.name: s for s in self._layout.specs(alive=faces is not None, cell_alive=cells is not None)}
        absent = [n for n in self._layout.fields if n not in self._found.fields]
        self._arrays = create_arrays(self._store, [s for n, s in specs.items() if n not in absent], 1)
        digests: dict[str, str] = {}
        error = self._displacement(specs["displacement"], gone, digests)
        for name, flags in (("alive", faces), ("cell_alive", cells)):
            if flags is not None:
                self._put(specs[name], partial(_columns, flags), digests)
        for name, wanted in self._found.fields.items():
            self._field(specs[name], wanted, digests)
        if "reference_position" in specs:
            self._arrays["reference_position"][0] = self._view.structure.position * self._view.system.length
        return digests, error

    # Displacements

    def _displacement(self, spec: ArraySpec, gone: Flags | None, digests: dict[str, str]) -> float:
        errors = [0.0]
        with _Turn((len(self._own), *spec.shape[1:]), self._scratch) as turn:
            for first, last in self._pieces(len(self._view.run.mesh.position) * 12):
                values = self._view.displacement(first, last)
                self._check(values, first)
                turn.put(first, values)

            def block(part: slice) -> Block:
                values = turn.nodes(part)
                if not self._aligned:
                    errors.append(interpolation_error(values, self._own, self._time))
                    values = interpolate(values, self._own, self._time)
                if gone is not None:
                    values = values.copy()
                    values[gone[:, part]] = np.nan
                return values

            self._put(spec, block, digests)
        return max(errors)

    def _check(self, values: Block, first: int) -> None:
        """Refuse displacements (state, node, 3) that are no numbers on living nodes, or not zero in the first state."""
        node_id = self._view.structure.node_id
        if first == 0 and len(values):
            size = np.abs(np.nan_to_num(values[0])).max(axis=-1)
            size = size if self._gone is None else np.where(self._gone[0], 0, size)
            node = int(size.argmax())
            if size[node] > FIRST_STATE_TOLERANCE:
                raise DataError(
                    f"{self._file(0)}: in the first state (time {self._own[0]:g} s) node {node_id[node]} is displaced by "
                    f"{size[node]:.3g} m; expected zero: are the first states missing, or are these positions and not "
                    "displacements?"
                )
        for k, state in enumerate(values, first):
            gone = None if self._gone is None else self._gone[k]
            if not np.isfinite(state).all():
                bad = ~np.isfinite(state).all(axis=-1)
                if gone is not None:
                    bad &= ~gone
                if bad.any():
                    node = int(np.argmax(bad))
                    raise DataError(f"{self._place(k, node)} is {state[node].tolist()}; {_DIVERGED}")
            self._measure(k, state, gone)

    def _measure(self, k: int, state: Block, gone: NDArray[np.bool_] | None) -> None:
        """Keep the largest displacement and speed so far; refuse a displacement (node, 3) that nothing can reach."""
        living = state if gone is None else np.where(gone[:, None], np.float32(0), state)
        node, largest = _longest(living)
        if largest > _FARTHEST or (k > 0 and largest > _LEAP * max(self.displacement, self._size)):
            raise DataError(
                f"{self._place(k, node)} is {largest:.3g} m long, that of the states before at most "
                f"{self.displacement:.3g} m, in a structure of {self._size:.3g} m; {_DIVERGED}"
            )
        if self._before is not None:
            moved = living - self._before
            before = None if self._gone is None else self._gone[k - 1]
            for absent in (gone, before):  # a node that is gone stands at zero here
                if absent is not None:
                    moved[absent] = 0
            step = _longest(moved)[1]
            self.speed = max(self.speed, step / float(self._own[k] - self._own[k - 1]))
            self.leaps.add(k, moved, step)
        self.displacement = max(self.displacement, largest)
        self._before = living

    def _place(self, state: int, node: int) -> str:
        number = self._view.structure.node_id[node]
        return f"{self._file(state)}: state {state} (time {self._own[state]:g} s), node {number}: the displacement"

    def _file(self, state: int) -> str:
        """The file that holds a state, as far as that can be told."""
        return str(self._view.run.file_of(state) if self._found.files else self._found.source)

    # Erosion

    def _alive(self) -> tuple[Flags | None, Flags | None]:
        """(state, face) and (state, cell) at the run's own times; None where nothing ever dies."""
        found: list[Flags | None] = [None, None]
        structure = self._view.structure
        sizes = len(structure.face_nodes), len(structure.cell_nodes)
        for first, last in self._pieces(sum(sizes)):
            for k, flags in enumerate(self._view.alive(first, last)):
                if flags is None or flags.all():
                    continue
                whole = found[k]
                if whole is None:
                    whole = found[k] = np.ones((len(self._own), sizes[k]), bool)
                whole[first:last] = flags
        return found[0], found[1]

    # Fields

    def _field(self, spec: ArraySpec, wanted: Field, digests: dict[str, str]) -> None:
        width = int(np.prod(spec.shape[2:], dtype=np.int64)) * 4
        with _Turn((len(self._own), *spec.shape[1:]), self._scratch) as turn:
            for first, last in self._pieces(self._view.field_rows(wanted) * width):
                turn.put(first, self._view.field(wanted, first, last))

            def block(part: slice) -> Block:
                values = turn.nodes(part)
                return values if self._aligned else interpolate(values, self._own, self._time, cubic=False)

            self._put(spec, block, digests)

    # Writing

    def _pieces(self, state_bytes: int) -> list[tuple[int, int]]:
        """Ranges of own states whose values stay below `_PIECE_BYTES`."""
        return split_states(len(self._own), -(-state_bytes // 12), _PIECE_BYTES)

    def _put(self, spec: ArraySpec, block: Callable[[slice], Block], digests: dict[str, str]) -> None:
        """Write an array whose blocks `block` makes; several at a time, since most of the work is outside Python."""
        array = self._arrays[spec.name]

        def write(part: slice) -> BlockDigest:
            values = block(part)
            array[0, :, part] = values
            return block_digest(values)

        digest = array_digest(self._pool.map(write, _parts(spec)))
        if digest is not None:
            digests[spec.name] = digest


_kept = threading.local()


def _memory(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Memory for a run, used again for the next one: getting it from the system costs as much as filling it."""
    size = int(np.prod(shape, dtype=np.int64))
    if getattr(_kept, "values", np.empty(0)).size < size:
        _kept.values = np.empty(size, np.float32)
    values: NDArray[np.float32] = _kept.values[:size].reshape(shape)
    return values


def let_memory_go() -> None:
    """Give back what is kept from run to run."""
    _kept.__dict__.clear()


class _Turn:
    """Values (state, node, ...) put in by states and taken out by nodes; in a file where they are many."""

    def __init__(self, shape: tuple[int, ...], scratch: Path) -> None:
        self._shape = shape
        self._entry = int(np.prod(shape[2:], dtype=np.int64)) * 4
        small = shape[0] * shape[1] * self._entry <= MEMORY_BYTES
        self._values = _memory(shape) if small else None
        self._scratch = scratch
        self._lock = threading.Lock()

    def __enter__(self) -> _Turn:
        self._file = None if self._values is not None else self._scratch.open("w+b", buffering=0)
        return self

    def __exit__(self, *_: object) -> None:
        self._values = None
        if self._file is not None:
            self._file.close()
            self._scratch.unlink()

    def put(self, first: int, values: Block) -> None:
        if self._values is not None:
            self._values[first : first + len(values)] = values
        elif self._file is not None:
            self._file.seek(first * self._shape[1] * self._entry)
            self._file.write(np.ascontiguousarray(values, np.float32).data.cast("B"))

    def nodes(self, part: slice) -> Block:
        """(state, nodes of `part`, ...) of all states, not to be written to; may be called from several threads."""
        if self._values is not None:
            return np.ascontiguousarray(self._values[:, part])
        out = np.empty((self._shape[0], part.stop - part.start, *self._shape[2:]), np.float32)
        with self._lock:
            for state in range(self._shape[0]):
                if self._file is not None:
                    self._file.seek((state * self._shape[1] + part.start) * self._entry)
                    self._file.readinto(out[state].data.cast("B"))
        return out


def _longest(vectors: Block) -> tuple[int, float]:
    """Place and length of the longest of some vectors (node, 3)."""
    squared = np.einsum("ij,ij->i", vectors, vectors, dtype=np.float64)
    node = int(squared.argmax())
    return node, float(np.sqrt(squared[node]))


def _columns(flags: Flags, part: slice) -> Block:
    return np.ascontiguousarray(flags[:, part])


def _parts(spec: ArraySpec) -> list[slice]:
    step = spec.chunks[1]
    return [slice(k, min(k + step, spec.shape[1])) for k in range(0, spec.shape[1], step)]
