"""Tests do not depend on luck, nor on how they were started.

Property tests draw the same examples every time, so that a run says something about the code and not about luck.

New examples are sought with `pytest --hypothesis-profile=explore`; what it finds belongs into a test as an @example.
"""

from __future__ import annotations

import os
import signal
import tempfile

import pytest
from hypothesis import settings

# Two workers and their child processes share two cores: with more threads each, they would wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A shell starts what runs in the background deaf to Ctrl-C, and children inherit that; tests that interrupt need ears.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.register_profile("explore", max_examples=500, deadline=None)
settings.load_profile("repeatable")

_TEMPORARY = pytest.StashKey[tempfile.TemporaryDirectory]()
_BEFORE = pytest.StashKey[tuple[str, str | None]]()


def pytest_configure(config: pytest.Config) -> None:
    """What tests, their libraries and child processes put into the temporary folder goes with the session.

    pytest's own folders (`tmp_path`) stay where they are, so that those of a failed test can be looked at.
    """
    config.stash[_BEFORE] = tempfile.gettempdir(), os.environ.get("TMPDIR")
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())
    config.stash[_TEMPORARY] = tempfile.TemporaryDirectory(prefix="crashkit-tests-", ignore_cleanup_errors=True)
    os.environ["TMPDIR"] = tempfile.tempdir = config.stash[_TEMPORARY].name


def pytest_unconfigure(config: pytest.Config) -> None:
    tempfile.tempdir, variable = config.stash[_BEFORE]
    if variable is None:
        os.environ.pop("TMPDIR", None)
    else:
        os.environ["TMPDIR"] = variable
    config.stash[_TEMPORARY].cleanup()
