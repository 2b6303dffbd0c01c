"""The example of a reduction of one's own: trained in a cascade, stored, and told where it is not registered."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import plate
import pytest
import torch

from surrogates import settings as config
from surrogates.errors import SurrogateError
from surrogates.reductions import reduction
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.training.train import train_surrogate

EXAMPLE = Path(__file__).parents[3] / "examples" / "add_reduction.py"
SMALL = ("level.latent=3", "level.epochs=2", "levels=[2, 1]", "level.mlp.widths=[8]", "level.reduction=quadratic")


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As after importing the example; forgotten after the test."""
    monkeypatch.setattr(reduction, "_MAKERS", dict(reduction._MAKERS))
    before = list(config.REDUCTIONS)
    runpy.run_path(str(EXAMPLE))
    yield
    config.REDUCTIONS[:] = before


@pytest.mark.parametrize("more", [(), ("level.start=plain",), ("transfer.encoder=concat",)])
def test_a_cascade_of_it_learns_and_is_stored(more: tuple[str, ...], registered: None, tmp_path: Path) -> None:
    made = train_surrogate(plate.campaign(), settings("mh", overrides=[*SMALL, *more]), device="cpu")
    save(made, tmp_path / "model")
    asked = np.array([20.0, 1.0, 3e8])
    np.testing.assert_array_equal(load(tmp_path / "model").predict(asked), made.predict(asked))


def test_it_is_a_quadratic_function_of_the_latent_vector(registered: None) -> None:
    level = settings("mh", overrides=[*SMALL, "level.start=plain"]).level
    made = reduction.make_reduction(level, None, 9)
    points = torch.linspace(-1, 1, 4)[:, None] * torch.ones(4, 3)
    third = torch.diff(made.decode(points), n=3, dim=1)
    torch.testing.assert_close(third, torch.zeros_like(third), atol=1e-5, rtol=0)


def test_a_model_is_refused_by_name_where_it_is_not_registered(registered: None, tmp_path: Path) -> None:
    save(train_surrogate(plate.campaign(), settings("mh", overrides=SMALL), device="cpu"), tmp_path / "model")
    config.REDUCTIONS.remove("quadratic")
    with pytest.raises(SurrogateError, match=r"model.*reduction.*'quadratic'.*'gcn', 'ae' or 'pod'"):
        load(tmp_path / "model")


def test_without_its_encoder_a_unified_network_cannot_use_it(registered: None) -> None:
    with pytest.raises(SurrogateError, match="QuadraticReduction cannot do without its encoder; set unified=false"):
        train_surrogate(plate.campaign(), settings("mh", overrides=[*SMALL, "unified=true"]), device="cpu")


def test_the_example_is_as_short_as_it_says() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 60
