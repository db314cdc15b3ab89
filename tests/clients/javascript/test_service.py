"""The JavaScript client before a real service: photos, private templates, tokens."""

import base64
from collections.abc import Sequence
from typing import Any

from tests.api.deployment import photo, picture
from tests.clients.conftest import Running
from tests.clients.javascript.conftest import Node
from tests.clients.proxy import Proxy


def png(person: int, shot: int = 0) -> dict[str, str]:
    return {"png": base64.b64encode(photo(person, shot)).decode()}


def rgb(person: int, shot: int = 0) -> dict[str, str]:
    return {"rgb": base64.b64encode(picture(person, shot).tobytes()).decode()}


def calls(
    node: Node,
    service: Running,
    steps: Sequence[dict[str, Any]],
    *,
    url: str | None = None,
    **more: Any,
) -> list[dict[str, Any]]:
    """Outcomes of calls, one after the other."""
    return list(
        node(
            "serve.js",
            {
                "url": url or service.url,
                "bearer": service.deployment.token,
                "embedder": str(service.pack / "tiny.onnx"),
                "steps": steps,
                **more,
            },
        )
    )


def test_photos(node: Node, service: Running) -> None:
    key = {"holderKey": {"kept": "holderKey"}}
    enrolled, again, found, wrong, refused, held, keyless, with_key, erased, nobody = calls(
        node,
        service,
        [
            {"kind": "photos", **step}
            for step in (
                {"call": "enroll", "args": ["js-anna", [png(1, 0), png(1, 1)]]},
                {"call": "enroll", "args": ["js-anna", [png(1)], {"replace": False}]},
                {"call": "verify", "args": ["js-anna", [png(1, 2)], {"level": "fmr-1e-3"}]},
                {"call": "verify", "args": ["js-anna", [png(2)]]},
                {"call": "verify", "args": ["js-anna", [{"png": "AAAA"}]]},
                {"call": "enroll", "args": ["js-emil", [png(3)], key]},
                {"call": "verify", "args": ["js-emil", [png(3, 1)]]},
                {"call": "describe", "args": ["js-emil"]},
                {"call": "erase", "args": ["js-anna"]},
                {"call": "describe", "args": ["js-anna"]},
            )
        ],
    )
    assert enrolled["value"]["replaced"] is False
    assert len(enrolled["value"]["images"]) == 2
    assert again["code"] == "enrollment_conflict"
    assert again["details"]["template_id"] == enrolled["value"]["template_id"]
    assert (found["value"]["accepted"], found["value"]["level"]) == (True, "fmr-1e-3")
    assert (wrong["value"]["accepted"], wrong["value"]["reason"]) == (False, "no_match")
    assert (refused["status"], refused["code"]) == (400, "unsupported_image")
    assert held["value"]["holder_key"] is True
    assert keyless["value"]["accepted"] is False
    assert with_key["value"]["holder_key"] is True
    assert erased["value"]["claims"]["held"] is True
    assert (nobody["code"], nobody["status"]) == ("not_enrolled", 404)


def test_private_templates(node: Node, service: Running) -> None:
    """Lifted in Node, decided by the service; nothing that was sent has a picture in it."""
    token = service.deployment.token
    key = {"holderKey": {"kept": "holderKey"}}
    probe = {"kept": "probe"}
    with Proxy(service.port) as proxy:
        outcomes = calls(
            node,
            service,
            [
                {"call": "enroll", "args": ["js-bert", [rgb(4, 0), rgb(4, 1)], key]},
                {"call": "describe", "args": ["js-bert"]},
                {"call": "lift", "args": [[rgb(4, 2)]], "keep": "probe"},
                {"call": "verify", "args": ["js-bert", probe, key]},
                {
                    "call": "verify",
                    "args": ["js-bert", probe, {**key, "level": "fmr-1e-2"}],
                },
                {"call": "verify", "args": ["js-bert", probe]},
                {"call": "verify", "args": ["js-bert", [rgb(5)], key]},
                {"call": "enroll", "args": ["js-bert", [rgb(4), rgb(5)], key]},
            ],
            url=proxy.url,
        )
        sent = proxy.sent
    enrolled, described, probe, found, levelled, keyless, wrong, two = outcomes
    assert enrolled["value"]["images"] == []
    assert described["value"]["enrolled_by"] == "template"
    assert "template" not in probe["shown"]
    assert found["value"]["accepted"] is True
    assert levelled["value"]["level"] == "fmr-1e-2"
    assert keyless["value"]["accepted"] is False
    assert wrong["value"]["accepted"] is False
    assert two["code"] == "inconsistent_images"
    assert "status" not in two, "it was found before anything was sent"
    assert all(token not in str(outcome) for outcome in outcomes)
    assert sent.count(b"GET /v1/contract/generator") == 1, "fetched once, and kept"
    for shot in range(3):
        pixels = picture(4, shot).tobytes()
        assert pixels[:64] not in sent
        assert base64.b64encode(pixels)[:64] not in sent


def test_tokens(node: Node, service: Running) -> None:
    """A backend asks for a token, a page uses it once, and the backend asks what came of it."""
    page, probe = {"as": "token"}, {"kept": "probe"}
    steps: list[dict[str, Any]] = [
        {"call": "enroll", "args": ["js-dora", [rgb(7, 0), rgb(7, 1)]]},
        {"call": "token", "args": ["js-dora", {"action": "verify"}], "keep": "token"},
        {**page, "call": "lift", "args": [[rgb(7, 2)]], "keep": "probe"},
        {**page, "call": "verify", "args": ["js-dora", probe]},
        {**page, "call": "verify", "args": ["js-dora", probe]},
        {**page, "call": "verify", "args": ["js-dora", [rgb(7, 2)]]},
        {**page, "call": "describe", "args": ["js-dora"]},
    ]
    _, made, _, first, repeated, another, described = calls(node, service, steps)
    assert "vft_" not in made["shown"]
    assert first["value"]["accepted"] is True
    for second in (repeated, another):
        assert second["code"] == "replayed"
    assert described["code"] == "forbidden"
    (outcome,) = calls(
        node, service, [{"call": "tokenOutcome", "args": ["js-dora", made["value"]["token_id"]]}]
    )
    assert (outcome["value"]["used"], outcome["value"]["outcome"]) == (True, "accept")
