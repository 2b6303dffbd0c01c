"""Peak memory and throughput of ingest, against writing the same amount of data with Zarr alone.

    python benchmarks/ingest_memory.py           # 8 runs of 100 800 nodes x 101 states, about 1 GB
    python benchmarks/ingest_memory.py --full    # 64 runs, 7.8 GB of float32
    python benchmarks/ingest_memory.py --quick   # 4 runs

The runs are the embedded kart, 42 copies of it side by side, its 21 states interpolated to 101 and every run scaled
differently. They lie in an HDF5 file (`--source hdf5`, the default, needs that much disk) or are made up while they
are read (`--source memory`). Each measurement is a process of its own; its peak resident memory is what the system
says; imports are not timed. `raw` writes one run again and again into the same chunks with the same compression, and
has both on the disk at the end, as ingest does.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

COPIES, STATES, FULL, QUICK = 42, 101, 64, 4
MIB = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--full", action="store_true", help=f"{FULL} runs")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} runs")
    parser.add_argument("--json", type=Path, help="file for the ratios")
    parser.add_argument("--source", choices=("hdf5", "memory"), default="hdf5")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=1, help="measure each this many times, in turn; the best counts")
    parser.add_argument("--folder", type=Path, help="where to write; a temporary folder without")
    parser.add_argument("--part", choices=("make", "ingest", "raw"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    runs = FULL if args.full else QUICK if args.quick else args.runs
    if args.part:
        print(json.dumps(PARTS[args.part](args.folder, runs, args)))
        return
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        if args.source == "hdf5":
            measure("make", folder, runs, args)
        found: dict[str, list[dict[str, float]]] = {"raw": [], "ingest": []}
        for _ in range(args.repeat):
            for part in found:
                found[part].append(measure(part, folder, runs, args))
    report(found, runs, args)


def measure(part: str, folder: str, runs: int, args: argparse.Namespace) -> dict[str, float]:
    """What one part says of itself, run as a process of its own."""
    command = [
        sys.executable, __file__, "--part", part, "--folder", folder, "--runs", str(runs), "--source", args.source,
        "--workers", str(args.workers),
    ]  # fmt: skip
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]))


def report(found: dict[str, list[dict[str, float]]], runs: int, args: argparse.Namespace) -> None:
    gigabytes = found["raw"][0]["bytes"] / 1e9
    print(f"{runs} runs x {STATES} states x {int(found['raw'][0]['nodes'])} nodes, {gigabytes:.2f} GB of float32")
    print(f"{'':10}{'seconds':>9}{'MB/s':>8}{'peak MiB':>10}{'on disk':>10}")
    best = {part: min(results, key=lambda r: r["seconds"]) for part, results in found.items()}
    for part, result in best.items():
        rate = result["bytes"] / result["seconds"] / 1e6
        print(f"{part:10}{result['seconds']:9.1f}{rate:8.0f}{result['peak'] / MIB:10.0f}{result['stored'] / 1e9:9.2f}G")
    ratio = best["raw"]["seconds"] / best["ingest"]["seconds"]
    peak = max(r["peak"] for r in found["ingest"])
    print(f"ingest reaches {ratio:.2f} of raw writing (goal 0.5), peak {peak / MIB:.0f} MiB (goal below 1024)")
    if args.workers > 1:
        print(f"the peak is that of the largest of {args.workers} workers or the process itself")
    if args.json:
        note = (
            f"{runs} runs x {STATES} states x {int(found['raw'][0]['nodes'])} nodes, {gigabytes:.2f} GB, {args.source}"
        )
        entries = [
            {"what": "throughput of ingest against writing alone", "ratio": ratio, "goal": 0.5, "sense": "at least"},
            {"what": "peak memory of ingest against 1 GiB", "ratio": peak / (1 << 30), "goal": 1.0, "sense": "at most"},
        ]
        args.json.write_text(json.dumps([{**entry, "note": note} for entry in entries], indent=1))


# --- the parts -----------------------------------------------------------------------------------------------------


def make(folder: Path, runs: int, args: argparse.Namespace) -> dict[str, Any]:
    """The source as an HDF5 file in the layout of the kart campaign."""
    import h5py

    base, faces = tiled_kart()
    moved = tiled_states(len(base))
    with h5py.File(folder / "tiled.h5", "w") as file:
        file["kart/reference_configuration"] = base
        file["kart/faces"] = faces
        file["time"] = np.linspace(0, 0.03, STATES)
        data = file.create_dataset("kart/displacements", (runs, *moved.shape), "float32")
        data.attrs["units"] = "m"
        for run in range(runs):
            data[run] = moved * scale_of(run)
    return {}


def ingest(folder: Path, runs: int, args: argparse.Namespace) -> dict[str, Any]:
    import zarr  # noqa: F401 - imports are not timed, here and in `raw`

    import crashkit
    from crashkit.readers import readers

    readers()
    source = folder / "tiled.h5"
    reader = None
    if args.source == "memory":
        source, reader = folder, register_tiled(runs)
    output = folder / "out.zarr"
    shutil.rmtree(output, ignore_errors=True)
    begin = perf_counter()
    summary = crashkit.ingest([source], output, units="SI", reader=reader, workers=args.workers)
    seconds = perf_counter() - begin
    count = len(summary.runs) * summary.states * summary.nodes * 12
    return {"seconds": seconds, "bytes": count, "nodes": summary.nodes, "peak": peak(), "stored": size(output)}


def raw(folder: Path, runs: int, args: argparse.Namespace) -> dict[str, Any]:
    """One run, written again and again into a store of the same kind."""
    import zarr  # noqa: F401

    from crashkit.ingestion.store import ArraySpec, create_arrays
    from data_schema.replace import put_in_place

    values = tiled_states(COPIES * len(kart()[0]))
    spec = ArraySpec("displacement", ("time", "node", "xyz"), values.shape, "float32")
    output = folder / "raw.zarr"
    shutil.rmtree(output, ignore_errors=True)
    begin = perf_counter()
    array = create_arrays(folder / "raw.new", [spec], runs)["displacement"]
    for run in range(runs):
        array[run] = values
    put_in_place(folder / "raw.new", output, durable=True)
    seconds = perf_counter() - begin
    return {
        "seconds": seconds, "bytes": runs * values.nbytes, "nodes": values.shape[1], "peak": peak(), "stored": size(output),
    }  # fmt: skip


PARTS = {"make": make, "ingest": ingest, "raw": raw}


def peak() -> int:
    """Largest resident memory so far, bytes, of this process or of any of its children."""
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def size(folder: Path) -> int:
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())


# --- the data ------------------------------------------------------------------------------------------------------


def kart() -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float32]]:
    """Position (node, 3), triangles, and the displacement (state, node, 3) of one embedded run."""
    import h5py

    from crashkit.dataset import demo_data

    with h5py.File(demo_data()) as file:
        group = file["kart"]
        return group["reference_configuration"][0], group["faces"][:], group["displacements"][3]


def tiled_kart() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Position and triangles of many karts beside each other."""
    position, faces, _ = kart()
    shifts = np.arange(COPIES)[:, None, None] * np.array([0.0, 1.5, 0.0])
    steps = np.arange(COPIES)[:, None, None] * len(position)
    return (position + shifts).reshape(-1, 3), (faces + steps).reshape(-1, 3).astype(np.int32)


