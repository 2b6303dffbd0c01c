"""Make the project's environment and show what happens meanwhile: `python tools/make_environment.py .venv`.

The environment has the package with all extras, the development tools, and the exact versions of constraints.txt. Only the
standard library is used, since nothing else is installed yet. Everything that pip prints is kept in `install.log` in
the environment's folder.
"""

from __future__ import annotations

import queue
import re
import subprocess
import sys
import sysconfig
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PATIENCE = 3.0  # seconds without a line at most


class Display:
    """One line that is rewritten on a terminal, or one line every few seconds elsewhere."""

    def __init__(self) -> None:
        self._start = self._last = time.monotonic()
        self._terminal = sys.stdout.isatty()

    def heading(self, text: str) -> None:
        """Start a step."""
        print(("\r\x1b[K" if self._terminal else "") + text, flush=True)
        self._last = time.monotonic()

    def status(self, text: str) -> None:
        """Say what happens now, if it is time to say something."""
        now = time.monotonic()
        if now - self._last < (0.2 if self._terminal else PATIENCE):
            return
        self._last = now
        line = f"  {now - self._start:4.0f} s | {text}"[:79]
        print(("\r\x1b[K" + line) if self._terminal else line, end="" if self._terminal else "\n", flush=True)


def explain(line: str, before: str) -> str:
    """What a line of pip's output means, in words; `before` where it is nothing to show."""
    if found := re.match(r"\s*Downloading (\S+?)-(\d[^-\s]*)\S*(?: \(([^)]*)\))?", line):
        return f"downloading {found[1].rsplit('/', 1)[-1]} {found[2]}" + (f" ({found[3]})" if found[3] else "")
    if found := re.match(r"\s*(?:Collecting|Requirement already satisfied:) ([A-Za-z0-9_.-]+)", line):
        return f"looking up {found[1]}"
    if line.startswith("Installing collected packages:"):
        return f"installing {line.count(',') + 1} packages"
    if found := re.match(r"\s*(?:Building|Preparing) .* for ([A-Za-z0-9_.-]+)", line):
        return f"building {found[1]}"
    return before


def installed(folder: Path) -> int:
    """How many packages the environment has so far."""
    packages = Path(sysconfig.get_path("purelib", "venv", {"base": str(folder), "platbase": str(folder)}))
    try:
        return sum(entry.name.endswith(".dist-info") for entry in packages.iterdir())
    except OSError:
        return 0


def run(command: list[str], folder: Path, log: Path, display: Display) -> None:
    """Run a command; its lines go to the log, and a status line appears every few seconds."""
    lines: queue.Queue[str | None] = queue.Queue()
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    doing = "starting"
    with log.open("a", encoding="utf-8") as file:
        while True:
            try:
                line = lines.get(timeout=1.0)
            except queue.Empty:
                line = ""
            if line is None:
                break
            file.write(line)
            doing = explain(line, doing)
            display.status(doing + (f", {installed(folder)} there" if doing.startswith("installing") else ""))
    if process.wait():
        tail = "".join(log.read_text(encoding="utf-8").splitlines(keepends=True)[-25:])
        sys.exit(f"\n{tail}\nThe environment could not be made; the lines above say why, {log} has all of them.")


def main() -> None:
    """Make the folder named on the command line, `.venv` without a name."""
    name = sys.argv[1] if len(sys.argv) > 1 else ".venv"
    folder = Path(name).resolve()
    display = Display()
    if sys.version_info < (3, 11):  # noqa: UP036 - whoever starts this may have an older Python
        sys.exit(f"Python {sys.version.split()[0]} found; crashkit needs 3.11 or later: make PYTHON=python3.12")
    windows = sys.platform == "win32"
    python = folder / ("Scripts/python.exe" if windows else "bin/python")
    display.heading(f"[1/3] virtual environment in {name} (about 3 GB in the end; once, some minutes)")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "install.log"
    log.unlink(missing_ok=True)
    if not python.exists():
        run([sys.executable, "-m", "venv", str(folder)], folder, log, display)
    pip = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "--progress-bar", "off"]
    display.heading("[2/3] pip itself")
    run([*pip, "--upgrade", "pip>=25.1"], folder, log, display)  # the first that knows dependency groups
    display.heading("[3/3] crashkit, its extras and the development tools, as listed in constraints.txt")
    run([*pip, "-c", "constraints.txt", "-e", ".[all]", "--group", "dev"], folder, log, display)
    use = rf"{name}\Scripts\activate" if windows else f"source {name}/bin/activate"
    display.heading(f"ready: {name}; to use it in a shell: {use}")


if __name__ == "__main__":
    main()
