"""Training shared by two processes (torchrun, gloo), and files for TensorBoard."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import plate
import pytest
from test_train_command import dataset, hierarchy

import crashkit
from crashkit.mesh.store import write_hierarchy
from surrogates.storage.folder import load


@pytest.fixture(scope="module")
def crash(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "crash.nc"
    dataset().to_netcdf(path)
    write_hierarchy(path, hierarchy())
    return path


def test_two_processes_have_the_losses_of_one(crash: Path, tmp_path: Path) -> None:
    chosen = ["level.epochs=3", "transfer.epochs=1", "level.batch=16"]
    alone = crashkit.train(crash, tmp_path / "alone", "mh", settings=chosen, test="8:10", device="cpu").surrogate
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2", "-m", "crashkit",
        "train", str(crash), "-o", str(tmp_path / "shared"), "--test", "8:10", "--device", "cpu", "--json",
        *(part for text in chosen for part in ("--set", text)),
    ]  # fmt: skip
    done = subprocess.run(
        command, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    shared = load(tmp_path / "shared")
    for level in (2, 1):
        for name in ("total", "approximation", "reconstruction", "validation_total"):
            np.testing.assert_allclose(shared.history(level)[name], alone.history(level)[name], rtol=2e-4)
    mu = plate.parameters(1, seed=3)[0]
    np.testing.assert_allclose(shared.predict(mu), alone.predict(mu), atol=1e-4)


def test_losses_and_rate_go_to_tensorboard(crash: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    trained = crashkit.train(
        crash, tmp_path / "m", "podnn", settings=["level.epochs=3"], test="8:10", device="cpu",
        tensorboard=tmp_path / "board",
    )  # fmt: skip
    board = EventAccumulator(str(tmp_path / "board")).Reload()
    names = {"total", "approximation", "reconstruction", "validation", "learning_rate"}
    assert set(board.Tags()["scalars"]) == {f"PODNN/{name}" for name in names}
    values = [event.value for event in board.Scalars("PODNN/total")]
    np.testing.assert_allclose(values, trained.surrogate.history(0)["total"], rtol=1e-6)
