"""A cascade as lists of steps on named vectors, one list per level: what a program without torch has to do.

    inputs -> regression of each level, coarsest first -> z -> decoders, each lifted to the next finer level and added

Vectors of nodes stand node by node, three coordinates each. Names are those of `evaluation/explorer/model.js`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.errors import SurrogateError
from surrogates.models.cascade import Cascade
from surrogates.models.level import LevelNetwork
from surrogates.operators.convolutions import ChebConv
from surrogates.operators.stacks import GraphDecoder
from surrogates.operators.upsampling import Upsampling
from surrogates.reductions.reduction import DenseReduction, GraphReduction, LinearReduction, Reduction, SumReduction
from surrogates.regression.latent_process import LatentProcess

_ACTIVATIONS: Mapping[type[nn.Module], str] = {nn.ELU: "elu", nn.SiLU: "silu", nn.Tanh: "tanh", nn.GELU: "gelu"}


# Share of the largest displacement by which a rounded column of modes may be wrong: many add up, and 1e-4 is promised.
SHARE = 3e-6
# Dense layers are rounded to this share of the largest weight of each column.
_DENSE = 2.0**-19


def cascade_steps(
    members: Sequence[Cascade], levels: list[dict[str, Any]], arrays: dict[str, NDArray[Any]], prefix: str,
    rounded: dict[str, NDArray[np.float64]], known: Tensor | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Give each of `levels` (see `browser`) its `steps`, put numbers into `arrays`; the rest is returned.

    The steps end in `out`, m, the mean of `outs`, one for each of the `members`. What does nothing is left out: an
    untrained remainder, and networks beside a process that has the whole share.

    Parameters
    ----------
    rounded
        Filled with the steps to which columns of arrays may be rounded (`Browsable.steps`).
    known
        (sample, input) scaled inputs of training runs, which say how large latent numbers become; without them nothing
        that depends on it is rounded.

    Raises
    ------
    SurrogateError
        For a part of the model that has no such form.
    """
    writer = _Writer(arrays, prefix, rounded)
    if known is not None:
        for cascade in members:
            writer.measure(cascade, known)
    for told in levels:
        writer.steps = []
        outs = []
        for cascade in members:
            level = cascade.levels[told["number"]]
            with torch.no_grad():
                states = writer.decode(level, writer.regress(level))
            outs.append(writer.add("times", of=states, factor=float(level.scale)))
        if len(outs) > 1:
            writer.add("times", "out", of=writer.add("sum", of=outs), factor=1 / len(outs))
        else:
            writer.steps[-1]["out"] = "out"
        told |= {"steps": writer.steps, "outs": outs if len(outs) > 1 else ["out"]}
    inputs = members[0].inputs
    scaling = {
        "low": inputs.low.tolist(), "high": inputs.high.tolist(), "products": inputs.products, "angles": list(inputs.angles),
    }  # fmt: skip
    return {"kind": "cascade", "scaling": scaling}


