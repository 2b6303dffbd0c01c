"""One HTML file with sliders: models, mesh and program in it; no server, no network.

What a model needs is given as plain values and arrays (`BrowserModel`); the page does the arithmetic itself (`model.js`)
and draws with WebGL (`viewer.js`).
"""

from __future__ import annotations

import base64
import gzip
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import EvaluationError


@dataclass(frozen=True)
class BrowserModel:
    """A model as the page computes it.

    Parameters
    ----------
    about
        Plain values: name, kind ("process" or "cascade"), parameters, levels, registration and so on, as `model.js` reads
        them; where it says the name of an array, that one of `arrays` is meant.
    arrays
        Numbers by name. Those named in `quantised` may be rounded to whole steps, 32767 for the largest of each column.
    """

    about: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    quantised: frozenset[str] = frozenset()


@dataclass(frozen=True)
class ExplorerMesh:
    """The full mesh: position (node, 3), m; faces (face, 3 or 4), -1 behind a triangle; node_id; parts: name -> nodes."""

    position: NDArray[np.float64]
    faces: NDArray[np.int32]
    node_id: NDArray[np.int64] | None = None
    parts: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


def explorer_page(
    title: str,
    models: Sequence[BrowserModel],
    mesh: ExplorerMesh,
    *,
    about: str = "",
    note: str = "",
    largest: float = 1.0,
    axis: int = 3,
    share: float = 0.9,
) -> str:
    """The page.

    Parameters
    ----------
    largest
        Displacement, m, at the upper end of the colours.
    axis
        0, 1, 2 for the direction in which numbers are given first, 3 for all.
    share
        Of the band.

    Raises
    ------
    EvaluationError
        Without a model, or if models take different parameters.
    """
    if not models:
        raise EvaluationError("no model was given; the page needs at least one")
    names = [[p["name"] for p in m.about["parameters"]] for m in models]
    if any(sorted(n) != sorted(names[0]) for n in names):
        raise EvaluationError("the models take different parameters; a page shows models of one campaign")
    arrays: dict[str, NDArray[Any]] = {
        "mesh_reference": mesh.position.astype(np.float32).ravel(),
        "mesh_faces": triangles(mesh.faces).astype(np.uint32).ravel(),
    }
    if mesh.node_id is not None:
        arrays["mesh_node_id"] = mesh.node_id.astype(np.int32)
    parts = []
    for k, (name, nodes) in enumerate(mesh.parts.items()):
        arrays[f"mesh_part_{k}"] = nodes.astype(np.uint32)
        parts.append({"name": name, "nodes": f"mesh_part_{k}"})
    steps: dict[str, list[float]] = {}
    for model in models:
        for name, values in model.arrays.items():
            if name in model.quantised:
                arrays[name], steps[name] = quantised(values)
            else:
                arrays[name] = values
    bundle = {
        "about": about, "largest": largest, "axis": axis, "share": share,
        "models": [m.about for m in models],
        "mesh": {
            "nodes": len(mesh.position), "reference": "mesh_reference", "faces": "mesh_faces", "parts": parts,
            "node_id": None if mesh.node_id is None else "mesh_node_id",
        },
        "arrays": {name: packed(values, steps.get(name)) for name, values in arrays.items()},
    }  # fmt: skip
    home = files("evaluation.explorer")
    script = "\n".join(home.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in ("viewer", "model", "page"))
    page = home.joinpath("explorer.html").read_text(encoding="utf-8")
    # The bundle goes in last, so that nothing in it is taken for a place to fill.
    for place, text in (("title", html.escape(title)), ("note", html.escape(note)), ("script", script)):
        page = page.replace("{{ " + place + " }}", text)
    return page.replace(
        "{{ bundle }}", json.dumps(bundle, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    )


def triangles(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """(face, 3 or 4) with -1 behind a triangle -> (triangle, 3)."""
    if faces.shape[1] == 3:
        return faces
    quads = faces[faces[:, 3] >= 0]
    return np.concatenate([faces[:, :3], quads[:, [0, 2, 3]]])


def quantised(values: NDArray[Any]) -> tuple[NDArray[np.int16], list[float]]:
    """Whole numbers for each column of (row, column), and the step of each column."""
    largest = np.abs(values).max(axis=0)
    step = np.where(largest > 0, largest / 32767, 1.0)
    return np.round(values / step).astype(np.int16).ravel(), [float(s) for s in step]


def packed(values: NDArray[Any], steps: list[float] | None = None) -> dict[str, Any]:
    """An array as the page unpacks it: byte planes, gzipped, base64."""
    kind = {"f4": "<f4", "f8": "<f8", "i4": "<i4", "u4": "<u4", "i2": "<i2", "i8": "<i4"}[values.dtype.str[1:]]
    raw = np.ascontiguousarray(values.ravel().astype(kind))
    planes = raw.view(np.uint8).reshape(-1, raw.dtype.itemsize).T.tobytes()
    out: dict[str, Any] = {
        "kind": kind[1:],
        "data": base64.b64encode(gzip.compress(planes, 9, mtime=0)).decode("ascii"),
    }
    if steps is not None:
        out["steps"] = steps
    return out
