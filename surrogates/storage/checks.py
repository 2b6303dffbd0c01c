"""Whether the arrays of a model folder fit together: sizes, ranges of indices, finite numbers.

Compiled code below (sparse products, VTK) trusts indices; one that points nowhere ends the interpreter. A folder may come
from anybody, so nothing is used before it was looked at here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from surrogates.data.campaign import Labels
from surrogates.data.graphs import Graphs
from surrogates.errors import SurrogateError
from surrogates.models.coarse_base import CoarseBase, CoarseMesh
from surrogates.models.curves import Curve
from surrogates.models.element_field import ElementField
from surrogates.models.pod_regression import PodRegression
from surrogates.models.removal import Removal
from surrogates.record import Record
from surrogates.uncertainty import SHARES, Band

if TYPE_CHECKING:
    from surrogates.models.base import Network


def plain_files(files: Any) -> Mapping[str, str]:
    """The list of files in a model's description: plain names and SHA-256, nothing else."""
    if not isinstance(files, Mapping):
        raise SurrogateError(f"files is {type(files).__name__}; expected names with their SHA-256")
    for name, digest in files.items():
        if "/" in name or "\\" in name or name in ("", ".", "..") or not isinstance(digest, str):
            raise SurrogateError(f"files names {name!r}; expected the name of a file in the folder and its SHA-256")
    return files


def numbers(
    what: str, values: Any, shape: Sequence[int | None], low: int | None = None, high: int | None = None
) -> NDArray[Any]:
    """`values`, which must be an array of `shape` (None: any length), finite, from `low` to below `high` where said."""
    array = np.asarray(values)
    fits = array.ndim == len(shape) and all(n is None or m == n for m, n in zip(array.shape, shape, strict=True))
    if not fits:
        raise SurrogateError(
            f"{what} has the shape {array.shape}; expected {tuple('any' if n is None else n for n in shape)}"
        )
    if array.dtype.kind not in ("iu" if low is not None else "iuf"):
        raise SurrogateError(f"{what} holds {array.dtype}; expected {'whole ' if low is not None else ''}numbers")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise SurrogateError(f"{what} holds numbers that are not finite")
    if low is not None and high is not None and array.size and (array.min() < low or array.max() >= high):
        raise SurrogateError(f"{what} holds {array.min()} to {array.max()}; expected {low} to {high - 1}")
    return array


def whole_matrix(what: str, matrix: sparse.csr_matrix) -> None:
    """Raise SurrogateError unless a sparse matrix points only into itself and holds finite numbers."""
    try:
        matrix.check_format(full_check=True)
    except (ValueError, IndexError) as error:
        raise SurrogateError(f"{what} is no sparse matrix ({error})") from error
    numbers(what, matrix.data, (None,))


def check_graphs(graphs: Graphs, points: Any, faces: Any) -> None:
    """Levels, their maps, and the full mesh."""
    n = graphs.n_full
    if n < 1:
        raise SurrogateError(f"the full mesh has {n} nodes")
    if (points is None) != (faces is None):
        raise SurrogateError("points and faces belong together; one of them is missing")
    if points is not None:
        numbers("points", points, (n, 3))
        corners = numbers("faces", faces, (None, None), -1, n)
        if corners.shape[1] not in (3, 4) or (corners.size and corners[:, :3].min() < 0):
            raise SurrogateError(f"faces has the shape {corners.shape} or lacks corners; expected 3 or 4 nodes a face")
    if graphs.full_edges is not None:
        numbers("edges", graphs.full_edges, (None, 2), 0, n)
    finer = n
    for level in graphs.levels:
        name, count = f"level {level.index}", len(level.kept)
        if not 1 <= count <= finer:
            raise SurrogateError(f"{name} has {count} nodes; expected 1 to {finer}")
        if len(np.unique(numbers(f"kept of {name}", level.kept, (None,), 0, n))) < count:
            raise SurrogateError(f"{name} keeps a node twice")
        numbers(f"faces of {name}", level.faces, (None, 3), 0, count)
        numbers(f"edges of {name}", level.edges, (None, 2), 0, count)
        numbers(f"in_finer of {name}", level.in_finer, (count,), 0, finer)
        whole_matrix(f"to_finer of {name}", level.to_finer)
        whole_matrix(f"to_full of {name}", level.to_full)
        finer = count


def check_record(record: Record) -> None:
    """Ranges and times."""
    ranges, count = record.ranges, len(record.ranges.names)
    numbers("ranges.low", ranges.low, (count,))
    numbers("ranges.high", ranges.high, (count,))
    if len(ranges.units) != count or len(ranges.written) != count or (ranges.low > ranges.high).any():
        raise SurrogateError(f"ranges do not fit the {count} parameters")
    if not all(np.isfinite(factor) and factor > 0 for _, factor in ranges.written):
        raise SurrogateError("ranges.table holds a unit without a value")
    _check_times("time", record.time)
    runs = len(record.fitted_runs)
    for name, values in record.parameters.items():
        numbers(f"values of {name}", np.array(values), (runs,))
    unknown = record.left_out.keys() - set(record.fitted_runs)
    if unknown:
        raise SurrogateError(f"left_out names {min(unknown)!r}, which is none of the {runs} runs it was fitted to")
    numbers("left_out", np.array(list(record.left_out.values())).ravel(), (2 * len(record.left_out),))


def _check_times(what: str, values: Any) -> None:
    time = numbers(what, values, (None,))
    if not len(time) or (np.diff(time) <= 0).any():
        raise SurrogateError(f"{what}: not increasing")


