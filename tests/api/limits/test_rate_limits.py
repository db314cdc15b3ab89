"""Limits per API key and per address, in the process and in a real Redis."""

import json
import os
import secrets
import signal
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from datetime import UTC, datetime
from functools import partial
from typing import Any

import anyio
import httpx
import pytest
import redis
import uvicorn

from api.http.app import create_app
from api.http.errors import ApiError, StartError
from api.limits import rates
from api.limits.rates import RateLimits, address_of
from api.service.metrics import RATE_LIMITED, RATE_STORAGE_FAILURES
from api.service.runtime import Runtime
from api.service.server import uvicorn_options
from api.settings import Settings, load_settings
from tests.api.deployment import Deployment, bearer, deploy
from tests.api.shapes import assert_error
from tests.redis_server import OwnRedis, own_redis_server

REDIS = os.environ.get("VEILFACE_TEST_REDIS_URL", "redis://127.0.0.1:6379/0")
Make = Callable[[str], AbstractAsyncContextManager[RateLimits]]


@pytest.fixture(scope="session")
def redis_url() -> str:
    client = redis.Redis.from_url(REDIS, socket_connect_timeout=3)
    try:
        client.ping()
    except redis.RedisError as error:
        pytest.skip(f"no Redis server answers ({type(error).__name__})")
    finally:
        client.close()
    return REDIS


@pytest.fixture
def prefix(redis_url: str) -> Iterator[str]:
    """A prefix of this test's own; its keys go at the end."""
    name = f"veilface-test-{secrets.token_hex(6)}"
    yield name
    with redis.Redis.from_url(redis_url) as client:
        for key in client.scan_iter(f"{name}:*"):
            client.delete(key)


