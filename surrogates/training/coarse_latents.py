"""Coarse runs on the nodes of a level, registered and encoded as the fine ones are."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_schema.levels import lift
from surrogates.data.campaign import CoarseRuns
from surrogates.data.samples import LevelRuns, Notes
from surrogates.data.shelf import Shelf
from surrogates.models.coarse_fit import with_inputs
from surrogates.physics.registration import Registration
from surrogates.regression.beneath import twins
from surrogates.settings import Settings

_log = logging.getLogger(__name__)


class _Once:
    """Runs that are read once: every level asks for all of them, and what they are read from is slow."""

    def __init__(self, runs: LevelRuns, count: int) -> None:
        self._runs = runs
        self._shelf = Shelf(count, (runs.states, runs.nodes, 3))
        self._there = np.zeros(count, bool)

    def read(self, run: int) -> NDArray[np.float32]:
        """(state, node, 3), m"""
        if not self._there[run]:
            self._shelf.put(run, self._runs.read(run)[None])
            self._there[run] = True
        out: NDArray[np.float32] = self._shelf.take(np.array([run]))[0]
        return out


@dataclass(frozen=True)
class CoarseFields:
    """Coarse runs as fields on fine nodes, run by run.

    keep  (run,) places of the coarse runs that have the registration's inputs
    """

    coarse: CoarseRuns
    registration: Registration
    keep: NDArray[np.int64]
    runs: _Once

    @classmethod
    def of(cls, coarse: CoarseRuns, registration: Registration, settings: Settings, notes: Notes) -> CoarseFields:
        keep = with_inputs(coarse, registration, notes)
        runs = LevelRuns(coarse.campaign, 0, settings, notes)
        return cls(coarse, registration, keep, _Once(runs, len(coarse.campaign.parameters)))

    @property
    def inputs(self) -> NDArray[np.float64]:
        """(run and image, input)"""
        return self.registration.read_with_images(self.coarse.campaign.parameters[self.keep])

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
        for done, run in enumerate(self.keep, 1):
            _log.info("latent numbers of coarse run %d of %d", done, len(self.keep))
            seen = self.runs.read(int(run))
            for k, (rows, courses) in enumerate(zip(maps, out, strict=True)):
                states = lift(rows, seen)
                if k and mirror is not None:
                    states = states @ mirror.reflection.T.astype(np.float32)
                courses.append(encode(self.registration.on_grid(states, self.coarse.campaign.parameters[run], time)))
        return np.stack([course for courses in out for course in courses])