def tiled_states(nodes: int) -> NDArray[np.float32]:
    """(state, node, 3) of one run, m; every copy moves a little differently."""
    few = kart()[2]
    at = np.linspace(0, len(few) - 1, STATES)
    left = np.minimum(at.astype(int), len(few) - 2)
    part = (at - left)[:, None, None].astype(np.float32)
    states = few[left] * (1 - part) + few[left + 1] * part
    out = np.empty((STATES, COPIES, few.shape[1], 3), np.float32)
    for copy in range(COPIES):
        out[:, copy] = states * np.float32(1 + copy / 97)
    return out.reshape(STATES, nodes, 3)


def scale_of(run: int) -> np.float32:
    return np.float32(0.5 + run / 61)


def register_tiled(runs: int) -> str:
    """A source format whose runs are made up while they are read; its name."""
    from crashkit.readers import register
    from crashkit.readers.base import Part, Run, RunMesh

    position, faces = tiled_kart()
    count = len(faces)
    whole = RunMesh(
        position=position,
        node_id=np.arange(1, len(position) + 1),
        face_nodes=faces,
        face_part=np.zeros(count, np.int32),
        face_id=np.arange(1, count + 1),
        parts=(Part(1, "karts"),),
    )
    moved = tiled_states(len(position))

    class TiledRun(Run):
        solver, files, parameters, fields, units, mesh = "none", (), {}, {}, "SI", whole

        def __init__(self, number: int) -> None:
            self.name, self.number, self.time = f"run_{number:03d}", number, np.linspace(0, 0.03, STATES)

        def displacement(self, first: int, last: int) -> NDArray[np.float32]:
            return moved[first:last] * scale_of(self.number)

    class Tiled:
        name = "tiled"
        description = "made up while it is read"

        def sniff(self, path: Path) -> bool:
            return False

        def runs(self, path: Path, **options: object) -> Iterator[Run]:
            return (TiledRun(k) for k in range(runs))

    register(Tiled())
    return "tiled"


if __name__ == "__main__":
    main()
