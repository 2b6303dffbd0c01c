"""The weights of a training's best epoch so far: on the device, or in a file where they would be a burden in memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from typing import IO

import torch
from torch import Tensor

from surrogates.errors import SurrogateError

# Bytes of weights above which the best ones are in an unnamed temporary file, on a CPU.
IN_MEMORY = 64 << 20


class BestWeights:
    """A copy of tensors that go on changing; none is kept at first.

    Parameters
    ----------
    live
        The tensors by name.
    """

    def __init__(self, live: Mapping[str, Tensor], in_memory: int | None = None) -> None:
        self._live = live
        size = sum(t.numel() * t.element_size() for t in live.values())
        on_cpu = all(t.device.type == "cpu" and t.is_contiguous() for t in live.values())
        large = on_cpu and size > (IN_MEMORY if in_memory is None else in_memory)
        self._copies: dict[str, Tensor] = {}
        self._file: IO[bytes] | None = tempfile.TemporaryFile(prefix="crashkit-best-") if large else None  # noqa: SIM115 - as long as this
        self._kept = False

    def __bool__(self) -> bool:
        return self._kept

    def keep(self, value_of: Callable[[str], Tensor] | None = None) -> None:
        """Copy the tensors as they are, or what `value_of` gives for their names, one after the other.

        Raises
        ------
        SurrogateError
            Where the temporary folder has no room.
        """
        given = self._live.__getitem__ if value_of is None else value_of
        if self._file is None:
            self._copies = {name: given(name).detach().to(live.device, copy=True) for name, live in self._live.items()}
        else:
            try:
                self._file.seek(0)
                for name in self._live:
                    self._file.write(_bytes_of(given(name).contiguous()))
            except OSError as error:
                raise SurrogateError(
                    f"{tempfile.gettempdir()}: no room for the best weights ({error.strerror}); make room there, or "
                    "name another folder in the environment variable TMPDIR"
                ) from error
        self._kept = True

    def restore(self) -> None:
        """Put what is kept back into the tensors."""
        if self._kept:
            self._read_into({name: tensor.detach() for name, tensor in self._live.items()})

    def tensors(self) -> dict[str, Tensor]:
        """What is kept, by name; empty where nothing is."""
        if not self._kept or self._file is None:
            return self._copies
        out = {name: torch.empty_like(tensor) for name, tensor in self._live.items()}
        self._read_into(out)
        return out

    def _read_into(self, targets: Mapping[str, Tensor]) -> None:
        if self._file is None:
            for name, target in targets.items():
                target.copy_(self._copies[name])
            return
        self._file.seek(0)
        for target in targets.values():
            self._file.readinto(_bytes_of(target))  # type: ignore[attr-defined]


def _bytes_of(tensor: Tensor) -> memoryview:
    data: memoryview = tensor.detach().view(-1).view(torch.uint8).numpy().data
    return data
