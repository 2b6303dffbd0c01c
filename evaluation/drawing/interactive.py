"""One run in three dimensions inside a web page: truth beside prediction, with a time slider, without a network.

The page is what PyVista's export makes: the scene as VTK.js reads it, in the viewer that comes with trame-vtk
(the `viewer` extra). PyVista's own function starts a web server to get there; here the same exporter is called
directly. The exported scene holds one state; the others travel beside it as 16-bit positions, and a few lines of
script move the points when the slider moves.
"""

from __future__ import annotations

import base64
import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_schema.levels import Level
from evaluation.drawing.pictures import DISPLACEMENT, ERROR
from evaluation.drawing.rendering import choose_view, off_screen
from evaluation.errors import EvaluationError
from evaluation.measures.projection import last_seen

MAX_NODES = 10_000
MAX_STATES = 31
_FEWEST = 4  # a level is shown if it has at least this part of the nodes that may be shown
_STEPS = 2**16 - 1
_COLOURS = 64


def shown_states(count: int, most: int = MAX_STATES) -> NDArray[np.int64]:
    """Which of `count` states a view shows: all, or so many of them, evenly spread, with first and last."""
    return np.unique(np.round(np.linspace(0, count - 1, min(most, count))).astype(np.int64))


def interactive_view(
    points: ArrayLike,
    faces: ArrayLike,
    time: ArrayLike,
    truth: ArrayLike,
    prediction: ArrayLike,
    path: str | os.PathLike[str] | None = None,
    *,
    names: tuple[str, str] = ("truth", "prediction"),
    title: str = "truth and prediction",
    alive: ArrayLike | None = None,
    levels: Sequence[Level] = (),
    max_nodes: int = MAX_NODES,
    max_states: int = MAX_STATES,
) -> str:
    """A whole HTML page that shows one run; also written to `path` unless that is None.

    The size is bounded: a mesh of more than `max_nodes` nodes is shown on that many of them, chosen as the mesh
    hierarchy chooses them, and of more than `max_states` states as many, evenly spread, with first and last. Positions
    are rounded to 1/65535 of the space the run takes. Errors named in the page are those of all nodes.

    Parameters
    ----------
    points
        (n, 3) reference position, m.
    faces
        (m, 3 or 4), -1 in the last corner of a triangle.
    time
        (t,) s.
    truth, prediction
        (t, n, 3) displacements, m; NaN where nodes are gone.
    alive
        (t, m) bool, False once an element has eroded.
    levels
        The mesh's coarse levels, where there are any: one of them is shown in place of a mesh that is too large.

    Raises
    ------
    EvaluationError
        Where arrays do not belong together, the extra is missing or nothing can be drawn.
    """
    x, corners, times = np.asarray(points, np.float64), np.asarray(faces), np.asarray(time, np.float64)
    u, p = np.asarray(truth), np.asarray(prediction)
    if not u.shape == p.shape == (len(times), *x.shape):
        raise EvaluationError(
            f"truth {u.shape} and prediction {p.shape}: expected {len(times)} states of {len(x)} nodes x 3"
        )
    chosen = shown_states(len(times), max_states)
    u, p = u[chosen], p[chosen]
    living = np.ones((len(chosen), len(corners)), bool) if alive is None else np.asarray(alive, bool)[chosen]
    errors = [
        _errors(a.astype(np.float64), b.astype(np.float64), len(x) > max_nodes) for a, b in zip(u, p, strict=True)
    ]
    x, corners, u, p, living = _thinned(x, corners, u, p, living, levels, max_nodes)
    u, p = u.astype(np.float64), p.astype(np.float64)
    there = np.asarray(np.isfinite(u).all(axis=-1))
    corners, living = _triangles(corners, living & (there[:, corners] | (corners < 0)).all(axis=-1))
    both = np.concatenate([x[None], x + last_seen(u), x[None], x + last_seen(p)])
    origin = both.min(axis=(0, 1))
    step = np.maximum(both.max(axis=(0, 1)) - origin, 1e-9) / _STEPS
    steps = np.round((both - origin) / step).astype(np.uint16)
    half = len(both) // 2
    view = choose_view([both], corners)
    eye = np.cross(view.right, view.up)
    distance = 10 * max(view.width, view.height)
    run = {
        "nodes": len(x),
        "time": times[chosen].tolist(),
        "first": len(chosen) - 1,
        "names": names,
        "origin": origin.tolist(),
        "step": step.tolist(),
        "truth": _packed(steps[:half]),
        "prediction": _packed(steps[half:]),
        "shown": "" if living.all() else _deflated(np.packbits(living).tobytes()),
        "limits": [_limit(u, p), _limit(p - u)],
        "colours": [_colours(DISPLACEMENT), _colours(ERROR)],
        "errors": errors,
        "view": {
            "centre": view.centre.tolist(),
            "position": (view.centre + distance * eye).tolist(),
            "up": view.up.tolist(),
            "width": view.width,
            "height": view.height,
        },
    }
    page = _page(_exported(x, corners), run, title)
    if path is not None:
        Path(path).write_text(page, encoding="utf-8")
    return page


