"""Every setting from end to end on two levels: it trains, has the effect it should where it should, and survives storage.

The table below has a line for every field of `Settings` and every choice of it; a new one fails until it has its line.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import plate
import pytest
from pydantic import BaseModel

from surrogates.data.campaign import Campaign, ElementTarget
from surrogates.errors import SurrogateError
from surrogates.physics import trials
from surrogates.settings import Settings, settings
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

# A small cascade, and a small regression on modes: what the lines of the table change.
SMALL = {
    "mh": (
        "levels=[2,1]", "level.epochs=2", "level.batch=16", "level.latent=3", "level.channels=[4,5]", "level.start=plain",
        "level.mlp.members=1", "level.patience=0", "level.first_state=learned", "level.states=1",
        "level.mlp.widths=[8]", "level.mlp.activation=elu", "level.regression=network", "level.schedule=constant",
        "level.weight_decay=0", "level.rate_inputs=0", "level.learning_rate=0.01", "transfer.upsampling=static",
        "transfer.mlp=input", "transfer.epochs=1", "validation.share=0.3", "inputs.derived=off", "physics.clock=off",
        "physics.symmetry=off", "removal=off",
    ),
    "pod-gpr": ("pod.modes=[3]", "pod.inputs=trajectory", "inputs.derived=off", "physics.clock=off", "physics.symmetry=off", "removal=off"),
}  # fmt: skip
BOTH, FINE, NONE = {2, 1}, {1}, set[int]()


@dataclass(frozen=True)
class Line:
    """What is changed, from what, and on which levels predictions change for it (0: the full mesh of `pod-gpr`)."""

    change: tuple[str, ...]
    changes: frozenset[int]
    given: tuple[str, ...] = ()
    model: str = "mh"


def line(*change: str, on: set[int] = BOTH, given: tuple[str, ...] = (), model: str = "mh") -> Line:
    return Line(change, frozenset(on), given, model)


POD = {"model": "pod-gpr", "on": {0}}
TABLE: dict[str, list[Line]] = {
    "seed": [line("seed=1")],
    "seeds": [line("seeds=2")],
    "levels": [line("levels=[2]", on=NONE)],
    "level.reduction": [line("level.reduction=ae", "level.hidden=[9]"), line("level.reduction=pod")],
    "level.convolution": [line("level.convolution=gcn"), line("level.convolution=gcn2")],
    "level.latent": [line("level.latent=5")],
    "level.channels": [line("level.channels=[6]")],
    "level.order": [line("level.order=1")],
    "level.hidden": [line("level.hidden=[5, 4]", given=("level.reduction=ae", "level.hidden=[9]"))],
    "level.start": [line("level.start=pod")],
    "level.mlp.widths": [line("level.mlp.widths=[6, 6]")],
    "level.mlp.activation": [line(f"level.mlp.activation={a}") for a in ("gelu", "silu", "tanh")],
    "level.mlp.members": [line("level.mlp.members=2", given=("level.regression=mean",))],
    "level.patience": [line("level.patience=1", on=NONE)],
    "level.first_state": [line("level.first_state=kept")],
    "level.regression": [line("level.regression=process"), line("level.regression=mean"), line("level.regression=auto")],
    "level.epochs": [line("level.epochs=3")],
    "level.states": [line("level.states=0.5"), line("level.states=auto", on=NONE)],
    "level.batch": [line("level.batch=8")],
    "level.learning_rate": [line("level.learning_rate=0.03")],
    "level.schedule": [line("level.schedule=one_cycle"), line("level.schedule=cosine")],
    "level.optimiser": [line("level.optimiser=adam", given=("level.weight_decay=0.1",)), line("level.optimiser=sgd")],
    "level.weight_decay": [line("level.weight_decay=0.5")],
    "level.clip": [line("level.clip=1e-9", "level.optimiser=sgd", given=("level.optimiser=sgd",))],
    "level.rate_inputs": [line("level.rate_inputs=4")],
    "level.weight_approximation": [line("level.weight_approximation=0")],
    "level.weight_reconstruction": [line("level.weight_reconstruction=0")],
    "at": [line("at.1.epochs=3", on=FINE), line("at.2.learning_rate=0.03")],
    "transfer.upsampling": [
        line("transfer.upsampling=sparse", on=FINE),
        line("transfer.upsampling=linear", on=FINE),
    ],
    "transfer.encoder": [line("transfer.encoder=concat", on=FINE)],
    "transfer.mlp": [line("transfer.mlp=residual", on=FINE)],
    "transfer.epochs": [line("transfer.epochs=0.5", on=FINE)],
    "transfer.lifting": [line("transfer.lifting=static", on=NONE)],
    "inputs.products": [line("inputs.products=true")],
    "inputs.angles": [line("inputs.angles=true")],
    "inputs.initial_state": [line("inputs.initial_state=true")],
    "inputs.derived": [
        line("inputs.derived=impact_speed**2/yield_stress", given=("physics.clock=auto",), **POD),  # type: ignore[arg-type]
        line("inputs.derived=auto", given=("physics.clock=auto",), **POD),  # type: ignore[arg-type]
    ],
    "physics.clock": [line("physics.clock=auto", **POD)],  # type: ignore[arg-type]
    "physics.symmetry": [line("physics.symmetry=auto", **POD)],  # type: ignore[arg-type]
    "physics.odd": [line("physics.odd=[]", given=("physics.symmetry=auto",), **POD)],  # type: ignore[arg-type]
    "validation.measure": [line("validation.measure=paper")],
    "validation.share": [line("validation.share=0.5")],
    "validation.runs": [line("validation.runs=[run_000]")],
    "validation.folds": [line("validation.folds=3", model="pod-gpr", on=NONE)],
    "refinement.adaptive": [line("refinement.adaptive=true", on=FINE)],
    "refinement.share": [line("refinement.share=1.0", on=FINE, given=("refinement.adaptive=true", "refinement.share=0.2"))],
    "refinement.rings": [line("refinement.rings=2", on=FINE, given=("refinement.adaptive=true", "refinement.share=0.1"))],
    "unified": [line("unified=true")],
    "pod.modes": [line("pod.modes=[2]", **POD)],  # type: ignore[arg-type]
    "pod.inputs": [line("pod.inputs=point", **POD), line("pod.inputs=auto", on=NONE, model="pod-gpr")],  # type: ignore[arg-type]
    "pod.points": [line("pod.points=20", given=("pod.inputs=point",), **POD)],  # type: ignore[arg-type]
    "precision": [line("precision=tf32", on=NONE), line("precision=bfloat16")],
    "targets": [line("targets=[displacement, bending]", on=NONE)],
    "removal": [line("removal=auto", on=NONE)],
    "missing": [line("missing=hold", on=NONE), line("missing=refuse", on=NONE)],
}  # fmt: skip
MU = plate.parameters(2, seed=5)


@functools.cache
def campaign() -> Campaign:
    speed, stress = (0.0, 1.0, -1.0), (1.0, -1.0, -2.0)
    bending = np.linspace(0, 1, 10 * len(plate.TIME) * 64).reshape(10, len(plate.TIME), 64).astype(np.float32)
    alive = bending < np.linspace(0.3, 1.1, 64)
    return plate.campaign(
        10, dimensions=(speed, None, stress), mirrors=(plate.MIRROR,), alive=alive,
        targets=(ElementTarget("bending", "1", bending),),
    )  # fmt: skip


@functools.cache
def trained(model: str, overrides: tuple[str, ...]) -> Surrogate:
    return train_surrogate(campaign(), settings(model, overrides=(*SMALL[model], *overrides)))


def predicted(surrogate: Surrogate) -> dict[int, np.ndarray]:
    return {level: surrogate.predict(MU, plate.TIME, level) for level in surrogate.level_names.values()}


def fields(kind: type[BaseModel], before: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and type of every setting."""
    for name, field in kind.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from fields(field.annotation, f"{before}{name}.")
        else:
            yield f"{before}{name}", field.annotation


