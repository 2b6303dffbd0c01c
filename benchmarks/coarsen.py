"""The mesh hierarchy against vtkQuadricDecimation: how near, how well it lifts, how fast, how much memory.

    python benchmarks/coarsen.py quality [--campaign RUNS.h5] [--mesh SURFACE.vtp] [--nodes 1165,292,73,36]
    python benchmarks/coarsen.py speed [--nodes 10000,30000,100000,400000] [--figure docs/images/coarsen_speed.png]

quality: each mesh is coarsened to the same node counts three ways: by vtkQuadricDecimation as it is (its vertices are
moved, so there is nothing to train on; for lifting they are tied to distinct nearest nodes), by `--selection vtk`, and
by `--selection quadric`. Distances are those of the fine nodes to the coarse surface. The lifting error is the mean
of |U D u - u| over nodes, states and runs of a campaign in the paper's HDF5 layout; without `--campaign` the embedded
one. Without `--mesh` the airplane that pyvista ships (shells with T-joints) stands beside it.

speed: a kart skin is subdivided to each size and goes to 1/8, 1/32 and 1/128 with all maps, against the time that
vtkQuadricDecimation takes for the three reductions in the same run; the goal is a ratio of at most 5. Each size runs
in a process of its own, so that the peak memory is its own. Compilation (once a machine) is not counted.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pyvista as pv
from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

from crashkit.dataset import demo_data
from crashkit.mesh.hierarchy import build_hierarchy
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.lifting import LiftingMeter
from crashkit.mesh.selection import select_quadric
from crashkit.mesh.selection_vtk import nearest_nodes
from crashkit.mesh.surface import Surface, face_edges, surface


def decimated(position: np.ndarray, faces: np.ndarray, count: int) -> pv.PolyData:
    """What vtkQuadricDecimation gives with as near to `count` vertices as it goes."""
    mesh = pv.PolyData.from_regular_faces(position, faces)
    low, high, best = 0.0, 1.0, None
    reduction = 1 - count / len(position)
    for _ in range(20):
        out = reduced(mesh, reduction)
        if best is None or abs(out.n_points - count) < abs(best.n_points - count):
            best = out
        if out.n_points == count:
            break
        low, high = (reduction, high) if out.n_points > count else (low, reduction)
        reduction = (low + high) / 2
    assert best is not None
    return best


def reduced(mesh: pv.PolyData, reduction: float) -> pv.PolyData:
    decimate = vtkQuadricDecimation()
    decimate.SetInputData(mesh)
    decimate.SetTargetReduction(reduction)
    decimate.Update()
    return pv.wrap(decimate.GetOutput())


def distances(position: np.ndarray, coarse: pv.PolyData) -> np.ndarray:
    _, closest = coarse.find_closest_cell(position, return_closest_point=True)
    return np.linalg.norm(closest - position, axis=1)


def tied_lifting(mesh: Surface, coarse: pv.PolyData, blocks: Iterator[np.ndarray]) -> float:
    """Lifting error, m, when VTK's vertices are tied to distinct nearest nodes and VTK's triangles lift."""
    points = np.asarray(coarse.points, np.float64)
    # One node a vertex, in the order of the vertices.
    kept = np.full(len(points), -1)
    free = np.arange(mesh.n_nodes)
    from scipy.spatial import cKDTree

    candidates = nearest_nodes(points, mesh, free)
    gap, near = cKDTree(mesh.position[candidates]).query(points, k=min(16, len(candidates)))
    order = np.argsort(gap.ravel(), kind="stable")
    taken = np.zeros(len(candidates), bool)
    for vertex, node in zip(order // gap.shape[1], near.ravel()[order], strict=True):
        if kept[vertex] < 0 and not taken[node]:
            kept[vertex], taken[node] = candidates[node], True
    kept[kept < 0] = candidates[~taken][: (kept < 0).sum()]
    corners = coarse.regular_faces
    tied = pv.PolyData.from_regular_faces(mesh.position[kept], corners)
    cell, closest = tied.find_closest_cell(mesh.position, return_closest_point=True)
    a, b, c = (mesh.position[kept[corners[cell, k]]] for k in range(3))
    weights = barycentric(closest, a, b, c)
    total, count = 0.0, 0
    for u in blocks:
        lifted = sum(weights[:, k, None] * u[:, kept[corners[cell, k]]] for k in range(3))
        total += float(np.linalg.norm(lifted - u, axis=-1).sum(dtype=np.float64))
        count += u.shape[0] * u.shape[1]
    return total / count


def barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    u, v, w = b - a, c - a, p - a
    uu, uv, vv, uw, vw = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = np.maximum(uu * vv - uv * uv, 1e-300)
    s, t = (vv * uw - uv * vw) / det, (uu * vw - uv * uw) / det
    out = np.clip(np.stack([1 - s - t, s, t], axis=1), 0, 1)
    return out / out.sum(axis=1, keepdims=True)


def campaign(path: Path) -> tuple[np.ndarray, np.ndarray, Path]:
    with h5py.File(path) as file:
        return file["kart/reference_configuration"][0].astype(np.float64), file["kart/faces"][:].astype(np.int64), path


def runs(path: Path | None) -> Iterator[np.ndarray]:
    if path is None:
        return
    with h5py.File(path) as file:
        for run in range(len(file["kart/displacements"])):
            yield file["kart/displacements"][run]


def lifting(hierarchy: Hierarchy, path: Path | None) -> list[float]:
    meter = LiftingMeter(hierarchy)
    for u in runs(path):
        meter.add(u)
    return [error.mean for error in meter.errors]


def quality(arguments: argparse.Namespace) -> None:
    cases: list[tuple[str, np.ndarray, np.ndarray, Path | None]] = []
    source = arguments.campaign or demo_data()
    cases.append((source.name, *campaign(source)))
    plane = pv.read(arguments.mesh) if arguments.mesh else pv.examples.load_airplane()
    name = arguments.mesh.name if arguments.mesh else "airplane (pyvista)"
    cases.append((name, np.asarray(plane.points, np.float64), plane.regular_faces.astype(np.int64), None))
    for name, position, faces, path in cases:
        n = len(position)
        counts = arguments.nodes or [n // 8, n // 32, n // 128]
        mesh = surface(position, faces)
        print(f"\n{name}: {n} nodes, lengths in cm of a mesh in metres")
        print(f"{'':34s}" + "".join(f"{c:>22d}" for c in counts))
        rows: dict[str, list[str]] = {"vtkQuadricDecimation, moved": []}
        for count in counts:
            coarse = decimated(position, faces, count)
            d = distances(position, coarse)
            error = tied_lifting(mesh, coarse, runs(path)) if path else float("nan")
            rows["vtkQuadricDecimation, moved"].append(cell(d, error, coarse.n_points - count))
        for selection in ("vtk", "quadric"):
            hierarchy = build_hierarchy(position, faces, counts, selection=selection)  # type: ignore[arg-type]
            errors = lifting(hierarchy, path)
            rows[f"--selection {selection}"] = [
                cell(level.distance, error) for level, error in zip(hierarchy.levels, errors, strict=True)
            ]
        for label, cells in rows.items():
            print(f"{label:34s}" + "".join(f"{c:>22s}" for c in cells))
    print("\ndistance mean / max, lifting error (n/a without runs); (+k): VTK stopped k nodes above the count")


def cell(distance: np.ndarray, error: float, extra: int = 0) -> str:
    told = f"{100 * error:.4f}" if error == error else "n/a"
    return f"{100 * distance.mean():.3f}/{100 * distance.max():.2f} {told}" + (f" ({extra:+d})" if extra else "")


def skin(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The kart's skin with about `nodes` nodes: coarsened a little, subdivided, and given fine waves."""
    position, faces, _ = campaign(demo_data())
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
    """One size: seconds of VTK and ours, and the peak memory of ours (VTK's runs come after)."""
    position, faces, _ = campaign(demo_data())
    build_hierarchy(position, faces, [300, 75, 19])  # compiles
    position, faces = skin(nodes)
    n = len(position)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    hierarchy = build_hierarchy(position, faces, [n // 8, n // 32, n // 128])
    ours = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    mesh = pv.PolyData.from_regular_faces(position, faces)
    start = time.perf_counter()
    for level in hierarchy.levels:
        reduced(mesh, 1 - level.n_nodes / n)
    vtk = time.perf_counter() - start
    return {
        "nodes": n,
        "ours_s": ours,
        "vtk_s": vtk,
        "ratio": ours / vtk,
        "peak_gib": peak / 2**20,
        "start_gib": before / 2**20,
    }


def speed(arguments: argparse.Namespace) -> None:
    results = []
    print(f"{'nodes':>8} {'ours (s)':>9} {'VTK (s)':>9} {'ratio':>6} {'peak (GiB)':>10} {'us a node':>9}")
    for nodes in arguments.nodes or [10_000, 30_000, 100_000, 400_000]:
        out = subprocess.run([sys.executable, __file__, "one", str(nodes)], capture_output=True, text=True, check=True)
        r = json.loads(out.stdout)
        results.append(r)
        print(
            f"{r['nodes']:8d} {r['ours_s']:9.2f} {r['vtk_s']:9.2f} {r['ratio']:6.2f} {r['peak_gib']:10.2f} "
            f"{1e6 * r['ours_s'] / r['nodes']:9.0f}",
            flush=True,
        )
    n, t = (np.log([r[k] for r in results]) for k in ("nodes", "ours_s"))
    if len(results) > 1:
        print(f"seconds grow like nodes^{np.polyfit(n, t, 1)[0]:.2f}")
    if arguments.figure:
        draw(results, arguments.figure)


def draw(results: list[dict[str, float]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.6), layout="constrained", dpi=150)
    ax = figure.subplots()
    nodes = np.array([r["nodes"] for r in results])
    ours, vtk = (np.array([r[k] for r in results]) for k in ("ours_s", "vtk_s"))
    ax.loglog(nodes, ours, "o-", color="#c1121f", label="hierarchy with all maps")
    ax.loglog(nodes, vtk, "s-", color="#3a6ea5", label="vtkQuadricDecimation, three reductions")
    ax.loglog(nodes, ours[0] * nodes / nodes[0], ":", color="#5a5f66", label="linear")
    ax.set_xlabel("nodes of the skin")
    ax.set_ylabel("seconds")
    ax.grid(alpha=0.3, which="both")
    ax.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main() -> None:
    def numbers(text: str) -> list[int]:
        return [int(n) for n in text.split(",")]

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    near = commands.add_parser("quality")
    near.add_argument("--campaign", type=Path)
    near.add_argument("--mesh", type=Path)
    near.add_argument("--nodes", type=numbers)
    near.set_defaults(run=quality)
    fast = commands.add_parser("speed")
    fast.add_argument("--nodes", type=numbers)
    fast.add_argument("--figure", type=Path)
    fast.set_defaults(run=speed)
    one = commands.add_parser("one")
    one.add_argument("nodes", type=int)
    one.set_defaults(run=lambda a: print(json.dumps(measure(a.nodes))))
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
