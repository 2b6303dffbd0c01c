"""The hierarchy in the dataset: groups /hierarchy/level_1 .. of a .zarr folder or a .nc file.

Group /hierarchy holds how the levels were made and which mesh and runs they belong to; each level holds its kept
nodes, faces, edges, adjacency and probe maps (CSR parts), distances and lifting errors; level 1 also holds the
displacements of its nodes, of which those of coarser levels are a subset. A new hierarchy is written beside the
dataset and moved into place when it is complete, so that a killed run leaves the dataset as it was.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crashkit.chunks import KEYS, codecs
from crashkit.dataset import open_dataset, opened_dataset, reading_dataset
from crashkit.errors import DataError, OutputError, ReadError
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.lifting import LiftingError, LiftingMeter
from crashkit.netcdf import handle, open_netcdf, writing
from data_schema.blocks import split_states
from data_schema.levels import Level
from data_schema.progress import Progress
from data_schema.replace import beside, put_in_place, room_beside

if TYPE_CHECKING:
    import xarray as xr
    from scipy import sparse

# Bytes of displacement held at once while streaming: mostly a whole run, since its chunks hold all states.
_BUDGET = 512 << 20


def write_hierarchy(
    path: str | Path, hierarchy: Hierarchy, *, test: Collection[int] = (), report: Progress | None = None
) -> list[LiftingError]:
    """Write `hierarchy` into the dataset at `path` and return the lifting error of each level.

    The displacements are read once, a block of states at a time; `report` hears of each run. The runs at the places
    `test` do not count in the lifting errors. An older hierarchy is replaced when the new one is complete.

    Raises
    ------
    DataError
        If the hierarchy is not one of this dataset's mesh.
    OutputError
        If `path` cannot be written.
    """
    path = Path(path)
    with open_dataset(path, chunks=None) as dataset:
        if dataset.sizes["node"] != hierarchy.n_nodes:
            raise DataError(
                f"{path}: has {dataset.sizes['node']} nodes, but the hierarchy was made for a mesh of "
                f"{hierarchy.n_nodes}; build it from this dataset"
            )
        about = {
            "settings": json.dumps(hierarchy.settings, default=_plain),
            "mesh_checksum": mesh_checksum(dataset),
            "dataset_checksum": str(dataset.attrs.get("checksum", "")),
            "runs": json.dumps([str(s) for s in dataset["sim"].values]),
            "lifting_error_without": json.dumps([str(dataset["sim"].values[k]) for k in sorted(test)]),
            "levels": len(hierarchy.levels),
        }
        try:
            with _target(path) as target:
                target.group("hierarchy", about)
                errors = _stream(path, dataset, hierarchy, target, test, report)
                if report is not None:
                    report("writing the levels", 0, 0, "")
                for level, error in zip(hierarchy.levels, errors, strict=True):
                    _write_level(target, level, error)
        except OSError as error:
            raise OutputError(
                f"{path}: the hierarchy cannot be written ({error.strerror or error}); check permissions and free space"
            ) from error
    return errors


def open_hierarchy(path: str | Path) -> Hierarchy:
    """The mesh hierarchy stored in the dataset at `path`, read whole.

    Parameters
    ----------
    path
        A crash dataset, `.zarr` or `.nc`, with a hierarchy made by `coarsen`.

    Returns
    -------
    Hierarchy
        Its levels (`hierarchy[1]` is the finest coarse one), with nodes, faces, edges and the maps between them.

    Raises
    ------
    DataError
        If there is none or it belongs to another mesh.
    ReadError
        If it is damaged.
    """
    path = Path(path)
    about = _about(path)
    levels = []
    n_finer = n_full = about["nodes"]
    for index in range(1, int(about["levels"]) + 1):
        with _open_level(path, index) as group:
            try:
                level = Level(
                    index=index,
                    kept=group["kept"].values.astype(np.int64),
                    faces=group["faces"].values.astype(np.int32),
                    edges=group["edges"].values.astype(np.int32),
                    in_finer=group["in_finer"].values.astype(np.int64),
                    to_finer=_csr(group, "to_finer", n_finer, group.sizes["level_node"]),
                    to_full=_csr(group, "to_full", n_full, group.sizes["level_node"]),
                    distance=group["distance"].values.astype(np.float64) if "distance" in group else None,
                    face_part=group["face_part"].values.astype(np.int32) if "face_part" in group else None,
                )
            except (KeyError, ValueError) as error:
                raise ReadError(
                    f"{path}: /hierarchy/level_{index} is damaged ({error}); run crashkit coarsen again"
                ) from error
        levels.append(level)
        n_finer = level.n_nodes
    return Hierarchy(n_full, tuple(levels), json.loads(about["settings"]))


def runs_of_hierarchy(path: str | Path) -> int:
    """For how many runs the hierarchy at `path` holds displacements."""
    return len(json.loads(_about(Path(path))["runs"]))


def level_displacement(path: str | Path, level: int, runs: Sequence[int] | None = None) -> NDArray[np.float32]:
    """Displacements (sim, time, node of `level`, 3), m, of the runs numbered `runs` (all without), level >= 1.

    Only the displacements of level 1 are on disk; coarser levels are a subset of them. The fine field is not read.
    """
    path = Path(path)
    about = _about(path)
    if not 1 <= level <= int(about["levels"]):
        raise DataError(f"{path}: level {level} was asked for; the hierarchy has levels 1 to {about['levels']}")
    chosen = None
    for index in range(2, level + 1):
        with _open_level(path, index) as group:
            places = group["in_finer"].values
        chosen = places if chosen is None else chosen[places]
    with _open_level(path, 1) as group:
        stored = group["displacement"]
        which = range(stored.sizes["sim"]) if runs is None else runs
        nodes = stored.sizes["level_node"] if chosen is None else len(chosen)
        out = np.empty((len(which), stored.sizes["time"], nodes, 3), np.float32)
        for k, run in enumerate(which):
            block = stored.isel(sim=int(run)).values
            out[k] = block if chosen is None else block[:, chosen]
    return out


def lifting_errors_over(path: str | Path) -> str:
    """Over which runs lifting errors were measured: "all 36 runs" or "27 training runs"."""
    about = _about(Path(path))
    runs, without = (len(json.loads(about.get(name) or "[]")) for name in ("runs", "lifting_error_without"))
    count = runs - without
    return f"{count} training run{'s' if count > 1 else ''}" if without else f"all {runs} runs"


def part_nodes(dataset: xr.Dataset) -> list[NDArray[np.int64]]:
    """The nodes on the faces of each part, in the order of the dataset's parts; a shared node is in both."""
    faces, part = dataset["face_nodes"].values, dataset["face_part"].values
    found = (np.unique(faces[part == k]) for k in range(dataset.sizes["part"]))
    return [nodes[nodes >= 0].astype(np.int64) for nodes in found]


