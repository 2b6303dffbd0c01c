"""Every command on a campaign of vehicle size: processor time, wall time and peak memory beside goals and limits.

    python benchmarks/vehicle.py                                    # 300 000 nodes, 24 runs, 51 states: 4.4 GB
    python benchmarks/vehicle.py --nodes 20000                      # a minute or two
    python benchmarks/vehicle.py --nodes 20000 75000 300000         # and the power by which each command grows
    python benchmarks/vehicle.py --only predict evaluate --folder W # again with what the folder W holds already

The campaign is the embedded kart (`--campaign FILE` takes another one in its layout), each triangle cut into as many
as it takes to come near `--nodes`, displacements interpolated to the new nodes and to `--states` times. Three quarters
of the runs train, the others test. Each command is a process of its own; seconds and peak resident memory are what the
system says of it and of the processes it started. Temporary files need about three times the campaign's size.

Goals are those of 300 000 nodes x 24 runs x 51 states, made smaller with the data, but never below what starting the
command costs. The machine's own limit is the time to move the bytes and to do the operations that the command cannot do
without, one after the other: bytes over the rate at which the dataset's own store is read (or written, where it writes),
measured in the same run; operations over the rate of a large float32 matrix product on one core.

    ingest    the runs read once and written once
    coarsen   the runs read once, to measure the lifting error and to store the levels' displacements
    pod-gpr   the training runs read once and the matrix of all their states' products made
    mh        the levels' states read once, and the operations of the steps (`train_step.work`)
    predict   one run made from its modes or latent numbers and written
    evaluate  three passes over the test runs and one over the training runs
    files     the run read and the arrays asked for written once

--epochs sets the epochs of the network levels. `--quick` is `--nodes 20000`. --json writes the ratios that have a goal.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

GIB = 1 << 30
FULL = 300_000 * 24 * 51  # states of nodes that the goals are meant for
BATCH = 32


@dataclass(frozen=True)
class Command:
    """One command line, and what it shall cost: processor seconds at full size, GiB, start (s) and the machine's limit."""

    name: str
    arguments: tuple[str, ...]
    seconds: float | None
    gib: float | None
    limit: Callable[[Size, Rates], float]
    start: float = 3.0
    needs: tuple[str, ...] = ()
    wall: bool = False  # whether the goal is one of wall time


@dataclass(frozen=True)
class Size:
    """What the campaign holds; levels are nodes of each, finest first."""

    nodes: int
    runs: int
    states: int
    test: int
    levels: tuple[int, ...] = ()
    epochs: tuple[int, int] = (20, 4)
    written: float = 0.0  # bytes of the files

    @property
    def run(self) -> float:
        return 12.0 * self.nodes * self.states

    @property
    def training(self) -> int:
        return self.runs - self.test


@dataclass(frozen=True)
class Rates:
    """Bytes a second of reading and writing the store, operations a second; of one core."""

    read: float
    write: float
    product: float


@dataclass
class Measured:
    """What one command took."""

    name: str
    nodes: int
    processor: float
    wall: float
    gib: float
    limit: float
    goal: float | None
    goal_gib: float | None
    wall_goal: bool = False
    note: str = ""

    @property
    def counted(self) -> float:
        return self.wall if self.wall_goal else self.processor


