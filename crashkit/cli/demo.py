"""`crashkit demo`: the whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from crashkit.api.steps import Step
from crashkit.cli._console import run_shown, say, table, what_next

# As in the kart data's README: the first 27 of 36 runs train, the last 9 test.
TEST_RUNS = "27:36"
# The paper keeps about 1/8, 1/4 and 1/4 of the nodes; the demo mesh has 2400.
NODES = "300,75,19"


def steps(output: Path, source: Path) -> list[Step]:
    """The commands of the demo, in order."""
    data, report = output / "kart.zarr", output / "report"
    models = {name: output / name for name in ("mh", "podnn", "pod-gpr")}

    def command(*arguments: str | Path) -> tuple[str, ...]:
        return tuple(map(str, arguments))

    return [
        Step("Solver runs become one dataset", command("ingest", source, "-o", data), data, again=("--overwrite",)),
        Step("What is in it?", command("info", data)),
        Step("Does it keep the rules of a crash dataset?", command("validate", data)),
        Step(
            "Three coarser meshes, each a subset of the nodes",
            command("coarsen", data, "--nodes", NODES, "--picture", output / "levels.png"),
            output / "levels.png",
        ),
        *(
            Step(
                why, command("train", data, "-o", models[name], "--model", name, "--test", TEST_RUNS), models[name],
                again=("--overwrite",),
            )
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
            again=("--overwrite",),
        ),
        Step(
            "A crash nobody computed: 22 m/s, 10 degrees, 350 MPa",
            command(
                "predict", models["mh"], "--param", "impact_speed=22", "--param", "impact_angle=10",
                "--param", "yield_stress=350MPa", "-o", output / "new_crash.pvd",
            ),
            output / "new_crash.pvd",
        ),
        Step(
            "Both models as one page with sliders, for any browser or phone",
            command("explore", models["mh"], models["pod-gpr"], "-o", output / "crash.html", "--title", "Kart frame"),
            output / "crash.html",
        ),
    ]  # fmt: skip


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="Make everything again.")] = False,
) -> None:
    """Run the whole workflow on embedded kart crashes.

    From solver results to a report and ParaView files, in a few minutes. Run again, it does only what is missing.
    """
    from crashkit.dataset import demo_data
    from crashkit.errors import OutputError

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another folder with -o") from error
    run_shown(steps(output, demo_data()), output / "done.json", fresh=fresh)
    show_result(output)


def show_result(output: Path) -> None:
    """The errors from the report's own numbers, and the paths worth opening."""
    rows = json.loads((output / "report" / "report.json").read_text())["performance"]
    say("")
    table(
        "Mean node error on runs no model has seen, on the full mesh",
        ("model", "error (cm)", "worst run (cm)", "best linear compression (cm)"),
        (
            (r["model"], *(_centimetres(r[key]) for key in ("error_cm", "worst_run_cm", "pod_floor_cm")))
            for r in sorted(rows, key=lambda r: -float(r["error_cm"]))
        ),
    )
    say("Open next:")
    for path, what in (
        (output / "crash.html", "sliders: change speed, angle and strength and see the crash, in a browser"),
        (output / "report" / "report.html", "the report, in a browser"),
        (output / "report" / "vtk", "truth, predictions and errors of two runs, in ParaView (.pvd)"),
        (output / "new_crash.pvd", "a crash nobody computed, in ParaView"),
        (output / "levels.png", "the meshes the surrogate works on"),
    ):
        if path.exists():
            say(f"  {path}  {what}")
    what_next(None, ("info", output / "mh"), ("run", "study.yaml"))


def _centimetres(value: float | None) -> str:
    """A number of the report, which has none where a model keeps more modes than are looked at."""
    return "-" if value is None else f"{value:.2f}"
