"""The public functions: paths or objects in, objects out; no typer, no printing."""
