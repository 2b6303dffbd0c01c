"""lasso-python, kept on a lead: bounded loops, no output of its own, and failures that are raised.

lasso-python configures the root logger when imported, prints failures while parsing and goes on, and loops over
counts that a file gives. Its classes are used below their front door here, since that loads the whole first file and
parses the mesh anew for every slice of states.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from crashkit.errors import ReadError


@cache
def header_class() -> Any:
    """lasso-python's D3plotHeader."""
    _swallowed()
    from lasso.dyna.d3plot_header import D3plotHeader

    return D3plotHeader


@cache
def d3plot_class() -> Any:
    """lasso-python's D3plot, which reads a whole family and writes one."""
    _swallowed()
    from lasso.dyna import D3plot

    return D3plot


@cache
def geometry_class() -> Any:
    """lasso-python's D3plot for a geometry section in memory, with its loops bounded."""
    _swallowed()
    from lasso.dyna import D3plot
    from lasso.io.binary_buffer import BinaryBuffer

    class Geometry(D3plot):  # type: ignore[misc]
        def __init__(self, content: bytes) -> None:
            super().__init__()
            self._buffer = BinaryBuffer()
            self._buffer.memoryview = memoryview(content)
            self._read_header()
            self._parse_geometry()
            self._buffer = None

        def _bound(self, what: str, place: int, limit: int) -> None:
            """lasso-python loops over counts from the file; a count that cannot be true is refused."""
            at = self.geometry_section_size + place * self.header.wordsize
            count = int(self._buffer.read_number(at, self.header.itype))
            if not 0 <= count <= limit:
                raise ValueError(f"{count} {what}, expected at most {limit}")

        def _read_particle_data(self) -> None:
            if self._buffer and 0 < self.header.raw_header["npefg"] <= 10_000_000:
                for place in (0, 1, 3):
                    self._bound("airbag variables", place, 10_000)
                self._bound("airbag particles", 2, 1 << 28)
            super()._read_particle_data()

        def _read_rigid_body_description(self) -> None:
            if self._buffer and self.header.has_rigid_body_data:
                self._bound("rigid bodies", 0, self.header.n_parts)
            super()._read_rigid_body_description()

        def _read_rigid_road_surface(self) -> None:
            if self._buffer and self.header.has_rigid_road_surface:
                for place, what in enumerate(("road nodes", "road segments", "road surfaces")):
                    self._bound(what, place, len(self._buffer) // self.header.wordsize)
            super()._read_rigid_road_surface()

    return Geometry


class _Swallowed(logging.Handler):
    """Keeps what lasso-python logs instead of raising, for the thread that it was logged in."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = record.getMessage()
        except (TypeError, ValueError):  # some of its messages do not fit their arguments
            text = str(record.msg)
        self.found.__dict__.setdefault("messages", []).append(text)


@cache
def _swallowed() -> _Swallowed:
    # lasso-python configures the root logger when imported, which is for the application to do: this has to be the
    # first import of it, so that what it adds is known and can be taken away again.
    root = logging.getLogger()
    before = list(root.handlers)
    from lasso.dyna import d3plot, d3plot_header

    for handler in [h for h in root.handlers if h not in before]:
        root.removeHandler(handler)
    keeper = _Swallowed()
    for logger in (d3plot.LOGGER, d3plot_header.LOGGER):
        logger.addHandler(keeper)
        logger.propagate = False
    return keeper


@contextmanager
def guarded(file: Path) -> Iterator[None]:
    """What lasso-python raises or logs becomes a ReadError."""
    keeper = _swallowed()
    keeper.found.messages = []
    try:
        yield
    except ReadError:
        raise
    except Exception as error:  # it raises whatever numpy or struct meet in its way
        raise ReadError(f"{file}: not readable as d3plot ({error}); the file is damaged, copy it again") from error
    for message in keeper.found.messages:
        last = " ".join(message.strip().splitlines()[-1].split())
        raise ReadError(f"{file}: not fully understood as d3plot ({last}); the file is damaged or of an unknown kind")
