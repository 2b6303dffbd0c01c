"""Folders that appear under their name when everything in them is complete, and never half-written; names of results."""

from __future__ import annotations

import contextlib
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator
from pathlib import Path

from crashkit.errors import OutputError
from data_schema.replace import beside


def refuse_earlier(output: Path, mark: str, what: str, option: str = "-o") -> None:
    """Raise OutputError where `output` holds an earlier result, known by its file `mark`, that nobody asked to replace."""
    if (output / mark).exists():
        raise OutputError(
            f"{output}: holds a {what} already; replace it with --overwrite, or choose another place with {option}"
        )


def check_folder(output: Path, mark: str) -> None:
    """Raise OutputError if `complete_folder` could not make `output`: better now than after the work."""
    if output.exists() and not (output / mark).exists() and (not output.is_dir() or any(output.iterdir())):
        raise OutputError(
            f"{output}: exists and holds no {mark}; expected a new folder, or an earlier result to replace"
        )
    home = next(place for place in output.absolute().parents if place.exists())
    if not home.is_dir():
        raise OutputError(f"{output}: no folder can be made there ({home} is a file); choose another with -o")
    if not os.access(home, os.W_OK | os.X_OK):
        raise OutputError(f"{output}: no folder can be made there (no permission in {home}); choose another with -o")


def refuse_there(outputs: Iterable[Path], overwrite: bool) -> None:
    """Raise OutputError where one of `outputs` is there already and nobody asked to replace it; an empty folder may be."""
    if overwrite:
        return
    there = [path for path in outputs if path.exists() and not (path.is_dir() and not any(path.iterdir()))]
    if there:
        more = f", as are {len(there) - 1} more of what would be written" if there[1:] else ""
        raise OutputError(f"{there[0]}: is there already{more}; replace it with --overwrite, or choose another place")


@contextlib.contextmanager
def complete_folder(output: Path, mark: str) -> Iterator[Path]:
    """A new folder beside `output` that takes its place when the block ends well, and vanishes otherwise.

    Parameters
    ----------
    mark
        Name of a file by which an earlier result is known: only such a folder, or an empty one, is replaced.

    Raises
    ------
    OutputError
        Where `output` is something else, or nothing can be written there.
    """
    check_folder(output, mark)
    try:
        with contextlib.ExitStack() as stack:
            try:
                new = stack.enter_context(beside(output))
                new.mkdir()
            except OSError as error:
                raise OutputError(
                    f"{output}: no folder can be made there ({error.strerror or error}); choose another with -o"
                ) from error
            yield new
    except OSError as error:
        raise OutputError(
            f"{output}: cannot be written ({error.strerror or error}); check permissions and free space"
        ) from error


def file_name(name: str) -> str:
    """`name` with everything that is troublesome in file names replaced by a dash.

    Letters of all languages stay, accents in one form: VTK, ParaView, HDF5, Zarr and all present file systems take them.
    """
    return re.sub(r"[^\w.+=-]+", "-", unicodedata.normalize("NFC", name)).strip("-.") or "run"


def check_model_folder(output: Path, overwrite: bool, resume: bool = False) -> None:
    """Raise OutputError if a model cannot be stored as the folder `output`: better now than after the training."""
    if output.exists():
        if not output.is_dir() or (any(output.iterdir()) and not (output / "model.json").exists()):
            raise OutputError(f"{output}: exists and is no model folder; choose another place with -o")
        if not overwrite and any(output.iterdir()):
            if resume:
                raise OutputError(
                    f"{output}: holds a finished training, so there is nothing to resume; to go on with further seeds of a "
                    "series that was interrupted, give --overwrite beside --resume"
                )
            raise OutputError(f"{output}: holds a model already; replace it with --overwrite, or choose another place")
    home = output.absolute().parent
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another place with -o") from error
    if not os.access(home, os.W_OK | os.X_OK):
        raise OutputError(f"{output}: cannot be written (no permission in {home}); choose another place with -o")
