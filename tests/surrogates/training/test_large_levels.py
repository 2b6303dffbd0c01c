"""Levels of many nodes: steps in stages and Adam with less memory, made to happen on a small mesh."""

from __future__ import annotations

from typing import Any

import plate
import pytest
import torch
from torch import nn

from surrogates.models.level import LevelNetwork
from surrogates.operators import stacks
from surrogates.reductions.reduction import make_reduction
from surrogates.regression.network import Regressor
from surrogates.settings import LevelSettings, settings
from surrogates.training import lean, loop, objectives
from surrogates.training.lean import LeanAdam
from surrogates.training.loop import StagedStep, fit
from surrogates.training.objectives import LevelObjective, Samples

SETTINGS = settings("mh", "fast", None, ["level.latent=12", "level.batch=8", "level.epochs=4"]).level
SAMPLES = 16


def objective(*, alone: bool = False, at_rest: bool = False) -> LevelObjective:
    """A level of 81 nodes and states that it can learn."""
    torch.manual_seed(0)
    reduction = make_reduction(SETTINGS, plate.edges(9), 81)
    regressor = Regressor(4, 12, (8, 8), "gelu", coarse=0, residual=False, members=1)
    level = LevelNetwork(reduction, regressor, n_nodes=81, latent=12, time_column=3)
    level.at_rest = at_rest
    for matrix in (reduction.linear.encode_matrix, reduction.linear.decode_matrix):  # type: ignore[union-attr,operator]
        nn.init.normal_(matrix, std=0.1)  # type: ignore[arg-type]
    if alone:
        regressor.requires_grad_(False)
    states = torch.randn(SAMPLES, 4) @ torch.randn(4, 243)
    samples = Samples(states.view(SAMPLES, 3, 81), torch.rand(SAMPLES, 4))
    return LevelObjective(level, samples, None, reduction_alone=alone)


def trained(given: LevelObjective, changes: dict[str, Any] | None = None, **more: Any) -> list[float]:
    """The losses of a training."""
    own = SETTINGS.model_copy(update=changes or {})
    return fit(given, own, name="MH1", seed=0, **more).history["total"]


def weights(given: LevelObjective) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone() for name, tensor in given.level.named_parameters()}


CPU = torch.device("cpu")


def kind_of_step(given: LevelObjective, **changes: Any) -> type:
    return loop._kind_of_step(given, SETTINGS.model_copy(update=changes), "float32", None, CPU)


@pytest.fixture
def staged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objectives, "_LARGE", 0)
    monkeypatch.setattr(objectives, "_NODES_IN_TRAINING", 81 * 3)  # some pieces, not all of a length


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("at_rest", [False, True])
def test_stages_give_the_weights_of_whole_steps(monkeypatch: pytest.MonkeyPatch, alone: bool, at_rest: bool) -> None:
    monkeypatch.setattr(objectives, "_NODES_IN_TRAINING", 81 * 3)
    monkeypatch.setattr(objectives, "pieces", lambda batch, nodes: 3)
    whole = objective(alone=alone, at_rest=at_rest)
    losses = trained(whole)
    monkeypatch.setattr(objectives, "_LARGE", 0)
    parted = objective(alone=alone, at_rest=at_rest)
    assert kind_of_step(parted) is StagedStep
    assert trained(parted) == losses
    for name, tensor in weights(whole).items():
        assert torch.equal(weights(parted)[name], tensor), name


def test_gradients_added_in_place_are_those_of_the_formulas(staged: None, monkeypatch: pytest.MonkeyPatch) -> None:
    losses = trained(objective())
    monkeypatch.setattr(stacks, "WIDE_UP_TO", 0)  # the mesh counts as a large one
    added = []
    monkeypatch.setattr(stacks, "_add_product", lambda *given, do=stacks._add_product: (added.append(1), do(*given)))
    assert trained(objective()) == pytest.approx(losses, rel=1e-4)
    assert added


@pytest.mark.parametrize(
    ("changes", "precision"), [({"clip": 1.0}, "float32"), ({}, "bfloat16")], ids=["a limit", "mixed"]
)
def test_what_needs_all_gradients_is_not_in_stages(staged: None, changes: dict[str, Any], precision: str) -> None:
    own = SETTINGS.model_copy(update=changes)
    assert loop._kind_of_step(objective(), own, precision, None, CPU) is loop._Step


def test_small_levels_and_parts_that_may_share_weights_are_not_in_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    given = objective()
    assert not given.staged
    monkeypatch.setattr(objectives, "_LARGE", 0)
    assert given.staged
    monkeypatch.setattr(given.level.reduction, "remainder", nn.Linear(1, 1))
    assert not given.staged


