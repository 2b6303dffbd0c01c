"""The mesh hierarchy against vtkQuadricDecimation: how near, how well it lifts, how fast, how much memory.

    python benchmarks/coarsen.py [quality | speed] [--quick] [--json FILE]
    python benchmarks/coarsen.py quality --campaign RUNS.h5 --mesh SURFACE.vtp --nodes 1165,292,73,36
    python benchmarks/coarsen.py speed --sizes 10000,30000,100000,400000 --figure docs/images/coarsen_speed.svg

quality: each mesh is coarsened to the same node counts three ways: by vtkQuadricDecimation as it is (its vertices are
moved, so there is nothing to train on; for lifting they are tied to distinct nearest nodes), by `--selection vtk`, and
by `--selection quadric`. Distances are those of the fine nodes to the coarse surface. The lifting error is the mean
of |U D u - u| over nodes, states and runs of a campaign in the paper's HDF5 layout; without `--campaign` the embedded
one. The airplane that pyvista ships (shells with T-joints) stands beside it, at 1/8, 1/32 and 1/128.

speed: a kart skin is subdivided to each size and goes to 1/8, 1/32 and 1/128 with all maps, against the time that
vtkQuadricDecimation takes for the three reductions in the same process; the goal is a ratio of at most 5 and less than
4 GiB. Times are processor times, so that other work on the machine counts little. Each size has a process of its own,
so that the peak memory is its own. Compilation (once a machine) is not counted.

--quick takes fewer states and smaller skins. --json writes the ratios that have a goal.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyvista as pv
from scipy import sparse
from scipy.spatial import cKDTree
from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

from crashkit.dataset import demo_data
from crashkit.mesh.hierarchy import build_hierarchy
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.lifting import LiftingMeter
from crashkit.mesh.selection import select_quadric
from crashkit.mesh.surface import Surface, surface
from data_schema.edges import face_edges

# Lifting errors, cm, that the full kart campaign of 4600 nodes shall stay below, by nodes kept.
LIFTING_GOAL = {1165: 0.045, 292: 0.15, 73: 0.33}
TIME_GOAL, MEMORY_GOAL, GROWTH_GOAL = 5.0, 4.0, 1.2
# States of a run that --quick looks at: every so many.
FEW = 20

Entries = list[dict[str, Any]]


def entry(what: str, ratio: float, goal: float, note: str) -> dict[str, Any]:
    return {"what": what, "ratio": float(ratio), "goal": goal, "sense": "at most", "note": note}


def decimated(position: np.ndarray, faces: np.ndarray, count: int) -> pv.PolyData:
    """What vtkQuadricDecimation gives with as near to `count` vertices as it goes."""
    mesh = pv.PolyData.from_regular_faces(position, faces)
    low, high, best = 0.0, 1.0, mesh
    reduction = 1 - count / len(position)
    for _ in range(20):
        out = reduced(mesh, reduction)
        if abs(out.n_points - count) < abs(best.n_points - count):
            best = out
        if out.n_points == count:
            break
        low, high = (reduction, high) if out.n_points > count else (low, reduction)
        reduction = (low + high) / 2
    return best


def reduced(mesh: pv.PolyData, reduction: float) -> pv.PolyData:
    decimate = vtkQuadricDecimation()
    decimate.SetInputData(mesh)
    decimate.SetTargetReduction(reduction)
    decimate.Update()
    return pv.wrap(decimate.GetOutput())


def distances(position: np.ndarray, coarse: pv.PolyData) -> np.ndarray:
    return np.linalg.norm(closest(position, coarse)[1] - position, axis=1)


def closest(position: np.ndarray, coarse: pv.PolyData) -> tuple[np.ndarray, np.ndarray]:
    """The closest cell of each position, and the closest point on it."""
    found: Any = coarse.find_closest_cell(position, return_closest_point=True)
    return found


def tied_lifting(mesh: Surface, coarse: pv.PolyData, blocks: Iterator[np.ndarray]) -> float:
    """Lifting error, m, when VTK's vertices are tied to distinct nearest nodes and VTK's triangles lift."""
    kept = distinct_nearest(np.asarray(coarse.points, np.float64), mesh.position)
    corners = coarse.regular_faces
    tied = pv.PolyData.from_regular_faces(mesh.position[kept], corners)
    cells, at = closest(mesh.position, tied)
    corners = kept[corners[cells]]
    weights = barycentric(at, *(mesh.position[corners[:, k]] for k in range(3)))
    rows = np.arange(0, corners.size + 1, 3)
    u = sparse.csr_matrix((weights.ravel().astype(np.float32), corners.ravel(), rows), (mesh.n_nodes, mesh.n_nodes))
    total, count = 0.0, 0
    for block in blocks:
        fine = block.transpose(1, 0, 2)
        error = (u @ fine.reshape(mesh.n_nodes, -1)).reshape(fine.shape) - fine
        total += float(np.linalg.norm(error, axis=-1).sum(dtype=np.float64))
        count += fine.shape[0] * fine.shape[1]
    return total / count


def distinct_nearest(points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """A node of its own for each of the points, the closest pairs first."""
    gap, near = cKDTree(nodes).query(points, k=min(256, len(nodes)))
    chosen, taken = np.full(len(points), -1), np.zeros(len(nodes), bool)
    order = np.argsort(gap.ravel(), kind="stable")
    for point, node in zip(order // gap.shape[1], near.ravel()[order], strict=True):
        if chosen[point] < 0 and not taken[node]:
            chosen[point], taken[node] = node, True
    if (chosen < 0).any():
        raise SystemExit("too many of VTK's vertices lie at one place to give each a node")
    return chosen


def barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    u, v, w = b - a, c - a, p - a
    uu, uv, vv, uw, vw = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = np.maximum(uu * vv - uv * uv, 1e-300)
    s, t = (vv * uw - uv * vw) / det, (uu * vw - uv * uw) / det
    out = np.clip(np.stack([1 - s - t, s, t], axis=1), 0, 1)
    return out / out.sum(axis=1, keepdims=True)


def campaign(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions, m, and faces of a campaign in the paper's layout."""
    with h5py.File(path) as file:
        return file["kart/reference_configuration"][0].astype(np.float64), file["kart/faces"][:].astype(np.int64)


