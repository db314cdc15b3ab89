"""The private clients: real lifts, for a service that has no pack."""

import io
from pathlib import Path

import pytest

from tests.api.deployment import photo
from tests.clients.conftest import Running
from tests.clients.proxy import Proxy
from veilface_client import (
    ConnectionFailed,
    PrivateClient,
    Retries,
    new_holder_key,
)

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
        ) as client,
    ):
        client.contract()
        enrolled = client.enroll("anna", [photo(1, 0), path])
        assert (enrolled.replaced, enrolled.images) == (False, ())
        assert client.describe("anna").enrolled_by == "template"

        probe = client.lift([photo(1, 2), io.BytesIO(photo(1, 3))])
        assert client.verify("anna", probe, level="fmr-1e-2").level == "fmr-1e-2"
        assert client.verify("anna", probe)
        assert not client.verify("anna", photo(2))

        sent = proxy.sent
    assert sent.count(b"GET /v1/contract/generator") == 1, "fetched once, and kept"


def test_a_holders_key_locks_a_lift(packless: Running) -> None:
    with PrivateClient(packless.url, packless.deployment.token, pack=packless.pack) as client:
        key, probe = new_holder_key(), client.lift(photo(1, 2))
        assert client.enroll("emil", [photo(1, 0), photo(1, 1)], holder_key=key).holder_key
        assert client.verify("emil", probe, holder_key=key)
        assert not client.verify("emil", probe)
        assert client.erase("emil").held


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
