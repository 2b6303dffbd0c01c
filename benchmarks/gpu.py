"""What a GPU makes of training: the paper's preset with its step as one CUDA graph, beside eager torch and torch_geometric.

    python benchmarks/gpu.py -o gpu-results [--campaign kart.h5] [--epochs 20] [--vehicle 300000]
    python benchmarks/gpu.py -o trial --rehearse                     # on a CPU, in small: whether it goes to its end

One command, ten minutes on one device. Without a CUDA device it says so, and ends with code 3; `--rehearse` takes every
step on a CPU with tiny sizes, and its figures mean nothing. It writes into the
folder, after each part, results.json (every figure) and results.md (the same as a table):

    levels     MH3, MH2 and MH1 of the paper's preset on the campaign's training runs: seconds an epoch with the step
               captured as one graph and with one call after the other, sparse and dense operators, the losses of each
               epoch, and the error on validation runs
    peer       a step of the same networks of torch_geometric's ChebConv against ours, captured and not (`train_step`);
               torch_geometric's drops edges by a mask in every pass, which no graph can capture
    predict    a run of all states at each level, alone and 64 runs at once
    vehicle    the levels of a campaign of `--vehicle` nodes (made as `vehicle.py` does) in float32, tf32 and bfloat16:
               seconds an epoch, peak device memory, and the error on validation runs

`--data` and `--vehicle-data` take datasets with their hierarchy that are ready, so that nothing needs VTK on the device's
machine.

The goal: an epoch of MH1 at 1165 nodes, 9696 samples, in less than 0.1 s.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

GOAL = 0.1  # s, an epoch of MH1 with 9696 samples
NO_DEVICE = 3

Results = dict[str, Any]


def synchronised(call: Callable[[], Any]) -> float:
    """Seconds of a call, with all that it started on the device."""
    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    wait()
    started = time.perf_counter()
    call()
    wait()
    return time.perf_counter() - started


def trained(
    data: Path,
    out: Path,
    epochs: int,
    captured: bool,
    options: argparse.Namespace,
    more: tuple[str, ...] = (),
    test: str | float | None = None,
) -> Results:
    """Train the paper's cascade; of each level the seconds of an epoch, the error on validation runs, the losses; peak memory."""
    import crashkit
    from surrogates.training import loop, trainer

    cuda = options.device == "cuda"
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    out_of: Results = {"seconds_per_epoch": {}, "error_cm": {}, "loss": {}}

    def fit(*arguments: Any, name: str, report: Any = None, **named: Any) -> Any:
        ends, heard = [time.perf_counter()], []

        def told(epoch: Any) -> None:
            ends.append(time.perf_counter())
            heard.append(epoch)

        found = loop.fit(*arguments, name=name, report=told, **named, captured=captured)
        # The first epoch also warms up, and records the graph.
        out_of["seconds_per_epoch"][name] = float(np.median(np.diff(ends)[1:]))
        out_of["error_cm"][name] = 100 * float(heard[-1].best_error)
        out_of["loss"][name] = [float(epoch.total) for epoch in heard]
        return found

    before = trainer.run_epochs
    trainer.run_epochs = fit
    try:
        crashkit.train(
            data, out, "mh", preset="paper", device=options.device, test=test or options.test, overwrite=True, progress=False,
            settings=["validation.measure=runs", f"level.epochs={epochs}", "transfer.epochs=1", *more],
        )  # fmt: skip
    finally:
        trainer.run_epochs = before
    out_of["peak_gib"] = torch.cuda.max_memory_allocated() / 2**30 if cuda else 0.0
    return out_of


def prepared(source: Path, place: Path, nodes: str) -> Path:
    """The campaign as a dataset with its hierarchy."""
    import crashkit

    data = place / f"{source.stem}.zarr"
    crashkit.ingest([source], data)
    crashkit.coarsen(data, nodes=[int(n) for n in nodes.split(",")])
    return data


