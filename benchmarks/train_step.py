"""One training step of a level against torch_geometric and against what the machine can do.

    python benchmarks/train_step.py [--nodes 73 292 1165 9314] [--mesh FILE] [--threads 2] [--seconds 10] [--forms]
                                    [--quick] [--json FILE]

The step: batch 32, approximation and reconstruction loss, AdamW; encoder 3-6-12-24 channels and a dense layer to
latent 4, decoder in reverse, MLP 4-64-64-64-4, ELU, three Chebyshev terms. Ours is `surrogates.operators.graph`. The peer is
the same network of torch_geometric's ChebConv over a block-diagonal batch, as public code does it: samples below each
other, edges repeated for every sample, the Laplacian normalised in every forward pass of every layer. Both start from
the same weights, and their losses are compared before anything is timed. The peer is spared the making of its
batches (edges are repeated once) and gets torch's default AdamW.

The limit is the larger of two times: the step's floating-point operations at the rate of a large matrix product, and
the bytes that must cross the memory at the rate of a large copy, both measured in the same run. Operations count each
product once forward and twice backward (once where the input needs no gradient); bytes count each layer's input and
output once forward and twice backward, weights, gradients and the optimiser's two moments: nothing is kept in cache
between layers, and nothing else moves.

The graphs: a triangulated band, or with `--mesh` the surface in a file and its coarse levels.
Turns: one step of each in turn until the time is spent; the median of each is given, so a busy machine slows both.
`--forms` compares instead the sparse and the dense form of the operator, which settles `surrogates.operators.graph.DENSE_UP_TO`.
`--quick` leaves out 9314 nodes and takes 3 seconds for each size; `--json` writes the ratios.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional
from torch_geometric.nn import ChebConv as PeerConv

from surrogates.operators.graph import GraphOperator
from surrogates.operators.stacks import GraphDecoder, GraphEncoder

BATCH, LATENT, CHANNELS, ORDER = 32, 4, (3, 6, 12, 24), 3
GOAL = 10.0


def band(n_nodes: int) -> np.ndarray:
    """(e, 2) edges of a triangulated closed band of n nodes: six neighbours a node, as on a crash model's skin."""
    around = max(6, round(np.sqrt(n_nodes / 8)))
    k = np.arange(n_nodes)
    angle, height = 2 * np.pi * (k % around) / around, k // around + (k % around) / around
    radius = around / (2 * np.pi)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    neighbours = cKDTree(points).query(points, k=min(7, n_nodes))[1][:, 1:]
    edges = np.column_stack([np.repeat(k, neighbours.shape[1]), neighbours.ravel()])
    return np.unique(np.sort(edges, axis=1), axis=0)


def graphs_of_mesh(file: Path, sizes: list[int]) -> dict[int, np.ndarray]:
    """Nodes -> edges of the mesh in `file` and of its coarse levels with `sizes` nodes."""
    import pyvista as pv

    from crashkit.mesh.hierarchy import build_hierarchy

    mesh = pv.read(file).triangulate()
    faces = mesh.regular_faces
    full = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graphs = {mesh.n_points: np.unique(np.sort(full, axis=1), axis=0)}
    coarse = sorted((n for n in sizes if n < mesh.n_points), reverse=True)
    if coarse:
        hierarchy = build_hierarchy(np.asarray(mesh.points, float), faces, coarse)
        graphs |= {level.n_nodes: level.edges for level in hierarchy.levels}
    return graphs


def mlp() -> nn.Sequential:
    sizes = (4, 64, 64, 64, LATENT)
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(sizes):
        layers += [nn.Linear(a, b), nn.ELU()]
    return nn.Sequential(*layers[:-1])


class Ours(nn.Module):
    def __init__(self, edges: np.ndarray, n_nodes: int, form: str = "auto") -> None:
        super().__init__()
        operator = GraphOperator(edges, n_nodes, form=form)
        self.encoder = GraphEncoder(operator, LATENT, CHANNELS, ORDER)
        self.decoder = GraphDecoder(operator, LATENT, CHANNELS[::-1], ORDER)
        self.mlp = mlp()

    def loss(self, x: Tensor, inputs: Tensor) -> Tensor:
        """x (node, batch, 3)"""
        _n, batch, _ = x.shape
        both = self.decoder(torch.cat([self.mlp(inputs), self.encoder(x)])).unflatten(1, (2, batch))
        return 2.0 * functional.mse_loss(both, x[:, None].expand_as(both))


