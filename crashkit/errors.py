"""What goes wrong for a user, said so that they can mend it."""

from __future__ import annotations


class CrashkitError(Exception):
    """A failure the user can act on.

    The message is one line: what was found (with file and place), what was expected, what to do.
    The command line prints it and exits with 1; no traceback.
    """


class ReadError(CrashkitError):
    """A source file cannot be read as what it claims to be, or is incomplete."""


class DataError(CrashkitError):
    """The data is readable but not usable: wrong units, topology, parameters, missing hierarchy."""


class MeshError(CrashkitError):
    """A mesh operation cannot do what was asked."""


class OutputError(CrashkitError):
    """A result cannot be written where it was asked to go."""
