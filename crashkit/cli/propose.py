"""`crashkit propose`: which runs to compute next, as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import names, print_json, say
from crashkit.cli._progress import Progress


def command(
    dataset: Annotated[
        Path | None, typer.Argument(help="Dataset with the runs computed so far (.zarr or .nc).", show_default=False)
    ] = None,
    box: Annotated[
        Path | None, typer.Option(help="Box of the parameters (YAML).", show_default="what the runs span")
    ] = None,
    count: Annotated[int, typer.Option("--count", "-n", help="Number of runs.", min=1)] = 8,
    output: Annotated[Path, typer.Option("--output", "-o", help="Table to write.")] = Path("next.csv"),
    method: Annotated[str, typer.Option(help="expected-reduction, halton, sobol or random.")] = "expected-reduction",
    seed: Annotated[int, typer.Option(help="The same seed gives the same table.", min=0)] = 0,
    odd: Annotated[
        str,
        typer.Option(help="Parameters that change sign in the mirror, with commas.", show_default="those of the box"),
    ] = "",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a table that is there.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the table as JSON, too.")] = False,
) -> None:
    """Propose the next runs: without a dataset they fill the box, with one they lower its error most."""
    from typing import get_args

    from crashkit.api.propose import check_table_name, propose, write_table
    from crashkit.campaign.plan import Method
    from crashkit.output import refuse_there

    if method not in get_args(Method):
        raise typer.BadParameter(f"{method!r}; expected one of {', '.join(get_args(Method))}", param_hint="--method")
    if dataset is None and box is None:
        raise typer.BadParameter("give a dataset, or a box with --box box.yaml", param_hint="DATASET|--box")
    check_table_name(output)
    refuse_there([output], overwrite)
    with Progress(f"reading {dataset or box}", quiet=json) as shown:
        table = propose(
            dataset, count, box=box, method=method, seed=seed,  # type: ignore[arg-type]
            odd=tuple(names(odd)), report=shown.step,
        )  # fmt: skip
    write_table(table, output)
    now, after = table.attrs.get("expected_error_m"), table.attrs.get("expected_error_after_m")
    if json:
        print_json({"output": output, "runs": table.reset_index().to_dict("records"), **table.attrs})
        return
    if now is not None and after is not None:
        say(f"expected error over the box: {1e3 * now:.2f} mm now, {1e3 * after:.2f} mm with these {len(table)} runs")
    say(f"{output}: {len(table)} runs to compute; then ingest them and propose again")
