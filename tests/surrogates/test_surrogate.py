"""What a trained surrogate says of its own predictions: bands that survive storage, derivatives that are its own."""

from __future__ import annotations

import numpy as np
import plate
import pytest

from surrogates.errors import SurrogateError
from surrogates.settings import settings as choose
from surrogates.storage.folder import load, save
from surrogates.training.train import train_surrogate

SHORT = ("level.epochs=4", "level.latent=3", "level.batch=16", "validation.share=0.3")


@pytest.mark.parametrize("model", ["mh", "podnn", "pod-gpr"])
def test_bands_of_own_nodes_and_of_the_full_mesh_survive_storage(model: str, tmp_path) -> None:  # type: ignore[no-untyped-def]
    fitted = train_surrogate(plate.campaign(10), choose(model, overrides=SHORT))
    stored = load(save(fitted, tmp_path / "model"))
    for level in fitted.level_names.values():
        for full in (False, True):
            width = stored.band(0.9, [0.0, 0.011], level, full=full)
            assert width.shape == (2, plate.SIDES[0] ** 2 if full else fitted.graphs.n_nodes(level))
            np.testing.assert_array_equal(width, fitted.band(0.9, [0.0, 0.011], level, full=full))


def test_without_validation_runs_there_is_no_band() -> None:
    fitted = train_surrogate(plate.campaign(6), choose("mh", overrides=(*SHORT, "validation.measure=paper")))
    with pytest.raises(SurrogateError, match="no band for MH1: too few runs"):
        fitted.band()


@pytest.mark.parametrize("overrides", [(), ("transfer.encoder=concat", "level.convolution=gcn2"), ("unified=true",)])
def test_automatic_derivatives_agree_with_differences(overrides: tuple[str, ...]) -> None:
    fitted = train_surrogate(
        plate.campaign(10), choose("mh", overrides=(*SHORT, "level.mlp.activation=tanh", *overrides))
    )
    at = np.array([20.0, 1.0, 3e8])
    found = fitted.sensitivity(at, level=1)
    assert found.shape == (len(plate.TIME), plate.SIDES[1] ** 2, 3, 3)
    for k, step in enumerate((0.05, 0.05, 2e6)):
        move = step * np.eye(3)[k]
        high, low = (fitted.predict(at + s * move, level=1).astype(np.float64) for s in (1, -1))
        slope = (high - low) / (2 * step)
        assert np.abs(found[..., k] - slope).max() <= 0.02 * np.abs(slope).max()


def test_derivatives_of_chosen_nodes_are_a_part_of_all() -> None:
    fitted = train_surrogate(plate.campaign(10), choose("mh", overrides=SHORT))
    at = [20.0, 1.0, 3e8]
    np.testing.assert_array_equal(fitted.sensitivity(at, nodes=[3, 7]), fitted.sensitivity(at)[:, [3, 7]])


def test_derivatives_of_gaussian_processes_are_differences() -> None:
    fitted = train_surrogate(plate.campaign(10), choose("pod-gpr"))
    at = np.array([20.0, 1.0, 3e8])
    found = fitted.sensitivity(at, [0.02])[..., 0]
    step = np.array([1e-2, 0.0, 0.0])
    slope = fitted.predict(at + step, [0.02]) - fitted.predict(at - step, [0.02])
    np.testing.assert_allclose(found, slope / 2e-2, atol=0.02 * np.abs(found).max())


def test_sensitivities_are_those_of_one_run() -> None:
    fitted = train_surrogate(plate.campaign(10), choose("podnn", overrides=SHORT))
    with pytest.raises(SurrogateError, match="those of one run; found parameters of 2"):
        fitted.sensitivity(plate.parameters(2))
