"""What clients do to the service over real sockets, and what became of each request."""

import itertools
import json
import math
import secrets
import threading
import time
from dataclasses import dataclass, field
from typing import Any, Literal

import httpx
import numpy as np
from numpy.typing import NDArray

from api.http.requests import LONGEST_S
from api.http.tokens import SubjectToken, ends_in
from api.service.opening import open_keyring, open_store
from models.pack import ModelPack
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.server_process import Server
from tests.patience import PATIENCE_S

Kind = Literal["enroll", "erase", "verify", "describe", "contract"]

TIMEOUT_S = PATIENCE_S
SETTLES_S = 30.0
"""Seconds in which a database may still finish what a killed worker asked of it."""

NOT_SENT = "not sent"
LOST = "connection lost"


@dataclass(eq=False)
class Operation:
    """One request.

    Attributes
    ----------
    started, answered
        Moments on the monotonic clock.
    over
        Moment after which it cannot take effect any more.
    outcome
        HTTP status, or :data:`NOT_SENT` or :data:`LOST`.
    token
        What it was sent with.
    """

    kind: Kind
    subject: str
    person: int | None
    request_id: str
    started: float
    answered: float = math.inf
    over: float = math.inf
    outcome: int | str = LOST
    code: str | None = None
    retry_after: str | None = None
    answer: dict[str, Any] = field(default_factory=dict, repr=False)
    token: str = field(default="", repr=False)

    @property
    def answered_well(self) -> bool:
        """Whether a success was answered; for a description, that there is nobody counts too."""
        return self.outcome in (200, 201) or (self.kind == "describe" and self.outcome == 404)

    @property
    def writes(self) -> bool:
        """Whether it is an enrollment or an erasure."""
        return self.kind in ("enroll", "erase")

    @property
    def may_have_happened(self) -> bool:
        """Whether there was no good answer, and it may have taken effect nevertheless."""
        unsure = self.outcome == LOST or (self.outcome in (500, 503) and self.code != "overloaded")
        return not self.answered_well and unsure

    @property
    def template_id(self) -> str | None:
        """Of an enrollment or a description."""
        return self.answer.get("template_id")

    @property
    def replaced(self) -> bool | None:
        """Of an enrollment."""
        return self.answer.get("replaced")

    @property
    def accepted(self) -> bool:
        """Of a verification."""
        return self.answer.get("decision") == "accept"

    @property
    def receipt(self) -> dict[str, Any]:
        """Of an erasure: the signed receipt."""
        receipt: dict[str, Any] = self.answer["receipt"]
        return receipt

    @property
    def receipt_id(self) -> str:
        """Of an erasure."""
        return str(json.loads(self.receipt["body"])["receipt_id"])

    @property
    def held(self) -> bool:
        """Of an erasure: whether its receipt says that there was a template."""
        return bool(json.loads(self.receipt["body"])["held"])

    @property
    def seconds(self) -> float:
        """How long the client waited."""
        return self.answered - self.started

    def __str__(self) -> str:
        return (
            f"{self.kind} {self.subject} person {self.person} request {self.request_id}: "
            f"{self.outcome} {self.code or ''} {self.template_id or ''}"
        )


class People:
    """Photos and embeddings of drawn people; computed once."""

    def __init__(self, deployment: Deployment, people: list[int]) -> None:
        assert deployment.settings.pack is not None
        pack = ModelPack.load(deployment.settings.pack, threads=1)
        self.photos = {each: photo(each) for each in people}
        self.embeddings: dict[int, NDArray[np.float32]] = {
            each: pack.embed_photo(photo(each, 3)).embedding for each in people
        }


class Tokens:
    """One key for each task; the one that verifies is not told who is enrolled."""

    def __init__(self, deployment: Deployment) -> None:
        self.enroll = deployment.key("enroll")
        self.erase = deployment.key("erase")
        self.verify = deployment.key("verify", "embeddings")
        self._keyring = open_keyring(deployment.settings)
        store = open_store(deployment.settings, self._keyring)
        try:
            key = store.api_keys.verify(self.verify)
        finally:
            store.close()
        assert key is not None
        self._key = key

    def once(self, subject: str) -> str:
        """Make a token as ``POST /v1/tokens`` does, without a request: for one verification."""
        token = SubjectToken(
            subject=subject,
            action="verify",
            level=None,
            key_prefix=self._key.prefix,
            expires_at=ends_in(LONGEST_S),
        )
        return token.text(self._keyring, key_id=self._key.id)


