"""A secret of the deployment: its names, the value in force, and those before it."""

import base64
import hashlib
import hmac
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any

from templates.contract.canonical import Json, canonical_json, parse_object

SECRET_BYTES = 32


class SecretName(StrEnum):
    """Every secret of a deployment; there are no others, so that a renewal forgets none."""

    CHAIN = "audit-chain"
    PSEUDONYM = "pseudonym"
    RECEIPT = "receipt-signing"
    EXPORT = "export"
    STAND_INS = "stand-ins"
    LIFTS = "lifts"


@dataclass(frozen=True)
class RetiredValue:
    """A value that was in force.

    Attributes
    ----------
    value
        32 bytes.
    at
        When it was retired.
    line
        Number of the last line of the audit log from its time.
    """

    value: bytes = field(repr=False)
    at: datetime
    line: int


@dataclass(frozen=True)
class Secret:
    """A secret: the value in force, and those before it.

    Attributes
    ----------
    value
        32 random bytes.
    retired
        The oldest first.
    proof
        Sealed, at the renewal that drew it, under the master key of then, and bound to the value;
        None for one that was never renewed.
    """

    value: bytes = field(repr=False)
    retired: tuple[RetiredValue, ...] = ()
    proof: bytes | None = field(default=None, repr=False)

    def renewed(
        self, *, at: datetime, line: int, prove: Callable[[bytes], bytes | None] = lambda _: None
    ) -> "Secret":
        """Draw a new value, and retire this one; `prove` makes the proof of a value."""
        before = RetiredValue(self.value, at, line)
        value = os.urandom(SECRET_BYTES)
        return Secret(value, (*self.retired, before), prove(value))

    def digests(self, message: bytes) -> tuple[bytes, ...]:
        """Keyed digests of a message under every value, that of the one in force first.

        Each value is applied to the digest under the one before (:func:`digest_again`), so that a
        renewal can bring a digest forward without knowing the message.
        """
        oldest, *later = [*(before.value for before in self.retired), self.value]
        digests = [hmac.digest(oldest, message, hashlib.sha256)]
        for value in later:
            digests.append(digest_again(value, digests[-1]))
        return tuple(reversed(digests))

    def since(self, line: int) -> tuple[bytes, ...]:
        """Values that came into force after a line of the audit log, the oldest first."""
        _, *values = *(before.value for before in self.retired), self.value
        ended = (before.line for before in self.retired)
        return tuple(value for value, end in zip(values, ended, strict=True) if line <= end)

    def digest(self, message: bytes) -> bytes:
        """Keyed digest of a message under the value in force."""
        return self.digests(message)[0]

    def to_bytes(self) -> bytes:
        """What is sealed: the value alone, unless there were others."""
        if not self.retired:
            return self.value
        retired: list[Json] = [
            {"value": _text(before.value), "at": before.at.isoformat(), "line": before.line}
            for before in self.retired
        ]
        proof = None if self.proof is None else _text(self.proof)
        return canonical_json({"value": _text(self.value), "retired": retired, "proof": proof})

    @classmethod
    def from_bytes(cls, plain: bytes) -> "Secret":
        """Read :meth:`to_bytes`'s form."""
        if len(plain) == SECRET_BYTES:
            return cls(plain)
        fields: Any = parse_object(plain, what="a secret")
        retired = (
            RetiredValue(_bytes(key["value"]), datetime.fromisoformat(key["at"]), key["line"])
            for key in fields["retired"]
        )
        proof = None if fields["proof"] is None else _bytes(fields["proof"])
        return cls(_bytes(fields["value"]), tuple(retired), proof)


def digest_again(value: bytes, digest: bytes) -> bytes:
    """Bring a digest under the value before forward to a secret's new value."""
    return hmac.digest(value, digest, hashlib.sha256)


def _text(value: bytes) -> str:
    return base64.b64encode(value).decode()


def _bytes(text: str) -> bytes:
    return base64.b64decode(text, validate=True)
