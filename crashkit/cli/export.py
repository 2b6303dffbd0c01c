"""`crashkit export`: a level of a stored model as one file for programs without this package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import print_json, say


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="model.onnx, or model.pt2 for torch.export.")],
    level: Annotated[int | None, typer.Option(help="Mesh level.", show_default="the finest it has")] = None,
    full: Annotated[bool, typer.Option("--full", help="With the lifting to the full mesh.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Write one level as ONNX or torch.export file, and check that it predicts the same."""
    from crashkit.extras import need

    need("exporting a model", "train")
    from surrogates.storage.export import export
    from surrogates.storage.folder import load

    error = export(load(model), output, level, full=full)
    if json:
        print_json({"output": output, "relative_difference": error})
        return
    say(f"{output}: predicts as the model does (largest relative difference {error:.1e})")
