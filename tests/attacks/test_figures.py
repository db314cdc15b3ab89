"""Figures of an audit's report, drawn from documents of a few rows."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import StepPatch
from PIL import Image

from attacks.figures import NAMES, linkage_figure, oracle_figure, write_figures

SCHEMES = (
    {"strategy": "adversarial", "decoys": "generator", "dim": 16},
    {"strategy": "random", "decoys": None, "dim": 4},
)
SETTINGS = ("secret rotations", "one tenant", "holder's key kept", "one set for both")
SCORES = ("nearest points", "foot lengths")


def linkage_rows() -> list[dict[str, Any]]:
    """Local D(s) that differs from row to row, to be told apart in the figure."""
    rows: list[dict[str, Any]] = []
    for scheme in SCHEMES:
        for setting in SETTINGS:
            for score in SCORES:
                level = len(rows) / 20
                rows.append(
                    {
                        **scheme,
                        "attack": score,
                        "property": "unlinkability",
                        "variant": setting,
                        "details": {
                            "score_edges": [0.0, 0.25, 0.5, 1.0],
                            "local_d": [level, level + 0.1, level + 0.2],
                        },
                    }
                )
    return rows


def oracle_rows() -> list[dict[str, Any]]:
    return [
        {
            **scheme,
            "attack": "oracle",
            "property": "irreversibility",
            "variant": variant,
            "details": {
                "curve": [
                    {"neighbours": k, "distance_to_truth_mean": start - 0.1 * i}
                    for i, k in enumerate((1, 10, 100))
                ]
            },
        }
        for scheme, variant, start in (
            (SCHEMES[0], "gallery", 1.3),
            (SCHEMES[0], "projected", 1.1),
            (SCHEMES[1], "gallery", 0.9),
        )
    ]


def attribute_row(strategy: str, decoys: str | None, dim: int, accuracy: float) -> dict[str, Any]:
    return {
        **{"strategy": strategy, "decoys": decoys, "dim": dim, "attribute": "gender"},
        **{"attacker": "knn", "metric": "euclidean", "knowledge": "algorithm"},
        **{"accuracy": accuracy, "ci_low": accuracy - 0.02, "ci_high": accuracy + 0.02},
        **{"chance": 0.5, "held_out_strength": 0.1},
        "baselines": {"majority": 0.5, "uniform": 0.5, "prior": 0.5},
    }


ATTRIBUTES = [
    attribute_row("raw", None, 0, 0.9),
    attribute_row("adversarial", "generator", 16, 0.6),
]
OTHER = {
    **SCHEMES[0],
    "attack": "foot-point",
    "property": "irreversibility",
    "variant": "",
    "details": {},
}


def document(rows: list[dict[str, Any]], outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    return {"format": "veilface audit", "rows": rows, "outcomes": outcomes}


def test_a_line_of_the_linkage_figure_is_the_local_d_of_its_row() -> None:
    rows = linkage_rows()
    figure = linkage_figure([OTHER, *rows])
    assert figure is not None
    panels = figure.axes
    assert len(panels) == len(SCHEMES) * len(SCORES)
    titles = [axes.get_title(loc="left") for axes in panels]
    assert titles == ["adversarial, m = 16, generated decoys"] * 2 + ["random, m = 4"] * 2
    assert [axes.get_xlabel() for axes in panels] == [f"score: {name}" for name in SCORES] * 2
    for place, axes in enumerate(panels):
        mine = [row for row in rows if row["dim"] == (16 if place < 2 else 4)]
        mine = [row for row in mine if row["attack"] == SCORES[place % 2]]
        drawn = [patch for patch in axes.patches if isinstance(patch, StepPatch)]
        assert [patch.get_label() for patch in drawn] == list(SETTINGS)
        for patch, row in zip(drawn, mine, strict=True):
            values, edges, _ = patch.get_data()
            np.testing.assert_array_equal(values, row["details"]["local_d"])
            np.testing.assert_array_equal(edges, row["details"]["score_edges"])
        looks = {(patch.get_edgecolor(), str(patch.get_linestyle())) for patch in drawn}
        assert len(looks) == len(SETTINGS)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(SETTINGS)


def test_a_setting_of_one_score_is_in_the_legend() -> None:
    rows = linkage_rows()
    alone = {**rows[-1], "variant": "a control"}
    figure = linkage_figure([*rows, alone])
    assert figure is not None
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [*SETTINGS, "a control"]


def test_a_line_of_the_oracle_figure_is_the_curve_of_its_row() -> None:
    rows = oracle_rows()
    figure = oracle_figure([*rows, OTHER])
    assert figure is not None
    (axes,) = figure.axes
    lines = {
        line.get_label(): line for line in axes.lines if len(np.asarray(line.get_xdata())) == 3
    }
    assert list(lines) == [
        "adversarial, m = 16, generated decoys: gallery",
        "adversarial, m = 16, generated decoys: projected",
        "random, m = 4: gallery",
    ]
    for line, row in zip(lines.values(), rows, strict=True):
        curve = row["details"]["curve"]
        assert list(np.asarray(line.get_xdata())) == [1, 10, 100]
        assert list(np.asarray(line.get_ydata())) == [
            point["distance_to_truth_mean"] for point in curve
        ]
    assert axes.get_xscale() == "log"
    (unrelated,) = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == 2]
    assert list(np.asarray(unrelated.get_ydata())) == pytest.approx([2**0.5] * 2)


def test_there_is_no_figure_without_data(tmp_path: Path) -> None:
    assert linkage_figure([OTHER]) is None
    assert oracle_figure([OTHER]) is None
    assert linkage_figure([]) is None
    assert oracle_figure([]) is None
    assert write_figures(document([], [OTHER]), tmp_path) == []
    assert write_figures(document([], []), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_what_has_data_is_written_and_what_an_earlier_run_drew_is_gone(tmp_path: Path) -> None:
    whole = document(ATTRIBUTES, [*linkage_rows()[:6], *oracle_rows()])
    files = write_figures(whole, tmp_path)
    expected = [f"{name}.{end}" for name in NAMES for end in ("png", "svg")]
    assert [file.name for file in files] == expected
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(expected)
    for name in NAMES:
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert min(picture.size) > 300
            assert len(set(np.asarray(picture.convert("L")).ravel().tolist())) > 10
        assert ET.parse(tmp_path / f"{name}.svg").getroot().tag.endswith("svg")
    kept = tmp_path / "report.json"
    kept.write_text("{}")
    fewer = write_figures(document([], oracle_rows()), tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([kept, *fewer])
    assert [file.name for file in fewer] == ["oracle.png", "oracle.svg"]
