"""One latent vector for all levels: the levels differ in their decoders alone."""

from __future__ import annotations

import numpy as np
import plate
import torch

from surrogates.data.graphs import Graphs
from surrogates.data.inputs import Ranges
from surrogates.data.scaling import InputScaling
from surrogates.models.unified import Unified
from surrogates.settings import settings as choose
from surrogates.training.train import train_surrogate


def unified(*overrides: str) -> Unified:
    torch.manual_seed(0)
    ranges = Ranges(("a", "b", "c"), ("", "", ""), np.zeros(3), np.ones(3), (0.0, 1.0))
    chosen = choose("mh", "paper", overrides=("unified=true", "transfer.upsampling=static", *overrides))
    return Unified(InputScaling(ranges), chosen, Graphs.of(plate.campaign(2)), (2, 1))


def test_a_finer_level_is_the_lifted_coarser_one_and_its_own_decoding() -> None:
    network = unified()
    z = torch.randn(5, 4)
    found = network.decode_all(z)
    up = torch.from_numpy(plate.levels()[1].to_finer.toarray()).float()
    expected = torch.einsum("fc,cbx->fbx", up, found[2]) + network.reduction(1).decode(z)
    torch.testing.assert_close(found[1], expected)


def test_there_is_one_encoder() -> None:
    network = unified()
    encoders = [name for name, _ in network.named_parameters() if ".encoder." in name]
    assert encoders
    assert all(name.startswith("reductions.1.") for name in encoders)


def test_a_coarse_prediction_asks_no_finer_decoder() -> None:
    network = unified()
    mu, time = torch.rand(3, 3), torch.zeros(3)
    with torch.no_grad():
        before = network(mu, time, 2)
        for name, parameter in network.named_parameters():
            if name.startswith("reductions.1.decoder"):
                parameter.add_(1.0)
        assert torch.equal(network(mu, time, 2), before)


def test_all_levels_train_at_once() -> None:
    chosen = choose("mh", overrides=("unified=true", "level.epochs=25", "level.latent=3", "level.batch=16"))
    fitted = train_surrogate(plate.campaign(10), chosen)
    assert list(fitted.record.fits) == [1]
    assert fitted.level_names == {"MH2": 2, "MH1": 1}
    history = fitted.history(1)["total"]
    assert history[-1] < 0.5 * history[0]


def test_the_same_seed_gives_the_same_network() -> None:
    chosen = choose("mh", overrides=("unified=true", "level.epochs=2", "level.latent=3"))
    first, second = (train_surrogate(plate.campaign(6), chosen).core.tensors()["levels"] for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
