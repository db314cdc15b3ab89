"""Moving old lines of the audit log into a file, so that the log does not grow for ever.

An archive is a file of JSON lines: first a signed head, then the audit lines as they were stored::

    {"body": "<canonical JSON>", "signature": "<base64, Ed25519 over the UTF-8 bytes of body>"}
    {"sequence": 1, "at": "…", …, "mac": "<hex>"}

The body names the anchors between which the lines lie, and the SHA-256 of everything after the
first line. So anybody who has the public key of the deployment's receipts can check an archive, and
the anchors of one archive after another, and of the log, show that none is missing.
"""

import hashlib
import json
from dataclasses import dataclass
from datetime import UTC, timedelta
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError
from templates.keys.private_file import create_private
from templates.store.audit_chain import (
    Anchor,
    BrokenAuditLog,
    ChainBreak,
    Head,
    good_lines,
)
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.database import delete
from templates.store.receipts import Receipt, sign_claims, verify_claims
from templates.store.schema import AuditRow
from templates.store.secrets import SecretName

KIND = "veilface-audit-archive"
TOKENS_LAST = timedelta(minutes=10)
"""Longer than any one-use token is good for: until then, the line of its use stays in the log."""


@dataclass(frozen=True)
class Archive:
    """A piece of the audit log in a file: the lines after `base` up to `last`."""

    base: Anchor
    last: Anchor
    lines: int


def archive_audit_log(
    context: StoreContext, file: Path, *, through: int | None, by: By = PROGRAM
) -> Archive:
    """Verify the lines up to a number, write them to a new file, and remove them from the log.

    In one write, for which every other one waits. The file is complete on disk before the lines
    go; where the write fails afterwards, they are in both.

    The archive ends before the first line that used up a token which may still be in time: without
    that line, the token would be good once more.

    `through` is the number of the last line to go; None for all that may.

    Raises
    ------
    BrokenAuditLog
        If the chain breaks among these lines. Nothing is written or removed.
    StoreError
        If there are none, or the file exists or cannot be written.
    """
    with context.database.write() as session:
        archive = write_archive(session, context, file, _last_to_go(session, context, through))
        detail = f"{archive.base.sequence + 1}-{archive.last.sequence}"
        context.audit_log.append(session, Entry("audit-archive", "archived", by, detail=detail))
    context.database.purge_log()
    return archive


def _last_to_go(session: Session, context: StoreContext, through: int | None) -> int | None:
    used_since = (context.clock() - TOKENS_LAST).astimezone(UTC).isoformat(timespec="microseconds")
    query = sa.select(sa.func.min(AuditRow.sequence)).where(
        AuditRow.token.is_not(None), AuditRow.at > used_since
    )
    first_use = session.scalar(query)
    if first_use is None:
        return through
    return first_use - 1 if through is None else min(through, first_use - 1)


def write_archive(
    session: Session, context: StoreContext, file: Path, through: int | None
) -> Archive:
    """:func:`archive_audit_log` inside a write, without the line that tells of it."""
    key = context.audit_log.key
    head = Head.read(session, key)
    end = head.last.sequence if through is None else min(through, head.last.sequence)
    last, texts = head.base, []
    try:
        for values in good_lines(session, key, head, through=end):
            texts.append(json.dumps({**values, "mac": values["mac"].hex()}))
            last = Anchor(values["sequence"], values["mac"])
    except ChainBreak as problem:
        raise BrokenAuditLog(
            f"line {problem.sequence} of the audit log is {problem.what}, and nothing was "
            "archived: run `veilface audit-log verify`"
        ) from None
    if not texts:
        raise StoreError(
            "the audit log holds no line up to this number that may go; nothing was archived"
        )
    body = "".join(f"{text}\n" for text in texts).encode()
    claims: dict[str, Any] = {
        "kind": KIND,
        "base": str(head.base),
        "last": str(last),
        "lines": len(texts),
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    first = sign_claims(claims, context.secrets.get(SecretName.RECEIPT)).to_json()
    try:
        create_private(file, json.dumps(first).encode() + b"\n" + body)
    except OSError as error:
        raise StoreError(f"the archive {file} cannot be written: {error.strerror}") from None
    delete(session, AuditRow, AuditRow.sequence <= last.sequence)
    Head(last, head.last).replace(session, key)
    return Archive(head.base, last, len(texts))


def verify_archive(file: Path, public_key: bytes) -> Archive:
    """Check the signature of an archive by the 32 bytes that verify the deployment's receipts.

    :class:`StoreError` if the file cannot be read, was altered, or is another deployment's.
    """
    try:
        first, _, lines = file.read_bytes().partition(b"\n")
        claims = verify_claims(Receipt.from_json(json.loads(first)), public_key)
        if claims["kind"] != KIND or hashlib.sha256(lines).hexdigest() != claims["sha256"]:
            raise ValueError
        base, last = Anchor.parse(claims["base"]), Anchor.parse(claims["last"])
    except OSError as error:
        raise StoreError(f"the archive {file} cannot be read: {error.strerror}") from None
    except (StoreError, ValueError, KeyError, TypeError):
        raise StoreError(
            f"{file} is no archive of this deployment's audit log, or was altered"
        ) from None
    return Archive(base, last, claims["lines"])
