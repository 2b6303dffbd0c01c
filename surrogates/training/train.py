"""From a campaign to a surrogate: the way each kind of model is fitted."""

from __future__ import annotations

import difflib
import itertools
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign, CurveTarget
from surrogates.data.graphs import Graphs
from surrogates.data.inputs import Ranges
from surrogates.data.samples import LevelRuns, Notes, check, everything, split
from surrogates.data.scaling import InputScaling
from surrogates.errors import SurrogateError
from surrogates.models.average import Average, some_states, spread_of
from surrogates.models.cascade import Cascade
from surrogates.models.coarse_base import CoarseMesh
from surrogates.models.curves import fit_curve
from surrogates.models.pod_regression import Held, PodFit, fit_pod_regression
from surrogates.models.unified import Unified
from surrogates.physics.choice import of_campaign
from surrogates.physics.trials import Folds
from surrogates.record import Fit, Record
from surrogates.regression.beneath import Beneath
from surrogates.settings import Settings
from surrogates.surrogate import Surrogate
from surrogates.training.beside import check_targets, fit_beside
from surrogates.training.by_folds import FoldTrainer, chooses_by_folds
from surrogates.training.coarse import check_coarse, note_coarse, note_coarse_levels
from surrogates.training.coarse_latents import CoarseFields
from surrogates.training.lifting import Lifts, learn_lifts
from surrogates.training.loop import Diverged, Epoch, Keeper, device_of
from surrogates.training.members import averaged, fits_together, trainer_of
from surrogates.training.refinement import Refined
from surrogates.training.trainer import Trainer
from surrogates.uncertainty import (
    FEWEST_BY_FOLDS,
    FEWEST_RUNS,
    Beliefs,
    calibrate_gathered,
    gather,
    living_mean,
)

_log = logging.getLogger(__name__)

# Told of each left-out run: the surrogate as far as it is, the place of the run, its displacements (state, node, 3), m.
Watch = Callable[[Surrogate, int, NDArray[np.float32]], None]

# A trained model, and what trained it: one, or one for each seed.
Member = tuple[Surrogate, Trainer]

# Share of the error below which what trainings differ by is nothing: their mean is better by its square at most.
_NOTHING = 0.02

# Bytes of one run on the full mesh up to which lifted predictions are judged.
_LARGEST_RUN = 2 << 30
# States whose distances are worked out at once.
_STATES = 8


def train_surrogate(
    campaign: Campaign,
    settings: Settings,
    *,
    device: str = "cpu",
    report: Callable[[Epoch], None] | None = None,
    keeper: Keeper | None = None,
    watch: Watch | None = None,
) -> Surrogate:
    """Fit the surrogate that `settings` describe to the runs of `campaign`.

    Interrupted (KeyboardInterrupt), it returns what there is: the finished levels, and the one in training with its
    best weights.

    Parameters
    ----------
    device
        cpu, cuda, mps, or auto.
    report
        Called after every epoch.
    keeper
        Where the state of the training is kept between epochs, to go on from after an interruption.
    watch
        Told of every left-out run: the surrogate as far as it is, the place of the run, and displacements (state, node, 3), m,
        on the full mesh without it.

    Raises
    ------
    Diverged
        Where a loss is not finite, with the surrogate that is left on it.
    SurrogateError
        For data nothing can be learnt from.
    """
    notes = Notes()
    check(campaign, settings, notes)
    check_targets(campaign, settings)
    check_coarse(campaign, settings, notes)
    of_pod = settings.model in ("pod-gpr", "pod-rbf")
    by_folds = of_pod or chooses_by_folds(settings, campaign)
    parts = everything(campaign, settings) if by_folds else split(campaign, settings, notes)
    graphs = Graphs.of(campaign)
    ranges = Ranges.of(
        campaign.parameter_names, campaign.parameter_units, campaign.parameters[parts.training], campaign.time,
        campaign.table_units,
    )  # fmt: skip
    wanted = curve_targets(campaign, settings)
    trainer = Trainer(campaign, settings, graphs, parts, notes, device_of(device), report, keeper)
    record = Record.of(campaign, settings, ranges, parts)
    record.notes = notes.lines
    surrogate = Surrogate(settings, record, graphs, Cascade(scaling(settings, ranges)), campaign.points, campaign.faces)
    surrogate.labels = campaign.labels
    if of_pod:
        if settings.seeds > 1:
            notes.add(
                f"{settings.model} is trained once and not {settings.seeds} times: its seed draws the folds alone, so an "
                "average over seeds brings nothing; mh, podnn, aenn and gaenn have weights that differ by it"
            )
        _fit_regression(surrogate, trainer, wanted, watch)
        return surrogate
    if by_folds:
        trainer = _registered(surrogate, trainer)
    _fit_curves(surrogate, campaign, settings, parts.training, wanted)
    try:
        members = _fit_members(surrogate, trainer)
    except Diverged as error:
        if error.surrogate is not None:
            _note_coarse([(error.surrogate, trainer)])
        raise
    if campaign.coarse is not None:
        _note_coarse(members, surrogate.record)
    lifts = _learnt_lifts(surrogate, members[0][1])
    _judge(surrogate, members, watch, lifts)
    fit_beside(surrogate, campaign, settings, parts.training, notes)
    return surrogate


