"""All benchmarks one after the other, and their ratios beside their goals as one table.

    python benchmarks/table.py [-o benchmarks.md] [--quick] [--only train_step predict] [--with damage="--data FOLDER"]

Each script runs in a process of its own with `--json`; `--quick` is passed on, and `--with NAME="..."` gives one script
further options. A script that fails stands in the table with the last line it wrote. Exit code 1 where one failed; a
goal that is not met is shown, and is no failure.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

SCRIPTS = ("coarsen", "damage", "ingest_memory", "paraview", "train_step", "predict", "time_to_error", "vehicle")
FIELDS = {"what", "ratio", "goal", "sense", "note"}


def run(name: str, more: list[str], quick: bool) -> tuple[list[dict[str, Any]], str]:
    """The entries of one script, and what went wrong, if anything."""
    with tempfile.TemporaryDirectory() as place:
        results = Path(place) / "results.json"
        script = Path(__file__).with_name(f"{name}.py")
        command = [sys.executable, str(script), "--json", str(results), *(["--quick"] if quick else []), *more]
        done = subprocess.run(command, stdout=sys.stderr, stderr=subprocess.PIPE, text=True, check=False)
        try:
            entries = json.loads(results.read_text(encoding="utf-8")) if results.exists() else []
        except ValueError:
            return [], "wrote no valid JSON"
    if not all(isinstance(entry, dict) and entry.keys() >= FIELDS for entry in entries):
        return [], f"wrote other entries than {', '.join(sorted(FIELDS))}"
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing said"]
        return entries, f"exit code {done.returncode}: {said[-1]}"
    return entries, "" if entries else "wrote no ratios"


def met(entry: dict[str, Any]) -> bool:
    return entry["ratio"] <= entry["goal"] if entry["sense"] == "at most" else entry["ratio"] >= entry["goal"]


def rows(name: str, entries: list[dict[str, Any]], fault: str) -> list[str]:
    """Markdown rows of one script."""
    out = [
        f"| {name} | {cell(e['what'])} | {e['ratio']:.3g} | {e['sense']} {e['goal']:g} | {'yes' if met(e) else '**no**'}"
        f" | {cell(e['note'])} |"
        for e in entries
    ]
    return [*out, f"| {name} | **failed** | | | **no** | {cell(fault)} |"] if fault else out


def cell(text: str) -> str:
    return " ".join(text.replace("|", "/").split())


def machine() -> str:
    memory = ""
    if hasattr(os, "sysconf"):
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    names = [line for line in _lines(Path("/proc/cpuinfo")) if line.startswith("model name")]
    processor = names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
    return f"{processor}, {os.cpu_count()} cores{memory}, {platform.system()}, Python {platform.python_version()}"


def _lines(file: Path) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines() if file.exists() else []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", "-o", type=Path, default=Path("benchmarks.md"))
    parser.add_argument("--quick", action="store_true", help="smaller sizes; under a minute each")
    parser.add_argument("--only", nargs="+", choices=SCRIPTS, default=SCRIPTS, metavar="NAME", help=", ".join(SCRIPTS))
    parser.add_argument("--with", dest="more", action="append", default=[], metavar='NAME="..."', help="its options")
    options = parser.parse_args()
    more = {name: shlex.split(text) for name, _, text in (given.partition("=") for given in options.more)}
    unknown = more.keys() - set(SCRIPTS)
    if unknown:
        parser.error(f"--with {min(unknown)}: no such benchmark; there are {', '.join(SCRIPTS)}")
    body: list[str] = []
    failed = False
    for name in options.only:
        started = time.perf_counter()
        print(f"== {name}", file=sys.stderr, flush=True)
        entries, fault = run(name, more.get(name, []), options.quick)
        print(fault or f"done in {time.perf_counter() - started:.0f} s", file=sys.stderr)
        failed |= bool(fault)
        body += rows(name, entries, fault)
    text = "\n".join(
        [
            f"{machine()}; {datetime.datetime.now(datetime.UTC):%Y-%m-%d}{'; with --quick' if options.quick else ''}",
            "",
            "| benchmark | what | ratio | goal | met | measured |",
            "|---|---|---|---|---|---|",
            *body,
        ]
    )
    print(text)
    options.output.write_text(text + "\n", encoding="utf-8")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
