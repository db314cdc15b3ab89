"""Two hosts decide as one: both up, one cut off inside a write, one killed inside a write.

And nginx before them, as docs/deploy.md has it.
"""

import itertools
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import httpx
import psycopg
import pytest

from api.service.opening import open_keyring, open_store
from tests.api.cli.conftest import run
from tests.api.deployment import bearer, images
from tests.patience import PATIENCE_S, wait_until
from tests.reliability.cluster import Cluster
from tests.reliability.hosts import Host, Network, two_hosts
from tests.reliability.operations import LOST, Clients, People, Tokens
from tests.reliability.proxy import NAME, nginx, require_nginx

pytestmark = pytest.mark.long

LIMIT = 40
"""Requests of an API key: more than the test makes with any but those that it exhausts."""
LOCKOUT = 4
PEOPLE = {"ann": 1, "ben": 2, "cas": 3, "dan": 4}
STRANGER = 9
T = TypeVar("T")
WAITS = "wait_event_type = 'Lock'"
KILLED = "killed-inside-a-verification"


@pytest.fixture
def network() -> Iterator[Network]:
    """Two hosts, and a third where a client is."""
    with Network(3) as made:
        yield made


@pytest.fixture
def cluster_address(network: Network) -> str:
    return network.address


def clients_of(first: Host, second: Host) -> tuple[Clients, Clients]:
    """Clients of each host, with the same API keys."""
    people = People(first.service.deployment, [*PEOPLE.values(), STRANGER])
    a, b = (Clients(host.service, people) for host in (first, second))
    b.tokens = a.tokens
    return a, b


def lock(subject: str, *hosts: Clients) -> None:
    """Let strangers fail on these hosts in turn, until the subject is locked."""
    for clients, _ in zip(itertools.cycle(hosts), range(LOCKOUT), strict=False):
        failed = clients.verify(subject, STRANGER)
        assert (failed.outcome, failed.accepted) == (200, False)


def is_locked(subject: str, clients: Clients) -> bool:
    return clients.verify(subject, PEOPLE[subject]).outcome == 423


def describe(host: Host, token: str) -> int:
    url = f"{host.service.url}/v1/contract"
    return httpx.get(url, headers=bearer(token), timeout=PATIENCE_S, trust_env=False).status_code


def exhausted_key(first: Host, second: Host) -> str:
    """A key that is used up on both hosts, after exactly as many requests as it may make."""

    def outages() -> int:
        logs = (*first.service.lines(), *second.service.lines())
        return sum(line.get("event") == "rate limit storage failed" for line in logs)

    for _ in range(20):
        before, token = outages(), first.service.deployment.key("verify")
        hosts = itertools.islice(itertools.cycle((first, second)), LIMIT + 10)
        answers = [describe(host, token) for host in hosts]
        # On a busy machine Redis may answer too late, and is done without for some seconds.
        if outages() == before:
            assert answers == [200] * LIMIT + [429] * 10
            return token
    raise AssertionError("Redis never answered in time")


@contextmanager
def write_that_waits(
    cluster: Cluster, hosts: Sequence[Host], verify: Callable[[], T]
) -> Iterator[tuple[Host, list[T]]]:
    """Hold a verification up in the middle of its transaction during the block.

    Gives the one of the hosts that it is on, and a list, in which is what comes of it, some time
    after the block.
    """
    answers: list[T] = []
    serving: list[Host] = []
    thread = threading.Thread(target=lambda: answers.append(verify()), daemon=True)

    def waits() -> bool:
        serving.extend(each for each in hosts if sessions(cluster, each, WAITS))
        return bool(serving)

    with psycopg.connect(cluster.url) as held:
        held.execute("SELECT * FROM audit_head FOR UPDATE")
        thread.start()
        wait_until(waits)
        yield serving[0], answers


