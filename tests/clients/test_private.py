"""The private client: real lifts, for a service that has no pack."""

import io
from pathlib import Path

from tests.api.deployment import photo
from tests.clients.conftest import Running
from tests.clients.proxy import Proxy
from veilface_client import PrivateClient, new_holder_key


def test_enrolled_and_verified_without_a_photo_leaving(packless: Running, tmp_path: Path) -> None:
    path = tmp_path / "anna.png"
    path.write_bytes(photo(1, 1))
    key = new_holder_key()
    with (
        Proxy(packless.port) as proxy,
        PrivateClient(proxy.url, packless.deployment.token, pack=packless.pack) as client,
    ):
        client.contract()
        lift = client.lift_enrollment([photo(1, 0), path])
        enrolled = client.enroll("anna", lift, holder_key=key)
        assert (enrolled.replaced, enrolled.images, enrolled.holder_key) == (False, (), True)
        again = client.enroll("anna", lift, holder_key=key)
        assert again.replaced
        described = client.describe("anna")
        assert (described.enrolled_by, described.template_id) == ("template", again.template_id)

        probe = client.lift([photo(1, 2), io.BytesIO(photo(1, 3))])
        verified = client.verify("anna", probe, level="fmr-1e-2", holder_key=key)
        assert (verified.accepted, verified.level) == (True, "fmr-1e-2")
        assert not client.verify("anna", probe)
        assert not client.verify("anna", photo(2), holder_key=key)
        assert client.erase("anna").held
        sent = proxy.sent
    assert sent.count(b"GET /v1/contract/generator") == 1, "fetched once, and kept"