def commands(place: Path, size: Size) -> list[Command]:
    """The commands in the order in which they need each other."""
    data, held = str(place / "runs.zarr"), f"{size.training}:{size.runs}"
    model = {name: str(place / name) for name in ("pod-gpr", "mh")}
    epochs, finer = size.epochs
    nodes = ",".join(map(str, (size.nodes // 8, size.nodes // 64, size.nodes // 512)))
    asked = ("--param", "impact_speed=22", "--param", "impact_angle=10", "--param", "yield_stress=350MPa")
    both = (data, *model.values(), "--overwrite")

    def trained(name: str, *more: str) -> tuple[str, ...]:
        return ("train", data, "-o", model[name], "--model", name, "--test", held, "--overwrite", *more)

    def predicted(name: str) -> tuple[str, ...]:
        return ("predict", model[name], *asked, "-o", str(place / f"{name}.vtkhdf"), "--overwrite")

    return [
        Command(
            "ingest", ("ingest", str(place / "runs.h5"), "-o", data, "--overwrite"), None, 1.0,
            lambda s, r: s.runs * s.run * (1 / r.read + 1 / r.write),
        ),
        Command("info", ("info", data), 0.8, None, lambda s, r: 0.0, start=0.8, wall=True),
        Command("coarsen", ("coarsen", data, "--nodes", nodes), 139.0, None, lambda s, r: s.runs * s.run / r.read),
        Command(
            "train pod-gpr", trained("pod-gpr"), 90.0, 1.5,
            lambda s, r: s.training * s.run / r.read + 3 * s.nodes * (s.training * s.states) ** 2 / r.product, start=10.0,
        ),
        Command(
            "train mh", trained("mh", "--set", f"level.epochs={epochs}", "--set", f"transfer.epochs={finer / epochs:g}"), None, 2.0,
            _training_limit, start=10.0,
        ),
        Command("predict pod-gpr", predicted("pod-gpr"), 6.0, 1.0, _prediction_limit, start=2.0, wall=True),
        Command("predict mh", predicted("mh"), 6.0, 1.0, _prediction_limit, start=3.0, wall=True),
        Command(
            "evaluate", ("evaluate", *both, "-o", str(place / "report")), 300.0, None,
            lambda s, r: (3 * s.test + s.training) * s.run / r.read, start=30.0,
        ),
        Command(
            "evaluate, files", ("evaluate", *both, "-o", str(place / "report_files"), "--write-vtkhdf"), None, None,
            lambda s, r: (3 * s.test + s.training) * s.run / r.read + s.written / r.write, start=30.0,
        ),
        Command(
            "info --report", ("info", data, "--report", str(place / "card.html"), "--overwrite"), None, None,
            lambda s, r: s.runs * s.run / r.read,
        ),
    ]  # fmt: skip


def _training_limit(size: Size, rates: Rates) -> float:
    """The levels' training states read once, and the operations of every step of every epoch."""
    from train_step import work

    samples, total = size.training * size.states, 0.0
    for k, nodes in enumerate(size.levels):
        epochs = size.epochs[0] if k == len(size.levels) - 1 else size.epochs[1]
        steps = epochs * (samples // BATCH)
        total += steps * work(nodes, 7 * nodes)[0] / rates.product + 12.0 * nodes * samples / rates.read
    return total


def _prediction_limit(size: Size, rates: Rates) -> float:
    return size.run / rates.write + 2 * 3 * size.nodes * size.states * 64 / rates.product


# --- the campaign ---------------------------------------------------------------------------------------------------


def make(target: Path, source: Path, nodes: int, runs: int, states: int) -> int:
    """Write the campaign with about so many nodes; gives how many."""
    import h5py

    with h5py.File(source) as given:
        base = given["kart/reference_configuration"][0].astype(np.float64)
        faces = given["kart/faces"][:].astype(np.int64)
        there = len(given["kart/displacements"])
        if runs > there:
            raise SystemExit(f"{source}: has {there} runs; {runs} were asked for")
        weights, finer = subdivided(faces, max(1, round(np.sqrt(nodes / len(base)))), len(base))
        time = given["time"][:]
        at = np.linspace(time[0], time[-1], states)
        with h5py.File(target, "w") as out:
            out["kart/reference_configuration"] = weights @ base
            out["kart/faces"] = finer.astype(np.int32)
            out["time"] = at
            out["parameter"] = given["parameter"][:runs]
            for name, value in given["parameter"].attrs.items():
                out["parameter"].attrs[name] = value
            shape = (states, weights.shape[0], 3)
            moved = out.create_dataset("kart/displacements", (runs, *shape), "f4", chunks=(1, *shape))
            for run in range(runs):
                u = given["kart/displacements"][run].reshape(len(time), -1)
                k = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
                share = ((at - time[k]) / (time[k + 1] - time[k]))[:, None].astype(np.float32)
                some = ((1 - share) * u[k] + share * u[k + 1]).reshape(states, -1, 3)
                moved[run] = np.stack([(weights @ state).astype(np.float32) for state in some])
            for name in ("kart/displacements", "kart/reference_configuration"):
                out[name].attrs["units"] = "m"
            out["time"].attrs["units"] = "s"
    return int(weights.shape[0])


def subdivided(faces: NDArray[np.int64], cuts: int, nodes: int) -> tuple[Any, NDArray[np.int64]]:
    """Triangles with each side cut into `cuts`: csr (finer node, node) that interpolates, and the finer triangles."""
    from scipy import sparse

    steps = [(i, j, cuts - i - j) for i in range(cuts + 1) for j in range(cuts + 1 - i)]
    place = {step[:2]: k for k, step in enumerate(steps)}
    # A point is known by the corners it lies between and how far it is from each, whichever face it is seen from.
    corner = np.where(np.array(steps)[None] > 0, faces[:, None, :], -1)
    share = np.broadcast_to(np.array(steps)[None], corner.shape)
    order = np.argsort(corner, axis=2, kind="stable")
    rows = np.concatenate([np.take_along_axis(a, order, axis=2) for a in (corner, share)], axis=2).reshape(-1, 6)
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    # Nodes of the coarser mesh come first, and keep their order.
    kept = (unique[:, :2] < 0).all(axis=1)
    number = np.empty(len(unique), np.int64)
    number[kept] = unique[kept, 2]
    number[~kept] = nodes + np.arange((~kept).sum())
    total = nodes + int((~kept).sum())
    used = unique[:, :3] >= 0
    matrix = sparse.csr_matrix(
        (unique[:, 3:][used] / cuts, (np.repeat(number, used.sum(axis=1)), unique[:, :3][used])), (total, nodes)
    )
    loose = np.flatnonzero(np.diff(matrix.indptr) == 0)
    matrix = matrix + sparse.csr_matrix((np.ones(len(loose)), (loose, loose)), matrix.shape)
    local = []
    for i, j, k in steps:
        if k > 0:
            local.append((place[i, j], place[i + 1, j], place[i, j + 1]))
        if i > 0 and j > 0:
            local.append((place[i, j], place[i - 1, j], place[i, j - 1]))
    at = number[inverse].reshape(len(faces), len(steps))
    return matrix.astype(np.float32), at[:, np.array(local)].reshape(-1, 3)


# --- measuring ------------------------------------------------------------------------------------------------------


def measure(arguments: tuple[str, ...]) -> tuple[float, float, float]:
    """Processor seconds, wall seconds and peak GiB of one command."""
    started = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen([sys.executable, "-m", "crashkit", *arguments], stdout=said, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - started
        if child.returncode:
            said.seek(0)
            raise SystemExit(f"crashkit {' '.join(arguments)}: {said.read().decode(errors='replace')[-2000:]}")
    unit = 1 if sys.platform == "darwin" else 1024
    return used.ru_utime + used.ru_stime, wall, used.ru_maxrss * unit / GIB


def apart(call: Callable[..., Any], *arguments: Any) -> Any:
    """What a function gives, in a process of its own: a command's peak memory begins at that of the process that starts it."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()


def rates_of(dataset: Path) -> Rates:
    """The rates of one core, each the best of three: the dataset's first runs read, one of them written, a product."""
    found = json.loads(
        subprocess.run(
            [sys.executable, __file__, "--rates", str(dataset)], check=True, capture_output=True, text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        ).stdout
    )  # fmt: skip
    return Rates(**found)


def print_rates(dataset: Path) -> None:
    import zarr

    field = zarr.open_group(dataset, mode="r")["displacement"]
    a, b = np.ones((2, 2048, 2048), np.float32)
    read, write, product = [], [], []
    for turn in range(3):
        started = time.process_time()
        values = field[turn % field.shape[0]]
        read.append(values.nbytes / (time.process_time() - started))
        with tempfile.TemporaryDirectory(dir=dataset.parent) as place:
            target = zarr.create_array(
                Path(place) / "a.zarr", shape=field.shape, chunks=field.chunks, dtype=field.dtype,
                compressors=field.compressors, filters=field.filters,
            )  # fmt: skip
            started = time.process_time()
            target[0] = values
            write.append(values.nbytes / (time.process_time() - started))
        started = time.process_time()
        a @ b
        product.append(2 * 2048**3 / (time.process_time() - started))
    print(json.dumps({"read": max(read), "write": max(write), "product": max(product)}))


def levels_of(dataset: Path) -> tuple[int, ...]:
    from crashkit.mesh.store import has_hierarchy, open_hierarchy

    return tuple(level.n_nodes for level in open_hierarchy(dataset).levels) if has_hierarchy(dataset) else ()


def of_size(place: Path, nodes: int, options: argparse.Namespace) -> Iterator[Measured]:
    """Every command on one campaign, which is made in `place` unless it is there."""
    from crashkit.dataset import demo_data

    place.mkdir(parents=True, exist_ok=True)
    about = place / "size.json"
    if not about.exists():
        made = apart(make, place / "runs.h5", options.campaign or demo_data(), nodes, options.runs, options.states)
        about.write_text(json.dumps({"nodes": made, "runs": options.runs, "states": options.states}))
    size = Size(**json.loads(about.read_text()), test=max(1, options.runs // 4), epochs=tuple(options.epochs))
    rates = None
    for command in commands(place, size):
        if options.only and command.name not in options.only and command.arguments[0] not in options.only:
            continue
        processor, wall, gib = measure(command.arguments)
        rates = rates or rates_of(place / "runs.zarr")
        files = place / "report_files" / "vtk"
        written = float(sum(f.stat().st_size for f in files.rglob("*") if f.is_file())) if files.exists() else 0.0
        known = Size(**{**asdict(size), "levels": apart(levels_of, place / "runs.zarr"), "written": written})
        share = size.nodes * size.runs * size.states / FULL
        goal = None if command.seconds is None else max(command.start, command.seconds * share)
        yield Measured(
            command.name, size.nodes, processor, wall, gib, command.limit(known, rates), goal, command.gib, command.wall,
            note=f"{written / 1e6:.0f} MB of files" if command.name == "evaluate, files" else "",
        )  # fmt: skip


def table(rows: list[Measured]) -> Iterator[str]:
    """Rows of one size."""
    yield f"{'':16}{'processor s':>12}{'wall s':>8}{'GiB':>6}{'goal s':>9}{'goal GiB':>9}{'limit s':>9}{'times':>7}"
    for r in rows:
        yield (
            f"{r.name:16}{r.processor:12.1f}{r.wall:8.1f}{r.gib:6.2f}"
            f"{_number(r.goal) + (' w' if r.wall_goal and r.goal else ''):>9}{_number(r.goal_gib):>9}"
            f"{r.limit:9.1f}{_number(r.processor / r.limit if r.limit else None):>7}  {r.note}"
        )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def growth(rows: list[Measured]) -> Iterator[str]:
    """For each command the power of its processor time and of its memory in the number of nodes."""
    yield f"{'':16}{'nodes':>24}{'processor s':>30}{'power':>7}{'GiB':>22}{'power':>7}"
    for name in dict.fromkeys(r.name for r in rows):
        some = sorted((r for r in rows if r.name == name), key=lambda r: r.nodes)
        if len(some) < 2:
            continue
        nodes = [r.nodes for r in some]
        columns = []
        for values, form in (([r.processor for r in some], ".1f"), ([r.gib for r in some], ".2f")):
            # The power of the last step: at small sizes starting the command hides it.
            power = np.log(values[-1] / values[-2]) / np.log(nodes[-1] / nodes[-2])
            columns.append((" ".join(f"{v:{form}}" for v in values), f"{power:.2f}"))
        (seconds, p), (gib, q) = columns
        yield f"{name:16}{' '.join(map(str, nodes)):>24}{seconds:>30}{p:>7}{gib:>22}{q:>7}"


def entries(rows: list[Measured]) -> list[dict[str, Any]]:
    """The ratios that have a goal, for the table of all benchmarks."""
    out: list[dict[str, Any]] = []
    for r in rows:
        kind = "wall" if r.wall_goal else "processor"
        at = f"{r.name}, {r.nodes} nodes"
        if r.goal is not None:
            out.append(
                {
                    "what": f"{at}: {kind} time / {r.goal:.0f} s",
                    "ratio": r.counted / r.goal,
                    "note": f"{r.counted:.1f} s",
                }
            )
        if r.goal_gib is not None:
            out.append(
                {
                    "what": f"{at}: peak memory / {r.goal_gib:g} GiB",
                    "ratio": r.gib / r.goal_gib,
                    "note": f"{r.gib:.2f} GiB",
                }
            )
    return [{**entry, "goal": 1.0, "sense": "at most"} for entry in out]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--nodes", type=int, nargs="+", default=[300_000], help="about so many; several show the growth"
    )
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--states", type=int, default=51)
    parser.add_argument("--epochs", type=int, nargs=2, default=(20, 4), metavar=("COARSEST", "FINER"))
    parser.add_argument("--campaign", type=Path, help="runs in the layout of the embedded ones")
    parser.add_argument("--only", nargs="+", default=(), metavar="COMMAND", help="such as ingest, evaluate, 'train mh'")
    parser.add_argument("--folder", type=Path, help="keep everything here; a temporary folder without")
    parser.add_argument("--quick", action="store_true", help="20 000 nodes")
    parser.add_argument("--json", type=Path, help="file for the ratios")
    parser.add_argument("--rates", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rates:
        print_rates(options.rates)
        return
    rows: list[Measured] = []
    scratch = (
        Path(tempfile.mkdtemp(prefix="vehicle-", dir=options.folder)) if options.folder is None else options.folder
    )
    try:
        for nodes in [20_000] if options.quick else options.nodes:
            place = scratch / str(nodes)
            some = []
            for row in of_size(place, nodes, options):
                some.append(row)
                print(f"{row.name}: {row.processor:.1f} s", file=sys.stderr, flush=True)
            if options.folder is None:
                shutil.rmtree(place)
            print(f"\n{some[0].nodes} nodes, {options.runs} runs, {options.states} states" if some else "nothing to do")
            print("\n".join(table(some)), flush=True)
            rows += some
        if len({row.nodes for row in rows}) > 1:
            print()
            print("\n".join(growth(rows)))
    finally:
        if options.folder is None:
            shutil.rmtree(scratch, ignore_errors=True)
    if options.json:
        options.json.write_text(json.dumps(entries(rows), indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
