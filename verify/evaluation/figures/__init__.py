"""Figures of an evaluation; the only place that imports matplotlib."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from verify.evaluation.figures.bars import verification_figure
from verify.evaluation.figures.det import det_figure, liveness_figure
from verify.evaluation.figures.style import write

__all__ = ["det_figure", "liveness_figure", "verification_figure", "write_figures"]


def write_figures(results: Mapping[str, Any], folder: Path | str) -> list[Path]:
    """Write ``figure`` and ``det``, each as PNG and SVG.

    Parameters
    ----------
    folder
        An existing folder; files of these names are replaced.

    Returns
    -------
    The files written; a figure for which the results have nothing is left out.
    """
    figures = {
        "figure": verification_figure(results),
        "det": det_figure(results),
    }
    return [
        path
        for name, figure in figures.items()
        if figure is not None
        for path in write(figure, Path(folder), name)
    ]
