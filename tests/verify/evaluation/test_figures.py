"""The files of the figures: complete, readable, the same each time, and with what they name."""

import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from PIL import Image

from tests.verify.evaluation.sample_results import sample_results
from verify.evaluation.figures import det_figure, verification_figure
from verify.evaluation.figures.bars import MODE_TITLES
from verify.evaluation.figures.det import shown_curves
from verify.evaluation.figures.style import write

PAPER = (("random", None), ("adversarial", "pool"), ("hybrid", "pool"))


def words(svg: Path) -> set[str]:
    root = ElementTree.fromstring(svg.read_text(encoding="utf-8"))
    return {"".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")}


def test_a_panel_has_the_ends_of_m_and_raw() -> None:
    results = sample_results(liftings=PAPER)
    curves = [c for c in results["curves"] if (c["strategy"], c["dim"]) != ("hybrid", 16)]
    shown = shown_curves(curves, "s2s")
    assert {c["strategy"] for c in shown if c["metric"] == "euclidean"} == {"raw"}
    lifted = {(c["strategy"], c["dim"]) for c in shown if c["mode"] == "s2s"}
    assert lifted == {(s, m) for s in ("random", "adversarial", "hybrid") for m in (2, 8)}
    assert not any(c["strategy"] == "raw+flip" for c in shown)


@pytest.mark.parametrize("mode", ["p2s", "s2s"])
def test_files_are_complete_readable_and_the_same_each_time(tmp_path: Path, mode: str) -> None:
    name = r"$\frac{1}{$ & $x$"  # no formula: names are foreign text
    results = sample_results(liftings=PAPER, dims=(2, 16), modes=(mode,), shared=(True,))
    for part in ("rows", "datasets", "curves"):
        for entry in results[part]:
            entry["name" if part == "datasets" else "dataset"] = name
    before = matplotlib.rcParams["font.size"]
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        paths = [
            path
            for name_of, draw in (("figure", verification_figure), ("det", det_figure))
            for path in write(draw(results), tmp_path / folder, name_of)
        ]
    assert matplotlib.rcParams["font.size"] == before
    assert [path.name for path in paths] == ["figure.png", "figure.svg", "det.png", "det.svg"]
    for path in paths:
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
    for path in paths[::2]:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGBA"))
        assert image.width >= 1000
        assert pixels[..., 3].min() == 255, "the ground is opaque"
        assert 0.01 < (pixels[..., :3] < 128).any(axis=2).mean() < 0.6
    (raw,) = (
        r for r in results["rows"] if r["strategy"] == "raw" and r["threshold_search"] == "exact"
    )
    figure, det = words(paths[1]), words(paths[3])
    title = f"{name}, {MODE_TITLES[mode]}"
    assert {title, "Euclidean", "spherical", f"{100 * raw['accuracy_mean']:.2f}"} <= figure
    assert {f"{name}, {mode[0]}-to-s, spherical", "FMR %", "FNMR %", "raw", "random"} <= det
    assert any("shared" in word for word in figure) == (mode == "s2s")
    assert not re.search(r"20\d\d-\d\d-\d\d", paths[1].read_text(encoding="utf-8"))


def test_a_figure_without_content_is_left_out() -> None:
    only_raw = sample_results(liftings=())
    assert verification_figure(only_raw) is None
    assert det_figure(only_raw) is not None
    assert det_figure(only_raw | {"curves": []}) is None
    without_folds = sample_results(liftings=PAPER, dims=(2,))
    for row in without_folds["rows"]:
        row |= dict.fromkeys(("accuracy_mean", "accuracy_std", "threshold_mean", "thresholds"))
    assert verification_figure(without_folds) is None


def test_only_the_figures_import_matplotlib_and_never_pyplot() -> None:
    code = (
        "import sys; import verify.evaluation.tables; "
        "assert 'matplotlib' not in sys.modules; "
        "import verify.evaluation.figures; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