class Clients:
    """Sends requests from any number of threads and keeps what became of them.

    Every request opens a connection, so that any worker may get it.
    """

    def __init__(self, service: Server, people: People) -> None:
        self.service = service
        self.tokens = Tokens(service.deployment)
        self.history: list[Operation] = []
        self.replays: list[tuple[Operation, Operation]] = []
        self._people = people
        self._local = threading.local()
        self._numbers = itertools.count()

    def enroll(self, subject: str, person: int) -> Operation:
        """Enroll or replace by a photo."""
        return self._send(
            "enroll",
            subject,
            person,
            "PUT",
            f"/v1/subjects/{subject}/enrollment",
            self.tokens.enroll,
            files=images(self._people.photos[person]),
        )

    def erase(self, subject: str) -> Operation:
        """Erase, with a key that is never told `not_enrolled`."""
        path = f"/v1/subjects/{subject}"
        return self._send("erase", subject, None, "DELETE", path, self.tokens.erase)

    def describe(self, subject: str) -> Operation:
        """Read the metadata."""
        path = f"/v1/subjects/{subject}"
        return self._send("describe", subject, None, "GET", path, self.tokens.enroll)

    def contract(self) -> Operation:
        """Read what does not depend on any subject."""
        return self._send("contract", "", None, "GET", "/v1/contract", self.tokens.enroll)

    def verify(self, subject: str, person: int) -> Operation:
        """Verify by an embedding, with a token of its own."""
        return self._verify(subject, person, self.tokens.once(subject))

    def replay(self, earlier: Operation) -> Operation:
        """Send an earlier verification again, with its token; not part of the history."""
        assert earlier.person is not None
        again = self._verify(earlier.subject, earlier.person, earlier.token, kept=False)
        self.replays.append((earlier, again))
        return again

    def _verify(self, subject: str, person: int, token: str, *, kept: bool = True) -> Operation:
        return self._send(
            "verify",
            subject,
            person,
            "POST",
            f"/v1/subjects/{subject}/verify",
            token,
            kept=kept,
            json={"embedding": self._people.embeddings[person].tolist()},
        )

    def _send(
        self,
        kind: Kind,
        subject: str,
        person: int | None,
        method: str,
        path: str,
        token: str,
        *,
        kept: bool = True,
        **sent: Any,
    ) -> Operation:
        request_id = f"{next(self._numbers):06d}-{secrets.token_hex(8)}"
        client, headers = self._client(), {**bearer(token), "X-Request-ID": request_id}
        each = Operation(kind, subject, person, request_id, time.monotonic())
        each.token = token
        if kept:
            # Before it is sent: an operation that is never heard of again counts too.
            self.history.append(each)
        try:
            answer = client.request(method, path, headers=headers, **sent)
        except httpx.ConnectError:
            each.outcome, each.answered = NOT_SENT, time.monotonic()
            each.over = each.answered
        except httpx.TimeoutException:
            each.answered, each.over = time.monotonic(), math.inf
        except httpx.TransportError:
            each.answered = time.monotonic()
            each.over = each.answered + SETTLES_S
        else:
            self._read(each, answer)
        return each

    def _read(self, each: Operation, answer: httpx.Response) -> None:
        each.answered = each.over = time.monotonic()
        each.answer = answer.json()
        each.outcome = answer.status_code
        each.code = each.answer.get("error", {}).get("code")
        each.retry_after = answer.headers.get("retry-after")

    def _client(self) -> httpx.Client:
        client: httpx.Client | None = getattr(self._local, "client", None)
        if client is None:
            client = self._local.client = httpx.Client(
                base_url=self.service.url,
                timeout=TIMEOUT_S,
                limits=httpx.Limits(max_keepalive_connections=0),
                trust_env=False,
            )
        return client

    def settle(self) -> None:
        """Note that nothing that was sent before takes effect any more: the service was gone."""
        now = time.monotonic()
        for each in self.history:
            if each.started < now:
                each.over = min(each.over, now)
