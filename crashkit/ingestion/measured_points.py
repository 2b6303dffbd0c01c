"""Points that were measured after (or during) a crash, from a table: which node or place, where it is now, when.

| column | what |
|---|---|
| `node` (`node_id`, `nid`, `id`) | the solver's number of a node; or |
| `x`, `y`, `z` | the place of the point on the undeformed structure |
| `ux`, `uy`, `uz` (`dx`, .., `displacement_x`, ..) | measured displacement; or |
| `px`, `py`, `pz` (`position_x`, .., `x_measured`, ..) | measured position |
| `time` (`t`) | when; without it at the end |

Units stand in brackets behind the names, as in tables of parameters: `ux [mm]`. An empty cell is a component that was not
measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.ingestion.parameter_table import read_numbers
from data_schema.units import UnknownUnits, to_si

_NODE = ("node", "node_id", "nid", "id")
_TIME = ("time", "t")
_PLACE = tuple((axis,) for axis in "xyz")
_MOVED = tuple((f"u{a}", f"d{a}", f"u_{a}", f"displacement_{a}", f"disp_{a}") for a in "xyz")
_POSITION = tuple((f"p{a}", f"position_{a}", f"pos_{a}", f"{a}_measured", f"measured_{a}") for a in "xyz")
_KEYS = (*_NODE, "x", "xm", "xmm", "xcm")


@dataclass(frozen=True)
class MeasuredPoints:
    """What a table says, in SI.

    Attributes
    ----------
    row
        (point,) row in the file.
    node
        (point,) the solver's number, -1 where a place is given.
    place, displacement, position
        (point, 3) m; NaN where nothing is given.
    time
        (point,) s; NaN where none is given.
    without_unit
        Columns that state no unit, and were taken as metres or seconds.
    """

    path: Path
    row: NDArray[np.int64]
    node: NDArray[np.int64]
    place: NDArray[np.float64]
    displacement: NDArray[np.float64]
    position: NDArray[np.float64]
    time: NDArray[np.float64]
    without_unit: tuple[str, ...]


def read_measured_points(path: Path) -> MeasuredPoints:
    """The table at `path` (CSV, TSV, JSON or XLSX).

    Raises
    ------
    ReadError
        With the row and column of what is missing or cannot be understood.
    """
    table = read_numbers(path, _KEYS, what="table of measured points")
    named = {name.lower(): (k, unit) for k, (name, unit) in enumerate(table.columns)}
    values = np.array([row for _, row in table.rows], np.float64).reshape(len(table.rows), -1)
    numbers = np.array([number for number, _ in table.rows], np.int64)
    without: list[str] = []
    used: set[int] = set()

    def column(names: tuple[str, ...], si: str) -> NDArray[np.float64]:
        found = [n for n in names if n in named]
        if len(found) > 1:
            raise ReadError(f"{path}: columns {found[0]} and {found[1]} say the same; keep one of them")
        if not found:
            return np.full(len(values), np.nan)
        place, unit = named[found[0]]
        used.add(place)
        if not si:
            return values[:, place]
        if not unit:
            without.append(found[0])
            return values[:, place]
        try:
            factor, label = to_si(unit)
        except UnknownUnits as error:
            raise ReadError(f"{path}: column {found[0]}: {error}") from error
        if label != si:
            raise ReadError(
                f"{path}: column {found[0]} is in {unit}; expected a unit such as {'mm' if si == 'm' else 'ms'}"
            )
        return values[:, place] * factor

    node, time = column(_NODE, ""), column(_TIME, "s")
    place, moved, position = (
        np.stack([column(names, "m") for names in group], axis=1) for group in (_PLACE, _MOVED, _POSITION)
    )
    unknown = [name for k, (name, _) in enumerate(table.columns) if k not in used]
    for name in unknown:
        column_of = [
            n for group in (*_PLACE, *_MOVED, *_POSITION, _TIME) for n in group if name.lower().startswith(f"{n}_")
        ]
        if column_of:
            word = name[len(column_of[0]) + 1 :]
            raise ReadError(f"{path}: column {name!r}: {word!r} behind {column_of[0]} is no unit that is known")
    if unknown:
        raise ReadError(
            f"{path}: column {unknown[0]!r} is not known; expected node or x, y, z; ux, uy, uz or px, py, pz; and time"
        )
    if not np.isfinite(moved).any() and not np.isfinite(position).any():
        raise ReadError(
            f"{path}: holds no measurement; expected columns ux, uy, uz (displacement) or px, py, pz (position)"
        )
    for k, number in enumerate(numbers):
        if np.isfinite(node[k]) == np.isfinite(place[k]).any():
            both = "both a node and a place" if np.isfinite(node[k]) else "neither a node nor a place x, y, z"
            raise ReadError(f"{path}: row {number} names {both}; expected one of them")
        if np.isfinite(node[k]) and node[k] != int(node[k]):
            raise ReadError(f"{path}: row {number}: node {node[k]:g} is no number of a node")
        if not np.isfinite(node[k]) and not np.isfinite(place[k]).all():
            raise ReadError(
                f"{path}: row {number}: the place lacks {', '.join('xyz'[i] for i in range(3) if not np.isfinite(place[k, i]))}"
            )
        if not np.isfinite(moved[k]).any() and not np.isfinite(position[k]).any():
            raise ReadError(f"{path}: row {number} holds no measurement; leave the row out")
        if (np.isfinite(moved[k]) & np.isfinite(position[k])).any():
            raise ReadError(f"{path}: row {number} has both a displacement and a position; keep one of them")
    return MeasuredPoints(
        path, numbers, np.where(np.isfinite(node), node, -1).astype(np.int64), place, moved, position, time,
        tuple(without),
    )  # fmt: skip
