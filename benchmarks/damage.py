"""Damaged solver results against ingest: cut at random places, and single bits flipped at random places.

    python benchmarks/damage.py [--data FOLDER] [--each 200] [--seed 0] [--workers 2] [--quick] [--json FILE]
                                [--case SET/MODE/NUMBER]

Every folder of d3plot or OpenRadioss files under FOLDER (without: the small ones of the tests) is damaged `--each`
times in each way, one file and one place at a time, and given to `crashkit.ingestion.ingest.ingest` with all its fields; what
comes out is opened and validated. Sets that are incomplete as they are, are read with `allow_incomplete`, else nothing
would be tried on them. `--quick` takes a few places. `--json` writes the share of the cases that must not be. The counts:

    refused     an error that names what is wrong, with nothing written; or a dataset that `validate` finds fault with
    identical   a dataset equal to that of the undamaged files: padding, or something nobody reads, was hit
    other value as many states as without damage, but some value differs. A flipped bit inside a number is a number.
    states lost `validate` calls the dataset good although states are missing: must be 0
    traceback   an exception that is no message for a user: must be 0
    crash       the process died: must be 0
    hang        no answer within a minute, and again none when asked a second time: must be 0

Exit code 1 where one of the last four is not 0. The work is done in child processes, which live on from case to
case and are started anew only after a crash or a hang.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import queue
import random
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

PATIENCE = 60.0
SHIPPED = Path(__file__).resolve().parents[1] / "tests" / "data"
QUICK = 5
OUTCOMES = ("refused", "identical", "other value", "states lost", "traceback", "crash", "hang")
FORBIDDEN = OUTCOMES[3:]
MODES = ("cut", "bit")


@dataclass(frozen=True)
class Case:
    """One damaged copy: `file` of the set in `folder` cut at byte `place`, or its bit `bit` there flipped."""

    folder: str
    mode: str
    number: int
    file: str
    place: int
    bit: int

    @property
    def name(self) -> str:
        return f"{Path(self.folder).name}/{self.mode}/{self.number}"


def result_sets(data: Path) -> list[Path]:
    """Folders under `data` that hold solver results themselves."""
    from crashkit.readers import readers

    known = [readers()[name] for name in ("d3plot", "openradioss")]
    files = sorted(p for p in data.rglob("*") if p.is_file())
    return sorted({f.parent for f in files if any(reader.sniff(f) for reader in known)})


def cases(folder: Path, mode: str, count: int, seed: int) -> list[Case]:
    """`count` random places in the files of a set; a long file is hit more often than a short one."""
    dice = random.Random(f"{seed} {folder.name} {mode}")
    files = sorted(p for p in folder.iterdir() if p.is_file())
    sizes = [f.stat().st_size for f in files]
    out = []
    for number in range(count):
        (hit,) = dice.choices(range(len(files)), sizes)
        out.append(Case(str(folder), mode, number, files[hit].name, dice.randrange(sizes[hit]), dice.randrange(8)))
    return out


# In the child


def damaged_copy(case: Case, target: Path) -> None:
    """The set of a case in the new folder `target`: links, and the damaged file itself."""
    target.mkdir()
    for file in Path(case.folder).iterdir():
        if file.name != case.file:
            (target / file.name).symlink_to(file)
            continue
        content = bytearray(file.read_bytes())
        if case.mode == "cut":
            del content[case.place :]
        else:
            content[case.place] ^= 1 << case.bit
        (target / file.name).write_bytes(content)


def digest(dataset: Any) -> dict[str, str]:
    """A checksum of every variable, to tell what differs."""
    sums = {}
    for name, variable in dataset.variables.items():
        values = variable.values
        values = values.astype(str) if values.dtype.kind in "UTO" else values
        sums[str(name)] = hashlib.sha256(f"{variable.dims} {values.dtype}".encode() + values.tobytes()).hexdigest()
    return sums


def offered_fields(folder: Path) -> list[str]:
    """Every field that the undamaged run has."""
    from crashkit.errors import ReadError
    from crashkit.readers import reader_for

    with contextlib.suppress(ReadError, StopIteration):
        return list(next(reader_for(folder).runs(folder)).fields)
    return []


def outcome(folder: Path, output: Path, how: dict[str, Any], undamaged: dict[str, Any] | None) -> dict[str, Any]:
    """What ingest makes of `folder` with the options `how`, compared with the undamaged set."""
    from crashkit.dataset import open_dataset
    from crashkit.errors import CrashkitError
    from crashkit.ingestion.ingest import ingest
    from data_schema import validate

    try:
        ingest(folder, output, units="SI", names="run", **how)
    except CrashkitError as error:
        left = " (but left something behind)" if output.exists() else ""
        return {"outcome": "traceback" if left else "refused", "text": f"{error}{left}"}
    except Exception as error:  # what must not happen, counted
        return {"outcome": "traceback", "text": f"{type(error).__name__}: {error}"}
    with open_dataset(output) as dataset:
        found = {"states": dataset.sizes["time"], "sums": digest(dataset)}
        faults = validate(dataset)
    if undamaged is None:
        return {"outcome": "reference", "reference": found}
    if found["states"] < undamaged["states"] or (faults and not how["allow_incomplete"]):
        return {"outcome": "refused" if faults else "states lost", "text": f"{found['states']} states, {faults[:1]}"}
    ours, theirs = found["sums"], undamaged["sums"]
    changed = sorted(n for n in ours.keys() | theirs.keys() if ours.get(n) != theirs.get(n))
    return {"outcome": "other value" if changed else "identical", "text": ", ".join(changed)}


def reference(folder: Path, output: Path) -> dict[str, Any]:
    """The undamaged set's dataset, and the options it takes to get it."""
    how: dict[str, Any] = {"fields": offered_fields(folder), "allow_incomplete": False}
    answer = outcome(folder, output, how, None)
    if answer["outcome"] == "refused":
        how["allow_incomplete"] = True
        answer = {**outcome(folder, output, how, None), "text": answer["text"]}
    return {**answer, "how": how}


