"""What an engineer asks first about a dataset, a model folder or a report, as plain values in SI units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashkit.errors import DataError
from data_schema.progress import Progress, silent

if TYPE_CHECKING:
    import xarray as xr

    from surrogates.record import Record
    from surrogates.storage.outline import Outline
    from surrogates.surrogate import Surrogate

# How the record names what coarse runs are worth on a level.
_ON = "coarse runs on "


def kind_of(path: str | Path) -> Literal["model", "report", "dataset"]:
    """What is stored at `path`, by the file that each kind of folder has; anything else is taken for a dataset."""
    path = Path(path)
    if (path / "model.json").exists():
        return "model"
    return "report" if (path / "report.json").exists() else "dataset"


def describe(
    path: str | Path, *, card: str | Path | None = None, overwrite: bool = False, report: Progress = silent
) -> dict[str, Any]:
    """The facts about a dataset, a model folder or a report as plain values, in SI units.

    Parameters
    ----------
    card
        Also write a data card of a dataset into this folder; its page is then in what is returned as `report`.
    overwrite
        Replace a data card that is there.
    report
        Called with (what, runs done, runs, note) while the card is made.

    Raises
    ------
    ReadError
        Where nothing is there, or it is damaged.
    DataError
        Where a card is asked of something else than a dataset.
    OutputError
        Where the card cannot be written.
    """
    path = Path(path)
    kind = kind_of(path)
    if card is not None and kind != "dataset":
        raise DataError(f"{path}: is a {kind}, and a data card describes a dataset; give the path of a dataset")
    if kind == "model":
        from crashkit.extras import need

        need("describing a model", "train")
        from surrogates.storage.outline import outline

        return describe_model(outline(path), path)
    if kind == "report":
        return describe_report(path)
    from crashkit.dataset import open_dataset, reading_dataset

    with open_dataset(path, chunks=None, indexes=card is not None) as dataset:
        with reading_dataset(path):
            found = describe_dataset(dataset, path)
        if card is not None:
            found["report"] = _write_card(dataset, path, Path(card), overwrite, report)
    return found


def _write_card(dataset: xr.Dataset, path: Path, card: Path, overwrite: bool, report: Progress) -> Path:
    from crashkit.api.reference import read_reference
    from crashkit.extras import need
    from crashkit.output import refuse_earlier

    need("a data card", "report")
    from evaluation.report.datacard import write_card

    if not overwrite:
        refuse_earlier(card, "card.json", "data card", option="--report")
    runs = dataset.sizes["sim"]
    return write_card(
        read_reference(str(path), dataset), card, about={"Dataset": path.name},
        done=lambda run: report("runs", run + 1, runs, ""),
    )  # fmt: skip


def describe_dataset(dataset: xr.Dataset, path: Path) -> dict[str, Any]:
    """The facts about the dataset at `path` in SI units; reads the displacements once, block by block.

    Sums are NumPy's: xarray's own import Dask, to ask whether an array is Dask's, and that takes as long as all the rest.

    Raises
    ------
    ReadError
        If values cannot be read.
    """
    from data_schema import fields, parameters, table_unit

    size = dataset.sizes
    part_faces = _counts(dataset, "face_part")
    part_cells = _counts(dataset, "cell_part")
    known = dataset.attrs
    return {
        "path": path,
        "bytes_on_disk": _bytes(path),
        "title": known.get("title"),
        "solver": known.get("solver"),
        "units_read": known.get("units_read"),
        "runs": size["sim"],
        "incomplete_runs": [str(n) for n in dataset["sim"].values[~dataset["complete"].values]] if "complete" in dataset else [],
        "marked_runs": {
            str(n): str(note) for n, note in zip(dataset["sim"].values, dataset["quality_note"].values, strict=True) if note
        } if "quality_note" in dataset else {},
        "states": size["time"],
        "time_begin": float(dataset["time"].values[0]),
        "time_end": float(dataset["time"].values[-1]),
        "alignment_error": float(dataset["alignment_error"].values.max()) if "alignment_error" in dataset else None,
        "nodes": size["node"],
        "faces": size["face"],
        "cells": size.get("cell", 0),
        "one_shape": "sim" not in dataset["reference_position"].dims,
        "parts": [
            {"id": int(number), "name": str(name), "faces": part_faces[k], "cells": part_cells[k]}
            for k, (number, name) in enumerate(zip(dataset["part_id"].values, dataset["part_name"].values, strict=True))
        ],
        "parameters": [
            {
                "name": name,
                "units": str(dataset[name].attrs.get("units", "")),
                "table_units": table_unit(dataset, name)[0],
                "table_factor": table_unit(dataset, name)[1],
                "min": float(dataset[name].values.min()),
                "max": float(dataset[name].values.max()),
            }
            for name in parameters(dataset)
        ],
        "fields": [
            {"name": name, "on": str(dataset[name].dims[2]), "units": str(dataset[name].attrs.get("units", ""))}
            for name in fields(dataset)
        ],
        "erodes": "alive" in dataset or "cell_alive" in dataset,
        "largest_displacement": _largest(dataset),
        "checksum": known.get("checksum"),
        **_levels(path),
    }  # fmt: skip


def _counts(dataset: xr.Dataset, name: str) -> list[int]:
    import numpy as np

    owners = dataset[name].values if name in dataset else np.empty(0, int)
    return [int(n) for n in np.bincount(owners, minlength=dataset.sizes["part"])]


def _largest(dataset: xr.Dataset) -> dict[str, Any]:
    """The largest displacement of all: value (m), run, time (s), node_id; an empty dictionary if none is a number."""
    import numpy as np

    from data_schema.checksum import result_blocks

    best: dict[str, Any] = {}
    displacement = dataset["displacement"].variable  # without coordinates, whose selection imports Dask
    for k, run in enumerate(dataset["sim"].values):
        for first, _, u in result_blocks(displacement.isel(sim=k)):
            squared = np.nan_to_num(np.einsum("tnx,tnx->tn", u, u), nan=-1.0)
            state, node = (int(i) for i in np.unravel_index(int(squared.argmax()), squared.shape))
            value = float(squared[state, node])
            if value >= 0 and value**0.5 > best.get("value", -1.0):
                best = {
                    "value": value**0.5,
                    "run": str(run),
                    "time": float(dataset["time"].values[state]),
                    "node_id": int(dataset["node_id"].values[first + node]),
                }
    return best


def _bytes(path: Path) -> int:
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) if path.is_dir() else path.stat().st_size


def _levels(path: Path) -> dict[str, Any]:
    from crashkit.mesh.store import has_hierarchy, lifting_errors_over, summarize_hierarchy

    if not has_hierarchy(path):
        return {"levels": []}
    return {"levels": list(summarize_hierarchy(path)), "interpolation_errors_over": lifting_errors_over(path)}


def describe_model(outline: Outline, path: Path) -> dict[str, Any]:
    """The facts about the model stored in the folder `path`, by its `outline`."""
    record = outline.record
    ranges = record.ranges
    spans = zip(ranges.names, ranges.units, ranges.written, ranges.low, ranges.high, strict=True)
    return {
        "path": path,
        "bytes_on_disk": _bytes(path),
        "kind": outline.settings.model,
        "preset": outline.settings.preset,
        "created": record.created,
        "seed": record.seed,
        "seeds": list(outline.seeds),
        "crashkit_version": record.versions.get("crashkit"),
        "checksum": record.checksum,
        **{key: str(value) for key, value in record.attributes.items()},
        "training_runs": list(record.fitted_runs),
        "validation_runs": list(record.validation_runs),
        "held_out_runs": list(record.held_out_runs),
        "nodes": outline.nodes,
        "states": len(record.time),
        "time_begin": ranges.time[0],
        "time_end": ranges.time[1],
        "parameters": [
            {"name": n, "units": u, "table_units": t, "table_factor": f, "min": float(a), "max": float(b)}
            for n, u, (t, f), a, b in spans
        ],
        "levels": [
            {
                "model": level.name,
                "level": level.number,
                "nodes": level.nodes,
                "latent": level.latent,
                "parameters": level.parameters,
                "validation_error": record.errors.get(level.name),
                "validation_error_full": record.errors.get(
                    f"{level.name}, lifted to the full mesh", record.errors.get(level.name)
                ),
                "has_band": level.band,
            }
            for level in outline.levels
        ],
        "error_name": record.error_name,
        "choice": record.choice,
        "coarse": record.physics.get("coarse runs", ""),
        "coarse_levels": {
            name.removeprefix(_ON): told for name, told in record.physics.items() if name.startswith(_ON)
        },
        "notes": list(record.notes),
    }


def describe_training(surrogate: Surrogate, output: Path) -> dict[str, Any]:
    """How the training of the model stored in `output` went."""
    record = surrogate.record
    return {
        "output": output, "levels": trained_levels(surrogate), "choice": record.choice,
        "validation_errors_m": record.errors, "training_runs": record.fitted_runs,
        "validation_runs": record.validation_runs, "held_out_runs": record.held_out_runs,
        "seeds": surrogate.seeds, "errors_of_each_seed_m": record.members,
        "physics": record.physics, "coarse": record.coarse, "notes": record.notes,
        "removal": None if surrogate.removal is None else {k: vars(v) for k, v in surrogate.removal.scores.items()},
        "fields": {name: known.errors for name, known in surrogate.fields.items()},
    }  # fmt: skip


def trained_levels(surrogate: Surrogate) -> list[dict[str, Any]]:
    """Each level that was trained: its size, how long that took, and its error on runs that were left out, m."""
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


def what_the_mean_is_worth(surrogate: Surrogate) -> list[str]:
    """For each level the error of the mean of several trainings, and of each alone, cm: a line each."""
    out, record = [], surrogate.record
    for name in surrogate.level_names:
        alone = [100 * errors[name] for errors in record.members.values() if name in errors]
        if alone:
            out.append(
                f"{name}: the mean of {len(alone)} trainings has {100 * record.errors[name]:.2f} cm, each alone "
                f"{min(alone):.2f} to {max(alone):.2f} cm"
            )
    return out


def what_was_chosen(record: Record) -> list[str]:
    """What was put in beforehand and what it was worth, and what was chosen and by what: a line each."""
    out = [f"{name}: {told}" for name, told in record.physics.items() if isinstance(told, str)]
    errors = record.physics.get("errors") or {}
    if errors:
        worth = ", ".join(f"{name} {100 * error:.2f}" for name, error in errors.items())
        out.append(f"worth in cross-validation (cm): {worth}")
    if record.choice:
        by = "on validation runs" if record.validation_runs and not record.physics else "by cross-validation"
        pieces = [f"{k} {v}" for k, v in record.choice.items()]
        several = any("(" in piece for piece in pieces)  # one line for each level
        out += [f"chosen {by}: {line}" for line in (pieces if several else [", ".join(pieces)])]
    return out


def what_is_said_of_elements(surrogate: Surrogate) -> list[str]:
    """Errors of the predicted removal and of results on elements, on left-out runs: one line each."""
    out = []
    removal = surrogate.removal
    if removal is not None and removal.scores:
        told = "; ".join(
            f"{name} {_share(score.precision)} and {_share(score.recall)}" for name, score in removal.scores.items()
        )
        out.append(f"removal ({' and '.join(removal.terms)}), precision and recall in cross-validation: {told}")
    for name, known in surrogate.fields.items():
        unit = "" if known.unit in ("1", "") else f" {known.unit}"
        told = ", ".join(f"{what} {error:.3g}{unit}" for what, error in known.errors.items())
        out += [f"{name}, mean absolute error in cross-validation: {told}"] if told else []
    return out


def _share(value: float) -> str:
    return "-" if value != value else f"{value:.2f}"


def middle(surrogate: Surrogate) -> dict[str, str]:
    """The middle of each parameter's trained range, in the unit of its table."""
    ranges = surrogate.record.ranges
    values = (ranges.low + ranges.high) / 2
    return {n: f"{v / f:.4g}" for n, v, (_, f) in zip(ranges.names, values, ranges.written, strict=True)}


def describe_report(path: Path) -> dict[str, Any]:
    """What stands in the report folder `path`: its own `report.json`.

    Raises
    ------
    ReadError
        Where that is damaged.
    """
    from crashkit.errors import ReadError

    file = path / "report.json"
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(found, dict) or not isinstance(found.get("performance"), list):
            raise ValueError("no table of performance")
    except (OSError, ValueError, RecursionError) as error:
        raise ReadError(
            f"{file}: cannot be read as a report ({error}); make it again with crashkit evaluate"
        ) from error
    return {"path": path, **found}
