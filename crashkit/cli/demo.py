"""`crashkit demo`: the whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import fail, say, table

# As in the kart data's README: the first 27 of 36 runs train, the last 9 test.
TEST_RUNS = "27:36"
# The paper keeps about 1/8, 1/4 and 1/4 of the nodes; the demo mesh has 2400.
NODES = "300,75,19"


@dataclass(frozen=True)
class Step:
    """One command of the demo and why it is run; `result` is the file or folder that it leaves, if any."""

    why: str
    arguments: tuple[str, ...]
    result: Path | None = None


def steps(output: Path, source: Path) -> list[Step]:
    """The commands of the demo, in order."""
    data, report = output / "kart.zarr", output / "report"
    models = {name: output / name for name in ("mh", "podnn", "pod-gpr")}

    def command(*arguments: str | Path) -> tuple[str, ...]:
        return tuple(map(str, arguments))

    return [
        Step("Solver runs become one dataset", command("ingest", source, "-o", data), data),
        Step("What is in it?", command("info", data)),
        Step("Does it keep the rules of a crash dataset?", command("validate", data)),
        Step(
            "Three coarser meshes, each a subset of the nodes",
            command("coarsen", data, "--nodes", NODES, "--picture", output / "levels.png"),
            output / "levels.png",
        ),
        *(
            Step(why, command("train", data, "-o", models[name], "--model", name, "--test", TEST_RUNS), models[name])
            for name, why in (
                ("podnn", "The usual baseline: four modes and a network"),
                ("pod-gpr", "The baseline to beat: modes and Gaussian processes"),
                ("mh", "The multi-hierarchical surrogate, coarse to fine"),
            )
        ),
        Step(
            "How far can they be trusted? On runs none of them has seen",
            command("evaluate", data, *models.values(), "-o", report, "--write-vtu"),
            report,
        ),
        Step(
            "A crash nobody computed: 22 m/s, 10 degrees, 350 MPa",
            command(
                "predict", models["mh"], "--param", "impact_speed=22", "--param", "impact_angle=10",
                "--param", "yield_stress=350MPa", "--full", "-o", output / "new_crash.pvd",
            ),
            output / "new_crash.pvd",
        ),
    ]  # fmt: skip


def run_steps(todo: list[Step], done_file: Path) -> None:
    """Run the steps one after the other; those whose command and result are there from last time are skipped."""
    done: list[str] = json.loads(done_file.read_text()) if done_file.exists() else []
    for number, step in enumerate(todo, 1):
        line = "crashkit " + shlex.join(step.arguments)
        say(f"\n[{number}/{len(todo)}] {step.why}\n$ {line}")
        if step.result is not None and line in done and step.result.exists():
            say("  (done before)")
            continue
        code = subprocess.run([sys.executable, "-m", "crashkit", *step.arguments], check=False).returncode
        if code:
            fail(f"step {number} of the demo ended with code {code}; its message stands above", code=code)
        # A step that is run again makes those behind it stale.
        done = [*done[: number - 1], line] if line not in done else done[: done.index(line) + 1]
        done_file.write_text(json.dumps(done))


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="Start again, though earlier results are there.")] = False,
) -> None:
    """Take the embedded kart runs from solver results to a report and ParaView files (a few minutes)."""
    from crashkit.dataset import demo_data
    from crashkit.errors import OutputError

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be made a folder ({error.strerror}); choose another with -o") from error
    done_file = output / "done.json"
    if fresh:
        done_file.unlink(missing_ok=True)
    run_steps(steps(output, demo_data()), done_file)
    show_result(output)


def show_result(output: Path) -> None:
    """The table of errors from the report's own numbers, and the paths worth opening."""
    numbers = json.loads((output / "report" / "report.json").read_text())
    say("")
    print(numbers.keys())
    table("", (), ())
