"""`crashkit train`: a dataset and settings in, a model folder out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.api.train import interrupted, train
from crashkit.cli._console import print_json, say, table, what_next
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
    epochs: Annotated[
        int | None, typer.Option(help="Epochs of every level.", min=1, show_default="from the settings")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Random seed.", min=0, show_default="from the settings")] = None,
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
        _name_dead(output, resume)
    with Progress(f"reading {dataset}", quiet=json) as shown:
        surrogate = train(
            dataset, output, model or None, preset=preset or None, settings=given, config=config, seed=seed,
            epochs=epochs, test=test or None, device=device, resume=resume, overwrite=overwrite,
            tensorboard=tensorboard, on_epoch=epoch_lines(shown, verbose),
        ).surrogate  # fmt: skip
    if json:
        print_json(_as_json(surrogate, output))
        return
    show(surrogate, output)
    if interrupted(surrogate):
        say("interrupted: the best weights so far are stored; continue with --resume --overwrite")
    elif surrogate.record.held_out_runs:
        what_next(output / "card.md", ("evaluate", dataset, output, "-o", "report"))
    else:
        ranges = surrogate.record.ranges
        middle = (ranges.low + ranges.high) / 2
        first = {n: f"{m / f:.4g}" for n, m, (_, f) in zip(ranges.names, middle, ranges.written, strict=True)}
        what_next(
            output / "card.md", ("predict", output, *(x for n, a in first.items() for x in ("--param", f"{n}={a}")))
        )


# A living training writes its state every half minute.
_DEAD_AFTER = 600.0


def _name_dead(output: Path, resume: bool) -> None:
    """Say what trainings that were killed have left beside `output`, and what can be done with it."""
    for left in sorted(output.absolute().parent.glob(".*.training")):
        files = [f.stat() for f in left.glob("*") if f.is_file()]
        name = left.name.removeprefix(".").removesuffix(".training")
        if not files or (name == output.name and resume) or time.time() - max(f.st_mtime for f in files) < _DEAD_AFTER:
            continue
        size = sum(f.st_size for f in files) / 1e6
        what = (
            "is replaced now"
            if name == output.name
            else f"goes on with -o {output.with_name(name)} --resume; else delete it"
        )
        say(f"note: {left.name} ({size:.1f} MB) is left of a training that was killed: it {what}")


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


def _levels(surrogate: Surrogate) -> list[dict[str, object]]:
    return [
        {
            "model": name,
            "level": number,
            "nodes": surrogate.graphs.n_nodes(number),
            "parameters": surrogate.n_parameters(number),
            "epochs": fit.epochs,
            "best_epoch": fit.best_epoch,
            "seconds": round(fit.seconds, 2),
            "status": fit.status,
            "validation_error_m": surrogate.record.errors.get(name),
        }
        for name, number in surrogate.level_names.items()
        if (fit := surrogate.training(number)) is not None
    ]


def _as_json(surrogate: Surrogate, output: Path) -> dict[str, object]:
    record = surrogate.record
    return {
        "output": output, "levels": _levels(surrogate), "choice": record.choice, "validation_errors_m": record.errors,
        "training_runs": record.fitted_runs, "validation_runs": record.validation_runs,
        "held_out_runs": record.held_out_runs, "physics": record.physics, "notes": record.notes,
    }  # fmt: skip


def show(surrogate: Surrogate, output: Path) -> None:
    """What was trained and how well it does on validation runs."""
    record = surrogate.record
    for text in record.notes:
        say(f"note: {text}")
    table(
        f"{output}: {len(record.fitted_runs)} training, {len(record.validation_runs)} validation, "
        f"{len(record.held_out_runs)} held-out runs",
        ("model", "nodes", "parameters", "epochs", "best", "training (s)", "validation error (cm)"),
        (
            (
                r["model"], r["nodes"], r["parameters"], r["epochs"] or "-", r["best_epoch"] or "-",
                f"{r['seconds']:.1f}",
                "-" if r["validation_error_m"] is None else f"{100 * float(str(r['validation_error_m'])):.2f}",
            )
            for r in _levels(surrogate)
        ),
    )  # fmt: skip
    for line in _physics(record.physics):
        say(line)
    if record.choice:
        by = "on validation runs" if record.validation_runs and not record.physics else "by cross-validation"
        pieces = [f"{k} {v}" for k, v in record.choice.items()]
        several = any("(" in piece for piece in pieces)  # one line for each level
        for line in pieces if several else [", ".join(pieces)]:
            say(f"chosen {by}: {line}")


def _physics(physics: Mapping[str, Any]) -> list[str]:
    """What was put in beforehand, and what it was worth."""
    out = [f"{name}: {told}" for name, told in physics.items() if isinstance(told, str)]
    errors = physics.get("errors") or {}
    if errors:
        worth = ", ".join(f"{name} {100 * error:.2f}" for name, error in errors.items())
        out.append(f"worth in cross-validation (cm): {worth}")
    return out
