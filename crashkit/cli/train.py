"""`crashkit train`: a dataset and settings in, a model folder out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.api.describe import (
    describe_training,
    middle,
    trained_levels,
    what_is_said_of_elements,
    what_the_mean_is_worth,
    what_was_chosen,
)
from crashkit.api.train import interrupted, left_behind, train
from crashkit.cli._console import fixed, names, print_json, say, table, what_next
from crashkit.cli._progress import Progress

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate
    from surrogates.training.loop import Epoch


def command(
    dataset: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc) with a mesh hierarchy.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Model folder to write.")],
    model: Annotated[
        str, typer.Option(help="Kind of model: mh, podnn, aenn, gaenn, pod-gpr or pod-rbf.", show_default="mh")
    ] = "",
    preset: Annotated[
        str, typer.Option(help="Starting values of the settings: fast, or paper (as published).", show_default="fast")
    ] = "",
    config: Annotated[Path | None, typer.Option(help="YAML file with settings.", show_default=False)] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting, such as level.latent=8; repeat for more.")
    ] = None,
    test: Annotated[
        str, typer.Option(help="Runs held out for testing: 27:36, names, a count or a fraction.", show_default="none")
    ] = "",
    odd: Annotated[
        str,
        typer.Option(
            help="Parameters that change their sign in the mirror, such as impact_angle.", show_default="tried in turn"
        ),
    ] = "",
    targets: Annotated[
        str,
        typer.Option(
            help="What is learnt: displacement, and beside it results on elements (plastic_strain) and histories (history:wall_force)."
        ),
    ] = "displacement",
    coarse: Annotated[
        Path | None,
        typer.Option(
            help="Dataset of runs on a coarser mesh of the same structure, beneath few fine ones (mh, pod-gpr): coarse.zarr.",
            show_default="none",
        ),
    ] = None,
    epochs: Annotated[
        int | None, typer.Option(help="Epochs of every level.", min=1, show_default="from the settings")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Random seed.", min=0, show_default="from the settings")] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            help="Trainings whose mean is the model, such as 5: with this seed and the next ones; each takes as long as one.",
            min=1,
            show_default="1",
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, mps or auto.")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted training.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the model that is there.")] = False,
    tensorboard: Annotated[Path | None, typer.Option(help="Folder for TensorBoard files.", show_default="none")] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Also show the losses.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a surrogate and store it as a folder. Ctrl-C stops early and keeps the best weights so far."""
    given = list(settings or ())
    if odd:
        given.append(f"physics.odd=[{odd}]")
    if not json:
        for left in left_behind(output, resume=resume):
            say(f"note: {left}")
        if seeds is not None and seeds > 1:
            say(
                f"{seeds} trainings, one after the other: {seeds} times the time of one and {seeds} times its space on disk, the "
                "memory of one and the weights of those that are done; "
                "Ctrl-C keeps those that are done, --resume --overwrite goes on with the next"
            )
    with Progress(f"reading {dataset}", quiet=json) as shown:
        surrogate = train(
            dataset, output, model or None, preset=preset or None, settings=given, config=config, seed=seed, seeds=seeds,
            epochs=epochs, test=test or None, device=device, resume=resume, overwrite=overwrite,
            targets=() if targets == "displacement" else names(targets), coarse=coarse,
            tensorboard=tensorboard, on_epoch=epoch_lines(shown, verbose),
        ).surrogate  # fmt: skip
    if json:
        print_json(describe_training(surrogate, output))
        return
    show(surrogate, output)
    if interrupted(surrogate):
        say("interrupted: the best weights so far are stored; continue with --resume --overwrite")
    elif surrogate.record.held_out_runs:
        what_next(output / "card.md", ("evaluate", dataset, output, "-o", "report"))
    else:
        asked = (x for name, value in middle(surrogate).items() for x in ("--param", f"{name}={value}"))
        what_next(output / "card.md", ("predict", output, *asked))


def epoch_lines(shown: Progress, verbose: bool = False) -> Callable[[Epoch], None]:
    """Reports of epochs as lines of progress."""

    def report(epoch: Epoch) -> None:
        note = epoch.note()
        if verbose:
            note += (
                f" | total {epoch.total:.3e} = approximation {epoch.approximation:.3e} + reconstruction "
                f"{epoch.reconstruction:.3e}, validation {epoch.validation:.3e}, rate {epoch.learning_rate:.1e}, "
                f"{epoch.rate:.1f} epochs/s"
            )
        shown.step(epoch.name, epoch.epoch, epoch.epochs, note, left=epoch.seconds_left)

    return report


def show(surrogate: Surrogate, output: Path) -> None:
    """What was trained and how well it does on runs that were left out."""
    from crashkit.api.numbers import told_beside
    from evaluation.report.page import plain

    record = surrogate.record
    for text in record.notes:
        say(f"note: {text}")
    table(
        f"{output}: runs {record.runs_told}",
        ("model", "nodes", "parameters", "epochs", "best", "training (s)", f"{record.error_name} (cm)"),
        (
            (
                r["model"], r["nodes"], r["parameters"], r["epochs"] or "-", r["best_epoch"] or "-",
                f"{r['seconds']:.1f}", fixed(r["validation_error_m"], 2, 100),
            )
            for r in trained_levels(surrogate)
        ),
    )  # fmt: skip
    beside = told_beside(surrogate)
    if beside:
        table(
            "Beside the displacements: errors on runs that were left out",
            ("what", "unit", "runs", "mean error", "typical value"),
            ((r["name"], r["unit"], r["runs"], plain(r["error"]), plain(r["size"])) for r in beside),
        )
    for line in [*what_the_mean_is_worth(surrogate), *what_was_chosen(record), *what_is_said_of_elements(surrogate)]:
        say(line)
