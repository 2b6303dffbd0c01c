"""Parameters of runs from a few measured points: how near the most likely ones are, and how often the region holds.

    python benchmarks/invert.py kart.zarr --test 96: [--points 20] [--noise 0.001] [-o table.md]

A POD regression with a Gaussian process is trained on the other runs through the public functions. For each test run
the final positions of a few nodes (drawn at random, the same for all runs), with noise added, are given to
`crashkit.invert`; the table shows the errors of the most likely parameters, and whether the true ones lie within the 90 %
region. Test runs choose nothing.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import crashkit
from crashkit.dataset import open_dataset
from crashkit.selection import runs_of


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--test", required=True, help="runs that choose nothing, such as 96:120")
    parser.add_argument("--model", type=Path, help="a model trained without them; default: one is trained")
    parser.add_argument("--points", type=int, default=20)
    parser.add_argument("--noise", type=float, default=1e-3, help="standard deviation of a component, m")
    parser.add_argument("-o", "--output", type=Path, help="where the table goes as Markdown, too")
    options = parser.parse_args(arguments)
    lines: list[str] = []
    for line in table(options.dataset, options.test, options.model, options.points, options.noise):
        print(line, flush=True)
        lines.append(line)
    if options.output:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def table(dataset: Path, test: str, folder: Path | None, count: int, noise: float) -> Iterator[str]:
    """Markdown, line by line, as soon as each is known."""
    model = crashkit.load_model(folder) if folder else crashkit.train(dataset, model="pod-gpr", test=test)
    random = np.random.default_rng(0)
    names, units = list(model.parameters), [u for *_, u in model.parameters.values()]
    errors, within, inside, seconds = [], [], [], []
    with open_dataset(dataset) as opened:
        nodes = np.sort(random.choice(opened.sizes["node"], count, replace=False))
        number = opened["node_id"].values[nodes]
        start = opened["reference_position"].values[..., nodes, :]
        yield f"{count} nodes, noise {1e3 * noise:g} mm, {len(model.record.fitted_runs)} training runs"
        yield ""
        yield (
            "| run | " + " | ".join(f"{n} ({u}): true, found" for n, u in zip(names, units)) + " | in the 90 % region |"
        )
        yield "|---|" + "---|" * (len(names) + 1)
        for run in runs_of([str(n) for n in opened["sim"].values], test):
            one = opened.isel(sim=run)
            place = (start if start.ndim == 2 else start[run]) + one["displacement"].values[-1, nodes]
            place = place + noise * random.standard_normal(place.shape)
            points = pd.DataFrame(place, columns=["px [m]", "py [m]", "pz [m]"]).assign(node=number)
            started = time.perf_counter()
            found = crashkit.invert(model, points, noise=noise)
            seconds.append(time.perf_counter() - started)
            true = {n: float(one[n]) for n in names}
            low, high = found.posterior.interval(0.9)
            errors.append([found.best[n] - true[n] for n in names])
            within.append([a <= true[n] <= b for n, a, b in zip(names, low, high)])
            inside.append(found.contains(true))
            pairs = " | ".join(f"{true[n]:.4g}, {found.best[n]:.4g}" for n in names)
            yield f"| {run} | {pairs} | {'yes' if inside[-1] else 'no'} |"
            errors[-1] += [100 * abs(e) / max(abs(true[n]), 1e-12) for e, n in zip(errors[-1], names)]
    found_errors = np.abs(np.array(errors))
    yield ""
    yield "| parameter | median error | median error (%) | largest error | 90 % interval holds |"
    yield "|---|---|---|---|---|"
    for k, (name, unit) in enumerate(zip(names, units)):
        own, share = found_errors[:, k], found_errors[:, len(names) + k]
        told = f"{np.median(own):.3g} {unit} | {np.median(share):.2f} | {own.max():.3g} {unit}"
        yield f"| {name} | {told} | {np.mean([w[k] for w in within]):.2f} |"
    yield ""
    yield f"90 % region holds the truth in {sum(inside)} of {len(inside)} runs; {np.median(seconds):.1f} s a run"


if __name__ == "__main__":
    main()
