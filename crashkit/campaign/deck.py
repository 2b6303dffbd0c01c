"""The deck of one run: files from a template, or a command of the user's that writes them.

Templates are read by Jinja2's sandbox with `{{ ... }}` alone, so that decks may contain whatever else they like. A name
that the box does not have is an error before anything is computed.
"""

from __future__ import annotations

import shutil
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from crashkit.campaign.box import CampaignError

# Statements and comments of the template language are given delimiters that no deck contains.
_UNUSED = {
    "block_start_string": "\x01%", "block_end_string": "%\x01",
    "comment_start_string": "\x01#", "comment_end_string": "#\x01",
}  # fmt: skip


def template_files(home: Path, patterns: Sequence[str]) -> list[Path]:
    """The files that `patterns` (relative to `home`) mean, sorted.

    Raises
    ------
    CampaignError
        Where one means none.
    """
    out: list[Path] = []
    for pattern in patterns:
        found = sorted(p for p in home.glob(pattern) if p.is_file())
        if not found:
            raise CampaignError(f"{home / pattern}: no such file; the campaign file names it as template or file")
        out += found
    names = [p.name for p in out]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice:
        raise CampaignError(f"two files are called {twice}; every file of a run needs a name of its own")
    return out


def check_template(file: Path, names: Sequence[str]) -> None:
    """Raise CampaignError, with the line, where the template cannot be read or names what the box does not have."""
    from jinja2 import TemplateError, TemplateSyntaxError, meta

    environment = _environment()
    text = _text(file)
    try:
        unknown = sorted(meta.find_undeclared_variables(environment.parse(text)) - set(names))
    except TemplateSyntaxError as error:
        raise CampaignError(f"{file}, line {error.lineno}: {error.message}") from error
    except TemplateError as error:
        raise CampaignError(f"{file}: {error}") from error
    if unknown:
        line = next((k for k, row in enumerate(text.splitlines(), 1) if "{{" in row and unknown[0] in row), 1)
        raise CampaignError(f"{file}, line {line}: {unknown[0]!r} is no parameter; the box has {', '.join(names)}")


def write_deck(folder: Path, templates: Sequence[Path], files: Sequence[Path], values: Mapping[str, float]) -> None:
    """Fill `templates` with `values` into `folder`, and copy `files` beside them."""
    from jinja2 import TemplateError

    environment = _environment()
    for template in templates:
        try:
            text = environment.from_string(_text(template)).render(**values)
        except (TemplateError, ArithmeticError, ValueError, TypeError) as error:
            raise CampaignError(f"{template}: cannot be filled ({' '.join(str(error).split())})") from error
        (folder / template.name).write_text(text, encoding="utf-8", newline="\n")
    for file in files:
        shutil.copyfile(file, folder / file.name)


def arguments(command: Sequence[str], values: Mapping[str, Any]) -> list[str]:
    """`command` with {name} replaced by values; a number is written with ten significant digits.

    Raises
    ------
    CampaignError
        For a name that is not among `values`.
    """
    out = []
    for word in command:
        pieces = []
        try:
            parsed = list(string.Formatter().parse(word))
        except ValueError as error:
            raise CampaignError(
                f"{word!r} in a command cannot be read ({error}); braces are written {{{{ and }}}}"
            ) from error
        for text, name, spec, _ in parsed:
            pieces.append(text)
            if name is None:
                continue
            if name not in values:
                raise CampaignError(f"{{{name}}} in a command is no parameter; there are {', '.join(map(str, values))}")
            value = values[name]
            pieces.append(format(value, spec or ".10g") if isinstance(value, float) else str(value))
        out.append("".join(pieces))
    return out


def program_of(command: Sequence[str], home: Path) -> str:
    """The program that `command` starts, as a path; looked for beside the campaign file, then on the PATH.

    Raises
    ------
    CampaignError
        Where there is none.
    """
    first = command[0].replace("{study}", str(home.resolve()))
    if "/" in first or (home / first).is_file():
        path = (home / first).absolute()  # a link stays one: the python of an environment is a link
        if not path.is_file():
            raise CampaignError(f"{path}: no such program; the campaign file starts runs with it")
        found = shutil.which(str(path))
        if found is None:
            raise CampaignError(f"{path}: is not executable; make it so with chmod +x")
        return found
    found = shutil.which(first)
    if found is None:
        raise CampaignError(
            f"the program {first!r} is not on the PATH; install it, or give its path in the campaign file"
        )
    return found


def _environment() -> Any:
    from jinja2 import StrictUndefined
    from jinja2.sandbox import SandboxedEnvironment

    return SandboxedEnvironment(undefined=StrictUndefined, keep_trailing_newline=True, autoescape=False, **_UNUSED)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return file.read_text(encoding="latin-1")
    except OSError as error:
        raise CampaignError(f"{file}: cannot be read ({error.strerror or error})") from error
