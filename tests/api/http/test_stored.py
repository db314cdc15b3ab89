"""What is stored of a subject, and what an audit found: true numbers, and no byte of a template."""

import json
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.http.app import create_app
from api.http.audit_report import open_audit_report
from api.http.errors import StartError
from api.http.schemas import AuditAnswer, StoredAnswer
from api.process.runtime import open_keyring, open_store
from models.pack import ModelPack
from templates.contract import wire
from templates.errors import StoreUnavailable
from tests.api.client import Client
from tests.api.deployment import AXES, Deployment, M, bearer, deploy, images, photo
from tests.api.shapes import assert_answer, assert_error


def test_the_numbers_are_those_of_the_database(client: Client, deployment: Deployment) -> None:
    assert client.put("/v1/subjects/a/enrollment", files=images(photo(1), photo(1, 1))).is_success
    body = assert_answer(client.get("/v1/subjects/a/stored"), 200, StoredAnswer)
    with sqlite3.connect(deployment.settings.data_dir / "veilface.db") as database:
        (sealed,) = database.execute("SELECT ciphertext FROM templates").fetchone()
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        found = store.subjects.get("default", "a")
    finally:
        store.close()
    assert found is not None
    assert (body["n"], body["m"], body["decoys"]) == (AXES, M, M)
    assert (body["wire_bytes"], body["sealed_bytes"]) == (len(found.wire), len(sealed))
    assert body["dtype"] == "float16"
    assert body["current"] is True
    assert body["enrolled_by"] == "photos"
    assert body["photos"] == 2
    assert body["last_used_at"] is None
    excerpt = bytes.fromhex(body["sealed_excerpt"])
    assert len(excerpt) == 64
    assert excerpt in sealed
    # The length of the foot point is its cosine to the hidden descriptor, whatever the rotation.
    subspace = wire.decode(found.wire).subspace
    assert body["foot_point_similarity"] == round(float(np.linalg.norm(subspace.foot)), 3)
    assert deployment.settings.pack is not None
    pack = ModelPack.load(deployment.settings.pack, threads=1)
    mean = sum(pack.embed_photo(photo(1, shot)).embedding for shot in (0, 1))
    turned = _turned(deployment, found.template_id, mean / np.linalg.norm(mean))
    cosine = float(subspace.foot @ turned) / float(np.linalg.norm(subspace.foot))
    assert body["foot_point_similarity"] == pytest.approx(cosine, abs=2e-3)


def _turned(deployment: Deployment, template_id: str, descriptor: Any) -> Any:
    from templates.keys.rotation import TenantRotation

    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        key = store.tenants.rotation_key("default").key
    finally:
        store.close()
    points = deployment.source.project(descriptor[None])
    return TenantRotation(key, AXES).of(template_id).turned(points)[0]


def test_no_byte_of_the_template_is_told(client: Client, deployment: Deployment) -> None:
    assert client.put("/v1/subjects/secret/enrollment", files=images(photo(3))).is_success
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        found = store.subjects.get("default", "secret")
    finally:
        store.close()
    assert found is not None
    body = client.get("/v1/subjects/secret/stored").json()
    excerpt = bytes.fromhex(body["sealed_excerpt"])
    pieces = {found.wire[start : start + 4] for start in range(len(found.wire) - 3)}
    told = [excerpt[start : start + 4] for start in range(len(excerpt) - 3)]
    # 61 pieces of four random bytes among a thousand: that one meets by chance is 1 in 60,000.
    assert not pieces & set(told)
    # Besides the excerpt there are texts, counts and one rounded number.
    numbers = [value for value in body.values() if isinstance(value, float)]
    assert numbers == [body["foot_point_similarity"]]
    assert not any(isinstance(value, list | dict) for value in body.values())


def test_use_and_replacement_are_seen(client: Client) -> None:
    client.put("/v1/subjects/used/enrollment", files=images(photo(4)))
    before = client.get("/v1/subjects/used/stored").json()
    accepted = client.post("/v1/subjects/used/verify", files=images(photo(4, 1), name="image"))
    assert accepted.json()["decision"] == "accept"
    assert client.get("/v1/subjects/used/stored").json()["last_used_at"] is not None
    client.put("/v1/subjects/used/enrollment", files=images(photo(4)))
    after = client.get("/v1/subjects/used/stored").json()
    assert after["template_id"] != before["template_id"]
    assert after["sealed_excerpt"] != before["sealed_excerpt"]


def test_who_may_ask(client: Client, deployment: Deployment) -> None:
    client.put("/v1/subjects/mine/enrollment", files=images(photo(5)))
    path = "/v1/subjects/mine/stored"
    blind = client.get(path, headers=bearer(deployment.key("verify", "erase", "admin")))
    assert_error(blind, 403, "forbidden")
    other = client.get(path, headers=bearer(deployment.key("enroll", tenant="other")))
    assert_error(other, 404, "not_enrolled")
    assert_error(client.get("/v1/subjects/nobody/stored"), 404, "not_enrolled")
    assert_error(client.get("/v1/subjects/a%20b/stored"), 422, "validation_failed")


def test_whoever_looks_is_written_down(client: Client, deployment: Deployment) -> None:
    store = client.app.state.runtime.store
    verifier = bearer(deployment.key("verify"))
    client.put("/v1/subjects/seen/enrollment", files=images(photo(6)))
    before = list(store.audit_log.lines())[-1].sequence
    path = "/v1/subjects/seen/stored"
    answers = [
        client.get(path),
        client.get(path, headers=verifier),
        client.get("/v1/subjects/unseen/stored"),
    ]
    lines = list(store.audit_log.lines(after=before))
    assert [(line.action, line.outcome, line.tenant) for line in lines] == [
        ("inspect", "inspected", "default"),
        ("inspect", "forbidden", "default"),
        ("inspect", "not_enrolled", "default"),
    ]
    assert lines[0].actor == f"key:{deployment.token[3:15]}"
    # A right that is missing is refused before the subject is looked at.
    assert [line.pseudonym for line in lines] == [
        store.signer.pseudonym("default", "seen"),
        None,
        store.signer.pseudonym("default", "unseen"),
    ]
    assert [line.request_id for line in lines] == [
        answer.headers["x-request-id"] for answer in answers
    ]
    assert store.audit_log.verify().intact


def test_what_cannot_be_written_down_is_not_shown(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    client.put("/v1/subjects/seen/enrollment", files=images(photo(6)))

    def full(*_: object) -> None:
        raise StoreUnavailable("the SQLite database does not answer: database or disk is full")

    monkeypatch.setattr(client.app.state.runtime.store.audit_log, "record", full)
    answer = client.get("/v1/subjects/seen/stored")
    assert_error(answer, 503, "store_unavailable")
    assert "foot_point_similarity" not in answer.text


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
