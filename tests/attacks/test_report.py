import json
from typing import Any

from attacks.outcomes import AttackOutcome, Estimate, KnowledgeLevel, Leaked, Property, Scheme
from attacks.report import document
from attacks.report_tables import markdown
from verify.metrics import rate

SCHEME = Scheme("adversarial", "generator", 16)
OTHER = Scheme("adversarial", "pool", 16)


def outcomes(scheme: Scheme, hits: int) -> list[AttackOutcome]:
    return [
        AttackOutcome(
            attack="foot-point",
            breaks=Property.IRREVERSIBILITY,
            leaked=Leaked.HOLDER_KEYS,
            knowledge=KnowledgeLevel.TEMPLATE,
            assumption="One template; guesses its foot point.",
            scheme=scheme,
            level="fmr-1e-3",
            measured=rate(hits, 200),
            chance=0.001,
            details={"cosine_to_truth_mean": 0.2875},
        ),
        AttackOutcome(
            attack="linkage",
            variant="secret rotations, nearest points",
            breaks=Property.UNLINKABILITY,
            leaked=Leaked.MASTER_KEY,
            knowledge=KnowledgeLevel.ALGORITHM,
            assumption="Two rotated templates | of two tenants.",
            scheme=scheme,
            measured=Estimate(0.09, 0.06, 0.12, 400, "bootstrap"),
            chance=0.085,
        ),
    ]


def row(attacker: str, accuracy: float) -> dict[str, Any]:
    return {
        **SCHEME.to_json(),
        "attribute": "gender",
        "attacker": attacker,
        "metric": "spherical" if attacker == "knn" else None,
        "knowledge": "algorithm",
        "accuracy": accuracy,
        "correct": round(1000 * accuracy),
        "trials": 1000,
        "ci_low": accuracy - 0.03,
        "ci_high": accuracy + 0.03,
        "balanced_accuracy": accuracy,
        "chance": 0.529,
        "baselines": {"uniform": 0.5, "majority": 0.529, "prior": 0.502},
        "chance_of_predictions": 0.501,
    }


def made(**more: Any) -> dict[str, Any]:
    return document(
        "templates",
        outcomes=[*outcomes(SCHEME, 10), *outcomes(OTHER, 150)],
        limits={"foot-point-success": 0.1},
        comparisons=[str(OTHER)],
        model={"pack": "a | pack"},
        settings={"seed": 0},
        **more,
    )


def test_a_comparison_does_not_decide_and_is_said_apart() -> None:
    report = made()
    assert report["passed"] is True
    assert [each["passed"] for each in report["verdicts"]] == [True, False]
    assert [each["comparison"] for each in report["verdicts"]] == [False, True]
    assert not any("pool" in line for line in report["headlines"])
    assert "irreversibility fails: foot-point" in report["comparison_headlines"][0]
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_the_markdown_begins_with_the_result_and_shows_every_attack() -> None:
    text = markdown(made(rows=[row("knn", 0.56), row("logistic", 0.61)]))
    lines = text.splitlines()
    assert lines[0] == "# Privacy audit: templates"
    assert lines[2].startswith("**PASSED**")
    assert "5.00 [2.74, 8.96] (10/200)" in text
    assert "0.090 [0.060, 0.120]" in text
    assert "61.00 [58.00, 64.00] (610/1000)" in text
    assert "Two rotated templates &#124; of two tenants." in text
    assert ", for comparison" in text
    assert "Baselines in %: uniform 50.00, majority 52.90, prior 50.20." in text
    width: int | None = None
    for line in lines:
        width = (width or line.count("|")) if line.startswith("|") else None
        assert line.count("|") == (width or line.count("|")), line