def check_labels(labels: Labels | None, n_nodes: int, n_faces: int) -> None:
    """The solver's numbers."""
    if labels is None:
        return
    parts = len(labels.part_name)
    numbers("node_id", labels.node_id, (n_nodes,))
    numbers("part_id", labels.part_id, (parts,))
    numbers("face_part", labels.face_part, (n_faces,), 0, parts)
    if labels.face_id is not None:
        numbers("face_id", labels.face_id, (n_faces,))


def check_curves(curves: Mapping[str, Curve]) -> None:
    """Components, values and times of each channel fit together."""
    for name, curve in curves.items():
        samples, places = (
            len(numbers(f"time of {name}", curve.time, (None,))),
            len(numbers("grid", curve.grid, (None,))),
        )
        modes = numbers(f"modes of {name}", curve.modes, (None, places))
        values = numbers(f"values of {name}", curve.values, (None, len(modes)))
        inputs = len(numbers("low", curve.low, (None,)))
        numbers("high", curve.high, (inputs,))
        numbers(f"inputs of {name}", curve.machine.x, (len(values), None))
        if not samples or (np.diff(curve.time) <= 0).any() or (np.diff(curve.grid) <= 0).any():
            raise SurrogateError(f"times of {name} are not increasing")
        if curve.band is not None:
            numbers("node", curve.band.node, (1,))
            numbers("state", curve.band.state, (samples,))
            numbers("factor", curve.band.factor, (len(SHARES),))
            if not (np.isfinite(curve.band.unit) and curve.band.unit > 0):
                raise SurrogateError(f"the band of {name} has the unit {curve.band.unit}; expected a number above 0")


def check_bands(bands: Mapping[tuple[int, bool], Band], graphs: Graphs, record: Record) -> None:
    """One number for each node, each state and each share."""
    for (level, full), band in bands.items():
        name = f"band of level {level}"
        numbers(f"node of the {name}", band.node, (graphs.n_nodes(0 if full else level),))
        numbers(f"state of the {name}", band.state, (len(record.time),))
        numbers(f"factor of the {name}", band.factor, (len(SHARES),))
        if not (np.isfinite(band.unit) and band.unit > 0):
            raise SurrogateError(f"{name} has the unit {band.unit}; expected a number above 0")
        if band.local is not None:
            places = len(band.local.ratio)
            numbers(f"points of the {name}", band.local.points, (places, None))
            numbers(f"ratio of the {name}", band.local.ratio, (places,))
            numbers(f"run of the {name}", band.local.run, (places,))


def check_core(core: Network | PodRegression, graphs: Graphs) -> None:
    """What answers: weights are finite, modes have a row for each coordinate of each node."""
    if isinstance(core, PodRegression):
        numbers("modes", core.modes, (3 * graphs.n_full, None))
        runs, states = core.data.parameters.shape[0], len(core.data.time)
        _check_times("times of the modes", core.data.time)
        numbers("values", core.data.values, (runs, states, core.modes.shape[1]))
        numbers("parameters", core.data.parameters, (runs, None))
        if core.samples is not None:
            numbers("samples", core.samples, (None,), 0, runs * states)
        return
    for number in core.numbers:
        if not 0 <= number <= len(graphs.levels):
            raise SurrogateError(f"level {number} is answered for; the hierarchy has levels 0 to {len(graphs.levels)}")
    for name, tensor in core.state_dict().items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise SurrogateError(f"weights {name} hold numbers that are not finite")


def check_base(base: CoarseBase | None, graphs: Graphs) -> None:
    """What coarse runs add: a course for each sample of their process, a slope for each mode, and the map from their mesh."""
    if base is None:
        return
    samples = len(numbers("inputs of the coarse runs", base.process.x, (None, None)))
    slopes = numbers("slopes of the coarse runs", base.slopes, (None,))
    numbers("values of the coarse runs", base.values, (samples, None, len(slopes)))
    if base.beside is not None:
        fine = len(numbers("inputs beside the coarse runs", base.beside[0].x, (None, None)))
        numbers("values beside the coarse runs", base.beside[1], (fine, base.values.shape[1], len(slopes)))
    check_coarse_mesh(base.mesh, graphs)


def check_coarse_mesh(mesh: CoarseMesh, graphs: Graphs) -> None:
    """Places and numbers of the coarse nodes, and the map to each node of the full mesh."""
    nodes = len(numbers("position of the coarse mesh", mesh.position, (None, 3)))
    numbers("node_id of the coarse mesh", mesh.node_id, (nodes,))
    whole_matrix("the map from the coarse mesh", mesh.to_fine)
    if mesh.to_fine.shape[0] != graphs.n_full:
        raise SurrogateError(f"the map from the coarse mesh has {mesh.to_fine.shape[0]} rows; expected {graphs.n_full}")


def check_elements(removal: Removal | None, fields: Mapping[str, ElementField], n_faces: int, states: int) -> None:
    """What is said of elements: places of elements, and as many weights as runs."""
    if removal is not None:
        count = len(numbers("faces of the removal", removal.faces, (None,), 0, n_faces))
        numbers("inputs of the removal", removal.weigher.machine.x, (None, None))
        if removal.gone_at.shape != (len(removal.weigher.machine.x), count) or np.isnan(removal.gone_at).any():
            raise SurrogateError(f"gone_at of the removal has the shape {removal.gone_at.shape}, or gaps")
        numbers("slopes of the removal", removal.slopes, (None,))
        whole_matrix("neighbours of the removal", removal.around)
        if set(removal.terms) - {"rate", "nearest", "process"}:
            raise SurrogateError(f"the removal asks for {', '.join(removal.terms)}")
    for name, field in fields.items():
        numbers(f"modes of {name}", field.modes, (n_faces, None))
        runs = len(numbers(f"inputs of {name}", field.weigher.machine.x, (None, None)))
        numbers(f"courses of {name}", field.courses, (runs, states, field.modes.shape[1]))
