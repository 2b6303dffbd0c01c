"""One YAML file for the whole way from solver runs to a report: what may stand in it, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from crashkit.yaml_file import checked, read_yaml
from surrogates.settings import MODELS, ModelName

Positive = Annotated[int, Field(ge=1)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())


class IngestStep(_Strict):
    """Options of `crashkit ingest`; paths are relative to the YAML file."""

    sources: Annotated[list[Path], Field(min_length=1)]
    params: Path | None = None
    units: str | None = None
    reader: str | None = None
    mesh: Path | None = None
    time_step: float | None = None
    names: str | None = None
    parts: list[str | int] = []
    exclude_parts: list[str | int] = []
    keep_rigid_walls: bool = False
    fields: list[str] = []
    time: str | None = None
    on_error: Literal["stop", "skip"] = "stop"
    allow_incomplete: bool = False
    workers: Positive = 1


class CoarsenStep(_Strict):
    """Options of `crashkit coarsen`."""

    nodes: list[Positive] = []
    ratios: list[float] = []
    selection: Literal["quadric", "vtk"] | None = None
    pair_distance: float | None = None


class ModelStep(_Strict):
    """Options of `crashkit train` for one model; `model` is by default what the model is called."""

    model: ModelName | None = None
    preset: Literal["fast", "paper"] | None = None
    config: Path | None = None
    coarse: Path | None = None
    set: dict[str, Any] = {}
    epochs: Positive | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    seeds: Positive | None = None
    device: str | None = None


class TrainStep(_Strict):
    """The runs held out for testing, and the models by name."""

    test: str | int | float = 0.25
    models: dict[str, ModelStep | None] = {"mh": None, "pod-gpr": None}

    @model_validator(mode="after")
    def _named(self) -> TrainStep:
        for name, options in self.models.items():
            if Path(name).name != name or name.startswith("."):
                raise ValueError(f"{name!r} cannot be the name of a model folder")
            if (options is None or options.model is None) and name not in MODELS:
                raise ValueError(f"model {name!r} needs a kind, such as model: mh; known are {', '.join(MODELS)}")
        return self


class EvaluateStep(_Strict):
    """Options of `crashkit evaluate`."""

    write_vtu: bool = False
    write_vtkhdf: bool = False
    vtk_runs: str | None = None
    probes: list[int] = []
    intrusion: str | None = None
    workers: Positive = 1


class Study(_Strict):
    """The whole way. Either `ingest` says what the dataset is made of, or `dataset` names one that is there.

    Attributes
    ----------
    output
        Folder of the dataset, the models and the report, relative to the YAML file.
    """

    output: Path = Path("results")
    dataset: Path | None = None
    ingest: IngestStep | None = None
    coarsen: CoarsenStep | None = None
    train: TrainStep = TrainStep()
    evaluate: EvaluateStep | None = EvaluateStep()

    @model_validator(mode="after")
    def _one_source(self) -> Study:
        if (self.dataset is None) == (self.ingest is None):
            raise ValueError("expected either ingest (with its sources) or dataset")
        return self


def read_study(path: str | Path) -> Study:
    """The study in the YAML file at `path`.

    Raises
    ------
    ReadError
        Where there is no such file, or it is no YAML, with the line.
    DataError
        Where a name is not known or a value does not fit, naming it and what was expected.
    """
    return checked(Study, read_yaml(path, "a study with ingest or dataset, coarsen, train and evaluate"), path)
