"""The compiled convolutions against the same in torch, against finite differences, and where they may be left out."""

from __future__ import annotations

import os
from shutil import which

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogates.operators import compiled
from surrogates.operators.graph import GraphOperator
from surrogates.operators.stacks import GraphDecoder, GraphEncoder


def graph(n_nodes: int, seed: int = 0) -> GraphOperator:
    pairs = np.random.default_rng(seed).integers(0, n_nodes, (3 * n_nodes, 2))
    return GraphOperator(pairs, n_nodes)


def pair(operator: GraphOperator, latent: int, widths: tuple[int, ...], order: int, dtype: torch.dtype):
    """An encoder and a decoder with random weights and biases."""
    torch.manual_seed(1)
    both = GraphEncoder(operator, latent, widths, order), GraphDecoder(operator, latent, widths[::-1], order)
    for module in both:
        module.to(dtype)
        for parameter in module.parameters():
            torch.nn.init.uniform_(parameter, -0.4, 0.4)
    return both


def everything(operator, latent, widths, order, dtype, batch) -> list[torch.Tensor]:
    """Results and all gradients of an encoder and a decoder."""
    encoder, decoder = pair(operator, latent, widths, order, dtype)
    x = torch.randn(operator.n_nodes, batch, widths[0], dtype=dtype, requires_grad=True)
    z = encoder(x)
    y = decoder(z)
    by = torch.autograd.grad(y.square().sum() + z.sum(), [x, z, *encoder.parameters(), *decoder.parameters()])
    return [z, y, *by]


@pytest.fixture
def not_built(monkeypatch):
    """As on a machine without a compiler."""
    return lambda: monkeypatch.setattr(compiled, "library", lambda: None)


def test_they_are_built_where_there_is_a_compiler():
    compiler = which(os.environ.get("CC", "").split(" ")[0] or "cc") or which("gcc")
    assert (compiled.library() is not None) == (compiler is not None)


@settings(max_examples=25, deadline=None)
@given(
    nodes=st.integers(1, 90),
    batch=st.integers(1, 40),
    latent=st.integers(1, 9),
    order=st.integers(1, 5),
    widths=st.sampled_from([(3, 6, 12, 24), (3, 5), (4, 1), (3, 7, 2, 13), (1, 1)]),
    threads=st.integers(1, 3),
)
def test_results_and_gradients_equal_those_of_torch(nodes, batch, latent, order, widths, threads):
    operator = graph(nodes)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        torch.manual_seed(0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(compiled, "SHARED_FROM", 0)
            fast = everything(operator, latent, widths, order, torch.float64, batch)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(compiled, "library", lambda: None)
            torch.manual_seed(0)
            plain = everything(operator, latent, widths, order, torch.float64, batch)
    finally:
        torch.set_num_threads(before)
    for one, other in zip(fast, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_single_precision_is_as_exact_as_torch(not_built):
    torch.manual_seed(0)
    fast = everything(graph(60), 4, (3, 6, 12, 24), 3, torch.float32, 20)
    not_built()
    torch.manual_seed(0)
    plain = everything(graph(60), 4, (3, 6, 12, 24), 3, torch.float32, 20)
    for one, other in zip(fast, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-4, atol=2e-5 * float(other.detach().abs().max()))


@pytest.mark.parametrize("batch", [1, 16, 35])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_prediction_equals_what_training_computes(batch, threads, monkeypatch):
    monkeypatch.setattr(compiled, "SHARED_FROM", 0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    _, decoder = pair(graph(60), 4, (3, 6, 12, 24), 3, torch.float64)
    z = torch.randn(batch, 4, dtype=torch.float64)
    with torch.no_grad():
        alone = decoder(z)
    torch.testing.assert_close(alone, decoder(z).detach(), rtol=1e-13, atol=1e-13)


def test_gradients_agree_with_finite_differences():
    encoder, decoder = pair(graph(5), 2, (2, 3, 4), 3, torch.float64)
    x = torch.randn(5, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x, *_: decoder(encoder(x)), (x, *encoder.parameters(), *decoder.parameters())
    )


@pytest.mark.parametrize("value", [-200.0, -30.0, -1e-3, 0.0, 1e-3, 40.0])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-7), (torch.float64, 1e-15)])
def test_elu_is_exact_from_one_end_to_the_other(value, dtype, tolerance):
    decoder = GraphDecoder(graph(1), 1, (1, 1), order=1).to(dtype)
    with torch.no_grad():
        decoder.dense.weight.fill_(1.0)
        decoder.dense.bias.zero_()
        decoder.convolutions.layers[0].weight.fill_(1.0)
    got = decoder(torch.tensor([[value]], dtype=dtype)).item()
    assert got == pytest.approx(value if value > 0 else np.expm1(value), rel=tolerance, abs=tolerance)


def test_what_is_not_a_number_stays_so():
    encoder, decoder = pair(graph(6), 2, (3, 6), 3, torch.float32)
    x = torch.zeros(6, 2, 3)
    x[:, 1] = float("nan")
    y = decoder(encoder(x))
    assert torch.isfinite(y[:, 0]).all()
    assert torch.isnan(y[:, 1]).all()


def test_gradients_do_not_depend_on_the_number_of_threads_beyond_rounding():
    operator, results = graph(400), []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            torch.manual_seed(0)
            results.append(everything(operator, 4, (3, 6, 12), 3, torch.float64, 70))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            torch.testing.assert_close(one, two, rtol=1e-10, atol=1e-10)


def test_same_threads_give_the_same_bits():
    operator = graph(300)
    torch.manual_seed(0)
    first = everything(operator, 4, (3, 6, 12), 3, torch.float32, 64)
    torch.manual_seed(0)
    second = everything(operator, 4, (3, 6, 12), 3, torch.float32, 64)
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))


def test_other_kinds_and_forms_are_left_to_torch():
    x = torch.zeros(4, 1, 3)
    edges = [[0, 1], [1, 2], [2, 3]]
    assert compiled.usable(x, GraphOperator(edges, 4))
    assert not compiled.usable(x, GraphOperator(edges, 4, "gcn"))
    assert not compiled.usable(x, GraphOperator(edges, 4, form="dense"))
    assert not compiled.usable(x.to(torch.bfloat16), GraphOperator(edges, 4))


def test_without_a_compiler_everything_still_works(not_built):
    not_built()
    assert not compiled.usable(torch.zeros(4, 1, 3), graph(4))
    encoder, decoder = pair(graph(20), 3, (3, 6), 3, torch.float32)
    assert decoder(encoder(torch.randn(20, 4, 3))).shape == (20, 4, 3)