def sessions(cluster: Cluster, host: Host, condition: str) -> int:
    query = f"SELECT count(*) FROM pg_stat_activity WHERE client_addr = %s AND {condition}"
    with psycopg.connect(cluster.url) as connection:
        row = connection.execute(query, [host.address]).fetchone()
    assert row is not None
    return int(row[0])


def test_two_hosts_decide_as_one(network: Network, cluster: Cluster, tmp_path: Path) -> None:
    limits = {"lockout_after": LOCKOUT, "rate_limit_key": f"{LIMIT}/day"}
    with two_hosts(network, cluster, tmp_path, **limits) as (first, second):
        decide_as_one(cluster, first, second)


def decide_as_one(cluster: Cluster, first: Host, second: Host) -> None:
    a, b = clients_of(first, second)
    for subject, person in PEOPLE.items():
        assert a.enroll(subject, person).outcome == 201
        assert b.verify(subject, person).accepted

    # Both are up.
    used = a.verify("ann", PEOPLE["ann"])
    assert b.replay(used).code == "replayed"
    lock("ben", a, b)
    assert is_locked("ben", a)
    assert is_locked("ben", b)
    exhausted = exhausted_key(first, second)

    # The first is cut off inside a write, with the locks that every write needs.
    verify = partial(a.verify, "cas", PEOPLE["cas"])
    with write_that_waits(cluster, [first], verify) as (_, cut):
        first.cut_off()
    writes = "xact_start IS NOT NULL"
    wait_until(lambda: not sessions(cluster, first, writes), what="the end of its session")
    wait_until(lambda: not first.thinks_it_is_ready(), what="that the host notices", every_s=0.5)
    lock("dan", b)
    used = b.verify("ann", PEOPLE["ann"])
    assert used.accepted
    settings = second.service.deployment.settings
    files = ["--data-dir", settings.data_dir, "--database-url", settings.resolved_database_url]
    turned = run("keys", "rotate-tenant", "--json", *files)
    assert turned.json["moved"] == len(PEOPLE)

    first.reconnect()
    wait_until(first.service.is_ready, what="that the host is back")
    wait_until(lambda: cut, what="what the host says of the write")
    assert cut[0].outcome in (503, LOST)
    assert b.replay(cut[0]).outcome == 200  # its use was undone with the write
    assert a.replay(cut[0]).code == "replayed"
    assert a.replay(used).code == "replayed"
    assert is_locked("dan", a)
    assert a.verify("ann", PEOPLE["ann"]).accepted
    wait_until(lambda: {describe(host, exhausted) for host in (first, second)} == {429})

    # The second is killed inside a write.
    verify = partial(b.verify, "cas", PEOPLE["cas"])
    with write_that_waits(cluster, [second], verify) as (_, killed):
        second.service.kill()
    wait_until(lambda: killed, what="that its client notices")
    assert killed[0].outcome in (503, LOST)
    assert a.verify("cas", PEOPLE["cas"]).accepted
    assert a.replay(killed[0]).outcome == 200
    second.service.start()
    assert b.replay(killed[0]).code == "replayed"
    assert is_locked("dan", b)
    wait_until(lambda: describe(second, exhausted) == 429)
    store = open_store(settings, open_keyring(settings))
    assert store.audit_log.verify().intact
    store.close()


UNTIL_REFUSED = """
import ssl, sys, httpx
url, chain, name = sys.argv[1:]
context = ssl.create_default_context(cafile=chain)
with httpx.Client(verify=context, trust_env=False, timeout=600) as client:
    for number in range(4 * int({limit})):
        headers = {{"Host": name, "X-Forwarded-For": f"203.0.113.{{number % 250}}"}}
        sent = {{"headers": headers, "extensions": {{"sni_hostname": name}}}}
        if client.get(f"{{url}}/nowhere", **sent).status_code == 429:
            print("refused")
            break
"""


