"""What stands where in an LS-DYNA d3plot family, and its sections, parsed by lasso-python.

lasso-python believes every count in the header, so they are checked against the file's size before it sees them. It
gets the geometry section once, and then single blocks of single states: memory stays at a block.

A file of the family holds whole states, then the word -999999.0, then zeros up to a multiple of 512 words. The
first file holds the geometry before its states, usually without any.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers.lasso import geometry_class, guarded, header_class

_END = -999999.0
_HEADER_WORDS = 64
# More than this is read of the first file only where its header asks for it (part titles, rigid bodies).
_SLACK = 32 << 20
_D3PLOT, _D3PART = 1, 5
# The word with the number of parts, and what FEMZIP writes there.
_NMMAT, _FEMZIP = 51, 76_893_465
# Words of the header that are counts, by the names of LS-DYNA's database manual.
_COUNTS = (
    "numnp", "nglbv", "nummat8", "nv3d", "nel2", "nummat2", "nv1d", "nel4", "nummat4", "nv2d", "neiph", "neips",
    "nmsph", "ngpsph", "narbs", "nelt", "nummatt", "nv3dt", "ialemat", "nmmat", "npefg", "nel48", "extra",
)  # fmt: skip


@dataclass(frozen=True)
class StateAt:
    """Where one state begins."""

    file: Path
    offset: int


def word_size(file: Path) -> int | None:
    """4 or 8 where the file begins like a d3plot in single or double precision, else None."""
    with file.open("rb") as stream:
        head = stream.read(_HEADER_WORDS * 8)
    for size, kind in ((4, "<i4"), (8, "<i8")):
        if len(head) < _HEADER_WORDS * size:
            continue
        words = np.frombuffer(head[: _HEADER_WORDS * size], kind)
        kinds, dimensions, nodes, code = (int(words[k]) for k in (11, 15, 16, 17))
        if kinds % 1000 in (_D3PLOT, _D3PART) and 2 <= dimensions <= 9 and nodes > 0 and code in (2, 6):
            return size
    return None


def is_femzip(file: Path) -> bool:
    """Whether a file begins like a d3plot that FEMZIP has packed: its number of materials is a mark."""
    with file.open("rb") as stream:
        head = stream.read(_HEADER_WORDS * 8)
    kinds = ((4, "<i4"), (8, "<i8"))
    return any(
        len(head) >= _HEADER_WORDS * size and np.frombuffer(head[: _HEADER_WORDS * size], kind)[_NMMAT] == _FEMZIP
        for size, kind in kinds
    )


class D3plotFile:
    """One family: header, geometry arrays and the places of all states.

    `header` is lasso-python's, `arrays` its geometry arrays by its names, `states` the places of the whole states,
    `problems` why there may be fewer of them than were computed.
    """

    def __init__(self, first: Path, rest: tuple[Path, ...]) -> None:
        self.first = first
        size = first.stat().st_size
        word = word_size(first)
        if word is None:
            raise ReadError(f"{first}: does not begin like a d3plot ({size} bytes); it is something else or damaged")
        self._word = word
        need = self._check_header(size)
        with first.open("rb") as stream:
            geometry = stream.read(2 * need + _SLACK)
        with guarded(first):
            self._lasso = geometry_class()(geometry)
        self.header = self._lasso.header
        self.arrays: dict[str, Any] = dict(self._lasso.arrays)
        self._lasso.arrays = {}
        self.state_bytes = int(self._lasso._compute_n_bytes_per_state())
        end = int(self._lasso.geometry_section_size)
        if end > size or self.state_bytes < word:
            raise ReadError(
                f"{first}: its mesh should end at byte {end} of {size} and its states take {self.state_bytes} bytes; "
                "the file is damaged, copy it again"
            )
        self.blocks = self._place_blocks()
        self.shells_withheld = self._unknown_of_shells()
        self.states: list[StateAt] = []
        self.problems: list[str] = []
        self._find_states(first, end, geometry=True)
        for file in rest:
            self._find_states(file, 0, geometry=False)

    def _check_header(self, size: int) -> int:
        """Bytes that the header's counts ask for.

        Raises
        ------
        ReadError
            Where they cannot be true.
        """
        with guarded(self.first):
            header = header_class()(str(self.first))
        words = header.raw_header
        for name in _COUNTS:
            if words.get(name, 0) < 0:
                raise ReadError(
                    f"{self.first}: word {name.upper()} of the header is {words[name]}; the file is damaged"
                )
        if header.has_femzip_indicator:
            raise ReadError(f"{self.first}: is packed with FEMZIP, which needs a licence to read; unpack it first")
        if words["ndim"] == 2:
            raise ReadError(f"{self.first}: holds a 2-D model; only 3-D models are read")
        if words["nel8"] < 0:
            raise ReadError(f"{self.first}: holds ten-node solids (NEL8 = {words['nel8']}), which are not read")
        need = self._word * (
            _HEADER_WORDS
            + words["extra"]
            + 3 * words["numnp"]
            + 9 * (words["nel8"] + words["nelt"])
            + 6 * words["nel2"]
            + 5 * (words["nel4"] + words["nel48"])
            + words["narbs"]
            + 2 * words["nmsph"]
            + words["ialemat"]
        )
        if need > size:
            raise ReadError(
                f"{self.first}: its header asks for {need} bytes of mesh ({words['numnp']} nodes, "
                f"{words['nel4']} shells, {words['nel8']} solids), the file has {size}; "
                "it is cut short or damaged, copy it again"
            )
        return int(need)

    def _place_blocks(self) -> dict[str, tuple[int, int]]:
        """Name -> (first word, words) of the blocks of one state, in the order of LS-DYNA's database manual."""
        h = self.header
        rigid = self._lasso._material_section_info.n_rigid_shells
        shells = h.n_shells - rigid if h.filetype.value == _D3PLOT else h.n_shells
        nodal = {
            "displacement": 3 * h.has_node_displacement,
            "temperature": (3 if h.has_node_temperature_layers else 1) * h.has_node_temperatures,
            "heat_flux": 3 * h.has_node_heat_flux,
            "mass_scaling": h.has_node_mass_scaling,
            "temperature_gradient": h.has_node_temperature_gradient,
            "residual": 3 * h.has_node_residual_forces + 3 * h.has_node_residual_moments,
            "velocity": 3 * h.has_node_velocity,
            "acceleration": 3 * h.has_node_acceleration,
        }
        lengths = {
            "time": 1,
            "global": h.n_global_vars,
            **{name: width * h.n_nodes for name, width in nodal.items()},
            "thermal": h.n_solids * h.n_solid_thermal_vars,
            "solid": h.n_solids * h.n_solid_vars,
            "tshell": h.n_thick_shells * h.n_thick_shell_vars,
            "beam": h.n_beams * h.n_beam_vars,
            "shell": shells * h.n_shell_vars,
        }
        self._n_shells = shells
        if h.has_node_deletion_data:
            lengths["node_alive"] = h.n_nodes
        elif h.has_element_deletion_data:
            counts = (h.n_solids, h.n_thick_shells, h.n_shells, h.n_beams)
            for kind, count in zip(("solid", "tshell", "shell", "beam"), counts, strict=True):
                lengths[f"{kind}_alive"] = count
        lengths["sph"] = h.n_sph_nodes * int(self._lasso._sph_info.n_sph_vars)
        blocks, start = {}, 0
        for name, length in lengths.items():
            blocks[name] = (start, int(length))
            start += int(length)
        if start * self._word > self.state_bytes:
            raise ReadError(
                f"{self.first}: the variables its header names take {start * self._word} bytes a state, "
                f"the states {self.state_bytes}; the file is damaged"
            )
        return blocks

    def _find_states(self, file: Path, start: int, *, geometry: bool) -> None:
        """Add the whole states of `file`, and a problem where something else than an end mark follows them."""
        size = file.stat().st_size
        content = _content_end(file, start)
        count, rest = divmod(max(0, content - start), self.state_bytes)
        self.states += [StateAt(file, start + k * self.state_bytes) for k in range(count)]
        if geometry and count == 0 and rest == 0:
            return  # the geometry's own end mark stands before `start`
        place = start + count * self.state_bytes
        if rest != self._word or self._word_at(file, place) != _END:
            whole = f"behind {count} whole state{'s' if count != 1 else ''} of {self.state_bytes} bytes"
            self.problems.append(
                f"{file}: {whole}, at byte {place} of {size}, stands no end mark but {rest} bytes more; "
                "it is cut short or damaged, or the solver was stopped while writing"
            )

    def _word_at(self, file: Path, offset: int) -> float:
        with file.open("rb") as stream:
            stream.seek(offset)
            found = stream.read(self._word)
        return float(np.frombuffer(found, self.header.ftype)[0]) if len(found) == self._word else 0.0

    def block(self, name: str, state: int) -> NDArray[Any]:
        """The words of block `name` of one state, (n,) float."""
        at = self.states[state]
        first, length = self.blocks[name]
        with at.file.open("rb") as stream:
            stream.seek(at.offset + first * self._word)
            found = stream.read(length * self._word)
        if len(found) != length * self._word:
            raise ReadError(
                f"{at.file}: ends at byte {at.offset + first * self._word + len(found)}, within state {state}"
            )
        return np.frombuffer(found, self.header.ftype)

    def elements(self, kind: str, state: int) -> dict[str, NDArray[Any]]:
        """Element results of one state by lasso-python's names, (1, element, ...); `kind` as the block is called."""
        if kind == "shell" and self.shells_withheld:
            return self._shells(state)
        read = {"solid": "solids", "tshell": "tshell", "beam": "beams", "shell": "shell", "sph": "sph"}[kind]
        found: dict[str, NDArray[Any]] = {}
        with guarded(self.states[state].file):
            getattr(self._lasso, f"_read_states_{read}")(self.block(kind, state)[None], 0, found)
        return found

    def particle_alive(self, state: int) -> NDArray[np.bool_]:
        """(particle,): the first word of a particle is its material, with a minus once it is deleted."""
        return np.asarray(self.block("sph", state).reshape(self.header.n_sph_nodes, -1)[:, 0] > 0)

    @property
    def particle_fields(self) -> dict[str, bool]:
        """Which results of particles a state holds, by lasso-python's names."""
        info = self._lasso._sph_info
        return {
            "sph_radius": info.has_influence_radius,
            "sph_pressure": info.has_particle_pressure,
            "sph_stress": info.has_stresses,
            "sph_effective_plastic_strain": info.has_plastic_strain,
            "sph_density": info.has_material_density,
            "sph_internal_energy": info.has_internal_energy,
            "sph_n_neighbors": info.has_n_affecting_neighbors,
            "sph_strain": info.has_strain,
            "sph_strainrate": info.has_strainrate,
            "sph_mass": info.has_mass,
        }

    def _unknown_of_shells(self) -> dict[str, str]:
        """Fields of shells whose place in a state is not known -> why; empty where every word is accounted for.

        A shell's words begin with its layers, forces and thickness. Behind them stand the strain and, where
        *DATABASE_EXTENT_BINARY asks for them (STRFLG), plastic and thermal strain tensors, whose number of layers the
        file does not tell.
        """
        h = self.header
        front = self._layer_words * h.n_shell_tshell_layers + 8 * h.has_shell_forces + 4 * h.has_shell_extra_variables
        known = front + 12 * h.has_element_strain
        tensors = h.has_solid_shell_plastic_strain_tensor or h.has_solid_shell_thermal_strain_tensor
        if not h.n_shell_vars or (h.n_shell_vars == known and not tensors):
            return {}
        if tensors and h.n_shell_vars > front and (h.n_shell_vars - front) % 6 == 0:
            kind = "plastic" if h.has_solid_shell_plastic_strain_tensor else "thermal"
            return {
                "strain": f"shells hold {kind} strain tensors (IDTDT = {h.raw_header['idtdt']}, asked for by STRFLG of "
                "*DATABASE_EXTENT_BINARY), which cannot be distinguished from other values; compute the run without them"
            }
        why = (
            f"shells hold {h.n_shell_vars} words each, the header's output options (*DATABASE_EXTENT_BINARY) account for "
            f"{known}"
        )
        return dict.fromkeys(("stress", "von_mises", "plastic_strain", "strain", "thickness"), why)

    @property
    def _layer_words(self) -> int:
        h = self.header
        return int(6 * h.has_shell_tshell_stress + h.has_shell_tshell_pstrain + h.n_shell_tshell_history_vars)

    def _shells(self, state: int) -> dict[str, NDArray[Any]]:
        """Results of shells up to what is not known, as `elements` gives them."""
        h = self.header
        words = self.block("shell", state).reshape(1, self._n_shells, h.n_shell_vars)
        layers = h.n_shell_tshell_layers
        behind = layers * self._layer_words
        layered = words[:, :, :behind].reshape(1, self._n_shells, layers, self._layer_words)
        stress = 6 * h.has_shell_tshell_stress
        found = {}
        if h.has_shell_tshell_stress:
            found["element_shell_stress"] = layered[..., :6]
        if h.has_shell_tshell_pstrain:
            found["element_shell_effective_plastic_strain"] = layered[..., stress]
        if h.has_shell_extra_variables:
            found["element_shell_thickness"] = words[:, :, behind + 8 * h.has_shell_forces]
        return found


def _content_end(file: Path, start: int) -> int:
    """Byte behind the last one that is not zero, but not before `start`; the padding is short, so from the rear."""
    with file.open("rb") as stream:
        end = stream.seek(0, 2)
        while end > start:
            begin = max(start, end - (1 << 16))
            stream.seek(begin)
            filled = np.flatnonzero(np.frombuffer(stream.read(end - begin), np.uint8))
            if len(filled):
                return begin + int(filled[-1]) + 1
            end = begin
    return start
