"""Which parameters explain positions that were measured on a crashed structure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from crashkit.api.model import Model
    from crashkit.ingestion.measured_points import MeasuredPoints
    from data_schema.progress import Progress
    from surrogates.queries.misfit import Measured, Misfit
    from surrogates.queries.points import AtPoints
    from surrogates.queries.posterior import ParameterPosterior
    from surrogates.surrogate import Surrogate

# More rows add nothing to what errors of the model leave to be known, and the time grows with their square.
_MOST_ROWS = 300
# A place further from the structure than this share of its diagonal is somewhere else.
_FAR = 0.05
# An explanation with less of the posterior is none.
_SHARE = 0.05
# Predictions that a search takes for each free parameter, about; how many are timed; and seconds that are not worth a word.
_PREDICTIONS, _TIMED, _SOON = 10_000, 16, 10.0
# Measured displacements so many times smaller or larger than those of all training runs are of another size; factors
# between units that are taken for one another.
_OTHER, _MISTAKEN = 1.5, (10.0, 0.1, 1000.0, 1e-3, 100.0, 0.01, 25.4, 1 / 25.4)
# Worse explained than all but this share of the training runs by their own parameters.
_RARE = 0.02


@dataclass(frozen=True)
class Inversion:
    """What measured positions say about the parameters.

    Attributes
    ----------
    names, units
        Parameters of the model, and the units in which tables write them.
    posterior
        Samples and optima, in the model's units; see `surrogates.queries.posterior.ParameterPosterior`.
    residual
        One row a measured number: row of the table, time (s), component, measured, explained (by the best parameters),
        noise (standard deviation, the model's and the measurement's): m.
    warnings
        What to know before the answer is used.
    notes
        What was assumed.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    factors: tuple[float, ...]
    posterior: ParameterPosterior
    residual: pd.DataFrame
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    _misfit: Misfit

    @property
    def best(self) -> dict[str, float]:
        """The most likely parameters, in the model's units (SI)."""
        return dict(zip(self.names, map(float, self.posterior.best), strict=True))

    def table(self, share: float = 0.9) -> pd.DataFrame:
        """One row a parameter, in the unit of its table: most likely value, mean, standard deviation, bounds of `share`."""
        import pandas as pd

        low, high = self.posterior.interval(share)
        samples, scale = self.posterior.samples, 1 / _array(self.factors)
        return pd.DataFrame(
            {
                "unit": list(self.units),
                "best": self.posterior.best * scale,
                "mean": samples.mean(axis=0) * scale,
                "deviation": samples.std(axis=0) * scale,
                "low": low * scale,
                "high": high * scale,
                "range_low": self.posterior.low * scale,
                "range_high": self.posterior.high * scale,
            },
            index=pd.Index(self.names, name="parameter"),
        )

    def explanations(self) -> pd.DataFrame:
        """Parameters of every explanation, in the units of the table, and the share of the posterior it has."""
        import numpy as np
        import pandas as pd

        found = self.posterior.explanations
        values = np.array([e.parameters for e in found]) / _array(self.factors)
        out = pd.DataFrame(values, columns=[_head(n, u) for n, u in zip(self.names, self.units, strict=True)])
        out.insert(0, "run", [f"explanation_{k}" for k in range(len(found))])
        out["share"] = [e.share for e in found]
        return out

    def contains(self, parameters: Mapping[str, Any], share: float = 0.9) -> bool:
        """Whether `parameters` lie in the region of the highest density that holds `share` of the posterior."""
        from crashkit.api.parameters import parameter_values

        values = parameter_values(parameters, self._misfit.points.surrogate.record.ranges)
        return bool(self._misfit(values[None])[0] >= self.posterior.threshold(share))

    def figure(self) -> Figure:
        """Distributions of the parameters, each alone and in pairs."""
        import numpy as np

        from evaluation.drawing.pairs import pairs_figure

        p = self.posterior
        free = p.high > p.low
        units = self._misfit.points.surrogate.record.ranges.units
        others = [e.parameters[free] for e in p.explanations[1:] if e.share >= _SHARE]
        return pairs_figure(
            [n for n, f in zip(self.names, free, strict=True) if f],
            [u for u, f in zip(units, free, strict=True) if f],
            p.samples[:, free], p.best[free], p.low[free], p.high[free],
            np.array(others) if others else None,
        )  # fmt: skip

    def save(self, folder: str | Path) -> Path:
        """Write parameters.csv, explanations.csv, samples.csv, residuals.csv and pairs.png into a folder.

        Raises
        ------
        OutputError
            Where the folder holds something else or cannot be written.
        """
        import pandas as pd

        from crashkit.extras import need
        from crashkit.output import complete_folder

        need("the picture of the parameters", "report")
        from evaluation.drawing.style import look

        folder = Path(folder)
        with complete_folder(folder, "explanations.csv") as new:
            self.table().to_csv(new / "parameters.csv", float_format="%.7g")
            self.explanations().to_csv(new / "explanations.csv", index=False, float_format="%.7g")
            heads = [_head(n, u) for n, u in zip(self.names, self.units, strict=True)]
            samples = pd.DataFrame(self.posterior.samples / _array(self.factors), columns=heads)
            samples.to_csv(new / "samples.csv", index_label="run", float_format="%.6g")
            self.residual.to_csv(new / "residuals.csv", index=False, float_format="%.6g")
            with look():
                self.figure().savefig(new / "pairs.png", dpi=150)
        return folder


