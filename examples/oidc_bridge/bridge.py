"""An OpenID Connect provider whose login is a face: authorization code with PKCE, ES256.

One process. It keeps a login in memory until its ID token is fetched, and nothing of a person who
did not log in. docs/login.md says how to run it and what it leaves to you.
"""

import base64
import hashlib
import hmac
import html
import json
import os
import secrets
import time
import unicodedata
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote_plus, urlencode, urlsplit

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import decode_dss_signature
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartParser
from starlette.middleware.base import RequestResponseEndpoint

from veilface_client import (
    AsyncClient,
    Forbidden,
    LockedOut,
    ServiceError,
    Unauthorized,
    VeilfaceError,
)

ISSUER = os.environ["ISSUER"]
CLIENTS: dict[str, dict[str, str]] = json.loads(os.environ["CLIENTS"])
KEY = load_pem_private_key(Path(os.environ["SIGNING_KEY"]).read_bytes(), None)
MOST_BYTES = 20_000_000
MOST_PHOTOS = 5
LOGIN_S, CODE_S, TOKEN_S = 600, 60, 300
MOST_WAITING, MOST_COOKIE = 10_000, 3500
SECRET = secrets.token_bytes(32)
MultiPartParser.spool_max_size = MOST_BYTES  # no photo in a temporary file

app = FastAPI(openapi_url=None)


@dataclass(frozen=True)
class Asked:
    """What an application asked for, and the login's own number."""

    number: str
    client_id: str
    redirect_uri: str
    challenge: str
    state: str
    nonce: str


@dataclass(frozen=True)
class Granted:
    """Who logged in, for which application."""

    asked: Asked
    subject: str
    at: int


codes: dict[str, Granted] = {}
used: dict[str, bool] = {}
"""Numbers of the logins that succeeded: each gives one code."""


def b64(data: bytes) -> str:
    """Encode base64url without padding."""
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def keep(table: dict[str, Any], name: str, value: object) -> None:
    """Keep what belongs to somebody who logged in; of too many, the oldest goes."""
    while len(table) >= MOST_WAITING:
        del table[next(iter(table))]
    table[name] = value


def ticket(purpose: str, claims: dict[str, Any], seconds: float) -> str:
    """Return claims as a text that only this process can have made."""
    text = b64(json.dumps({**claims, "until": time.time() + seconds}).encode())
    return f"{text}.{b64(hmac.digest(SECRET, f'{purpose}.{text}'.encode(), 'sha256'))}"


def claims_of(purpose: str, given: str) -> dict[str, Any] | None:
    """Return the claims of a ticket; None where it is not ours, or has expired."""
    text, _, mac = given.partition(".")
    expected = b64(hmac.digest(SECRET, f"{purpose}.{text}".encode(), "sha256"))
    if not hmac.compare_digest(mac.encode(), expected.encode()):
        return None
    claims: dict[str, Any] = json.loads(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)))
    return claims if claims.pop("until") > time.time() else None


def public_key() -> dict[str, str]:
    """Return the signing key as a JWK, named by its RFC 7638 thumbprint."""
    numbers = KEY.public_key().public_numbers()
    x, y = (b64(number.to_bytes(32, "big")) for number in (numbers.x, numbers.y))
    key = {"crv": "P-256", "kty": "EC", "x": x, "y": y}
    thumbprint = json.dumps(key, separators=(",", ":"), sort_keys=True).encode()
    return {**key, "kid": b64(hashlib.sha256(thumbprint).digest()), "alg": "ES256", "use": "sig"}


def signed(claims: dict[str, Any]) -> str:
    """Return a JWT."""
    header = {"alg": "ES256", "kid": public_key()["kid"], "typ": "JWT"}
    text = ".".join(b64(json.dumps(part).encode()) for part in (header, claims))
    r, s = decode_dss_signature(KEY.sign(text.encode(), ec.ECDSA(hashes.SHA256())))
    return f"{text}.{b64(r.to_bytes(32, 'big') + s.to_bytes(32, 'big'))}"


