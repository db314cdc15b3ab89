"""Both clients against a running service: every call."""

import asyncio
import inspect
import io
from pathlib import Path
from typing import Any

import pytest

from tests.api.cli.conftest import run
from tests.api.deployment import make_source, photo
from tests.clients.conftest import Running
from veilface_client import (
    AsyncClient,
    Client,
    EnrollmentConflict,
    Forbidden,
    LockedOut,
    NotEnrolled,
    PhotoRefused,
    ServiceError,
    Unauthorized,
    new_holder_key,
)


def test_a_person_from_enrollment_to_receipt(service: Running, token: str, tmp_path: Path) -> None:
    path = tmp_path / "anna.png"
    path.write_bytes(photo(1, 1))
    with Client(service.url, token) as client:
        first = client.enroll("anna", [photo(1, 0), path, io.BytesIO(photo(1, 2))])
        assert not first.replaced
        assert [image.index for image in first.images] == [0, 1, 2]
        assert client.enroll("anna", path, attributes={"gender": "Female"}, face="single").replaced

        with path.open("rb") as file:
            accepted = client.verify("anna", file, level="fmr-1e-2")
        assert accepted
        assert (accepted.decision, accepted.level, accepted.fmr) == ("accept", "fmr-1e-2", 0.01)
        assert accepted.distance is not None, "the key has the right scores"
        assert client.verify("anna", str(path)).accepted
        assert client.verify("anna", [photo(1, 3), io.BytesIO(photo(1, 4)), path])
        assert client.compare(photo(1), path, level="fmr-1e-2").level == "fmr-1e-2"
        assert not client.compare(path, photo(2))
        rejected = client.verify("anna", photo(2, 0))
        assert not rejected
        assert rejected.reason == "no_match"

        described = client.describe("anna")
        assert (described.subject_id, described.photos, described.current) == ("anna", 1, True)
        assert client.ready().status == "ok"

        contract = client.contract()
        assert client.generator().source_id == contract.binding["decoy_source_id"]
        assert client.generator().data == make_source().to_bytes()

        receipt = client.erase("anna")
        assert receipt.held
        assert client.erase("anna").receipt == receipt.receipt
        with pytest.raises(NotEnrolled):
            client.describe("anna")

    receipt.save(tmp_path / "receipt.json")
    contract.save(tmp_path / "contract.json")
    saved = (tmp_path / "receipt.json", "--public-key", tmp_path / "contract.json")
    assert run("keys", "verify-receipt", *saved).status == 0
    forged = receipt.raw.replace(b'\\"held\\":true', b'\\"held\\":false')
    assert forged != receipt.raw
    (tmp_path / "receipt.json").write_bytes(forged)
    assert run("keys", "verify-receipt", *saved).status != 0


def test_an_enrollment_replaces_what_it_may(service: Running, token: str) -> None:
    with Client(service.url, token) as client:
        with pytest.raises(EnrollmentConflict, match="or has none"):
            client.enroll("ida", photo(1), replace="0" * 32)
        first = client.enroll("ida", photo(1), replace=False)
        with pytest.raises(EnrollmentConflict) as refused:
            client.enroll("ida", photo(1), replace=False)
        assert refused.value.details == {"template_id": first.template_id}
        second = client.enroll("ida", photo(1), replace=first.template_id)
        assert second.template_id != first.template_id
        client.erase("ida")


def test_an_enrollment_that_needs_its_holders_key(service: Running, token: str) -> None:
    key, other = new_holder_key(), new_holder_key()
    with Client(service.url, token) as client:
        assert client.enroll("kept", photo(7), holder_key=key).holder_key
        assert client.describe("kept").holder_key
        assert client.verify("kept", photo(7, 1), holder_key=key)
        for wrong in (other, None):
            assert not client.verify("kept", photo(7, 1), holder_key=wrong)
        assert not client.enroll("kept", photo(7)).holder_key
        assert client.verify("kept", photo(7, 1), holder_key=other)
        client.erase("kept")


def test_export_and_import(service: Running, token: str) -> None:
    with Client(service.url, token) as client:
        client.enroll("carl", photo(3))
        assert client.enroll("Zoe\u0308", photo(1)).replaced is False
        assert client.describe("Zo\xeb").subject_id == "Zo\xeb"
        client.erase("Zo\xeb")
        exported = client.export("carl")
        client.erase("carl")
        imported = client.import_(exported)
        assert (imported.subject_id, imported.replaced) == ("carl", False)
        assert client.import_(exported.export).replaced
        assert client.verify("carl", photo(3, 1))
        client.erase("carl")


def test_pages_hold_everybody_once(service: Running, token: str) -> None:
    names = [f"page-{index}" for index in range(5)]
    with Client(service.url, token) as client:
        for name in names:
            client.enroll(name, photo(4))
        page = client.page(limit=2)
        assert len(page.subjects) == 2
        assert page.next_cursor is not None
        assert client.page(limit=2, cursor=page.next_cursor).subjects != page.subjects
        found = [subject.subject_id for subject in client.subjects(page_size=2)]
        for name in names:
            client.erase(name)
    assert sorted(found) == found
    assert [name for name in found if name.startswith("page-")] == names