class _Writer:
    """Collects steps; equal tensors, which several levels or trainings use, are kept once."""

    def __init__(self, arrays: dict[str, NDArray[Any]], prefix: str, rounded: dict[str, NDArray[np.float64]]) -> None:
        self.arrays, self.prefix, self.rounded = arrays, prefix, rounded
        self._columns: dict[int, NDArray[np.float64]] = {}
        self._latent: dict[int, NDArray[np.float64]] = {}
        self.steps: list[dict[str, Any]] = []
        self._kept: dict[tuple[bytes, str], str] = {}
        self._count = 0

    def array(self, tensor: Tensor, dtype: Any = np.float32, steps: NDArray[np.float64] | None = None) -> str:
        """The name under which `tensor` is kept, row by row; `steps` it may be rounded to, see `Browsable`."""
        values = np.ascontiguousarray(tensor.detach().cpu().numpy().astype(dtype))
        name = self.numbers(values)
        if steps is not None:
            self.rounded[name] = np.minimum(steps, self.rounded.get(name, np.inf))
        return name

    def numbers(self, values: NDArray[Any]) -> str:
        """The name under which `values` are kept."""
        key = (hashlib.sha256(values.tobytes()).digest(), values.dtype.str)
        if key not in self._kept:
            self._kept[key] = f"{self.prefix}t{len(self._kept)}"
            self.arrays[self._kept[key]] = values if values.ndim == 2 else values.ravel()
        return self._kept[key]

    def add(self, step: str, out: str = "", **values: Any) -> str:
        if not out:
            self._count += 1
            out = f"v{self._count}"
        self.steps.append({"step": step, "out": out, **values})
        return out

    @torch.no_grad()
    def measure(self, cascade: Cascade, known: Tensor) -> None:
        """Find out to what modes and latent numbers of `cascade` may be rounded, from inputs (sample, input) that occur."""
        for level in cascade.levels.values():
            if level.with_initial:
                return
            reach = level.regress(known).abs().amax(dim=0).double().numpy()
            parts = _linear_parts(level)
            if parts is None:
                continue
            sizes = np.zeros(level.latent)
            for factor, matrix in parts:
                columns = factor * matrix.abs().amax(dim=0).double().numpy()
                sizes[: len(columns)] = np.maximum(sizes[: len(columns)], columns)
            allowed = SHARE * float((sizes * reach).max())
            for factor, matrix in parts:
                some = reach[: matrix.shape[1]]
                step = allowed / np.maximum(factor * some, 1e-30)
                key = id(matrix)
                self._columns[key] = np.minimum(step, self._columns.get(key, np.full(len(step), np.inf)))
            self._latent[id(level)] = allowed / np.maximum(sizes, 1e-30)

    # ------------------------------------------------------------------------------------------ regression

    def regress(self, level: LevelNetwork) -> str:
        """z of `level` from the scaled inputs."""
        if level.with_initial:
            raise SurrogateError("inputs.initial_state has no form for a browser; train without it")
        if level.process is not None and float(level.process.share) == 1:
            return self.process(level)
        below = None if level.coarse is None else self.regress(level.coarse)
        read = "inputs" if below is None else self.add("concat", of=["inputs", below])
        z = self.team(level.regressor.network, read)
        course = getattr(level, "course", None)
        if course is not None:
            z = self.add(
                "course", of=z, column=int(getattr(level, "time_column", -1)), time=self.array(course.time, dtype=np.float64),
                mean=self.array(course.mean), growth=self.array(course.growth),
            )  # fmt: skip
        if below is not None and level.regressor.residual:
            z = self.add("sum", of=[z, below])
        if level.process is not None:
            z = self.add("mix", of=[z, self.process(level)], share=float(level.process.share))
        return z

    def team(self, network: nn.Module, of: str) -> str:
        """A fully connected network, or the mean of several of one shape."""
        if isinstance(network, nn.Sequential):
            return self.dense(network, of)
        depth, members = int(network.depth), int(network.members)  # type: ignore[arg-type]
        activation = self.activation(network.activation)  # type: ignore[arg-type]
        ends = []
        for k in range(members):
            now = of
            for i in range(depth):
                weight, bias = (
                    network.get_parameter(f"weight_{i}")[k].T.contiguous(),
                    network.get_parameter(f"bias_{i}")[k, 0],
                )
                now = self.add("linear", of=now, weight=self.array(weight), bias=self.array(bias))
                if i < depth - 1:
                    now = self.add("activation", of=now, kind=activation)
            ends.append(now)
        return self.add("times", of=self.add("sum", of=ends), factor=1 / members) if members > 1 else ends[0]

    def dense(self, network: nn.Module, of: str) -> str:
        for layer in network.children():
            if isinstance(layer, nn.Linear):
                of = self.linear(layer, of)
            else:
                of = self.add("activation", of=of, kind=self.activation(layer))
        return of

    def linear(self, layer: nn.Linear, of: str) -> str:
        largest = layer.weight.abs().amax(dim=0).double().numpy()
        weight = self.array(layer.weight, steps=_DENSE * np.maximum(largest, 1e-30))
        return self.add("linear", of=of, weight=weight, bias=self.array(layer.bias))

    def activation(self, layer: nn.Module) -> str:
        if type(layer) not in _ACTIVATIONS:
            raise SurrogateError(f"activation {type(layer).__name__} has no form for a browser")
        return _ACTIVATIONS[type(layer)]

    def process(self, level: LevelNetwork) -> str:
        process = level.process
        assert process is not None
        own, over = self.kernel(process, level), process.over
        if over is None:
            return own
        beside = [] if over.beside is None else [self.kernel(over.beside, level)]
        return self.add("sum", of=[own, *beside, self.kernel(over.below, level)])

    def kernel(self, process: LatentProcess, level: LevelNetwork) -> str:
        """What the runs of one process say."""
        steps = self._latent.get(id(level))
        if steps is not None:
            weights = process.weights(process.runs).norm(dim=1).max()
            steps = steps / float(weights)
        return self.add(
            "kernel", of="inputs", runs=self.array(process.runs, dtype=np.float64), mix=self.array(process.mix, dtype=np.float64),
            numbers=[float(v) for v in process.numbers], time=self.array(process.time, dtype=np.float64),
            mean=self.array(process.mean, dtype=np.float64), pull=self.array(process.pull.flatten(1), np.float64, steps),
            parameters=process.runs.shape[1], samples=process.runs.shape[0],
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------ decoding

    def decode(self, level: LevelNetwork, z: str) -> str:
        """States of `level` from z, in its own unit."""
        made = self.reduction(level.reduction, z)
        if level.coarse is not None and level.upsampling is not None:
            part = z if level.coarse.latent == level.latent else self.add("first", of=z, count=level.coarse.latent)
            lifted = self.lift(
                level.upsampling, self.add("times", of=self.decode(level.coarse, part), factor=level.ratio)
            )
            made = self.add("sum", of=[lifted, made])
        if getattr(level, "at_rest", False):
            zero = next(level.reduction.parameters()).new_zeros(1, level.latent)
            rest = self.at_zero(level, zero)
            made = self.add("minus", of=made, array=self.array(rest))
        return made

    def at_zero(self, level: LevelNetwork, zero: Tensor) -> Tensor:
        """What a latent vector of zeros is decoded as, which a level at rest takes away: (node, 3)."""
        level.at_rest = False
        try:
            return level.decode(zero)[:, 0].contiguous()
        finally:
            level.at_rest = True

    def reduction(self, reduction: Reduction, z: str) -> str:
        if isinstance(reduction, SumReduction):
            if gives_zero(reduction.remainder):
                return self.reduction(reduction.linear, z)
            return self.add("sum", of=[self.reduction(reduction.linear, z), self.reduction(reduction.remainder, z)])
        if isinstance(reduction, LinearReduction):
            return self.add(
                "linear", of=z, bias=self.array(reduction.offset),
                weight=self.array(reduction.decode_matrix, steps=self._columns.get(id(reduction.decode_matrix))),
            )  # fmt: skip
        if isinstance(reduction, DenseReduction):
            return self.dense(reduction.decoder, z)
        if isinstance(reduction, GraphReduction):
            return self.graph(reduction.decoder, z)
        raise SurrogateError(f"reduction {type(reduction).__name__} has no form for a browser")

    def graph(self, decoder: GraphDecoder, z: str) -> str:
        now = self.add("activation", of=self.linear(decoder.dense, z), kind="elu")
        for layer in decoder.convolutions.layers:
            if not isinstance(layer, ChebConv):
                raise SurrogateError(
                    "only Chebyshev convolutions have a form for a browser; train with level.convolution=cheb"
                )
            order, inputs, outputs = layer.weight.shape
            columns, entries = self.operator(layer)
            now = self.add(
                "chebyshev", of=now, columns=columns, entries=entries, weight=self.array(layer.weight),
                bias=None if layer.bias is None else self.array(layer.bias), nodes=decoder.n_nodes, inputs=inputs,
                outputs=outputs, order=order,
            )  # fmt: skip
            if layer.elu:
                now = self.add("activation", of=now, kind="elu")
        return now

    def operator(self, layer: ChebConv) -> tuple[str, str]:
        """The graph's operator row by row."""
        columns, entries = side_by_side(layer.operator.matrix)
        return self.numbers(columns), self.numbers(entries)

    def lift(self, upsampling: Upsampling, of: str) -> str:
        if upsampling.kind == "linear":
            import scipy.sparse as sp

            columns, weights = side_by_side(sp.csr_matrix(upsampling.weight.detach().numpy()))
            names = [self.numbers(columns), self.numbers(weights)]
        else:
            names = [self.array(upsampling.columns, dtype=np.uint32), self.array(upsampling.weight)]
        bias = None if upsampling.kind == "static" else self.array(upsampling.bias)
        return self.add("gather", of=of, columns=names[0], weights=names[1], bias=bias, nodes=upsampling.shape[0])


def gives_zero(reduction: Reduction) -> bool:
    """Whether it decodes everything as zero, as one beside a linear part does until it is trained."""
    if isinstance(reduction, GraphReduction):
        last: Any = reduction.decoder.convolutions.layers[-1]
    elif isinstance(reduction, DenseReduction):
        last = [layer for layer in reduction.decoder.children() if isinstance(layer, nn.Linear)][-1]
    else:
        return False
    return not any(bool(values.any()) for values in last.parameters())


def _linear_parts(level: LevelNetwork) -> list[tuple[float, Tensor]] | None:
    """Decoding matrices of a level and of those below it, each with its unit against the level's; None for another kind."""
    linear = level.reduction.linear if isinstance(level.reduction, SumReduction) else level.reduction
    if not isinstance(linear, LinearReduction):
        return None
    out = [(1.0, linear.decode_matrix)]
    if level.coarse is None:
        return out  # type: ignore[return-value]
    below = _linear_parts(level.coarse)
    return None if below is None else [*out, *((factor * level.ratio, matrix) for factor, matrix in below)]


def side_by_side(matrix: Any) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """The few entries of each row of a sparse matrix: columns and weights (row * width,), filled up with zeros."""
    csr = matrix.tocsr()
    counts = np.diff(csr.indptr)
    width = int(counts.max(initial=1))
    columns = np.zeros((csr.shape[0], width), np.uint32)
    weights = np.zeros((csr.shape[0], width), np.float32)
    places = np.arange(len(csr.indices)) - np.repeat(csr.indptr[:-1], counts)
    rows = np.repeat(np.arange(csr.shape[0]), counts)
    columns[rows, places], weights[rows, places] = csr.indices, csr.data
    return columns.ravel(), weights.ravel()
