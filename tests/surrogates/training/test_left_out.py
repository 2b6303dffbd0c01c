"""Runs that are left out are not known to what is trained without them, and their errors are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate
import pytest

from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.training.train import train_surrogate


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
