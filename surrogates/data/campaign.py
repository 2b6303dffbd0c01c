"""What a surrogate is trained on: parameters, times, displacements by level, and the graphs between levels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.levels import Level
from data_schema.mirror import MirrorPlane

# Coarse runs without which there is no process of them.
FEWEST_COARSE = 4


class RunByRun(Protocol):
    """Displacements (sim, state, node, 3) float32, m, of which one run at a time is taken; a numpy array is one."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, run: int, /) -> NDArray[Any]: ...


@dataclass(frozen=True)
class ElementTarget:
    """A result on elements that is learnt beside the displacements.

    Attributes
    ----------
    values
        (sim, state, face), taken run by run; NaN where the solver wrote none.
    unit
        Of its numbers, such as 1 or Pa.
    """

    name: str
    unit: str
    values: RunByRun


@dataclass(frozen=True)
class Labels:
    """The solver's numbers and names on the full mesh, kept so that files written from a model carry them.

    node_id (node,), face_id and face_part (face,) an index into part_id (part,) and part_name; face_id may be missing
    """

    node_id: NDArray[np.int64]
    face_part: NDArray[np.int64]
    part_id: NDArray[np.int64]
    part_name: tuple[str, ...]
    face_id: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class CurveTarget:
    """A channel of the time histories that is learnt beside the displacements.

    Attributes
    ----------
    name, unit
        Of the channel.
    values
        (sim, sample), NaN where a run lacks it.
    """

    name: str
    unit: str
    values: NDArray[np.float64]


@dataclass(frozen=True)
class Campaign:
    """The runs a surrogate may see, and nothing of the test runs.

    Attributes
    ----------
    parameters
        (sim, parameter) float64, in the units of `parameter_units`.
    time
        (state,) float64, s.
    displacement
        Level index -> (sim, state, node of that level, 3) float32, m. Called with 0 for the full mesh only by
        models that work there (POD baselines, AENN, GAENN); the cascade asks for its levels, and reads only
        validation runs of the full mesh, to judge lifted predictions. Anything that gives one run when indexed will
        do, so the full field need not be in memory.
    full_edges
        (e, 2) graph edges of level 0, for models that convolve there.
    levels
        Coarse levels, level 1 first; may be empty for POD baselines.
    runs
        Names of the runs, for messages and the model card.
    held_out
        Names of the runs that were kept away (the test runs), for the record.
    checksum
        SHA-256 that identifies the dataset.
    points, faces
        The full mesh (node, 3), m, and (face, corner), stored with the model so that it draws without data.
    labels
        The solver's numbers and names on it.
    table_units
        For each parameter the unit people write it in, and its value in `parameter_units`: ("MPa", 1e6).
    dimensions
        Exponents of (kg, m, s) of each parameter's unit, None where it has none that is known.
    mirrors
        Planes of symmetry of the structure, the best first.
    erodes
        Whether elements disappear, so that displacements of nodes that nothing holds are missing.
    marked
        Run -> what of it was beyond a limit when it was ingested.
    alive
        (sim, state, face) whether an element is still there, taken run by run; None where none disappears.
    targets
        Results on elements that are learnt beside the displacements.
    curves, curve_time
        Channels of time histories that are learnt beside the displacements, and their times (sample,), s.
    known
        (sim, state) whether a run was computed that far; None: all were. Other states are in no loss.
    coarse
        Runs of the same structure on a coarser mesh, which help to predict these.
    """

    parameters: NDArray[np.float64]
    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    time: NDArray[np.float64]
    displacement: Callable[[int], RunByRun]
    n_nodes: int
    levels: tuple[Level, ...] = ()
    full_edges: NDArray[np.int32] | None = None
    runs: tuple[str, ...] = ()
    checksum: str = ""
    attributes: Mapping[str, str] | None = None
    held_out: tuple[str, ...] = ()
    points: NDArray[np.float64] | None = None
    faces: NDArray[np.int32] | None = None
    labels: Labels | None = None
    table_units: tuple[tuple[str, float], ...] = ()
    dimensions: tuple[tuple[float, float, float] | None, ...] = ()
    mirrors: tuple[MirrorPlane, ...] = ()
    known: NDArray[np.bool_] | None = None
    erodes: bool = False
    marked: Mapping[str, str] | None = None
    alive: RunByRun | None = None
    targets: tuple[ElementTarget, ...] = ()
    curves: tuple[CurveTarget, ...] = ()
    curve_time: NDArray[np.float64] | None = None
    coarse: CoarseRuns | None = None


@dataclass(frozen=True)
class CoarseRuns:
    """Runs of the same structure on another, coarser mesh.

    Attributes
    ----------
    campaign
        The runs: parameters in the order and units of those of the finer mesh, displacements on their own full mesh.
    to_fine
        (node of the finer mesh, node of the coarser one): what a field says at each node, part by part.
    notes
        What is odd about them, a sentence each.
    """

    campaign: Campaign
    to_fine: sparse.csr_matrix
    notes: tuple[str, ...] = ()
