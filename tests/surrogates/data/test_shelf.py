"""States in a temporary file are those in memory, and a training does not tell them apart."""

from __future__ import annotations

import numpy as np
import plate
import pytest
import torch

from surrogates.data import shelf as module
from surrogates.data.samples import LevelRuns, Notes
from surrogates.data.shelf import Shelf, StoredStates, divide, moved
from surrogates.errors import SurrogateError
from surrogates.settings import settings
from surrogates.training import objectives
from surrogates.training.train import train_surrogate


def test_rows_come_back_from_a_file_as_from_memory() -> None:
    values = np.random.default_rng(0).standard_normal((9, 2, 3)).astype(np.float32)
    for in_memory in (0, 1 << 20):
        shelf = Shelf(9, (2, 3), in_memory)
        shelf.put(4, values[4:])
        shelf.put(0, values[:4])
        np.testing.assert_array_equal(shelf.take(np.array([8, 0, 3])), values[[8, 0, 3]])
        assert (shelf.array is None) == (in_memory == 0)


@pytest.mark.parametrize("room", [239, 240])
def test_states_leave_the_file_for_a_device_with_room(room: int) -> None:
    values = torch.arange(60.0).reshape(5, 3, 4)
    shelf = Shelf(5, (3, 4), in_memory=0)
    shelf.put(0, values.numpy())
    stored = StoredStates(shelf)
    divide(stored, 2.0)
    found = moved(stored, torch.device("cpu"), room)
    assert found is stored if room < 240 else torch.equal(found, values / 2)


def test_stored_states_are_indexed_and_divided_as_a_tensor_is() -> None:
    values = torch.arange(60.0).reshape(5, 3, 4)
    shelf = Shelf(5, (3, 4), in_memory=0)
    shelf.put(0, values.numpy())
    stored = StoredStates(shelf)
    divide(stored, 2.0)
    divide(values, 2.0)
    assert torch.equal(stored[torch.tensor([3, 1])], values[[3, 1]])
    assert torch.equal(stored[::2], values[::2])
    assert torch.equal(torch.cat(list(stored.split(2))), values)


def test_a_full_disk_is_said_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def seek(self, place: int) -> None: ...

        def write(self, values: object) -> None:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.tempfile, "TemporaryFile", lambda **_: Full())
    with pytest.raises(SurrogateError, match=r"no room for 0\.0 GB of states \(No space left on device\).*TMPDIR"):
        Shelf(2, (3,), in_memory=0).put(0, np.zeros((2, 3), np.float32))


def test_what_states_are_like_is_noted_as_they_pass() -> None:
    runs = LevelRuns(plate.campaign(4), 1, settings("mh"), Notes())
    known = np.ones((3, len(plate.TIME)), bool)
    known[1, 5:] = False
    states, seen = runs.gathered(np.array([0, 2, 3]), known)
    every = runs.samples(np.array([0, 2, 3]))
    assert torch.equal(states[:], every[torch.from_numpy(known.ravel())])
    assert seen.mean_square == pytest.approx(float(states[:].double().square().mean()), rel=1e-6)
    assert seen.largest == float(states[:].abs().max())
    assert seen.first == float(every[:: len(plate.TIME)].abs().max())
    by_state = every.unflatten(0, (3, -1)).square().mean(dim=(0, 2, 3)).sqrt()
    np.testing.assert_allclose(seen.course, by_state, rtol=1e-5)


def test_training_from_a_file_in_pieces_gives_the_model_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def predicted() -> np.ndarray:
        wish = settings("mh", overrides=["level.epochs=2", "level.batch=8", "level.start=plain"])
        return train_surrogate(plate.campaign(6), wish).predict([20.0, 2.0, 3e8])

    whole = predicted()
    monkeypatch.setattr(module, "IN_MEMORY", 0)
    for bound in ("_NODES", "_NODES_IN_TRAINING"):  # so that batches, and what is encoded at once, are cut
        monkeypatch.setattr(objectives, bound, 64)
    np.testing.assert_allclose(predicted(), whole, rtol=1e-3, atol=1e-3 * np.abs(whole).max())