def runs(path: Path, step: int) -> Iterator[np.ndarray]:
    """Displacements (state, node, 3), m, of one run after the other, every `step`-th state."""
    with h5py.File(path) as file:
        for run in range(len(file["kart/displacements"])):
            yield file["kart/displacements"][run, ::step]


def lifting(hierarchy: Hierarchy, path: Path, step: int) -> list[float]:
    meter = LiftingMeter(hierarchy)
    for u in runs(path, step):
        meter.add(u)
    return [error.mean for error in meter.errors]


def quality(arguments: argparse.Namespace) -> Entries:
    source = arguments.campaign or demo_data()
    position, faces = campaign(source)
    entries = compare(source.name, position, faces, arguments.nodes, 100.0, "cm", source, FEW if arguments.quick else 1)
    for path in arguments.mesh:
        entries += compare(path.name, *triangles(pv.read(path)), arguments.nodes, 100.0, "cm")
    position, faces = triangles(pv.examples.load_airplane())
    share = 1000 / float(np.linalg.norm(np.ptp(position, axis=0)))
    return entries + compare("airplane", position, faces, None, share, "thousandths of the diagonal")


def triangles(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.points, np.float64), mesh.regular_faces.astype(np.int64)


def compare(
    name: str, position: np.ndarray, faces: np.ndarray, counts: Sequence[int] | None, scale: float, unit: str,
    path: Path | None = None, step: int = 1,
) -> Entries:  # fmt: skip
    """Print one mesh's table, lengths times `scale`, lifting errors of the campaign at `path` in cm; its ratios."""
    n = len(position)
    counts = [c for c in counts or [n // 8, n // 32, n // 128] if c < n]
    mesh = surface(position, faces)
    print(f"\n{name}: {n} nodes; distance mean / max ({unit})" + (", lifting error (cm)" if path else ""))
    print(f"{'':30s}" + "".join(f"{c:>24d}" for c in counts))
    coarse = [decimated(position, faces, count) for count in counts]
    rows = {
        "vtkQuadricDecimation, moved": [
            (distances(position, c), tied_lifting(mesh, c, runs(path, step)) if path else None) for c in coarse
        ]
    }
    for selection in ("vtk", "quadric"):
        hierarchy = build_hierarchy(position, faces, counts, selection=selection)  # type: ignore[arg-type]
        errors = lifting(hierarchy, path, step) if path else [None] * len(counts)
        rows[f"--selection {selection}"] = [(k.distance, e) for k, e in zip(hierarchy.levels, errors, strict=True)]
    for label, cells in rows.items():
        print(f"{label:30s}" + "".join(f"{cell(d, e, scale):>24s}" for d, e in cells), flush=True)
    surplus = [f"{c.n_points - count:+d}" for c, count in zip(coarse, counts, strict=True)]
    print(f"nodes of vtkQuadricDecimation above or below the count: {', '.join(surplus)}")

    entries = []
    for count, (_, theirs), (_, ours) in zip(counts, *list(rows.values())[::2], strict=True):
        if ours is None or theirs is None:
            continue
        at = f"{name}, {n} -> {count} nodes"
        note = f"{100 * ours:.3f} / {100 * theirs:.3f} cm"
        entries.append(entry(f"{at}: lifting error / vtkQuadricDecimation's", ours / theirs, 1.0, note))
        if n == 4600 and count in LIFTING_GOAL:
            goal = LIFTING_GOAL[count]
            entries.append(entry(f"{at}: lifting error / {goal} cm", 100 * ours / goal, 1.0, f"{100 * ours:.3f} cm"))
    return entries


def cell(distance: np.ndarray, error: float | None, scale: float) -> str:
    told = "" if error is None else f"  {100 * error:.3f}"
    return f"{scale * distance.mean():.3f} / {scale * distance.max():.2f}{told}"


def skin(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The kart's skin with about `nodes` nodes: coarsened a little, subdivided, and given fine waves."""
    position, faces = campaign(demo_data())
    base, steps = nodes, 0
    while base > 2300:
        base, steps = base // 4, steps + 1
    chosen = select_quadric(surface(position, faces), [base], rounds=0)[0]
    own = np.full(len(position), -1)
    own[chosen.kept] = np.arange(base)
    position, faces = position[chosen.kept], own[chosen.faces]
    for _ in range(steps):
        edges = face_edges(faces).astype(np.int64)
        n = len(position)
        keys = edges[:, 0] * n + edges[:, 1]

        def middle(i: np.ndarray, j: np.ndarray, n: int = n, keys: np.ndarray = keys) -> np.ndarray:
            return n + np.searchsorted(keys, np.minimum(i, j) * n + np.maximum(i, j))

        a, b, c = faces.T
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        position = np.concatenate([position, position[edges].mean(axis=1)])
        faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return position + 2e-4 * np.sin(300 * position[:, [1, 2, 0]]), faces


def measure(nodes: int) -> dict[str, float]:
    """One size: processor seconds of VTK and ours, and the peak memory of ours (VTK's turn comes after)."""
    position, faces = campaign(demo_data())
    build_hierarchy(position, faces, [300, 75, 19])  # compiles
    position, faces = skin(nodes)
    n = len(position)
    start = time.process_time()
    hierarchy = build_hierarchy(position, faces, [n // 8, n // 32, n // 128])
    ours = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    mesh = pv.PolyData.from_regular_faces(position, faces)
    start = time.process_time()
    for level in hierarchy.levels:
        reduced(mesh, 1 - level.n_nodes / n)
    vtk = time.process_time() - start
    return {"nodes": n, "ours_s": ours, "vtk_s": vtk, "peak_gib": peak / 2**20}


def speed(arguments: argparse.Namespace) -> Entries:
    sizes = arguments.sizes or ([10_000, 30_000] if arguments.quick else [10_000, 30_000, 100_000, 400_000])
    results: list[dict[str, float]] = []
    print(f"\n{'nodes':>8} {'ours (s)':>9} {'VTK (s)':>9} {'ratio':>6} {'peak (GiB)':>10} {'us a node':>9}")
    for nodes in sizes:
        out = subprocess.run([sys.executable, __file__, "one", "--sizes", str(nodes)], capture_output=True, text=True)
        if out.returncode:
            raise SystemExit(f"{nodes} nodes: {out.stderr.strip() or out.returncode}")
        r = json.loads(out.stdout)
        results.append(r)
        print(
            f"{r['nodes']:8d} {r['ours_s']:9.2f} {r['vtk_s']:9.2f} {r['ours_s'] / r['vtk_s']:6.2f} {r['peak_gib']:10.2f} "
            f"{1e6 * r['ours_s'] / r['nodes']:9.0f}",
            flush=True,
        )
    if arguments.figure:
        draw(results, arguments.figure)
    last = results[-1]
    at = f"hierarchy of {last['nodes']} nodes with all maps"
    entries = [
        entry(
            f"{at}: time / vtkQuadricDecimation's", last["ours_s"] / last["vtk_s"], TIME_GOAL,
            f"{last['ours_s']:.1f} / {last['vtk_s']:.1f} s of processor time",
        ),
        entry(f"{at}: peak memory / {MEMORY_GOAL:g} GiB", last["peak_gib"] / MEMORY_GOAL, 1.0, f"{last['peak_gib']:.2f} GiB"),
    ]  # fmt: skip
    if len(results) > 1:
        n, t = (np.log([r[k] for r in results]) for k in ("nodes", "ours_s"))
        note = f"{results[0]['nodes']} to {last['nodes']} nodes; 1 is linear"
        entries.append(entry("time of a hierarchy: power of the nodes", np.polyfit(n, t, 1)[0], GROWTH_GOAL, note))
    return entries


def draw(results: list[dict[str, float]], path: Path) -> None:
    """Seconds and memory over nodes, both axes logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout="constrained", dpi=150)
    left, right = figure.subplots(1, 2)
    nodes, ours, vtk, peak = (np.array([r[k] for r in results]) for k in ("nodes", "ours_s", "vtk_s", "peak_gib"))
    left.loglog(nodes, ours, "o-", color="#c1121f", label="hierarchy with all maps")
    left.loglog(nodes, vtk, "s-", color="#3a6ea5", label="vtkQuadricDecimation, three reductions")
    left.loglog(nodes, ours[0] * nodes / nodes[0], ":", color="#5a5f66", label="linear")
    left.set_ylabel("processor time (s)")
    left.legend(frameon=False, fontsize=8)
    right.loglog(nodes, peak, "o-", color="#c1121f", label="hierarchy with all maps")
    right.axhline(MEMORY_GOAL, ls="--", color="#5a5f66", label="goal")
    right.set_ylabel("peak memory of the process (GiB)")
    right.set_ylim(0.1, 10)
    right.legend(frameon=False, fontsize=8)
    for ax in (left, right):
        ax.set_xlabel("nodes of the skin")
        ax.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def main() -> None:
    def numbers(text: str) -> list[int]:
        return [int(n) for n in text.split(",")]

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "part", nargs="?", choices=("quality", "speed", "one"), metavar="quality | speed", help="default: both"
    )
    parser.add_argument("--campaign", type=Path, help="runs in the paper's HDF5 layout; default: the embedded ones")
    parser.add_argument("--mesh", type=Path, action="append", default=[], help="a further triangle surface for quality")
    parser.add_argument("--nodes", type=numbers, help="node counts for quality; default: 1/8, 1/32 and 1/128")
    parser.add_argument("--sizes", type=numbers, help="skins for speed, in nodes")
    parser.add_argument("--figure", type=Path, help="draw the speed into this file")
    parser.add_argument("--quick", action="store_true", help="fewer states, smaller skins")
    parser.add_argument("--json", type=Path, help="write the ratios that have a goal")
    arguments = parser.parse_args()
    if arguments.part == "one":  # a size in a process of its own
        print(json.dumps(measure(arguments.sizes[0])))
        return
    entries = quality(arguments) if arguments.part != "speed" else []
    entries += speed(arguments) if arguments.part != "quality" else []
    print()
    for e in entries:
        print(f"{e['what']}: {e['ratio']:.2f} ({e['sense']} {e['goal']:g}); {e['note']}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