class Peer(nn.Module):
    def __init__(self, edges: np.ndarray, n_nodes: int) -> None:
        super().__init__()
        self.n_nodes = n_nodes
        both_ways = torch.from_numpy(np.concatenate([edges, edges[:, ::-1]]).T.astype(np.int64).copy())
        shift = (torch.arange(BATCH) * n_nodes).repeat_interleave(both_ways.shape[1])
        self.edge_index = both_ways.repeat(1, BATCH) + shift
        steps = list(itertools.pairwise(CHANNELS))
        self.encode_convs = nn.ModuleList(PeerConv(a, b, K=ORDER) for a, b in steps)
        self.decode_convs = nn.ModuleList(PeerConv(b, a, K=ORDER) for a, b in reversed(steps))
        self.encode_dense = nn.Linear(n_nodes * CHANNELS[-1], LATENT)
        self.decode_dense = nn.Linear(LATENT, n_nodes * CHANNELS[-1])
        self.mlp = mlp()
        self.lambda_max: Tensor | None = None

    def encode(self, x: Tensor) -> Tensor:
        for conv in self.encode_convs:
            x = functional.elu(conv(x, self.edge_index, lambda_max=self.lambda_max))
        return self.encode_dense(x.view(BATCH, -1))

    def decode(self, z: Tensor) -> Tensor:
        x = functional.elu(self.decode_dense(z)).view(BATCH * self.n_nodes, -1)
        for conv in self.decode_convs[:-1]:
            x = functional.elu(conv(x, self.edge_index, lambda_max=self.lambda_max))
        return self.decode_convs[-1](x, self.edge_index, lambda_max=self.lambda_max)

    def loss(self, x: Tensor, inputs: Tensor) -> Tensor:
        """x (batch * node, 3)"""
        approximation = self.decode(self.mlp(inputs))
        reconstruction = self.decode(self.encode(x))
        return functional.mse_loss(approximation, x) + functional.mse_loss(reconstruction, x)

    def take_weights(self, ours: Ours) -> None:
        """The same network: weights of `ours`, and its lambda_max where the peer would guess one."""
        with torch.no_grad():
            for theirs, mine in (
                (self.encode_convs, ours.encoder.convolutions.layers),
                (self.decode_convs, ours.decoder.convolutions.layers),
            ):
                for conv, layer in zip(theirs, mine):
                    conv.bias.copy_(layer.bias)
                    for linear, weight in zip(conv.lins, layer.weight):
                        linear.weight.copy_(weight.t())
            self.encode_dense.load_state_dict(ours.encoder.dense.state_dict())
            self.decode_dense.load_state_dict(ours.decoder.dense.state_dict())
            self.mlp.load_state_dict(ours.mlp.state_dict())
        self.lambda_max = torch.tensor(ours.encoder.convolutions.operator.lambda_max)


def stepper(model: Ours | Peer, x: Tensor, inputs: Tensor, *, fused: bool) -> Callable[[], None]:
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-3, fused=fused or None)

    def step() -> None:
        optimiser.zero_grad()
        model.loss(x, inputs).backward()
        optimiser.step()

    return step


def work(n_nodes: int, n_entries: int) -> tuple[float, float]:
    """(floating-point operations, bytes) that one step cannot do without, as the docstring says."""
    operations = values = 0.0
    for passes, widths, first in ((1, CHANNELS, True), (2, CHANNELS[::-1], False)):
        states = passes * BATCH * n_nodes
        for k, (a, b) in enumerate(itertools.pairwise(widths)):
            mixing = 2.0 * states * ORDER * a * b
            moving = 2.0 * passes * BATCH * (ORDER - 1) * n_entries * min(a, b)
            times = 2 if first and k == 0 else 3  # the first layer's input needs no gradient
            operations += times * mixing + (1 if times == 2 else 2) * moving
            values += 3 * states * (a + b)
        operations += 3 * 2.0 * states * 24 * LATENT
    parameters = 2 * n_nodes * 24 * LATENT
    return operations, 4.0 * (values + 7 * parameters)


def rates(seconds: float) -> tuple[float, float]:
    """(operations a second of a 2048 x 2048 float32 matrix product, bytes a second of a 200 MB copy)."""
    a, b = torch.randn(2, 2048, 2048)
    c, d = torch.empty(2, 50_000_000)
    product = median_turns([lambda: torch.mm(a, b)], seconds)[0]
    copy = median_turns([lambda: d.copy_(c)], seconds)[0]
    return 2.0 * 2048**3 / product, 2.0 * 4 * c.numel() / copy


def median_turns(steps: list[Callable[[], object]], seconds: float, least: int = 5) -> list[float]:
    """Median seconds of each step, taken in turns."""
    for step in steps:
        step()
    taken: list[list[float]] = [[] for _ in steps]
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(taken[0]) < least:
        for step, times in zip(steps, taken):
            start = time.perf_counter()
            step()
            times.append(time.perf_counter() - start)
    return [float(np.median(times)) for times in taken]


