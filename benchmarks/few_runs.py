"""What the choices made by folds are worth when runs are few, and whether the bands hold: twenty random splits.

    python benchmarks/few_runs.py demo --model pod-gpr [--splits 20] [--first 0] -o few/
    python benchmarks/few_runs.py kart.zarr --model mh --every 10 -o few/
    python benchmarks/few_runs.py --table few/*.csv

A split draws 24 runs of the campaign with its number as the seed: 16 train, 8 judge. The default, which chooses by folds
of the 16, is compared with what could have been fixed instead; both see the same training runs, and the 8 choose nothing.
What could have been fixed:

    registration   what the default chose (`chosen`), nothing known beforehand (`none`), or logarithms, clock and mirrored
                   runs as the search starts (`usual`, with `--odd`)
    pod-gpr        number of modes, and whole runs or single states as samples
    mh             the regression: a network, a process, or their mean

One line for each split goes into a CSV file named by campaign and model, and lines that are there are not computed
again. Errors are e2, the mean distance of nodes in cm, on the full mesh. `inside` is the share of nodes and states
of the judging runs within the default's band of 90 %, overall and by thirds of the campaign's range of speed.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import xarray as xr
from numpy.typing import NDArray

import crashkit
from crashkit.api.model import Model
from crashkit.mesh.levels import Hierarchy
from data_schema import parameters
from surrogates.data.campaign import Campaign
from surrogates.physics.choice import Worth
from surrogates.physics.clock import Clock
from surrogates.physics.derived import DerivedInputs, logarithms
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import Symmetry

TRAIN, JUDGE = 16, 8
BAND = 0.9
THIRDS = ("slow", "middle", "fast")
# What is stored in the place of the search for a registration: it, and the place of its plane.
Found = tuple[Registration, int]
# A fixed alternative: which registration, and settings.
Alternative = tuple[str, tuple[str, ...]]

OF_MODEL: dict[str, dict[str, Alternative]] = {
    "pod-gpr": {
        **{f"none, {m} modes": ("none", (f"pod.modes=[{m}]", "pod.inputs=trajectory")) for m in (4, 8, 16, 32, 64)},
        "none, states": ("none", ("pod.modes=[16]", "pod.inputs=point")),
        **{f"usual, {m} modes": ("usual", (f"pod.modes=[{m}]", "pod.inputs=trajectory")) for m in (8, 16, 32, 64)},
    },
    "mh": {
        "none, process": ("none", ("level.regression=process",)),
        "usual, process": ("usual", ("level.regression=process",)),
        "none, network": ("none", ("level.regression=network",)),
        "chosen, process": ("chosen", ("level.regression=process",)),
        "chosen, mean": ("chosen", ("level.regression=mean",)),
    },
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", nargs="?", help="demo, or a dataset")
    parser.add_argument("--model", choices=sorted(OF_MODEL), default="pod-gpr")
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first split, which is its seed")
    parser.add_argument("--every", type=int, default=1, help="take every so many-th state, from the first on")
    parser.add_argument("--nodes", default="300,75", help="nodes of the levels of mh")
    parser.add_argument("--odd", default="impact_angle", help="parameter that changes its sign in the mirror")
    parser.add_argument(
        "--set", action="append", default=[], help="a setting of all trainings, such as level.epochs=100"
    )
    parser.add_argument("--default-only", action="store_true", help="no alternatives: bands alone")
    parser.add_argument("-o", "--output", type=Path, default=Path())
    parser.add_argument("--table", nargs="*", type=Path, help="print the table of CSV files that are there")
    options = parser.parse_args(arguments)
    for file in options.table or ():
        print_table(file)
    if options.campaign is None:
        return
    options.output.mkdir(parents=True, exist_ok=True)
    stored = Path(options.campaign)
    if options.campaign == "demo":
        stored = options.output / "demo.zarr"
        if not stored.exists():
            crashkit.ingest(crashkit.demo_data(), stored)
    dataset = crashkit.open_dataset(stored).isel(time=slice(None, None, options.every))
    hierarchy = None
    if options.model == "mh":
        hierarchy = crashkit.coarsen(dataset, [int(n) for n in options.nodes.split(",")])
    alternatives = {} if options.default_only else OF_MODEL[options.model]
    file = options.output / f"{Path(options.campaign).stem}-{options.model}.csv"
    done = {int(row["split"]) for row in rows_of(file)}
    for number in range(options.first, options.first + options.splits):
        if number not in done:
            add_row(file, {"split": number, **one_split(dataset, hierarchy, number, options, alternatives)})
    print_table(file)


def one_split(
    dataset: xr.Dataset,
    hierarchy: Hierarchy | None,
    number: int,
    options: argparse.Namespace,
    alternatives: Mapping[str, Alternative],
) -> dict[str, float]:
    """The line of one split."""
    draw = np.random.default_rng(number).permutation(dataset.sizes["sim"])[: TRAIN + JUDGE]
    training = dataset.isel(sim=np.sort(draw[:TRAIN])).load()
    judging = dataset.isel(sim=np.sort(draw[TRAIN:])).load()
    found: list[Found] = []

    def trained(settings: Sequence[str]) -> Model:
        given = [f"seed={number}", *options.set, *settings]
        return crashkit.train(training, model=options.model, settings=given, hierarchy=hierarchy, progress=False)

    started = time.process_time()
    with noted(found):
        model = trained(())
    out = {"seconds": time.process_time() - started, "default": error(model, judging)}
    out |= inside(model, dataset, judging)
    for name, (registration, settings) in alternatives.items():
        with fixed(registration, found, options.odd):
            out[name] = error(trained(settings), judging)
        print(f"split {number}: {name} {out[name]:.2f} cm, default {out['default']:.2f} cm", flush=True)
    return out


def error(model: Model, judging: xr.Dataset) -> float:
    """e2, cm."""
    return float(100 * np.mean([np.nanmean(distances(model, run)) for run in runs(judging)]))


def inside(model: Model, dataset: xr.Dataset, judging: xr.Dataset) -> dict[str, float]:
    """Shares of nodes and states within the band: of all judging runs, and of those of each third of the speeds; how many these are."""
    speed = next(name for name in parameters(dataset) if dataset[name].attrs.get("units") == "m s-1")
    low, high = float(dataset[speed].min()), float(dataset[speed].max())
    by_third: dict[str, list[float]] = {third: [] for third in THIRDS}
    for run in runs(judging):
        distance, width = distances(model, run), widths(model, run)
        there = np.isfinite(distance)
        third = THIRDS[min(2, int(3 * (float(run[speed]) - low) / (high - low)))]
        by_third[third].append(float((distance <= width)[there].mean()))
    shares = [share for found in by_third.values() for share in found]
    out = {"inside": float(np.mean(shares))}
    for third, found in by_third.items():
        out |= {f"inside {third}": float(np.mean(found)) if found else np.nan, f"runs {third}": len(found)}
    return out


def distances(model: Model, run: xr.Dataset) -> NDArray[np.floating]:
    """(state, node), m, of truth and prediction."""
    said = model.surrogate.predict_full(given(model, run)[None], run["time"].values, model.surrogate.number(None))
    out: NDArray[np.floating] = np.linalg.norm(said[0] - run["displacement"].values, axis=-1)
    return out


def widths(model: Model, run: xr.Dataset) -> NDArray[np.floating]:
    """(state, node), m: the band's half-widths."""
    surrogate = model.surrogate
    return surrogate.band(
        BAND, run["time"].values, surrogate.number(None), full=True, parameters=given(model, run)
    )  # fmt: skip


