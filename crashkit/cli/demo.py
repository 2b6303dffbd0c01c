"""`crashkit demo`: the whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import fail, say, table
from crashkit.version import __version__

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
        Step(
            "Both models as one page with sliders, for any browser or phone",
            command("explore", models["mh"], models["pod-gpr"], "-o", output / "crash.html", "--title", "Kart frame"),
            output / "crash.html",
        ),
    ]  # fmt: skip


def run_steps(todo: list[Step], done_file: Path) -> None:
    """Run the steps in order; those that ended well last time, with the same command and version, are skipped.

    From the first step that is run on, all are run: what they read has changed.
    """
    before: list[str] = json.loads(done_file.read_text()) if done_file.exists() else []
    done: list[str] = []
    renewed = False
    for number, step in enumerate(todo, 1):
        line = "crashkit " + shlex.join(step.arguments)
        say(f"\n[{number}/{len(todo)}] {step.why}\n$ {line}")
        mark = f"{__version__}: {line}"
        if step.result is not None and step.result.exists():
            if not renewed and before[number - 1 : number] == [mark]:
                say("  (done before; --fresh starts again)")
                done.append(mark)
                continue
            _remove(step.result)
        renewed = renewed or step.result is not None
        code = subprocess.run([sys.executable, "-m", "crashkit", *step.arguments], check=False).returncode
        if code:
            fail(f"step {number} of the demo ended with code {code}; its message stands above", code=code)
        done.append(mark)
        done_file.write_text(json.dumps(done))


def _remove(result: Path) -> None:
    """Make room for a result that is made again."""
    if result.is_dir():
        shutil.rmtree(result)
    else:
        result.unlink()


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="Start again, though earlier results are there.")] = False,
) -> None:
    """Take the embedded kart runs from solver results to a report and ParaView files (a few minutes)."""
    from crashkit.dataset import demo_data
    from crashkit.errors import OutputError

    done_file = output / "done.json"
    try:
        output.mkdir(parents=True, exist_ok=True)
        if fresh:
            done_file.unlink(missing_ok=True)
        done_file.touch()
        if done_file.stat().st_size == 0:
            done_file.write_text("[]")
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another folder with -o") from error
    run_steps(steps(output, demo_data()), done_file)
    show_result(output)


def show_result(output: Path) -> None:
    """The errors from the report's own numbers, and the paths worth opening."""
    rows = json.loads((output / "report" / "report.json").read_text())["performance"]
    say("")
    table(
        "Mean node error on runs no model has seen, lifted to the full mesh",
        ("model", "error (cm)", "worst run (cm)", "POD floor (cm)"),
        (
            (r["model"], f"{r['error_cm']:.2f}", f"{r['worst_run_cm']:.2f}", f"{r['pod_floor_cm']:.2f}")
            for r in sorted(rows, key=lambda r: -float(r["error_cm"]))
        ),
    )
    say("Open next:")
    for path, what in (
        (output / "crash.html", "sliders: change speed, angle and strength and see the crash, in a browser"),
        (output / "report" / "report.html", "the report, in a browser"),
        (output / "report" / "vtk", "truth, prediction and error of two runs, in ParaView (.pvd or .vtkhdf)"),
        (output / "new_crash.pvd", "a crash nobody computed, in ParaView"),
        (output / "levels.png", "the meshes the surrogate works on"),
    ):
        say(f"  {path}  {what}")