def page(told: str, status: int = 200, asked: Asked | None = None) -> HTMLResponse:
    """Return the login form, or a page that only tells something."""
    form = (
        '<form method="post" action="login" enctype="multipart/form-data"><p><label>Name <input '
        'name="name" required autocomplete="username"></label><p><label>One to five photos, better '
        'three <input name="images" type="file" accept="image/*" multiple required></label><p>'
        "<button>Log in</button>"
        "</form>"
    )
    # Browsers hold the redirect that answers the form to this policy too.
    home = f" {'{0.scheme}://{0.netloc}'.format(urlsplit(asked.redirect_uri))}" if asked else ""
    policy = f"default-src 'none'; frame-ancestors 'none'; form-action 'self'{home}"
    body = (
        f'<!doctype html><html lang="en"><title>Log in</title><p role="status">{html.escape(told)}'
    )
    headers = {"Content-Security-Policy": policy, "Cache-Control": "no-store"}
    return HTMLResponse(body + (form if asked else ""), status, headers)


def back(asked: Asked, **told: str) -> RedirectResponse:
    """Return to the application."""
    query = urlencode({**told, **({"state": asked.state} if asked.state else {}), "iss": ISSUER})
    joint = "&" if "?" in asked.redirect_uri else "?"
    return RedirectResponse(asked.redirect_uri + joint + query, 303)


@app.middleware("http")
async def bounded(request: Request, answer: RequestResponseEndpoint) -> Response:
    """Refuse a body that is too large, or does not say how large it is, before it is read."""
    size = request.headers.get("Content-Length", "")
    if request.method == "POST" and not (size.isdecimal() and int(size) <= MOST_BYTES):
        return page("Send photos of at most 20 MB together.", 413)
    return await answer(request)


@app.get("/.well-known/openid-configuration")
async def configuration() -> dict[str, Any]:
    """Tell applications where everything is."""
    return {
        "issuer": ISSUER,
        "authorization_endpoint": f"{ISSUER}/authorize",
        "token_endpoint": f"{ISSUER}/token",
        "userinfo_endpoint": f"{ISSUER}/userinfo",
        "jwks_uri": f"{ISSUER}/jwks",
        "response_types_supported": ["code"],
        "grant_types_supported": ["authorization_code"],
        "subject_types_supported": ["public"],
        "id_token_signing_alg_values_supported": ["ES256"],
        "scopes_supported": ["openid"],
        "code_challenge_methods_supported": ["S256"],
        "token_endpoint_auth_methods_supported": [
            "client_secret_basic",
            "client_secret_post",
            "none",
        ],
        "authorization_response_iss_parameter_supported": True,
    }


@app.get("/jwks")
async def jwks() -> dict[str, Any]:
    """Tell what ID tokens are verified with."""
    return {"keys": [public_key()]}


@app.get("/authorize")
async def authorize(request: Request) -> Response:
    """Begin a login."""
    query = request.query_params
    client = CLIENTS.get(query.get("client_id", ""))
    if client is None or query.get("redirect_uri") != client["redirect_uri"]:
        return page("This application is not known here.", 400)
    asked = Asked(
        secrets.token_urlsafe(16),
        query["client_id"],
        query["redirect_uri"],
        query.get("code_challenge", ""),
        query.get("state", ""),
        query.get("nonce", ""),
    )
    if query.get("response_type") != "code":
        return back(asked, error="unsupported_response_type")
    if "openid" not in query.get("scope", "").split():
        return back(asked, error="invalid_scope")
    if query.get("code_challenge_method") != "S256" or len(asked.challenge) != 43:
        return back(asked, error="invalid_request", error_description="PKCE with S256 is needed")
    # In the browser, not here: nobody's requests push out the logins of others.
    cookie = ticket("login", asdict(asked), LOGIN_S)
    if len(cookie) > MOST_COOKIE:
        return page("The application sent a state or nonce that is too long.", 400)
    answer = page("Log in with your face.", asked=asked)
    answer.set_cookie("login", cookie, LOGIN_S, httponly=True, secure=True, samesite="strict")
    return answer


