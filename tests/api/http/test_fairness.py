"""One API key with many requests, and another one with a single one."""

import threading
from collections import Counter
from collections.abc import Callable
from functools import partial

import anyio
import anyio.from_thread

from api.limits.admission import Gate
from api.service.metrics import exposition
from tests.patience import PATIENCE_S


def waiting() -> float:
    lines = exposition().decode().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith("veilface_compute_w")))


async def until(condition: Callable[[], bool]) -> None:
    with anyio.fail_after(PATIENCE_S):
        while not condition():
            await anyio.sleep(0.01)


def test_a_busy_key_computes_in_its_slots_and_keeps_no_other_waiting() -> None:
    go_on, computing = threading.Event(), Counter[str]()

    def work(key: str) -> None:
        computing[key] += 1
        go_on.wait(PATIENCE_S)
        computing[key] -= 1

    async def scenario() -> None:
        gate = Gate(slots=2, waiting=100)
        async with anyio.create_task_group() as tasks:
            for _ in range(60):
                tasks.start_soon(partial(gate.compute, partial(work, "busy"), key="busy"))
            await until(lambda: computing["busy"] == 2 and waiting() == 58)
            for key in ("b", "c"):
                tasks.start_soon(partial(gate.compute, partial(work, key), key=key))
            await until(lambda: computing["b"] == computing["c"] == 1)
            assert (computing["busy"], waiting()) == (2, 58)
            go_on.set()
        assert (computing.total(), waiting()) == (0, 0)

    with anyio.from_thread.start_blocking_portal() as portal:
        portal.call(scenario)


def test_a_request_that_gives_up_waiting_takes_no_slot() -> None:
    go_on = threading.Event()

    async def scenario() -> None:
        gate = Gate(slots=1, waiting=10)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(partial(gate.compute, lambda: go_on.wait(PATIENCE_S), key="a"))
            await anyio.sleep(0)
            with anyio.move_on_after(0.05) as given_up:
                await gate.compute(lambda: None, key="a")
            assert given_up.cancelled_caught
            assert waiting() == 0
            go_on.set()
        assert await gate.compute(lambda: "runs", key="a") == "runs"

    with anyio.from_thread.start_blocking_portal() as portal:
        portal.call(scenario)
