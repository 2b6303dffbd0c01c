"""What a process notes of runs that were left out while it was trained: campaigns judge their error by it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate

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
