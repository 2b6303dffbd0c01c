"""Does it help to take the rigid motion out before training and to put it back after? Cross-validated on training runs.

The regression is the one that needs no seed: POD and one Gaussian process over whole runs. It learns the displacements
of level 2, or, beside the rotation and translation of the body, the deformation that a passenger would see.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plan import TRAIN
from scipy.spatial.transform import Rotation

import crashkit
from crashkit.mesh.store import level_displacement
from data_schema import parameters
from data_schema.pod import pod
from evaluation.measures.rigid import RigidMotion, fit_rigid
from surrogates.regression.gaussian import Gaussian

LEVEL, MODES, FOLDS = 2, 48, 4


def courses(x: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Courses (query, state, number) at `at` by a Gaussian process over the known ones (run, state, number) at `x`."""
    flat = known.reshape(len(known), -1).astype(np.float64)
    mean = flat.mean(axis=0)
    return (mean + Gaussian(x).fit(flat, 0).weights(at) @ (flat - mean)).reshape(len(at), *known.shape[1:])


def field(x: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fields (query, state, node, 3) likewise, through POD."""
    basis = pod(known, MODES)
    found = courses(x, at, np.stack([basis.coefficients(run) for run in known]))
    return (found @ basis.modes.T).reshape(len(at), *known.shape[1:])


def cross_validated(data: Path) -> dict[str, list[object]]:
    """Mean node errors, cm, of both ways, each training run predicted by the models that have not seen it."""
    dataset = crashkit.open_dataset(data).isel(sim=slice(0, TRAIN))
    values = np.stack([dataset[n].values for n in parameters(dataset)], axis=1)
    x = 2 * (values - values.min(axis=0)) / np.ptp(values, axis=0) - 1
    kept = crashkit.open_hierarchy(data).levels[LEVEL - 1].kept
    position = dataset["reference_position"].values[kept]
    truth = level_displacement(data, LEVEL, range(TRAIN))
    motions = [fit_rigid(position, run) for run in truth]
    deformation = np.stack(
        [m.deformation(position, run) for m, run in zip(motions, truth, strict=True)], dtype=np.float32
    )
    turn = np.stack([Rotation.from_matrix(m.rotation).as_rotvec() for m in motions])
    shift = np.stack([m.translation for m in motions])
    size = np.sqrt(((position - position.mean(axis=0)) ** 2).sum(axis=1).mean())  # makes an angle a length
    body = np.concatenate([turn * size, shift], axis=2)
    errors = np.zeros((2, TRAIN))
    for fold in np.array_split(np.random.default_rng(0).permutation(TRAIN), FOLDS):
        rest = np.setdiff1d(np.arange(TRAIN), fold)
        plain = field(x[rest], x[fold], truth[rest])
        moved, bent = courses(x[rest], x[fold], body[rest]), field(x[rest], x[fold], deformation[rest])
        for k, run in enumerate(fold):
            rotation = Rotation.from_rotvec(moved[k, :, :3] / size).as_matrix()
            motion = RigidMotion(rotation, moved[k, :, 3:], position.mean(axis=0))
            both = motion.displacement(position) + np.einsum("tij,tnj->tni", rotation, bent[k])
            errors[:, run] = [np.linalg.norm(u - truth[run], axis=2).mean() for u in (plain[k], both)]
    ways = ["displacements as they are", "rigid motion apart"]
    return {"learnt": ways, "cross_validated_error_cm": [100 * float(e) for e in errors.mean(axis=1)]}
