"""Levels as ONNX and torch.export files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import plate
import pytest
import torch

from surrogates.errors import SurrogateError
from surrogates.physics.derived import Column
from surrogates.settings import settings
from surrogates.storage.export import export
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate


@pytest.fixture(scope="module")
def surrogate() -> Surrogate:
    return train_surrogate(
        plate.campaign(8), settings("mh", overrides=["level.epochs=2", "transfer.upsampling=sparse"])
    )


def questions() -> tuple[np.ndarray, np.ndarray]:
    return plate.parameters(5, seed=4), np.linspace(0.0, 0.03, 5)


@pytest.mark.parametrize(("level", "full"), [(1, False), (2, True)])
def test_onnxruntime_predicts_as_the_surrogate_does(
    surrogate: Surrogate, tmp_path: Path, level: int, full: bool
) -> None:
    path = tmp_path / "model.onnx"
    assert export(surrogate, path, level, full=full) <= 1e-4
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    mu, time = questions()
    found = session.run(None, {"parameters": mu, "time": time})[0]
    ask = surrogate.predict_full if full else surrogate.predict
    expected = np.stack([ask(p, [t], level)[0] for p, t in zip(mu, time, strict=True)])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_a_mean_of_several_trainings_is_one_file(tmp_path: Path) -> None:
    chosen = settings("mh", overrides=["level.epochs=1", "level.regression=network", "levels=[2]", "seeds=2"])
    mean = train_surrogate(plate.campaign(8), chosen)
    assert mean.seeds == (0, 1)
    assert export(mean, tmp_path / "model.onnx", 2) <= 1e-4


def test_warped_and_logarithmic_inputs_are_known_to_onnxruntime(surrogate: Surrogate, tmp_path: Path) -> None:
    """The numbers of such a model mean nothing, but they are the same."""
    registration = surrogate.registration
    columns = (Column((1, 0, 0), logarithm=True), Column((0, 1, 0), width=4.0), Column((0, 0, 1), logarithm=True))
    surrogate.registration = replace(registration, inputs=replace(registration.inputs, columns=columns))
    try:
        assert export(surrogate, tmp_path / "model.onnx", 2) <= 1e-4
    finally:
        surrogate.registration = registration


def test_a_torch_program_predicts_as_the_surrogate_does(surrogate: Surrogate, tmp_path: Path) -> None:
    path = tmp_path / "model.pt2"
    export(surrogate, path)
    mu, time = questions()
    found = torch.export.load(path).module()(torch.from_numpy(mu), torch.from_numpy(time)).detach().numpy()
    expected = np.stack([surrogate.predict(p, [t])[0] for p, t in zip(mu, time, strict=True)])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_exporting_leaves_the_surrogate_as_it_was(surrogate: Surrogate, tmp_path: Path) -> None:
    before = surrogate.predict(plate.parameters(1)[0])
    export(surrogate, tmp_path / "model.pt2")
    np.testing.assert_array_equal(surrogate.predict(plate.parameters(1)[0]), before)


def test_a_file_that_disagrees_is_not_kept(
    surrogate: Surrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surrogates.storage.export.TOLERANCE", -1.0)
    with pytest.raises(SurrogateError, match=r"differs by .* not kept"):
        export(surrogate, tmp_path / "model.pt2")
    assert list(tmp_path.iterdir()) == []


def test_another_suffix_is_refused(surrogate: Surrogate, tmp_path: Path) -> None:
    with pytest.raises(SurrogateError, match=r"model\.pth: .*expected \.onnx or \.pt2"):
        export(surrogate, tmp_path / "model.pth")


def test_a_pod_regression_is_refused(tmp_path: Path) -> None:
    made = train_surrogate(plate.campaign(6), settings("pod-rbf", overrides=["pod.modes=[2]"]))
    with pytest.raises(SurrogateError, match="pod-rbf is no network"):
        export(made, tmp_path / "model.onnx")
