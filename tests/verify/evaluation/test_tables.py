"""The CSV read back by the csv module, the report by its own cells."""

import csv
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.verify.evaluation.sample_results import sample_results
from verify.evaluation import markdown_cells as cells
from verify.evaluation.groups import by_group
from verify.evaluation.tables import markdown, write_csv


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, strict=True))


def section(report: str, title: str) -> list[list[str]]:
    """Cells of the table below a heading, without its rule."""
    text = report.split(f"### {title}\n")[1].split("\n#")[0]
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:1] + lines[2:]]


def column(rows: list[list[str]], title: str) -> list[str]:
    return [row[rows[0].index(title)] for row in rows[1:]]


def test_the_csv_has_each_row_with_its_numbers_in_full(tmp_path: Path) -> None:
    results = sample_results(shared=(False, True))
    write_csv(results["rows"], tmp_path / "r.csv")
    lines = read(tmp_path / "r.csv")
    assert len(lines) == len(results["rows"])
    for line, row in zip(lines, results["rows"], strict=True):
        assert float(line["accuracy_mean"]) == row["accuracy_mean"]
        rate = row["fnmr_at_fmr"]["0.001"]
        assert float(line["fnmr_at_fmr_0.001"]) == rate["value"]
        assert float(line["fnmr_at_fmr_0.001_ci_low"]) == rate["ci_low"]
        assert line["fnmr_at_fmr_0.001_interval"] == "subject-bootstrap"
        assert [float(line[f"thresholds_{i}"]) for i in range(1, 11)] == row["thresholds"]
        assert line["decoys"] == (row["decoys"] or "")
        assert (
            line["shared_decoys"] == {None: "", True: "true", False: "false"}[row["shared_decoys"]]
        )


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\tx", "\rx"])
def test_the_csv_holds_no_formula(tmp_path: Path, text: str) -> None:
    results = sample_results(dims=(2,))
    for row in results["rows"]:
        row |= {"dataset": text, "d_prime": -0.25, "thresholds": [-0.5, -1e-9]}
    write_csv(results["rows"], tmp_path / "r.csv")
    for line in read(tmp_path / "r.csv"):
        assert line["dataset"] == f"'{text}"
        assert (line["d_prime"], line["thresholds_1"], line["thresholds_2"]) == (
            "-0.25",
            "-0.5",
            "-1e-09",
        )


def test_the_csv_quotes_what_would_break_it(tmp_path: Path) -> None:
    results = sample_results(dims=(2,))
    for row in results["rows"]:
        row["dataset"] = 'my "set", of\nfaces'
    write_csv(results["rows"], tmp_path / "r.csv")
    assert {line["dataset"] for line in read(tmp_path / "r.csv")} == {'my "set", of\nfaces'}
    assert (tmp_path / "r.csv").read_bytes().split(b"\r\n")[0].startswith(b"dataset,strategy,")


def test_the_report_has_a_table_for_each_kind_of_comparison() -> None:
    results = sample_results(dims=(2, 16))
    report = markdown(results)
    counts = {
        "Raw embeddings": lambda r: r["strategy"].startswith("raw"),
        "Point to subspace (p-to-s)": lambda r: r["mode"] == "p2s",
        "Subspace to subspace (s-to-s)": lambda r: r["mode"] == "s2s",
    }
    for title, belongs in counts.items():
        table = section(report, title)
        chosen = [row for row in results["rows"] if belongs(row)]
        assert len(table) - 1 == len(chosen)
        assert len({len(row) for row in table}) == 1
        shown = sorted(column(table, "accuracy %"))
        assert sorted(text.split()[0] for text in shown) == sorted(
            f"{100 * row['accuracy_mean']:.2f}" for row in chosen
        )


def find(results: dict[str, Any], **keys: Any) -> dict[str, Any]:
    (found,) = (r for r in results["rows"] if all(r[k] == v for k, v in keys.items()))
    return found


