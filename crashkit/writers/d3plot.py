"""A run as an LS-DYNA d3plot family, d3plot and d3plot01, for post-processors that open nothing else (lasso-python writes).

Without a template the mesh is that of the run: every face a shell, with the solver's numbers of nodes, elements and parts,
titles of parts and deleted elements; metres and seconds. With a template, a d3plot of the same model, everything but the
states is the template's: solids, beams and parts that are not predicted, its numbers, titles and units.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError

if TYPE_CHECKING:
    import xarray as xr

# Length of a title, and the release that is named: VTK's reader asks for one.
_TITLE, _VERSION = 72, 971.0
# SI values of the units a template may have, and how well its mesh must be the run's, as a share of its size.
_LENGTHS, _TIMES, _ALIKE = (1.0, 1e-3, 1e-2, 0.0254), (1.0, 1e-3, 1e-6), 2e-3
_ELEMENTS = ("solid", "tshell", "beam", "shell")


def write_d3plot(
    run: xr.Dataset, folder: str | Path, template: str | Path | None = None, title: str = "crashkit"
) -> list[Path]:
    """Write one run, a crash dataset without `sim`, into `folder` as d3plot, d3plot01.

    Parameters
    ----------
    run
        `displacement` (time, node, xyz), m, `reference_position`, `face_nodes`; numbers, parts and `alive` where known.
        A node that is gone stays where it was last.
    folder
        New or empty: what a solver wrote looks like what this wrote, so nothing is ever replaced.
    template
        A d3plot of the same model; nodes are matched by their numbers.
    title
        Of the family, 40 letters.

    Raises
    ------
    DataError
        Where the template is of another mesh, or holds what cannot be written again.
    OutputError
        Where the folder holds anything already or cannot be written.
    """
    from crashkit.errors import OutputError
    from crashkit.output import complete_folder
    from crashkit.readers.lasso import d3plot_class

    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(
            f"{folder}: is there and not empty; a d3plot is written into a new folder alone, so remove it or choose another"
        )
    family = d3plot_class()
    if template is None:
        content = _of_run(family(), run)
    else:
        content = _of_template(family, run, Path(template))
    content.header.title = title.encode("ascii", "replace").decode()[:40].ljust(40)
    if not content.header.version:
        content.header.version, content.header.release_version = _VERSION, "971 "
    with complete_folder(folder, "d3plot") as new:
        try:
            content.write_d3plot(str(new / "d3plot"), single_file=True)
        except OSError:
            raise
        except Exception as error:  # it raises whatever numpy or struct meet in its way
            said = " ".join(str(error).split())[:200]
            raise DataError(f"{template or folder}: cannot be written as d3plot again ({said})") from error
    return sorted(folder.iterdir())


def _of_run(content: Any, run: xr.Dataset) -> Any:
    if "face_nodes" not in run or "reference_position" not in run:
        raise DataError("the run has no mesh to be written as d3plot; expected reference_position and face_nodes")
    arrays = content.arrays
    start, faces = run["reference_position"].values, run["face_nodes"].values.astype(np.int64)
    if faces.shape[1] == 3:
        faces = np.concatenate([faces, faces[:, 2:]], axis=1)
    faces[:, 3] = np.where(faces[:, 3] < 0, faces[:, 2], faces[:, 3])
    count = len(faces)
    parts = run["part_id"].values.astype(np.int64) if "part_id" in run else np.array([1])
    owner = run["face_part"].values.astype(np.int64) if "face_part" in run else np.zeros(count, np.int64)
    names = run["part_name"].values if "part_name" in run else np.array(["structure"])
    numbers = run["face_id"].values.astype(np.int64) if "face_id" in run else np.arange(1, count + 1)
    arrays["node_coordinates"] = start
    arrays["node_ids"] = run["node_id"].values.astype(np.int64) if "node_id" in run else np.arange(1, len(start) + 1)
    arrays["element_shell_node_indexes"] = faces
    arrays["element_shell_part_indexes"] = owner
    # A solid's sides share its number, and LS-DYNA's shells have each their own.
    arrays["element_shell_ids"] = numbers if len(np.unique(numbers)) == count else np.arange(1, count + 1)
    arrays["part_ids"], arrays["part_titles_ids"] = parts, parts
    arrays["part_titles"] = np.array([_padded(str(n)) for n in names], f"S{_TITLE}")
    arrays["timesteps"] = run["time"].values.astype(np.float64)
    arrays["node_displacement"] = start + _kept(run["displacement"].values)
    alive = run["alive"].values if "alive" in run and "face" in run["alive"].dims else None
    arrays["element_shell_is_alive"] = np.ones((run.sizes["time"], count)) if alive is None else alive.astype(float)
    return content


def _of_template(family: Any, run: xr.Dataset, template: Path) -> Any:
    """The template's geometry with the run's states, in the template's units."""
    from crashkit.readers import reader_for
    from crashkit.readers.lasso import guarded

    first = template / "d3plot" if template.is_dir() else template
    known = next(iter(reader_for(first, "d3plot").runs(first)))  # looks at everything before lasso-python does
    end = float(known.time[-1])
    known.close()
    with guarded(first):
        content = family(str(first), state_filter={0})
    arrays = content.arrays
    ids = np.asarray(arrays.get("node_ids", np.arange(1, len(arrays["node_coordinates"]) + 1)), np.int64)
    order = np.argsort(ids)
    wanted = run["node_id"].values.astype(np.int64)
    place = order[np.clip(np.searchsorted(ids, wanted, sorter=order), 0, len(ids) - 1)]
    missing = wanted[ids[place] != wanted]
    if len(missing):
        raise DataError(f"{first}: has no node {missing[0]}; the template is of another model")
    start = np.array(arrays["node_coordinates"], np.float64)
    own = run["reference_position"].values
    size = float(np.linalg.norm(np.ptp(own, axis=0)))
    off = {unit: float(np.abs(start[place] * unit - own).max()) / max(size, 1e-12) for unit in _LENGTHS}
    length = min(off, key=lambda unit: off[unit])
    if off[length] > _ALIKE:
        raise DataError(
            f"{first}: its nodes lie up to {100 * off[length]:.1f} % of the structure's size away from those of the run, "
            "in any unit; the template is of another mesh"
        )
    last = max(float(run["time"].values[-1]), 1e-12)
    unit_of_time = min(_TIMES, key=lambda unit: abs(np.log(max(end, 1e-12) * unit / last))) if end > 0 else 1.0
    states = run.sizes["time"]
    moved = np.repeat(start[None], states, axis=0)
    moved[:, place] = start[place] + _kept(run["displacement"].values) / length
    for name in [n for n in arrays if _of_states(n)]:
        del arrays[name]
    arrays["timesteps"] = run["time"].values / unit_of_time
    arrays["node_displacement"] = moved
    for kind in _ELEMENTS:
        count = len(arrays.get(f"element_{kind}_node_indexes", ()))
        if count:
            arrays[f"element_{kind}_is_alive"] = np.ones((states, count))
    _delete(arrays, run)
    return content


