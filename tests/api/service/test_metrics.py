"""What is counted, by whom, and what no metric may say."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import anyio.from_thread
import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from api.http.app import VERSION
from api.http.errors import ERROR_CODES
from api.limits.admission import Gate
from api.service.housekeeping import purge_regularly
from api.service.metrics import exposition, shared_directory, step
from templates.store.lockout import LockedOut
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, environment_of, images, photo
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from tests.reliability.full_disk import may_mount, small_file_system

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


def test_the_text_is_what_prometheus_reads(client: Client) -> None:
    answer = client.get("/metrics", headers={"Authorization": ""})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    found = samples(answer.text)
    contract = client.app.state.runtime.contract.contract_id
    assert value(found, "veilface_build_info", version=VERSION, contract_id=contract) == 1
    assert value(found, "veilface_store_up") == 1
    assert value(found, "veilface_model_up") == 1
    assert value(found, "veilface_requests_in_flight") == 0
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


def test_a_failed_purge_is_counted() -> None:
    class Broken:
        def purge(self) -> bool:
            raise OSError

    failures: list[Exception] = []
    before = value(samples(exposition().decode()), "veilface_purge_failures_total")

    async def scenario() -> None:
        with anyio.CancelScope() as purging:

            def failed(error: Exception) -> None:
                failures.append(error)
                purging.cancel()

            await purge_regularly(
                Broken(),  # type: ignore[arg-type]
                every_s=60,
                on_failure=failed,
            )

    anyio.run(scenario)
    after = value(samples(exposition().decode()), "veilface_purge_failures_total")
    assert after == before + 1
    assert [type(each) for each in failures] == [OSError]


def test_a_step_is_measured_even_if_it_fails() -> None:
    name = "a step of this test"

    def fail() -> None:
        time.sleep(0.02)
        raise KeyError

    begun = time.perf_counter()
    with pytest.raises(KeyError), step(name):
        fail()
    took = time.perf_counter() - begun
    found = samples(exposition().decode())
    assert value(found, "veilface_step_seconds_count", step=name) == 1
    assert 0.02 <= value(found, "veilface_step_seconds_sum", step=name) <= took
    assert value(found, "veilface_step_seconds_bucket", step=name, le="0.01") == 0
    assert value(found, "veilface_step_seconds_bucket", step=name, le="+Inf") == 1


def test_who_waits_for_a_slot_is_seen() -> None:
    go_on = threading.Event()

    def waiting() -> float:
        return value(samples(exposition().decode()), "veilface_compute_waiting")

    async def scenario() -> None:
        gate = Gate(slots=2, waiting=10)
        with anyio.fail_after(PATIENCE_S):
            async with anyio.create_task_group() as tasks:
                for _ in range(5):
                    tasks.start_soon(partial(gate.compute, lambda: go_on.wait(PATIENCE_S), key="a"))
                while gate.waiting < 3 or gate.computing < 2:
                    await anyio.sleep(0.01)
                assert (gate.computing, gate.waiting, waiting()) == (2, 3, 3)
                go_on.set()
        assert (gate.computing, gate.waiting, waiting()) == (0, 0, 0)

    with anyio.from_thread.start_blocking_portal() as portal:
        portal.call(scenario)


def test_who_gives_up_waiting_is_not_counted_any_more() -> None:
    go_on = threading.Event()

    async def scenario() -> None:
        gate = Gate(slots=1, waiting=10)
        with anyio.fail_after(PATIENCE_S):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(partial(gate.compute, lambda: go_on.wait(PATIENCE_S), key="a"))
                while not gate.computing:
                    await anyio.sleep(0.01)
                with anyio.move_on_after(0.05):
                    await gate.compute(lambda: None, key="b")
                assert (gate.computing, gate.waiting) == (1, 0)
                go_on.set()
            assert await gate.compute(lambda: "runs", key="b") == "runs"

    with anyio.from_thread.start_blocking_portal() as portal:
        portal.call(scenario)


def test_operations_md_explains_every_metric_and_no_other() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "operations.md").read_text()
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


COUNTS = """
import sys
from api.service.metrics import IN_FLIGHT, count_error, count_request, exposition
from api.service.metrics import join_shared_directory
join_shared_directory()
IN_FLIGHT.inc(7)
for _ in range(int(sys.argv[1])):
    count_error("no_face")
    count_request(route="/r", method="GET", status=200, seconds=0.02)
