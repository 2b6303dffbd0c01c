"""A dataset and settings in, a model folder out."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashkit.display import watched
from data_schema.memory import give_back
from data_schema.progress import Progress

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.api.model import Model
    from crashkit.mesh.levels import Hierarchy
    from crashkit.selection import WhichRuns
    from surrogates.data.campaign import Campaign
    from surrogates.settings import Settings
    from surrogates.surrogate import Surrogate
    from surrogates.training.loop import Epoch


def train(
    dataset: str | Path | xr.Dataset,
    output: str | Path | None = None,
    model: str | None = None,
    *,
    preset: str | None = None,
    settings: Mapping[str, Any] | Sequence[str] = (),
    config: str | Path | None = None,
    seed: int | None = None,
    seeds: int | None = None,
    epochs: int | None = None,
    test: WhichRuns | None = None,
    targets: Sequence[str] = (),
    coarse: str | Path | xr.Dataset | None = None,
    hierarchy: Hierarchy | None = None,
    device: str = "auto",
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int = 0,
    tensorboard: str | Path | None = None,
    report: Progress | None = None,
    on_epoch: Callable[[Epoch], None] | None = None,
    progress: bool | Literal["auto"] = "auto",
) -> Model:
    """Train a surrogate, and store it as the folder `output`.

    Ctrl-C ends the training, and what there is gets stored. The folder appears under its name when it is complete.

    Parameters
    ----------
    dataset
        Path of a crash dataset, or the dataset in hand: all runs, or a selection such as `dataset.isel(sim=slice(27))`.
    output
        Model folder; without it the model is returned and not stored (`Model.save` does that).
    model
        mh, podnn, aenn, gaenn, pod-gpr or pod-rbf; without it what `config` says, else mh.
    preset
        fast, or paper for exactly what the paper does.
    settings
        Over `config` and the preset: a dictionary, nested or with dotted names ({"level": {"epochs": 20}} or
        {"level.epochs": 20}), or texts "level.epochs=20". Fields: `surrogates.settings.Settings`.
    config
        YAML file with the same fields.
    seed, epochs
        Random seed, and epochs of every level; over all of the above.
    seeds
        Trainings, with this seed and the next ones, one after the other; the model is their mean, and its band follows how
        far they lie apart. It takes as many times as long to train, and to predict, as one.
    test
        Runs held out for testing: "27:36", names, a number or a fraction (drawn at random, seeded).
    targets
        What is learnt beside the displacements: "history:wall_force", a channel, a pattern, or the name of a resultant.
    coarse
        Dataset of runs of the same structure on a coarser mesh, which help where fine runs are few (mh, pod-gpr). Parts are
        matched by name or number, parameters by name. Folds over the fine runs decide whether they are used.
    hierarchy
        Mesh hierarchy of a dataset in memory, as `crashkit.coarsen(dataset)` returns it. A dataset on disk has its own.
    device
        cpu, cuda, mps, or the best there is (auto).
    resume
        Go on where an interrupted training of the same settings on the same data stopped.
    overwrite
        Replace a model that is already in `output`.
    checkpoint_every
        Epochs between two notes of the state of the training, kept beside `output` until it is done; 0: about every
        half minute.
    tensorboard
        Folder for TensorBoard files.
    report
        Called with (level, epochs done, epochs, note) after every epoch.
    on_epoch
        Called with the losses and rates of every epoch.
    progress
        Show a line of progress in a notebook; "auto": where this is one.

    Returns
    -------
    Model
        To be asked with `predict`, `encode` and others.

    Raises
    ------
    SurrogateError
        For settings and data that do not fit; an unknown setting is named with the nearest one that there is. Diverged,
        which is one, where a loss is not finite: then the last good weights are stored.
    DataError, ReadError
        For the dataset.
    OutputError
        Where `output` cannot be written.
    """
    from crashkit.extras import need

    need("training a model", "train")
    from crashkit.api.campaign import open_campaign
    from crashkit.api.source import source_of
    from crashkit.output import check_model_folder
    from crashkit.presence import require_dataset
    from surrogates.devices import check_device_name
    from surrogates.errors import SurrogateError
    from surrogates.settings import settings as all_settings

    given: dict[str, Any] = {} if seed is None else {"seed": seed}
    given |= {} if seeds is None else {"seeds": seeds}
    given |= {} if epochs is None else {"level.epochs": epochs, "transfer.epochs": 1}
    if targets:
        given["targets"] = list(dict.fromkeys(["displacement", *targets]))
    chosen = all_settings(model, preset, config, [settings, given])
    check_device_name(device)
    folder = None if output is None else Path(output)
    if folder is not None:
        check_model_folder(folder, overwrite, resume)
    elif resume:
        raise SurrogateError("resume goes on with a training beside its model folder; give output")
    if coarse is not None:
        from surrogates.training.coarse import check_coarse_settings

        check_coarse_settings(chosen)
    for given_path in (dataset, coarse):
        if isinstance(given_path, (str, Path)):
            require_dataset(given_path)
    symmetry = chosen.model in ("mh", "podnn", "pod-gpr", "pod-rbf") and chosen.physics.symmetry == "auto"
    odd = chosen.physics.odd or ()
    source = source_of(dataset, hierarchy)
    if coarse is not None:
        from crashkit.api.coarse_runs import check_count, coarse_runs

        check_count(coarse)
    campaign = open_campaign(source, test, symmetry=symmetry, odd=odd)
    give_back()  # the search for mirror planes leaves much free between what stays
    if coarse is not None:
        campaign = replace(campaign, coarse=coarse_runs(coarse, campaign, source))
    # From here on torch is needed: what can be refused without it was.
    from crashkit.api.model import Model
    from crashkit.api.numbers import NumberJudge
    from surrogates.storage.folder import save
    from surrogates.training.checkpoints import Checkpoints
    from surrogates.training.loop import Diverged
    from surrogates.training.train import train_surrogate

    judge = NumberJudge.of(chosen, campaign)
    state = None if folder is None else folder.with_name(f".{folder.name}.training")
    with (
        tempfile.TemporaryDirectory(prefix="crashkit-") as scratch,
        _processes(device) as first,
        _enough_threads(largest_product(chosen, campaign)),
        _tensorboard(tensorboard if first else None) as note,
    ):
        keeper = Checkpoints(
            state or Path(scratch) / "training", chosen, campaign, every=checkpoint_every, resume=resume
        )

        tell_progress = watched(report, progress)

        def tell(epoch: Epoch) -> None:
            note(epoch)
            tell_progress(epoch.name, epoch.epoch, epoch.epochs, epoch.note())
            if on_epoch is not None:
                on_epoch(epoch)

        rescued = None if folder is None or not first else _rescued(folder, keeper.fingerprint, overwrite)
        if rescued is not None:
            keeper.discard()
            return Model(rescued, folder)
        try:
            surrogate = train_surrogate(campaign, chosen, device=device, report=tell, keeper=keeper, watch=judge)
            if judge is not None and surrogate.core.numbers:
                judge.note(surrogate)
        except SurrogateError as error:
            if first and folder is not None and isinstance(error, Diverged) and error.surrogate is not None:
                save(error.surrogate, folder, overwrite=overwrite)
            if first and not resume:
                keeper.discard()
            raise
        if first and folder is not None:
            _store(surrogate, folder, keeper.fingerprint, overwrite)
            if not interrupted(surrogate):
                keeper.discard()
    return Model(surrogate, folder)


def _spare(folder: Path, fingerprint: str) -> Path:
    """Where a model is kept that could not be stored as `folder`: the same place for the same training."""
    import hashlib

    place = hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"crashkit-kept-{fingerprint}-{place}"


def _store(surrogate: Surrogate, folder: Path, fingerprint: str, overwrite: bool) -> None:
    """Store the trained model; where the disk refuses, keep it elsewhere, so that the hours are not lost.

    Raises OutputError that names the place and what to do.
    """
    from crashkit.errors import OutputError
    from surrogates.errors import ModelFolderError
    from surrogates.storage.folder import save

    try:
        save(surrogate, folder, overwrite=overwrite)
    except ModelFolderError as error:
        spare = _spare(folder, fingerprint)
        try:
            save(surrogate, spare, overwrite=True)
        except ModelFolderError:
            raise error from None
        raise OutputError(
            f"{error}. The trained model is kept in {spare}: once there is room, the same command stores it without training again"
        ) from error


def _rescued(folder: Path, fingerprint: str, overwrite: bool) -> Surrogate | None:
    """The model that an earlier start of the same training could not store, now stored as `folder`; None without one."""
    import os
    import shutil

    from surrogates.errors import ModelFolderError
    from surrogates.storage.folder import load, save

    spare = _spare(folder, fingerprint)
    if not spare.is_dir() or (hasattr(os, "getuid") and spare.stat().st_uid != os.getuid()):
        return None
    try:
        surrogate = load(spare)
    except ModelFolderError:
        return None
    save(surrogate, folder, overwrite=overwrite)
    shutil.rmtree(spare, ignore_errors=True)
    surrogate.record.notes.append("was trained by an earlier start, which could not store it")
    return surrogate


def interrupted(surrogate: Surrogate) -> bool:
    """Whether the training was ended early by Ctrl-C: its state is kept, so that --resume can go on."""
    return any(fit.status == "interrupted" for fit in surrogate.record.fits.values())


# A living training writes its state every half minute.
_DEAD_AFTER = 600.0


def left_behind(output: str | Path, *, resume: bool = False) -> list[str]:
    """What trainings that were killed have left beside the model folder `output`, and what can be done: a sentence each.

    Parameters
    ----------
    resume
        Whether the training of `output` is gone on with, which is then no news.
    """
    import time

    output, out = Path(output), []
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
        out.append(f"{left.name} ({size:.1f} MB) is left of a training that was killed: it {what}")
    return out


# Below this many numbers in the largest array of a step, handing work to a second thread costs more than it saves: a
# step of small networks is hundreds of short operations, each of which waits for the slowest thread.
_WORTH_A_THREAD = 1_000_000


def largest_product(chosen: Settings, campaign: Campaign) -> int:
    """How many numbers the widest convolution or dense layer of one training step makes, over all levels."""
    out = 0
    for number in chosen.levels or tuple(level.index for level in campaign.levels):
        level = chosen.for_level(number)
        nodes = campaign.n_nodes if number == 0 else campaign.levels[number - 1].n_nodes
        width = {"gcn": max(3, *level.channels), "pod": 0}.get(level.reduction, 3)
        out = max(out, nodes * width * level.batch)
    return out


@contextlib.contextmanager
def _enough_threads(numbers: int) -> Iterator[None]:
    """One thread for small networks; as many as torch would take for large ones."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(before if numbers > _WORTH_A_THREAD else 1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _processes(device: str) -> Iterator[bool]:
    """Join the other processes that torchrun started; gives whether this is the one that writes."""
    import os

    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield True
        return
    import torch
    from torch import distributed

    cuda = device.startswith("cuda") or (device == "auto" and torch.cuda.is_available())
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield distributed.get_rank() == 0
    finally:
        distributed.destroy_process_group()


@contextlib.contextmanager
def _tensorboard(folder: str | Path | None) -> Iterator[Callable[[Epoch], None]]:
    """A listener that writes losses and learning rate for TensorBoard into `folder`; without one it does nothing."""
    if folder is None:
        yield lambda epoch: None
        return
    from crashkit.extras import need

    need("writing TensorBoard files", "tracking")
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder))

    def note(epoch: Epoch) -> None:
        for name in ("total", "approximation", "reconstruction", "validation", "learning_rate"):
            writer.add_scalar(f"{epoch.name}/{name}", getattr(epoch, name), epoch.epoch)

    try:
        yield note
    finally:
        writer.close()
