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
        Numbers by name.
    steps
        For arrays (row, column) that may be rounded: to multiples of what, for each column or for a group of columns
        that comes again and again.
    """

    about: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    steps: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)


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
    steps: dict[str, NDArray[np.float64]] = {}
    for model in models:
        arrays |= model.arrays
        steps |= model.steps
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


def packed(values: NDArray[Any], steps: NDArray[np.float64] | None = None) -> dict[str, Any]:
    """An array as the page unpacks it: byte planes, gzipped, base64.

    With `steps` for `values` (row, column), see `BrowserModel`: column by column, whole multiples of the steps. What is rounded to
    a step far above its last bit has upper bytes that are zero, which cost nothing.
    """
    whole = None if steps is None else rounded(values, steps)
    kind = {"f4": "<f4", "f8": "<f8", "i4": "<i4", "u4": "<u4", "i8": "<i8"}[values.dtype.str[1:]]
    raw = np.ascontiguousarray(values.ravel().astype(kind)) if whole is None else whole
    planes = raw.view(np.uint8).reshape(-1, raw.dtype.itemsize).T.tobytes()
    out: dict[str, Any] = {
        "kind": kind[1:],
        "data": base64.b64encode(gzip.compress(planes, 9, mtime=0)).decode("ascii"),
    }
    if whole is not None and steps is not None:
        out["steps"], out["columns"] = _told(steps), values.shape[1]
    return out


def rounded(values: NDArray[Any], steps: NDArray[np.float64]) -> NDArray[np.uint32] | None:
    """(column * row,) multiples of the steps: 0, -1, 1, -2, .. as 0, 1, 2, 3, ..; None where they have more than 31 bits."""
    whole = np.rint(values / np.resize(_told(steps), values.shape[1]))
    if not np.abs(whole).max(initial=0) < 2**30:
        return None
    signed = whole.T.astype(np.int64).ravel()
    return np.asarray(np.where(signed < 0, -2 * signed - 1, 2 * signed), np.uint32)


def _told(steps: NDArray[np.float64]) -> list[float]:
    """As many digits as are written into the page."""
    return [float(f"{step:.9g}") for step in steps]
