"""Encoder and decoder of graph convolutions against the formulas written out, and against finite differences."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

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


def textbook(operator, encoder, decoder, x):
    """Encoder and decoder by the formulas of the paper: dense matrices, the recurrence of the terms, one sample at a time."""
    scaled = torch.from_numpy(operator.matrix.toarray())

    def convolved(h, layers, last_is_linear):
        for number, layer in enumerate(layers):
            terms = [h, scaled @ h]
            while len(terms) < len(layer.weight):
                terms.append(2 * scaled @ terms[-1] - terms[-2])
            h = sum(term @ weight for term, weight in zip(terms, layer.weight)) + layer.bias
            if not (last_is_linear and number == len(layers) - 1):
                h = torch.nn.functional.elu(h)
        return h

    codes, states = [], []
    for sample in x.unbind(1):
        z = encoder.dense(convolved(sample, encoder.convolutions.layers, False).flatten())
        wide = torch.nn.functional.elu(decoder.dense(z)).view(operator.n_nodes, -1)
        codes.append(z)
        states.append(convolved(wide, decoder.convolutions.layers, True))
    return torch.stack(codes), torch.stack(states, 1)


@settings(max_examples=25, deadline=None)
@given(
    nodes=st.integers(1, 90),
    batch=st.integers(1, 9),
    latent=st.integers(1, 9),
    order=st.integers(1, 5),
    widths=st.sampled_from([(3, 6, 12, 24), (3, 5), (4, 1), (3, 7, 2, 13), (1, 1)]),
    large=st.booleans(),
)
def test_results_and_gradients_equal_those_of_the_formulas(nodes, batch, latent, order, widths, large):
    with patch("surrogates.operators.stacks.WIDE_UP_TO", 0 if large else nodes):
        _check_against_the_formulas(graph(nodes), batch, latent, order, widths)


def _check_against_the_formulas(operator, batch, latent, order, widths):
    both = pair(operator, latent, widths, order, torch.float64)
    x = torch.randn(operator.n_nodes, batch, widths[0], dtype=torch.float64, requires_grad=True)
    parameters = [x, *both[0].parameters(), *both[1].parameters()]
    z = both[0](x)
    y = both[1](z)
    z2, y2 = textbook(operator, *both, x)
    ours = [z, y, *torch.autograd.grad(y.square().sum() + z.sum(), parameters)]
    theirs = [z2, y2, *torch.autograd.grad(y2.square().sum() + z2.sum(), parameters)]
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("batch", [1, 16, 35])
def test_a_prediction_equals_what_training_computes(batch):
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