def invert(
    model: Model | Surrogate | str | Path,
    measured: str | Path | pd.DataFrame,
    *,
    noise: float | str = "1 mm",
    known: Mapping[str, Any] | None = None,
    level: int | None = None,
    seed: int = 0,
    report: Progress | None = None,
) -> Inversion:
    """Which parameters of the model explain measured positions, and how sure that is.

    Parameters
    ----------
    model
        A model, or the folder it is stored in; the training data is not needed.
    measured
        A table of points (CSV, TSV, JSON, XLSX, or a data frame with the same columns): `node`, or the undeformed place
        `x`, `y`, `z`; the measured displacement `ux`, `uy`, `uz` or position `px`, `py`, `pz`; `time` where it is not
        the end. Units in brackets, "ux [mm]"; without, metres and seconds. Empty cells are not measured.
    noise
        Standard deviation of one measured component: m, or text with a unit.
    known
        Parameters that are known, by name, as for `Model.predict`; the others are sought over their trained range.
    level
        Mesh level that predicts; default: the finest one.
    seed
        Of the samples.
    report
        Called with what is done; the first call says about how long the search takes, where that is more than some seconds.

    Returns
    -------
    Inversion
        Samples of the posterior, optima, residuals and warnings.

    Raises
    ------
    ReadError
        For a table that cannot be understood, with its row and column.
    DataError
        For nodes or places the model does not have, times it was not trained on, parameters it does not know.

    Notes
    -----
    The prior is even over the trained range. The model's own error enters as noise of the size of its band: see
    `surrogates.queries.misfit`.
    """
    import numpy as np

    from crashkit.api.predict import model_in_hand
    from crashkit.errors import DataError
    from surrogates.queries.misfit import Misfit
    from surrogates.queries.posterior import posterior
    from surrogates.storage.presence import require_model_folder

    if isinstance(model, (str, Path)):
        require_model_folder(model)
    table = _read(measured)
    deviation = _length(noise)
    surrogate = model_in_hand(model).surrogate
    ranges = surrogate.record.ranges
    points, values, rows, notes = _placed(surrogate, table, deviation, level)
    low, high = ranges.low.copy(), ranges.high.copy()
    for name, value in known_values(known or {}, surrogate).items():
        low[ranges.names.index(name)] = high[ranges.names.index(name)] = value
    if not (high > low).any():
        raise DataError("all parameters are known; leave at least one to be found")
    misfit = Misfit(points, values, high > low)
    if not misfit.banded:
        notes.append(
            "the model has no band (too few runs); its error is taken from a regression of its own predictions"
        )
    if report is not None:
        report(f"searching the range{_duration(misfit)}", 0, 0, "")
    first = posterior(misfit, low, high, samples=500, seed=seed, starts=3)
    misfit = misfit.sized(first.best)
    found = posterior(misfit, low, high, seed=seed)
    residual = _residual(table, values, rows, misfit, found.best)
    factors = tuple(factor for _, factor in ranges.written)
    units = tuple("" if unit == "1" else unit for unit, _ in ranges.written)
    warnings = [
        *(
            f"{sentence}: it is held there, where the model extrapolates"
            for sentence in _known_outside(surrogate, known)
        ),
        *_another_size(misfit),
        *_warnings(found, misfit, residual, ranges.names, units, np.array(factors)),
    ]
    return Inversion(
        tuple(ranges.names), units, factors, found, residual, tuple(warnings), tuple(notes), misfit
    )  # fmt: skip


