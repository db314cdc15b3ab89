"""The OpenID Connect bridge before a real service, as an application and a browser see it."""

import base64
import hashlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from tests.examples.conftest import EXAMPLES, PYTHON, Service, clean_environment, running
from tests.patience import PATIENCE_S
from tests.ports import free_port
from veilface_client import Client

CALLBACK = "https://wiki.example.org/callback"
VERIFIER = "v" * 64
CHALLENGE = (
    base64.urlsafe_b64encode(hashlib.sha256(VERIFIER.encode()).digest()).rstrip(b"=").decode()
)
ASKED = {
    "response_type": "code",
    "client_id": "wiki",
    "redirect_uri": CALLBACK,
    "scope": "openid",
    "state": "of & mine",
    "nonce": "once",
    "code_challenge": CHALLENGE,
    "code_challenge_method": "S256",
}


def write_key(path: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


@pytest.fixture(scope="module")
def bridge(service: Service, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("bridge")
    write_key(folder / "key.pem")
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    clients = {"wiki": {"redirect_uri": CALLBACK, "secret": "s3cret"}, "app": {
        "redirect_uri": "https://app.example.org/cb?x=1"}}  # fmt: skip
    env = clean_environment(
        ISSUER=url, CLIENTS=json.dumps(clients), SIGNING_KEY=str(folder / "key.pem"),
        VEILFACE_URL=service.url, VEILFACE_API_KEY=service.verifying,
    )  # fmt: skip
    arguments = [
        PYTHON, "-m", "uvicorn", "--app-dir", str(EXAMPLES / "oidc_bridge"), "bridge:app",
        "--port", str(port),
    ]  # fmt: skip
    with (
        running(arguments, url, env, folder / "log"),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
    ):
        yield client


def begin(bridge: httpx.Client, **changes: str) -> str:
    """Begin a login; return the cookie, which httpx would keep to https."""
    answer = bridge.get("/authorize", params=ASKED | changes)
    assert answer.status_code == 200, answer.text
    policy = answer.headers["Content-Security-Policy"]
    assert policy.endswith("form-action 'self' https://wiki.example.org")
    cookie, *attributes = answer.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "Secure", "SameSite=strict"} <= set(attributes)
    return cookie


def show(bridge: httpx.Client, cookie: str, name: str, photo: bytes) -> httpx.Response:
    return bridge.post(
        "/login", data={"name": name}, files={"images": photo}, headers={"Cookie": cookie}
    )


def returned(answer: httpx.Response) -> dict[str, str]:
    assert answer.status_code == 303, answer.text
    location = urlsplit(answer.headers["Location"])
    assert f"{location.scheme}://{location.netloc}{location.path}" == CALLBACK
    return {name: value for name, (value,) in parse_qs(location.query).items()}


def change(bridge: httpx.Client, code: str, **changes: str) -> httpx.Response:
    sent = {
        "grant_type": "authorization_code", "code": code, "redirect_uri": CALLBACK,
        "client_id": "wiki", "client_secret": "s3cret", "code_verifier": VERIFIER,
    }  # fmt: skip
    return bridge.post("/token", data=sent | changes)


def decoded(part: str) -> bytes:
    return base64.urlsafe_b64decode(part + "=" * (-len(part) % 4))


def encoded(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def code_of(bridge: httpx.Client, service: Service) -> str:
    told = returned(show(bridge, begin(bridge), "ann", service.photo(1, 4)))
    assert (told["state"], told["iss"]) == ("of & mine", str(bridge.base_url).rstrip("/"))
    return told["code"]


def test_a_face_becomes_an_id_token(bridge: httpx.Client, service: Service) -> None:
    before = int(time.time())
    answer = change(bridge, code := code_of(bridge, service))
    assert answer.status_code == 200, answer.text
    assert answer.headers["Cache-Control"] == "no-store"
    head, body, signature = answer.json()["id_token"].split(".")
    known = bridge.get("/.well-known/openid-configuration").json()
    (key,) = bridge.get(known["jwks_uri"]).json()["keys"]
    header = json.loads(decoded(head))
    assert (header["alg"], header["kid"]) == ("ES256", key["kid"])
    point = (int.from_bytes(decoded(key[axis]), "big") for axis in ("x", "y"))
    public = ec.EllipticCurvePublicNumbers(*point, ec.SECP256R1()).public_key()
    raw = decoded(signature)
    assert len(raw) == 64
    der = encode_dss_signature(int.from_bytes(raw[:32], "big"), int.from_bytes(raw[32:], "big"))
    public.verify(der, f"{head}.{body}".encode(), ec.ECDSA(hashes.SHA256()))
    claims = json.loads(decoded(body))
    assert claims["iss"] == known["issuer"]
    assert (claims["sub"], claims["aud"], claims["nonce"]) == ("ann", "wiki", "once")
    assert claims["amr"] == ["face"]
    assert before <= claims["auth_time"] <= claims["iat"] < claims["exp"]
    again = change(bridge, code)
    assert (again.status_code, again.json()) == (400, {"error": "invalid_grant"}), "once"
    who = bridge.get(known["userinfo_endpoint"], headers=bearer(answer.json()["access_token"]))
    assert (who.status_code, who.json()) == (200, {"sub": "ann"})
    assert who.headers["Cache-Control"] == "no-store"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def test_userinfo_is_for_access_tokens_alone(bridge: httpx.Client, service: Service) -> None:
    told = change(bridge, code_of(bridge, service)).json()
    text, mac = told["access_token"].split(".")
    forged = encoded(decoded(text).replace(b"ann", b"bob"))
    _, _, login = begin(bridge).partition("=")
    tokens = (
        "guessed",
        told["id_token"],
        login,
        text,
        f"{text}.",
        f"{forged}.{mac}",
        "\u00e9.a",
    )
    for headers in ({}, *(bearer(token) for token in tokens)):
        sent = {name: value.encode() for name, value in headers.items()}
        for answer in (
            bridge.get("/userinfo", headers=sent),
            bridge.post("/userinfo", headers=sent),
        ):
            assert (answer.status_code, answer.json()) == (401, {"error": "invalid_token"})
            assert answer.headers["WWW-Authenticate"] == 'Bearer error="invalid_token"'
    assert bridge.post("/userinfo", headers=bearer(told["access_token"])).json() == {"sub": "ann"}


def test_another_face_gets_no_code(bridge: httpx.Client, service: Service) -> None:
    cookie = begin(bridge)
    wrong = show(bridge, cookie, "ann", service.photo(2, 0))
    nobody = show(bridge, cookie, "nobody", service.photo(1, 4))
    impossible = show(bridge, cookie, "../ann", service.photo(1, 4))
    for answer in (wrong, nobody, impossible):
        assert answer.status_code == 401
        assert answer.text == wrong.text
        assert "Location" not in answer.headers
    assert show(bridge, cookie, "ann", b"no picture").status_code == 400
    # And the right one may try again.
    assert "code" in returned(show(bridge, cookie, "ann", service.photo(1, 4)))
    assert show(bridge, cookie, "ann", service.photo(1, 4)).status_code == 400, "used up"
    with Client(service.url, service.token) as client:
        client.reset_lockout("ann")


def test_a_login_belongs_to_its_browser(bridge: httpx.Client, service: Service) -> None:
    begin(bridge)
    _, _, ours = begin(bridge).partition("=")
    text, mac = ours.split(".")
    asked = json.loads(decoded(text)) | {"redirect_uri": "https://evil.example.org/"}
    forged = encoded(json.dumps(asked).encode())
    cookies = ("", "login=", "login=guessed", f"login={text}.", f"login={forged}.{mac}")
    access = change(bridge, code_of(bridge, service)).json()["access_token"]
    for cookie in (*cookies, f"login={access}"):
        answer = show(bridge, cookie, "ann", service.photo(1, 4))
        assert answer.status_code == 400
        assert "Location" not in answer.headers


@pytest.mark.parametrize(
    "changes",
    [{"client_id": "other"}, {"redirect_uri": f"{CALLBACK}/more"},
     {"redirect_uri": "https://evil.example.org/"}, {"client_id": "app"}],
)  # fmt: skip
def test_nobody_is_sent_to_a_stranger(bridge: httpx.Client, changes: dict[str, str]) -> None:
    answer = bridge.get("/authorize", params=ASKED | changes)
    assert answer.status_code == 400
    assert "Location" not in answer.headers
    assert "Set-Cookie" not in answer.headers


@pytest.mark.parametrize(
    ("changes", "status", "error"),
    [({"code_verifier": "w" * 64}, 400, "invalid_grant"), ({"client_secret": ""}, 401,
     "invalid_client"), ({"client_id": "app", "client_secret": ""}, 400, "invalid_grant"),
     ({"redirect_uri": "https://evil.example.org/"}, 400, "invalid_grant"),
     ({"grant_type": "password"}, 400, "unsupported_grant_type")],
)  # fmt: skip
def test_a_code_is_for_who_asked_and_is_burnt_by_others(
    bridge: httpx.Client, service: Service, changes: dict[str, str], status: int, error: str
) -> None:
    code = code_of(bridge, service)
    refused = change(bridge, code, **changes)
    assert (refused.status_code, refused.json()) == (status, {"error": error})
    assert change(bridge, code).json() == {"error": "invalid_grant"}
