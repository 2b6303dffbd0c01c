"""A fitted surrogate: one object whatever is inside, asked for displacements at any of its levels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from data_schema.levels import lift
from surrogates.data.campaign import Labels
from surrogates.data.graphs import Graphs
from surrogates.data.inputs import over_range
from surrogates.errors import SurrogateError
from surrogates.local_errors import HARD, LocalErrors
from surrogates.models.coarse_base import CoarseMesh
from surrogates.models.curves import Curve
from surrogates.models.element_field import ElementField, faces_to_level
from surrogates.models.pod_regression import PodRegression, from_coarse_run
from surrogates.models.removal import Removal
from surrogates.physics.clock import between
from surrogates.physics.registration import Registration
from surrogates.record import Fit, Record
from surrogates.settings import Settings
from surrogates.uncertainty import Band, Beliefs

if TYPE_CHECKING:
    from torch import Tensor

    from surrogates.models.base import Network

# Samples predicted at once, and how many nodes they may have together.
_CHUNK, _AT_ONCE = 512, 1 << 21


def _chunk(n_nodes: int) -> int:
    return max(1, min(_CHUNK, _AT_ONCE // n_nodes))


_NAMES = {"podnn": "PODNN", "aenn": "AENN", "gaenn": "GAENN", "pod-gpr": "POD-GPR", "pod-rbf": "POD-RBF"}


def level_name(settings: Settings, number: int) -> str:
    """What tables call the level: MH1, MH2, .. or the baseline's name."""
    return _NAMES.get(settings.model, f"MH{number}")


