"""What is counted, by whom, and what no metric may say."""

import os
import re
import signal
import socket
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from api.http.app import VERSION, create_app
from api.http.errors import ERROR_CODES
from api.service.metrics import exposition
from templates.store.lockout import LockedOut
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.server_process import Server
from tests.api.shapes import assert_error
from tests.patience import wait_until
from tests.ports import free_port

Labels = dict[str, str]
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def samples(text: str) -> Samples:
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def value(found: Samples, name: str, **labels: str) -> float:
    return found.get((name, frozenset(labels.items())), 0.0)


class Rise:
    """How much each series rose since this was made."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._before = samples(client.get("/metrics").text)

    def __call__(self, name: str, **labels: str) -> float:
        now = samples(self._client.get("/metrics").text)
        return value(now, name, **labels) - value(self._before, name, **labels)


def test_a_request_is_counted_by_its_route_and_never_by_its_path(client: Client) -> None:
    rise = Rise(client)
    subject = "a-subject-in-no-metric"
    assert client.get(f"/v1/subjects/{subject}").status_code == 404
    for number in range(30):
        client.get(f"/unknown/{subject}/{number}")
    client.request("BREW", "/v1/contract")
    route = "/v1/subjects/{subject_id}"
    assert rise("veilface_requests_total", route=route, method="GET", status="404") == 1
    assert rise("veilface_requests_total", route="unmatched", method="GET", status="404") == 30
    assert rise("veilface_request_seconds_count", route=route) == 1
    assert rise("veilface_errors_total", code="not_enrolled") == 1
    assert rise("veilface_errors_total", code="not_found") == 30
    found = samples(client.get("/metrics").text)
    labels = [dict(each) for name, each in found if name == "veilface_requests_total"]
    assert {each["method"] for each in labels} <= {
        "GET", "POST", "PUT", "DELETE", "PATCH", "OPTIONS", "HEAD", "other",
    }  # fmt: skip
    assert any(each["method"] == "other" for each in labels)
    paths = {entry["route"] for entry in labels}
    assert {path for path in paths if "unknown" in path or subject in path} == set()


def test_a_decision_is_counted_with_its_level_and_kind_of_probe(client: Client) -> None:
    path = "/v1/subjects/metrics"
    assert client.put(f"{path}/enrollment", files=images(photo(1))).status_code == 201
    rise = Rise(client)
    for person in (1, 1, 2):
        answer = client.post(f"{path}/verify", files=images(photo(person, 2), name="image"))
        assert answer.status_code == 200
    level = answer.json()["level"]
    for decision, reason, times in (("accept", "match", 2), ("reject", "no_match", 1)):
        labels = {"decision": decision, "reason": reason, "level": level, "probe": "photo"}
        assert rise("veilface_decisions_total", **labels) == times
    for name in ("body", "photo", "decide"):
        assert rise("veilface_step_seconds_count", step=name) >= 3, name


def test_no_metric_names_a_subject_a_tenant_or_a_key(
    client: Client, deployment: Deployment
) -> None:
    subject, tenant = "subject-in-no-metric", "tenant-in-no-metric"
    token = deployment.key("enroll", "verify", tenant=tenant)
    path, headers = f"/v1/subjects/{subject}", bearer(token)
    assert (
        client.put(f"{path}/enrollment", files=images(photo(1)), headers=headers).status_code == 201
    )
    client.post(f"{path}/verify", files=images(photo(1), name="image"), headers=headers)
    client.get(path, headers=headers)
    text = client.get("/metrics").text
    pseudonym = client.app.state.runtime.store.signer.pseudonym(tenant, subject)
    secrets = (subject, tenant, token, token.split("_")[1], pseudonym[:16])
    assert [secret for secret in secrets if secret in text] == []


def test_metrics_need_their_right_unless_a_setting_opens_them(
    client: Client, deployment: Deployment
) -> None:
    for token, status, code in (
        ("", 401, "unauthorized"),
        (deployment.key("enroll", "verify", "scores"), 403, "forbidden"),
    ):
        assert_error(client.get("/metrics", headers=bearer(token)), status, code)
    token = deployment.key("metrics")
    assert client.get("/metrics", headers=bearer(token)).status_code == 200
    settings = deployment.settings.model_copy(update={"open_metrics": True})
    with Client(create_app(settings)) as opened:
        assert opened.get("/metrics").status_code == 200


def test_the_text_is_what_prometheus_reads(client: Client) -> None:
    answer = client.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    found = samples(answer.text)
    contract = client.app.state.runtime.contract.contract_id
    assert value(found, "veilface_build_info", version=VERSION, contract_id=contract) == 1
    assert value(found, "veilface_store_up") == 1
    assert value(found, "veilface_model_up") == 1
    assert value(found, "veilface_requests_in_flight") == 1  # this one
    assert value(found, "process_resident_memory_bytes") > 1e6
    # Every code has a series before its first error, so that no first rise is missed.
    for code in ERROR_CODES:
        assert ("veilface_errors_total", frozenset({("code", code)})) in found
    assert not any(name.endswith("_created") for name, _ in found)


def test_a_refusal_of_a_locked_subject_is_counted(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    rise = Rise(client)
    for wait in (30.0, 30.0, None):

        def locked(*_: Any, wait: float | None = wait, **__: Any) -> None:
            raise LockedOut(wait)

        monkeypatch.setattr(client.app.state.runtime.store.subjects, "describe", locked)
        assert client.get("/v1/subjects/a").status_code == 423
    assert rise("veilface_lockouts_total", kind="locked") == 2
    assert rise("veilface_lockouts_total", kind="disabled") == 1


def test_operations_md_explains_every_metric_and_no_other() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "deploy.md").read_text()
    told = set(re.findall(r"^\| `(veilface_[a-z_]+)` ", text, re.MULTILINE))
    families = list(text_string_to_metric_families(exposition().decode()))
    known = {
        f"{family.name}_total" if family.type == "counter" else family.name
        for family in families
        if family.name.startswith("veilface_")
    }
    assert told == known
    written = {sample.name for family in families for sample in family.samples}
    alarms = set(
        re.findall(r"veilface_[a-z_]+", "".join(re.findall(r"```yaml(.*?)```", text, re.S)))
    )
    assert alarms - written - known <= {"veilface_request_seconds_bucket"}


# Several workers


@pytest.mark.long
def test_any_worker_answers_for_all_and_nothing_falls_when_one_dies(tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    deployment = deploy(tmp_path, workers=2, port=free_port(), compute_slots=1, open_metrics=True)

    def started() -> list[int]:
        return [line["pid"] for line in server.lines() if line["event"] == "started"]

    with Server(deployment, tmp_path, TMPDIR=str(temporary)) as server:
        wait_until(lambda: len(started()) == 2, what="both workers")
        for _ in range(20):
            assert server.get("/nowhere").status_code == 404
        labels = {"route": "unmatched", "method": "GET", "status": "404"}

        def counted() -> float:
            return value(samples(server.get("/metrics").text), "veilface_requests_total", **labels)

        assert [counted() for _ in range(8)] == [20] * 8  # either worker
        held = socket.create_connection(("127.0.0.1", server.port))
        held.sendall(
            b"POST /v1/subjects/import HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n"
            + f"Authorization: Bearer {deployment.token}\r\n".encode()
            + b"Content-Type: application/json\r\n\r\n{"
        )
        wait_until(lambda: server.in_flight() == 2, what="a request in flight")  # and the scrape
        for pid in started():
            os.kill(pid, signal.SIGKILL)
        wait_until(lambda: len(started()) == 4, what="workers in place of the dead")
        server.wait()
        assert counted() == 20
        assert server.in_flight() == 1
        assert [path.stat().st_mode & 0o077 for path in temporary.glob("veilface-*")] == [0]
        held.close()
        assert server.stop() == 0
    assert list(temporary.iterdir()) == []
