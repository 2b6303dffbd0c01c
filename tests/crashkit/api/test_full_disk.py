"""A full disk at the end of a training costs nothing: the model is kept elsewhere, and the next start stores it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate
import pytest
import xarray as xr

import crashkit
from crashkit.errors import OutputError
from surrogates.errors import ModelFolderError
from surrogates.settings import settings
from surrogates.storage import folder as storage
from surrogates.training import train as training
from surrogates.training.checkpoints import Checkpoints


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    mu = plate.parameters(8)
    path = tmp_path / "crash.nc"
    xr.Dataset(
        {
            "displacement": (("sim", "time", "node", "xyz"), plate.displacement(mu), {"units": "m"}),
            "reference_position": (("node", "xyz"), plate.grid(9), {"units": "m"}),
            "node_id": ("node", np.arange(1, 82)),
            "face_nodes": (("face", "corner"), plate.quads(9)),
            "face_part": ("face", np.zeros(64, np.int32)),
            "part_id": ("part", [7]),
            "part_name": ("part", np.array(["plate"], "O")),
            "impact_speed": ("sim", mu[:, 0], {"units": "m s-1", "role": "parameter"}),
        },
        coords={"sim": [f"run_{k:03d}" for k in range(8)], "time": ("time", plate.TIME, {"units": "s"})},
        attrs={"checksum": "abc", "solver": "plate"},
    ).to_netcdf(path)
    return path


def test_a_model_that_cannot_be_stored_is_kept_and_stored_by_the_next_start(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, target = storage.save, tmp_path / "gpr"

    def full(surrogate: object, folder: Path, **options: bool) -> Path:
        if Path(folder) == target:
            raise ModelFolderError(f"{folder}: cannot be written (No space left on device)")
        return real(surrogate, folder, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(storage, "save", full)
        with pytest.raises(OutputError, match=r"No space left on device.*is kept in .*the same command stores it"):
            crashkit.train(dataset, target, model="pod-gpr")
    assert not target.exists()

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(training, "train_surrogate", refuse)
    model = crashkit.train(dataset, target, model="pod-gpr")
    assert (target / "model.json").exists()
    assert any("earlier start" in note for note in model.surrogate.record.notes)


def test_a_state_that_cannot_be_written_does_not_end_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    campaign, chosen = plate.campaign(8), settings("mh", overrides=["level.epochs=2", "transfer.epochs=1"])
    keeper = Checkpoints(tmp_path / "state", chosen, campaign, every=1)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("surrogates.training.checkpoints.save_file", full)
    surrogate = training.train_surrogate(campaign, chosen, keeper=keeper)
    assert surrogate.predict(campaign.parameters[0], campaign.time, 1).shape == (7, 25, 3)
    assert "goes on without it" in caplog.text
