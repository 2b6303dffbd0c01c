"""What every reader checks in the same words."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import CrashkitError, ReadError

# What HDF5, NetCDF, Zarr and XML libraries raise when a file's structure is damaged. A size that cannot be true
# ends in MemoryError.
LIBRARY_ERRORS = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError,
)  # fmt: skip


@contextmanager
def reading(place: object) -> Iterator[None]:
    """What a library raises over a damaged file becomes a ReadError that names `place`."""
    try:
        yield
    except LIBRARY_ERRORS as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise ReadError(f"{place}: cannot be read ({text}); it is cut short or damaged, copy it again") from error


@contextmanager
def closed_if_refused(*opened: Any) -> Iterator[None]:
    """What a run has opened is closed again where the block raises, and not when memory is tidied up."""
    try:
        yield
    except BaseException:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # SciPy keeps a file mapped as long as arrays look into it
            for file in opened:
                file.close()
        raise


def time_problems(time: NDArray[np.float64], places: Sequence[object]) -> list[str]:
    """Sentences about states whose time is not finite or not after the one before; `places` names the states."""
    for k, value in enumerate(time):
        if not np.isfinite(value):
            return [f"{places[k]}: its time is {value}; expected a number"]
        if k and value <= time[k - 1]:
            return [f"{places[k]}: its time {value:g} is not after {time[k - 1]:g}, that of {places[k - 1]}"]
    return []


def require_finite(values: NDArray[np.floating], what: str, place: str) -> None:
    """Raise ReadError with the first index where `values` (node, ...) are no numbers; `place` is file and state."""
    good = np.isfinite(values)
    if not good.all():
        index = int(np.argwhere(~good)[0][0])
        raise ReadError(
            f"{place}: {what} of entry {index} is not a finite number ({int((~good).sum())} such values); "
            "the run diverged or the file is damaged"
        )


def holds_positions(first: NDArray[np.floating], position: NDArray[np.floating]) -> bool:
    """Whether an array (node, 3) called displacement holds current positions instead.

    Told by the first state: displacements are zero there, positions are `position` (node, 3).
    """
    size = float(np.ptp(position, axis=0).max(initial=0.0))
    close = 1e-5 * max(size, float(np.abs(position).max(initial=0.0)))
    is_zero = np.abs(first).max(initial=0.0) <= close
    return bool(np.abs(first - position).max(initial=0.0) <= close and not is_zero)


def require_indices(nodes: NDArray[np.integer], count: int, what: str, place: object, lowest: int = 0) -> None:
    """Raise ReadError where a node number in `nodes` is outside lowest .. count - 1."""
    if nodes.size and (nodes.min() < lowest or nodes.max() >= count):
        wrong = (nodes < lowest) | (nodes >= count)
        row = int(np.argwhere(wrong)[0][0])
        raise ReadError(
            f"{place}: {what} {row} names node {int(nodes[wrong][0])}; expected {lowest} to {count - 1}; "
            "the file is damaged"
        )


def require_options(reader: str, options: Mapping[str, object], known: Sequence[str] = ()) -> None:
    """Raise CrashkitError for an option that is given but not known to the reader."""
    for name, value in options.items():
        if value is not None and name not in known:
            ours = f"its options are {', '.join(known)}" if known else "it has no options"
            raise CrashkitError(f"reader {reader!r} has no option {name!r}; {ours}")


def time_step_option(options: Mapping[str, object]) -> float | None:
    """The option `time_step`, the time between two states.

    Raises
    ------
    CrashkitError
        Where it is no time.
    """
    given = options.get("time_step")
    try:
        step = None if given is None else float(str(given))
    except ValueError:
        step = float("nan")
    if step is not None and not 0 < step < float("inf"):
        raise CrashkitError(f"--time-step is {given!r}; expected the time between two states, such as 0.001")
    return step


def is_damaged_hdf5(path: Path) -> bool:
    """Whether a file has the signature of HDF5 and still cannot be opened; several formats lie in such files."""
    import h5py

    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    try:
        with h5py.File(path, "r"):
            return False
    except LIBRARY_ERRORS:
        return True
