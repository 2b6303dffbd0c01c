"""Which runs a text, a number, a slice or a list of names means."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np

from crashkit.errors import DataError

WhichRuns = int | float | slice | str | Sequence[int | str]


def runs_of(names: Sequence[str], chosen: WhichRuns, *, seed: int = 0) -> list[int]:
    """Which of the runs `names` a selection means, as increasing numbers.

    An int or a fraction below 1 ("25%", too) draws that many at random (seeded); a slice or "27:36" means places; a list or
    "run_003,run_007" means names or places, or ranges of them ("0:3,run_007").

    Raises
    ------
    DataError
        For a run that is not there, or a selection of nothing.
    """
    count = len(names)
    place = {str(n): k for k, n in enumerate(names)}
    if isinstance(chosen, str):
        text, chosen = chosen, _parse(chosen)
        if isinstance(chosen, slice):
            chosen = _within(chosen, text.strip(), count)
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
            elif isinstance(item, str) and ":" in item:
                out += range(count)[_within(_range(item), item, count)]
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
        return _range(text)
    if "," not in text:
        percent = text.endswith("%")
        with contextlib.suppress(ValueError):
            number = float(text.rstrip("% ")) / (100 if percent else 1)
            return int(number) if number == int(number) and "." not in text else number
    return [p.strip() for p in text.split(",") if p.strip()]


def _range(text: str) -> slice:
    try:
        return slice(*(int(p) if p.strip() else None for p in text.split(":")))
    except (ValueError, TypeError) as error:
        raise DataError(
            f"{text!r} is no range of runs; expected first:last, such as 27:36, or 27: to the end"
        ) from error


def _within(chosen: slice, text: str, count: int) -> slice:
    """`chosen`, which was written as `text`, if it means runs that are there, all of them."""
    if chosen.step == 0 or (chosen.stop is not None and chosen.stop > count) or not range(count)[chosen]:
        some = max(0, count - max(1, count // 4))
        raise DataError(
            f"{text!r} does not fit {count} runs, which are 0 to {count - 1}; expected first:behind the last, such as "
            f"{some}:{count}, or {some}: to the end"
        )
    return chosen
