"""The whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

from pathlib import Path

from crashkit.api.steps import Step

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
