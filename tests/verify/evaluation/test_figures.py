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

from tests.verify.evaluation.made_results import made_results
from verify.evaluation.figures import det_figure, verification_figure
from verify.evaluation.figures.bars import MODE_TITLES
from verify.evaluation.figures.det import shown_curves
from verify.evaluation.figures.style import write


def words(svg: Path) -> set[str]:
    root = ElementTree.fromstring(svg.read_text(encoding="utf-8"))
    return {"".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")}


def test_a_panel_has_the_ends_of_m_that_all_have_and_raw() -> None:
    curves = made_results()["curves"]
    further = [c | {"dim": 16} for c in curves if c["strategy"] == "random" and c["dim"] == 2]
    shown = shown_curves([*curves, *further], "s2s")
    assert {c["strategy"] for c in shown if c["metric"] == "euclidean"} == {"raw"}
    lifted = {(c["strategy"], c["dim"]) for c in shown if c["mode"] == "s2s"}
    assert lifted == {(s, m) for s in ("random", "adversarial", "hybrid") for m in (2, 3)}


@pytest.mark.parametrize("mode", ["p2s", "s2s"])
def test_files_are_complete_readable_and_the_same_each_time(tmp_path: Path, mode: str) -> None:
    name = r"$\frac{1}{$ & $x$"  # no formula: names are foreign text
    results = made_results()
    for part in ("rows", "curves"):
        results[part] = [one for one in results[part] if one["mode"] in (mode, "p2p")]
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
    assert {f"{name}, {mode[0]}-to-s, spherical", "FMR %", "FNMR %", "raw", "random, m = 2"} <= det
    assert "(pool, shared)" in figure
    assert not re.search(r"20\d\d-\d\d-\d\d", paths[1].read_text(encoding="utf-8"))


def test_a_figure_without_content_is_left_out() -> None:
    results = made_results()
    only_raw = results | {
        part: [one for one in results[part] if one["mode"] == "p2p"] for part in ("rows", "curves")
    }
    assert verification_figure(only_raw) is None
    assert det_figure(only_raw) is not None
    assert det_figure(only_raw | {"curves": []}) is None
    for row in results["rows"]:
        row |= dict.fromkeys(("accuracy_mean", "accuracy_std", "threshold_mean"))
    assert verification_figure(results) is None


def test_only_the_figures_import_matplotlib_and_never_pyplot() -> None:
    code = (
        "import sys; import verify.evaluation.tables; "
        "assert 'matplotlib' not in sys.modules; "
        "import verify.evaluation.figures; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
