"""What an audit found of templates like those of the contract."""

import json
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.audit_report import open_audit_report
from api.http.errors import StartError
from api.http.schemas import AuditAnswer
from tests.api.client import Client
from tests.api.deployment import AXES, M, bearer, deploy
from tests.api.shapes import assert_answer


def cell(**changes: Any) -> dict[str, Any]:
    return {
        "property": "irreversibility", "leaked": "holder keys", "knowledge": "algorithm",
        "attack": "likelihood", "variant": "", "value": 0.2, "ci_low": 0.1, "ci_high": 0.3,
        "chance": 0.001, "compared": 0.2, "compared_low": 0.1, "compared_high": 0.3,
        "limit": "recovery-success", "most": 0.1, "status": "fail", "reason": None, **changes,
    }  # fmt: skip


LINKABILITY = cell(
    property="unlinkability", knowledge="algorithm", attack="foot-point-distance",
    value=0.25, ci_low=0.2, ci_high=0.3, chance=0.1,
    compared=0.15, compared_low=0.1, compared_high=0.2, limit="linkability",
)  # fmt: skip
GENDER = cell(
    property="confidentiality", knowledge="algorithm", attack="gender",
    value=0.63, ci_low=0.58, ci_high=0.68, chance=0.51,
    compared=0.12, compared_low=0.07, compared_high=0.17, limit="attribute-leakage",
)  # fmt: skip
SCHEME = f"adversarial, m = {M} of {AXES} axes, generated decoys"


def report(dim: int = M, *, axes: int = AXES, **changes: Any) -> dict[str, Any]:
    verdict = {
        "strategy": "adversarial", "decoys": "generator", "dim": dim, "axes": axes,
        "passed": False,
        "comparison": False,
        "cells": [
            cell(attack="foot-point", knowledge="template", value=0.05, compared=0.05),
            cell(),
            cell(knowledge="right", value=1.0, compared=1.0, limit="success-with-key"),
            cell(property="impersonation", value=0.9, compared=0.9),
            LINKABILITY,
            GENDER,
        ],
    }  # fmt: skip
    compared = {**verdict, "decoys": "pool", "comparison": True, "cells": [cell(value=0.99)]}
    return {
        "format": "veilface audit", "version": 3, "kind": "templates", "passed": False,
        "headlines": [f"{SCHEME.replace(f'm = {M} ', f'm = {dim} ')}: irreversibility fails."],
        "comparison_headlines": [],
        "limits": {"recovery-success": 0.1}, "verdicts": [compared, verdict],
        "model": {"embedder_sha256": "0" * 64}, "settings": {"contract_id": None},
        "rows": [], "outcomes": [], **changes,
    }  # fmt: skip


@pytest.fixture
def audited(tmp_path: Path) -> Any:
    """The audit's answer where the operator named this report."""
    deployment = deploy(tmp_path)

    def answer(document: dict[str, Any]) -> dict[str, Any]:
        file = tmp_path / "report.json"
        file.write_text(json.dumps(document))
        settings = deployment.settings.model_copy(update={"audit_report_file": file})
        with Client(create_app(settings), headers=bearer(deployment.key("verify"))) as client:
            return assert_answer(client.get("/v1/contract/audit"), 200, AuditAnswer)

    return deployment, answer


def test_a_report_for_this_contract(audited: Any) -> None:
    deployment, answer = audited
    contract = deployment.contract
    body = answer(report(settings={"contract_id": contract.contract_id}))
    assert body["audited"] is True
    assert body["fits"] == "contract"
    assert body["passed"] is False
    # Getting the face back from one template, without the key; not the comparison.
    assert body["strongest"]["value"] == 0.2
    assert body["strongest"]["attack"] == "likelihood"
    assert len(body["cells"]) == 6
    assert LINKABILITY in body["cells"]
    assert body["headlines"] == [f"{SCHEME}: irreversibility fails."]
    assert body["limits"] == [
        {
            "name": "recovery-success",
            "most": 0.1,
            "meaning": "share of templates from which any other attack recovers a match for a "
            "fresh photo",
        }
    ]


def test_a_report_that_judged_nothing_neither_passed_nor_failed(audited: Any) -> None:
    deployment, answer = audited
    document = report(settings={"contract_id": deployment.contract.contract_id}, passed=None)
    document["verdicts"][1] |= {"passed": None, "cells": []}
    body = answer(document)
    assert (body["audited"], body["fits"], body["passed"]) == (True, "contract", None)
    assert (body["cells"], body["strongest"]) == ([], None)


