"""Twelve real kart crashes at six states, a hierarchy, and toy surrogates on it, for the tests of evaluation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import h5py
import numpy as np
import pytest
from toy import NearestPod

from crashkit.dataset import demo_data
from crashkit.mesh.hierarchy import build_hierarchy
from evaluation.comparison.predictor import ComparedModel
from evaluation.comparison.reference import Reference
from evaluation.comparison.result import Evaluation, compare
from evaluation.comparison.sensors import choose_sensors
from evaluation.comparison.split import agree_on_split

TRAIN, TEST = range(9), range(9, 12)


@pytest.fixture(scope="session")
def reference() -> Reference:
    with h5py.File(demo_data()) as file:
        u = file["kart/displacements"][:12, ::4].astype(np.float32)
        position = file["kart/reference_configuration"][0].astype(np.float64)
        faces = file["kart/faces"][:].astype(np.int32)
        parameters = file["parameter"][:12].astype(np.float64)
        time = file["time"][::4].astype(np.float64)
    middle = position[faces].mean(axis=1)
    return Reference(
        runs=tuple(f"run_{k:02d}" for k in range(12)),
        parameters=parameters,
        parameter_names=("impact_speed", "impact_angle", "yield_stress"),
        parameter_units=("m s-1", "degree", "Pa"),
        time=time,
        displacement=lambda k: u[k],
        position=position,
        faces=faces,
        face_part=(middle[:, 0] > np.median(middle[:, 0])).astype(np.int32),
        part_names=("rear", "front"),
        node_id=np.arange(1, len(position) + 1),
        part_id=np.array([1, 2]),
        levels=build_hierarchy(position, faces, [150, 50, 15]).levels,
        checksum="c0ffee",
        attributes={"title": "Kart"},
    )


@pytest.fixture(scope="session")
def make_predictor(reference: Reference) -> Callable[..., NearestPod]:
    """A toy surrogate that has seen the training runs."""

    def make(name: str, level: int, modes: int, runs: range = TRAIN) -> NearestPod:
        fields = [reference.displacement(k) for k in runs]
        if level:
            fields = [u[:, reference.level(level).kept] for u in fields]
        epochs = np.arange(1, 31)
        history = dict.fromkeys(("total", "approximation", "reconstruction"), 1.0 / epochs) if level else {}
        return NearestPod(name, level, reference.parameters[list(runs)], reference.time, fields, modes, history)

    return make


@pytest.fixture(scope="session")
def models(reference: Reference, make_predictor: Callable[..., NearestPod]) -> tuple[ComparedModel, ...]:
    seen = {
        "fitted_runs": reference.runs[:8],
        "tuned_runs": reference.runs[8:9],
        "held_out_runs": reference.runs[9:],
        "checksum": "c0ffee",
    }
    cascade = tuple(make_predictor(f"MH{level}", level, 8 - level) for level in (1, 2, 3))
    return (
        ComparedModel("mh", cascade, **seen, seed=0, configuration={"model": "mh"}),
        ComparedModel("podnn", (make_predictor("PODNN", 0, 4),), **seen, seed=0, configuration={"model": "podnn"}),
        ComparedModel(
            "gpr",
            (make_predictor("POD-GPR", 0, 8),),
            **seen,
            configuration={"model": "gpr"},
            hard={"run_03": (0.031, 4.2), "run_05": (0.02, 2.1)},
        ),
    )


@pytest.fixture(scope="session")
def evaluation(reference: Reference, models: tuple[ComparedModel, ...]) -> Evaluation:
    context = {"Dataset": "kart.zarr", "Machine": "a test"}
    split, sensors = agree_on_split(reference, models), choose_sensors(reference, probes=[1, 900])
    return compare(reference, models, split, context=context, sensors=sensors)


@pytest.fixture(scope="session")
def eroded(reference: Reference) -> Reference:
    """The same runs with the first 50 nodes gone from the third state on."""

    def displacement(run: int) -> np.ndarray:
        u = reference.displacement(run).copy()
        u[2:, :50] = np.nan
        return u

    return replace(reference, displacement=displacement)