def serve() -> None:
    """Answer one case a line, on stdin and stdout, until stdin ends."""
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        question = json.loads(line)
        with tempfile.TemporaryDirectory(prefix="damage-") as place:
            output = Path(place) / "out.nc"
            if question["case"] is None:
                answer = reference(Path(question["folder"]), output)
            else:
                damaged_copy(Case(**question["case"]), Path(place) / "set")
                answer = outcome(Path(place) / "set", output, question["how"], question["undamaged"])
        print(json.dumps(answer), file=answers, flush=True)


# In the parent


class Child:
    """A process that works on cases; `ask` starts it where there is none."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, __file__, "--serve"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            )  # fmt: skip
        process, late = self.process, threading.Event()

        def give_up() -> None:
            late.set()
            process.kill()

        watchdog = threading.Timer(PATIENCE, give_up)
        watchdog.start()
        try:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(json.dumps(question) + "\n")
                process.stdin.flush()
            line = process.stdout.readline()
        finally:
            watchdog.cancel()
        if line:
            return json.loads(line)
        self.process = None
        return {"outcome": "hang" if late.is_set() else "crash", "text": f"exit code {process.wait()}"}

    def stop(self) -> None:
        if self.process is not None:
            self.process.stdin.close()
            self.process.wait()


def work(todo: queue.SimpleQueue[tuple[Case, dict[str, Any]]], done: list[tuple[Case, dict[str, Any]]]) -> None:
    child = Child()
    with contextlib.suppress(queue.Empty):
        while True:
            case, question = todo.get_nowait()
            answer = child.ask(question)
            if answer["outcome"] == "hang":  # or the machine was busy with something else
                print(f"  {case.name} gave no answer in {PATIENCE:.0f} s; asked again", file=sys.stderr)
                answer = child.ask(question)
            done.append((case, answer))
            if len(done) % 100 == 0:
                print(f"  {len(done)} cases done", file=sys.stderr)
    child.stop()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--data", type=Path, default=SHIPPED, help="folder with d3plot and OpenRadioss results, at any depth"
    )
    parser.add_argument("--each", type=int, default=200, help="cases for each set and way of damage (default 200)")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} cases for each set and way of damage")
    parser.add_argument("--json", type=Path, help="file for the share of cases that must not be")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="child processes (default 2)")
    parser.add_argument("--case", help="run this one case, SET/MODE/NUMBER, and tell what came out")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve()
        return 0
    sets = result_sets(arguments.data.resolve())
    if not sets:
        parser.error(f"no d3plot or OpenRadioss results under {arguments.data}")

    first = Child()
    todo: queue.SimpleQueue[tuple[Case, dict[str, Any]]] = queue.SimpleQueue()
    for folder in sets:
        whole = first.ask({"case": None, "folder": str(folder)})
        states = f"{whole['reference']['states']} states" if "reference" in whole else "no dataset"
        print(f"{folder.name}: {states}" + (f" ({whole['text']})" if "text" in whole else ""))
        for mode in MODES:
            for case in cases(folder, mode, QUICK if arguments.quick else arguments.each, arguments.seed):
                if arguments.case in (None, case.name):
                    # A set that cannot be read undamaged must not be read damaged either: any state is one too few.
                    undamaged = whole.get("reference", {"states": sys.maxsize, "sums": {}})
                    todo.put((case, {"case": asdict(case), "how": whole["how"], "undamaged": undamaged}))
    first.stop()

    done: list[tuple[Case, dict[str, Any]]] = []
    threads = [threading.Thread(target=work, args=(todo, done)) for _ in range(arguments.workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    counts = Counter((Path(case.folder).name, case.mode, answer["outcome"]) for case, answer in done)
    print(f"\n{'set':26} {'damage':7}" + "".join(f"{name:>13}" for name in OUTCOMES))
    for folder in sets:
        for mode in MODES:
            row = "".join(f"{counts[folder.name, mode, name]:13}" for name in OUTCOMES)
            print(f"{folder.name:26} {mode:7}{row}")
    told = [(c, a) for c, a in done if arguments.case or a["outcome"] in FORBIDDEN]
    for case, answer in told[:20]:
        print(
            f"{case.name}: {answer['outcome']}: {case.file}, byte {case.place}, bit {case.bit}: {answer.get('text', '')}"
        )
    bad = sum(answer["outcome"] in FORBIDDEN for _, answer in done)
    if arguments.json:
        seen = Counter(answer["outcome"] for _, answer in done)
        entry = {
            "what": "damaged results: share of cases with lost states, traceback, crash or hang",
            "ratio": bad / max(1, len(done)),
            "goal": 0.0,
            "sense": "at most",
            "note": f"{len(done)} cases on {len(sets)} sets: " + ", ".join(f"{n} {name}" for name, n in seen.items()),
        }
        arguments.json.write_text(json.dumps([entry], indent=1))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