def _read(measured: str | Path | pd.DataFrame) -> MeasuredPoints:
    import tempfile

    from crashkit.ingestion.measured_points import read_measured_points

    if isinstance(measured, (str, Path)):
        return read_measured_points(Path(measured))
    with tempfile.TemporaryDirectory(prefix="crashkit-") as folder:
        path = Path(folder) / "points.csv"
        measured.to_csv(path, index=False)
        return read_measured_points(path)


def _length(noise: float | str) -> float:
    """The standard deviation `noise`, m: a number in m, or a text with its unit."""
    from crashkit.errors import DataError
    from data_schema.units import UnknownUnits, length, number_and_unit

    text = noise if isinstance(noise, str) else f"{float(noise)!r} m"
    if (alone := number_and_unit(text)) and not alone[1] and alone[0]:
        raise DataError(f"noise {text}: in which unit? write for example '{text} mm'")
    try:
        return length(text)
    except UnknownUnits as error:
        raise DataError(f"noise: {error}") from error


def known_values(given: Mapping[str, Any], surrogate: Surrogate) -> dict[str, float]:
    """Values, in the model's units, of the parameters that are given, by name and with units as for `Model.predict`."""
    from crashkit.api.parameters import parameter_values

    ranges = surrogate.record.ranges
    middle = dict(zip(ranges.names, map(float, (ranges.low + ranges.high) / 2), strict=True))
    values = parameter_values({**middle, **given}, ranges)
    return {n: float(v) for n, v in zip(ranges.names, values, strict=True) if n in given}


