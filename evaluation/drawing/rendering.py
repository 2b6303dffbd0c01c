"""Meshes to images, off screen: arrays in, (height, width, 3) uint8 out.

Positions are deformed positions in metres; the caller adds displacement to reference. Images of one figure share
a `View`, so that what looks displaced is displaced. Everything with text, colour bars and rows of panels is in
`evaluation.drawing.pictures`.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evaluation.errors import EvaluationError

Image = NDArray[np.uint8]

GREY = "#c4c7cb"  # a mesh, or a node, without a value
_SAMPLES = 2  # images are drawn this much larger and averaged: smooth edges on any graphics library


@dataclass(frozen=True)
class View:
    """A parallel projection.

    Attributes
    ----------
    right, up
        (3,) unit vectors of the picture's axes.
    centre
        (3,) m.
    width, height
        m, of what is seen.
    """

    right: NDArray[np.float64]
    up: NDArray[np.float64]
    centre: NDArray[np.float64]
    width: float
    height: float


def choose_view(
    positions: Sequence[ArrayLike], faces: ArrayLike, elevation: float = 35.0, margin: float = 0.03
) -> View:
    """The view in which all `positions` fit, chosen from the first state of the first of them.

    Up is z, or the axis along which the structure is clearly flatter. Of the four corners, seen from `elevation`
    degrees above, that one which shows most of the faces' area. `margin` is left free around, as a share of the size.

    Parameters
    ----------
    positions
        Arrays (n, 3) or (t, n, 3) on one mesh, m; NaN where nodes are gone.
    faces
        (m, 3 or 4).

    Raises
    ------
    EvaluationError
        Where no node is left to look at.
    """
    clouds = [np.asarray(p, np.float64) for p in positions]
    cloud = np.concatenate([c.reshape(-1, 3) for c in clouds])
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if not len(cloud):
        raise EvaluationError("no node with a finite position: expected something to look at")
    first = clouds[0].reshape(-1, clouds[0].shape[-2], 3)[0]
    extent = np.ptp(first[np.isfinite(first).all(axis=1)], axis=0) if np.isfinite(first).any() else np.ones(3)
    flattest = int(np.argmin(extent))
    vertical = flattest if extent[flattest] < 0.8 * extent[2] else 2
    across, along = sorted({0, 1, 2} - {vertical}, key=lambda axis: extent[axis])
    x, y, z = np.eye(3)[[along, across, vertical]]
    area = _area_vectors(first, np.asarray(faces))
    tilt = np.radians(elevation)

    def eye(side: int, turn: int) -> NDArray[np.float64]:
        level = np.cos(np.radians(30)) * side * y + np.sin(np.radians(30)) * turn * x
        return np.asarray(np.cos(tilt) * level + np.sin(tilt) * z)

    corners = [eye(side, turn) for side in (-1, 1) for turn in (-1, 1)]
    # Rounded, so that noise does not decide between the corners of a symmetric structure.
    shown = [
        round(float(np.abs(area @ corner).sum() / max(np.linalg.norm(area, axis=1).sum(), 1e-30)), 2)
        for corner in corners
    ]
    towards_eye = corners[int(np.argmax(shown))]
    right = np.cross(z, towards_eye)
    right /= np.linalg.norm(right)
    up = np.cross(towards_eye, right)

    seen = cloud @ np.stack([right, up], axis=1)
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = np.maximum(high - low, 0.05 * max(float((high - low).max()), 1e-9))
    middle = (low + high) / 2
    centre = middle[0] * right + middle[1] * up + float((cloud @ towards_eye).mean()) * towards_eye
    width, height = size + 2 * margin * size.max()
    return View(right, up, centre, float(width), float(height))


def _area_vectors(position: NDArray[np.float64], faces: NDArray[Any]) -> NDArray[np.float64]:
    """(m, 3) normals as long as the faces are large; for quadrilaterals the first half stands for the whole."""
    if not len(faces):
        return np.ones((1, 3))
    a, b, c = (position[faces[:, k]] for k in range(3))
    vectors = np.cross(b - a, c - a)
    return vectors[np.isfinite(vectors).all(axis=1)]


def render(
    position: ArrayLike,
    faces: ArrayLike,
    view: View,
    values: ArrayLike | None = None,
    limits: tuple[float, float] = (0.0, 1.0),
    colours: str = "viridis",
    width: int = 900,
    *,
    alive: ArrayLike | None = None,
    lines: ArrayLike | None = None,
    edges: bool = False,
    marked: ArrayLike | None = None,
    marker_size: float = 9.0,
    marker_colour: str = "#c1121f",
    opacity: float = 1.0,
    ghost: ArrayLike | None = None,
) -> Image:
    """One image of a deformed mesh on white.

    Parameters
    ----------
    position
        (n, 3) deformed positions, m; faces with a NaN corner are left out.
    faces
        (m, 3 or 4), -1 in the last corner of a triangle.
    values
        (n,) or (m,) coloured between `limits` by the matplotlib colour map `colours`; NaN is grey, and without
        values everything is.
    width
        Pixels; the height follows from `view`.
    alive
        (m,) bool: False hides a face.
    lines
        (e, 2) edges without a face, drawn as lines.
    edges
        Draw the edges of the faces.
    marked
        Numbers of nodes drawn as dots, `marker_size` pixels wide.
    ghost
        (n, 3) other positions of the same mesh, drawn as a grey shadow to compare with, m.

    Raises
    ------
    EvaluationError
        Where nothing can be drawn on this machine (see `rendering_problem`).
    """
    import pyvista as pv

    xyz, corners = np.asarray(position, np.float64), np.asarray(faces).reshape(-1, np.shape(faces)[-1])
    there = np.asarray(np.isfinite(xyz).all(axis=1))
    height = max(1, round(width * view.height / view.width))
    with off_screen():
        plotter: Any = pv.Plotter(off_screen=True, window_size=[width * _SAMPLES, height * _SAMPLES], lighting="none")
    try:
        plotter.set_background("white")
        _light(plotter, view)
        if ghost is not None:
            shadow, _ = _shown(np.asarray(ghost, np.float64), corners, alive, view)
            if shadow.n_cells:
                plotter.add_mesh(shadow, color="#8d9299", opacity=0.35, lighting=False)
        mesh, shown = _shown(xyz, corners, alive, view)
        look: dict[str, Any] = {"color": GREY}
        if values is not None:
            field = np.asarray(values, np.float64)
            on_faces = len(field) == len(corners) != len(xyz)
            (mesh.cell_data if on_faces else mesh.point_data)["field"] = field[shown] if on_faces else field
            look = {"scalars": "field", "cmap": colours, "clim": _open(limits), "nan_color": GREY}
        if mesh.n_cells:
            plotter.add_mesh(
                mesh, **look, show_scalar_bar=False, smooth_shading=not edges, opacity=opacity, ambient=0.35,
                diffuse=0.7, show_edges=edges, edge_color="#5a5f66", line_width=0.7 * _SAMPLES,
            )  # fmt: skip
        if lines is not None and len(np.asarray(lines)):
            ends = np.asarray(lines)[there[np.asarray(lines)].all(axis=1)]
            cells = np.column_stack([np.full(len(ends), 2), ends]).ravel()
            plotter.add_mesh(pv.PolyData(xyz, lines=cells), color="#5a5f66", line_width=1.5 * _SAMPLES, lighting=False)
        if marked is not None:
            dots = xyz[np.asarray(marked)]
            dots = dots[np.isfinite(dots).all(axis=1)]
            if len(dots):
                plotter.add_points(
                    dots,
                    color=marker_colour,
                    point_size=marker_size * _SAMPLES,
                    render_points_as_spheres=True,
                    lighting=False,
                )
        _aim(plotter.camera, view)
        with off_screen():
            image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    finally:
        plotter.close()
    return _averaged(image)


def _shown(
    xyz: NDArray[np.float64], corners: NDArray[Any], alive: ArrayLike | None, view: View
) -> tuple[Any, NDArray[np.bool_]]:
    """The faces that are to be seen as poly data, and which those are (m,)."""
    import pyvista as pv

    there = np.asarray(np.isfinite(xyz).all(axis=1))
    shown = (there[corners] | (corners < 0)).all(axis=1) if len(corners) else np.zeros(0, bool)
    if alive is not None:
        shown &= np.asarray(alive, bool)
    xyz, corners = np.where(there[:, None], xyz, view.centre), corners[shown]
    if corners.shape[1] == 3:
        return pv.PolyData.from_regular_faces(xyz, corners), shown
    sized = np.column_stack([(corners >= 0).sum(axis=1), corners])
    return pv.PolyData(xyz, faces=sized[sized >= 0]), shown


def _open(limits: tuple[float, float]) -> tuple[float, float]:
    """Limits that are not equal: a field that is zero everywhere has a colour too."""
    low, high = float(limits[0]), float(limits[1])
    return (low, high) if high > low else (low, low + 1e-12 + abs(low) * 1e-6)


def _light(plotter: Any, view: View) -> None:
    """One light from the upper left of the eye, one weaker from the right: shapes read without shadows."""
    import pyvista as pv

    eye = np.cross(view.right, view.up)
    for direction, strength in ((eye + 0.5 * view.up - 0.4 * view.right, 0.75), (eye + 0.6 * view.right, 0.3)):
        light = pv.Light(position=view.centre + direction, focal_point=view.centre, intensity=strength)
        light.positional = False
        plotter.add_light(light)


def _aim(camera: Any, view: View) -> None:
    eye = np.cross(view.right, view.up)
    reach = 10 * max(view.width, view.height)
    camera.focal_point = view.centre
    camera.position = view.centre + reach * eye
    camera.up = view.up
    camera.parallel_projection = True
    camera.parallel_scale = view.height / 2
    camera.clipping_range = (1e-3 * reach, 2 * reach)


def _averaged(image: NDArray[Any]) -> Image:
    height, width = (size // _SAMPLES for size in image.shape[:2])
    blocks = image[: height * _SAMPLES, : width * _SAMPLES].reshape(height, _SAMPLES, width, _SAMPLES, 3)
    return np.asarray(np.round(blocks.mean(axis=(1, 3))).astype(np.uint8))


# --- drawing without a display ---------------------------------------------------------------------------------

_WINDOW = "VTK_DEFAULT_OPENGL_WINDOW"
_PROBE = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.AddRenderer(vtkRenderer())
window.Render()
print("drawn")
"""