def test_a_line_of_the_report_says_what_its_row_says() -> None:
    results = sample_results(dims=(16,), shared=(True,), liftings=(("adversarial", "pool"),))
    row = find(results, mode="s2s", metric="spherical")
    row |= {"accuracy_mean": 0.93854, "accuracy_std": 0.0121, "accuracy_std_seeds": 0.0031}
    row |= {"eer": 0.0612, "auc": 0.981234, "d_prime": 3.456, "template_bytes": 17700}
    row |= {"collision_floor": 0.0512, "collisions_mean": 153.4}
    row["fnmr_at_fmr"] = {
        "0.01": {"value": 0.0653, "ci_low": 0.0571, "ci_high": 0.0747, "interval": "pair-bootstrap"}
        | {"trials": 3000, "errors_mean": 195.9},
    }
    table = section(markdown(results), "Subspace to subspace (s-to-s)")
    line = dict(zip(table[0], next(r for r in table if "spherical" in r), strict=True))
    assert line == {
        "strategy": "adversarial (pool, shared)",
        "m": "16",
        "metric": "spherical",
        "accuracy %": "93.85 ± 1.21 (± 0.31)",
        "EER %": "6.12",
        "FNMR % at FMR 1e-2": "6.53 [5.71, 7.47] (195.9/3000)",
        "FNMR % at FMR 1e-3": "-",
        "AUC": "0.98123",
        "d'": "3.46",
        "collision floor %": "5.12",
        "collisions seen": "153.4 of 3,000",
        "template bytes": "17,700",
    }


def test_what_was_not_measured_is_a_dash() -> None:
    results = sample_results(dims=(2,), liftings=(("random", None),))
    row = find(results, mode="p2s", metric="spherical")
    row |= {"accuracy_mean": None, "eer": None, "auc": None, "d_prime": None}
    row |= {"fnmr_at_fmr": {}}
    table = section(markdown(results), "Point to subspace (p-to-s)")
    line = next(row for row in table if "spherical" in row)
    assert line == ["random", "2", "spherical", *["-"] * 6, "3,072"]


def test_decoys_that_were_left_out_are_stated_for_each_set() -> None:
    results = sample_results(datasets=("lfw", "cfp_fp"), dims=(2,))
    results["datasets"][1]["decoys"] = [
        {"kind": "pool", "source_id": "f" * 64, "entries": 4000, "left_out": 1000},
        {"kind": "generator", "source_id": "0" * 64, "entries": None, "left_out": 0},
    ]
    head, lfw, cfp = re.split(r"(?m)^## (?:lfw|cfp_fp)$", markdown(results))
    assert "left out" not in head
    said = "left out because they resemble people of this set"
    assert f"Decoys: pool, 4,997 entries used, 3 {said}; source `made up`." in lfw
    assert f"Decoys: pool, 4,000 entries used, 1,000 {said}; source `ffffffffffff`." in cfp
    assert "Decoys: generator; source `000000000000`." in cfp


@pytest.mark.parametrize(
    ("interval", "words"),
    [("subject-bootstrap", "bootstrap by subject"), ("pair-bootstrap", "bootstrap of pairs")],
)
def test_the_kind_of_interval_is_named(interval: str, words: str) -> None:
    results = sample_results(dims=(2,))
    for row in results["rows"]:
        for rate in row["fnmr_at_fmr"].values():
            rate["interval"] = interval
    report, reading = markdown(results).split("## How to read this")
    assert report.count(f"intervals: {words}.") == 3
    assert words in reading


def test_the_spread_over_seeds_is_shown_where_there_are_two() -> None:
    assert cells.accuracy({"accuracy_mean": 0.99, "accuracy_std_seeds": None}) == "99.00"
    assert cells.accuracy({"accuracy_mean": 0.99, "accuracy_std_seeds": 0.0}) == "99.00 (± 0.00)"


def test_a_separation_may_be_negative() -> None:
    results = sample_results(dims=(2,), liftings=(("random", None),))
    find(results, mode="p2s", metric="spherical")["d_prime"] = -0.128
    table = section(markdown(results), "Point to subspace (p-to-s)")
    assert "-0.13" in column(table, "d'")


def test_failures_to_acquire_are_listed_up_to_twenty() -> None:
    report = markdown(sample_results(dims=(2,), failures=23))
    assert report.count("- `Nobody_") == 20
    assert "- and 3 more" in report
    assert "Failures to acquire: 23 photos (FTA 0.30 %); 23 genuine and 0 impostor" in report
    assert "Failures to acquire: none." in markdown(sample_results(dims=(2,), failures=0))


def test_foreign_text_cannot_break_the_report() -> None:
    results = sample_results(dims=(2,), failures=1)
    results["datasets"][0]["failures"][0] |= {"image": "a`|\n# b<script>", "reason": "x |\r\ny"}
    report = markdown(results)
    assert "- `a'| # b<script>`: no_face, x &#124; y" in report
    assert "\n# b" not in report


