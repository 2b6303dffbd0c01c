"""Make the pictures of the gallery again: `python docs/make_gallery.py demo`, where `demo` is the folder of `make demo`.

Every script of examples/gallery runs on that folder. Pictures go to docs/images/gallery, the animation to the README.
"""

from __future__ import annotations

import os
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).resolve().parent
SCRIPTS = DOCS.parent / "examples" / "gallery"
# As on the page: from the data to what a surrogate is good for.
ORDER = (
    "one_state", "motion_of_all_runs", "design_space", "modes", "levels", "prediction_and_truth", "error_over_time", "band",
    "sensitivity", "response_surface", "animation",
)  # fmt: skip


def run(name: str) -> Path:
    """Run one script in the working folder; the picture that it makes."""
    import matplotlib.pyplot as plt

    plt.switch_backend("agg")
    runpy.run_path(str(SCRIPTS / f"{name}.py"), run_name="__main__")
    plt.close("all")
    return Path(f"{name}.gif" if name == "animation" else f"{name}.png")


def page() -> str:
    """The gallery as Markdown: what a picture shows, the picture, and the lines that make it."""
    sections = []
    for name in ORDER:
        _, caption, code = (SCRIPTS / f"{name}.py").read_text(encoding="utf-8").split('"""', 2)
        picture = "images/crash.gif" if name == "animation" else f"images/gallery/{name}.png"
        sections.append(
            f"## {name.replace('_', ' ').capitalize()}\n\n{caption}\n\n![{caption}]({picture})\n\n"
            f"```python\n{code.strip()}\n```\n"
        )
    return "\n".join(sections)


def main() -> None:
    """Run all scripts on the folder named on the command line."""
    if len(sys.argv) != 2 or not (Path(sys.argv[1]) / "mh").is_dir():
        sys.exit("usage: python docs/make_gallery.py demo; where demo is the folder of `make demo`")
    demo = Path(sys.argv[1]).resolve()
    pictures = DOCS / "images" / "gallery"
    pictures.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place:  # the demo has pictures of its own, such as levels.png
        for name in ("kart.zarr", "mh", "pod-gpr"):
            (Path(place) / name).symlink_to(demo / name)
        os.chdir(place)
        for name in ORDER:
            made = run(name)
            if made.suffix == ".gif":
                shutil.copy(made, DOCS / "images" / "crash.gif")
            else:
                Image.open(made).convert("RGB").quantize(128).save(pictures / made.name, optimize=True)
            print(name, flush=True)
        os.chdir(demo)


if __name__ == "__main__":
    main()
