"""LS-DYNA's binout: glstat, matsum, rwforc, nodout and their like as curves, through lasso-python.

Each database holds arrays (sample,) or (sample, object) by name, with the objects' numbers in `ids`. Databases are
written at times of their own; the curves of a run are brought to those of the first one, linear in between.
"""

from __future__ import annotations

import contextlib
import io
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers.history import Channel, History, distinct, quantity_of

# Databases that are read, in this order; the first one that is there gives the times.
_DATABASES = (
    "glstat",
    "matsum",
    "rwforc",
    "nodout",
    "secforc",
    "rcforc",
    "abstat",
    "deforc",
    "bndout",
    "sleout",
    "rbdout",
)
_NO_CURVE = {
    "time",
    "ids",
    "cycle",
    "date",
    "legend",
    "legend_ids",
    "revision",
    "title",
    "version",
    "version_number",
    "state",
}


def binout_files(folder: Path) -> list[Path]:
    """The binout family of `folder`, in order."""
    return sorted(p for p in folder.glob("binout*") if p.is_file() and not p.suffix)


def read_binout(files: Sequence[Path]) -> History:
    """The curves of a binout family.

    Raises
    ------
    ReadError
        Where it holds none, or is damaged.
    """
    channels: list[Channel] = []
    columns: list[NDArray[np.float64]] = []
    times: NDArray[np.float64] | None = None
    with _opened(files) as databases:
        for name in _DATABASES:
            for arrays in _arrays(databases, name):
                time = _times(arrays)
                if time is None:
                    continue
                times = time if times is None else times
                for channel, values in _curves(name, arrays, len(time)):
                    channels.append(channel)
                    columns.append(np.interp(times, time, values))
    if times is None or not channels:
        raise ReadError(
            f"{files[0]}: holds none of {', '.join(_DATABASES)}; ask for them with *DATABASE_GLSTAT and so on"
        )
    return History(times, distinct(channels), np.stack(columns, axis=1))


@contextlib.contextmanager
def _opened(files: Sequence[Path]) -> Iterator[Mapping[str, Any]]:
    """The family as nested mappings. What lasso-python prints or raises on damaged files becomes one line."""
    from lasso.dyna.lsda_py3 import Lsda

    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            family = Lsda([str(f) for f in files], "r")
            yield _children(family.root)
    except ReadError:
        raise
    except Exception as error:  # whatever the library raises on bytes it does not expect
        with contextlib.redirect_stderr(io.StringIO()):  # what is left of its reader complains when it is let go
            traceback.clear_frames(error.__traceback__)
        raise ReadError(
            f"{files[0]}: cannot be read as a binout ({type(error).__name__}: {' '.join(str(error).split())[:120]}); "
            f"it is cut short or damaged, copy it again"
        ) from error


def _arrays(databases: Mapping[str, Any], name: str) -> Iterator[dict[str, NDArray[Any]]]:
    """The arrays of a database by name, states joined; rwforc and the like hold them in a folder `forces`."""
    found = databases.get(name)
    if found is None:
        return
    inside = _children(found)
    home = _children(inside["forces"]) if "forces" in inside else inside
    states = sorted((k for k in home if k[:1] == "d" and k[1:].isdigit()), key=lambda k: int(k[1:]))
    arrays: dict[str, list[NDArray[Any]]] = {}
    for state in states:
        for key, symbol in _children(home[state]).items():
            arrays.setdefault(key, []).append(np.atleast_1d(symbol.read()))
    out = {
        key: np.stack(pieces)[:, 0] if pieces[0].shape == (1,) else np.stack(pieces)
        for key, pieces in arrays.items()
        if len(pieces) == len(states) and len({p.shape for p in pieces}) == 1
    }
    metadata = home.get("metadata") or inside.get("metadata")
    if metadata is not None and "ids" in _children(metadata):
        out["ids"] = np.atleast_1d(_children(metadata)["ids"].read())
    yield out


def _children(symbol: Any) -> dict[str, Any]:
    """What a folder holds, by name: folders are named in text, arrays in bytes."""
    return {k.decode("latin-1") if isinstance(k, bytes) else str(k): v for k, v in symbol.children.items()}


def _times(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float64] | None:
    time = arrays.get("time")
    if time is None or time.ndim != 1 or len(time) < 2:
        return None
    time = time.astype(np.float64)
    return time if (np.diff(time) > 0).all() else None


def _curves(
    database: str, arrays: Mapping[str, NDArray[Any]], samples: int
) -> Iterator[tuple[Channel, NDArray[np.float64]]]:
    ids = arrays.get("ids")
    for key, values in arrays.items():
        if key in _NO_CURVE or values.dtype.kind not in "fiu" or len(values) != samples:
            continue
        numbers = values.astype(np.float64)
        if numbers.ndim == 1:
            yield Channel(f"{database}_{key}", quantity_of(key)), numbers
        elif numbers.ndim == 2:
            objects = ids if ids is not None and len(ids) == numbers.shape[1] else range(1, numbers.shape[1] + 1)
            for k, number in enumerate(objects):
                yield Channel(f"{database}_{int(number)}_{key}", quantity_of(key)), numbers[:, k]
