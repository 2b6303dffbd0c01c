"""The whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crashkit.api.steps import Step, run_steps

# As in the kart data's README: the first 27 of 36 runs train, the last 9 test.
TEST_RUNS = "27:36"
# The paper keeps about 1/8, 1/4 and 1/4 of the nodes; the demo mesh has 2400.
NODES = "300,75,19"
# As many modes as the fast preset's surrogate has latent numbers, so that the baseline is as wide.
LATENT = 48
WIDE = f"podnn-{LATENT}"


@dataclass(frozen=True)
class DemoResult:
    """What the demo has made.

    Attributes
    ----------
    performance
        The table of the report, the largest error first: model, error_cm, worst_run_cm, pod_floor_cm.
    regressions
        One sentence: what predicts the latent numbers on each level of the finest model.
    files
        What is worth opening, and what each is.
    model
        The folder of the finest model.
    """

    performance: list[dict[str, Any]]
    regressions: str
    files: dict[Path, str]
    model: Path


def run_demo(
    output: str | Path = "demo", *, fresh: bool = False, say: Callable[[str], None] | None = None
) -> DemoResult:
    """From the embedded solver runs to a report, ParaView files and a page with sliders; only what is missing is made.

    Parameters
    ----------
    output
        Folder for everything.
    fresh
        Make everything again.
    say
        Called with a sentence before each step.

    Raises
    ------
    OutputError
        For a result in `output` that somebody else has made, or where it cannot be written.
    StepFailedError
        Where a step ends with an error.
    """
    from crashkit.dataset import demo_data

    output = Path(output)
    run_steps(steps(output, demo_data()), output, fresh=fresh, say=say)
    return demo_result(output)


def demo_result(output: Path) -> DemoResult:
    """What a demo has left in `output`."""
    from crashkit.api.describe import describe_report

    rows = describe_report(output / "report")["performance"]
    files = {
        output / "crash.html": "sliders: change speed, angle and strength and see the crash, in a browser",
        output / "report" / "report.html": "the report, in a browser",
        output / "report" / "vtk": "truth, predictions and errors of two runs, in ParaView (.pvd)",
        output / "new_crash.pvd": "a crash nobody computed, in ParaView",
        output / "levels.png": "the meshes the surrogate works on",
    }
    return DemoResult(
        sorted(rows, key=lambda row: -float(row["error_cm"])),
        _regressions(output / "mh"),
        {path: what for path, what in files.items() if path.exists()},
        output / "mh",
    )


def _regressions(folder: Path) -> str:
    """What the levels of the model in `folder` predict their latent numbers with, in one sentence."""
    choice = json.loads((folder / "model.json").read_text(encoding="utf-8"))["record"]["choice"]
    levels = ", ".join(f"{name} {told.split(' (')[0]}" for name, told in choice.items())
    return (
        f"From parameters to latent numbers: {levels or 'a network on every level'}, as chosen by cross-validation "
        "(process: a Gaussian process over whole runs; the rest is a network)."
    )


def steps(output: Path, source: Path) -> list[Step]:
    """The commands of the demo, in order."""
    data, report = output / "kart.zarr", output / "report"
    models = {name: output / name for name in ("mh", "podnn", WIDE, "pod-gpr")}

    def command(*arguments: str | Path) -> tuple[str, ...]:
        return tuple(map(str, arguments))

    return [
        Step("Solver runs become one dataset", command("ingest", source, "-o", data), data, again=("--overwrite",)),
        Step("What is in it?", command("info", data)),
        Step("Does it keep the rules of a crash dataset?", command("validate", data)),
        Step(
            "Three coarser meshes, each a subset of the nodes",
            command("coarsen", data, "--nodes", NODES, "--test", TEST_RUNS, "--picture", output / "levels.png"),
            output / "levels.png",
            again=("--overwrite",),
        ),
        *(
            Step(
                why, command("train", data, "-o", models[name], "--model", kind, *more, "--test", TEST_RUNS), models[name],
                again=("--overwrite",),
            )
            for name, kind, more, why in (
                ("podnn", "podnn", (), "The usual baseline: four modes and a network"),
                (
                    WIDE, "podnn", ("--set", f"level.latent={LATENT}"),
                    f"The same with {LATENT} modes, as many as the surrogate has latent numbers",
                ),
                ("pod-gpr", "pod-gpr", (), "The baseline to beat: modes and Gaussian processes"),
                ("mh", "mh", (), "The multi-hierarchical surrogate, coarse to fine"),
            )
        ),
        Step(
            "How far can they be trusted? On runs none of them has seen",
            command("evaluate", data, *models.values(), "-o", report, "--write-vtu"),
            report,
            again=("--overwrite",),
        ),
        Step(
            "A crash nobody computed: 22 m/s, 10 degrees, 350 MPa",
            command(
                "predict", models["mh"], "--param", "impact_speed=22", "--param", "impact_angle=10",
                "--param", "yield_stress=350MPa", "-o", output / "new_crash.pvd",
            ),
            output / "new_crash.pvd",
            again=("--overwrite",),
        ),
        Step(
            "Both models as one page with sliders, for any browser or phone",
            command("explore", models["mh"], models["pod-gpr"], "-o", output / "crash.html", "--title", "Kart frame"),
            output / "crash.html",
            again=("--overwrite",),
        ),
    ]  # fmt: skip
