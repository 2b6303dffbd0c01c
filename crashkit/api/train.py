"""A dataset and settings in, a model folder out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surrogates.data.campaign import Campaign
    from surrogates.settings import Settings
    from surrogates.surrogate import Surrogate
    from surrogates.training.loop import Epoch


def train(
    dataset: str | Path,
    output: str | Path,
    model: str | None = None,
    config: str | Path | None = None,
    overrides: Sequence[str] = (),
    *,
    preset: str | None = None,
    test: str | int | float | slice | Sequence[int | str] | None = None,
    device: str = "auto",
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int = 0,
    tensorboard: str | Path | None = None,
    report: Callable[[Epoch], None] | None = None,
) -> Surrogate:
    """Train a surrogate on the dataset at `dataset` and store it as the folder `output`.

    model      mh, podnn, aenn, gaenn, pod-gpr or pod-rbf; without, what `config` says, else mh
    config     YAML file with the fields of `surrogates.settings.Settings`
    overrides  "path=value", such as "level.epochs=200"; they win over `config`
    preset     fast, or paper for exactly what the paper does
    test       runs that nobody may see: "27:36", names, a number or a fraction (drawn at random, seeded)
    device     cpu, cuda, mps, or the best there is (auto)
    resume     go on where an interrupted training of the same settings on the same data stopped
    overwrite  replace a model that is already in `output`
    checkpoint_every  epochs between two notes of the state of the training, kept beside `output` until it is done;
                      0: about every half minute
    tensorboard       folder for TensorBoard files
    report            told after every epoch

    Ctrl-C ends the training, and what there is gets stored. The folder appears under its name when it is complete.

    Raises SurrogateError for settings and data that do not fit, DataError and ReadError for the dataset, OutputError
    where `output` cannot be written, Diverged where a loss is not finite: then the last good weights are stored.
    """
    from crashkit.extras import need

    need("training a model", "train")
    from crashkit.api.campaign import open_campaign
    from surrogates.errors import SurrogateError
    from surrogates.settings import settings
    from surrogates.storage.folder import save
    from surrogates.training.checkpoints import Checkpoints
    from surrogates.training.loop import Diverged
    from surrogates.training.train import train_surrogate

    output = Path(output)
    chosen = settings(model, preset, config, overrides)
    check_output(output, overwrite)
    by_folds = chosen.model in ("pod-gpr", "pod-rbf")
    campaign = open_campaign(dataset, test, symmetry=by_folds and chosen.physics.symmetry == "auto")
    state = output.with_name(f".{output.name}.training")
    with (
        _processes(device) as first,
        _enough_threads(largest_product(chosen, campaign)),
        _tensorboard(tensorboard if first else None) as note,
    ):
        keeper = Checkpoints(state, chosen, campaign, every=checkpoint_every, resume=resume)

        def tell(epoch: Epoch) -> None:
            note(epoch)
            if report is not None:
                report(epoch)

        try:
            surrogate = train_surrogate(campaign, chosen, device=device, report=tell, keeper=keeper)
        except SurrogateError as error:
            if first and isinstance(error, Diverged) and error.surrogate is not None:
                save(error.surrogate, output, overwrite=overwrite)
            if first and not resume:
                keeper.discard()
            raise
        if first:
            save(surrogate, output, overwrite=overwrite)
            if not interrupted(surrogate):
                keeper.discard()
    return surrogate


def interrupted(surrogate: Surrogate) -> bool:
    """Whether the training was ended early by Ctrl-C: its state is kept, so that --resume can go on."""
    return any(fit.status == "interrupted" for fit in surrogate.record.fits.values())


def check_output(output: Path, overwrite: bool) -> None:
    """Raise OutputError if a model cannot be stored as the folder `output`: better now than after the training."""
    import os

    from crashkit.errors import OutputError

    if output.exists():
        if not output.is_dir() or (any(output.iterdir()) and not (output / "model.json").exists()):
            raise OutputError(f"{output}: exists and is no model folder; choose another place with -o")
        if not overwrite and any(output.iterdir()):
            raise OutputError(f"{output}: holds a model already; replace it with --overwrite, or choose another place")
    home = output.absolute().parent
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another place with -o") from error
    if not os.access(home, os.W_OK | os.X_OK):
        raise OutputError(f"{output}: cannot be written (no permission in {home}); choose another place with -o")


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