def _errors(truth: NDArray[np.float64], prediction: NDArray[np.float64], thinned: bool) -> str:
    error = 100 * np.linalg.norm(prediction - truth, axis=-1)
    error = error[np.isfinite(error)]
    if not error.size:
        return "no node left"
    of = "all nodes, more than are shown" if thinned else "all nodes"
    return f"error over {of}: mean {error.mean():.2f} cm, largest {error.max():.2f} cm"


def _limit(*fields: NDArray[np.float64]) -> float:
    """The largest length in cm, for a colour bar from zero."""
    return max(1e-9, max(float(np.nanmax(100 * np.linalg.norm(f, axis=-1), initial=0.0)) for f in fields))


def _thinned(
    x: NDArray[np.float64],
    corners: NDArray[Any],
    u: NDArray[np.floating],
    p: NDArray[np.floating],
    living: NDArray[np.bool_],
    levels: Sequence[Level],
    max_nodes: int,
) -> tuple[NDArray[np.float64], NDArray[Any], NDArray[np.floating], NDArray[np.floating], NDArray[np.bool_]]:
    if len(x) <= max_nodes:
        return x, corners, u, p, living
    fitting = [level for level in levels if max_nodes / _FEWEST <= level.n_nodes <= max_nodes]
    if fitting:
        kept, faces = fitting[0].kept, fitting[0].faces
    else:
        from crashkit.mesh.hierarchy import PAIR_SHARE
        from crashkit.mesh.selection import select_quadric
        from crashkit.mesh.surface import surface

        # From the coarsest level that is still too fine, which takes far less time than from the full mesh.
        finer = [level for level in levels if level.n_nodes > max_nodes]
        kept, faces = (finer[-1].kept, finer[-1].faces) if finer else (np.arange(len(x)), corners)
        mesh = surface(x[kept], faces)
        # No lifting: the search for nodes that lift better, and the maps of a hierarchy, would take as long again.
        count = min(max_nodes, int(mesh.used.sum()))
        drawn = select_quadric(mesh, [count], PAIR_SHARE * mesh.diagonal, rounds=0)[0]
        kept, faces = kept[drawn.kept], np.searchsorted(drawn.kept, drawn.faces).astype(np.int32)
    # A coarse face stands for many; it is shown as long as its nodes are there.
    return x[kept], faces, u[:, kept], p[:, kept], np.ones((len(u), len(faces)), bool)


