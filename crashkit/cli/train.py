"""`crashkit train`: a dataset and settings in, a model folder out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.api.train import interrupted, train
from crashkit.cli._console import print_json, progress, say, table

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate
    from surrogates.training.loop import Epoch


def command(
    dataset: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc) with a hierarchy.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Model folder.")],
    model: Annotated[str, typer.Option(help="mh, podnn, aenn, gaenn, pod-gpr or pod-rbf.", show_default="mh")] = "",
    preset: Annotated[
        str, typer.Option(help="fast, or paper for exactly what the paper does.", show_default="fast")
    ] = "",
    config: Annotated[Path | None, typer.Option(help="Settings as YAML.", show_default=False)] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting: level.latent=8. Repeat for more.")
    ] = None,
    test: Annotated[
        str, typer.Option(help="Runs nobody may see: 27:36, names with commas, a number or a fraction.")
    ] = "",
    epochs: Annotated[int | None, typer.Option(help="Epochs of every level.", min=1, show_default=False)] = None,
    seed: Annotated[int | None, typer.Option(help="Seed.", min=0, show_default=False)] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, mps or auto.")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted training.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the model that is there.")] = False,
    tensorboard: Annotated[Path | None, typer.Option(help="Folder for TensorBoard files.", show_default=False)] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a surrogate and store it as a folder. Ctrl-C ends early and stores what there is."""
    given = list(settings or ())
    if epochs is not None:
        given += [f"level.epochs={epochs}", "transfer.epochs=1"]
    if seed is not None:
        given.append(f"seed={seed}")
    with _progress(quiet=json) as report:
        surrogate = train(
            dataset, output, model or None, config, given, preset=preset or None, test=test or None, device=device,
            resume=resume, overwrite=overwrite, tensorboard=tensorboard, report=report,
        )  # fmt: skip
    _show(surrogate, output, json)


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[Epoch], None]]:
    """A bar a level on a terminal, ten lines a level elsewhere."""
    with progress(quiet=quiet) as bar:
        tasks: dict[str, Any] = {}

        def report(epoch: Epoch) -> None:
            if epoch.name not in tasks:
                tasks[epoch.name] = bar.add_task(epoch.name, total=epoch.epochs, note="")
            note = (
                f"total {epoch.total:.3e} = approximation {epoch.approximation:.3e} + reconstruction "
                f"{epoch.reconstruction:.3e}, validation {epoch.validation:.3e} (best in epoch {epoch.best_epoch}), "
                f"{epoch.rate:.1f} epochs/s"
            )
            bar.update(tasks[epoch.name], completed=epoch.epoch, note=note)
            every = max(1, epoch.epochs // 10)
            if bar.disable and not quiet and (epoch.epoch % every == 0 or epoch.epoch == epoch.epochs):
                say(f"{epoch.name} {epoch.epoch}/{epoch.epochs}  {note}, {epoch.seconds_left:.0f} s left")

        yield report


def _show(surrogate: Surrogate, output: Path, as_json: bool) -> None:
    """What was trained and how well it does on validation runs."""
    record = surrogate.record
    rows = [
        {
            "model": name,
            "level": number,
            "nodes": surrogate.graphs.n_nodes(number),
            "parameters": surrogate.n_parameters(number),
            "epochs": fit.epochs,
            "best_epoch": fit.best_epoch,
            "seconds": round(fit.seconds, 2),
            "status": fit.status,
            "validation_error_m": record.errors.get(name),
        }
        for name, number in surrogate.level_names.items()
        if (fit := surrogate.fit(number)) is not None
    ]
    if as_json:
        print_json(
            {
                "output": output, "levels": rows, "choice": record.choice, "validation_errors_m": record.errors,
                "training_runs": record.fitted_runs, "validation_runs": record.validation_runs,
                "held_out_runs": record.held_out_runs, "notes": record.notes,
            }
        )  # fmt: skip
        return
    for line in record.notes:
        say(f"note: {line}")
    table(
        f"{output}: {len(record.fitted_runs)} training, {len(record.validation_runs)} validation, "
        f"{len(record.held_out_runs)} held-out runs",
        ("model", "nodes", "parameters", "epochs", "best", "training (s)", "validation error (cm)"),
        (
            (
                r["model"],
                r["nodes"],
                r["parameters"],
                r["epochs"] or "-",
                r["best_epoch"] or "-",
                f"{r['seconds']:.1f}",
                "-" if r["validation_error_m"] is None else f"{100 * r['validation_error_m']:.2f}",
            )
            for r in rows
        ),
    )
    if record.choice:
        say("chosen on validation runs: " + ", ".join(f"{k} {v}" for k, v in record.choice.items()))
    if interrupted(surrogate):
        say("interrupted: the best weights so far are stored; --resume --overwrite goes on from here")
