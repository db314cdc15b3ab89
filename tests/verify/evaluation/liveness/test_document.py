"""The document of a liveness evaluation against counting, and what its report says of gaps."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.verify.evaluation.liveness.sets import scored_set
from verify.evaluation.liveness.document import document, markdown

GENERATOR = np.random.default_rng(8)
LIVE = GENERATOR.normal(1, 1, 40)
ATTACKS = {"mask": GENERATOR.normal(0.5, 1, 30), "print": GENERATOR.normal(-1, 1, 50)}


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    scored = scored_set(
        [(None, None, float(score)) for score in LIVE]
        + [(name, None, float(one)) for name, scores in ATTACKS.items() for one in scores]
        + [("cut|out", None, None)]
    )
    return document(
        scored,
        {"n": 4, "pack": "tiny"},
        SimpleNamespace(members=()),  # type: ignore[arg-type]
        {"contract": 0.25, "bpcer-0.05": -0.5},
        contract=None,
        verified=None,
        unverified="there are no decoys",
        refused=["40 live photos are few"],
    )


def test_the_worst_species_is_the_headline(results):
    for row in results["rows"]:
        passed = {n: np.mean(scores >= row["threshold"]) for n, scores in ATTACKS.items()}
        assert row["apcer"]["value"] == pytest.approx(passed[row["species"]])
        assert row["bpcer"]["value"] == pytest.approx(np.mean(row["threshold"] > LIVE))
        assert row["worst"] == (row["species"] == max(passed, key=lambda name: passed[name]))
    assert len(results["rows"]) == 4
    assert "(worst species: mask)" in markdown(results)


def test_the_report_says_what_is_missing(results):
    text = markdown(results)
    assert "IAPMR was not measured: there are no decoys." in text
    assert "40 live photos are few" in text
    assert results["dataset"]["apnrr"]["cut|out"]["errors"] == 1
    assert "cut|out" not in text
    assert "cut&#124;out" in text
