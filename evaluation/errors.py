"""What goes wrong in evaluation, said so that it can be mended."""

from __future__ import annotations


class EvaluationError(Exception):
    """One line: what was found, what was expected, what to do."""
