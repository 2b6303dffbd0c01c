"""The training loop: one objective, one optimiser, epochs until done; best weights kept, every epoch told.

Nothing in the loop asks the device for a number: losses add up where they are computed and are read once an epoch. The
order of samples in an epoch follows from seed and epoch alone, so a resumed training goes on as if nothing happened.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from data_schema.memory import give_back
from surrogates.devices import check_device_name
from surrogates.errors import SurrogateError
from surrogates.record import HISTORY, Fit
from surrogates.settings import LevelSettings
from surrogates.training.best import BestWeights
from surrogates.training.lean import LARGE, LeanAdam

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate


_log = logging.getLogger(__name__)


class Objective(nn.Module):
    """A network and the samples it is trained on; subclasses say what one batch costs.

    `forward(index)` gives the losses (2,) of training samples `index`: approximation and reconstruction, unweighted.
    """

    size: int

    @property
    def scale(self) -> float:
        """The unit of the states the losses are taken of, m."""
        return 1.0

    def validation(self) -> Tensor | None:
        """Losses (2,) over the validation samples; None where there are none."""
        raise NotImplementedError

    @property
    def in_place(self) -> bool:
        """Whether all that a step reads lies on the device of the networks, so that its calls can be recorded there."""
        return False

    def pieces(self, batch: int) -> int:
        """Into how many pieces a batch of so many samples is cut, one gradient after the other being added up."""
        return 1

    @property
    def staged(self) -> bool:
        """Whether gradients of a step shall come in `stages`, since all of them together are large."""
        return False

    def stages(self, indices: Tensor, weights: Tensor, pieces: int) -> Iterator[Tensor]:
        """Add up the gradients of the losses (2,) of a batch, weighted, one part of the network after the other.

        After each stage it gives the losses that are known since the last one; gradients that are there are complete then,
        and no later stage needs the weights they belong to.
        """
        raise NotImplementedError

    def networks(self) -> dict[str, nn.Module]:
        """What is trained, by name; their tensors are what best weights and checkpoints hold."""
        raise NotImplementedError


@dataclass(frozen=True)
class Epoch:
    """Progress report of one epoch.

    total, approximation, reconstruction, validation  losses: the weighted total, its unweighted parts, the total over
                                                      the validation runs (NaN without any)
    validation_error, best_error  root mean square distance of predicted and true nodes over the validation runs, m, in
                                  this epoch and in the best one; NaN without validation runs
    rate                          epochs per second
    """

    name: str
    epoch: int
    epochs: int
    total: float
    approximation: float
    reconstruction: float
    validation: float
    best_epoch: int
    learning_rate: float
    rate: float
    seconds_left: float
    validation_error: float = math.nan
    best_error: float = math.nan

    def note(self) -> str:
        """How good it is, in centimetres where there are validation runs."""
        if math.isnan(self.validation_error):
            return f"training loss {self.total:.2e}"
        best = f"best {100 * self.best_error:.2f}, epoch {self.best_epoch}"
        return f"validation {100 * self.validation_error:.2f} cm ({best})"


class Keeper(Protocol):
    """Where a training's state goes between epochs; see `surrogates.training.checkpoints`."""

    def load(self, name: str) -> tuple[Mapping[str, Tensor], dict[str, Any]] | None: ...

    def due(self, epoch: int) -> bool: ...

    def save(self, name: str, tensors: dict[str, Tensor], about: dict[str, Any]) -> None: ...