def test_the_report_says_where_its_numbers_come_from() -> None:
    results = sample_results(dims=(2,))
    report = markdown(results)
    assert "Model pack: made_up, n = 512, SHA-256 `abababababab`" in report
    assert "- Decoys: pool, `pool.veil`, 5,000 entries, labelled, SHA-256 `cdcd" in report
    assert "- Seeds: 0, 1, 2\n" in report
    assert "veilface 0.0.0, python 3.11.9, numpy 2.2.0" in report
    assert "6,000 pairs (3,000 genuine, 3,000 impostor)" in report
    assert "- FMR 1e-4 on lfw: 3,000 impostor pairs resolve 1e-3." in report
    assert report == markdown(results)
    assert not re.search(r"\b20\d\d-\d\d", report)


def test_the_worst_group_is_named_with_its_counts() -> None:
    """From the counting code itself, on trials whose rates are known."""
    same = np.repeat([True, False], 1000)
    labels = np.tile(["Female", "Male"], 1000).tolist()
    # Female: 30 of 500 genuine rejected, 5 of 500 impostor accepted; Male: 10 and 20.
    wrong = np.zeros(2000, dtype=bool)
    for start, count in ((0, 30), (1, 10), (1000, 5), (1001, 20)):
        wrong[start : start + 2 * count : 2] = True
    similarities = np.where(same ^ wrong, 0.9, 0.1)
    groups, summary = by_group(
        [similarities], same, labels, labels, attribute="gender", thresholds=[0.5], target_fmr=0.01
    )
    results = sample_results(dims=(2,))
    row = find(results, strategy="hybrid", mode="s2s", metric="spherical")
    names = ("dataset", "strategy", "decoys", "shared_decoys", "dim", "mode", "metric")
    head = {name: row[name] for name in names} | {"seed": 0}
    results["groups"] = [head | entry for entry in groups]
    results["group_summaries"] = [head | summary]
    table = section(markdown(results), "By group")
    assert len(table) == 2
    line = dict(zip(table[0], table[1], strict=True))
    assert line["strategy"] == "hybrid (pool)"
    assert line["matching"] == "s-to-s"
    assert re.fullmatch(
        r"Male: 4\.00 \[2\.\d\d, 6\.\d\d\] \(20/500\)( apart)?", line["worst FMR %"]
    )
    assert re.fullmatch(
        r"Female: 6\.00 \[4\.\d\d, 8\.\d\d\] \(30/500\)( apart)?", line["worst FNMR %"]
    )
    assert column(table, "Female: FMR / FNMR %") == ["1.00 / 6.00"]
    assert column(table, "Male: FMR / FNMR %") == ["4.00 / 2.00"]
    ratios = [cell for title, cell in zip(table[0], table[1], strict=True) if title == "× mean"]
    assert ratios == [f"{4 / np.sqrt(1 * 4):.2f}", f"{6 / np.sqrt(6 * 2):.2f}"]
    assert (" apart" in line["worst FMR %"]) == summary["worst_fmr"]["apart"]


def test_a_group_that_is_not_judged_is_marked() -> None:
    results = sample_results(dims=(2,), groups=True, modes=("p2s",))
    for group in results["groups"]:
        if group["group"] == "Male":
            group["fnmr"] = {"value": None, "errors": 0, "trials": 0, "judged": False}
            group["fmr"] |= {"value": 0.025, "judged": False}
    for summary in results["group_summaries"]:
        summary["worst_fnmr"] = summary["fnmr_ratio"] = None
    table = section(markdown(results), "By group")
    assert set(column(table, "Male: FMR / FNMR %")) == {"2.50* / -"}
    assert set(column(table, "worst FNMR %")) == {"-"}
    assert "*" not in "".join(column(table, "Female: FMR / FNMR %"))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.99473, "99.47"),
        (0.0, "0.00"),
        (0.00026, "0.026"),
        (0.001, "0.10"),
        (1.0, "100.00"),
        (1e-6, "0.0001"),
        (9.9e-7, "<0.0001"),
        (5e-324, "<0.0001"),
        (float("nan"), "-"),
        (None, "-"),
    ],
)
def test_per_cent_keeps_the_digits_of_small_rates(value: float | None, text: str) -> None:
    assert cells.percent(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0512, "0.0512"),
        (17.04, "17.0"),
        (1234.5, "1,230"),
        (0, "0"),
        (None, "-"),
        (9.999, "10.0"),
    ],
)
def test_three_significant_digits(value: float | None, text: str) -> None:
    assert cells.significant(value) == text


@pytest.mark.parametrize(
    ("target", "text"), [("0.01", "1e-2"), ("0.0005", "5e-4"), ("1e-06", "1e-6"), (0.1, "1e-1")]
)
def test_targets_are_spelled_as_they_are_quoted(target: str | float, text: str) -> None:
    assert cells.power(target) == text
