"""The model card: what a surrogate is, what it has seen and how well it did, in Markdown for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import yaml

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate


def card(surrogate: Surrogate) -> str:
    """Markdown."""
    record, settings = surrogate.record, surrogate.settings
    ranges = record.ranges
    names = " -> ".join(surrogate.level_names)
    by_folds = bool(record.left_out)
    lines = [
        f"# {names}",
        "",
        f"Surrogate of kind `{settings.model}` (preset `{settings.preset}`), fitted {record.created} with {_seeds(surrogate)}.",
        "It predicts nodal displacements in metres for given parameters and times.",
        "",
        "## Inputs",
        "",
        *_table(
            ("parameter", "unit", "from", "to"),
            [
                (n, u, f"{a / factor:.6g}", f"{b / factor:.6g}")
                for n, (u, factor), a, b in zip(ranges.names, ranges.written, ranges.low, ranges.high, strict=True)
            ]
            + [("time", "s", f"{ranges.time[0]:g}", f"{ranges.time[1]:g}")],
        ),
        "",
        "Numbers given to `crashkit predict` without a unit are in these units. Outside these ranges predictions are",
        "extrapolations: `crashkit predict` says so, and refuses those far outside without `--extrapolate`.",
        "",
        *_physics(surrogate),
        "## Levels",
        "",
        *_table(
            ("model", "mesh level", "nodes", "latent", "parameters", "epochs", "best epoch", "training (s)", "status"),
            [_level_row(surrogate, name, number) for name, number in surrogate.level_names.items()],
        ),
        "",
        *_members(surrogate),
        *(("## Errors in cross-validation", "") if by_folds else ("## Errors on validation runs", "")),
    ]
    if record.errors and by_folds:
        lines += [
            "Mean distance between true and predicted nodes over nodes, states and training runs, each run predicted by a model",
            "that was fitted without it; what the reduction of a network alone loses is that of the one fitted to all runs.",
            "Choices were made by these errors, so test runs may be a little worse.",
            "",
            *_table(("measured", "error (cm)"), [(k, f"{100 * v:.3f}") for k, v in record.errors.items()]),
        ]
    elif record.errors:
        lines += [
            "Mean distance between true and predicted nodes over nodes, states and validation runs, on each level's own",
            "nodes unless lifted. Validation runs chose the weights kept, so test runs may be worse.",
            "",
            *_table(("measured", "error (cm)"), [(k, f"{100 * v:.3f}") for k, v in record.errors.items()]),
        ]
    else:
        lines.append("None were held out, so there is no independent error here.")
    lines += ["", *_bands(surrogate), *_hard(surrogate)]
    lines += [*_elements(surrogate), *_curves(surrogate), *_numbers(surrogate)]
    lines += ["", "## Data", "", f"- dataset checksum (SHA-256): `{record.checksum or 'not recorded'}`"]
    lines += [f"- {_plain(key)}: {_plain(value)}" for key, value in record.attributes.items()]
    lines += [
        f"- {len(record.fitted_runs)} training runs: {_runs(record.fitted_runs)}",
        *(
            [f"- {len(record.validation_runs)} validation runs: {_runs(record.validation_runs)}"]
            if record.validation_runs
            else []
        ),
        f"- {len(record.held_out_runs)} runs kept away: {_runs(record.held_out_runs)}",
        "",
    ]
    if record.notes:
        lines += ["## Notes", "", *(f"- {_plain(note)}" for note in record.notes), ""]
    if record.choice:
        how = "by cross-validation" if by_folds else "on validation runs"
        lines += [f"Chosen {how}:", "", *(f"- {k}: {v}" for k, v in record.choice.items()), ""]
    lines += [
        "## Settings",
        "",
        "```yaml",
        yaml.safe_dump(settings.as_dict(), sort_keys=False).rstrip(),
        "```",
        "",
        "Versions: " + ", ".join(f"{k} {v}" for k, v in record.versions.items()) + ".",
        "",
    ]
    return "\n".join(lines)


def _seeds(surrogate: Surrogate) -> str:
    seeds = surrogate.seeds
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(map(str, seeds))}"


def _members(surrogate: Surrogate) -> list[str]:
    """What the mean of several trainings is worth beside each of them."""
    record = surrogate.record
    if not record.members:
        return []
    levels = list(surrogate.level_names)
    rows = [
        (f"seed {seed}", *(f"{100 * errors[name]:.3f}" for name in levels)) for seed, errors in record.members.items()
    ]
    mean = ("mean of all", *(f"{100 * record.errors[name]:.3f}" for name in levels))
    return [
        "## Trainings",
        "",
        f"Every prediction is the mean of those of {len(surrogate.seeds)} trainings that differ by their seed alone; epochs above",
        "are the first one's, seconds those of all. Errors (cm) on the same runs as below, of each alone and of the mean:",
        "",
        *_table(("training", *levels), [*rows, mean]),
        "",
    ]


def _elements(surrogate: Surrogate) -> list[str]:
    """Errors of removal and of results on elements, on training runs that folds left out."""
    out: list[str] = []
    removal = surrogate.removal
    if removal is not None:
        out += ["", "## Removal of elements", ""]
        out.append(
            f"{len(removal.faces)} elements disappear in some training run or its image. How likely each is gone is predicted from: "
            f"{', '.join(removal.terms)}."
        )
        rows = [
            (name, *("-" if v != v else f"{v:.3g}" for v in (score.precision, score.recall, score.loss)))
            for name, score in removal.scores.items()
        ]
        if rows:
            out += ["", "On training runs that folds left out, called gone above a probability of one half:", ""]
            out += _table(("what", "precision", "recall", "logarithmic loss"), rows)
    for name, known in surrogate.fields.items():
        out += [
            "",
            f"## {_plain(name)}",
            "",
            f"On elements, {known.modes.shape[1]} modes; unit {_plain(known.unit or '1')}.",
        ]
        if known.errors:
            out += ["", "Mean absolute error over living elements of training runs that folds left out:", ""]
            out += _table(("with", "error"), [(what, f"{error:.4g}") for what, error in known.errors.items()])
    return out


def _curves(surrogate: Surrogate) -> list[str]:
    """Errors of time histories on training runs that folds left out."""
    rows = []
    for name, curve in surrogate.curves.items():
        size = float(np.sqrt(np.square(curve.values @ curve.modes).mean()))
        error = curve.errors.get("chosen", float("nan"))
        rows.append((name, curve.unit or "1", *("-" if v != v else f"{v:.4g}" for v in (error, size))))
    if not rows:
        return []
    return [
        "",
        "## Histories",
        "",
        "Root mean square over samples and runs of the error on training runs that folds left out, and of the channel itself:",
        "",
        *_table(("channel", "unit", "error", "size"), rows),
    ]


def _numbers(surrogate: Surrogate) -> list[str]:
    """How well numbers by formula are told of runs that were left out."""
    rows = []
    for name, told in surrogate.record.numbers.items():
        errors = np.abs(list(told["errors"].values()))
        mean = f"{errors.mean():.4g}" if len(errors) else "-"
        size = "-" if told["size"] is None else f"{told['size']:.4g}"
        rows.append((name, str(told["formula"]), str(told["unit"]), str(len(errors)), mean, size))
    if not rows:
        return []
    return [
        "",
        "## Numbers by formula",
        "",
        "Mean absolute error on runs that were left out, and mean size:",
        "",
        *_table(("number", "formula", "unit", "runs", "error", "size"), rows),
    ]


def _physics(surrogate: Surrogate) -> list[str]:
    """What the surrogate knows before the first run, and what it was worth."""
    physics = surrogate.record.physics
    if not physics:
        return []
    mirror = surrogate.registration.symmetry.mirror
    out = ["## Known before the first run", ""]
    out += [f"- {name}: {told}" for name, told in physics.items() if isinstance(told, str)]
    if mirror is not None:
        out.append(f"- {mirror.told}")
    errors = physics.get("errors") or {}
    if errors:
        out += [
            "",
            "What each is worth: error of a process over whole runs in cross-validation over the training runs, on all modes.",
            "",
            *_table(("with", "error (cm)"), [(k, f"{100 * v:.3f}") for k, v in errors.items()]),
        ]
    return [*out, ""]


def _bands(surrogate: Surrogate) -> list[str]:
    if not surrogate.bands:
        return ["There is no band around predictions: there were too few runs to judge it by (see the notes)."]
    rows = []
    for name, number in surrogate.level_names.items():
        for (k, lifted), band in surrogate.bands.items():
            if k == number:
                width = band.half_width(0.9, band.time)
                rows.append(
                    (
                        f"{name}{', lifted to the full mesh' if lifted else ''}",
                        f"{100 * width.mean():.2f}",
                        str(band.runs),
                    )
                )
    return [
        "Band that holds nine of ten true nodes around the predicted ones, calibrated on runs the model had not seen; wider where",
        "the model itself knows less (`half_width` of `crashkit predict --band`). Of a typical run:",
        "",
        *_table(("prediction", "mean half-width (cm)", "runs"), rows),
    ]


def _hard(surrogate: Surrogate) -> list[str]:
    """Where neighbouring training runs differ by more than their distance explains."""
    found = surrogate.hard_runs()
    if not found:
        return []
    record = surrogate.record
    names = record.ranges.names
    rows = []
    for run, (error, times) in found.items():
        place = record.fitted_runs.index(run)
        values = (f"{record.parameters[name][place]:.4g}" for name in names)
        rows.append((run, *values, f"{100 * error:.2f}", f"{times:.1f}"))
    units = (f"{name} ({unit})" for name, unit in zip(names, record.ranges.units, strict=True))
    return [
        "",
        "## Near a fold",
        "",
        "Runs that were predicted far worse than the model expected when they were left out, and so were others near them:",
        "there the structure goes one way or another, and neighbouring runs differ by more than their distance explains.",
        "Queries near them get a wider band and a warning. Look at these runs in ParaView; compute further runs there.",
        "",
        *_table(("run", *units, "error left out (cm)", "times the typical"), rows),
    ]


def _level_row(surrogate: Surrogate, name: str, number: int) -> tuple[str, ...]:
    kept = surrogate.record.fits.get(number)
    epochs = str(kept.epochs) if kept is not None and kept.epochs else "-"
    return (
        name,
        str(number),
        str(surrogate.graphs.n_nodes(number)),
        str(surrogate.n_latent(number)),
        str(surrogate.n_parameters(number)),
        epochs,
        str(kept.best_epoch) if kept is not None and kept.best_epoch else "-",
        f"{kept.seconds:.1f}" if kept is not None else "-",
        kept.status if kept is not None else "-",
    )


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    head = list(head)
    return [
        "| " + " | ".join(map(_plain, head)) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(map(_plain, row)) + " |" for row in rows),
    ]


def _runs(names: tuple[str, ...]) -> str:
    return ", ".join(map(_plain, names)) if names else "none"


def _plain(text: str) -> str:
    """`text` on one line, with nothing that Markdown would take for a table, code or HTML: names come from strangers."""
    return " ".join(str(text).split()).replace("|", "\\|").replace("`", "\\`").replace("<", "&lt;")