def fit(
    objective: Objective,
    settings: LevelSettings,
    *,
    name: str,
    seed: int,
    precision: str = "float32",
    report: Callable[[Epoch], None] | None = None,
    keeper: Keeper | None = None,
    captured: bool | None = None,
) -> Fit:
    """Train what `objective` holds and leave the weights of its best epoch in place.

    Samples that do not fill a batch are left out of an epoch, other ones each time. Under torchrun each process takes
    its share of every batch, so the losses are those of one process with the same `settings.batch`.

    On a CUDA device the step is recorded once and then sent as one CUDA graph (`CapturedStep`), which changes nothing in the
    result; `captured` says whether it is. None: where one process trains on states that lie on the device.

    Raises Diverged, with the best weights so far in place and the history on it, if a loss is not finite.
    KeyboardInterrupt ends the training early with status "interrupted" once an epoch is done.
    """
    device = next(objective.parameters()).device
    plan = _Plan(objective.size, settings, seed, device)
    trained = [p for p in objective.parameters() if p.requires_grad]
    optimiser = _optimiser(objective, settings, device)
    names = _names(objective)
    out = Fit()
    best = BestWeights(names)
    if keeper is not None and (stored := keeper.load(name)) is not None:
        _restore(stored, names, best, optimiser, trained, out)
        del stored
    weights = torch.tensor([settings.weight_approximation, settings.weight_reconstruction], device=device)
    cut = 1 if torch.distributed.is_initialized() else objective.pieces(plan.batch)
    step = _kind_of_step(objective, settings, precision, captured, device)(
        _distributed(objective), optimiser, weights, settings.clip, precision, cut
    )
    started, spent = time.perf_counter(), out.seconds
    try:
        for epoch in range(out.epochs, settings.epochs):
            if _enough(out, settings):
                break
            sums = torch.zeros(2, device=device)
            for indices, rate in plan.batches(epoch):
                sums += step(indices, rate)
            step.rest()
            measured = _measured(objective, sums / plan.steps, weights)
            out.seconds = spent + time.perf_counter() - started
            if not all(map(math.isfinite, measured.values())):
                out.status = "diverged"
                raise _diverged(name, epoch, out)
            for key, value in {**measured, "learning_rate": rate}.items():
                out.history.setdefault(key, []).append(value)
            judged = measured.get("validation_total", measured["total"])
            if judged < out.best:
                out.best, out.best_epoch = judged, epoch + 1
                best.keep()
            if report is not None and plan.rank == 0:
                report(_told(name, settings.epochs, out, objective.scale))
            if (
                keeper is not None
                and plan.rank == 0
                and (keeper.due(epoch + 1) or epoch + 1 == settings.epochs or _enough(out, settings))
            ):
                keeper.save(name, _tensors(names, best.tensors(), optimiser, trained), _about(out))
    except KeyboardInterrupt:
        if not best:
            raise
        out.status = "interrupted"
    finally:
        step.rest()
        best.restore()
    return out


def set_up(seed: int, precision: str) -> None:
    """Seed torch and choose the precision of matrix products."""
    torch.manual_seed(seed)
    torch.set_float32_matmul_precision("high" if precision in ("tf32", "bfloat16") else "highest")


def device_of(choice: str) -> torch.device:
    """The device called cpu, cuda, mps, or the best there is for auto; raises SurrogateError if it is not there."""
    there = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if choice == "auto":
        choice = next(k for k in ("cuda", "mps", "cpu") if there[k])
    check_device_name(choice)
    if not there[choice.split(":")[0]]:
        raise SurrogateError(
            f"device {choice!r} is not there; this machine has {', '.join(k for k in there if there[k])}"
        )
    if choice == "cuda" and torch.distributed.is_initialized():
        choice = f"cuda:{torch.distributed.get_rank() % torch.cuda.device_count()}"
    return torch.device(choice)