def summarize_hierarchy(path: str | Path) -> list[dict[str, Any]]:
    """For each level: level, nodes, faces, edges, mean and largest distance (m), mean and largest lifting error (m).

    `lifting_error_of_parts` is the mean by the name of the part, m; NaN for a part without faces, empty where the
    hierarchy was made by a crashkit that did not tell parts apart.
    """
    path = Path(path)
    with opened_dataset(path, indexes=False) as dataset:
        titles = [str(name) for name in dataset["part_name"].values] if "part_name" in dataset else []
        numbers = dataset["part_id"].values.tolist() if "part_id" in dataset else []
    parts = [t if titles.count(t) == 1 else f"{t} ({n})" for t, n in zip(titles, numbers, strict=True)]
    rows: list[dict[str, Any]] = []
    for index in range(1, int(_about(path)["levels"]) + 1):
        with _open_level(path, index) as group:
            distance = group["distance"].values if "distance" in group else np.array([np.nan])
            rows.append(
                {
                    "level": index,
                    "nodes": int(group.sizes["level_node"]),
                    "faces": int(group.sizes.get("level_face", 0)),
                    "edges": int(group.sizes.get("level_edge", 0)),
                    "distance_mean": float(distance.mean()),
                    "distance_max": float(distance.max()),
                    "lifting_error_mean": float(group.attrs["lifting_error_mean"]),
                    "lifting_error_max": float(group.attrs["lifting_error_max"]),
                    "lifting_error_of_parts": _by_part(parts, group.attrs.get("lifting_error_of_parts", ())),
                }
            )
    return rows


