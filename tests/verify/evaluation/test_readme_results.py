"""The README's results table, made from a small document by the script that makes the real one."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.readme_results import BEGIN, END, main, merged, readme_table, written_into
from tests.verify.evaluation.sample_results import sample_results
from verify.datasets import DatasetError


def document(tmp_path: Path, results: Any) -> Path:
    path = tmp_path / "results.json"
    path.write_text(json.dumps(results), encoding="utf-8")
    return path


def test_every_number_of_the_table_is_in_the_results() -> None:
    results = sample_results(dims=(2, 16), seed=3)
    block = readme_table(results)
    lines = [line for line in block.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert rows[0] == ["lifting (decoys)", "matching", "m = 2", "m = 16"]
    assert len(rows) - 2 == 5 * 2
    modes = {"p-to-s": "p2s", "s-to-s": "s2s"}
    for label, mode, *cells in rows[2:]:
        strategy, _, decoys = label.rstrip(")").partition(" (")
        for dim, cell in zip((2, 16), cells, strict=True):
            (row,) = (
                r
                for r in results["rows"]
                if (r["strategy"], r["decoys"] or "", r["dim"]) == (strategy, decoys, dim)
                and (r["mode"], r["metric"]) == (modes[mode], "spherical")
            )
            assert cell == f"{100 * row['accuracy_mean']:.2f} ± 0.04"
    raw = next(r for r in results["rows"] if r["strategy"] == "raw" and r["dim"] == 0)
    assert raw["threshold_search"] == "exact"
    assert f"Raw embeddings: {100 * raw['accuracy_mean']:.2f} %" in block
    assert "6,000 pairs of LFW (3,000 genuine and 3,000 impostor compared)" in block
    assert "mean of 3 seeds" in block


def test_a_cell_that_was_not_run_is_a_dash() -> None:
    results = sample_results(dims=(2, 16), liftings=(("random", None),))
    results["rows"] = [r for r in results["rows"] if (r["mode"], r["dim"]) != ("s2s", 16)]
    assert readme_table(results).splitlines()[-1].rstrip(" |").endswith("-")


def test_the_table_is_written_between_the_markers_only(tmp_path: Path) -> None:
    results = sample_results(dims=(2,))
    readme = tmp_path / "README.md"
    readme.write_text(f"# A\n\n{BEGIN}\nold\n{END}\n\nrest\n", encoding="utf-8")
    arguments = [str(document(tmp_path, results)), "--write", str(readme)]
    assert main(arguments) == 0
    once = readme.read_text(encoding="utf-8")
    assert once == f"# A\n\n{BEGIN}\n{readme_table(results)}\n{END}\n\nrest\n"
    assert main(arguments) == 0
    assert readme.read_text(encoding="utf-8") == once


def test_without_write_the_table_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = sample_results(dims=(2,))
    assert main([str(document(tmp_path, results))]) == 0
    assert capsys.readouterr().out == readme_table(results) + "\n"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"format": "something"}, "is no evaluation"),
        ({"version": 2}, "is version 2 and this table is made from version 1"),
        ({"rows": []}, "lacks rows"),
        ({"rows": None, "datasets": None}, "lacks datasets, rows"),
    ],
)
def test_another_document_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], reason: str
) -> None:
    path = document(tmp_path, sample_results(dims=(2,)) | change)
    assert main([str(path)]) == 1
    assert reason in capsys.readouterr().err


def test_a_file_that_is_no_json_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "r.json").write_text("{", encoding="utf-8")
    assert main([str(tmp_path / "r.json")]) == 1
    assert "cannot be read as JSON" in capsys.readouterr().err
    assert main([str(tmp_path / "absent.json")]) == 1


def test_all_that_the_results_lack_is_said() -> None:
    results = sample_results(dims=(2,), metrics=("euclidean",))
    results["rows"] = [row for row in results["rows"] if row["strategy"] != "raw"]
    with pytest.raises(DatasetError, match=r"no raw row .*; no spherical rows"):
        readme_table(results)
    with pytest.raises(DatasetError, match="about cfp_ff"):
        readme_table(sample_results(datasets=("cfp_ff",), dims=(2,)))


@pytest.mark.parametrize("text", ["none", f"{BEGIN} only", f"{END}{BEGIN}", f"{BEGIN}{END}{END}"])
def test_a_readme_without_its_markers_is_left_alone(text: str) -> None:
    with pytest.raises(DatasetError, match="each once"):
        written_into(text, "table")


def test_the_kept_copy_has_everything_but_single_runs(tmp_path: Path) -> None:
    results = sample_results(dims=(2,))
    target = tmp_path / "kept.json"
    assert main([str(document(tmp_path, results)), "--keep", str(target)]) == 0
    kept = json.loads(target.read_text(encoding="utf-8"))
    assert kept == {k: v for k, v in results.items() if k not in ("runs", "curves")}
    assert readme_table(kept) == readme_table(results)


def parts_of(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The same evaluation as two: raw and random lifting, raw and all others."""
    parts = []
    for belongs in (lambda s: s == "random", lambda s: s != "random"):
        part = copy.deepcopy(results)
        part["rows"] = [
            row for row in part["rows"] if row["strategy"] == "raw" or belongs(row["strategy"])
        ]
        parts.append(part)
    return parts


