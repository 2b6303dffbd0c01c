"""What goes wrong in training, storing and asking a surrogate, said so that it can be mended."""

from __future__ import annotations


class SurrogateError(Exception):
    """One line: what was found, what was expected, what to do."""


class ModelFolderError(SurrogateError):
    """A model folder is missing something, was altered, or belongs to other data."""