def _placed(
    surrogate: Surrogate, table: MeasuredPoints, noise: float, level: int | None
) -> tuple[AtPoints, Measured, NDArray[np.int64], list[str]]:
    """The model at the measured points, what was measured there, the row of each number, and what was assumed."""
    import numpy as np
    from scipy import sparse

    from crashkit.errors import DataError
    from crashkit.mesh.locate import node_weights
    from surrogates.queries.misfit import Measured
    from surrogates.queries.points import AtPoints

    notes = []
    if table.without_unit:
        notes.append(f"{', '.join(table.without_unit)}: no unit is given; taken as metres (time: seconds)")
    if surrogate.points is None or surrogate.faces is None:
        raise DataError("the model was stored without its mesh; train it again from a dataset")
    chosen = np.arange(len(table.row))
    if len(chosen) > _MOST_ROWS:
        chosen = np.unique(np.linspace(0, len(chosen) - 1, _MOST_ROWS).astype(int))
        notes.append(f"{len(chosen)} of the {len(table.row)} rows are used, evenly over the table")
    by_node = table.node[chosen] >= 0
    where = sparse.lil_matrix((len(chosen), surrogate.graphs.n_full))
    if by_node.any():
        numbers = np.arange(1, surrogate.graphs.n_full + 1) if surrogate.labels is None else surrogate.labels.node_id
        order = np.argsort(numbers)
        at = np.clip(np.searchsorted(numbers, table.node[chosen], sorter=order), 0, len(numbers) - 1)
        index = order[at]
        wrong = np.flatnonzero(by_node & (numbers[index] != table.node[chosen]))
        if len(wrong):
            raise DataError(
                f"{table.path}: row {table.row[chosen[wrong[0]]]}: node {table.node[chosen[wrong[0]]]} is none of the model, "
                f"whose nodes are {numbers.min()} to {numbers.max()}"
            )
        where[np.flatnonzero(by_node), index[by_node]] = 1.0
    size = float(np.linalg.norm(np.ptp(surrogate.points, axis=0)))
    if not by_node.all():
        places = table.place[chosen[~by_node]]
        weights, distance = node_weights(places, surrogate.points, surrogate.faces)
        worst = int(distance.argmax())
        if distance[worst] > _FAR * size:
            raise DataError(
                f"{table.path}: row {table.row[chosen[~by_node][worst]]}: the place {places[worst].round(4).tolist()} m is "
                f"{100 * distance[worst]:.1f} cm away from the undeformed structure; check units and coordinate system"
            )
        where[np.flatnonzero(~by_node)] = weights
    where = sparse.csr_matrix(where)
    base = np.where(by_node[:, None], where @ surrogate.points, table.place[chosen])
    moved = np.where(np.isfinite(table.position[chosen]), table.position[chosen] - base, table.displacement[chosen])
    if np.nanmax(np.abs(moved)) > 100 * size:
        raise DataError(
            f"{table.path}: a point moved {np.nanmax(np.abs(moved)):.3g} m, and the structure is {size:.2g} m long; "
            "state the units of the columns, such as ux [mm]"
        )
    first, last = surrogate.record.ranges.time
    time = np.where(np.isfinite(table.time[chosen]), table.time[chosen], last)
    beyond = np.flatnonzero((time < first - 1e-9) | (time > last * (1 + 1e-9)))
    if len(beyond):
        raise DataError(
            f"{table.path}: row {table.row[chosen[beyond[0]]]}: time {time[beyond[0]]:g} s; the model was trained from "
            f"{first:g} to {last:g} s"
        )
    times, state = np.unique(np.clip(time, first, last), return_inverse=True)
    place, component = np.nonzero(np.isfinite(moved))
    measured = Measured(
        moved[place, component], np.full(len(place), noise), state[place].astype(np.int64), place.astype(np.int64),
        component.astype(np.int64),
    )  # fmt: skip
    return AtPoints(surrogate, where, times, level), measured, chosen[place], notes


def _residual(
    table: MeasuredPoints, values: Measured, rows: NDArray[np.int64], misfit: Misfit, best: NDArray[np.float64]
) -> pd.DataFrame:
    import numpy as np
    import pandas as pd

    return pd.DataFrame(
        {
            "row": table.row[rows],
            "node": table.node[rows],
            "time (s)": misfit.points.time[values.state],
            "component": np.array(list("xyz"))[values.component],
            "measured (m)": values.value,
            "explained (m)": misfit.predicted(best[None])[0],
            "noise (m)": np.hypot(values.deviation, misfit.size * misfit.model_error),
        }
    )


def _duration(misfit: Misfit) -> str:
    """About how long the search takes, in words, by the time of some predictions; empty for some seconds."""
    import time

    some = misfit.runs[:_TIMED]
    started = time.perf_counter()
    misfit.predicted(some)
    seconds = (time.perf_counter() - started) / len(some) * _PREDICTIONS * int(misfit.free.sum())
    if seconds < _SOON:
        return ""
    return f", about {seconds / 60:.0f} min" if seconds > 90 else f", about {seconds:.0f} s"


