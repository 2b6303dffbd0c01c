"""Runs that are left out are not known to what is trained without them, and their errors are kept."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import plate
import pytest

from surrogates.physics.derived import SPEED, STRESS
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.training import train
from surrogates.training.train import train_surrogate
from surrogates.uncertainty import Band, Beliefs, Gathered


def test_every_run_is_left_out_once_and_its_error_and_deviation_are_kept(tmp_path: Path) -> None:
    surrogate = train_surrogate(plate.campaign(10), settings("pod-gpr"))
    left_out = surrogate.record.left_out
    assert set(left_out) == set(surrogate.record.fitted_runs)
    errors, deviations = np.array(list(left_out.values())).T
    assert (errors > 0).all()
    assert (deviations > 0).all()
    assert np.isclose(errors.mean(), surrogate.record.errors["POD-GPR"], rtol=0.05)
    save(surrogate, tmp_path / "model")
    assert load(tmp_path / "model").record.left_out == left_out


@pytest.mark.parametrize(
    ("model", "overrides"),
    [
        ("mh", ("level.regression=network", "level.start=pod")),
        ("mh", ("level.regression=mean", "level.reduction=pod", "level.start=plain")),
        ("mh", ("unified=true",)),
        ("aenn", ("level.hidden=[9]",)),
        ("podnn", ()),
    ],
)
def test_validation_runs_train_nothing(model: str, overrides: tuple[str, ...]) -> None:
    """One epoch, so that they choose none either; only the error and the band may know them."""
    chosen = settings(
        model, overrides=["level.epochs=1", "level.latent=3", "validation.runs=[run_002, run_005]", *overrides]
    )
    u, coarse = plate.displacement(plate.parameters(8)), plate.levels()
    other = u.copy()
    other[[2, 5]] = other[[2, 5], ::-1] + 0.3
    one, two = (
        train_surrogate(
            plate.campaign(8, displacement=lambda k, v=values: v if k == 0 else v[:, :, coarse[k - 1].kept]), chosen
        )
        for values in (u, other)
    )
    assert one.record.validation_runs == ("run_002", "run_005")
    mu = plate.parameters(3, seed=9)
    for name, level in one.level_names.items():
        np.testing.assert_array_equal(two.predict(mu, level=level), one.predict(mu, level=level))
        assert two.record.errors[name] != one.record.errors[name]


def test_ranges_are_those_of_the_runs_that_train() -> None:
    mu = plate.parameters(8)
    fastest = int(mu[:, 0].argmax())
    chosen = settings("podnn", overrides=["level.epochs=1", f"validation.runs=[run_{fastest:03d}]"])
    ranges = train_surrogate(plate.campaign(8), chosen).record.ranges
    np.testing.assert_array_equal(ranges.high, np.delete(mu, fastest, axis=0).max(axis=0))
    assert ranges.high[0] < mu[fastest, 0]


@pytest.mark.parametrize(("model", "times"), [("pod-gpr", 2), ("podnn", 1)])
def test_a_band_is_calibrated_on_each_left_out_run_by_what_the_model_says_of_it(
    monkeypatch: pytest.MonkeyPatch, model: str, times: int
) -> None:
    """POD regression leaves each of few runs out twice: then it must not judge itself."""
    given = []
    real = train.calibrate_gathered

    def noted(gathered: Gathered, time: np.ndarray, beliefs: Beliefs, runs: np.ndarray | None = None) -> Band:
        given.append((beliefs, np.arange(len(gathered[2])) if runs is None else runs))
        return real(gathered, time, beliefs, runs)

    monkeypatch.setattr(train, "calibrate_gathered", noted)
    campaign = plate.campaign(14, dimensions=(SPEED, None, STRESS))
    chosen = settings(model, overrides=["level.epochs=1", "inputs.derived=off", "pod.modes=[4]", "validation.folds=4"])
    surrogate = train_surrogate(campaign, chosen)
    (beliefs, runs) = given[0]
    assert sorted(runs.tolist()) == sorted(list(range(14)) * times)
    assert not surrogate.registration.clock.is_identity
    np.testing.assert_allclose(beliefs.size, surrogate.registration.clock.size(campaign.parameters[runs]))
    assert (len(set(beliefs.deviation.tolist())) > 1) == (model == "pod-gpr")
    assert surrogate.bands[0, False].runs == 14


def test_a_model_of_modes_and_processes_is_loaded_and_asked_without_torch(tmp_path: Path) -> None:
    surrogate = train_surrogate(plate.campaign(6), settings("pod-gpr"))
    save(surrogate, tmp_path / "model")
    code = (
        "import sys\nfrom surrogates.storage.folder import load\n"
        f"u = load({str(tmp_path / 'model')!r}).predict([20.0, 2.0, 3e8])\n"
        "assert 'torch' not in sys.modules\nprint(float(abs(u).max()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(float(abs(surrogate.predict([20.0, 2.0, 3e8])).max()), rel=1e-6)
