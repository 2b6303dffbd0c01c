"""Arrays of states that may be larger than memory: in memory while they are small, else in an unnamed temporary file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

# Bytes up to which an array stays in memory.
IN_MEMORY = 64 << 20


class Shelf:
    """Rows of float32 arrays of one `shape`, written and read by their numbers."""

    def __init__(self, rows: int, shape: tuple[int, ...], in_memory: int | None = None) -> None:
        self.rows, self.shape = rows, shape
        self._bytes = 4 * int(np.prod(shape, dtype=np.int64))
        small = rows * self._bytes <= (IN_MEMORY if in_memory is None else in_memory)
        self._array: NDArray[np.float32] | None = np.empty((rows, *shape), np.float32) if small else None
        self._file: IO[bytes] | None = (
            None if small else tempfile.TemporaryFile(prefix="crashkit-states-")  # noqa: SIM115 - as long as the shelf
        )

    @property
    def array(self) -> NDArray[np.float32] | None:
        """(row, ..), where all of it is in memory."""
        return self._array

    def put(self, first: int, values: NDArray[np.float32]) -> None:
        """Write `values` (row, ..) from row `first` on.

        Raises
        ------
        SurrogateError
            Where the temporary folder has no room.
        """
        if self._array is not None:
            self._array[first : first + len(values)] = values
            return
        assert self._file is not None
        try:
            self._file.seek(first * self._bytes)
            self._file.write(np.ascontiguousarray(values, np.float32).data.cast("B"))
        except OSError as error:
            raise SurrogateError(
                f"{tempfile.gettempdir()}: no room for {self.rows * self._bytes / 1e9:.1f} GB of states "
                f"({error.strerror}); make room there, or name another folder in the environment variable TMPDIR"
            ) from error

    def take(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """(row, ..) of the given numbers, a copy."""
        if self._array is not None:
            return self._array[rows]
        assert self._file is not None
        out = np.empty((len(rows), *self.shape), np.float32)
        for place, row in zip(out, rows, strict=True):
            self._file.seek(int(row) * self._bytes)
            self._file.readinto(place.data.cast("B"))  # type: ignore[attr-defined]
        return out


class StoredStates:
    """States (sample, 3, node) on a shelf, divided by `scale` as they are read; indexed as a tensor of them would be."""

    def __init__(self, shelf: Shelf) -> None:
        self._shelf = shelf
        self.scale = 1.0

    def __len__(self) -> int:
        return self._shelf.rows

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one state: (3, node)."""
        return self._shelf.shape

    @property
    def nbytes(self) -> int:
        """Bytes of all states."""
        return 4 * len(self) * int(np.prod(self.shape, dtype=np.int64))

    def __getitem__(self, index: Tensor | slice) -> Tensor:
        import torch

        rows = np.arange(len(self))[index] if isinstance(index, slice) else index.cpu().numpy()
        return torch.from_numpy(self._shelf.take(rows)).div_(self.scale)

    def split(self, count: int) -> Iterator[Tensor]:
        """All states, `count` at a time."""
        return (self[slice(k, min(k + count, len(self)))] for k in range(0, len(self), count))


def moved(states: States, device: torch.device, room: int | None = None) -> States:
    """States on `device`: from a file into the memory of a CUDA device that has room for them, else they stay there.

    room  bytes that they may take; None: half of what is free on a CUDA device, nothing elsewhere
    """
    import torch

    if isinstance(states, torch.Tensor):
        return states.to(device)
    if room is None:
        room = torch.cuda.mem_get_info(device)[0] // 2 if device.type == "cuda" else 0
    if states.nbytes > room:
        return states
    out = torch.empty((len(states), *states.shape), device=device)
    row = 0
    for part in states.split(1024):
        out[row : row + len(part)] = part
        row += len(part)
    return out


States: TypeAlias = "Tensor | StoredStates"


def divide(states: States, by: float) -> None:
    """Divide in place, or from now on."""
    if isinstance(states, StoredStates):
        states.scale *= by
    else:
        states /= by