def _delete(arrays: dict[str, Any], run: xr.Dataset) -> None:
    """Shells of the template that are gone in the run, by their numbers."""
    if "alive" not in run or "face_id" not in run or "face" not in run["alive"].dims:
        return
    ids = np.asarray(arrays.get("element_shell_ids", ()), np.int64)
    where = {int(number): k for k, number in enumerate(ids)}
    pairs = [(k, where[int(n)]) for k, n in enumerate(run["face_id"].values) if int(n) in where]
    if pairs:
        faces, shells = np.array(pairs).T
        arrays["element_shell_is_alive"][:, shells] = run["alive"].values[:, faces].astype(float)


def _of_states(name: str) -> bool:
    """Whether lasso-python's array `name` holds results of states, and no mesh."""
    if name.startswith(("global_", "part_")):
        return not name.startswith(("part_ids", "part_titles", "part_material"))
    if name.startswith("element_"):
        return not name.endswith(("_node_indexes", "_part_indexes", "_ids", "_extra_nodes"))
    if name.startswith("rigid_body_"):
        return name not in ("rigid_body_part_indexes", "rigid_body_n_nodes", "rigid_body_node_indexes_list",
                            "rigid_body_n_active_nodes", "rigid_body_active_node_indexes_list")  # fmt: skip
    return name in ("timesteps", "rigid_wall_force", "rigid_wall_position", "stress_temperature") or (
        name.startswith("node_") and name not in ("node_coordinates", "node_ids")
    )


def _kept(displacement: NDArray[Any]) -> NDArray[np.float64]:
    """Displacements (state, node, 3) in which a node that is gone (NaN) stays where it was last."""
    out = np.array(displacement, np.float64)
    out[0] = np.nan_to_num(out[0])
    for k in range(1, len(out)):
        gone = np.isnan(out[k])
        out[k][gone] = out[k - 1][gone]
    return out


def _padded(name: str) -> bytes:
    return name.encode("ascii", "replace")[:_TITLE].ljust(_TITLE)
