"""The graph operators against torch_geometric, against their own other form, and against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch_geometric.nn import ChebConv as PeerCheb
from torch_geometric.nn import GCN2Conv as PeerGCN2
from torch_geometric.nn import GCNConv as PeerGCN

from surrogates.errors import SurrogateError
from surrogates.operators.convolutions import ChebConv, GCN2Conv, GCNConv, exportable
from surrogates.operators.graph import WIDE_UP_TO, GraphOperator, largest_eigenvalue, normalised_laplacian
from surrogates.operators.stacks import GraphDecoder, GraphEncoder

DOUBLE = torch.float64


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def random_edges(n_nodes: int, n_edges: int, seed: int) -> np.ndarray:
    """(e, 2) undirected edges i < j, each once; nodes may stay alone."""
    pairs = np.random.default_rng(seed).integers(0, n_nodes, (n_edges, 2))
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return np.unique(pairs, axis=0)


def both_ways(edges: np.ndarray) -> torch.Tensor:
    """(2, 2e) directed edges as torch_geometric takes them."""
    return torch.from_numpy(np.concatenate([edges, edges[:, ::-1]]).T.copy())


def peer_states(x: torch.Tensor) -> torch.Tensor:
    """[node, batch, channel] -> [batch, node, channel], the layout torch_geometric broadcasts over."""
    return x.transpose(0, 1)


graphs = st.tuples(st.integers(2, 90), st.integers(1, 4), st.integers(0, 10_000)).map(
    lambda g: (g[0], random_edges(g[0], g[0] * g[1], g[2]))
)


@settings(max_examples=30, deadline=None)
@given(graph=graphs, order=st.integers(1, 5), widths=st.sampled_from([(3, 6), (6, 3), (4, 4), (1, 5)]))
def test_chebyshev_layer_equals_torch_geometric(graph, order, widths):
    n_nodes, edges = graph
    operator = GraphOperator(edges, n_nodes)
    layer = ChebConv(*widths, order, operator).to(DOUBLE)
    peer = PeerCheb(*widths, K=order).to(DOUBLE)
    with torch.no_grad():
        layer.bias.uniform_(-1, 1)
        peer.bias.copy_(layer.bias)
        for mine, theirs in zip(layer.weight, peer.lins):
            theirs.weight.copy_(mine.T)
    x = torch.randn(n_nodes, 3, widths[0], dtype=DOUBLE)
    expected = peer(peer_states(x), both_ways(edges), lambda_max=torch.tensor(operator.lambda_max, dtype=DOUBLE))
    torch.testing.assert_close(layer(x), expected.transpose(0, 1), rtol=1e-10, atol=1e-10)


@settings(max_examples=30, deadline=None)
@given(graph=graphs)
def test_lambda_max_is_the_largest_eigenvalue(graph):
    n_nodes, edges = graph
    adjacency = np.zeros((n_nodes, n_nodes))
    adjacency[edges[:, 0], edges[:, 1]] = adjacency[edges[:, 1], edges[:, 0]] = 1
    root = np.array([1 / np.sqrt(d) if d else 0.0 for d in adjacency.sum(axis=1)])
    laplacian = np.eye(n_nodes) - root[:, None] * adjacency * root
    operator = GraphOperator(edges, n_nodes)
    assert operator.lambda_max == pytest.approx(np.linalg.eigvalsh(laplacian).max(), abs=1e-10)
    spectrum = np.linalg.eigvalsh(operator.matrix.toarray())
    assert spectrum.max() == pytest.approx(1.0, abs=1e-10)
    assert spectrum.min() >= -1 - 1e-10


def test_lambda_max_of_a_large_graph_agrees_with_the_dense_spectrum():
    operator = GraphOperator(random_edges(400, 1200, 3), 400)
    adjacency = GraphOperator(random_edges(400, 1200, 3), 400, "gcn").matrix
    adjacency = ((adjacency != 0).astype(float) - np.eye(400)) > 0
    laplacian = normalised_laplacian(type(operator.matrix)(adjacency.astype(float)))
    assert largest_eigenvalue(laplacian) == pytest.approx(np.linalg.eigvalsh(laplacian.toarray())[-1], abs=1e-11)


@pytest.mark.parametrize("widths", [(3, 6), (6, 3)])
@pytest.mark.parametrize("elu", [False, True])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_sparse_and_dense_forms_agree_in_value_and_gradient(widths, elu, order):
    edges = random_edges(40, 100, 5)
    sparse = ChebConv(*widths, order, GraphOperator(edges, 40, form="sparse"), elu=elu).to(DOUBLE)
    dense = ChebConv(*widths, order, sparse.operator.dense_form(), elu=elu).to(DOUBLE)
    dense.load_state_dict(sparse.state_dict())
    x = torch.randn(40, 5, widths[0], dtype=DOUBLE)
    results = []
    for layer in (sparse, dense):
        state = x.clone().requires_grad_()
        y = layer(state)
        results.append([y, *torch.autograd.grad(y.square().sum(), [state, layer.weight, layer.bias])])
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("widths", [(2, 3), (3, 2)])
@pytest.mark.parametrize("elu", [False, True])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_chebyshev_gradient_agrees_with_finite_differences(widths, elu, order):
    layer = ChebConv(*widths, order, GraphOperator(random_edges(6, 9, 2), 6, form="sparse"), elu=elu).to(DOUBLE)
    x = torch.randn(6, 2, widths[0], dtype=DOUBLE, requires_grad=True)

    def value(x, weight, bias):
        return torch.func.functional_call(layer, {"weight": weight, "bias": bias}, (x,))

    assert torch.autograd.gradcheck(value, (x, layer.weight, layer.bias))


def test_propagation_is_differentiable_twice_and_forward():
    operator = GraphOperator(random_edges(7, 12, 4), 7, form="sparse")
    x = torch.randn(3, 7, 2, dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(operator.propagate, (x,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(operator.propagate, (x,))


@pytest.mark.parametrize("n_nodes", [12, WIDE_UP_TO + 1])
@pytest.mark.parametrize("form", ["sparse", "dense"])
def test_propagation_is_the_matrix_product_in_every_channel(form, n_nodes):
    operator = GraphOperator(random_edges(n_nodes, 2 * n_nodes, 4), n_nodes, form=form)
    x = torch.randn(3, n_nodes, 2, dtype=DOUBLE)
    expected = np.stack([operator.matrix @ channel for channel in x.numpy()])
    np.testing.assert_allclose(operator.propagate(x).numpy(), expected, atol=1e-12)
    start = torch.randn_like(x)
    added = operator.times(x, start.clone(), add=True)
    np.testing.assert_allclose(added.numpy(), start.numpy() + expected, atol=1e-12)


def test_node_without_edges_keeps_the_row_of_the_identity():
    operator = GraphOperator([[0, 1], [1, 2]], 4)
    row = operator.matrix.toarray()[3]
    np.testing.assert_allclose(row, [0, 0, 0, 2 / operator.lambda_max - 1])


def test_graph_without_edges_is_a_multiple_of_the_identity():
    operator = GraphOperator(np.zeros((0, 2), dtype=int), 3)
    np.testing.assert_allclose(operator.matrix.toarray(), np.eye(3))


def test_repeated_and_reversed_edges_and_loops_count_once():
    plain = GraphOperator([[0, 1], [1, 2]], 3).matrix
    twice = GraphOperator([[0, 1], [1, 0], [1, 2], [1, 2], [2, 2]], 3).matrix
    np.testing.assert_allclose(plain.toarray(), twice.toarray())


@pytest.mark.parametrize("widths", [(3, 6), (6, 3)])
def test_gcn_layer_equals_torch_geometric(widths):
    edges = random_edges(30, 60, 8)
    layer = GCNConv(*widths, GraphOperator(edges, 30, "gcn")).to(DOUBLE)
    peer = PeerGCN(*widths).to(DOUBLE)
    with torch.no_grad():
        peer.bias.copy_(layer.bias.uniform_(-1, 1))
        peer.lin.weight.copy_(layer.weight.T)
    x = torch.randn(30, 4, widths[0], dtype=DOUBLE)
    torch.testing.assert_close(layer(x), peer(peer_states(x), both_ways(edges)).transpose(0, 1), rtol=1e-10, atol=1e-10)


def test_gcn2_layer_equals_torch_geometric():
    edges = random_edges(30, 60, 9)
    layer = GCN2Conv(5, GraphOperator(edges, 30, "gcn2"), layer=3, alpha=0.2, theta=0.7).to(DOUBLE)
    peer = PeerGCN2(5, alpha=0.2, theta=0.7, layer=3).to(DOUBLE)
    with torch.no_grad():
        peer.weight1.copy_(layer.weight)
    x, x0 = torch.randn(2, 30, 4, 5, dtype=DOUBLE)
    # The peer scales its propagated input in place, so it takes one sample at a time.
    expected = [peer(x[:, b], x0[:, b], both_ways(edges)) for b in range(4)]
    torch.testing.assert_close(layer(x, x0), torch.stack(expected, dim=1), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["cheb", "gcn", "gcn2"])
def test_a_sample_does_not_depend_on_the_others_in_its_batch(kind):
    operator = GraphOperator(random_edges(25, 60, 1), 25, kind)
    encoder, decoder = GraphEncoder(operator, 4).to(DOUBLE), GraphDecoder(operator, 4).to(DOUBLE)
    x = torch.randn(25, 6, 3, dtype=DOUBLE)
    together = decoder(encoder(x))
    alone = torch.cat([decoder(encoder(x[:, b : b + 1])) for b in range(6)], dim=1)
    torch.testing.assert_close(together, alone, rtol=1e-10, atol=1e-10)


def test_encoder_and_decoder_have_the_parameters_of_the_paper():
    operator = GraphOperator(random_edges(73, 200, 1), 73)
    count = sum(p.numel() for m in (GraphEncoder(operator, 4), GraphDecoder(operator, 4)) for p in m.parameters())
    assert count == 18_103


def test_dense_layer_of_the_encoder_runs_over_nodes_then_channels():
    operator = GraphOperator(random_edges(5, 8, 1), 5)
    encoder = GraphEncoder(operator, 2, (3, 4)).to(DOUBLE)
    x = torch.randn(5, 1, 3, dtype=DOUBLE)
    h = encoder.convolutions(x)[:, 0].detach().numpy()
    weight = encoder.dense.weight.detach().numpy().reshape(2, 5, 4)
    expected = np.einsum("rnc,nc->r", weight, h) + encoder.dense.bias.detach().numpy()
    np.testing.assert_allclose(encoder(x)[0].detach().numpy(), expected, atol=1e-12)


def test_dense_form_is_exported_and_the_model_is_given_back_unchanged():
    operator = GraphOperator(random_edges(20, 50, 1), 20, form="sparse")
    decoder = GraphDecoder(operator, 3).eval()
    z = torch.randn(4, 3)
    with exportable(decoder):
        program = torch.export.export(decoder, (z,))
    torch.testing.assert_close(program.module()(z), decoder(z), rtol=1e-5, atol=1e-6)
    assert decoder.convolutions.layers[0].operator is operator


@pytest.mark.parametrize(
    ("edges", "n_nodes", "text"),
    [
        ([[0, 5]], 3, "edges name the nodes 0 to 5; the graph has 0 to 2"),
        ([[-1, 1]], 3, "edges name the nodes -1 to 1; the graph has 0 to 2"),
        ([[0, 1, 2]], 3, r"shape \(1, 3\); expected \(edge, 2\)"),
        ([], 0, "a graph of 0 nodes"),
    ],
)
def test_bad_graph_is_refused_by_what_was_found(edges, n_nodes, text):
    with pytest.raises(SurrogateError, match=text):
        GraphOperator(edges, n_nodes)


def test_layers_refuse_an_operator_or_state_that_does_not_fit():
    cheb, gcn = GraphOperator([[0, 1]], 3), GraphOperator([[0, 1]], 3, "gcn")
    with pytest.raises(SurrogateError, match="ChebConv was given an operator of kind 'gcn'; it needs cheb"):
        ChebConv(3, 6, 3, gcn)
    with pytest.raises(SurrogateError, match="Chebyshev order is 0"):
        ChebConv(3, 6, 0, cheb)
    with pytest.raises(SurrogateError, match=r"shape \(4, 2, 3\); expected \(3 nodes, batch, 3 channels\)"):
        ChebConv(3, 6, 3, cheb)(torch.zeros(4, 2, 3))
    with pytest.raises(SurrogateError, match="convolution 'spline' is unknown; choose cheb, gcn or gcn2"):
        GraphOperator([[0, 1]], 3, "spline")
