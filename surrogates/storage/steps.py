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


def cascade_steps(
    members: Sequence[Cascade], levels: list[dict[str, Any]], arrays: dict[str, NDArray[Any]], prefix: str
) -> dict[str, Any]:
    """Give each of `levels` (see `browser`) its `steps`, put numbers into `arrays`; the rest is returned.

    The steps end in `out`, m, the mean of `outs`, one for each of the `members`.

    Raises
    ------
    SurrogateError
        For a part of the model that has no such form.
    """
    writer = _Writer(arrays, prefix)
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

    def __init__(self, arrays: dict[str, NDArray[Any]], prefix: str) -> None:
        self.arrays, self.prefix = arrays, prefix
        self.steps: list[dict[str, Any]] = []
        self._kept: dict[tuple[bytes, str], str] = {}
        self._count = 0

    def array(self, tensor: Tensor, dtype: Any = np.float32) -> str:
        """The name under which `tensor` is kept, row by row."""
        return self.numbers(np.ascontiguousarray(tensor.detach().cpu().numpy().astype(dtype)).ravel())

    def numbers(self, values: NDArray[Any]) -> str:
        """The name under which `values` are kept."""
        key = (hashlib.sha256(values.tobytes()).digest(), values.dtype.str)
        if key not in self._kept:
            self._kept[key] = f"{self.prefix}t{len(self._kept)}"
            self.arrays[self._kept[key]] = values
        return self._kept[key]

    def add(self, step: str, out: str = "", **values: Any) -> str:
        if not out:
            self._count += 1
            out = f"v{self._count}"
        self.steps.append({"step": step, "out": out, **values})
        return out

    # ------------------------------------------------------------------------------------------ regression

    def regress(self, level: LevelNetwork) -> str:
        """z of `level` from the scaled inputs."""
        if level.with_initial:
            raise SurrogateError("inputs.initial_state has no form for a browser; train without it")
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
            z = self.add("mix", of=[z, self.process(level.process)], share=float(level.process.share))
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
        return self.add("linear", of=of, weight=self.array(layer.weight), bias=self.array(layer.bias))

    def activation(self, layer: nn.Module) -> str:
        if type(layer) not in _ACTIVATIONS:
            raise SurrogateError(f"activation {type(layer).__name__} has no form for a browser")
        return _ACTIVATIONS[type(layer)]

    def process(self, process: LatentProcess) -> str:
        return self.add(
            "kernel", of="inputs", runs=self.array(process.runs, dtype=np.float64), mix=self.array(process.mix, dtype=np.float64),
            numbers=[float(v) for v in process.numbers], time=self.array(process.time, dtype=np.float64),
            mean=self.array(process.mean, dtype=np.float64), pull=self.array(process.pull, dtype=np.float64),
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
            return self.add("sum", of=[self.reduction(reduction.linear, z), self.reduction(reduction.remainder, z)])
        if isinstance(reduction, LinearReduction):
            return self.add(
                "linear", of=z, weight=self.array(reduction.decode_matrix), bias=self.array(reduction.offset)
            )
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
