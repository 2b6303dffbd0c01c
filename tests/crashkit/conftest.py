"""Fixtures of the tests of data going in and coming out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from memory_runs import RunsInMemory

from crashkit import readers


@pytest.fixture
def memory() -> Iterator[RunsInMemory]:
    """A reader of runs in memory, known as `memory` during the test."""
    readers.readers()
    reader = RunsInMemory()
    readers.register(reader)
    yield reader
    readers._READERS.pop("memory")


@pytest.fixture(scope="session")
def demo_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The embedded kart runs as a dataset; not to be changed."""
    from crashkit.dataset import demo_data
    from crashkit.ingestion.ingest import ingest

    output = tmp_path_factory.mktemp("demo") / "kart.zarr"
    ingest(demo_data(), output)
    return output


@pytest.fixture
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files need not survive a power cut during a test."""
    monkeypatch.setattr("data_schema.replace._synchronise", lambda path: None)
