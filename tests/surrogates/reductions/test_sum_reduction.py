"""A linear reduction beside a nonlinear one: what is not trained yet is not computed, and nothing else changes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from surrogates.operators.graph import GraphOperator
from surrogates.reductions.reduction import DenseReduction, GraphReduction, LinearReduction, Reduction, SumReduction

N_NODES, LATENT, BATCH = 7, 3, 5


def both(kind: str) -> SumReduction:
    torch.manual_seed(0)
    operator = GraphOperator([[k, k + 1] for k in range(N_NODES - 1)], N_NODES)
    remainder: Reduction = DenseReduction(N_NODES, LATENT, LATENT, (4,))
    if kind == "gcn":
        remainder = GraphReduction(operator, LATENT, LATENT, (4, 6), 3)
    made = SumReduction(LinearReduction(N_NODES, LATENT, LATENT, trainable=True), remainder)
    for parameter in made.linear.parameters():
        nn.init.uniform_(parameter, -1, 1)
    return made


def said(reduction: SumReduction) -> tuple[Tensor, Tensor]:
    torch.manual_seed(1)
    x, z = torch.randn(N_NODES, BATCH, 3), torch.randn(BATCH, LATENT)
    return reduction.encode(x), reduction.decode(z)


@pytest.mark.parametrize("kind", ["gcn", "ae"])
def test_what_gives_zero_is_not_computed(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reduction = both(kind)
    with_gradients = [t.detach() for t in said(reduction)]

    def computed(*_: Tensor) -> Tensor:
        raise AssertionError("the remainder is still zero")

    monkeypatch.setattr(reduction.remainder, "encode", computed)
    monkeypatch.setattr(reduction.remainder, "decode", computed)
    with torch.no_grad():
        for one, other in zip(said(reduction), with_gradients, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["gcn", "ae"])
def test_one_weight_that_moved_counts(kind: str) -> None:
    reduction = both(kind)
    with torch.no_grad():
        before = said(reduction)
        for part in ("encoder", "decoder"):
            layer = reduction.remainder.last_layer(part)
            assert layer is not None
            next(layer.parameters()).view(-1)[-1] = 0.5  # the first numbers are zero as before
        after = said(reduction)
    for one, other in zip(after, before, strict=True):
        assert (one - other).abs().max() > 1e-3
    for one, other in zip(after, said(reduction), strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-5, atol=1e-6)
