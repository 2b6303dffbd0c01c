"""The state of a training between epochs, so that a killed one goes on where it was."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from data_schema.replace import beside
from surrogates.data.campaign import Campaign
from surrogates.errors import SurrogateError
from surrogates.settings import Settings

_log = logging.getLogger(__name__)
_IDENTITY = "training.json"
_SECONDS = 30.0


class Checkpoints:
    """A folder with one file a level: its tensors, and the rest as JSON in the file's header.

    Parameters
    ----------
    every
        Epochs between two files of one level; 0: about every half minute.
    resume
        Go on from what is there, which must be the same training; without, the folder starts empty.

    Raises
    ------
    SurrogateError
        If there is nothing to resume, or it belongs to another training.
    """

    def __init__(
        self, folder: Path, settings: Settings, campaign: Campaign, *, every: int = 0, resume: bool = False
    ) -> None:
        self.folder, self.every = folder, every
        self._last = time.monotonic()
        self._writes = _rank() == 0
        identity = {
            "settings": settings.as_dict(), "data": campaign.checksum, "runs": list(campaign.runs),
            "mesh hierarchy": _digest(campaign),
        }  # fmt: skip
        if campaign.coarse is not None:
            identity["coarse runs"] = [campaign.coarse.campaign.checksum, *campaign.coarse.campaign.runs]
        self.fingerprint = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
        if resume:
            self._check(identity)
        elif self._writes:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            (folder / _IDENTITY).write_text(json.dumps(identity), encoding="utf-8")

    def load(self, name: str) -> tuple[Mapping[str, Tensor], dict[str, Any]] | None:
        """Tensors, each read when it is asked for, and the rest of level `name`, or None."""
        path = self._path(name)
        if not path.exists():
            return None
        try:
            with safe_open(path, framework="pt") as file:
                return _Stored(path, list(file.keys())), json.loads((file.metadata() or {})["about"])
        except (SafetensorError, KeyError, ValueError) as error:
            raise SurrogateError(f"{path}: is damaged ({error}); train again without resuming") from error

    def due(self, epoch: int) -> bool:
        """Whether it is time to write, after `epoch` epochs."""
        return epoch % self.every == 0 if self.every else time.monotonic() - self._last >= _SECONDS

    def save(self, name: str, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
        """Write level `name`; the file before stays until the new one is complete."""
        path = self._path(name)
        self._last = time.monotonic()
        try:
            with beside(path, durable=True) as new:
                save_file({k: v.contiguous().cpu() for k, v in tensors.items()}, new, {"about": json.dumps(about)})
        except (OSError, SafetensorError) as error:  # a full disk costs the checkpoint, and not the training
            _log.warning(
                "%s: the state of the training cannot be written (%s); the training goes on without it", path, error
            )

    def discard(self) -> None:
        """Forget everything: the training is finished and stored."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"

    def _check(self, identity: dict[str, Any]) -> None:
        mark = self.folder / _IDENTITY
        try:
            stored = json.loads(mark.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise SurrogateError(f"{self.folder}: holds no training to go on from; train without resuming") from error
        for key, value in identity.items():
            if stored.get(key) != json.loads(json.dumps(value)):
                raise SurrogateError(
                    f"{self.folder}: belongs to a training with other {key}; train without resuming, or with the same {key}"
                )


class _Stored(Mapping[str, Tensor]):
    """The tensors of a file. It is opened anew for each, since what was read of an open one stays in memory."""

    def __init__(self, path: Path, names: list[str]) -> None:
        self._path, self._names = path, names

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._names:
            raise KeyError(name)
        with safe_open(self._path, framework="pt") as file:
            tensor: Tensor = file.get_tensor(name)
        return tensor

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _digest(campaign: Campaign) -> str:
    """What tells hierarchies apart that have the same numbers of nodes; the dataset's checksum does not cover them."""
    nodes = [np.asarray(level.kept, np.int64).tobytes() for level in campaign.levels]
    return hashlib.sha256(b"".join(nodes)).hexdigest()[:16]


def _rank() -> int:
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0
