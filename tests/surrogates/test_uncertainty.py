"""The band around predictions holds what it says, and derivatives are those of the prediction."""

from __future__ import annotations

import numpy as np
import plate
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogates.errors import SurrogateError
from surrogates.settings import settings as choose
from surrogates.storage.folder import load, save
from surrogates.training.train import train
from surrogates.uncertainty import calibrate, coverage

TIME = np.linspace(0.0, 0.02, 11)


def distances(runs: int, seed: int, nodes: int = 40) -> list[np.ndarray]:
    """Errors that grow with time, differ between nodes, and vary from run to run."""
    random = np.random.default_rng(seed)
    pattern = (0.1 + TIME / TIME[-1])[:, None] * np.random.default_rng(0).uniform(0.2, 2.0, nodes)
    return [(pattern * random.gamma(4.0, 0.25, pattern.shape)).astype(np.float32) for _ in range(runs)]


@pytest.mark.parametrize("share", [0.5, 0.8, 0.9, 0.95])
def test_the_share_asked_for_lies_within_the_band_in_new_runs(share: float) -> None:
    band = calibrate(distances(12, seed=1), TIME)
    found = coverage(np.stack(distances(40, seed=2)), band.half_width(share, TIME))
    assert found == pytest.approx(share, abs=0.03)


def test_the_band_is_wide_where_and_when_errors_were_large() -> None:
    width = calibrate(distances(12, seed=1), TIME).half_width(0.9, TIME)
    expected = np.mean(distances(500, seed=3), axis=0)
    assert np.corrcoef(width.ravel(), expected.ravel())[0, 1] > 0.98


@settings(max_examples=20, deadline=None)
@given(factor=st.floats(1e-3, 1e3))
def test_the_band_scales_with_the_errors(factor: float) -> None:
    given_ = distances(3, seed=4)
    one = calibrate(given_, TIME).half_width(0.8, TIME)
    other = calibrate([d * np.float32(factor) for d in given_], TIME).half_width(0.8, TIME)
    np.testing.assert_allclose(other, factor * one, rtol=1e-3)


def test_a_larger_share_needs_a_wider_band() -> None:
    band = calibrate(distances(3, seed=5), TIME)
    widths = [band.half_width(share, TIME) for share in (0.5, 0.75, 0.99)]
    assert (widths[0] < widths[1]).all()
    assert (widths[1] < widths[2]).all()


def test_errors_of_zero_give_a_band_that_is_no_division_by_zero() -> None:
    width = calibrate([np.zeros((11, 5), np.float32)] * 3, TIME).half_width(0.9, TIME)
    assert np.isfinite(width).all()


def test_one_validation_run_is_not_enough() -> None:
    with pytest.raises(SurrogateError, match="at least 2 validation runs; found 1"):
        calibrate(distances(1, seed=0), TIME)


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_shares_it_has_no_quantile_for_are_refused(share: float) -> None:
    with pytest.raises(SurrogateError, match=r"expected 0.5 to 0.99"):
        calibrate(distances(3, seed=0), TIME).half_width(share, TIME)


SHORT = ("level.epochs=4", "level.latent=3", "level.batch=16", "validation.share=0.3")


@pytest.mark.parametrize("model", ["mh", "podnn", "pod-gpr"])
def test_bands_of_own_nodes_and_of_the_full_mesh_survive_storage(model: str, tmp_path) -> None:  # type: ignore[no-untyped-def]
    fitted = train(plate.campaign(10), choose(model, overrides=SHORT))
    stored = load(save(fitted, tmp_path / "model"))
    for level in fitted.level_names.values():
        for full in (False, True):
            width = stored.band(0.9, [0.0, 0.011], level, full=full)
            assert width.shape == (2, plate.SIDES[0] ** 2 if full else fitted.graphs.n_nodes(level))
            np.testing.assert_array_equal(width, fitted.band(0.9, [0.0, 0.011], level, full=full))


def test_without_validation_runs_there_is_no_band() -> None:
    fitted = train(plate.campaign(6), choose("mh", overrides=(*SHORT, "validation.measure=paper")))
    with pytest.raises(SurrogateError, match="no band for MH1: too few validation runs"):
        fitted.band()


@pytest.mark.parametrize("overrides", [(), ("transfer.encoder=concat", "level.convolution=gcn2"), ("unified=true",)])
def test_automatic_derivatives_agree_with_differences(overrides: tuple[str, ...]) -> None:
    fitted = train(plate.campaign(10), choose("mh", overrides=(*SHORT, "level.mlp.activation=tanh", *overrides)))
    at = np.array([20.0, 1.0, 3e8])
    found = fitted.sensitivity(at, level=1)
    assert found.shape == (len(plate.TIME), plate.SIDES[1] ** 2, 3, 3)
    for k, step in enumerate((0.05, 0.05, 2e6)):
        move = step * np.eye(3)[k]
        high, low = (fitted.predict(at + s * move, level=1).astype(np.float64) for s in (1, -1))
        slope = (high - low) / (2 * step)
        assert np.abs(found[..., k] - slope).max() <= 0.02 * np.abs(slope).max()


def test_derivatives_of_chosen_nodes_are_a_part_of_all() -> None:
    fitted = train(plate.campaign(10), choose("mh", overrides=SHORT))
    at = [20.0, 1.0, 3e8]
    np.testing.assert_array_equal(fitted.sensitivity(at, nodes=[3, 7]), fitted.sensitivity(at)[:, [3, 7]])


def test_derivatives_of_gaussian_processes_are_differences() -> None:
    fitted = train(plate.campaign(10), choose("pod-gpr"))
    at = np.array([20.0, 1.0, 3e8])
    found = fitted.sensitivity(at, [0.02])[..., 0]
    step = np.array([1e-2, 0.0, 0.0])
    slope = fitted.predict(at + step, [0.02]) - fitted.predict(at - step, [0.02])
    np.testing.assert_allclose(found, slope / 2e-2, atol=0.02 * np.abs(found).max())


def test_sensitivities_are_those_of_one_run() -> None:
    fitted = train(plate.campaign(10), choose("podnn", overrides=SHORT))
    with pytest.raises(SurrogateError, match="those of one run; found parameters of 2"):
        fitted.sensitivity(plate.parameters(2))
