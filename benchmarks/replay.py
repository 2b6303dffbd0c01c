"""Proposals among runs that are computed already: error against the number of runs, for several ways to choose them.

    python benchmarks/replay.py crash.zarr --judged 96:128 [--pool 0:96,128:256] [--starts 10] [--first 16] [--batch 8]
                                [--counts 24 48] [--odd pole_offset] [--folds] [--local] [--known] [--every 1] [--json FILE]

Each start draws `--first` runs of the pool at random. Then `--batch` runs at a time are asked for among the rest of the pool
by the expected reduction of the error over the box (`surrogates.design.criteria`), with everything chosen anew by folds
over the runs chosen so far. Against it stand random subsets (the same starts, filled up at random) and blocks of consecutive
runs of the pool, which is a Halton sequence: one prefix may be lucky, so the mean over blocks counts. The error is the mean
node distance over runs that nobody chooses: `--judged`, or with `--folds` a quarter of the pool that is left out of each
start's pool in turn. The estimate of `crashkit campaign` at the last count is compared with that error. With `--json`
the same call goes on where an interrupted one stopped. With `--known` what is known of the crash beforehand is chosen once,
on up to 96 runs of the pool, and kernels alone are fitted again: that tells what the places are worth from what the choices
are, in a fifth of the time.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from crashkit.api._design import TrainedProcess
from crashkit.api.campaign import open_campaign
from crashkit.api.source import source_of
from crashkit.campaign.box import Box
from crashkit.selection import runs_of
from surrogates.data.campaign import Campaign
from surrogates.design.criteria import ExpectedReduction
from surrogates.models import pod_regression
from surrogates.physics.choice import Worth, choose
from surrogates.physics.registration import Registration
from surrogates.settings import settings
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

METHODS = ("random", "halton", "expected-reduction")
# Starts that are drawn to say how sure a mean over starts is.
_RESAMPLES = 4000
# Runs that choose the physics where it is known.
_KNOWN = 96
# Standard errors to each side of a mean that make a 90 % interval.
_NORMAL = 1.645


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--judged", default="", help="runs that nobody chooses")
    parser.add_argument("--pool", default="", help="runs to choose among, ranges with commas; default: all others")
    parser.add_argument("--folds", action="store_true", help="judge each start on a quarter of the pool")
    parser.add_argument("--every", type=int, default=1, help="take every so many states")
    parser.add_argument("--starts", default="10", help="how many, or which: 4:6")
    parser.add_argument("--first", type=int, default=16)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--counts", type=int, nargs="+", default=[24, 48])
    parser.add_argument("--local", action="store_true", help="weigh places by the errors of left-out runs around them")
    parser.add_argument("--known", action="store_true", help="physics chosen once, on many runs of the pool")
    parser.add_argument("--odd", nargs="*", default=[])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()

    whole = open_campaign(source_of(args.dataset), symmetry=True)
    memory = np.stack([np.asarray(whole.displacement(0)[k]) for k in range(len(whole.parameters))])
    memory = np.ascontiguousarray(memory[:, :: args.every])
    whole = replace(  # displacements alone, so that a subset of the runs needs nothing else
        whole, displacement=lambda level: memory, time=whole.time[:: args.every], known=None, alive=None, targets=(),
        curves=(),
    )  # fmt: skip
    names = list(whole.runs)
    judged = runs_of(names, args.judged) if args.judged else []
    pool = (
        sorted({k for part in args.pool.split(",") for k in runs_of(names, part)}) if args.pool else range(len(names))
    )
    pool = [k for k in pool if k not in set(judged)]
    replay = Replay(whole, memory, args.odd, args.batch, args.local)
    out: list[dict[str, Any]] = json.loads(args.json.read_text()) if args.json and args.json.exists() else []
    begin, _, end = args.starts.rpartition(":")
    for start in range(int(begin or 0), int(end)):
        if any(row["start"] == start for row in out):
            continue
        rng = np.random.default_rng(start)
        fold = judged
        own = pool
        if args.folds:
            parts = np.array_split(np.random.default_rng(start // 4).permutation(pool), 4)
            fold = sorted(parts[start % 4].tolist())
            own = [k for k in pool if k not in set(fold)]
        first = rng.choice(own, args.first, replace=False).tolist()
        if args.known:
            replay.know(own[:_KNOWN])
        row = {m: replay.course(m, first, own, fold, args.counts, start) for m in METHODS}
        out.append({"start": start, **row})
        show(out, args.counts)
        if args.json:
            args.json.write_text(json.dumps(out))
    show(out, args.counts)


class Replay:
    """Trains on subsets of computed runs, and asks which to take next."""

    def __init__(self, whole: Campaign, memory: NDArray[np.float32], odd: list[str], batch: int, local: bool) -> None:
        self.local = local
        self.whole, self.memory, self.odd, self.batch = whole, memory, odd, batch
        self.box = Box.of_values(whole.parameter_names, whole.parameter_units, whole.parameters)
        self.physics: dict[tuple[int, ...], Registration] = {}
        self.fixed: Registration | None = None

    def know(self, runs: list[int]) -> None:
        """From now on take the physics that these runs choose, as after a former campaign on the same structure."""
        key = tuple(runs)
        if key not in self.physics:
            self.fixed = None
            self.physics[key] = self.trained(runs).registration
        self.fixed = self.physics[key]

    def choose(self, campaign: Campaign, chosen: NDArray[np.int64], *_: object) -> tuple[Registration, int, Worth]:
        """What `know` has chosen, on the grid of the runs `chosen`."""
        fixed = self.fixed
        assert fixed is not None
        plane = next((k for k, m in enumerate(campaign.mirrors) if m is fixed.symmetry.mirror), 0)
        grid = fixed.clock.grid(campaign.parameters[chosen], campaign.time)
        return replace(fixed, grid=grid), plane, Worth()

    def course(
        self, method: str, first: list[int], pool: list[int], judged: list[int], counts: list[int], start: int
    ) -> dict[str, list[float]]:
        """At each of `counts` runs, m: error and its standard error over the judged runs, estimate and its 90 % interval."""
        rng = np.random.default_rng(1000 + start)
        rest = [k for k in pool if k not in set(first)]
        chosen = list(first)
        out: dict[str, list[float]] = {}
        if method == "random":
            chosen += rng.permutation(rest)[: max(counts) - len(first)].tolist()
        if method == "halton":
            begin = start * max(counts) // 2 % max(1, len(pool) - max(counts) + 1)
            chosen = pool[begin : begin + max(counts)]
        while True:
            done = method != "expected-reduction"
            for count in counts if done else [len(chosen)]:
                surrogate = self.trained(chosen[:count])
                if count in counts:
                    judged_by_itself = TrainedProcess.of(surrogate, self.box).judge(0.9)
                    estimate = (judged_by_itself.error, judged_by_itself.low, judged_by_itself.high)
                    out[str(count)] = [*self.error(surrogate, judged), *estimate]
            if done or len(chosen) >= max(counts):
                return out
            chosen += self.ask(surrogate, chosen, pool)

    def trained(self, runs: list[int]) -> Surrogate:
        some = replace(
            self.whole, parameters=self.whole.parameters[runs], runs=tuple(self.whole.runs[k] for k in runs),
            displacement=lambda level: self.memory[runs],
        )  # fmt: skip
        told = [f"physics.odd=[{', '.join(self.odd)}]"] if self.odd else []
        with patch.object(pod_regression, "choose", self.choose if self.fixed else choose):
            return train_surrogate(some, settings("pod-gpr", overrides=told))

    def ask(self, surrogate: Surrogate, chosen: list[int], pool: list[int]) -> list[int]:
        known = TrainedProcess.of(surrogate, self.box)
        left = [k for k in pool if k not in set(chosen)]
        over = known.parameters(known.points(0, 512))
        weights = known.size(over)
        if self.local:
            weights = weights * np.sqrt(known.wrongness(over))
        method = ExpectedReduction(known.posterior(self.whole.parameters[chosen]), over, weights)
        asked = method.ask(self.whole.parameters[left], self.batch)
        return [left[int(np.flatnonzero((self.whole.parameters[left] == row).all(axis=1))[0])] for row in asked]

    def error(self, surrogate: Surrogate, judged: list[int]) -> tuple[float, float]:
        errors = []
        for k in judged:
            predicted = surrogate.predict(self.whole.parameters[k], self.whole.time, 0)
            errors.append(float(np.nanmean(np.linalg.norm(predicted - self.memory[k], axis=-1))))
        return float(np.mean(errors)), float(np.std(errors, ddof=1) / np.sqrt(len(errors)))


def show(out: list[dict[str, Any]], counts: list[int]) -> None:
    """The table so far, in mm, with 90 % intervals over starts."""
    print(f"{len(out)} starts, mean error in mm; ratios to random and to Halton with 90 % intervals over starts")
    for count in counts:
        errors = {m: np.array([start[m][str(count)][0] for start in out]) for m in METHODS}
        asked = errors["expected-reduction"]
        means = ", ".join(f"{m} {1e3 * errors[m].mean():.2f}" for m in METHODS)
        print(f"{count:4d} runs: {means}; {_ratio(asked, errors['random'])}, {_ratio(asked, errors['halton'])}")
    for method in METHODS:
        true, unsure, said, low, high = np.array([start[method][str(max(counts))] for start in out]).T
        inside = (low <= true) & (true <= high)
        # The truth is a mean over few runs: the distance that is allowed grows by its own 90 % interval.
        side = np.where(true < said, said - low, high - said)
        nearly = np.abs(true - said) <= np.hypot(side, _NORMAL * unsure)
        ratio = said / true
        print(
            f"{max(counts)} runs, {method}: estimate / true {ratio.mean():.3f} +- {ratio.std():.3f}, from {ratio.min():.2f} "
            f"to {ratio.max():.2f}; 90 % interval holds the mean over the judged runs in {inside.sum()} of {len(inside)}, "
            f"with that mean's own interval ({100 * (unsure / true).mean():.0f} % standard error) in {nearly.sum()}",
            flush=True,
        )


def _ratio(asked: NDArray[np.float64], others: NDArray[np.float64]) -> str:
    """The ratio of means, with its 90 % interval by drawing starts anew."""
    draws = np.random.default_rng(0).integers(0, len(asked), (_RESAMPLES, len(asked)))
    low, high = np.quantile(asked[draws].mean(axis=1) / others[draws].mean(axis=1), [0.05, 0.95])
    return f"{asked.mean() / others.mean():.3f} ({low:.3f} to {high:.3f})"


if __name__ == "__main__":
    main()
