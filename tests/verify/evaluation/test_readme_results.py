"""The results table of docs/evaluation.md, of a small document."""

import argparse
import json
from pathlib import Path

import pytest

from benchmarks.readme_results import BEGIN, END, measure, readme_table, table_rows
from tests.verify.evaluation.made_results import made_results, row_of


def test_every_number_of_the_table_is_in_the_results() -> None:
    results = made_results()
    lines = table_rows([results])
    assert list(lines[0]) == ["lifting (decoys)", "matching", "m = 2", "m = 3"]
    assert len(lines) == 5 * 2
    kind = {"pool, shared": "pool", "generator": "generator", "": None}
    for line in lines:
        strategy, _, decoys = str(line["lifting (decoys)"]).rstrip(")").partition(" (")
        keys = {"strategy": strategy, "decoys": kind[decoys], "metric": "spherical"}
        for dim in (2, 3):
            mode = str(line["matching"]).replace("-to-", "2")
            row = row_of(results, mode=mode, dim=dim, **keys)
            shown = f"{100 * row['accuracy_mean']:.2f} ± {100 * row['accuracy_std_seeds']:.2f}"
            assert line[f"m = {dim}"] == shown
    raw = row_of(results, strategy="raw", threshold_search="exact")
    block = readme_table([results])
    assert f"Raw embeddings: {100 * raw['accuracy_mean']:.2f} %" in block
    assert "100 pairs of LFW (50 genuine and 50 impostor compared)" in block
    assert "mean of 2 seeds" in block


def test_several_results_make_one_table_between_the_markers_only(tmp_path: Path) -> None:
    results = made_results()
    files = []
    for number, dim in enumerate((2, 3)):
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