def choices(annotation: Any) -> set[Any]:
    if get_origin(annotation) is Literal:
        return set(get_args(annotation))
    return set().union(*map(choices, get_args(annotation))) if get_args(annotation) else set()


def test_the_table_has_every_setting_and_every_choice() -> None:
    known = dict(fields(Settings))
    # Numbers by formula are worked out in crashkit.api, and have their tests there.
    assert known.keys() - {"model", "preset", "kpi"} == TABLE.keys()
    for name, annotation in known.items():
        if name in TABLE and choices(annotation):
            told = {c.partition("=")[2] for entry in TABLE[name] for c in (*entry.change,) if c.startswith(f"{name}=")}
            small = {c.partition("=")[2] for own in SMALL.values() for c in own if c.startswith(f"{name}=")}
            default = {str(getattr(functools.reduce(getattr, name.split(".")[:-1], Settings()), name.split(".")[-1]))}
            assert choices(annotation) <= told | (small or default) | default, name


@pytest.mark.parametrize(
    ("name", "entry"), [pytest.param(n, e, id="-".join(e.change)) for n, entries in TABLE.items() for e in entries]
)
def test_a_setting_trains_changes_what_it_should_and_is_stored(name: str, entry: Line, tmp_path: Path) -> None:
    before = trained(entry.model, entry.given)
    after = train_surrogate(
        campaign(), settings(entry.model, overrides=(*SMALL[entry.model], *entry.given, *entry.change))
    )
    old, new = predicted(before), predicted(after)
    nodes = {0: 81, 1: 25, 2: 9}
    for level, field in new.items():
        refined = after.settings.refinement.adaptive and level == 1
        assert field.shape == (2, 7, after.graphs.n_nodes(1) if refined else nodes[level], 3)
        assert np.isfinite(field).all()
    changed = {level for level in old.keys() & new.keys() if not np.array_equal(old[level], new[level])}
    assert changed == entry.changes
    assert before.settings != after.settings
    again = load(save(after, tmp_path / "model"))
    assert again.settings == after.settings
    for level, field in predicted(again).items():
        np.testing.assert_array_equal(field, new[level])
    assert (after.removal is not None) == (name == "removal")
    assert set(after.fields) == ({"bending"} if name == "targets" else set())
    for known in after.fields:
        np.testing.assert_array_equal(again.predict_field(known, MU), after.predict_field(known, MU))
    if after.removal is not None:
        np.testing.assert_array_equal(again.predict_removal(MU), after.predict_removal(MU))


