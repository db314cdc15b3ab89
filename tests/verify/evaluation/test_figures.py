"""What the figures show, read from their artists and their files."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from PIL import Image
from scipy.special import ndtri

from tests.verify.evaluation.sample_results import sample_results
from verify.evaluation.figures import (
    det_figure,
    roc_figure,
    verification_figure,
    write_figures,
)
from verify.evaluation.figures.curves import shown_curves

PAPER = (("random", None), ("adversarial", "pool"), ("hybrid", "pool"))


def drawn(figure: Figure | None) -> list[Axes]:
    assert figure is not None
    return [axes for axes in figure.axes if axes.axison]


def bars(axes: Axes) -> dict[str, BarContainer]:
    return {str(c.get_label()): c for c in axes.containers if isinstance(c, BarContainer)}


def labelled(axes: Axes, label: str) -> Any:
    return next(line for line in axes.get_lines() if line.get_label() == label)


def texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def legend(figure: Figure | None) -> list[str]:
    assert figure is not None
    return [text.get_text() for text in figure.legends[0].get_texts()]


def select(results: dict[str, Any], **keys: Any) -> list[dict[str, Any]]:
    return [r for r in results["rows"] if all(r[k] == v for k, v in keys.items())]


def test_bars_are_as_high_as_the_accuracies() -> None:
    results = sample_results(datasets=("lfw", "cfp_fp"), liftings=PAPER)
    axes = drawn(verification_figure(results))
    places = [(name, mode) for mode in ("p2s", "s2s") for name in ("lfw", "cfp_fp")]
    assert len(axes) == 4
    for panel, (name, mode) in zip(axes, places, strict=True):
        for metric, label in (("euclidean", "Euclidean"), ("spherical", "spherical")):
            rows = select(results, dataset=name, mode=mode, metric=metric)
            by_dim = {"random": 0, "adversarial": 1, "hybrid": 2}
            rows.sort(key=lambda row: (by_dim[row["strategy"]], row["dim"]))
            container = bars(panel)[label]
            by_place = sorted(container.patches, key=lambda bar: bar.get_x())
            assert [bar.get_height() for bar in by_place] == pytest.approx(
                [100 * row["accuracy_mean"] for row in rows]
            )
            assert container.errorbar is not None
            whiskers = container.errorbar.lines[2][0].get_segments()
            lengths = sorted(float(end[1] - start[1]) for start, end in whiskers)
            assert lengths == pytest.approx(sorted(200 * row["accuracy_std"] for row in rows))


def test_the_reference_is_raw_by_the_same_threshold_search() -> None:
    results = sample_results(liftings=PAPER)
    (raw,) = select(results, strategy="raw", threshold_search="exact")
    for panel in drawn(verification_figure(results)):
        assert labelled(panel, "raw").get_ydata()[0] == pytest.approx(100 * raw["accuracy_mean"])
        assert f"raw\n{100 * raw['accuracy_mean']:.2f}" in texts(panel)
    results["rows"].remove(raw)
    (grid,) = select(results, strategy="raw")
    panel = drawn(verification_figure(results))[0]
    assert labelled(panel, "raw").get_ydata()[0] == pytest.approx(100 * grid["accuracy_mean"])
    results["rows"].remove(grid)
    panel = drawn(verification_figure(results))[0]
    assert not [line for line in panel.get_lines() if line.get_label() == "raw"]


def test_pool_generator_and_shared_pool_are_groups_of_their_own() -> None:
    liftings = (("adversarial", "pool"), ("adversarial", "generator"))
    both = sample_results(liftings=liftings, dims=(2,), shared=(False, True))
    top, bottom = drawn(verification_figure(both))
    names = ["adversarial\ngenerator", "adversarial\npool", "adversarial\npool, shared"]
    assert [text for text in texts(bottom) if text.startswith("adv")] == names
    assert len(bars(bottom)["spherical"].patches) == 3
    assert len(bars(top)["spherical"].patches) == 2
    only = sample_results(liftings=liftings, dims=(2,), shared=(True,))
    top, bottom = drawn(verification_figure(only))
    assert [text for text in texts(bottom) if text.startswith("adv")] == names[:2]
    assert "shared pool" in bottom.get_ylabel()
    assert "shared pool" not in top.get_ylabel()


@pytest.mark.parametrize("mode", ["p2s", "s2s"])
@pytest.mark.parametrize("metric", ["euclidean", "spherical"])
def test_one_mode_and_one_metric_are_enough(mode: str, metric: str) -> None:
    results = sample_results(liftings=PAPER, modes=(mode,), metrics=(metric,))
    figure = verification_figure(results)
    (panel,) = drawn(figure)
    assert len(bars(panel)) == 1
    assert legend(figure)[1:] == ["raw", "± 1 std over folds"]


def test_the_det_shows_the_curves_on_normal_deviates() -> None:
    results = sample_results()
    panel = drawn(det_figure(results))[0]
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("FMR %", "FNMR %")
    (curve,) = (c for c in results["curves"] if c["strategy"] == "raw")
    raw = panel.get_lines()[0]
    assert raw.get_xdata() == pytest.approx(np.clip(curve["fmr"], 0, 1 - 1e-7))
    assert raw.get_ydata() == pytest.approx(np.clip(curve["fnmr"], 1e-7, 1))
    for axis in (panel.xaxis, panel.yaxis):
        rates = np.array([0.01, 0.05, 0.2])
        placed = axis.get_transform().transform(rates)
        assert np.diff(placed) == pytest.approx(np.diff(ndtri(rates)))
    ticks = dict(zip(panel.get_xticks(), panel.get_xticklabels(), strict=True))
    assert all(float(text.get_text()) == pytest.approx(100 * at) for at, text in ticks.items())
    low, high = (np.asarray(curve[name])[3] for name in ("low", "high"))
    band = panel.collections[0].get_paths()[0].vertices
    at_fourth = band[np.isclose(band[:, 0], curve["fmr"][3]), 1]
    assert sorted(set(at_fourth.round(9))) == pytest.approx(sorted([low, high]))


def test_the_roc_shows_the_true_match_rate_over_the_logarithm() -> None:
    results = sample_results()
    panel = drawn(roc_figure(results))[0]
    assert panel.get_xscale() == "log"
    (curve,) = (c for c in results["curves"] if c["strategy"] == "raw")
    assert panel.get_lines()[0].get_ydata() == pytest.approx(100 - 100 * np.array(curve["fnmr"]))
    assert panel.get_ylim()[0] <= 100 * (1 - max(curve["fnmr"]))


def test_a_panel_has_the_ends_of_m_and_raw() -> None:
    results = sample_results(liftings=PAPER)
    results["curves"] = [
        c for c in results["curves"] if (c["strategy"], c["dim"]) != ("hybrid", 16)
    ]
    shown = shown_curves(results["curves"], "s2s")
    assert {c["metric"] for c in shown} == {"spherical", "euclidean"}
    assert {c["strategy"] for c in shown if c["metric"] == "euclidean"} == {"raw"}
    lifted = {(c["strategy"], c["dim"]) for c in shown if c["mode"] == "s2s"}
    assert lifted == {(s, m) for s in ("random", "adversarial", "hybrid") for m in (2, 8)}
    assert not any(c["strategy"] == "raw+flip" for c in shown)
    for figure in (det_figure(results), roc_figure(results)):
        names = ["raw", "random", "adversarial (pool)", "hybrid (pool)"]
        assert legend(figure)[:4] == names
        assert any(label.startswith("solid: m = ") for label in legend(figure))


@pytest.mark.long
def test_a_name_is_no_formula(tmp_path: Path) -> None:
    results = sample_results(liftings=PAPER, dims=(2, 16))
    for part in ("rows", "datasets", "curves"):
        for entry in results[part]:
            entry["name" if part == "datasets" else "dataset"] = r"$\frac{1}{$ & $x$"
    for path in write_figures(results, tmp_path):
        if path.suffix == ".svg":
            root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
            words = ["".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")]
            assert any(word.startswith(r"$\frac{1}{$ & $x$") for word in words)


@pytest.mark.long
def test_files_are_complete_readable_and_the_same_each_time(tmp_path: Path) -> None:
    results = sample_results(liftings=PAPER, dims=(2, 16))
    matplotlib.rcParams["font.size"], before = 31.0, matplotlib.rcParams["font.size"]
    try:
        paths = []
        for name in ("one", "two"):
            (tmp_path / name).mkdir()
            paths.append(write_figures(results, tmp_path / name))
        assert matplotlib.rcParams["font.size"] == 31.0
    finally:
        matplotlib.rcParams["font.size"] = before
    names = [f"{n}.{s}" for n in ("figure", "det", "roc") for s in ("png", "svg")]
    assert [path.name for path in paths[0]] == names
    for first, second in zip(*paths, strict=True):
        assert first.read_bytes() == second.read_bytes()
        if first.suffix == ".png":
            with Image.open(first) as image:
                pixels = np.asarray(image.convert("RGBA"))
                assert image.width >= 1000
            assert pixels[..., 3].min() == 255, "the ground is opaque"
            assert (pixels[0, 0, :3] == 255).all()
            assert 0.01 < (pixels[..., :3] < 128).any(axis=2).mean() < 0.6
        else:
            text = first.read_text(encoding="utf-8")
            assert "<dc:date>" not in text
            assert not re.search(r"20\d\d-\d\d-\d\d", text)
            root = ElementTree.fromstring(text)
            words = {"".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")}
            assert {"adversarial (pool)", "adversarial"} & words
            assert {"lfw", "lfw, p-to-s, spherical"} & words


def test_a_figure_without_content_is_left_out(tmp_path: Path) -> None:
    only_raw = sample_results(liftings=())
    names = [path.name for path in write_figures(only_raw, tmp_path)]
    assert names == ["det.png", "det.svg", "roc.png", "roc.svg"]
    only_raw["curves"] = []
    assert write_figures(only_raw, tmp_path) == []


def test_only_the_figures_import_matplotlib_and_never_pyplot() -> None:
    code = (
        "import sys; import verify.evaluation.tables, benchmarks.readme_results; "
        "assert 'matplotlib' not in sys.modules; "
        "import verify.evaluation.figures; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