@app.post("/login")
async def login(request: Request) -> Response:
    """Verify a face, and return to the application with a code."""
    claims = claims_of("login", request.cookies.get("login", ""))
    asked = None if claims is None else Asked(**claims)
    if asked is None or asked.number in used:
        return page("This login has expired. Start again in the application.", 400)
    try:
        async with request.form(max_files=MOST_PHOTOS, max_fields=1) as form:
            name = form.get("name")
            files = [file for file in form.getlist("images") if isinstance(file, UploadFile)]
            if not isinstance(name, str) or not files:
                return page("Give a name and a photo.", 400, asked)
            photos = [await file.read() for file in files]
    except HTTPException:  # too many files, or no such form
        return page("Give a name and a photo. At most five photos.", 400, asked)
    name = unicodedata.normalize("NFC", name)  # as the service reads it: one person, one `sub`
    try:
        async with AsyncClient(
            os.environ["VEILFACE_URL"], os.environ["VEILFACE_API_KEY"]
        ) as veilface:
            accepted = bool(await veilface.verify(name, photos))
    except (Unauthorized, Forbidden):  # our key, not their face
        return page("Logging in by face does not work now.", 502, asked)
    except LockedOut as error:
        return page(f"{error.message}. An administrator can lift the lock.", error.status, asked)
    except ServiceError as error:  # no face in the photo …
        return page(error.message, error.status, asked)
    except ValueError:  # no name that anybody can have
        accepted = False
    except VeilfaceError:
        return page("Logging in by face does not work now.", 502, asked)
    if not accepted:
        return page("Not recognised. Try again.", 401, asked)
    if asked.number in used:  # by a request beside this one
        return page("This login has expired. Start again in the application.", 400)
    keep(used, asked.number, True)
    keep(codes, code := secrets.token_urlsafe(32), Granted(asked, name, int(time.time())))
    answer = back(asked, code=code)
    answer.delete_cookie("login", httponly=True, secure=True, samesite="strict")
    return answer


def client_of(request: Request, sent: dict[str, str]) -> tuple[str, str]:
    """Return the id and secret of the application, of the header or of the form."""
    kind, _, given = request.headers.get("Authorization", "").partition(" ")
    if kind.lower() != "basic":
        return sent.get("client_id", ""), sent.get("client_secret", "")
    try:
        name, _, secret = base64.b64decode(given, validate=True).decode().partition(":")
    except ValueError:
        return "", ""
    return unquote_plus(name), unquote_plus(secret)  # RFC 6749 §2.3.1


@app.post("/token")
async def token(request: Request) -> Response:
    """Change a code into an ID token, once, for the application that asked."""
    async with request.form(max_files=0, max_fields=10) as form:
        sent = {key: value for key, value in form.items() if isinstance(value, str)}
    headers = {"Cache-Control": "no-store"}
    granted = codes.pop(sent.get("code", ""), None)
    client_id, secret = client_of(request, sent)
    client = CLIENTS.get(client_id, {})
    expected = client.get("secret", "").encode()
    if not client or not hmac.compare_digest(expected, secret.encode()):
        return JSONResponse({"error": "invalid_client"}, 401, headers)
    if sent.get("grant_type") != "authorization_code":
        return JSONResponse({"error": "unsupported_grant_type"}, 400, headers)
    now = int(time.time())
    proof = b64(hashlib.sha256(sent.get("code_verifier", "").encode()).digest())
    if (
        granted is None
        or now > granted.at + CODE_S
        or granted.asked.client_id != client_id
        or granted.asked.redirect_uri != sent.get("redirect_uri")
        or not hmac.compare_digest(granted.asked.challenge.encode(), proof.encode())
    ):
        return JSONResponse({"error": "invalid_grant"}, 400, headers)
    claims = {
        "iss": ISSUER,
        "sub": granted.subject,
        "aud": granted.asked.client_id,
        "iat": now,
        "exp": now + TOKEN_S,
        "auth_time": granted.at,
        "amr": ["face"],  # RFC 8176
        **({"nonce": granted.asked.nonce} if granted.asked.nonce else {}),
    }
    access = ticket("access", {"sub": granted.subject}, TOKEN_S)
    answer = {"id_token": signed(claims), "token_type": "Bearer", "expires_in": TOKEN_S}
    return JSONResponse({**answer, "access_token": access}, 200, headers)


@app.api_route("/userinfo", methods=["GET", "POST"])
async def userinfo(request: Request) -> JSONResponse:
    """Tell an application with an access token who logged in."""
    kind, _, given = request.headers.get("Authorization", "").partition(" ")
    claims = claims_of("access", given) if kind.lower() == "bearer" else None
    headers = {"Cache-Control": "no-store"}
    if claims is None:
        headers["WWW-Authenticate"] = 'Bearer error="invalid_token"'
        return JSONResponse({"error": "invalid_token"}, 401, headers)
    return JSONResponse(claims, 200, headers)