class Surrogate:
    """A fitted surrogate.

    Attributes
    ----------
    settings, record
        What it was asked to be, and what became of it.
    graphs
        The levels it knows; with them predictions are lifted to the full mesh without the data.
    points, faces
        The full mesh (node, 3), m, and (face, corner), where the training data told them.
    curves
        Time histories that were learnt beside the displacements, by channel.
    labels
        The solver's numbers and names on it, where the training data told them.
    removal
        How likely elements are gone; None where none was ever removed.
    fields
        Results on elements that were learnt beside the displacements, by name.
    run_bands
        As `bands`, of predictions that start from a coarse run of the query.
    mesh_below
        The mesh of the coarse runs beneath a network's levels; None without any.
    """

    def __init__(
        self,
        settings: Settings,
        record: Record,
        graphs: Graphs,
        core: Network | PodRegression,
        points: NDArray[np.float64] | None = None,
        faces: NDArray[np.int32] | None = None,
        registration: Registration | None = None,
    ) -> None:
        self.settings, self.record, self.graphs, self.core = settings, record, graphs, core
        self.points, self.faces = points, faces
        self.labels: Labels | None = None
        self.registration = registration or Registration.identity(record.ranges.names, record.time)
        self.bands: dict[tuple[int, bool], Band] = {}
        self.run_bands: dict[tuple[int, bool], Band] = {}
        self.mesh_below: CoarseMesh | None = None
        self.removal: Removal | None = None
        self.fields: dict[str, ElementField] = {}
        self.curves: dict[str, Curve] = {}
        self._upward: dict[int, sparse.csr_matrix] = {}

    def use_graphs(self, graphs: Graphs) -> None:
        """Take over other maps of the same levels to the full mesh."""
        self.graphs, self._upward = graphs, {}

    def untrained(self) -> Surrogate:
        """Another one for the same data, behind the same registration, with nothing trained yet."""
        from surrogates.models.cascade import Cascade

        if isinstance(self.core, PodRegression):
            raise SurrogateError("what is trained for each seed is a network")
        core, record = Cascade(self.core.inputs), replace(self.record, fits={}, errors={}, choice={})
        return Surrogate(self.settings, record, self.graphs, core, self.points, self.faces, self.registration)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of the trainings it is the mean of, or of its only one."""
        return getattr(self.core, "seeds", (self.record.seed,))

    @property
    def level_names(self) -> dict[str, int]:
        """Name of each level it answers on -> mesh level, coarsest first, such as {"MH3": 3, "MH2": 2, "MH1": 1}."""
        return {level_name(self.settings, k): k for k in self.core.numbers}

    def predict(
        self, parameters: ArrayLike, time: ArrayLike | None = None, level: int | None = None
    ) -> NDArray[np.float32]:
        """Displacements, m, on the nodes of `level` (default: the finest one it has).

        Parameters
        ----------
        parameters
            (p,) -> (state, node, 3), or (batch, p) -> (batch, state, node, 3), in the units it was trained with.
        time
            (state,) s, any times; default: those it was trained on.

        Raises
        ------
        SurrogateError
            For a level it does not have, or parameters of the wrong number or not finite.
        """
        number = self.number(level)
        values, times = self.checked(parameters, time)
        out = self.registration.undo(lambda x, t: self._registered(x, t, number), values, times)
        return out[0] if np.ndim(parameters) == 1 else out

    def predict_full(
        self, parameters: ArrayLike, time: ArrayLike | None = None, level: int | None = None
    ) -> NDArray[np.float32]:
        """`predict` lifted to the full mesh by the level's static U."""
        number = self.number(level)
        values, times = self.checked(parameters, time)
        if number == 0 or isinstance(self.core, PodRegression):
            return self.lift(self.predict(parameters, times, number), number)
        out = self.registration.undo(
            lambda x, t: self.by_network(x, t, number, lambda states: self._lifted(states, number)), values, times
        )
        return out[0] if np.ndim(parameters) == 1 else out

    @property
    def coarse_mesh(self) -> CoarseMesh | None:
        """The mesh of the coarse runs that a prediction can start from; None where the model takes nothing from any."""
        if isinstance(self.core, PodRegression):
            return None if self.core.base is None else self.core.base.mesh
        core = self.core
        return self.mesh_below if any(core.takes_coarse(k) for k in core.numbers) else None

    def takes_coarse(self, level: int | None = None) -> bool:
        """Whether predictions on `level` can start from a coarse run."""
        if self.coarse_mesh is None:
            return False
        return isinstance(self.core, PodRegression) or self.core.takes_coarse(self.number(level))

    def check_takes_coarse(self, level: int | None = None) -> None:
        """Raise SurrogateError unless predictions on `level` can start from a coarse run, with the reason."""
        if self.takes_coarse(level):
            return
        if self.coarse_mesh is None:
            why = "those it was trained with did not pay" if self.record.coarse else "train mh or pod-gpr with --coarse"
            raise SurrogateError(f"the model takes nothing from coarse runs: {why}")
        taking = ", ".join(f"{name} (--level {k})" for name, k in self.level_names.items() if self.takes_coarse(k))
        name = level_name(self.settings, self.number(level))
        raise SurrogateError(
            f"{name} takes nothing from coarse runs: those it was trained with did not pay there; ask for {taking}"
        )

    def predict_from_coarse(
        self,
        parameters: ArrayLike,
        states: NDArray[np.float32],
        states_time: NDArray[np.float64],
        time: ArrayLike | None = None,
        level: int | None = None,
        *,
        full: bool = False,
    ) -> NDArray[np.float32]:
        """`predict` of one run from a run of the same parameters on the coarse mesh: (state, node of `level`, 3), m.

        Parameters
        ----------
        states
            (state, coarse node, 3), m, in the order of the coarse runs the model was trained with, at `states_time`, s.
        full
            Lifted to the full mesh, as by `predict_full`.

        Raises
        ------
        SurrogateError
            For a model or level without coarse runs, and as `predict`.
        """
        core, mesh, number = self.core, self.coarse_mesh, self.number(level)
        values, times = self.checked(parameters, time)
        self.check_takes_coarse(number)
        if len(values) != 1:
            raise SurrogateError(f"one coarse run was given for parameters of {len(values)} runs")
        if isinstance(core, PodRegression):
            return from_coarse_run(core, self.registration, values, states, states_time, times)
        assert mesh is not None
        kept = self.graphs.kept(number)
        on_level = lift(mesh.to_fine[kept].astype(np.float32), np.asarray(states, np.float32))
        z = self.encode(self.registration.on_grid(on_level, values[0], states_time), number)
        out: NDArray[np.float32] = self.registration.undo(
            lambda x, t: self._from_latents(x, t, number, z), values, times
        )[0]
        return self.lift(out, number) if full else out

    def _from_latents(
        self, inputs: NDArray[np.float64], time: NDArray[np.float64], number: int, z: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """(1, state, node, 3) of registered inputs (1, input) and times, from a coarse run's course (state of the grid, latent)."""
        import torch

        core, some = self.core, _chunk(self.graphs.n_nodes(number))
        assert not isinstance(core, PodRegression)
        grid = self.record.time if self.registration.is_identity else self.registration.grid
        at = torch.from_numpy(np.repeat(inputs, len(time), axis=0))
        given = (at, torch.from_numpy(time), torch.from_numpy(between(z, grid, time)))
        with torch.no_grad():
            parts = [
                core.from_coarse(a, t, number, seen).transpose(0, 1)
                for a, t, seen in zip(*(of.split(some) for of in given), strict=True)
            ]
        return np.ascontiguousarray(torch.cat(parts).numpy())[None]

    def predict_nodes(
        self, parameters: ArrayLike, nodes: NDArray[np.int64], time: ArrayLike | None = None, level: int | None = None
    ) -> NDArray[np.float32]:
        """`predict_full` of several runs on some nodes of the full mesh: (run, state, some nodes, 3), m."""
        number = self.number(level)
        values, times = self.checked(parameters, time)
        core = self.core
        if isinstance(core, PodRegression):
            return self.registration.undo(lambda x, t: core.displacement(x, t, number, nodes), values, times)
        return np.asarray(self.predict_full(values, times, number)[:, :, nodes])

    def predict_curve(self, name: str, parameters: ArrayLike) -> NDArray[np.float64]:
        """A channel of the histories: (sample,), or (batch, sample), in its unit at the times of `curves[name]`.

        Raises
        ------
        SurrogateError
            For a channel that was no target of the training.
        """
        if name not in self.curves:
            has = ", ".join(self.curves) or "none"
            raise SurrogateError(
                f"{name} was not learnt, of histories there is {has}; train with --targets history:{name}"
            )
        values, _ = self.checked(parameters, None)
        out = self.curves[name].predict(self.registration, values)
        return np.asarray(out[0] if np.ndim(parameters) == 1 else out)

    def lift(
        self, states: NDArray[np.float32], level: int, to_full: sparse.csr_matrix | None = None
    ) -> NDArray[np.float32]:
        """(..., node of `level`, 3) -> (..., node of the full mesh, 3); `to_full` replaces the model's own map."""
        if level == 0:
            return states
        import torch

        flat = torch.from_numpy(np.asarray(states, np.float32).reshape(-1, *states.shape[-2:]))
        if to_full is None:
            rows = self._lifted(flat.transpose(0, 1), level).numpy()
        else:
            rows = np.asarray(lift(to_full, flat.numpy()))
        return rows.reshape(*states.shape[:-2], -1, 3)

    def _lifted(self, states: Tensor, level: int) -> Tensor:
        """(node of `level`, b, 3) -> (b, node of the full mesh, 3), a view: transposing it costs more than lifting."""
        import torch

        if level not in self._upward:
            self._upward[level] = self.graphs.to_full(level).astype(np.float32)
        return torch.from_numpy(lift(self._upward[level], states.transpose(0, 1).numpy()))

    def predict_removal(self, parameters: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float32]:
        """Probability that an element of the full mesh is gone: (state, face), or (batch, state, face), as `predict`.

        Raises
        ------
        SurrogateError
            Where the model was trained on runs that lose no element.
        """
        if self.removal is None or self.faces is None:
            raise SurrogateError("the model says nothing of removed elements: its training runs lost none")
        values, times = self.checked(parameters, time)
        out = self.removal.probability(self.registration, values, times, len(self.faces))
        return out[0] if np.ndim(parameters) == 1 else out

    def predict_field(
        self, name: str, parameters: ArrayLike, time: ArrayLike | None = None, level: int = 0
    ) -> NDArray[np.float32]:
        """A result on the elements of `level`: (state, face), or (batch, state, face), as `predict`.

        On a coarse level, each face has the mean of the elements that lie nearest to it.

        Raises
        ------
        SurrogateError
            For a name that was no target of the training.
        """
        if name not in self.fields:
            has = ", ".join(self.fields) or "none"
            raise SurrogateError(f"{name} was not learnt, of results on elements there is {has}; train with --targets")
        values, times = self.checked(parameters, time)
        out = self.fields[name].predict(self.registration, values, times)
        if level:
            out = self.on_level(out, level)
        return out[0] if np.ndim(parameters) == 1 else out

    def on_level(self, values: NDArray[np.float32], level: int) -> NDArray[np.float32]:
        """(..., face of the full mesh) -> (..., face of `level`)"""
        if self.points is None or self.faces is None:
            raise SurrogateError("the model was stored without its mesh; train it again from a dataset")
        part = None if self.labels is None else self.labels.face_part
        to_level = faces_to_level(self.points, self.faces, self.graphs[level], part)
        return np.asarray(
            (to_level @ values.reshape(-1, values.shape[-1]).T).T.reshape(*values.shape[:-1], -1), np.float32
        )

    def reconstruct(self, states: ArrayLike, level: int | None = None) -> NDArray[np.float32]:
        """Encode and decode displacements (state, node of `level`, 3), m: what the reduction alone costs."""
        number = self.number(level)
        x = self._states(states, number)
        if isinstance(self.core, PodRegression):
            return self.core.reconstruct(x, number)
        import torch

        x = np.require(x, requirements="W")  # torch warns of arrays that may not be written to

        core = self.core
        with torch.no_grad():
            parts = [
                core.reconstruct(part.transpose(0, 1), number) for part in torch.from_numpy(x).split(_chunk(x.shape[1]))
            ]
        return torch.cat([part.transpose(0, 1) for part in parts]).contiguous().numpy()

    def encode(self, states: ArrayLike, level: int | None = None) -> NDArray[np.float32]:
        """Displacements (state, node of `level`, 3), m -> latent vectors (state, latent)."""
        number = self.number(level)
        x = self._states(states, number)
        if isinstance(self.core, PodRegression):
            return self.core.encode(x)
        import torch

        x = np.require(x, requirements="W")
        core = self.core
        with torch.no_grad():
            parts = [
                core.encode_metres(part.transpose(0, 1), number)
                for part in torch.from_numpy(x).split(_chunk(x.shape[1]))
            ]
        return torch.cat(parts).numpy()

    def _states(self, states: ArrayLike, number: int) -> NDArray[np.float32]:
        x = np.asarray(states, np.float32)
        nodes = self.graphs.n_nodes(number)
        if x.ndim != 3 or x.shape[1:] != (nodes, 3):
            raise SurrogateError(f"states have the shape {x.shape}; expected (state, {nodes} nodes, 3)")
        return x

    def has_band(self, level: int | None = None) -> bool:
        """Whether there were runs enough for `band` on the full mesh."""
        number = self.number(level)
        return (number, number > 0) in self.bands

    def band(
        self,
        coverage: float = 0.9,
        time: ArrayLike | None = None,
        level: int | None = None,
        *,
        full: bool = False,
        parameters: ArrayLike | None = None,
        from_coarse: bool = False,
    ) -> NDArray[np.float32]:
        """How far, m, the true node may lie from the predicted one: (state, node of `level` or of the full mesh).

        The share `coverage` of nodes and states of a new run lies within it, as far as the runs tell that were left
        out; see `surrogates.uncertainty`. With `parameters` (parameter,) it is the band of that run, wider where the
        model itself knows less; without, that of a typical run. With `from_coarse` it is that of `predict_from_coarse`.

        Raises
        ------
        SurrogateError
            Where there were too few runs.
        """
        number = self.number(level)
        found = (self.run_bands if from_coarse else self.bands).get((number, full and number > 0))
        if found is None:
            raise SurrogateError(
                f"there is no band for {level_name(self.settings, number)}: too few runs to judge it by; see the model card"
            )
        times = self.record.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
        if parameters is None:
            return found.half_width(coverage, times)
        values, times = self.checked(parameters, times)
        return found.half_width(coverage, times, self.beliefs(values))

    def beliefs(self, parameters: NDArray[np.float64]) -> Beliefs:
        """What the model says of runs (run, parameter) before they are computed: their size, and its own deviation."""
        core = self.core
        said = self._apart(parameters)
        if isinstance(core, PodRegression):
            said = core.deviation(self.registration.read(parameters))
        deviation = np.ones(len(parameters)) if said is None else said
        return Beliefs(self.registration.clock.size(parameters), deviation, *self.places(parameters))

    def _apart(self, parameters: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(run,) m: how far the trainings behind it lie apart, for a run of size 1; None for a single one."""
        from surrogates.models.average import Average, some_states, spread_of

        core = self.core
        if not isinstance(core, Average):
            return None
        number, time = max(core.numbers), self.record.time[some_states(len(self.record.time))]
        said = [
            self.registration.undo(lambda x, t, n=one: self.by_network(x, t, number, network=n), parameters, time)  # type: ignore[misc]
            for one in core.networks
        ]
        spread = np.array([spread_of([one[run] for one in said]) for run in range(len(parameters))])
        return core.deviation(spread / self.registration.clock.size(parameters))

    def places(self, parameters: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Where runs (run, parameter) lie in the trained range, in [-1, 1], and where their mirror images do."""
        ranges, symmetry = self.record.ranges, self.registration.symmetry
        corners = np.stack([ranges.low, ranges.high])
        images = None if symmetry.is_identity else over_range(symmetry.images(parameters, ranges.names), corners)
        return over_range(parameters, corners), images

    def local_errors(self) -> LocalErrors | None:
        """Where left-out runs were predicted worse than the model expected; None where too few runs say it."""
        record = self.record
        if not record.left_out or len(record.parameters) != len(record.ranges.names):
            return None
        places = [record.fitted_runs.index(name) for name in record.left_out]
        runs = np.array([record.parameters[n] for n in record.ranges.names], np.float64).T[places]
        errors, deviations = np.array(list(record.left_out.values()), np.float64).T
        beliefs = Beliefs(self.registration.clock.size(runs), deviations, *self.places(runs))
        return beliefs.local(errors, np.arange(len(runs)))

    def hard_runs(self) -> dict[str, tuple[float, float]]:
        """Runs at places where others, too, were predicted badly when left out: e2, m, and times the typical error."""
        local = self.local_errors()
        if local is None:
            return {}
        around = local.at(local.points, local.run)
        out = {}
        for place in np.argsort(-local.ratio, kind="stable"):
            name = tuple(self.record.left_out)[int(local.run[place])]
            if min(local.ratio[place], around[place]) >= HARD and name not in out:
                out[name] = (self.record.left_out[name][0], float(local.ratio[place]))
        return out

    def hard(self, parameters: ArrayLike) -> list[str]:
        """One sentence for each place where runs near the queries (query, parameter) were predicted badly without them."""
        local = self.local_errors()
        if local is None:
            return []
        values, _ = self.checked(parameters, None)
        points, _ = self.places(values)
        names = np.array(list(self.record.left_out))
        out: dict[str, float] = {}
        for point, times in zip(points, local.at(points), strict=True):
            found = local.hard_runs(point)
            if times >= HARD and len(found):
                named = [(name, self.record.left_out[name][0]) for name in names[found[:3]]]
                said = ", ".join(f"{name} ({100 * error:.2g} cm)" for name, error in named)
                out[said] = max(times, out.get(said, 0.0))
        return [
            f"near a fold: the model was wrong about {said} when left out; expect {times:.1f} times the typical error here, "
            "or compute a run"
            for said, times in out.items()
        ]

    def sensitivity(
        self,
        parameters: ArrayLike,
        time: ArrayLike | None = None,
        level: int | None = None,
        nodes: ArrayLike | None = None,
    ) -> NDArray[np.float32]:
        """Derivatives by the parameters (state, node, 3, parameter); see `surrogates.surrogate.sensitivity`."""
        return sensitivity(self, parameters, time, level, nodes)

    def outside(self, parameters: ArrayLike, time: ArrayLike | None = None) -> list[str]:
        """One sentence for each parameter, and the time, beyond the trained range; empty inside."""
        return self.record.ranges.outside(*self.checked(parameters, time))

    def n_parameters(self, level: int | None = None) -> int:
        """Numbers behind a prediction on `level`, those of the coarser levels it rests on included."""
        return self.core.n_parameters(self.number(level))

    def n_latent(self, level: int | None = None) -> int:
        """Length of the latent vector."""
        return self.core.latent(self.number(level))

    def history(self, level: int | None = None) -> Mapping[str, NDArray[np.float64]]:
        """Losses by epoch: "total", "approximation", "reconstruction", the same with "validation_", "learning_rate"."""
        kept = self.record.fits.get(self.number(level))
        return {} if kept is None else {k: np.asarray(v, np.float64) for k, v in kept.history.items() if v}

    def training(self, level: int | None = None) -> Fit | None:
        """The training behind `level`: its own, or that of all levels where they were trained together."""
        number = self.number(level)
        return self.record.fits.get(min(self.core.numbers) if self.settings.unified else number)

    def seconds_per_epoch(self, level: int | None = None) -> float:
        """As measured in training; NaN for models without epochs."""
        kept = self.training(level)
        return float("nan") if kept is None else kept.seconds_per_epoch

    def training_seconds(self, level: int | None = None) -> float:
        """Of `level` and the coarser ones it rests on, or of all levels where they were trained together."""
        number = self.number(level)
        return sum(kept.seconds for k, kept in self.record.fits.items() if k >= number or self.settings.unified)

    def _registered(self, inputs: NDArray[np.float64], time: NDArray[np.float64], number: int) -> NDArray[np.float32]:
        """What the core says of registered inputs (batch, input) at registered times: (batch, state, node, 3)."""
        if isinstance(self.core, PodRegression):
            return self.core.displacement(inputs, time, number)
        return self.by_network(inputs, time, number)

    def by_network(
        self,
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        number: int,
        end: Callable[[Tensor], Tensor] = lambda states: states.transpose(0, 1).contiguous(),
        network: Network | None = None,
    ) -> NDArray[np.float32]:
        """(batch, state, node, 3); `end` makes (b, node, 3) of states (node, b, 3); `network`: instead of its own."""
        import torch

        core, some = network or self.core, _chunk(self.graphs.n_nodes(number))
        at = torch.from_numpy(np.repeat(parameters, len(time), axis=0))
        when = torch.from_numpy(np.tile(time, len(parameters)))
        with torch.no_grad():
            parts = [
                end(core(a, t, number))  # type: ignore[operator]
                for a, t in zip(at.split(some), when.split(some), strict=True)
            ]
        out = (parts[0] if len(parts) == 1 else torch.cat(parts)).numpy()
        return out.reshape(len(parameters), len(time), *out.shape[1:])

    def number(self, level: int | None = None) -> int:
        """The mesh level meant by `level`, the finest for None; raises SurrogateError for one it does not have."""
        if not self.core.numbers:
            raise SurrogateError("the surrogate has no trained level")
        if level is None:
            return min(self.core.numbers)
        if level not in self.core.numbers:
            has = ", ".join(f"{n} ({k})" for n, k in self.level_names.items())
            raise SurrogateError(f"level {level} was asked for; this surrogate predicts on {has}")
        return level

    def checked(self, parameters: ArrayLike, time: ArrayLike | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Parameters as (batch, p) and times (state,); raises SurrogateError unless some, finite and of the right number."""
        values = np.atleast_2d(np.asarray(parameters, np.float64))
        names = self.record.ranges.names
        if values.ndim != 2 or values.shape[1] != len(names):
            raise SurrogateError(
                f"parameters have the shape {np.shape(parameters)}; expected ({len(names)},) or (batch, {len(names)}): {', '.join(names)}"
            )
        times = self.record.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
        if not len(values) or not len(times):
            raise SurrogateError(
                f"{len(values)} sets of parameters and {len(times)} times were asked for; expected at least one of each"
            )
        if not np.isfinite(values).all() or not np.isfinite(times).all():
            raise SurrogateError("parameters and times must be finite numbers; found NaN or infinity")
        return values, times


def sensitivity(
    surrogate: Surrogate,
    parameters: ArrayLike,
    time: ArrayLike | None = None,
    level: int | None = None,
    nodes: ArrayLike | None = None,
) -> NDArray[np.float32]:
    """Derivatives of displacements by the parameters, m per unit of the parameter: (state, node, 3, parameter).

    Networks are differentiated automatically, in forward mode; Gaussian processes, radial basis functions and whatever
    stands behind a registration by central differences over a thousandth of the trained range.

    Parameters
    ----------
    parameters
        (parameter,), time (state,) s and level as in `Surrogate.predict`.
    nodes
        Node numbers on the level; default: all.
    """
    number = surrogate.number(level)
    values, times = surrogate.checked(parameters, time)
    if len(values) != 1:
        raise SurrogateError(f"sensitivities are those of one run; found parameters of {len(values)}")
    chosen = slice(None) if nodes is None else np.atleast_1d(np.asarray(nodes))
    columns = []
    for k in range(values.shape[1]):
        core = surrogate.core
        moved = (
            _forward_mode(core, values[0], times, number, k)
            if not isinstance(core, PodRegression) and surrogate.registration.is_identity
            else _central(surrogate, values[0], times, number, k)
        )
        columns.append(moved[:, chosen])
    return np.stack(columns, axis=-1).astype(np.float32)


def _forward_mode(
    network: Network, values: NDArray[np.float64], times: NDArray[np.float64], number: int, k: int
) -> NDArray[np.floating]:
    import torch

    from surrogates.operators.convolutions import exportable

    at = torch.from_numpy(values).expand(len(times), -1)
    direction = torch.zeros_like(at)
    direction[:, k] = 1.0
    when = torch.from_numpy(times)

    def states(parameters: Tensor) -> Tensor:
        result: Tensor = network(parameters, when, number)
        return result

    with exportable(network), torch.no_grad():
        moved = torch.func.jvp(states, (at.contiguous(),), (direction,))[1]
    return np.asarray(moved.transpose(0, 1).numpy())


def _central(
    surrogate: Surrogate, values: NDArray[np.float64], times: NDArray[np.float64], number: int, k: int
) -> NDArray[np.floating]:
    ranges = surrogate.record.ranges
    step = 1e-3 * (ranges.high[k] - ranges.low[k])
    if step == 0:
        return np.zeros((len(times), surrogate.graphs.n_nodes(number), 3))
    there = np.repeat(values[None], 2, axis=0)
    there[:, k] += (-step, step)
    states = surrogate.predict(there, times, number).astype(np.float64)
    return np.asarray((states[1] - states[0]) / (2 * step))
