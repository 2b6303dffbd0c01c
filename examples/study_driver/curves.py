"""Learning curves of several structures beside each other, from what studies and `benchmarks/physics_table.py` have written.

    python examples/study_driver/curves.py "kart frame=kart.csv" "bumper=study/results/learning_curves.csv" -o curves
    python examples/study_driver/curves.py ... -o curves --models POD-GPR,"POD-GPR without physics"

Writes curves.png, curves.svg and curves.csv. Each panel keeps the unit of its file.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from evaluation.figures import Sheet
from evaluation.figures.kind import Columns, write
from study_driver.tables import UNITS, LearningCurves, columns, curve_styles


@dataclass(frozen=True)
class SideBySide:
    """Learning curves by the name of their structure."""

    curves: dict[str, LearningCurves]

    def numbers(self) -> Columns:
        lines = [
            (name, *line[:2], line[2] * UNITS["mm"] / UNITS[of.unit])
            for name, of in self.curves.items()
            for line in zip(*of.numbers().values(), strict=True)
        ]
        return columns(("structure", "model", "training_runs", "mean_node_error_mm"), lines)

    def draw(self, sheet: Sheet) -> Any:
        figure, axes = sheet.panels(len(self.curves), height=7.0)
        for panel, (name, of) in zip(axes, self.curves.items(), strict=True):
            of.draw_on(panel, sheet)
            panel.set_title(name)
        most = max(zip(axes, self.curves.values(), strict=True), key=lambda pair: len(pair[1].errors))
        sheet.legend(figure, most[0])
        return figure

    def caption(self) -> str:
        return "Mean node error on the full mesh over test runs against the number of training runs."


def read(file: Path, models: Sequence[str] = ()) -> LearningCurves:
    """Curves from a file of `LearningCurves.numbers`; only those of `models`, where it names some."""
    with file.open(encoding="utf-8", newline="") as text:
        lines = list(csv.DictReader(text))
    (head,) = (name for name in lines[0] if name.startswith("mean_node_error_"))
    unit = head.rpartition("_")[2]
    sizes = sorted({int(line["training_runs"]) for line in lines})
    errors: dict[str, list[float]] = {}
    for line in lines:
        if models and line["model"] not in models:
            continue
        of = errors.setdefault(line["model"], [np.nan] * len(sizes))
        of[sizes.index(int(line["training_runs"]))] = float(line[head] or "nan") / UNITS[unit]
    return LearningCurves(tuple(sizes), errors, unit)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", help="structure=FILE.csv")
    parser.add_argument("--models", default="", help="show these alone, such as POD-GPR,MH1; default: all")
    parser.add_argument("-o", "--output", type=Path, default=Path("curves"), help="the files' name without its ending")
    given = parser.parse_args(arguments)
    models = [name.strip() for name in given.models.split(",") if name.strip()]
    pairs = [text.partition("=")[::2] for text in given.files]
    both = SideBySide({name: read(Path(file), models) for name, file in pairs})
    labels = list(dict.fromkeys(label for of in both.curves.values() for label in of.errors))
    paths, _ = write(both, given.output.name, given.output.parent, Sheet(styles=curve_styles(labels)))
    for path in paths:
        print(f"  {path}")


if __name__ == "__main__":
    main()