@pytest.fixture(params=["process", "redis"])
def make(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes limits by key; two in Redis share their counts."""
    where = {}
    if request.param == "redis":
        where = {name: request.getfixturevalue(name) for name in ("redis_url", "prefix")}
        # On a busy machine Redis may answer late, and would be taken for one that is away.
        monkeypatch.setattr(rates, "STORAGE_TIMEOUT_S", 30.0)
    return lambda key: opened(key=key, **where)


@asynccontextmanager
async def opened(**options: Any) -> AsyncIterator[RateLimits]:
    made = RateLimits(**{"address": "off", **options})
    try:
        yield made
    finally:
        await made.close()


async def refusal(count: Awaitable[None]) -> ApiError | None:
    try:
        await count
    except ApiError as error:
        return error
    return None


@pytest.mark.parametrize(
    ("host", "crowded", "counted"),
    [
        ("192.0.2.7", False, "192.0.2.7"),
        ("2001:db8:1:2:3:4:5:6", False, "2001:db8:1:2::/64"),
        ("fe80::1%eth0", False, "fe80::/64"),
        ("::ffff:192.0.2.7", False, "192.0.2.7"),
        ("", False, "unknown"),
        ("192.0.2.7, 10.0.0.1", False, "unknown"),
        ("2001:db8:1:2::", True, "2001:db8:1::/48"),
        ("::ffff:192.0.2.7", True, "192.0.2.0/24"),
        ("", True, "unknown"),
    ],
)
def test_an_address_is_counted_by_what_one_client_has(
    host: str, crowded: bool, counted: str
) -> None:
    assert address_of(host, crowded=crowded) == counted


def test_one_customer_with_many_networks_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rates, "CROWD", 100)

    async def knock() -> None:
        limits = RateLimits(key="off", address="50/minute")
        for network in range(300):
            await limits.count_address({"client": (f"2001:db8:1:{network:x}::", 1)})

    with pytest.raises(ApiError, match="too many requests from this address"):
        anyio.run(knock)


def test_the_next_one_is_refused_and_told_how_long_to_wait(make: Make) -> None:
    async def scenario() -> None:
        async with make("3/hour") as counted:
            before = RATE_LIMITED.labels("key")._value.get()
            for _ in range(3):
                await counted.count_key("a")
            refused = await refusal(counted.count_key("a"))
            assert refused is not None
            assert (refused.code, refused.details) == ("rate_limited", {"limit": "key"})
            assert 1 <= int(refused.headers["Retry-After"]) <= 3600
            assert await refusal(counted.count_key("b")) is None
            assert RATE_LIMITED.labels("key")._value.get() == before + 1

    anyio.run(scenario)


def test_workers_share_a_limit_in_redis_and_not_without_it(
    make: Make, request: pytest.FixtureRequest
) -> None:
    async def scenario() -> list[bool]:
        async with make("4/day") as one, make("4/day") as other:
            return [await refusal(each.count_key("a")) is None for each in (one, other) * 4]

    passed = anyio.run(scenario)
    assert sum(passed) == (4 if "redis" in request.node.callspec.id else 8)


@pytest.fixture
def own_redis() -> Iterator[OwnRedis]:
    with own_redis_server() as server:
        yield server


def events(text: str) -> list[str]:
    return [json.loads(line)["event"] for line in text.splitlines()]


def test_while_redis_is_away_each_worker_counts_for_itself(
    own_redis: OwnRedis, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rates, "RETRY_STORAGE_S", 0.3)
    # One that is away refuses at once; one that answers late on a busy machine is not away.
    monkeypatch.setattr(rates, "STORAGE_TIMEOUT_S", 30.0)

    async def passed(counted: RateLimits, times: int) -> int:
        return sum([await refusal(counted.count_key("a")) is None for _ in range(times)])

    async def scenario() -> None:
        from api.service.logging import configure

        configure("info")
        failures = RATE_STORAGE_FAILURES._value.get()
        async with opened(redis_url=own_redis.url, key="10/day") as counted:
            assert await passed(counted, 4) == 4
            own_redis.kill()
            assert await passed(counted, 15) == 10
            await anyio.sleep(0.4)
            assert await passed(counted, 3) == 0  # it is tried again, in vain, and the limit holds
            assert RATE_STORAGE_FAILURES._value.get() == failures + 1
            own_redis.start()
            await anyio.sleep(0.4)
            assert await passed(counted, 15) == 10  # a fresh server has counted nothing
        assert events(capfd.readouterr().err) == [
            "rate limit storage failed",
            "rate limit storage answers again",
        ]

    own_redis.start()
    anyio.run(scenario)


def test_a_redis_that_hangs_does_not_hold_a_request(
    own_redis: OwnRedis, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with opened(redis_url=own_redis.url, key="10/day") as counted:
            await counted.count_key("a")
            assert own_redis.process is not None
            own_redis.process.send_signal(signal.SIGSTOP)
            try:
                for _ in range(5):  # returns although Redis never answers
                    await counted.count_key("a")
            finally:
                own_redis.process.send_signal(signal.SIGCONT)

    own_redis.start()
    anyio.run(scenario)


@pytest.mark.parametrize(
    "url",
    ["http://user:hunter2@host", "redis//:hunter2@host", "redis://user:hunter2@host:port/x"],
)
def test_no_message_repeats_a_password(url: str) -> None:
    with pytest.raises(StartError, match="rate_limit_storage") as caught:
        RateLimits.open(load_settings(rate_limit_storage=url))
    assert "hunter2" not in str(caught.value)
    assert caught.value.__suppress_context__


def test_without_the_client_library_redis_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "redis.asyncio", None)
    with pytest.raises(StartError, match=r"veilface\[redis\]"):
        RateLimits.open(load_settings(rate_limit_storage="redis://127.0.0.1"))


# The service

Ask = Callable[..., Awaitable[httpx.Response]]


async def sent(
    app: Any, path: str, *, host: str = "192.0.2.1", json: Any = None, **headers: str
) -> httpx.Response:
    """GET a path, or POST JSON to it."""
    transport = httpx.ASGITransport(app, client=(host, 1234))
    async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
        return await client.request(
            "GET" if json is None else "POST", path, json=json, headers=headers
        )


def served(settings: Settings, scenario: Callable[[Any, Ask], Awaitable[None]]) -> None:
    """Run a scenario with a service and a function that asks it."""

    async def run() -> None:
        app = create_app(settings)
        async with app.router.lifespan_context(app):
            await scenario(app, partial(sent, app))

    anyio.run(run)


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> Deployment:
    return deploy(
        tmp_path_factory.mktemp("tight"), rate_limit_key="4/day", rate_limit_address="6/day"
    )


def test_an_address_is_refused_before_its_key_is_looked_up(
    tight: Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(app: Any, ask: Ask) -> None:
        store = app.state.runtime.store
        looked_up: list[str] = []
        verify = store.api_keys.verify
        monkeypatch.setattr(
            store.api_keys, "verify", lambda token: looked_up.append(token) or verify(token)
        )
        unknown = bearer(f"vf_{0:012}_{0:064}")
        answers = [await ask("/v1/contract", **unknown) for _ in range(8)]
        assert [each.status_code for each in answers] == [401] * 6 + [429] * 2
        assert len(looked_up) == 6
        details = assert_error(answers[-1], 429, "rate_limited")
        assert details == {"limit": "address"}
        assert int(answers[-1].headers["retry-after"]) >= 1
        assert answers[-1].headers["x-content-type-options"] == "nosniff"
        # Any path counts, and a client elsewhere has a count of his own.
        assert_error(await ask("/nowhere"), 429, "rate_limited")
        assert (await ask("/nowhere", host="192.0.2.2")).status_code == 404
        # Health is exempt, so that a busy neighbour does not get the service restarted.
        for path in ("/health/live", "/health/ready"):
            assert (await ask(path)).status_code == 200

    served(tight.settings, scenario)


def test_a_key_is_counted_wherever_it_is_used_from(tight: Deployment) -> None:
    other = tight.key("verify")

    async def scenario(app: Any, ask: Ask) -> None:
        answers = [
            await ask("/v1/contract", host=f"192.0.2.{number}", **bearer(tight.token))
            for number in range(6)
        ]
        assert [each.status_code for each in answers] == [200] * 4 + [429] * 2
        answers.append(await ask("/v1/compare", json={}, host="192.0.2.7", **bearer(tight.token)))
        for refused in answers[-2:]:
            assert assert_error(refused, 429, "rate_limited") == {"limit": "key"}
        assert (await ask("/v1/contract", **bearer(other))).status_code == 200

    served(tight.settings, scenario)


def test_tokens_count_for_the_key_that_made_them(tight: Deployment) -> None:
    key = bearer(tight.key("verify"))

    async def scenario(app: Any, ask: Ask) -> None:
        tokens = []
        for number in range(2):
            body = {"subject_id": f"s{number}", "action": "verify"}
            answer = await ask("/v1/tokens", host=f"192.0.2.{number}", json=body, **key)
            tokens.append(answer.json()["token"])
        answers = [
            await ask("/v1/contract", host=f"198.51.100.{number}", **bearer(token))
            for number, token in enumerate(tokens * 2)
        ]
        assert [each.status_code for each in answers] == [200] * 2 + [429] * 2
        assert (await ask("/v1/contract", **key)).status_code == 429

    served(tight.settings, scenario)


def test_a_late_token_uses_up_nothing_of_its_key(tight: Deployment) -> None:
    key = bearer(tight.key("verify"))

    async def scenario(app: Any, ask: Ask) -> None:
        body = {"subject_id": "late", "action": "verify", "lifetime_s": 1}
        issued = (await ask("/v1/tokens", host="203.0.113.1", json=body, **key)).json()
        while datetime.now(UTC) <= datetime.fromisoformat(issued["expires_at"]):
            await anyio.sleep(0.1)
        for number in range(2, 8):
            token = bearer(issued["token"])
            answer = await ask("/v1/contract", host=f"203.0.113.{number}", **token)
            assert_error(answer, 401, "replayed")
        assert (await ask("/v1/contract", host="203.0.113.8", **key)).status_code == 200

    served(tight.settings, scenario)


@pytest.mark.parametrize(
    ("trusted", "from_host", "passing"),
    [
        ("127.0.0.1", "127.0.0.1", 9),
        ("10.0.0.0/8,192.0.2.1", "10.1.2.3", 9),
        ("127.0.0.1", "192.0.2.9", 6),
        ("none", "127.0.0.1", 6),
    ],
)
def test_forwarded_addresses_are_believed_from_proxies_only(
    tight: Deployment, trusted: str, from_host: str, passing: int
) -> None:
    settings = tight.settings.model_copy(update={"trusted_proxies": trusted})

    async def scenario() -> None:
        options = uvicorn_options(Runtime.open(settings))
        app = options["app"]()
        config = uvicorn.Config(**{**options, "app": app, "factory": False, "log_config": None})
        config.load()
        async with app.router.lifespan_context(app):
            codes = [
                (
                    await sent(
                        config.loaded_app,
                        "/nowhere",
                        host=from_host,
                        **{"X-Forwarded-For": f"198.51.100.{number}"},
                    )
                ).status_code
                for number in range(9)
            ]
        assert codes == [404] * passing + [429] * (9 - passing)

    anyio.run(scenario)