def test_rows_of_several_evaluations_make_one_table() -> None:
    results = sample_results(dims=(2, 16), datasets=("lfw", "cfp_fp"))
    one, two = parts_of(results)
    two["datasets"] = two["datasets"][:1]
    two["rows"] = [row for row in two["rows"] if row["dataset"] == "lfw"]
    both = merged([one, two])
    assert [dataset["name"] for dataset in both["datasets"]] == ["lfw", "cfp_fp"]
    keys = [json.dumps(row, sort_keys=True) for row in both["rows"]]
    assert len(set(keys)) == len(keys) == len(one["rows"]) + len(two["rows"]) - 2
    assert readme_table(both) == readme_table(results)
    assert merged([results]) == results
    # Kept copies have no single runs.
    del one["runs"], two["runs"]
    assert "mean of 3 seeds" in readme_table(merged([one, two]))


def shared_row(results: dict[str, Any]) -> dict[str, Any]:
    return next(row for row in results["rows"] if row["strategy"] == "raw")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda r: r["model"].update(embedder_sha256="0"), "results 2 are of another model"),
        (lambda r: r.update(seed=7), "results 2 have other seeds"),
        (lambda r: r.update(repeats=5), "results 2 have other seeds"),
        (
            lambda r: r["datasets"][0].update(pictures_sha256="0"),
            "results 2 have other photos or pairs of lfw",
        ),
        (
            lambda r: r["datasets"][0].update(protocol_files=[]),
            "results 2 have other photos or pairs of lfw",
        ),
        (lambda r: r["datasets"][0].update(name="mine"), "results 2 give LFW another name"),
        (
            lambda r: shared_row(r).update(eer=0.5),
            "results 2 have other numbers of lfw: raw, m = 0, p2p, euclidean",
        ),
    ],
)
def test_evaluations_of_another_set_up_are_not_put_together(change: Any, reason: str) -> None:
    one, two = parts_of(sample_results(dims=(2,)))
    change(two)
    with pytest.raises(DatasetError, match=reason):
        merged([one, two])


def test_several_files_are_read_and_each_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = sample_results(dims=(2,))
    files, copies = [], []
    for number, part in enumerate(parts_of(results)):
        files.append(tmp_path / f"{number}.json")
        copies.append(tmp_path / f"kept {number}.json")
        files[-1].write_text(json.dumps(part), encoding="utf-8")
    names = [str(file) for file in files]
    assert main([*names, "--keep", *map(str, copies)]) == 0
    assert capsys.readouterr().out == readme_table(results) + "\n"
    for part, kept in zip(parts_of(results), copies, strict=True):
        expected = {k: v for k, v in part.items() if k not in ("runs", "curves")}
        assert json.loads(kept.read_text(encoding="utf-8")) == expected
    with pytest.raises(SystemExit):
        main([*names, "--keep", str(tmp_path / "one.json")])
    assert not (tmp_path / "one.json").exists()


def test_a_single_seed_has_no_spread() -> None:
    results = sample_results(dims=(2,))
    for row in results["rows"]:
        row["accuracy_std_seeds"] = None
    results["runs"] = [run for run in results["runs"] if run["seed"] == 0]
    block = readme_table(results)
    assert "one seed" in block
    assert "±" not in block.split("Raw embeddings")[1].split("\n", 1)[1]
