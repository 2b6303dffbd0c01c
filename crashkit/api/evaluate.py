"""Compare stored models on test runs, and write the report and the ParaView files."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashkit.display import watched
from data_schema.progress import Progress

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

    from crashkit.api._predicted import FormulaMesh
    from crashkit.api.model import Model as Trained
    from crashkit.api.source import Source
    from crashkit.mesh.levels import Hierarchy
    from crashkit.selection import WhichRuns
    from data_schema.levels import Level
    from evaluation.comparison.beside import Beside
    from evaluation.comparison.predictor import ComparedModel
    from evaluation.comparison.reference import Reference
    from evaluation.comparison.result import Evaluation
    from evaluation.comparison.scoring import RunScores
    from evaluation.comparison.sensors import Sensors
    from evaluation.measures.formula import Formula
    from surrogates.surrogate import Surrogate

    GivenModel = Trained | Surrogate | str | Path

# Largest difference of weights below which two maps to the full mesh are the same: stored ones are rounded.
_SAME_WEIGHT = 1e-5


def evaluate(
    dataset: str | Path | xr.Dataset,
    models: GivenModel | Sequence[GivenModel],
    output: str | Path | None = None,
    *,
    test: WhichRuns | None = None,
    hierarchy: Hierarchy | None = None,
    write_vtu: bool = False,
    write_vtkhdf: bool = False,
    vtk_runs: WhichRuns | None = None,
    probes: Sequence[int] | None = None,
    intrusion: tuple[str, str] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    seeds_as_spread: bool = True,
    overwrite: bool = False,
    report: Progress | None = None,
    progress: bool | Literal["auto"] = "auto",
) -> Evaluation:
    """Compare models on runs none of them has seen, and write everything into the folder `output`.

    The folder appears under its name when it is complete. Peak memory is one run a worker.

    Parameters
    ----------
    dataset
        Path of a crash dataset, or the dataset in hand: all runs, or a selection with training and test runs.
    models
        One or several: as `crashkit.train` and `crashkit.load_model` return them, or folders. Those that differ only
        in their seed become one row with its spread.
    output
        Folder for the report; without it nothing is written, and the numbers are in what is returned.
    test
        Test runs: names, or a selection such as "27:36"; default: those that all the models hold out, and where the
        models hold out none, the runs of a dataset in hand that no model has seen.
    hierarchy
        Mesh hierarchy of a dataset in memory, as `crashkit.coarsen(dataset)` returns it.
    write_vtu, write_vtkhdf
        Also write truth, prediction and error for ParaView, as PVD + VTU or as VTKHDF.
    vtk_runs
        The runs written so: names or places, or a selection such as "27:36"; default: the worst and the median run of the best model.
    probes
        The solver's numbers of nodes whose histories are compared; default: four spread over the structure.
    intrusion
        Name of a part and a direction (x, -x, y, -y, z or -z); default: the whole structure, against its motion.
    workers, scheduler
        Processes that share the runs; or the address of a Dask scheduler, which is used instead.
    seeds_as_spread
        Whether models that differ only in their seed become one row.
    overwrite
        Replace an earlier report in `output`.
    report
        Called with (what, steps done, steps in all or 0, note).
    progress
        Show a line of progress in a notebook; "auto": where this is one.

    Raises
    ------
    EvaluationError
        Where the comparison would not be honest, or the models do not fit the data.
    DataError, ReadError, ModelFolderError
        Where files are not what they should be.
    OutputError
        Where `output` cannot be written.
    """
    from crashkit.extras import need

    need("evaluating models", "train", "report")
    from crashkit.output import check_folder, refuse_earlier
    from crashkit.presence import require_dataset
    from surrogates.storage.presence import require_model_folder

    if output is not None:
        check_folder(Path(output), "report.json")
        if not overwrite:
            refuse_earlier(Path(output), "report.json", "report")
    if isinstance(dataset, (str, Path)):
        require_dataset(dataset)
    for folder in _folders(models):
        require_model_folder(folder)
    from crashkit.api.source import source_of
    from crashkit.parallel import as_finished
    from evaluation.comparison.result import compare, decompose
    from evaluation.comparison.sensors import choose_sensors
    from evaluation.comparison.split import agree_on_split, entries
    from evaluation.errors import EvaluationError
    from evaluation.figures import kinds
    from evaluation.figures.folds import pair
    from evaluation.report.files import default_runs, write_run
    from evaluation.report.report import write_report

    tell = watched(report, progress)
    formats = [suffix for suffix, wanted in ((".pvd", write_vtu), (".vtkhdf", write_vtkhdf)) if wanted]
    source = source_of(dataset, hierarchy)
    asked = _asked(models)
    reference, stored = _opened(source, asked)
    split = agree_on_split(reference, stored, _test_names(source, reference, stored, test))
    if not split.train:
        none = "test runs alone" if len(split.test) == len(reference.runs) else "none of the runs the models have seen"
        raise EvaluationError(
            f"{source.name}: holds {none}; give the training runs, too, by which the data is described"
        )
    entries(stored, seeds_as_spread)  # refuses what cannot be compared before anything is computed
    shown_runs = None if vtk_runs is None else _places(reference, vtk_runs)
    sensors = choose_sensors(reference, probes, intrusion)
    found = pair(reference, stored)
    two_ways = () if found is None else found[1:]
    with _folder(output) as folder:
        with _counted(tell, "modes of the training runs", len(split.train)) as step:
            last: dict[int, NDArray[np.floating]] = {}

            def keep(run: int, truth: NDArray[np.floating]) -> None:
                if run in two_ways:
                    last[run] = truth[-1].copy()

            pods = decompose(reference, split.train, done=lambda _: step(), watch=keep)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".modes-") as kept:
            scorer = Scorer(source, asked, _keep_modes(pods, Path(kept)), sensors, opened=(reference, stored))
            scored: dict[int, RunScores] = {}
            with _counted(tell, "test runs", len(split.test)) as step:
                for place, scores in as_finished(
                    _score, split.test, scorer, workers=workers, scheduler=scheduler,
                    label=lambda run: f"run {reference.runs[run]}",
                ):  # fmt: skip
                    scored[place] = scores
                    step()
        tell("comparing the models", 0, 0, "")
        result = compare(
            reference, stored, split, seeds_as_spread=seeds_as_spread, pods=pods, scored=[scored[k] for k in sorted(scored)],
            sensors=sensors, context=_context(Path(source.name), reference, stored, split),
        )  # fmt: skip
        result = dataclasses.replace(result, beside=_beside(source, result, tell), last_states=last)
        if formats:
            runs = default_runs(result) if shown_runs is None else shown_runs
            with _counted(tell, "runs for ParaView", len(runs)) as step:
                written = []
                for run in runs:
                    written += write_run(result, run, folder / "vtk", formats)
                    step()
            result = dataclasses.replace(result, files=tuple(written))
        if output is not None:
            with _counted(tell, "figures", len(kinds())) as step:
                write_report(result, folder, done=step)
    _note_bands(asked, result)
    return result


def _note_bands(asked: Sequence[tuple[str, Trained | Path]], result: Evaluation) -> None:
    """Beside each stored model: what share of the test runs its band held, which `predict` tells with later bands."""
    import numpy as np

    from surrogates.storage.tested import BandCheck, note_held

    of_model: dict[int, dict[str, BandCheck]] = {}
    for entry in result.entries:
        for (model, _), predictor, covered in zip(
            entry.keys,
            (result.predictor(entry, k) for k in range(len(entry.keys))),
            result.scores[entry.label].covered,
            strict=True,
        ):
            known = covered[np.isfinite(covered)]
            if len(known):
                of_model.setdefault(model, {})[predictor.name] = BandCheck(float(known.mean()), len(known))
    for model, held in of_model.items():
        given = asked[model][1]
        folder = given if isinstance(given, Path) else given.folder
        if folder is not None:
            note_held(folder, held)


def _beside(source: Source, result: Evaluation, tell: Progress) -> Beside | None:
    """Histories and numbers of the models that have any, on their finest level, against the truth."""
    import numpy as np

    from crashkit.api._predicted import FormulaMesh, GivenRuns
    from crashkit.api.campaign import histories
    from crashkit.api.numbers import half_width, model_formulas, predicted_numbers
    from evaluation.comparison.beside import SHARE, Beside, CurveCompared, NumberCompared
    from evaluation.measures.formula import Value

    asked: dict[str, StoredLevel] = {}
    for entry in result.entries:
        one = result.predictor(entry)
        if not isinstance(one, StoredLevel) or one.level != one.surrogate.number(None):
            continue
        if one.surrogate.curves or one.surrogate.record.numbers:
            asked[entry.label] = one
    if not asked:
        return None
    test, reference = list(result.split.test), result.reference
    with source.opened() as opened:
        time, channels = histories(opened)
    true_curves = {name: (unit, values[test]) for name, unit, values in channels}
    parameters = {label: reference.parameters[test][:, list(one.order)] for label, one in asked.items()}
    numbers: dict[tuple[str, str, str], tuple[Any, dict[str, Any], dict[str, float]]] = {}
    to_measure: dict[tuple[str, str, str], tuple[str, FormulaMesh, Mapping[str, Formula], Formula]] = {}
    for label, one in asked.items():
        formulas, structure = model_formulas(one.surrogate), FormulaMesh.of(one.surrogate)
        said = [predicted_numbers(one.surrogate, p[None]) for p in parameters[label]]
        for k, (name, formula) in enumerate(formulas.items()):
            key = (name, formula.text, said[0][k].unit)
            if key not in numbers:
                numbers[key] = (np.full(len(test), np.nan), {}, {})
                to_measure[key] = (label, structure, formulas, formula)
            errors = list(one.surrogate.record.numbers[name]["errors"].values())
            width = half_width(errors, SHARE)
            numbers[key][1][label] = np.array([float(found[k].values[0]) for found in said])
            numbers[key][2][label] = float("nan") if width is None else width
    for place, run in enumerate(test if to_measure else ()):  # each is read once for all numbers
        tell("numbers of the test runs", place + 1, len(test), "")
        curves = {
            c: Value(values[place : place + 1], ("time",), time, unit or "1")
            for c, (unit, values) in true_curves.items()
        }
        states = reference.displacement(run)[None]
        for key, (label, structure, others, formula) in to_measure.items():
            true = GivenRuns(structure, parameters[label][place : place + 1], reference.time, states, curves)
            numbers[key][0][place] = float(np.asarray(formula.number(true, others).array).ravel()[0])
    curves_compared = []
    for name, (unit, truth) in true_curves.items():
        having = {label: one.surrogate for label, one in asked.items() if name in one.surrogate.curves}
        if not having or time is None:
            continue
        predictions, widths = {}, {}
        for label, surrogate in having.items():
            curve = surrogate.curves[name]
            said_curves = surrogate.predict_curve(name, parameters[label])
            predictions[label] = np.stack([np.interp(time, curve.time, c) for c in said_curves])
            widths[label] = np.full(predictions[label].shape, np.nan)
            if curve.band is not None:
                of_runs = curve.half_width(SHARE, surrogate.registration, parameters[label])
                widths[label] = np.stack([np.interp(time, curve.time, width) for width in of_runs])
        curves_compared.append(CurveCompared(name, unit, time, truth, predictions, widths))
    compared = tuple(NumberCompared(*key, *found) for key, found in numbers.items())
    return Beside(result.test_names, compared, tuple(curves_compared))


def _folder(output: str | Path | None) -> contextlib.AbstractContextManager[Path]:
    """Where results are put together: the folder that becomes `output`, or one that vanishes."""
    from crashkit.output import complete_folder

    return _scratch() if output is None else complete_folder(Path(output), "report.json")


@contextlib.contextmanager
def _scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="crashkit-") as folder:
        yield Path(folder)


def _folders(models: GivenModel | Sequence[GivenModel]) -> list[Path]:
    """Those of `models` that are given as folders."""
    several = [models] if isinstance(models, (str, Path)) or not isinstance(models, Sequence) else models
    return [Path(given) for given in several if isinstance(given, (str, Path))]


def _asked(models: GivenModel | Sequence[GivenModel]) -> tuple[tuple[str, Trained | Path], ...]:
    """Each model with the name that tells it apart; those stored in a folder as that, which travels lightly."""
    from crashkit.api.model import Model as Trained

    several = [models] if isinstance(models, (str, Path)) or not isinstance(models, Sequence) else models
    out: list[tuple[str, Trained | Path]] = []
    for given in several:
        if isinstance(given, (str, Path)):
            out.append((str(given), Path(given)))
            continue
        model = given if isinstance(given, Trained) else Trained(given)
        taken = {name for name, _ in out}
        name = model.name if model.folder is None else str(model.folder)
        names = itertools.chain([name], (f"{name}-{k}" for k in itertools.count(2)))
        out.append((next(n for n in names if n not in taken), model))
    return tuple(out)


def _test_names(
    source: Source, reference: Reference, models: Sequence[ComparedModel], test: WhichRuns | None
) -> Sequence[str] | None:
    """Names of the test runs that were asked for; None to take those that the models hold out."""
    from crashkit.selection import runs_of

    if test is not None:
        listed = isinstance(test, Sequence) and not isinstance(test, str) and all(isinstance(n, str) for n in test)
        return list(map(str, test)) if listed else [reference.runs[k] for k in runs_of(reference.runs, test)]  # type: ignore[arg-type]
    if source.dataset is None:
        return None
    held_out = {name for model in models for name in model.held_out_runs}
    seen = {name for model in models for name in (*model.fitted_runs, *model.tuned_runs)}
    mine = [name for name in reference.runs if (name in held_out if held_out else name not in seen)]
    same = all(set(model.held_out_runs) == held_out for model in models)
    return mine if same else None


def _places(reference: Reference, chosen: WhichRuns) -> list[int]:
    """Which runs are meant. A text without a colon is names or places, never how many to draw at random."""
    from crashkit.selection import runs_of

    if isinstance(chosen, str) and ":" not in chosen:
        chosen = chosen.split(",")
    return runs_of(reference.runs, chosen)


def whole_meshes(result: Evaluation, output: str | Path) -> list[Path]:
    """The files for ParaView in the report folder `output` that show runs on the full mesh, not on the models' levels."""
    folder = Path(output) / "vtk"
    files = sorted((*folder.glob("*.pvd"), *folder.glob("*.vtkhdf"))) if result.files else []
    return [file for file in files if "_level" not in file.stem]


