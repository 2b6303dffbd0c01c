"""Whether there is a model folder at all: seen at a glance, before torch is imported or anything is read."""

from __future__ import annotations

from pathlib import Path

from surrogates.errors import ModelFolderError

MAIN = "model.json"


def require_model_folder(folder: str | Path) -> None:
    """Raise ModelFolderError where nothing at `folder` can be a stored model."""
    folder = Path(folder)
    if not folder.exists():
        raise ModelFolderError(f"{folder}: no such model folder; crashkit train makes one")
    if folder.name == MAIN:
        raise ModelFolderError(f"{folder}: lies in a model folder; give the folder, {folder.parent}")
    if (folder / "zarr.json").exists() or folder.suffix in (".nc", ".h5"):
        raise ModelFolderError(f"{folder}: is a dataset; expected a model folder made by crashkit train")
    if not (folder / MAIN).is_file():
        raise ModelFolderError(f"{folder}: holds no {MAIN}; expected a model folder made by crashkit train")
