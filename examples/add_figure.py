"""Adding a figure to the report, in under 60 lines: the error of every model against the motion of the state.

Run it with `python examples/add_figure.py kart.zarr REPORT MODEL...`. In a package of your own, name the figure under
the entry point group `crashkit.figures` instead of calling `register`; then `crashkit evaluate` shows it as well.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import crashkit
from evaluation.figures import Kind, Sheet, register


@dataclass(frozen=True)
class ErrorOverMotion:
    """For every state of a test run (state,): the true mean displacement, cm, and model -> mean node error, cm."""

    motion: np.ndarray
    errors: Mapping[str, np.ndarray]

    def numbers(self):
        """What the CSV beside the figure holds."""
        return {"mean_displacement_cm": self.motion, **{f"{model} (cm)": e for model, e in self.errors.items()}}

    def draw(self, sheet: Sheet):
        """The sheet knows how wide the page is, and how each model looks in all figures."""
        figure, (axes,) = sheet.panels(1, height=7)
        for model, error in self.errors.items():
            style = sheet.style(model)
            axes.plot(self.motion, error, style.marker, color=style.colour, alpha=0.5, label=model)
        axes.set_xlabel("mean displacement of a state (cm)")
        axes.set_ylabel("mean node error (cm)")
        sheet.legend(figure, axes)
        return figure

    def caption(self) -> str:
        """What to see, from the numbers themselves."""
        links = {model: np.corrcoef(self.motion, error)[0, 1] for model, error in self.errors.items()}
        most = max(links, key=lambda model: links[model])
        return f"Every point is a state of a test run. {most} follows the motion most closely ({links[most]:.2f})."


def select(evaluation):
    """Take the arrays out of the evaluation; None would leave the figure out."""
    errors = {e.label: 100 * evaluation.scores[e.label].e2.mean(axis=0).ravel() for e in evaluation.entries}
    return ErrorOverMotion(100 * np.array([run.size for run in evaluation.runs]).ravel(), errors)


if __name__ == "__main__":
    register(Kind("error_over_motion", "Error over motion", select))
    crashkit.evaluate(sys.argv[1], sys.argv[3:], sys.argv[2])
