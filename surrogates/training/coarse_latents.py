"""Coarse runs on the nodes of a level, registered and encoded as the fine ones are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_schema.levels import lift
from surrogates.data.campaign import CoarseRuns
from surrogates.data.samples import LevelRuns, Notes
from surrogates.models.coarse_fit import with_inputs
from surrogates.physics.registration import Registration
from surrogates.regression.beneath import twins
from surrogates.settings import Settings


@dataclass(frozen=True)
class CoarseFields:
    """Coarse runs as fields on fine nodes: run by run, none is kept.

    keep  (run,) places of the coarse runs that have the registration's inputs
    """

    coarse: CoarseRuns
    registration: Registration
    keep: NDArray[np.int64]
    runs: LevelRuns

    @classmethod
    def of(cls, coarse: CoarseRuns, registration: Registration, settings: Settings, notes: Notes) -> CoarseFields:
        keep = with_inputs(coarse, registration, notes)
        return cls(coarse, registration, keep, LevelRuns(coarse.campaign, 0, settings, notes))

    @property
    def inputs(self) -> NDArray[np.float64]:
        """(run and image, input)"""
        parameters, of = self.coarse.campaign.parameters[self.keep], self.registration
        own = of.read(parameters)
        if of.symmetry.is_identity:
            return own
        images = of.read(of.symmetry.images(parameters, of.inputs.names))
        if of.symmetry.flagged:
            images[:, -1] = 1.0
        return np.concatenate([own, images])

    def twin(self, parameters: NDArray[np.float64]) -> NDArray[np.int64]:
        """(run,) of fine runs (run, parameter): the coarse run of the same parameters; -1 without one."""
        return twins(parameters, self.coarse.campaign.parameters[self.keep])

    def courses(
        self, nodes: NDArray[np.int64], encode: Callable[[NDArray[np.float32]], NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """(run and image, state of the grid, latent): `encode` of the registered states (state, some fine nodes, 3), m."""
        maps = [self.coarse.to_fine[nodes].astype(np.float32)]
        mirror = self.registration.symmetry.mirror
        if mirror is not None:
            maps.append((mirror.to_image[nodes] @ self.coarse.to_fine).tocsr().astype(np.float32))
        time = self.coarse.campaign.time
        out: list[list[NDArray[np.float32]]] = [[] for _ in maps]
        for run in self.keep:
            seen = self.runs.read(int(run))
            for k, (rows, courses) in enumerate(zip(maps, out, strict=True)):
                states = lift(rows, seen)
                if k and mirror is not None:
                    states = states @ mirror.reflection.T.astype(np.float32)
                courses.append(encode(self.registration.on_grid(states, self.coarse.campaign.parameters[run], time)))
        return np.stack([course for courses in out for course in courses])