def given(model: Model, run: xr.Dataset) -> NDArray[np.float64]:
    return np.array([float(run[name]) for name in model.record.ranges.names])


def runs(dataset: xr.Dataset) -> Iterator[xr.Dataset]:
    return (dataset.isel(sim=k) for k in range(dataset.sizes["sim"]))


Choose = Callable[..., tuple[Registration, int, Worth]]


@contextmanager
def noted(found: list[Found]) -> Iterator[None]:
    """Trainings note the registration they choose in `found`."""
    from surrogates.physics.choice import choose

    def choosing(*of: object) -> tuple[Registration, int, Worth]:
        registration, plane, worth = choose(*of)  # type: ignore[arg-type]
        found.append((registration, plane))
        return registration, plane, worth

    with replaced(choosing):
        yield


@contextmanager
def fixed(which: str, found: Sequence[Found], odd: str) -> Iterator[None]:
    """Trainings take a registration without a search."""

    def given(campaign: Campaign, *_: object) -> tuple[Registration, int, Worth]:
        if which == "chosen":
            return (*found[-1], Worth())
        if which == "none":
            return Registration.identity(campaign.parameter_names, campaign.time), 0, Worth()
        return usual(campaign, odd), 0, Worth()

    with replaced(given):
        yield


@contextmanager
def replaced(choosing: Choose) -> Iterator[None]:
    with (
        patch("surrogates.physics.choice.choose", choosing),
        patch("surrogates.models.pod_regression.choose", choosing),
    ):
        yield


