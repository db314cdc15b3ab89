"""Figures of an evaluation; the only place that imports matplotlib."""

from verify.evaluation.figures.bars import verification_figure
from verify.evaluation.figures.det import det_figure

__all__ = ["det_figure", "verification_figure"]
