"""One API key with many requests, and another one with a single one."""

import asyncio
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest

from api.http.app import create_app
from api.limits.admission import Gate, Slots
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from verify import probe_of_photos

SENT = 20
"""Photos that the busy key sends at once: fewer than its places, so that all of them wait."""


@pytest.fixture
def service(tmp_path: Path) -> Iterator[tuple[Client, Deployment]]:
    """A service with one compute slot, so that the order of turns is the order of answers."""
    deployment = deploy(tmp_path, compute_slots=1, lockout_after=0)
    with Client(create_app(deployment.settings)) as client:
        yield client, deployment


def test_a_photo_waits_for_at_most_two_turns_of_a_busy_key(
    service: tuple[Client, Deployment], monkeypatch: pytest.MonkeyPatch
) -> None:
    client, deployment = service
    busy, other = deployment.key("verify", tenant="busy"), deployment.key("verify", tenant="other")
    go_on, turns = threading.Event(), []

    def counted(pack: Any, contract: Any, data: list[bytes], **options: Any) -> Any:
        turns.append("other" if data == [single] else "busy")
        go_on.wait()
        return probe_of_photos(pack, contract, data, **options)

    def verify(token: str, data: bytes) -> int:
        return client.post(
            "/v1/subjects/a/verify", files=images(data, name="image"), headers=bearer(token)
        ).status_code

    def until(waiting: int) -> None:
        gate: Gate = client.app.state.gate
        while gate.waiting < waiting:
            assert not any(sent.done() for sent in flood)
            time.sleep(0.01)

    single = photo(2)
    monkeypatch.setattr("api.http.routes.verification.probe_of_photos", counted)
    with ThreadPoolExecutor(SENT + 1) as pool:
        try:
            flood = [pool.submit(verify, busy, photo(1, shot)) for shot in range(SENT)]
            until(waiting=SENT - 1)
            answer = pool.submit(verify, other, single)
            until(waiting=SENT)
        finally:
            go_on.set()
        assert answer.result() == 200
        assert {sent.result() for sent in flood} == {200}
    # The one that ran when it came, and the one whose turn was next.
    assert turns.index("other") <= 2
    assert len(turns) == SENT + 1


def test_turns_go_round_the_keys_and_in_order_within_one() -> None:
    turns: list[str] = []

    async def scenario() -> None:
        gate, go_on = Gate(slots=1, waiting=100), threading.Event()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(partial(gate.compute, go_on.wait, key="first"))
            while not gate.computing:
                await anyio.sleep(0)
            for count, name in enumerate(("a1", "a2", "a3", "a4", "b1", "b2", "c1"), start=1):
                tasks.start_soon(partial(gate.compute, partial(turns.append, name), key=name[0]))
                while gate.waiting < count:
                    await anyio.sleep(0)
            go_on.set()

    anyio.run(scenario)
    assert turns == ["a1", "b1", "c1", "a2", "b2", "a3", "a4"]


def test_a_turn_that_is_given_to_a_request_that_ended_goes_to_the_next() -> None:
    async def take(slots: Slots, key: str) -> None:
        async with slots.turn(key):
            pass

    async def scenario() -> None:
        slots = Slots(1)
        async with slots.turn("a"):
            tasks = [asyncio.create_task(take(slots, key)) for key in "bcc"]
            while slots.waiting < 3:
                await asyncio.sleep(0)
            tasks[2].cancel()
            await asyncio.gather(tasks[2], return_exceptions=True)
            assert (slots.taken, slots.waiting) == (1, 2)
        # The turn is that of `b` now, and before it learns of it, it is cancelled.
        tasks[0].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert [task.cancelled() for task in tasks] == [True, False, True]
        assert (slots.taken, slots.waiting) == (0, 0)

    asyncio.run(scenario())
