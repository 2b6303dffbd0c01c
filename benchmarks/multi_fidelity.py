"""What coarse runs beneath few fine ones bring, and from which cost on they pay.

    python benchmarks/multi_fidelity.py fine.zarr coarse.zarr --test 96:108 [--model mh] [--runs 8,12,16,24,48,96]
        [--coarse-runs 24,48,96,0] [--cost 0.19] [--draws 4] [--set physics.odd=[pole_offset]] [--keep rows/]
        [--fresh 24] [-o table.md]

POD-GPR, or with --model mh the cascade (its finest level, on the full mesh; fine.zarr needs a hierarchy), is trained on some
fine runs, drawn at random (several draws where they are few; the number of the draw is its seed), alone and with some coarse
runs beneath (0: all of them). Test runs are asked once, at the end of all choices. While something is still to be
chosen, `--fresh 24` asks in their place so many training runs that end each draw and are never among its training runs.
Coarse runs with the parameters of a test run are never
among them; they are used for the column "from a coarse run of the query" alone, where each prediction starts from its
own. Everything is chosen by folds over the fine runs, test runs are asked once. `cost` is what a coarse run costs
against a fine one: with it the table says how many fine runs alone would have the same error, and below which cost of a
coarse run it pays to compute them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from crashkit.api.campaign import open_campaign
from crashkit.api.coarse_runs import coarse_runs
from crashkit.api.source import Source, source_of
from crashkit.dataset import open_dataset
from crashkit.selection import runs_of
from surrogates.data.campaign import Campaign, CoarseRuns, RunByRun
from surrogates.data.samples import LevelRuns, Notes
from surrogates.models.pod_regression import PodFit, fit_pod_regression, from_coarse_run, with_coarse
from surrogates.regression.beneath import ALONE, twins
from surrogates.settings import Settings
from surrogates.settings import settings as all_settings
from surrogates.surrogate import Surrogate

# Fine runs from which on draws are fewer: half of them, then one.
_SOME, _MANY = 16, 48


@dataclass
class Cell:
    """Errors, m, of one pair of numbers, a value for each draw: on test runs, in folds, from a coarse run of the query."""

    test: list[float] = field(default_factory=list)
    folds: list[float] = field(default_factory=list)
    itself: list[float] = field(default_factory=list)
    ways: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Chosen:
    """Some runs of a field (sim, state, node, 3)."""

    values: RunByRun
    runs: NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.runs), *self.values.shape[1:])

    def __getitem__(self, run: int) -> NDArray[np.float32]:
        out: NDArray[np.float32] = self.values[int(self.runs[run])]
        return out


class Fitted(Protocol):
    """A model of some fine runs, with coarse runs beneath or without.

    folds, way  error, m, in cross-validation over the fine runs, and how coarse runs are used
    """

    folds: float
    way: str

    def said(self, one: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        """(state, node, 3), m, of a run with parameters (parameter,)."""
        ...

    def from_run(
        self,
        one: NDArray[np.float64],
        seen: NDArray[np.float32],
        seen_time: NDArray[np.float64],
        time: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        """The same from its coarse run (state, coarse node, 3), m, where the model takes it."""
        ...


@dataclass(frozen=True)
class OfPod:
    """POD-GPR: physics and modes are chosen once, whatever coarse runs there are."""

    fit: PodFit
    folds: float = np.nan
    way: str = ALONE

    def said(self, one: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        out: NDArray[np.float32] = self.fit.registration.undo(self.fit.core.displacement, one[None], time)[0]
        return out

    def from_run(
        self,
        one: NDArray[np.float64],
        seen: NDArray[np.float32],
        seen_time: NDArray[np.float64],
        time: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        if self.fit.core.base is None:
            return self.said(one, time)
        return from_coarse_run(self.fit.core, self.fit.registration, one[None], seen, seen_time, time)


@dataclass(frozen=True)
class OfCascade:
    """The cascade's finest level on the full mesh."""

    surrogate: Surrogate

    @property
    def folds(self) -> float:
        names, errors = list(self.surrogate.level_names), self.surrogate.record.errors
        return errors.get(f"{names[-1]}, lifted to the full mesh", errors[names[-1]])

    @property
    def way(self) -> str:
        return str(self.surrogate.record.coarse.get("way", ALONE))

    def said(self, one: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        return self.surrogate.predict_full(one, time)

    def from_run(
        self,
        one: NDArray[np.float64],
        seen: NDArray[np.float32],
        seen_time: NDArray[np.float64],
        time: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        if not self.surrogate.takes_coarse():
            return self.said(one, time)
        return self.surrogate.predict_from_coarse(one, seen, seen_time, time, full=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fine", type=Path)
    parser.add_argument("coarse", type=Path)
    parser.add_argument("--test", required=True, help="fine runs that choose nothing, such as 96:108")
    parser.add_argument("--model", default="pod-gpr", choices=["pod-gpr", "mh"], help="what is trained")
    parser.add_argument(
        "--fresh", type=int, default=0, help="ask so many fresh training runs in place of the test runs"
    )
    parser.add_argument("--runs", default="8,12,16,24,48,96", help="numbers of fine runs")
    parser.add_argument("--coarse-runs", default="24,48,96,0", help="numbers of coarse runs; 0: all")
    parser.add_argument("--cost", type=float, default=0.19, help="cost of a coarse run against a fine one")
    parser.add_argument("--draws", type=int, default=4, help="draws of the fewest fine runs")
    parser.add_argument("--set", action="append", default=[], help="a setting, such as physics.odd=[pole_offset]")
    parser.add_argument("--keep", type=Path, help="folder where finished draws are kept, and not computed again")
    parser.add_argument("-o", "--output", type=Path, help="where the table goes as Markdown; default: the terminal")
    options = parser.parse_args(arguments)
    counts, below = ([int(n) for n in text.split(",")] for text in (options.runs, options.coarse_runs))
    settings = all_settings(options.model, None, None, [options.set])
    bench = Bench(source_of(options.fine), source_of(options.coarse), options.test, settings, options.fresh)
    total = len(bench.coarse.campaign.parameters)
    most = total - options.fresh  # the coarse runs of what is asked are kept away
    below = sorted({min(number or most, most) for number in below})
    asked = f"{options.fresh} fresh training runs" if options.fresh else "test runs"
    found: dict[tuple[int, int | None], Cell] = {}
    for count in counts:
        for draw in range(draws(count, options.draws)):
            for number, said in kept(options.keep, count, draw, lambda c=count, d=draw: bench.row(c, below, d)):
                cell = found.setdefault((count, number), Cell())
                for name, value in said.items():
                    getattr(cell, name).append(value)
            lines = list(tables(found, options.cost, asked))
            if options.output:  # what is known so far is kept, whatever happens
                options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(tables(found, options.cost, asked)))


Row = Iterable[tuple[int | None, dict[str, float | str]]]


def kept(folder: Path | None, count: int, draw: int, row: Callable[[], Row]) -> Row:
    """What one draw said, from `folder` where it is there."""
    file = None if folder is None else folder / f"{count}_{draw}.json"
    if file is not None and file.exists():
        return [(number, said) for number, said in json.loads(file.read_text(encoding="utf-8"))]
    out = list(row())
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(out), encoding="utf-8")
    return out


def draws(count: int, most: int) -> int:
    """How many draws of so many fine runs: the fewer runs, the more."""
    return most if count < _SOME else max(1, most // 2) if count < _MANY else 1


class Bench:
    """Fine and coarse runs, and the test runs with their coarse runs."""

    def __init__(self, fine: Source, coarse: Source, test: str, settings: Settings, fresh: int = 0) -> None:
        self.settings, self.fresh = settings, fresh
        self.campaign = open_campaign(fine, test, symmetry=True, odd=settings.physics.odd or ())
        self.coarse = coarse_runs(coarse.path or coarse.name, self.campaign, fine)
        self.coarse_every = open_campaign(coarse)
        with open_dataset(fine.name) as opened:
            place = runs_of([str(n) for n in opened["sim"].values], test)
            tested = opened.isel(sim=place)
            self.parameters = np.stack([tested[n].values for n in self.campaign.parameter_names], axis=1).astype(float)
            self.truth = [] if fresh else [tested["displacement"].isel(sim=k).values for k in range(len(place))]
        self.own = self._coarse_of_queries()

    def _asked(self, runs: NDArray[np.int64]) -> None:
        """From now on these training runs are asked, which are kept from the training with their coarse runs."""
        field = LevelRuns(self.campaign, 0, self.settings, Notes())
        self.parameters = self.campaign.parameters[runs]
        self.truth = []
        for run in runs:
            there = field.there(int(run))
            states = field.read(int(run))
            self.truth.append(states if there is None else np.where(there[..., None], states, np.float32(np.nan)))
        self.own = self._coarse_of_queries()

    def _coarse_of_queries(self) -> list[NDArray[np.float32] | None]:
        """Displacements of the coarse run of each run that is asked; None without one."""
        every = self.coarse_every
        order = [every.parameter_names.index(n) for n in self.campaign.parameter_names]
        runs = LevelRuns(every, 0, self.settings, Notes())
        out: list[NDArray[np.float32] | None] = []
        for one in self.parameters:
            same = np.flatnonzero(np.isclose(every.parameters[:, order], one, rtol=1e-6).all(axis=1))
            out.append(runs.read(int(same[0])) if len(same) else None)
        return out

    def row(self, count: int, below: Sequence[int], draw: int) -> Row:
        """Errors of `count` fine runs alone, and with each number of coarse runs."""
        started = time.perf_counter()
        order = np.random.default_rng(draw).permutation(len(self.campaign.parameters))
        rest = np.arange(len(self.coarse.campaign.parameters))
        if self.fresh:
            order, asked = order[: -self.fresh], order[-self.fresh :]
            self._asked(asked)
            same = twins(self.parameters, self.coarse.campaign.parameters)
            rest = np.setdiff1d(rest, same[same >= 0])
        campaign = some_runs(self.campaign, np.sort(order[:count]))
        rest = np.random.default_rng(1000 + draw).permutation(rest)
        alone = self._trained(campaign, None, None)
        error = self._mean([alone.said(one, self.campaign.time) for one in self.parameters])
        print(
            f"{count} fine runs, draw {draw}: {1e3 * error:.2f} mm ({time.perf_counter() - started:.0f} s)", flush=True
        )
        judged = alone.folds
        for number in below:
            runs = np.sort(rest[:number])
            them = self._trained(
                campaign, CoarseRuns(some_runs(self.coarse.campaign, runs), self.coarse.to_fine), alone
            )
            if isinstance(them, OfPod) and them.fit.coarse is not None and np.isnan(judged):
                judged = them.fit.coarse.errors.get(ALONE, np.nan)
            test = self._mean([them.said(one, self.campaign.time) for one in self.parameters])
            itself = self._mean([self._from_run(them, k) for k in range(len(self.parameters))])
            print(f"  {len(runs)} coarse: {1e3 * test:.2f} mm, from itself {1e3 * itself:.2f} ({them.way})", flush=True)
            yield number, {"test": test, "folds": them.folds, "itself": itself, "ways": them.way}
        yield None, {"test": error, "folds": judged, "itself": error, "ways": ALONE}

    def _trained(self, campaign: Campaign, coarse: CoarseRuns | None, alone: Fitted | None) -> Fitted:
        """A model of the runs of `campaign`, over `coarse` ones; what was chosen for `alone` stays where it can."""
        if self.settings.model == "mh":
            from surrogates.training.train import train_surrogate

            return OfCascade(train_surrogate(replace(campaign, coarse=coarse), self.settings))
        if coarse is None or not isinstance(alone, OfPod):
            return OfPod(fit_pod_regression(campaign, self.settings, np.arange(len(campaign.parameters)), Notes()))
        fit = with_coarse(alone.fit, coarse, self.settings, Notes())
        assert fit.coarse is not None
        return OfPod(fit, fit.coarse.errors.get(fit.coarse.way, np.nan), fit.coarse.way)

    def _from_run(self, fit: Fitted, k: int) -> NDArray[np.float32]:
        """A run that is asked, from its own coarse run where there is one."""
        seen, one = self.own[k], self.parameters[k]
        if seen is None:
            return fit.said(one, self.campaign.time)
        return fit.from_run(one, seen, self.coarse.campaign.time, self.campaign.time)

    def _mean(self, said: Iterable[NDArray[np.float32]]) -> float:
        return float(np.nanmean([self._error(one, k) for k, one in enumerate(said)]))

    def _error(self, said: NDArray[np.float32], k: int) -> float:
        return float(np.nanmean(np.linalg.norm(said - self.truth[k], axis=-1)))


def some_runs(campaign: Campaign, runs: NDArray[np.int64]) -> Campaign:
    """The runs `runs` of `campaign`."""
    return replace(
        campaign, parameters=campaign.parameters[runs], runs=tuple(campaign.runs[k] for k in runs),
        displacement=lambda level: Chosen(campaign.displacement(level), runs), marked={}, targets=(), curves=(), alive=None,
    )  # fmt: skip


def tables(found: dict[tuple[int, int | None], Cell], cost: float, asked: str = "test runs") -> Iterable[str]:
    """Markdown: errors on the runs that are `asked`, then costs."""
    counts = sorted({count for count, _ in found})
    below = list(dict.fromkeys(number for _, number in found if number is not None))
    alone = {count: float(np.mean(found[count, None].test)) for count in counts if (count, None) in found}
    for title, part in (
        (f"Error on {asked}, mm", "test"),
        ("Error in cross-validation over the fine runs, mm", "folds"),
        (f"Error on {asked}, mm, from a coarse run of the query", "itself"),
    ):
        yield f"{title}:"
        yield ""
        yield "| fine runs | draws | alone | " + " | ".join(f"with {n} coarse" for n in below) + " |"
        yield "|---|---|---|" + "---|" * len(below)
        for count in alone:
            base = float(np.mean(getattr(found[count, None], part)))
            row = [f"{1e3 * base:.2f}"]
            for number in below:
                mean = float(np.mean(getattr(found[count, number], part)))
                row.append(f"{1e3 * mean:.2f} ({100 * (1 - mean / base):.0f} %)")
            yield f"| {count} | {len(found[count, None].test)} | " + " | ".join(row) + " |"
        yield ""
    yield "How many fine runs alone have the same error, and below which cost of a coarse run against a fine one it pays"
    yield f"to compute them instead of further fine runs (here a coarse run costs {cost:g}):"
    yield ""
    yield "| fine runs | " + " | ".join(f"with {n} coarse" for n in below) + " |"
    yield "|---|" + "---|" * len(below)
    for count in alone:
        cells = []
        for number in below:
            same = same_error(alone, float(np.mean(found[count, number].test)))
            cells.append("-" if same is None else f"{same:.0f} runs, below {max(0.0, same - count) / number:.2f}")
        yield f"| {count} | " + " | ".join(cells) + " |"
    yield ""
    yield "How they are used (number of draws): " + told_ways(found)


def same_error(alone: dict[int, float], error: float) -> float | None:
    """The number of fine runs with that error, by straight lines between logarithms; None beyond the numbers tried."""
    counts = np.array(sorted(alone))
    errors = np.minimum.accumulate([alone[int(n)] for n in counts])
    if len(counts) < 2 or not errors[-1] <= error <= errors[0]:
        return None
    return float(np.exp(np.interp(-np.log(error), -np.log(errors), np.log(counts))))


def told_ways(found: dict[tuple[int, int | None], Cell]) -> str:
    """How often each way was chosen, by number of fine runs."""
    out = []
    for count in sorted({count for count, _ in found}):
        ways = [way for (n, number), cell in found.items() if n == count and number is not None for way in cell.ways]
        names = sorted(set(ways), key=ways.count, reverse=True)
        out.append(f"{count} fine runs: " + ", ".join(f"{name} {ways.count(name)}" for name in names))
    return "; ".join(out) + "."


if __name__ == "__main__":
    main()
