"""Time histories as functions of the parameters: on curves whose law is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate
import pytest

from surrogates.data.campaign import CurveTarget
from surrogates.errors import ModelFolderError, SurrogateError
from surrogates.models.curves import Curve, fit_curve
from surrogates.physics.registration import Registration
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

TIME = np.linspace(0, 0.03, 61)
NAMES = ("force_x", "force_y", "energy")


def force(runs: np.ndarray) -> np.ndarray:
    """(run, sample) N: a pulse that grows and comes earlier with the speed."""
    speed = runs[:, :1]
    return 1e3 * speed * np.exp(-(((TIME - 0.2 / speed) / 0.006) ** 2))


def targets(runs: np.ndarray) -> tuple[CurveTarget, ...]:
    values = (force(runs), force(runs) * np.radians(runs[:, 1:2]), np.cumsum(force(runs), axis=1) * 5e-4)
    return tuple(CurveTarget(n, u, v) for n, u, v in zip(NAMES, ("N", "N", "J"), values, strict=True))


@pytest.fixture(scope="module")
def surrogate() -> Surrogate:
    runs = plate.parameters(24)
    campaign = plate.campaign(24, curves=targets(runs), curve_time=TIME)
    return train_surrogate(
        campaign, settings("pod-gpr", overrides=["targets=[displacement, history:force, history:en*]"])
    )


def test_a_new_run_has_the_true_curve(surrogate: Surrogate) -> None:
    new = plate.parameters(8, seed=7)
    for true in targets(new):
        said = surrogate.predict_curve(true.name, new)
        assert said.shape == (8, len(TIME))
        assert np.sqrt(np.mean((said - true.values) ** 2)) < 0.08 * np.sqrt(np.mean(true.values**2))
    np.testing.assert_allclose(surrogate.predict_curve("energy", new[3]), surrogate.predict_curve("energy", new)[3])


def test_its_band_holds_what_it_says(surrogate: Surrogate) -> None:
    new = plate.parameters(60, seed=8)
    for true in targets(new):
        curve = surrogate.curves[true.name]
        off = np.abs(surrogate.predict_curve(true.name, new) - true.values)
        assert 0.75 < (off <= curve.half_width(0.9)).mean() <= 1
        assert (curve.half_width(0.5) <= curve.half_width(0.9)).all()
        assert 0.8 < (off <= curve.half_width(0.9, surrogate.registration, new)).mean() <= 1


def test_its_band_follows_the_size_of_a_run_where_errors_do() -> None:
    """Errors in proportion to the curve: with one width for all, small runs would be held too often and large ones too seldom."""
    rng = np.random.default_rng(0)
    size = 10 ** rng.uniform(0, 2, 60)
    wave = np.sin(np.linspace(0.1, 3, 40)) * (1 + 0.1 * rng.standard_normal((60, 40)).cumsum(axis=1) / 6)
    target = CurveTarget("force", "N", size[:, None] * wave)
    runs = np.log10(size)[:, None]
    identity = Registration.identity(("a",), plate.TIME)
    found = fit_curve(target, np.linspace(0, 1, 40), runs, identity, 5, 0)
    assert found.band is not None
    assert found.band.spread == "size"
    small, large = found.half_width(0.9, identity, np.array([[0.3], [1.8]])).mean(axis=1)
    assert large > 5 * small
    back = Curve.load("force", found.told(), found.arrays())
    np.testing.assert_allclose(back.half_width(0.9, identity, runs), found.half_width(0.9, identity, runs))


def test_channels_are_named_by_pattern_and_by_resultant(surrogate: Surrogate) -> None:
    assert tuple(surrogate.curves) == NAMES
    with pytest.raises(
        SurrogateError, match=r"targets names 'history:door', and the dataset has force_x, force_y, energy"
    ):
        train_surrogate(
            plate.campaign(6, curves=targets(plate.parameters(6)), curve_time=TIME),
            settings("pod-gpr", overrides=["targets=[history:door]"]),
        )


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("history:forcex", r"did you mean 'history:force_x'\?"),
        ("displacment", r"has displacement; did you mean 'displacement'\?"),
        ("plastic_strian", r"did you mean 'plastic_strain'\? results on elements are kept by crashkit ingest --fields"),
    ],
)
def test_a_misspelt_target_is_told_with_the_nearest_name(target: str, told: str) -> None:
    campaign = plate.campaign(6, curves=targets(plate.parameters(6)), curve_time=TIME)
    with pytest.raises(SurrogateError, match=told):
        train_surrogate(campaign, settings("pod-gpr", overrides=[f"targets=[displacement, {target}]"]))


def test_each_left_out_run_is_predicted_without_it(surrogate: Surrogate) -> None:
    curve = surrogate.curves["force_x"]
    assert sorted(curve.held) == list(range(24))
    runs = plate.parameters(24)
    fitted = curve.predict(surrogate.registration, runs)
    without = np.stack([curve.held[k] for k in range(24)])
    true = force(runs)
    assert np.abs(without - true).mean() > 1.2 * np.abs(fitted - true).mean()


def test_runs_without_the_whole_channel_are_left_out() -> None:
    runs = plate.parameters(10)
    values = force(runs)
    values[3, 40:] = np.nan
    target = CurveTarget("force", "N", values)
    identity = Registration.identity(("a", "b", "c"), plate.TIME)
    found = fit_curve(target, TIME, runs, identity, 5, 0)
    assert len(found.values) == 9
    assert 3 not in found.held
    values[2:] = np.nan
    with pytest.raises(SurrogateError, match="2 of 10 training runs have the whole channel"):
        fit_curve(CurveTarget("force", "N", values), TIME, runs, identity, 5, 0)


def test_a_channel_that_never_changes_stays_as_it_is() -> None:
    runs = plate.parameters(8)
    flat = CurveTarget("mass", "kg", np.full((8, len(TIME)), 12.5))
    found = fit_curve(flat, TIME, runs, Registration.identity(("a", "b", "c"), plate.TIME), 4, 0)
    np.testing.assert_allclose(found.predict(Registration.identity(("a", "b", "c"), plate.TIME), runs), 12.5)


def test_it_is_stored_and_comes_back_the_same(surrogate: Surrogate, tmp_path: Path) -> None:
    save(surrogate, tmp_path / "model")
    back = load(tmp_path / "model")
    new = plate.parameters(3, seed=9)
    for name in NAMES:
        np.testing.assert_allclose(back.predict_curve(name, new), surrogate.predict_curve(name, new), rtol=1e-12)
        np.testing.assert_allclose(back.curves[name].half_width(0.9), surrogate.curves[name].half_width(0.9))
        assert back.curves[name].errors == surrogate.curves[name].errors
    with pytest.raises(SurrogateError, match="door was not learnt, of histories there is force_x"):
        back.predict_curve("door", new)
    (tmp_path / "model" / "curves.safetensors").write_bytes(b"")
    with pytest.raises(ModelFolderError, match=r"curves\.safetensors: was altered"):
        load(tmp_path / "model")


def test_a_network_has_histories_beside_it_too() -> None:
    runs = plate.parameters(10)
    campaign = plate.campaign(10, curves=targets(runs), curve_time=TIME)
    found = train_surrogate(
        campaign, settings("podnn", "paper", overrides=["level.epochs=1", "targets=[history:energy]"])
    )
    assert found.predict_curve("energy", runs[0]).shape == TIME.shape
