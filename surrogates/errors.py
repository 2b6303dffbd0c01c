"""What goes wrong in training, storing and asking a surrogate, said so that it can be mended."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate
    from surrogates.training.loop import Fit


class SurrogateError(Exception):
    """One line: what was found, what was expected, what to do."""


class ModelFolderError(SurrogateError):
    """A model folder is missing something, was altered, or belongs to other data."""


class Diverged(SurrogateError):
    """A loss became NaN or infinite; names the model, level and epoch. The last good weights are kept.

    fit        how the training went until then
    surrogate  what can be used: the finished levels, and this one with its best weights; None without any
    """

    fit: Fit | None = None
    surrogate: Surrogate | None = None