def _known_outside(surrogate: Surrogate, known: Mapping[str, Any] | None) -> list[str]:
    """A sentence for each known parameter beyond its trained range."""
    import numpy as np

    ranges = surrogate.record.ranges
    values = (ranges.low + ranges.high) / 2
    for name, value in known_values(known or {}, surrogate).items():
        values[ranges.names.index(name)] = value
    return list(ranges.beyond(values, np.array(ranges.time)).values())


def _another_size(misfit: Misfit) -> list[str]:
    """A sentence where the structure of no training run moves about as far at the measured points as was measured."""
    import numpy as np

    def size(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sqrt(np.square(values).mean(axis=-1)))

    ours, theirs = float(size(misfit.measured.value)), size(misfit.predicted(misfit.runs))
    low, high = float(theirs.min()) / _OTHER, float(theirs.max()) * _OTHER
    if low <= ours <= high or not ours:
        return []
    fits = [f for f in _MISTAKEN if low * _OTHER <= ours * f <= high / _OTHER]
    hint = f"; {fits[0]:g} times as much would fit, so a wrong unit is likely" if fits else ""
    return [
        f"measured displacements are {100 * ours:.3g} cm (root mean square), those of the training runs at these points "
        f"{100 * theirs.min():.3g} to {100 * theirs.max():.3g} cm{hint}: check the units of the columns"
    ]


def _warnings(
    found: ParameterPosterior,
    misfit: Misfit,
    residual: pd.DataFrame,
    names: tuple[str, ...],
    units: tuple[str, ...],
    factors: NDArray[np.float64],
) -> list[str]:
    out = []
    off = (residual["measured (m)"] - residual["explained (m)"]).abs()
    place = int((off / residual["noise (m)"]).to_numpy().argmax())
    worst = residual.iloc[place]
    if misfit.rarity(found.best) < _RARE:
        out.append(
            "no parameters within the trained range explain the measurement: it is further off than the training runs are "
            f"from themselves (largest at row {worst['row']}, {worst['component']}: {100 * off.iloc[place]:.1f} cm, where "
            f"{100 * worst['noise (m)']:.1f} cm are usual); check units, coordinate system, time and node numbers"
        )
    told = [e for e in found.explanations if e.share >= _SHARE]
    if len(told) > 1:
        texts = (
            ", ".join(
                f"{n} {v / f:.4g} {u}".rstrip() for n, v, f, u in zip(names, e.parameters, factors, units, strict=True)
            )
            for e in told
        )
        shares = (f"({100 * e.share:.0f} %) {text}" for e, text in zip(told, texts, strict=True))
        out.append(f"{len(told)} explanations: {'; '.join(shares)}; more or other points may distinguish them")
    for k in found.at_edge().nonzero()[0]:
        edge = found.low[k] if found.best[k] - found.low[k] < found.high[k] - found.best[k] else found.high[k]
        out.append(
            f"{names[k]} is at the edge of the trained range ({edge / factors[k]:.4g} {units[k]}".rstrip()
            + "); the truth may lie beyond it, where the model knows nothing"
        )
    low, high = found.interval()
    aside = [n for n, b, lo, hi in zip(names, found.best, low, high, strict=True) if not lo <= b <= hi]
    if aside:
        out.append(
            f"{', '.join(aside)}: the most likely value lies outside the 90 % interval, since the distribution is lopsided or "
            "has several tops (pairs.png shows it); do not use the most likely value alone"
        )
    wide = [n for n, w in zip(names, found.hardly_told(), strict=True) if w]
    if wide:
        out.append(f"{', '.join(wide)}: hardly determined by these points; nearly the whole range explains them")
    return out


def _array(values: tuple[float, ...]) -> NDArray[np.float64]:
    import numpy as np

    return np.array(values, np.float64)


def _head(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name
