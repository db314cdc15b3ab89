"""The figure shows the numbers of the rows."""

from collections.abc import Iterator
from typing import Any

import pytest
from matplotlib.patches import Rectangle

from attacks.attributes.figure import attribute_figure


def rows() -> Iterator[dict[str, Any]]:
    accuracy = 0.9
    for strategy, decoys, dim in (
        ("raw", None, 0),
        ("random", None, 2),
        ("adversarial", "pool", 2),
        ("adversarial", "generator", 2),
        ("adversarial", "generator", 8),
    ):
        for attribute in ("gender", "race"):
            for attacker, metric, more, strength in (
                ("knn", "spherical", 0.01, 0.1),
                ("knn", "euclidean", 0.0, 0.1),
                ("svm", None, 0.05, 0.2),
            ):
                value = accuracy + more
                yield {
                    "strategy": strategy,
                    "decoys": decoys,
                    "dim": dim,
                    "attribute": attribute,
                    "attacker": attacker,
                    "metric": metric,
                    "knowledge": "algorithm",
                    "accuracy": value,
                    "ci_low": value - 0.02,
                    "ci_high": value + 0.02,
                    "held_out_strength": strength,
                    "baselines": {"majority": 0.53, "uniform": 0.5},
                }
        accuracy -= 0.1


def test_bars_are_the_papers_attacker_and_markers_the_strongest() -> None:
    figure = attribute_figure(list(rows()))
    assert figure is not None
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["gender", "race"]
    for axes in figure.axes:
        heights = [bar.get_height() for bar in axes.patches if isinstance(bar, Rectangle)]
        assert heights == pytest.approx([90, 80, 70, 60, 50])
        (marks,) = [line for line in axes.lines if line.get_marker() == "D"]
        assert list(marks.get_ydata()) == pytest.approx([95, 85, 75, 65, 55])
        levels = [line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1]
        assert {53.0, 50.0} <= set(levels)
    assert attribute_figure([row for row in rows() if row["attacker"] != "knn"]) is None
