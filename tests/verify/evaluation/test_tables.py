"""The CSV read back by the csv module, the report by its own cells."""

import csv
import re
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.verify.evaluation.made_results import made_results, row_of
from verify.evaluation import markdown_cells as cells
from verify.evaluation.groups import by_group
from verify.evaluation.tables import markdown, write_csv


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, strict=True))


def table_of(report: str, *, place: int = 0) -> list[dict[str, str]]:
    """Lines of a table of the report, by title; of two columns of one title the last."""
    tables = re.findall(r"(?:^\|.*\n?)+", report, re.MULTILINE)
    titles, _, *lines = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in tables[place].splitlines()
    )
    return [dict(zip(titles, line, strict=True)) for line in lines]


def test_the_csv_has_each_row_with_its_numbers_in_full(tmp_path: Path) -> None:
    results = made_results()
    write_csv(results["rows"], tmp_path / "r.csv")
    lines = read(tmp_path / "r.csv")
    assert (tmp_path / "r.csv").read_bytes().split(b"\r\n")[0].startswith(b"dataset,strategy,")
    for line, row in zip(lines, results["rows"], strict=True):
        assert float(line["accuracy_mean"]) == row["accuracy_mean"]
        rate = row["fnmr_at_fmr"]["0.1"]
        assert float(line["fnmr_at_fmr_0.1"]) == rate["value"]
        assert float(line["fnmr_at_fmr_0.1_ci_low"]) == rate["ci_low"]
        assert line["fnmr_at_fmr_0.1_interval"] == "subject-bootstrap"
        assert line["decoys"] == (row["decoys"] or "")
        spelled = {None: "", True: "true", False: "false"}
        assert line["shared_decoys"] == spelled[row["shared_decoys"]]


@pytest.mark.parametrize(
    ("text", "written"),
    [(text, f"'{text}") for text in ("=1+1", "+1", "-1", "@SUM(A1)", "\tx", "\rx")]
    + [('my "set", of\nfaces', 'my "set", of\nfaces')],
)
def test_the_csv_holds_no_formula(tmp_path: Path, text: str, written: str) -> None:
    results = made_results()
    for row in results["rows"]:
        row |= {"dataset": text, "eer": -0.25, "auc": [-0.5, -1e-9]}
    write_csv(results["rows"], tmp_path / "r.csv")
    for line in read(tmp_path / "r.csv"):
        assert line["dataset"] == written
        numbers = (line["eer"], line["auc_1"], line["auc_2"])
        assert numbers == ("-0.25", "-0.5", "-1e-09")


def test_a_line_of_the_report_says_what_its_row_says() -> None:
    results = made_results()
    keys = {"strategy": "adversarial", "decoys": "pool", "dim": 3, "metric": "spherical"}
    row = row_of(results, mode="s2s", **keys)
    row |= {"accuracy_mean": 0.93854, "accuracy_std": 0.0121, "accuracy_std_seeds": 0.0031}
    row["eer"] = 0.0612
    row["fnmr_at_fmr"] = {
        "0.01": {"value": 0.0653, "ci_low": 0.0571, "ci_high": 0.0747, "interval": "pair-bootstrap"}
        | {"trials": 3000, "errors_mean": 195.9},
    }
    other = row_of(results, mode="p2s", **keys)
    other |= {"accuracy_mean": None, "eer": None, "fnmr_at_fmr": {}}
    report = markdown(results)
    lines = table_of(report)
    assert len(lines) == len(results["rows"])
    assert "raw (grid)" in {line["strategy"] for line in lines}
    assert "Intervals: bootstrap by subject." in report
    assert "Intervals: bootstrap of pairs." in report
    shown = {
        line["matching"]: line
        for line in lines
        if (line["strategy"], line["m"]) == ("adversarial (pool, shared)", "3")
        and line["metric"] == "spherical"
    }
    assert shown["s-to-s"] == {
        "strategy": "adversarial (pool, shared)",
        "m": "3",
        "matching": "s-to-s",
        "metric": "spherical",
        "accuracy %": "93.85 ± 1.21 (± 0.31)",
        "EER %": "6.12",
        "FNMR % at FMR 1e-1": "-",
        "FNMR % at FMR 1e-2": "6.53 [5.71, 7.47] (195.9/3000)",
    }
    assert list(shown["p-to-s"].values())[4:] == ["-"] * 4


