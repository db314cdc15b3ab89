"""Figures of an audit's report, drawn from documents of a few rows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from attacks.attributes.figure import attribute_figure
from attacks.figures import oracle_figure, write_figures
from tests.api.cli.audit_bench import are_pictures, both

OTHER = {"strategy": "random", "decoys": None, "dim": 4, "attack": "foot-point", "details": {}}


def oracle_row(variant: str, start: float) -> dict[str, Any]:
    distances = zip((1, 10, 100), (start, start - 0.1, start - 0.2), strict=True)
    curve = [{"neighbours": k, "distance_to_truth_mean": value} for k, value in distances]
    return {**OTHER, "attack": "oracle", "variant": variant, "details": {"curve": curve}}


def attribute_row(
    strategy: str, decoys: str | None, dim: int, accuracy: float, **more: Any
) -> dict[str, Any]:
    return {
        **{"strategy": strategy, "decoys": decoys, "dim": dim, "attribute": "gender"},
        **{"attacker": "knn", "metric": "euclidean", "knowledge": "algorithm"},
        **{"accuracy": accuracy, "ci_low": accuracy - 0.02, "ci_high": accuracy + 0.02},
        **{"chance": 0.5, "held_out_strength": 0.1},
        "baselines": {"majority": 0.53, "uniform": 0.5},
        **more,
    }


ORACLE = [oracle_row("neighbour", 1.3), oracle_row("projected", 1.1)]
ATTRIBUTES = [
    attribute_row("raw", None, 0, 0.9),
    attribute_row("adversarial", "generator", 16, 0.6),
]


def test_a_line_of_the_oracle_figure_is_the_curve_of_its_row() -> None:
    figure = oracle_figure([*ORACLE, OTHER])
    assert figure is not None
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.lines if len(line.get_xydata()) == 3}
    assert list(lines) == ["random, m = 4: neighbour", "random, m = 4: projected"]
    for line, row in zip(lines.values(), ORACLE, strict=True):
        curve = [tuple(point.values()) for point in row["details"]["curve"]]
        np.testing.assert_array_equal(line.get_xydata(), curve)
    assert axes.get_xscale() == "log"
    (unrelated,) = [line for line in axes.lines if len(line.get_xydata()) == 2]
    assert list(np.asarray(unrelated.get_ydata())) == pytest.approx([2**0.5] * 2)


def test_bars_are_the_papers_attacker_and_markers_the_strongest() -> None:
    schemes = [("raw", None, 0), ("random", None, 2), ("adversarial", "pool", 2)]
    schemes += [("adversarial", "generator", m) for m in (2, 8)]
    attackers = [("knn", "spherical", 0.01, 0.1), ("knn", "euclidean", 0.0, 0.1)]
    attackers += [("logistic", None, 0.05, 0.2)]
    rows = [
        attribute_row(
            *scheme, 0.9 - 0.1 * number + more,
            attribute=attribute, attacker=attacker, metric=metric, held_out_strength=strength,
        )
        for number, scheme in enumerate(schemes)
        for attribute in ("gender", "race")
        for attacker, metric, more, strength in attackers
    ]  # fmt: skip
    figure = attribute_figure(rows)
    assert figure is not None
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["gender", "race"]
    for axes in figure.axes:
        heights = [bar.get_height() for bar in axes.patches if isinstance(bar, Rectangle)]
        assert heights == pytest.approx([90, 80, 70, 60, 50])
        (marks,) = [line for line in axes.lines if line.get_marker() == "D"]
        assert list(marks.get_ydata()) == pytest.approx([95, 85, 75, 65, 55])
        levels = [line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1]
        assert {53.0, 50.0} <= set(levels)
    assert attribute_figure([row for row in rows if row["attacker"] != "knn"]) is None


def test_what_has_data_is_written_and_what_an_earlier_run_drew_is_gone(tmp_path: Path) -> None:
    assert write_figures({"rows": [], "outcomes": [OTHER]}, tmp_path) == []
    files = write_figures({"rows": ATTRIBUTES, "outcomes": ORACLE}, tmp_path)
    assert [file.name for file in files] == both(["figure", "oracle"])
    are_pictures(tmp_path, ["figure", "oracle"])
    kept = tmp_path / "report.json"
    kept.write_text("{}")
    fewer = write_figures({"rows": [], "outcomes": ORACLE}, tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([kept, *fewer])
    assert [file.name for file in fewer] == both(["oracle"])