def usual(campaign: Campaign, odd: str) -> Registration:
    """Logarithms, a clock by speed and strength, and mirrored runs, with the numbers that a search starts from."""
    names, units = campaign.parameter_names, campaign.parameter_units
    speed, strengths = units.index("m s-1"), [k for k, unit in enumerate(units) if unit in ("Pa", "MPa")]
    inputs: DerivedInputs = logarithms(names, campaign.parameters, warp=True)
    clock = Clock.of(
        campaign.parameters, speed, dict.fromkeys((speed, *strengths), 0.25), float(campaign.time[0])
    )  # fmt: skip
    symmetry = Symmetry(campaign.mirrors[0], (odd,), True) if campaign.mirrors else Symmetry()
    return Registration(inputs, clock, symmetry, clock.grid(campaign.parameters, campaign.time), campaign.time[-1])


def rows_of(file: Path) -> list[dict[str, str]]:
    if not file.is_file():
        return []
    with file.open(newline="", encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


def add_row(file: Path, row: Mapping[str, float]) -> None:
    new = not file.is_file()
    with file.open("a", newline="", encoding="utf-8") as lines:
        writer = csv.writer(lines)
        if new:
            writer.writerow(row)
        writer.writerow([value if isinstance(value, int) else f"{value:.5g}" for value in row.values()])


def print_table(file: Path) -> None:
    """Errors of the default and of each alternative, and how many nodes and states the band held."""
    rows = [{name: float(value or "nan") for name, value in row.items()} for row in rows_of(file)]
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    names = [name for name in columns if name.split(", ")[0] in ("none", "usual", "chosen")]
    default = columns["default"]
    print(f"## {file.stem}: {len(rows)} splits ({TRAIN} train, {JUDGE} judge), numbers {rows[0]['split']:.0f} on\n")
    print("| | mean (cm) | default over it, mean | worst |\n|---|---|---|---|")
    print(f"| default | {default.mean():.2f} | | |")
    for name in names:
        ratio = default / columns[name]
        print(f"| {name} | {columns[name].mean():.2f} | {ratio.mean():.2f} | {ratio.max():.2f} |")
    if names:
        best = min(names, key=lambda name: columns[name].mean())
        each = default / np.min([columns[name] for name in names], axis=0)
        print(
            f"\nBest fixed one on average: {best}. Beside the best of each split, known afterwards: {each.mean():.2f}."
        )
    told = []
    for third in THIRDS:
        count, share = columns[f"runs {third}"], columns[f"inside {third}"]
        told.append(f"{third} {100 * np.nansum(count * share) / count.sum():.0f} % of {count.sum():.0f} runs")
    print(f"\nInside the band of 90 %: {100 * columns['inside'].mean():.1f} %; {', '.join(told)}.")
    print(f"A training of the default took {columns['seconds'].mean():.0f} s of processor time.\n")


if __name__ == "__main__":
    main()
