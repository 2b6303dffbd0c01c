"""A level as one file for programs without this package: ONNX, or a torch.export program; every graph in dense form.

Inputs: parameters (batch, parameter) float64 in the units of the training data, and time (batch,) float64, s. Output:
displacement (batch, node, 3) float32, m, on the level's nodes, or on the full mesh.
"""

from __future__ import annotations

import itertools
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from data_schema.replace import beside
from surrogates.errors import SurrogateError
from surrogates.models.base import Network
from surrogates.operators.convolutions import exportable
from surrogates.operators.upsampling import Upsampling
from surrogates.physics.registration import Registration
from surrogates.surrogate import Surrogate

SUFFIXES = (".onnx", ".pt2")
# Largest difference to the surrogate itself, relative to its largest displacement, at which a file is accepted.
TOLERANCE = 1e-4


class LevelProgram(nn.Module):
    """(parameters, time) -> displacements of one level, lifted to the full mesh by its static U if asked."""

    def __init__(
        self, network: Network, number: int, lift: Upsampling | None, registration: Registration | None = None
    ) -> None:
        super().__init__()
        self.network = network
        self.registration = registration
        self.number = number
        self.lift = lift

    def forward(self, parameters: Tensor, time: Tensor) -> Tensor:
        inputs, size = parameters, None
        if self.registration is not None and not self.registration.is_identity:
            inputs, time, size = _registered(self.registration, parameters, time)
        states = self.network(inputs, time, self.number)
        out: Tensor = (states if self.lift is None else self.lift(states)).transpose(0, 1)
        return out if size is None else out * size[:, None, None].to(out.dtype)


def _registered(registration: Registration, parameters: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs (b, input), reference times (b,) and sizes (b,) of parameters (b, parameter) and times (b,)."""
    columns = []
    for column in registration.inputs.columns:
        if column.logarithm:
            terms = [power * parameters[:, k].log() for k, power in enumerate(column.powers) if power]
            columns.append(torch.stack(terms).sum(dim=0))
        else:
            value = parameters[:, column.powers.index(1)]
            columns.append(_asinh(value / column.width) if column.width else value)
    if registration.symmetry.flagged:
        columns.append(torch.zeros_like(parameters[:, 0]))
    clock = registration.clock
    rate = torch.ones_like(parameters[:, 0])
    for k, power in enumerate(clock.exponents):
        if power:
            rate = rate * (parameters[:, k] / clock.reference[k]) ** power
    size = torch.ones_like(rate)
    if clock.speed is not None:
        size = parameters[:, clock.speed] / clock.reference[clock.speed] / rate
        time = clock.start + (time - clock.start) * rate
    return torch.stack(columns, dim=1), time, size


def _asinh(x: Tensor) -> Tensor:
    """As torch.asinh, from operations that ONNX Runtime has in double precision."""
    return x.sign() * (x.abs() + (x.square() + 1).sqrt()).log()


def export(surrogate: Surrogate, path: str | Path, level: int | None = None, *, full: bool = False) -> float:
    """Write `level` (default: the finest) to `path`, .onnx or .pt2 by the suffix, and hold it against the surrogate.

    Returns the largest difference on the corners and the middle of the trained range, relative to the largest
    displacement. The file only stands under its name if that is at most `TOLERANCE`.

    Raises
    ------
    SurrogateError
        For POD regressions, other suffixes, missing packages, and a file that disagrees.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise SurrogateError(f"{path}: the suffix says what is written; expected {' or '.join(SUFFIXES)}")
    if not isinstance(surrogate.core, Network):
        raise SurrogateError(
            f"{surrogate.settings.model} is no network; export takes mh, podnn, aenn and gaenn. Its folder holds plain arrays"
        )
    number = min(surrogate.core.numbers) if level is None else level
    lift = Upsampling(surrogate.graphs.to_full(number), "static") if full and number else None
    program = LevelProgram(surrogate.core, number, lift, surrogate.registration).eval()
    parameters, time = _probes(surrogate, _batch_unlike(program))
    states = surrogate.predict_full if full else surrogate.predict
    wanted = np.stack([states(p, t[None], number)[0] for p, t in zip(parameters, time, strict=True)])
    with beside(path) as new:
        with exportable(program), _quiet(), torch.no_grad():
            exported = torch.export.export(
                program,
                (torch.from_numpy(parameters), torch.from_numpy(time)),
                dynamic_shapes={
                    "parameters": {0: torch.export.Dim("batch", min=1)},
                    "time": {0: torch.export.Dim("batch", min=1)},
                },
            )
            found = (_write_onnx if path.suffix == ".onnx" else _write_program)(exported, new, parameters, time)
        error = float(np.abs(found - wanted).max() / (np.abs(wanted).max() or 1.0))
        if not error <= TOLERANCE:
            raise SurrogateError(
                f"{path}: the exported model differs by {error:.1e} of the largest displacement; not kept"
            )
    return error


def _write_onnx(
    exported: torch.export.ExportedProgram, path: Path, parameters: np.ndarray, time: np.ndarray
) -> np.ndarray:
    try:
        import onnxruntime
        import onnxscript  # noqa: F401 - torch.onnx needs it
    except ImportError as error:
        raise SurrogateError(
            "ONNX files need onnx, onnxscript and onnxruntime; pip install 'crashkit[export]'"
        ) from error
    torch.onnx.export(
        exported, f=str(path), dynamo=True, input_names=["parameters", "time"], output_names=["displacement"],
        external_data=False, verbose=False,
    )  # fmt: skip
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"parameters": parameters, "time": time})[0])


def _write_program(
    exported: torch.export.ExportedProgram, path: Path, parameters: np.ndarray, time: np.ndarray
) -> np.ndarray:
    torch.export.save(exported, path)
    program = torch.export.load(path).module()
    return np.asarray(program(torch.from_numpy(parameters), torch.from_numpy(time)).detach().numpy())


def _probes(surrogate: Surrogate, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends and middle of every range, and points drawn between them: (count, parameter) and (count,)."""
    ranges = surrogate.record.ranges
    low, high = np.append(ranges.low, ranges.time[0]), np.append(ranges.high, ranges.time[1])
    fixed = np.array([[0.0], [0.5], [1.0]]) + np.zeros(len(low))
    share = np.concatenate([fixed, np.random.default_rng(0).random((count - 3, len(low)))])
    at = low + share * (high - low)
    return np.ascontiguousarray(at[:, :-1]), np.ascontiguousarray(at[:, -1])


def _batch_unlike(program: nn.Module) -> int:
    """A batch size that is no size of any tensor inside: torch.export takes equal sizes for one and the same."""
    taken = {size for tensor in (*program.parameters(), *program.buffers()) for size in tensor.shape}
    return next(k for k in itertools.count(9) if k not in taken)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporters' chatter."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