@pytest.mark.parametrize("preset", ["fast", "paper"])
@pytest.mark.parametrize("model", ["mh", "podnn", "aenn", "gaenn", "pod-gpr", "pod-rbf"])
def test_every_model_and_preset_trains_predicts_and_is_stored(model: str, preset: str, tmp_path: Path) -> None:
    overrides = ["level.epochs=1", "level.hidden=[8]", "level.channels=[4]", "pod.modes=[3]", "level.mlp.widths=[8]"]
    overrides += ["levels=[2,1]"] * (model == "mh")
    after = train_surrogate(campaign(), settings(model, preset, overrides=overrides))
    new = predicted(after)
    assert new.keys() == ({2, 1} if model == "mh" else {0})
    assert all(np.isfinite(field).all() for field in new.values())
    again = predicted(load(save(after, tmp_path / "model")))
    for level, field in new.items():
        np.testing.assert_array_equal(again[level], field)


# What cannot be seen in a prediction alone


def test_levels_are_those_asked_for() -> None:
    assert list(trained("mh", ()).level_names.values()) == [2, 1]
    assert list(trained("mh", ("levels=[2]",)).level_names.values()) == [2]


def test_epochs_of_a_transferred_level_are_a_share() -> None:
    fits = trained("mh", ("level.epochs=4", "transfer.epochs=0.5")).record.fits
    assert (fits[2].epochs, fits[1].epochs) == (4, 2)
    assert trained("mh", ("level.epochs=4", "transfer.epochs=0.5", "at.1.epochs=3")).record.fits[1].epochs == 3


@pytest.mark.parametrize(
    ("override", "held_out"),
    [
        ("validation.share=0.3", 3),
        ("validation.share=0.5", 5),
        ("validation.measure=paper", 0),
        ("validation.runs=[run_000]", 1),
    ],
)
def test_as_many_runs_are_held_out_as_asked_for(override: str, held_out: int) -> None:
    record = trained("mh", (override,)).record
    assert len(record.validation_runs) == held_out
    assert len(record.fitted_runs) == 10 - held_out


def test_a_refined_level_has_more_nodes_for_a_larger_share_or_more_rings() -> None:
    few, more, rings = (
        trained("mh", ("refinement.adaptive=true", *more)).graphs.n_nodes(1)
        for more in (
            ("refinement.share=0.1",),
            ("refinement.share=0.5",),
            ("refinement.share=0.1", "refinement.rings=2"),
        )
    )
    assert 9 < few < more <= 25
    assert few < rings <= 25


def eroded() -> Campaign:
    """Node 0, which all levels keep, is gone in the last two states of a run."""
    original = campaign()
    u = original.displacement(0).copy()  # type: ignore[attr-defined]
    u[4, 5:, 0] = np.nan
    kept = {0: np.arange(81)} | {level.index: level.kept for level in original.levels}
    return plate.campaign(10, displacement=lambda level: u[:, :, kept[level]])


def test_missing_values_are_refused_or_held_as_asked() -> None:
    chosen = settings("mh", overrides=(*SMALL["mh"], "missing=refuse"))
    with pytest.raises(SurrogateError, match="run run_004, state 5, node 0"):
        train_surrogate(eroded(), chosen)
    held = train_surrogate(eroded(), settings("mh", overrides=(*SMALL["mh"], "missing=hold")))
    assert all(np.isfinite(field).all() for field in predicted(held).values())
    assert any("last displacement" in note for note in held.record.notes)


def test_folds_decide_with_how_many_runs_a_left_out_run_is_judged() -> None:
    """With few runs each is a part of its own whatever is asked for."""
    runs = trials._LEAVE_ONE + 2
    few, many = (
        train_surrogate(
            plate.campaign(runs), settings("pod-gpr", overrides=(*SMALL["pod-gpr"], f"validation.folds={n}"))
        ).record
        for n in (2, runs)
    )
    assert few.left_out.keys() == many.left_out.keys() == set(few.fitted_runs)
    left_out = [np.mean([error for error, _ in record.left_out.values()]) for record in (few, many)]
    assert left_out[1] < left_out[0], "all but one run teach more than half of them"
