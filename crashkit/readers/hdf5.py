"""The HDF5 layout of the public kart data set: all runs of a campaign in one file.

    kart/displacements            (run, state, node, 3)
    kart/reference_configuration  (run, node, 3), or (node, 3) where all runs start alike
    kart/faces                    (triangle, 3), 0-based; or a mesh file beside it (option `mesh`)
    kart/<field>                  (run, state, node | face [, 3]), such as plastic_strain
    kart/alive                    (run, state, face), 0 once an element has eroded
    kart/part, part_id, part_name (face,) place among the parts, (part,) their numbers and (part,) titles
    kart/node_id, element_id      (node,), (face,) the solver's numbers
    history/<curve>               (run, sample); history/time (sample,) or (run, sample), s where the file is in SI
    run                           (run,) the campaign's own numbers, which name the runs
    parameter                     (run, parameter), with attributes `names` and `units`
    time                          (state,), or (run, state); where it is missing, the option `time_step` gives it

Any group name will do. Lengths in metre are known by the attribute `units` of the displacements; then the unit
system is SI, else the user must say. In a file in SI a curve may have a unit of its own in its attribute `units` (kN).

The public file has no names of parameters. Where the group is called `kart` and `parameter` has three columns
without names, they are taken to be that campaign's: impact_speed in m/s, impact_angle in degree, yield_stress in MPa.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import register
from crashkit.readers._hdf5_data import SIGNATURE, files_behind
from crashkit.readers._names import quantity
from crashkit.readers.base import FieldInfo, Parameter, Part, Run, RunMesh, Runs
from crashkit.readers.checks import (
    LIBRARY_ERRORS,
    closed_if_refused,
    reading,
    require_finite,
    require_indices,
    require_options,
    time_problems,
    time_step_option,
)
from crashkit.readers.history import Channel, History, quantity_of
from crashkit.readers.parameter_names import parameter_columns
from data_schema import UnknownUnits, si_unit, to_si
from data_schema.units import quantity_in

if TYPE_CHECKING:
    import h5py

_NEEDED = ("displacements", "reference_configuration")
_KART_PARAMETERS = (("impact_speed", "m s-1"), ("impact_angle", "degree"), ("yield_stress", "MPa"))
_METRE = ("m", "metre", "meter")
# One chunk may hold all states of a run; the cache keeps it while its states are read slice by slice.
_CHUNK_CACHE = 96 << 20


class KartHdf5:
    """Reader of the layout above; the option `mesh` names a file with the faces where the data has none."""

    name = "kart-hdf5"
    description = "HDF5 in the layout of the public kart data set (displacements, reference_configuration, parameter)"

    def sniff(self, path: Path) -> bool:
        import h5py

        try:
            if not path.is_file():
                return False
            with path.open("rb") as stream:
                if stream.read(8) != SIGNATURE:
                    return False
            with h5py.File(path, "r") as file:
                return _group(file) is not None
        except LIBRARY_ERRORS:
            return False

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options, ("mesh", "time_step"))
        mesh, step = options.get("mesh"), time_step_option(options)
        with reading(path):
            campaign = _Campaign(path, None if mesh is None else Path(str(mesh)), step)
        return Runs({campaign.name(k): partial(_KartRun, campaign, k) for k in range(campaign.runs)})


def _open(path: Path) -> h5py.File:
    import h5py

    try:
        return h5py.File(path, "r", rdcc_nbytes=_CHUNK_CACHE)
    except FileNotFoundError:
        raise ReadError(f"{path}: no such file") from None
    except OSError as error:
        raise ReadError(f"{path}: not readable as HDF5 ({error}); copy the file again") from error


def _group(file: h5py.File) -> str | None:
    """Name of the top group with the displacements ("/" where they stand at the top)."""
    import h5py

    for name in (*file, "/"):
        found = file.get(name)
        if isinstance(found, h5py.Group) and all(isinstance(found.get(n), h5py.Dataset) for n in _NEEDED):
            return str(name)
    return None


class _Campaign:
    """The file, opened once for all its runs, with everything they share."""

    def __init__(self, path: Path, mesh: Path | None, step: float | None) -> None:
        self.path = path
        self.file = _open(path)
        with closed_if_refused(self.file):
            self._behind: dict[str, set[Path]] = {}
            self.notes: tuple[str, ...] = ()
            group = _group(self.file)
            if group is None:
                raise ReadError(
                    f"{path}: no group with datasets {' and '.join(_NEEDED)}; found {', '.join(self.file) or 'nothing'}"
                )
            self.group = group
            self.displacements = self._dataset("displacements", 4)
            self.runs, self.states, self.nodes, xyz = self.displacements.shape
            if xyz != 3 or 0 in self.displacements.shape:
                raise self._wrong("displacements", "(run, state, node, 3), none of them 0")
            self.reference = self._dataset("reference_configuration", 2, 3)
            if self.reference.shape[-2:] != (self.nodes, 3) or self.reference.shape[:-2] not in ((), (self.runs,)):
                raise self._wrong("reference_configuration", f"({self.runs}, {self.nodes}, 3)")
            self.faces = self._faces(mesh)
            self.time = self._time(step)
            self.parameters = self._parameters()
            self.numbers = self._numbers()
            self.alive = self._if_there("alive", (self.runs, self.states, len(self.faces)))
            self.parts, self.face_part = self._parts()
            self.node_id = self._identities("node_id", self.nodes)
            self.face_id = self._identities("element_id", len(self.faces))
            self.fields = self._fields()
            self.curves = self._curves()
            self.left_out = self._left_out()
            used = () if mesh is None or "faces" in self.file[self.group] else (mesh,)
            self.files = (path, *used, *sorted(set().union(*self._behind.values())))
            unit = _text(self.displacements.attrs.get("units", ""))
            self.units = "SI" if unit in _METRE else None

    def name(self, index: int) -> str:
        number = int(self.numbers[index])
        return f"run_{number:0{max(3, len(str(int(self.numbers.max()))))}d}"

    def _if_there(self, name: str, shape: tuple[int, ...]) -> h5py.Dataset | None:
        """The dataset `name`, whose shape must be `shape`; None where there is none."""
        import h5py

        if not isinstance(self.file[self.group].get(name, self.file.get(name)), h5py.Dataset):
            return None
        found = self._dataset(name)
        if found.shape != shape:
            raise self._wrong(name, str(shape))
        return found

    def _numbers(self) -> NDArray[np.int64]:
        """The campaign's own numbers of its runs; 0, 1, 2, ... where it has none."""
        found = self._if_there("run", (self.runs,))
        if found is None:
            return np.arange(self.runs)
        numbers = self.read(found, ...).astype(np.int64)
        if len(np.unique(numbers)) != self.runs or numbers.min() < 0:
            raise ReadError(
                f"{self.path}: {found.name} holds numbers twice or below 0; expected a number of its own per run"
            )
        return np.asarray(numbers)

    def _identities(self, name: str, count: int) -> NDArray[np.int64]:
        found = self._if_there(name, (count,))
        return np.arange(1, count + 1) if found is None else self.read(found, ...).astype(np.int64)

    def _parts(self) -> tuple[tuple[Part, ...], NDArray[np.int32]]:
        """The parts, and the part (face,) of each face."""
        whole = (Part(1, self.group.strip("/") or "structure"),)
        found = self._if_there("part", (len(self.faces),))
        if found is None:
            return whole, np.zeros(len(self.faces), np.int32)
        places = self.read(found, ...).astype(np.int64)
        home = self.file[self.group]
        known = np.asarray(home["part_id"][...]) if "part_id" in home else np.unique(places)
        # Either places among the parts from 0, or the parts' own numbers.
        if not (np.isin(places, known).all() and places.min() >= known.min()):
            require_indices(places, len(known), "part", f"{self.path}: {found.name}")
        else:
            order = np.argsort(known)
            places = order[np.searchsorted(known[order], places)]
        names = [_text(n) for n in home["part_name"][...]] if "part_name" in home else [""] * len(known)
        if len(names) != len(known):
            raise ReadError(f"{self.path}: {len(names)} part_name and {len(known)} part_id; expected as many of each")
        return tuple(Part(int(k), n or f"part {k}") for k, n in zip(known, names, strict=True)), places.astype(np.int32)

    def _curves(self) -> dict[str, h5py.Dataset]:
        """Time histories (run, sample) by name, with "time"; empty where there are none."""
        import h5py

        home = self.file.get("history", self.file[self.group].get("history"))
        if not isinstance(home, h5py.Group) or not isinstance(home.get("time"), h5py.Dataset):
            return {}
        shape = home["time"].shape
        if shape not in ((shape[-1],), (self.runs, shape[-1])):
            raise ReadError(
                f"{self.path}: {home.name}/time has shape {shape}, expected (sample,) or ({self.runs}, sample)"
            )
        wanted = (self.runs, shape[-1])
        return {n: d for n, d in home.items() if n == "time" or (isinstance(d, h5py.Dataset) and d.shape == wanted)}

    def _left_out(self) -> tuple[str, ...]:
        """Names of datasets that are not read."""
        import h5py

        used = {
            "displacements", "reference_configuration", "faces", "parameter", "time", "run", "alive", "part", "part_id",
            "part_name", "node_id", "element_id", *self.fields,
        }  # fmt: skip
        curves = {d.name for d in self.curves.values()}
        out: list[str] = []

        def look(name: str, found: object) -> None:
            if isinstance(found, h5py.Dataset) and name.split("/")[-1] not in used and found.name not in curves:
                out.append(name)

        self.file.visititems(look)
        return tuple(sorted(out))

    def _dataset(self, name: str, *dimensions: int) -> h5py.Dataset:
        import h5py

        found = self.file[self.group].get(name)
        if not isinstance(found, h5py.Dataset):
            found = self.file.get(name)
        if not isinstance(found, h5py.Dataset):
            raise ReadError(f"{self.path}: no dataset {name}; found {', '.join(self.file[self.group])}")
        if found.dtype.kind not in "fiu" or (dimensions and found.ndim not in dimensions):
            raise ReadError(
                f"{self.path}: {found.name} has shape {found.shape} and type {found.dtype}; "
                f"expected numbers with {' or '.join(map(str, dimensions))} dimensions"
            )
        if found.name not in self._behind:
            self._behind[found.name] = files_behind(found, self.path)
        return found

    def _wrong(self, name: str, expected: str) -> ReadError:
        found = self._dataset(name)
        return ReadError(f"{self.path}: {found.name} has shape {found.shape}, expected {expected}")

    def read(self, dataset: h5py.Dataset, *index: Any) -> NDArray[Any]:
        """`dataset[index]`, with damage on the disk as an error that names file and place."""
        with reading(f"{self.path}, {dataset.name}{list(index)}"):
            return np.asarray(dataset[index])

    def _time(self, step: float | None) -> NDArray[np.float64]:
        there = "time" in self.file or "time" in self.file[self.group]
        if not there and step is not None:
            return np.broadcast_to(np.arange(self.states) * step, (self.runs, self.states))
        if not there:
            raise ReadError(f"{self.path}: no dataset time; give the time between two states (--time-step)")
        if step is not None:
            self.notes = (f"{self.path}: holds times of its own, so --time-step is not used",)
        time = self._dataset("time", 1, 2)
        if time.shape not in ((self.states,), (self.runs, self.states)):
            raise self._wrong("time", f"({self.states},) or ({self.runs}, {self.states})")
        return np.broadcast_to(self.read(time, ...).astype(np.float64), (self.runs, self.states))

    def _faces(self, mesh: Path | None) -> NDArray[np.int32]:
        found = self.file[self.group].get("faces")
        if found is not None:
            faces = self._dataset("faces", 2)
            if faces.shape[1] not in (3, 4) or faces.dtype.kind not in "iu":
                raise self._wrong("faces", "whole numbers, (face, 3) or (face, 4)")
            nodes = self.read(faces, ...).astype(np.int64)
            require_indices(nodes, self.nodes, "face", f"{self.path}: {faces.name}", lowest=-1)
            return nodes.astype(np.int32)
        if mesh is None:
            raise ReadError(
                f"{self.path}: no dataset {self.group}/faces, so the mesh is not known; "
                "name a mesh file with the same nodes (--mesh FILE)"
            )
        from crashkit.readers._mesh_file import faces_of

        return faces_of(mesh, self.read(self.reference, *((0,) if self.reference.ndim == 3 else (...,))))

    def _parameters(self) -> list[dict[str, Parameter]]:
        if "parameter" not in self.file and "parameter" not in self.file[self.group]:
            return [{} for _ in range(self.runs)]
        table = self._dataset("parameter", 2)
        if table.shape[0] != self.runs:
            raise self._wrong("parameter", f"({self.runs}, any)")
        names = [_text(n) for n in np.atleast_1d(table.attrs.get("names", []))]
        units = [_text(u) for u in np.atleast_1d(table.attrs.get("units", [""] * len(names)))]
        if not names and self.group == "kart" and table.shape[1] == len(_KART_PARAMETERS):
            names, units = (list(column) for column in zip(*_KART_PARAMETERS, strict=True))
        if not names:  # numbers without a name are of no use to anybody
            return [{} for _ in range(self.runs)]
        if not len(names) == len(units) == table.shape[1]:
            raise ReadError(
                f"{self.path}: {table.name} has {table.shape[1]} columns, {len(names)} names and {len(units)} units; "
                "expected as many of each"
            )
        rows = self.read(table, ...).astype(np.float64)
        columns = parameter_columns(names, units, f"{self.path}: {table.name}")
        return [{n: Parameter(float(v), u) for (n, u), v in zip(columns, row, strict=True)} for row in rows]

    def _fields(self) -> dict[str, FieldInfo]:
        import h5py

        fields = {}
        for name, found in self.file[self.group].items():
            if (
                not isinstance(found, h5py.Dataset)
                or found.dtype.kind not in "fiu"
                or name in ("displacements", "alive")
            ):
                continue
            if found.shape[:2] != (self.runs, self.states) or found.ndim not in (3, 4):
                continue
            places = {self.nodes: "node", len(self.faces): "face"}
            place = _text(found.attrs.get("location", "")) or places.get(found.shape[2])
            if place in ("node", "face"):
                self._dataset(name)  # its values are there, and known by their files
                components = found.shape[3] if found.ndim == 4 else 1
                fields[name] = FieldInfo(name, place, components, quantity(name))  # type: ignore[arg-type]
        return fields