def learning_rates(settings: LevelSettings, steps: int) -> NDArray[np.float64]:
    """The rate of every step (steps,).

    one_cycle rises from a tenth over the first tenth of the steps and falls to a thousandth along a cosine (after
    Smith and Topin 2018); cosine only falls.
    """
    top = settings.learning_rate
    if settings.schedule == "constant":
        return np.full(steps, top)
    rise = max(1, steps // 10) if settings.schedule == "one_cycle" else 0
    up = np.linspace(0.1 * top, top, rise, endpoint=False)
    low = 1e-3 * top
    down = low + (top - low) * 0.5 * (1 + np.cos(np.pi * np.linspace(0, 1, max(steps - rise, 1))))
    return np.concatenate([up, down])[:steps]


def _enough(out: Fit, settings: LevelSettings) -> bool:
    """Whether the last `settings.patience` of the epochs brought nothing on runs that are left out."""
    if not settings.patience or "validation_total" not in out.history:
        return False
    return out.epochs - out.best_epoch >= math.ceil(settings.patience * settings.epochs)


class _Plan:
    """Which samples each step takes, and its learning rate."""

    def __init__(self, size: int, settings: LevelSettings, seed: int, device: torch.device) -> None:
        self.rank, self.processes = _rank_and_size()
        self.batch = min(settings.batch, size)
        if self.batch % self.processes:
            raise SurrogateError(
                f"a batch of {self.batch} samples cannot be shared by {self.processes} processes; choose a multiple"
            )
        self.size, self.seed, self.device = size, seed, device
        share = 1.0 if settings.states == "auto" else settings.states
        self.steps = max(1, int(share * size) // self.batch)
        self.rates = learning_rates(settings, self.steps * settings.epochs)

    def batches(self, epoch: int) -> Iterator[tuple[Tensor, float]]:
        generator = torch.Generator().manual_seed((self.seed << 24) + epoch)
        order = torch.randperm(self.size, generator=generator)[: self.steps * self.batch]
        share = self.batch // self.processes
        mine = order.view(self.steps, self.batch)[:, self.rank * share : (self.rank + 1) * share].to(self.device)
        for k in range(self.steps):
            yield mine[k], float(self.rates[epoch * self.steps + k])


class _Step:
    """One step of the optimiser; gives the losses (2,) of its batch, still on the device."""

    def __init__(
        self, objective: nn.Module, optimiser: torch.optim.Optimizer, weights: Tensor, clip: float, precision: str,
        pieces: int = 1,
    ) -> None:  # fmt: skip
        self.objective, self.optimiser, self.weights, self.clip = objective, optimiser, weights, clip
        self.half, self.pieces = precision == "bfloat16", pieces
        self.parameters = [p for group in optimiser.param_groups for p in group["params"]]

    def __call__(self, indices: Tensor, rate: float) -> Tensor:
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["factor"]
        return self.taken(indices)

    def taken(self, indices: Tensor) -> Tensor:
        """The step at the rates that are set."""
        self.optimiser.zero_grad(set_to_none=True)
        losses = torch.zeros_like(self.weights)
        for part in indices.tensor_split(self.pieces):
            with torch.autocast(indices.device.type, torch.bfloat16) if self.half else contextlib.nullcontext():
                of_part = self.objective(part) * (len(part) / len(indices))
            (of_part * self.weights).sum().backward()
            losses += of_part.detach()
        if self.clip:
            nn.utils.clip_grad_norm_(self.parameters, self.clip)
        self.optimiser.step()
        return losses

    def rest(self) -> None:
        """Give back what gradients take, until the next step makes them anew."""
        self.optimiser.zero_grad(set_to_none=True)


class StagedStep(_Step):
    """A step that moves the weights of one part of the network, and forgets their gradients, before the next part's.

    The results are those of a step that moves all weights together.
    """

    def taken(self, indices: Tensor) -> Tensor:
        losses = torch.zeros_like(self.weights)
        for of_stage in self.objective.stages(indices, self.weights, self.pieces):  # type: ignore[operator]
            losses += of_stage
            self.optimiser.step()
            self.optimiser.zero_grad(set_to_none=True)
        give_back()
        return losses


class CapturedStep(_Step):
    """A step whose calls are recorded once, as one CUDA graph, and then sent to the device together.

    What changes from step to step, the samples' numbers and the rates, lies in tensors that stay where they are. The
    first steps are taken one call at a time, as a capture wants it, and count as any others. Where there is no CUDA
    device, or its calls cannot be recorded, all steps are, through the same code. `benchmarks/gpu.py` measures what it is
    worth: small networks wait for single calls, six to eleven times as long as for what they compute.
    """

    _BEFORE = 3

    def __init__(
        self, objective: nn.Module, optimiser: torch.optim.Optimizer, weights: Tensor, clip: float, precision: str,
        pieces: int = 1,
    ) -> None:  # fmt: skip
        super().__init__(objective, optimiser, weights, clip, precision, pieces)
        self.device = weights.device
        self.cuda = self.device.type == "cuda"
        self.graph: torch.cuda.CUDAGraph | None = None
        self.index, self.losses = torch.empty(0, dtype=torch.int64), weights
        self.steps = 0
        for group in optimiser.param_groups:
            group["lr"] = torch.tensor(0.0, device=self.device)
            group["capturable"] = self.cuda

    def __call__(self, indices: Tensor, rate: float) -> Tensor:
        if not self.steps:
            self.index = indices.clone()
        self.steps += 1
        self.index.copy_(indices)
        for group in self.optimiser.param_groups:
            group["lr"].fill_(rate * group["factor"])
        if not self.cuda:
            return self.taken(self.index)
        if self.graph is None and self.steps <= self._BEFORE:
            side = torch.cuda.Stream(self.device)
            side.wait_stream(torch.cuda.current_stream(self.device))
            with torch.cuda.stream(side):
                losses = self.taken(self.index)
            torch.cuda.current_stream(self.device).wait_stream(side)
            return losses
        if self.graph is None:
            try:
                self.graph = self._recorded()
            except RuntimeError as error:
                # Recording moves no weight, so this step is still to be taken.
                _log.warning("the device takes the calls of a step one by one, which is slower (%s)", error)
                self.cuda = False
                return self.taken(self.index)
        self.graph.replay()
        return self.losses.clone()

    def _recorded(self) -> torch.cuda.CUDAGraph:
        """The calls of a step, none of them made yet."""
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self.losses = self.taken(self.index)
        return graph

    def rest(self) -> None:
        """Gradients belong to the graph."""


def _kind_of_step(
    objective: Objective, settings: LevelSettings, precision: str, captured: bool | None, device: torch.device
) -> type[_Step]:
    if torch.distributed.is_initialized():
        return _Step
    if captured is None:
        # AdamW was tried on a device; Adam goes the same way.
        captured = device.type == "cuda" and objective.in_place and settings.optimiser != "sgd"
    if captured:
        return CapturedStep
    # A limit on the gradient's norm needs all of it.
    return StagedStep if objective.staged and not settings.clip and precision != "bfloat16" else _Step


def _optimiser(objective: Objective, settings: LevelSettings, device: torch.device) -> torch.optim.Optimizer:
    """One group of parameters for each factor on the learning rate."""
    groups: dict[float, list[nn.Parameter]] = {}
    for name, parameter in objective.named_parameters():
        if parameter.requires_grad:
            factor = min(1.0, settings.rate_inputs / _inputs(name, parameter)) if settings.rate_inputs else 1.0
            groups.setdefault(factor, []).append(parameter)
    rate, decay = settings.learning_rate, settings.weight_decay
    given = [{"params": some, "factor": factor} for factor, some in groups.items()]
    fused = device.type in ("cpu", "cuda")
    numbers = sum(parameter.numel() for some in groups.values() for parameter in some)
    if device.type == "cpu" and 4 * numbers > LARGE and settings.optimiser != "sgd":
        return LeanAdam(given, rate, decay, decoupled=settings.optimiser == "adamw")
    if settings.optimiser == "adamw":
        return torch.optim.AdamW(given, lr=rate, weight_decay=decay, fused=fused)
    if settings.optimiser == "adam":
        return torch.optim.Adam(given, lr=rate, weight_decay=decay, fused=fused)
    return torch.optim.SGD(given, lr=rate, weight_decay=decay, momentum=0.9, fused=fused)


def _inputs(name: str, parameter: nn.Parameter) -> int:
    """Over how many numbers one output of a reduction's or upsampling's layer sums; 1 elsewhere."""
    if parameter.ndim != 2 or "regressor" in name:
        return 1
    return parameter.shape[0] if name.endswith("encode_matrix") else parameter.shape[1]


def _measured(objective: Objective, losses: Tensor, weights: Tensor) -> dict[str, float]:
    """Total, approximation, reconstruction of the training samples, and of the validation samples if there are any."""
    if torch.distributed.is_initialized():
        torch.distributed.all_reduce(losses)
        losses = losses / torch.distributed.get_world_size()
    with torch.no_grad():
        validation = objective.validation()
    parts = [losses] if validation is None else [losses, validation]
    numbers = torch.cat([torch.cat([(p * weights).sum()[None], p]) for p in parts]).tolist()
    return dict(zip(HISTORY, numbers, strict=False))


def _distributed(objective: Objective) -> nn.Module:
    if not torch.distributed.is_initialized():
        return objective
    from torch.nn.parallel import DistributedDataParallel

    return DistributedDataParallel(objective, broadcast_buffers=False)


def _rank_and_size() -> tuple[int, int]:
    if not torch.distributed.is_initialized():
        return 0, 1
    return torch.distributed.get_rank(), torch.distributed.get_world_size()


def _names(objective: Objective) -> dict[str, Tensor]:
    """The trained tensors by name, live."""
    return {
        f"{part}.{key}": value
        for part, network in objective.networks().items()
        for key, value in network.named_parameters()
        if value.requires_grad
    }


def _tensors(
    names: dict[str, Tensor], best: dict[str, Tensor], optimiser: torch.optim.Optimizer, trained: list[nn.Parameter]
) -> dict[str, Tensor]:
    """Everything a training needs to go on, flat."""
    out = {f"now.{k}": v.detach() for k, v in names.items()} | {f"best.{k}": v for k, v in best.items()}
    for number, parameter in enumerate(trained):
        for key, value in optimiser.state.get(parameter, {}).items():
            if isinstance(value, Tensor):
                out[f"optimiser.{number}.{key}"] = value.detach()
    return out


def _about(out: Fit) -> dict[str, Any]:
    return {"history": out.history, "best_epoch": out.best_epoch, "best": out.best, "seconds": out.seconds}


def _restore(
    stored: tuple[Mapping[str, Tensor], dict[str, Any]],
    names: dict[str, Tensor],
    best: BestWeights,
    optimiser: torch.optim.Optimizer,
    trained: list[nn.Parameter],
    out: Fit,
) -> None:
    """Put a stored training back in place."""
    tensors, about = stored
    with torch.no_grad():
        for key, value in names.items():
            value.copy_(tensors[f"now.{key}"])
    for number, parameter in enumerate(trained):
        prefix = f"optimiser.{number}."
        own = [key for key in tensors if key.startswith(prefix)]
        if own:
            optimiser.state[parameter] = {
                key.removeprefix(prefix): tensors[key].clone().to(parameter.device) for key in own
            }
    out.history, out.best_epoch = about["history"], about["best_epoch"]
    out.best, out.seconds = about["best"], about["seconds"]
    if all(f"best.{k}" in tensors for k in names):
        best.keep(lambda name: tensors[f"best.{name}"])


def _told(name: str, epochs: int, out: Fit, scale: float) -> Epoch:
    losses = out.history.get("validation_approximation", [math.nan] * out.epochs)
    distance, best = (scale * math.sqrt(3.0 * loss) for loss in (losses[-1], losses[out.best_epoch - 1]))
    last = {key: values[-1] for key, values in out.history.items()}
    done = out.epochs
    return Epoch(
        name, done, epochs, last["total"], last["approximation"], last["reconstruction"],
        last.get("validation_total", math.nan),
        out.best_epoch, last["learning_rate"], done / out.seconds, out.seconds / done * (epochs - done),
        distance, best,
    )  # fmt: skip


def _diverged(name: str, epoch: int, out: Fit) -> Diverged:
    kept = f"the weights of epoch {out.best_epoch} are kept" if out.best_epoch else "no epoch ended well"
    error = Diverged(
        f"{name}: the loss is not finite in epoch {epoch + 1}; {kept}. Lower level.learning_rate, or set level.clip=1"
    )
    error.fit = out
    return error


class Diverged(SurrogateError):
    """A loss became NaN or infinite; names the model, level and epoch. The last good weights are kept.

    fit        how the training went until then
    surrogate  what can be used: the finished levels, and this one with its best weights; None without any
    """

    fit: Fit | None = None
    surrogate: Surrogate | None = None
