"""The API key is in no text that this package makes, and goes to the service alone."""

import logging
import traceback
from pathlib import Path

import httpx
import pytest

import veilface_client
from tests.api.deployment import photo
from tests.clients.conftest import Running
from veilface_client import AsyncClient, Client, PrivateClient, VeilfaceError
from veilface_client.results import Enrollable, Export, Generator, Probe

SECRET = "5e" * 32
TOKEN = f"vf_{'0' * 12}_{SECRET}"


def test_the_key_is_in_no_representation(tmp_path: Path) -> None:
    with (
        Client("http://service.test", TOKEN) as client,
        PrivateClient("http://service.test", TOKEN, pack=tmp_path) as private,
    ):
        shown = [
            form(each)
            for form in (repr, str)
            for each in (client, private, AsyncClient("http://service.test", TOKEN))
        ]
        shown += [repr(vars(client)), repr(vars(private))]
    assert "Client('http://service.test')" in shown[0]
    assert not any(SECRET in each for each in shown)


def test_templates_and_exports_are_in_no_representation() -> None:
    marked = b"private-bytes"
    values = [
        Probe(template=marked, contract_id="c"),
        Enrollable(template=marked, contract_id="c"),
        Generator(data=marked, source_id="s"),
        Export(export="private-bytes", contract_id="c", key_id="k", request_id="r"),
    ]
    assert not any("private-bytes" in form(value) for value in values for form in (repr, str))


def test_the_key_is_in_no_log_and_no_error(
    service: Running, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    texts = []
    for url in (service.url, "http://127.0.0.1:9"):
        with Client(url, TOKEN, retries=veilface_client.Retries(sendings=1)) as client:
            with pytest.raises(VeilfaceError) as failed:
                client.verify("anna", photo(1))
            texts.append("".join(traceback.format_exception(failed.value)))
    assert caplog.records, "httpx logs, or this test sees nothing"
    assert not any(SECRET in text for text in [*texts, caplog.text])


@pytest.mark.parametrize("wrong", [f"{TOKEN}\n", f"{TOKEN}\r\nX: y", f" {TOKEN}", f"{TOKEN}ä", ""])
def test_a_key_that_cannot_be_sent_is_refused_without_being_repeated(wrong: str) -> None:
    with pytest.raises(ValueError, match="API key") as refused:
        Client("http://service.test", wrong)
    assert SECRET not in str(refused.value)


@pytest.mark.parametrize(
    "url",
    ["", "service.test", "ftp://service.test", f"https://u:{SECRET}@x", "http://", "http://x/?a=b"],
)
def test_a_url_that_is_none(url: str) -> None:
    with pytest.raises(ValueError, match="URL") as refused:
        Client(url, TOKEN)
    assert SECRET not in str(refused.value)


def test_redirections_are_not_followed() -> None:
    seen = []

    def elsewhere(request: httpx.Request) -> httpx.Response:
        seen.append(str(request.url))
        return httpx.Response(307, headers={"Location": "http://thief.test/"})

    with (
        Client("http://service.test", TOKEN, transport=httpx.MockTransport(elsewhere)) as client,
        pytest.raises(VeilfaceError, match="307"),
    ):
        client.contract()
    assert seen == ["http://service.test/v1/contract"]
