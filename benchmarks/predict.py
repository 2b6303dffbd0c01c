"""Milliseconds of a prediction at each level, against PODNN, torch_geometric and one POD reconstruction.

    python benchmarks/predict.py [--mesh FILE] [--nodes 1165 292 73] [--threads 2] [--seconds 4] [--quick] [--json FILE]

Asked are one state and a run of 101 states, on the level's own nodes and lifted to the full mesh, through
`Surrogate.predict` and `predict_full`: numbers in, a numpy array out. Weights are random, since only time counts; both
presets are measured, "fast" with a Gaussian process over 84 runs beside its network, as `regression: auto` may choose.

Beside them, in turns within one run:

    torch_geometric  the paper preset's cascade of ChebConv layers over a block-diagonal batch, as public code does it,
                     with the same weights; its displacements are compared with ours before anything is timed
    PODNN            on the full mesh, with as many modes as the preset has latent numbers
    reconstruction   the matrix product of PODNN alone: (states, r) times (r, 3 * node), float32, into a new array

The goal: a run of 101 states at the finest level, lifted, costs at most 3 reconstructions of that run. It is given twice:
with all answers kept, so that each needs new memory from the system, and with each dropped before the next is asked for,
so that one piece of memory, still in cache, serves all. Getting memory costs a reconstruction more than computing.
Beside it stands how many times the operations of a reconstruction the decoders and the lifting take: where answers are
dropped, a smaller ratio would need a faster processor for graphs than for matrix products.
The mesh is a closed band of 9314 nodes, or with `--mesh` the surface in a file.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch_geometric.nn import ChebConv as PeerConv
from train_step import median_turns

from crashkit.mesh.hierarchy import build_hierarchy
from surrogates.data.campaign import Campaign
from surrogates.data.graphs import Graphs
from surrogates.data.inputs import Ranges
from surrogates.data.samples import ValidationSplit
from surrogates.data.scaling import InputScaling
from surrogates.models.cascade import Cascade, build_level
from surrogates.models.level import LevelNetwork
from surrogates.record import Record
from surrogates.regression.latent_process import LatentProcess
from surrogates.settings import Settings, settings
from surrogates.surrogate import Surrogate

STATES, RUNS, GOAL = 101, 84, 3.0
PARAMETERS = np.array([[10.0, -10.0, 2e8], [30.0, 10.0, 5e8]])
ASKED = np.array([21.0, 3.0, 3.1e8])
TIME = np.linspace(0.0, 0.03, STATES)


def band(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and triangles of a closed band of about n nodes, a little uneven as real meshes are."""
    around = max(6, round(np.sqrt(n_nodes)))
    rows = max(3, round(n_nodes / around))
    row, column = np.divmod(np.arange(rows * around), around)
    dice = np.random.default_rng(0)
    angle, height = 2 * np.pi * column / around, 2 * np.pi * row / around
    radius = 1 + 0.2 * np.sin(3 * height) + 0.02 * dice.standard_normal(len(row))
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    a = np.arange((rows - 1) * around)
    b = a // around * around + (a + 1) % around
    faces = np.concatenate([np.column_stack([a, b, a + around]), np.column_stack([b, b + around, a + around])])
    return points, faces


def mesh_of(file: Path) -> tuple[np.ndarray, np.ndarray]:
    import pyvista as pv

    mesh = pv.read(file).triangulate()
    return np.asarray(mesh.points, float), mesh.regular_faces


def graphs_of(points: np.ndarray, faces: np.ndarray, nodes: list[int]) -> Graphs:
    hierarchy = build_hierarchy(points, faces, nodes)
    return Graphs(len(points), hierarchy.levels)


def untrained(chosen: Settings, graphs: Graphs) -> Surrogate:
    """A surrogate with random weights on all levels that `chosen` names, or all that there are."""
    torch.manual_seed(0)
    ranges = Ranges.of(("impact_speed", "impact_angle", "yield_stress"), ("m s-1", "degree", "Pa"), PARAMETERS, TIME)
    cascade = Cascade(InputScaling(ranges))
    for number in chosen.levels or range(len(graphs.levels), 0, -1):
        level = build_level(number, chosen, graphs, cascade)
        with torch.no_grad():
            for parameter in level.reduction.parameters():
                parameter.normal_(std=0.1)
        if chosen.for_level(number).regression != "network":
            level.process = random_process(level.latent)
        cascade.add(number, level)
    campaign = Campaign(PARAMETERS, ranges.names, ranges.units, TIME, lambda _: np.empty(0), graphs.n_full)
    record = Record.of(campaign, chosen, ranges, ValidationSplit(np.array([0, 1]), np.array([], int)))
    return Surrogate(chosen, record, graphs, cascade)


