"""The results table of docs/evaluation.md, of a small document."""

import argparse
import json
from pathlib import Path

import pytest

from benchmarks.readme_results import BEGIN, END, measure, readme_table, table_rows
from tests.verify.evaluation.sample_results import sample_results


def test_every_number_of_the_table_is_in_the_results() -> None:
    results = sample_results(dims=(2, 16), seed=3)
    rows = table_rows([results])
    assert list(rows[0]) == ["lifting (decoys)", "matching", "m = 2", "m = 16"]
    assert len(rows) == 5 * 2
    modes = {"p-to-s": "p2s", "s-to-s": "s2s"}
    for line in rows:
        strategy, _, decoys = str(line["lifting (decoys)"]).rstrip(")").partition(" (")
        for dim in (2, 16):
            (row,) = (
                r
                for r in results["rows"]
                if (r["strategy"], r["decoys"] or "", r["dim"]) == (strategy, decoys, dim)
                and (r["mode"], r["metric"]) == (modes[str(line["matching"])], "spherical")
            )
            assert line[f"m = {dim}"] == f"{100 * row['accuracy_mean']:.2f} ± 0.04"
    raw = next(r for r in results["rows"] if r["strategy"] == "raw" and r["dim"] == 0)
    assert raw["threshold_search"] == "exact"
    block = readme_table([results])
    assert f"Raw embeddings: {100 * raw['accuracy_mean']:.2f} %" in block
    assert "6,000 pairs of LFW (3,000 genuine and 3,000 impostor compared)" in block
    assert "mean of 3 seeds" in block


def test_several_results_make_one_table_between_the_markers_only(tmp_path: Path) -> None:
    results = sample_results(dims=(2, 16), datasets=("lfw", "cfp_fp"))
    files = []
    for number, dim in enumerate((2, 16)):
        files.append(tmp_path / f"{number}.json")
        part = [row for row in results["rows"] if row["dim"] in (0, dim)]
        files[-1].write_text(json.dumps(results | {"rows": part}), encoding="utf-8")
    page = tmp_path / "README.md"
    page.write_text(f"# A\n\n{BEGIN}\nold\n{END}\n\nrest\n", encoding="utf-8")
    wanted = f"# A\n\n{BEGIN}\n{readme_table([results])}\n{END}\n\nrest\n"
    for _ in range(2):
        assert measure(argparse.Namespace(results=files, write=page)) == table_rows([results])
        assert page.read_text(encoding="utf-8") == wanted
    page.write_text("a page without its markers", encoding="utf-8")
    with pytest.raises(ValueError, match="unpack"):
        measure(argparse.Namespace(results=files, write=page))
