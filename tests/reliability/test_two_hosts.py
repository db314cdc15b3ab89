"""Two hosts decide as one: both up, one cut off inside a write, one killed inside a write."""

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx
import psycopg
import pytest

from api.service.opening import open_keyring, open_store
from templates.store import verify_audit_log
from tests.api.cli.conftest import run
from tests.api.deployment import bearer
from tests.patience import PATIENCE_S, wait_until
from tests.reliability.cluster import Cluster
from tests.reliability.hosts import Host, Network, two_hosts
from tests.reliability.operations import LOST, Clients, Operation, People

pytestmark = pytest.mark.long

LIMIT = 40
"""Requests of an API key: more than the test makes with any but those that it exhausts."""
LOCKOUT = 4
PEOPLE = {"ann": 1, "ben": 2, "cas": 3, "dan": 4}
STRANGER = 9
WAITS = "wait_event_type = 'Lock'"


@pytest.fixture
def network() -> Iterator[Network]:
    """Two hosts, and the bridge between them."""
    with Network(2) as made:
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


def knows_of_the_lock(subject: str, clients: Clients) -> bool:
    """Whether the subject is locked, or, where its lock has ended, is again after one failure."""
    clients.verify(subject, STRANGER)
    return is_locked(subject, clients)


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
    cluster: Cluster, host: Host, verify: Callable[[], Operation]
) -> Iterator[list[Operation]]:
    """Hold a verification up in the middle of its transaction during the block.

    Gives a list, in which is what comes of it, some time after the block.
    """
    answers: list[Operation] = []
    thread = threading.Thread(target=lambda: answers.append(verify()), daemon=True)
    with psycopg.connect(cluster.url) as held:
        held.execute("SELECT * FROM audit_head FOR UPDATE")
        thread.start()
        wait_until(lambda: bool(sessions(cluster, host, WAITS)))
        yield answers


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
    with write_that_waits(cluster, first, verify) as cut:
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
    assert knows_of_the_lock("dan", a)
    assert a.verify("ann", PEOPLE["ann"]).accepted
    wait_until(lambda: {describe(host, exhausted) for host in (first, second)} == {429})

    # The second is killed inside a write.
    verify = partial(b.verify, "cas", PEOPLE["cas"])
    with write_that_waits(cluster, second, verify) as killed:
        second.service.kill()
    wait_until(lambda: killed, what="that its client notices")
    assert killed[0].outcome in (503, LOST)
    assert a.verify("cas", PEOPLE["cas"]).accepted
    assert a.replay(killed[0]).outcome == 200
    second.service.start()
    assert b.replay(killed[0]).code == "replayed"
    assert knows_of_the_lock("dan", b)
    wait_until(lambda: describe(second, exhausted) == 429)
    store = open_store(settings, open_keyring(settings))
    assert verify_audit_log(store).intact
    store.close()
