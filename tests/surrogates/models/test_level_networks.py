"""One level and what it takes over from a frozen coarser one: sizes, and the equations of section 3.4."""

from __future__ import annotations

import numpy as np
import plate
import pytest
import torch
from scipy import sparse

from data_schema.levels import Level
from surrogates.data.graphs import Graphs
from surrogates.data.inputs import Ranges
from surrogates.data.scaling import InputScaling
from surrogates.errors import SurrogateError
from surrogates.models.cascade import Cascade, build_level
from surrogates.operators.upsampling import Upsampling
from surrogates.settings import settings
from surrogates.training.train import train_surrogate

PAPER_NODES = (1165, 292, 73)
# Table 1 of the paper without its bookkeeping scalars; docs/method.md says how they differ.
PAPER_SIZES = {3: 18_103, 2: 65_407, 1: 253_975}


def chain(nodes: tuple[int, ...], full: int) -> Graphs:
    """Stars of the given sizes, each a beginning of the next finer one: only sizes matter here."""
    levels, finer = [], full
    for index, n in enumerate(nodes, 1):
        up = sparse.csr_matrix((np.ones(finer), (np.arange(finer), np.minimum(np.arange(finer), n - 1))), (finer, n))
        kept = np.arange(n)
        levels.append(Level(index, kept, np.empty((0, 3), np.int32), star(n), kept, up, sparse.csr_matrix((full, n))))
        finer = n
    return Graphs(full, tuple(levels), star(full))


def star(n: int) -> np.ndarray:
    """Edges (n - 1, 2) from node 0 to every other."""
    return np.stack([np.zeros(n - 1), np.arange(1, n)], axis=1).astype(np.int32)


def scaling() -> InputScaling:
    ranges = Ranges(("a", "b", "c"), ("", "", ""), np.zeros(3), np.ones(3), (0.0, 1.0))
    return InputScaling(ranges)


def sizes(graphs: Graphs, model: str, *overrides: str) -> dict[int, dict[str, int]]:
    chosen = settings(model, "paper", overrides=overrides)
    cascade = Cascade(scaling())
    for number in chosen.levels or range(len(graphs.levels), 0, -1):
        cascade.add(number, build_level(number, chosen, graphs, cascade))
    return {k: level.parameter_counts() for k, level in cascade.levels.items()}


def test_the_cascade_has_the_papers_number_of_parameters() -> None:
    found = sizes(chain(PAPER_NODES, 1200), "mh", "transfer.upsampling=static")
    assert {k: v["reduction"] for k, v in found.items()} == PAPER_SIZES
    assert found[3]["regression"] == 8_900


@pytest.mark.parametrize(("model", "count"), [("podnn", 111_768), ("aenn", 11_237_946), ("gaenn", 2_014_159)])
def test_the_baselines_have_the_papers_number_of_parameters(model: str, count: int) -> None:
    found = sizes(chain((), 9314), model)[0]
    assert found["reduction"] == count
    assert found["regression"] == 8_900


def test_linear_upsampling_has_one_weight_for_each_pair_of_nodes_and_one_bias_for_each_fine_node() -> None:
    found = sizes(chain((9, 5), 20), "mh", "transfer.upsampling=linear")
    assert found[1]["upsampling"] == 9 * 5 + 9
    assert found[2]["upsampling"] == 0


def two_levels(*overrides: str) -> tuple[Cascade, torch.Tensor]:
    """Levels 2 (9 nodes) and 1 (25 nodes) of the plate with random weights, and states of level 1."""
    torch.manual_seed(1)
    graphs = Graphs(81, plate.levels(), plate.edges(9))
    chosen = settings("mh", "paper", overrides=overrides)
    cascade = Cascade(scaling())
    for number, scale in ((2, 2.0), (1, 0.5)):
        level = build_level(number, chosen, graphs, cascade)
        level.scale = scale
        for parameter in level.regressor.parameters():
            torch.nn.init.normal_(parameter, std=0.5)
        cascade.add(number, level)
    return cascade, torch.randn(25, 4, 3)


def inputs() -> torch.Tensor:
    return torch.rand(4, 4) * 2 - 1


def test_encodings_of_both_levels_add() -> None:
    cascade, x = two_levels()
    coarse, fine = cascade.levels[2], cascade.levels[1]
    in_finer = plate.levels()[1].in_finer
    # The coarse level reads the same metres in its own unit: 0.5 / 2.0.
    expected = coarse.encode(x[in_finer] * 0.25) + fine.reduction.encode(x)
    torch.testing.assert_close(fine.encode(x), expected)


