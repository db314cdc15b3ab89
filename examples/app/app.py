"""Accounts with a password first and a face second; of the face, the page sends a private template.

Needs fastapi, uvicorn, both clients (``make javascript``), and what docs/login.md says of the
service.
"""

import hashlib
import hmac
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import uvicorn
from fastapi import Cookie, Depends, FastAPI, HTTPException, Request, Response
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, Field

from veilface_client import Client, NotEnrolled, VeilfaceError

URL = os.environ["VEILFACE_URL"].rstrip("/")
CLIENT = Client(URL, os.environ["VEILFACE_API_KEY"])
HERE = Path(__file__).parent
PACKAGE = HERE.parents[1] / "clients" / "javascript"  # in a project of yours: node_modules
# Of a connection, not of a path: a browser takes a path without a slash at its end for one file.
ORIGIN = "{0.scheme}://{0.netloc}".format(urlsplit(URL))
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; "
    f"connect-src 'self' {ORIGIN}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
app = FastAPI(openapi_url=None)


@dataclass
class Account:
    """Who has an account; Veilface knows them by a random id."""

    name: str
    subject: str
    salt: bytes
    password: bytes


@dataclass
class Session:
    """A browser whose visitor knew the password; `face` once they showed the face too."""

    account: Account
    face: bool = False
    token_id: str | None = None


ACCOUNTS: dict[str, Account] = {}  # yours live in a database
SESSIONS: dict[str, Session] = {}


class Credentials(BaseModel):
    """What a form sends."""

    name: str = Field(pattern=r"^[\w.@-]{1,64}$")
    password: str = Field(min_length=8, max_length=256)


def scrypt(password: str, salt: bytes) -> bytes:
    """Hash a password."""
    return hashlib.scrypt(password.encode(), salt=salt, n=2**15, r=8, p=3, maxmem=2**26)


def open_session(response: Response, session: Session) -> None:
    """Give the browser a session under a new id."""
    SESSIONS[key := secrets.token_urlsafe(24)] = session
    response.set_cookie("session", key, httponly=True, secure=True, samesite="strict")


def session_of(session: Annotated[str, Cookie()] = "") -> Session:
    """Find the session of a request."""
    if session not in SESSIONS:
        raise HTTPException(401, "sign in")
    return SESSIONS[session]


def next_call(subject: str) -> dict[str, str]:
    """Tell the page what to do, and where: enroll where there is no face yet, and else verify."""
    try:
        CLIENT.describe(subject)
    except NotEnrolled:
        return {"service": URL, "action": "enroll"}
    return {"service": URL, "action": "verify"}


HasPassword = Annotated[Session, Depends(session_of)]


@app.exception_handler(VeilfaceError)
async def away(request: Request, error: Exception) -> JSONResponse:  # noqa: ARG001
    """Nobody gets in while the service does not answer."""
    return JSONResponse({"detail": "your face cannot be checked now"}, 502)


@app.post("/register", status_code=201)
def register(sent: Credentials, response: Response) -> dict[str, str]:
    """Make an account."""
    salt = os.urandom(16)
    account = Account(sent.name, secrets.token_hex(16), salt, scrypt(sent.password, salt))
    if ACCOUNTS.setdefault(sent.name, account) is not account:
        raise HTTPException(409, "this name is taken")
    open_session(response, Session(account))
    return {"service": URL, "action": "enroll"}


@app.post("/login")
def login(sent: Credentials, response: Response) -> dict[str, str]:
    """Check a password; in a program of yours, limit the guesses too."""
    account = ACCOUNTS.get(sent.name)
    salt, expected = (bytes(16), bytes(64)) if account is None else (account.salt, account.password)
    right = hmac.compare_digest(scrypt(sent.password, salt), expected)
    if account is None or not right:
        raise HTTPException(401, "wrong name or password")
    asked = next_call(account.subject)
    open_session(response, Session(account))
    return asked


@app.post("/token")
def token(session: HasPassword) -> dict[str, str]:
    """Ask for a token for what is next."""
    subject = session.account.subject
    asked = next_call(subject)
    if asked["action"] == "enroll":
        # The first face only: who holds an older token must not replace it.
        issued = CLIENT.create_token(subject, "enroll", replace=False)
    else:
        issued = CLIENT.create_token(subject, "verify")
    session.token_id = issued.token_id  # it stays here: the page could name another one
    return {**asked, "subject": subject, "token": issued.token}


@app.post("/face")
def face(session: HasPassword, response: Response) -> dict[str, bool | str]:
    """Ask the service what the page did with its token, and let in who is accepted."""
    token_id, subject = session.token_id, session.account.subject
    outcome = CLIENT.token_outcome(subject, token_id).outcome if token_id else None
    session.token_id = None  # it counts once, and stays where the service did not answer
    if outcome not in ("accept", "created"):
        return {"accepted": False, **next_call(subject)}
    open_session(response, Session(session.account, face=True))
    return {"accepted": True, "name": session.account.name}


@app.get("/account")
def account(session: HasPassword) -> dict[str, str]:
    """Show what only password and face together open."""
    if not session.face:
        raise HTTPException(401, "show your face")
    return {"name": session.account.name}


@app.get("/")
def page() -> FileResponse:
    """Show the page."""
    return FileResponse(HERE / "index.html", headers={"Content-Security-Policy": POLICY})


@app.get("/page.js")
def script() -> FileResponse:
    """Its script."""
    return FileResponse(HERE / "page.js")


app.mount("/client", StaticFiles(directory=PACKAGE / "dist"))
app.mount("/ort", StaticFiles(directory=PACKAGE / "node_modules" / "onnxruntime-web" / "dist"))


if __name__ == "__main__":
    uvicorn.run(app, port=int(os.environ.get("PORT", "3000")))
