"""LS-DYNA d3plot families: d3plot, d3plot01, .. d3plot99, d3plot100, read through lasso-python.

The node block of a state holds current positions (IU = 1), whatever it is called elsewhere; a file whose first
state is zero there holds displacements. Both become displacements from the geometry section's positions.

Shells are faces; solids, thick shells, beams and particles are cells, in this order. Fields of shells and nodes
stand alone (`plastic_strain`, `velocity`); those of cells carry their kind in front (`solid_plastic_strain`). Where
an element has several integration points, `plastic_strain` and `von_mises` are the largest of them and `stress` and
`strain` their mean (xx, yy, zz, xy, yz, zx). Shells of rigid parts have no results; their fields are NaN.

A part is taken for a rigid wall if it is called so and, where the file tells materials, is rigid (material 20), or if
LS-DYNA drew it with "null shells for visualization". Titles of parts come with numbers: those of the parts up to
release 11, and 1, 2, 3, ... in the order of the parts since release 12.

In a folder with a d3plot, other families of LS-DYNA (d3part, d3drlf, ...) are left aside; where they are all there is,
they are read.

A d3plot does not know its end time; it is taken from *CONTROL_TERMINATION of a keyword file in the same folder.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import register
from crashkit.readers._binout import binout_files, read_binout
from crashkit.readers._cells import LINE, VERTEX, shell_faces, solid_cells, stack_cells
from crashkit.readers._d3plot_file import D3plotFile, word_size
from crashkit.readers._folders import Collected, files_in, named, recognises, runs_in
from crashkit.readers._names import DRAWN_WALL, WALL_NAME, quantity
from crashkit.readers.base import FieldInfo, Parameter, Part, Run, RunMesh, Runs
from crashkit.readers.checks import require_finite, require_indices, require_options, time_problems
from crashkit.readers.history import History

_RIGID = 20
# How first files are called, with a job's name in front where it has one; the second are those beside a d3plot.
_ENDING = re.compile(r"d3(plot|part)$", re.IGNORECASE)
_BESIDE = re.compile(r"d3(part|drlf|eigv|mode|iter)$", re.IGNORECASE)
_DECK_SUFFIXES = (".k", ".key", ".dyn")
_DECK_BYTES = 16 << 20
# (kind, field, lasso-python's name, components); the header says which of them a file holds.
_ELEMENT_FIELDS = (
    ("solid", "stress", "element_solid_stress", 6),
    ("solid", "von_mises", "element_solid_stress", 1),
    ("solid", "plastic_strain", "element_solid_effective_plastic_strain", 1),
    ("tshell", "stress", "element_tshell_stress", 6),
    ("tshell", "von_mises", "element_tshell_stress", 1),
    ("tshell", "plastic_strain", "element_tshell_effective_plastic_strain", 1),
    ("beam", "axial_force", "element_beam_axial_force", 1),
    ("beam", "shear_force", "element_beam_shear_force", 2),
    ("shell", "stress", "element_shell_stress", 6),
    ("shell", "von_mises", "element_shell_stress", 1),
    ("shell", "plastic_strain", "element_shell_effective_plastic_strain", 1),
    ("shell", "strain", "element_shell_strain", 6),
    ("shell", "thickness", "element_shell_thickness", 1),
    ("sph", "radius", "sph_radius", 1),
    ("sph", "pressure", "sph_pressure", 1),
    ("sph", "stress", "sph_stress", 6),
    ("sph", "von_mises", "sph_stress", 1),
    ("sph", "plastic_strain", "sph_effective_plastic_strain", 1),
    ("sph", "density", "sph_density", 1),
    ("sph", "internal_energy", "sph_internal_energy", 1),
    ("sph", "neighbors", "sph_n_neighbors", 1),
    ("sph", "strain", "sph_strain", 6),
    ("sph", "strain_rate", "sph_strainrate", 6),
    ("sph", "mass", "sph_mass", 1),
)
# Dimensions of these fields where elements have no integration points.
_WITHOUT_POINTS = {"plastic_strain": 1, "stress": 2, "von_mises": 2, "strain": 2, "strain_rate": 2}
_CELL_KINDS = ("solid", "tshell", "beam", "sph")


class D3plot:
    """Reader of a d3plot (its first file), of a folder with one or several, or of a folder of such folders."""

    name = "d3plot"
    description = "LS-DYNA d3plot, d3plot01, ... (through lasso-python)"

    def sniff(self, path: Path) -> bool:
        return recognises(_found, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options)
        found = _found(path) or Collected({path.name: path} if path.is_file() else {})
        if not found:
            raise ReadError(f"{path}: no d3plot here; expected files d3plot, d3plot01, ...")
        return Runs({name: partial(_D3plotRun, name, file) for name, file in found.runs.items()}, found.aside)


def _found(path: Path) -> Collected[Path]:
    """Run name -> first file of all families at `path`."""
    if path.is_file():
        if word_size(path) is None:
            return Collected()
        main, beside = _first_files_in(path.parent)
        alike = beside if path in beside else main
        return Collected({path.resolve().parent.name if len(alike) <= 1 else path.name: path})
    return runs_in(path, _found_in) if path.is_dir() else Collected()


def _found_in(folder: Path) -> Collected[Path]:
    main, beside = _first_files_in(folder)
    aside = []
    if main and beside:
        names = ", ".join(p.name for p in beside)
        aside.append(f"{folder}: {names} left aside, since {main[0].name} is there; name the file to read it")
    return Collected(named((p.name, p.name, p) for p in main or beside), aside)


def _first_files_in(folder: Path) -> tuple[list[Path], list[Path]]:
    """First files of the families with whole results, and of those with parts of them (d3part, d3drlf, ...)."""
    files = list(files_in(folder))
    names = {p.name for p in files}
    likely = [p for p in files if _ENDING.search(p.name) or f"{p.name}01" in names]
    good = [p for p in likely if word_size(p) is not None]
    return [p for p in good if not _BESIDE.search(p.name)], [p for p in good if _BESIDE.search(p.name)]


class _D3plotRun(Run):
    """One family; the states' blocks are read when they are asked for."""

    def __init__(self, name: str, first: Path) -> None:
        self.name, self.solver = name, "LS-DYNA"
        family = _family(first)
        self._file = D3plotFile(first, tuple(family.values()))
        if "displacement" not in self._file.blocks or not self._file.blocks["displacement"][1]:
            found = [n for n in ("temperature", "velocity", "acceleration") if self._file.blocks[n][1]]
            raise ReadError(
                f"{first}: has no displacements (IU = 0), only {', '.join(found) or 'no node results'}; "
                "let LS-DYNA write them (*DATABASE_EXTENT_BINARY), or leave this run out"
            )
        if not self._file.states:
            raise ReadError(f"{first}: no state found in {1 + len(family)} file(s); {_reason(self._file.problems)}")
        self._arrays = self._file.arrays
        self.mesh = self._read_mesh()
        self.time = np.array([self._file.block("time", k)[0] for k in range(len(self._file.states))], np.float64)
        self._holds_positions = self._told_positions()
        self.fields = self._offered()
        self.parameters: Mapping[str, Parameter] = {}
        decks = sorted(p for p in first.parent.iterdir() if p.suffix.lower() in _DECK_SUFFIXES and p.is_file())
        self.end_time = _end_time(decks)
        self._curves = binout_files(first.parent)
        self.files = (first, *family.values(), *self._curves)
        self.problems = (
            *_gaps(first, tuple(family)),
            *_adapted(first),
            *self._file.problems,
            *time_problems(self.time, [self._place(k) for k in range(len(self.time))]),
        )

    def history(self) -> History | None:
        """The curves of the binout family beside the d3plot, where there is one."""
        return read_binout(self._curves) if self._curves else None

    def file_of(self, state: int) -> Path:
        return self._file.states[state].file

    def printed(self) -> tuple[Path, str] | None:
        """messag or d3hsp of the folder; of a folder with several runs nobody knows whose they are."""
        folder = self.files[0].parent
        return (folder, "*") if len(_found_in(folder).runs) == 1 else None

    def _place(self, state: int) -> str:
        at = self._file.states[state]
        return f"{at.file}, state {state}, byte {at.offset}"

    # The mesh

    def _array(self, name: str, length: int) -> NDArray[np.int64]:
        found = np.asarray(self._arrays.get(name, np.arange(1, length + 1)), np.int64)
        if len(found) != length:
            raise ReadError(f"{self._file.first}: {name} has {len(found)} entries, expected {length}; it is damaged")
        return found

    def _read_mesh(self) -> RunMesh:
        header, first = self._file.header, self._file.first
        position = np.array(self._arrays["node_coordinates"], np.float64)
        require_finite(position, "the position", f"{first}, geometry")
        parts = self._parts()
        owners: dict[str, NDArray[np.int64]] = {}
        nodes: dict[str, NDArray[np.int64]] = {}
        for kind, corners in (("solid", 8), ("tshell", 8), ("beam", 2), ("shell", 4)):
            joined = np.asarray(self._arrays[f"element_{kind}_node_indexes"], np.int64)[:, :corners]
            owners[kind] = np.asarray(self._arrays[f"element_{kind}_part_indexes"], np.int64)
            nodes[kind] = joined
        nodes["sph"] = np.asarray(self._arrays.get("sph_node_indexes", []), np.int64).reshape(-1, 1)
        owners["sph"] = np.asarray(self._arrays.get("sph_node_material_index", []), np.int64)
        for kind in nodes:
            require_indices(nodes[kind], len(position), kind, f"{first}, geometry")
            if owners[kind].size and not 0 <= owners[kind].min() <= owners[kind].max() < len(parts):
                raise ReadError(
                    f"{first}: a {kind} names part {int(owners[kind].max()) + 1} of {len(parts)}; the file is damaged"
                )
        self._counts = {kind: len(nodes[kind]) for kind in _CELL_KINDS}
        cells, types = [], []
        for kind in _CELL_KINDS:
            if kind in ("solid", "tshell"):
                shaped, shapes = solid_cells(nodes[kind])
            else:
                shaped = nodes[kind].astype(np.int32)
                shapes = np.full(len(shaped), LINE if kind == "beam" else VERTEX, np.uint8)
            cells.append(shaped)
            types.append(shapes)
        ids = [self._array(f"element_{k}_ids", self._counts[k]) for k in _CELL_KINDS if k != "sph"]
        particles = self._array("node_ids", header.n_nodes)[nodes["sph"][:, 0]]
        return RunMesh(
            position=position,
            node_id=self._array("node_ids", header.n_nodes),
            face_nodes=shell_faces(nodes["shell"]),
            face_part=owners["shell"].astype(np.int32),
            face_id=self._array("element_shell_ids", len(nodes["shell"])),
            parts=parts,
            cell_nodes=stack_cells(cells),
            cell_type=np.concatenate(types),
            cell_part=np.concatenate([owners[k] for k in _CELL_KINDS]).astype(np.int32),
            cell_id=np.concatenate([*ids, particles]),
        )

    def _parts(self) -> tuple[Part, ...]:
        count = int(self._file.header.n_parts)
        titled = np.asarray(self._arrays.get("part_titles_ids", []), np.int64)
        if "part_ids" in self._arrays:
            ids = self._array("part_ids", count)
        else:
            ids = titled if len(titled) == count else np.arange(1, count + 1)
        texts = [bytes(t).split(b"\0")[0].decode("latin-1").strip() for t in self._arrays.get("part_titles", ())]
        counted = np.array_equal(titled, np.arange(1, count + 1))
        if len(titled) == count and (counted or set(titled.tolist()) != set(ids.tolist())):
            titles = dict(zip(ids.tolist(), texts, strict=True))
        else:
            titles = dict(zip(titled.tolist(), texts, strict=True))
        materials = np.asarray(self._arrays.get("part_material_type", []), np.int64)
        parts = []
        for k, number in enumerate(ids.tolist()):
            name = titles.get(number) or f"part {number}"
            rigid = len(materials) != count or materials[k] == _RIGID
            wall = bool(DRAWN_WALL.search(name) or (rigid and WALL_NAME.search(name)))
            parts.append(Part(number, name, wall))
        return tuple(parts)

    def _told_positions(self) -> bool:
        """Whether the node block holds positions; else it holds displacements."""
        first = self._file.block("displacement", 0)
        size = float(np.ptp(self.mesh.position, axis=0).max(initial=0.0))
        return not (np.abs(first).max(initial=0.0) < 1e-6 * size < np.abs(self.mesh.position).max(initial=0.0))

    # States

    def displacement(self, first: int, last: int) -> NDArray[np.float32]:
        out = np.empty((last - first, len(self.mesh.position), 3), np.float32)
        for row, state in enumerate(range(first, last)):
            found = self._file.block("displacement", state).reshape(-1, 3)
            require_finite(found, "the position", self._place(state))
            out[row] = found - self.mesh.position if self._holds_positions else found
        return out

    def _offered(self) -> dict[str, FieldInfo]:
        header, blocks = self._file.header, self._file.blocks
        fields = {}
        for name in ("velocity", "acceleration"):
            if blocks[name][1]:
                fields[name] = FieldInfo(name, "node", 3, name)
        if blocks["temperature"][1] and not header.has_node_temperature_layers:
            fields["temperature"] = FieldInfo("temperature", "node", 1, "temperature")
        told = {
            "stress": {"solid": header.has_solid_stress, "default": header.has_shell_tshell_stress},
            "plastic_strain": {"solid": header.has_solid_pstrain, "default": header.has_shell_tshell_pstrain},
            "strain": {"default": header.has_element_strain},
            "thickness": {"default": header.has_shell_extra_variables},
            "axial_force": {"default": header.n_beam_vars >= 6},
            "shear_force": {"default": header.n_beam_vars >= 6},
        }
        withheld = {}
        for kind, plain, theirs, components in _ELEMENT_FIELDS:
            if kind == "sph":
                there = self._file.particle_fields.get(theirs, False)
            else:
                flags = told["stress" if plain == "von_mises" else plain]
                there = flags.get(kind, flags["default"])
            if kind == "shell" and there and plain in self._file.shells_withheld:
                withheld[plain] = self._file.shells_withheld[plain]
            elif blocks[kind][1] and there:
                name = plain if kind == "shell" else f"{kind}_{plain}"
                place = "face" if kind == "shell" else "cell"
                fields[name] = FieldInfo(name, place, components, quantity(plain))  # type: ignore[arg-type]
        self.withheld = withheld
        return fields

    def field(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        if name in self.withheld:
            raise ReadError(f"{self._file.first}: {name} is not read: {self.withheld[name]}")
        info = self.fields[name]
        if info.location == "node":
            values = np.stack([self._file.block(name, s) for s in range(first, last)]).astype(np.float32)
            return values.reshape(last - first, -1, 3) if info.components == 3 else values
        kind, plain, theirs = next(
            (kind, plain, theirs)
            for kind, plain, theirs, _ in _ELEMENT_FIELDS
            if name == (plain if kind == "shell" else f"{kind}_{plain}")
        )
        found = []
        for state in range(first, last):
            arrays = self._file.elements(kind, state)
            if theirs not in arrays:
                raise ReadError(f"{self._place(state)}: its header tells of {name}, but it is not there")
            found.append(_one_value(plain, arrays[theirs][0]))
        values = np.stack(found).astype(np.float32)
        return self._among_shells(values) if kind == "shell" else self._among_cells(kind, values)

    def _among_shells(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Values of the deformable shells as values of all, NaN on those of rigid parts."""
        count = len(self.mesh.face_nodes)
        if values.shape[1] == count:
            return values
        materials = np.asarray(self._arrays.get("part_material_type", []), np.int64)
        soft = materials[self.mesh.face_part] != _RIGID if len(materials) else np.zeros(count, bool)
        if soft.sum() != values.shape[1]:
            raise ReadError(
                f"{self._file.first}: {values.shape[1]} of {count} shells have results, "
                f"but {int(soft.sum())} are not in rigid parts; the file is damaged"
            )
        out = np.full((len(values), count, *values.shape[2:]), np.nan, np.float32)
        out[:, soft] = values
        return out

    def _among_cells(self, kind: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Values of one kind of cells as values of all, NaN on the others."""
        start = sum(self._counts[k] for k in _CELL_KINDS[: _CELL_KINDS.index(kind)])
        out = np.full((len(values), sum(self._counts.values()), *values.shape[2:]), np.nan, np.float32)
        out[:, start : start + values.shape[1]] = values
        return out

    def alive(self, first: int, last: int) -> NDArray[np.bool_] | None:
        return self._living(("shell",), self.mesh.face_nodes, first, last)

    def alive_cells(self, first: int, last: int) -> NDArray[np.bool_] | None:
        return self._living(_CELL_KINDS, self.mesh.cell_nodes, first, last)

    def _living(
        self, kinds: tuple[str, ...], nodes: NDArray[np.int32], first: int, last: int
    ) -> NDArray[np.bool_] | None:
        """(state, element): element words other than zero; or, where nodes are marked instead, elements with all their nodes.

        Particles have a word of their own (`D3plotFile.particle_alive`).
        """
        blocks = self._file.blocks
        if not len(nodes):
            return None
        particles = "sph" in kinds and blocks["sph"][1] > 0
        if not particles and not any(f"{kind}_alive" in blocks for kind in ("node", *kinds)):
            return None
        rows = []
        for state in range(first, last):
            told = [self._elements_alive(kind, state) for kind in kinds]
            rows.append(np.concatenate(told))
            if "node_alive" in blocks:
                there = np.append(self._file.block("node_alive", state) != 0, True)
                rows[-1] &= there[nodes].all(axis=1)  # node -1 of the padding is the True appended
        return np.stack(rows)

    def _elements_alive(self, kind: str, state: int) -> NDArray[np.bool_]:
        """(element,) of one kind; all where the state does not say."""
        if kind == "sph" and self._file.blocks["sph"][1]:
            return self._file.particle_alive(state)
        if f"{kind}_alive" in self._file.blocks:
            return np.asarray(self._file.block(f"{kind}_alive", state) != 0)
        return np.ones(self._counts.get(kind, len(self.mesh.face_nodes)), bool)


def _one_value(plain: str, values: NDArray[Any]) -> NDArray[Any]:
    """One value an element from its integration points: (element, point[, component]) -> (element[, component])."""
    if values.ndim == _WITHOUT_POINTS.get(plain):  # particles have none
        values = values[:, None]
    if plain == "von_mises":
        xx, yy, zz, xy, yz, zx = np.moveaxis(values.astype(np.float64), -1, 0)
        squared = ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) / 2 + 3 * (xy**2 + yz**2 + zx**2)
        return np.asarray(np.sqrt(squared).max(axis=1))
    if plain == "plastic_strain":
        return np.asarray(values.max(axis=1))
    if plain in ("stress", "strain", "strain_rate"):
        return np.asarray(values.mean(axis=1, dtype=np.float64))
    return values


def _family(first: Path) -> dict[int, Path]:
    """Number -> file of the family behind its first file, in the order of their numbers."""
    name = re.compile(re.escape(first.name) + r"(\d+)")
    found: dict[int, Path] = {}
    for file in files_in(first.parent):
        if match := name.fullmatch(file.name):
            other = found.setdefault(int(match[1]), file)
            if other != file:
                raise ReadError(
                    f"{first.parent}: {other.name} and {file.name} have the same number; expected one file each, so "
                    "rename or remove one of them"
                )
    return dict(sorted(found.items()))


def _gaps(first: Path, numbers: tuple[int, ...]) -> list[str]:
    missing = sorted(set(range(1, max(numbers, default=0) + 1)) - set(numbers))
    if not missing:
        return []
    names = ", ".join(f"{first.name}{n:02d}" for n in missing[:5]) + (", ..." if len(missing) > 5 else "")
    return [
        f"{first.parent}: {len(missing)} files of the family up to {first.name}{numbers[-1]:02d} are missing: {names}"
    ]


def _adapted(first: Path) -> list[str]:
    """LS-DYNA begins a family with letters behind its name (d3plotaa) whenever it has remeshed."""
    name = re.compile(re.escape(first.name) + r"[a-z]{2}")
    found = sorted(p.name for p in first.parent.iterdir() if name.fullmatch(p.name))
    if not found:
        return []
    return [f"{first.parent}: the mesh was adapted during the run ({found[0]} is there), which is not supported"]


def _reason(problems: list[str]) -> str:
    return problems[0] if problems else "the state files (d3plot01, ...) are missing"


def _end_time(decks: list[Path]) -> float | None:
    """ENDTIM of *CONTROL_TERMINATION, where all decks that have it agree."""
    found = set()
    for deck in decks:
        try:
            with deck.open(encoding="latin-1") as stream:
                lines = iter(stream.read(_DECK_BYTES).splitlines())
        except OSError:
            continue
        for line in lines:
            if line.upper().startswith("*CONTROL_TERMINATION"):
                card = next((rest for rest in lines if not rest.startswith("$")), "")
                try:
                    found.add(float(card.split(",")[0] if "," in card else card[:10]))
                except ValueError:
                    return None
    return found.pop() if len(found) == 1 else None


register(D3plot())