def _triangles(corners: NDArray[Any], living: NDArray[np.bool_]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Faces (m, 3 or 4) as triangles, and which of them live (t, m)."""
    if corners.shape[1] == 3:
        return corners, living
    quads = np.flatnonzero(corners[:, 3] >= 0)
    triangles = np.concatenate([corners[:, :3], corners[quads][:, [0, 2, 3]]])
    return triangles, np.concatenate([living, living[:, quads]], axis=1)


def _packed(steps: NDArray[np.uint16]) -> str:
    """Differences from state to state, low bytes before high bytes: what deflate makes least of."""
    differences = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1])).ravel()
    return _deflated((differences & 0xFF).astype(np.uint8).tobytes() + (differences >> 8).astype(np.uint8).tobytes())


def _deflated(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def _colours(name: str) -> list[int]:
    """`_COLOURS` colours as r, g, b, r, g, b, .. of 0 to 255."""
    from matplotlib import colormaps

    return (colormaps[name](np.linspace(0, 1, _COLOURS))[:, :3] * 255).round().astype(int).ravel().tolist()


def _exported(x: NDArray[np.float64], triangles: NDArray[Any]) -> bytes:
    """The scene as a VTK.js file: truth on the left; prediction, with the truth as grey lines, on the right."""
    import pyvista as pv

    try:
        import vtkmodules.vtkWebCore  # noqa: F401 - what trame-vtk serializes with
        from trame_vtk.modules.vtk import serializers
    except ImportError as error:
        raise EvaluationError(
            f"the interactive view needs the package {error.name}: install it with pip install 'crashkit[viewer]'"
        ) from error
    with off_screen():
        plotter: Any = pv.Plotter(off_screen=True, shape=(1, 2), window_size=[64, 32], border=False)
        try:
            for side in range(2):
                plotter.subplot(0, side)
                plotter.set_background("white")
                mesh: Any = pv.PolyData.from_regular_faces(x, triangles)
                mesh["rgb"] = np.zeros((len(x), 3), np.uint8)
                plotter.add_mesh(mesh, scalars="rgb", rgb=True, smooth_shading=False, ambient=0.3, diffuse=0.75)
            shadow: Any = pv.PolyData.from_regular_faces(x, triangles)
            # Lines, since VTK.js draws what is translucent across both halves of the window.
            plotter.add_mesh(shadow, color="#b4b8be", style="wireframe", line_width=1, lighting=False)
            plotter.render()
            window = plotter.render_window
            serializers.initialize_serializers()
            context = serializers.SynchronizationContext()
            scene = serializers.serialize(None, window, serializers.reference_id(window), context, 1)
            camera = plotter.renderers[0].camera
            scene["extra"] = {
                "vtkRefId": serializers.reference_id(window),
                "centerOfRotation": camera.focal_point,
                "camera": serializers.reference_id(camera),
            }
            hashes = {
                entry["hash"]: {**entry, "content": context.get_cached_data_array(entry["hash"], False)}
                for entry in serializers.extract_array_hash(scene)
            }
        finally:
            plotter.close()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("index.json", json.dumps({"hashes": hashes, "scene": scene}))
    return packed.getvalue()


def _page(scene: bytes, run: Mapping[str, Any], title: str) -> str:
    """The viewer's page around `scene`, with the controls of `viewer.html`."""
    from html import escape
    from importlib.resources import files

    from jinja2 import Template
    from trame_vtk.tools.vtksz2html import write_html

    out = io.StringIO()
    write_html(scene, out)
    page = out.getvalue()
    template = files("evaluation.drawing").joinpath("viewer.html").read_text(encoding="utf-8")
    controls = Template(template).render(run=json.dumps(run, separators=(",", ":")).replace("<", "\\u003c"))
    head, body, rest = page.partition("<body>")
    start, _, end = head.partition("<title>")
    load = "function loadDataSet() {"
    if not body or "</title>" not in end or load not in rest:
        raise EvaluationError("the viewer of this trame-vtk is not the page expected: install trame-vtk 2.11")
    head = f"{start}<title>{escape(title)}{end[end.index('</title>') :]}"
    return str(head + body + controls + rest.replace(load, load + " if (window.withoutView) return;", 1))