def best_folder(result: Evaluation, models: Sequence[Path]) -> Path:
    """Of the model folders that were compared, the one with the smallest error."""
    best = result.model(result.ranked[0]).name
    return next(folder for folder in models if folder.resolve().name == best)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Sums in one order: how many threads share a product must not decide the last bits of a table."""
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


def _score(run: int, scorer: Scorer) -> RunScores:
    return scorer.scores(run)


@dataclass
class Scorer:
    """Scores runs. Sent to another process it leaves behind what is open, and opens the files there once.

    A dataset or a model in hand travels as it is.
    """

    source: Source
    models: tuple[tuple[str, Trained | Path], ...]
    modes: Mapping[int, str]
    sensors: Sensors
    opened: tuple[Reference, tuple[ComparedModel, ...]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "opened": None}

    def scores(self, run: int) -> RunScores:
        import numpy as np

        from evaluation.comparison.result import default_groups, predictors_of
        from evaluation.comparison.scoring import score_run

        if self.opened is None:
            self.opened = _opened(self.source, self.models)
        reference, models = self.opened
        modes = {level: np.load(path, mmap_mode="r", allow_pickle=False) for level, path in self.modes.items()}
        with _one_thread():
            return score_run(reference, predictors_of(models), run, modes, default_groups(reference)[0], self.sensors)


def _keep_modes(pods: Mapping[int, Any], folder: Path) -> dict[int, str]:
    """Modes as files, which workers map into memory instead of being sent them with every run."""
    import numpy as np

    out = {}
    for level, pod in pods.items():
        path = folder.absolute() / f"level_{level}.npy"
        np.save(path, pod.modes, allow_pickle=False)
        out[level] = str(path)
    return out


def _opened(
    source: Source, models: tuple[tuple[str, Trained | Path], ...]
) -> tuple[Reference, tuple[ComparedModel, ...]]:
    """The dataset and the models as evaluation sees them."""
    from crashkit.api.predict import model_in_hand
    from crashkit.api.reference import read_reference
    from crashkit.dataset import open_dataset
    from crashkit.errors import DataError

    surrogates = [(Path(name), model_in_hand(model).surrogate) for name, model in models]
    opened = open_dataset(source.name, chunks=None) if source.dataset is None else source.dataset
    coarse = any(number > 0 for _, s in surrogates for number in s.level_names.values())
    if coarse and source.hierarchy is None:
        raise DataError(
            f"{source.name}: has no mesh hierarchy; "
            + (
                f"run crashkit coarsen {source.name} first"
                if source.path
                else "give hierarchy=crashkit.coarsen(dataset)"
            )
        )
    reference = read_reference(source.name, opened, () if source.hierarchy is None else source.hierarchy.levels)
    return reference, tuple(as_model(surrogate, folder, reference) for folder, surrogate in surrogates)


@dataclass
class StoredLevel:
    """One level of a stored surrogate as evaluation asks it (evaluation.comparison.predictor.Predictor).

    Attributes
    ----------
    order
        For each parameter of the surrogate, its place among those of the dataset.
    """

    surrogate: Surrogate
    name: str
    level: int
    mesh: Level | None
    order: tuple[int, ...]
    n_parameters: int
    n_latent: int
    seconds_per_epoch: float
    training_seconds: float
    history: Mapping[str, NDArray[np.float64]]

    def predict(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        return self.surrogate.predict(parameters[list(self.order)], time, self.level)

    def reconstruct(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        return self.surrogate.reconstruct(displacement, self.level)

    def half_width(
        self, share: float, time: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float32] | None:
        known = self.surrogate.has_band(self.level)
        at = parameters[list(self.order)]
        return self.surrogate.band(share, time, self.level, full=True, parameters=at) if known else None

    def element_fields(
        self, parameters: NDArray[np.float64], time: NDArray[np.float64]
    ) -> Mapping[str, NDArray[np.float32]]:
        at = parameters[list(self.order)]
        return {name: self.surrogate.predict_field(name, at, time) for name in self.surrogate.fields}

    def removal(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32] | None:
        if self.surrogate.removal is None:
            return None
        return self.surrogate.predict_removal(parameters[list(self.order)], time)


def as_model(surrogate: Surrogate, folder: Path, reference: Reference) -> ComparedModel:
    """A surrogate, stored in `folder`, as evaluation sees it: one predictor a level, and the runs it has seen.

    Raises
    ------
    EvaluationError
        Where its parameters, nodes or levels are not those of the dataset.
    """
    from evaluation.comparison.predictor import ComparedModel
    from evaluation.errors import EvaluationError

    names = surrogate.record.ranges.names
    if sorted(names) != sorted(reference.parameter_names):
        raise EvaluationError(
            f"{folder}: the model takes the parameters {', '.join(names)}; the dataset has "
            f"{', '.join(reference.parameter_names) or 'none'}; give the dataset it was trained on"
        )
    if surrogate.graphs.n_nodes(0) != reference.n_nodes:
        raise EvaluationError(
            f"{folder}: the model was trained on a mesh of {surrogate.graphs.n_nodes(0)} nodes; the dataset has "
            f"{reference.n_nodes}; give the dataset it was trained on"
        )
    order = tuple(reference.parameter_names.index(n) for n in names)
    predictors = tuple(
        StoredLevel(
            surrogate, name, level, _own_mesh(surrogate, folder, name, level, reference), order,
            n_parameters=surrogate.n_parameters(level),
            n_latent=surrogate.n_latent(level),
            seconds_per_epoch=surrogate.seconds_per_epoch(level),
            training_seconds=surrogate.training_seconds(level),
            history=surrogate.history(level),
        )
        for name, level in sorted(surrogate.level_names.items(), key=lambda item: item[1])
    )  # fmt: skip
    record = surrogate.record
    configuration = surrogate.settings.model_dump(mode="json")
    configuration.pop("seed", None)
    return ComparedModel(
        name=folder.resolve().name,
        predictors=predictors,
        fitted_runs=record.fitted_runs,
        tuned_runs=record.validation_runs,
        held_out_runs=record.held_out_runs,
        checksum=record.checksum,
        seed=record.seed,
        averaged=len(surrogate.seeds),
        configuration=configuration,
        beneath=str(record.coarse.get("checksum", "")),
        known={name: told for name, told in record.physics.items() if isinstance(told, str)},
        worth=record.physics.get("errors") or {},
        hard=surrogate.hard_runs(),
    )


def _own_mesh(surrogate: Surrogate, folder: Path, name: str, level: int, reference: Reference) -> Level | None:
    """The level as training left it, refined or with a learnt map to the full mesh; None where it is the dataset's."""
    import numpy as np

    from evaluation.errors import EvaluationError

    if level == 0:
        return None
    if np.array_equal(surrogate.graphs.kept(level), reference.level(level).kept):
        apart = surrogate.graphs.to_full(level) - reference.level(level).to_full
        return surrogate.graphs[level] if abs(apart).max() > _SAME_WEIGHT else None
    if surrogate.settings.refinement.adaptive:
        return surrogate.graphs[level]
    raise EvaluationError(
        f"{folder}: {name} was trained on {surrogate.graphs.n_nodes(level)} other nodes than level {level} of the "
        f"dataset has ({reference.level_nodes(level)}); the dataset was coarsened anew: train the model again"
    )


