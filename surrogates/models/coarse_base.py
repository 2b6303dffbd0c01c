"""What runs on a coarser mesh add to a regression of fine ones.

A prediction is w(x)' (F - s B) + s c(x): the fine process's weights w of the fine courses F, and what the coarse field c
at the query says beyond the coarse fields B at the parameters of the fine runs, taken over with a slope s for each mode.
c is a process over all coarse runs, or a coarse run of the query itself. A mean of several such predictions is another
sum of weighted courses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from surrogates.data.campaign import CoarseRuns
from surrogates.errors import SurrogateError
from surrogates.regression.gaussian import Gaussian


@dataclass(frozen=True)
class CoarseMesh:
    """The mesh of coarse runs: a coarse run that a prediction starts from must be on it.

    Attributes
    ----------
    to_fine
        (node of the full mesh, coarse node): what a coarse field says at each node.
    position, node_id
        (coarse node, 3), m, and the solver's numbers on it.
    """

    to_fine: sparse.csr_matrix
    position: NDArray[np.float64]
    node_id: NDArray[np.int64]

    @classmethod
    def of(cls, coarse: CoarseRuns) -> CoarseMesh:
        """That of `coarse`; nodes are numbered 1, 2, .. without the solver's numbers.

        Raises
        ------
        SurrogateError
            For runs without a mesh.
        """
        campaign = coarse.campaign
        if campaign.points is None:
            raise SurrogateError("coarse runs need their mesh, to tell later whether a coarse run is on it")
        numbers = np.arange(1, campaign.n_nodes + 1) if campaign.labels is None else campaign.labels.node_id
        return cls(coarse.to_fine, campaign.points, numbers)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be stored."""
        u = self.to_fine
        return {
            "data": u.data, "indices": u.indices.astype(np.int32), "indptr": u.indptr.astype(np.int64),
            "position": self.position, "node_id": self.node_id,
        }  # fmt: skip

    @classmethod
    def load(cls, a: Mapping[str, NDArray[Any]]) -> CoarseMesh:
        """From what `arrays` gave."""
        shape = (len(a["indptr"]) - 1, len(a["position"]))
        return cls(sparse.csr_matrix((a["data"], a["indices"], a["indptr"]), shape=shape), a["position"], a["node_id"])


@dataclass
class CoarseBase:
    """The coarse runs behind a model.

    Attributes
    ----------
    process
        Over the coarse runs and their images, with inputs scaled as those of the fine runs.
    values
        (coarse run and image, state of the grid, mode), m: registered courses times the slopes.
    slopes
        (mode,) how much of the coarse field is taken over.
    mesh
        That of the coarse runs.
    share
        How much a coarse run of the query counts; the process counts by the rest.
    beside
        A second process over the fine runs and images, with other lengths, and its courses; None without.
    """

    def weights(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, sample): how much each of the `courses` enters at scaled inputs (run, input)."""
        own = self.process.weights(x)
        return own if self.beside is None else np.concatenate([self.beside[0].weights(x), own], axis=1)

    @property
    def courses(self) -> NDArray[np.float32]:
        """(sample, state of the grid, mode), m."""
        return self.values if self.beside is None else np.concatenate([self.beside[1], self.values])

    process: Gaussian
    values: NDArray[np.float32]
    slopes: NDArray[np.float64]
    mesh: CoarseMesh
    share: float = 1.0
    beside: tuple[Gaussian, NDArray[np.float32]] | None = None

    def project(self, states: NDArray[np.float32], modes: NDArray[np.float32]) -> NDArray[np.float64]:
        """Coarse displacements (state, coarse node, 3), m -> what is taken over of their coefficients (state, mode)."""
        return np.asarray((states.reshape(len(states), -1) @ coarse_modes(self.mesh.to_fine, modes)) * self.slopes)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be stored."""
        beside: dict[str, NDArray[Any]] = {}
        if self.beside is not None:
            machine, values = self.beside
            numbers = machine.numbers()
            beside = {"beside.x": machine.x, "beside.values": values, **{f"beside.{k}": v for k, v in numbers.items()}}
        return beside | self.mesh.arrays() | {
            "x": self.process.x, **self.process.numbers(), "values": self.values, "slopes": self.slopes,
            "share": np.array([self.share]),
        }  # fmt: skip

    @classmethod
    def load(cls, a: Mapping[str, NDArray[Any]]) -> CoarseBase:
        """From what `arrays` gave."""
        process = Gaussian.load(a["x"], a)
        beside = None
        if "beside.x" in a:
            numbers = {k: a[f"beside.{k}"] for k in process.numbers()}
            beside = Gaussian.load(a["beside.x"], numbers), a["beside.values"]
        share = float(a["share"][0])
        return cls(process, a["values"], a["slopes"], CoarseMesh.load(a), share, beside)


def coarse_modes(to_fine: sparse.csr_matrix, modes: NDArray[np.float32]) -> NDArray[np.float32]:
    """(3 * coarse node, mode): the modes (3 * node, mode) as coarse displacements see them, so that none is lifted."""
    by_node = modes.reshape(to_fine.shape[0], -1)
    return np.asarray((to_fine.T @ by_node).reshape(-1, modes.shape[1]), np.float32)
