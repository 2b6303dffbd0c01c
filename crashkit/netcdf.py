"""One open handle for each NetCDF file, whoever reads it.

NetCDF's library crashes the interpreter on texts in a file that is open twice, and when a group is closed while another
handle of its file is read. So all of this package, and the datasets it gives away, share one handle for each file.
"""

from __future__ import annotations

import contextlib
import inspect
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xarray.backends import FileManager, NetCDF4DataStore

from crashkit.errors import OutputError

if TYPE_CHECKING:
    import netCDF4
    import xarray as xr

_LOCK = threading.RLock()
# What a file is known by -> its handle and how many hold it. A file that was replaced is another one.
_OPEN: dict[tuple[str, int, int, int], list[Any]] = {}


class SharedFile(FileManager):  # type: ignore[type-arg]
    """A hold on the one handle of a file; the last one that lets go closes it. Can be sent to another process."""

    def __init__(self, path: str | Path) -> None:
        self._path = str(Path(path).absolute())
        self._key: tuple[str, int, int, int] | None = None
        about = Path(self._path).stat()
        key = (self._path, about.st_ino, about.st_mtime_ns, about.st_size)
        with _LOCK:
            if key not in _OPEN:
                import netCDF4

                _OPEN[key] = [netCDF4.Dataset(self._path), 0]
            _OPEN[key][1] += 1
            self._handle = _OPEN[key][0]
        self._key = key

    def acquire(self, needs_lock: bool = True) -> netCDF4.Dataset:
        handle: netCDF4.Dataset = self._handle
        return handle

    @contextlib.contextmanager
    def acquire_context(self, needs_lock: bool = True) -> Iterator[netCDF4.Dataset]:
        yield self._handle

    def close(self, needs_lock: bool = True) -> None:
        with _LOCK:
            if self._key is None:
                return
            key, self._key = self._key, None
            _OPEN[key][1] -= 1
            if _OPEN[key][1] == 0:
                _OPEN.pop(key)[0].close()

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # the interpreter may be going down
            self.close()

    def __getstate__(self) -> str:
        return self._path

    def __setstate__(self, path: str) -> None:
        self.__init__(path)  # type: ignore[misc]


def default_indexes(wanted: bool) -> dict[str, Any]:
    """The argument of `xarray.open_dataset` that asks for indexes or not; older versions lack it and always make them."""
    import xarray as xr

    known = "create_default_indexes" in inspect.signature(xr.open_dataset).parameters
    return {} if wanted or not known else {"create_default_indexes": False}


def open_netcdf(path: str | Path, group: str | None = None, chunks: Any = None, *, indexes: bool = True) -> xr.Dataset:
    """The dataset, or a group of it, in the file at `path`, through the shared handle."""
    import xarray as xr

    shared = SharedFile(path)
    try:
        store = NetCDF4DataStore(shared, group=group, mode="r")
        dataset = xr.open_dataset(store, chunks=chunks, **default_indexes(indexes))
    except BaseException:
        shared.close()
        raise
    dataset.set_close(shared.close)
    return dataset


@contextlib.contextmanager
def handle(path: str | Path) -> Iterator[netCDF4.Dataset]:
    """The shared handle itself, for what xarray does not say."""
    shared = SharedFile(path)
    try:
        yield shared.acquire()
    finally:
        shared.close()


@contextlib.contextmanager
def writing(target: Path) -> Iterator[None]:
    """What HDF5 says when the disk is full ("HDF error"), in words: OutputError."""
    try:
        yield
    except RuntimeError as error:
        free = shutil.disk_usage(target.parent).free >> 20
        raise OutputError(
            f"{target.name}: cannot be written ({error}); is the disk full? {free} MB are free in {target.parent}"
        ) from error
