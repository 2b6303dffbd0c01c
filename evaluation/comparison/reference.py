"""The solver's runs as evaluation reads them: names, parameters and mesh at hand, the fields one run at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from data_schema.levels import Level
from evaluation.errors import EvaluationError

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Result:
    """A further result of a run, such as plastic strain: `values` (state, node | face | cell, ...), and what it is on."""

    values: NDArray[np.floating]
    on: str
    unit: str


@dataclass(frozen=True)
class Reference:
    """Everything about the runs but their fields, and a way to read these.

    node_id, part_id the solver's own numbers
    levels           coarse levels, level 1 first; may be empty
    checksum         SHA-256 that identifies the dataset
    positions        run number -> (node, 3), m, where runs differ in shape; else None
    alive            run number -> (state, face) bool, False once an element has failed; None where nothing erodes

    Attributes
    ----------
    runs
        (sim,) names.
    parameters
        (sim, parameter) float64 in `parameter_units`.
    time
        (state,) float64, s.
    displacement
        Run number -> (state, node, 3) float32, m; NaN where a node is gone.
    position
        (node, 3) float64, m: undeformed; of the first run where runs differ in shape.
    faces
        (face, 3 or 4) int32, -1 in the last corner of a triangle among quadrilaterals.
    face_part
        (face,) int32 index into `part_names`.
    face_id
        (face,) the solver's numbers of the elements; None where nobody says.
    fields
        Run number -> its further results by name; None where there are none.
    table_units
        For each parameter the unit people write it in and its value in `parameter_units`, such as ("MPa", 1e6).
    """

    runs: tuple[str, ...]
    parameters: NDArray[np.float64]
    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    time: NDArray[np.float64]
    displacement: Callable[[int], NDArray[np.float32]]
    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    face_part: NDArray[np.integer]
    part_names: tuple[str, ...]
    node_id: NDArray[np.integer]
    part_id: NDArray[np.integer]
    levels: tuple[Level, ...] = ()
    checksum: str = ""
    attributes: Mapping[str, str] = field(default_factory=dict)
    positions: Callable[[int], NDArray[np.float64]] | None = None
    alive: Callable[[int], NDArray[np.bool_]] | None = None
    face_id: NDArray[np.integer] | None = None
    fields: Callable[[int], Mapping[str, Result]] | None = None
    table_units: tuple[tuple[str, float], ...] = ()

    @property
    def written(self) -> tuple[tuple[str, float], ...]:
        """`table_units`, or the parameters' own units where they say nothing."""
        return self.table_units or tuple((unit, 1.0) for unit in self.parameter_units)

    @property
    def n_nodes(self) -> int:
        return len(self.position)

    def position_of(self, run: int) -> NDArray[np.float64]:
        """(node, 3), m: undeformed positions of run number `run`."""
        return self.position if self.positions is None else self.positions(run)

    def level_nodes(self, level: int) -> int:
        """Number of nodes of `level`; 0 is the full mesh."""
        return self.n_nodes if level == 0 else self.level(level).n_nodes

    def level(self, index: int) -> Level:
        """Coarse level `index` (1 is the finest).

        Raises
        ------
        EvaluationError
            Where the hierarchy has no such level.
        """
        if not 1 <= index <= len(self.levels):
            raise EvaluationError(
                f"level {index} asked for; the dataset's hierarchy has {len(self.levels)} coarse levels; "
                f"make one with `crashkit coarsen`"
            )
        return self.levels[index - 1]

    def part_nodes(self) -> list[NDArray[np.int64]]:
        """Node numbers of each part, (part) arrays; a node that two parts share belongs to both."""
        out = []
        for part in range(len(self.part_names)):
            nodes = np.unique(self.faces[self.face_part == part])
            out.append(nodes[nodes >= 0].astype(np.int64))
        return out

    def index(self, names: Sequence[str]) -> tuple[int, ...]:
        """Run numbers of `names`, in their order.

        Raises
        ------
        EvaluationError
            Naming a run that is not there.
        """
        number = {name: k for k, name in enumerate(self.runs)}
        missing = [name for name in names if name not in number]
        if missing:
            raise EvaluationError(
                f"run {missing[0]!r} is not in the dataset ({len(self.runs)} runs, {self.runs[0]} to {self.runs[-1]}); "
                f"give the dataset that the models were trained on"
            )
        return tuple(number[name] for name in names)


def reference_of(
    dataset: xr.Dataset, levels: Sequence[Level] = (), attributes: Mapping[str, str] | None = None
) -> Reference:
    """The runs of a crash dataset (`data_schema`); reads no field until one is asked for."""
    from data_schema import fields, parameters, table_unit

    names = tuple(parameters(dataset))
    results = fields(dataset)

    def further(run: int) -> dict[str, Result]:
        found = {name: dataset[name].isel(sim=run) for name in results}
        return {n: Result(a.values, str(a.dims[1]), str(a.attrs.get("units", ""))) for n, a in found.items()}

    position = dataset["reference_position"]
    displacement = dataset["displacement"]
    by_run = "sim" in position.dims
    life = dataset["alive"] if "alive" in dataset.variables else None
    return Reference(
        runs=tuple(map(str, dataset["sim"].values)),
        parameters=np.stack([dataset[n].values.astype(np.float64) for n in names], axis=1)
        if names
        else np.empty((dataset.sizes["sim"], 0)),
        parameter_names=names,
        parameter_units=tuple(str(dataset[n].attrs.get("units", "")) for n in names),
        time=dataset["time"].values.astype(np.float64),
        displacement=lambda k: np.asarray(displacement.isel(sim=k).values),
        position=np.asarray((position.isel(sim=0) if by_run else position).values, dtype=np.float64),
        faces=dataset["face_nodes"].values,
        face_part=dataset["face_part"].values,
        part_names=tuple(map(str, dataset["part_name"].values)),
        node_id=dataset["node_id"].values,
        part_id=dataset["part_id"].values,
        levels=tuple(levels),
        checksum=str(dataset.attrs.get("checksum", "")),
        attributes={str(k): str(v) for k, v in dataset.attrs.items()} | dict(attributes or {}),
        positions=(lambda k: position.isel(sim=k).values.astype(np.float64)) if by_run else None,
        alive=(lambda k: life.isel(sim=k).values.astype(bool)) if life is not None else None,
        face_id=dataset["face_id"].values if "face_id" in dataset.variables else None,
        fields=further if results else None,
        table_units=tuple(table_unit(dataset, name) for name in names),
    )
