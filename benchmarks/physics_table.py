"""What is known before the first run, and what it is worth: each idea alone and left out, and learning curves.

    python benchmarks/physics_table.py kart.zarr bumper.zarr --test 96: [--runs 12,24,48,96] [--seeds 5] [-o table.md]
        [--csv curves.csv]

A POD regression with a Gaussian process is trained on the first runs of each dataset, as many as `--runs` says, with
everything chosen by cross-validation among these, and with all of it switched off (`inputs.derived`, `physics.clock`,
`physics.symmetry`). The tables show e2, the mean distance of nodes: in cross-validation over the training runs for each
idea alone and left out, and on the test runs, which choose nothing and are asked once, with and without all of it. The latter
as CSV (the first seed) are what `examples/study_driver/curves.py` draws.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

import crashkit
from crashkit.dataset import open_dataset
from crashkit.selection import runs_of
from surrogates.surrogate import Surrogate

OFF = ("inputs.derived=off", "physics.clock=off", "physics.symmetry=off")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--test", required=True, help="runs that choose nothing, such as 96:120")
    parser.add_argument("--runs", default="", help="numbers of training runs, such as 12,24,48,96; default: all")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of the largest number of runs, seeds 0, 1, ..")
    parser.add_argument("--set", action="append", default=[], help="a setting of both, such as pod.modes=[96]")
    parser.add_argument("-o", "--output", type=Path, help="where the tables go as Markdown; default: the terminal")
    parser.add_argument("--csv", type=Path, help="where the errors on test runs of one dataset go as CSV")
    options = parser.parse_args(arguments)
    if options.csv and len(options.datasets) > 1:
        parser.error("--csv is for one dataset; expected one, or no --csv")
    found: dict[int, tuple[float, float]] = {}
    lines: list[str] = []
    for dataset in options.datasets:
        for line in tables(dataset, options.test, options.runs, options.seeds, options.set, found):
            print(line, flush=True)
            lines.append(line)
            if options.csv:
                options.csv.write_text(curves(found), encoding="utf-8")
    if options.output:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def curves(found: Mapping[int, tuple[float, float]]) -> str:
    """CSV of learning curves, mm, from training runs -> errors without and with physics, m."""
    lines = ["model,training_runs,mean_node_error_mm"]
    for k, name in ((1, "POD-GPR"), (0, "POD-GPR without physics")):
        lines += [f"{name},{runs},{1e3 * errors[k]:.7g}" for runs, errors in found.items()]
    return "\n".join(lines) + "\n"


def tables(
    dataset: Path, test: str, wanted: str, seeds: int, more: Sequence[str], errors_found: dict[int, tuple[float, float]]
) -> Iterable[str]:
    """Markdown, line by line, as soon as each is known; `errors_found` gets what `curves` takes."""
    with open_dataset(dataset) as opened:
        names = [str(name) for name in opened["sim"].values]
    held = runs_of(names, test)
    training = [k for k in range(len(names)) if k not in set(held)]
    counts = [int(n) for n in wanted.split(",")] if wanted else [len(training)]
    yield f"## {dataset.stem}: {len(held)} test runs"
    yield ""
    yield "| training runs | as they are (mm) | with physics (mm) | worst run | in cross-validation | seconds | inputs | clock | symmetry |"
    yield "|---|---|---|---|---|---|---|---|---|"
    worth: dict[int, dict[str, float]] = {}
    for count in counts:
        for seed in range(seeds if count == max(counts) else 1):
            given = [*more, f"seed={seed}"]
            before = np.mean(errors(fitted(dataset, names, training[:count], [*given, *OFF]), dataset, held))
            started = time.perf_counter()
            surrogate = fitted(dataset, names, training[:count], given)
            seconds = time.perf_counter() - started
            found = errors(surrogate, dataset, held)
            errors_found.setdefault(count, (float(before), float(np.mean(found))))
            physics = surrogate.record.physics
            worth.setdefault(count, physics["errors"])
            told = " | ".join(str(physics[name]) for name in ("inputs", "clock", "symmetry"))
            judged = 1e3 * surrogate.record.errors["POD-GPR"]
            yield (
                f"| {count} | {1e3 * before:.2f} | {1e3 * np.mean(found):.2f} | {1e3 * max(found):.1f} | {judged:.2f} "
                f"| {seconds:.0f} | {told} |"
            )
    yield ""
    yield "What each idea is worth in cross-validation over the training runs, mm:"
    yield ""
    yield "| | " + " | ".join(f"{n} runs" for n in worth) + " |"
    yield "|---|" + "---|" * len(worth)
    for name in dict.fromkeys(name for found in worth.values() for name in found):
        row = (f"{1e3 * found[name]:.2f}" if name in found else "-" for found in worth.values())
        yield f"| {name} | {' | '.join(row)} |"
    yield ""


def fitted(dataset: Path, names: Sequence[str], chosen: Sequence[int], overrides: Sequence[str]) -> Surrogate:
    """POD-GPR trained on the runs `chosen` alone."""
    others = [name for k, name in enumerate(names) if k not in set(chosen)]
    return crashkit.train(dataset, model="pod-gpr", settings=overrides, test=others or None).surrogate


def errors(surrogate: Surrogate, dataset: Path, runs: Sequence[int]) -> list[float]:
    """e2, m, of each run."""
    out = []
    order = surrogate.record.ranges.names
    with open_dataset(dataset) as opened:
        for run in runs:
            one = opened.isel(sim=run)
            predicted = surrogate.predict([float(one[name]) for name in order], one["time"].values)
            distance = np.linalg.norm(predicted - one["displacement"].values, axis=-1)
            out.append(float(np.nanmean(distance)))
    return out


if __name__ == "__main__":
    main()
