"""Which runs a text, a number, a slice or a list of names means."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np

from crashkit.errors import DataError

WhichRuns = int | float | slice | str | Sequence[int | str]


def runs_of(names: Sequence[str], chosen: WhichRuns, *, seed: int = 0) -> list[int]:
    """Which of the runs `names` a selection means, as increasing numbers.

    An int or a fraction below 1 draws that many at random (seeded); a slice or "27:36" means places; a list or
    "run_003,run_007" means names or places.

    Raises
    ------
    DataError
        For a run that is not there, or a selection of nothing.
    """
    count = len(names)
    place = {str(n): k for k, n in enumerate(names)}
    if isinstance(chosen, str):
        chosen = _parse(chosen)
    if isinstance(chosen, slice):
        out = list(range(count))[chosen]
    elif isinstance(chosen, (int, float, np.integer, np.floating)):
        size = round(float(chosen) * count) if 0 < chosen < 1 else int(chosen)
        if not 0 < size < count or (chosen > 1 and size != chosen):
            raise DataError(
                f"{chosen} of {count} runs were asked for; expected a fraction, or a whole number from 1 to {count - 1}"
            )
        out = sorted(np.random.default_rng(seed).choice(count, size, replace=False).tolist())
    else:
        out = []
        for item in chosen:
            if str(item) in place:
                out.append(place[str(item)])
            elif isinstance(item, (int, np.integer)) and -count <= item < count:
                out.append(int(item) % count)
            elif isinstance(item, str) and item.strip().isdigit() and int(item) < count:
                out.append(int(item))
            else:
                raise DataError(f"there is no run {item!r}; the dataset has {names[0]} to {names[-1]} ({count} runs)")
    out = sorted(set(out))
    if not out:
        raise DataError(f"the selection {chosen!r} means none of the {count} runs")
    return out


def _parse(text: str) -> WhichRuns:
    text = text.strip()
    if ":" in text and "," not in text:
        try:
            return slice(*(int(p) if p.strip() else None for p in text.split(":")))
        except ValueError as error:
            raise DataError(f"{text!r} is no range of runs; expected first:last, such as 27:36") from error
    if "," not in text:
        with contextlib.suppress(ValueError):
            number = float(text)
            return int(number) if number == int(number) and "." not in text else number
    return [p.strip() for p in text.split(",") if p.strip()]