def test_concatenated_encodings_stand_side_by_side() -> None:
    cascade, x = two_levels("transfer.encoder=concat")
    fine = cascade.levels[1]
    z = fine.encode(x)
    assert z.shape == (4, 8)
    torch.testing.assert_close(z[:, :4], cascade.levels[2].encode(fine.restrict(x)))
    torch.testing.assert_close(fine.decode(z), fine.lifted(z[:, :4]) + fine.reduction.decode(z))


@pytest.mark.parametrize("kind", ["static", "sparse", "linear"])
def test_decodings_of_both_levels_add_and_upsampling_starts_barycentric(kind: str) -> None:
    cascade, _ = two_levels(f"transfer.upsampling={kind}")
    z = torch.randn(4, 4)
    fine = cascade.levels[1]
    up = torch.from_numpy(plate.levels()[1].to_finer.toarray()).float()
    coarse = torch.einsum("fc,cbx->fbx", up, cascade.levels[2].decode(z) * 4.0)
    torch.testing.assert_close(fine.decode(z), coarse + fine.reduction.decode(z))


def test_the_coarse_regression_is_an_input_of_the_finer_one() -> None:
    cascade, _ = two_levels()
    given = inputs()
    below = cascade.levels[2].regressor.network(given)
    torch.testing.assert_close(
        cascade.levels[1].regress(given), cascade.levels[1].regressor.network(torch.cat([given, below], dim=1))
    )


def test_a_level_predicts_the_same_alone_and_under_a_finer_one() -> None:
    cascade, _ = two_levels()
    mu, t = torch.rand(5, 3, dtype=torch.float64), torch.rand(5, dtype=torch.float64)
    before = cascade.levels[2].decode(cascade.levels[2].regress(cascade.inputs(mu, t))) * 2.0
    assert torch.equal(cascade(mu, t, 2), before)


def test_a_finer_level_without_a_say_gives_the_lifted_coarse_prediction() -> None:
    cascade, _ = two_levels("transfer.mlp=residual", "transfer.upsampling=static")
    fine = cascade.levels[1]
    with torch.no_grad():
        for parameter in (*fine.regressor.parameters(), *fine.reduction.decoder.parameters()):
            parameter.zero_()
    mu, t = torch.rand(5, 3, dtype=torch.float64), torch.rand(5, dtype=torch.float64)
    up = torch.from_numpy(plate.levels()[1].to_finer.toarray()).float()
    torch.testing.assert_close(cascade(mu, t, 1), torch.einsum("fc,cbx->fbx", up, cascade(mu, t, 2)))


def test_only_the_finest_level_trains() -> None:
    cascade, _ = two_levels()
    assert not any(p.requires_grad for p in cascade.levels[2].parameters())
    assert all(p.requires_grad for name, p in cascade.levels[1].named_parameters() if not name.startswith("coarse."))


def test_sparse_upsampling_trains_the_entries_of_u_alone() -> None:
    up = plate.levels()[0].to_finer
    layer = Upsampling(up, "sparse")
    with torch.no_grad():
        layer.weight += 1.0
    trained = layer.as_matrix().numpy()
    np.testing.assert_array_equal(trained != 0, up.toarray() != 0)


def test_upsampling_is_shared_by_the_coordinates() -> None:
    layer = Upsampling(plate.levels()[0].to_finer, "linear")
    x = torch.randn(25, 2, 1).expand(25, 2, 3)
    out = layer(x)
    torch.testing.assert_close(out[..., 0], out[..., 2])


def test_weights_of_another_shape_are_refused_by_name() -> None:
    cascade, _ = two_levels()
    level = cascade.levels[1]
    tensors = dict(level.own_state())
    tensors["reduction.encoder.dense.weight"] = torch.zeros(4, 7)
    with pytest.raises(SurrogateError, match=r"reduction\.encoder\.dense\.weight is stored as \(4, 7\)"):
        level.load_own_state(tensors)


def test_a_mesh_of_few_nodes_has_as_many_latent_numbers_as_displacements() -> None:
    cascade, _ = two_levels("level.latent=40")
    assert {number: cascade.latent(number) for number in cascade.numbers} == {2: 27, 1: 40}


@pytest.mark.parametrize("model", ["aenn", "gaenn", "podnn"])
def test_predictions_start_at_exactly_zero_however_many_states_are_asked_for(model: str) -> None:
    """A product of matrices rounds otherwise for one column than for many."""
    campaign = plate.campaign(9)
    quick = ["level.epochs=2", "physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]
    surrogate = train_surrogate(campaign, settings(model, overrides=quick))
    time = np.linspace(0, float(campaign.time[-1]), 301)
    for count in (1, 2, 33, 301):
        said = surrogate.predict_full(campaign.parameters[:1] * 1.01, time[:count])
        assert (said[0, 0] == 0).all()
    assert np.abs(said).max() > 0
