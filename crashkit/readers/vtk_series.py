"""VTK files with time: a PVD collection of VTU or VTP, or files with a number each.

A run is a `.pvd`; or a `.series` list as ParaView writes it; or files that differ by a number in their name
(run_0000.vtu, kartA001.vtk), each with its time in the field data (TimeValue, or TIME as OpenRadioss's converter to
legacy VTK writes it). Where files hold no times, the option `time_step` gives the time between two of them. VTU and
VTP are read by VTK, legacy files here (the modules that do it say why).

A state may lie in several files: the blocks of a VTM become parts, and the pieces of a PVTU, which solvers write on
several processors, are joined by their global node numbers.

Of legacy files made from OpenRadioss, the solver's node, element and part numbers are kept, EROSION_STATUS (1 for
living elements) becomes `alive`, and elements numbered 0 on nodes numbered 0 are a rigid wall.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import register
from crashkit.readers._folders import Collected, files_in, named, recognises, runs_in
from crashkit.readers._grid import Grid, WholeStates
from crashkit.readers._grid_run import GridRun
from crashkit.readers._names import NODE_IDS
from crashkit.readers._vtk_legacy import is_legacy, legacy_field_data, read_legacy
from crashkit.readers._vtk_lists import Leaf, kind_of, leaves, listed_states, named_files
from crashkit.readers._vtk_process import read_xml
from crashkit.readers.base import Run, Runs
from crashkit.readers.checks import reading, require_options, time_step_option

_NUMBERED = re.compile(r"(?P<stem>.*?)(?P<number>\d+)")
_NUMBERED_SUFFIXES = (".vtu", ".vtp", ".vtk", ".pvtu", ".pvtp", ".vtm")
_STATES = ("grid", "pieces", "blocks")
_LISTS = ("pvd", "series")
_TIMES = ("timevalue", "time")
# Points of a node that several pieces have may differ by this fraction of the mesh's size: pieces are written apart.
_SAME_POINT = 1e-5
_DUPLICATE = 1  # of vtkGhostType: another piece has this cell as well


class VtkSeries:
    """Reader of PVD collections, file series and numbered VTU, VTP and legacy VTK files, or a folder of them."""

    name = "vtk-series"
    description = "VTK files with time: PVD with VTU or VTP, or numbered VTU, VTP and legacy VTK files"

    def sniff(self, path: Path) -> bool:
        return recognises(_found, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options, ("time_step",))
        step = time_step_option(options)
        found = _found(path)
        if not found:
            raise ReadError(f"{path}: no VTK files with time (.pvd, .series, or numbered .vtu, .vtp, .vtk files) here")
        return Runs({name: partial(_open, name, files, step) for name, files in found.runs.items()}, found.aside)


def _found(path: Path) -> Collected[Sequence[Path]]:
    """Run name -> its list of states (one .pvd or .series file), or the files of its states."""
    if path.is_file():
        kind = kind_of(path)
        if kind in _LISTS:
            return Collected({_stem(path): [path]})
        if kind not in _STATES:
            return Collected()
        families = _numbered(path.parent, set())
        alone = path.resolve().parent.name if len(families) == 1 else None
        return Collected({alone or name: files for name, files in families.items() if path in files})
    if not path.is_dir():
        return Collected()
    # A list names files beside it or in folders below: those are no runs of their own.
    lists = {folder: _lists(folder) for folder in (path, *(p for p in path.iterdir() if p.is_dir()))}
    listed = named_files([file for files in lists.values() for file in files])

    def find(folder: Path) -> Collected[Sequence[Path]]:
        known = [(_stem(file), file.name, [file]) for file in lists[folder]]
        if listed is not None:
            known += [(name, name, files) for name, files in _numbered(folder, listed).items()]
        elif not known and not lists[path]:
            known = [(name, name, files) for name, files in _numbered(folder, set()).items()]
        return Collected(named(known))

    return runs_in(path, find, own_name_at_top=bool(lists[path]))


def _lists(folder: Path) -> list[Path]:
    return [p for p in files_in(folder) if p.suffix.lower() in (".pvd", ".series") and kind_of(p) in _LISTS]


def _stem(file: Path) -> str:
    """The name of a list without what makes it a list: "v10.5_t1.2" of v10.5_t1.2.pvd, "a" of a.vtu.series."""
    stem = file.stem
    return Path(stem).stem if file.suffix == ".series" and Path(stem).suffix in _NUMBERED_SUFFIXES else stem


def _numbered(folder: Path, listed: set[Path]) -> dict[str, list[Path]]:
    """Families of at least two files that differ by a number, in the order of their numbers, without those `listed`."""
    families: dict[tuple[str, str], dict[int, Path]] = {}
    for file in files_in(folder):
        match = _NUMBERED.fullmatch(file.stem)
        if match and file.suffix.lower() in _NUMBERED_SUFFIXES and file.resolve() not in listed:
            states = families.setdefault((match["stem"], file.suffix), {})
            if int(match["number"]) in states:
                raise ReadError(
                    f"{folder}: {states[int(match['number'])].name} and {file.name} have the same number; expected one "
                    "file a state, so rename or remove one of them"
                )
            states[int(match["number"])] = file
    found = []
    pieces: set[Path] = set()
    for (stem, suffix), files in families.items():
        ordered = [files[n] for n in sorted(files)]
        kinds = {kind_of(f) for f in ordered}
        if len(ordered) > 1 and kinds & set(_STATES):
            found.append((stem.rstrip("_.- ") or folder.resolve().name, stem + suffix, ordered))
            for file in ordered if kinds & {"pieces", "blocks"} else ():
                pieces.update(leaf.file.resolve() for leaf in leaves(file))
    return named(entry for entry in found if not pieces.intersection(f.resolve() for f in entry[2]))


def _open(name: str, files: Sequence[Path], step: float | None) -> Run:
    with reading(files[0]):
        return _opened(name, files, step)


def _opened(name: str, files: Sequence[Path], step: float | None) -> Run:
    kind = kind_of(files[0]) if len(files) == 1 else "grid"
    if kind in _LISTS:
        listed, notes = listed_states(files[0])
        missing = [f for state in listed for f in state.files if not f.is_file()]
        listed = [state for state in listed if all(f.is_file() for f in state.files)]
        if not listed:
            raise ReadError(
                f"{files[0]}: none of the files it lists is there ({missing[0] if missing else 'it lists none'})"
            )
        told = [state.time for state in listed if state.time is not None]
        if 0 < len(told) < len(listed):
            raise ReadError(
                f"{files[0]}: {len(listed) - len(told)} of its entries have no timestep; expected all or none"
            )
        times, more = _times(told, len(listed), step, files[0])
        source = FileSeries(times, [state.files for state in listed], index=files[0])
        run = GridRun(name, source, _solver(source))
        run.notes = (*notes, *more, *run.notes)
        if missing:
            text = f"{files[0]}: {len(missing)} of the files it lists are missing: {missing[0].name}"
            run.problems = (text + (", ..." if len(missing) > 1 else ""), *run.problems)
        return run
    own = [_time_of(f) for f in files]
    without = [f for f, time in zip(files, own, strict=True) if time is None]
    if without and len(without) < len(own):
        raise ReadError(
            f"{without[0]}: has no time in its field data, other files of the run have; expected all or none"
        )
    times, notes = _times([time for time in own if time is not None], len(files), step, files[0])
    source = FileSeries(times, [(f,) for f in files])
    run = GridRun(name, source, _solver(source))
    run.notes = (*notes, *run.notes)
    run.problems = (*_gaps(files), *run.problems)
    return run


def _times(own: Sequence[float], count: int, step: float | None, place: Path) -> tuple[list[float], tuple[str, ...]]:
    """The times of `count` states, their own where they have any, and what there is to say about them."""
    if own:
        used = () if step is None else (f"{place}: holds times of its own, so --time-step is not used",)
        return list(own), used
    if step is None:
        raise ReadError(
            f"{place}: has no time in its field data (TimeValue or TIME), and no list does; give the time between two "
            "states (--time-step), or list the states with their times in a .pvd file"
        )
    return [k * step for k in range(count)], ()


def _gaps(files: Sequence[Path]) -> list[str]:
    """Numbers that are missing between the first and the last; steps of ten, say, are no gaps."""
    numbers = [int(m["number"]) for f in files if (m := _NUMBERED.fullmatch(f.stem))]
    steps = np.diff(numbers)
    if not len(steps) or (steps == steps.min()).all():
        return []
    k = int(np.argmax(steps != steps.min()))
    return [f"{files[k].parent}: {files[k].name} is followed by {files[k + 1].name}; files between them are missing"]


def _time_of(file: Path) -> float | None:
    """The time in the field data of a file (of the first piece where it names others), None where there is none."""
    mesh = leaves(file)[0].file
    data = legacy_field_data(mesh) if is_legacy(mesh) else read_xml(mesh).field_data
    for name, values in data.items():
        if name.lower() in _TIMES and values.size == 1:
            return float(values.reshape(-1)[0])
    return None


def _solver(source: FileSeries) -> str:
    names = {n.upper() for n in source.first().cell_data}
    return "OpenRadioss" if {"EROSION_STATUS", "ELEMENT_ID", "PART_ID"} <= names else "unknown"


class FileSeries(WholeStates):
    """States in files of their own, or in several files that are pieces of one mesh."""

    def __init__(self, time: Sequence[float], states: Sequence[tuple[Path, ...]], index: Path | None = None) -> None:
        self.time = np.array(time, np.float64)
        self._states = [[leaf for file in files for leaf in leaves(file)] for files in states]
        named = [f for files in states for f in files]
        behind = [leaf.file for state in self._states for leaf in state]
        self.files = tuple(dict.fromkeys((*(() if index is None else (index,)), *named, *behind)))

    def place(self, state: int) -> str:
        return f"{self.file_of(state)}, state {state}"

    def file_of(self, state: int) -> Path:
        return self._states[state][0].file

    def read(self, state: int) -> Grid:
        listed = self._states[state]
        pieces = [read_legacy(leaf.file) if is_legacy(leaf.file) else read_xml(leaf.file) for leaf in listed]
        whole = [(leaf, grid) for leaf, grid in zip(listed, pieces, strict=True) if len(grid.points)]
        if not whole:
            raise ReadError(f"{self.place(state)}: its {len(listed)} files hold no point; expected a mesh")
        for leaf, grid in whole:
            grid.check(leaf.file)
        return _joined(whole)


def _joined(pieces: Sequence[tuple[Leaf, Grid]]) -> Grid:
    """Pieces of one state as one mesh; arrays that not all pieces have are left out."""
    groups = {leaf.group for leaf, _ in pieces}
    grids = [_without_ghosts(grid) if leaf.group is not None else grid for leaf, grid in pieces]
    if len(grids) == 1:
        return grids[0]
    points = np.cumsum([0, *(len(g.points) for g in grids)])
    corners = np.cumsum([0, *(len(g.connectivity) for g in grids)])

    def common(arrays: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        names = [n for n, v in arrays[0].items() if all(n in a and a[n].shape[1:] == v.shape[1:] for a in arrays)]
        return {n: np.concatenate([a[n] for a in arrays]) for n in names}

    joined = Grid(
        np.concatenate([g.points for g in grids]),
        np.concatenate([g.connectivity + start for g, start in zip(grids, points)]),
        np.concatenate([[0], *(g.offsets[1:] + start for g, start in zip(grids, corners))]),
        np.concatenate([g.types for g in grids]),
        common([g.point_data for g in grids]),
        common([g.cell_data for g in grids]),
        grids[0].field_data,
        units=grids[0].units,
    )
    domains = groups != {None}
    ids = next((n for n in joined.point_data if n.lower() in NODE_IDS and joined.point_data[n].ndim == 1), None)
    if ids is None and domains:
        raise ReadError(
            f"{pieces[0][0].group}: its {len(pieces)} pieces (PVTU) have no global node numbers, so nodes on their borders "
            "would be there twice; write the point array GlobalNodeIds, or one VTU a state"
        )
    merged = None if ids is None else _merged(joined, ids, str(pieces[0][0].file), domains)
    if merged is not None:
        return merged
    if _same_mesh_twice(grids):
        raise ReadError(
            f"{pieces[0][0].file}: the list of states names the same mesh {len(grids)} times at one time (also "
            f"{pieces[1][0].file.name}); expected one file a state and part"
        )
    if "part_id" in joined.cell_data:
        return joined
    part = np.repeat(np.arange(1, len(grids) + 1), [len(g.types) for g in grids])
    names = {k: leaf.name for k, (leaf, _) in enumerate(pieces, 1) if leaf.name}
    return replace(joined, cell_data={**joined.cell_data, "part_id": part}, part_names=names)


def _merged(joined: Grid, ids: str, place: str, domains: bool) -> Grid | None:
    """Pieces with every node once, matched by the numbers `ids`; None where the pieces share no node.

    Numbers that mean another place in another piece are those of blocks that count on their own: an error in
    `domains`, no reason to join elsewhere.
    """
    numbers = np.asarray(joined.point_data[ids]).astype(np.int64)
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    if len(first) == len(numbers) and not domains:
        return None
    apart = np.abs(joined.points[first[inverse]] - joined.points).max(initial=0.0)
    if apart > _SAME_POINT * float(np.ptp(joined.points, axis=0).max(initial=0.0)):
        if not domains:
            return None
        node = int(numbers[int(np.abs(joined.points[first[inverse]] - joined.points).max(axis=1).argmax())])
        raise ReadError(f"{place}: node {node} has other positions in different pieces; expected global node numbers")
    return replace(
        joined,
        points=joined.points[first],
        connectivity=inverse.reshape(-1)[joined.connectivity],
        point_data={name: values[first] for name, values in joined.point_data.items()},
    )


def _without_ghosts(grid: Grid) -> Grid:
    """A piece without the cells that other pieces have as well."""
    ghosts = grid.cell_data.get("vtkGhostType")
    if ghosts is None or not (ghosts & _DUPLICATE).any():
        return grid
    kept = (ghosts & _DUPLICATE) == 0
    sizes = np.diff(grid.offsets)
    return replace(
        grid,
        connectivity=grid.connectivity[np.repeat(kept, sizes)],
        offsets=np.concatenate([[0], np.cumsum(sizes[kept])]),
        types=grid.types[kept],
        cell_data={name: values[kept] for name, values in grid.cell_data.items()},
    )


def _same_mesh_twice(grids: Sequence[Grid]) -> bool:
    first, second = grids[:2]
    return np.array_equal(first.points, second.points) and np.array_equal(first.connectivity, second.connectivity)


register(VtkSeries())
