"""Mirror planes of a mesh, and the probe map that says what a mirrored field is at every node.

A structure can be symmetric in shape although its mesh is not: a mirrored node then lands between other nodes, and takes
the barycentric weights of the closest point of the mesh there, as in `crashkit.mesh.probe`. Parts go over into parts
(the left box into the right one), so that sheets that touch are not mixed up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from crashkit.mesh import _closest
from crashkit.mesh.probe import cells_of_nodes, closest_cells, coarse_cells
from crashkit.mesh.surface import Surface, surface
from data_schema.mirror import MirrorPlane

# A plane counts as one where mirrored nodes lie this close to the surface, in mean edge lengths: on average, and but
# for one node in a hundred.
MEAN_WITHIN = 0.25
MOST_WITHIN = 1.5
# Nodes by which planes are compared while they are sought; on a mesh of many more, they also say which are far from fitting.
_SEEN, _MANY = 2000, 20_000
_ROUNDS = 12
# Cosine above which two normals are the same direction.
_ALIKE = 0.999


def mirror_planes(position: ArrayLike, face_nodes: ArrayLike, face_part: ArrayLike | None = None) -> list[MirrorPlane]:
    """Planes in which the mesh is its own image within `MEAN_WITHIN` and `MOST_WITHIN` edges, the best first.

    Sought along the axes and the principal axes of the surface; each plane is then moved and turned until mirrored
    nodes lie closest to the nodes (an iterative closest point).

    Parameters
    ----------
    position
        (n, 3), m; face_nodes (m, 3 or 4), -1 in the last corner of a triangle among quadrilaterals.
    face_part
        (m,) part of each face, from 0.

    Raises
    ------
    MeshError
        As `surface` does.
    """
    mesh, moved = _surface(position, face_nodes, face_part)
    edge = float(np.linalg.norm(np.diff(mesh.position[mesh.edges], axis=1)[:, 0], axis=1).mean())
    seen = _Seen(mesh)
    found: list[MirrorPlane] = []
    for normal, offset in _candidates(mesh, seen):
        known = any(abs(normal @ other.normal) > _ALIKE for other in found)
        if known or seen.spread(normal, offset) > 2 * edge or _hopeless(mesh, seen, normal, offset, edge):
            continue
        plane = _plane(mesh, normal, offset, edge)
        if plane.mean <= MEAN_WITHIN * edge and plane.most <= MOST_WITHIN * edge:
            found.append(replace(plane, offset=plane.offset + float(plane.normal @ moved)))
    return sorted(found, key=lambda plane: plane.mean)


def mirror_plane(
    position: ArrayLike, face_nodes: ArrayLike, normal: ArrayLike, offset: float, face_part: ArrayLike | None = None
) -> MirrorPlane:
    """The plane normal . x = offset and its map, however well it fits.

    Raises
    ------
    MeshError
        As `surface` does.
    """
    mesh, moved = _surface(position, face_nodes, face_part)
    edge = float(np.linalg.norm(np.diff(mesh.position[mesh.edges], axis=1)[:, 0], axis=1).mean())
    direction = np.asarray(normal, np.float64)
    length = float(np.linalg.norm(direction))
    unit, place = direction / length, float(offset) / length
    return replace(_plane(mesh, unit, place - float(unit @ moved), edge), offset=place)


def _surface(
    position: ArrayLike, face_nodes: ArrayLike, face_part: ArrayLike | None
) -> tuple[Surface, NDArray[np.float64]]:
    """The surface, and by what (3,) it was moved towards the origin, as `surface` does with a mesh far away from it."""
    mesh = surface(position, face_nodes, face_part)
    return mesh, np.asarray(position, np.float64)[0] - mesh.position[0]


class _Seen:
    """The nodes on faces, and those of them by which planes are compared."""

    def __init__(self, mesh: Surface) -> None:
        self.nodes = mesh.position[mesh.used]
        self.tree = cKDTree(self.nodes)
        some = np.unique(np.linspace(0, len(self.nodes) - 1, _SEEN).astype(int))
        self.places, self.at = np.flatnonzero(mesh.used)[some], self.nodes[some]

    def spread(self, normal: NDArray[np.float64], offset: float) -> float:
        """Mean distance, m, of mirrored nodes to the closest node."""
        return float(self.tree.query(_mirrored(self.at, normal, offset))[0].mean())


def _candidates(mesh: Surface, seen: _Seen) -> list[tuple[NDArray[np.float64], float]]:
    """Normals and offsets: axes first, principal axes after, each as given and then as a closest-point search leaves it."""
    corners = mesh.position[mesh.triangles]
    twice = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = corners.mean(axis=1)
    centre = np.average(middle, axis=0, weights=twice)
    spread = ((middle - centre) * twice[:, None]).T @ (middle - centre)
    axes = [*np.eye(3), *np.linalg.eigh(spread)[1].T]
    box = (seen.nodes.min(axis=0) + seen.nodes.max(axis=0)) / 2
    out = []
    for k, axis in enumerate(axes):
        normal = axis * np.sign(axis[np.abs(axis).argmax()])
        # Engineers put the plane of symmetry at zero; then the middle of the box, then the centre of the surface.
        starts = [0.0, float(normal @ box), float(normal @ centre)]
        spreads = [seen.spread(normal, start) for start in starts]
        best = next(i for i in range(3) if spreads[i] <= 1.01 * min(spreads) + 1e-12)
        moved = _settled(seen, normal, starts[best], turn=k >= 3)
        improved = seen.spread(*moved) < 0.98 * spreads[best]
        out.append(moved if improved else (normal, starts[best]))
    return out


def _settled(
    seen: _Seen, normal: NDArray[np.float64], offset: float, *, turn: bool
) -> tuple[NDArray[np.float64], float]:
    """The plane moved (and turned) so that nodes and the nodes closest to their images lie symmetric to it."""
    for _ in range(_ROUNDS):
        apart, nearest = seen.tree.query(_mirrored(seen.at, normal, offset))
        close = apart <= np.quantile(apart, 0.9)
        one, other = seen.at[close], seen.nodes[nearest[close]]
        if turn:
            # The normal along which pairs differ most, and the middle of the pairs.
            across = one - other
            values, vectors = np.linalg.eigh(across.T @ across)
            if values[-1] <= 0:
                break
            normal = vectors[:, -1] if vectors[:, -1] @ normal >= 0 else -vectors[:, -1]
        offset = float(((one + other) / 2 @ normal).mean())
    return normal, offset


def _mirrored(at: NDArray[np.float64], normal: NDArray[np.float64], offset: float) -> NDArray[np.float64]:
    return at - 2 * (at @ normal - offset)[:, None] * normal


def _hopeless(mesh: Surface, seen: _Seen, normal: NDArray[np.float64], offset: float, edge: float) -> bool:
    """Whether some nodes of a large mesh already say, by a wide margin, that the plane does not fit."""
    if mesh.n_nodes <= _MANY:
        return False
    images = _mirrored(mesh.position, normal, offset)
    columns, weights = _probed(mesh, images, seen.places)
    at = np.einsum("nk,nkx->nx", weights, mesh.position[columns])
    apart = np.linalg.norm(images[seen.places] - at, axis=1)
    # One node in a hundred may lie further off; three in a hundred of two thousand are no accident.
    return bool(apart.mean() > 2 * MEAN_WITHIN * edge or np.quantile(apart, 0.97) > MOST_WITHIN * edge)


def _plane(mesh: Surface, normal: NDArray[np.float64], offset: float, edge: float) -> MirrorPlane:
    images = _mirrored(mesh.position, normal, offset)
    columns, weights = _probed(mesh, images, np.arange(mesh.n_nodes))
    here = weights > 0
    row = np.broadcast_to(np.arange(mesh.n_nodes)[:, None], here.shape)[here]
    u = sparse.csr_matrix((weights[here], (row, columns[here])), shape=(mesh.n_nodes, mesh.n_nodes))
    u.sort_indices()
    apart = np.linalg.norm(images - u @ mesh.position, axis=1)[mesh.used]
    mean, most, largest = float(apart.mean()), float(np.quantile(apart, 0.99)), float(apart.max())
    return MirrorPlane(normal, float(offset), u, mean, most, largest, edge)


def _probed(
    mesh: Surface, images: NDArray[np.float64], places: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(k, 3) nodes and their weights at the closest points of the mesh to the images of the nodes `places` (k,)."""
    cells = coarse_cells(mesh.triangles, mesh.part, mesh.edges, mesh.node_parts, mesh.n_parts)
    sets = _image_parts(mesh, images)[places]
    images = images[places]
    candidate = closest_cells(images, sets, mesh.position, cells)
    rows = np.flatnonzero(candidate >= 0)
    columns, weights = np.zeros((len(places), 3), np.int64), np.zeros((len(places), 3))
    weights[:, 0] = 1.0
    columns[:, 0] = cKDTree(mesh.position).query(images)[1]
    start, listed = cells_of_nodes(cells.nodes, mesh.n_nodes)
    first = np.ascontiguousarray(cells.nodes[candidate[rows], 0])
    none = np.zeros(mesh.n_nodes + 1, np.int64)
    found, weight = _closest.settle(
        images[rows], first, candidate[rows], mesh.position, cells.nodes, start, listed, none, none[:0], 0
    )
    columns[rows] = cells.nodes[found]
    weights[rows] = weight
    weights[weights < 1e-9] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    return columns, weights