def test_a_report_of_the_same_scheme_or_of_another(audited: Any) -> None:
    deployment, answer = audited
    binding = deployment.contract.binding
    model = {"embedder_sha256": binding.embedder_sha256}
    assert answer(report(model=model))["fits"] == "scheme"
    for other in (report(), report(model=model, verdicts=[]), report(model=model, dim=M + 1)):
        body = answer(other)
        assert (body["audited"], body["fits"], body["passed"]) == (True, "nothing", None)
        # What was found of another scheme says nothing of this one.
        assert body["cells"] == body["headlines"] == body["limits"] == []
        assert body["strongest"] is None


def test_of_several_schemes_only_this_one_is_told(audited: Any) -> None:
    deployment, answer = audited
    (_, found) = report()["verdicts"]
    pooled = {**found, "decoys": "pool", "cells": [cell(value=0.99, compared=0.99)]}
    wider = {**pooled, "decoys": "generator", "dim": 2 * M}
    mine = {**found, "passed": True, "cells": [cell(value=0.01, compared=0.01, status="pass")]}
    lines = [
        f"adversarial, m = {M}, decoys of a pool: fails.",
        f"adversarial, m = {2 * M}, generated decoys: fails.",
        f"{SCHEME}: no attack that was made exceeds its limit.",
    ]
    settings = {"contract_id": deployment.contract.contract_id}
    model = {"embedder_sha256": deployment.contract.binding.embedder_sha256}
    several = report(
        settings=settings, model=model, headlines=lines, verdicts=[pooled, wider, mine]
    )
    body = answer(several)
    assert body["fits"] == "contract"
    assert body["passed"] is True
    assert body["headlines"] == lines[2:]
    assert [each["value"] for each in body["cells"]] == [0.01]
    assert body["strongest"]["value"] == 0.01
    # Decoys of a pool are another scheme.
    assert answer({**several, "verdicts": [pooled, wider]})["fits"] == "nothing"


def test_what_a_report_leaves_open_is_null(audited: Any) -> None:
    deployment, answer = audited
    document = report(settings={"contract_id": deployment.contract.contract_id})
    bare = {name: value for name, value in cell().items() if name not in ("ci_low", "variant")}
    document["verdicts"][1]["cells"] = [{**bare, "chance": None}]
    (told,) = answer(document)["cells"]
    assert (told["ci_low"], told["variant"], told["chance"]) == (None, None, None)


def test_nobody_audited(client: Client) -> None:
    body = assert_answer(client.get("/v1/contract/audit"), 200, AuditAnswer)
    assert body["audited"] is False
    assert body["strongest"] is None
    assert body["command"].startswith("veilface audit templates")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("{", "is not JSON"),
        ("[]", "is not a report"),
        ('{"format": "veilface evaluation", "version": 1}', "is not a report"),
        (json.dumps(report(verdicts=[{"cells": [{"value": 1}]}])), "is not a report"),
        (json.dumps(report(passed="yes")), "is not a report"),
        *(
            (json.dumps(report(verdicts=[{**report()["verdicts"][1], **part}])), "is not a report")
            for part in (
                {"passed": "no"},
                {"strategy": None},
                {"decoys": 1},
                {"cells": [cell(value=float("nan"))]},
                {"cells": [cell(compared=True)]},
                {"cells": [cell(most=10**400)]},
                {"cells": [cell(ci_low=float("nan"))]},
                {"cells": [cell(ci_high="0.3")]},
                {"cells": [cell(chance=float("inf"))]},
                {"cells": [cell(compared_low=[])]},
                {"cells": [cell(compared_high=float("-inf"))]},
                {"cells": [cell(variant=1)]},
                {"cells": [cell(limit={})]},
                {"cells": [cell(status=False)]},
            )
        ),
    ],
)
def test_the_service_does_not_start_with_what_is_no_report(
    tmp_path: Path, text: str | None, words: str
) -> None:
    file = tmp_path / "report.json"
    if text is not None:
        file.write_text(text)
    settings = deploy(tmp_path).settings.model_copy(update={"audit_report_file": file})
    with pytest.raises(StartError, match=words) as refused:
        open_audit_report(settings)
    assert "audit_report_file" in str(refused.value)
    with pytest.raises(StartError, match=words), Client(create_app(settings)):
        pass