def _by_part(names: Sequence[str], values: Any) -> dict[str, float]:
    """The errors with the parts' names; a single number comes back from a file without its list."""
    errors = np.atleast_1d(np.asarray(values, np.float64)).tolist()
    return dict(zip(names, errors, strict=True)) if len(errors) == len(names) else {}


def mesh_checksum(dataset: xr.Dataset) -> str:
    """SHA-256 of the reference positions and faces: what a hierarchy depends on."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(dataset["reference_position"].values, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(dataset["face_nodes"].values, dtype="<i8").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class MeshArrays:
    """The mesh of a dataset: what a hierarchy is built from, and the solver's numbers.

    position (n, 3) float64, m; face_nodes (m, 3 or 4), -1 in the last corner of a triangle; face_part (m,) index into
    part_id (parts,); node_id (n,)
    """

    position: NDArray[np.float64]
    face_nodes: NDArray[np.integer]
    face_part: NDArray[np.integer]
    node_id: NDArray[np.integer]
    part_id: NDArray[np.integer]


def open_mesh(path: Path) -> MeshArrays:
    """The mesh of the dataset at `path`; where the runs differ in shape, the one of the first run.

    Raises
    ------
    ReadError
        If the file is no crash dataset or lacks its faces.
    """
    with opened_dataset(path, indexes=False) as dataset:
        return mesh_of(dataset)


def mesh_of(dataset: xr.Dataset) -> MeshArrays:
    """The mesh of a dataset; where the runs differ in shape, the one of the first run."""
    at = dataset["reference_position"]
    at = at.isel(sim=0) if "sim" in at.dims else at
    others = (dataset[name].values for name in ("face_nodes", "face_part", "node_id", "part_id"))
    return MeshArrays(np.asarray(at.values, np.float64), *others)


def parts_without_faces(path: Path) -> list[str]:
    """What to know of parts that have no face in the dataset at `path` (beams, particles), in words; one a part.

    A hierarchy is made of faces. Nodes on none take the displacement of the nearest coarse node, which is one of another
    part where their own has no face.

    Raises
    ------
    ReadError
        If the file is no crash dataset or lacks its faces.
    """
    with opened_dataset(path, indexes=False) as dataset:
        if "cell_part" not in dataset:
            return []
        cells, owner = dataset["cell_nodes"].values, dataset["cell_part"].values
        faces, face_part = dataset["face_nodes"].values, dataset["face_part"].values
        numbers, names = dataset["part_id"].values, dataset["part_name"].values
    on_faces = np.zeros(int(max(cells.max(initial=-1), faces.max(initial=-1))) + 2, bool)  # the last one is node -1
    on_faces[faces] = True
    on_faces[-1] = True
    out = []
    for part in np.setdiff1d(owner, face_part):
        nodes = np.unique(cells[owner == part])
        loose = int((~on_faces[nodes]).sum())
        if loose:
            count = f"{loose} node{'s' if loose > 1 else ''}"
            out.append(
                f"part {numbers[part]} ({names[part]}) has no faces (beams, particles): its {count} on no face of another "
                "part move as the nearest node of another part does; leave it out with crashkit ingest "
                f"--exclude-parts {numbers[part]}, or do not rely on predictions there"
            )
    return out


@contextmanager
def _open_group(path: Path, name: str) -> Iterator[xr.Dataset]:
    """A group of the dataset at `path`; raises DataError if it is not there."""
    import xarray as xr

    try:
        if path.is_dir():
            group = xr.open_dataset(path, group=name, chunks=None, engine="zarr", consolidated=False)
        else:
            group = open_netcdf(path, name)
    except (OSError, KeyError, ValueError) as error:  # what a missing group raises depends on the library below
        raise DataError(f"{path}: has no group /{name}; run crashkit coarsen {path} again") from error
    with group, reading_dataset(path):
        yield group


@contextmanager
def _open_level(path: Path, index: int) -> Iterator[xr.Dataset]:
    with _open_group(path, f"hierarchy/level_{index}") as group:
        yield group


def _about(path: Path) -> dict[str, Any]:
    """Attributes of /hierarchy, checked against the dataset around it; `nodes` is added."""
    with opened_dataset(path, indexes=False) as dataset:
        try:
            with _open_group(path, "hierarchy") as group:
                about = dict(group.attrs)
        except DataError as error:
            raise DataError(f"{path}: has no mesh hierarchy; run crashkit coarsen {path} first") from error
        if about["mesh_checksum"] != mesh_checksum(dataset):
            raise DataError(f"{path}: its mesh hierarchy belongs to another mesh; run crashkit coarsen {path} again")
        runs = [str(s) for s in dataset["sim"].values]
        if json.loads(about["runs"]) != runs or about["dataset_checksum"] != str(dataset.attrs.get("checksum", "")):
            raise DataError(f"{path}: its mesh hierarchy was made with other runs; run crashkit coarsen {path} again")
        about["nodes"] = dataset.sizes["node"]
    return about


def _stream(
    path: Path,
    dataset: xr.Dataset,
    hierarchy: Hierarchy,
    target: _Target,
    test: Collection[int],
    report: Progress | None,
) -> list[LiftingError]:
    """One pass over the fine field: the displacements of level 1 go out, lifting errors add up."""
    meter = LiftingMeter(hierarchy, part_nodes(dataset))
    first = hierarchy.levels[0]
    runs, states = dataset.sizes["sim"], dataset.sizes["time"]
    write = target.stream(
        "hierarchy/level_1", "displacement", ("sim", "time", "level_node", "xyz"), (runs, states, first.n_nodes, 3),
        {"units": "m", "long_name": "displacement of the nodes of level 1"},
    )  # fmt: skip
    for run in range(runs):
        for begin, end in split_states(states, hierarchy.n_nodes, _BUDGET):
            with reading_dataset(path):
                block = dataset["displacement"].isel(sim=run, time=slice(begin, end)).values
            if run not in test:
                meter.add(block)
            write(run, begin, end, block[:, first.kept].astype(np.float32))
        if report:
            report("interpolation errors", run + 1, runs, "")
    return meter.errors


def _write_level(target: _Target, level: Level, error: LiftingError) -> None:
    group = f"hierarchy/level_{level.index}"
    target.group(
        group,
        {
            "level": level.index,
            "nodes": level.n_nodes,
            "lifting_error_mean": error.mean,
            "lifting_error_max": error.largest,
            "lifting_error_units": "m",
            "lifting_error_of_parts": list(error.parts),
        },
    )
    target.array(group, "kept", ("level_node",), level.kept, {"long_name": "node of level 0"})
    target.array(
        group, "faces", ("level_face", "level_corner"), level.faces, {"long_name": "triangles, nodes of this level"}
    )
    if level.face_part is not None:
        target.array(group, "face_part", ("level_face",), level.face_part, {"long_name": "part of each face"})
    target.array(
        group, "edges", ("level_edge", "level_end"), level.edges, {"long_name": "graph edges, nodes of this level"}
    )
    target.array(
        group, "in_finer", ("level_node",), level.in_finer, {"long_name": "place among the nodes of the finer level"}
    )
    if level.distance is not None:
        about = {"units": "m", "long_name": "distance to the coarse surface"}
        target.array(group, "distance", ("node",), level.distance, about)
    for name, matrix in (("adjacency", level.adjacency), ("to_finer", level.to_finer), ("to_full", level.to_full)):
        target.array(group, f"{name}_indptr", (f"{name}_row",), matrix.indptr.astype(np.int64), {})
        target.array(group, f"{name}_indices", (f"{name}_entry",), matrix.indices.astype(np.int32), {})
        if name != "adjacency":
            target.array(group, f"{name}_data", (f"{name}_entry",), matrix.data, {})


def _csr(group: xr.Dataset, name: str, rows: int, columns: int) -> sparse.csr_matrix:
    from scipy import sparse

    matrix = sparse.csr_matrix(
        (group[f"{name}_data"].values, group[f"{name}_indices"].values, group[f"{name}_indptr"].values),
        shape=(rows, columns),
    )
    matrix.check_format(full_check=True)
    return matrix


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


class _Target(Protocol):
    """Where groups are written: beside the dataset until everything is there."""

    def group(self, name: str, attributes: dict[str, Any]) -> None: ...

    def array(
        self, group: str, name: str, dims: tuple[str, ...], values: NDArray[Any], attributes: dict[str, Any]
    ) -> None: ...

    def stream(
        self, group: str, name: str, dims: tuple[str, ...], shape: tuple[int, ...], attributes: dict[str, Any]
    ) -> Callable[[int, int, int, NDArray[Any]], None]:
        """A function that writes (run, first state, last state + 1, block)."""
        ...


class _ZarrTarget:
    def __init__(self, folder: Path) -> None:
        import zarr

        self._root = zarr.open_group(str(folder), mode="w")

    def group(self, name: str, attributes: dict[str, Any]) -> None:
        self._root.require_group(name).attrs.update(attributes)

    def array(
        self, group: str, name: str, dims: tuple[str, ...], values: NDArray[Any], attributes: dict[str, Any]
    ) -> None:
        array = self._root.require_group(group).create_array(
            name, data=np.ascontiguousarray(values), dimension_names=dims, compressors=codecs(),
            config={"write_empty_chunks": True}, chunk_key_encoding=KEYS,
        )  # fmt: skip
        array.attrs.update(attributes)

    def stream(
        self, group: str, name: str, dims: tuple[str, ...], shape: tuple[int, ...], attributes: dict[str, Any]
    ) -> Callable[[int, int, int, NDArray[Any]], None]:
        array = self._root.require_group(group).create_array(
            name, shape=shape, chunks=(1, *shape[1:]), dtype="float32", fill_value=np.nan, dimension_names=dims,
            compressors=codecs(), config={"write_empty_chunks": True}, chunk_key_encoding=KEYS,
        )  # fmt: skip
        array.attrs.update(attributes)

        def write(run: int, begin: int, end: int, block: NDArray[Any]) -> None:
            array[run, begin:end] = block

        return write


class _NetcdfTarget:
    def __init__(self, file: Path) -> None:
        import netCDF4

        self._root = netCDF4.Dataset(str(file), "a")

    def close(self) -> None:
        self._root.close()

    def group(self, name: str, attributes: dict[str, Any]) -> None:
        self._root.createGroup(name).setncatts(attributes)

    def array(
        self, group: str, name: str, dims: tuple[str, ...], values: NDArray[Any], attributes: dict[str, Any]
    ) -> None:
        self._variable(group, name, dims, values.shape, values.dtype, attributes)[...] = values

    def stream(
        self, group: str, name: str, dims: tuple[str, ...], shape: tuple[int, ...], attributes: dict[str, Any]
    ) -> Callable[[int, int, int, NDArray[Any]], None]:
        variable = self._variable(group, name, dims, shape, np.dtype(np.float32), attributes, (1, *shape[1:]))

        def write(run: int, begin: int, end: int, block: NDArray[Any]) -> None:
            variable[run, begin:end] = block

        return write

    def _variable(
        self,
        group: str,
        name: str,
        dims: tuple[str, ...],
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        attributes: dict[str, Any],
        chunks: tuple[int, ...] | None = None,
    ) -> Any:
        home = self._root.createGroup(group)
        for dim, size in zip(dims, shape, strict=True):
            if dim not in home.dimensions and dim not in self._root.dimensions:
                home.createDimension(dim, size)
        options: dict[str, Any] = {"fill_value": np.nan} if dtype.kind == "f" else {}
        variable = home.createVariable(
            name, dtype, dims, compression="zlib", complevel=1, chunksizes=chunks, fletcher32=True, **options
        )
        variable.setncatts(attributes)
        return variable


@contextmanager
def _target(path: Path) -> Iterator[_Target]:
    """Somewhere to write /hierarchy; taken over into the dataset at the end, thrown away on failure."""
    if path.is_dir():
        with room_beside(path) as room:
            yield _ZarrTarget(room)
            put_in_place(room / "hierarchy", path / "hierarchy", durable=True)
        _consolidate_again(path)
    else:
        with writing(path), beside(path, durable=True) as new:
            _copy_without_hierarchy(path, new)
            target = _NetcdfTarget(new)
            try:
                yield target
            finally:
                target.close()


def _consolidate_again(path: Path) -> None:
    """Renew the metadata of all groups in one file, where the store has them."""
    import zarr

    if zarr.open_group(str(path), mode="r").metadata.consolidated_metadata is not None:
        with warnings.catch_warnings():
            # Zarr warns that version 3 does not specify what xarray has put there already.
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(str(path))


def _copy_without_hierarchy(path: Path, copy: Path) -> None:
    """A copy of a NetCDF file; HDF5 gives no space back, so an older hierarchy is left out by copying around it."""
    import netCDF4

    with handle(path) as source:
        if "hierarchy" in source.groups:
            with netCDF4.Dataset(str(copy), "w") as target:
                _copy_netcdf(source, target, leave_out="hierarchy")
            return
    shutil.copyfile(path, copy)


def _copy_netcdf(source: Any, target: Any, leave_out: str = "") -> None:
    target.setncatts({name: source.getncattr(name) for name in source.ncattrs()})
    for name, dim in source.dimensions.items():
        target.createDimension(name, None if dim.isunlimited() else len(dim))
    for name, variable in source.variables.items():
        attributes = {k: variable.getncattr(k) for k in variable.ncattrs()}
        chunks = variable.chunking()
        filters = variable.filters() or {}
        options: dict[str, Any] = {"zlib": True, "complevel": filters["complevel"]} if filters.get("zlib") else {}
        options |= {name: bool(filters.get(name)) for name in ("shuffle", "fletcher32")} if options else {}
        new = target.createVariable(
            name, variable.dtype, variable.dimensions, fill_value=attributes.pop("_FillValue", None),
            chunksizes=None if chunks == "contiguous" or not variable.dimensions else chunks, **options,
        )  # fmt: skip
        new.setncatts(attributes)
        variable.set_auto_maskandscale(False)
        new.set_auto_maskandscale(False)
        if variable.ndim > 1 and variable.dtype is not str:
            for row in range(variable.shape[0]):
                new[row] = variable[row]
        else:
            new[...] = variable[...]
    for name, group in source.groups.items():
        if name != leave_out:
            _copy_netcdf(group, target.createGroup(name))


def has_hierarchy(path: str | Path) -> bool:
    """Whether the dataset at `path` has a mesh hierarchy."""
    path = Path(path)
    if path.is_dir():
        return (path / "hierarchy").is_dir()
    with handle(path) as file:
        return "hierarchy" in file.groups
