"""One HTML file in which stored models run: sliders, the structure in 3-D, curves; no server, no network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate


def explore(
    models: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    title: str = "",
    share: float = 0.9,
    overwrite: bool = False,
) -> Path:
    """Write a page with sliders for stored models.

    Parameters
    ----------
    models
        One model folder or several, trained on the same campaign.
    output
        The HTML file.
    title
        Heading of the page; default: the names of the models.
    share
        Of nodes and states that the band should hold.
    overwrite
        Replace a file that is there.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        Where `output` is there already or cannot be written.
    DataError
        Where a model was stored without its mesh, or the models are of different meshes.
    SurrogateError
        For a kind of model that has no form for a browser.

    Notes
    -----
    The page does the arithmetic itself: `await window.crashkit.predict(parameters, time, level)` gives what
    `crashkit.predict` gives, to rounding.
    """
    from crashkit.extras import need

    need("a page with sliders", "train")
    from crashkit.errors import DataError, OutputError
    from surrogates.storage.presence import require_model_folder

    output = Path(output)
    if output.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{output}: a page is written; expected a name that ends in .html")
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: is there already; replace it with --overwrite, or choose another name")
    folders = [Path(models)] if isinstance(models, (str, Path)) else [Path(m) for m in models]
    for folder in folders:
        require_model_folder(folder)
    import numpy as np

    from crashkit.api.predict import load_model
    from data_schema.replace import beside
    from evaluation.explorer.page import BrowserModel, ExplorerMesh, explorer_page
    from surrogates.storage.browser import browsable

    loaded = [load_model(folder).surrogate for folder in folders]
    first = loaded[0]
    if first.points is None or first.faces is None:
        raise DataError(f"{folders[0]}: the model was stored without its mesh; train it again from a dataset")
    for folder, other in zip(folders, loaded, strict=True):
        if not _same_mesh(first, other):
            raise DataError(f"{folder}: is of another mesh than {folders[0]}; a page shows models of one campaign")
    browser, largest = [], 0.0
    for k, (folder, surrogate) in enumerate(zip(folders, loaded, strict=True)):
        found = browsable(surrogate, folder.resolve().name, f"m{k}_", share)
        browser.append(BrowserModel({**found.about, "parameters": _parameters(surrogate)}, found.arrays, found.steps))
        largest = max(largest, _largest(surrogate))
    mesh = ExplorerMesh(np.asarray(first.points, np.float64), first.faces)
    runs = len(first.record.fitted_runs)
    page = explorer_page(
        title or " and ".join(folder.resolve().name for folder in folders), browser, mesh,
        about=f"{runs} training runs of {first.record.attributes.get('dataset', 'a dataset')}, {len(first.points)} nodes",
        note=(
            "The predictions are computed in this page. A model says nothing reliable outside the trained ranges; marks above "
            "the sliders are training runs. Band: on average over left-out runs that share of nodes and states lies as near."
        ),
        largest=largest, axis=_axis(first), share=share,
    )  # fmt: skip
    try:
        with beside(output) as new:
            new.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{output}: cannot be written ({error.strerror or error}); choose another place with -o"
        ) from error
    return output


def _same_mesh(one: Surrogate, other: Surrogate) -> bool:
    """Whether two models are of the same nodes and faces; positions may differ by what files round."""
    import numpy as np

    if one.points is None or other.points is None or one.faces is None or other.faces is None:
        return False
    if one.points.shape != other.points.shape or not np.array_equal(one.faces, other.faces):
        return False
    size = np.ptp(one.points, axis=0).max()
    return bool(np.allclose(one.points, other.points, rtol=0.0, atol=1e-6 * size))


# Units as people read them on a page: unit in the model -> (unit, factor).
_SHOWN = {"Pa": ("MPa", 1e-6), "m s-1": ("m/s", 1.0), "m": ("mm", 1e3), "degree": ("°", 1.0), "kg m-3": ("kg/m³", 1.0)}


def _parameters(surrogate: Surrogate) -> list[dict[str, Any]]:
    ranges = surrogate.record.ranges
    out = []
    for k, (name, unit) in enumerate(zip(ranges.names, ranges.units, strict=True)):
        shown, factor = _SHOWN.get(unit, (unit if unit != "1" else "", 1.0))
        values = surrogate.record.parameters.get(name, ())
        out.append(
            {
                "name": name, "label": name.replace("_", " "), "unit": shown, "factor": factor,
                "low": float(ranges.low[k]), "high": float(ranges.high[k]), "runs": [float(v) for v in values],
            }
        )  # fmt: skip
    return out


def _middle(surrogate: Surrogate) -> Any:
    ranges = surrogate.record.ranges
    return (ranges.low + ranges.high) / 2


def _largest(surrogate: Surrogate) -> float:
    """A displacement, m, that few predictions exceed: the largest at the upper end of every range."""
    import numpy as np

    number = min(surrogate.level_names.values())
    end = surrogate.record.time[-1:]
    ranges = surrogate.record.ranges
    found = [surrogate.predict(p, end, number) for p in (_middle(surrogate), ranges.high)]
    return float(max(np.linalg.norm(u, axis=-1).max() for u in found))


def _axis(surrogate: Surrogate) -> int:
    """The direction in which the structure moves most."""
    import numpy as np

    number = min(surrogate.level_names.values())
    u = surrogate.predict(_middle(surrogate), surrogate.record.time[-1:], number)
    return int(np.abs(u[0]).mean(axis=0).argmax())