def _registered(surrogate: Surrogate, trainer: Trainer) -> FoldTrainer:
    """A trainer on the registered campaign, whose folds hold a run and its image together."""
    campaign, settings, record = trainer.campaign, trainer.settings, surrogate.record
    registration, worth = of_campaign(campaign, settings, trainer.notes)
    surrogate.registration = registration
    record.physics = {**registration.told(), "errors": worth.errors}
    inner = registration.apply(campaign, settings, trainer.notes)
    count = len(campaign.parameters)
    part = Folds.of(count, settings.validation.folds, settings.seed).part[0]
    surrogate.core = Cascade(scaling(settings, ranges_of(inner)))
    coarse, notes = campaign.coarse, trainer.notes
    below = None
    if coarse is not None:
        below = CoarseFields.of(coarse, registration, settings, notes)
        surrogate.mesh_below = CoarseMesh.of(coarse)
    return FoldTrainer(
        inner, settings, trainer.graphs, registration.split(trainer.split, count), trainer.notes, trainer.device,
        trainer.report, trainer.keeper,
        part=np.tile(part, len(inner.parameters) // count), original=campaign, registration=registration, below=below,
    )  # fmt: skip


def ranges_of(campaign: Campaign) -> Ranges:
    """What the runs of a campaign cover."""
    return Ranges.of(campaign.parameter_names, campaign.parameter_units, campaign.parameters, campaign.time)


def scaling(settings: Settings, ranges: Ranges) -> InputScaling:
    """The input scaling that `settings` ask for."""
    return InputScaling(ranges, products=settings.inputs.products, angles=settings.inputs.angles)


def level_numbers(settings: Settings, graphs: Graphs) -> tuple[int, ...]:
    """The levels that are trained, coarsest first; raises SurrogateError for one the hierarchy does not have."""
    chosen = settings.levels or tuple(range(len(graphs.levels), 0, -1))
    for number in chosen:
        graphs.n_nodes(number)
    if settings.refinement.adaptive and list(chosen) != list(range(chosen[0], chosen[0] - len(chosen), -1)):
        raise SurrogateError(f"adaptive refinement goes level by level; found levels {list(chosen)}")
    return chosen


def curve_targets(campaign: Campaign, settings: Settings) -> tuple[CurveTarget, ...]:
    """The channels that `settings.targets` name: by name, by pattern, or by the name of their resultant.

    Raises
    ------
    SurrogateError
        For a target that the campaign does not have.
    """
    out: dict[str, CurveTarget] = {}
    known = [c.name for c in campaign.curves]
    for target in settings.targets:
        if not target.startswith("history:"):
            continue
        wish = target.removeprefix("history:")
        names = [n for n in known if n == wish] or [n for n in known if fnmatchcase(n, wish)]
        names = names or [n for n in known if n in {f"{wish}_{axis}" for axis in "xyz"}]
        if not names:
            some = ", ".join(known[:16]) or "no history"
            near = difflib.get_close_matches(wish, known, n=1, cutoff=0.5)
            hint = f"; did you mean 'history:{near[0]}'?" if near else ""
            raise SurrogateError(f"targets names {target!r}, and the dataset has {some}{hint}")
        out |= {c.name: c for c in campaign.curves if c.name in names}
    return tuple(out.values())


def _fit_curves(
    surrogate: Surrogate,
    campaign: Campaign,
    settings: Settings,
    chosen: NDArray[np.int64],
    wanted: tuple[CurveTarget, ...],
) -> None:
    """The histories beside the displacements, behind the same registration."""
    for target in wanted:
        assert campaign.curve_time is not None
        _log.info("history %s", target.name)
        mine = CurveTarget(target.name, target.unit, target.values[chosen])
        found = fit_curve(
            mine, campaign.curve_time, campaign.parameters[chosen], surrogate.registration, settings.validation.folds,
            settings.seed, campaign.parameter_names,
        )  # fmt: skip
        found.held = {int(chosen[place]): curve for place, curve in found.held.items()}
        surrogate.curves[target.name] = found


def _fit_regression(
    surrogate: Surrogate, trainer: Trainer, wanted: tuple[CurveTarget, ...], watch: Watch | None
) -> None:
    """Everything is chosen by folds, and the errors and the band come from the runs each fold left out."""
    started = time.perf_counter()
    campaign, record, runs = trainer.campaign, surrogate.record, trainer.split.training
    found = fit_pod_regression(campaign, trainer.settings, runs, trainer.notes)
    surrogate.core, surrogate.registration = found.core, found.registration
    record.choice = {"inputs": found.choice.inputs, "modes": found.choice.modes}
    record.physics = {**found.registration.told(), "errors": found.worth.errors}
    if found.coarse is not None and campaign.coarse is not None:
        note_coarse(record, campaign.coarse, found.coarse)
    _fit_curves(surrogate, campaign, trainer.settings, runs, wanted)
    _judge_by_folds(surrogate, trainer, found, watch)
    record.errors |= found.choice.errors
    fit_beside(surrogate, campaign, trainer.settings, runs, trainer.notes, found.trials)
    record.fits[0] = Fit(seconds=time.perf_counter() - started)


def _judge_by_folds(surrogate: Surrogate, trainer: Trainer, found: PodFit, watch: Watch | None) -> None:
    """Note e2 (m) over the left-out runs, and calibrate the band on them where there are enough."""
    runs, record = trainer.split.training, surrogate.record
    field = trainer.runs(0, surrogate.graphs)
    places: list[int] = []
    deviations: list[float] = []
    errors: list[float] = []

    def distances() -> Iterator[NDArray[np.float32]]:
        for held, distance in _off_held(found.held(), field, runs):
            places.append(held.run)
            deviations.append(held.deviation)
            if watch is not None:
                watch(surrogate, int(runs[held.run]), held.predicted)
            errors.append(_mean(distance))
            yield distance

    gathered = gather(distances())
    if errors:
        record.errors[next(iter(surrogate.level_names))] = float(np.mean(errors))
    for place in sorted(set(places)):  # several folds may have left a run out
        of_run = np.flatnonzero(np.array(places) == place)
        record.left_out[record.fitted_runs[place]] = (
            float(np.array(errors)[of_run].mean()), float(np.array(deviations)[of_run].mean())
        )  # fmt: skip
    if len(set(places)) < FEWEST_BY_FOLDS:
        trainer.notes.add(
            f"there is no band: it takes {FEWEST_BY_FOLDS} training runs, and there are {len(set(places))}"
        )
        return
    campaign_parameters = trainer.campaign.parameters
    parameters = campaign_parameters[runs[places]]
    sizes = found.registration.clock.size(parameters)
    beliefs = Beliefs(sizes, np.array(deviations), *surrogate.places(parameters))
    surrogate.bands[0, False] = calibrate_gathered(gathered, record.time, beliefs, np.array(places))
    if found.itself is not None:
        judged = ((int(runs[h.run]), h.deviation, distance) for h, distance in _off_held(found.itself(), field, runs))
        _note_from_runs(surrogate, trainer, (0, False), judged)


def _note_from_runs(
    surrogate: Surrogate, trainer: Trainer, band: tuple[int, bool],
    judged: Iterable[tuple[int, float, NDArray[np.float32]]],
) -> None:  # fmt: skip
    """The band of predictions that start from a coarse run of the query, where enough fine runs have one.

    Parameters
    ----------
    judged
        Left-out runs that have a coarse run: place, deviation, and distances (state, node), m, of what was said from it.
    """
    places: list[int] = []
    deviations: list[float] = []

    def distances() -> Iterator[NDArray[np.float32]]:
        for run, deviation, distance in judged:
            places.append(run)
            deviations.append(deviation)
            yield distance

    gathered = gather(distances())
    if len(set(places)) < FEWEST_BY_FOLDS:
        return
    of_runs = trainer.judged_campaign.parameters[places]
    sizes = surrogate.registration.clock.size(of_runs)
    beliefs = Beliefs(sizes, np.array(deviations), *surrogate.places(of_runs))
    surrogate.run_bands[band] = calibrate_gathered(gathered, surrogate.record.time, beliefs, np.array(places))


def _fit_members(surrogate: Surrogate, trainer: Trainer) -> list[Member]:
    """Train once for each seed, and put the network, or the mean of all, on `surrogate`; whole members are kept."""
    settings, record = trainer.settings, surrogate.record
    fit = _fit_unified if settings.unified else _fit_cascade
    if settings.seeds == 1:
        fit(surrogate, trainer)
        return [(surrogate, trainer)]
    members: list[Member] = []
    stopped = False
    for place in range(settings.seeds):
        own, mine = trainer_of(trainer, place), surrogate.untrained()
        try:
            fit(mine, own)
        except Diverged as error:
            if not members:
                raise
            trainer.notes.add(f"the training with seed {own.settings.seed} is left out: {error}")
            continue
        except KeyboardInterrupt:
            if not members:
                raise
            stopped = True
            break
        stopped = not _whole(mine, own)
        if not stopped or not members:
            members.append((mine, own))
        if stopped:
            break
    if stopped:
        trainer.notes.add(
            f"was interrupted: what is kept is {len(members)} of {settings.seeds} trainings"
            + ("" if len(members) > 1 else ", as far as it went")
        )
    surrogate.core = averaged(members) if len(members) > 1 else members[0][0].core
    record.fits |= fits_together(members, interrupted=stopped)
    return members


def _whole(member: Surrogate, trainer: Trainer) -> bool:
    """Whether no level of a trained member is missing or was interrupted."""
    wanted = level_numbers(trainer.settings, trainer.graphs)
    ended = [kept.status for kept in member.record.fits.values()]
    return set(member.core.numbers) == set(wanted) and "interrupted" not in ended


def _fit_unified(surrogate: Surrogate, trainer: Trainer) -> None:
    numbers = level_numbers(trainer.settings, trainer.graphs)
    inputs = scaling(trainer.settings, surrogate.record.ranges)
    try:
        surrogate.record.fits[numbers[-1]] = trainer.unified(surrogate, numbers, inputs)
    except Diverged as error:
        if error.fit is not None and error.fit.best_epoch:
            surrogate.record.fits[numbers[-1]] = error.fit
            error.surrogate = surrogate
        raise
    finally:
        if isinstance(surrogate.core, Unified):
            surrogate.core.cpu()


def _fit_cascade(surrogate: Surrogate, trainer: Trainer) -> None:
    """Level after level; what is finished stays on `surrogate`, whatever happens to the next one."""
    cascade, record = surrogate.core, surrogate.record
    if not isinstance(cascade, Cascade):
        raise SurrogateError("a cascade is trained into a cascade")
    settings = trainer.settings
    numbers = level_numbers(settings, trainer.graphs)
    refined = Refined.start(trainer.graphs, numbers[0]) if settings.refinement.adaptive else None
    try:
        for number in numbers:
            if refined is not None and number != numbers[0]:
                error = node_errors(surrogate, trainer, number + 1)
                refined = refined.finer(error, settings.refinement.share, settings.refinement.rings)
                surrogate.graphs = refined.graphs
            record.fits[number] = trainer.level(number, cascade, surrogate.graphs)
            cascade.cpu()
            if record.fits[number].status == "interrupted":
                break
    except (KeyboardInterrupt, Diverged) as error:
        diverged = error if isinstance(error, Diverged) else None
        if diverged is not None and diverged.fit is not None and diverged.fit.best_epoch:
            record.fits[cascade.numbers[-1]] = diverged.fit
        if cascade.numbers and cascade.numbers[-1] not in record.fits:
            cascade.drop_finest()
        if diverged is not None and cascade.numbers:
            diverged.surrogate = surrogate
        if diverged is not None or not cascade.numbers:
            raise
    finally:
        cascade.cpu()


# A run, and the distances (state, node), m, between its truth and what is said of it without it.
_Judged = tuple[int, NDArray[np.float32]]


def _learnt_lifts(surrogate: Surrogate, trainer: Trainer) -> Lifts | None:
    """Maps from the levels to the full mesh, as far as training runs give better ones; they are put on the surrogate."""
    settings, campaign = trainer.settings, trainer.judged_campaign
    full = _full_field(trainer)
    if settings.transfer.lifting == "static" or settings.refinement.adaptive or campaign.points is None or full is None:
        return None
    runs = len(campaign.parameters)
    if isinstance(trainer, FoldTrainer):
        training, part = np.arange(runs), trainer.part[:runs]
    else:  # validation runs are in no fold, since none learns from them
        training, part = trainer.split.training, np.full(runs, -1)
        part[training] = np.random.default_rng(settings.seed).permutation(len(training)) % settings.validation.folds
    numbers = list(surrogate.level_names.values())
    lifts = learn_lifts(full, surrogate.graphs, numbers, part, training, campaign.points, campaign.known)
    surrogate.use_graphs(lifts.put_on(surrogate.graphs))
    return lifts


def _judge(
    surrogate: Surrogate, members: Sequence[Member], watch: Watch | None = None, lifts: Lifts | None = None
) -> None:
    """Note errors e2 (m) over runs that were left out, and calibrate the bands on them: on own nodes, and lifted.

    A run that was left out is lifted by maps that were learnt without it.
    """
    trainer, record = members[0][1], surrogate.record
    if isinstance(trainer, FoldTrainer):
        record.choice = _choices(members)
    for name, number in surrogate.level_names.items():
        if lifts is not None and (told := lifts.told(number)):
            before = record.choice.get(name)
            record.choice[name] = told if before is None else f"{before}; {told}"
    if not isinstance(trainer, FoldTrainer) and not len(trainer.split.validation):
        trainer.notes.add("no runs were held out, so there is neither a validation error nor a band")
        return
    full = _full_field(trainer)
    deviations = _deviations(surrogate, members)
    for name, number in surrogate.level_names.items():
        runs = trainer.judged(number, surrogate.graphs)
        reduced: list[float] = []
        alone: list[list[float]] = [[] for _ in members]

        def own(
            number: int = number, runs: LevelRuns = runs, reduced: list[float] = reduced, alone: list[list[float]] = alone
        ) -> Iterator[_Judged]:  # fmt: skip
            for run, said in _left_out(members, number):
                predicted = _mean_of(said)
                if watch is not None and number == min(surrogate.core.numbers):
                    watch(surrogate, run, surrogate.lift(predicted, number))
                truth = runs.read(run)
                reduced.append(_mean(_off(surrogate.reconstruct(truth, number), runs, run)))
                for errors, one in zip(alone, said, strict=True):
                    errors.append(_mean(_off(one, runs, run)))
                yield run, _off(predicted, runs, run)

        def lifted(number: int = number) -> Iterator[_Judged]:
            for run, said in _left_out(members, number):
                if full is not None:
                    yield run, _off(_mean_of(said), full, run, _lifting(surrogate, number, lifts, run))

        _note(surrogate, trainer, name, (number, False), own(), deviations)
        if full is not None and number > 0:
            _note(surrogate, trainer, f"{name}, lifted to the full mesh", (number, True), lifted(), deviations)
        if surrogate.takes_coarse(number):
            _judge_from_runs(surrogate, members, number, runs, full, deviations, lifts)
        record.errors[f"{name}, reduction alone"] = float(np.mean(reduced))
        if len(members) > 1:
            for (_, own_trainer), errors in zip(members, alone, strict=True):
                record.members.setdefault(str(own_trainer.settings.seed), {})[name] = float(np.mean(errors))


def _judge_from_runs(
    surrogate: Surrogate, members: Sequence[Member], number: int, runs: LevelRuns, full: LevelRuns | None,
    deviations: NDArray[np.float64], lifts: Lifts | None,
) -> None:  # fmt: skip
    """Bands of predictions that start from a coarse run of the query: on the level's own nodes, and lifted."""
    trainer = members[0][1]
    if not isinstance(trainer, FoldTrainer) or trainer.below is None:
        return
    twin = trainer.below.twin(trainer.original.parameters)

    def judged(field: LevelRuns, *, lifted: bool) -> Iterator[tuple[int, float, NDArray[np.float32]]]:
        for run, said in _left_out(members, number, from_coarse=True):
            if twin[run] >= 0:
                up = _lifting(surrogate, number, lifts, run) if lifted else (lambda some: some)
                yield run, float(deviations[run]), _off(_mean_of(said), field, run, up)

    _note_from_runs(surrogate, trainer, (number, False), judged(runs, lifted=False))
    if full is not None and number > 0:
        _note_from_runs(surrogate, trainer, (number, True), judged(full, lifted=True))


def _lifting(
    surrogate: Surrogate, number: int, lifts: Lifts | None, run: int
) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """From the nodes of a level to the full mesh, by a map that has not seen the run."""
    to_full = None if lifts is None else lifts.without(run, number)
    return lambda states: surrogate.lift(states, number, to_full)


def _left_out(
    members: Sequence[Member], number: int, *, from_coarse: bool = False
) -> Iterator[tuple[int, list[NDArray[np.float32]]]]:
    """Runs, and what each member says of them (state, node, 3), m, without them; or from the coarse run of each."""
    of_members = [_left_out_by(member, trainer, number, from_coarse=from_coarse) for member, trainer in members]
    for told in zip(*of_members, strict=True):
        yield told[0][0], [said for _, said in told]


def _left_out_by(
    member: Surrogate, trainer: Trainer, number: int, *, from_coarse: bool = False
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    if isinstance(trainer, FoldTrainer) and isinstance(member.core, Cascade):
        yield from enumerate(trainer.left_out(number, member.core.levels[number], from_coarse=from_coarse))
        return
    for run in trainer.split.validation:
        yield int(run), _predicted(member, trainer.campaign, run, number)


def _mean_of(said: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    return said[0] if len(said) == 1 else np.mean(said, axis=0, dtype=np.float32)


def _deviations(surrogate: Surrogate, members: Sequence[Member]) -> NDArray[np.float64]:
    """(judged run,): how far members lie apart, as bands may follow it; 1 for a single training.

    Where that is nothing beside their errors, it is noted that the seed brings nothing.
    """
    trainer, core = members[0][1], surrogate.core
    if not isinstance(core, Average):
        return np.ones(len(trainer.judged_campaign.parameters))
    number = max(core.numbers)
    runs = trainer.judged(number, surrogate.graphs)
    places, spreads, errors = [], [], []
    for run, said in _left_out(members, number):
        some = some_states(len(said[0]))
        places.append(run)
        spreads.append(spread_of([one[some] for one in said]))
        errors.append(_mean(_off(_mean_of(said), runs, run)))
    spread = np.array(spreads) / surrogate.registration.clock.size(trainer.judged_campaign.parameters[places])
    core.floor = 0.5 * float(spread.mean())
    if np.mean(spreads) < _NOTHING * np.mean(errors):
        core.floor = max(float(np.mean(errors)), 1e-9)  # far above the spread, so that no band follows it
        trainer.notes.add(
            f"the {len(members)} trainings differ by {100 * np.mean(spreads):.1g} cm, their error is "
            f"{100 * np.mean(errors):.2g} cm: with these settings the seed changes next to nothing, and one training does as well"
        )
    return core.deviation(spread)


def _note_coarse(members: Sequence[Member], record: Record | None = None) -> None:
    """Keep in the record what coarse runs are worth on each level, coarsest first; by seed where there are several."""
    out: dict[str, Beneath] = {}
    for member, trainer in members:
        for name, number in member.level_names.items():
            chosen = trainer.chosen.get(number) if isinstance(trainer, FoldTrainer) else None
            if chosen is not None and chosen.coarse is not None:
                out[name if len(members) == 1 else f"{name}, seed {trainer.settings.seed}"] = chosen.coarse.found
    coarse = members[0][1].campaign.coarse
    if coarse is not None:
        note_coarse_levels(record or members[0][0].record, coarse, out)


def _choices(members: Sequence[Member]) -> dict[str, str]:
    """What was chosen for each level, from what, in words; by seed where there are several."""
    out = {}
    of_all = ((member, trainer, *told) for member, trainer in members for told in member.level_names.items())
    for member, trainer, name, number in of_all:
        if not isinstance(trainer, FoldTrainer):
            continue
        chosen, fit = trainer.chosen[number], member.record.fits[number]
        tried = ", ".join(f"{what} {100 * error:.2f} cm" for what, error in chosen.errors.items())
        epochs = f"; network {fit.best_epoch} of {fit.epochs} epochs" if chosen.share < 1 and fit.epochs else ""
        trained = (
            f"; reduction {chosen.reduction_epochs} epochs" if chosen.reduction_epochs else "; reduction as computed"
        )
        label = name if len(members) == 1 else f"{name}, seed {trainer.settings.seed}"
        out[label] = f"{chosen.told} ({tried}){epochs}{trained}"
    return out


def _note(
    surrogate: Surrogate, trainer: Trainer, label: str, band: tuple[int, bool], judged: Iterable[_Judged],
    deviations: NDArray[np.float64],
) -> None:  # fmt: skip
    """The error, and the band where runs are enough, from distances on runs that were left out."""
    record, campaign = surrogate.record, trainer.judged_campaign
    places: list[int] = []
    errors: list[float] = []

    def distances() -> Iterator[NDArray[np.float32]]:
        for run, distance in judged:
            places.append(run)
            errors.append(_mean(distance))
            yield distance

    gathered = gather(distances())
    record.errors[label] = float(np.mean(errors))
    by_folds = isinstance(trainer, FoldTrainer)
    if by_folds and band == (min(surrogate.core.numbers), False):
        told = zip(record.fitted_runs, errors, deviations, strict=True)
        record.left_out = {name: (error, float(deviation)) for name, error, deviation in told}
    fewest = FEWEST_BY_FOLDS if by_folds else FEWEST_RUNS
    if len(places) < fewest:
        kind = "training" if by_folds else "validation"
        trainer.notes.add(f"there is no band: it takes {fewest} {kind} runs, and there are {len(places)}")
        return
    parameters = campaign.parameters[places]
    sizes = surrogate.registration.clock.size(parameters)
    beliefs = Beliefs(sizes, deviations[: len(places)], *surrogate.places(parameters))
    surrogate.bands[band] = calibrate_gathered(gathered, record.time, beliefs)


def _full_field(trainer: Trainer) -> LevelRuns | None:
    """The full mesh's displacements, of which runs left out alone are read; None where one run is too large."""
    campaign = trainer.judged_campaign
    if len(campaign.time) * campaign.n_nodes * 12 > _LARGEST_RUN:
        trainer.notes.add("a run of the full mesh is too large to judge lifted predictions while training")
        return None
    return LevelRuns(campaign, 0, trainer.settings, trainer.notes)


def node_errors(surrogate: Surrogate, trainer: Trainer, number: int) -> NDArray[np.float64]:
    """Mean distance (node,), m, of prediction and truth over states and validation runs (training runs without any)."""
    runs: LevelRuns = trainer.judged(number, surrogate.graphs)
    total = np.zeros(surrogate.graphs.n_nodes(number))
    if isinstance(trainer, FoldTrainer):
        told = list(_left_out_by(surrogate, trainer, number))
        mean: NDArray[np.float64] = np.mean(
            [np.nanmean(_off(said, runs, run), axis=0) for run, said in told], axis=0, dtype=np.float64
        )
        return mean
    held = trainer.split.validation if len(trainer.split.validation) else trainer.split.training
    for run in held:
        total += np.nanmean(_off(_predicted(surrogate, trainer.campaign, run, number), runs, run), axis=0)
    return total / len(held)


def _predicted(surrogate: Surrogate, campaign: Campaign, run: int, number: int) -> NDArray[np.float32]:
    return surrogate.predict(campaign.parameters[run], campaign.time, number)


def _off(
    said: NDArray[np.float32],
    runs: LevelRuns,
    run: int,
    lifted: Callable[[NDArray[np.float32]], NDArray[np.float32]] = lambda some: some,
) -> NDArray[np.float32]:
    """(state, node), m: how far `said` is from the truth of a run; NaN where the node is gone, which no error counts.

    Parameters
    ----------
    lifted
        Brings some states of `said` to the nodes of `runs`; not many of them are in memory at once.
    """
    truth = runs.read(run)
    out = np.empty(truth.shape[:2], np.float32)
    for k in range(0, len(truth), _STATES):
        some = slice(k, k + _STATES)
        out[some] = np.linalg.norm(lifted(said[some]) - truth[some], axis=-1)
    there = runs.there(run)
    return out if there is None else np.where(there, out, np.float32(np.nan))


def _off_held(
    left_out: Iterable[Held], field: LevelRuns, runs: NDArray[np.int64]
) -> Iterator[tuple[Held, NDArray[np.float32]]]:
    """Left-out runs, and (state, node), m, how far each is from its truth, as `_off` says it.

    A run that comes several times in a row is read once.
    """
    for place, same in itertools.groupby(left_out, key=lambda held: held.run):
        truth, there = field.read(runs[place]), field.there(runs[place])
        for held in same:
            distance = held.off(truth)
            yield held, distance if there is None else np.where(there, distance, np.float32(np.nan))
        del truth  # else it is there while the next one is read


def _mean(distance: NDArray[np.float32]) -> float:
    """e2, m: the mean over living nodes, then over states."""
    return float(living_mean(distance, 1).mean())
