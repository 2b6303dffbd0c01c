"""Seconds of training until a level is as good as 1500 epochs at batch 32 and constant rate make it.

    python benchmarks/time_to_error.py [--data crash.zarr --test 96:120] [--work FOLDER] [--levels 1 2 3]
                                       [--epochs 1500] [--lengths 300 150 75 37] [--threads 2] [--quick] [--json FILE]

The baseline is the preset "paper" with `--epochs` epochs. Its error is that of its best epoch, and so is its time; later
epochs are not counted. Against it stands the preset "fast", trained with each of `--lengths` as its number of epochs (its
rate falls to nothing at the end, so a part of a long training is no short one): the quickest whose error is not larger
counts. The error is the mean node distance of predictions on the level's own nodes on validation runs, the same ones for
both, taken from the training runs by the seed. Test runs are never read. Seconds of a level include those of the
coarser ones that it rests on; those of "fast" are all that passed since its start, reading of data, POD and Gaussian
processes included, those of the baseline its epochs alone.

Without `--data` the embedded kart runs are ingested and coarsened to 300, 75 and 19 nodes first; runs 27:36 are test runs.
Trained models stay in `--work`, and one that is there is not trained again; a training that was killed goes on where it
stopped. `--quick` gives the baseline 30 epochs and "fast" 6, 3 and 1: it shows that all works, and says little.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from crashkit.api.train import train
from surrogates.settings import settings
from surrogates.storage.folder import load
from surrogates.surrogate import Surrogate
from surrogates.training.loop import Epoch

GOAL = 10.0
DEMO_NODES, DEMO_TEST = [300, 75, 19], "27:36"


def demo_dataset(path: Path) -> Path:
    """The embedded runs with their hierarchy, made once."""
    from crashkit.api.coarsen import coarsen
    from crashkit.dataset import demo_data
    from crashkit.ingestion.ingest import ingest

    if not path.exists():
        part = path.with_name(f"part-{path.name}")
        ingest(demo_data(), part)
        coarsen(part, DEMO_NODES)
        part.replace(path)
    return path


def trained(data: Path, folder: Path, preset: str, epochs: int, test: str) -> Surrogate:
    """The model in `folder`, trained first unless it is there. Beside it stands when each level was done."""
    if (folder / "model.json").exists():
        return load(folder)
    overrides = [f"level.epochs={epochs}", "validation.measure=runs"]
    resume = preset == "paper" and folder.with_name(f".{folder.name}.training").exists()
    started, last, done = time.perf_counter(), "", {}

    def tell(epoch: Epoch) -> None:
        nonlocal last
        now = time.perf_counter() - started
        if last and epoch.name != last:  # the first epoch of the next level is over
            done[last] = now
        last = epoch.name

    made = train(
        data, folder, "mh", settings=overrides, preset=preset, test=test, device="cpu", resume=resume, on_epoch=tell
    )
    done[last] = time.perf_counter() - started
    if any(fit.status == "interrupted" for fit in made.record.fits.values()):
        raise SystemExit("interrupted; the same command goes on")
    folder.with_name(f"{folder.name}.seconds.json").write_text(json.dumps(done), encoding="utf-8")
    return made.surrogate


def seconds_to_best(model: Surrogate, number: int) -> float:
    """Until the best epoch of `number`, and of each coarser level it rests on."""
    fits = {k: fit for k, fit in model.record.fits.items() if k >= number}
    return sum(fit.seconds * fit.best_epoch / fit.epochs for fit in fits.values())


def compare(
    baseline: Surrogate, candidates: dict[int, Surrogate], seconds: dict[int, dict[str, float]], number: int
) -> dict[str, Any]:
    """One entry of the table; `seconds` of each candidate until a level was done, by name."""
    name = next(n for n, k in baseline.level_names.items() if k == number)
    error = baseline.record.errors[name]
    slow = seconds_to_best(baseline, number)
    reached = {e: seconds[e][name] for e, m in candidates.items() if m.record.errors[name] <= error}
    best = min(reached, key=lambda e: reached[e], default=None)
    errors = ", ".join(f"{e} epochs {100 * m.record.errors[name]:.2f} cm" for e, m in sorted(candidates.items()))
    told = "not reached" if best is None else f"reached in {reached[best]:.1f} s with {best} epochs"
    return {
        "what": f"time to the baseline's error, {name} of {baseline.graphs.n_nodes(number)} nodes: baseline / fast preset",
        "ratio": 0.0 if best is None else slow / reached[best],
        "goal": GOAL,
        "sense": "at least",
        "note": f"{100 * error:.2f} cm after {slow:.1f} s; {told} ({errors})",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=None, help="coarsened dataset; default: the embedded runs")
    parser.add_argument("--test", default=DEMO_TEST, help="runs held out for testing")
    parser.add_argument("--work", type=Path, default=None, help="where trained models stay; default: nowhere")
    parser.add_argument("--levels", type=int, nargs="+", default=None, help="default: all")
    parser.add_argument("--epochs", type=int, default=None, help="of the baseline; default 1500")
    parser.add_argument("--lengths", type=int, nargs="+", default=None, help="of the fast preset")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path, default=None, help="write the ratios")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    usual = settings("mh", "fast").level.epochs
    epochs = options.epochs or (30 if options.quick else 1500)
    lengths = options.lengths or ([6, 3, 1] if options.quick else [usual, usual // 2, usual // 4, usual // 8])
    with tempfile.TemporaryDirectory(prefix="time-to-error-") as place:
        work = options.work or Path(place)
        work.mkdir(parents=True, exist_ok=True)
        data = demo_dataset(work / "demo.zarr") if options.data is None else options.data
        baseline = trained(data, work / f"paper-{epochs}", "paper", epochs, options.test)
        candidates = {e: trained(data, work / f"fast-{e}", "fast", e, options.test) for e in lengths}
        seconds = {e: json.loads((work / f"fast-{e}.seconds.json").read_text(encoding="utf-8")) for e in lengths}
    different = [e for e, m in candidates.items() if m.record.validation_runs != baseline.record.validation_runs]
    if different:
        raise SystemExit(f"the models in {work} were judged on different validation runs; choose another --work")
    entries = [compare(baseline, candidates, seconds, k) for k in options.levels or baseline.core.numbers]
    for entry in entries:
        print(f"{entry['what']}: {entry['ratio']:.1f} ({entry['sense']} {entry['goal']:g}); {entry['note']}")
    if options.json is not None:
        options.json.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