class _KartRun(Run):
    """One row of the file."""

    def __init__(self, campaign: _Campaign, index: int) -> None:
        self._campaign, self._index = campaign, index
        self.name = campaign.name(index)
        self.solver = _text(campaign.file.attrs.get("source", "")) or "unknown"
        self.files = campaign.files
        self.notes = campaign.notes
        self.time = np.array(campaign.time[index])
        self.parameters: Mapping[str, Parameter] = campaign.parameters[index]
        self.fields: Mapping[str, FieldInfo] = campaign.fields
        self.units = campaign.units
        self.left_out = campaign.left_out
        reference = campaign.reference
        position = campaign.read(reference, *((index,) if reference.ndim == 3 else (...,))).astype(np.float64)
        require_finite(position, "the reference position", f"{campaign.path}: {reference.name}, {self.name}")
        faces = campaign.faces
        self.mesh = RunMesh(
            position=position,
            node_id=campaign.node_id,
            face_nodes=faces,
            face_part=campaign.face_part,
            face_id=campaign.face_id,
            parts=campaign.parts,
        )
        self.problems = tuple(
            time_problems(self.time, [f"{campaign.path}: time, {self.name}, state {k}" for k in range(len(self.time))])
        )

    def _place(self, name: str) -> str:
        return f"{self._campaign.path}: {self._campaign.group}/{name}, {self.name}"

    def displacement(self, first: int, last: int) -> NDArray[np.float32]:
        dataset = self._campaign.displacements
        values = self._campaign.read(dataset, self._index, slice(first, last)).astype(np.float32, copy=False)
        for k, state in enumerate(values, first):
            require_finite(state, "the displacement", f"{self._place('displacements')}, state {k}")
        return values

    def alive(self, first: int, last: int) -> NDArray[np.bool_] | None:
        found = self._campaign.alive
        return None if found is None else self._campaign.read(found, self._index, slice(first, last)) != 0

    def history(self) -> History | None:
        curves = self._campaign.curves
        if len(curves) < 2:
            return None
        names = [n for n in curves if n != "time"]
        time = curves["time"]
        times = self._campaign.read(time, *((self._index,) if time.ndim == 2 else (...,))).astype(np.float64)
        values = [self._campaign.read(curves[n], self._index).astype(np.float64) for n in names]
        told = [self._unit_of(curves[n], n) for n in names]
        channels = tuple(Channel(n, quantity) for n, (quantity, _) in zip(names, told, strict=True))
        return History(times, channels, np.stack(values, axis=1) * [factor for _, factor in told])

    def _unit_of(self, curve: h5py.Dataset, name: str) -> tuple[str, float]:
        """What a curve measures, and its value in SI where the file is in SI and the curve says its unit: (force, 1000)."""
        unit = _text(curve.attrs.get("units", ""))
        if not unit or self.units != "SI":
            return quantity_of(name), 1.0
        try:
            factor, si = to_si(unit)
        except UnknownUnits as error:
            raise ReadError(f"{self._campaign.path}: {curve.name}: {error}") from error
        known = quantity_of(name)
        return (known if known != "unknown" and si_unit(known) == si else quantity_in(si)), factor

    def field(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        if name not in self.fields:
            raise KeyError(name)
        dataset = self._campaign.file[self._campaign.group][name]
        return self._campaign.read(dataset, self._index, slice(first, last)).astype(np.float32, copy=False)


def _text(value: object) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


register(KartHdf5())
