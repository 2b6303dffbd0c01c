"""crashkit: crash runs in, one labelled dataset, a mesh hierarchy and trustworthy surrogates out.

The functions below are what the commands of the same name call; they are imported when first used, so that
`import crashkit` stays quick. Type checkers and editors read the imports under `TYPE_CHECKING`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from crashkit.register import register_accessor
from crashkit.siblings import know_siblings
from crashkit.version import __version__ as __version__

if TYPE_CHECKING:
    from crashkit.api.coarsen import coarsen as coarsen
    from crashkit.api.estimator import Surrogate as Surrogate
    from crashkit.api.evaluate import evaluate as evaluate
    from crashkit.api.explore import explore as explore
    from crashkit.api.export import export_run as export_run
    from crashkit.api.invert import Inversion as Inversion
    from crashkit.api.invert import invert as invert
    from crashkit.api.model import Model as Model
    from crashkit.api.optimise import Optimum as Optimum
    from crashkit.api.optimise import optimise as optimise
    from crashkit.api.predict import load_model as load_model
    from crashkit.api.predict import predict as predict
    from crashkit.api.propose import propose as propose
    from crashkit.api.run_campaign import run_campaign as run_campaign
    from crashkit.api.run_study import run_study as run_study
    from crashkit.api.scatter import scatter as scatter
    from crashkit.api.train import train as train
    from crashkit.api.validate import validate as validate
    from crashkit.dataset import bumper_data as bumper_data
    from crashkit.dataset import demo_data as demo_data
    from crashkit.dataset import open_dataset as open_dataset
    from crashkit.errors import CrashkitError as CrashkitError
    from crashkit.errors import DataError as DataError
    from crashkit.errors import MeshError as MeshError
    from crashkit.errors import OutputError as OutputError
    from crashkit.errors import ReadError as ReadError
    from crashkit.ingestion.arrays import from_arrays as from_arrays
    from crashkit.ingestion.ingest import IngestSummary as IngestSummary
    from crashkit.ingestion.ingest import ingest as ingest
    from crashkit.mesh.levels import Hierarchy as Hierarchy
    from crashkit.mesh.store import open_hierarchy as open_hierarchy
    from crashkit.writers.paraview import write_paraview as write_paraview
    from data_schema import Violation as Violation
    from evaluation.comparison.result import Evaluation as Evaluation
    from evaluation.errors import EvaluationError as EvaluationError
    from surrogates.errors import SurrogateError as SurrogateError

# Public name -> the module that has it; the same as above (a test compares), imported when first used.
_LAZY = {
    "CrashkitError": "crashkit.errors",
    "DataError": "crashkit.errors",
    "Evaluation": "evaluation.comparison.result",
    "EvaluationError": "evaluation.errors",
    "Hierarchy": "crashkit.mesh.levels",
    "IngestSummary": "crashkit.ingestion.ingest",
    "Inversion": "crashkit.api.invert",
    "MeshError": "crashkit.errors",
    "Model": "crashkit.api.model",
    "Optimum": "crashkit.api.optimise",
    "OutputError": "crashkit.errors",
    "ReadError": "crashkit.errors",
    "Surrogate": "crashkit.api.estimator",
    "SurrogateError": "surrogates.errors",
    "Violation": "data_schema",
    "bumper_data": "crashkit.dataset",
    "coarsen": "crashkit.api.coarsen",
    "demo_data": "crashkit.dataset",
    "evaluate": "crashkit.api.evaluate",
    "explore": "crashkit.api.explore",
    "export_run": "crashkit.api.export",
    "from_arrays": "crashkit.ingestion.arrays",
    "ingest": "crashkit.ingestion.ingest",
    "invert": "crashkit.api.invert",
    "load_model": "crashkit.api.predict",
    "open_dataset": "crashkit.dataset",
    "open_hierarchy": "crashkit.mesh.store",
    "optimise": "crashkit.api.optimise",
    "predict": "crashkit.api.predict",
    "propose": "crashkit.api.propose",
    "run_campaign": "crashkit.api.run_campaign",
    "run_study": "crashkit.api.run_study",
    "scatter": "crashkit.api.scatter",
    "train": "crashkit.api.train",
    "validate": "crashkit.api.validate",
    "write_paraview": "crashkit.writers.paraview",
}

__all__ = ["__version__", *_LAZY]

if not TYPE_CHECKING:  # a type checker must not take this for the type of every name

    def __getattr__(name: str) -> Any:
        if name not in _LAZY:
            raise AttributeError(f"module 'crashkit' has no attribute {name!r}")
        return getattr(importlib.import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


know_siblings()
register_accessor()
