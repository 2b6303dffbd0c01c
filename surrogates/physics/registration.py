"""Registration of a whole campaign: put on a reference's clock and size, doubled by images, with derived inputs.

It is a change of variables that any model can be trained behind, like taking rigid motion out: learn on the registered
campaign, and bring predictions back to the query's own clock and size. Clock, symmetry and inputs each have an identity,
where they do not pay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign, RunByRun
from surrogates.data.samples import LevelRuns, Notes, ValidationSplit
from surrogates.data.shelf import Shelf
from surrogates.physics.clock import Clock, between
from surrogates.physics.derived import DerivedInputs
from surrogates.physics.symmetry import Symmetry
from surrogates.settings import Settings

# Registered name of the input that says whether a run is mirrored.
SIDE = "mirrored"


@dataclass(frozen=True)
class Registration:
    """How a campaign is registered.

    Attributes
    ----------
    inputs, clock, symmetry
        See `surrogates.physics`.
    grid
        (state,) s, the reference's times on which registered runs are given.
    reach
        s, how far courses count in a process's likelihood: to the reference's own end, or all along. Beyond that
        end most courses are their last slope going on.
    """

    inputs: DerivedInputs
    clock: Clock
    symmetry: Symmetry
    grid: NDArray[np.float64]
    reach: float = np.inf

    @classmethod
    def identity(cls, names: tuple[str, ...], time: NDArray[np.float64]) -> Registration:
        """The campaign as it is."""
        return cls(DerivedInputs.identity(names), Clock.identity(len(names)), Symmetry(), np.asarray(time, np.float64))

    @property
    def is_identity(self) -> bool:
        return self.inputs.is_identity and self.clock.is_identity and self.symmetry.is_identity

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs of a model behind it."""
        return (*self.inputs.told(), *((SIDE,) if self.symmetry.flagged else ()))

    def apply(self, campaign: Campaign, settings: Settings, notes: Notes) -> Campaign:
        """The registered campaign: its runs, then their images in the same order.

        Fields are read run by run as before. `known` says how far each run was computed: states beyond are its last
        slope going on, and belong in no loss and no error.
        """
        if self.is_identity:
            return campaign
        runs = campaign.parameters
        images = self.symmetry.images(runs, campaign.parameter_names)
        doubled = runs if self.symmetry.is_identity else np.concatenate([runs, images])
        names = campaign.runs or tuple(str(k) for k in range(len(runs)))
        told = self.input_names
        return replace(
            campaign,
            parameters=self._inputs(doubled, len(runs)),
            parameter_names=told,
            parameter_units=("1",) * len(told),
            time=self.grid,
            displacement=_RegisteredFields(self, campaign, settings, notes),
            runs=names if self.symmetry.is_identity else (*names, *(f"{name} {SIDE}" for name in names)),
            dimensions=(),
            mirrors=(),
            known=self.clock.known(doubled, campaign.time, self.grid),
        )

    def split(self, split: ValidationSplit, runs: int) -> ValidationSplit:
        """Places in the registered campaign: images train with their runs, and never choose."""
        if self.symmetry.is_identity:
            return split
        return replace(split, training=np.concatenate([split.training, split.training + runs]))

    def read(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inputs (run, input) of a model for parameters (run, parameter) of runs as computed."""
        return self._inputs(np.atleast_2d(parameters), len(np.atleast_2d(parameters)))

    def read_with_images(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run and image, input) for parameters (run, parameter): runs as computed, then their images in the same order."""
        own = self.read(parameters)
        if self.symmetry.is_identity:
            return own
        images = self.read(self.symmetry.images(parameters, self.inputs.names))
        if self.symmetry.flagged:
            images[:, -1] = 1.0
        return np.concatenate([own, images])

    def on_grid(self, states: NDArray[Any], parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[Any]:
        """States (state, ..) at `time` of a run with parameters (parameter,), registered, at the states of the grid.

        Unlike runs that are learnt, it may have other times where the clock is each run's own.
        """
        if self.clock.is_identity:
            return between(states, time, self.grid)
        return self.clock.apply(states, parameters, time, self.grid)

    def undo(
        self,
        model: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[Any]],
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
    ) -> NDArray[Any]:
        """What the `model` behind it, (run, input) and (state,) -> (run, state, ..), says of runs at their own times.

        The arrays that the model gives are scaled in place.

        Parameters
        ----------
        parameters
            (run, parameter); time (state,), s.
        """
        inputs = self.read(parameters)
        if self.clock.is_identity:
            return model(inputs, time)
        sizes = self.clock.size(parameters)
        out = []
        for k in range(len(parameters)):
            states = model(inputs[k : k + 1], self.clock.times(parameters[k], time))
            states *= np.asarray(sizes[k], states.dtype)  # in place: a run of the full mesh is not held twice
            out.append(states)
        return out[0] if len(out) == 1 else np.concatenate(out)

    def _inputs(self, parameters: NDArray[np.float64], computed: int) -> NDArray[np.float64]:
        out = self.inputs.apply(parameters)
        if not self.symmetry.flagged:
            return out
        side = (np.arange(len(parameters)) >= computed).astype(np.float64)
        return np.concatenate([out, side[:, None]], axis=1)

    def told(self) -> dict[str, str]:
        """What was chosen, for people."""
        return {
            "inputs": ", ".join(self.input_names) + (" (full matrix of lengths)" if self.inputs.mixed else ""),
            "clock": self.clock.told(self.inputs.names),
            "symmetry": self.symmetry.told(),
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "inputs": self.inputs.as_dict(),
            "clock": self.clock.as_dict(),
            "symmetry": self.symmetry.as_dict(),
            "grid": self.grid.tolist(),
            "reach": self.reach if np.isfinite(self.reach) else None,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Registration:
        """The way back; enough to predict, not to register a campaign anew."""
        return cls(
            DerivedInputs.from_dict(values["inputs"]),
            Clock.from_dict(values["clock"]),
            Symmetry.from_dict(values["symmetry"]),
            np.array(values["grid"], np.float64),
            np.inf if values["reach"] is None else float(values["reach"]),
        )


class _RegisteredFields:
    """The displacements of every level, registered: (run and image, state of the grid, node of a level, 3), m.

    A coarser level's nodes are nodes of level 1, and what is asked of that is kept: to make an image, the run is read
    on the full mesh, since mirrored nodes of a level lie between nodes the level lacks.
    """

    def __init__(self, registration: Registration, campaign: Campaign, settings: Settings, notes: Notes) -> None:
        self._of, self._campaign, self._settings, self._notes = registration, campaign, settings, notes
        self._levels: dict[int, _RegisteredField] = {}

    def __call__(self, level: int) -> RunByRun:
        if level > 1:
            return _Some(self(1), np.searchsorted(self._campaign.levels[0].kept, self._campaign.levels[level - 1].kept))
        if level not in self._levels:
            own = LevelRuns(self._campaign, level, self._settings, self._notes)
            mirrors = not self._of.symmetry.is_identity
            full = LevelRuns(self._campaign, 0, self._settings, self._notes) if mirrors and level else own
            kept = self._campaign.levels[level - 1].kept if level else None
            self._levels[level] = _RegisteredField(self._of, self._campaign, own, full, kept, keep=level == 1)
        return self._levels[level]


@dataclass(frozen=True)
class _Some:
    """Some `places` among the nodes of a `field`, run by run."""

    field: RunByRun
    places: NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, ...]:
        return (*self.field.shape[:2], len(self.places), 3)

    def __getitem__(self, run: int, /) -> NDArray[np.float32]:
        return np.take(self.field[run], self.places, axis=1)


class _RegisteredField:
    """Displacements of one level, run by run, from those of the level and, for images, of the full mesh."""

    def __init__(
        self, registration: Registration, campaign: Campaign, own: LevelRuns, full: LevelRuns,
        kept: NDArray[np.int64] | None, *, keep: bool,
    ) -> None:  # fmt: skip
        self._of, self._campaign, self._own, self._full, self._kept = registration, campaign, own, full, kept
        self._count = len(campaign.parameters)
        count = self._count * (1 if registration.symmetry.is_identity else 2)
        self.shape = (count, len(registration.grid), own.nodes, 3)
        self._shelf = Shelf(count, self.shape[1:]) if keep else None
        self._there = np.zeros(count, bool)

    def __getitem__(self, run: int, /) -> NDArray[np.float32]:
        if self._shelf is None:
            return self._made(run)
        if not self._there[run]:
            self._shelf.put(run, self._made(run)[None])
            self._there[run] = True
        return self._shelf.take(np.array([run])).reshape(self.shape[1:])

    def _made(self, run: int) -> NDArray[np.float32]:
        of, parameters, own = self._of, self._campaign.parameters, run % self._count
        states = self._own.read(run) if run == own else of.symmetry.apply(self._full.read(own), self._kept)
        return np.asarray(of.clock.apply(states, parameters[own], self._campaign.time, of.grid), np.float32)
