"""Whether all numbers of a large array are finite."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def all_finite(values: NDArray[np.floating[Any]]) -> bool:
    """Whether no number is missing or infinite: by their sum, which takes a tenth of the time of asking every one."""
    with np.errstate(invalid="ignore", over="ignore"):
        whole = np.isfinite(values.sum())
    return bool(whole or np.isfinite(values).all())  # the sum of numbers that are finite may overflow