def rendering_problem() -> str | None:
    """Why no image can be drawn here, in one line, or None where it can.

    VTK ends the interpreter where it finds neither a display nor EGL nor OSMesa, so this is tried once in a
    process of its own (a second), before the first image.
    """
    return (
        None
        if _working_window(_settings()) is not None
        else (
            "no image can be drawn: VTK found neither a display nor the EGL or OSMesa library; "
            "install one (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri), or leave pictures out"
        )
    )


def _settings() -> tuple[str | None, str | None]:
    return os.environ.get(_WINDOW), os.environ.get("DISPLAY")


@functools.cache
def _working_window(settings: tuple[str | None, str | None]) -> Mapping[str, str] | None:
    """The environment variables under which VTK can draw with these `settings`; None if under none."""
    chosen, display = settings
    # Asked by name, VTK does not look for an X server first and complain about it on stderr.
    names = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")
    without_display = [{_WINDOW: name} for name in names] if sys.platform == "linux" else []
    tries: list[dict[str, str]] = [{}] if chosen or display or not without_display else without_display
    for variables in tries:
        try:
            done = subprocess.run(
                [sys.executable, "-c", _PROBE], env={**os.environ, **variables}, capture_output=True, text=True,
                timeout=120, check=False,
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0 and "drawn" in done.stdout:
            return variables
    return None


@contextmanager
def off_screen() -> Iterator[None]:
    """The environment in which VTK makes windows that work without a display; put back afterwards."""
    problem = rendering_problem()
    if problem is not None:
        raise EvaluationError(problem)
    before = os.environ.copy()
    os.environ.update(_working_window(_settings()) or {})
    try:
        yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