print(exposition().decode())
"""


@pytest.mark.long
def test_what_dead_workers_counted_stays_in_one_file() -> None:
    with shared_directory() as folder:
        assert folder.stat().st_mode & 0o077 == 0
        for number in range(1, 4):
            ran = subprocess.run(
                [sys.executable, "-c", COUNTS, str(number)],
                capture_output=True,
                text=True,
                check=True,
                cwd=Path(__file__).resolve().parents[3],
            )
            found, sum_ = samples(ran.stdout), number * (number + 1) / 2
            labels = {"route": "/r", "method": "GET", "status": "200"}
            assert value(found, "veilface_errors_total", code="no_face") == sum_
            assert value(found, "veilface_requests_total", **labels) == sum_
            assert value(found, "veilface_request_seconds_count", route="/r") == sum_
            assert value(found, "veilface_request_seconds_bucket", route="/r", le="0.01") == 0
            assert value(found, "veilface_request_seconds_bucket", route="/r", le="0.025") == sum_
            seconds = value(found, "veilface_request_seconds_sum", route="/r")
            assert seconds == pytest.approx(0.02 * sum_)
            # What is now is said by the living alone.
            assert value(found, "veilface_requests_in_flight") == 7
        files = sorted(path.name for path in folder.glob("*.db"))
        assert sum(name.startswith("counter_") for name in files) == 2  # the dead, and the last
        assert sum(name.startswith("histogram_") for name in files) == 2
    assert not folder.exists()
    assert "PROMETHEUS_MULTIPROC_DIR" not in os.environ


@pytest.mark.long
def test_any_worker_answers_for_all_and_nothing_falls_when_one_dies(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, workers=2, port=free_port(), compute_slots=1)
    url = f"http://127.0.0.1:{deployment.settings.port}"
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "veilface", "serve"],
            cwd=Path(__file__).resolve().parents[3],
            env={**environment_of(deployment.settings), "TMPDIR": str(temporary)},
            stdout=log,
            stderr=log,
        )

    def scraped() -> Samples:
        return samples(httpx.get(f"{url}/metrics", timeout=PATIENCE_S).text)

    def workers(found: Samples) -> set[str]:
        return {
            dict(labels)["pid"] for name, labels in found if name == "process_resident_memory_bytes"
        }

    def until(condition: Callable[[], bool]) -> None:
        def holds() -> bool:
            assert process.poll() is None, (tmp_path / "log").read_text()
            with suppress(httpx.TransportError):
                return condition()
            return False

        wait_until(holds)

    try:
        until(lambda: len(workers(scraped())) == 2)
        for _ in range(20):
            assert httpx.get(f"{url}/nowhere", timeout=PATIENCE_S).status_code == 404
        labels = {"route": "unmatched", "method": "GET", "status": "404"}
        for _ in range(8):  # either worker
            assert value(scraped(), "veilface_requests_total", **labels) == 20
        before = workers(scraped())
        (victim, _) = sorted(before)
        os.kill(int(victim), signal.SIGKILL)
        until(lambda: len(workers(scraped()) - before) == 1)
        found = scraped()
        assert victim not in workers(found)
        assert '"ended_by": "SIGKILL"' in (tmp_path / "log").read_text()
        assert value(found, "veilface_requests_total", **labels) == 20
        assert value(found, "veilface_store_up") == 1
        assert [path.stat().st_mode & 0o077 for path in temporary.glob("veilface-*")] == [0]
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=PATIENCE_S) == 0
        assert list(temporary.glob("veilface-metrics-*")) == []
    finally:
        process.kill()
        process.wait()


@pytest.mark.long
@pytest.mark.skipif(not may_mount(), reason="may not mount a file system")
def test_a_worker_starts_where_the_folder_for_temporary_files_is_full(tmp_path: Path) -> None:
    """A page of a mapped file for which there is no room would end it, and each after it."""
    deployment = deploy(tmp_path, workers=2, port=free_port(), compute_slots=1)
    log = tmp_path / "log"

    def lines() -> list[dict[str, Any]]:
        return [json.loads(line) for line in log.read_text().splitlines() if line[:1] == "{"]

    def started() -> list[int]:
        return [line["pid"] for line in lines() if line["event"] == "started"]

    with small_file_system() as temporary, log.open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "veilface", "serve"],
            cwd=Path(__file__).resolve().parents[3],
            env={**environment_of(deployment.settings), "TMPDIR": str(temporary)},
            stdout=stderr,
            stderr=stderr,
        )
        try:
            wait_until(lambda: len(started()) == 2)
            for pid in started():
                with suppress(OSError), (temporary / f"filler-{pid}").open("wb") as filler:
                    while filler.write(bytes(4096)):
                        filler.flush()
                os.kill(pid, signal.SIGKILL)
            wait_until(lambda: len(started()) == 4)
            url = f"http://127.0.0.1:{deployment.settings.port}"
            assert httpx.get(f"{url}/health/ready", timeout=PATIENCE_S).status_code == 200
            assert httpx.get(f"{url}/metrics", timeout=PATIENCE_S).status_code == 200
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=PATIENCE_S) == 0
        finally:
            process.kill()
            process.wait()
    assert [line["ended_by"] for line in lines() if "ended_by" in line] == ["SIGKILL"] * 2