def test_a_lockout_and_its_reset(service: Running, token: str) -> None:
    with Client(service.url, token) as client:
        client.enroll("dora", photo(5))
        with pytest.raises(ServiceError, match="not_found"):
            client.lockout("dora")
        for _ in range(5):
            assert not client.verify("dora", photo(6))
        with pytest.raises(LockedOut) as locked:
            client.verify("dora", photo(5))
        assert locked.value.retry_after is not None
        assert 0 < locked.value.retry_after <= 30
        assert locked.value.details == {"disabled": False}
        assert client.lockout("dora").consecutive_failures == 5
        assert client.reset_lockout("dora").lifted
        assert client.verify("dora", photo(5))
        assert not client.reset_lockout("dora").lifted
        client.erase("dora")


def test_asynchronously(service: Running, token: str, tmp_path: Path) -> None:
    path = tmp_path / "emil.png"
    path.write_bytes(photo(7))

    async def scenario() -> None:
        async with AsyncClient(service.url, token) as client:
            enrolled = await client.enroll("emil", [path, photo(7, 1)])
            assert len(enrolled.images) == 2
            answers = await asyncio.gather(
                client.verify("emil", [photo(7, 2), path]), client.verify("emil", photo(8))
            )
            assert [bool(each) for each in answers] == [True, False]
            await client.enroll("fred", path)
            found = [each.subject_id async for each in client.subjects(page_size=1)]
            assert {"emil", "fred"} <= set(found)
            assert len(set(found)) == len(found)
            for subject in ("emil", "fred"):
                assert (await client.erase(subject)).held
            with pytest.raises(NotEnrolled):
                await client.describe("emil")

    asyncio.run(scenario())


def test_a_token_is_used_once_and_its_outcome_is_told(service: Running, token: str) -> None:
    with Client(service.url, token) as server:
        late = server.create_token("tina", "enroll", replace=False)
        writing = server.create_token("tina", "enroll")
        with Client(service.url, writing.token) as page:
            assert not page.enroll("tina", photo(1)).replaced
            with pytest.raises(Unauthorized, match="used before"):
                page.enroll("tina", photo(2))
        with Client(service.url, late.token) as page, pytest.raises(EnrollmentConflict):
            page.enroll("tina", photo(2))
        assert server.token_outcome("tina", writing.token_id).outcome == "created"
        for person in (1, 2):
            issued = server.create_token("tina", "verify", level="fmr-1e-3", lifetime_s=60)
            assert issued.token not in repr(issued)
            assert not server.token_outcome("tina", issued.token_id).used
            with Client(service.url, issued.token) as page:
                assert bool(page.verify("tina", photo(person, 3))) is (person == 1)
            outcome = server.token_outcome("tina", issued.token_id)
            assert (bool(outcome), outcome.level) == (person == 1, "fmr-1e-3")
        server.erase("tina")


def test_an_error_says_which_photo_and_which_right(service: Running, token: str) -> None:
    with Client(service.url, token) as client:
        with pytest.raises(PhotoRefused) as refused:
            client.enroll("fritz", [photo(9), b"no picture at all"])
        assert (refused.value.code, refused.value.details["image"]) == ("unsupported_image", 1)
        assert refused.value.request_id is not None
    with Client(service.url, service.deployment.key("verify")) as client:
        with pytest.raises(Forbidden) as forbidden:
            client.enroll("fritz", photo(9))
        assert forbidden.value.details["missing"] == ["enroll"]


@pytest.mark.parametrize(
    ("call", "arguments", "message"),
    [
        *(("describe", (subject,), "subject id") for subject in ("", ".", "..", "a/b", "../x")),
        ("verify", ("a/b", b"x"), "subject id"),
        *(("verify", ("anna", each), "a photo") for each in (b"", io.StringIO("text"), 3)),
        ("enroll", ("anna", []), "at least one"),
    ],
)
def test_what_cannot_be_sent_is_refused_here(
    call: str, arguments: tuple[Any, ...], message: str
) -> None:
    with (
        Client("http://127.0.0.1:9", "vf_x") as client,
        pytest.raises((ValueError, TypeError), match=message),
    ):
        getattr(client, call)(*arguments)


def test_a_file_that_is_absent() -> None:
    with (
        Client("http://127.0.0.1:9", "vf_x") as client,
        pytest.raises(FileNotFoundError),
    ):
        client.verify("anna", "there/is/no.jpg")


def test_both_have_the_same_calls() -> None:
    def calls(kind: type) -> dict[str, list[tuple[str, object]]]:
        return {
            name: [
                (each.name, each.default)
                for each in inspect.signature(getattr(kind, name)).parameters.values()
            ]
            for name in dir(kind)
            if not name.startswith("_") and callable(getattr(kind, name))
        }

    assert calls(Client) == calls(AsyncClient)
    assert {"enroll", "verify", "erase", "subjects"} <= calls(Client).keys()