def test_a_lean_training_goes_where_adamw_goes(staged: None, monkeypatch: pytest.MonkeyPatch) -> None:
    many = {"epochs": 15}
    losses = trained(objective(alone=True), many)
    monkeypatch.setattr(loop, "LARGE", 0)
    monkeypatch.setattr(lean, "_SMALL", 64)
    lean_losses = trained(objective(alone=True), many)
    assert lean_losses != losses
    assert losses[-1] < 0.5 * losses[0]
    assert lean_losses[-1] < 1.1 * losses[-1]


class Kept:
    """Holds what was stored last."""

    def __init__(self, every: int, given: Any = None) -> None:
        self.every, self.given = every, given

    def load(self, name: str) -> Any:
        return self.given

    def due(self, epoch: int) -> bool:
        return epoch == self.every

    def save(self, name: str, tensors: dict[str, torch.Tensor], about: dict[str, Any]) -> None:
        if about and len(about["history"]["total"]) == self.every:
            copied = {key: list(of) for key, of in about["history"].items()}
            self.given = ({k: v.clone() for k, v in tensors.items()}, {**about, "history": copied})


def test_a_resumed_lean_training_equals_an_uninterrupted_one(staged: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "LARGE", 0)
    monkeypatch.setattr(lean, "_SMALL", 64)
    kept = Kept(2)
    whole = objective()
    losses = trained(whole, keeper=kept)
    assert any(tensor.dtype == torch.bfloat16 for tensor in kept.given[0].values())
    resumed = objective()
    assert trained(resumed, keeper=Kept(0, kept.given)) == losses
    for name, tensor in weights(whole).items():
        assert torch.equal(weights(resumed)[name], tensor), name


@pytest.mark.parametrize("shape", [(40, 7), (7, 40)])
@pytest.mark.parametrize("decoupled", [True, False])
def test_where_squares_are_a_product_lean_adam_is_adam(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int], decoupled: bool
) -> None:
    monkeypatch.setattr(lean, "_SMALL", 64)
    monkeypatch.setattr(lean, "_BLOCK", 60)  # some blocks, the last one shorter
    torch.manual_seed(1)
    start, signs = torch.randn(shape), torch.randn(shape).sign()
    sizes = torch.outer(torch.rand(shape[0]) + 0.1, torch.rand(shape[1]) + 0.1)
    mine, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    decay = 0.1 if decoupled else 0.0
    ours = LeanAdam([mine], 0.01, decay, decoupled=decoupled)
    torchs = (torch.optim.AdamW if decoupled else torch.optim.Adam)([theirs], lr=0.01, weight_decay=decay)
    for step in range(12):
        mine.grad = theirs.grad = (step + 1) * signs * sizes
        ours.step()
        torchs.step()
    torch.testing.assert_close(mine, theirs, rtol=0, atol=0.01 * 12 * 2**-8)
    assert sum(t.numel() * t.element_size() for t in ours.state[mine].values()) < 3 * mine.numel()


@pytest.mark.parametrize("decoupled", [True, False])
def test_what_is_small_moves_as_adam_moves_it(decoupled: bool) -> None:
    torch.manual_seed(2)
    start = torch.randn(9)
    mine, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    ours = LeanAdam([mine], 0.01, 0.1, decoupled=decoupled)
    torchs = (torch.optim.AdamW if decoupled else torch.optim.Adam)([theirs], lr=0.01, weight_decay=0.1)
    for _ in range(5):
        mine.grad = torch.randn(9)
        theirs.grad = mine.grad.clone()
        ours.step()
        torchs.step()
    torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)


def test_a_gradient_of_zero_moves_nothing() -> None:
    weight = nn.Parameter(torch.randn(300, 300))
    before = weight.detach().clone()
    weight.grad = torch.zeros_like(weight)
    LeanAdam([weight], 0.01, 0.0, decoupled=True).step()
    assert torch.equal(weight, before)


def test_only_large_trainings_on_a_cpu_are_lean(monkeypatch: pytest.MonkeyPatch) -> None:
    given, own = objective(), LevelSettings()
    assert not isinstance(loop._optimiser(given, own, torch.device("cpu")), LeanAdam)
    monkeypatch.setattr(loop, "LARGE", 0)
    assert isinstance(loop._optimiser(given, own, torch.device("cpu")), LeanAdam)
    sgd = own.model_copy(update={"optimiser": "sgd"})
    assert isinstance(loop._optimiser(given, sgd, torch.device("cpu")), torch.optim.SGD)
