"""Write beside, then replace: the one way in which a file or folder appears under its name, complete or not at all."""

from __future__ import annotations

import contextlib
import ctypes
import glob
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def beside(target: str | Path, *, durable: bool = False) -> Iterator[Path]:
    """A path beside `target` to write a file or a folder at; at the end it takes the place of `target`.

    Nothing appears under `target`, and what was there stays, if the block raises or writes nothing.

    Parameters
    ----------
    target
        A file, or a folder, that need not be there yet. Folders above it are made.
    durable
        Have everything on the disk before it appears, so that a power cut finds the old or the new one whole.

    Yields
    ------
    Path
        Where to write, with the name of `target`; nothing is there yet.

    Raises
    ------
    OSError
        Where nothing can be written there.
    """
    target = Path(target)
    with room_beside(target) as room:
        new = room / target.name
        yield new
        if new.exists():
            put_in_place(new, target, durable=durable)


@contextlib.contextmanager
def room_beside(target: Path) -> Iterator[Path]:
    """A hidden folder beside `target`, on the same disk, gone afterwards; so are those that killed processes left."""
    target.parent.mkdir(parents=True, exist_ok=True)
    sweep(target)
    room = Path(tempfile.mkdtemp(prefix=f"{_mark(target)}{os.getpid()}.", suffix=".part", dir=target.parent))
    try:
        yield room
    finally:
        shutil.rmtree(room, ignore_errors=True)


def _mark(target: Path) -> str:
    """How the names of hidden folders of this machine's processes begin."""
    return f".{target.name}.{re.sub('[^A-Za-z0-9]', '-', platform.node()) or 'here'}."


def sweep(target: Path) -> None:
    """Delete the hidden folders beside `target` whose process has ended."""
    mark = _mark(target)
    for left in target.parent.glob(f"{glob.escape(mark)}*.part"):
        process = left.name.removeprefix(mark).split(".")[0]
        if process.isdigit() and not _runs(int(process)):
            shutil.rmtree(left, ignore_errors=True)


def _runs(process: int) -> bool:
    """Whether there is such a process; True where asking could end it."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def put_in_place(new: Path, target: Path, *, durable: bool = False) -> None:
    """Make `new` the file or folder `target`, on the same disk; what was there is gone afterwards.

    A file, and a folder that was not there, appears in one step. A folder that was there is exchanged in one step
    where the system can do that (Linux); elsewhere it is first set aside, as `set_aside(new, target)`, and comes back
    if the new one cannot take its place.
    """
    if durable:
        _synchronise(new)
    if not target.is_dir():
        new.replace(target)
    elif not _exchange(new, target):
        old = set_aside(new, target)
        target.replace(old)
        try:
            new.replace(target)
        except OSError:
            old.replace(target)
            raise
    if durable:
        _synchronise_folder(target.absolute().parent)
    for left in (set_aside(new, target), new):
        remove(left)


def set_aside(new: Path, target: Path) -> Path:
    """Where a folder is for the moment in which `new` takes its place."""
    return new.with_name(f"replaced{target.suffix}")


def remove(path: Path) -> None:
    """Delete a file or folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _exchange(one: Path, other: Path) -> bool:
    """Let two folders change places in one step; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of renameat2(2)
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # a C library from before 2018
        return False
    return bool(rename(here, os.fsencode(one), here, os.fsencode(other), ctypes.c_uint(exchange)) == 0)


def _synchronise(path: Path) -> None:
    """Have everything under `path` on the disk."""
    files = [path] if path.is_file() else [Path(folder) / f for folder, _, names in os.walk(path) for f in names]
    for file in files:
        with file.open("rb+" if os.name == "nt" else "rb") as stream:  # Windows wants it open for writing
            os.fsync(stream.fileno())
    if path.is_dir():
        for folder, _, _ in os.walk(path):
            _synchronise_folder(Path(folder))


def _synchronise_folder(folder: Path) -> None:
    if os.name == "nt":  # Windows has no handle of a folder, and needs none
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