def _image_parts(mesh: Surface, images: NDArray[np.float64]) -> NDArray[np.uint64]:
    """(n, words) bit sets of the parts on which the image of each node lies: a part's nodes go to the part closest to them."""
    words = mesh.node_parts.shape[1]
    out = np.zeros((mesh.n_nodes, words), np.uint64)
    members = [
        np.flatnonzero(mesh.node_parts[:, p // 64] >> np.uint64(p % 64) & np.uint64(1)) for p in range(mesh.n_parts)
    ]
    low = np.array([mesh.position[m].min(axis=0) if len(m) else np.full(3, np.inf) for m in members])
    high = np.array([mesh.position[m].max(axis=0) if len(m) else np.full(3, -np.inf) for m in members])
    trees: dict[int, cKDTree] = {}
    for mine in members:
        if not len(mine):
            continue
        at = images[mine]
        # Parts whose box is closest to the box of the image; the nodes of a few decide.
        apart = np.abs(low - at.min(axis=0)).sum(axis=1) + np.abs(high - at.max(axis=0)).sum(axis=1)
        near = [int(q) for q in np.argsort(apart)[:6] if len(members[q])]
        for q in near:
            if q not in trees:
                trees[q] = cKDTree(mesh.position[members[q]])
        some = at[np.unique(np.linspace(0, len(at) - 1, 200).astype(int))]
        best = min(near, key=lambda q: float(trees[q].query(some)[0].mean()))
        out[mine, best // 64] |= np.uint64(1) << np.uint64(best % 64)
    return out
