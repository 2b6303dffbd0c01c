"""Time histories on their way into the dataset: one file per run while it waits, then arrays over all runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers.checks import reading
from data_schema import UnknownUnits, si_unit, unit_system

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.readers.base import Run
    from crashkit.readers.history import History

# Variables of the dataset.
CURVES = ("history", "history_time", "channel_unit", "channel_note")
_FILE = "curves.npz"


@dataclass(frozen=True)
class Curves:
    """The curves of one run in SI units: time (sample,), s; values (sample, channel); names, units and notes of channels."""

    time: NDArray[np.float64]
    values: NDArray[np.float64]
    names: tuple[str, ...]
    units: tuple[str, ...]
    notes: tuple[str, ...]


def write_curves(run: Run, units: str, folder: Path) -> History | None:
    """Keep the curves of `run`, changed to SI, beside its arrays; returns them as its source has them, None without any.

    Raises
    ------
    ReadError
        Where the run has curves that cannot be read.
    """
    try:
        with reading(f"run {run.name}, its time histories"):
            history = run.history()
    except ReadError as error:
        raise ReadError(f"{error}; or move the file away to ingest the run without its curves") from error
    if history is None:
        return None
    system = unit_system(units)
    factors, names = [], []
    for channel in history.channels:
        try:
            factors.append(system.factor(channel.quantity))
            names.append(si_unit(channel.quantity))
        except UnknownUnits:  # the values stay as they are, and say so
            factors.append(1.0)
            names.append("unknown")
    np.savez(
        folder / _FILE,
        time=history.time * system.time,
        values=history.values * np.array(factors),
        names=np.array([c.name for c in history.channels], dtype=str),
        units=np.array(names, dtype=str),
        notes=np.array([c.derived for c in history.channels], dtype=str),
    )
    return history


def read_curves(folder: Path) -> Curves | None:
    """What `write_curves` kept; None where there was nothing."""
    if not (folder / _FILE).exists():
        return None
    with np.load(folder / _FILE, allow_pickle=False) as kept:
        texts = (tuple(map(str, kept[name])) for name in ("names", "units", "notes"))
        return Curves(kept["time"], kept["values"], *texts)


def curves_of(of_run: xr.Dataset) -> Curves | None:
    """The curves of one run of a dataset; None where it has none."""
    if "history" not in of_run:
        return None
    time, values = of_run["history_time"].values, of_run["history"].values
    samples, known = np.isfinite(time), ~np.isnan(values).all(axis=0)
    if not samples.any():
        return None
    texts = (
        tuple(str(t) for t, k in zip(of_run[name].values, known, strict=True) if k)
        for name in ("channel", "channel_unit", "channel_note")
    )
    return Curves(time[samples], values[samples][:, known], *texts)


def with_curves(dataset: xr.Dataset, runs: Sequence[Curves | None]) -> xr.Dataset:
    """`dataset` with the curves of its runs, side by side: channels in the order in which runs name them."""
    found = [r for r in runs if r is not None]
    if not found:
        return dataset
    units: dict[str, str] = {}
    notes: dict[str, str] = {}
    for run in found:
        units |= {n: u for n, u in zip(run.names, run.units, strict=True) if n not in units}
        notes |= {n: t for n, t in zip(run.names, run.notes, strict=True) if n not in notes}
    place = {name: k for k, name in enumerate(units)}
    samples = max(len(r.time) for r in found)
    values = np.full((len(runs), samples, len(place)), np.nan)
    times = np.full((len(runs), samples), np.nan)
    for k, one in enumerate(runs):
        if one is not None:
            values[k, : len(one.time), [place[n] for n in one.names]] = one.values.T
            times[k, : len(one.time)] = one.time
    return dataset.assign_coords(channel=("channel", np.array(list(place), dtype=str))).assign(
        history=(("sim", "sample", "channel"), values, {"long_name": "time histories, each channel in its own unit"}),
        history_time=(("sim", "sample"), times, {"units": "s", "long_name": "times of the samples"}),
        channel_unit=("channel", np.array(list(units.values()), dtype=str)),
        channel_note=("channel", np.array(list(notes.values()), dtype=str)),
    )