class ThroughProxy:
    """A client that knows the proxy's name and certificate."""

    def __init__(self, url: str, certificate: Path, people: People, tokens: Tokens) -> None:
        context = ssl.create_default_context(cafile=str(certificate))
        self._client = httpx.Client(
            base_url=url,
            verify=context,
            headers={"Host": NAME},
            timeout=PATIENCE_S,
            trust_env=False,
        )
        self._people, self._tokens = people, tokens

    def __enter__(self) -> "ThroughProxy":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def send(
        self, method: str, path: str, token: str, request_id: str | None = None, **sent: Any
    ) -> httpx.Response:
        headers = bearer(token)
        if request_id is not None:
            headers["X-Request-ID"] = request_id
        sent |= {"headers": headers, "extensions": {"sni_hostname": NAME}}
        return self._client.request(method, path, **sent)

    def enroll(self, subject: str) -> int:
        files = images(self._people.photos[PEOPLE[subject]])
        path = f"/v1/subjects/{subject}/enrollment"
        return self.send("PUT", path, self._tokens.enroll, files=files).status_code

    def verify(self, subject: str, request_id: str | None = None) -> httpx.Response:
        token = self._tokens.verify
        body = {"embedding": self._people.embeddings[PEOPLE[subject]].tolist()}
        return self.send("POST", f"/v1/subjects/{subject}/verify", token, request_id, json=body)


def verifications(host: Host) -> int:
    """How many reached a host."""
    return sum(line.get("route", "").endswith("/verify") for line in host.service.lines())


def test_nginx_leads_to_both_hosts_and_repeats_no_verification(
    network: Network, cluster: Cluster, tmp_path: Path
) -> None:
    require_nginx()
    limits = {"trusted_proxies": network.address, "rate_limit_address": "200/day"}
    with ExitStack() as running:
        hosts = running.enter_context(two_hosts(network, cluster, tmp_path, **limits))
        deployment = hosts[0].service.deployment
        folder = tmp_path / "nginx"
        addresses = [host.address for host in hosts]
        url = running.enter_context(
            nginx(folder, network.address, addresses, deployment.settings.port)
        )
        people = People(deployment, list(PEOPLE.values()))
        client = running.enter_context(
            ThroughProxy(url, folder / "chain.pem", people, Tokens(deployment))
        )
        assert [client.enroll(subject) for subject in PEOPLE] == [201] * len(PEOPLE)
        assert client.send("GET", "/metrics", "none").status_code == 404
        for subject in itertools.islice(itertools.cycle(PEOPLE), 12):
            assert client.verify(subject).json()["decision"] == "accept"
        wait_until(lambda: all(map(verifications, hosts)), what="verifications on both hosts")

        # One address is refused, whatever it says that it forwards, and no other one with it.
        script = UNTIL_REFUSED.format(limit=200 * deployment.settings.workers * len(hosts))
        arguments = [url, str(folder / "chain.pem"), NAME]
        done = subprocess.run(
            [*network.within(2), sys.executable, "-c", script, *arguments],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        assert (done.stdout.strip(), done.stderr) == ("refused", "")
        assert client.verify("ann").json()["decision"] == "accept"
        wait_until(lambda: sum(map(verifications, hosts)) == 13, what="all in the logs")
        before = {host: verifications(host) for host in hosts}

        # A host is killed inside a verification: the other one never sees that. Connections that
        # nginx keeps have ended: where one of those fails, it tries the same host again first.
        time.sleep(6)
        verify = partial(client.verify, "ben", KILLED)
        with write_that_waits(cluster, hosts, verify) as (killed, answers):
            killed.service.kill()
            wait_until(lambda: answers)
        (other,) = (each for each in hosts if each is not killed)
        # 503 where it waited for so long that the service itself gave up just before.
        assert answers[0].status_code in (502, 503)
        for subject in itertools.islice(itertools.cycle(PEOPLE), 12):
            assert client.verify(subject).json()["decision"] == "accept"
        wait_until(lambda: verifications(other) >= before[other] + 12)
        assert KILLED not in [line.get("request_id") for line in other.service.lines()]
