"""A run in the layout of PhysicsNeMo Curator's crash data, for training tools that read it: a Zarr store or a VTP file.

Zarr: `mesh_pos` (state, node, 3), positions, and the faces as `mesh_connectivity_flat` and `mesh_connectivity_offsets`;
besides, `time` (state,), which the Curator leaves out. VTP: points are the reference position, and the point arrays
`displacement_t0.000`, .. the states, with the time in their names. Metres and seconds.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError, OutputError
from data_schema.replace import beside

if TYPE_CHECKING:
    import xarray as xr

# Most decimals of a time in the name of an array.
_DECIMALS = 9
SUFFIXES = (".zarr", ".vtp")


def write_physicsnemo(run: xr.Dataset, output: str | Path) -> list[Path]:
    """Write one run, a crash dataset without `sim`, as `.zarr` or `.vtp` in the layout of PhysicsNeMo Curator.

    Raises
    ------
    DataError
        Where the run has no mesh, or nodes that are gone.
    OutputError
        Where `output` cannot be written, or is a store of something else.
    """
    output = Path(output)
    if output.suffix not in SUFFIXES:
        raise OutputError(f"{output}: PhysicsNeMo's data is a Zarr store or a VTP file; expected .zarr or .vtp")
    if "face_nodes" not in run or "reference_position" not in run:
        raise DataError(f"{output}: the run has no mesh; expected reference_position and face_nodes")
    displacement = run["displacement"].values
    if not np.isfinite(displacement).all():
        raise DataError(f"{output}: nodes are gone in this run, for which the layout has no place; write .vtkhdf")
    if output.is_dir() and output.suffix == ".zarr" and not (output / "mesh_pos").is_dir() and any(output.iterdir()):
        raise OutputError(f"{output}: holds something else; choose another place")
    try:
        with beside(output) as new:
            (_zarr if output.suffix == ".zarr" else _vtp)(run, displacement, new)
    except OSError as error:
        raise OutputError(
            f"{output}: cannot be written ({error.strerror or error}); check permissions and free space"
        ) from error
    return [output]


def _zarr(run: xr.Dataset, displacement: NDArray[Any], target: Path) -> None:
    import zarr

    flat, offsets = _faces(run)
    position = (run["reference_position"].values + displacement).astype(np.float32)
    store = zarr.open_group(str(target), mode="w", zarr_format=2)
    arrays = {
        "mesh_pos": position, "mesh_connectivity_flat": flat, "mesh_connectivity_offsets": offsets,
        "time": run["time"].values.astype(np.float64),
    }  # fmt: skip
    for name, values in arrays.items():
        chunks = (1, *values.shape[1:]) if name == "mesh_pos" else values.shape
        # Chunks of zeros are written, too: one that is missing reads as damage.
        made = store.create_array(
            name, shape=values.shape, dtype=values.dtype, chunks=chunks, config={"write_empty_chunks": True}
        )
        made[...] = values


def _vtp(run: xr.Dataset, displacement: NDArray[Any], target: Path) -> None:
    import pyvista as pv

    flat, offsets = _faces(run)
    sizes = np.diff(offsets)
    faces = np.insert(flat, offsets[:-1], sizes)
    mesh = pv.PolyData(np.ascontiguousarray(run["reference_position"].values, np.float64), faces.astype(np.int64))
    for title, state in zip(_titles(run["time"].values), displacement, strict=True):
        mesh.point_data[title] = np.ascontiguousarray(state, np.float32)
    mesh.save(target)


def _faces(run: xr.Dataset) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Corners of all faces one behind the other, and where each begins."""
    faces = run["face_nodes"].values.astype(np.int64)
    valid = faces >= 0
    if faces.shape[1] == 4:  # a triangle may repeat its last node
        valid[:, 3] &= faces[:, 3] != faces[:, 2]
    return faces[valid], np.concatenate([[0], np.cumsum(valid.sum(axis=1))])


def _titles(time: NDArray[np.float64]) -> list[str]:
    """Names with the time in as few decimals as keep all states apart, three at least."""
    step = float(np.diff(time).min()) if len(time) > 1 else 1.0
    decimals = min(_DECIMALS, max(3, 4 - math.floor(math.log10(step)) if step > 0 else 3))
    return [f"displacement_t{t:.{decimals}f}" for t in time]