def test_the_report_says_where_its_numbers_come_from() -> None:
    results = made_results()
    other = results["datasets"][0] | {"name": "cfp_fp", "failures": []}
    other["decoys"] = [
        {"kind": "pool", "source_id": "f" * 64, "entries": 4000, "left_out": 0},
        {"kind": "generator", "source_id": "0" * 64, "entries": None, "left_out": 0},
    ]
    results["datasets"].append(other)
    results["rows"] += [row | {"dataset": "cfp_fp"} for row in results["rows"]]
    report = markdown(results)
    assert report == markdown(results)
    assert not re.search(r"\b20\d\d-\d\d", report)
    head, lfw, cfp = re.split(r"(?m)^## (?:lfw|cfp_fp)$", report)
    assert "- Embeddings: made_up, n = 24\n" in head
    assert "- Decoys: `pool.veil`, pool of 120 entries, labelled\n" in head
    assert "- Seeds: 0, 1\n" in head
    assert f"- Software: veilface {version('veilface')}\n" in head
    assert (
        "60 photos, 30 people, aligned crops; 50 genuine and 50 impostor comparisons of 100" in lfw
    )
    assert "Decoys left out that resemble people of this set: 3." in lfw
    assert "Decoys left out" not in cfp
    assert "- lfw: FMR 0.0001 is not reported." in cfp


def test_failures_to_acquire_are_listed_up_to_twenty_and_cannot_break_the_report() -> None:
    results = made_results()
    assert "Failures to acquire: none." in markdown(results)
    named = [{"image": f"Nobody_{i}", "code": "no_face", "reason": "-"} for i in range(22)]
    foreign = {"image": "a`|\n# b<script>", "code": "no_face", "reason": "x |\r\ny"}
    results["datasets"][0] |= {"failures": [foreign, *named], "fta": 0.003, "failed_genuine": 23}
    report = markdown(results)
    assert report.count("- `Nobody_") == 19
    assert "- `a'| # b<script>`: no_face, x &#124; y" in report
    assert "\n# b" not in report
    assert "- and 3 more" in report
    assert "Failures to acquire: 23 photos (FTA 0.30 %); 23 genuine and 0 impostor" in report


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
    results = made_results()
    keys = {"strategy": "hybrid", "decoys": "generator", "dim": 2}
    row = row_of(results, mode="s2s", metric="spherical", **keys)
    names = ("dataset", "strategy", "decoys", "shared_decoys", "dim", "mode", "metric")
    head = {name: row[name] for name in names} | {"seed": 0}
    results["groups"] = [head | entry for entry in groups]
    results["group_summaries"] = [head | summary]
    assert "without a common label, which are in no group: 0." in markdown(results)
    (line,) = table_of(markdown(results), place=1)
    assert (line["strategy"], line["matching"]) == ("hybrid (generator)", "s-to-s")
    for title, start, counts in (
        ("worst FMR %", "Male: 4.00 [", "(20/500)"),
        ("worst FNMR %", "Female: 6.00 [", "(30/500)"),
    ):
        assert line[title].startswith(start)
        assert counts in line[title]
    assert line["Female: FMR / FNMR %"] == "1.00 / 6.00"
    assert line["Male: FMR / FNMR %"] == "4.00 / 2.00"
    assert line["× mean"] == f"{6 / np.sqrt(6 * 2):.2f}"
    assert (" apart" in line["worst FMR %"]) == summary["worst_fmr"]["apart"]
    # Rates of too few trials are marked, and what was not tried is a dash.
    results["groups"][1]["fmr"] |= {"value": 0.025, "judged": False}
    results["groups"][1]["fnmr"] = {"value": None, "errors": 0, "trials": 0, "judged": False}
    results["group_summaries"][0]["worst_fnmr"] = None
    (line,) = table_of(markdown(results), place=1)
    assert line["Male: FMR / FNMR %"] == "2.50* / -"
    assert line["worst FNMR %"] == "-"


@pytest.mark.parametrize(
    ("written", "value", "text"),
    [
        (cells.percent, 0.99473, "99.47"),
        (cells.percent, 0.0, "0.00"),
        (cells.percent, 0.00026, "0.026"),
        (cells.percent, 0.001, "0.10"),
        (cells.percent, 1e-6, "0.0001"),
        (cells.percent, 9.9e-7, "<0.0001"),
        (cells.percent, float("nan"), "-"),
        (cells.percent, None, "-"),
        (cells.significant, 0.0512, "0.0512"),
        (cells.significant, 17.04, "17.0"),
        (cells.significant, 1234.5, "1,230"),
        (cells.significant, 0, "0"),
        (cells.significant, None, "-"),
        (cells.significant, 9.999, "10.0"),
        (cells.power, "0.01", "1e-2"),
        (cells.power, "0.0005", "5e-4"),
        (cells.power, 0.1, "1e-1"),
    ],
)
def test_numbers_have_the_digits_that_the_data_carries(written: Any, value: Any, text: str) -> None:
    assert written(value) == text
