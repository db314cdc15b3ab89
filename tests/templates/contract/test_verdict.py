"""The verdict of a contract: what passes, what a file may claim, and what its seal covers."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from templates.contract.document import Contract, Rate
from templates.contract.verdict import Judgement, Verdict, upper_bound
from templates.errors import ContractError, SealError
from tests.templates.contract.test_contract import SEALER, make_contract


def rate(errors: int, trials: int = 400) -> Rate:
    return Rate(errors, trials, 0.0, 1.0)


@pytest.fixture
def verdict() -> Verdict:
    return Verdict(
        privacy=Judgement(rate(20), 0.05, {"attack": "decoy-likelihood", "attacker_faces": 5000}),
        accuracy=Judgement(rate(9), 0.02, {"level": "fmr-1e-4", "probe_photos": 3}),
    )


def test_a_rate_at_its_limit_passes_and_one_above_fails(verdict: Verdict) -> None:
    assert verdict.privacy.status == "PASS"
    assert replace(verdict.privacy, rate=rate(21)).status == "FAIL"
    assert verdict.accuracy.status == "FAIL"


@pytest.mark.parametrize(
    ("errors", "trials", "bound"),
    # Clopper and Pearson's: scipy.stats.beta.ppf(0.95, errors + 1, trials - errors).
    [(0, 100, 0.029513), (5, 100, 0.102253), (15, 300, 0.075949), (400, 5000, 0.086594), (3, 3, 1)],
)
def test_the_upper_bound_is_exact(errors: int, trials: int, bound: float) -> None:
    assert upper_bound(errors, trials) == pytest.approx(bound, abs=1e-6)


def test_a_rate_within_its_limit_is_not_shown_where_its_bound_is_not() -> None:
    bounded = Judgement(rate(5, 100), 0.05, bound=0.1)
    assert (bounded.status, bounded.close) == ("NOT SHOWN", True)
    assert replace(bounded, rate=rate(15, 300)).status == "PASS"
    assert replace(bounded, rate=rate(0, 300), shortfall="few faces").status == "NOT SHOWN"
    assert Judgement.from_json(bounded.to_json()) == bounded
    for broken in ({"upper": 0.05}, {"upper": None}, {"bound": None}, {"bound": 0.04}):
        with pytest.raises(ContractError):
            Judgement.from_json({**bounded.to_json(), **broken})
    with pytest.raises(ContractError, match="at most 10,000"):
        replace(bounded, rate=rate(0, 10_001))


def test_a_verdict_without_accuracy_is_kept(verdict: Verdict) -> None:
    alone = Verdict(privacy=verdict.privacy)
    assert Verdict.from_json(alone.to_json()) == alone
    assert alone.to_json().keys() == {"privacy"}


def test_a_contract_keeps_its_verdict(tmp_path: Path, verdict: Verdict) -> None:
    contract = replace(make_contract(), verdict=verdict)
    contract.save(tmp_path / "contract.json", SEALER)
    assert Contract.load(tmp_path / "contract.json", SEALER).verdict == verdict
    # A verdict on no groups is written as it was before there were any.
    assert verdict.to_json().keys() == {"privacy", "accuracy"}
    assert contract.public()["verdict"] == verdict.to_json()
    assert contract.contract_id == make_contract().contract_id
    make_contract().save(tmp_path / "unmeasured.json", SEALER)
    assert Contract.load(tmp_path / "unmeasured.json", SEALER).verdict is None


def test_an_edited_verdict_is_refused(tmp_path: Path, verdict: Verdict) -> None:
    path = tmp_path / "contract.json"
    replace(make_contract(), verdict=verdict).save(path, SEALER)
    document = json.loads(path.read_text())
    document["verdict"]["accuracy"] = replace(verdict.accuracy, rate=rate(1)).to_json()
    path.write_text(json.dumps(document))
    with pytest.raises(SealError):
        Contract.load(path, SEALER)


def test_a_verdict_on_groups_is_kept_and_may_not_contradict_itself(verdict: Verdict) -> None:
    worst = Judgement(rate(9), 0.02, {"attribute": "gender", "group": "Female"})
    judged = replace(verdict, groups=worst)
    document = judged.to_json()
    assert Verdict.from_json(document) == judged
    assert document["groups"]["status"] == "FAIL"
    for broken in (None, {}, {**worst.to_json(), "status": "PASS"}):
        with pytest.raises(ContractError):
            Verdict.from_json({**document, "groups": broken})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("status", "PASS"),
        ("value", 0.0),
        ("limit", 0.0),
        ("limit", 1.0),
        ("rate", {}),
        ("more", 1),
        ("shortfall", 1),
    ],
)
def test_a_verdict_that_contradicts_itself_is_refused(
    verdict: Verdict, key: str, value: object
) -> None:
    document = verdict.to_json()
    document["accuracy"] = {**verdict.accuracy.to_json(), key: value}
    with pytest.raises(ContractError):
        Verdict.from_json(document)


def test_a_verdict_without_trials_is_refused() -> None:
    with pytest.raises(ContractError, match="without a trial"):
        Judgement(Rate(0, 0, 0.0, 1.0), 0.05)