def compare(n_nodes: int, edges: np.ndarray, seconds: float, peak: tuple[float, float]) -> dict[str, float]:
    torch.manual_seed(0)
    ours, peer = Ours(edges, n_nodes), Peer(edges, n_nodes)
    peer.take_weights(ours)
    x = torch.randn(3, n_nodes, BATCH).permute(1, 2, 0)  # the memory order the convolutions work in
    inputs = torch.randn(BATCH, 4)
    stacked = x.transpose(0, 1).reshape(-1, 3)
    mine, theirs = ours.loss(x, inputs).item(), peer.loss(stacked, inputs).item()
    if abs(mine - theirs) > 1e-4 * abs(theirs):
        raise SystemExit(f"{n_nodes} nodes: loss {mine} here, {theirs} there; the two are not the same network")
    t_ours, t_peer = median_turns(
        [stepper(ours, x, inputs, fused=True), stepper(peer, stacked, inputs, fused=False)], seconds
    )
    operations, size = work(n_nodes, ours.encoder.convolutions.operator.matrix.nnz)
    limit = max(operations / peak[0], size / peak[1])
    return {
        "nodes": n_nodes,
        "ours_ms": 1e3 * t_ours,
        "torch_geometric_ms": 1e3 * t_peer,
        "times_faster": t_peer / t_ours,
        "limit_ms": 1e3 * limit,
        "operations_ms": 1e3 * operations / peak[0],
        "bytes_ms": 1e3 * size / peak[1],
        "times_limit": t_ours / limit,
    }


def compare_forms(n_nodes: int, seconds: float) -> dict[str, float]:
    """The fused convolution over the sparse operator against the same over the dense one."""
    edges = band(n_nodes)
    x, inputs = torch.randn(3, n_nodes, BATCH).permute(1, 2, 0), torch.randn(BATCH, 4)
    steps = [stepper(Ours(edges, n_nodes, form), x, inputs, fused=True) for form in ("sparse", "dense")]
    sparse, dense = median_turns(steps, seconds)
    return {"nodes": n_nodes, "sparse_ms": 1e3 * sparse, "dense_ms": 1e3 * dense}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, nargs="+", default=None)
    parser.add_argument("--mesh", type=Path, default=None, help="surface mesh whose levels give the graphs")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=None, help="time spent on each size; default 10")
    parser.add_argument("--forms", action="store_true", help="compare the operator's forms instead")
    parser.add_argument("--quick", action="store_true", help="up to 1165 nodes, 3 seconds each")
    parser.add_argument("--json", type=Path, default=None, help="write the ratios that have a goal")
    options = parser.parse_args()
    options.seconds = options.seconds or (3.0 if options.quick else 10.0)
    torch.set_num_threads(options.threads)
    if options.forms:
        for n in options.nodes or (8, 16, 24, 32, 48, 73, 128, 292):
            row = compare_forms(n, options.seconds)
            print("  ".join(f"{name} {value:.4g}" for name, value in row.items()))
    else:
        peak = rates(min(2.0, options.seconds))
        print(f"{options.threads} threads; matrix product {peak[0] / 1e9:.0f} GFLOP/s, copy {peak[1] / 1e9:.1f} GB/s")
        print("  nodes   ours ms   torch_geometric ms   times faster   limit ms   times the limit")
        rows = []
        sizes = options.nodes or [73, 292, 1165, 9314][: 3 if options.quick else 4]
        graphs = {n: band(n) for n in sizes} if options.mesh is None else graphs_of_mesh(options.mesh, sizes)
        for n in sizes:
            if n not in graphs:
                raise SystemExit(f"{options.mesh} has {max(graphs)} nodes and no level of {n}")
            rows.append(row := compare(n, graphs[n], options.seconds, peak))
            print(
                f"{n:7d} {row['ours_ms']:9.2f} {row['torch_geometric_ms']:20.1f} {row['times_faster']:14.1f}"
                f" {row['limit_ms']:10.2f} {row['times_limit']:17.1f}",
                flush=True,
            )
        if options.json is not None:
            options.json.write_text(json.dumps([entry(row) for row in rows], indent=2) + "\n", encoding="utf-8")


def entry(row: dict[str, float]) -> dict[str, object]:
    """What the table of all benchmarks needs."""
    return {
        "what": f"training step of {row['nodes']} nodes, batch 32: torch_geometric / ours",
        "ratio": row["times_faster"],
        "goal": GOAL,
        "sense": "at least",
        "note": f"{row['ours_ms']:.2f} ms against {row['torch_geometric_ms']:.1f} ms; {row['times_limit']:.1f} times the machine's limit",
    }


if __name__ == "__main__":
    main()
