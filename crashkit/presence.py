"""Whether there is a dataset at all: seen at a glance, before anything heavy is imported or read."""

from __future__ import annotations

from pathlib import Path

from crashkit.errors import ReadError


def require_dataset(path: str | Path) -> None:
    """Raise ReadError where nothing at `path` can be a crash dataset."""
    path = Path(path)
    if not path.exists():
        raise ReadError(f"{path}: no such dataset; make one with crashkit ingest, or check the path")
    if (path / "model.json").exists():
        raise ReadError(f"{path}: is a model folder; expected a dataset made by crashkit ingest")
    if path.is_dir() and not (path / "zarr.json").exists():
        raise ReadError(f"{path}: is a folder, but no Zarr store; expected a dataset made by crashkit ingest")