def levels(data: Path, place: Path, options: argparse.Namespace) -> Results:
    """Both forms of the step from the same start; the operator of the finest level in both of its forms."""
    from surrogates.operators import graph

    out: Results = {"captured": trained(data, place / "mh", options.epochs, True, options)}
    out["eager"] = trained(data, place / "eager", max(2, options.epochs // 4), False, options)
    before = dict(graph.DENSE_UP_TO)
    for form, limit in (("sparse operators", 0), ("dense operators", 4096)):
        graph.DENSE_UP_TO["cuda"] = limit
        try:
            found = trained(data, place / "form", max(2, options.epochs // 4), True, options)
            out[f"captured, {form}"] = found
        except Exception as error:
            out[f"captured, {form}"] = {"failed": f"{type(error).__name__}: {error}"}
    graph.DENSE_UP_TO.update(before)
    return out


class _OneBatch(torch.nn.Module):
    """A model of `train_step` with its batch, as the training loop's step wants it."""

    def __init__(self, model: Any, x: torch.Tensor, inputs: torch.Tensor) -> None:
        super().__init__()
        self.model, self.x, self.inputs = model, x, inputs

    def forward(self, index: torch.Tensor) -> torch.Tensor:
        loss = self.model.loss(self.x, self.inputs) / 2
        return torch.stack([loss, loss])


def captured_stepper(model: Any, x: torch.Tensor, inputs: torch.Tensor) -> Callable[[], Any]:
    """`train_step.stepper` by the training loop's captured step."""
    from surrogates.training.loop import CapturedStep

    given = [{"params": list(model.parameters()), "factor": 1.0}]
    optimiser = torch.optim.AdamW(given, lr=1e-3, fused=True)
    step = CapturedStep(_OneBatch(model, x, inputs), optimiser, torch.ones(2, device=x.device), 0.0, "float32")
    index = torch.arange(len(inputs), device=x.device)
    return lambda: step(index, 1e-3)


def peer(data: Path, place: Path, options: argparse.Namespace) -> Results:
    """Steps of `train_step` on the device, milliseconds."""
    import train_step as step

    out: Results = {}
    device = options.device
    for nodes in options.peer:
        edges = step.band(nodes)
        ours, again, theirs = step.Ours(edges, nodes), step.Ours(edges, nodes), step.Peer(edges, nodes)
        theirs.take_weights(ours)
        again.load_state_dict(ours.state_dict())
        ours, again, theirs = ours.to(device), again.to(device), theirs.to(device)
        theirs.edge_index, theirs.lambda_max = theirs.edge_index.to(device), theirs.lambda_max.to(device)
        x, inputs = torch.randn(3, nodes, step.BATCH, device=device).permute(1, 2, 0), torch.randn(32, 4, device=device)
        stacked = x.transpose(0, 1).reshape(-1, 3)
        calls = {
            "ours, captured": captured_stepper(again, x, inputs),
            "ours, eager": step.stepper(ours, x, inputs, fused=True),
            "torch_geometric, eager": step.stepper(theirs, stacked, inputs, fused=True),
        }
        for _ in range(5):
            for call in calls.values():
                call()
        # The same steps were taken: both forms of ours stand at the same weights.
        apart = max(float((a - b).detach().abs().max()) for a, b in zip(ours.parameters(), again.parameters()))
        took = {
            name: 1e3
            * min(synchronised(lambda c=call: [c() for _ in range(options.steps)]) / options.steps for _ in range(3))  # type: ignore[misc]
            for name, call in calls.items()
        }
        fastest = min(took["ours, captured"], took["ours, eager"])
        out[str(nodes)] = {
            **took, "times faster than torch_geometric": took["torch_geometric, eager"] / fastest,
            "largest difference of weights, captured and eager": apart,
        }  # fmt: skip
    return out


def predict(data: Path, place: Path, options: argparse.Namespace) -> Results:
    """Milliseconds of a run, and of each of 64 runs at once, by level."""
    import crashkit

    model = crashkit.load_model(place / "mh")
    device = options.device
    core, times = model.surrogate.core.to(device), torch.from_numpy(model.time).to(device)
    low, high = (torch.from_numpy(a).to(device) for a in (model.record.ranges.low, model.record.ranges.high))
    out: Results = {}
    for name, level in model.levels.items():
        cost = {}
        for runs in (1, 64):
            at = (low + (high - low) * torch.rand(runs, len(low), device=device, dtype=low.dtype)).repeat_interleave(
                len(times), 0
            )
            with torch.no_grad():
                cost[f"{runs} runs"] = 1e3 * min(
                    synchronised(lambda a=at, r=runs, k=level: core(a, times.repeat(r), k)) / runs  # type: ignore[misc]
                    for _ in range(5)
                )
        out[name] = cost
    return out


def vehicle(data: Path, place: Path, options: argparse.Namespace) -> Results:
    """Levels 3 to 1 of a campaign of vehicle size, in each precision."""
    large = options.vehicle_data
    if large is None:
        from vehicle import make

        from crashkit.dataset import demo_data

        source = place / "vehicle.h5"
        nodes = make(source, options.campaign or demo_data(), options.vehicle, *options.runs)
        large = prepared(source, place, f"{nodes // 8},{nodes // 64},{nodes // 512}")
    out: Results = {}
    for precision in ("float32", "tf32", "bfloat16"):
        out[precision] = trained(
            large,
            place / "vehicle",
            options.vehicle_epochs,
            True,
            options,
            (f"precision={precision}", "level.batch=32"),
        )
    return out


PARTS = {"levels": levels, "peer": peer, "predict": predict, "vehicle": vehicle}


def table(results: Results) -> str:
    """All figures as a table, one a row."""

    def rows(found: Any, path: tuple[str, ...]) -> list[str]:
        if isinstance(found, dict):
            return [row for key, value in found.items() for row in rows(value, (*path, str(key)))]
        return [
            f"| {' / '.join(path)} | {found:.4g} |" if isinstance(found, float) else f"| {' / '.join(path)} | {found} |"
        ]

    return "\n".join(["| what | figure |", "|---|---|", *rows(results, ())]) + "\n"


def _campaign(place: Path, options: argparse.Namespace) -> Path:
    """The campaign that was named, or the embedded one, as a dataset with its hierarchy."""
    import h5py

    from crashkit.dataset import demo_data

    source = options.campaign or demo_data()
    with h5py.File(source) as file:
        n = file["kart/displacements"].shape[2]
    if options.rehearse:
        from vehicle import make

        source = place / "small.h5"
        n = make(source, options.campaign or demo_data(), n, *options.runs)
    return prepared(source, place, options.nodes or f"{n // 8},{n // 32},{n // 128}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", "-o", type=Path, default=Path("gpu-results"))
    parser.add_argument("--campaign", type=Path, help="runs in the layout of the embedded ones, which are the default")
    parser.add_argument(
        "--nodes", default="", help="nodes of the levels; default: an eighth, then a quarter of that, twice"
    )
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--vehicle", type=int, default=300_000, help="nodes of the large campaign")
    parser.add_argument("--data", type=Path, help="a ready dataset with its hierarchy, instead of --campaign")
    parser.add_argument("--vehicle-data", type=Path, help="the same for the large campaign")
    parser.add_argument("--test", default=0.2, help="test runs, which are left out of everything, as --test of train")
    parser.add_argument("--vehicle-epochs", type=int, default=8)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--rehearse", action="store_true", help="on a CPU with tiny sizes: does it go to its end?")
    options = parser.parse_args()
    options.device, options.peer, options.steps, options.runs = "cuda", (73, 292, 1165), 50, (24, 51)
    if options.rehearse:
        options.device, options.peer, options.steps, options.runs = "cpu", (19,), 2, (8, 6)
        options.epochs, options.vehicle, options.vehicle_epochs = 2, 2400, 2
    elif not torch.cuda.is_available():
        print(
            f"no CUDA device is there (torch {torch.__version__}); this benchmark needs one, and nothing was measured"
        )
        return NO_DEVICE
    options.output.mkdir(parents=True, exist_ok=True)
    device = "rehearsed on a CPU; figures mean nothing" if options.rehearse else torch.cuda.get_device_name()
    results: Results = {"device": device, "torch": torch.__version__}
    with tempfile.TemporaryDirectory(prefix="gpu-") as scratch:
        place = Path(scratch)
        data = options.data or _campaign(place, options)
        for name in options.only:
            started = time.perf_counter()
            try:
                results[name] = PARTS[name](data, place, options)
            except Exception as error:  # what one part runs into must not cost the others
                traceback.print_exc()
                results[name] = {"failed": f"{type(error).__name__}: {error}"}
            results[f"{name}, s"] = time.perf_counter() - started
            (options.output / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
            (options.output / "results.md").write_text(table(results), encoding="utf-8")
            print(f"{name}: {results[f'{name}, s']:.0f} s", flush=True)
    epoch = results.get("levels", {}).get("captured", {}).get("seconds_per_epoch", {}).get("MH1")
    if epoch is not None and not options.rehearse:
        print(f"an epoch of MH1: {epoch:.3f} s (goal, at 1165 nodes and 9696 samples: below {GOAL} s)")
    print(table(results))
    return 1 if any("failed" in results[name] for name in options.only) else 0


if __name__ == "__main__":
    sys.exit(main())