def random_process(latent: int) -> LatentProcess:
    process = LatentProcess(RUNS, 3, STATES, latent)
    for tensor in (process.runs, process.mean, process.pull):
        tensor.normal_()
    process.time.copy_(torch.linspace(-1, 1, STATES))
    process.numbers.fill_(1.0)
    process.share.fill_(0.5)
    return process


class Peer(nn.Module):
    """The cascade of the paper preset in torch_geometric, as far as prediction needs it."""

    def __init__(self, surrogate: Surrogate) -> None:
        super().__init__()
        self.surrogate = surrogate
        self.levels: dict[int, LevelNetwork] = surrogate.core.levels
        self.convolutions = {
            k: [self._like(layer) for layer in level.reduction.decoder.convolutions.layers]
            for k, level in self.levels.items()
        }

    @staticmethod
    def _like(layer: nn.Module) -> PeerConv:
        order, a, b = layer.weight.shape
        out = PeerConv(a, b, K=order)
        with torch.no_grad():
            out.bias.copy_(layer.bias)
            for linear, weight in zip(out.lins, layer.weight, strict=True):
                linear.weight.copy_(weight.t())
        return out

    def edge_index(self, number: int, batch: int) -> Tensor:
        """Edges of the block-diagonal batch, made before the clock runs."""
        edges, n = self.surrogate.graphs.edges(number), self.levels[number].n_nodes
        both = torch.from_numpy(np.concatenate([edges, edges[:, ::-1]]).T.astype(np.int64))
        return both.repeat(1, batch) + (torch.arange(batch) * n).repeat_interleave(both.shape[1])

    def regress(self, inputs: Tensor, number: int) -> Tensor:
        level = self.levels[number]
        if level.coarse is None:
            return level.regressor.network(inputs)
        return level.regressor.network(torch.cat([inputs, self.regress(inputs, number + 1)], dim=1))

    def decode(self, z: Tensor, number: int, edges: dict[int, Tensor]) -> Tensor:
        """(batch, latent) -> (batch, node, 3)"""
        level, operator = self.levels[number], self.levels[number].reduction.decoder.convolutions.operator
        x = functional.elu(level.reduction.decoder.dense(z)).view(len(z) * level.n_nodes, -1)
        largest = torch.tensor(operator.lambda_max)
        for k, conv in enumerate(self.convolutions[number]):
            x = conv(x, edges[number], lambda_max=largest)
            x = functional.elu(x) if k + 1 < len(self.convolutions[number]) else x
        x = x.view(len(z), level.n_nodes, 3)
        if level.upsampling is None:
            return x
        return x + level.upsampling.weight @ self.decode(z, number + 1, edges) + level.upsampling.bias[:, None]

    @torch.no_grad()
    def predict(self, time: np.ndarray, number: int, edges: dict[int, Tensor]) -> np.ndarray:
        parameters = torch.from_numpy(np.repeat(ASKED[None], len(time), axis=0))
        inputs = self.surrogate.core.inputs(parameters, torch.from_numpy(time))
        return self.decode(self.regress(inputs, number), number, edges).numpy()


def rows_of(preset: str, graphs: Graphs, seconds: float) -> list[dict[str, Any]]:
    """One row for each level, number of states and target; the last one is the finest level's lifted run."""
    surrogate = untrained(settings("mh", preset), graphs)
    latent = surrogate.n_latent()
    podnn = untrained(settings("podnn", overrides=[f"level.latent={latent}"]), graphs)
    peer = Peer(surrogate) if preset == "paper" else None
    modes = np.random.default_rng(0).standard_normal((3 * graphs.n_full, latent)).astype(np.float32)
    rows: list[dict[str, Any]] = []
    for times in (TIME[-1:], TIME):
        z = np.random.default_rng(1).standard_normal((len(times), latent)).astype(np.float32)
        for name, number in surrogate.level_names.items():
            for lifted in (False, True):
                ask = surrogate.predict_full if lifted else surrogate.predict
                steps = [lambda ask=ask, t=times, n=number: ask(ASKED, t, n)]
                steps.append(lambda z=z: z @ modes.T)
                if lifted:
                    steps.append(lambda t=times: podnn.predict(ASKED, t))
                if peer is not None:
                    edges = {k: peer.edge_index(k, len(times)) for k in surrogate.core.numbers if k >= number}

                    def by_peer(
                        t: np.ndarray = times, n: int = number, e: Any = edges, up: bool = lifted
                    ) -> np.ndarray:
                        u = peer.predict(t, n, e)
                        return surrogate.lift(u, n) if up else u

                    steps.append(by_peer)
                    same(name, steps[0](), by_peer())
                taken = [1e3 * t for t in median_turns(steps, seconds)]
                row: dict[str, Any] = {"preset": preset, "level": name, "nodes": graphs.n_nodes(number)}
                row |= {"states": len(times), "lifted": lifted, "ours_ms": taken[0], "reconstruction_ms": taken[1]}
                row["podnn_ms"] = taken[2] if lifted else None
                row["torch_geometric_ms"] = taken[-1] if peer is not None else None
                rows.append(row)
                print(shown(row), flush=True)
    rows[-1]["kept_ms"] = kept(steps[:2])
    return rows


