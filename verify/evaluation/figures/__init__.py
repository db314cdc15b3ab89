"""Figures of an evaluation; the only place that imports matplotlib."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from verify.evaluation.figures.bars import verification_figure
from verify.evaluation.figures.curves import det_figure, roc_figure
from verify.evaluation.figures.frontier import frontier_figure
from verify.evaluation.figures.style import write

__all__ = ["det_figure", "frontier_figure", "roc_figure", "verification_figure", "write_figures"]


def write_figures(
    results: Mapping[str, Any], folder: Path | str, *, audit: Mapping[str, Any] | None = None
) -> list[Path]:
    """Write ``figure``, ``det``, ``roc`` and, with an audit, ``frontier``, each as PNG and SVG.

    Parameters
    ----------
    folder
        An existing folder; files of these names are replaced.
    audit
        The ``report.json`` of `veilface audit fairface`.

    Returns
    -------
    The files written; a figure for which the results have nothing is left out.

    Raises
    ------
    DatasetError
        If the audit report is not one or lacks fields; nothing is written then.
    """
    figures = {
        "figure": verification_figure(results),
        "det": det_figure(results),
        "roc": roc_figure(results),
        "frontier": frontier_figure(results, audit) if audit is not None else None,
    }
    return [
        path
        for name, figure in figures.items()
        if figure is not None
        for path in write(figure, Path(folder), name)
    ]
