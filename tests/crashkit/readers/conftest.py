"""Real inputs for the readers: solver files, and a piece of a real kart run to write other formats with."""

from __future__ import annotations

import lzma
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import h5py
import numpy as np
import pytest

from crashkit.readers import reader_for
from crashkit.readers.base import Run

DATA = Path(__file__).parents[2] / "data"


@dataclass(frozen=True)
class Sample:
    """162 nodes and 120 triangles of a kart run in 3 states; lengths in m, times in s."""

    points: np.ndarray
    faces: np.ndarray
    displacement: np.ndarray
    time: np.ndarray


@pytest.fixture(scope="session")
def sample() -> Sample:
    with h5py.File(str(files("crashkit") / "data" / "kart_demo.h5")) as file:
        faces = file["kart/faces"][:120]
        kept = np.unique(faces)
        return Sample(
            points=file["kart/reference_configuration"][3][kept].astype(float),
            faces=np.searchsorted(kept, faces),
            displacement=file["kart/displacements"][3, ::10][:, kept],
            time=file["time"][::10],
        )


@pytest.fixture
def data(tmp_path) -> Callable[[str], Path]:
    """A copy of a folder of tests/data, packed files unpacked, that a test may damage."""

    def copy(name: str) -> Path:
        folder = tmp_path / Path(name).name
        shutil.copytree(DATA / name, folder)
        for packed in folder.glob("*.xz"):
            packed.with_suffix("").write_bytes(lzma.decompress(packed.read_bytes()))
            packed.unlink()
        return folder

    return copy


@pytest.fixture
def only_run() -> Callable[..., Run]:
    """The one run at a path, through the reader that recognises it."""

    def read(path: Path, reader: str | None = None, **options: object) -> Run:
        (run,) = reader_for(path, reader).runs(path, **options)
        return run

    return read