def kept(steps: list[Callable[[], np.ndarray]], turns: int = 60) -> list[float]:
    """Median milliseconds of each step, in turns, where every answer is kept."""
    give_back_memory()
    answers: list[np.ndarray] = []
    taken: list[list[float]] = [[] for _ in steps]
    for _ in range(turns):
        for step, times in zip(steps, taken, strict=True):
            start = time.perf_counter()
            answers.append(step())
            times.append(1e3 * (time.perf_counter() - start))
    return [float(np.median(times)) for times in taken]


def give_back_memory() -> None:
    """What earlier turns freed goes back to the system, where the C library can do that."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def operations(surrogate: Surrogate) -> float:
    """Floating-point operations of one state from the latent vector to the full mesh."""
    total = 6.0 * surrogate.graphs.to_full(surrogate.number(None)).nnz
    for level in surrogate.core.levels.values():
        decoder = getattr(level.reduction, "remainder", level.reduction).decoder
        nodes, entries = level.n_nodes, decoder.convolutions.operator.matrix.nnz
        total += 2.0 * decoder.dense.weight.numel()
        total += 0.0 if hasattr(level.reduction, "decoder") else 6.0 * nodes * level.latent
        total += 0.0 if level.upsampling is None else 6.0 * level.upsampling.weight.numel()
        for layer in decoder.convolutions.layers:
            order, a, b = layer.weight.shape
            total += 2.0 * order * a * b * nodes + 2.0 * (order - 1) * min(a, b) * entries
    return total


def same(name: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    apart = np.abs(ours - theirs).max() / np.abs(theirs).max()
    if not apart < 1e-4:
        raise SystemExit(f"{name}: predictions differ by {apart:.1e} of the largest; the two are not the same network")


def shown(row: dict[str, Any]) -> str:
    def cell(value: float | None, width: int) -> str:
        return f"{'-' if value is None else format(value, '.3f'):>{width}}"

    return (
        f"{row['preset']:6} {row['level']:5} {row['nodes']:6d} {row['states']:6d}  {'full mesh' if row['lifted'] else 'own nodes'}"
        f" {cell(row['ours_ms'], 9)} {cell(row['torch_geometric_ms'], 18)} {cell(row['podnn_ms'], 10)} {cell(row['reconstruction_ms'], 17)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mesh", type=Path, default=None, help="surface mesh; default: a band of 9314 nodes")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1165, 292, 73], help="nodes of levels 1, 2, ..")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=4.0, help="time spent on each row")
    parser.add_argument("--quick", action="store_true", help="half a second on each row")
    parser.add_argument("--json", type=Path, default=None, help="write the ratios that have a goal")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    graphs = graphs_of(*(band(9314) if options.mesh is None else mesh_of(options.mesh)), options.nodes)
    print(
        f"{options.threads} threads; levels of {', '.join(str(k.n_nodes) for k in graphs.levels)} nodes under {graphs.n_full}"
    )
    print("preset level  nodes states  target       ours ms torch_geometric ms   PODNN ms reconstruction ms")
    entries = []
    for preset in ("fast", "paper"):
        last = rows_of(preset, graphs, 0.5 if options.quick else options.seconds)[-1]
        latent = settings("mh", preset).level.latent
        times = operations(untrained(settings("mh", preset), graphs)) / (2.0 * 3 * graphs.n_full * latent)
        run = f"a run at {last['level']} lifted to {graphs.n_full} nodes"
        measured = {"kept": last["kept_ms"], "dropped": [last["ours_ms"], last["reconstruction_ms"]]}
        for how, (ours, reconstruction) in measured.items():
            entries.append(
                {
                    "what": f"{run}, {preset} preset / one POD reconstruction, answers {how}",
                    "ratio": ours / reconstruction,
                    "goal": GOAL,
                    "sense": "at most",
                    "note": f"{ours:.1f} ms; {latent} modes take {reconstruction:.1f} ms; {times:.1f}-fold operations",
                }
            )
    for entry in entries:
        print(f"{entry['what']}: {entry['ratio']:.2f} ({entry['sense']} {entry['goal']:g}); {entry['note']}")
    if options.json is not None:
        options.json.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
