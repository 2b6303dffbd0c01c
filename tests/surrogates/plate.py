"""A plate that is hit: a small campaign with known answers, on nested grids of 81, 25 and 9 nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy import sparse

from data_schema.levels import Level
from data_schema.mirror import MirrorPlane
from surrogates.data.campaign import Campaign, CoarseRuns

SIDES = (9, 5, 3)
TIME = np.linspace(0.0, 0.03, 7)


# x -> 1 - x, node by node.
MIRROR = MirrorPlane(
    np.array([1.0, 0.0, 0.0]), 0.5,
    sparse.csr_matrix(np.eye(SIDES[0] ** 2)[np.arange(SIDES[0] ** 2).reshape(SIDES[0], SIDES[0])[::-1].ravel()]),
)  # fmt: skip


def displacement(parameters: np.ndarray, time: np.ndarray = TIME) -> np.ndarray:
    """(sim, state, node, 3) float32, m: a dent that grows with speed and time, and drifts with the angle."""
    x, y = grid(SIDES[0])[:, :2].T
    speed, angle = parameters[:, 0, None, None], np.radians(parameters[:, 1, None, None])
    t = time[None, :, None]
    depth = 0.5 * speed * t * np.exp(-8 * ((x - 0.5 - angle * t / 0.03) ** 2 + (y - 0.5) ** 2))
    slide = speed * t * np.sin(angle) * np.ones_like(x)
    return np.stack([slide, 0.2 * depth * (x - 0.5), -depth], axis=-1).astype(np.float32)


def parameters(runs: int, seed: int = 0) -> np.ndarray:
    """(sim, 3): speed, m/s; angle, degree; and one that does nothing, Pa."""
    return np.random.default_rng(seed).uniform([10, -10, 2e8], [30, 10, 5e8], (runs, 3))


def grid(side: int) -> np.ndarray:
    """(side^2, 3) points of the unit square."""
    axis = np.linspace(0, 1, side)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)


def quads(side: int) -> np.ndarray:
    number = np.arange(side * side).reshape(side, side)
    return np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)


def edges(side: int) -> np.ndarray:
    number = np.arange(side * side).reshape(side, side)
    along = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in along]).astype(np.int32)


def levels() -> tuple[Level, ...]:
    """Every second point in both directions, and bilinear interpolation back."""
    out = []
    to_full = sparse.identity(SIDES[0] ** 2, format="csr")
    kept = np.arange(SIDES[0] ** 2)
    for index, (fine, coarse) in enumerate(pairwise(SIDES), 1):
        line = sparse.lil_matrix((fine, coarse))
        for k in range(coarse):
            line[2 * k, k] = 1.0
        for k in range(coarse - 1):
            line[2 * k + 1, k] = line[2 * k + 1, k + 1] = 0.5
        up = sparse.csr_matrix(sparse.kron(line, line))
        places = np.arange(fine * fine).reshape(fine, fine)[::2, ::2].ravel()
        kept, to_full = kept[places], sparse.csr_matrix(to_full @ up)
        q = quads(coarse)
        triangles = np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]).astype(np.int32)
        out.append(Level(index, kept, triangles, edges(coarse), places, up, to_full))
    return tuple(out)


def campaign(runs: int = 10, *, seed: int = 0, **changes: object) -> Campaign:
    """`runs` training runs; two further ones are held out by name. `changes` replace fields."""
    mu = parameters(runs, seed)
    u = displacement(mu)
    coarse = levels()
    values: dict[str, object] = {
        "parameters": mu,
        "parameter_names": ("impact_speed", "impact_angle", "yield_stress"),
        "parameter_units": ("m s-1", "degree", "Pa"),
        "time": TIME,
        "displacement": lambda level: u if level == 0 else u[:, :, coarse[level - 1].kept],
        "n_nodes": SIDES[0] ** 2,
        "levels": coarse,
        "full_edges": edges(SIDES[0]),
        "runs": tuple(f"run_{k:03d}" for k in range(runs)),
        "checksum": "c0ffee",
        "held_out": ("run_900", "run_901"),
        "points": grid(SIDES[0]),
        "faces": quads(SIDES[0]).astype(np.int32),
    }
    return Campaign(**{**values, **changes})  # type: ignore[arg-type]


def folding(runs: int = 40) -> Campaign:
    """Runs whose dent also goes to one side or the other, at random, where the angle is below three degrees."""
    mu = parameters(runs)
    u = displacement(mu)
    side = np.where(np.arange(runs) % 2 == 0, 1.0, -1.0) * (np.abs(mu[:, 1]) < 3.0)
    u[..., 1] += (side[:, None, None] * np.abs(u[..., 2])).astype(np.float32)
    return campaign(runs, displacement=lambda level: u)


def waving(mu: np.ndarray) -> np.ndarray:
    """(sim, state, node, 3): the plate's dent, deeper and shallower with the strength, which few runs do not show."""
    wave = 1 + 0.8 * np.sin(9 * (mu[:, 2] - 2e8) / 3e8)
    return np.asarray(displacement(mu) * wave[:, None, None, None], np.float32)


def seen_coarsely(mu: np.ndarray) -> np.ndarray:
    """The same on every second node, a tenth too stiff."""
    return np.asarray(0.9 * waving(mu)[:, :, levels()[0].kept], np.float32)


def noise(mu: np.ndarray) -> np.ndarray:
    """Coarse runs of the same size and with no relation to the fine ones."""
    draw = np.random.default_rng(5).standard_normal((len(mu), len(TIME), len(levels()[0].kept), 3))
    return np.asarray(0.1 * draw * (TIME / TIME[-1])[:, None, None], np.float32)


def waving_campaign(
    runs: int = 10, coarse: Callable[[np.ndarray], np.ndarray] | None = seen_coarsely, more: int = 50
) -> Campaign:
    """`runs` fine runs of the waving plate, with coarse ones of the same parameters and `more` others beneath them."""
    mu, level = parameters(runs), levels()
    u = waving(mu)
    fine = campaign(runs, displacement=lambda k: u if k == 0 else u[:, :, level[k - 1].kept])
    if coarse is None:
        return fine
    below = np.concatenate([mu, parameters(more, seed=3)])
    field = coarse(below)
    other = replace(
        fine, parameters=below, displacement=lambda k: field, n_nodes=len(level[0].kept), points=grid(SIDES[0])[level[0].kept],
        levels=(), checksum="facade", runs=tuple(f"coarse_{k}" for k in range(len(below))),
    )  # fmt: skip
    return replace(fine, coarse=CoarseRuns(other, level[0].to_full))


# Settings of a process that takes a folding plate as it is, without the physics that would be tried first.
PLAIN_PROCESS = ("pod.modes=[6]", "inputs.derived=off", "physics.clock=off", "physics.symmetry=off")
