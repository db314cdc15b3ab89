"""Nothing private reaches a log line, on good paths and on bad ones."""

import base64
import io
import json
import logging
import re
import sys
from typing import Any

import numpy as np
import pytest

from api.service.logging import FIELDS, JsonLines, configure, log
from tests.api.calls import b64, lifted
from tests.api.client import Client
from tests.api.deployment import Deployment, N, bearer, images, photo, unit

SUBJECT = "subject-who-must-not-be-logged"
LINE_FIELDS = {"time", "level", "logger", "event"} | FIELDS


def everything(client: Client, deployment: Deployment, probe: list[float]) -> list[Any]:
    """Good and bad requests of every call."""
    base = f"/v1/subjects/{SUBJECT}"
    template = lifted(deployment)
    deployment.allow_templates()
    verifier = bearer(deployment.key("verify", "embeddings"))
    return [
        client.put(f"{base}/enrollment", files=images(photo(1), photo(1, 1))),
        client.put(f"{base}/enrollment", files=images(photo(1), photo(2))),
        client.put(f"{base}/enrollment", files=images(photo(1)[:500])),
        client.put(
            f"{base}/enrollment",
            files=images(photo(1)),
            data={"attributes": '{"race": "Indian", "gender": "Female"}'},
        ),
        client.put(
            f"{base}/enrollment", files=images(photo(1)), data={"attributes": '{"x": "Indian"}'}
        ),
        client.put(f"{base}/enrollment", json={"template": b64(template)}),
        client.put(f"{base}/enrollment", json={"template": b64(template[:-2])}),
        client.put(f"{base}/enrollment", json={"tmplt": b64(template)}),
        client.post(f"{base}/verify", files=images(photo(1), name="image")),
        client.post(f"{base}/verify", json={"embedding": probe}),
        client.post(f"{base}/verify", json={"embedding": [2 * x for x in probe]}),
        client.post(f"{base}/verify", json={"embedding": probe, "level": "Indian"}),
        client.post(f"{base}/verify", json={"embedding": [*probe, "x"]}),
        client.post(f"{base}-2/verify", json={"embedding": probe}, headers=verifier),
        client.post(f"{base}-2/verify", json={"embedding": probe}),
        client.post(f"{base}/verify", json={"template": b64(template)}),
        client.get(base),
        client.get(f"{base}%20x"),
        client.get(f"{base}/export"),
        client.get("/v1/subjects", params={"cursor": SUBJECT}),
        client.get(f"/{SUBJECT}"),
        client.get(base, headers={"Authorization": f"Bearer {deployment.token}0"}),
        client.get(base, headers={"X-Request-ID": f"{SUBJECT} {SUBJECT}"}),
        client.post("/v1/subjects/import", json={"export": b64(b"VEILEXP1" + template)}),
        client.delete(base),
    ]


def test_no_log_line_holds_anything_private(
    client: Client,
    deployment: Deployment,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    probe = unit(np.random.default_rng(11).normal(size=(1, N)))[0].tolist()
    runtime = client.app.state.runtime
    # The test's own HTTP client logs what it sends.
    caplog.set_level(logging.WARNING, "httpx")
    caplog.set_level(logging.WARNING, "httpcore")
    with caplog.at_level(logging.DEBUG):
        answers = everything(client, deployment, probe)

        def explode(*args: object, **options: object) -> None:
            raise RuntimeError(f"{SUBJECT} {deployment.token} {probe}")

        # A defect in any package, with the worst possible text.
        for where, name in (
            (runtime.store.subjects, "get"),
            (runtime.store.subjects, "describe"),
            (runtime.store.erasures, "erase"),
            (runtime.store.subjects, "put"),
            (runtime.store.subjects, "list"),
            (runtime.store.api_keys, "verify"),
        ):
            with monkeypatch.context() as patch:
                patch.setattr(where, name, explode)
                answers += everything(client, deployment, probe)
    written = capfd.readouterr()
    logged = written.err + written.out + caplog.text
    logged += "".join(str(record.__dict__) for record in caplog.records)
    assert '"event": "request"' in written.err
    assert any(answer.status_code == 500 for answer in answers)
    secrets = [
        SUBJECT,
        deployment.token,
        deployment.token.split("_")[2],
        "Indian",
        "Female",
        b64(lifted(deployment))[:40],
        b64(photo(1))[:40],
        base64.b64encode(photo(1)).decode()[100:140],
        repr(photo(1)[:16])[2:-1],
        *[str(x)[:9] for x in probe],
        *[answer.json().get("export", SUBJECT)[:40] for answer in answers],
    ]
    assert [secret for secret in secrets if secret in logged] == []
    # And none of it in an answer to a mistake either.
    for answer in answers:
        if answer.status_code >= 400:
            assert [s for s in secrets[:6] if s in answer.text] == []
            assert not re.search(r"\d\.\d{5,}", answer.text)


def test_every_line_is_json_of_declared_fields(
    client: Client, deployment: Deployment, capfd: pytest.CaptureFixture[str]
) -> None:
    client.get("/v1/subjects/abc")
    client.get("/nowhere")
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    assert [line["status"] for line in lines] == [404, 404]
    for line in lines:
        assert set(line) <= LINE_FIELDS
    assert lines[0]["route"] == "/v1/subjects/{subject_id}"
    assert "route" not in lines[1]
    pseudonym = client.app.state.runtime.store.signer.pseudonym("default", "abc")
    assert lines[0]["subject"] == pseudonym[:16]
    assert lines[0]["code"] == "not_enrolled"


def test_undeclared_fields_are_refused() -> None:
    with pytest.raises(ValueError, match="embedding"):
        log("x", embedding=[1.0])


def test_an_exception_is_logged_by_its_type_only() -> None:
    try:
        raise RuntimeError("secret text")
    except RuntimeError:
        record = logging.LogRecord(
            "uvicorn.error", logging.ERROR, "f", 1, "Exception in app", (), sys.exc_info()
        )
    line = JsonLines().format(record)
    assert "secret" not in line
    assert json.loads(line)["error_type"] == "RuntimeError"


def test_severity_is_a_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(sys, "stderr", out)
    logger = logging.getLogger("veilface")
    before = logger.level
    try:
        configure("warning")
        log("quiet")
        log("loud", severity=logging.ERROR)
    finally:
        logger.setLevel(before)
    assert [json.loads(line)["event"] for line in out.getvalue().splitlines()] == ["loud"]
