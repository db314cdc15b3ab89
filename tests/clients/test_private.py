"""The private clients: real lifts, for a service that has no pack."""

import asyncio
import io
import time
from pathlib import Path

import httpx
import pytest

from templates.keys.probe_signature import sign_probe
from tests.api.deployment import photo
from tests.clients.conftest import Running
from tests.clients.proxy import Proxy
from veilface_client import (
    AsyncPrivateClient,
    ConnectionFailed,
    PrivateClient,
    Retries,
    new_holder_key,
)
from veilface_client.signature import signed_probe

TOKEN = f"vf_{'0' * 12}_{'5e' * 32}"


def test_enrolled_and_verified_without_a_photo_leaving(packless: Running, tmp_path: Path) -> None:
    path = tmp_path / "anna.png"
    path.write_bytes(photo(1, 1))
    with (
        Proxy(packless.port) as proxy,
        PrivateClient(
            proxy.url,
            packless.deployment.token,
            pack=packless.pack,
            retries=Retries(first_s=0.01),
        ) as client,
    ):
        client.contract()
        enrolled = client.enroll("anna", [photo(1, 0), path])
        assert (enrolled.replaced, enrolled.images) == (False, ())
        assert client.describe("anna").enrolled_by == "template"

        probe = client.lift([photo(1, 2), io.BytesIO(photo(1, 3))])
        assert client.verify("anna", probe, level="fmr-1e-2").level == "fmr-1e-2"
        assert client.verify("anna", probe), "signed anew, else it would be replayed"
        assert not client.verify("anna", photo(2))

        held = client.enroll("anna", [photo(1, 0), path], storage="holder").held_template
        assert client.verify("anna", probe, held_template=held)
        assert not client.verify("anna", probe)
        sent = proxy.sent
    assert sent.count(b"GET /v1/contract/generator") == 1, "fetched once, and kept"


def test_asynchronously(packless: Running) -> None:
    async def scenario() -> None:
        async with AsyncPrivateClient(
            packless.url, packless.deployment.token, pack=packless.pack
        ) as client:
            key, probe = new_holder_key(), await client.lift(photo(1, 2))
            enrolled = await client.enroll("emil", [photo(1, 0), photo(1, 1)], holder_key=key)
            assert enrolled.holder_key
            assert await client.verify("emil", probe, holder_key=key)
            assert not await client.verify("emil", probe)
            assert (await client.erase("emil")).held

    asyncio.run(scenario())


def test_an_enrollment_is_repeated_with_its_lift(packless: Running) -> None:
    with Proxy(packless.port) as proxy:
        client = PrivateClient(
            proxy.url,
            packless.deployment.token,
            pack=packless.pack,
            retries=Retries(sendings=1),
        )
        with client:
            lift = client.lift_enrollment([photo(1, 0), photo(1, 1)])
            proxy.lose = 1
            with pytest.raises(ConnectionFailed) as failed:
                client.enroll("once", lift)
            assert failed.value.sent
            assert failed.value.lift is lift
            enrolled = client.enroll("once", lift)
            described = client.describe("once")
            assert enrolled.replaced, "what the first sending wrote"
            assert described.template_id == enrolled.template_id
            assert not client.enroll("twice", lift).replaced, "another subject, the same lift"
            client.erase("once")
            assert not client.enroll("once", lift).replaced, "erased: it is a new write"


@pytest.mark.parametrize("level", [None, "fmr-1e-3"])
def test_signatures_are_those_of_the_service(level: str | None) -> None:
    begun = time.time()
    body = signed_probe(TOKEN, "anna", b"template", level=level)
    assert int(begun) <= body["timestamp"] <= time.time()
    again = sign_probe(
        TOKEN, "anna", b"template", level=level, nonce=body["nonce"], timestamp=body["timestamp"]
    )
    assert body["hmac"] == again.hmac
    assert signed_probe(TOKEN, "anna", b"template")["nonce"] != body["nonce"]


def test_a_captured_probe_is_of_no_use(packless: Running) -> None:
    """The service refuses the very request that it has decided."""
    with Proxy(packless.port) as proxy:
        token = packless.deployment.token
        client = PrivateClient(proxy.url, token, pack=packless.pack)
        with client:
            client.enroll("dora", [photo(1, 0), photo(1, 1)])
            proxy.forget()
            client.verify("dora", photo(1, 2))
            body = proxy.sent.split(b"\r\n\r\n")[1].split(b"\n")[0]
            sent = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
            again = httpx.post(
                f"{packless.url}/v1/subjects/dora/verify", content=body, headers=sent
            )
    assert again.json()["error"]["code"] == "replayed"