@contextlib.contextmanager
def _counted(tell: Progress, what: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Report one step after the other under the name `what`, with the name of each where it has one."""
    count = 0

    def step(name: str = "") -> None:
        nonlocal count
        count += 1
        tell(what, count, total or 0, name)

    tell(what, 0, total or 0, "")
    yield step


def _context(dataset: Path, reference: Reference, models: Sequence[ComparedModel], split: Any) -> dict[str, str]:
    """The methods section: what was compared, on what, with what."""
    import datetime
    import platform
    from importlib.metadata import PackageNotFoundError, version

    packages = []
    for name in ("crashkit", "torch", "scikit-learn", "numpy", "scipy", "xarray", "vtk", "pyvista"):
        with contextlib.suppress(PackageNotFoundError):
            packages.append(f"{name} {version(name)}")
    names = [reference.runs[k] for k in split.test]
    unused = len(reference.runs) - len(split.train) - len(split.test)
    attributes = reference.attributes
    return {
        "Dataset": dataset.name,
        "Checksum (SHA-256)": reference.checksum or "not recorded",
        "Solver": attributes.get("solver", "not recorded"),
        "Runs": f"{len(reference.runs)}, of which {len(names)} test" + (f" and {unused} not used" if unused else ""),
        "Test runs": ", ".join(names),
        "Parameters": ", ".join(
            f"{n} ({u})" for n, u in zip(reference.parameter_names, reference.parameter_units, strict=True)
        )
        or "none",
        "States": f"{len(reference.time)} from {reference.time[0] * 1e3:.4g} to {reference.time[-1] * 1e3:.4g} ms",
        "Meshes": ", ".join(f"{reference.level_nodes(k)} nodes (level {k})" for k in range(len(reference.levels) + 1)),
        "Models": ", ".join(m.name for m in models),
        "Versions": f"Python {platform.python_version()}, {', '.join(packages)}",
        "Machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "Made": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def _processor() -> str:
    """The processor's name as far as the system tells it."""
    import platform

    with contextlib.suppress(OSError), Path("/proc/cpuinfo").open(encoding="utf-8") as lines:
        for line in lines:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
