"""Fills tables of the documentation from the code and from results on file, so that they cannot drift apart."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace `<!-- schema: dimensions|variables|attributes -->`, `<!-- table: FILE -->` and `<!-- project: FILE -->`."""
    markdown = re.sub(r"<!-- project: (\S+) -->", lambda found: _project_file(found[1]), markdown)
    markdown = re.sub(r"<!-- table: (\S+) -->", lambda found: (HERE / found[1]).read_text(encoding="utf-8"), markdown)
    if "<!-- gallery -->" in markdown:
        markdown = markdown.replace("<!-- gallery -->", _gallery())
    for name, make in (("dimensions", _dimensions), ("variables", _variables), ("attributes", _attributes)):
        marker = f"<!-- schema: {name} -->"
        if marker in markdown:
            markdown = markdown.replace(marker, make())
    return markdown


def _gallery() -> str:
    import runpy

    return str(runpy.run_path(str(HERE / "make_gallery.py"))["page"]())


def _project_file(name: str) -> str:
    """A page of the project's root, with its links as they are from within `docs`."""
    text = (HERE.parent / name).read_text(encoding="utf-8")
    return text.replace("](docs/", "](").replace("](CONTRIBUTING.md)", "](contributing.md)")


def on_page_content(html: str, **_: Any) -> str:
    """Formulas as MathML, which browsers draw themselves: no script, no network."""
    return re.sub(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', _formula, html, flags=re.DOTALL)


def on_post_page(output: str, **_: Any) -> str:
    """Pages of notebooks bring a script that fetches diagrams from the network; we draw none."""
    scripts = re.compile(r"<script(?: [^>]*)?>(?:(?!</script>).)*mermaid(?:(?!</script>).)*</script>", re.DOTALL)
    return scripts.sub("", output)


def _formula(found: re.Match[str]) -> str:
    from html import unescape

    from latex2mathml.converter import convert

    return convert(unescape(found[3]), display="inline" if found[2] == "(" else "block")


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines)


def _dimensions() -> str:
    from data_schema import DIMENSIONS

    return _table(("dimension", "meaning"), [(f"`{k}`", v) for k, v in DIMENSIONS.items()])


def _variables() -> str:
    from data_schema import VARIABLES

    return _table(
        ("name", "dimensions", "unit", "required", "meaning"),
        [
            (
                f"`{v.name}`",
                " or ".join(", ".join(d) for d in v.dims),
                v.unit or "-",
                "yes" if v.required else "",
                v.meaning,
            )
            for v in VARIABLES.values()
        ],
    )


def _attributes() -> str:
    from data_schema import ATTRIBUTES

    return _table(
        ("attribute", "required", "meaning"),
        [(f"`{a.name}`", "yes" if a.required else "", a.meaning) for a in ATTRIBUTES.values()],
    )
