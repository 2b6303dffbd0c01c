#!/usr/bin/env python
"""Mutate files and see whether the tests notice: `python tools/mutate.py FILE... [--sample 15] [--seed 0]`.

A mutant is the file with one small change (`+` for `-`, `<=` for `<`, an argument left out, ...), made by mutmut. A
random sample of them is tried, each against the tests nearest to the file; one that all tests pass is a survivor, and
its change is shown. The working tree is copied first, so nothing in it changes.

Nearest are the test files called after the module, in the folder of `tests/` that mirrors its own; without any, those that
import from the module; without any, the folder. `--tests` names others. Left out of the sample are changes that only touch
the words of a message (text with a space in it) and `strict=` of zip, which guards and does nothing else.

Ends with exit code 1 where less than `--share` of a file's sample was killed.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("crashkit", "data_schema", "evaluation", "surrogates")
# Exit codes that mutmut keeps: pytest's, or minus the signal.
STATUS = {
    0: "survived",
    1: "killed",
    3: "killed",
    5: "no tests",
    33: "no tests",
    36: "timeout",
    -24: "timeout",
    -9: "timeout",
    -11: "crash",
    -6: "crash",
}
KILLED = ("killed", "timeout", "crash")


@dataclass(frozen=True)
class Outcome:
    """What became of the mutants of one file: status by name, and the change that each survivor made."""

    file: str
    status: dict[str, str]
    survivors: dict[str, str]

    @property
    def killed(self) -> int:
        return sum(status in KILLED for status in self.status.values())

    @property
    def share(self) -> float:
        return self.killed / len(self.status) if self.status else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0], epilog="See the head of this file.")
    parser.add_argument("files", nargs="+", metavar="FILE", help="Python files of the four packages")
    parser.add_argument("--sample", type=int, default=15, help="mutants tried in each file (default 15)")
    parser.add_argument("--seed", type=int, default=0, help="of the random sample (default 0)")
    parser.add_argument("--tests", nargs="+", metavar="PATH", help="tests to run instead of the nearest")
    parser.add_argument(
        "--share", type=float, default=0.85, help="of a file's sample that must be killed (default 0.85)"
    )
    parser.add_argument("--jobs", type=int, default=1, help="mutants tried at the same time (default 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the outcome here as well")
    given = parser.parse_args()
    outcomes = []
    for file in given.files:
        name = Path(file).resolve().relative_to(ROOT).as_posix()
        tests = given.tests or nearest_tests(name)
        print(f"{name}: tested by {' '.join(tests)}", flush=True)
        outcome = try_mutants(name, tests, given.sample, given.seed, given.jobs)
        outcomes.append(outcome)
        for mutant, change in outcome.survivors.items():
            print(f"\n{mutant}: {outcome.status[mutant]}\n{change}")
        how = ", ".join(f"{count} {status}" for status, count in Counter(outcome.status.values()).items())
        print(f"{name}: {outcome.killed} of {len(outcome.status)} killed ({how}; seed {given.seed})\n", flush=True)
    if given.json:
        told = [{"file": o.file, "seed": given.seed, "status": o.status, "survivors": o.survivors} for o in outcomes]
        given.json.write_text(json.dumps(told, indent=1), encoding="utf-8")
    print("\n".join(f"{o.share:6.0%}  {o.killed:3d} of {len(o.status):3d}  {o.file}" for o in outcomes))
    return int(any(o.share < given.share for o in outcomes))


def nearest_tests(file: str) -> list[str]:
    """Test files called after the module, or else those that import from it, or else the folder that mirrors its own."""
    module = file.removesuffix(".py").replace("/", ".")
    room, _, stem = module.rpartition(".")
    folder = ROOT / "tests" / Path(file).parent
    named = {*folder.glob(f"test_{stem}.py"), *folder.glob(f"test_{stem}_*.py"), *folder.glob(f"test_*_{stem}.py")}
    imports = re.compile(
        rf"^\s*(from {re.escape(module)} import|import {re.escape(module)}\b"
        rf"|from {re.escape(room)} import ([\w, ]+, )?{stem}\b)", re.MULTILINE
    )  # fmt: skip
    tests = (ROOT / "tests").rglob("test_*.py")
    found = named or {t for t in tests if imports.search(t.read_text(encoding="utf-8"))} or {folder}
    return sorted(t.relative_to(ROOT).as_posix() for t in found)


def try_mutants(file: str, tests: list[str], sample: int, seed: int, jobs: int) -> Outcome:
    """Make the mutants of `file` in a copy of the tree, and run `tests` against a sample of them."""
    with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
        place = Path(folder)
        copy_tree(place)
        (place / "mutants").mkdir()  # before Python starts, which remembers folders that are not there
        with (place / "pyproject.toml").open("a", encoding="utf-8") as project:
            project.write(settings(file, tests))
        chosen = sampled(place, file, sample, seed)
        if not chosen:
            return Outcome(file, {}, {})
        # Child processes of tests import the mutated tree as well.
        beside = {"PYTHONPATH": str(place / "mutants"), "OMP_NUM_THREADS": "1", "TMPDIR": str(place)}
        environment = {**os.environ, **beside}
        ran = mutmut(place, environment, "run", "--max-children", str(jobs), *chosen)
        codes = json.loads((place / "mutants" / f"{file}.meta").read_text(encoding="utf-8"))["exit_code_by_key"]
        status = {name: STATUS.get(codes[name], "not tried") for name in chosen}
        if "not tried" in status.values():
            raise SystemExit(f"{file}: tests could not be run against every mutant\n{ran[-3000:]}")
        lost = [name for name in chosen if status[name] not in KILLED]
        return Outcome(file, status, {name: mutmut(place, environment, "show", name).strip() for name in lost})


def settings(file: str, tests: list[str]) -> str:
    """The section of pyproject.toml that has mutmut mutate `file` alone."""
    values = {
        "source_paths": list(PACKAGES),
        "only_mutate": [file],
        "also_copy": ["examples", "docs", "tools"],
        "pytest_add_cli_args": ["-p", "no:cacheprovider"],
        "pytest_add_cli_args_test_selection": tests,
        "process_isolation": "forkserver",
        "timeout_multiplier": 5.0,
        "timeout_constant": 20.0,  # a hundred seconds: machines may be busy
        "track_dependencies": False,
        "use_git_change_detection": False,
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in values.items()]
    return "\n".join(["\n[tool.mutmut]", *lines, ""])


def sampled(place: Path, file: str, sample: int, seed: int) -> list[str]:
    """Names of the mutants to try, in their order in the file."""
    program = (
        "import sys, json; from pathlib import Path; from mutmut.mutation.file_mutation import mutate_file_contents;"
        "from mutmut.utils.format_utils import get_mutant_name; file = sys.argv[1];"
        "made = mutate_file_contents(file, Path(file).read_text(encoding='utf-8'));"
        "print(json.dumps([made.code, {n: get_mutant_name(Path(file), n) for n in made.mutant_names}]))"
    )
    done = subprocess.run([sys.executable, "-c", program, file], cwd=place, capture_output=True, text=True, check=True)
    code, names = json.loads(done.stdout.splitlines()[-1])
    functions = dict(_functions(ast.parse(code)))
    worth = [
        name
        for short, name in names.items()
        if functions[short] != functions[f"{short.partition('__mutmut_')[0]}__mutmut_orig"]
    ]
    picked = set(random.Random(seed).sample(worth, min(sample, len(worth))))
    return [name for name in worth if name in picked]


def _functions(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Name and content of every function, without the words of messages and `strict=`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for part in ast.walk(node):
                if isinstance(part, ast.Constant) and isinstance(part.value, str) and " " in part.value.strip():
                    part.value = " "
                if isinstance(part, ast.Call):
                    part.keywords = [k for k in part.keywords if k.arg != "strict"]
            yield node.name, "\n".join(map(ast.dump, (node.args, *node.body)))


def copy_tree(place: Path) -> None:
    """The files that git knows, or would take, as they are on disk."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, place / name)


def mutmut(place: Path, environment: dict[str, str], *arguments: str) -> str:
    done = subprocess.run(
        [str(Path(sys.executable).with_name("mutmut")), *arguments],
        cwd=place, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"mutmut {' '.join(arguments)} failed\n{done.stdout[-4000:]}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
